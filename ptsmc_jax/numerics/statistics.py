"""Statistics of a campaign: shares and quantiles with intervals, and which inputs drive a metric."""

import bisect
from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np
from scipy import special  # `scipy.stats` takes half a second to import

STEEPEST = 60.0  # tilt of a mean towards its largest values or its smallest, at which nothing else is left
SOBOL_BINS = 32  # of an input, with equally many trials each
SAME_INPUT = 0.9999  # rank correlation above which two inputs count as one
BY_CHANCE = 0.0027  # probability of what is taken for chance in a category: that of a normal number beyond three sigma
ROUNDING = 1e-12  # of the largest value: by how much values may differ that are one number


def share_interval(successes: int, trials: int, confidence: float) -> tuple[float, float]:
    """Two-sided interval of a share: Clopper and Pearson, Biometrika 26 (1934); at least as likely as `confidence`.

    >>> low, high = share_interval(successes=997, trials=1000, confidence=0.95)
    >>> f"{low:.4f} {high:.4f}"
    '0.9913 0.9994'
    """
    each = (1.0 + confidence) / 2.0
    return share_bound(successes, trials, each), 1.0 - share_bound(trials - successes, trials, each)


def share_bound(successes: int, trials: int, confidence: float) -> float:
    """One-sided lower bound of a share, beta(1 - confidence; k, trials - k + 1): Clopper and Pearson."""
    return float(special.betaincinv(successes, trials - successes + 1, 1.0 - confidence)) if successes > 0 else 0.0


def mean_bound(shares: np.ndarray, confidence: float) -> float:
    """One-sided upper bound of the mean of shares, (n,) independent numbers from 0 to 1.

    Gaffke's (2005), which has never been seen to cover less than it says: the quantile of sum D_i x_i + D_(n+1), D
    uniform on the simplex (Learned-Miller, Thomas, A New Confidence Interval for the Mean of a Bounded Random Variable,
    arXiv:1905.06208). Of zeros and ones it is Clopper and Pearson's. A run that fails counts as 1, however short the
    others are beyond their limit, and 3/n of such runs may stay unseen: the bound lies about as much above the mean
    even where all shares are small, which no bound avoids that covers rare failures.

    >>> f"{mean_bound(np.zeros(852), confidence=0.9):.6f} {1 - 0.1 ** (1 / 852):.6f}"
    '0.002699 0.002699'
    >>> f"{mean_bound(np.append(np.zeros(990), np.full(10, 0.3)), confidence=0.95):.4f}"
    '0.0065'
    """
    from scipy import optimize

    shares = np.clip(shares, 0.0, 1.0)  # a share of time may be a rounding error off
    low = float(shares.min())
    if low == 1.0:
        return 1.0
    # measured from the smallest, which the quantile of a weighted mean allows: zero and one are always among them
    x, counts = np.unique(np.append((shares - low) / (1.0 - low), 1.0), return_counts=True)
    if x.size == 2:
        return low + (1.0 - low) * (1.0 - share_bound(int(counts[0]), shares.size, confidence))
    tilt: Any = optimize.brentq(lambda tilt: _tilted(x, counts, tilt)[0] - confidence, -STEEPEST, STEEPEST, xtol=1e-10)
    return low + (1.0 - low) * _tilted(x, counts, tilt)[1]


def _tilted(x: np.ndarray, counts: np.ndarray, tilt: float) -> tuple[float, float]:
    """Chance that sum D_i x_i is below a mean X, and this mean: of x, weighted by 1 / (1 - t x), t = 1 - exp(-tilt).

    x, counts: (values,) from 0 to 1, and how often each is there. The D are exponential numbers over their sum: it is
    the chance that their sum with weights x - X is negative, by the saddlepoint formula of Lugannani and Rice (Adv.
    Appl. Prob. 12, 1980). Its saddlepoint has this X in closed form. It puts the bound at most 0.5 % too high.
    """
    t, scale = -np.expm1(-tilt), (1.0 - x) + x * np.exp(-tilt)  # 1 - t x
    total = np.sum(counts / scale)
    rest = np.sum(counts * (1.0 - x) / scale) / total  # 1 - X
    weights = (rest - (1.0 - x)) / scale
    variance = np.sum(counts * weights**2)
    u = t * np.sqrt(variance)
    w = np.sign(t) * np.sqrt(max(0.0, 2.0 * np.sum(counts * np.log(scale * total / counts.sum()))))
    # at the mean, where both terms grow without end, their difference is a sixth of the skewness
    between = 1.0 / w - 1.0 / u if abs(u) > 0.01 else np.sum(counts * weights**3) / variance**1.5 / 3.0
    density = np.exp(-0.5 * w**2) / np.sqrt(2.0 * np.pi)
    return float(special.ndtr(w) + density * between), float(1.0 - rest)


