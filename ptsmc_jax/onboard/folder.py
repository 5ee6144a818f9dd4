"""The folder of an exported controller: C, test vectors, programs that check them, README. Read `export` first."""

import hashlib
import json
import re
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from ptsmc_jax import scenario as scenarios
from ptsmc_jax.campaigns import store
from ptsmc_jax.numerics import draws
from ptsmc_jax.onboard import fmu as fmu_files
from ptsmc_jax.onboard import templates, vectors
from ptsmc_jax.onboard.board import Board, build_board
from ptsmc_jax.onboard.generate import Code, generate
from ptsmc_jax.onboard.plant import plant_board
from ptsmc_jax.onboard.sources import LAYOUT
from ptsmc_jax.onboard.templates import ExportInfo
from ptsmc_jax.scenario import custom, mission, parsing
from ptsmc_jax.scenario.assembly import Study
from ptsmc_jax.scenario.errors import ScenarioError, wrong
from ptsmc_jax.scenario.tables import Scenario


class Controller:
    """The flight computer of a scenario, in C."""

    def __init__(self, scenario: Scenario, name: str, source: str, reference_input: bool = False):
        """Trace the flight computer of a scenario and translate it to C.

        Args:
            scenario: a scenario with a sampled loop; the C uses its flight clock.
            name: name of the controller, a C identifier.
            source: name of the scenario's file, for comments.
            reference_input: whether the reference is an input of the C, instead of a part of it.

        Raises:
            ScenarioError: the flight computer cannot be written in C.
        """
        self.scenario = on_flight_clock(scenario)
        self.ready: Study = scenarios.study(self.scenario)
        self.reference_input = reference_input  # whether the reference is an input
        self.board: Board = build_board(self.ready.parts, reference_input)
        for sensor, place in getattr(self.scenario.sensors, "places", {}).items():
            self.board.meanings[sensor] = f"{place} of scenario.toml. {self.board.meanings[sensor]}"
        self.code: Code = generate(self.board)
        law, device = self.ready.parts.controller, self.ready.parts.actuators
        self.period = float(self.ready.parts.period)  # control period [s]
        # the smallest possible time to go at the last sample before the hand-over [s]
        self.last_time_to_go = float(law.delta) + self.period
        self.info = ExportInfo(
            name, source, checksum(self.scenario), type(law).__qualname__, self.board.parameters["filter"] is not None,
            self.board.model.largest_measurement,
            device.delay, float((law.t_f / self.last_time_to_go) ** 2), mission.describe_default_gains(self.scenario),
        )  # fmt: skip


def on_flight_clock(scenario: Scenario) -> Scenario:
    """Return the scenario with the flight clock, which the exported controller uses.

    Raises:
        ScenarioError: if the loop is continuous, or if the flight computer knows of wheel failures.
    """
    if not scenario.sampled:
        raise wrong("loop.mode", scenario.loop.mode, '"sampled" to be exported: a flight computer has samples')
    failure = getattr(scenario.dispersion, "wheel_failure", None)
    if failure is not None and failure.known:
        raise wrong("dispersion.wheel_failure.known", True, "false to be exported: the C does not know of failures")
    return scenarios.replace(scenario, loop__clock="flight")


def checksum(scenario: Scenario) -> str:
    """Return the SHA-256 of a scenario's tables with all defaults, and of the files that it names."""
    content = json.dumps([parsing.dump(scenario), custom.checksums(scenario)], sort_keys=True, default=str)
    return hashlib.sha256(content.encode()).hexdigest()


def identifier(text: str) -> str:
    """Return a valid C identifier."""
    plain = re.sub(r"\W+", "_", text, flags=re.ASCII).strip("_").lower()
    return plain if plain and not plain[0].isdigit() else f"c_{plain}".rstrip("_")


