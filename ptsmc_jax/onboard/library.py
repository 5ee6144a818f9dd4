"""Compiled controllers as the flight computer of a simulation (software in the loop).

Read `Library` first, which compiles an exported folder, then `InTheLoop`, which connects it to the simulation.
"""

import ctypes
import itertools
import json
import os
import re
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from ptsmc_jax.devices.actuators import ActuatorState
from ptsmc_jax.devices.ticks import Ticks
from ptsmc_jax.dispersions.variation import Dispersion
from ptsmc_jax.numerics.draws import WholeNumber
from ptsmc_jax.observers.base import Bound
from ptsmc_jax.onboard import sources
from ptsmc_jax.onboard.board import Values, board_parameters, build_board
from ptsmc_jax.onboard.fields import COMPUTED, collect_parameters, name_parameters
from ptsmc_jax.onboard.generate import column_names
from ptsmc_jax.onboard.templates import fill_template, with_public_prefix
from ptsmc_jax.plants.base import State
from ptsmc_jax.scenario.errors import ScenarioError
from ptsmc_jax.simulation.assembly import Parts
from ptsmc_jax.simulation.computer import PYTHON_SOFTWARE, SAMPLE_STATUSES, Computer, Decision, Period, Software

PARAMETER_TOLERANCE = 1e-6  # smaller differences, relative to the largest element, may be rounding to 32 bits
MOST_LISTED = 4  # largest number of different parameters that a message lists
_loaded = itertools.count()  # number of the next library, for unique names in XLA


def compiler() -> list[str]:
    """Return the command of the C compiler. Raises ScenarioError if there is none."""
    configured = os.environ.get("CC", "").split()
    for command in [configured] if configured else (["cc"], ["gcc"], ["clang"]):
        if shutil.which(command[0]):
            return command
    name = "".join(f" {part}" for part in configured)
    raise ScenarioError(f"there is no C compiler{name}; install cc, gcc or clang, or set CC to one")


def compile_library(*arguments: str, folder: Path | None = None) -> str:
    """Compile a shared library in a folder; return the first error of the compiler, empty if there is none.

    Raises:
        ScenarioError: if there is no C compiler.
    """
    command = [*compiler(), "-std=c99", "-O2", "-shared", "-fPIC", *arguments, "-lm"]
    process = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    if process.returncode == 0:
        return ""
    lines = process.stderr.strip().splitlines() or ["without a message"]
    errors = [line for line in lines if "error: " in line and not line.startswith("collect2: ")]
    return (errors or lines)[0]


