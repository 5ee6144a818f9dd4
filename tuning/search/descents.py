"""Local searches from many starting points by successive halving, with the best point and the history.

`Descents` runs the steps of a search, and `optimise.search` calls them in order. The local search is sequential
quadratic programming with gradients of the simulation, see `descent.descend`. Without gradients, it is replaced by
differential evolution. Points are normalised gains (`share`), 0 to 1 within the bounds.
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
from tuning.search.evolution import WIDELY, evolve
from tuning.search.lockstep import Ask, in_step
from tuning.search.objective import LIMITS, Problem, ended, failures, fewer_trials
from tuning.search.progress import Report
from tuning.search.shares import TIMES
from tuning.search.starts import (
    NEARLY,
    STEEP,
    charged,
    promising,
    spread,
    spread_widely,
    starting_points,
)

AGAIN = 3  # number of local searches that a further round continues
EXPLORED, AVERAGED = 32, 16  # trials of the first searches, constraints included; smallest number in the objective
TOGETHER = 2  # concurrent local searches for each device, so that the device waits for SLSQP less often
FOLLOWED = 3  # number of explored starting points that continue with all trials
SAME = 1e-4  # points are equally good if their F differs by less: 0.01 % of the objective
FINISH = 1e-2  # factor on `CLOSE` for the last local search, from the best point
CONFLICTING = 0.1  # limits whose excess is within this fraction of the largest excess count as conflicting
LOOKS = 3  # largest number of attempts with other hand-over times
MANY = 512  # Sobol points of a search without gradients


@dataclass(frozen=True)
class Step:
    """A point in the history of a search."""

    start: int
    gains: np.ndarray  # (gains,)
    value: float  # objective over the training trials; NaN if no trial completes
    worst: np.ndarray  # (requirements,) largest metric / limit; infinite if a trial fails


@dataclass(frozen=True)
class _Racer:
    """A starting point in successive halving, and the history that led to it."""

    start: Start
    before: list[Step]


def _few_trials(problem: Problem) -> Problem:
    """Return the problem with few averaged trials, for the first searches."""
    return fewer_trials(problem, max(AVERAGED, EXPLORED - (problem.trials.size - problem.averaged)))


class Descents:
    """The steps of a search, with its best point and its history."""

    def __init__(
        self,
        evaluate: Evaluator,
        margin: ArrayLike,
        steps: int,
        rng: np.random.Generator,
        report: Report = lambda *_: None,
    ):
        """Prepare a search.

        Args:
            evaluate: measures the problem.
            margin: relative tightening of each limit, (rows,) or one number.
            steps: largest number of measured points of each local search.
            rng: random generator of the search without gradients.
            report: is called after every step.
        """
        self._evaluate, self._steps, self._rng, self._report = evaluate, steps, rng, report
        self._margin = np.asarray(margin)  # relative tightening of each limit, (rows,) or one number
        self._scenario_gains: np.ndarray | None = None  # (gains,) gains of the scenario
        self.globally = False  # `search_globally` was called
        self._designs = np.zeros((0, 0))  # (designs, gains) normalised gains of the designs
        self._best: Best | None = None
        self._problem: Problem | None = None
        self._history: dict[int, list[Step]] = {}  # by number of the local search
        self._ends: dict[int, Best] = {}  # best point of each local search
        self._from = 0  # number of the local search that found the best point

    @property
    def started(self) -> bool:
        """Whether a point with a finite F was found."""
        return self._best is not None and bool(np.isfinite(self._best.f))

    @property
    def so_far(self) -> tuple[float, float]:
        """Objective and relative violation of the best point, or NaN before the first point."""
        return (np.nan, np.nan) if self._best is None else self._best.so_far

    @property
    def best(self) -> Best:
        """The best point so far."""
        assert self._best is not None
        return self._best

    @property
    def problem(self) -> Problem:
        """The problem that the best point belongs to, with the original limits."""
        assert self._problem is not None
        return self._problem.tightened(1.0 / (1.0 - self._margin))

    @property
    def share(self) -> np.ndarray:
        """Normalised gains of the best point, (gains,)."""
        return self.best.share

    @property
    def gains(self) -> np.ndarray:
        """Gains of the best point, (gains,)."""
        return self._evaluate.bounds.gains(self.share)

    @property
    def ends(self) -> list[np.ndarray]:
        """Normalised gains of the best points of the local searches, (gains,) each, the best first."""
        return [end.share for _, end in _ranked(self._ends)]

    @property
    def history(self) -> list[Step]:
        """The history of accepted points, ordered by local search and step."""
        return [step for _, steps in sorted(self._history.items()) for step in steps]

    def set_out(self, problem: Problem, scenario_gains: np.ndarray, designs: np.ndarray) -> None:
        """Search locally on few trials, from the scenario's gains or from the best design if that is better.

        Args:
            problem: the tuning problem.
            scenario_gains: (gains,) gains of the scenario.
            designs: (designs, gains) gains of designs that follow from the mission.
        """
        few = _few_trials(problem)
        self._scenario_gains = scenario_gains
        self._designs = np.asarray([self._evaluate.bounds.share(one) for one in designs])
        self._report("setting out", 0, 2, *self.so_far)
        points = np.concatenate(
            [self._evaluate.bounds.share(scenario_gains)[None], self._designs.reshape(-1, scenario_gains.size)]
        )
        first = points[0]
        if len(points) > 1:
            (first,) = promising(self._evaluate, self.tightened(few), points, 1, lambda *_: None)
        self._descend(few, 0, Start(first, CAREFUL), max(2, self._steps // 2))

    def explore(self, problem: Problem, starts: int, seed: int) -> dict[int, np.ndarray]:
        """Run short local searches on few trials from many starting points, and return the best results.

        The first local search continues from the result of `set_out`, with the trials that joined since. The other
        starting points are chosen after it.

        Args:
            problem: the tuning problem.
            starts: number of starting points.
            seed: seed of the candidates for starting points.

        Returns:
            Normalised gains, (gains,), of at most `FOLLOWED` results, by number of the local search.
        """
        problem, more = _few_trials(problem), max(2, self._steps // 2)
        self._report("setting out", 1, 2, *self.so_far)
        self._descend(problem, 0, Start(self.share, CAREFUL), more, afresh=True)
        first = starting_points(
            self._evaluate, self.tightened(problem), self.share, self._designs, starts, seed, self._report
        )
        return self._promising(problem, first)

    def _promising(self, problem: Problem, first: np.ndarray, number: int = 0) -> dict[int, np.ndarray]:
        """Return the results of the best short local searches, by number of the local search.

        Args:
            problem: the tuning problem.
            first: (starts, gains) normalised gains of the starting points.
            number: number of the first local search.
        """
        few, more = max(2, self._steps // 4), max(2, self._steps // 2)
        racing = dict(enumerate(first, number))
        rungs = ((len(racing), few), (max(FOLLOWED, len(racing) // 2), more))
        ranked = self._race(problem, racing, rungs, "searching", scales=(CAREFUL, BOLD))
        return {k: self._ends[k].share for k in ranked[:FOLLOWED]} or {number: first[0]}

    def descend(self, problem: Problem, starts: Mapping[int, np.ndarray]) -> None:
        """Search locally with half of the steps from each starting point, then with all steps from the best one.

        Args:
            problem: the tuning problem.
            starts: (gains,) normalised gains of each starting point, by number of the local search.
        """
        half, self._ends = max(2, self._steps // 2), {}
        self._race(problem, starts, ((len(starts), half), (1, self._steps)), "following the best", afresh=True)
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
        """Run successive halving and return the numbers of the local searches, the best first.

        Args:
            problem: the tuning problem.
            starts: (gains,) normalised gains of each starting point, by number of the local search.
            rungs: for each stage, the number of local searches that continue, and the total steps of each.
            what: name of the step in progress reports.
            scales: scalings of the variables, which the local searches use in turn.
            afresh: replace the best point so far by the first result, because the problem has changed.
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
        """Run local searches from these starting points, with `TOGETHER` of them at a time for each device."""
        tightened, bests, reports = self.tightened(problem), dict[int, Best](), 0

        def race(k: int, ask: Ask) -> None:
            bests[k] = Best(racers[k].start.share, len(problem.rows), self._margin)
            self._history[k] = list(racers[k].before)  # the longer search repeats the points of the shorter one
            descend(ask, bests[k], racers[k].start, steps, partial(self._keep, k), relaxed=_relaxed(problem))

        def tell() -> None:
            nonlocal reports
            begun = [*bests.values()] if afresh or self._best is None else [self._best, *bests.values()]
            best = min(begun, key=lambda best: best.rank)
            while reports < len(bests):  # one report for each local search that has begun
                self._report(what, reports, len(racers), *best.so_far)
                reports += 1

        def fly(points: list[np.ndarray]) -> list[Sloped]:
            tell()
            measured = self._evaluate.slopes(tightened, np.concatenate(points))
            return [measured.at(k) for k in range(len(points))]

        try:
            in_step([partial(race, k) for k in racers], fly, TOGETHER * len(configure.devices()))
            tell()
        finally:  # also after an interrupt
            for k in racers:
                if k in bests:
                    self._take(bests[k], tightened, k, afresh=afresh)
                    afresh = False

    def again(self, problem: Problem) -> None:
        """Continue from the best results, with the trials that joined the problem."""
        for k, (start, end) in enumerate(_ranked(self._ends)[:AGAIN]):
            self._descend(problem, start, Start(end.share, CAREFUL), self._steps, afresh=k == 0)
        self._finish(problem)

    def search_globally(self, problem: Problem, starts: int, seed: int) -> None:
        """Search from the best of many points of the whole box, and keep the earlier result if it is better.

        Args:
            problem: the tuning problem.
            starts: number of starting points.
            seed: seed of the points.
        """
        self.globally = True
        found = self.best, self._problem, self._from, self._ends
        try:
            few = _few_trials(problem)
            first = spread_widely(self._evaluate, self.tightened(few), starts, seed, self._report)
            self.descend(problem, self._promising(few, first, 1 + max(self._history, default=-1)))
        finally:  # also after an interrupt
            if found[0].rank <= self.best.rank:
                self._best, self._problem, self._from, self._ends = found

    def sweep(self, problem: Problem, scenario_gains: np.ndarray) -> None:
        """Measure Sobol points and the scenario's gains, and take the best of them. No gradients are used.

        Args:
            problem: the tuning problem.
            scenario_gains: (gains,) gains of the scenario.
        """
        tightened = self.tightened(problem)
        share = np.concatenate(
            [self._evaluate.bounds.share(scenario_gains)[None], spread(len(problem.names), MANY, self._rng)]
        )
        share = promising(self._evaluate, tightened, share, 1, partial(self._report, "choosing starts"))
        best, flown = self._best_of(tightened, share)
        self._keep(0, flown)  # if the search is interrupted now, the history has this point
        self._take(best, tightened, 0, afresh=True)

    def _best_of(self, tightened: Problem, share: np.ndarray) -> tuple[Best, Measured]:
        """Measure points (points, gains) without gradients. Return the best point and the measurement."""
        best, flown = Best(share[0], len(tightened.rows), self._margin), self._evaluate.fly(tightened, share)
        best.offer(share, flown)
        return best, flown

    def evolve(self, problem: Problem, share: np.ndarray, size: tuple[int, float] = WIDELY) -> None:
        """Search by differential evolution from a point, without gradients.

        Args:
            problem: the tuning problem.
            share: (gains,) normalised gains of the point.
            size: points of a generation and spread of the first generation, see `evolution.evolve`.
        """
        tightened = self.tightened(problem)
        best, _ = self._best_of(tightened, share[None])
        try:
            evolve(self._evaluate, tightened, best, share, int(self._rng.integers(2**31)),
                   lambda done, steps: self._report("evolving", done, steps, *best.so_far),
                   partial(self._keep, 0), size)  # fmt: skip
        finally:  # also after an interrupt
            self._take(best, tightened, 0, afresh=True)
        on_samples = np.asarray(hand_overs.on_samples(problem, self._evaluate.bounds, self.share))
        if on_samples.size:
            best, _ = self._best_of(tightened, on_samples)
            self._take(best, tightened, 0, afresh=best.beyond <= self.best.beyond)

    def conflict(self, problem: Problem) -> dict[str, float | None]:
        """Return the limits that the best compromise exceeds most, and the smallest ratio that each can reach alone.

        The ratio is metric / limit, with every other limit kept to 0.1 %. It is None if the other limits cannot be
        kept.
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
            kept = [share_of_start for rest, share_of_start in seen if rest <= 1.0 + 10.0 * SLACK]
            margin = float(np.broadcast_to(self._margin, worst.size)[row])
            found[problem.rows[row]] = (1.0 - margin) * min(kept) if kept else None
        return found

    def _finish(self, problem: Problem) -> None:
        self._report("finishing", 0, 1, *self.so_far)
        for _ in range(LOOKS):
            if not self._hand_over_elsewhere(problem):
                break
        self._descend(problem, self._from, Start(self.share, CAREFUL), self._steps, close=FINISH * CLOSE)
        self._hand_over_on_a_sample(problem)
        times = [k for k, name in enumerate(problem.names) if name in TIMES]
        others = [k for k in range(len(problem.names)) if k not in times]
        if self._scenario_gains is not None and others:
            self._take_back(problem, self._scenario_gains, others)

    def _take_back(self, problem: Problem, scenario_gains: np.ndarray, indices: Sequence[int]) -> None:
        """Reset as many gains as possible to the scenario's values.

        F may grow by `SAME`, and the violation may not grow.

        Args:
            problem: the tuning problem.
            scenario_gains: (gains,) gains of the scenario.
            indices: indices of the gains that may be reset.
        """
        tightened, current = self.tightened(problem), self.best

        def judged(changes: Sequence[Sequence[int]]) -> list[Best]:
            back = [np.isin(np.arange(scenario_gains.size), change) for change in changes]
            share = np.clip(
                [self._evaluate.bounds.replaced(current.share, scenario_gains, which) for which in back], 0.0, 1.0
            )
            flown = self._evaluate.slopes(tightened, share)  # this program is already compiled
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
        """Try other hand-over times, search locally from the best of them, and return whether that was better.

        The noise samples in the window change with delta. F of a few hundred trials therefore has ripples of 1 % over
        delta, and a local search can end in the local minimum of a ripple.
        """
        found, share = self.best, hand_overs.elsewhere(problem, self._evaluate.bounds, self.share)
        if found.over > 0.0 or not share:
            return False
        tightened = self.tightened(problem)
        flown = self._evaluate.fly(tightened, np.stack(share))
        price = prices(self._evaluate.slopes(tightened, found.share[None]), found.share)
        # for small violations, the multipliers estimate F after the other gains have restored the limits
        paid = flown.f + np.maximum(ended(flown.c).max(axis=2, initial=-1.0), 0.0) @ price
        known = np.isfinite(paid) & (failures(flown.c) == 0) & (flown.beyond <= NEARLY)
        paid = np.where(known, paid, np.inf)
        first = int(paid.argmin())
        if paid[first] < found.f - SAME:
            self._descend(problem, self._from, Start(share[first], CAREFUL), self._steps)
        return self.best is not found

    def _hand_over_on_a_sample(self, problem: Problem) -> None:
        """Move the hand-over of the best point onto a sample, as on a flight computer, and search the other gains.

        If the best point was admissible and the new point is not, the results of other local searches are tried.
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
        """Run a local search and take its result.

        Args:
            problem: the tuning problem.
            number: number of the local search.
            start: starting point.
            steps: largest number of measured points.
            close: change of F at which the search ends.
            afresh: replace the best point so far, because the problem has changed.
        """
        best, tightened = Best(start.share, len(problem.rows), self._margin), self.tightened(problem)
        try:
            keep = partial(self._keep, number)
            descend(partial(self._evaluate.slopes, tightened), best, start, steps, keep, close, _relaxed(problem))
        finally:  # also after an interrupt
            self._take(best, tightened, number, afresh=afresh)

    def _take(self, best: Best, tightened: Problem, start: int, *, afresh: bool) -> None:
        """Replace the best point by a better one, or, with `afresh`, by any result, because the problem has changed."""
        if np.isfinite(best.f):
            self._ends[start] = best
        if self._best is None or (np.isfinite(best.f) and (afresh or best.rank < self._best.rank)):
            self._best, self._problem, self._from = best, tightened, start

    def _keep(self, start: int, seen: Measured) -> None:
        worst = np.where(failures(seen.c)[0] > 0, np.inf, largest(seen.c, self._margin)[0])
        step = Step(start, seen.gains[0], float(seen.goal[0]), worst)
        self._history.setdefault(start, []).append(step)

    def tightened(self, problem: Problem) -> Problem:
        """Return the problem with tightened limits."""
        return problem.tightened(1.0 - self._margin)


def _relaxed(problem: Problem) -> Relaxed | None:
    """Return what a local search minimises, if that is not F subject to the limits."""
    return Relaxed(to_the_end=True) if problem.goal == LIMITS else None


def _ranked(ends: Mapping[int, Best]) -> list[tuple[int, Best]]:
    """Return the results of the local searches, the best first."""
    return sorted(ends.items(), key=lambda item: item[1].rank)