def simulate(controller: Controller, seed: int, trials: int) -> dict[int, vectors.Samples]:
    """Return simulated trials that can be used as test vectors, by number of the trial.

    Args:
        controller: the controller.
        seed: seed of the trials.
        trials: number of trials.

    Raises:
        ScenarioError: if no trial is usable, see `vectors.is_usable`.
    """
    parts, dispersion = controller.ready.parts, controller.ready.dispersion
    numbers = jnp.arange(trials, dtype=jnp.uint32)
    simulated = vectors.simulate_many(parts, dispersion, jnp.uint32(seed), numbers)
    samples_by_trial = {k: vectors.single_trial(simulated, k) for k in range(trials)}
    usable = {k: samples for k, samples in samples_by_trial.items() if vectors.is_usable(samples)}
    if not usable:
        raise ScenarioError(
            f"none of the first {trials} trials is finite and away from the law's singularity, but the test vectors "
            "need at least one such trial"
        )
    return usable


def vector_table(
    controller: Controller, samples_by_trial: dict[int, vectors.Samples]
) -> tuple[list[str], list[list[float]]]:
    """Return the header and the rows of vectors.csv."""
    columns = controller.code.columns
    names = [f"{kind}.{name}" for kind in ("in", "out", "state") for name in columns[kind]]
    rows: list[list[float]] = []
    for k, samples in samples_by_trial.items():
        inputs, outputs, state = vectors.rows(controller.board, samples)
        zeros = [0.0] * (inputs.shape[1] + outputs.shape[1])
        rows.append([k, -1, 0, *zeros, *vectors.first_state(controller.board, samples).tolist()])
        sample_rows = np.column_stack([inputs, outputs, state]).tolist()
        numbered = enumerate(zip(samples.limited, sample_rows, strict=True))
        rows += [[k, n, int(limited), *row] for n, (limited, row) in numbered]
    return ["trial", "sample", "status", *names], rows


def controller_model(controller: Controller) -> fmu_files.Model:
    """Return the controller as the model of an FMU."""
    code, info = controller.code, controller.info
    texts = templates.controller_texts(code, info)
    filter_state = [field for field in code.state if info.has_filter and field.name in fmu_files.FILTER_STATE]
    title, t_end = f"controller of {info.scenario}", float(controller.ready.parts.t_end)
    c_texts = {name: texts[name] for name in (f"{info.stem}.c", f"{info.stem}.h")}
    return fmu_files.Model(code, info, title, c_texts, t_end, filter_state)


def plant_model(controller: Controller) -> fmu_files.Model:
    """Return the true plant of a controller's scenario as the model of an FMU.

    Raises:
        ScenarioError: if it cannot be written in C.
    """
    ready, info = controller.ready, controller.info._replace(name=f"{controller.info.name}_plant", has_filter=False)
    code = generate(plant_board(ready.parts, ready.dispersion, controller.board))
    if code.underivable:
        raise ScenarioError(f"the plant cannot be exported: {next(iter(code.underivable.values()))}")
    title = f"plant of {info.scenario}"
    return fmu_files.Model(code, info, title, templates.plant_texts(code, info), float(ready.parts.t_end), plant=True)


class Fmus(NamedTuple):
    """The FMUs to write beside the C."""

    controller: bool = False
    plant: bool = False
    version: int | None = None  # version of FMI, 2 or 3; None: both
    binary: bool = True  # whether they contain a binary for this machine

    def write(self, folder: Path, controller: Controller) -> None:
        """Write the FMUs of a controller and of its plant into a folder.

        Raises:
            ScenarioError: if the plant cannot be written in C, or there is no C compiler for a binary.
        """
        for name, build_model in (("controller", controller_model), ("plant", plant_model)):
            if getattr(self, name):
                model = build_model(controller)
                for version in self.versions:
                    fmu_files.write_fmu(folder / f"{name}_fmi{version}.fmu", model, version, binary=self.binary)

    @property
    def versions(self) -> tuple[int, ...]:
        """The versions of FMI to write."""
        return fmu_files.VERSIONS if self.version is None else (self.version,)

    @property
    def files(self) -> list[str]:
        """The names of the FMUs."""
        kinds = [name for name in ("controller", "plant") if getattr(self, name)]
        return [f"{name}_fmi{version}.fmu" for name in kinds for version in self.versions]


