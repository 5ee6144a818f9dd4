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
    assert statistics.most_extreme(values, failed, 4, larger_is_better=True).tolist() == [3, 1, 0, 2]


def test_the_bound_of_a_mean_of_shares_is_a_share():
    """And never below the mean, though nearly all of them are one, or off one or zero by rounding."""
    few, off = np.append(np.ones(40), [0.5, 0.9]), np.append(np.ones(9), 1.0 + 2e-16)
    for shares in (few, off, np.append(-1e-17, np.zeros(3)), np.full(9, 1.0 - 1e-13), np.ones(4), np.array([0.3])):
        for confidence in (0.5, 0.95, 0.999999):
            assert shares.mean() <= statistics.mean_bound(shares, confidence) <= 1.0 + 1e-15


def test_the_bound_of_a_mean_is_clopper_and_pearsons_of_zeros_and_ones():
    for ones, n, confidence in ((0, 852, 0.9), (0, 1109, 0.95), (3, 1000, 0.95), (60, 1000, 0.9)):
        shares = np.zeros(n)
        shares[:ones] = 1.0
        exact = stats.binomtest(n - ones, n, alternative="greater").proportion_ci(confidence, "exact").low
        np.testing.assert_allclose(statistics.mean_bound(shares, confidence), 1.0 - exact, rtol=1e-9)
        near = statistics.mean_bound(shares * (1.0 - 1e-9), confidence)  # by the saddlepoint formula
        assert near == pytest.approx(1.0 - exact, rel=4e-3)


def test_the_bound_of_a_mean_is_the_quantile_that_it_says():
    """Gaffke's against a hundred thousand draws of its weights."""
    rng, n = np.random.default_rng(4), 1000
    some = rng.uniform(size=8) ** 2
    weights, rest = rng.exponential(size=(100_000, 9)), rng.gamma(n - 8, size=100_000)
    drawn = weights @ np.append(some, 1.0) / (weights.sum(axis=1) + rest)
    found = statistics.mean_bound(np.append(np.zeros(n - 8), some), 0.95)
    assert 0.948 < np.mean(drawn <= found) < 0.953  # sampling: 0.0007


@pytest.mark.parametrize(("runs", "part", "small", "fails"), [
    (1000, 0.2, 0.01, 0.001), (1000, 0.05, 0.005, 0.002), (300, 1.0, 0.01, 0.003), (5000, 0.2, 0.005, 0.0002),
])  # fmt: skip
def test_bounds_of_a_mean_cover_runs_that_fail_rarely_among_many_short_excursions(runs, part, small, fails):
    """A part of the runs is beyond its limit for a share of up to 2 `small`; few fail, which counts as all the time.

    How many fail is binomial: what covers is added up. The short shares, whose mean varies by a tenth of what the
    failures' does, are at their quantiles. Hall's bound for a skew mean, 30 being positive, covers 59 to 86 %.
    """
    mean = (1.0 - fails) * part * small + fails
    short = np.zeros(runs)
    many = round(part * runs)
    short[-many:] = 2.0 * small * (np.arange(many) + 0.5) / many
    counts = np.arange(20)
    covers = [statistics.mean_bound(np.append(np.ones(k), short[k:]), 0.95) >= mean for k in counts]
    assert stats.binom.pmf(counts, runs, fails)[covers].sum() >= 0.95


SETS = 300  # of which 95 % have a standard error of 1.3 %
# how many runs, how long each is beyond its limit, and the mean of that; of 10 000 sets of each the bound from above
# covers (in order) 96.7, 97.6, 100, 100, 95.5, 97.5 %, and that from below 95.7, 95.7, 96.9, 97.5, 95.6, 96.7 %
MEANS = {
    "a tenth of the runs, for any share": (600, lambda rng, n: (rng.random(n) < 0.1) * rng.random(n), 0.05),
    "few runs, for long": (1000, lambda rng, n: (rng.random(n) < 0.05) * rng.random(n) ** 3, 0.0125),
    "hardly any": (400, lambda rng, n: (rng.random(n) < 0.01) * rng.random(n), 0.005),
    "most for nearly nothing": (30, lambda rng, n: rng.beta(0.05, 2.0, n), 0.05 / 2.05),
    "every run, for about half": (1000, lambda rng, n: rng.beta(2.0, 2.0, n), 0.5),
    "short, and some fail": (200, lambda rng, n: np.maximum(rng.random(n) < 0.02, 0.2 * rng.random(n)), 0.118),
}


