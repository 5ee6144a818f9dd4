"""The statistics of a Monte Carlo campaign: verdicts, quantiles with intervals, sensitivities, worst trials, replays.

All of them are computed from the rows of the campaign. Read `summarise` first.
"""

from collections.abc import Callable
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
from tuning.studies.campaign_folder import Folder, opened
from tuning.studies.campaign_theory import lower_bound_of, margins_of, unjudged

SAME = 1e-12  # largest relative difference of equal results
CONFIDENCE = 0.95  # confidence level of the intervals, unless a requirement has its own
QUANTILES = (0.5, 0.9, 0.99, 0.9973)
SHOWN = 0.9973  # fraction of the runs that keep a pointing budget: three sigma of a normal distribution
SEARCHED = 100_000  # largest number of trials for the sensitivities to inputs


def first_look(folder: Folder, force: bool) -> int | None:
    """Return the number of trials before `until_confident` first checks the intervals; None: one part.

    A finished campaign that is extended is first checked with all its trials. An interrupted campaign keeps its first
    check when it resumes, and so stops after the same number of trials as without the interruption.
    """
    try:
        before = None if force else opened(folder.path)
    except RefusedError:  # the folder has no campaign yet
        before = None
    if before is None:
        return None
    finished = before.trials < folder.trials and _existing_trials(before) >= before.trials
    return before.trials if finished else before.first_look


def until_confident(folder: Folder, width: float, fly_first: Callable[[int], None]) -> int:
    """Simulate until the confidence interval of every requirement's fraction is narrow enough.

    The number of trials doubles until the check succeeds, or until the campaign is complete. The intervals are valid
    for a number of trials that is fixed in advance. Repeated checks reduce their coverage probability slightly.

    Args:
        folder: the campaign. It has at most `folder.trials` trials.
        width: largest width of the intervals [-].
        fly_first: simulates the first trials up to a number.

    Returns:
        The number of trials.
    """
    count, there = folder.first_look or running.PART, _existing_trials(folder)
    while count < there:  # so that the first part has all existing trials
        count *= 2
    while True:
        count = min(count, folder.trials)
        fly_first(count)
        intervals = [verdict["fraction_interval"] for verdict in judged(folder, first=count)]
        widths = [high - low for low, high in intervals]
        if count == folder.trials or all(w <= width for w in widths):
            return count
        count *= 2


def _existing_trials(folder: Folder) -> int:
    return sum(part.count for part in folder.rows.parts()[0])


def judged(folder: Folder, first: int | None = None) -> list[dict[str, Any]]:
    """Return the verdict on each requirement except margins, as in `summary.json`; first: use only the first trials."""
    required = scenario.requirements(folder.scenario)
    names = dict.fromkeys(name for r in required for name in (r.metric, r.timed) if name is not None)
    frame = rows.read(folder.whole_parts(), ["status", *names]).head(first or folder.trials)
    finished = running.finished(frame)
    verdicts = running.verdicts(required, frame)
    pairs = zip(verdicts, required, strict=True)
    return [_in_summary(v, r, _fraction_of_time_beyond(frame, r, finished)) for v, r in pairs]


def _fraction_of_time_beyond(frame: pl.DataFrame, required: Requirement, ok: np.ndarray) -> np.ndarray:
    """Return the fraction of time that each trial is beyond a limit, (trials,).

    A failed trial counts as beyond the limit at all times. The array is empty if the requirement is not "mixed".
    """
    if required.interpretation != "mixed" or required.timed is None:
        return np.zeros(0)
    return np.where(ok, 1.0 - frame[required.timed].fill_null(0.0).to_numpy(), 1.0)


