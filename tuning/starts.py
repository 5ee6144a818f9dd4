"""Where a search starts: points spread over the bounds, and the most promising of them, one of each valley."""

import warnings
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from scipy.stats import qmc

from tuning.evaluate import Evaluator, Measured
from tuning.objective import Problem

SWEPT = 64  # points flown, among which starts are chosen
CALL = 16  # of them between two reports
CHARGE, APART = 3.0, 0.15
STEEP = 10.0  # times the charge, where many points are close to a limit
CHOOSING = "choosing starts"
# what is being done, steps done, in all, best goal, how far beyond a limit
Report = Callable[[str, int, int, float, float], None]


def starting_points(
    evaluate: Evaluator, problem: Problem, own: np.ndarray, starts: int, seed: int, report: Report
) -> np.ndarray:
    """(starts, gains) shares: the scenario's own gains first, then the most promising of a Latin hypercube."""
    first = evaluate.bounds.share(own)[None]
    if starts == 1:
        return first
    share = spread(len(problem.names), max(SWEPT, starts), np.random.default_rng(seed))
    return np.concatenate([first, promising(evaluate, problem, share, starts - 1, partial(report, CHOOSING))])


def spread(gains: int, count: int, rng: np.random.Generator) -> np.ndarray:
    """(count, gains) shares spread evenly: Sobol's sequence, scrambled."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # counts other than powers of 2 are a little less even
        return qmc.Sobol(gains, rng=rng).random(count)


def promising(evaluate: Evaluator, problem: Problem, share: np.ndarray, count: int, tell: Callable) -> np.ndarray:
    """So many of the points, (points, gains), by F with breaches of a limit charged: one of each valley first.

    By turns charged little and much: what is far beyond a limit may lead to better gains, and what keeps it is near.
    """
    flown = []
    for k in range(0, len(share), CALL):
        flown.append(evaluate.fly(problem, share[k : k + CALL]))
        tell(min(k + CALL, len(share)), len(share), np.nan, np.nan)
    apart = np.abs(share[:, None] - share[None]).max(axis=2)
    ranked = [_valleys_first(np.concatenate([merit(one, times) for one in flown]), apart) for times in (1.0, STEEP)]
    queue = [k for pair in zip(*ranked, strict=True) for k in pair]
    chosen: list[int] = []
    for distance in (APART, 0.0):
        for k in queue:
            if len(chosen) < count and k not in chosen and np.all(apart[k, chosen] >= distance):
                chosen.append(k)
    return share[chosen]


def _valleys_first(merits: np.ndarray, apart: np.ndarray) -> list[int]:
    """Points by their merit, those first that have no better one within `APART`, in the unit cube.

    They are taken for the lowest of their valley, as in multi-level single linkage (Rinnooy Kan and Timmer, Math.
    Programming 39, 1987).
    """
    order = [int(k) for k in np.argsort(merits, kind="stable") if np.isfinite(merits[k])]
    lowest = [k for rank, k in enumerate(order) if np.all(apart[k, order[:rank]] >= APART)]
    return lowest + [k for k in order if k not in lowest]


def merit(flown: Measured, times: float = 1.0) -> np.ndarray:
    """(points,) F, with what the trials that end are beyond a limit charged, so many times as hard."""
    return charged(flown.f, flown.beyond, times)


def charged(f: Any, beyond: Any, times: float) -> Any:
    """F with a breach of a limit charged, so many times as hard."""
    return f + CHARGE * np.log1p(times * np.maximum(beyond, 0.0))
