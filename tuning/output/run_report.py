"""The report of one run."""

from collections.abc import Iterator

from ptsmc_jax.simulation.catalogues import CATALOGUES
from tuning.output import report
from tuning.output.formats import digits, error, listed, named_error, over_bound, ratio
from tuning.output.report import Report, Section, Table
from tuning.output.summaries import Run


def build(summary: Run, plant: str) -> Report:
    """Return the report of a run of this kind of plant."""
    status = summary.status
    if status == "ok" and summary.verdicts:
        status = "met" if all(one.met for one in summary.verdicts) else "not met"
    first = named_error(summary.metrics.get("window_error"), plant)
    headline, mood = report.headline(status, summary.verdicts, first)
    sections = [*report.requirements(summary.verdicts), Section("Metrics", [metrics(summary, plant)])]
    return Report(headline, mood, [*_lines(summary, plant), *warnings(summary.warnings)], sections)


def _lines(summary: Run, plant: str) -> Iterator[str]:
    """Return the ratio to the lower bound, the reason of a failure, and the status of the samples of C code."""
    yield from bound(summary.metrics.get("window_error"), summary.lower_bound, plant)
    if summary.reason:
        when = "" if summary.bad_time is None else f", at {summary.bad_time:.4g} s"
        yield f"status {summary.status}: {summary.reason}{when}"
    if summary.controller_statuses:
        yield f"samples of the controller: {listed(summary.controller_statuses)}"


def bound(value: float | None, lower_bound: float | None, plant: str) -> Iterator[str]:
    """Return the ratio of an error to its lower bound; nothing without a bound."""
    times = over_bound(value, lower_bound)
    if times is not None:
        yield f"{ratio(times)} times the lower bound of {error(lower_bound, plant)} with these sensors"


def metrics(summary: Run, plant: str) -> Table:
    """Return the table of the metrics."""
    none = "never" if summary.status in ("ok", "not_converged") else "-"
    rows = [
        (name, digits(summary.metrics[name], ".5g", none), entry.unit, entry.meaning)
        for name, entry in CATALOGUES[plant].items()
        if name in summary.metrics
    ]
    return Table(("metric", "value", "unit", "meaning"), rows)


def warnings(texts: list[str]) -> list[str]:
    """Return the warnings about a scenario as lines."""
    return [f"WARNING: {text}" for text in texts]
