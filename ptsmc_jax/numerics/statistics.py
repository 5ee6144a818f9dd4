"""Statistics of a campaign: confidence intervals of fractions, means and quantiles, and sensitivities to inputs.

A fraction is a binomial proportion, for example the fraction of trials that meet a requirement. Start with
`fraction_interval`, `quantile_interval` and `drivers`, the sensitivity of a metric to each dispersed input.
"""

import bisect
from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np
from scipy import special  # instead of `scipy.stats`, whose import takes half a second

MAX_TILT = 60.0  # largest exponential tilt of `_tilted_mean`; the mean then equals the largest or smallest value
SOBOL_BINS = 32  # bins of an input with equal numbers of trials
DUPLICATE_CORRELATION = 0.9999  # rank correlation above which two inputs are duplicates
MIN_EXPLAINED = 0.05  # fraction of the variance of a metric's ranks that an input must explain to be named in reports
SIGNIFICANCE = 0.0027  # probability of a normal number beyond three sigma, the level of the test of categories
ROUNDING = 1e-12  # largest difference of values that is a rounding error, divided by the largest value


def fraction_interval(successes: int, trials: int, confidence: float) -> tuple[float, float]:
    """Return the two-sided confidence interval of a fraction (Clopper and Pearson, Biometrika 26, 1934).

    Args:
        successes: number of trials that succeed.
        trials: number of trials.
        confidence: smallest coverage probability of the interval [-].

    Returns:
        Lower and upper bound [-].

    >>> low, high = fraction_interval(successes=997, trials=1000, confidence=0.95)
    >>> f"{low:.4f} {high:.4f}"
    '0.9913 0.9994'
    """
    one_sided = (1.0 + confidence) / 2.0
    return fraction_bound(successes, trials, one_sided), 1.0 - fraction_bound(trials - successes, trials, one_sided)


def fraction_bound(successes: int, trials: int, confidence: float) -> float:
    """Return the one-sided lower confidence bound of a fraction (Clopper and Pearson).

    It is the quantile 1 - confidence of the beta distribution with the parameters k and trials - k + 1.

    Args:
        successes: number k of trials that succeed.
        trials: number of trials.
        confidence: smallest coverage probability of the bound [-].

    Returns:
        The bound, from 0 to 1 [-].
    """
    return float(special.betaincinv(successes, trials - successes + 1, 1.0 - confidence)) if successes > 0 else 0.0


def mean_bound(fractions: np.ndarray, confidence: float) -> float:
    """Return the one-sided upper confidence bound of the mean of independent numbers (n,) from 0 to 1.

    The bound is Gaffke's (2005): the quantile of sum_i D_i x_i + D_(n+1), with D uniform on the simplex
    (Learned-Miller, Thomas, A New Confidence Interval for the Mean of a Bounded Random Variable, arXiv:1905.06208). Its
    coverage is not proven, but no violation is known. If all numbers are 0 or 1, it is the bound of Clopper and
    Pearson.

    The bound is at least about 3/n above the mean at 95 %, even if all numbers are small. Failures, which count as 1,
    may have a probability of 3/n without any of them among n runs, and a valid bound must allow for that.

    >>> f"{mean_bound(np.zeros(852), confidence=0.9):.6f} {1 - 0.1 ** (1 / 852):.6f}"
    '0.002699 0.002699'
    >>> f"{mean_bound(np.append(np.zeros(990), np.full(10, 0.3)), confidence=0.95):.4f}"
    '0.0065'
    """
    from scipy import optimize

    fractions = np.clip(fractions, 0.0, 1.0)  # rounding errors may put a fraction of time outside
    low = float(fractions.min())
    if low == 1.0:
        return 1.0
    # Shift and scale the numbers to a smallest of 0 and a largest of 1. The quantile is scaled back in the result.
    x, counts = np.unique(np.append((fractions - low) / (1.0 - low), 1.0), return_counts=True)
    if x.size == 2:
        return low + (1.0 - low) * (1.0 - fraction_bound(int(counts[0]), fractions.size, confidence))
    tilt: Any = optimize.brentq(
        lambda tilt: _tilted_mean(x, counts, tilt)[0] - confidence, -MAX_TILT, MAX_TILT, xtol=1e-10
    )
    return low + (1.0 - low) * _tilted_mean(x, counts, tilt)[1]