def percentile(values: np.ndarray, value: float) -> float:
    """Where a value stands among all [%], among equal ones in their middle: what most rows of a plan say is no extreme.

    >>> percentile(np.array([1.0, 2.0, 3.0, 4.0]), 4.0), percentile(np.array([10.0, 10.0, 10.0, 10.0, 20.0]), 10.0)
    (100.0, 50.0)
    """
    below, equal = np.count_nonzero(values < value), np.count_nonzero(values == value)
    return float((below + (equal + 1) / 2 * (equal > 0)) / values.size * 100.0)


def quantile_interval(ordered: np.ndarray, quantile: float, confidence: float) -> tuple[float, float]:
    """Two-sided interval of a quantile between two order statistics, whatever the distribution.

    ordered: (n,) ascending, infinite where a trial has no value. The count of values below the quantile is binomial:
    the l-th smallest lies above it with a probability of P(B < l) (David and Nagaraja, Order Statistics, 2003, 7.1).
    Infinite ends where so few trials bound it on that side by nothing.
    """
    n, outside = ordered.size, (1.0 - confidence) / 2.0
    # the largest l with P(B < l) < outside, and the smallest u with P(B >= u) <= outside
    low = bisect.bisect_left(range(n), outside, key=lambda k: special.bdtr(k, n, quantile))
    high = bisect.bisect_left(range(n), True, key=lambda k: special.bdtrc(k, n, quantile) <= outside) + 1
    below = float(ordered[low - 1]) if low >= 1 else -np.inf
    return below, float(ordered[high - 1]) if high <= n else np.inf


def value_at(ordered: np.ndarray, quantile: float) -> float:
    """The quantile of a sample, ordered (n,): the smallest value that this share of it does not exceed.

    >>> value_at(np.array([1.0, 2.0, 3.0, 4.0]), quantile=0.5)
    2.0
    """
    return float(ordered[max(0, int(np.ceil(quantile * ordered.size - 1e-9)) - 1)])


def drivers(
    inputs: Mapping[str, np.ndarray],
    metric: np.ndarray,
    ranked: dict[str, tuple] | None = None,
    categories: Collection[str] = (),
) -> dict[str, dict[str, Any]]:
    """How each input drives a metric: Spearman's rank correlation, and the first-order share of its ranks' variance.

    The latter, a Sobol index estimated from the trials as they are (Plischke, Borgonovo, Smith, European J. Operational
    Research 226, 2013): the variance of the metric's mean over `SOBOL_BINS` bins of the input with equally many trials,
    over its variance, less what bins of unrelated numbers would show. Of ranks, so that a long tail does not decide.

    Args:
        inputs: (trials,) each, by name. Of inputs that rank the trials alike, such as an angle and the scalar part of
            its quaternion, the first one speaks for all.
        metric: (trials,).
        ranked: what the inputs are ranked to, kept here for other metrics of the same trials.
        categories: names of inputs that say which of several things. They have no rank, and instead of bins their
            trials with the same number; their share is 0 where unrelated ones would show as much.

    Returns:
        {"rank_correlation", "first_order"} by the input's name, the first None of a category; empty where the metric or
        every input has one value.
    """
    ranked = {} if ranked is None else ranked
    if metric.size < 4 * SOBOL_BINS or not vary(metric):
        return {}
    metric_ranks, effects = _ranks(metric), {}
    for name, values in inputs.items():
        if not vary(values):
            continue
        if name in categories:
            bins = [metric_ranks[values == one] for one in np.unique(values)]
            chance = special.chdtrc(len(bins) - 1, metric.size * _between(bins, metric.size))
            share = _first_order(bins, metric.size) if chance < BY_CHANCE else 0.0
            effects[name] = {"rank_correlation": None, "first_order": share}
            continue
        if name not in ranked:
            ranks = _ranks(values)
            duplicate = any(abs(np.mean(ranks * other)) > SAME_INPUT for other, _ in filter(None, ranked.values()))
            ranked[name] = () if duplicate else (ranks, np.argsort(ranks, kind="stable"))
        if not ranked[name]:
            continue
        ranks, order = ranked[name]
        bins = np.array_split(metric_ranks[order], SOBOL_BINS)
        effects[name] = {
            "rank_correlation": float(np.mean(ranks * metric_ranks)),
            "first_order": _first_order(bins, metric.size),
        }
    return effects


