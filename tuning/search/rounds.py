"""Rounds of a search: after each search, trials and loops that violate a requirement join the constraints.

Read `Rounds` first.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ptsmc_jax.simulation.requirements import Requirement
from tuning.search import confirm, margin_rows
from tuning.search import worst as worst_case
from tuning.search.evaluate import Evaluator
from tuning.search.objective import Problem, coordinates_of, kept_by_every_trial, replace_entries, with_trials
from tuning.search.worst import Hardest

MARGIN = 0.03  # relative tightening of limits in the search: held-out trials can be harder than all screened trials
SURE_MARGIN = 0.003  # `MARGIN` if no trial can be harder: with a search for the worst case, or without dispersions
HARDEST = 8  # number of worst screened trials that join the constraints
SPARE_SLOTS = 8  # slots for trials of later rounds: another number of trials would need another compilation
BAND_SIZE = confirm.BAND_MAY_BREAK + confirm.BAND_MUST_KEEP  # number of trials in a band, see `confirm`
ROUNDS = 6  # largest number of searches that are repeated with harder trials


@dataclass(frozen=True)
class Joining:
    """Trials that join the constraints."""

    trials: np.ndarray  # (trials,) numbers that select the noise and the dispersions
    counted: np.ndarray  # (requirements,) bool: the limits that these trials must keep
    coordinates: dict[str, list[float]] | None = None  # dispersions of a single trial, if moved by `worst.find_hardest`


class Rounds:
    """A tuning problem whose constraints grow from round to round.

    The hardest few trials decide a limit on every trial, and the training trials need not contain them. The hardest of
    many screened trials therefore join the constraints after a first short search. They join again after each search
    whose gains break the limit in some screened trial. After a robust search, the worst case inside the support of the
    dispersions joins instead.

    A limit on a fraction of the trials is confirmed on other trials after each search. If too many of these trials
    break it, the worst trials that must keep it join. If the training trials are too few to represent the fraction, a
    band joins first. A band consists of the confirmation trials ranked around the last trial that may break the limit.
    """

    def __init__(self, evaluate: Evaluator, problem: Problem, requirements: Sequence[Requirement], *, robust: bool):
        """Reserve slots for the trials that will join.

        Args:
            evaluate: counts the rollouts.
            problem: the tuning problem with the training trials.
            requirements: the requirements of its limits.
            robust: search for the worst case after each search, instead of screening.
        """
        self._evaluate, self._robust = evaluate, robust
        on_every_trial = [r for r in requirements if r.quantile is None]
        self._on_every_trial = on_every_trial if problem.dispersion.varies else []  # requirements on every trial
        several, quantile_sample = problem.trials.size > 1, np.asarray(problem.quantile_sample)
        # requirements on a fraction of the trials by their rows in the problem, and the rows with a band
        self._quantiles = {k: r for k, r in enumerate(requirements) if r.quantile is not None and several}
        self._bands = [k for k in self._quantiles if not quantile_sample[k].any()]
        self.margin = SURE_MARGIN if (robust and self._on_every_trial) or not several else MARGIN
        # number of limits that can add their hardest trials in a round
        limits = bool(self._on_every_trial) + len(self._quantiles)
        before = problem.trials.size
        if limits:
            problem = _add_slots(problem, limits * HARDEST + SPARE_SLOTS)
        # slots of trials that join; the last ones hold trials that joined in an earlier search of the problem
        self._slots = np.r_[before : problem.trials.size, problem.averaged : before]
        self.problem = _add_slots(problem, len(self._bands) * BAND_SIZE)
        self.count = 0  # number of rounds that have added harder trials or loops
        self.hardest: Hardest | None = None  # worst case of the gains of the last search
        self.counts: list[confirm.Count] = []  # violations that the last confirmation counted
        self._joined = 0  # number of trials that have joined the constraints
        self._confirmations = 0  # number of calls of `confirm.count_violations`; each one simulates other trials
        self._screening: worst_case.Screened | None = None  # screened trials of the last gains

    def begin(self, gains: np.ndarray) -> None:
        """Add the hardest trials and loops for approximate gains, (gains,), to the constraints."""
        self.problem, _ = _select_worst_loops(self.problem, gains)
        if self._bands:
            counts = dict(zip(self._quantiles, self._count_violations(gains), strict=True))
            self.problem = _with_bands(self.problem, {k: counts[k].band for k in self._bands})
        if self._on_every_trial:
            hardest = _select_hardest(self.problem, *self._screen(gains))
            self._join(Joining(hardest, kept_by_every_trial(self.problem)))

    def add_harder_trials(self, gains: np.ndarray, announce: Callable[[str], None]) -> bool:
        """Add trials and loops that violate a requirement, if a round is left. The search then continues.

        Args:
            gains: (gains,) the gains of the last search.
            announce: is called with the name of each step.

        Returns:
            Whether anything was added.
        """
        if not (self._on_every_trial or self._quantiles or self.problem.margins is not None):
            return False
        joining: list[Joining] = []
        with_worst_loops, loops_break_limits = _select_worst_loops(self.problem, gains)
        if self._quantiles:  # each confirmation uses new trials, which were not screened
            announce("confirming on other trials")
            self.counts = self._count_violations(gains)
            rows = np.arange(len(self.problem.metrics))
            joining += [  # the worst violators of each requirement whose confirmation failed
                Joining(one.surplus_violators[:HARDEST], rows == k)
                for k, one in zip(self._quantiles, self.counts, strict=True)
                if not one.confirmed
            ]
        if self._on_every_trial and self._robust:
            announce("looking for the worst case")
            self.hardest = worst_case.find_hardest(self.problem, self._on_every_trial, gains, self._screen(gains))
            if self.hardest.breaks_limit and not self.hardest.unbounded:
                trial, counted = np.asarray([self.hardest.trial]), kept_by_every_trial(self.problem)
                joining.append(Joining(trial, counted, self.hardest.coordinates))
        elif self._on_every_trial:
            self._screening = self._screen(gains)
            if np.any(self._screening[1] > 1.0):
                joining.append(
                    Joining(_select_hardest(self.problem, *self._screening), kept_by_every_trial(self.problem))
                )
        if not (joining or loops_break_limits) or self.count == ROUNDS:
            return False
        self.problem = with_worst_loops if loops_break_limits else self.problem
        for trials in joining:
            self._join(trials)
        self.hardest = None  # the next search replaces the gains of this worst case
        self.count += 1
        return True

    def find_worst_case(self, gains: np.ndarray, announce: Callable[[str], None]) -> None:
        """Find the worst case of the final gains, unless it is already known.

        Args:
            gains: (gains,) the final gains.
            announce: is called with the name of the step.
        """
        if self._on_every_trial and self.hardest is None:
            announce("worst case of the gains found")
            self.hardest = worst_case.find_hardest(self.problem, self._on_every_trial, gains, self._screening)

    def _screen(self, gains: np.ndarray) -> worst_case.Screened:
        """Return the screened trials for gains (gains,), see `worst.screen`, and count the rollouts."""
        self._evaluate.rollouts += worst_case.SCREENED
        return worst_case.screen(self.problem, self._on_every_trial, gains)

    def _count_violations(self, gains: np.ndarray) -> list[confirm.Count]:
        """Count the trials beyond each limit on a fraction of the trials. Each call simulates other trials.

        Returns:
            A count for each of these limits, in the order of their rows in the problem.
        """
        first = self.problem.averaged + worst_case.SCREENED
        counts = confirm.count_violations(
            self.problem, list(self._quantiles.values()), gains, first, self._confirmations
        )
        self._confirmations += 1
        self._evaluate.rollouts += counts[0].trials
        return counts

    def _join(self, joining: Joining) -> None:
        """Put trials into the next slots of the problem. If all slots are full, they replace the oldest trials."""
        slots = self._slots[(self._joined + np.arange(joining.trials.size)) % self._slots.size]
        self.problem = _fill_slots(self.problem, slots, joining)
        self._joined += joining.trials.size


def _add_slots(problem: Problem, slots: int) -> Problem:
    """Return the problem with additional slots. They repeat the first trial until other trials join."""
    return with_trials(problem, np.repeat(np.asarray(problem.trials)[:1], slots))


def _select_worst_loops(problem: Problem, gains: np.ndarray) -> tuple[Problem, bool]:
    """Return the problem with the loops that have the worst margins, and whether one of them breaks a limit."""
    if problem.margins is None:
        return problem, False
    worst, largest_ratio = margin_rows.select_hardest_trials(problem.margins, gains)
    return replace(problem, margins=worst), largest_ratio > 1.0


def _fill_slots(problem: Problem, slots: np.ndarray, joining: Joining) -> Problem:
    """Return the problem with more trials in these slots."""
    if joining.coordinates is None:
        added = coordinates_of(problem.dispersion, int(problem.seed), joining.trials)
    else:
        added = {name: np.asarray(v)[None] for name, v in joining.coordinates.items()}
    return replace(
        problem,
        trials=replace_entries(problem.trials, slots, joining.trials),
        coordinates={name: replace_entries(v, slots, added[name]) for name, v in problem.coordinates.items()},
        counted=replace_entries(problem.counted, np.s_[:, slots], joining.counted[:, None]),
    )


def _with_bands(problem: Problem, bands: Mapping[int, np.ndarray]) -> Problem:
    """Return the problem with limits that apply to bands of trials instead of to the averaged trials.

    The bands are in the last slots.

    Args:
        problem: the tuning problem.
        bands: numbers of the trials of a band, by the row of the limit.
    """
    for turn, (row, band) in enumerate(bands.items(), start=1):
        slots = problem.trials.size - turn * BAND_SIZE + np.arange(band.size)
        problem = _fill_slots(problem, slots, Joining(band, kept_by_every_trial(problem)))
        problem = replace(
            problem,
            quantile_sample=replace_entries(problem.quantile_sample, np.s_[row, slots], True),
            counted=replace_entries(problem.counted, np.s_[row, : problem.averaged], False),
        )
    return problem


def _select_hardest(problem: Problem, trials: np.ndarray, ratio: np.ndarray) -> np.ndarray:
    """Return the numbers of the screened trials with the largest violation ratios that are not in the problem yet.

    They are at most `HARDEST`, the worst first.
    """
    known = set(np.asarray(problem.trials).tolist())
    return np.asarray([t for t in trials[np.argsort(-ratio)] if int(t) not in known][:HARDEST], dtype=np.uint32)
