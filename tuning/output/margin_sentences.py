"""Margins of the nominal loop as a table and in sentences, for `ptsmc margins` and for tuned gains."""

from collections.abc import Iterator, Mapping
from typing import Any

from ptsmc_jax.simulation.catalogues import MARGINS
from tuning.output.cells import Summary, Table, digits

HOLD, APPROACH = "nominal loop, hold phase", "nominal loop, approach phase"
ENOUGH = {"gain_margin": 6.0, "phase_margin": 30.0}  # with less an engineer asks
COLUMNS = {
    "gain_up": "gain up",
    "gain_down": "down [dB]",
    "phase": "phase [deg]",
    "delay": "delay [s]",
    "modulus": "|S| [dB]",
}


def table(summary: Summary) -> Table:
    """Margins in the hold phase: at each input alone, at all inputs at once, and at each measured state."""

    def row(where: str, margins: Mapping[str, Any], none: str = "none") -> tuple[str, ...]:
        return where, *(digits(margins[name], ".3g", none) if name in margins else "-" for name in COLUMNS)

    rows = [row(f"input {name}", margins) for name, margins in summary["hold"].items()]
    rows.append(row("all inputs", summary["together"], "none" if summary["stable"] else "-"))
    rows += [row(name, margins) for name, margins in summary["sensors"].items()]
    return Table((HOLD, *COLUMNS.values()), rows)


def lines(summary: Summary, *, with_least: bool = True) -> Iterator[str]:
    """Whether the loop is stable, and what is least where it is judged.

    with_least: False where `left` is said already.
    """
    if "swing" in summary:
        yield _swings(summary["swing"])
    elif not summary["stable"]:
        yield "the nominal loop is NOT stable in the hold phase"
    elif not summary.get("open"):  # which is said below
        yield "the nominal loop is stable in the hold phase"
    if "start_deg" in summary:
        yield (
            f"these margins are of the nominal run, which starts {summary['start_deg']:.4g} deg from the reference "
            "(another start: [initial])"
        )
    if summary.get("missed"):
        yield "the nominal run misses t_f: its loop in the hold phase is not at the reference"
    if summary.get("dispersed"):
        yield (
            "the nominal loop has no dispersions: ptsmc tune and montecarlo judge required margins by the worst of "
            f"{summary['dispersed']} dispersed loops"
        )
    unstable = [loop for loop in summary["before"] if not loop["stable"]]
    for judged, caveat in (
        (True, ""), (False, ", where gains change too fast, or the loop is too slow, for that to say much"),
    ):  # fmt: skip
        times = sorted(loop["time_to_go"] for loop in unstable if loop["judged"] == judged)
        if times:
            yield f"before the hand-over the loop with its gains frozen is unstable at {_span(times)}{caveat}"
    yield from _cut(summary)
    if summary["stable"] and with_least and not summary.get("open"):
        yield f"nominal loop, least at any input in the hold phase and the judged approach phase: {left(summary)}"
    if summary["said"]:
        yield summary["said"]


def _cut(summary: Summary) -> Iterator[str]:
    """Where the loop is open, so that what is infinite is no margin: by a limit of the actuators, or by itself."""
    for by_limit in (True, False):
        for where, names in _opened(summary, by_limit).items():
            if by_limit:
                yield (
                    f"a limit of the actuators cuts the nominal run's command at input {', '.join(names)} {where}: the "
                    "loop is open there, and margins without a limit say nothing of it once the limit is left"
                )
            else:
                yield (
                    f"law and sensors make nothing of the state at input {', '.join(names)} {where}: the loop is open "
                    "in that sample, and margins without a limit say nothing of the samples beside it"
                )


def _opened(summary: Summary, by_limit: bool) -> dict[str, dict[str, None]]:
    """Inputs at which nothing comes back, by where; of results of before this was told apart, by a limit."""

    def at(loop: Mapping[str, Any]) -> list[str]:
        opened = loop.get("open") or []  # none in results of before it was looked at
        cut = loop.get("cut", opened)
        return [name for name in opened if (name in cut) == by_limit]

    found = {"in the hold phase": dict.fromkeys(at(summary))}
    loops = [loop for loop in summary["before"] if at(loop)]
    if loops:
        span = _span(sorted(loop["time_to_go"] for loop in loops))
        found[f"before the hand-over, at {span}"] = dict.fromkeys(name for loop in loops for name in at(loop))
    return {where: names for where, names in found.items() if names}


def _span(times: list[float]) -> str:
    """Times to go [s] in words; times: the shortest first."""
    span = f"{times[0]:.3g}" if len(times) == 1 else f"{len(times)} times, {times[0]:.3g} to {times[-1]:.3g}"
    return f"{span} s to go"


def left(summary: Summary) -> str:
    """The least margins where they are judged, in words."""
    return _shown(summary["worst"])


def tuned(worst: Mapping[str, Any] | None, *, asked: bool = False) -> Iterator[str]:
    """What tuned gains leave, see `stability.worst`, and whether an engineer would ask for more.

    asked: a margin is among the requirements already.
    """
    short = False
    for where, loop in (("hold", HOLD), ("before", APPROACH)):
        if worst is None or where not in worst:
            continue
        margins = worst[where]
        if "swing" in margins:
            short = True
            yield _swings(margins["swing"])
            continue
        if not margins["stable"]:
            short = True
            yield f"{loop}: NOT stable with tuned gains"
            continue
        yield f"{loop}: margins with tuned gains are {_shown(margins)}"
        few = " and ".join(
            f"{enough:g} {MARGINS[name].unit} of {_short(name)}"
            for name, enough in ENOUGH.items()
            if margins[name] is not None and margins[name] < enough
        )
        if few:
            short = True
            yield f"{loop}: less than {few}; errors of the model may make the loop unstable"
    if short and not asked:
        more = " and ".join(f"requirements.{name} = {enough:g}" for name, enough in ENOUGH.items())
        yield f"gains that keep more are found with {more}; what they cost, ptsmc pareto --against margins shows"


def _swings(swing: Mapping[str, Any]) -> str:
    return (
        "the nominal run does NOT come to rest in the hold phase: without noise and disturbance its command still "
        f"swings by {swing['size']:.3g} {swing['unit']} every {swing['periods']:.3g} control periods, as with a smooth "
        "sign too narrow for the period, or gains at the border of stability; a loop that swings by itself has no "
        "margins left, and they count as zero"
    )


def _shown(margins: Mapping[str, Any]) -> str:
    """The margins that are limited, in words."""
    limited = [name for name in MARGINS if margins[name] is not None]
    return ", ".join(f"{_short(name)} {margins[name]:.3g} {MARGINS[name].unit}" for name in limited)


def _short(name: str) -> str:
    return name.removesuffix("_margin")
