"""What is said of a campaign from its rows: verdicts, quantiles with intervals, drivers, single trials."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from ptsmc_jax import scenario
from ptsmc_jax.campaigns import campaign as flying
from ptsmc_jax.campaigns import plans, rows, runs, store
from ptsmc_jax.campaigns.store import RefusedError
from ptsmc_jax.dispersions.quantities import CATEGORIES
from ptsmc_jax.numerics import statistics
from ptsmc_jax.scenario import cautions, parsing
from ptsmc_jax.simulation import catalogues
from ptsmc_jax.simulation.requirements import Requirement, Verdict, must_keep
from ptsmc_jax.simulation.rollout import STATUS
from tuning.studies.campaign_folder import Folder, opened
from tuning.studies.campaign_theory import floor_of, margins_of, unjudged

SAME = 1e-12  # how far a replayed run may be off its row, relative
CONFIDENCE = 0.95  # of the intervals, where a requirement says nothing else
QUANTILES = (0.5, 0.9, 0.99, 0.9973)
SHOWN = 0.9973  # share of the runs that a pointing budget holds for: three sigma of a normal number
SEARCHED = 100_000  # trials by which it is judged what drives a metric


def first_look(folder: Folder, force: bool) -> int | None:
    """How many trials are looked at first: all that a finished campaign has that goes on; None: a part.

    One that was interrupted has the same first look when it goes on, and so stops where it would have stopped anyway.
    """
    try:
        before = None if force else opened(folder.path)
    except RefusedError:  # there is none
        before = None
    if before is None:
        return None
    finished = before.trials < folder.trials and _there(before) >= before.trials
    return before.trials if finished else before.first_look


def until_confident(folder: Folder, width: float, fly_first: Callable[[int], None]) -> int:
    """Fly ever more trials until every requirement's share is known to within `width`; returns how many.

    Looked at after each doubling. The intervals are those of a campaign whose size was fixed beforehand: looking
    often, and stopping by what is seen, makes them a little too sure.
    """
    count, there = folder.first_look or flying.PART, _there(folder)
    while count < there:  # none is left out
        count *= 2
    while True:
        count = min(count, folder.trials)
        fly_first(count)
        intervals = [verdict["share_interval"] for verdict in judged(folder, first=count)]
        widths = [high - low for low, high in intervals]
        if count == folder.trials or all(w <= width for w in widths):
            return count
        count *= 2


def _there(folder: Folder) -> int:
    return sum(part.count for part in folder.rows.parts()[0])


def judged(folder: Folder, first: int | None = None) -> list[dict[str, Any]]:
    """What `summary.json` says of each verdict over the trials (the first so many), but for margins."""
    wanted = scenario.requirements(folder.scenario)
    names = dict.fromkeys(name for r in wanted for name in (r.metric, r.timed) if name is not None)
    frame = rows.read(folder.whole_parts(), ["status", *names]).head(first or folder.trials)
    finished = flying.finished(frame)
    verdicts = flying.verdicts(wanted, frame)
    return [_in_summary(v, r, _beyond(frame, r, finished)) for v, r in zip(verdicts, wanted, strict=True)]


def _beyond(frame: pl.DataFrame, wanted: Requirement, ok: np.ndarray) -> np.ndarray:
    """Share of the time that each trial is beyond a limit: 0 or 1 where it is asked for at all times, (trials,)."""
    if wanted.interpretation != "mixed" or wanted.timed is None:
        return np.zeros(0)
    return np.where(ok, 1.0 - frame[wanted.timed].fill_null(0.0).to_numpy(), 1.0)


def _in_summary(verdict: Verdict, wanted: Requirement, beyond: np.ndarray) -> dict[str, Any]:
    within, confidence = verdict.trials - verdict.failures, wanted.confidence or CONFIDENCE
    entry = verdict.in_summary()
    if beyond.size:  # a share of the time, of which runs are what is independent
        each = (1.0 + CONFIDENCE) / 2.0
        entry["share"] = 1.0 - beyond.mean()
        entry["share_interval"] = 1.0 - statistics.mean_bound(beyond, each), statistics.mean_bound(1.0 - beyond, each)
        entry["share_bound"] = 1.0 - statistics.mean_bound(beyond, confidence)
    else:
        entry["share"] = within / verdict.trials
        entry["share_interval"] = statistics.share_interval(within, verdict.trials, CONFIDENCE)
        entry["share_bound"] = statistics.share_bound(within, verdict.trials, confidence)
    if wanted.quantile is not None and wanted.confidence is not None:
        failures = verdict.failures if wanted.timed is None else 0
        entry["fewest_trials"] = statistics.fewest_for(failures, wanted.quantile, wanted.confidence)
    return entry


def summarise(folder: Folder) -> dict[str, Any]:
    """What `summary.json` says."""
    parts = folder.whole_parts()
    verdicts, waiting = [*judged(folder), *margins_of(folder)], unjudged(folder)
    head = rows.read(parts, ["status", "reason", "bad_time"]).head(folder.trials)
    counts = {status: int((head["status"] == status).sum()) for status in dict.fromkeys(s for s, _ in STATUS.values())}
    finished, failed = flying.finished(head), head.filter(pl.col("status") != "ok")
    reasons = [
        {"status": status, "reason": reason, "trials": int(part.height), "first_bad_time": part["bad_time"].min()}
        for (status, reason), part in sorted(failed.group_by(["status", "reason"]))
    ]
    quantiles, drivers, driver_trials = {}, {}, {}
    ranks: dict[bytes, dict[str, tuple]] = {}  # of the inputs, by the trials that they are ranked among
    drawn = drawn_columns(folder, parts)
    inputs = rows.read(parts, drawn).head(min(SEARCHED, folder.trials))
    for name in (*scenario.catalogue(folder.scenario), *folder.own_names):
        values = rows.read(parts, [name]).head(folder.trials)[name].to_numpy().astype(float)
        quantiles[name] = (_of_share if name in catalogues.LARGER_IS_BETTER else _of_metric)(values, finished)
        known = np.isfinite(values[:SEARCHED]) & finished[:SEARCHED]
        driver_trials[name] = int(known.sum())
        of = {key: inputs[key].to_numpy()[known] for key in drawn}
        ranked = ranks.setdefault(known.tobytes(), {})
        drivers[name] = statistics.drivers(of, values[:SEARCHED][known], ranked, CATEGORIES) if known.sum() > 1 else {}
    done = int(head.height)
    differ = any(statistics.vary(inputs[key].to_numpy().astype(float)) for key in drawn)
    met = all(v["met"] for v in verdicts) if verdicts else counts["ok"] == done
    return {
        "status": "unfinished" if done < folder.trials or waiting else "met" if met else "not met",
        "plant": folder.scenario.plant.kind,
        "seed": folder.seed,
        "plan": folder.plan,
        "trials": folder.trials,
        "flown": done,
        "unjudged": waiting,
        "counts": counts,
        "reasons": reasons,
        "interval_confidence": CONFIDENCE,
        "floor": floor_of(folder),
        "verdicts": verdicts,
        **_pointing(folder, parts, finished),
        "quantiles": quantiles,
        "drivers": drivers,
        "driver_trials": driver_trials,  # in which they were seen: those that have the metric
        **_samples(folder, parts),
        "cautions": [
            *cautions.of(folder.scenario),
            *filter(None, [folder.otherwise]),
            *_alike(quantiles, done, drawn=differ),
        ],
    }


def _samples(folder: Folder, parts: list[rows.Part]) -> dict[str, Any]:
    """How many samples the controller's C ended with each status, and in how many trials; nothing without one."""
    if folder.controller is None:
        return {}
    kept = rows.columns_of(parts[0])
    names = [name for name in plans.SAMPLES if name in kept]  # the gravest last
    counts = rows.read(parts, names).head(folder.trials)
    told = {
        name.removeprefix(plans.COUNTED): {"samples": int(counts[name].sum()), "trials": int((counts[name] > 0).sum())}
        for name in names
    }
    return {"controller_samples": told}


