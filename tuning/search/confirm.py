"""Confirmation of quantile requirements on trials that the search has not used.

The verdict is made later on held-out trials. `count_violations` simulates other trials and estimates the
probability that this verdict will be met. Read `count_violations` first.
"""

import bisect
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ptsmc_jax.simulation.requirements import Requirement, fewest_trials, must_keep, violation_ratio
from tuning.search import simulations
from tuning.search.objective import Problem

HELD_OUT = 1000  # smallest number of held-out trials of the verdict
FEWEST_TRIALS, FEWEST_RATIO = 4096, 8  # smallest number of confirmation trials: absolute, relative to held-out trials
SPARE_RATIO = 2  # ratio of trials to the fewest that can verify a quantile, so that some trials may break the limit
CONFIDENT = 0.98  # a requirement is confirmed if its verdict will be met with at least this probability
BAND_MAY_BREAK, BAND_MUST_KEEP = 16, 8  # trials in a band: at most 16 may break the limit, 8 must keep it


@dataclass(frozen=True)
class Count:
    """The number of confirmation trials that break a requirement."""

    metric: str
    trials: int
    violations: int
    allowed: int | None  # largest number of trials beyond the limit; None: too few trials to confirm the requirement
    probability: float  # probability that the verdict on held-out trials is met
    surplus_violators: np.ndarray  # trials beyond the limit except for the `allowed` worst, the worst first
    band: np.ndarray  # trials ranked around the last trial that may break the limit, see `allowed_in_training`

    @property
    def confirmed(self) -> bool:
        """Whether the requirement is confirmed."""
        return self.allowed is not None and self.violations <= self.allowed


def held_out_trials(requirements: Sequence[Requirement]) -> int:
    """Return the number of held-out trials: enough to verify every quantile with some trials beyond the limit."""
    needed = [fewest_trials(r.quantile, r.confidence) for r in requirements if r.quantile and r.confidence]
    return max([HELD_OUT, *(SPARE_RATIO * count for count in needed)])


def confirmation_trials(requirements: Sequence[Requirement]) -> int:
    """Return the number of confirmation trials."""
    return max(FEWEST_TRIALS, FEWEST_RATIO * held_out_trials(requirements))


def allowed_in_training(
    requirement: Requirement, requirements: Sequence[Requirement], trials: int
) -> tuple[int | None, bool]:
    """Return how many of the constrained trials may break a limit, and whether these trials are a band.

    The number is None if every trial must keep the limit. Training trials represent a quantile if there are
    `SPARE_RATIO` times the smallest number that can verify it. With this smallest number, every single trial would have
    to keep the limit: 299 trials for 99 % of the trials with 95 % confidence. With fewer training trials, the `band` of
    a count represents the confirmation trials.

    Args:
        requirement: the requirement with the limit.
        requirements: all requirements, which set the numbers of held-out and confirmation trials.
        trials: number of training trials.
    """
    quantile, confidence = requirement.quantile, requirement.confidence
    if quantile is None:
        return None, False
    if confidence is None or trials >= SPARE_RATIO * fewest_trials(quantile, confidence):
        least = must_keep(trials, quantile, confidence)
        assert least is not None
        return trials - least, False
    most = allowed_violations(requirement, held_out_trials(requirements), confirmation_trials(requirements))
    return min(BAND_MAY_BREAK, most or 0), True


def verdict_probability(requirement: Requirement, held_out: int, trials: int, violations: int) -> float:
    """Return the probability that a verdict on held-out trials is met, given a count on other trials.

    The distribution is beta-binomial with a uniform prior on the fraction of trials that break the limit (Gelman and
    others, Bayesian Data Analysis, 2013, section 2.4).

    Args:
        requirement: the requirement.
        held_out: number of held-out trials of the verdict.
        trials: number of counted trials.
        violations: number of counted trials that break the limit.
    """
    from scipy.stats import betabinom  # imported here because the import is slow and most runs do not need it

    least = must_keep(held_out, requirement.quantile, requirement.confidence)
    return (
        0.0
        if least is None
        else float(betabinom.cdf(held_out - least, held_out, violations + 1, trials - violations + 1))
    )


def allowed_violations(requirement: Requirement, held_out: int, trials: int) -> int | None:
    """Return how many counted trials may break a limit if the verdict is to be met with probability `CONFIDENT`.

    Args:
        requirement: the requirement.
        held_out: number of held-out trials of the verdict.
        trials: number of counted trials, which are simulated before the verdict.

    Returns:
        The number, or None if the requirement cannot be confirmed on so few trials.
    """
    too_many = bisect.bisect_left(
        range(trials),
        True,
        key=lambda violations: verdict_probability(requirement, held_out, trials, violations) < CONFIDENT,
    )
    return too_many - 1 if too_many else None


def count_violations(
    problem: Problem, requirements: Sequence[Requirement], gains: np.ndarray, first: int, turn: int
) -> list[Count]:
    """Simulate confirmation trials and count the trials that break each limit.

    Args:
        problem: the tuning problem.
        requirements: the quantile requirements.
        gains: (gains,) the gains to confirm.
        first: number of the first trial of the first confirmation.
        turn: number of earlier confirmations. Each confirmation simulates other trials.

    Returns:
        The count for each requirement.
    """
    held_out, number = held_out_trials(requirements), confirmation_trials(requirements)
    numbers = (first + turn * number + np.arange(number)).astype(np.uint32)
    simulated = simulations.simulate_trials(problem.batch_of(numbers), gains)
    counts = []
    for requirement in requirements:
        values = np.where(simulated.finished, getattr(simulated.metrics, requirement.metric), np.inf)
        ratio = violation_ratio(np.where(np.isnan(values), np.inf, values), requirement.limit, at_least=False)
        worst_first = numbers[np.argsort(-ratio, kind="stable")]
        violations = int(np.sum(ratio > 1.0))
        allowed = allowed_violations(requirement, held_out, number)
        first_kept = allowed or 0
        counts.append(
            Count(
                metric=requirement.metric,
                trials=number,
                violations=violations,
                allowed=allowed,
                probability=verdict_probability(requirement, held_out, number, violations),
                surplus_violators=worst_first[first_kept:violations],
                band=worst_first[max(0, first_kept - BAND_MAY_BREAK) : first_kept + BAND_MUST_KEEP],
            )
        )
    return counts
