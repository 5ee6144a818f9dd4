"""Local search by sequential quadratic programming (SLSQP)."""

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import minimize, nnls

from tuning.search.evaluate import Measured, Sloped
from tuning.search.objective import ended, failures

ACTIVE = 1e-3  # of a limit, nearer to which it is active
SLACK = 1e-4  # of a limit that an admissible point may use
ELASTIC = 0.1  # of a limit, beyond which the violation is minimised before the objective
BROKEN = 1e3  # added to the relative violation for each failed trial
CLOSE = 1e-5  # change of F at which a descent ends
# Scaling of the variables. The first step is the gradient over its square: 1 may leave the neighbourhood of the
# starting point, 4 stays in it.
BOLD, CAREFUL = 1.0, 4.0
# Gradients are clipped to this change of F per interval. A chattering loop has useless gradients that are far larger.
STEEPEST = 30.0


def largest(c: np.ndarray, margin: ArrayLike) -> np.ndarray:
    """Return the largest ratio of metric to limit over the completed trials, (points, rows).

    Args:
        c: (points, rows, trials) constraints whose limits are tighter by the margin.
        margin: (rows,) or one number, share of each limit.
    """
    return (ended(c).max(axis=2, initial=-1.0) + 1.0) * (1.0 - np.asarray(margin))


class Best:
    """The best point so far. The order is: fewest failed trials, then smallest violation, then smallest F."""

    def __init__(self, share: np.ndarray, requirements: int, margin: ArrayLike):
        self.margin = np.asarray(margin)
        self.share = share.copy()  # (gains,) the starting point, until a better one is offered
        self.f = self.value = self.over = self.lost = np.inf
        self.worst = np.full(requirements, np.inf)  # largest metric / limit

    @property
    def failed(self) -> bool:
        """Whether a trial fails there, or has no value."""
        return 0.0 < self.lost < np.inf

    @property
    def beyond(self) -> tuple[float, float]:
        """Number of failed trials and relative violation; (0, 0) if every limit is kept."""
        return self.lost, self.over

    @property
    def rank(self) -> tuple[float, float, float]:
        """Sort key, best first: failed trials, violation, F."""
        return self.lost, self.over, self.f

    @property
    def so_far(self) -> tuple[float, float]:
        """Its goal, and how far it is beyond a limit; not numbers where none has been offered."""
        return (self.value, self.over) if np.isfinite(self.f) else (np.nan, np.nan)

    def offer(self, share: np.ndarray, seen: Measured) -> None:
        """Keep the best of these points, (points, gains), if it is better; admissible is what keeps the margin."""
        worst = largest(seen.c, self.margin)
        over = np.maximum((worst - (1.0 - self.margin)).max(axis=1, initial=-1.0) - SLACK, 0.0)
        lost = np.where(np.isfinite(seen.f), failures(seen.c), np.inf)
        over = over + BROKEN * lost
        first = int(np.lexsort((seen.f, over, lost))[0])
        if np.isfinite(seen.f[first]) and (lost[first], over[first], seen.f[first]) < self.rank:
            self.share, self.worst = share[first].copy(), worst[first]
            self.f, self.value = float(seen.f[first]), float(seen.goal[first])
            self.lost, self.over = float(lost[first]), float(over[first])


class _EnoughError(Exception):
    """A descent has looked at as many points as it may."""


@dataclass(frozen=True)
class Start:
    """Where a descent begins, and how."""

    share: np.ndarray  # (gains,)
    scale: float = BOLD  # the first step is the slope over its square
    fixed: Sequence[int] = ()  # gains that stay as they are
    # points that a shorter search from the same starting point has measured; a longer one uses them again
    seen: dict[bytes, Sloped] = field(default_factory=dict)


class _FeasibleError(Exception):
    """A point keeps every limit. From there on the objective is minimised."""


@dataclass(frozen=True)
class Relaxed:
    """Which limits are exceeded by as little as possible, instead of minimising the objective."""

    rows: Sequence[int] | None = None  # of the problem; None: all of them
    to_the_end: bool = False  # continue after every limit is kept, to maximise the distance from the limits


def descend(
    slopes: Callable[[np.ndarray], Sloped],
    best: Best,
    start: Start,
    steps: int,
    keep: Callable[[Sloped], None],
    close: float = CLOSE,
    relaxed: Relaxed | None = None,
    steepest: float = STEEPEST,
) -> None:
    """Search locally from a starting point inside the bounds, by sequential quadratic programming (SLSQP).

    From a point that breaks a limit by more than `ELASTIC`, the largest relative violation is minimised first: min t
    subject to c <= t for every limit and trial. Its linearised constraints can always be met. Those of the problem
    itself can contradict each other far from a solution. The same happens if the search ends at a point that breaks a
    limit. The objective is not minimised if the violation cannot be removed.

    Args:
        slopes: returns the measurement with gradients at a point (1, gains).
        best: is offered every point.
        start: the starting point and the scaling of the variables.
        steps: how many points may be measured.
        keep: is called with the measurement at accepted points, not at those of a line search.
        close: change of F at which the search ends.
        relaxed: minimise the violation of these limits only, the others being constraints.
        steepest: gradients are clipped to this change of F or c per interval.
    """
    local = _Local(slopes, best, start, steps, keep, close, steepest)
    first = start.scale * start.share
    with contextlib.suppress(_EnoughError):
        keep(local.at(first))
        if relaxed is not None:
            local.least_violation(first, relaxed)
            return
        if local.violation(first) > ELASTIC:
            first = local.least_violation(first, Relaxed())
            if local.violation(first) > SLACK:
                return
        last = local.minimise(first)
        if local.violation(last) > SLACK:
            nearer = local.least_violation(last, Relaxed())
            if local.violation(nearer) <= SLACK:
                local.minimise(nearer)


