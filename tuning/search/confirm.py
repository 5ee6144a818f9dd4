"""Whether a limit for a share of the trials will hold: counted on trials that no search has seen, as it is judged."""

import bisect
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ptsmc_jax.simulation.requirements import Requirement, fewest_trials, must_keep, over
from tuning.search import flights
from tuning.search.objective import Problem

FRESH = 1000  # trials on which gains are judged, at least
FEWEST, TIMES = 4096, 8  # trials to count on: this many, and so many times what the gains are judged on
SHOWN = 2  # times the fewest trials that can show a quantile: some may then break its limit
SURE = 0.98  # probability that gains which are confirmed are met by the verdict
FARTHER, NEARER = 16, 8  # trials of a band: so many of those that may break a limit, at most, and of those that may not


@dataclass(frozen=True)
class Count:
    """How many of the trials counted on break a requirement."""

    metric: str
    trials: int
    beyond: int
    allowed: int | None  # of them; None: even with none the verdict would not be sure
    probability: float  # that the verdict on fresh trials is met
    harder: np.ndarray  # trials beyond the limit but for the `allowed` farthest, the farthest of these first
    band: np.ndarray  # trials about the last that may break it, within the limit or not, see `may_break`

    @property
    def held(self) -> bool:
        """Whether the requirement is confirmed."""
        return self.allowed is not None and self.beyond <= self.allowed


def fresh_trials(requirements: Sequence[Requirement]) -> int:
    """Trials to judge on: enough to show every quantile that is asked for, with some beyond the limit."""
    needed = [fewest_trials(r.quantile, r.confidence) for r in requirements if r.quantile and r.confidence]
    return max([FRESH, *(SHOWN * count for count in needed)])


def counted_on(requirements: Sequence[Requirement]) -> int:
    """Trials to count on."""
    return max(FEWEST, TIMES * fresh_trials(requirements))


def may_break(requirement: Requirement, requirements: Sequence[Requirement], trials: int) -> tuple[int | None, bool]:
    """How many of the trials that a limit is kept among may break it, and whether these are a band.

    None of a limit on every trial. Training trials show a share themselves where there are `SHOWN` times the fewest
    that can: with the fewest every single one would have to keep the limit, 99 % with 95 % takes 299. Where there are
    fewer than that, those in the `band` of a count stand for all that are counted on.
    """
    quantile, confidence = requirement.quantile, requirement.confidence
    if quantile is None:
        return None, False
    if confidence is None or trials >= SHOWN * fewest_trials(quantile, confidence):
        least = must_keep(trials, quantile, confidence)
        assert least is not None
        return trials - least, False
    return min(FARTHER, allowed(requirement, fresh_trials(requirements), counted_on(requirements)) or 0), True


def probability(requirement: Requirement, fresh: int, trials: int, beyond: int) -> float:
    """Probability that a verdict on `fresh` trials is met where `beyond` of `trials` others break the limit.

    Beta-binomial: the share is known by the count, with a uniform prior (Gelman and others, Bayesian Data Analysis,
    2013, 2.4).
    """
    from scipy.stats import betabinom  # takes a while to import, which most runs need not wait for

    least = must_keep(fresh, requirement.quantile, requirement.confidence)
    return 0.0 if least is None else float(betabinom.cdf(fresh - least, fresh, beyond + 1, trials - beyond + 1))


def allowed(requirement: Requirement, fresh: int, trials: int) -> int | None:
    """How many of `trials` may break the limit for the verdict on `fresh` others to be met with `SURE`."""
    too_many = bisect.bisect_left(
        range(trials), True, key=lambda beyond: probability(requirement, fresh, trials, beyond) < SURE
    )
    return too_many - 1 if too_many else None


def count(
    problem: Problem, requirements: Sequence[Requirement], gains: np.ndarray, first: int, turn: int
) -> list[Count]:
    """Fly gains (gains,) on trials from number `first` on, others each turn, and count those beyond each limit."""
    fresh, many = fresh_trials(requirements), counted_on(requirements)
    numbers = (first + turn * many + np.arange(many)).astype(np.uint32)
    flown = flights.trials(problem.others(numbers), gains)
    counts = []
    for requirement in requirements:
        values = np.where(flown.finished, getattr(flown.metrics, requirement.metric), np.inf)
        ratio = over(np.where(np.isnan(values), np.inf, values), requirement.limit, at_least=False)
        farthest_first = numbers[np.argsort(-ratio, kind="stable")]
        beyond = int(np.sum(ratio > 1.0))
        most = allowed(requirement, fresh, many)
        last = most or 0
        counts.append(
            Count(
                metric=requirement.metric,
                trials=many,
                beyond=beyond,
                allowed=most,
                probability=probability(requirement, fresh, many, beyond),
                harder=farthest_first[last:beyond],
                band=farthest_first[max(0, last - FARTHER) : last + NEARER],
            )
        )
    return counts
