"""Descents from many starts, from few of them all the way: the best point, and the points gone through.

Sequential quadratic programming on the slopes of what flies, see `descend`; where there are none, evolution.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import ArrayLike

from ptsmc_jax import configure
from tuning.search import hand_overs
from tuning.search.descent import BOLD, CAREFUL, CLOSE, SLACK, Best, Relaxed, Start, descend, largest, prices
from tuning.search.evaluate import Evaluator, Measured, Sloped
from tuning.search.evolution import GENERATIONS, WIDELY, evolve
from tuning.search.lockstep import Ask, in_step
from tuning.search.objective import LIMITS, Problem, ended, failures, fewer_trials
from tuning.search.progress import Report
from tuning.search.shares import TIMES
from tuning.search.starts import (
    CHOOSING,
    NEARLY,
    STEEP,
    SWEPT,
    charged,
    promising,
    spread,
    spread_widely,
    starting_points,
)
from tuning.search.work import ROUND, SLOPED

AGAIN = 3  # starts from whose best points a further round goes on
EXPLORED, AVERAGED = 32, 16  # trials on which most starts are given up; at least so many count in the objective
TOGETHER = 2  # descents of each device that go in step: it waits for one call where they think, not for two
FOLLOWED = 3  # of the explored starts go on with all trials
SAME = 1e-4  # points whose F differs by less are equally good: 0.01 % of the error
FINISH = 1e-2  # share of `CLOSE` at which the last descent, from the best point, ends
CONFLICTING = 0.1  # limits whose excess is within this fraction of the largest excess count as conflicting
LOOKS = 3  # at other hand-overs, at most
MANY = 512  # points swept where there are no slopes

SETTING_OUT, SEARCHING, FOLLOWING, FINISHING, EVOLVING = (
    "setting out", "searching", "following the best", "finishing", "evolving",
)  # fmt: skip


@dataclass(frozen=True)
class Step:
    """A point that the search went through; kept as the history."""

    start: int
    gains: np.ndarray  # (gains,)
    value: float  # the goal over the training trials, NaN where none has one
    worst: np.ndarray  # (requirements,) largest metric / limit, infinite where a trial fails


@dataclass(frozen=True)
class _Racer:
    """A start in a race, and the history that led to it."""

    start: Start
    before: list[Step]


def planned(problem: Problem, starts: int, steps: int, *, sloped: bool) -> tuple[dict, dict]:
    """What each step of a search flies at most, in rollouts, and each of a further round; see `Work`."""
    trials = float(problem.trials.size)
    if not sloped:
        evolving = {EVOLVING: GENERATIONS * WIDELY[0] * trials}
        return {CHOOSING: MANY * trials, **evolving}, {ROUND: 0.0, **evolving}
    one, few = SLOPED * steps, _few_trials(problem).trials.size
    finishing = (hand_overs.LOOKED + one) * trials
    exploring = {SETTING_OUT: one * few, CHOOSING: max(SWEPT, starts) * few, SEARCHING: starts * one * 3 / 8 * few}
    return (
        {
            **(exploring if starts > 1 else {}),
            FOLLOWING: (min(starts, FOLLOWED) + 1) / 2 * one * trials,
            FINISHING: finishing,
        },
        {ROUND: AGAIN * one * trials, FINISHING: finishing},
    )


def _few_trials(problem: Problem) -> Problem:
    """The problem with few trials."""
    return fewer_trials(problem, max(AVERAGED, EXPLORED - (problem.trials.size - problem.averaged)))


class Descents:
    """Descents from many starts and what they leave: the best point, the history."""

    def __init__(
        self,
        evaluate: Evaluator,
        margin: ArrayLike,
        steps: int,
        rng: np.random.Generator,
        report: Report = lambda *_: None,
    ):
        self._evaluate, self._steps, self._rng, self._report = evaluate, steps, rng, report
        self._margin = np.asarray(margin)  # share kept from each limit, (rows,) or one number
        self._own: np.ndarray | None = None  # (gains,) to come back to where one makes no difference
        self.globally = False  # `search_globally` was called
        self._designs = np.zeros((0, 0))  # (designs, gains) shares
        self._best: Best | None = None
        self._problem: Problem | None = None
        self._history: dict[int, list[Step]] = {}  # by the start
        self._ends: dict[int, Best] = {}  # the best point of each start
        self._from = 0  # the start that the best point comes from

    @property
    def started(self) -> bool:
        """Whether there is a point at all."""
        return self._best is not None and bool(np.isfinite(self._best.f))

    @property
    def so_far(self) -> tuple[float, float]:
        """The goal of the best point, and how far it is beyond a limit."""
        return (np.nan, np.nan) if self._best is None else self._best.so_far

    @property
    def best(self) -> Best:
        """The best point so far."""
        assert self._best is not None
        return self._best

    @property
    def problem(self) -> Problem:
        """What it is the best point of, with its own limits."""
        assert self._problem is not None
        return self._problem.tightened(1.0 / (1.0 - self._margin))

    @property
    def share(self) -> np.ndarray:
        """(gains,) shares of the best point."""
        return self.best.share

    @property
    def gains(self) -> np.ndarray:
        """(gains,) of the best point."""
        return self._evaluate.bounds.gains(self.share)

    @property
    def ends(self) -> list[np.ndarray]:
        """Shares, (gains,) each, where the starts ended that were followed to the end, the best first."""
        return [end.share for _, end in _ranked(self._ends)]

    @property
    def history(self) -> list[Step]:
        """The points gone through, in the order of the starts and of each start's steps."""
        return [step for _, steps in sorted(self._history.items()) for step in steps]

    def set_out(self, problem: Problem, own: np.ndarray, designs: np.ndarray) -> None:
        """Search locally on a few trials, from the best of the scenario's gains, (gains,), and of the designs.

        designs: (designs, gains).
        """
        few = _few_trials(problem)
        self._own, self._designs = own, np.asarray([self._evaluate.bounds.share(one) for one in designs])
        self._report(SETTING_OUT, 0, 2, *self.so_far)
        points = np.concatenate([self._evaluate.bounds.share(own)[None], self._designs.reshape(-1, own.size)])
        first = points[0]
        if len(points) > 1:
            (first,) = promising(self._evaluate, self.tightened(few), points, 1, lambda *_: None)
        self._descend(few, 0, Start(first, CAREFUL), max(2, self._steps // 2))

    def explore(self, problem: Problem, starts: int, seed: int) -> dict[int, np.ndarray]:
        """The shares where the most promising of so many starts end, after a few steps from each on a few trials.

        The first goes on from where it set out to, with what has joined the problem; the others are chosen from there.
        """
        problem, more = _few_trials(problem), max(2, self._steps // 2)
        self._report(SETTING_OUT, 1, 2, *self.so_far)
        self._descend(problem, 0, Start(self.share, CAREFUL), more, afresh=True)
        first = starting_points(
            self._evaluate, self.tightened(problem), self.share, self._designs, starts, seed, self._report
        )
        return self._promising(problem, first)

    def _promising(self, problem: Problem, first: np.ndarray, number: int = 0) -> dict[int, np.ndarray]:
        """Return the end points of the best short local searches, by the index of their starting point.

        first: (starts, gains) shares; number: index of the first one.
        """
        few, more = max(2, self._steps // 4), max(2, self._steps // 2)
        racing = dict(enumerate(first, number))
        rungs = ((len(racing), few), (max(FOLLOWED, len(racing) // 2), more))
        ranked = self._race(problem, racing, rungs, SEARCHING, scales=(CAREFUL, BOLD))
        return {k: self._ends[k].share for k in ranked[:FOLLOWED]} or {number: first[0]}

    def descend(self, problem: Problem, starts: Mapping[int, np.ndarray]) -> None:
        """Descend part of the way from each of these shares, and from the best end to the optimum next to it."""
        half, self._ends = max(2, self._steps // 2), {}
        self._race(problem, starts, ((len(starts), half), (1, self._steps)), FOLLOWING, afresh=True)
        self._finish(problem)

    def _race(
        self,
        problem: Problem,
        starts: Mapping[int, np.ndarray],
        rungs: Sequence[tuple[int, int]],
        what: str,
        *,
        scales: Sequence[float] = (CAREFUL,),
        afresh: bool = False,
    ) -> list[int]:
        """The starts by where they end, the best first; on each rung so many of them go so many steps in all.

        scales: of the descents, by turns.
        """
        racers = {
            k: _Racer(Start(share, scales[k % len(scales)]), list(self._history.get(k, ())))
            for k, share in starts.items()
        }
        ranked = list(starts)
        for count, steps in rungs:
            self._descend_in_lockstep(problem, {k: racers[k] for k in ranked[:count]}, steps, what, afresh=afresh)
            afresh = False
            ends = {k: self._ends[k] for k in ranked if k in self._ends}
            ranked = sorted(ends, key=lambda k, ends=ends: (ends[k].lost, charged(ends[k].f, ends[k].over, STEEP)))
        return ranked

    def _descend_in_lockstep(
        self,
        problem: Problem,
        racers: Mapping[int, _Racer],
        steps: int,
        what: str,
        *,
        afresh: bool,
    ) -> None:
        """Descend from each of these starts, `TOGETHER` at a time of each device."""
        tightened, bests, reports = self.tightened(problem), dict[int, Best](), 0

        def race(k: int, ask: Ask) -> None:
            bests[k] = Best(racers[k].start.share, len(problem.rows), self._margin)
            self._history[k] = list(racers[k].before)  # it goes through the same points again, and on
            descend(ask, bests[k], racers[k].start, steps, partial(self._keep, k), relaxed=_relaxed(problem))

        def tell() -> None:
            nonlocal reports
            begun = [*bests.values()] if afresh or self._best is None else [self._best, *bests.values()]
            best = min(begun, key=lambda best: best.rank)
            while reports < len(bests):  # once for each that has begun
                self._report(what, reports, len(racers), *best.so_far)
                reports += 1

        def fly(points: list[np.ndarray]) -> list[Sloped]:
            tell()
            measured = self._evaluate.slopes(tightened, np.concatenate(points))
            return [measured.at(k) for k in range(len(points))]

        try:
            in_step([partial(race, k) for k in racers], fly, TOGETHER * len(configure.devices()))
            tell()
        finally:  # interrupted too
            for k in racers:
                if k in bests:
                    self._take(bests[k], tightened, k, afresh=afresh)
                    afresh = False

    def again(self, problem: Problem) -> None:
        """Go on from where the best starts ended, with what has joined the problem."""
        self._instead(problem, [(start, end.share) for start, end in _ranked(self._ends)[:AGAIN]])
        self._finish(problem)

    def search_globally(self, problem: Problem, starts: int, seed: int) -> None:
        """Search from the best of many points of the whole box, and keep the earlier result if it is better."""
        self.globally = True
        found = self.best, self._problem, self._from, self._ends
        try:
            few = _few_trials(problem)
            first = spread_widely(self._evaluate, self.tightened(few), starts, seed, self._report)
            self.descend(problem, self._promising(few, first, 1 + max(self._history, default=-1)))
        finally:  # interrupted too
            if found[0].rank <= self.best.rank:
                self._best, self._problem, self._from, self._ends = found

    def _instead(self, problem: Problem, ends: Sequence[tuple[int, np.ndarray]]) -> None:
        """Descend from each of these (start, shares); the best point found takes the place of the best so far."""
        for k, (start, share) in enumerate(ends):
            self._descend(problem, start, Start(share, CAREFUL), self._steps, afresh=k == 0)

    def sweep(self, problem: Problem, own: np.ndarray) -> None:
        """The best of the scenario's gains and of points spread widely, where there are no slopes."""
        tightened = self.tightened(problem)
        share = np.concatenate([self._evaluate.bounds.share(own)[None], spread(len(problem.names), MANY, self._rng)])
        share = promising(self._evaluate, tightened, share, 1, partial(self._report, CHOOSING))
        best, flown = self._best_of(tightened, share)
        self._keep(0, flown)  # interrupted before evolution has a generation, it is all that there is to tell
        self._take(best, tightened, 0, afresh=True)

    def _best_of(self, tightened: Problem, share: np.ndarray) -> tuple[Best, Measured]:
        """The best of these points, (points, gains), flown without slopes, and what was measured at each of them."""
        best, flown = Best(share[0], len(tightened.rows), self._margin), self._evaluate.fly(tightened, share)
        best.offer(share, flown)
        return best, flown

    def evolve(self, problem: Problem, share: np.ndarray, size: tuple[int, float] = WIDELY) -> None:
        """Look for better points around these shares, without slopes."""
        tightened = self.tightened(problem)
        best, _ = self._best_of(tightened, share[None])
        try:
            evolve(self._evaluate, tightened, best, share, int(self._rng.integers(2**31)),
                   lambda done, steps: self._report(EVOLVING, done, steps, *best.so_far),
                   partial(self._keep, 0), size)  # fmt: skip
        finally:  # interrupted too
            self._take(best, tightened, 0, afresh=True)
        on_samples = np.asarray(hand_overs.on_samples(problem, self._evaluate.bounds, self.share))
        if on_samples.size:
            best, _ = self._best_of(tightened, on_samples)
            self._take(best, tightened, 0, afresh=best.beyond <= self.best.beyond)

    def conflict(self, problem: Problem) -> dict[str, float | None]:
        """Return the limits that the best compromise exceeds most, and the least ratio that each can reach alone.

        The ratio is metric over limit, with every other limit kept to 0.1 %. It is None if the others cannot be kept.
        """
        tightened, found = self.tightened(problem), dict[str, float | None]()
        worst = largest(self._evaluate.slopes(tightened, self.share[None]).c, 0.0)[0]
        for row in np.flatnonzero(worst >= 1.0 + (worst.max() - 1.0) * (1.0 - CONFLICTING)):
            others = np.arange(worst.size) != row
            seen: list[tuple[float, float]] = []

            def keep(one: Sloped, row: int = int(row), others: np.ndarray = others, seen: list = seen) -> None:
                each = largest(one.c, 0.0)[0]
                seen.append((float(each[others].max(initial=0.0)), float(each[row])))

            descend(
                partial(self._evaluate.slopes, tightened),
                Best(self.share, worst.size, self._margin),
                Start(self.share, CAREFUL),
                self._steps,
                keep,
                relaxed=Relaxed(rows=[int(row)], to_the_end=True),
            )
            kept = [own for rest, own in seen if rest <= 1.0 + 10.0 * SLACK]
            margin = float(np.broadcast_to(self._margin, worst.size)[row])
            found[problem.rows[row]] = (1.0 - margin) * min(kept) if kept else None
        return found

    def _finish(self, problem: Problem) -> None:
        self._report(FINISHING, 0, 1, *self.so_far)
        for _ in range(LOOKS):
            if not self._hand_over_elsewhere(problem):
                break
        self._descend(problem, self._from, Start(self.share, CAREFUL), self._steps, close=FINISH * CLOSE)
        self._hand_over_on_a_sample(problem)
        times = [k for k, name in enumerate(problem.names) if name in TIMES]
        others = [k for k in range(len(problem.names)) if k not in times]
        if self._own is not None and others:
            self._take_back(problem, self._own, others)

    def _take_back(self, problem: Problem, own: np.ndarray, indices: Sequence[int]) -> None:
        """The scenario's own value for as many of some gains as make no difference together."""
        tightened, current = self.tightened(problem), self.best

        def judged(changes: Sequence[Sequence[int]]) -> list[Best]:
            back = [np.isin(np.arange(own.size), change) for change in changes]
            share = np.clip([self._evaluate.bounds.replaced(current.share, own, which) for which in back], 0.0, 1.0)
            flown = self._evaluate.slopes(tightened, share)  # the program that is compiled already
            bests = [Best(one, len(problem.rows), self._margin) for one in share]
            for k, best in enumerate(bests):
                best.offer(share[k : k + 1], flown.at(k))
            return bests

        alone = dict(zip(indices, judged([[k] for k in indices]), strict=True))
        order = sorted((k for k in indices if self._as_good(alone[k])), key=lambda k: alone[k].f)
        if order:
            together = judged([order[: k + 1] for k in range(len(order))])
            self._best = next((best for best in reversed(together) if self._as_good(best)), current)

    def _as_good(self, best: Best) -> bool:
        return best.beyond <= self.best.beyond and best.f <= self.best.f + SAME

    def _hand_over_elsewhere(self, problem: Problem) -> bool:
        """Whether the best of other hand-overs leads to a better point, the other gains at first as they are.

        Noise moves along with the hand-over: by delta other noise falls into the window, and F of a few hundred trials
        has ripples of a per cent, in which descents end.
        """
        found, share = self.best, hand_overs.elsewhere(problem, self._evaluate.bounds, self.share)
        if found.over > 0.0 or not share:
            return False
        tightened = self.tightened(problem)
        flown = self._evaluate.fly(tightened, np.stack(share))
        price = prices(self._evaluate.slopes(tightened, found.share[None]), found.share)
        # a little beyond a limit: the other gains come back from there, at its price
        paid = flown.f + np.maximum(ended(flown.c).max(axis=2, initial=-1.0), 0.0) @ price
        known = np.isfinite(paid) & (failures(flown.c) == 0) & (flown.beyond <= NEARLY)
        paid = np.where(known, paid, np.inf)
        first = int(paid.argmin())
        if paid[first] < found.f - SAME:
            self._descend(problem, self._from, Start(share[first], CAREFUL), self._steps)
        return self.best is not found

    def _hand_over_on_a_sample(self, problem: Problem) -> None:
        """The best point whose hand-over is flown as it is trained, the other gains anew, in place of the best so far.

        Where that was admissible and what it becomes is not, from where other starts ended.
        """
        admissible, moved = self.best.over == 0.0, False
        times = [k for k, name in enumerate(problem.names) if name in TIMES]
        others = [(k, end) for k, end in _ranked(self._ends) if k != self._from]
        for number, end in [(self._from, self.best), *others]:
            for share in hand_overs.on_samples(problem, self._evaluate.bounds, end.share):
                self._descend(problem, number, Start(share, CAREFUL, times), self._steps, afresh=not moved)
                moved = True
            if not admissible or self.best.over == 0.0:
                return

    def _descend(
        self, problem: Problem, number: int, start: Start, steps: int, close: float = CLOSE, *, afresh: bool = False
    ) -> None:
        """Descend from a start of this number, and take what it finds."""
        best, tightened = Best(start.share, len(problem.rows), self._margin), self.tightened(problem)
        try:
            keep = partial(self._keep, number)
            descend(partial(self._evaluate.slopes, tightened), best, start, steps, keep, close, _relaxed(problem))
        finally:  # interrupted too
            self._take(best, tightened, number, afresh=afresh)

    def _take(self, best: Best, tightened: Problem, start: int, *, afresh: bool) -> None:
        """Take what was found where it is better than the best so far; afresh: whatever it is, of another problem."""
        if np.isfinite(best.f):
            self._ends[start] = best
        if self._best is None or (np.isfinite(best.f) and (afresh or best.rank < self._best.rank)):
            self._best, self._problem, self._from = best, tightened, start

    def _keep(self, start: int, seen: Measured) -> None:
        worst = np.where(failures(seen.c)[0] > 0, np.inf, largest(seen.c, self._margin)[0])
        step = Step(start, seen.gains[0], float(seen.goal[0]), worst)
        self._history.setdefault(start, []).append(step)

    def tightened(self, problem: Problem) -> Problem:
        """With the margin kept from the limits."""
        return problem.tightened(1.0 - self._margin)


def _relaxed(problem: Problem) -> Relaxed | None:
    """Return what a local search minimises, if that is not F subject to the limits."""
    return Relaxed(to_the_end=True) if problem.goal == LIMITS else None


def _ranked(ends: Mapping[int, Best]) -> list[tuple[int, Best]]:
    """Where starts ended, the best first."""
    return sorted(ends.items(), key=lambda item: item[1].rank)
