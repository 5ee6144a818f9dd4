"""Pareto fronts: the smallest window error for each value of a traded quantity, judged on held-out trials.

A trade states the tuning problems, see `trades`. Each problem starts from the best gains of the others.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from ptsmc_jax.campaigns import store
from ptsmc_jax.campaigns.montecarlo import Trials
from ptsmc_jax.figures import study_plots, style
from ptsmc_jax.scenario import parsing, plausibility, study, tables
from ptsmc_jax.scenario.tables import Scenario
from ptsmc_jax.scenario.timing import Reach
from ptsmc_jax.simulation.catalogues import MARGINS
from tuning.search import gains, trust
from tuning.search.evolution import NEAR_BEST
from tuning.search.journal import Journal
from tuning.search.local_search import Best
from tuning.search.local_searches import LocalSearches
from tuning.search.objective import Problem
from tuning.search.progress import Report
from tuning.search.rounds import MARGIN
from tuning.studies import judging, posing
from tuning.studies.front import KINDS, Front, Point, metric_heading
from tuning.studies.trades import SENSITIVITY, TORQUE, Target, Trade

WARM_STARTS = 3  # starting points of a target among the known gains
# known gains that violate a limit by less than this fraction are starting points like feasible ones
NEARLY_FEASIBLE = 0.05
STEPS = 40  # largest number of evaluations from each starting point
SMALLEST_DISTANCE = 1e-3  # smallest distance of two points, as a fraction of the bounds' intervals

JudgedPoint = tuple[Point, Trials]  # a point and its held-out trials


def trace(trade: Trade, seed: int, report: Report = lambda *_: None, journal: Journal | None = None) -> Front:
    """Find the front of a trade. Raises KeyboardInterrupt on Ctrl-C.

    Args:
        trade: the scenario, and the quantity that its window error is traded against.
        seed: seed of the search. The seed of the held-out trials follows from it.
        report: called with the progress after every step.
        journal: evaluations of an interrupted search, which then resumes.
    """
    setup = posing.set_up_tuning(trade.base, seed, journal, **trade.reach_overrides)
    overrides = trade.reach_overrides
    reach = posing.tuning_reach(trade.base, **overrides) if overrides else None
    targets, known_gains = trade.targets(setup, report)
    best = refine_targets(targets, known_gains, setup, report)
    chosen = drop_equal_gains(best) if trade.merges_points else best
    held_out_seed, judged = judging.derive_held_out_seed(seed), []
    for done, k in enumerate(sorted(chosen)):
        report("judging on held-out trials", done, len(chosen), np.nan, 0.0)
        tuned_gains, value = setup.rounded_gains(chosen[k].normalised), targets[k].value
        tuned = trade.tuned_scenario(value, tuned_gains)
        point = Point(value, tuned_gains, trained=chosen[k].value)
        judged.append(_judge_point(trade, point, tuned, held_out_seed, setup.problem, reach))
    references, published_error = judging.reference_scenarios(trade.scenario) if trade.compares_points else ({}, None)
    scenario = trade.scenario

    def judge_reference(compared: Scenario) -> Point:
        point = Point(np.nan, gains.gains_of(study(compared).parts))
        return _judge_point(trade, point, compared, held_out_seed, setup.problem, reach)[0]

    points = mark_points(judged) if trade.compares_points else [point for point, _ in judged]
    others = {name: judge_reference(compared) for name, compared in references.items()}
    gain_names = [name for point in (*points, *others.values()) for name in point.gains]
    return Front(
        against=trade.against,
        plant=scenario.plant.kind,
        points=points,
        idle=[targets[k].value for k in best if k not in chosen],
        without=[target.value for k, target in enumerate(targets) if k not in best],
        trials=judged[0][1].status.size if judged else 0,
        seed=held_out_seed,
        interval_confidence=trust.CONFIDENCE,
        lower_bound=None if overrides else judging.rms_lower_bound(scenario, held_out_seed),  # the bound depends on t_f
        rollouts=setup.evaluate.rollouts,
        gradients=setup.evaluate.gradients,
        requirements=list(scenario.requirements),
        gain_units=gains.units_of(scenario, gain_names),
        warnings=plausibility.warnings(scenario),
        published_label=gains.published_label(scenario),
        published_unavailable=published_error,
        others=others,
    )


def _judge_point(
    trade: Trade, point: Point, tuned: Scenario, seed: int, problem: Problem, reach: Reach | None
) -> JudgedPoint:
    """Return a point with its results on the held-out trials of this seed, and these trials."""
    trials = judging.judge(tuned, seed, problem, reach)
    rms, interval = judging.rms_window_error(trials)
    verdicts = judging.verdicts_of(tuned, trials, seed, problem, reach)
    met, costs = judging.meets_requirements(verdicts, trials), trade.costs(tuned, trials, verdicts, seed)
    results = {"rms": np.nan if rms is None else rms, "interval": interval, "failures": int(np.sum(~trials.ok))}
    return replace(point, costs=costs, meets=met, **results), trials


def refine_targets(
    targets: Sequence[Target], known_gains: list[np.ndarray], setup: posing.TuningSetup, report: Report
) -> dict[int, Best]:
    """Improve the gains of all targets from the last to the first and back, each from the gains known by then.

    Args:
        targets: the targets in the order of their values.
        known_gains: gains as fractions of the bounds' intervals, (gains,) each; the gains found are added.
        setup: evaluates gains.
        report: called with the progress.

    Returns:
        The best gains by the index of their target. A target without gains that keep its limits is missing.
    """
    best: dict[int, Best] = {}
    order = [*reversed(range(len(targets))), *range(len(targets))]
    for done, k in enumerate(order):
        report(f"refining, {targets[k].name}", done, len(order), np.nan, 0.0)
        candidate = _refine_gains(setup, targets[k].problem, np.unique(np.asarray(known_gains), axis=0))
        if candidate is not None and (k not in best or candidate.f < best[k].f):
            best[k] = candidate
            known_gains.append(candidate.normalised)
    return best


def _refine_gains(setup: posing.TuningSetup, problem: Problem, known_gains: np.ndarray) -> Best | None:
    """Return the best feasible point of known gains and of searches from the best of them; None: there is none."""
    searches = LocalSearches(setup.evaluate, MARGIN, STEPS, np.random.default_rng(0))
    results = setup.evaluate.measure(searches.tightened(problem), known_gains)
    starts = known_gains[np.lexsort((results.f, np.maximum(results.largest_c - NEARLY_FEASIBLE, 0.0)))[:WARM_STARTS]]
    best = Best(known_gains[0], len(problem.rows), MARGIN)
    best.offer(known_gains, results)
    if setup.settings.with_gradients:
        searches.search_locally(problem, dict(enumerate(starts)))
    else:
        searches.evolve(problem, starts[0], NEAR_BEST)
    best = min(best, searches.best, key=lambda candidate: candidate.rank) if searches.started else best
    return best if best.violation == 0.0 else None


def drop_equal_gains(best: dict[int, Best]) -> dict[int, Best]:
    """Return the first target of each group with the same gains, because the limits of the others are not active."""
    distinct: dict[int, Best] = {}
    for k in sorted(best):
        if all(np.abs(best[k].normalised - other.normalised).max() >= SMALLEST_DISTANCE for other in distinct.values()):
            distinct[k] = best[k]
    return distinct


def mark_points(judged: Sequence[JudgedPoint]) -> list[Point]:
    """Return the points in order of peak torque, with dominated points and the knee marked."""
    pairs = sorted(judged, key=lambda pair: pair[0].peak)
    points = [replace(pair[0], dominated=any(_dominates(other, pair) for other in pairs)) for pair in pairs]
    # logarithms need positive numbers, which exist if a trial ends
    front = [k for k, p in enumerate(points) if not p.dominated and p.peak > 0.0 and p.rms > 0.0]
    if len(front) > 2:
        knee = front[find_knee(np.asarray([[points[k].peak, points[k].rms] for k in front]))]
        points[knee] = replace(points[knee], knee=True)
    return points


def _dominates(one: JudgedPoint, other: JudgedPoint) -> bool:
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


def find_knee(points: np.ndarray) -> int:
    """Return the index of the point farthest below the line between the ends of a front, in logarithms.

    Args:
        points: peak torque and error (count, 2), in order along the front.
    """
    log_offsets = np.log(points) - np.log(points[0])
    chord = log_offsets[-1]  # a scaled axis changes all distances by the same factor
    return int(np.argmax(log_offsets[:, 0] * chord[1] - log_offsets[:, 1] * chord[0]))


def write(folder: Path, trade: Trade, front: Front, figures: bool, identity: Mapping[str, object]) -> None:
    """Write a result folder: `summary.json`, a CSV file with the points, and a figure.

    Args:
        folder: an empty folder.
        trade: the scenario and the traded quantity.
        front: the results.
        figures: write the figure too.
        identity: entries of `versions.json`, see `Trade.identity`.
    """
    kind, names = KINDS[front.against], gains.free_gain_names(trade.scenario)
    store.write_run_files(folder, parsing.dump(trade.scenario), identity, front.summary())
    error, marks = ("rms_window_error", "rms_low", "rms_high"), ("dominated", "knee", "trained_objective")
    costs = front.points[0].costs if front.points else ()
    header = [kind.column, *names, *error, *costs, "failures", "meets", *(marks if trade.compares_points else ())]
    rows = [
        [p.value, *(p.gains[name] for name in names), p.rms, *(p.interval or ("", "")), *p.costs.values(), p.failures,
         int(p.meets), *((int(p.dominated), int(p.knee), p.trained) if trade.compares_points else ())]
        for p in front.points
    ]  # fmt: skip
    store.write_csv(folder / f"{kind.file}.csv", header, rows)
    if figures and front.points:
        style.save({kind.file: figure_of(trade, front)}, folder / "figures")


def figure_of(trade: Trade, front: Front) -> Figure:
    """Plot the error over the peak torque, or the error and the costs over the traded quantity."""
    kind, scenario = KINDS[front.against], trade.scenario
    if trade.compares_points:
        limit = tables.limit_of(scenario, TORQUE)
        return study_plots.front(front.points, front.labelled(), limit, front.plant, front.lower_bound)
    to_shown_unit, error, unit = style.error_display(front.plant)
    limit = tables.limit_of(scenario, "window_error")
    rms = to_shown_unit([point.rms for point in front.points])
    panels = {f"RMS {error} in the window [{unit}]": (rms, None if limit is None else float(to_shown_unit(limit)))}
    for name in front.points[0].costs:
        if (front.against, name) == ("margins", SENSITIVITY):  # the horizontal axis
            continue
        is_margin = name in MARGINS
        convert, unit = (np.asarray, MARGINS[name].unit) if is_margin else style.metric_display(name, front.plant)
        column, limit = convert([point.costs[name] for point in front.points]), tables.limit_of(scenario, name)
        shown_limit = None if limit is None else float(convert(limit))
        panels[metric_heading(name, unit)] = (np.where(np.isfinite(column), column, np.nan), shown_limit)
    values = [point.value for point in front.points]
    finite = [value for value in values if np.isfinite(value)]
    # the point without a limit is as far from the loosest limit as the next limit
    no_limit_place = 2.0 * finite[0] - finite[1] if len(finite) > 1 else sum(finite) + 1.0
    ticks = [f"{value:g}" if np.isfinite(value) else "none" for value in values] if len(finite) < len(values) else None
    places = [value if np.isfinite(value) else no_limit_place for value in values]
    title = f"{kind.title}, held-out trials"
    return study_plots.costs(
        front.points, study_plots.Sweep(title, kind.label(front.plant), places, ticks), panels, front.plant
    )