def _in_summary(verdict: Verdict, required: Requirement, beyond: np.ndarray) -> dict[str, Any]:
    within, confidence = verdict.trials - verdict.failures, required.confidence or CONFIDENCE
    entry = verdict.in_summary()
    if beyond.size:  # fraction of time: the samples of one run depend on each other, but the runs are independent
        each = (1.0 + CONFIDENCE) / 2.0
        entry["fraction"] = 1.0 - beyond.mean()
        entry["fraction_interval"] = (
            1.0 - statistics.mean_bound(beyond, each),
            statistics.mean_bound(1.0 - beyond, each),
        )
        entry["fraction_bound"] = 1.0 - statistics.mean_bound(beyond, confidence)
    else:
        entry["fraction"] = within / verdict.trials
        entry["fraction_interval"] = statistics.fraction_interval(within, verdict.trials, CONFIDENCE)
        entry["fraction_bound"] = statistics.fraction_bound(within, verdict.trials, confidence)
    if required.quantile is not None and required.confidence is not None:
        failures = verdict.failures if required.timed is None else 0
        entry["fewest_trials"] = statistics.fewest_for(failures, required.quantile, required.confidence)
    return entry


def summarise(folder: Folder) -> dict[str, Any]:
    """Return the content of `summary.json`."""
    parts = folder.whole_parts()
    verdicts, waiting = [*judged(folder), *margins_of(folder)], unjudged(folder)
    head = rows.read(parts, ["status", "reason", "bad_time"]).head(folder.trials)
    counts = {status: int((head["status"] == status).sum()) for status in dict.fromkeys(s for s, _ in STATUS.values())}
    finished, failed = running.finished(head), head.filter(pl.col("status") != "ok")
    reasons = [
        {"status": status, "reason": reason, "trials": int(part.height), "first_bad_time": part["bad_time"].min()}
        for (status, reason), part in sorted(failed.group_by(["status", "reason"]))
    ]
    quantiles, drivers, driver_trials = {}, {}, {}
    ranks: dict[bytes, dict[str, tuple]] = {}  # cached ranks of the inputs, by the subset of trials
    drawn = drawn_columns(folder, parts)
    inputs = rows.read(parts, drawn).head(min(SEARCHED, folder.trials))
    for name in (*scenario.catalogue(folder.scenario), *folder.custom_metric_names):
        values = rows.read(parts, [name]).head(folder.trials)[name].to_numpy().astype(float)
        quantiles[name] = (_of_larger_is_better if name in catalogues.LARGER_IS_BETTER else _of_metric)(
            values, finished
        )
        known = np.isfinite(values[:SEARCHED]) & finished[:SEARCHED]
        driver_trials[name] = int(known.sum())
        of = {key: inputs[key].to_numpy()[known] for key in drawn}
        ranked = ranks.setdefault(known.tobytes(), {})
        drivers[name] = statistics.drivers(of, values[:SEARCHED][known], ranked, CATEGORIES) if known.sum() > 1 else {}
    done = int(head.height)
    differ = any(statistics.vary(inputs[key].to_numpy().astype(float)) for key in drawn)
    met = all(v["met"] for v in verdicts) if verdicts else counts["ok"] == done
    return {
        "status": "incomplete" if done < folder.trials or waiting else "met" if met else "not met",
        "plant": folder.scenario.plant.kind,
        "seed": folder.seed,
        "run_table": folder.table_name,
        "trials": folder.trials,
        "simulated": done,
        "unjudged": waiting,
        "counts": counts,
        "reasons": reasons,
        "interval_confidence": CONFIDENCE,
        "lower_bound": lower_bound_of(folder),
        "verdicts": verdicts,
        **_pointing(folder, parts, finished),
        "quantiles": quantiles,
        "drivers": drivers,
        "driver_trials": driver_trials,  # number of trials with a value of the metric
        **_samples(folder, parts),
        "warnings": [
            *plausibility.warnings(folder.scenario),
            *filter(None, [folder.parameter_differences]),
            *_equal_trials(quantiles, done, drawn=differ),
        ],
    }


def _samples(folder: Folder, parts: list[rows.Part]) -> dict[str, Any]:
    """Return the numbers of samples and of trials for each status of the C code; empty without C code."""
    if folder.controller is None:
        return {}
    kept = rows.columns_of(parts[0])
    names = [name for name in run_tables.SAMPLES if name in kept]  # the most severe status is the last one
    counts = rows.read(parts, names).head(folder.trials)
    samples = {
        name.removeprefix(run_tables.COUNTED): {
            "samples": int(counts[name].sum()),
            "trials": int((counts[name] > 0).sum()),
        }
        for name in names
    }
    return {"controller_samples": samples}


