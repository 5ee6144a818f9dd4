import math

import numpy as np
import pytest
from scipy import stats

from ptsmc_jax.numerics import statistics
from ptsmc_jax.simulation.requirements import fewest_trials, must_keep


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
            assert must_keep(n, quantile, confidence) == n - failures
            fewer = must_keep(n - 1, quantile, confidence)
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


def test_the_bound_of_a_mean_of_shares_is_a_share():
    """Nearly all of them one: so far beyond the mean there is none."""
    assert statistics.mean_bound(np.append(np.ones(40), [0.5, 0.9]), 0.99) == 1.0


def test_the_bound_of_a_mean_is_clopper_and_pearsons_of_zeros_and_ones():
    for ones, n, confidence in ((0, 852, 0.9), (0, 1109, 0.95), (3, 1000, 0.95), (60, 1000, 0.9)):
        shares = np.zeros(n)
        shares[:ones] = 1.0
        exact = stats.binomtest(n - ones, n, alternative="greater").proportion_ci(confidence, "exact").low
        np.testing.assert_allclose(statistics.mean_bound(shares, confidence), 1.0 - exact, rtol=1e-9)
        # nearly ones, by the saddlepoint formula and, where there are many, by Hall's
        near = statistics.mean_bound(shares * (1.0 - 1e-9), confidence)
        assert near == pytest.approx(1.0 - exact, rel=4e-3 if ones < statistics.NEARLY_NORMAL else 0.03)


def test_the_bound_of_a_mean_is_the_quantile_that_it_says():
    """Gaffke's against a hundred thousand draws of its weights."""
    rng, n = np.random.default_rng(4), 1000
    some = rng.uniform(size=8) ** 2
    weights, rest = rng.exponential(size=(100_000, 9)), rng.gamma(n - 8, size=100_000)
    drawn = weights @ np.append(some, 1.0) / (weights.sum(axis=1) + rest)
    found = statistics.mean_bound(np.append(np.zeros(n - 8), some), 0.95)
    assert 0.948 < np.mean(drawn <= found) < 0.953  # sampling: 0.0007


SETS = 10_000  # of which 95 % have a standard error of 0.2 %
MEANS = {  # how many runs, how long each is beyond its limit, and the mean of that
    "a tenth of the runs, for any share": (600, lambda rng, size: (rng.random(size) < 0.1) * rng.random(size), 0.05),
    "every run, for a little": (300, lambda rng, size: rng.exponential(0.01, size), 0.01),
    "few runs, for long": (1000, lambda rng, size: (rng.random(size) < 0.05) * rng.random(size) ** 3, 0.0125),
}


@pytest.mark.parametrize("case", MEANS)
def test_bounds_of_a_mean_cover_as_often_as_they_say(case):
    """What `mixed` requirements are shown with: runs are independent, the moments of one are not."""
    runs, beyond, mean = MEANS[case]
    rng = np.random.default_rng(5)
    covers = [mean <= statistics.mean_bound(beyond(rng, runs), 0.95) for _ in range(SETS)]
    assert 0.94 < np.mean(covers) < 0.96


def test_bounds_of_a_mean_never_fall_short_where_few_runs_leave_the_limit():
    rng = np.random.default_rng(6)
    covers = [
        statistics.mean_bound((rng.random(400) < 0.01) * rng.random(400), 0.95) >= 0.005 for _ in range(SETS // 20)
    ]
    assert np.mean(covers) > 0.95


@pytest.mark.parametrize("quantile", [0.5, 0.9])
def test_intervals_of_shares_and_quantiles_cover_as_often_as_they_say(quantile):
    """What `ensemble` requirements are shown with, of 2 000 runs: never less, and hardly more, for counts are whole.

    How many runs keep a limit is binomial: what covers is added up, whatever a generator draws.
    """
    n = 2000
    chance = stats.binom.pmf(np.arange(n + 1), n, quantile)
    likely = [k for k in range(n + 1) if chance[k] > 1e-12]  # the others have less than 1e-8 together
    intervals = {k: statistics.share_interval(k, n, 0.95) for k in likely}
    assert 0.95 <= sum(chance[k] for k in likely if intervals[k][0] <= quantile <= intervals[k][1]) < 0.96
    assert 0.95 <= sum(chance[k] for k in likely if statistics.share_bound(k, n, 0.95) <= quantile) < 0.96
    low, high = statistics.quantile_interval(1.0 + np.arange(n), quantile, 0.95)  # the l-th and the u-th smallest
    assert 0.95 <= chance[int(low) : int(high)].sum() < 0.96
