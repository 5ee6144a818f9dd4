"""The report of a campaign: error, requirements, quantiles, and the inputs that drive the metrics."""

from collections.abc import Iterator
from typing import Any

import msgspec

from ptsmc_jax.numerics import statistics
from ptsmc_jax.simulation import catalogues
from ptsmc_jax.simulation.catalogues import percent
from tuning.output import pointing_report, report
from tuning.output.formats import format_count, format_named_error, format_number, list_counts
from tuning.output.report import Block, Report, Section, Table, Text
from tuning.output.summaries import Campaign, Entry, Quantile

NOTES = {
    "max": "Quantiles with 95 % intervals; a failed trial is beyond every quantile. -: there is no value, "
    "because too many trials fail or never settle, or too few were simulated.",
    "min": "Fractions of the time within a limit, larger is better: the value that 99.73 % of the trials reach, and "
    "the smallest. A failed trial counts as 0.",
}


def build(summary: Campaign) -> Report:
    """Return the report of a campaign."""
    error = summary.quantiles["window_error"].rms
    error_text = format_named_error(error, summary.plant, "RMS ")
    headline, mood = report.headline(summary.status, summary.verdicts, error_text)
    driven = list(driver_lines(summary))
    blocks: list[Block] = [*quantile_tables(summary), *([Text(driven)] if driven else [])]
    sections = [
        *report.requirement_sections(summary.verdicts, verdict_with_fraction),
        Section("Metrics", blocks),
        *pointing_report.pointing_sections(summary),
    ]
    lines = [
        *report.bound_lines(error, summary.lower_bound, summary.plant),
        *count_lines(summary),
        *report.warning_lines(summary.warnings),
    ]
    return Report(headline, mood, lines, sections)


def verdict_with_fraction(entry: Entry) -> str:
    """Return a verdict with the fraction of trials within the limit."""
    text = str(entry)
    if entry.fraction_of_time is not None or entry.fraction is None or entry.fraction_interval is None:
        return text
    low, high = entry.fraction_interval
    text += f"; {percent(entry.fraction)} % of trials keep the limit (95 %: {percent(low)} to {percent(high)} %)"
    if entry.quantile is not None and entry.confidence is not None and entry.fraction_bound is not None:
        text += f", at least {percent(entry.fraction_bound)} % at {100 * entry.confidence:g} % one-sided confidence"
        if entry.fraction > entry.quantile:
            failures = "as many failures" if entry.failures else "no failure"
            text += f"; {entry.fewest_trials} trials with {failures} are enough"
    return text


def count_lines(summary: Campaign) -> Iterator[str]:
    """Return how the trials ended, and the reasons of failures."""
    if summary.simulated < summary.trials:
        yield f"NOT finished: {summary.simulated} of {summary.trials} trials are simulated"
    for name in summary.unjudged:
        yield f"NOT finished: {name} is required and not judged yet; run the same `ptsmc montecarlo` again"
    source = f"the run table {summary.run_table} and seed" if summary.run_table else "seed"
    yield f"{format_count(summary.simulated, 'trial')} of {source} {summary.seed}: {list_counts(summary.counts)}"
    for reason in summary.reasons:
        first_time = "" if reason.first_bad_time is None else f", the first at {reason.first_bad_time:.4g} s"
        yield f"  {reason.trials} {reason.status}: {reason.reason}{first_time}"
    controller_samples = {
        status: status_samples
        for status, status_samples in summary.controller_samples.items()
        if status_samples.samples
    }
    if controller_samples:
        numbers = (
            f"{status_samples.samples} {status} in {format_count(status_samples.trials, 'trial')}"
            for status, status_samples in controller_samples.items()
        )
        yield f"samples of the controller: {', '.join(numbers)}"
    if summary.run_table:
        yield "fractions, quantiles and intervals assume random trials; they hold as far as the run table is random"


def quantile_tables(summary: Campaign) -> list[Table]:
    """Return the quantiles of every metric; metrics that are better when larger have a table of their own."""
    heads = {"max": ("", "median", "99.73 %", "its 95 % interval", "largest", "unit"),
             "min": ("", "median", "99.73 % reach", "its 95 % interval", "smallest", "unit")}  # fmt: skip
    tables = [Table(head, _quantile_rows(summary, bad_end), NOTES[bad_end]) for bad_end, head in heads.items()]
    return [table for table in tables if table.rows]