def drawn_columns(folder: Folder, parts: list[rows.Part]) -> list[str]:
    """The columns that say what trials flew with: all but results, and whose draws a row has.

    They stand in the order of their names: inertias and disturbances before the initial angle.
    """
    others = {plans.TRIAL, *plans.OF_ROWS.values(), *plans.RESULTS, *plans.SAMPLES, *folder.own_names}
    return [name for name in rows.columns_of(parts[0]) if name not in others]


def _alike(quantiles: dict[str, Any], trials: int, *, drawn: bool = False) -> list[str]:
    """Whether every trial is the same flight, to round-off; drawn: something is that differs between them."""
    known = [metric for metric in quantiles.values() if "max" in metric]
    if trials < 2 or not known or any(abs(m["max"] - m["mean"]) > SAME * abs(m["max"]) for m in known):
        return []
    if any(m["without_value"] for m in known):  # a trial that failed is no flight of one that did not
        return []
    if drawn:  # as another inertia of a body that stays at rest
        return [f"all {trials} trials have the same metrics: what is drawn in them changes none"]
    return [
        f"all {trials} trials are the same flight: nothing is drawn in them, neither by [dispersion] nor as noise of "
        "[hardware], and one would do"
    ]


def _pointing(folder: Folder, parts: list[rows.Part], finished: np.ndarray) -> dict[str, Any]:
    """The pointing budget: of every index what `SHOWN` of the runs keep, with `CONFIDENCE` at most this much [rad]."""
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
    """Statistics of a metric: mean, RMS and largest of the trials that have it, quantiles over all trials.

    In the quantiles a trial without a value counts as beyond all others: it is not left out.
    """
    has = finished & np.isfinite(values)
    ordered = np.sort(np.where(has, values, np.inf))
    return _of_known(values, has) | {str(quantile): _at(ordered, quantile) for quantile in QUANTILES}


