"""Other hand-over times t_f - delta for a point of a search: on neighbouring samples, and farther away.

Points are normalised gains, 0 at the lower bound and 1 at the upper bound. Read `points_on_samples` first.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from tuning.search.normalisation import TIMES, Bounds
from tuning.search.objective import Problem

SAMPLES_AHEAD = 4  # number of consecutive samples that t_f moves the hand-over to, from the sample before it
OTHER_HAND_OVERS = 16  # largest number of hand-overs from `other_hand_overs`
DELTA_RATIO = 2.0  # largest ratio of their delta to the present delta, and inverse of the smallest ratio


@dataclass(frozen=True)
class _HandOver:
    """The hand-over of one point of a search, in s."""

    normalised: np.ndarray  # (gains,) normalised gains
    bounds: Bounds
    gains: np.ndarray  # (gains,)
    at: dict[str, int]  # indices of delta and t_f among the free gains
    t_f: float
    delta: float
    period: float  # control period

    def with_time(self, name: str, time: float) -> np.ndarray | None:
        """Return the normalised gains with another time, or None if the time is outside its bounds."""
        k = self.at[name]
        if not self.bounds.lower[k] * (1 - 1e-9) <= time <= self.bounds.upper[k]:
            return None
        gains, point = self.gains.copy(), self.normalised.copy()
        gains[k] = time
        point[k] = self.bounds.normalise(gains)[k]
        return point


def _find_hand_over(problem: Problem, bounds: Bounds, normalised: np.ndarray) -> _HandOver | None:
    """Return the hand-over of a point, or None if no free gain moves it or the clock is not anchored to it."""
    clock: Any = problem.parts.clock
    law, indices = problem.parts.controller, {name: k for k, name in enumerate(problem.names) if name in TIMES}
    if not indices or not clock.anchored or "delta" not in law.tunable:  # a law without delta has no hand-over
        return None
    gains = bounds.gains(normalised)
    t_f, delta = (float(gains[indices[name]] if name in indices else getattr(law, name)) for name in ("t_f", "delta"))
    return _HandOver(normalised, bounds, gains, indices, t_f, delta, float(clock.period))


def points_on_samples(problem: Problem, bounds: Bounds, normalised: np.ndarray) -> list[np.ndarray]:
    """Return points whose hand-over t_f - delta is at a controller sample near the present hand-over.

    A flight computer hands over at its first sample at or after t_f - delta. The anchored clock of the search has a
    sample exactly at t_f - delta. Both agree only if t_f - delta is a multiple of the period.

    Args:
        problem: the tuning problem.
        bounds: bounds of the free gains.
        normalised: (gains,) normalised gains of the point.

    Returns:
        Normalised gains, (gains,) each. The list is empty if no free gain moves the hand-over or the clock is not
        anchored to it.
    """
    now = _find_hand_over(problem, bounds, normalised)
    if now is None:
        return []
    samples, points = (now.t_f - now.delta) / now.period, list[np.ndarray | None]()
    sample_before, sample_after = math.floor(samples + 1e-9), math.ceil(samples - 1e-9)
    if "delta" in now.at:
        points += [
            now.with_time("delta", now.t_f - sample * now.period) for sample in sorted({sample_before, sample_after})
        ]
    if "t_f" in now.at:  # if t_f is as short as the limits allow, another delta may break a limit
        samples_ahead = range(sample_before, sample_before + SAMPLES_AHEAD)
        points += [now.with_time("t_f", sample * now.period + now.delta) for sample in samples_ahead]
    return [point for point in points if point is not None]


def other_hand_overs(problem: Problem, bounds: Bounds, normalised: np.ndarray) -> list[np.ndarray]:
    """Return points with other hand-overs, with delta up to `DELTA_RATIO` times longer or shorter.

    Args:
        problem: the tuning problem.
        bounds: bounds of the free gains.
        normalised: (gains,) normalised gains of the point.

    Returns:
        Normalised gains, (gains,) each. The list is empty if delta is not free.
    """
    now = _find_hand_over(problem, bounds, normalised)
    if now is None or "delta" not in now.at:
        return []
    k = now.at["delta"]
    longest, shortest = (min(bounds.upper[k], DELTA_RATIO * now.delta), max(bounds.lower[k], now.delta / DELTA_RATIO))
    first, last = ((now.t_f - delta) / now.period for delta in (longest, shortest))
    spread = np.linspace(math.ceil(first - 1e-9), math.floor(last + 1e-9), OTHER_HAND_OVERS)
    points = [now.with_time("delta", now.t_f - sample * now.period) for sample in np.unique(np.round(spread)).tolist()]
    return [point for point in points if point is not None]
