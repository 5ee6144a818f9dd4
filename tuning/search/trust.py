"""Checks of a tuning result: gradients against finite differences, influence of the gains, and confidence intervals.

Read `gradient_error` and `profiles` first.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ptsmc_jax.simulation import rollout
from tuning.search import simulations
from tuning.search.evaluate import Evaluator
from tuning.search.normalisation import TIMES, Bounds
from tuning.search.objective import Problem

DIFFERENCE_STEPS = (3e-4, 3e-5)  # steps of the finite differences, in normalised gains
STEP = 1e-2  # step of the gains for `sensitivities`, relative to the gain
SMALLEST_GRADIENT = 1e-6  # errors are relative to the gradient, or to this number if the gradient is smaller
PROFILE_POINTS = 15  # number of values of a gain between its bounds, besides the final value
FLAT = 0.01  # a quantity that changes by a smaller fraction counts as independent of the gain
CONFIDENCE = 0.95  # confidence level of intervals
BOOTSTRAP_SAMPLES = 2000  # bootstrap samples of an interval


def gradient_error(evaluate: Evaluator, problem: Problem, normalised: np.ndarray) -> float:
    """Return the largest relative error of the gradient of F, from automatic differentiation, at a point.

    The reference are central finite differences of order 4. The result is the smaller error of two `DIFFERENCE_STEPS`:
    the larger step has a truncation error if F has a sharp minimum, and the smaller step has a larger rounding error.
    The error is relative to the largest element of the gradient. Near a bound, the point is moved just inside the
    bound. A time is moved past its sample, because F has a kink if the hand-over lies on a sample: the first period of
    the anchored clock vanishes.

    Args:
        evaluate: measures the problem.
        problem: the tuning problem.
        normalised: (gains,) normalised gains of the point.

    Returns:
        The relative error [-]. It is NaN if F has no gradient: no trial completes, or the objective is zero.
    """
    count, steps = normalised.size, np.asarray(DIFFERENCE_STEPS)
    shift = 3 * steps.max() * np.isin(problem.names, TIMES)
    inside = np.clip(normalised + shift, 2 * steps.max(), 1.0 - 2 * steps.max())
    offsets = np.concatenate([k * step * np.eye(count) for step in steps for k in (-2, -1, 1, 2)])
    measured = evaluate.measure(problem, inside + offsets)
    if np.isnan(measured.objective).all():  # no trial has an objective, so F is a constant
        return np.nan
    f = np.moveaxis(measured.f.reshape(steps.size, 4, count), 1, 0)
    numeric = (f[0] - 8 * f[1] + 8 * f[2] - f[3]) / (12 * steps[:, None])
    exact = evaluate.measure_with_gradients(problem, inside[None]).f_gradient[0]
    return float(np.abs(exact - numeric).max(axis=1).min() / max(np.abs(exact).max(), SMALLEST_GRADIENT))


@dataclass(frozen=True)
class Profile:
    """Objective and limits along one gain between its bounds, with the other gains at their final values."""

    gain: np.ndarray  # (points,)
    value: np.ndarray  # (points,) objective; NaN if no trial has a value
    violation_ratio: (
        np.ndarray
    )  # (points,) largest metric / limit; `FAILED` if a trial fails; zero without requirements
    f: np.ndarray  # (points,) F: ln of the objective plus the weighted torque term
    nearest: list[str] = field(default_factory=list)  # (points,) metric with the largest metric / limit

    @property
    def has_value(self) -> bool:
        """Whether the objective has a value at some point."""
        return bool(np.isfinite(self.value).any())

    @property
    def is_flat(self) -> bool:
        """Whether neither F nor the largest metric / limit depends on the gain."""
        steady = self.f.max() - self.f.min() <= np.log1p(FLAT)
        return bool(steady and self.violation_ratio.max() <= (1.0 + FLAT) * self.violation_ratio.min())


def profiles(evaluate: Evaluator, problem: Problem, normalised: np.ndarray) -> dict[str, Profile]:
    """Return the profile of each gain by name.

    Args:
        evaluate: measures the problem.
        problem: the tuning problem.
        normalised: (gains,) normalised gains of the final point.
    """
    count, bounds = normalised.size, evaluate.bounds
    points = np.tile(normalised, (count, PROFILE_POINTS + 1, 1))
    for k in range(count):
        points[k, :, k] = np.sort(np.append(np.linspace(0.0, 1.0, PROFILE_POINTS), normalised[k]))
        points[k] = [bounds.with_gains(normalised, bounds.gains(point), np.arange(count) == k) for point in points[k]]
    measured = evaluate.measure(problem, points.reshape(-1, count))
    largest = measured.c.max(axis=2, initial=-1.0)  # (points, rows); a failed trial breaks every limit
    arrays = (measured.gains, measured.objective, largest.max(axis=1, initial=-1.0) + 1.0, measured.f)
    gains, value, violation_ratio, f = (v.reshape(count, PROFILE_POINTS + 1, -1) for v in arrays)
    rows = largest.argmax(axis=1) if problem.rows else np.zeros(len(largest), int)
    nearest = np.asarray(problem.rows or ("",))[rows].reshape(count, PROFILE_POINTS + 1)
    return {
        name: Profile(gains[k, :, k], value[k, :, 0], violation_ratio[k, :, 0], f[k, :, 0], nearest[k].tolist())
        for k, name in enumerate(problem.names)
    }


def sensitivities(
    problem: Problem, bounds: Bounds, gains: np.ndarray, names: Sequence[str]
) -> dict[str, dict[str, float]]:
    """Return d ln(RMS of metric) / d ln(gain) over the averaged trials, in percent per percent.

    The sensitivities are central finite differences inside the bounds. They use the
    program without gradients: the compilation of another one with gradients would take longer than these few runs. A
    metric whose RMS is zero or has no value is omitted. A gain that is zero has no relative change and is omitted.

    Args:
        problem: the tuning problem.
        bounds: bounds of the free gains.
        gains: (gains,) the final gains.
        names: names of the metrics.

    Returns:
        Sensitivities [-] by metric and gain.
    """
    down, up = (np.clip(gains + side * np.diag(STEP * gains), bounds.lower, bounds.upper) for side in (-1.0, 1.0))
    batch = problem.batch_of(np.asarray(problem.trials)[: problem.averaged])
    simulated = simulations.simulate(batch, np.concatenate([down, up]))
    finished = np.isin(simulated.status, rollout.FINISHED)
    metrics = (getattr(simulated.metrics, name) for name in names)
    with np.errstate(divide="ignore", invalid="ignore"):
        metric_rms = [
            [rms(one[done]) if done.any() else np.nan for one, done in zip(metric, finished, strict=True)]
            for metric in metrics
        ]
        below, above = np.split(np.transpose(metric_rms), 2)
        rows = np.log(above / below) / np.log(np.diag(up) / np.diag(down))[:, None]
    nonzero = np.flatnonzero(gains)
    return {
        metric: {problem.names[k]: float(row[k]) for k in nonzero}
        for metric, row in zip(names, np.transpose(rows), strict=True)
        if nonzero.size and np.all(np.isfinite(row[nonzero]))
    }


def rms(values: np.ndarray, axis: int = -1) -> Any:
    """Return the root mean square along an axis."""
    return np.sqrt(np.mean(values**2, axis=axis))


def interval(values: np.ndarray, statistic: Callable = np.mean) -> tuple[float, float] | None:
    """Return the bootstrap confidence interval of a statistic of values (trials,).

    The interval is bias-corrected and accelerated (Efron, JASA 82, 1987) at the level `CONFIDENCE`. It is None for
    fewer than 8 values and for equal values.
    """
    return _bootstrap_interval((values,), statistic, paired=False)


def ratio_interval(numerator: np.ndarray, denominator: np.ndarray) -> tuple[float, float] | None:
    """Return the bootstrap interval of the ratio of two RMS over the same trials, (trials,), resampled in pairs."""
    return _bootstrap_interval((numerator, denominator), lambda a, b, axis=-1: rms(a, axis) / rms(b, axis), paired=True)


def _bootstrap_interval(samples: tuple, statistic, *, paired: bool) -> tuple[float, float] | None:
    """Return the bootstrap confidence interval of a statistic, or None.

    The result is None for fewer than 8 values, for equal values, and if an end is not finite.

    Args:
        samples: arrays (trials,), the arguments of the statistic.
        statistic: function of these arrays and an axis.
        paired: resample the same trials of all arrays.
    """
    if len(samples[0]) < 8 or all(np.ptp(one) == 0.0 for one in samples):
        return None
    from scipy import stats  # imported here because the import takes half a second

    bootstrap = stats.bootstrap(
        samples,
        statistic,
        n_resamples=BOOTSTRAP_SAMPLES,
        batch=250,
        confidence_level=CONFIDENCE,
        paired=paired,
        rng=np.random.default_rng(0),
    )
    low, high = bootstrap.confidence_interval
    return (float(low), float(high)) if np.isfinite(low) and np.isfinite(high) else None
