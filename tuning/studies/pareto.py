"""Accuracy against peak torque: the front by epsilon-constraint with warm starts, every point judged on fresh trials.

The smallest window error is found for a ladder of limits on the peak torque, from the gains that ask for the least to
those that no limit holds back; each step starts from what its neighbours found (Haimes, Lasdon and Wismer, IEEE Trans.
SMC 1(3), 1971), and from what searches found at both ends and at the scenario's own limit, or in the middle.
"""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ptsmc_jax.campaigns import store
from ptsmc_jax.campaigns.montecarlo import Trials
from ptsmc_jax.figures import study_plots, style
from ptsmc_jax.scenario import cautions, own, parsing, study, tables
from ptsmc_jax.scenario import replace as changed
from ptsmc_jax.scenario.errors import wrong
from ptsmc_jax.scenario.tables import Scenario
from ptsmc_jax.simulation import catalogues
from tuning.search import gains, trust
from tuning.search.cma_es import NEARBY
from tuning.search.descent import Best
from tuning.search.descents import Descents
from tuning.search.journal import Journal
from tuning.search.objective import Problem, replaced
from tuning.search.optimise import Search
from tuning.search.progress import Report, headed
from tuning.search.rounds import MARGIN
from tuning.studies import judging, posing

TORQUE = "peak_torque"
OFF = 1e9  # a limit that holds nothing back
HARDLY = 0.05  # of the largest torque that gains accuracy: a limit that hardly any gains keep
TIGHTER = 3  # such limits at most, each of the one before, where gains keep that
FEWER = 4  # starts of the search for the least torque
WARM = 3  # of the gains known so far, from which each step of the ladder starts
NEARLY = 0.05  # of a limit: known gains that are beyond it by less are as good a start as those that keep it
STEPS = 40  # points looked at from each of them, at most
APART = 1e-3  # of the bounds' intervals between two points, at least


@dataclass(frozen=True)
class Point:
    """Gains on the front, or off it."""

    limit: float  # on the largest peak torque of the training trials [N m]; NaN: gains that were not searched for
    gains: dict[str, float]
    trained: float  # the goal over the training trials
    rms: float  # window error over the fresh trials
    interval: tuple[float, float] | None  # of it
    peak: float  # peak torque that the share of fresh trials asked for stays below, or all of them
    mean_peak: float
    failures: int  # fresh trials that failed or missed t_f
    meets: bool  # every requirement, on the fresh trials
    dominated: bool = False  # by another point, beyond the interval of the ratio of their errors
    knee: bool = False


@dataclass(frozen=True)
class Front:
    """The points in order of their peak torque, and for comparison the paper's and the scenario's own gains."""

    points: list[Point]
    steps: int  # of the ladder of limits that they were looked for on
    others: dict[str, Point]
    paper_refused: str | None  # why the paper's gains are not among them
    fresh_seed: int
    trials: int
    floor: float | None  # RMS window error that no controller can beat
    rollouts: int
    gradients: int

    @property
    def kept(self) -> list[Point]:
        """The points that no other one dominates."""
        return [point for point in self.points if not point.dominated]

    @property
    def status(self) -> str:
        """Whether some gains on the front meet every requirement on the fresh trials."""
        return "met" if any(point.meets for point in self.kept) else "not met"


