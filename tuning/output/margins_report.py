"""The report of the margins of the nominal loop, also for tuned gains."""

from collections.abc import Iterator, Mapping

from ptsmc_jax.simulation.catalogues import MARGINS
from tuning.output.formats import format_number
from tuning.output.report import Report, Section, Table
from tuning.output.summaries import Margins, Numbers, Row

USUAL_MARGINS = {"gain_margin": 6.0, "phase_margin": 30.0}  # usual requirements [dB, deg]
PHASES = {"hold": "hold phase", "before": "approach phase"}
COLUMNS = {
    "gain_up": "gain up [dB]",
    "gain_down": "gain down [dB]",
    "phase": "phase [deg]",
    "delay": "delay [s]",
    "peak_sensitivity": "|S| [dB]",
}


def build(summary: Margins) -> Report:
    """Return the report of `ptsmc margins`."""
    unstable = any(loop["judged"] and not loop["stable"] for loop in summary.before)
    if summary.open:
        headline, mood = "The nominal loop is open in the hold phase", "bad"
    elif not summary.stable:
        headline, mood = "The nominal loop is NOT stable in the hold phase", "bad"
    elif unstable:
        headline, mood = f"Stable in the hold phase, NOT stable in the approach phase; {_format_worst(summary)}", "bad"
    else:
        headline, mood = f"The nominal loop is stable; {_format_worst(summary)}", "calm"
    return Report(headline, mood, list(_condition_lines(summary)), [Section("Margins", [margin_table(summary)])])


def _format_worst(summary: Margins) -> str:
    """Return the line with the smallest margins of the run, and the phases that they are from."""
    phases = "both phases" if any(loop["judged"] for loop in summary.before) else "the hold phase"
    return f"smallest margins at one input in {phases}: {format_margins(summary.worst)}"


def margin_table(summary: Margins) -> Table:
    """Return the margins in the hold phase at each input alone, at all inputs, and at each measured state.

    The last row has the worst input at the judged times of the approach phase.
    """

    def margin_row(where: str, phase: str, margins: Numbers, unlimited: str = "none") -> tuple[str, ...]:
        cells = (format_number(margins[name], ".3g", unlimited) if name in margins else "-" for name in COLUMNS)
        return where, phase, *cells

    rows = [margin_row(f"input {name}", "hold", margins) for name, margins in summary.hold.items()]
    rows.append(margin_row("all inputs", "hold", summary.together, "none" if summary.stable else "-"))
    rows += [margin_row(name, "hold", margins) for name, margins in summary.sensors.items()]
    judged = [loop for loop in summary.before if loop["judged"]]
    if judged:
        known = {name: [loop[name] for loop in judged if loop[name] is not None] for name in COLUMNS}
        worst = {name: (max if name == "peak_sensitivity" else min)(values, default=None)
                 for name, values in known.items()}  # fmt: skip
        rows.append(margin_row("worst input", "approach", worst))
    return Table(("loop opened at", "phase", *COLUMNS.values()), rows, "none: the margin is unlimited.")


def _condition_lines(summary: Margins) -> Iterator[str]:
    """Return the conditions under which the margins hold, and warnings."""
    if summary.stable and not summary.open:
        times = sorted(loop["time_to_go"] for loop in summary.before if loop["judged"])
        approach = f" and, with frozen gains, at {_format_times(times)}" if times else ""
        yield f"these are the smallest margins in the hold phase{approach}; margins.csv has them over time"
        yield "margins at all inputs together and at the sensors are not judged; they can be smaller, see the table"
    if summary.limit_cycle is not None:
        yield from limit_cycle_lines(summary.limit_cycle)
    if summary.start_deg is not None:
        yield f"the nominal run starts {summary.start_deg:.4g} deg from the reference; change [initial] for another"
    if summary.not_converged:
        yield "the nominal run has not converged at t_f, so its loop in the hold phase is not at the reference"
    if summary.dispersed is not None:
        yield (
            "the nominal loop has no dispersions; ptsmc tune and montecarlo judge required margins by the worst of "
            f"{summary.dispersed} dispersed loops"
        )
    for judged, caveat in (
        (True, ""), (False, "; this is not judged, because frozen gains mean little there"),
    ):  # fmt: skip
        times = sorted(loop["time_to_go"] for loop in summary.before if not loop["stable"] and loop["judged"] == judged)
        if times:
            yield f"in the approach phase, the loop with frozen gains is unstable at {_format_times(times)}{caveat}"
    yield from _open_loop_lines(summary)
    if summary.note:
        yield summary.note


