"""Options that several commands share."""

import contextlib
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter, Token
from cyclopts.validators import Number

from ptsmc_jax import units
from tuning.errors import UsageError

if TYPE_CHECKING:
    from ptsmc_jax.scenario.tables import Scenario


def _parse_integer(_: object, tokens: Sequence[Token]) -> int:
    """Return the whole number of an option; raise ValueError for other texts."""
    text = tokens[0].value
    if not text.removeprefix("-").isdecimal():  # cyclopts would round 2.5
        raise ValueError(f"{text} is no whole number")
    return int(text)


def whole_number(minimum: int = 0, maximum: int = 2**32 - 1, **others: Any) -> Parameter:
    """Return an option that is a whole number in a range; others: see `Parameter`."""
    return Parameter(converter=_parse_integer, validator=Number(gte=minimum, lte=maximum), **others)


def positive(unit: str) -> Parameter:
    """Return an option that is a finite number greater than 0 in a unit, or with another unit such as "2 deg/s"."""

    def parse(_: object, tokens: Sequence[Token]) -> float:
        text = tokens[0].value
        try:
            return units.to_number(text, unit)
        except ValueError:
            raise ValueError(f"{text} is no number in {unit} or with a unit such as {units.EXAMPLES[unit]}") from None

    return Parameter(converter=parse, validator=Number(gt=0, lt=float("inf")))


ScenarioFile = Annotated[Path | None, Parameter(help="Scenario file (TOML); default: the paper's Case I.")]
SampledFile = Annotated[Path | None, Parameter(help='Scenario file (TOML) with loop.mode = "sampled".')]
Out = Annotated[
    Path | None, Parameter(help="Folder for the results; default: out/COMMAND-NAME with the name of the scenario file.")
]
Seed = Annotated[int, whole_number(help="Seed of all random numbers, 0 to 4294967295.")]
Force = Annotated[bool, Parameter(help="Write into a folder that is not empty.")]
Quiet = Annotated[bool, Parameter(help="Print nothing but errors.")]
Figures = Annotated[bool, Parameter(negative="--no-figures", help="Draw figures.")]

ControllerFolder = Annotated[
    Path | None,
    Parameter(help="Folder of `ptsmc export`: its C code is compiled and controls the simulation."),
]
Trust = Annotated[
    bool,
    Parameter(
        help="Run the Python files that results name. Read them first: they run with your permissions.",
    ),
]


@Parameter(name="*")  # each field of the class is an option of the command
@dataclass(frozen=True)
class Common:
    """The options of every command that runs code of the user and writes a result folder."""

    trust: Trust = False
    force: Force = False
    quiet: Quiet = False
    figures: Figures = True


USUAL = Common()

Device = Annotated[Literal["cpu", "gpu"], Parameter(help="Hardware that batches run on.")]


@contextlib.contextmanager
def resumable(force: bool) -> Iterator[None]:
    """Let a Ctrl-C report that the same command resumes this work; force: whether the command had --force."""
    try:
        yield
    except KeyboardInterrupt:
        raise KeyboardInterrupt(how_to_resume(force)) from None


def how_to_resume(force: bool) -> str:
    """Return how to resume interrupted work; force: whether the command had --force, which would start again."""
    return f"the same command{' without --force' if force else ''} resumes it"


# option for the values of each quantity, their unit, their smallest number, and the allowed values
VALUES = {
    "torque": ("--points", "", 1, ""),
    "t_f": ("--times", "s", 2, "two times or more in s or with a unit, all different, such as 20,30,45 or 20s,1min"),
    "margins": ("--limits", "dB", 1, "limits in dB, greater than 0 and all different, such as 4,6,9"),
}


def parse_traded_values(against: str, points: int | None, times: str | None, limits: str | None) -> tuple[float, ...]:
    """Check --points, --times and --limits, and return the times or the limits in ascending order.

    Args:
        against: the quantity to trade, a key of `VALUES`.
        points: value of --points; None: it is absent.
        times: value of --times: times in s, separated by commas; None: it is absent.
        limits: value of --limits: limits in dB, separated by commas; None: it is absent.

    Returns:
        Times [s] or limits [dB]; empty if neither option is present.

    Raises:
        UsageError: an option does not belong to this quantity, or its values are not allowed.
    """
    numbers: tuple[float, ...] = ()
    for (kind, (option, unit, fewest, allowed)), value in zip(VALUES.items(), (points, times, limits), strict=True):
        if value is not None and against != kind:
            raise UsageError(f"{option} is {value}, but must be absent without --against {kind}")
        if isinstance(value, str):
            with contextlib.suppress(ValueError):
                numbers = tuple(sorted(units.to_number(part, unit) for part in value.split(",")))
            valid = all(0.0 < number < float("inf") for number in numbers)
            if len(numbers) < fewest or len(set(numbers)) < len(numbers) or not valid:
                raise UsageError(f"{option} is {value}, but must be {allowed}")
    return numbers


def prepare(
    scenario: Path | None,
    command: str,
    out: Path | None,
    device: Literal["cpu", "gpu"] = "cpu",
    bits: Literal[32, 64] = 64,
    *,
    trust: bool,
    force: bool | None = None,
    in_c: bool = False,
) -> "tuple[Scenario, Path]":
    """Check a scenario and the folder for its results, and configure JAX.

    Args:
        scenario: path of the scenario file; None: the paper's Case I.
        command: name of the command, which the default name of the folder contains.
        out: the folder of the option --out.
        device: hardware of the simulations.
        bits: floating-point precision.
        trust: whether custom code may be run if the scenario is in a result folder.
        force: whether the folder may contain files; None: the command checks the folder later.
        in_c: whether exported C code controls the simulations, which has the flight clock.

    Returns:
        The scenario, and the folder.

    Raises:
        ScenarioError: the scenario is not valid, or C code cannot control it.
        RefusedError: the folder must not be written to, or the scenario names code that must not be run.
        UsageError: the device is not available.
    """
    from ptsmc_jax.scenario import reading

    loaded = reading.from_tables({}) if scenario is None else reading.read(scenario)
    name = "default" if scenario is None else scenario.stem
    folder = out if out is not None else Path("out") / f"{command}-{name}"
    if force is not None:
        from ptsmc_jax.campaigns import store

        store.check_folder(folder, force)
    from ptsmc_jax.configure import NoDeviceError, configure

    try:
        configure(device=device, bits=bits, keep_programs=True)
    except NoDeviceError as error:
        raise UsageError(f"--device is {device}, but {error}") from None
    if scenario is not None:
        from ptsmc_jax.scenario import parsing
        from tuning.search import custom_parts

        if not any(parsing.stated_tables(loaded).values()):
            print(f"ptsmc: {scenario} is empty; the paper's Case I is simulated", file=sys.stderr)
        custom_parts.allow_scenario(scenario, loaded, trust)
    loaded = reading.complete(loaded)
    if in_c:
        from ptsmc_jax.onboard.folder import on_flight_clock

        loaded = on_flight_clock(loaded)
    return loaded, folder