def _tilted_mean(x: np.ndarray, counts: np.ndarray, tilt: float) -> tuple[float, float]:
    """Return the probability that sum_i D_i x_i is below the tilted mean X, and X.

    X is the mean of x with the weights 1 / (1 - t x), where t = 1 - exp(-tilt). The D_i are exponential random numbers
    divided by their sum. So the probability is that of a negative sum of exponential numbers with the weights x - X. It
    is computed by the saddlepoint formula of Lugannani and Rice (Adv. Appl. Prob. 12, 1980), whose saddlepoint is known
    in closed form for this X. The approximation makes `mean_bound` at most 0.5 % too high.

    Args:
        x: distinct values, (values,), from 0 to 1.
        counts: how often each value occurs, (values,).
        tilt: 0 for the plain mean; positive tilts move X towards the largest value.
    """
    t, scale = -np.expm1(-tilt), (1.0 - x) + x * np.exp(-tilt)  # scale is 1 - t x
    total = np.sum(counts / scale)
    rest = np.sum(counts * (1.0 - x) / scale) / total  # rest is 1 - X
    weights = (rest - (1.0 - x)) / scale
    variance = np.sum(counts * weights**2)
    u = t * np.sqrt(variance)
    w = np.sign(t) * np.sqrt(max(0.0, 2.0 * np.sum(counts * np.log(scale * total / counts.sum()))))
    # Near the plain mean both terms tend to infinity. Their difference tends to a sixth of the skewness.
    correction = 1.0 / w - 1.0 / u if abs(u) > 0.01 else np.sum(counts * weights**3) / variance**1.5 / 3.0
    density = np.exp(-0.5 * w**2) / np.sqrt(2.0 * np.pi)
    return float(special.ndtr(w) + density * correction), float(1.0 - rest)


def percentile(values: np.ndarray, value: float) -> float:
    """Return the percentile rank of a value among all values (n,) [%]; equal values have their mean rank.

    With the mean rank, the nominal value that most rows of a run table have is no extreme.

    >>> percentile(np.array([1.0, 2.0, 3.0, 4.0]), 4.0), percentile(np.array([10.0, 10.0, 10.0, 10.0, 20.0]), 10.0)
    (100.0, 50.0)
    """
    below, equal = np.count_nonzero(values < value), np.count_nonzero(values == value)
    return float((below + (equal + 1) / 2 * (equal > 0)) / values.size * 100.0)


def quantile_interval(ordered: np.ndarray, quantile: float, confidence: float) -> tuple[float, float]:
    """Return the two-sided, distribution-free confidence interval of a quantile between two order statistics.

    The number B of values below the quantile is binomial. So the l-th smallest value is above the quantile with the
    probability P(B < l) (David and Nagaraja, Order Statistics, 2003, 7.1).

    Args:
        ordered: values (n,), ascending; infinite if a trial has no value.
        quantile: which quantile, from 0 to 1.
        confidence: smallest coverage probability of the interval [-].

    Returns:
        Lower and upper bound in the unit of the values. A bound is infinite if there are too few trials for it.
    """
    n, outside = ordered.size, (1.0 - confidence) / 2.0
    # the largest l with P(B < l) < outside, and the smallest u with P(B >= u) <= outside
    low = bisect.bisect_left(range(n), outside, key=lambda k: special.bdtr(k, n, quantile))
    high = bisect.bisect_left(range(n), True, key=lambda k: special.bdtrc(k, n, quantile) <= outside) + 1
    below = float(ordered[low - 1]) if low >= 1 else -np.inf
    return below, float(ordered[high - 1]) if high <= n else np.inf


def sample_quantile(ordered: np.ndarray, quantile: float) -> float:
    """Return a quantile of a sample: the smallest value that is at least as large as this fraction of the sample.

    Args:
        ordered: values (n,), ascending.
        quantile: which quantile, from 0 to 1.

    >>> sample_quantile(np.array([1.0, 2.0, 3.0, 4.0]), quantile=0.5)
    2.0
    """
    return float(ordered[max(0, int(np.ceil(quantile * ordered.size - 1e-9)) - 1)])


