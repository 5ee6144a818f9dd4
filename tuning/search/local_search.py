"""Local search by sequential quadratic programming (SciPy's SLSQP). Read `search_locally` first.

F is the logarithm of the objective. c = metric / limit - 1 is the constraint of one limit in one trial, and is met if
c <= 0. Gains are normalised: 0 is the lower bound and 1 the upper bound of a gain.
"""

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import minimize, nnls

from tuning.search.evaluate import Measurement, MeasurementWithGradients
from tuning.search.objective import count_failures, ignore_failures

ACTIVE = 1e-3  # a limit is active if c > -ACTIVE
SLACK = 1e-4  # largest c of an admissible point
ELASTIC = 0.1  # if c is larger at the starting point, the violation is minimised before the objective
FAILURE_PENALTY = 1e3  # added to the relative violation for each failed trial
F_TOLERANCE = 1e-5  # a local search ends if F changes by less
# Scaling of the variables. The first step is the gradient divided by the square of the scaling. It may leave the
# neighbourhood of the starting point with 1, and stays in it with 4.
BOLD, CAREFUL = 1.0, 4.0
# Gradients with respect to normalised gains are clipped to this size. A chattering loop has useless, far larger ones.
STEEPEST = 30.0


def largest_ratios(c: np.ndarray, margin: ArrayLike) -> np.ndarray:
    """Return the largest ratio of metric to limit over the completed trials, (points, rows).

    Args:
        c: (points, rows, trials) constraints whose limits are tighter by the margin.
        margin: (rows,) or one number, relative tightening of each limit [-].
    """
    return (ignore_failures(c).max(axis=2, initial=-1.0) + 1.0) * (1.0 - np.asarray(margin))


class Best:
    """The best point so far, ordered by number of failed trials, then by violation, then by F."""

    def __init__(self, normalised: np.ndarray, requirements: int, margin: ArrayLike):
        """Begin without a measured point.

        Args:
            normalised: (gains,) normalised gains of the starting point.
            requirements: number of rows of c.
            margin: relative tightening of each limit, (rows,) or one number [-].
        """
        self.margin = np.asarray(margin)
        self.normalised = normalised.copy()  # (gains,) the starting point until a better point is offered
        self.f = self.value = self.violation = self.failed_trials = np.inf
        self.worst = np.full(requirements, np.inf)  # largest metric / limit

    @property
    def failed(self) -> bool:
        """Whether a trial fails or lacks a metric at the best point."""
        return 0.0 < self.failed_trials < np.inf

    @property
    def infeasibility(self) -> tuple[float, float]:
        """Number of failed trials, and relative violation. It is (0, 0) if every limit is met."""
        return self.failed_trials, self.violation

    @property
    def rank(self) -> tuple[float, float, float]:
        """Sort key, best first: failed trials, violation, F."""
        return self.failed_trials, self.violation, self.f

    @property
    def progress(self) -> tuple[float, float]:
        """Objective and relative violation of the best point, or NaN if no point was offered yet."""
        return (self.value, self.violation) if np.isfinite(self.f) else (np.nan, np.nan)

    def offer(self, normalised: np.ndarray, measured: Measurement) -> None:
        """Replace the best point by the best of these points, if that is better.

        Args:
            normalised: (points, gains) normalised gains.
            measured: the measurement at these points with tightened limits. A point is admissible if it meets them.
        """
        worst = largest_ratios(measured.c, self.margin)
        violation = np.maximum((worst - (1.0 - self.margin)).max(axis=1, initial=-1.0) - SLACK, 0.0)
        failed_trials = np.where(np.isfinite(measured.f), count_failures(measured.c), np.inf)
        violation = violation + FAILURE_PENALTY * failed_trials
        first = int(np.lexsort((measured.f, violation, failed_trials))[0])
        if np.isfinite(measured.f[first]) and (failed_trials[first], violation[first], measured.f[first]) < self.rank:
            self.normalised, self.worst = normalised[first].copy(), worst[first]
            self.f, self.value = float(measured.f[first]), float(measured.objective[first])
            self.failed_trials, self.violation = float(failed_trials[first]), float(violation[first])


class _StepLimitError(Exception):
    """A local search has measured its largest number of points."""


