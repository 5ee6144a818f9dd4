"""A controller's folder: C, vectors, what checks them, and what it all is."""

import hashlib
import json
import re
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from ptsmc_jax import scenario as scenarios
from ptsmc_jax.campaigns import store
from ptsmc_jax.numerics import draws
from ptsmc_jax.onboard import templates, vectors
from ptsmc_jax.onboard.board import Board, board
from ptsmc_jax.onboard.generate import Code, generate
from ptsmc_jax.onboard.readme import readme
from ptsmc_jax.onboard.sources import LAYOUT
from ptsmc_jax.onboard.templates import About
from ptsmc_jax.onboard.translate import NoRuleError
from ptsmc_jax.scenario import own, parsing
from ptsmc_jax.scenario.errors import ScenarioError, wrong
from ptsmc_jax.scenario.flyable import Study
from ptsmc_jax.scenario.tables import Scenario


class Controller:
    """The flight computer of a scenario, in C."""

    def __init__(self, scenario: Scenario, name: str, source: str):
        """Traces and writes it; raises ScenarioError where it cannot be."""
        self.scenario = flown(scenario)
        self.ready: Study = scenarios.study(self.scenario)
        self.board: Board = board(self.ready.parts)
        try:
            self.code: Code = generate(self.board)
        except NoRuleError as error:
            raise ScenarioError(str(error)) from None
        law, device = self.ready.parts.controller, self.ready.parts.actuators
        self.about = About(
            name, source, digest(self.scenario), type(law).__qualname__, self.board.parameters["filter"] is not None,
            self.board.spacecraft, device.wheels is not None,
            device.delay, float((law.t_f / self.last) ** 2),
        )  # fmt: skip

    @property
    def period(self) -> float:
        """The control period [s]."""
        return float(self.ready.parts.period)

    @property
    def last(self) -> float:
        """How long before t_f the last sample before the hand-over may be [s]."""
        return float(self.ready.parts.controller.delta) + self.period


def flown(scenario: Scenario) -> Scenario:
    """The scenario as a flight computer has it, on the flight clock.

    Raises ScenarioError of a continuous loop, and of failures that it would be told of.
    """
    if not scenario.sampled:
        raise wrong("loop.mode", scenario.loop.mode, '"sampled" to be exported: a flight computer has samples')
    failure = getattr(scenario.dispersion, "wheel_failure", None)
    if failure is not None and failure.known:
        raise wrong("dispersion.wheel_failure.known", True, "false to be exported: the C is not told of failures")
    return scenarios.replace(scenario, loop__clock="flight")


def digest(scenario: Scenario) -> str:
    """SHA-256 of a scenario's tables, every default filled in, and of the files that it names."""
    said = json.dumps([parsing.dump(scenario), own.digests(scenario)], sort_keys=True, default=str)
    return hashlib.sha256(said.encode()).hexdigest()


def identifier(text: str) -> str:
    """A name that C takes."""
    plain = re.sub(r"\W+", "_", text, flags=re.ASCII).strip("_").lower()
    return plain if plain and not plain[0].isdigit() else f"c_{plain}".rstrip("_")


def fly(made: Controller, seed: int, trials: int) -> dict[int, vectors.Samples]:
    """Those of so many trials that are usable, by their number."""
    dispersion = vectors.known_alike(made.ready.dispersion)
    numbers = np.arange(trials, dtype=np.uint32)
    flown = vectors.fly_many(made.ready.parts, dispersion, jnp.uint32(seed), jnp.asarray(numbers))
    each = {int(k): vectors.one(flown, int(k)) for k in numbers}
    usable = {k: samples for k, samples in each.items() if vectors.usable(samples)}
    if not usable:
        raise ScenarioError(
            f"none of the first {trials} trials stays finite and away from the law's singularity: nothing to check by"
        )
    return usable


def table(made: Controller, flown: dict[int, vectors.Samples]) -> tuple[list[str], list[list[Any]]]:
    """Header and rows of vectors.csv."""
    lists = templates.columns(made.code)
    header = [
        "trial",
        "sample",
        "status",
        *(f"{kind}.{name}" for kind in ("in", "out", "state") for name in lists[kind]),
    ]
    rows: list[list[Any]] = []
    for k, samples in flown.items():
        given, out, state = vectors.rows(made.board, samples)
        nothing = [0.0] * (given.shape[1] + out.shape[1])
        rows.append([k, -1, 0, *nothing, *vectors.first_state(made.board, samples).tolist()])
        together = np.column_stack([given, out, state]).tolist()
        rows += [[k, n, int(cut), *row] for n, (cut, row) in enumerate(zip(samples.limited, together, strict=True))]
    return header, rows


def write(folder: Path, made: Controller, seed: int, trials: int) -> None:
    """Fills a folder that is there."""
    flown, t_f = fly(made, seed, trials), float(made.ready.parts.controller.t_f)
    header, rows = table(made, flown)
    steepness = min(vectors.steepness(one, t_f, made.last) for one in flown.values()) if made.board.spacecraft else 0.0
    write_program(folder, made, steepness)
    store.write_csv(folder / "vectors.csv", header, rows)
    made_by = {"command": "export", "seed": seed, **own.digests(made.scenario)}
    store.record(folder, parsing.dump(made.scenario), made_by)


def write_program(folder: Path, made: Controller, steepness: float = 0.0) -> None:
    """The files without any trial's numbers; steepness: check.c is to allow for at least this one, see `About`."""
    code, about = made.code, made.about._replace(steepness=max(made.about.steepness, steepness))
    texts = {
        f"ptsmc_{about.name}.h": templates.header(code, about),
        f"ptsmc_{about.name}.c": templates.source(code, about),
        f"ptsmc_{about.name}_parameters.c": templates.values(code, about),
        f"ptsmc_{about.name}_flat.h": templates.flat(code, about),
        "check.c": templates.check(code, about),
        "fuzz.c": templates.fuzz(code, about),
        "Makefile": templates.makefile(about),
        "README.md": readme(code, about),
    }
    for name, text in texts.items():
        store.write_text(folder / name, templates.prefixed(text, about.name))
    layout = {"name": about.name, "digest": about.digest, "period": made.period, "parts": made.board.parts}
    layout["columns"] = templates.columns(code)
    store.write_json(folder / LAYOUT, layout)


def export(
    what: Scenario | str | Path, folder: str | Path, *, name: str | None = None, trials: int = 3, seed: int = 0,
    force: bool = False,
) -> Path:  # fmt: skip
    """Writes a scenario's flight computer as C99 into a folder, with vectors of so many trials that check it.

    name: of its files, by default the scenario's file. Raises ScenarioError where it cannot be written in C, or its
    loop is continuous; RefusedError where the folder holds something and force is not said; ValueError where trials or
    seed are no such numbers.
    """
    path = Path(folder)
    draws.check_whole_number("trials", trials, 1)
    draws.check_whole_number("seed", seed)
    store.check(path, force)
    known = what if isinstance(what, Scenario) else scenarios.read(what)
    source = "a scenario" if isinstance(what, Scenario) else Path(what).name
    made = Controller(known, identifier(name or ("flight" if isinstance(what, Scenario) else Path(what).stem)), source)
    with store.in_use(path, force=force):
        store.write(path, lambda making: write(making, made, seed, trials))
    return path
