"""Pareto fronts: the smallest window error for each value of a traded quantity, judged on held-out trials.

A trade states the tuning problems, see `trades`. Each problem starts from the best gains of the others.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from ptsmc_jax.campaigns import store
from ptsmc_jax.campaigns.montecarlo import Trials
from ptsmc_jax.figures import study_plots, style
from ptsmc_jax.scenario import parsing, plausibility, study, tables
from ptsmc_jax.scenario.tables import Scenario
from ptsmc_jax.scenario.timing import Reach
from tuning.search import gains, trust
from tuning.search.evolution import NEARBY
from tuning.search.journal import Journal
from tuning.search.local_search import Best
from tuning.search.local_searches import LocalSearches
from tuning.search.objective import Problem
from tuning.search.progress import Report
from tuning.search.rounds import MARGIN
from tuning.studies import judging, posing
from tuning.studies.front import KINDS, Front, Point, titled
from tuning.studies.trades import SENSITIVITY, TORQUE, Target, Trade

WARM = 3  # starting points of a target among the known gains
NEARLY = 0.05  # known gains that violate a limit by less than this fraction are starting points like feasible ones
STEPS = 40  # largest number of evaluations from each starting point
APART = 1e-3  # smallest distance of two points, as a fraction of the bounds' intervals

Judged = tuple[Point, Trials]


def trace(trade: Trade, seed: int, tell: Report = lambda *_: None, journal: Journal | None = None) -> Front:
    """Find the front of a trade. Raises KeyboardInterrupt on Ctrl-C.

    Args:
        trade: the scenario, and the quantity that its window error is traded against.
        seed: seed of the search. The seed of the held-out trials follows from it.
        tell: called with the progress after every step.
        journal: evaluations of an interrupted search, which then resumes.
    """
    posed = posing.tuning_problem(trade.base, seed, journal, **trade.farther)
    reach = posing.reach(trade.base, trade.base.search, **trade.farther) if trade.farther else None
    targets, known = trade.targets(posed, tell)
    best = refined(targets, known, posed, tell)
    chosen, held_out_seed, judged = apart(best) if trade.merged else best, judging.seed_of_judge(seed), []
    for done, k in enumerate(sorted(chosen)):
        tell("judging on held-out trials", done, len(chosen), np.nan, 0.0)
        found, value = posed.named(chosen[k].normalised), targets[k].value
        tuned = trade.tuned(value, found)
        judged.append(_judged(trade, Point(value, found, trained=chosen[k].value), tuned, held_out_seed, reach))
    others, refused = judging.beside(trade.scenario) if trade.compared else ({}, None)
    scenario = trade.scenario

    def reference(one: Scenario) -> Point:
        return _judged(trade, Point(np.nan, gains.gains_of(study(one).parts)), one, held_out_seed, reach)[0]

    return Front(
        against=trade.against,
        plant=scenario.plant.kind,
        points=marked(judged) if trade.compared else [point for point, _ in judged],
        idle=[targets[k].value for k in best if k not in chosen],
        without=[target.value for k, target in enumerate(targets) if k not in best],
        trials=judged[0][1].status.size if judged else 0,
        seed=held_out_seed,
        interval_confidence=trust.CONFIDENCE,
        lower_bound=None if trade.farther else judging.rms_lower_bound(scenario, held_out_seed),  # depends on t_f
        rollouts=posed.evaluate.rollouts,
        gradients=posed.evaluate.gradients,
        requirements=list(scenario.requirements),
        gain_units=gains.units_of(scenario),
        warnings=plausibility.warnings(scenario),
        published_label=gains.published_label(scenario),
        published_unavailable=refused,
        others={name: reference(one) for name, one in others.items()},
    )


def _judged(trade: Trade, point: Point, tuned: Scenario, seed: int, reach: Reach | None) -> Judged:
    """Return a point with its results on the held-out trials of this seed, and these trials."""
    trials = judging.judge(tuned, seed, reach)
    rms, interval = judging.window_error(trials)
    met, costs = judging.met(judging.verdicts_of(tuned, trials, seed), trials), trade.costs(tuned, trials, seed)
    found = {"rms": np.nan if rms is None else rms, "interval": interval, "failures": int(np.sum(~trials.ok))}
    return replace(point, costs=costs, meets=met, **found), trials


def refined(targets: Sequence[Target], known: list[np.ndarray], posed: posing.Posed, tell: Report) -> dict[int, Best]:
    """Improve the gains of all targets from the last to the first and back, each from the gains known by then.

    Args:
        targets: the targets in the order of their values.
        known: gains as fractions of the bounds' intervals, (gains,) each; the gains found are added.
        posed: evaluates gains.
        tell: called with the progress.

    Returns:
        The best gains by the index of their target. A target without gains that keep its limits is missing.
    """
    best: dict[int, Best] = {}
    order = [*reversed(range(len(targets))), *range(len(targets))]
    for done, k in enumerate(order):
        tell(f"refining, {targets[k].name}", done, len(order), np.nan, 0.0)
        found = _refined(posed, targets[k].problem, np.unique(np.asarray(known), axis=0))
        if found is not None and (k not in best or found.f < best[k].f):
            best[k] = found
            known.append(found.normalised)
    return best


def _refined(posed: posing.Posed, problem: Problem, known: np.ndarray) -> Best | None:
    """Return the best feasible gains, known ones or those of searches from the most promising known ones."""
    run = LocalSearches(posed.evaluate, MARGIN, STEPS, np.random.default_rng(0))
    simulated = posed.evaluate.measure(run.tightened(problem), known)
    chosen = known[np.lexsort((simulated.f, np.maximum(simulated.largest_c - NEARLY, 0.0)))[:WARM]]
    best = Best(known[0], len(problem.rows), MARGIN)
    best.offer(known, simulated)
    if posed.with_gradients:
        run.search_locally(problem, dict(enumerate(chosen)))
    else:
        run.evolve(problem, chosen[0], NEARBY)
    best = min(best, run.best, key=lambda one: one.rank) if run.started else best
    return best if best.violation == 0.0 else None


def apart(best: dict[int, Best]) -> dict[int, Best]:
    """Return the first target of each group with the same gains, because the limits of the others are not active."""
    kept: dict[int, Best] = {}
    for k in sorted(best):
        if all(np.abs(best[k].normalised - other.normalised).max() >= APART for other in kept.values()):
            kept[k] = best[k]
    return kept


def marked(judged: Sequence[Judged]) -> list[Point]:
    """Return the points in order of peak torque, with dominated points and the knee marked."""
    pairs = sorted(judged, key=lambda pair: pair[0].peak)
    points = [replace(pair[0], dominated=any(_dominates(other, pair) for other in pairs)) for pair in pairs]
    # logarithms need positive numbers, which exist if a trial ends
    front = [k for k, p in enumerate(points) if not p.dominated and p.peak > 0.0 and p.rms > 0.0]
    if len(front) > 2:
        knee = front[knee_of(np.asarray([[points[k].peak, points[k].rms] for k in front]))]
        points[knee] = replace(points[knee], knee=True)
    return points


def _dominates(one: Judged, other: Judged) -> bool:
    """Return whether a point needs no more torque and is more accurate, beyond the interval of the ratio.

    A point with more failed trials dominates no other. A single trial, without dispersions, has no interval.
    """
    (a, trials), (b, others) = one, other
    if a is b or a.failures > b.failures or not (a.peak <= b.peak and a.rms < b.rms):
        return False
    both = trials.finished & others.finished
    errors, error_of_others = (np.asarray(simulated.metrics.window_error)[both] for simulated in (trials, others))
    interval = trust.ratio_interval(error_of_others, errors)
    return trials.status.size == 1 if interval is None else interval[0] > 1.0


def knee_of(points: np.ndarray) -> int:
    """Return the index of the point farthest below the line between the ends of a front, in logarithms.

    Args:
        points: peak torque and error (count, 2), in order along the front.
    """
    off = np.log(points) - np.log(points[0])
    along = off[-1]  # a scaled axis changes all distances by the same factor
    return int(np.argmax(off[:, 0] * along[1] - off[:, 1] * along[0]))


def write(folder: Path, trade: Trade, front: Front, figures: bool, known_by: dict[str, Any]) -> None:
    """Write a result folder: `summary.json`, a CSV file with the points, and a figure.

    Args:
        folder: an empty folder.
        trade: the scenario and the traded quantity.
        front: the results.
        figures: write the figure too.
        known_by: entries of `versions.json`, see `Trade.identity`.
    """
    kind, names = KINDS[front.against], gains.named(trade.scenario)
    store.record(folder, parsing.dump(trade.scenario), known_by, front.summary())
    error, marks = ("rms_window_error", "rms_low", "rms_high"), ("dominated", "knee", "trained_objective")
    costs = front.points[0].costs if front.points else ()
    header = [kind.column, *names, *error, *costs, "failures", "meets", *(marks if trade.compared else ())]
    rows = [
        [p.value, *(p.gains[name] for name in names), p.rms, *(p.interval or ("", "")), *p.costs.values(), p.failures,
         int(p.meets), *((int(p.dominated), int(p.knee), p.trained) if trade.compared else ())]
        for p in front.points
    ]  # fmt: skip
    store.write_csv(folder / f"{kind.file}.csv", header, rows)
    if figures and front.points:
        style.save({kind.file: figure_of(trade, front)}, folder / "figures")


def figure_of(trade: Trade, front: Front) -> Figure:
    """Plot the error over the peak torque, or the error and the costs over the traded quantity."""
    kind, scenario = KINDS[front.against], trade.scenario
    if trade.compared:
        limit = tables.limit_of(scenario, TORQUE)
        return study_plots.front(front.points, front.labelled(), limit, front.plant, front.lower_bound)
    shown, error, unit = style.shown_error(front.plant)
    limit = tables.limit_of(scenario, "window_error")
    rms = shown([one.rms for one in front.points])
    panels = {f"RMS {error} in the window [{unit}]": (rms, None if limit is None else float(shown(limit)))} | {
        titled(name, front.plant): (
            np.array([one.costs[name] for one in front.points]),
            tables.limit_of(scenario, name),
        )
        for name in front.points[0].costs
        if name != SENSITIVITY
    }
    panels = {
        title: (np.where(np.isfinite(column), column, np.nan), limit) for title, (column, limit) in panels.items()
    }
    values = [one.value for one in front.points]
    finite = [value for value in values if np.isfinite(value)]
    # the point without a limit is as far from the loosest limit as the next limit
    beyond = 2.0 * finite[0] - finite[1] if len(finite) > 1 else sum(finite) + 1.0
    ticks = [f"{value:g}" if np.isfinite(value) else "none" for value in values] if len(finite) < len(values) else None
    places = [value if np.isfinite(value) else beyond for value in values]
    title = f"{kind.title}, held-out trials"
    return study_plots.costs(
        front.points, study_plots.Sweep(title, kind.label(front.plant), places, ticks), panels, front.plant
    )
