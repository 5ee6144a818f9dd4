"""The report of a campaign: error, requirements, quantiles, drivers, pointing budget, and its single trials."""

import itertools
import shlex
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ptsmc_jax.numerics import statistics
from ptsmc_jax.simulation import catalogues
from ptsmc_jax.simulation.catalogues import AXES, INDICES, percent
from ptsmc_jax.simulation.requirements import fewest_trials
from tuning.output import report
from tuning.output.formats import (
    format_angle,
    format_count,
    format_named_error,
    format_number,
    heading,
    in_readable_unit,
    list_counts,
)
from tuning.output.report import Block, Report, Section, Table, Text
from tuning.output.summaries import Campaign, Entry, Row

if TYPE_CHECKING:
    import polars as pl

# head and note of the table of the metrics whose worst value is the largest or the smallest
QUANTILE_TABLES = {
    "max": (
        ("", "median", "99.73 %", "its 95 % interval", "largest", "unit"),
        "Quantiles with 95 % intervals; a failed trial is beyond every quantile. -: there is no value, "
        "because too many trials fail or never settle, or too few were simulated.",
    ),
    "min": (
        ("", "median", "99.73 % reach", "its 95 % interval", "smallest", "unit"),
        "Fractions of the time within a limit, larger is better: the value that 99.73 % of the trials reach, and "
        "the smallest. A failed trial counts as 0.",
    ),
}
ROUND_OFF = 1e-9  # relative difference by rounding between the programs of a campaign and of a run with its history
REVIEW_CONFIDENCES = (0.9, 0.95)  # confidences that reviews ask for


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
        *pointing_sections(summary),
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
        if entry.fraction > entry.quantile and entry.word != "NOT shown":  # "NOT shown" comes with this number
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
        first_time = "" if reason["first_bad_time"] is None else f", the first at {reason['first_bad_time']:.4g} s"
        yield f"  {reason['trials']} {reason['status']}: {reason['reason']}{first_time}"
    numbers = [
        f"{count['samples']} {status} in {format_count(count['trials'], 'trial')}"
        for status, count in summary.controller_samples.items()
        if count["samples"]
    ]
    if numbers:
        yield f"samples of the controller: {', '.join(numbers)}"
    if summary.run_table:
        yield "fractions, quantiles and intervals assume random trials; they hold as far as the run table is random"


def quantile_tables(summary: Campaign) -> list[Table]:
    """Return the quantiles of every metric; metrics that are better when larger have a table of their own."""
    units, tables = catalogues.units(summary.plant), []
    failed = sum(count for status, count in summary.counts.items() if status not in ("ok", "not_converged"))
    for worst, (head, note) in QUANTILE_TABLES.items():
        rows = []
        for name in catalogues.without_norms(summary.quantiles):
            quantiles = summary.quantiles[name]
            tail = quantiles.high if worst == "max" else quantiles.low
            if _is_pointing_index(name) or tail is None:
                continue
            has_missing_values = quantiles.without_value > failed  # for example of runs that end but never settle
            values = quantiles.median["value"], tail["value"], tail["low"], tail["high"], getattr(quantiles, worst)
            unit, shown = in_readable_unit(name, units.get(name, ""), *values)
            median, bound, low, high, extreme = (format_number(value, ".3g") for value in shown)
            rows.append((name, median, bound, f"{low}..{high}", "none" if has_missing_values else extreme, unit))
        if rows:
            tables.append(Table(head, rows, note))
    return tables


def driver_lines(summary: Campaign) -> Iterator[str]:
    """Return the inputs that explain the error and the required metrics best, or that none explains them.

    An input is named if it explains a significant fraction of at least `statistics.MIN_EXPLAINED` of the variance.
    """
    unexplained = list[str]()
    for metric in catalogues.explained_metrics(one.metric for one in summary.verdicts):
        sensitivities = summary.drivers.get(metric, {})
        explained = statistics.strongest_drivers(sensitivities, summary.driver_trials.get(metric, 0))
        strongest, texts = list(explained)[:3], []
        for name in strongest:
            rank = sensitivities[name]["rank_correlation"]
            correlation = ""  # the number of a wheel has no rank correlation
            if rank is not None:
                is_monotonic = 2.0 * rank**2 > explained[name]
                correlation = f"rank correlation {rank:+.2f}, " if is_monotonic else "mostly not monotonic, "
            texts.append(f"{name} ({correlation}{100 * explained[name]:.0f} % of the variance of the ranks)")
        if texts:
            overlap = "; these inputs are correlated, so their percentages overlap"
            is_overlapping = sum(explained[name] for name in strongest) > 1.0
            yield f"{metric} is driven by {', '.join(texts)}{overlap if is_overlapping else ''}"
        elif sensitivities:
            unexplained.append(metric)
    if unexplained:
        threshold = f"{100 * statistics.MIN_EXPLAINED:g} % of the variance of the ranks"
        yield f"no dispersed quantity alone explains {threshold} of {', '.join(unexplained)}"


