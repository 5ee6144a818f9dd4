"""Confidence intervals and sensitivities against SciPy, closed forms and simulated coverage."""

import math

import numpy as np
import pytest
from scipy import stats

from ptsmc_jax.numerics import statistics
from ptsmc_jax.simulation.requirements import fewest_trials, must_keep


@pytest.mark.parametrize(("successes", "trials"), [(0, 20), (3, 20), (20, 20), (2398, 2400), (999_999, 1_000_000)])
@pytest.mark.parametrize("confidence", [0.9, 0.95])
def test_fraction_interval_and_bound_equal_exact_binomial_test(successes, trials, confidence):
    low, high = statistics.fraction_interval(successes, trials, confidence)
    exact = stats.binomtest(successes, trials).proportion_ci(confidence, "exact")
    np.testing.assert_allclose((low, high), (exact.low, exact.high), rtol=1e-9)
    bound = stats.binomtest(successes, trials, alternative="greater").proportion_ci(confidence, "exact")
    np.testing.assert_allclose(statistics.fraction_bound(successes, trials, confidence), bound.low, rtol=1e-9)


def test_fewest_trials_equal_published_tables_and_one_fewer_is_not_enough():
    """The published numbers are for the quantile 99.73 % with 90 % confidence and 0, 1 and 2 failures."""
    assert [statistics.fewest_trials(k, 0.9973, 0.9) for k in range(3)] == [852, 1440, 1970]
    for quantile, confidence in ((0.9973, 0.9), (0.9, 0.95), (0.5, 0.5)):
        assert statistics.fewest_trials(0, quantile, confidence) == fewest_trials(quantile, confidence)
        for failures in (1, 7):
            n = statistics.fewest_trials(failures, quantile, confidence)
            assert must_keep(n, quantile, confidence) == n - failures
            fewer = must_keep(n - 1, quantile, confidence)
            assert fewer is None or fewer > n - 1 - failures


@pytest.mark.parametrize("quantile", [0.5, 0.9, 0.9973])
@pytest.mark.parametrize("n", [5, 100, 1000, 4000])
def test_quantile_interval_has_its_coverage_and_a_narrower_one_has_not(n, quantile):
    """With the ranks as values, the exact coverage of order statistics follows from the binomial distribution."""
    ranks = np.arange(1, n + 1, dtype=float)
    low, high = statistics.quantile_interval(ranks, quantile, 0.95)
    below = 0.0 if low == -np.inf else stats.binom.cdf(low - 1, n, quantile)  # P(lower bound above the quantile)
    above = 0.0 if high == np.inf else stats.binom.sf(high - 1, n, quantile)  # P(upper bound below it)
    assert below <= 0.025 + 1e-12
    assert above <= 0.025 + 1e-12
    assert stats.binom.cdf((0 if low == -np.inf else low), n, quantile) > 0.025 - 1e-12  # one rank further is too much
    assert high == np.inf or stats.binom.sf(high - 2, n, quantile) > 0.025 - 1e-12
    if n == 100 and quantile == 0.9973:
        assert high == np.inf  # too few trials for an upper bound


def test_sample_quantile_is_an_observed_value():
    ordered = np.arange(1.0, 11.0)
    assert [statistics.sample_quantile(ordered, q) for q in (0.05, 0.1, 0.11, 0.5, 0.9, 0.9973, 1.0)] == [
        1,
        1,
        2,
        5,
        9,
        10,
        10,
    ]
    assert statistics.sample_quantile(np.array([1.0, np.inf]), 0.9) == np.inf  # a trial without a value is infinite


def test_sensitivities_of_a_linear_metric_equal_closed_forms():
    """For a sum of normal inputs, the first-order Sobol indices are close to the squared correlations.

    Constant inputs are left out, and a constant metric has no sensitivities. An even metric has a Sobol index without a
    rank correlation.
    """
    rng, n = np.random.default_rng(1), 60_000
    x, y, z = rng.normal(size=(3, n))
    found = statistics.drivers({"x": x, "y": y, "z": z, "same": np.ones(n)}, 3.0 * x + y)
    assert list(found) == ["x", "y", "z"]
    # rank correlation: 6/pi asin(rho/2), Pearson (1907); sampling errors are below 1/sqrt(n) = 0.004
    for name, rho in (("x", 3 / math.sqrt(10)), ("y", 1 / math.sqrt(10)), ("z", 0.0)):
        assert found[name]["rank_correlation"] == pytest.approx(6 / math.pi * math.asin(rho / 2), abs=0.016)
    assert found["x"]["first_order"] == pytest.approx(0.89, abs=0.02)
    assert found["y"]["first_order"] == pytest.approx(0.09, abs=0.02)
    assert found["z"]["first_order"] < 0.004  # the expected value for an unrelated input, 31/60000, is subtracted
    # for 1280 trials that value is 31/1280 = 0.024
    unrelated = statistics.drivers({str(k): rng.normal(size=1280) for k in range(40)}, rng.normal(size=1280))
    assert np.mean([one["first_order"] for one in unrelated.values()]) < 0.01
    even = statistics.drivers({"x": x}, x**2)
    assert abs(even["x"]["rank_correlation"]) < 0.02  # the metric is an even function of x
    assert even["x"]["first_order"] > 0.98  # and of nothing else
    assert statistics.drivers({"x": x}, np.ones(n)) == {}


