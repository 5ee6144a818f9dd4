"""The pointing budget of a campaign, and its compliance table."""

from collections.abc import Iterator

from ptsmc_jax.simulation.catalogues import AXES, INDICES, percent
from ptsmc_jax.simulation.requirements import fewest_trials
from tuning.output.formats import format_angle
from tuning.output.report import Section, Table, Text
from tuning.output.summaries import Campaign, Entry

REVIEW_CONFIDENCES = (0.9, 0.95)  # confidences that reviews ask for


def pointing_sections(summary: Campaign) -> list[Section]:
    """Return the section with the budget and the compliance, none if the campaign observes no pointing."""
    tables = [table for table in (budget_table(summary), compliance_table(summary)) if table is not None]
    return [Section("Pointing", [Text(list(heading_lines(summary))), *tables])] if tables else []


def is_index(metric: str) -> bool:
    """Return whether a metric is a pointing error index."""
    index, _, axis = metric.rpartition("_")
    return index in INDICES and axis in AXES


def budget_table(summary: Campaign) -> Table | None:
    """Return the angles of each index about the axes and as a half-cone; None if no pointing is observed."""
    pointing = summary.pointing
    if pointing is None:
        return None
    rows = []
    for index, angles in pointing.budget.items():
        name, _, meaning = INDICES[index].partition(", ")
        meaning_text = f"{meaning} ({pointing.window:g} s)" if "window" in meaning else meaning
        rows.append((name, *(format_angle(angles.get(axis)) for axis in AXES), meaning_text))
    return Table(("index", "x", "y", "z", "half-cone", "largest in the observation of"), rows)


def heading_lines(summary: Campaign) -> Iterator[str]:
    """Return the probability and the confidence of the budget, and the reason for missing values."""
    pointing = summary.pointing
    if pointing is None:
        return
    boresight = ", ".join(f"{v:g}" for v in pointing.boresight)
    begins = f"{pointing.after:g} s after t_f" if pointing.after else "t_f"
    yield (
        f"{100 * pointing.probability:g} % of the runs stay within the angles of this budget from {begins} to t_end, "
        f"with {100 * pointing.confidence:g} % confidence; boresight {boresight}"
    )
    if any(value is None for axes in pointing.budget.values() for value in axes.values()):
        few, many = (fewest_trials(pointing.probability, confidence) for confidence in REVIEW_CONFIDENCES)
        ended_early = (
            summary.simulated - summary.counts["ok"] - summary.counts.get("not_converged", 0)
        )  # runs that ended early and have no angles
        if summary.simulated >= many and ended_early:
            yield f"an angle is - because {ended_early} runs did not reach their end"
        else:
            yield f"an angle is - without {many} runs that all reach their end ({few} for 90 % confidence)"


def compliance_table(summary: Campaign) -> Table | None:
    """Return the requirements on pointing in the form that reviews use; None without such requirements."""
    rows = [_compliance_row(verdict) for verdict in summary.verdicts if is_index(verdict.metric)]
    if not rows:
        return None
    head = ("index", "about", "at most", "probability", "interpretation", "confidence", "shown", "runs", "beyond")
    return Table((*head, "enough if none", "verdict"), rows)


def _compliance_row(verdict: Entry) -> tuple[str, ...]:
    index, _, axis = verdict.metric.rpartition("_")
    if verdict.interpretation == "ensemble":
        demonstrated = format_angle(None if verdict.margin is None else verdict.margin * verdict.limit)
    else:
        demonstrated = "-" if verdict.shown is None else f"{percent(verdict.shown)} % of the time"
    return (
        INDICES[index].partition(",")[0],
        "half-cone" if axis == "boresight" else axis,
        format_angle(verdict.limit),
        "every run" if verdict.quantile is None else f"{100 * verdict.quantile:g} %",
        verdict.interpretation,
        "not required" if verdict.confidence is None else f"{100 * verdict.confidence:g} %",
        demonstrated,
        str(verdict.trials),
        str(verdict.failures),
        _runs_needed(verdict),
        "met" if verdict.met else "NOT met",
    )


def _runs_needed(verdict: Entry) -> str:
    """Return the number of runs without a failure that demonstrates the requirement."""
    if verdict.quantile is None or verdict.interpretation == "temporal":
        return "every run"
    if verdict.confidence is not None:
        return str(fewest_trials(verdict.quantile, verdict.confidence))
    return ", ".join(f"{fewest_trials(verdict.quantile, c)} ({100 * c:g} %)" for c in REVIEW_CONFIDENCES)
