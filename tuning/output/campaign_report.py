"""The report of a campaign: error, requirements, quantiles, and the inputs that drive the metrics."""

from collections.abc import Iterator
from typing import Any

import msgspec

from ptsmc_jax.numerics import statistics
from ptsmc_jax.simulation import catalogues
from ptsmc_jax.simulation.catalogues import percent
from tuning.output import pointing_report, report
from tuning.output.formats import digits, listed, many, named_error
from tuning.output.report import Block, Report, Section, Table, Text
from tuning.output.run_report import bound, warnings
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
    first = named_error(error, summary.plant, "RMS ")
    headline, mood = report.headline(summary.status, summary.verdicts, first)
    driven = list(drivers(summary))
    blocks: list[Block] = [*quantiles(summary), *([Text(driven)] if driven else [])]
    sections = [
        *report.requirements(summary.verdicts, verdict),
        Section("Metrics", blocks),
        *pointing_report.sections(summary),
    ]
    lines = [*bound(error, summary.lower_bound, summary.plant), *counts(summary), *warnings(summary.warnings)]
    return Report(headline, mood, lines, sections)


def verdict(entry: Entry) -> str:
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


def counts(summary: Campaign) -> Iterator[str]:
    """Return how the trials ended, and the reasons of failures."""
    if summary.simulated < summary.trials:
        yield f"NOT finished: {summary.simulated} of {summary.trials} trials are simulated"
    for name in summary.unjudged:
        yield f"NOT finished: {name} is required and not judged yet; run the same `ptsmc montecarlo` again"
    source = f"the run table {summary.run_table} and seed" if summary.run_table else "seed"
    yield f"{many(summary.simulated, 'trial')} of {source} {summary.seed}: {listed(summary.counts)}"
    for reason in summary.reasons:
        first = "" if reason.first_bad_time is None else f", the first at {reason.first_bad_time:.4g} s"
        yield f"  {reason.trials} {reason.status}: {reason.reason}{first}"
    ended = {status: one for status, one in summary.controller_samples.items() if one.samples}
    if ended:
        each = (f"{one.samples} {status} in {many(one.trials, 'trial')}" for status, one in ended.items())
        yield f"samples of the controller: {', '.join(each)}"
    if summary.run_table:
        yield "fractions, quantiles and intervals assume random trials; they hold as far as the run table is random"


def quantiles(summary: Campaign) -> list[Table]:
    """Return the quantiles of every metric; metrics that are better when larger have a table of their own."""
    heads = {"max": ("", "median", "99.73 %", "its 95 % interval", "largest", "unit"),
             "min": ("", "median", "99.73 % reach", "its 95 % interval", "smallest", "unit")}  # fmt: skip
    tables = [Table(head, _rows(summary, extreme), NOTES[extreme]) for extreme, head in heads.items()]
    return [table for table in tables if table.rows]


def _rows(summary: Campaign, extreme: str) -> list[tuple[str, ...]]:
    """Return the rows of the metrics whose bad end is "max" or "min"."""
    rows: list[tuple[str, ...]] = []
    units = catalogues.units(summary.plant)
    failed = sum(count for status, count in summary.counts.items() if status not in ("ok", "not_converged"))
    for name, found in summary.quantiles.items():
        far: Quantile | None = found.high if extreme == "max" else found.low
        if pointing_report.is_index(name) or far is None:
            continue
        never = found.without_value > failed  # trials without a value, such as runs that end but never settle
        largest = "none" if never else digits(getattr(found, extreme), ".3g")
        between = f"{digits(far.low, '.3g')}..{digits(far.high, '.3g')}"
        values = (digits(found.median.value, ".3g"), digits(far.value, ".3g"))
        rows.append((name, *values, between, largest, units.get(name, "")))
    return rows


def drivers(summary: Campaign) -> Iterator[str]:
    """Return the inputs that explain the error and the required metrics best, or that none explains them.

    An input is named if it explains a significant fraction of at least `statistics.EXPLAINS` of the variance.
    """
    unexplained = list[str]()
    for metric in dict.fromkeys(("window_error", *(one.metric for one in summary.verdicts))):
        sensitivities = summary.drivers.get(metric, {})
        explained = {
            name: statistics.explained_variance(msgspec.structs.asdict(driver), summary.driver_trials[metric])
            for name, driver in sensitivities.items()
        }
        strongest = sorted((name for name in explained if explained[name] >= statistics.EXPLAINS),
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
        least = f"{100 * statistics.EXPLAINS:g} % of the variance of the ranks"
        yield f"no dispersed quantity alone explains {least} of {', '.join(unexplained)}"


def gains(scenario: dict[str, Any], plant: str) -> Table:
    """Return the law, observer and filter of a scenario's tables with their gains; plant: its kind."""
    from ptsmc_jax.scenario import keys
    from ptsmc_jax.scenario.layouts import SCENARIOS

    rows: list[tuple[str, ...]] = []
    for table in ("controller", "observer", "filter", "sensors"):
        given = scenario.get(table, {})
        if isinstance(given, list):  # [[sensors]] have no gains
            continue
        custom = given.get("kind") == "custom"  # units are in its class, which is not run here
        kinds: Any = SCENARIOS[plant].TABLES.get(table, {})
        struct = kinds.get(given.get("kind"))
        units = {key.name: key.unit for key in keys.list_keys(struct, SCENARIOS[plant].unit_of_d)} if struct else {}
        for key, value in given.items():
            numbers = value if isinstance(value, list) else [value]
            each = [f"{one:.6g}" if isinstance(one, float | int) else str(one) for one in numbers]
            text = f"{each[0]} each" if len(each) > 1 and len(set(each)) == 1 else ", ".join(each)
            unit = "" if custom and key not in ("t_f", "delta") else (units.get(key) or "").replace("-", "")
            rows.append((f"{table}.{key}", text, unit))
    return Table(("key", "value", "unit"), rows)