def _of_share(values: np.ndarray, finished: np.ndarray) -> dict[str, Any]:
    """The same of a metric that is better when larger: its smallest too, and quantiles of its bad end.

    A trial without a value counts as 0. "0.0027" is what 99.73 % of the trials reach.
    """
    has = finished & np.isfinite(values)
    ordered = np.sort(-np.where(has, values, 0.0))  # the best first
    entry = _of_known(values, has) | {"min": -ordered[-1]}
    for quantile in QUANTILES:
        at = _at(ordered, quantile)
        entry[f"{1.0 - quantile:g}"] = {"value": -at["value"], "low": -at["high"], "high": -at["low"]}
    return entry


def _of_known(values: np.ndarray, has: np.ndarray) -> dict[str, Any]:
    """Statistics of the trials that have a value."""
    known = values[has]
    entry: dict[str, Any] = {"without_value": int(values.size - known.size)}
    if known.size:
        entry |= {"mean": known.mean(), "rms": np.sqrt(np.mean(known**2)), "max": known.max()}
    return entry


def _at(ordered: np.ndarray, quantile: float) -> dict[str, float]:
    """A quantile with its interval."""
    low, high = statistics.quantile_interval(ordered, quantile, CONFIDENCE)
    return {"value": statistics.value_at(ordered, quantile), "low": low, "high": high}


def write_summary(folder: Folder, summary: dict[str, Any], figures: bool) -> None:
    """Write the summary and the figures into the campaign's folder."""

    def fill(making: Path) -> None:
        store.write_json(making / store.SUMMARY, summary)
        if figures:
            from ptsmc_jax.figures import style  # takes half a second, which no other reader of rows need wait for
            from tuning.studies import campaign_figures

            style.save(campaign_figures.of(folder, summary), making / "figures")

    store.write(folder.path, fill)


def worst(folder: Folder, by: str, count: int) -> pl.DataFrame:
    """The rows of the worst trials by a metric, failed ones first."""
    parts = folder.whole_parts()
    names = rows.columns_of(parts[0])
    allowed = [name for name in names if name not in (plans.TRIAL, *plans.HEADING, *plans.OF_ROWS.values())]
    if by not in allowed:
        listed = f"the head of {folder.path / 'worst.csv'}, which ptsmc worst writes without --by, has all of them"
        raise RefusedError(f"--by is {by}, but must be a column of the rows; {parsing.like(by, allowed, listed)}")
    frame = rows.read(parts, [by, "status"]).head(folder.trials)
    failed = ~flying.finished(frame)
    chosen = most_extreme(by, frame[by].fill_null(float("nan")).to_numpy(), failed, count)
    return rows.read(parts).head(folder.trials)[chosen]


def most_extreme(metric: str, values: np.ndarray, failed: np.ndarray, count: int) -> np.ndarray:
    """Indices of the worst of trials (trials,) by a metric, failed ones first; see `statistics.most_extreme`."""
    better = metric in (*catalogues.LARGER_IS_BETTER, plans.SAMPLES[0])  # as of samples that ended well
    return statistics.most_extreme(values, failed, count, larger_is_better=better)


@dataclass(frozen=True)
class Replay:
    """A trial flown again."""

    run: runs.Run  # with its history
    off: float | None  # largest difference of the row flown again from the one kept, relative; None: none is kept
    rounding: float  # the same of the run with its history, which another program flies, from the row flown again


def replay(folder: Folder, trial: int) -> Replay:
    """A trial's row as the campaign flies it, and its run in full."""
    campaign = folder.campaign
    flown = trial if campaign.plan is None else campaign.plan.row(trial, folder.seed)
    run = runs.fly(campaign.ready, folder.seed, flown, campaign.software)
    again = campaign.fly([trial]).row(0, named=True)
    rounding = max(_off(value, again[name]) for name, value in run.metrics.items())
    if run.status != again["status"]:
        rounding = np.inf
    off = None
    for part in folder.rows.parts()[0]:
        if part.first <= trial < part.end:
            row = rows.read([part]).filter(pl.col("trial") == trial).row(0, named=True)
            off = max(_off(value, again[name]) for name, value in row.items())
    return Replay(run, off, rounding)


def _off(a: Any, b: Any) -> float:
    """Relative difference of two values of a row."""
    if isinstance(a, float) and isinstance(b, float) and np.isfinite([a, b]).all():
        return 0.0 if a == b else abs(a - b) / max(abs(a), abs(b))
    missing = [v is None or v != v for v in (a, b)]
    return 0.0 if a == b or all(missing) else np.inf