def write(folder: Path, controller: Controller, seed: int, trials: int, fmus: Fmus) -> None:
    """Write all files into an existing folder.

    Args:
        folder: the folder.
        controller: the controller.
        seed: seed of the trials in the test vectors.
        trials: number of these trials.
        fmus: the FMUs to write.
    """
    fmus.write(folder, controller)
    samples_by_trial, t_f = simulate(controller, seed, trials), float(controller.ready.parts.controller.t_f)
    rounding, last = controller.board.model.error_rounding, controller.last_time_to_go
    header, rows = vector_table(controller, samples_by_trial)
    growth = min(vectors.rounding_growth(samples, rounding, t_f, last) for samples in samples_by_trial.values())
    write_program(folder, controller, growth)
    store.write_csv(folder / "vectors.csv", header, rows)
    origin = {"command": "export", "seed": seed, **custom.checksums(controller.scenario)}
    store.write_run_files(folder, parsing.dump(controller.scenario), origin)


def write_program(folder: Path, controller: Controller, rounding_growth: float = 0.0) -> None:
    """Write the files that do not need trials.

    Args:
        folder: the folder.
        controller: the controller.
        rounding_growth: lower limit of the growth of rounding errors in check.c, see `ExportInfo`.
    """
    code, info = controller.code, controller.info
    info = info._replace(rounding_growth=max(info.rounding_growth, rounding_growth))
    texts = templates.controller_texts(code, info) | {"README.md": templates.readme(code, info)}
    for name, text in texts.items():
        store.write_text(folder / name, templates.with_public_prefix(text, info.name))
    layout = {
        "name": info.name,
        "checksum": info.checksum,
        "period": controller.period,
        "parts": controller.board.part_descriptions,
        "reference_input": controller.reference_input,
        "columns": code.columns,
    }
    store.write_json(folder / LAYOUT, layout)


def export(
    what: Scenario | str | Path, folder: str | Path, *, name: str | None = None, trials: int = 3, seed: int = 0,
    force: bool = False, reference_input: bool = False, fmu: bool = False, fmu_plant: bool = False,
    fmi: int | None = None, binary: bool = True,
) -> Path:  # fmt: skip
    """Write a scenario's flight computer as C99 into a folder, with test vectors.

    Args:
        what: the scenario or its file.
        folder: the new folder.
        name: name of the files; by default the name of the scenario's file.
        trials: number of trials in the test vectors.
        seed: seed of the trials.
        force: whether to write into a folder that has content.
        reference_input: whether the reference is an input of the C instead of a function of time in it.
        fmu: whether to write the controller as an FMU.
        fmu_plant: whether to write the true plant as an FMU.
        fmi: version of FMI, 2 or 3; None: both.
        binary: whether an FMU contains a binary for this machine besides its sources.

    Returns:
        The folder.

    Raises:
        ScenarioError: if the loop is continuous, C cannot express a part, or there is no C compiler for an FMU.
        RefusedError: if the folder has content, and `force` is not set.
        ValueError: if `trials`, `seed` or `fmi` is not a valid number.
    """
    path = Path(folder)
    if fmi not in (None, *fmu_files.VERSIONS):
        raise ValueError(f"fmi is {fmi!r}, but must be 2, 3 or None for both")
    draws.check_whole_number("trials", trials, 1)
    draws.check_whole_number("seed", seed)
    store.check_folder(path, force)
    loaded = what if isinstance(what, Scenario) else scenarios.read(what)
    source = "a scenario" if isinstance(what, Scenario) else Path(what).name
    stem = identifier(name or ("flight" if isinstance(what, Scenario) else Path(what).stem))
    controller = Controller(loaded, stem, source, reference_input)
    fmus = Fmus(fmu, fmu_plant, fmi, binary)
    with store.lock_folder(path, force=force):
        store.write_folder(path, lambda making: write(making, controller, seed, trials, fmus))
    return path