def pointing_sections(summary: Campaign) -> list[Section]:
    """Return the section with the pointing budget and its compliance, none if the campaign observes no pointing."""
    blocks: list[Block] = []
    if summary.pointing is not None:
        blocks = [Text(list(budget_lines(summary, summary.pointing))), budget_table(summary.pointing)]
    rows = [_compliance_row(verdict) for verdict in summary.verdicts if _is_pointing_index(verdict.metric)]
    if rows:
        head = ("index", "about", "at most", "probability", "interpretation", "confidence", "shown", "runs", "beyond",
                "enough if none", "verdict")  # fmt: skip
        blocks.append(Table(head, rows))
    return [Section("Pointing", blocks)] if blocks else []


def _is_pointing_index(metric: str) -> bool:
    """Return whether a metric is a pointing error index about an axis."""
    index, _, axis = metric.rpartition("_")
    return index in INDICES and axis in AXES


def budget_lines(summary: Campaign, pointing: Row) -> Iterator[str]:
    """Return the probability and the confidence of the pointing budget, and the reason for missing values."""
    boresight = ", ".join(f"{v:g}" for v in pointing["boresight"])
    begins = f"{pointing['after']:g} s after t_f" if pointing["after"] else "t_f"
    yield (
        f"{100 * pointing['probability']:g} % of the runs stay within the angles of this budget from {begins} to "
        f"t_end, with {100 * pointing['confidence']:g} % confidence; boresight {boresight}"
    )
    if any(value is None for axes in pointing["budget"].values() for value in axes.values()):
        needed = fewest_trials(pointing["probability"], pointing["confidence"])
        # runs that ended early have no angles
        ended_early = summary.simulated - summary.counts["ok"] - summary.counts.get("not_converged", 0)
        if summary.simulated >= needed and ended_early:
            yield f"an angle is - because {ended_early} runs did not reach their end"
        else:
            yield f"an angle is - because it needs {needed} runs that all reach their end"


def budget_table(pointing: Row) -> Table:
    """Return the angles of each index about the axes and as a half-cone."""
    rows = []
    for index, angles in pointing["budget"].items():
        name, _, meaning = INDICES[index].partition(", ")
        meaning_text = f"{meaning} ({pointing['window']:g} s)" if "window" in meaning else meaning
        rows.append((name, *(format_angle(angles.get(axis)) for axis in AXES), meaning_text))
    return Table(("index", "x", "y", "z", "half-cone", "largest in the observation of"), rows)


def _compliance_row(verdict: Entry) -> tuple[str, ...]:
    """Return a requirement on pointing in the form that reviews use."""
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
        verdict.word,
    )


def _runs_needed(verdict: Entry) -> str:
    """Return the number of runs without a failure that demonstrates the requirement."""
    if verdict.quantile is None or verdict.interpretation == "temporal":
        return "every run"
    if verdict.confidence is not None:
        return str(fewest_trials(verdict.quantile, verdict.confidence))
    return ", ".join(f"{fewest_trials(verdict.quantile, c)} ({100 * c:g} %)" for c in REVIEW_CONFIDENCES)


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


def worst_trial_table(frame: "pl.DataFrame", by: str, units: Mapping[str, str]) -> Table:
    """Return the table of the worst trials by a metric, the worst first.

    Args:
        frame: rows of the worst trials, the worst first.
        by: name of the metric that ranks them.
        units: unit of each column by name.
    """
    columns = ("trial", "status", by, "window_error", "peak_torque", "settling_time", "initial_angle")
    head, cells = [], []
    for name in catalogues.without_norms(name for name in columns if name in frame.columns):
        unit, values = units.get(name, ""), frame[name].to_list()
        if frame[name].dtype.is_float():
            unit, numbers = in_readable_unit(name, unit, *values)
            values = [format_number(number, ".5g") for number in numbers]
        head.append(heading(name, unit))
        cells.append(["-" if value is None else str(value) for value in values])
    return Table(tuple(head), list(zip(*cells, strict=True)))