@dataclass(frozen=True)
class Start:
    """Starting point of a local search, and its options."""

    normalised: np.ndarray  # (gains,)
    scale: float = BOLD  # scaling of the variables, see `BOLD` and `CAREFUL`
    fixed: Sequence[int] = ()  # indices of gains that are not changed


class _FeasibleError(Exception):
    """A point meets every limit. The search continues from it and minimises the objective."""


def search_locally(
    measure: Callable[[np.ndarray], MeasurementWithGradients],
    best: Best,
    start: Start,
    steps: int,
    on_accepted: Callable[[MeasurementWithGradients], None] = lambda _: None,
    tolerance: float = F_TOLERANCE,
    relaxed: Sequence[int] | None = None,
    steepest: float = STEEPEST,
) -> None:
    """Search locally from a starting point inside the bounds, by sequential quadratic programming (SLSQP).

    If the starting point breaks a limit by more than `ELASTIC`, the search first minimises the largest relative
    violation: min t subject to c <= t for every limit and trial. The linearised constraints of this problem can always
    be met. The linearised limits themselves can contradict each other far from a solution. The violation is also
    minimised if the search ends at a point that breaks a limit. If the violation cannot be removed, the objective is
    not minimised.

    Args:
        measure: function that measures one point, (1, gains) normalised gains, with gradients.
        best: is offered every point.
        start: starting point and scaling of the variables.
        steps: largest number of points to measure.
        on_accepted: is called with the measurement at each accepted point, but not during line searches.
        tolerance: change of F at which the search ends.
        relaxed: if given, indices of limits among the rows of c. The search then minimises their largest c instead of
            the objective, also below 0. The other limits are constraints.
        steepest: largest element of the gradients of F and c; larger gradients are scaled down.
    """
    local = _LocalSearch(measure, best, start, steps, on_accepted, tolerance, steepest)
    first = start.scale * start.normalised
    with contextlib.suppress(_StepLimitError):
        on_accepted(local.at(first))
        if relaxed is not None:
            local.minimise_largest(first, relaxed)
            return
        if local.violation(first) > ELASTIC:
            first = local.minimise_largest(first)
            if local.violation(first) > SLACK:
                return
        last = local.minimise(first)
        if local.violation(last) > SLACK:
            feasible = local.minimise_largest(last)
            if local.violation(feasible) <= SLACK:
                local.minimise(feasible)