def trace(
    scenario: Scenario,
    seed: int,
    points: int,
    tell: Report = lambda *_: None,
    journal: Journal | None = None,
) -> Front:
    """The front of a scenario's free gains, with so many steps of the ladder. Raises KeyboardInterrupt on Ctrl-C."""
    limited, own_limit = _limited(scenario)
    posed = posing.pose(limited, seed, journal)
    problem, evaluate, starts = posed.problem, posed.evaluate, limited.search.starts
    beside, refused = judging.beside(limited)
    at = problem.metrics.index(TORQUE)

    def under(limit: float) -> Problem:
        return replace(problem, limits=replaced(problem.limits, at, limit))

    loose = [replace(r, limit=OFF) if r.metric == TORQUE else r for r in posed.asked]
    report = headed(tell, "most torque")
    free = uninterrupted(posed.search(under(OFF), posed.own, starts, loose, judged=False, report=report))
    problem = replace(free.problem, limits=problem.limits)
    highest = free.ended[at] * OFF
    report = headed(tell, "least torque")

    def asking_for(limit: float) -> tuple[Search, float]:
        found = uninterrupted(posed.search(under(limit), posed.own, FEWER, (), judged=False, report=report))
        return found, found.ended[at] * limit

    least, lowest = least_torque(asking_for, highest)
    ladder, middle = ladder_between(lowest / (1.0 - MARGIN), highest / (1.0 - MARGIN), points, own_limit)
    # gains at the ends need not lead to the best valley between them
    report = headed(tell, f"peak torque {ladder[middle]:.3g}")
    between = uninterrupted(posed.search(under(ladder[middle]), posed.own, starts, (), judged=False, report=report))
    rungs = [(f"peak torque {limit:.3g}", under(limit)) for limit in ladder]
    known = [share for found in (free, least, between) for share in (found.share, *found.ends)]
    best = apart(climbed(rungs, known, posed, tell))
    by_limit = {float(ladder[k]): one for k, one in best.items()}
    fresh_seed = judging.seed_of_judge(seed)
    judged = _judge(limited, posed, by_limit, fresh_seed, tell)
    others = {}
    for name, other in beside.items():
        trials, values = judging.judge(other, fresh_seed), gains.gains_of(study(other).parts)
        others[name] = _point(np.nan, values, np.nan, trials, other, fresh_seed)
    return Front(
        points=_marked(judged),
        steps=points,
        others=others,
        paper_refused=refused,
        fresh_seed=fresh_seed,
        trials=next(iter(judged.values()))[1].status.size if judged else 0,
        floor=judging.floor_of(scenario, fresh_seed),
        rollouts=evaluate.rollouts,
        gradients=evaluate.gradients,
    )


def ladder_between(lowest: float, highest: float, points: int, own: float | None) -> tuple[np.ndarray, int]:
    """Limits (points,) evenly spread by their logarithms, and which of them the search between the ends is for.

    That is the scenario's own, in place of the one that is nearest to it, where it lies between the ends.
    """
    ladder, middle = np.geomspace(lowest, highest, points), points // 2
    if own is not None and lowest < own < highest:
        middle = 1 + int(np.argmin(np.abs(np.log(ladder[1:-1] / own))))
        ladder[middle] = own
    return ladder, middle


def least_torque(
    asking_for: Callable[[float], tuple[Any, float]], highest: float, tighter: int = TIGHTER
) -> tuple[Any, float]:
    """What asks for the least torque, and that torque [N m]: gains that keep a limit are only the most accurate ones.

    asking_for: what is found for a limit, and its peak torque; highest: the largest that gains accuracy; tighter: how
    many limits are tried.
    """
    limit = HARDLY * highest
    found, peak = asking_for(limit)
    return (found, peak) if peak > limit or tighter == 1 else least_torque(asking_for, limit, tighter - 1)


def check(scenario: Scenario) -> None:
    """Raise ScenarioError where there is no front of accuracy against torque to look for."""
    of, weight = "for a front of the window error", scenario.search.torque_weight
    check_search(scenario, of, ", whose points keep their limits in the trials drawn")
    if weight:
        raise wrong("tune.torque_weight", weight, f"absent {of} against the torque")


def check_search(scenario: Scenario, against: str, why: str = "") -> None:
    """Raise ScenarioError where a search minimises no error, or moves the trials; against: what that is in the way of.

    why: what speaks against moving them.
    """
    if scenario.search.minimise != "window_error":
        raise wrong("tune.minimise", scenario.search.minimise, f'"window_error" {against}')
    if scenario.search.worst_case:
        raise wrong("tune.worst_case", True, f"false {against}{why}")


