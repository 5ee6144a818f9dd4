"""The statistics of a Monte Carlo campaign: verdicts, quantiles with intervals, sensitivities, worst trials, replays.

All of them are computed from the rows of the campaign. Read `summarise` first.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from ptsmc_jax import scenario
from ptsmc_jax.campaigns import campaign as running
from ptsmc_jax.campaigns import rows, run_tables, runs, store
from ptsmc_jax.campaigns.store import RefusedError
from ptsmc_jax.dispersions.quantities import CATEGORIES
from ptsmc_jax.numerics import statistics
from ptsmc_jax.scenario import parsing, plausibility
from ptsmc_jax.simulation import catalogues
from ptsmc_jax.simulation.requirements import Requirement, Verdict, must_keep
from ptsmc_jax.simulation.rollout import STATUS
from tuning.studies import campaign_theory
from tuning.studies.campaign_folder import Folder

TOLERANCE = 1e-12  # largest relative difference of equal results
CONFIDENCE = 0.95  # confidence level of the intervals, unless a requirement has its own
QUANTILES = (0.5, 0.9, 0.99, 0.9973)
BUDGET_FRACTION = 0.9973  # fraction of the runs that keep a pointing budget by default: three sigma of a normal one
DRIVER_TRIALS = 100_000  # largest number of trials for the sensitivities to inputs


def until_confident(folder: Folder, width: float, simulate_first: Callable[[int], None]) -> int:
    """Simulate until the confidence interval of every requirement's fraction is narrow enough.

    The number of trials doubles until the check succeeds, or until the campaign is complete. The intervals are valid
    for a number of trials that is fixed in advance. Repeated checks reduce their coverage probability slightly.

    Args:
        folder: the campaign. It has at most `folder.trials` trials.
        width: largest width of the intervals [-].
        simulate_first: simulates the first trials up to a number.

    Returns:
        The number of trials.
    """
    count, existing = running.PART, sum(part.count for part in folder.rows.parts()[0])
    while count < existing:  # so that the first check uses all existing trials
        count *= 2
    while True:
        count = min(count, folder.trials)
        simulate_first(count)
        intervals = [verdict["fraction_interval"] for verdict in judge_requirements(folder, count=count)]
        widths = [high - low for low, high in intervals]
        if count == folder.trials or all(w <= width for w in widths):
            return count
        count *= 2


def judge_requirements(folder: Folder, count: int | None = None) -> list[dict[str, Any]]:
    """Return the verdict on each requirement except margins, as in `summary.json`; count: use only the first trials."""
    required = scenario.requirements(folder.scenario)
    names = dict.fromkeys(name for r in required for name in (r.metric, r.timed) if name is not None)
    frame = rows.read(folder.intact_parts(), ["status", *names]).head(count or folder.trials)
    finished = running.has_finished(frame)
    verdicts = running.verdicts(required, frame)
    pairs = zip(verdicts, required, strict=True)
    return [_verdict_entry(v, r, _fraction_of_time_beyond(frame, r, finished)) for v, r in pairs]


def _fraction_of_time_beyond(frame: pl.DataFrame, requirement: Requirement, finished: np.ndarray) -> np.ndarray:
    """Return the fraction of time that each trial is beyond a limit, (trials,).

    A failed trial counts as beyond the limit at all times. The array is empty if the requirement is not "mixed".
    """
    if requirement.interpretation != "mixed" or requirement.timed is None:
        return np.zeros(0)
    return np.where(finished, 1.0 - frame[requirement.timed].fill_null(0.0).to_numpy(), 1.0)


def _verdict_entry(verdict: Verdict, requirement: Requirement, beyond: np.ndarray) -> dict[str, Any]:
    """Return the entry of a requirement in `summary.json`, with the observed fraction, its interval and its bound.

    Args:
        verdict: the verdict on the requirement.
        requirement: the requirement.
        beyond: (trials,) fraction of time of each trial beyond the limit; empty if the requirement counts trials.
    """
    within, confidence = verdict.trials - verdict.failures, requirement.confidence or CONFIDENCE
    entry = verdict.in_summary()
    if beyond.size:  # fraction of time: the samples of one run depend on each other, but the runs are independent
        one_sided_confidence = (1.0 + CONFIDENCE) / 2.0
        entry["fraction"] = 1.0 - beyond.mean()
        entry["fraction_interval"] = (
            1.0 - statistics.mean_bound(beyond, one_sided_confidence),
            statistics.mean_bound(1.0 - beyond, one_sided_confidence),
        )
        entry["fraction_bound"] = 1.0 - statistics.mean_bound(beyond, confidence)
    else:
        entry["fraction"] = within / verdict.trials
        entry["fraction_interval"] = statistics.fraction_interval(within, verdict.trials, CONFIDENCE)
        entry["fraction_bound"] = statistics.fraction_bound(within, verdict.trials, confidence)
    return entry if verdict.fewest_trials is None else {**entry, "fewest_trials": verdict.fewest_trials}


def summarise(folder: Folder) -> dict[str, Any]:
    """Return the content of `summary.json`."""
    parts = folder.intact_parts()
    theory = campaign_theory.read(folder)
    verdicts = [*judge_requirements(folder), *theory.get("margins", [])]
    missing_margins = campaign_theory.margins_without_verdict(folder, theory)
    frame = rows.read(parts, ["status", "reason", "bad_time"]).head(folder.trials)
    counts = {status: int((frame["status"] == status).sum()) for status in dict.fromkeys(s for s, _ in STATUS.values())}
    finished, failed = running.has_finished(frame), frame.filter(pl.col("status") != "ok")
    reasons = [
        {"status": status, "reason": reason, "trials": int(part.height), "first_bad_time": part["bad_time"].min()}
        for (status, reason), part in sorted(failed.group_by(["status", "reason"]))
    ]
    quantiles, drivers, driver_trials = {}, {}, {}
    ranks: dict[bytes, dict[str, tuple]] = {}  # cached ranks of the inputs, by the subset of trials
    input_names = input_columns(folder, parts)
    inputs = rows.read(parts, input_names).head(min(DRIVER_TRIALS, folder.trials))
    for name in (*scenario.catalogue(folder.scenario), *folder.custom_metric_names):
        values = rows.read(parts, [name]).head(folder.trials)[name].to_numpy().astype(float)
        quantiles[name] = _metric_statistics(values, finished, name in catalogues.LARGER_IS_BETTER)
        has_value = np.isfinite(values[:DRIVER_TRIALS]) & finished[:DRIVER_TRIALS]
        driver_trials[name] = int(has_value.sum())
        known_inputs = {key: inputs[key].to_numpy()[has_value] for key in input_names}
        cached_ranks = ranks.setdefault(has_value.tobytes(), {})
        drivers[name] = {}
        if has_value.sum() > 1:
            known_values = values[:DRIVER_TRIALS][has_value]
            drivers[name] = statistics.drivers(known_inputs, known_values, cached_ranks, CATEGORIES)
    simulated = int(frame.height)
    met = all(v["met"] for v in verdicts) if verdicts else counts["ok"] == simulated
    return {
        "status": "incomplete" if simulated < folder.trials or missing_margins else "met" if met else "not met",
        "plant": folder.scenario.plant.kind,
        "seed": folder.seed,
        "run_table": folder.table_name,
        "trials": folder.trials,
        "simulated": simulated,
        "unjudged": missing_margins,
        "counts": counts,
        "reasons": reasons,
        "interval_confidence": CONFIDENCE,
        "lower_bound": theory.get("lower_bound"),
        "verdicts": verdicts,
        **_pointing_budget(folder, parts, finished),
        "quantiles": quantiles,
        "drivers": drivers,
        "driver_trials": driver_trials,  # number of trials with a value of the metric
        **_count_controller_samples(folder, parts),
        "warnings": [
            *plausibility.warnings(folder.scenario),
            *filter(None, [folder.parameter_differences]),
            *_equal_trials(quantiles, simulated),
        ],
    }


def _count_controller_samples(folder: Folder, parts: list[rows.Part]) -> dict[str, object]:
    """Return the numbers of samples and of trials for each status of the C code, for `summary.json`.

    The result is {"controller_samples": {status: {"samples": .., "trials": ..}}}, or {} without C code.
    """
    if folder.controller is None:
        return {}
    columns = rows.column_names(parts[0])
    names = [name for name in run_tables.SAMPLES if name in columns]  # the most severe status is the last one
    counts = rows.read(parts, names).head(folder.trials)
    samples = {
        name.removeprefix(run_tables.COUNT_PREFIX): {
            "samples": int(counts[name].sum()),
            "trials": int((counts[name] > 0).sum()),
        }
        for name in names
    }
    return {"controller_samples": samples}


def input_columns(folder: Folder, parts: list[rows.Part]) -> list[str]:
    """Return the names of the columns with the inputs of the trials: dispersions, and the values of a run table.

    They are all columns except the results, the trial number and the columns that identify a row's random sample.
    """
    others = {
        run_tables.TRIAL,
        *run_tables.RESULT_COLUMNS.values(),
        *run_tables.RESULTS,
        *run_tables.SAMPLES,
        *folder.custom_metric_names,
    }
    return [name for name in rows.column_names(parts[0]) if name not in others]


def _equal_trials(quantiles: dict[str, Any], trials: int) -> list[str]:
    """Return a list with a warning if all trials have the same metrics, otherwise an empty list."""
    measured = [metric for metric in quantiles.values() if "max" in metric]
    differ = any(abs(m["max"] - m["mean"]) > TOLERANCE * abs(m["max"]) for m in measured)
    if trials < 2 or not measured or differ or any(m["without_value"] for m in measured):  # failed trials differ too
        return []
    reason = "neither [dispersion] nor the noise of [hardware] changes them"
    return [f"all {trials} trials have the same metrics: {reason}; one trial is enough"]


def budget_statistics(required: Iterable[Requirement]) -> tuple[float, float]:
    """Return the fraction of runs and the confidence of the pointing budget.

    They are those of the requirements on the fraction of runs that keep a limit on a pointing index. If there are none,
    or if they differ, the result is `BUDGET_FRACTION` and `CONFIDENCE`.
    """
    stated = {
        (r.quantile, r.confidence or CONFIDENCE)
        for r in required
        if r.metric.rpartition("_")[0] in catalogues.INDICES
        and r.interpretation == "ensemble"
        and r.quantile is not None
    }
    return stated.pop() if len(stated) == 1 else (BUDGET_FRACTION, CONFIDENCE)


def _pointing_budget(folder: Folder, parts: list[rows.Part], finished: np.ndarray) -> dict[str, object]:
    """Return the pointing budget: an upper bound for every pointing error index and axis [rad].

    At least a fraction of all possible runs stays below the bound, with a confidence, see `budget_statistics`. A bound
    is None if there are too few trials, or too many of them failed. The result is {"pointing": {.., "budget":
    {index: {axis: bound}}}}, or {} without [pointing].
    """
    table = getattr(folder.scenario, "pointing", None)
    if table is None:
        return {}
    fraction, confidence = budget_statistics(scenario.requirements(folder.scenario))
    catalogue, budget = scenario.catalogue(folder.scenario), {}
    for index in catalogues.INDICES:
        names = {axis: f"{index}_{axis}" for axis in catalogues.AXES if f"{index}_{axis}" in catalogue}
        frame = rows.read(parts, names.values()).head(folder.trials)
        for axis, name in names.items():
            values = frame[name].to_numpy().astype(float)
            sorted_values = np.sort(np.where(finished & np.isfinite(values), values, np.inf))
            rank = must_keep(sorted_values.size, fraction, confidence)
            bound = None if rank is None or not np.isfinite(sorted_values[rank - 1]) else float(sorted_values[rank - 1])
            budget.setdefault(index, {})[axis] = bound
    observed = {"boresight": table.boresight, "window": table.window, "after": table.after}
    return {"pointing": {**observed, "probability": fraction, "confidence": confidence, "budget": budget}}


def _metric_statistics(values: np.ndarray, finished: np.ndarray, larger_is_better: bool) -> dict[str, Any]:
    """Return statistics of a metric: mean, RMS and maximum of the trials with a value, and quantiles of all trials.

    Quantiles count a trial without a value as infinite. If larger values are better, it counts as 0, the quantiles are
    low ones, and the minimum is included. Key "0.0027" then has the value that 99.73 % of the trials reach.
    """
    has_value = finished & np.isfinite(values)
    known_values = values[has_value]
    entry: dict[str, Any] = {"without_value": int(values.size - known_values.size)}
    if known_values.size:
        entry |= {"mean": known_values.mean(), "rms": np.sqrt(np.mean(known_values**2)), "max": known_values.max()}
    best_first = np.sort(-np.where(has_value, values, 0.0) if larger_is_better else np.where(has_value, values, np.inf))
    if larger_is_better:
        entry["min"] = -best_first[-1]
    for quantile in QUANTILES:
        value = statistics.sample_quantile(best_first, quantile)
        low, high = statistics.quantile_interval(best_first, quantile, CONFIDENCE)
        if larger_is_better:
            entry[f"{1.0 - quantile:g}"] = {"value": -value, "low": -high, "high": -low}
        else:
            entry[str(quantile)] = {"value": value, "low": low, "high": high}
    return entry


def write_summary(folder: Folder, summary: dict[str, Any], figures: bool) -> None:
    """Write `summary.json` and the figures into the campaign's folder.

    Args:
        folder: the campaign.
        summary: content of the file, see `summarise`.
        figures: write the figures too.
    """

    def write_summary_and_figures(staging: Path) -> None:
        store.write_json(staging / store.SUMMARY, summary)
        if figures:
            from ptsmc_jax.figures import style  # the import takes half a second, which only figures need
            from tuning.studies import campaign_figures

            style.save(campaign_figures.build(folder, summary), staging / "figures")

    store.write_folder(folder.path, write_summary_and_figures)


def worst_trials(folder: Folder, by: str, count: int) -> pl.DataFrame:
    """Return the rows of the worst trials, failed trials first.

    Args:
        folder: the campaign.
        by: column that orders the trials.
        count: number of rows.

    Raises:
        RefusedError: there is no such column, or the rows are damaged.
    """
    parts = folder.intact_parts()
    names = rows.column_names(parts[0])
    allowed = [
        name
        for name in names
        if name not in (run_tables.TRIAL, *run_tables.STATUS_COLUMNS, *run_tables.RESULT_COLUMNS.values())
    ]
    if by not in allowed:
        raise RefusedError(f"--by is {by}, but must be a column of the rows; {parsing.nearest_name_hint(by, allowed)}")
    frame = rows.read(parts, [by, "status"]).head(folder.trials)
    failed = ~running.has_finished(frame)
    chosen = most_extreme(by, frame[by].fill_null(float("nan")).to_numpy(), failed, count)
    return rows.read(parts).head(folder.trials)[chosen]


def most_extreme(metric: str, values: np.ndarray, failed: np.ndarray, count: int) -> np.ndarray:
    """Return the indices of the worst trials by a metric, failed trials first; see `statistics.most_extreme`.

    Args:
        metric: name of the metric, which decides whether large values are good.
        values: values of the metric (trials,), in its unit; NaN if a trial has no value.
        failed: whether each trial failed (trials,) [-].
        count: number of indices.

    Returns:
        Indices of at most `count` trials, the worst first.
    """
    # SAMPLES[0] counts samples without an error
    larger_is_better = metric in (*catalogues.LARGER_IS_BETTER, run_tables.SAMPLES[0])
    return statistics.most_extreme(values, failed, count, larger_is_better=larger_is_better)


def explain_worst_trials(folder: Folder, metrics: Sequence[str], count: int) -> list[dict[str, object]]:
    """Return the inputs of the worst trials by each metric, compared with the inputs of all trials.

    Failed trials come first, as in `worst_trials`. If several inputs order the trials equally, only the first of them
    is listed.

    Args:
        folder: the campaign.
        metrics: names of metrics.
        count: number of worst trials for each metric.

    Returns:
        An entry for each metric, trial and input. It has the percentile rank of the input [%] and the median of all
        trials. A categorical input, such as the number of a failed wheel, has the fraction of equal trials instead.
        "rank_correlation" and "first_order" are the sensitivities of the metric, see `statistics.drivers`. They are
        None if too few trials have a value. "trials" is the number of trials with a value.
    """
    parts, unit_of = folder.intact_parts(), folder.units
    input_names = input_columns(folder, parts)
    frame = rows.read(parts, ["trial", "status", *dict.fromkeys((*metrics, *input_names))]).head(folder.trials)
    inputs = {name: frame[name].to_numpy().astype(float) for name in input_names}
    varied = {name: values for name, values in inputs.items() if statistics.has_variation(values)}
    distinct = statistics.distinct_inputs({name: values for name, values in varied.items() if name not in CATEGORIES})
    names = [name for name in varied if name in distinct or name in CATEGORIES]
    failed = ~running.has_finished(frame)
    entries: list[dict[str, object]] = []
    for metric in metrics:
        values = frame[metric].fill_null(float("nan")).to_numpy()
        has_value = np.isfinite(values) & ~failed
        known_inputs = {name: inputs[name][has_value] for name in names}
        drivers = statistics.drivers(known_inputs, values[has_value], categories=CATEGORIES) if has_value.any() else {}
        for index in most_extreme(metric, values, failed, count):
            entries += [
                {
                    "metric": metric,
                    "trial": int(frame["trial"][int(index)]),
                    "value": float(values[index]) if np.isfinite(values[index]) else None,
                    "input": name,
                    "drawn": float(inputs[name][index]),
                    "unit": unit_of.get(name, ""),
                    **_rank_input(name, inputs[name], float(inputs[name][index])),
                    **drivers.get(name, {"rank_correlation": None, "first_order": None}),
                    "trials": int(has_value.sum()),
                }
                for name in names
            ]
    return entries


def _rank_input(name: str, values: np.ndarray, value: float) -> dict[str, float | None]:
    """Return the rank of an input's value among all trials, a dict.

    It has the "percentile" and the "median" of a number, and the "fraction" of equal trials for a category. The others
    are None.
    """
    if name in CATEGORIES:
        return {"percentile": None, "median": None, "fraction": float(np.mean(values == value))}
    return {"percentile": statistics.percentile(values, value), "median": float(np.median(values)), "fraction": None}


@dataclass(frozen=True)
class Replay:
    """A repeated simulation of a trial."""

    run: runs.Run  # the run with its history
    difference: float | None  # largest relative difference between the new and the stored row; None: no row is stored
    rounding: float  # largest relative difference between `run`, from another compiled program, and the new row


def replay(folder: Folder, trial: int) -> Replay:
    """Simulate a trial again: once as the campaign does, for its row, and once with its history.

    Raises RefusedError if a part of the rows is damaged.
    """
    parts, campaign = folder.stored_parts(), folder.campaign
    row_or_trial = trial if campaign.run_table is None else campaign.run_table.row(trial, folder.seed)
    run = runs.simulate(campaign.ready, folder.seed, row_or_trial, campaign.software)
    new_row = campaign.simulate([trial]).row(0, named=True)
    rounding = max(_relative_difference(value, new_row[name]) for name, value in run.metrics.items())
    if run.status != new_row["status"]:
        rounding = np.inf
    difference = None
    for part in parts:
        if part.first <= trial < part.end:
            row = rows.read([part]).filter(pl.col("trial") == trial).row(0, named=True)
            difference = max(_relative_difference(value, new_row[name]) for name, value in row.items())
    return Replay(run, difference, rounding)


def _relative_difference(a: Any, b: Any) -> float:
    """Return the relative difference of two values of a row.

    It is 0 if both are equal or missing. It is infinite if they differ and are not both finite floats.
    """
    if isinstance(a, float) and isinstance(b, float) and np.isfinite([a, b]).all():
        return 0.0 if a == b else abs(a - b) / max(abs(a), abs(b))
    missing = [v is None or v != v for v in (a, b)]
    return 0.0 if a == b or all(missing) else np.inf
