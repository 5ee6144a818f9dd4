"""Other hand-over times t_f - delta for a point of a search: on neighbouring samples, and farther away.

Points are normalised gains, 0 at the lower bound and 1 at the upper bound. Read `points_on_samples` first.
"""

import math
from typing import Any

import numpy as np

from tuning.search.normalisation import TIMES, Bounds
from tuning.search.objective import Problem

SAMPLES_AHEAD = 4  # number of consecutive samples that t_f moves the hand-over to, from the sample before it
OTHER_HAND_OVERS = 16  # largest number of hand-overs from `other_hand_overs`
DELTA_RATIO = 2.0  # largest ratio of their delta to the present delta, and inverse of the smallest ratio


def _find_hand_over(problem: Problem, bounds: Bounds, normalised: np.ndarray) -> tuple[float, float, float] | None:
    """Return t_f, delta and the control period of a point [s].

    The result is None if no free gain moves the hand-over or the clock is not anchored to it.
    """
    clock: Any = problem.parts.clock
    law, gains = problem.parts.controller, dict(zip(problem.names, bounds.gains(normalised), strict=True))
    if not gains.keys() & set(TIMES) or not clock.anchored or "delta" not in law.tunable:
        return None  # a law without delta has no hand-over
    t_f, delta = (float(gains[name] if name in gains else getattr(law, name)) for name in ("t_f", "delta"))
    return t_f, delta, float(clock.period)


def _with_times(
    problem: Problem, bounds: Bounds, normalised: np.ndarray, times: list[tuple[str, float]]
) -> list[np.ndarray]:
    """Return a copy of a point (gains,) for each of these times, in a list without times outside their bounds.

    Args:
        problem: the tuning problem.
        bounds: bounds of the free gains.
        normalised: (gains,) normalised gains of the point.
        times: pairs of a gain's name and its time [s], which replaces the time of the point.
    """
    points = []
    for name, time in times:
        k = problem.names.index(name)
        if bounds.lower[k] * (1 - 1e-9) <= time <= bounds.upper[k]:
            gains, point = bounds.gains(normalised), normalised.copy()
            gains[k] = time
            point[k] = bounds.normalise(gains)[k]
            points.append(point)
    return points


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
    hand_over = _find_hand_over(problem, bounds, normalised)
    if hand_over is None:
        return []
    t_f, delta, period = hand_over
    samples, times = (t_f - delta) / period, list[tuple[str, float]]()
    sample_before, sample_after = math.floor(samples + 1e-9), math.ceil(samples - 1e-9)
    if "delta" in problem.names:
        times += [("delta", t_f - sample * period) for sample in sorted({sample_before, sample_after})]
    if "t_f" in problem.names:  # if t_f is as short as the limits allow, another delta may break a limit
        samples_ahead = range(sample_before, sample_before + SAMPLES_AHEAD)
        times += [("t_f", sample * period + delta) for sample in samples_ahead]
    return _with_times(problem, bounds, normalised, times)


def other_hand_overs(problem: Problem, bounds: Bounds, normalised: np.ndarray) -> list[np.ndarray]:
    """Return points with other hand-overs, with delta up to `DELTA_RATIO` times longer or shorter.

    Args:
        problem: the tuning problem.
        bounds: bounds of the free gains.
        normalised: (gains,) normalised gains of the point.

    Returns:
        Normalised gains, (gains,) each. The list is empty if delta is not free.
    """
    hand_over = _find_hand_over(problem, bounds, normalised)
    if hand_over is None or "delta" not in problem.names:
        return []
    (t_f, delta, period), k = hand_over, problem.names.index("delta")
    longest, shortest = min(bounds.upper[k], DELTA_RATIO * delta), max(bounds.lower[k], delta / DELTA_RATIO)
    first, last = ((t_f - other) / period for other in (longest, shortest))
    spread = np.linspace(math.ceil(first - 1e-9), math.floor(last + 1e-9), OTHER_HAND_OVERS)
    times = [("delta", t_f - sample * period) for sample in np.unique(np.round(spread)).tolist()]
    return _with_times(problem, bounds, normalised, times)
