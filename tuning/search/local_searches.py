"""Local searches from many starting points by successive halving, with the best point and the history.

`LocalSearches` runs the steps of a search, and `optimise.search` calls them in order. The local search is sequential
quadratic programming with gradients of the simulation, see `local_search.search_locally`. Without gradients,
differential evolution replaces it. Points are normalised gains, 0 at the lower bound and 1 at the upper bound.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import ArrayLike

from ptsmc_jax import configure
from tuning.search import hand_overs
from tuning.search.evaluate import Evaluator, Measurement, MeasurementWithGradients
from tuning.search.evolution import WHOLE_BOX, evolve
from tuning.search.local_search import (
    BOLD,
    CAREFUL,
    F_TOLERANCE,
    SLACK,
    Best,
    Start,
    estimate_multipliers,
    largest_ratios,
    search_locally,
)
from tuning.search.lockstep import Ask, run_in_lockstep
from tuning.search.normalisation import TIMES
from tuning.search.objective import LIMITS, Problem, count_failures, fewer_trials, ignore_failures
from tuning.search.progress import Report
from tuning.search.starts import (
    NEARLY_ACTIVE,
    STEEP,
    choose_promising,
    global_starting_points,
    penalise,
    sobol_points,
    starting_points,
)

CONTINUED_SEARCHES = 3  # number of local searches that a further round continues
FIRST_TRIALS, FEWEST_AVERAGED = 32, 16  # number of trials of the first searches; smallest number of averaged trials
SEARCHES_PER_DEVICE = 2  # concurrent local searches for each device, so that the device waits for SLSQP less often
FOLLOWED_STARTS = 3  # number of explored starting points that continue with all trials
SAME_F = 1e-4  # points with a smaller difference of F, 0.01 % of the objective, are equally good
FINAL_TOLERANCE = 1e-2 * F_TOLERANCE  # for the last local search, from the best point
CONFLICTING = 0.1  # limits whose excess is within this fraction of the largest excess count as conflicting
HAND_OVER_ATTEMPTS = 3  # largest number of attempts to improve the best point by another hand-over time t_f - delta
SOBOL_POINTS = 512  # Sobol points of a search without gradients


@dataclass(frozen=True)
class Step:
    """A point in the history of a search."""

    start: int  # number of the local search
    gains: np.ndarray  # (gains,)
    value: float  # objective over the training trials; NaN if no trial completes
    worst: np.ndarray  # (requirements,) largest metric / limit; infinite if a trial fails
    stage: int  # number of the stage of the search: each stage searches again from some starting points


def _is_equal(one: Step, other: Step) -> bool:
    """Return whether two steps are equal apart from their stage."""
    names = ("start", "gains", "value", "worst")
    return all(np.array_equal(getattr(one, name), getattr(other, name), equal_nan=True) for name in names)


def _few_trials(problem: Problem) -> Problem:
    """Return the problem with few averaged trials, for the first searches."""
    return fewer_trials(problem, max(FEWEST_AVERAGED, FIRST_TRIALS - (problem.trials.size - problem.averaged)))


class LocalSearches:
    """The local searches of one tuning problem, run step by step, with the best point and the history so far."""

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
        self.searched_globally = False  # whether `search_globally` was called
        self._designs = np.zeros((0, 0))  # (designs, gains) normalised gains of the designs
        self._best: Best | None = None
        self._problem: Problem | None = None
        self._history: dict[int, list[Step]] = {}  # accepted points by number of the local search
        self._ends: dict[int, Best] = {}  # best point of each local search
        self._best_start = 0  # number of the local search that found the best point
        self._stage = 0  # number of the stage, see `Step`

    @property
    def started(self) -> bool:
        """Whether a point with a finite F was found."""
        return self._best is not None and bool(np.isfinite(self._best.f))

    @property
    def progress(self) -> tuple[float, float]:
        """Objective and relative violation of the best point, or NaN before the first point."""
        return (np.nan, np.nan) if self._best is None else self._best.progress

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
    def normalised(self) -> np.ndarray:
        """Normalised gains of the best point, (gains,)."""
        return self.best.normalised

    @property
    def gains(self) -> np.ndarray:
        """Gains of the best point, (gains,)."""
        return self._evaluate.bounds.gains(self.normalised)

    @property
    def ends(self) -> list[np.ndarray]:
        """Normalised gains of the best points of the local searches, (gains,) each, the best first."""
        return [end.normalised for _, end in _ranked(self._ends)]

    @property
    def history(self) -> list[Step]:
        """The history of accepted points, ordered by local search and step."""
        return [step for _, steps in sorted(self._history.items()) for step in steps]

    def begin(self, problem: Problem, scenario_gains: np.ndarray, designs: np.ndarray) -> None:
        """Search locally on few trials, from the scenario's gains or from the best design if that is better.

        Args:
            problem: the tuning problem.
            scenario_gains: (gains,) gains of the scenario.
            designs: (designs, gains) gains of designs that follow from the mission.
        """
        small, normalise = _few_trials(problem), self._evaluate.bounds.normalise
        self._scenario_gains, self._designs = scenario_gains, np.asarray([normalise(one) for one in designs])
        self._report("first local search", 0, 0, *self.progress)
        points = np.concatenate([normalise(scenario_gains)[None], self._designs.reshape(-1, scenario_gains.size)])
        first = points[0]
        if len(points) > 1:
            (first,) = choose_promising(self._evaluate, self.tightened(small), points, 1, lambda *_: None)
        self._search(small, 0, Start(first, CAREFUL), max(2, self._steps // 2))

    def explore(self, problem: Problem, starts: int, seed: int) -> dict[int, np.ndarray]:
        """Run short local searches on few trials from many starting points, and return the best results.

        The first local search continues from the result of `begin`, with the trials that joined since. The other
        starting points are chosen after it.

        Args:
            problem: the tuning problem.
            starts: number of starting points.
            seed: seed of the candidates for starting points.

        Returns:
            Normalised gains, (gains,), of at most `FOLLOWED_STARTS` results, by number of the local search.
        """
        problem, steps = _few_trials(problem), max(2, self._steps // 2)
        self._report("first local search", 0, 0, *self.progress)
        self._search(problem, 0, Start(self.normalised, CAREFUL), steps, replace_best=True)
        first = starting_points(
            self._evaluate, self.tightened(problem), self.normalised, self._designs, starts, seed, self._report
        )
        return self._explore_starts(problem, first)

    def _explore_starts(self, problem: Problem, first: np.ndarray, number: int = 0) -> dict[int, np.ndarray]:
        """Return the results of the best short local searches, by number of the local search, the best first.

        Args:
            problem: the tuning problem.
            first: (starts, gains) normalised gains of the starting points.
            number: number of the first local search.

        Returns:
            Normalised gains (gains,) of each of these searches.
        """
        first_steps, more_steps = max(2, self._steps // 4), max(2, self._steps // 2)
        contenders = dict(enumerate(first, number))
        stages = ((len(contenders), first_steps), (max(FOLLOWED_STARTS, len(contenders) // 2), more_steps))
        ranked = self._successive_halving(problem, contenders, stages, "searching", scalings=(CAREFUL, BOLD))
        return {k: self._ends[k].normalised for k in ranked[:FOLLOWED_STARTS]} or {number: first[0]}

    def search_locally(self, problem: Problem, starts: Mapping[int, np.ndarray]) -> None:
        """Search locally with half of the steps from each starting point, then with all steps from the best one.

        The result is `best`.

        Args:
            problem: the tuning problem.
            starts: (gains,) normalised gains of each starting point, by number of the local search.
        """
        half, self._ends = max(2, self._steps // 2), {}
        self._successive_halving(
            problem, starts, ((len(starts), half), (1, self._steps)), "refining the best results", replace_best=True
        )
        self._finish(problem)

    def _successive_halving(
        self,
        problem: Problem,
        starts: Mapping[int, np.ndarray],
        stages: Sequence[tuple[int, int]],
        step_name: str,
        *,
        scalings: Sequence[float] = (CAREFUL,),
        replace_best: bool = False,
    ) -> list[int]:
        """Run successive halving and return the numbers of the local searches, the best first.

        Args:
            problem: the tuning problem.
            starts: (gains,) normalised gains of each starting point, by number of the local search.
            stages: for each stage, the number of local searches that continue, and the total steps of each.
            step_name: name of the step in progress reports.
            scalings: scalings of the variables, `BOLD` or `CAREFUL`, which the local searches use in turn.
            replace_best: replace the best point so far by the first result, because the problem has changed.
        """
        contenders = {k: Start(normalised, scalings[k % len(scalings)]) for k, normalised in starts.items()}
        ranked = list(starts)
        for count, steps in stages:
            self._search_in_lockstep(
                problem, {k: contenders[k] for k in ranked[:count]}, steps, step_name, replace_best=replace_best
            )
            replace_best = False
            ends = {k: self._ends[k] for k in ranked if k in self._ends}
            ranked = sorted(
                ends, key=lambda k, ends=ends: (ends[k].failed_trials, penalise(ends[k].f, ends[k].violation, STEEP))
            )
        return ranked

    def _search_in_lockstep(
        self,
        problem: Problem,
        contenders: Mapping[int, Start],
        steps: int,
        step_name: str,
        *,
        replace_best: bool,
    ) -> None:
        """Run local searches, `SEARCHES_PER_DEVICE` at a time for each device; contenders: their starting points."""
        tightened, bests, reports = self.tightened(problem), dict[int, Best](), 0
        self._stage += 1

        def search(k: int, ask: Ask) -> None:
            start = contenders[k]
            bests[k] = self._new_best(problem, start.normalised)
            search_locally(ask, bests[k], start, steps, partial(self._record, k), relaxed=_relaxed(problem))

        def report_new_searches() -> None:
            """Report the progress once for each local search that has begun since the last call."""
            nonlocal reports
            begun = [*bests.values()] if replace_best or self._best is None else [self._best, *bests.values()]
            best = min(begun, key=lambda best: best.rank)
            while reports < len(bests):
                self._report(step_name, reports, len(contenders), *best.progress)
                reports += 1

        def measure(points: list[np.ndarray]) -> list[MeasurementWithGradients]:
            report_new_searches()
            measured = self._evaluate.measure_with_gradients(tightened, np.concatenate(points))
            return [measured.at(k) for k in range(len(points))]

        try:
            run_in_lockstep(
                [partial(search, k) for k in contenders], measure, SEARCHES_PER_DEVICE * len(configure.devices())
            )
            report_new_searches()
        finally:  # also after an interrupt
            for k in contenders:
                if k in bests:
                    self._update_best(bests[k], tightened, k, replace_best=replace_best)
                    replace_best = False

    def continue_best(self, problem: Problem) -> None:
        """Continue from the best results, with the trials that joined the problem."""
        for k, (start, end) in enumerate(_ranked(self._ends)[:CONTINUED_SEARCHES]):
            self._search(problem, start, Start(end.normalised, CAREFUL), self._steps, replace_best=k == 0)
        self._finish(problem)

    def search_globally(self, problem: Problem, starts: int, seed: int) -> None:
        """Search from the best of many points of the whole box, and keep the earlier result if it is better.

        Args:
            problem: the tuning problem.
            starts: number of starting points.
            seed: seed of the points.
        """
        self.searched_globally = True
        earlier = self.best, self._problem, self._best_start, self._ends
        try:
            small = _few_trials(problem)
            first = global_starting_points(self._evaluate, self.tightened(small), starts, seed, self._report)
            self.search_locally(problem, self._explore_starts(small, first, 1 + max(self._history, default=-1)))
        finally:  # also after an interrupt
            if earlier[0].rank <= self.best.rank:
                self._best, self._problem, self._best_start, self._ends = earlier

    def measure_sobol_points(self, problem: Problem, scenario_gains: np.ndarray) -> None:
        """Measure Sobol points and the scenario's gains, and take the best of them. No gradients are used.

        Args:
            problem: the tuning problem.
            scenario_gains: (gains,) gains of the scenario.
        """
        tightened = self.tightened(problem)
        normalised = np.concatenate(
            [
                self._evaluate.bounds.normalise(scenario_gains)[None],
                sobol_points(len(problem.names), SOBOL_POINTS, self._rng),
            ]
        )
        normalised = choose_promising(
            self._evaluate, tightened, normalised, 1, partial(self._report, "ranking starting points")
        )
        best, measured = self._best_of(tightened, normalised)
        self._record(0, measured)  # if the search is interrupted now, the history has this point
        self._update_best(best, tightened, 0, replace_best=True)

    def _new_best(self, problem: Problem, normalised: np.ndarray) -> Best:
        """Return a `Best` before the first measured point; normalised: (gains,) of the starting point."""
        return Best(normalised, len(problem.rows), self._margin)

    def _best_of(self, tightened: Problem, normalised: np.ndarray) -> tuple[Best, Measurement]:
        """Measure points (points, gains) without gradients. Return the best point and the measurement."""
        best, measured = self._new_best(tightened, normalised[0]), self._evaluate.measure(tightened, normalised)
        best.offer(normalised, measured)
        return best, measured

    def evolve(self, problem: Problem, normalised: np.ndarray, size: tuple[int, float] = WHOLE_BOX) -> None:
        """Search by differential evolution from a point, without gradients.

        Args:
            problem: the tuning problem.
            normalised: (gains,) normalised gains of the point.
            size: points of a generation and spread of the first generation, see `evolution.evolve`.
        """
        self._stage += 1
        tightened = self.tightened(problem)
        best, _ = self._best_of(tightened, normalised[None])
        try:
            evolve(self._evaluate, tightened, best, normalised, int(self._rng.integers(2**31)),
                   lambda done, steps: self._report("differential evolution", done, steps,
                                                    *best.progress),
                   partial(self._record, 0), size)  # fmt: skip
        finally:  # also after an interrupt
            self._update_best(best, tightened, 0, replace_best=True)
        on_samples = np.asarray(hand_overs.points_on_samples(problem, self._evaluate.bounds, self.normalised))
        if on_samples.size:
            best, _ = self._best_of(tightened, on_samples)
            self._update_best(best, tightened, 0, replace_best=best.infeasibility <= self.best.infeasibility)

    def find_conflicts(self, problem: Problem) -> dict[str, float | None]:
        """Return each limit that the best point exceeds most, with its smallest ratio if all other limits are kept.

        The ratio is metric / limit. Every other limit is kept to 0.1 % by every trial. The ratio is None if no such
        point is found.
        """
        tightened = self.tightened(problem)
        measure = partial(self._evaluate.measure_with_gradients, tightened)
        worst = largest_ratios(measure(self.normalised[None]).c, 0.0)[0]

        def find_smallest_ratio(row: int) -> float | None:
            """Return the smallest ratio to its limit that this constraint reaches while the others hold, if any."""
            kept = list[float]()

            def record_if_others_hold(measured: MeasurementWithGradients) -> None:
                ratios, fails = largest_ratios(measured.c, self._margin)[0], count_failures(measured.c)[0] > 0
                if not fails and _excess_of_others(ratios, row) <= 10.0 * SLACK:
                    kept.append(float(ratios[row]))

            for first in self._starts_without_limit(row):
                best, start = self._new_best(tightened, first), Start(first, CAREFUL)
                search_locally(measure, best, start, self._steps, record_if_others_hold, relaxed=[row])
                if kept:
                    return min(kept)
            return None

        most_exceeded = np.flatnonzero(worst >= 1.0 + (worst.max() - 1.0) * (1.0 - CONFLICTING)).tolist()
        return {problem.rows[row]: find_smallest_ratio(row) for row in most_exceeded}

    def _starts_without_limit(self, row: int) -> list[np.ndarray]:
        """Return starting points, (gains,), for a search that ignores the limit of this row.

        The best point is the first. The gradients there may not lead to a point that keeps the other limits, such as
        with saturated wheels. The point of the history that exceeds the other limits least and the scenario's gains
        follow.
        """
        steps = sorted(self.history, key=lambda step: (_excess_of_others(step.worst, row), step.worst[row]))
        others = [*(step.gains for step in steps[:1]), self._scenario_gains]
        return [self.normalised, *(self._evaluate.bounds.normalise(gains) for gains in others if gains is not None)]

    def _finish(self, problem: Problem) -> None:
        """Improve the best point: other hand-over times, a last local search, and gains reset to the scenario's."""
        self._report("last local search", 0, 0, *self.progress)
        for _ in range(HAND_OVER_ATTEMPTS):
            if not self._try_other_hand_overs(problem):
                break
        self._search(problem, self._best_start, Start(self.normalised, CAREFUL), self._steps, tolerance=FINAL_TOLERANCE)
        self._move_hand_over_to_sample(problem)
        self._restore_scenario_gains(problem)

    def _restore_scenario_gains(self, problem: Problem) -> None:
        """Reset as many gains as possible, except for times, to the scenario's values.

        F may grow by `SAME_F`, and the violation may not grow.
        """
        scenario_gains = self._scenario_gains
        indices = [k for k, name in enumerate(problem.names) if name not in TIMES]
        if scenario_gains is None or not indices:
            return
        tightened, current = self.tightened(problem), self.best

        def measure_resets(resets: Sequence[Sequence[int]]) -> list[Best]:
            """Measure the best point with some gains reset to the scenario's values; resets: indices of these gains."""
            masks = [np.isin(np.arange(scenario_gains.size), reset) for reset in resets]
            bounds = self._evaluate.bounds
            changed = [bounds.with_gains(current.normalised, scenario_gains, mask) for mask in masks]
            normalised = np.clip(changed, 0.0, 1.0)
            # with gradients, because this program is already compiled
            measured = self._evaluate.measure_with_gradients(tightened, normalised)
            bests = [self._new_best(problem, one) for one in normalised]
            for k, best in enumerate(bests):
                best.offer(normalised[k : k + 1], measured.at(k))
            return bests

        single = dict(zip(indices, measure_resets([[k] for k in indices]), strict=True))
        order = sorted((k for k in indices if self._is_as_good(single[k])), key=lambda k: single[k].f)
        if order:
            cumulative = measure_resets([order[: k + 1] for k in range(len(order))])
            self._best = next((best for best in reversed(cumulative) if self._is_as_good(best)), current)

    def _is_as_good(self, best: Best) -> bool:
        """Return whether a point has no larger violation than the best point, and F is at most `SAME_F` larger."""
        return best.infeasibility <= self.best.infeasibility and best.f <= self.best.f + SAME_F

    def _try_other_hand_overs(self, problem: Problem) -> bool:
        """Try other hand-over times, search locally from the best of them, and return whether that was better.

        The noise samples in the window change with delta. F of a few hundred trials therefore has ripples of 1 % over
        delta, and a local search can end in the local minimum of a ripple.
        """
        current, normalised = self.best, hand_overs.other_hand_overs(problem, self._evaluate.bounds, self.normalised)
        if current.violation > 0.0 or not normalised:
            return False
        tightened = self.tightened(problem)
        measured = self._evaluate.measure(tightened, np.stack(normalised))
        multiplier = estimate_multipliers(
            self._evaluate.measure_with_gradients(tightened, current.normalised[None]), current.normalised
        )
        # for small violations, the multipliers estimate F after the other gains have restored the limits
        estimate = measured.f + np.maximum(ignore_failures(measured.c).max(axis=2, initial=-1.0), 0.0) @ multiplier
        admissible = np.isfinite(estimate) & (count_failures(measured.c) == 0) & (measured.largest_c <= NEARLY_ACTIVE)
        estimate = np.where(admissible, estimate, np.inf)
        first = int(estimate.argmin())
        if estimate[first] < current.f - SAME_F:
            self._search(problem, self._best_start, Start(normalised[first], CAREFUL), self._steps)
        return self.best is not current

    def _move_hand_over_to_sample(self, problem: Problem) -> None:
        """Move the hand-over of the best point onto a sample, as on a flight computer, and search the other gains.

        If the best point was admissible and the new point is not, the results of other local searches are tried.
        """
        admissible, moved = self.best.violation == 0.0, False
        times = [k for k, name in enumerate(problem.names) if name in TIMES]
        others = [(k, end) for k, end in _ranked(self._ends) if k != self._best_start]
        for number, end in [(self._best_start, self.best), *others]:
            for normalised in hand_overs.points_on_samples(problem, self._evaluate.bounds, end.normalised):
                self._search(problem, number, Start(normalised, CAREFUL, times), self._steps, replace_best=not moved)
                moved = True
            if not admissible or self.best.violation == 0.0:
                return

    def _search(
        self,
        problem: Problem,
        number: int,
        start: Start,
        steps: int,
        tolerance: float = F_TOLERANCE,
        *,
        replace_best: bool = False,
    ) -> None:
        """Run a local search and take its result.

        Args:
            problem: the tuning problem.
            number: number of the local search.
            start: starting point.
            steps: largest number of measured points.
            tolerance: change of F at which the search ends.
            replace_best: replace the best point so far, because the problem has changed.
        """
        self._stage += 1
        best, tightened = self._new_best(problem, start.normalised), self.tightened(problem)
        measure, record = partial(self._evaluate.measure_with_gradients, tightened), partial(self._record, number)
        try:
            search_locally(measure, best, start, steps, record, tolerance, _relaxed(problem))
        finally:  # also after an interrupt
            self._update_best(best, tightened, number, replace_best=replace_best)

    def _update_best(self, best: Best, tightened: Problem, start: int, *, replace_best: bool) -> None:
        """Replace the best point by a better one. With `replace_best`, any result replaces it."""
        if np.isfinite(best.f):
            self._ends[start] = best
        if self._best is None or (np.isfinite(best.f) and (replace_best or best.rank < self._best.rank)):
            self._best, self._problem, self._best_start = best, tightened, start

    def _record(self, start: int, measured: Measurement) -> None:
        """Append a measured point to the history of the local search with this number, unless it is there already."""
        worst = np.where(count_failures(measured.c)[0] > 0, np.inf, largest_ratios(measured.c, self._margin)[0])
        step = Step(start, measured.gains[0], float(measured.objective[0]), worst, self._stage)
        steps = self._history.setdefault(start, [])
        if not any(_is_equal(step, earlier) for earlier in steps):
            steps.append(step)

    def tightened(self, problem: Problem) -> Problem:
        """Return the problem with tightened limits."""
        return problem.tightened(1.0 - self._margin)


def _relaxed(problem: Problem) -> Sequence[int] | None:
    """Return the indices of the limits whose largest c is minimised; None: F is minimised subject to the limits."""
    return range(len(problem.rows)) if problem.objective == LIMITS else None


def _excess_of_others(ratios: np.ndarray, row: int) -> float:
    """Return how far the largest ratio to a limit, (rows,), exceeds 1, without the ratio of this row; at least 0."""
    return max(float(np.delete(ratios, row).max(initial=0.0)) - 1.0, 0.0)


def _ranked(ends: Mapping[int, Best]) -> list[tuple[int, Best]]:
    """Return pairs of number and result of the local searches, in a list, the best first."""
    return sorted(ends.items(), key=lambda item: item[1].rank)
