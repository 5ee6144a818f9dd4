"""The report of one run."""

from collections.abc import Iterator

from ptsmc_jax.simulation.catalogues import CATALOGUES
from tuning.output import report
from tuning.output.formats import (
    format_error,
    format_named_error,
    format_number,
    format_ratio,
    list_counts,
    ratio_to_bound,
)
from tuning.output.report import Report, Section, Table
from tuning.output.summaries import Run


def build(summary: Run, plant: str) -> Report:
    """Return the report of a run of this kind of plant."""
    status = summary.status
    if status == "ok" and summary.verdicts:
        status = "met" if all(one.met for one in summary.verdicts) else "not met"
    error_text = format_named_error(summary.metrics.get("window_error"), plant)
    headline, mood = report.headline(status, summary.verdicts, error_text)
    sections = [*report.requirement_sections(summary.verdicts), Section("Metrics", [metrics(summary, plant)])]
    return Report(headline, mood, [*_summary_lines(summary, plant), *warning_lines(summary.warnings)], sections)


def _summary_lines(summary: Run, plant: str) -> Iterator[str]:
    """Return the ratio of window error to lower bound, the reason of a failure, and the sample statuses of C code."""
    yield from bound_lines(summary.metrics.get("window_error"), summary.lower_bound, plant)
    if summary.reason:
        when = "" if summary.bad_time is None else f", at {summary.bad_time:.4g} s"
        yield f"status {summary.status}: {summary.reason}{when}"
    if summary.controller_statuses:
        yield f"samples of the controller: {list_counts(summary.controller_statuses)}"


def bound_lines(value: float | None, lower_bound: float | None, plant: str) -> Iterator[str]:
    """Return the ratio of an error to its lower bound; nothing without a bound."""
    ratio = ratio_to_bound(value, lower_bound)
    if ratio is not None:
        yield f"{format_ratio(ratio)} times the lower bound of {format_error(lower_bound, plant)} with these sensors"


def metrics(summary: Run, plant: str) -> Table:
    """Return the table of the metrics."""
    missing = "never" if summary.status in ("ok", "not_converged") else "-"
    rows = [
        (name, format_number(summary.metrics[name], ".5g", missing), entry.unit, entry.meaning)
        for name, entry in CATALOGUES[plant].items()
        if name in summary.metrics
    ]
    return Table(("metric", "value", "unit", "meaning"), rows)


def warning_lines(texts: list[str]) -> list[str]:
    """Return the warnings about a scenario as lines."""
    return [f"WARNING: {text}" for text in texts]