@pytest.mark.parametrize("case", MEANS)
def test_bounds_of_a_mean_cover_at_least_as_often_as_they_say(case):
    """What `mixed` requirements are shown with, from above and from below: runs are independent, moments are not."""
    runs, beyond, mean = MEANS[case]
    rng = np.random.default_rng(5)
    sets = [beyond(rng, runs) for _ in range(SETS)]
    assert np.mean([mean <= statistics.mean_bound(x, 0.95) for x in sets]) > 0.92
    assert np.mean([mean >= 1.0 - statistics.mean_bound(1.0 - x, 0.95) for x in sets]) > 0.92


def test_bounds_of_a_mean_are_as_tight_as_failures_that_stay_unseen_allow():
    """Above Student's by no more than 3/n, which is what n runs without a failure leave open at 95 %."""
    rng = np.random.default_rng(6)
    for runs in (300, 10_000):
        for shares in (rng.beta(2.0, 2.0, runs), np.minimum(1.0, rng.exponential(0.01, runs))):
            students = shares.mean() + stats.t.ppf(0.95, runs - 1) * shares.std(ddof=1) / math.sqrt(runs)
            assert students < statistics.mean_bound(shares, 0.95) < students + 3.0 / runs


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


def test_one_of_equal_numbers_stands_in_their_middle():
    """In a plan that says 10 in nearly each row, 10 was named as the reason, "at 80 %"."""
    assert statistics.percentile(np.array([1.0, 2.0, 3.0, 4.0]), 4.0) == 100.0
    assert statistics.percentile(np.array([10.0, 10.0, 10.0, 10.0, np.inf]), 10.0) == 50.0


@pytest.mark.parametrize("seed", range(20))
def test_they_are_those_of_scipys_statistics(seed):
    """Which take half a second to import."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 3000))
    k, quantile, confidence = int(rng.integers(1, n + 1)), rng.uniform(), rng.uniform(0.5, 0.9999)
    bound = stats.beta.ppf(1.0 - confidence, k, n - k + 1)
    np.testing.assert_allclose(statistics.share_bound(k, n, confidence), bound, rtol=1e-12)
    low, high = (
        stats.binom.ppf((1.0 - confidence) / 2.0, n, quantile),
        stats.binom.isf((1.0 - confidence) / 2.0, n, quantile),
    )
    ends = np.concatenate([[-np.inf], np.arange(1.0, n + 1.0), [np.inf]])  # the l-th smallest is l
    assert statistics.quantile_interval(ends[1:-1], quantile, confidence) == (ends[int(low)], ends[int(high) + 1])
    values = rng.integers(0, 20, n).astype(float)
    for value in (-1.0, 3.0, 3.5, 30.0):
        expected = stats.percentileofscore(values, value, kind="rank")
        np.testing.assert_allclose(statistics.percentile(values, value), expected, rtol=1e-12)
    if np.ptp(values) > 0.0:
        np.testing.assert_allclose(statistics._ranks(values), stats.zscore(stats.rankdata(values)), atol=1e-12)


def test_a_share_of_the_variance_is_beyond_chance_from_three_sigma_of_unrelated_inputs_on():
    """Their spread over 2000 shuffles is known to 2 %."""
    n, rng = 3200, np.random.default_rng(5)
    ranks = statistics._ranks(np.arange(float(n)))
    orders = (rng.permutation(ranks).reshape(statistics.SOBOL_BINS, -1) for _ in range(2000))
    sigma = np.std([np.mean(bins.mean(axis=1) ** 2) for bins in orders])
    for times, told in ((2.75, False), (3.25, True)):
        driver = {"rank_correlation": 0.0, "first_order": times * sigma}
        assert statistics.beyond_chance(driver, n) == told


@pytest.mark.parametrize("values", [2, 4])
def test_a_category_that_moves_a_metric_is_told_among_few_trials_and_an_unrelated_one_is_not(values):
    """By 1.2 times what it spreads by itself; with the chance of 32 bins every second one of 4 was missed."""
    rng, told, false = np.random.default_rng(1), 0, 0
    for _ in range(300):
        which, noise = rng.integers(0, values, 128).astype(float), rng.normal(size=128)
        moved, unrelated = (
            statistics.drivers({"which": which}, metric, categories=["which"])["which"]
            for metric in (noise + 1.2 * (which == 0.0), noise)
        )
        told += statistics.beyond_chance(moved, 128)
        false += statistics.beyond_chance(unrelated, 128)
    assert told > 0.95 * 300
    assert false <= 4  # 0.8 are to be expected