def drawn_columns(folder: Folder, parts: list[rows.Part]) -> list[str]:
    """Return the columns with the inputs of the trials: dispersions, and the values of a run table.

    They are all columns except the results, the trial number and the columns that identify a row's random sample.
    """
    others = {
        run_tables.TRIAL,
        *run_tables.OF_ROWS.values(),
        *run_tables.RESULTS,
        *run_tables.SAMPLES,
        *folder.custom_metric_names,
    }
    return [name for name in rows.columns_of(parts[0]) if name not in others]


def _equal_trials(quantiles: dict[str, Any], trials: int, *, drawn: bool = False) -> list[str]:
    """Return a warning if all trials have the same metrics; drawn: whether the inputs of the trials differ."""
    known = [metric for metric in quantiles.values() if "max" in metric]
    if trials < 2 or not known or any(abs(m["max"] - m["mean"]) > SAME * abs(m["max"]) for m in known):
        return []
    if any(m["without_value"] for m in known):  # failed trials differ from the other trials
        return []
    if drawn:  # such as a dispersed inertia of a body that stays at rest
        return [f"all {trials} trials have the same metrics: the dispersions change no metric"]
    return [
        f"all {trials} trials are equal: neither [dispersion] nor the noise of [hardware] differs; one trial is enough"
    ]


def _pointing(folder: Folder, parts: list[rows.Part], finished: np.ndarray) -> dict[str, Any]:
    """Return the pointing budget: an upper bound for every pointing error index and axis [rad].

    At least the fraction `SHOWN` of all possible runs stays below the bound, with the confidence `CONFIDENCE`. A bound
    is None if there are too few trials, or too many of them failed.
    """
    table = getattr(folder.scenario, "pointing", None)
    if table is None:
        return {}
    there, budget = scenario.catalogue(folder.scenario), {}
    for index in catalogues.INDICES:
        names = {axis: f"{index}_{axis}" for axis in catalogues.AXES if f"{index}_{axis}" in there}
        frame = rows.read(parts, names.values()).head(folder.trials)
        for axis, name in names.items():
            values = frame[name].to_numpy().astype(float)
            ordered = np.sort(np.where(finished & np.isfinite(values), values, np.inf))
            least = must_keep(ordered.size, SHOWN, CONFIDENCE)
            bound = None if least is None or not np.isfinite(ordered[least - 1]) else float(ordered[least - 1])
            budget.setdefault(index, {})[axis] = bound
    observed = {"boresight": table.boresight, "window": table.window, "after": table.after}
    return {"pointing": {**observed, "probability": SHOWN, "confidence": CONFIDENCE, "budget": budget}}


def _of_metric(values: np.ndarray, finished: np.ndarray) -> dict[str, Any]:
    """Return statistics of a metric: mean, RMS and maximum of the trials with a value, and quantiles of all trials.

    Quantiles count a trial without a value as infinite.
    """
    has = finished & np.isfinite(values)
    ordered = np.sort(np.where(has, values, np.inf))
    return _of_known(values, has) | {str(quantile): _at(ordered, quantile) for quantile in QUANTILES}


def _of_larger_is_better(values: np.ndarray, finished: np.ndarray) -> dict[str, Any]:
    """Return statistics of a metric that is better when larger: as `_of_metric`, the minimum, and low quantiles.

    Quantiles count a trial without a value as 0. Key "0.0027" has the value that 99.73 % of the trials reach.
    """
    has = finished & np.isfinite(values)
    ordered = np.sort(-np.where(has, values, 0.0))  # sorted, the best value first
    entry = _of_known(values, has) | {"min": -ordered[-1]}
    for quantile in QUANTILES:
        at = _at(ordered, quantile)
        entry[f"{1.0 - quantile:g}"] = {"value": -at["value"], "low": -at["high"], "high": -at["low"]}
    return entry


def _of_known(values: np.ndarray, has: np.ndarray) -> dict[str, Any]:
    """Return statistics of the trials with a value."""
    known = values[has]
    entry: dict[str, Any] = {"without_value": int(values.size - known.size)}
    if known.size:
        entry |= {"mean": known.mean(), "rms": np.sqrt(np.mean(known**2)), "max": known.max()}
    return entry


