"""Other hand-over times t_f - delta for a point of a search: on neighbouring samples, and farther away.

Points are normalised gains, 0 at the lower bound and 1 at the upper bound. Read `on_samples` first.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from tuning.search.normalisation import TIMES, Bounds
from tuning.search.objective import Problem

LATER = 4  # number of consecutive samples that t_f moves the hand-over to, from the sample before it
OTHER_HAND_OVERS = 16  # largest number of hand-overs from `other_hand_overs`
FACTOR = 2.0  # largest ratio of their delta to the present delta, and inverse of the smallest ratio


@dataclass(frozen=True)
class _HandOver:
    """The hand-over of one point of a search, in s."""

    normalised: np.ndarray  # (gains,) normalised gains
    bounds: Bounds
    gains: np.ndarray  # (gains,)
    at: dict[str, int]  # indices of delta and t_f among the free gains
    t_f: float
    delta: float
    period: float  # sampling period

    def moved(self, name: str, time: float) -> np.ndarray | None:
        """Return the normalised gains with another time, or None if the time is outside its bounds."""
        k = self.at[name]
        if not self.bounds.lower[k] * (1 - 1e-9) <= time <= self.bounds.upper[k]:
            return None
        gains, there = self.gains.copy(), self.normalised.copy()
        gains[k] = time
        there[k] = self.bounds.normalise(gains)[k]
        return there


def _of(problem: Problem, bounds: Bounds, normalised: np.ndarray) -> _HandOver | None:
    """Return the hand-over of a point, or None if no free gain moves it or the clock is not anchored to it."""
    clock: Any = problem.parts.clock
    law, at = problem.parts.controller, {name: k for k, name in enumerate(problem.names) if name in TIMES}
    if not at or not clock.anchored or "delta" not in law.tunable:  # a law without delta has no hand-over
        return None
    values = bounds.gains(normalised)
    t_f, delta = (float(values[at[name]] if name in at else getattr(law, name)) for name in ("t_f", "delta"))
    return _HandOver(normalised, bounds, values, at, t_f, delta, float(clock.period))


def on_samples(problem: Problem, bounds: Bounds, normalised: np.ndarray) -> list[np.ndarray]:
    """Return points whose hand-over lies on a sample near the present hand-over.

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
    here = _of(problem, bounds, normalised)
    if here is None:
        return []
    samples, moves = (here.t_f - here.delta) / here.period, list[np.ndarray | None]()
    before, behind = math.floor(samples + 1e-9), math.ceil(samples - 1e-9)
    if "delta" in here.at:
        moves += [here.moved("delta", here.t_f - sample * here.period) for sample in sorted({before, behind})]
    if "t_f" in here.at:  # if t_f is as short as the limits allow, another delta may break a limit
        later = range(before, before + LATER)
        moves += [here.moved("t_f", sample * here.period + here.delta) for sample in later]
    return [there for there in moves if there is not None]


def other_hand_overs(problem: Problem, bounds: Bounds, normalised: np.ndarray) -> list[np.ndarray]:
    """Return points with other hand-overs, on samples spread evenly over delta / `FACTOR` to delta * `FACTOR`.

    Args:
        problem: the tuning problem.
        bounds: bounds of the free gains.
        normalised: (gains,) normalised gains of the point.

    Returns:
        Normalised gains, (gains,) each. The list is empty if delta is not free.
    """
    here = _of(problem, bounds, normalised)
    if here is None or "delta" not in here.at:
        return []
    k = here.at["delta"]
    longest, shortest = min(bounds.upper[k], FACTOR * here.delta), max(bounds.lower[k], here.delta / FACTOR)
    first, last = ((here.t_f - delta) / here.period for delta in (longest, shortest))
    spread = np.linspace(math.ceil(first - 1e-9), math.floor(last + 1e-9), OTHER_HAND_OVERS)
    moves = [here.moved("delta", here.t_f - sample * here.period) for sample in np.unique(np.round(spread)).tolist()]
    return [there for there in moves if there is not None]