def test_most_extreme_lists_failed_trials_first_then_the_worst_values():
    values = np.array([1.0, np.nan, 5.0, 3.0, 9.0])
    failed = np.array([False, False, False, True, False])
    assert statistics.most_extreme(values, failed, 4).tolist() == [3, 1, 4, 2]
    assert statistics.most_extreme(values, failed, 4, larger_is_better=True).tolist() == [3, 1, 0, 2]


def test_upper_mean_bound_of_fractions_is_between_their_mean_and_1():
    """This also holds if nearly all numbers are 1, or differ from 0 or 1 by rounding errors."""
    few, off = np.append(np.ones(40), [0.5, 0.9]), np.append(np.ones(9), 1.0 + 2e-16)
    for fractions in (few, off, np.append(-1e-17, np.zeros(3)), np.full(9, 1.0 - 1e-13), np.ones(4), np.array([0.3])):
        for confidence in (0.5, 0.95, 0.999999):
            assert fractions.mean() <= statistics.mean_bound(fractions, confidence) <= 1.0 + 1e-15


def test_mean_bound_of_zeros_and_ones_equals_clopper_pearson():
    for ones, n, confidence in ((0, 852, 0.9), (0, 1109, 0.95), (3, 1000, 0.95), (60, 1000, 0.9)):
        fractions = np.zeros(n)
        fractions[:ones] = 1.0
        exact = stats.binomtest(n - ones, n, alternative="greater").proportion_ci(confidence, "exact").low
        np.testing.assert_allclose(statistics.mean_bound(fractions, confidence), 1.0 - exact, rtol=1e-9)
        near = statistics.mean_bound(fractions * (1.0 - 1e-9), confidence)  # computed by the saddlepoint formula
        assert near == pytest.approx(1.0 - exact, rel=4e-3)


# Number of zeros, and the other numbers as quantiles of a distribution. Few runs exceed a limit, some runs fail, or all
# runs exceed it for a short time or for half of the time.
FRACTIONS = {
    "few": (992, (np.arange(8) + 0.5) ** 2 / 64.0),
    "few for short, and two fail": (948, np.append(np.linspace(0.0, 0.01, 50), [1.0, 1.0])),
    "most for nearly nothing": (0, stats.beta.ppf((np.arange(30) + 0.5) / 30.0, 0.05, 2.0)),
    "all for about half": (0, stats.beta.ppf((np.arange(100) + 0.5) / 100.0, 2.0, 2.0)),
}


@pytest.mark.parametrize("case", FRACTIONS)
def test_mean_bound_equals_gaffke_quantile_of_random_weights(case):
    """The test also takes 1 minus the numbers. The sampling error of the hundred thousand weights is 0.0007."""
    (zeros, others), rng = FRACTIONS[case], np.random.default_rng(4)
    weights, of_zeros = rng.exponential(size=(100_000, others.size + 1)), rng.gamma(zeros, size=100_000)
    for zero, numbers in ((0.0, others), (1.0, 1.0 - others)):
        means = (of_zeros * zero + weights @ np.append(numbers, 1.0)) / (of_zeros + weights.sum(axis=1))
        found = statistics.mean_bound(np.append(np.full(zeros, zero), numbers), 0.95)
        assert 0.948 < np.mean(means <= found) < 0.953


