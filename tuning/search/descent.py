"""From one start to the optimum next to it, along the active limits, by sequential quadratic programming."""

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.optimize import minimize, nnls

from tuning.search.evaluate import Measured, Sloped
from tuning.search.objective import ended, failures

ACTIVE = 1e-3  # of a limit, nearer to which it is active
SLACK = 1e-4  # of a limit that an admissible point may use
BROKEN = 1e3  # metric / limit by which a trial that fails is over, as progress tells it, beside those that end
CLOSE = 1e-5  # change of F at which a descent ends
BOLD, CAREFUL = 1.0, 4.0  # a first step that may lead across the bounds into a better valley, and one that stays
# change of F between two bounds of a gain: where the loop chatters slopes are many orders larger, and say nothing
STEEPEST = 30.0


def largest(c: np.ndarray, margin: float) -> np.ndarray:
    """(points, requirements) largest metric / limit of the trials that end, from c with limits tighter by a margin."""
    return (ended(c).max(axis=2, initial=-1.0) + 1.0) * (1.0 - margin)


class Best:
    """The best point so far: an admissible one by its F, another one by how many trials fail, then how far it is over.

    However far beyond a limit, a trial that ends is better than one that fails.
    """

    def __init__(self, share: np.ndarray, requirements: int, margin: float):
        self.margin, self.share = margin, share.copy()  # (gains,) where nothing better is known
        self.f = self.value = self.over = self.lost = np.inf
        self.worst = np.full(requirements, np.inf)  # largest metric / limit

    @property
    def failed(self) -> bool:
        """Whether a trial fails there, or has no value."""
        return 0.0 < self.lost < np.inf

    @property
    def beyond(self) -> tuple[float, float]:
        """How many trials fail there, or have no value, and how far it is over: none of it where it is admissible."""
        return self.lost, self.over

    @property
    def rank(self) -> tuple[float, float, float]:
        """The less, the better."""
        return self.lost, self.over, self.f

    @property
    def so_far(self) -> tuple[float, float]:
        """Its goal, and how far it is beyond a limit; not numbers where none has been offered."""
        return (self.value, self.over) if np.isfinite(self.f) else (np.nan, np.nan)

    def offer(self, share: np.ndarray, seen: Measured) -> None:
        """Keep the best of these points, (points, gains), if it is better; admissible is what keeps the margin."""
        worst = largest(seen.c, self.margin)
        over = np.maximum(worst.max(axis=1, initial=0.0) - (1.0 - self.margin + SLACK), 0.0)
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
    # the points that a shorter descent from here looked at, which are not flown again: a longer one goes on from there
    seen: dict[bytes, Sloped] = field(default_factory=dict)


def descend(
    slopes: Callable[[np.ndarray], Sloped],
    best: Best,
    start: Start,
    steps: int,
    keep: Callable[[Sloped], None],
    close: float = CLOSE,
) -> None:
    """Go downhill from a start inside the bounds.

    Args:
        slopes: measures the problem at a point (1, gains).
        best: is offered every point.
        start: where it begins.
        steps: how many points may be looked at.
        keep: is called with what was measured at each point that the descent goes through, without those that it only
            tries.
        close: change of F at which it ends.
    """
    seen, scale = start.seen, start.scale

    def at(scaled: np.ndarray) -> Sloped:
        key, point = scaled.tobytes(), np.clip(scaled / scale, 0.0, 1.0)[None]
        if key not in seen:
            if len(seen) == steps:
                raise _EnoughError
            seen[key] = slopes(point)
        if seen[key].finite[0]:
            best.offer(point, seen[key])
        return seen[key]

    limits = {
        "type": "ineq",
        "fun": lambda scaled: -ended(at(scaled).c).reshape(-1),
        "jac": lambda scaled: -_usable(at(scaled).c_slope.reshape(-1, scaled.size)) / scale,
    }

    def passed(scaled: np.ndarray) -> None:
        if scaled.tobytes() in seen:
            keep(seen[scaled.tobytes()])

    first = scale * start.share
    at_start = at(first)
    keep(at_start)
    with contextlib.suppress(_EnoughError):
        minimize(
            lambda scaled: float(at(scaled).f[0]),
            first.copy(),
            jac=lambda scaled: _usable(at(scaled).f_slope)[0] / scale,
            method="SLSQP",
            bounds=[(own, own) if k in start.fixed else (0.0, scale) for k, own in enumerate(first)],
            constraints=[limits] if at_start.c.shape[1] else [],
            callback=passed,
            options={"maxiter": steps, "ftol": close},
        )


def prices(at: Sloped, share: np.ndarray) -> np.ndarray:
    """(rows,) what F pays for each limit at an optimum (gains,), over c; none for those that are not active.

    Lagrange multipliers, by least squares over the gains that are not on a bound.
    """
    c, inside = ended(at.c[0]), (share > 0.0) & (share < 1.0)
    active = np.flatnonzero(c.max(axis=1, initial=-1.0) > -ACTIVE)
    slopes = at.c_slope[0, active, c[active].argmax(axis=1)]
    paid = np.zeros(len(c))
    if active.size and inside.any():
        paid[active] = nnls(_usable(slopes)[:, inside].T, -_usable(at.f_slope)[0, inside])[0]
    return paid


def _usable(slopes: np.ndarray) -> np.ndarray:
    """Slopes, (rows, gains), cut down to `STEEPEST`; zeros for a row with a number that is not finite."""
    size = np.abs(slopes).max(axis=1, keepdims=True)
    known = np.where(np.isfinite(size), slopes, 0.0)
    return known * np.minimum(1.0, STEEPEST / np.maximum(np.where(np.isfinite(size), size, 1.0), 1e-300))
