"""Rounds of a search: which trials, and which loops, join the constraints for the gains that were found last."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ptsmc_jax.simulation.requirements import Requirement
from tuning.search import confirm, margin_rows
from tuning.search import worst as worst_case
from tuning.search.evaluate import Evaluator
from tuning.search.objective import Problem, coordinates_of, kept_by_every_trial, replaced, with_trials
from tuning.search.worst import Hardest

MARGIN = 0.03  # kept from a limit in the search: fresh trials hold some that are harder than any screened one
SURE_MARGIN = 0.003  # where there is no harder one: the worst case is searched for, or nothing is drawn
HARDEST = 8  # of the screened trials, that join the constraints
SPARE = 8  # places for those that later rounds add: a trial more would be another program to compile
BAND = confirm.FARTHER + confirm.NEARER  # places of a band
ROUNDS = 6  # searches again with hardest trials added, at most


@dataclass(frozen=True)
class Joining:
    """Trials that join the constraints."""

    trials: np.ndarray  # that name the noise
    counted: np.ndarray  # (requirements,) bool: the limits that they must keep
    coordinates: dict[str, list[float]] | None = None  # of a single one, where they are not its own


class Rounds:
    """A problem that becomes harder from round to round.

    A limit on every trial hangs on the few hardest ones, which a training set need not hold: the hardest of many
    screened ones join the constraints first, and again after a search whose gains some of them still break; robust:
    not those drawn, but the worst case inside the dispersions' support. A limit on a share of the trials is confirmed
    on others after each search: where more of them break it than may, the hardest of the rest join. Where the training
    trials are too few to show it, a band joins first: those about the last that may break it, of as many as are counted
    on.
    """

    def __init__(self, evaluate: Evaluator, problem: Problem, requirements: Sequence[Requirement], *, robust: bool):
        self._evaluate, self._robust = evaluate, robust
        every = [r for r in requirements if r.quantile is None]
        self._every = every if problem.dispersion.varies else []  # limits on every trial
        several, among = problem.trials.size > 1, np.asarray(problem.among)
        # limits on a share of the trials, and of these those with a band, by their rows in the problem
        self._shares = {k: r for k, r in enumerate(requirements) if r.quantile is not None and several}
        self._bands = [k for k in self._shares if not among[k].any()]
        self.margin = SURE_MARGIN if (robust and self._every) or not several else MARGIN
        limits = bool(self._every) + len(self._shares)  # each of which may add its hardest trials in a round
        if limits:
            problem = _with_room(problem, limits * HARDEST + SPARE)
        self._places = np.arange(problem.averaged, problem.trials.size)  # for those that join
        self.problem = _with_room(problem, len(self._bands) * BAND)
        self.count = 0  # rounds so far
        self.hardest: Hardest | None = None  # for the gains found last
        self.counts: list[confirm.Count] = []
        self._joined, self._counted = 0, 0  # trials; times
        self._known: worst_case.Screened | None = None

    def begin(self, gains: np.ndarray) -> None:
        """What is hardest for gains that are about right, (gains,), joins."""
        self.problem, _ = _harder_margins(self.problem, gains)
        if self._bands:
            counts = dict(zip(self._shares, self._count(gains), strict=True))
            self.problem = _with_bands(self.problem, {k: counts[k].band for k in self._bands})
        if self._every:
            hardest = _hardest(self.problem, *self._screened(gains))
            self._join(Joining(hardest, kept_by_every_trial(self.problem)))

    def harder(self, gains: np.ndarray, tell: Callable[[str], None]) -> bool:
        """Whether anything joins that gains (gains,) do not meet, and a round is left: the search then goes on."""
        if not (self._every or self._shares or self.problem.margins is not None):
            return False
        joining: list[Joining] = []
        nearer_loops, beyond = _harder_margins(self.problem, gains)
        if self._shares:  # each time on other trials, which those screened are not among
            tell("confirming on other trials")
            joining += self._confirmed(gains)
        if self._every and self._robust:
            tell("looking for the worst case")
            self.hardest = worst_case.hardest(self.problem, self._every, gains, self._screened(gains))
            if self.hardest.beyond and not self.hardest.unbounded:
                trial, counted = np.asarray([self.hardest.trial]), kept_by_every_trial(self.problem)
                joining.append(Joining(trial, counted, self.hardest.coordinates))
        elif self._every:
            self._known = self._screened(gains)
            if np.any(self._known[1] > 1.0):
                joining.append(Joining(_hardest(self.problem, *self._known), kept_by_every_trial(self.problem)))
        if not (joining or beyond) or self.count == ROUNDS:
            return False
        self.problem = nearer_loops if beyond else self.problem
        for more in joining:
            self._join(more)
        self.hardest = None  # it was the worst case of gains that are searched on from
        self.count += 1
        return True

    def judge(self, gains: np.ndarray, tell: Callable[[str], None]) -> None:
        """Look for the worst case of the gains found in the end, (gains,), where that is not known already."""
        if self._every and self.hardest is None:
            tell("looking for the worst case")
            self.hardest = worst_case.hardest(self.problem, self._every, gains, self._known)

    def _screened(self, gains: np.ndarray) -> worst_case.Screened:
        self._evaluate.rollouts += worst_case.SCREENED
        return worst_case.screen(self.problem, self._every, gains)

    def _count(self, gains: np.ndarray) -> list[confirm.Count]:
        """Count, each time on other trials."""
        first = self.problem.averaged + worst_case.SCREENED
        counts = confirm.count(self.problem, list(self._shares.values()), gains, first, self._counted)
        self._counted += 1
        self._evaluate.rollouts += counts[0].trials
        return counts

    def _confirmed(self, gains: np.ndarray) -> list[Joining]:
        """Trials that join since more of those counted break a limit than may."""
        self.counts = self._count(gains)
        rows = np.arange(len(self.problem.metrics))
        return [
            Joining(one.harder[:HARDEST], rows == k)
            for k, one in zip(self._shares, self.counts, strict=True)
            if not one.held
        ]

    def _join(self, more: Joining) -> None:
        at = self._places[(self._joined + np.arange(more.trials.size)) % self._places.size]
        self.problem = _add(self.problem, at, more)
        self._joined += more.trials.size


def _with_room(problem: Problem, places: int) -> Problem:
    """The problem with so many places more, which hold the first trial again until others join."""
    return with_trials(problem, np.repeat(np.asarray(problem.trials)[:1], places))


def _harder_margins(problem: Problem, gains: np.ndarray) -> tuple[Problem, bool]:
    """The problem with the loops whose margins are least by these gains, and whether one of them breaks a limit."""
    if problem.margins is None:
        return problem, False
    asked, near = margin_rows.hardest(problem.margins, gains)
    return replace(problem, margins=asked), near > 1.0


def _add(problem: Problem, at: np.ndarray, more: Joining) -> Problem:
    """The problem with more trials, in these places."""
    placed = _placed(problem, at, more.trials, more.coordinates)
    return replace(placed, counted=replaced(placed.counted, np.s_[:, at], more.counted[:, None]))


def _with_bands(problem: Problem, bands: Mapping[int, np.ndarray]) -> Problem:
    """The problem with limits, by their rows, kept among these trials in its last places, not by the averaged ones."""
    for turn, (row, band) in enumerate(bands.items(), start=1):
        at = problem.trials.size - turn * BAND + np.arange(band.size)
        problem = _placed(problem, at, band)
        problem = replace(
            problem,
            among=replaced(problem.among, np.s_[row, at], True),
            counted=replaced(problem.counted, np.s_[row, : problem.averaged], False),
        )
    return problem


def _placed(
    problem: Problem, at: np.ndarray, trials: np.ndarray, coordinates: Mapping[str, list[float]] | None = None
) -> Problem:
    """The problem with other trials in these places; coordinates: of a single one, where they are not its own."""
    if coordinates is None:
        own = coordinates_of(problem.dispersion, int(problem.seed), trials)
    else:
        own = {name: np.asarray(v)[None] for name, v in coordinates.items()}
    return replace(
        problem,
        trials=replaced(problem.trials, at, trials),
        coordinates={name: replaced(v, at, own[name]) for name, v in problem.coordinates.items()},
    )


def _hardest(problem: Problem, trials: np.ndarray, ratio: np.ndarray) -> np.ndarray:
    """The screened trials that come nearest to a limit and are not in the problem yet."""
    known = set(np.asarray(problem.trials).tolist())
    return np.asarray([t for t in trials[np.argsort(-ratio)] if int(t) not in known][:HARDEST], dtype=np.uint32)
