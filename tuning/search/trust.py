"""What makes a tuning result believable: slopes checked, gains' influence, intervals of what was averaged."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ptsmc_jax.simulation import rollout
from tuning.search import flights
from tuning.search.evaluate import Evaluator
from tuning.search.objective import Problem
from tuning.search.shares import TIMES, Bounds

DIFFERENCE = 3e-4  # of the bounds' intervals, for slopes by differences
STEP = 1e-2  # of the gains, relative, for sensitivities
SMALLEST = 1e-6  # slopes of ln F below this are none
ACROSS = 15  # gains looked at between the bounds of each, besides the one found
FLAT = 0.01  # what changes by less than this share between the bounds does not depend on the gain
CONFIDENCE = 0.95  # of intervals
RESAMPLED = 2000  # times, for an interval


def slope_error(evaluate: Evaluator, problem: Problem, share: np.ndarray) -> float:
    """Largest difference of F's slopes, by automatic differentiation, from central differences, at shares (gains,).

    Over the largest slope by a share; differences of order 4 over +-`DIFFERENCE`, beside a bound just inside it, beside
    a hand-over on a sample just behind it: F has a kink there, where the first period of the anchored clock vanishes.
    NaN where there is nothing to compare, as where the error is zero or no trial ends.
    """
    behind = 3 * DIFFERENCE * np.isin(problem.names, TIMES)
    count, inside = share.size, np.clip(share + behind, 2 * DIFFERENCE, 1.0 - 2 * DIFFERENCE)
    offsets = np.concatenate([k * DIFFERENCE * np.eye(count) for k in (-2, -1, 1, 2)])
    flown = evaluate.fly(problem, inside + offsets)
    if np.isnan(flown.goal).all():  # what stands for the goal is the same everywhere
        return np.nan
    f = flown.f.reshape(4, count)
    numeric = (f[0] - 8 * f[1] + 8 * f[2] - f[3]) / (12 * DIFFERENCE)
    exact = evaluate.slopes(problem, inside[None]).f_slope[0]
    return float(np.abs(exact - numeric).max() / max(np.abs(exact).max(), SMALLEST))


@dataclass(frozen=True)
class Profile:
    """The goal along one gain between its bounds, the others as they were found."""

    gain: np.ndarray  # (points,)
    value: np.ndarray  # (points,) the goal, NaN where no trial has one
    over: np.ndarray  # (points,) largest metric / limit, `FAILED` where a trial fails; zero without a requirement
    f: np.ndarray  # (points,) F: ln of the goal, with what the torque weighs in it
    nearest: list[str] = field(default_factory=list)  # (points,) whose the largest metric / limit is

    @property
    def seen(self) -> bool:
        """Whether a trial has a goal anywhere: if none has, what stands for it is the same everywhere."""
        return bool(np.isfinite(self.value).any())

    @property
    def flat(self) -> bool:
        """Whether neither F nor the nearest limit depends on the gain."""
        steady = self.f.max() - self.f.min() <= np.log1p(FLAT)
        return bool(steady and self.over.max() <= (1.0 + FLAT) * self.over.min())


def profiles(evaluate: Evaluator, problem: Problem, share: np.ndarray) -> dict[str, Profile]:
    """How the goal goes with each gain, by its name; share: (gains,) of the bounds' intervals, of what was found."""
    count, bounds = share.size, evaluate.bounds
    points = np.tile(share, (count, ACROSS + 1, 1))
    for k in range(count):
        points[k, :, k] = np.sort(np.append(np.linspace(0.0, 1.0, ACROSS), share[k]))
        points[k] = [bounds.replaced(share, bounds.gains(point), np.arange(count) == k) for point in points[k]]
    flown = evaluate.fly(problem, points.reshape(-1, count))
    largest = flown.c.max(axis=2, initial=-1.0)  # (points, rows); a trial that fails keeps no limit
    arrays = (flown.gains, flown.goal, largest.max(axis=1, initial=-1.0) + 1.0, flown.f)
    gains, value, over, f = (v.reshape(count, ACROSS + 1, -1) for v in arrays)
    rows = largest.argmax(axis=1) if problem.rows else np.zeros(len(largest), int)
    nearest = np.asarray(problem.rows or ("",))[rows].reshape(count, ACROSS + 1)
    return {
        name: Profile(gains[k, :, k], value[k, :, 0], over[k, :, 0], f[k, :, 0], nearest[k].tolist())
        for k, name in enumerate(problem.names)
    }


def sensitivities(
    problem: Problem, bounds: Bounds, gains: np.ndarray, names: Sequence[str]
) -> dict[str, dict[str, float]]:
    """D ln(metric) / d ln(gain), percent by percent, of each metric's RMS over the averaged trials; by metric and gain.

    Central differences inside the bounds, of the program that judges, which has every metric: one that slopes are
    compiled for takes longer to compile than these few runs take. A metric that is zero somewhere, or has no value, is
    left out, and so is a gain that is zero, of which there is no percent.
    """
    less, more = (np.clip(gains + side * np.diag(STEP * gains), bounds.lower, bounds.upper) for side in (-1.0, 1.0))
    trials = problem.others(np.asarray(problem.trials)[: problem.averaged])
    flown = flights.fly(trials, np.concatenate([less, more]))
    finished = np.isin(flown.status, rollout.FINISHED)
    metrics = (getattr(flown.metrics, name) for name in names)
    with np.errstate(divide="ignore", invalid="ignore"):
        metric_rms = [
            [rms(one[ended]) if ended.any() else np.nan for one, ended in zip(metric, finished, strict=True)]
            for metric in metrics
        ]
        below, above = np.split(np.transpose(metric_rms), 2)
        rows = np.log(above / below) / np.log(np.diag(more) / np.diag(less))[:, None]
    some = np.flatnonzero(gains)
    return {
        metric: {problem.names[k]: float(row[k]) for k in some}
        for metric, row in zip(names, np.transpose(rows), strict=True)
        if some.size and np.all(np.isfinite(row[some]))
    }


def rms(values: np.ndarray, axis: int = -1) -> Any:
    """Root mean square."""
    return np.sqrt(np.mean(values**2, axis=axis))


def mean(values: np.ndarray, axis: int = -1) -> Any:
    """Mean."""
    return np.mean(values, axis=axis)


def interval(values: np.ndarray, statistic=mean) -> tuple[float, float] | None:
    """Bootstrap interval (bias-corrected and accelerated, Efron, JASA 82, 1987) of a statistic, at `CONFIDENCE`.

    None where there are too few trials to resample, or all are equal.
    """
    return _bootstrap((values,), statistic, paired=False)


def ratio_interval(numerator: np.ndarray, denominator: np.ndarray) -> tuple[float, float] | None:
    """Bootstrap interval of the ratio of two RMS over the same trials, which are resampled together."""
    return _bootstrap((numerator, denominator), lambda a, b, axis=-1: rms(a, axis) / rms(b, axis), paired=True)


def _bootstrap(samples: tuple, statistic, *, paired: bool) -> tuple[float, float] | None:
    if len(samples[0]) < 8 or all(np.ptp(one) == 0.0 for one in samples):
        return None
    from scipy import stats  # takes half a second, in which a search flies

    bootstrap = stats.bootstrap(
        samples,
        statistic,
        n_resamples=RESAMPLED,
        batch=250,
        confidence_level=CONFIDENCE,
        paired=paired,
        rng=np.random.default_rng(0),
    )
    low, high = bootstrap.confidence_interval
    return (float(low), float(high)) if np.isfinite(low) and np.isfinite(high) else None