def replay_hint(frame: "pl.DataFrame", folder: Path, *, is_custom: bool) -> str:
    """Return a sentence with the command that replays the worst trial.

    Args:
        frame: rows of the worst trials, the worst first.
        folder: folder of the campaign.
        is_custom: whether simulating the trial runs custom code, which needs --trust.
    """
    call = f"ptsmc replay {shlex.quote(str(folder))} --trial {frame['trial'][0]}" + (" --trust" if is_custom else "")
    return f"all columns are in {folder / 'worst.csv'}; replay one trial with {call}"


def explanation_lines(inputs: list[dict[str, Any]], units: Mapping[str, str]) -> Iterator[str]:
    """Return the inputs that explain a metric in each of the worst trials, as percentiles of all trials.

    If the trial failed, or too few trials show an influence, the inputs farthest from their medians are named. An error
    and its angle have the same reasons, so only the reasons of the angle are returned.

    Args:
        inputs: rows of `campaign_summary.explain_worst_trials`.
        units: unit of each metric.
    """
    metrics = catalogues.without_norms(row["metric"] for row in inputs)
    shown = (row for row in inputs if row["metric"] in metrics)
    for (metric, trial), group in itertools.groupby(shown, lambda row: (row["metric"], row["trial"])):
        rows = list(group)
        value = rows[0]["value"]
        measured = [row for row in rows if row["first_order"] is not None]
        if measured and value is not None:
            explained = [(statistics.explained_variance(row, row["trials"]), row) for row in measured]
            explained.sort(key=lambda pair: pair[0], reverse=True)
            rows = [row for fraction, row in explained if fraction >= statistics.MIN_EXPLAINED]
        else:
            rows.sort(key=_distance_from_median, reverse=True)
        texts = [_describe_input(row) for row in rows[:4]]
        reached = f"no {metric}"
        if value is not None:
            unit, (number,) = in_readable_unit(metric, units.get(metric, ""), value)  # a custom metric has no unit
            reached = f"{metric} {number:.4g} {unit}".rstrip(" -")
        nothing_found = "no sampled input explains it; sensor noise remains"
        yield f"{reached} in trial {trial}: {', '.join(texts) or nothing_found}"


def _describe_input(row: dict[str, Any]) -> str:
    """Return the value of an input in a trial, and its percentile among all trials."""
    unit, (drawn, median) = in_readable_unit(row["input"], row["unit"], row["drawn"], row["median"])
    text = f"{row['input']} {drawn:.4g} {unit}".rstrip(" -")
    if row["fraction"] is not None:
        return f"{text} as in {percent(row['fraction'])} % of the trials"
    return f"{text} at {row['percentile']:.1f} % (median {f'{median:.3g} {unit}'.rstrip(' -')})"


def _distance_from_median(row: dict[str, Any]) -> float:
    """Return the distance of an input from the median in per cent, or how few trials have the same value."""
    return 50.0 * (1.0 - row["fraction"]) if row["fraction"] is not None else abs(row["percentile"] - 50.0)


def replay_lines(difference: float | None, history_difference: float, tolerance: float) -> Iterator[str]:
    """Return how a replayed trial agrees with its row.

    Args:
        difference: largest relative difference from the row; None: the campaign has no row of this trial.
        history_difference: largest relative difference between the replayed row and the run with its history.
        tolerance: the largest difference that counts as equal.
    """
    if difference is None:
        yield "the campaign has no row of this trial yet to compare with"
    elif difference == 0.0:
        yield "the replayed trial equals its row to the last digit"
    elif difference <= tolerance:
        yield f"the replayed trial equals its row up to round-off: largest relative difference {difference:.1e}"
    else:
        found = _describe_difference(difference)
        yield f"the replayed trial does NOT equal its row: {found}; see versions and machine in versions.json"
    if history_difference <= ROUND_OFF:
        largest = f"largest relative difference {history_difference:.0e}"
        yield f"the history equals the replayed trial up to round-off: {largest}"
    else:
        yield (
            f"another program simulates the history, and its metrics differ: "
            f"{_describe_difference(history_difference)}; a loop that chatters or diverges magnifies round-off"
        )


def _describe_difference(difference: float) -> str:
    """Return in words how much a replayed row differs from the stored row."""
    if difference == float("inf"):
        return "it ends with another status, or other values are missing"
    return f"largest relative difference {difference:.1e}"
