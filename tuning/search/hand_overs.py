"""Hand-overs near that of a point of a search: on the samples beside it, and elsewhere."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from tuning.search.objective import Problem
from tuning.search.shares import TIMES, Bounds

LATER = 4  # samples from the one before the hand-over on, to which it is moved with t_f
LOOKED = 16  # hand-overs looked at elsewhere, at most
FACTOR = 2.0  # times delta, and its inverse, between which these lie


@dataclass(frozen=True)
class _HandOver:
    """The hand-over of one point of a search."""

    share: np.ndarray  # (gains,) of the bounds' intervals
    bounds: Bounds
    gains: np.ndarray  # (gains,)
    at: dict[str, int]  # where its free times stand among them
    t_f: float
    delta: float
    period: float  # between samples

    def moved(self, name: str, time: float) -> np.ndarray | None:
        """The point's shares with another time; None: it is beyond a bound."""
        k = self.at[name]
        if not self.bounds.lower[k] * (1 - 1e-9) <= time <= self.bounds.upper[k]:
            return None
        gains, there = self.gains.copy(), self.share.copy()
        gains[k] = time
        there[k] = self.bounds.share(gains)[k]
        return there


def _of(problem: Problem, bounds: Bounds, share: np.ndarray) -> _HandOver | None:
    """The hand-over of a point, or None where no gain moves it or the clock does not move along with it."""
    clock: Any = problem.parts.clock
    law, at = problem.parts.controller, {name: k for k, name in enumerate(problem.names) if name in TIMES}
    if not at or not clock.anchored or "delta" not in law.tunable:  # a law without it does not hand over
        return None
    own = bounds.gains(share)
    t_f, delta = (float(own[at[name]] if name in at else getattr(law, name)) for name in ("t_f", "delta"))
    return _HandOver(share, bounds, own, at, t_f, delta, float(clock.period))


def on_samples(problem: Problem, bounds: Bounds, share: np.ndarray) -> list[np.ndarray]:
    """Shares, (gains,), with the nearest hand-overs that are flown as they are trained; none where all are.

    A flight computer hands over at its first sample not before t_f - delta, which the anchored clock has at it.
    """
    here = _of(problem, bounds, share)
    if here is None:
        return []
    samples, moves = (here.t_f - here.delta) / here.period, list[np.ndarray | None]()
    before, behind = math.floor(samples + 1e-9), math.ceil(samples - 1e-9)
    if "delta" in here.at:
        moves += [here.moved("delta", here.t_f - sample * here.period) for sample in sorted({before, behind})]
    if "t_f" in here.at:  # where it is as short as limits allow, another delta may break one
        later = range(before, before + LATER)
        moves += [here.moved("t_f", sample * here.period + here.delta) for sample in later]
    return [there for there in moves if there is not None]


def elsewhere(problem: Problem, bounds: Bounds, share: np.ndarray) -> list[np.ndarray]:
    """Shares, (gains,), with other hand-overs by delta, on samples spread evenly over `FACTOR` of it to either side.

    None where delta is not free.
    """
    here = _of(problem, bounds, share)
    if here is None or "delta" not in here.at:
        return []
    k = here.at["delta"]
    longest, shortest = min(bounds.upper[k], FACTOR * here.delta), max(bounds.lower[k], here.delta / FACTOR)
    first, last = ((here.t_f - delta) / here.period for delta in (longest, shortest))
    spread = np.linspace(math.ceil(first - 1e-9), math.floor(last + 1e-9), LOOKED)
    moves = [here.moved("delta", here.t_f - sample * here.period) for sample in np.unique(np.round(spread)).tolist()]
    return [there for there in moves if there is not None]