def _at(ordered: np.ndarray, quantile: float) -> dict[str, float]:
    """Return a quantile and its confidence interval."""
    low, high = statistics.quantile_interval(ordered, quantile, CONFIDENCE)
    return {"value": statistics.value_at(ordered, quantile), "low": low, "high": high}


def write_summary(folder: Folder, summary: dict[str, Any], figures: bool) -> None:
    """Write `summary.json` and the figures into the campaign's folder.

    Args:
        folder: the campaign.
        summary: content of the file, see `summarise`.
        figures: write the figures too.
    """

    def fill(making: Path) -> None:
        store.write_json(making / store.SUMMARY, summary)
        if figures:
            from ptsmc_jax.figures import style  # the import takes half a second, which only figures need
            from tuning.studies import campaign_figures

            style.save(campaign_figures.build(folder, summary), making / "figures")

    store.write(folder.path, fill)


def worst(folder: Folder, by: str, count: int) -> pl.DataFrame:
    """Return the rows of the worst trials, failed trials first.

    Args:
        folder: the campaign.
        by: column that orders the trials.
        count: number of rows.

    Raises:
        RefusedError: there is no such column, or the rows are damaged.
    """
    parts = folder.whole_parts()
    names = rows.columns_of(parts[0])
    allowed = [
        name for name in names if name not in (run_tables.TRIAL, *run_tables.HEADING, *run_tables.OF_ROWS.values())
    ]
    if by not in allowed:
        listed = f"the head of {folder.path / 'worst.csv'}, which ptsmc worst writes without --by, has all of them"
        raise RefusedError(f"--by is {by}, but must be a column of the rows; {parsing.like(by, allowed, listed)}")
    frame = rows.read(parts, [by, "status"]).head(folder.trials)
    failed = ~running.finished(frame)
    chosen = most_extreme(by, frame[by].fill_null(float("nan")).to_numpy(), failed, count)
    return rows.read(parts).head(folder.trials)[chosen]


def most_extreme(metric: str, values: np.ndarray, failed: np.ndarray, count: int) -> np.ndarray:
    """Return the indices of the worst trials by a metric, failed trials first; see `statistics.most_extreme`.

    Args:
        metric: name of the metric, which decides whether large values are good.
        values: values of the metric (trials,), in its unit; NaN if a trial has no value.
        failed: whether each trial failed (trials,) [-].
        count: number of indices.
    """
    # SAMPLES[0] counts samples without an error
    better = metric in (*catalogues.LARGER_IS_BETTER, run_tables.SAMPLES[0])
    return statistics.most_extreme(values, failed, count, larger_is_better=better)


@dataclass(frozen=True)
class Replay:
    """A repeated simulation of a trial."""

    run: runs.Run  # the run with its history
    off: float | None  # largest relative difference between the new and the stored row; None: no row is stored
    rounding: float  # largest relative difference between `run`, from another compiled program, and the new row


def replay(folder: Folder, trial: int) -> Replay:
    """Simulate a trial again: once as the campaign does, for its row, and once with its history."""
    campaign = folder.campaign
    simulated = trial if campaign.run_table is None else campaign.run_table.row(trial, folder.seed)
    run = runs.simulate(campaign.ready, folder.seed, simulated, campaign.software)
    again = campaign.simulate([trial]).row(0, named=True)
    rounding = max(_relative_difference(value, again[name]) for name, value in run.metrics.items())
    if run.status != again["status"]:
        rounding = np.inf
    off = None
    for part in folder.rows.parts()[0]:
        if part.first <= trial < part.end:
            row = rows.read([part]).filter(pl.col("trial") == trial).row(0, named=True)
            off = max(_relative_difference(value, again[name]) for name, value in row.items())
    return Replay(run, off, rounding)


def _relative_difference(a: Any, b: Any) -> float:
    """Return the relative difference of two values of a row.

    It is 0 if both are equal or missing. It is infinite if they differ and are not both finite floats.
    """
    if isinstance(a, float) and isinstance(b, float) and np.isfinite([a, b]).all():
        return 0.0 if a == b else abs(a - b) / max(abs(a), abs(b))
    missing = [v is None or v != v for v in (a, b)]
    return 0.0 if a == b or all(missing) else np.inf