def _quantile_rows(summary: Campaign, bad_end: str) -> list[tuple[str, ...]]:
    """Return the rows of the metrics whose bad end is "max" or "min"."""
    rows: list[tuple[str, ...]] = []
    units = catalogues.units(summary.plant)
    failed = sum(count for status, count in summary.counts.items() if status not in ("ok", "not_converged"))
    for name, metric_quantiles in summary.quantiles.items():
        tail: Quantile | None = metric_quantiles.high if bad_end == "max" else metric_quantiles.low
        if pointing_report.is_index(name) or tail is None:
            continue
        has_missing_values = (
            metric_quantiles.without_value > failed
        )  # trials without a value, such as runs that end but never settle
        largest = "none" if has_missing_values else format_number(getattr(metric_quantiles, bad_end), ".3g")
        tail_interval = f"{format_number(tail.low, '.3g')}..{format_number(tail.high, '.3g')}"
        values = (format_number(metric_quantiles.median.value, ".3g"), format_number(tail.value, ".3g"))
        rows.append((name, *values, tail_interval, largest, units.get(name, "")))
    return rows


def driver_lines(summary: Campaign) -> Iterator[str]:
    """Return the inputs that explain the error and the required metrics best, or that none explains them.

    An input is named if it explains a significant fraction of at least `statistics.MIN_EXPLAINED` of the variance.
    """
    unexplained = list[str]()
    for metric in dict.fromkeys(("window_error", *(one.metric for one in summary.verdicts))):
        sensitivities = summary.drivers.get(metric, {})
        explained = {
            name: statistics.explained_variance(msgspec.structs.asdict(driver), summary.driver_trials[metric])
            for name, driver in sensitivities.items()
        }
        strongest = sorted((name for name in explained if explained[name] >= statistics.MIN_EXPLAINED),
                           key=lambda name: -explained[name])[:3]  # fmt: skip
        texts = []
        for name in strongest:
            rank = sensitivities[name].rank_correlation
            # the number of a wheel has no rank correlation
            correlation = "" if rank is None else f"rank correlation {rank:+.2f}, "
            texts.append(f"{name} ({correlation}{100 * explained[name]:.0f} % of the variance of the ranks)")
        if texts:
            yield f"{metric} is driven by {', '.join(texts)}"
        elif sensitivities:
            unexplained.append(metric)
    if unexplained:
        threshold = f"{100 * statistics.MIN_EXPLAINED:g} % of the variance of the ranks"
        yield f"no dispersed quantity alone explains {threshold} of {', '.join(unexplained)}"


def gain_table(scenario: dict[str, Any], plant: str) -> Table:
    """Return the law, observer and filter of a scenario's tables with their gains; plant: its kind."""
    from ptsmc_jax.scenario import keys
    from ptsmc_jax.scenario.layouts import SCENARIOS

    rows: list[tuple[str, ...]] = []
    for table in ("controller", "observer", "filter", "sensors"):
        scenario_table = scenario.get(table, {})
        if isinstance(scenario_table, list):  # [[sensors]] have no gains
            continue
        is_custom = scenario_table.get("kind") == "custom"  # units are in its class, which is not run here
        kinds: Any = SCENARIOS[plant].TABLES.get(table, {})
        struct = kinds.get(scenario_table.get("kind"))
        units = {key.name: key.unit for key in keys.list_keys(struct, SCENARIOS[plant].unit_of_d)} if struct else {}
        for key, value in scenario_table.items():
            numbers = value if isinstance(value, list) else [value]
            texts = [f"{number:.6g}" if isinstance(number, float | int) else str(number) for number in numbers]
            text = f"{texts[0]} each" if len(texts) > 1 and len(set(texts)) == 1 else ", ".join(texts)
            unit = "" if is_custom and key not in ("t_f", "delta") else (units.get(key) or "").replace("-", "")
            rows.append((f"{table}.{key}", text, unit))
    return Table(("key", "value", "unit"), rows)