SETS = 300  # the standard error of a coverage of 95 % is 1.3 %
# number of runs, random fractions of time beyond the limit, and their mean. The measured coverage with 10 000 sets is
# 95.5 to 100 % for the upper bound and 95.6 to 97.5 % for the lower bound
MEANS = {
    "a tenth of the runs, for any fraction of time": (600, lambda rng, n: (rng.random(n) < 0.1) * rng.random(n), 0.05),
    "few runs, for long": (1000, lambda rng, n: (rng.random(n) < 0.05) * rng.random(n) ** 3, 0.0125),
    "hardly any": (400, lambda rng, n: (rng.random(n) < 0.01) * rng.random(n), 0.005),
    "most for nearly nothing": (30, lambda rng, n: rng.beta(0.05, 2.0, n), 0.05 / 2.05),
    "every run, for about half": (1000, lambda rng, n: rng.beta(2.0, 2.0, n), 0.5),
    "short, and some fail": (200, lambda rng, n: np.maximum(rng.random(n) < 0.02, 0.2 * rng.random(n)), 0.118),
}


@pytest.mark.parametrize("case", MEANS)
def test_upper_and_lower_mean_bounds_have_their_coverage(case):
    """`mixed` requirements are verified by these bounds. Runs are independent; instants of one run are not."""
    runs, beyond, mean = MEANS[case]
    rng = np.random.default_rng(5)
    sets = [beyond(rng, runs) for _ in range(SETS)]
    assert np.mean([mean <= statistics.mean_bound(x, 0.95) for x in sets]) > 0.92
    assert np.mean([mean >= 1.0 - statistics.mean_bound(1.0 - x, 0.95) for x in sets]) > 0.92


def test_mean_bound_exceeds_the_student_bound_by_at_most_3_over_n():
    """After n runs without a failure, a failure probability of 3/n is still possible at 95 % confidence."""
    rng = np.random.default_rng(6)
    for runs in (300, 10_000):
        for fractions in (rng.beta(2.0, 2.0, runs), np.minimum(1.0, rng.exponential(0.01, runs))):
            students = fractions.mean() + stats.t.ppf(0.95, runs - 1) * fractions.std(ddof=1) / math.sqrt(runs)
            assert students < statistics.mean_bound(fractions, 0.95) < students + 3.0 / runs


@pytest.mark.parametrize("seed", range(5))
def test_percentiles_and_ranks_equal_scipy_stats(seed):
    rng = np.random.default_rng(seed)
    values = rng.integers(0, 20, rng.integers(1, 3000)).astype(float)
    for value in (-1.0, 3.0, 3.5, 30.0):
        expected = stats.percentileofscore(values, value, kind="rank")
        np.testing.assert_allclose(statistics.percentile(values, value), expected, rtol=1e-12)
    if np.ptp(values) > 0.0:
        np.testing.assert_allclose(statistics._ranks(values), stats.zscore(stats.rankdata(values)), atol=1e-12)


def test_sobol_index_is_significant_beyond_three_sigma_of_unrelated_inputs():
    """The standard deviation over 2000 permutations has an error of 2 %."""
    n, rng = 3200, np.random.default_rng(5)
    ranks = statistics._ranks(np.arange(float(n)))
    orders = (rng.permutation(ranks).reshape(statistics.SOBOL_BINS, -1) for _ in range(2000))
    sigma = np.std([np.mean(bins.mean(axis=1) ** 2) for bins in orders])
    for times, significant in ((2.75, False), (3.25, True)):
        driver = {"rank_correlation": 0.0, "first_order": times * sigma}
        assert (statistics.explained_variance(driver, n) > 0.0) == significant


@pytest.mark.parametrize("values", [2, 4])
def test_influential_category_is_detected_with_few_trials_and_an_unrelated_one_is_not(values):
    """The category shifts the metric by 1.2 standard deviations."""
    rng, detected, false = np.random.default_rng(1), 0, 0
    for _ in range(300):
        which, noise = rng.integers(0, values, 128).astype(float), rng.normal(size=128)
        moved, unrelated = (
            statistics.drivers({"which": which}, metric, categories=["which"])["which"]
            for metric in (noise + 1.2 * (which == 0.0), noise)
        )
        detected += statistics.explained_variance(moved, 128) > 0.0
        false += statistics.explained_variance(unrelated, 128) > 0.0
    assert detected > 0.95 * 300
    assert false <= 4  # 0.8 are expected


def test_inputs_that_rank_the_trials_alike_are_listed_as_one_driver():
    rng = np.random.default_rng(0)
    angle, other = rng.uniform(0.3, 2.4, 1000), rng.normal(size=1000)
    inputs = {"initial_angle": angle, "initial_q4": np.cos(angle / 2), "other": other}
    assert list(statistics.drivers(inputs, angle + other)) == ["initial_angle", "other"]