def _limited(scenario: Scenario) -> tuple[Scenario, float | None]:
    """The scenario with a requirement on the peak torque, and its own limit, if there is one."""
    own_limit = tables.limit_of(scenario, TORQUE)
    if own_limit is not None:
        return scenario, own_limit
    return changed(scenario, requirements={**parsing.dump(scenario).get("requirements", {}), TORQUE: OFF}), None


def uninterrupted(outcome: Search) -> Search:
    """The outcome of a search; raises KeyboardInterrupt where that was interrupted."""
    if outcome.interrupted:
        raise KeyboardInterrupt
    return outcome


def climbed(
    ladder: Sequence[tuple[str, Problem]], known: list[np.ndarray], posed: posing.Posed, tell: Report
) -> dict[int, Best]:
    """What is found on each rung, down the ladder and up again, each from what is known by then.

    ladder: what each rung is called, and its problem. known: shares of gains, (gains,) each. A rung on which no gains
    keep the limits is left out.
    """
    best: dict[int, Best] = {}
    rungs = [*range(len(ladder) - 1, -1, -1), *range(len(ladder))]
    for done, k in enumerate(rungs):
        name, problem = ladder[k]
        tell(f"ladder, {name}", done, len(rungs), np.nan, 0.0)
        step = _step(posed, problem, np.unique(np.asarray(known), axis=0))
        if step is not None and (k not in best or step.f < best[k].f):
            best[k] = step
            known.append(step.share)
    return best


def apart(best: dict[int, Best]) -> dict[int, Best]:
    """One rung of those that a limit does not hold back, and whose gains are the same."""
    kept: dict[int, Best] = {}
    for k in sorted(best):
        if all(np.abs(best[k].share - other.share).max() >= APART for other in kept.values()):
            kept[k] = best[k]
    return kept


def _step(posed: posing.Posed, problem: Problem, known: np.ndarray) -> Best | None:
    """The best gains that keep these limits: known ones, or what is found from the most promising of them."""
    run = Descents(posed.evaluate, MARGIN, STEPS, np.random.default_rng(0))
    flown = posed.evaluate.fly(run.tightened(problem), known)
    chosen = known[np.lexsort((flown.f, np.maximum(flown.beyond - NEARLY, 0.0)))[:WARM]]
    best = Best(known[0], len(problem.rows), MARGIN)
    best.offer(known, flown)
    if posed.sloped:
        run.descend(problem, dict(enumerate(chosen)))
    else:
        run.evolve(problem, chosen[0], NEARBY)
    best = min(best, run.best, key=lambda one: one.rank) if run.started else best
    return best if best.over == 0.0 else None


def _judge(
    scenario: Scenario, posed: posing.Posed, by_limit: dict[float, Best], fresh_seed: int, tell: Report
) -> dict[float, tuple[Point, Trials]]:
    judged = {}
    for k, (limit, best) in enumerate(by_limit.items()):
        tell("judging on fresh trials", k, len(by_limit), np.nan, 0.0)
        named = posed.named(best.share)
        tuned = gains.in_scenario(scenario, named)
        trials = judging.judge(tuned, fresh_seed)
        judged[limit] = _point(limit, named, best.value, trials, tuned, fresh_seed), trials
    return judged


def _point(
    limit: float, named: dict[str, float], trained: float, trials: Trials, scenario: Scenario, fresh_seed: int
) -> Point:
    peaks = np.asarray(trials.metrics.peak_torque)[trials.finished]
    return Point(
        limit=limit,
        gains=dict(named),
        trained=trained,
        peak=judging.largest(TORQUE, scenario, trials),
        mean_peak=float(np.mean(peaks)) if peaks.size else np.nan,
        **judging.figures(scenario, trials, fresh_seed),
    )