def _open_loop_lines(summary: Margins) -> Iterator[str]:
    """Return lines with the inputs at which the loop is open, and the reason."""
    for by_limit, reason in (
        (True, "a limit of the actuators cuts the command of the nominal run"),
        (False, "the controller does not react to the state at this sample"),
    ):
        places = {"in the hold phase": [name for name in summary.open if (name in summary.cut) == by_limit]}
        loops = {
            loop["time_to_go"]: [name for name in loop["open"] if (name in loop["cut"]) == by_limit]
            for loop in summary.before
        }
        times = sorted(time for time, names in loops.items() if names)
        if times:
            inputs = list(dict.fromkeys(name for names in loops.values() for name in names))
            places[f"in the approach phase, at {_format_times(times)}"] = inputs
        for where, names in places.items():
            if names:
                yield (
                    f"the loop is open at input {', '.join(names)} {where}: {reason}; unlimited margins do not apply "
                    "to the neighbouring samples"
                )


def _format_times(times: list[float]) -> str:
    """Return times to go [s], in ascending order, as text."""
    span = f"{times[0]:.3g}" if len(times) == 1 else f"{len(times)} samples from {times[0]:.3g} to {times[-1]:.3g}"
    return f"{span} s to go"


def tuned_margin_lines(margins: Mapping[str, Row] | None, *, required: bool) -> Iterator[str]:
    """Return the margins of tuned gains, and a warning if they are smaller than usual.

    Args:
        margins: the smallest of each phase, see `stability.worst_margins`.
        required: a margin is among the requirements.
    """
    is_insufficient = False
    for phase_key, phase in PHASES.items():
        smallest = (margins or {}).get(phase_key)
        if smallest is None:
            continue
        if smallest.get("limit_cycle") is not None:
            is_insufficient = True
            yield from limit_cycle_lines(smallest["limit_cycle"])
        elif not smallest["stable"]:
            is_insufficient = True
            yield f"the nominal loop is NOT stable in the {phase}"
        else:
            yield f"margins of the nominal loop in the {phase}: {format_margins(smallest)}"
            missed = [
                f"{usual:g} {MARGINS[name].unit} of {_short_name(name)}"
                for name, usual in USUAL_MARGINS.items()
                if smallest[name] is not None and smallest[name] < usual
            ]
            if missed:
                is_insufficient = True
                yield f"less than {' and '.join(missed)} in the {phase}: errors of the model may make the loop unstable"
    if is_insufficient and not required:
        advice = " and ".join(f"requirements.{name} = {usual:g}" for name, usual in USUAL_MARGINS.items())
        yield f"for larger margins, tune with {advice}; ptsmc pareto --against margins shows their cost"


def limit_cycle_lines(limit_cycle: Row) -> Iterator[str]:
    """Return the description of a limit cycle in the hold phase."""
    yield "the nominal run does NOT come to rest in the hold phase, so its margins count as zero"
    yield (
        f"without noise and disturbance its command oscillates by {limit_cycle['size']:.3g} {limit_cycle['unit']} "
        f"every {limit_cycle['periods']:.3g} control periods; the boundary layer is too thin, or the gains are at "
        "the stability limit"
    )


def format_margins(margins: Numbers) -> str:
    """Return a text with those margins that a scenario can require, `MARGINS`."""
    limited = {name: margins.get(name) for name in MARGINS}
    return ", ".join(
        f"{_short_name(name)} {value:.3g} {MARGINS[name].unit}" for name, value in limited.items() if value is not None
    )


def _short_name(name: str) -> str:
    """Return the short name of a margin, such as "gain" for "gain_margin"."""
    return "max |S|" if name == "peak_sensitivity" else name.removesuffix("_margin")