def drivers(
    inputs: Mapping[str, np.ndarray],
    metric: np.ndarray,
    ranked: dict[str, tuple] | None = None,
    categories: Collection[str] = (),
) -> dict[str, dict[str, Any]]:
    """Return the sensitivity of a metric to each input: the rank correlation and the first-order Sobol index.

    The rank correlation is Spearman's. The Sobol index is the fraction of the metric's variance that one input
    explains. It is estimated from the given trials (Plischke, Borgonovo, Smith, European J. Operational Research 226,
    2013): the variance of the metric's mean over `SOBOL_BINS` bins of the input, divided by the metric's variance,
    minus the expected value for an unrelated input. Both use the ranks of the metric, so that a long tail does not
    dominate.

    Args:
        inputs: values (trials,) by the name of the input. If several inputs order the trials equally, such as an angle
            and the scalar part of its quaternion, only the first one gets an entry.
        metric: values (trials,).
        ranked: cache of the ranks of the inputs; pass the same dict for other metrics of the same trials.
        categories: names of inputs without an order, such as the number of a wheel. The bins of such an input are its
            distinct values. Its Sobol index is 0 if it is not significant.

    Returns:
        {"rank_correlation": .., "first_order": ..} by the name of the input. The rank correlation of a category is
        None. The result is empty if the metric, or every input, is constant.
    """
    ranked = {} if ranked is None else ranked
    if metric.size < 4 * SOBOL_BINS or not has_variation(metric):
        return {}
    metric_ranks, effects = _ranks(metric), {}
    for name, values in inputs.items():
        if not has_variation(values):
            continue
        if name in categories:
            bins = [metric_ranks[values == category] for category in np.unique(values)]
            p_value = special.chdtrc(len(bins) - 1, metric.size * _variance_between(bins, metric.size))
            index = _first_order_index(bins, metric.size) if p_value < SIGNIFICANCE else 0.0
            effects[name] = {"rank_correlation": None, "first_order": index}
            continue
        if name not in ranked:
            ranks = _ranks(values)
            is_duplicate = any(
                abs(np.mean(ranks * other)) > DUPLICATE_CORRELATION for other, _ in filter(None, ranked.values())
            )
            ranked[name] = () if is_duplicate else (ranks, np.argsort(ranks, kind="stable"))
        if not ranked[name]:
            continue
        ranks, order = ranked[name]
        bins = np.array_split(metric_ranks[order], SOBOL_BINS)
        effects[name] = {
            "rank_correlation": float(np.mean(ranks * metric_ranks)),
            "first_order": _first_order_index(bins, metric.size),
        }
    return effects


def explained_variance(driver: Mapping[str, float | None], trials: int) -> float:
    """Return the fraction of the variance of a metric's ranks that one input explains; 0 if it is not significant.

    The fraction is the larger of the first-order index and the square of the rank correlation, which is the fraction
    that a linear function of the input's ranks explains. It is significant if one of the two sensitivities is beyond
    three sigma of the sensitivity to an unrelated input.

    Args:
        driver: one entry of the result of `drivers`. The index of a category is 0 if it is not significant.
        trials: number of trials.

    >>> weak = {"rank_correlation": 0.1, "first_order": 0.0}
    >>> explained_variance(weak, 300), round(explained_variance(weak, 3000), 6)
    (0.0, 0.01)
    """
    rank, index = driver["rank_correlation"], driver["first_order"] or 0.0
    if rank is None:
        return index
    significant = abs(rank) > 3.0 / np.sqrt(trials) or index > 3.0 * np.sqrt(2.0 * (SOBOL_BINS - 1)) / trials
    return max(index, rank**2) if significant else 0.0


def strongest_drivers(drivers: Mapping[str, Mapping[str, float | None]], trials: int) -> dict[str, float]:
    """Return the `explained_variance` of each input with at least `MIN_EXPLAINED`, the largest first.

    Args:
        drivers: result of the function `drivers`.
        trials: number of trials.

    >>> strongest_drivers({"x": {"rank_correlation": 0.5, "first_order": 0.2}}, 1000)
    {'x': 0.25}
    """
    explained = {name: explained_variance(driver, trials) for name, driver in drivers.items()}
    named = (name for name, fraction in explained.items() if fraction >= MIN_EXPLAINED)
    return {name: explained[name] for name in sorted(named, key=lambda name: -explained[name])}


