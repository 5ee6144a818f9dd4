"""What the commands share: their options, and how these are read. A value that cannot be followed is a `UsageError`."""

import contextlib
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter, Token
from cyclopts.validators import Number

from tuning.errors import UsageError

if TYPE_CHECKING:
    from ptsmc_jax.scenario.tables import Scenario


def _integer(_: object, tokens: Sequence[Token]) -> int:
    text = tokens[0].value
    if not text.removeprefix("-").isdecimal():  # cyclopts would round 2.5
        raise ValueError(f"{text} is no whole number")
    return int(text)


def whole(text: str, least: int = 0, most: int = 2**32 - 1, **others: Any) -> Parameter:
    """Return an option that is a whole number from least to most; text: its help; others: see `Parameter`."""
    return Parameter(converter=_integer, validator=Number(gte=least, lte=most), help=text, **others)


ScenarioFile = Annotated[
    Path | None, Parameter(name="SCENARIO", help="Scenario file (TOML); none: the paper's Case I.")
]
SampledFile = Annotated[
    Path | None, Parameter(name="SCENARIO", help='Scenario file (TOML) with loop.mode = "sampled".')
]
Out = Annotated[Path | None, Parameter(help="Folder for the results; by default out/COMMAND-NAME, the file's name.")]
Seed = Annotated[int, whole("Seed of all random numbers, 0 to 4294967295.")]
Force = Annotated[bool, Parameter(negative="", help="Write into a folder that holds something already.")]
Quiet = Annotated[bool, Parameter(negative="", help="Print nothing but errors.")]
Figures = Annotated[bool, Parameter(negative="--no-figures", help="Draw figures.")]

Against = Annotated[
    tuple[str, ...] | None,
    Parameter(
        negative="",
        help="Law to compare with, several times: pd, terminal, fixed_time, time_base_pd, time_base_sliding, scaling, "
        "predefined_time, super_twisting; none: all of them.",
    ),
]
Laws = Annotated[
    tuple[str, ...], Parameter(negative="", help="FILE.py:NAME of a law of your own beside them, several times.")
]
Device = Annotated[Literal["cpu", "gpu"], Parameter(help="Hardware that batches run on.")]
Trust = Annotated[
    bool,
    Parameter(
        negative="",
        help="Run Python files that results name (system, code, --metrics): read them first: they can do what you can.",
    ),
]

FrontAgainst = Annotated[
    Literal["torque", "margins", "t_f"], Parameter(help="Quantity that the accuracy is traded against.")
]
Points = Annotated[int | None, whole("Number of limits on the torque to tune for, 3 to 100; none: 20.", 3, 100)]
Times = Annotated[
    str | None,
    Parameter(help="Prescribed times to tune for, with --against t_f [s], such as 20,30,45; none: half to twice t_f."),
]
SensitivityLimits = Annotated[
    str | None,
    Parameter(
        help="Limits on the largest sensitivity |S| to tune for, with --against margins [dB], such as 4,6,9; none: "
        "3 to 12. What no limit leaves is found too."
    ),
]


@contextlib.contextmanager
def resumable(force: bool) -> Iterator[None]:
    """Let a Ctrl-C report that the same command resumes this work; force: the command had --force."""
    try:
        yield
    except KeyboardInterrupt:
        raise KeyboardInterrupt(resume_by(force)) from None


def resume_by(force: bool) -> str:
    """Return how to resume interrupted work; force: the command had --force, which would start again."""
    return f"the same command{' without --force' if force else ''} resumes it"


VALUES = {"torque": "--points", "t_f": "--times", "margins": "--limits"}  # option for the values of each quantity


def listed_against(against: str, points: int | None, times: str | None, limits: str | None) -> tuple[float, ...]:
    """Return the times of --times [s] or the limits of --limits [dB], empty without them.

    Raises:
        UsageError: an option does not belong to this quantity, or its values are not allowed.
    """
    for (kind, option), value in zip(VALUES.items(), (points, times, limits), strict=True):
        if value is not None and against != kind:
            raise UsageError(f"{option} is {value}, but must be absent without --against {kind}")
    if times is not None:
        return _numbers("--times", times, 2, "two times or more in s, all different, such as 20,30,45")
    if limits is not None:
        return _numbers("--limits", limits, 1, "limits in dB, greater than 0 and all different, such as 4,6,9")
    return ()


def _numbers(option: str, text: str, least: int, allowed: str) -> tuple[float, ...]:
    """Positive numbers between commas, in order, at least so many."""
    try:
        listed = tuple(sorted(float(part) for part in text.split(",")))
    except ValueError:
        listed = ()
    if len(listed) < least or len(set(listed)) < len(listed) or not all(0.0 < value < float("inf") for value in listed):
        raise UsageError(f"{option} is {text}, but must be {allowed}")
    return listed


def prepare(
    scenario: Path | None,
    command: str,
    out: Path | None,
    device: Literal["cpu", "gpu"] = "cpu",
    bits: Literal[32, 64] = 64,
    *,
    trust: bool,
    force: bool | None = None,
) -> "tuple[Scenario, Path]":
    """The checked scenario, which may be flown, and the folder for the results; the backend is configured on the way.

    Args:
        scenario: its file; None: the paper's Case I.
        command: after which the folder is named where none is given.
        out: the folder that is asked for, if any.
        device: what is flown on, "cpu" or "gpu".
        bits: of every number.
        trust: code that the scenario names may be run where it lies in results.
        force: whether the folder may hold something already; None: the command looks at that later.

    Raises ScenarioError, RefusedError or UsageError where one of these cannot be followed.
    """
    from ptsmc_jax.scenario import reading

    loaded = reading.from_tables({}) if scenario is None else reading.read(scenario)
    name = "default" if scenario is None else scenario.stem
    folder = out if out is not None else Path("out") / f"{command}-{name}"
    if force is not None:
        from ptsmc_jax.campaigns import store

        store.check(folder, force)
    from ptsmc_jax.configure import NoDeviceError, configure

    try:
        configure(device=device, bits=bits, keep_programs=True)
    except NoDeviceError as error:
        raise UsageError(f"--device is {device}, but {error}") from None
    if scenario is not None:
        from ptsmc_jax.scenario import parsing
        from tuning.search import own_parts

        if not any(parsing.stated(loaded).values()):
            print(f"ptsmc: {scenario} says nothing: what flies is the paper's Case I", file=sys.stderr)
        own_parts.allow_scenario(scenario, loaded, trust)
    return reading.complete(loaded), folder