def beyond_chance(driver: Mapping[str, float | None], trials: int) -> bool:
    """Whether one of `drivers` says more than unrelated numbers do among so many trials, by three sigma.

    A category, which has no rank correlation, has no share either where it does not.

    >>> weak = {"rank_correlation": 0.1, "first_order": 0.01}
    >>> beyond_chance(weak, 300), beyond_chance(weak, 3000)
    (False, True)
    """
    if driver["rank_correlation"] is None:
        return bool(driver["first_order"])
    by_chance = {"rank_correlation": 1.0 / np.sqrt(trials), "first_order": np.sqrt(2.0 * (SOBOL_BINS - 1)) / trials}
    shown = ((driver[name], sigma) for name, sigma in by_chance.items())
    return any(value is not None and abs(value) > 3.0 * sigma for value, sigma in shown)


def _first_order(bins: Sequence[np.ndarray], count: int) -> float:
    """The share of the variance of `count` ranks that is one of the means over bins, less what chance would show."""
    between = _between(bins, count)
    by_chance = (len(bins) - 1) / max(1, count - len(bins)) * (1.0 - between)
    return max(0.0, float(between - by_chance))


def _between(bins: Sequence[np.ndarray], count: int) -> float:
    """The variance of the means of `count` ranks over bins; times `count` chi-squared where bins say nothing."""
    return float(sum(part.size * part.mean() ** 2 for part in bins) / count)


def _ranks(values: np.ndarray) -> np.ndarray:
    """Ranks of values (trials,), of mean 0 and variance 1: the mean of their products is Spearman's correlation."""
    _, which, counts = np.unique(values, return_inverse=True, return_counts=True)
    rank = (np.cumsum(counts) - (counts - 1) / 2)[which]  # of equal ones the mean of theirs
    return (rank - rank.mean()) / rank.std()


def vary(values: np.ndarray) -> bool:
    """Whether values (trials,) differ by more than their rounding, as angles do not that are drawn from 100 to 100 deg.

    >>> vary(np.array([1.7453292519943295, 1.7453292519943298])), vary(np.array([1.7453, 1.7454]))
    (False, True)
    """
    return bool(np.ptp(values) > ROUNDING * np.max(np.abs(values)))


def distinct(inputs: Mapping[str, np.ndarray]) -> list[str]:
    """Names of inputs (trials,) each, but for those that rank the trials as one before them does, or its reverse.

    >>> angle = np.array([0.1, 0.7, 0.4])
    >>> distinct({"initial_angle": angle, "initial_q4": np.cos(angle / 2), "initial_w1": np.array([2.0, 1.0, 3.0])})
    ['initial_angle', 'initial_w1']
    """
    distinct_ranks: dict[str, np.ndarray] = {}
    for name, values in inputs.items():
        ranks = _ranks(values)
        if all(abs(np.mean(ranks * other)) <= SAME_INPUT for other in distinct_ranks.values()):
            distinct_ranks[name] = ranks
    return list(distinct_ranks)


def fewest_for(failures: int, quantile: float, confidence: float) -> int:
    """The fewest trials that show a quantile with this one-sided confidence although `failures` of them fail.

    >>> [fewest_for(failures, quantile=0.9973, confidence=0.9) for failures in (0, 1, 2)]
    [852, 1440, 1970]
    """

    def shown(trials: int) -> bool:
        return share_bound(trials - failures, trials, confidence) >= quantile

    enough = failures + 1
    while not shown(enough):
        enough *= 2
    return failures + 1 + bisect.bisect_left(range(failures + 1, enough), True, key=shown)


def most_extreme(values: np.ndarray, failed: np.ndarray, count: int, *, larger_is_better: bool = False) -> np.ndarray:
    """Indices of the worst trials: failed ones first, then those without a value, then by value, largest first.

    Smallest first where larger is better.
    """
    badness = values if larger_is_better else -values
    return np.lexsort((badness, ~np.isnan(values), ~failed))[:count]