@dataclass
class _LocalSearch:
    """The two optimisation problems of a local search, with shared measurements, see `search_locally`.

    Variables are normalised gains times the scaling.
    """

    measure: Callable[[np.ndarray], MeasurementWithGradients]
    best: Best
    start: Start
    steps: int
    on_accepted: Callable[[MeasurementWithGradients], None]
    tolerance: float
    steepest: float
    measurements: dict[bytes, MeasurementWithGradients] = field(default_factory=dict)

    @property
    def bounds(self) -> list[tuple[float, float]]:
        """The bounds of the variables."""
        scaled = enumerate(self.start.scale * self.start.normalised)
        return [(value, value) if k in self.start.fixed else (0.0, self.start.scale) for k, value in scaled]

    def at(self, scaled: np.ndarray) -> MeasurementWithGradients:
        """Return the measurement at a point. A point is measured once."""
        key, point = scaled.tobytes(), np.clip(scaled / self.start.scale, 0.0, 1.0)[None]
        if key not in self.measurements:
            if len(self.measurements) == self.steps:
                raise _StepLimitError
            self.measurements[key] = self.measure(point)
        if self.measurements[key].finite[0]:
            self.best.offer(point, self.measurements[key])
        return self.measurements[key]

    def violation(self, scaled: np.ndarray) -> float:
        """Return the largest c of the completed trials."""
        return float(ignore_failures(self.at(scaled).c).max(initial=-1.0))

    def minimise(self, scaled: np.ndarray) -> np.ndarray:
        """Minimise F subject to c <= 0, and return the last point."""
        limits = {
            "type": "ineq",
            "fun": lambda x: -_compress(self.at(x), self.steepest)[0],
            "jac": lambda x: -_compress(self.at(x), self.steepest)[1] / self.start.scale,
        }
        result = minimize(
            lambda x: float(self.at(x).f[0]),
            scaled.copy(),
            jac=lambda x: _clip(self.at(x).f_gradient, self.steepest)[0] / self.start.scale,
            method="SLSQP",
            bounds=self.bounds,
            constraints=[limits] if self.at(scaled).c.shape[1] else [],
            callback=self._report_accepted,
            options={"maxiter": self.steps, "ftol": self.tolerance},
        )
        return np.clip(result.x, *np.transpose(self.bounds))

    def minimise_largest(self, scaled: np.ndarray, relaxed: Sequence[int] | None = None) -> np.ndarray:
        """Minimise t subject to c <= t for the limits in `relaxed`, and c <= 0 for the others. Return the last point.

        If `relaxed` is None, minimise t for all limits, and return the first point that meets every limit, if any.
        """
        rows, trials = self.at(scaled).c.shape[1:]
        if not rows:
            return scaled
        is_relaxed = np.repeat(np.isin(np.arange(rows), range(rows) if relaxed is None else relaxed), trials)
        feasible_point = np.array(scaled)

        def measure_limits(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            nonlocal feasible_point
            measured = self.at(x)
            if relaxed is None and ignore_failures(measured.c).max() <= 0.0:
                feasible_point = np.array(x)
                raise _FeasibleError
            return _compress(measured, self.steepest)

        limits = {
            "type": "ineq",
            "fun": lambda y: y[-1] * is_relaxed - measure_limits(y[:-1])[0],
            "jac": lambda y: np.column_stack([-measure_limits(y[:-1])[1] / self.start.scale, is_relaxed.astype(float)]),
        }
        first_violation = _compress(self.at(scaled), self.steepest)[0][is_relaxed].max()
        try:
            result = minimize(
                lambda y: y[-1],
                np.append(scaled, first_violation),
                jac=lambda y: np.append(np.zeros(scaled.size), 1.0),
                method="SLSQP",
                bounds=[*self.bounds, (-1.0, None)],
                constraints=[limits],
                callback=lambda y: self._report_accepted(y[:-1]),
                options={"maxiter": self.steps, "ftol": self.tolerance},
            )
        except _FeasibleError:
            return feasible_point
        return np.clip(result.x[:-1], *np.transpose(self.bounds))

    def _report_accepted(self, scaled: np.ndarray) -> None:
        """Call `on_accepted` with the measurement at a point that SLSQP has accepted."""
        key = np.ascontiguousarray(scaled).tobytes()
        if key in self.measurements:
            self.on_accepted(self.measurements[key])


def _compress(measured: MeasurementWithGradients, steepest: float) -> tuple[np.ndarray, np.ndarray]:
    """Return ln(1 + c) for c above 0, else c, (limits,), and its derivatives, (limits, gains).

    c spans orders of magnitude far beyond a limit. The logarithm has the same sign as c and the same derivative at 0.
    """
    c = ignore_failures(measured.c).reshape(-1)
    excess = np.maximum(c, 0.0)
    gradients = measured.c_gradient.reshape(c.size, -1) / (1.0 + excess)[:, None]
    return np.where(c > 0.0, np.log1p(excess), c), _clip(gradients, steepest)


def estimate_multipliers(measured: MeasurementWithGradients, normalised: np.ndarray) -> np.ndarray:
    """Return the Lagrange multiplier of each limit at an optimum, (rows,). It is 0 for inactive limits.

    The multipliers are estimated by nonnegative least squares over the gains that are not on a bound.

    Args:
        measured: the measurement at the optimum.
        normalised: (gains,) normalised gains of the optimum.
    """
    c, inside = ignore_failures(measured.c[0]), (normalised > 0.0) & (normalised < 1.0)
    active = np.flatnonzero(c.max(axis=1, initial=-1.0) > -ACTIVE)
    gradients = measured.c_gradient[0, active, c[active].argmax(axis=1)]
    estimate = np.zeros(len(c))
    if active.size and inside.any():
        estimate[active] = nnls(_clip(gradients)[:, inside].T, -_clip(measured.f_gradient)[0, inside])[0]
    return estimate


def _clip(gradients: np.ndarray, steepest: float = STEEPEST) -> np.ndarray:
    """Return gradients, (rows, gains), with no element above `steepest`. Rows that are not finite become zero."""
    largest = np.abs(gradients).max(axis=1, keepdims=True)
    finite = np.where(np.isfinite(largest), gradients, 0.0)
    return finite * np.minimum(1.0, steepest / np.maximum(np.where(np.isfinite(largest), largest, 1.0), 1e-300))