class _Local:
    """Both programs of a local search, which share the points that were measured. Points are shares times a scale."""

    def __init__(
        self,
        slopes: Callable[[np.ndarray], Sloped],
        best: Best,
        start: Start,
        steps: int,
        keep: Callable[[Sloped], None],
        close: float,
        steepest: float,
    ):
        self._steepest = steepest
        self._slopes, self._best, self._start = slopes, best, start
        self._steps, self._keep, self._close = steps, keep, close
        self._seen, self._scale = start.seen, start.scale
        scaled = self._scale * start.share
        self._bounds = [(own, own) if k in start.fixed else (0.0, self._scale) for k, own in enumerate(scaled)]

    def at(self, scaled: np.ndarray) -> Sloped:
        """What is measured at a point, from memory if it was measured before."""
        key, point = scaled.tobytes(), np.clip(scaled / self._scale, 0.0, 1.0)[None]
        if key not in self._seen:
            if len(self._seen) == self._steps:
                raise _EnoughError
            self._seen[key] = self._slopes(point)
        if self._seen[key].finite[0]:
            self._best.offer(point, self._seen[key])
        return self._seen[key]

    def violation(self, scaled: np.ndarray) -> float:
        """The largest c of the trials that end."""
        return float(ended(self.at(scaled).c).max(initial=-1.0))

    def minimise(self, scaled: np.ndarray) -> np.ndarray:
        """Minimise F subject to c <= 0, and return the last point."""
        limits = {
            "type": "ineq",
            "fun": lambda x: -_compressed(self.at(x), self._steepest)[0],
            "jac": lambda x: -_compressed(self.at(x), self._steepest)[1] / self._scale,
        }
        found = minimize(
            lambda x: float(self.at(x).f[0]),
            scaled.copy(),
            jac=lambda x: _usable(self.at(x).f_slope, self._steepest)[0] / self._scale,
            method="SLSQP",
            bounds=self._bounds,
            constraints=[limits] if self.at(scaled).c.shape[1] else [],
            callback=self._passed,
            options={"maxiter": self._steps, "ftol": self._close},
        )
        return np.clip(found.x, *np.transpose(self._bounds))

    def least_violation(self, scaled: np.ndarray, relaxed: Relaxed) -> np.ndarray:
        """Minimise t subject to c <= t. Return the first point that keeps every limit, or else the last point."""
        rows, trials = self.at(scaled).c.shape[1:]
        if not rows:
            return scaled
        soft = np.repeat(np.isin(np.arange(rows), range(rows) if relaxed.rows is None else relaxed.rows), trials)
        reached = np.array(scaled)

        def excess(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            nonlocal reached
            seen = self.at(x)
            if not relaxed.to_the_end and relaxed.rows is None and ended(seen.c).max() <= 0.0:
                reached = np.array(x)
                raise _FeasibleError
            return _compressed(seen, self._steepest)

        limits = {
            "type": "ineq",
            "fun": lambda y: y[-1] * soft - excess(y[:-1])[0],
            "jac": lambda y: np.column_stack([-excess(y[:-1])[1] / self._scale, soft.astype(float)]),
        }
        first = _compressed(self.at(scaled), self._steepest)[0][soft].max()
        try:
            found = minimize(
                lambda y: y[-1],
                np.append(scaled, first),
                jac=lambda y: np.append(np.zeros(scaled.size), 1.0),
                method="SLSQP",
                bounds=[*self._bounds, (-1.0, None)],
                constraints=[limits],
                callback=lambda y: self._passed(y[:-1]),
                options={"maxiter": self._steps, "ftol": self._close},
            )
        except _FeasibleError:
            return reached
        return np.clip(found.x[:-1], *np.transpose(self._bounds))

    def _passed(self, scaled: np.ndarray) -> None:
        key = np.ascontiguousarray(scaled).tobytes()
        if key in self._seen:
            self._keep(self._seen[key])


def _compressed(seen: Sloped, steepest: float) -> tuple[np.ndarray, np.ndarray]:
    """(limits,) ln(1 + c) for c above 0, else c, and its derivatives (limits, gains).

    Far beyond a limit c spans orders of magnitude; its logarithm has the same sign and the same derivative at 0.
    """
    c = ended(seen.c).reshape(-1)
    beyond = np.maximum(c, 0.0)
    slopes = seen.c_slope.reshape(c.size, -1) / (1.0 + beyond)[:, None]
    return np.where(c > 0.0, np.log1p(beyond), c), _usable(slopes, steepest)


def prices(at: Sloped, share: np.ndarray) -> np.ndarray:
    """Return the Lagrange multiplier of each limit at an optimum (gains,), (rows,); 0 for inactive limits.

    They are estimated by nonnegative least squares over the gains that are not on a bound.
    """
    c, inside = ended(at.c[0]), (share > 0.0) & (share < 1.0)
    active = np.flatnonzero(c.max(axis=1, initial=-1.0) > -ACTIVE)
    slopes = at.c_slope[0, active, c[active].argmax(axis=1)]
    paid = np.zeros(len(c))
    if active.size and inside.any():
        paid[active] = nnls(_usable(slopes)[:, inside].T, -_usable(at.f_slope)[0, inside])[0]
    return paid


def _usable(slopes: np.ndarray, steepest: float = STEEPEST) -> np.ndarray:
    """Return gradients, (rows, gains), clipped to a largest element; zeros for a row that is not finite."""
    size = np.abs(slopes).max(axis=1, keepdims=True)
    known = np.where(np.isfinite(size), slopes, 0.0)
    return known * np.minimum(1.0, steepest / np.maximum(np.where(np.isfinite(size), size, 1.0), 1e-300))