class Library:
    """A compiled controller. Its `parameters` begin with the values of its folder and may be changed."""

    def __init__(self, folder: str | Path, real: str = "double", options: tuple[str, ...] = ()):
        """Compile and load a controller.

        Args:
            folder: folder that `ptsmc export` has written.
            real: type of real numbers in C, "double" or "float".
            options: further options of the C compiler.

        Raises:
            ScenarioError: the folder is not a controller, does not compile, or does not load.
        """
        self.folder = Path(folder)
        invalid = ScenarioError(f"the controller is {self.folder}, but must be a folder that ptsmc export has written")
        try:
            layout = json.loads((self.folder / sources.LAYOUT).read_text(encoding="utf-8"))
            self.name, self.checksum, self.columns = layout["name"], layout["checksum"], layout["columns"]
            self.period = float(layout["period"])  # control period [s]
            self.reference_input = bool(layout["reference_input"])
            self.part_descriptions = dict(layout["parts"])  # see `Board.part_descriptions`
            sizes = [len(self.columns[kind]) for kind in ("in", "out", "state", "params")]
            if not re.fullmatch(r"\w+", self.name, re.ASCII):
                raise invalid
        except (OSError, ValueError, OverflowError, KeyError, TypeError):
            raise invalid from None
        self.binary = self._load(real, options)
        # other sizes: the C belongs to another controller.json
        if sizes != list((ctypes.c_long * 4).in_dll(self.binary, "ptsmc_sizes")):
            raise invalid
        # parameters (columns,) in the order of columns["params"]; the array shares its memory with the C
        self.parameters = np.ctypeslib.as_array((ctypes.c_double * sizes[-1]).in_dll(self.binary, "ptsmc_given"))
        self.target = f"ptsmc_{self.name}_{self.checksum}_{real}_{next(_loaded)}"  # name of the C function in XLA
        jax.ffi.register_ffi_target(self.target, jax.ffi.pycapsule(self.binary.ptsmc_called), platform="cpu")

    def _load(self, real: str, options: tuple[str, ...]) -> ctypes.CDLL:
        """Compile and load the C. The library stays loaded after its file has been deleted."""
        with tempfile.TemporaryDirectory(prefix="ptsmc-") as build_folder:
            glue, library, copied = (Path(build_folder) / name for name in ("glue.c", "controller.so", "controller"))
            glue.write_text(with_public_prefix(fill_template("in_the_loop.c", name=self.name), self.name), "utf-8")
            sources.copy(self.folder, copied)  # only those files that campaigns store and check
            files = [str(copied / f"ptsmc_{self.name}{end}.c") for end in ("", "_parameters")]
            # XLA's headers are system headers, so that compilers warn of our code only
            flags = "-isystem", jax.ffi.include_dir(), *options, f"-DPTSMC_REAL={real}", f"-I{copied}"
            error = compile_library(*flags, *files, str(glue), "-o", str(library))
            if error:
                error = error.replace(str(copied), str(self.folder))
                raise ScenarioError(f"the *.c and *.h files of the controller in {self.folder} do not compile: {error}")
            try:
                binary = ctypes.CDLL(str(library))
                binary.ptsmc_set()
            except (OSError, AttributeError) as error:  # built for another processor or language, or without a function
                reason = str(error).removeprefix(f"{library}: ")
                raise ScenarioError(
                    f"the controller in {self.folder} does not load after {' '.join(compiler())} has compiled it: "
                    f"{reason}; use a C compiler for this machine, and put or #include all code in "
                    f"ptsmc_{self.name}.c and ptsmc_{self.name}_parameters.c"
                ) from None
        return binary

    def initial_state(self) -> np.ndarray:
        """Return the state after `ptsmc_init`."""
        state = np.zeros(len(self.columns["state"]))
        self.binary.ptsmc_first(ctypes.c_void_p(state.ctypes.data))
        return state

    def step_in_jax(self, state: jax.Array, inputs: jax.Array, parameters: jax.Array) -> tuple[jax.Array, ...]:
        """Call `ptsmc_step` for one row in a JAX program, or for many rows under vmap.

        Args:
            state: state (columns,), whose precision, 32 or 64 bits, is that of the results.
            inputs: inputs (columns,).
            parameters: parameters (columns,); NaN selects the value of `self.parameters`.

        Returns:
            The new state (columns,), the outputs (columns,) and the status.
        """
        real = jnp.promote_types(jnp.result_type(state, float), jnp.float32)
        state, inputs, parameters = (
            jnp.asarray(v, real).reshape(len(self.columns[kind]))
            for v, kind in ((state, "state"), (inputs, "in"), (parameters, "params"))
        )
        out = jax.ShapeDtypeStruct((len(self.columns["out"]),), real)
        results = jax.ShapeDtypeStruct(state.shape, real), out, jax.ShapeDtypeStruct((), jnp.int32)

        # a callback would deadlock: it waits for a thread that copies arrays, and each device may block one
        call: Any = jax.ffi.ffi_call(self.target, results, vmap_method="broadcast_all")
        return tuple(call(state, inputs, parameters))