def _first_order_index(bins: Sequence[np.ndarray], count: int) -> float:
    """Return the first-order Sobol index [-] of an input, at least 0.

    The index is the variance of the mean rank over the bins, minus its expected value for an unrelated input.

    Args:
        bins: ranks of the metric, with variance 1, in each bin of the input.
        count: number of all ranks.
    """
    between = _variance_between(bins, count)
    expected = (len(bins) - 1) / max(1, count - len(bins)) * (1.0 - between)
    return max(0.0, float(between - expected))


def _variance_between(bins: Sequence[np.ndarray], count: int) -> float:
    """Return the variance of the means of bins of `count` ranks.

    For unrelated bins, `count` times it is chi-squared.
    """
    return float(sum(part.size * part.mean() ** 2 for part in bins) / count)


def _ranks(values: np.ndarray) -> np.ndarray:
    """Return ranks (trials,) with mean 0 and variance 1. The mean of products of two is Spearman's correlation."""
    _, indices, counts = np.unique(values, return_inverse=True, return_counts=True)
    rank = (np.cumsum(counts) - (counts - 1) / 2)[indices]  # equal values have their mean rank
    return (rank - rank.mean()) / rank.std()


def has_variation(values: np.ndarray) -> bool:
    """Return whether values (trials,) differ by more than rounding errors.

    Angles with a dispersion from 100 to 100 deg, for example, differ by rounding errors only.

    >>> has_variation(np.array([1.7453292519943295, 1.7453292519943298])), has_variation(np.array([1.7453, 1.7454]))
    (False, True)
    """
    return bool(np.ptp(values) > ROUNDING * np.max(np.abs(values)))


def distinct_inputs(inputs: Mapping[str, np.ndarray]) -> list[str]:
    """Return the names of inputs without duplicates.

    An input is a duplicate if it orders the trials as an earlier input does, or in reverse order.

    Args:
        inputs: values (trials,) by the name of the input.

    >>> angle = np.array([0.1, 0.7, 0.4])
    >>> distinct_inputs(
    ...     {"initial_angle": angle, "initial_q4": np.cos(angle / 2), "initial_w1": np.array([2.0, 1.0, 3.0])}
    ... )
    ['initial_angle', 'initial_w1']
    """
    distinct_ranks: dict[str, np.ndarray] = {}
    for name, values in inputs.items():
        ranks = _ranks(values)
        if all(abs(np.mean(ranks * other)) <= DUPLICATE_CORRELATION for other in distinct_ranks.values()):
            distinct_ranks[name] = ranks
    return list(distinct_ranks)


def fewest_trials(failures: int, quantile: float, confidence: float) -> int:
    """Return the smallest number of trials that verifies a quantile requirement despite some failures.

    Args:
        failures: number of trials that fail.
        quantile: required fraction of successes, from 0 to 1.
        confidence: one-sided confidence of the verification [-].

    >>> [fewest_trials(failures, quantile=0.9973, confidence=0.9) for failures in (0, 1, 2)]
    [852, 1440, 1970]
    """

    def is_enough(trials: int) -> bool:
        return fraction_bound(trials - failures, trials, confidence) >= quantile

    upper = failures + 1
    while not is_enough(upper):
        upper *= 2
    return failures + 1 + bisect.bisect_left(range(failures + 1, upper), True, key=is_enough)


def most_extreme(values: np.ndarray, failed: np.ndarray, count: int, *, larger_is_better: bool = False) -> np.ndarray:
    """Return the indices of the worst trials: failed trials, then trials without a value, then by value.

    Args:
        values: values of a metric (trials,); NaN if a trial has no value.
        failed: whether each trial failed, (trials,).
        count: how many indices.
        larger_is_better: sort the smallest values first instead of the largest.

    Returns:
        Indices of at most `count` trials, the worst first.
    """
    badness = values if larger_is_better else -values
    return np.lexsort((badness, ~np.isnan(values), ~failed))[:count]
