"""Limits for a share of the trials: what training calls met must be met on trials that it never saw."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import binom

from ptsmc_jax.campaigns import montecarlo
from ptsmc_jax.simulation.requirements import Requirement, must_keep
from tests import helpers
from tests.search.test_tuning import SPREAD, problem
from tuning.search import confirm, gains, objective, optimise, shares
from tuning.search.evaluate import Evaluator

SHOWN = Requirement("window_error", 1e-4, None, 0.99, 0.95)
SEEN = Requirement("window_error", 1e-4, None, 0.9, None)


@pytest.mark.parametrize("requirement", [SHOWN, SEEN])
@pytest.mark.parametrize("beyond", [0, 3, 30])
def test_probability_is_the_verdicts_over_shares_that_the_count_allows(requirement, beyond):
    """The share integrated out by brute force: Bayes with a uniform prior on a grid, then the verdict's binomial."""
    share = (np.arange(20_000) + 0.5) / 20_000
    weight = binom.pmf(beyond, 4096, share)
    least = must_keep(1000, requirement.quantile, requirement.confidence)
    assert least is not None
    most = 1000 - least
    expected = np.sum(weight * binom.cdf(most, 1000, share)) / np.sum(weight)
    # the grid's step of 5e-5 beside a share that is known to 2e-4: the midpoint rule leaves some 1e-3 of that
    np.testing.assert_allclose(confirm.probability(requirement, 1000, 4096, beyond), expected, rtol=2e-3)


@pytest.mark.parametrize("requirement", [SHOWN, SEEN, replace(SHOWN, quantile=0.9973, confidence=0.9)])
def test_what_is_allowed_is_the_most_that_is_sure(requirement):
    fresh = confirm.fresh_trials([requirement])
    trials = max(confirm.FEWEST, confirm.TIMES * fresh)
    most = confirm.allowed(requirement, fresh, trials)
    assert most is not None
    assert confirm.probability(requirement, fresh, trials, most) >= confirm.SURE
    assert confirm.probability(requirement, fresh, trials, most + 1) < confirm.SURE
    assert most < (1.0 - requirement.quantile) * trials  # fewer than the share itself: the verdict is a sample


def test_too_few_trials_are_never_sure():
    assert confirm.allowed(SHOWN, 1000, 20) is None


@pytest.mark.long
def test_a_share_that_training_keeps_is_kept_by_others(monkeypatch):
    """Eight easy training trials: gains that keep a limit in all of them break it in more than a tenth of others."""
    helpers.small_search(monkeypatch, fresh=200)
    limits = shares.Bounds(("eta", "delta"), (2.05, 0.2), (6.0, 4.0))
    limit, seed = 0.7, 2  # whose first eight angles lie within 100 degrees; others go up to 140
    wanted = [Requirement("peak_torque", limit, None, 0.9)]
    parts = problem(peak_torque=limit).parts
    some = replace(objective.problem(parts, SPREAD, seed, np.arange(8), limits.names, wanted), must_keep=(8,))
    found = optimise.search(Evaluator(limits), some, wanted, np.array([3.0, 0.5]), 2, 20, 1)
    (last,) = found.counts
    assert last.held
    assert found.rounds >= 1  # the first gains found were not confirmed
    at = gains.with_gains(parts, dict(zip(some.names, found.gains, strict=True)))
    others = montecarlo.run(at, SPREAD, 99, np.arange(2000))
    assert np.mean(others.metrics.peak_torque <= limit) >= 0.9
    # what joined must keep this limit, and is let off by no cut
    assert np.asarray(found.problem.counted)[0, 8:].any()
    _, c, _ = objective.measure(found.problem, helpers.vector(found.gains))
    assert np.asarray(c)[0].max() <= 0.0
