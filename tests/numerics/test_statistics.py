import math

import numpy as np
import pytest
from scipy import stats

from ptsmc_jax.numerics import statistics
from ptsmc_jax.simulation.requirements import fewest_trials, least_within


@pytest.mark.parametrize(("successes", "trials"), [(0, 20), (3, 20), (20, 20), (2398, 2400), (999_999, 1_000_000)])
@pytest.mark.parametrize("confidence", [0.9, 0.95])
def test_share_intervals_are_those_of_the_exact_binomial_test(successes, trials, confidence):
    low, high = statistics.share_interval(successes, trials, confidence)
    exact = stats.binomtest(successes, trials).proportion_ci(confidence, "exact")
    np.testing.assert_allclose((low, high), (exact.low, exact.high), rtol=1e-9)
    bound = stats.binomtest(successes, trials, alternative="greater").proportion_ci(confidence, "exact")
    np.testing.assert_allclose(statistics.share_bound(successes, trials, confidence), bound.low, rtol=1e-9)


def test_the_fewest_trials_are_those_of_the_tables():
    """99.73 % at 90 %: 852 trials without a failure, 1 440 with one, 1 970 with two; and one fewer would not do."""
    assert [statistics.fewest_for(k, 0.9973, 0.9) for k in range(3)] == [852, 1440, 1970]
    for quantile, confidence in ((0.9973, 0.9), (0.9, 0.95), (0.5, 0.5)):
        assert statistics.fewest_for(0, quantile, confidence) == fewest_trials(quantile, confidence)
        for failures in (1, 7):
            n = statistics.fewest_for(failures, quantile, confidence)
            assert least_within(n, quantile, confidence) == n - failures
            fewer = least_within(n - 1, quantile, confidence)
            assert fewer is None or fewer > n - 1 - failures


@pytest.mark.parametrize("quantile", [0.5, 0.9, 0.9973])
@pytest.mark.parametrize("n", [5, 100, 1000, 4000])
def test_quantile_intervals_cover_as_they_say_and_no_narrower_ones_would(n, quantile):
    """Of the ranks themselves: P(l-th smallest <= quantile <= u-th), exactly, from the binomial law."""
    ranks = np.arange(1, n + 1, dtype=float)
    low, high = statistics.quantile_interval(ranks, quantile, 0.95)
    below = 0.0 if low == -np.inf else stats.binom.cdf(low - 1, n, quantile)  # the l-th lies above the quantile
    above = 0.0 if high == np.inf else stats.binom.sf(high - 1, n, quantile)  # the u-th lies below it
    assert below <= 0.025 + 1e-12
    assert above <= 0.025 + 1e-12
    assert stats.binom.cdf((0 if low == -np.inf else low), n, quantile) > 0.025 - 1e-12  # one rank on, too often
    assert high == np.inf or stats.binom.sf(high - 2, n, quantile) > 0.025 - 1e-12
    if n == 100 and quantile == 0.9973:
        assert high == np.inf  # so few trials bound it on no side


def test_quantiles_are_observed_values():
    ordered = np.arange(1.0, 11.0)
    assert [statistics.value_at(ordered, q) for q in (0.05, 0.1, 0.11, 0.5, 0.9, 0.9973, 1.0)] == [
        1,
        1,
        2,
        5,
        9,
        10,
        10,
    ]
    assert statistics.value_at(np.array([1.0, np.inf]), 0.9) == np.inf  # a trial without a value is beyond all


def test_drivers_are_found_and_shared_out():
    """Ranks of a sum of normal numbers: first-order shares of its variance close to the squared correlations."""
    rng, n = np.random.default_rng(1), 60_000
    x, y, z = rng.normal(size=(3, n))
    found = statistics.drivers({"x": x, "y": y, "z": z, "same": np.ones(n)}, 3.0 * x + y)
    assert list(found) == ["x", "y", "z"]
    # of ranks: 6/pi asin(rho/2), Pearson (1907); sampling errors below 1/sqrt(n) = 0.004
    for name, rho in (("x", 3 / math.sqrt(10)), ("y", 1 / math.sqrt(10)), ("z", 0.0)):
        assert found[name]["rank_correlation"] == pytest.approx(6 / math.pi * math.asin(rho / 2), abs=0.016)
    assert found["x"]["first_order"] == pytest.approx(0.89, abs=0.02)
    assert found["y"]["first_order"] == pytest.approx(0.09, abs=0.02)
    assert found["z"]["first_order"] < 0.004  # chance alone would show 31 of 60 000 bins' worth, which is taken off
    # with few trials a bin chance alone would show 31/1280 = 0.024 of the variance, on average
    chance = statistics.drivers({str(k): rng.normal(size=1280) for k in range(40)}, rng.normal(size=1280))
    assert np.mean([one["first_order"] for one in chance.values()]) < 0.01
    even = statistics.drivers({"x": x}, x**2)
    assert abs(even["x"]["rank_correlation"]) < 0.02  # it sees no direction
    assert even["x"]["first_order"] > 0.98  # but nothing else drives it
    assert statistics.drivers({"x": x}, np.ones(n)) == {}


def test_the_worst_come_first_failed_ones_before_all():
    values = np.array([1.0, np.nan, 5.0, 3.0, 9.0])
    failed = np.array([False, False, False, True, False])
    assert statistics.most_extreme(values, failed, 4).tolist() == [3, 1, 4, 2]