class InTheLoop:
    """A compiled controller as the flight computer of a simulation.

    The simulator computes the true motion, the measurements with noise, and the actuators. The C reads the measurements
    and returns the commands.
    """

    def __init__(self, library: Library, parts: Parts, dispersion: Dispersion | None = None):
        """Check that a controller and the parts of a simulation belong together.

        Args:
            library: the compiled controller.
            parts: nominal parts of the simulation.
            dispersion: dispersions of the simulation; None: there are none.

        Raises:
            ScenarioError: the controller is for other parts, or its parameters cannot have the dispersions.
        """
        self.library, self.board, self.nominal = library, build_board(parts, library.reference_input), parts
        board_columns = column_names(self.board)
        for kind, noun in (("in", "inputs"), ("out", "outputs"), ("state", "state")):
            if library.columns[kind] != board_columns[kind]:
                raise ScenarioError(
                    f"the controller in {library.folder} has other {noun} than the scenario, but must be an export of "
                    "one with the same plant, law, observer, filter and actuators"
                )
        for name in self.board.part_descriptions | library.part_descriptions:
            own, required = (
                parts.get(name, "none") for parts in (library.part_descriptions, self.board.part_descriptions)
            )
            if own != required:
                raise ScenarioError(
                    f"the controller in {library.folder} has the {name} {own}, but must have the {name} of the "
                    f"scenario, {required}"
                )
        # either number may have been rounded to 32 bits
        period, c_period = np.float32(parts.period), np.float32(library.period)
        if period != c_period:
            raise ScenarioError(
                f"loop.period is {period!s} s, but must be {c_period!s} s as in the controller in {library.folder}"
            )
        # the first column of each parameter in C, by its path
        self._columns, columns = dict[tuple, int](), {name: k for k, name in enumerate(library.columns["params"])}
        leaves = jax.tree_util.tree_leaves_with_path(self.board.parameters)
        for (path, _), member in zip(leaves, name_parameters(self.board).fields, strict=True):
            if member.size and member.elements()[0] in columns:
                self._columns[path] = columns[member.elements()[0]]
        self.software = Software(self.boot, self.decide, self.statuses, on_processor=True)  # for a simulation
        self._read_outputs, self._read_state = map(_tree_reader, (self.board.outputs, self.board.state))
        if dispersion is not None and dispersion.custom is not None:
            self._check_custom_dispersion(Dispersion(custom=dispersion.custom))

    def _check_custom_dispersion(self, dispersion: Dispersion) -> None:
        """Raise ScenarioError if a custom dispersion changes only one of several values that share a parameter in C."""
        params, numbers = collect_parameters(self.board), (jnp.uint32(0), jnp.uint32(0))
        drawn = updated = board_parameters(dispersion.apply(self.nominal, *numbers))
        for rule in params.rules:
            updated = rule(updated)
        drawn_leaves, updated_leaves = (dict(jax.tree_util.tree_leaves_with_path(tree)) for tree in (drawn, updated))
        first_values = dict[str, jax.Array]()
        pairs = zip(jax.tree_util.tree_leaves_with_path(self.board.parameters), params.fields, strict=True)
        for (path, _), field in sorted(pairs, key=lambda item: item[0][0][0].key in COMPUTED):
            value = drawn_leaves[path]
            is_derived = field.name in params.derived
            reference = updated_leaves[path] if is_derived else first_values.setdefault(field.name, value)
            tolerance = PARAMETER_TOLERANCE * float(jnp.max(jnp.abs(value), initial=0.0))
            if not np.allclose(reference, value, rtol=0.0, atol=tolerance, equal_nan=True):
                raise ScenarioError(
                    f"dispersion.custom changes {jax.tree_util.keystr(path, simple=True, separator='.')} alone, but "
                    f"the controller in {self.library.folder} has the single parameter {field.name} for it and other "
                    "values; change all of them in the same way"
                )

    @property
    def parameter_differences(self) -> str:
        """A sentence that lists the parameters of C that differ from the scenario; empty if there are none."""
        compiled = dict(zip(self.library.columns["params"], self.library.parameters, strict=True))
        params, differing = name_parameters(self.board), list[str]()
        for member in dict.fromkeys(params.fields):
            values = params.values[member.name]
            tolerance = PARAMETER_TOLERANCE * np.max(np.abs(values), initial=0.0, where=np.isfinite(values))
            for element, value in zip(member.elements(), values.flat, strict=True):
                if element in compiled and not np.isclose(compiled[element], value, rtol=0.0, atol=tolerance):
                    differing.append(f"{element} = {compiled[element]:.6g} instead of {value:.6g}")
        if not differing:
            return ""
        rest = f" and {len(differing) - MOST_LISTED} more" if len(differing) > MOST_LISTED else ""
        return f"the controller has other parameters than the scenario: {', '.join(differing[:MOST_LISTED])}{rest}"

    def boot(self, parts: Parts, seed: WholeNumber, trial: WholeNumber, x0: State, first: Ticks) -> Computer:
        """Return the flight computer before the first sample, with the state of `ptsmc_init`.

        The state of an attitude filter is replaced by that of a filter that has run before the manoeuvre.

        Args:
            parts: the scenario of the trial.
            seed: seed of the campaign.
            trial: number of the trial.
            x0: true state at the first sample.
            first: the first control period.
        """
        computer = PYTHON_SOFTWARE.boot(parts, seed, trial, x0, first)
        state = jnp.asarray(self.library.initial_state())
        for name, value in parts.sensors.filter_state(computer.sensors).items():
            start = self.library.columns["state"].index(name + "[0]" * value.ndim)
            state = state.at[start : start + value.size].set(jnp.ravel(value))
        return computer._replace(sensors=(computer.sensors, state, jnp.zeros(len(SAMPLE_STATUSES), jnp.int32)))

    def decide(
        self,
        parts: Parts,
        k2: Bound,
        period: Period,
        computer: Computer,
        x: State,
        star_x: State,
        acting: ActuatorState,
    ) -> tuple[Decision, Computer]:
        """Return the decision of `ptsmc_step` for a control period, and the flight computer after it.

        Args:
            parts: the scenario of the trial.
            k2: not used, because the C computes the bound on the estimation error itself.
            period: the control period.
            computer: the flight computer before the sample.
            x: true state at the sample.
            star_x: true state at the times of `Sensor.newest_reading_age`.
            acting: true state of the actuators, for telemetry.
        """
        (now, dt_before, *_), (sensing, state, counts) = period, computer.sensors
        inputs, sensing = parts.sensors.inputs(sensing, x, now, dt_before, star_x)
        inputs |= {"wheel_momentum": acting.h, "acting": acting.v, "reference": parts.reference(now.t)}
        if computer.applied is not None:
            inputs["applied"] = computer.applied[0]
        leaves = jax.tree.leaves([inputs[name] for name in self.board.inputs])
        row = jnp.concatenate([now.t[None], *map(jnp.ravel, leaves)])
        after, out, status = self.library.step_in_jax(state, row, self._changed_parameters(parts))
        has_length = period.length > 0.0
        after = jnp.where(has_length, after, state)
        other_index = SAMPLE_STATUSES.index("other")
        counted_index = jnp.where((status >= 0) & (status < other_index), status, other_index)
        counts = counts.at[counted_index].add(has_length.astype(counts.dtype))
        outputs, memory = self._read_outputs(out), self._read_state(after[3:])
        channels = outputs.get("wheel_torque", outputs.get("torque"))
        measured = self.board.model.state_of(memory)
        decision = Decision(parts.reference(now.t), outputs["d_hat"], outputs["command"], outputs["s"],
                            parts.plant.velocity(measured), channels)  # fmt: skip
        memories = memory["observer"], memory["law"], computer.applied, memory.get("command_filter")
        return decision, Computer((sensing, after, counts), measured, *memories)

    def statuses(self, computer: Computer) -> dict[str, jax.Array]:
        """Return the number of samples of a run with each status."""
        return dict(zip(SAMPLE_STATUSES, computer.sensors[2], strict=True))

    def _changed_parameters(self, parts: Parts) -> jax.Array:
        """Return the parameters (columns,) that a trial changes, with NaN for unchanged ones."""
        changed = jnp.full(len(self.library.columns["params"]), jnp.nan)
        trees = (board_parameters(source) for source in (parts, self.nominal))
        drawn, nominal = (dict(jax.tree_util.tree_leaves_with_path(tree)) for tree in trees)
        for path, start in self._columns.items():
            value = jnp.where(jnp.any(drawn[path] != nominal[path]), jnp.ravel(drawn[path]), jnp.nan)
            changed = changed.at[start : start + value.size].set(value)
        return changed


def _tree_reader(shapes: Values) -> Callable[[jax.Array], Values]:
    """Return the function from a row, which may be longer than necessary, to trees of these shapes by name."""
    zeros = [jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shape) for shape in shapes.values()]
    flat, unravel = ravel_pytree(zeros)
    return lambda row: dict(zip(shapes, unravel(row[: flat.size]), strict=True))