def _marked(judged: dict[float, tuple[Point, Trials]]) -> list[Point]:
    """The points in order of peak torque, dominated ones and the knee marked."""
    pairs = sorted(judged.values(), key=lambda pair: pair[0].peak)
    points = [
        replace(point, dominated=any(_beats(other, (point, trials)) for other in pairs)) for point, trials in pairs
    ]
    # with logarithms, so without zeros, and without gains with which no trial ends
    front = [k for k, p in enumerate(points) if not p.dominated and p.peak > 0.0 and p.rms > 0.0]
    if len(front) > 2:
        knee = front[knee_of(np.asarray([[points[k].peak, points[k].rms] for k in front]))]
        points[knee] = replace(points[knee], knee=True)
    return points


def _beats(one: tuple[Point, Trials], other: tuple[Point, Trials]) -> bool:
    """Whether a point asks for no more torque than another and is more accurate, beyond the interval of the ratio.

    A point with more failed trials does not. One trial, where nothing is drawn, has no interval.
    """
    (a, trials), (b, others) = one, other
    if a is b or a.failures > b.failures or not (a.peak <= b.peak and a.rms < b.rms):
        return False
    both = trials.finished & others.finished
    errors, error_of_others = (np.asarray(flown.metrics.window_error)[both] for flown in (trials, others))
    interval = trust.ratio_interval(error_of_others, errors)
    return trials.status.size == 1 if interval is None else interval[0] > 1.0


def knee_of(points: np.ndarray) -> int:
    """Which of the points (count, 2), in order along a front, lies farthest below the line between its ends, in log."""
    off = np.log(points) - np.log(points[0])
    along = off[-1]  # scaling an axis changes all distances by one factor
    return int(np.argmax(off[:, 0] * along[1] - off[:, 1] * along[0]))


def identity(scenario: Scenario, seed: int, points: int) -> dict[str, Any]:
    """What `versions.json` knows a finished or interrupted front by."""
    return {"command": "pareto", "seed": seed, "points": points, **own.digests(scenario)}


def summary(front: Front, scenario: Scenario) -> dict[str, Any]:
    """What `summary.json` says."""
    return {
        "status": front.status,
        "plant": scenario.plant.kind,
        "requirements": list(scenario.requirements),
        "trials": front.trials,
        "seed": front.fresh_seed,
        "interval_confidence": trust.CONFIDENCE,
        "floor": front.floor,
        "rollouts": front.rollouts,
        "gradients": front.gradients,
        "points": [asdict(point) for point in front.points],
        "steps": front.steps,
        **{name: asdict(point) for name, point in front.others.items()},
        "paper_refused": front.paper_refused,
        "paper_is": gains.paper_is(scenario),
        "gain_units": gains.units_of(scenario),
        "cautions": cautions.of(scenario),
    }


def write(folder: Path, scenario: Scenario, front: Front, figures: bool, known_by: dict[str, Any]) -> None:
    """Fill a result folder."""
    store.record(folder, parsing.dump(scenario), known_by, summary(front, scenario))
    names = gains.named(scenario)
    header = ["limit", *names, "rms_window_error", "rms_low", "rms_high", "peak_torque", "mean_peak_torque",
              "failures", "meets", "dominated", "knee", "trained_goal"]  # fmt: skip
    rows = [
        [p.limit, *(p.gains[name] for name in names), p.rms, *(p.interval or ("", "")), p.peak, p.mean_peak, p.failures,
         int(p.meets), int(p.dominated), int(p.knee), p.trained]
        for p in front.points
    ]  # fmt: skip
    store.write_csv(folder / "front.csv", header, rows)
    if figures:
        limit = tables.limit_of(scenario, TORQUE)
        units = tuple(catalogues.CATALOGUES[scenario.plant.kind][name].unit for name in ("window_error", TORQUE))
        others = {gains.paper_is(scenario) if name == "paper" else name: one for name, one in front.others.items()}
        figure = study_plots.front(front.points, others, limit, units, floor=front.floor)
        style.save({"front": figure}, folder / "figures")
