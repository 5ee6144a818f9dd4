"""Gradient search from a few starts, each to the optimum next to it; the best admissible point is kept.

A small sweep chooses the starts, and sequential quadratic programming on the slopes of what flies (SciPy's SLSQP) goes
on from each of them. Gains flown with the exact sign have no slopes: they are looked for by evolution instead.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import jax.numpy as jnp
import numpy as np

from ptsmc_jax.clock import Anchored
from ptsmc_jax.requirements import Requirement
from tuning import confirm
from tuning import worst as worst_case
from tuning.bounds import TIMES
from tuning.descent import BOLD, BROKEN, CAREFUL, CLOSE, Best, descend, largest
from tuning.evaluate import Evaluator, Measured
from tuning.objective import FAILED, Problem, coordinates_of, failures, whole_rows, with_trials
from tuning.refine import GENERATIONS, NEARBY, WIDELY, refine
from tuning.starts import APART, CHOOSING, STEEP, SWEPT, Report, charged, promising, spread, starting_points
from tuning.work import ROUND, SLOPED, Work
from tuning.worst import Hardest

MARGIN = 0.03  # kept from a limit in the search: fresh trials hold some that are harder than any screened one
SURE_MARGIN = 0.003  # where there is no harder one: the worst case is searched for, or nothing is drawn
HARDEST = 8  # of the screened trials, that join the constraints
SPARE = 8  # places for those that later rounds add: a trial more would be another program to compile
ROUNDS = 6  # searches again with hardest trials added, at most
AGAIN = 3  # starts, from whose best points they go on
# many starts, each with one in `SHORT` of the steps, then one in `FOLLOWED` of them with all: few lead to the optimum
MORE, SHORT, FOLLOWED = 2, 4, 4
FINISH = 1e-2  # of `CLOSE`: how near to the optimum the best start is taken in the end
MANY = 512  # points swept where there are no slopes

SEARCHING, FOLLOWING, FINISHING, EVOLVING = "searching", "following the best", "finishing", "evolving"


@dataclass(frozen=True)
class Step:
    """A point that the search went through; kept as the history."""

    start: int
    gains: np.ndarray  # (gains,)
    value: float  # the goal over the training trials
    worst: np.ndarray  # (requirements,) largest metric / limit, `FAILED` where a trial fails


@dataclass(frozen=True)
class Search:
    """Outcome of a search."""

    gains: np.ndarray  # (gains,) the best admissible point
    share: np.ndarray  # its shares of the bounds' intervals
    value: float  # its goal over the training trials
    worst: np.ndarray  # (requirements,) its largest metric / limit, infinite where a trial fails
    ended: np.ndarray  # (requirements,) the same over the trials that end
    history: list[Step]  # in the order of the starts, and of each start's steps
    problem: Problem  # with the hardest trials
    rounds: int = 0  # searches again with harder trials
    margin: float = MARGIN  # that was kept from the limits
    hardest: Hardest | None = None  # for the gains found; None: no requirement hangs on the hardest trial
    counts: list[confirm.Count] = field(default_factory=list)  # of requirements on a share, on other trials
    seconds: dict[str, float] = field(default_factory=dict)  # that each step of the search took
    interrupted: bool = False


@dataclass(frozen=True)
class Joining:
    """Trials that join the constraints."""

    trials: np.ndarray  # that name the noise
    counted: np.ndarray  # (requirements,) bool: the limits that they must keep
    coordinates: dict[str, list[float]] | None = None  # of a single one, where they are not its own


def search(
    evaluate: Evaluator,
    problem: Problem,
    requirements: Sequence[Requirement],
    own: np.ndarray,
    starts: int,
    steps: int,
    seed: int,
    *,
    sloped: bool = True,
    robust: bool = False,
    judged: bool = True,
    report: Report = lambda *told: None,
) -> Search:
    """Minimise F with every requirement met on the training trials.

    A limit on every trial hangs on the few hardest ones, which a training set need not hold: the hardest of many
    screened ones join the constraints first, and again after a search whose gains some of them still break; robust:
    not those drawn, but the worst case inside the dispersions' support. A limit on a share of the trials is confirmed
    on others after each search: where more of them break it than may, the hardest of the rest join. own:
    (gains,) the scenario's gains, the first start. steps: points that may be looked at from each start. sloped: F has
    slopes to go by. judged: say how hard the worst case is. report is called after every step. Interrupted, it returns
    the best so far once there is one.
    """
    sure = [r for r in requirements if r.quantile is None] if problem.dispersion.varies else []
    shares = [r for r in requirements if r.quantile is not None] if problem.trials.size > 1 else []
    margin = SURE_MARGIN if (robust and sure) or problem.trials.size == 1 else MARGIN
    if sure or shares:
        problem = _with_room(problem, HARDEST + SPARE if sure else SPARE)
    report = Work(report, evaluate, *_planned(problem, starts, steps, sloped=sloped))
    run = Run(evaluate, margin, steps, np.random.default_rng(seed), report)
    interrupted, hardest, counts, known = False, None, list[confirm.Count](), None

    def counted(requirement: Requirement) -> np.ndarray:
        return np.asarray([metric == requirement.metric for metric in problem.metrics])

    def screened(gains: np.ndarray) -> worst_case.Screened:
        evaluate.rollouts += worst_case.SCREENED
        return worst_case.screen(problem, sure, gains)

    try:
        if sloped:
            first = starting_points(
                evaluate, run.tightened(problem), own, MORE * starts if starts > 1 else 1, seed, report
            )
        else:
            first = run.swept(problem, own)
        joined = 0
        if sure:  # what is hardest for the most promising gains
            likely = np.asarray(evaluate.bounds.gains(jnp.asarray(first[min(1, len(first) - 1)])))
            harder = _hardest(problem, *screened(likely))
            problem, joined = _add(problem, joined, Joining(harder, whole_rows(problem))), harder.size
        if sloped:
            run.descend(problem, first)
        else:
            run.evolve(problem, first[0])
        rounds = 0
        while sure or shares:
            found, joining = run.gains, list[Joining]()
            if shares:  # each time on other trials, which those screened are not among
                report("confirming on other trials", 0, 0, *run.best_so_far)
                counts = confirm.count(problem, shares, found, problem.averaged + worst_case.SCREENED, rounds)
                evaluate.rollouts += counts[0].trials
                joining += [
                    Joining(one.harder[:HARDEST], counted(requirement))
                    for requirement, one in zip(shares, counts, strict=True)
                    if not one.held
                ]
            if sure and robust:
                report("looking for the worst case", 0, 0, *run.best_so_far)
                hardest = worst_case.hardest(problem, sure, found, screened(found))
                if hardest.beyond and not hardest.unbounded:
                    joining.append(Joining(np.asarray([hardest.trial]), whole_rows(problem), hardest.coordinates))
            elif sure:
                known = screened(found)
                if np.any(known[1] > 1.0):
                    joining.append(Joining(_hardest(problem, *known), whole_rows(problem)))
            if not joining or rounds == ROUNDS:
                break
            for more in joining:
                problem, joined = _add(problem, joined, more), joined + more.trials.size
            hardest = None  # it was the worst case of gains that are searched on from
            rounds += 1
            report(f"{ROUND}, round {rounds}", 0, 0, *run.best_so_far)
            if sloped:
                run.again(problem)
            else:
                run.evolve(problem, run.share, NEARBY)
            run.rounds = rounds
        if sure and judged and hardest is None:
            report("looking for the worst case", 0, 0, *run.best_so_far)
            hardest = worst_case.hardest(problem, sure, run.gains, known)
    except KeyboardInterrupt:
        if not run.started:
            raise
        interrupted = True
    report("done", 0, 0, *run.best_so_far)
    counts = [] if interrupted else counts
    return replace(run.outcome(), hardest=hardest, counts=counts, seconds=report.seconds, interrupted=interrupted)


def _planned(problem: Problem, starts: int, steps: int, *, sloped: bool) -> tuple[dict, dict]:
    """What each step of a search flies at most, in rollouts, and each of a further round; see `Work`."""
    trials = float(problem.trials.size)
    if not sloped:
        evolving = {EVOLVING: GENERATIONS * WIDELY[0] * trials}
        return {CHOOSING: MANY * trials, **evolving}, {ROUND: 0.0, **evolving}
    one = SLOPED * steps * trials
    return (
        {
            CHOOSING: SWEPT * trials if starts > 1 else 0.0,
            SEARCHING: MORE * starts * one / SHORT,
            FOLLOWING: max(1.0, MORE * starts / FOLLOWED) * one,
            FINISHING: one,
        },
        {ROUND: AGAIN * one, FINISHING: one},
    )


def _with_room(problem: Problem, places: int) -> Problem:
    """With so many places more, that hold the first trial again: it must keep what every trial must keep, twice."""
    return with_trials(problem, np.repeat(np.asarray(problem.trials)[:1], places))


def _add(problem: Problem, joined: int, more: Joining) -> Problem:
    """The problem with more trials in the places left for them, and then in those of the ones that joined first.

    joined: how many have been added to `_with_room`'s.
    """
    places = problem.trials.size - problem.averaged
    at = problem.averaged + (joined + np.arange(more.trials.size)) % places
    if more.coordinates is None:
        own = coordinates_of(problem.dispersion, int(problem.seed), more.trials)
    else:
        own = {name: jnp.asarray(v)[None] for name, v in more.coordinates.items()}
    return replace(
        problem,
        trials=problem.trials.at[at].set(jnp.asarray(more.trials, dtype=jnp.uint32)),
        counted=problem.counted.at[:, at].set(jnp.asarray(more.counted)[:, None]),
        coordinates={name: v.at[at].set(own[name]) for name, v in problem.coordinates.items()},
    )


def _hardest(problem: Problem, trials: np.ndarray, ratio: np.ndarray) -> np.ndarray:
    """Of screened trials those nearest to a limit that are not in the problem yet."""
    known = set(np.asarray(problem.trials).tolist())
    return np.asarray([t for t in trials[np.argsort(-ratio)] if int(t) not in known][:HARDEST], dtype=np.uint32)


class Run:
    """Descents from many starts and what they leave: the best point, the history."""

    def __init__(self, evaluate: Evaluator, margin: float, steps: int, rng: np.random.Generator, report: Report):
        self._evaluate, self._margin, self._steps, self._rng, self._report = evaluate, margin, steps, rng, report
        self._best: Best | None = None
        self._problem: Problem | None = None
        self._history: dict[int, list[Step]] = {}  # by the start
        self._ends: dict[int, Best] = {}  # the best point of each start
        self._from = 0  # the start that the best point comes from
        self.rounds = 0

    @property
    def started(self) -> bool:
        """Whether there is a point at all."""
        return self._best is not None and bool(np.isfinite(self._best.f))

    @property
    def best_so_far(self) -> tuple[float, float]:
        """The goal of the best point, and how far it is beyond a limit."""
        return (np.nan, np.nan) if self._best is None else (self._best.value, self._best.over)

    @property
    def best_point(self) -> tuple[float, float, np.ndarray]:
        """F, goal and shares of the best point."""
        assert self._best is not None
        return self._best.f, self._best.value, self._best.share

    @property
    def share(self) -> np.ndarray:
        """(gains,) shares of the best point."""
        return self.best_point[2]

    @property
    def gains(self) -> np.ndarray:
        """(gains,) of the best point."""
        return np.asarray(self._evaluate.bounds.gains(jnp.asarray(self.share)))

    def descend(self, problem: Problem, starts: np.ndarray) -> None:
        """From each of these starts, (starts, gains), a few steps, and from the most promising ends all of the way."""
        few, followed = max(2, self._steps // SHORT), max(1, len(starts) // FOLLOWED)
        for k, start in enumerate(starts):
            self._report(SEARCHING, k, len(starts), *self.best_so_far)
            self._descend(problem, start, k, few, scale=BOLD if k % 2 else CAREFUL)
        for rank, k in enumerate(self._best_of_each_valley(followed)):
            self._report(FOLLOWING, rank, followed, *self.best_so_far)
            self._descend(problem, self._ends[k].share, k, self._steps, scale=CAREFUL)
        self._finish(problem)

    def _best_of_each_valley(self, count: int) -> list[int]:
        """So many starts, by what they found; of those that ended beside each other one first."""
        ends = self._ends
        order = sorted(ends, key=lambda k: charged(ends[k].f, ends[k].over, STEEP))
        chosen: list[int] = []
        for distance in (APART, 0.0):
            for k in order:
                apart = all(np.abs(ends[k].share - ends[other].share).max() >= distance for other in chosen)
                if len(chosen) < count and k not in chosen and apart:
                    chosen.append(k)
        return chosen

    def again(self, problem: Problem) -> None:
        """On from where the best starts ended, with what has joined the problem."""
        ranked = sorted(self._ends.items(), key=lambda item: item[1].rank)
        afresh = True
        for start, end in ranked[:AGAIN]:
            self._descend(problem, end.share, start, self._steps, scale=CAREFUL, afresh=afresh)
            afresh = False
        self._finish(problem)

    def swept(self, problem: Problem, own: np.ndarray) -> np.ndarray:
        """(1, gains) the best of the scenario's gains and of points spread widely, where there are no slopes."""
        share = np.concatenate([self._evaluate.bounds.share(own)[None], spread(len(problem.names), MANY, self._rng)])

        return promising(self._evaluate, self.tightened(problem), share, 1, partial(self._report, CHOOSING))

    def evolve(self, problem: Problem, share: np.ndarray, size: tuple[int, float] = WIDELY) -> None:
        """Better points around these shares, without slopes."""
        best, tightened = Best(share, len(problem.metrics), self._margin), self.tightened(problem)
        best.offer(share[None], self._evaluate.fly(tightened, share[None]))
        try:
            refine(self._evaluate, tightened, best, share, int(self._rng.integers(2**31)),
                   lambda done, steps: self._report(EVOLVING, done, steps, best.value, best.over),
                   partial(self._keep, 0), size)  # fmt: skip
        finally:  # interrupted too
            self._take(best, tightened, 0, afresh=True)

    def _finish(self, problem: Problem) -> None:
        self._report(FINISHING, 0, 1, *self.best_so_far)
        self._descend(problem, self.share, self._from, self._steps, scale=CAREFUL, close=FINISH * CLOSE)
        on_samples = self._with_the_hand_over_on_a_sample(problem)
        afresh = True
        for share in on_samples:
            times = [k for k, name in enumerate(problem.names) if name in TIMES]
            self._descend(problem, share, self._from, self._steps, scale=CAREFUL, fixed=times, afresh=afresh)
            afresh = False

    def _with_the_hand_over_on_a_sample(self, problem: Problem) -> list[np.ndarray]:
        """The best gains with the nearest hand-overs that are flown as they are trained; none where all are.

        A flight computer hands over at its first sample not before t_f - delta, which the anchored clock has at it.
        """
        clock, bounds = problem.parts.clock, self._evaluate.bounds
        if "delta" not in problem.names or not isinstance(clock, Anchored):
            return []
        named, at = dict(zip(problem.names, self.gains, strict=True)), problem.names.index("delta")
        t_f, period = float(named.get("t_f", problem.parts.controller.t_f)), float(clock.period)
        samples = (t_f - named["delta"]) / period
        found = []
        for sample in sorted({math.floor(samples + 1e-9), math.ceil(samples - 1e-9)}):
            if bounds.lower[at] * (1 - 1e-9) <= t_f - sample * period <= bounds.upper[at]:
                gains = self.gains.copy()
                gains[at] = t_f - sample * period
                share = self.share.copy()
                share[at] = bounds.share(gains)[at]
                found.append(share)
        return found

    def _descend(
        self,
        problem: Problem,
        share: np.ndarray,
        start: int,
        steps: int,
        *,
        scale: float,
        close: float = CLOSE,
        fixed: Sequence[int] = (),
        afresh: bool = False,
    ) -> None:
        best, tightened = Best(share, len(problem.metrics), self._margin), self.tightened(problem)
        keep = partial(self._keep, start)
        try:
            descend(self._evaluate, tightened, best, share, steps, keep, close=close, scale=scale, fixed=fixed)
        finally:  # interrupted too
            self._take(best, tightened, start, afresh=afresh)

    def _take(self, best: Best, tightened: Problem, start: int, *, afresh: bool) -> None:
        """What was found, if it is better; afresh: than nothing, of another problem than the best so far."""
        if np.isfinite(best.f):
            self._ends[start] = best
        if self._best is None or (np.isfinite(best.f) and (afresh or best.rank < self._best.rank)):
            self._best, self._problem, self._from = best, tightened, start

    def _keep(self, start: int, seen: Measured) -> None:
        worst = np.where(failures(seen.c)[0] > 0, FAILED, largest(seen.c, self._margin)[0])
        step = Step(start, seen.gains[0], float(np.exp(seen.value[0])), worst)
        self._history.setdefault(start, []).append(step)

    def tightened(self, problem: Problem) -> Problem:
        """With the margin kept from the limits."""
        return replace(problem, limits=problem.limits * (1.0 - self._margin))

    def outcome(self) -> Search:
        """The best point."""
        assert self._best is not None
        assert self._problem is not None
        best = self._best
        return Search(
            gains=self.gains,
            share=best.share,
            value=best.value,
            worst=np.where(best.over >= BROKEN, np.inf, best.worst),
            ended=best.worst,
            history=[step for _, steps in sorted(self._history.items()) for step in steps],
            problem=replace(self._problem, limits=self._problem.limits / (1.0 - self._margin)),
            rounds=self.rounds,
            margin=self._margin,
        )
