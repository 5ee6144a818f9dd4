"""Where a search starts: points spread over the bounds, and the most promising of them, one of each valley."""

from collections.abc import Callable
from functools import partial

import numpy as np
from scipy.stats import qmc

from tuning.evaluate import Evaluator, Measured
from tuning.objective import Problem

CANDIDATES = 128  # points flown for each start that is chosen
CHARGE, APART = 3.0, 0.15
EDGE = 3e-4  # share of each interval that is left out at both ends
CHOOSING = "choosing starts"
# what is being done, steps done, in all, best goal, how far beyond a limit
Report = Callable[[str, int, int, float, float], None]


def starting_points(
    evaluate: Evaluator, problem: Problem, own: np.ndarray, starts: int, seed: int, report: Report
) -> np.ndarray:
    """(starts, gains) free reals: the scenario's own gains first, then the most promising of a Latin hypercube."""
    first = evaluate.bounds.free(own)[None]
    if starts == 1:
        return first
    share = qmc.LatinHypercube(len(problem.names), rng=np.random.default_rng(seed)).random(CANDIDATES * starts)
    z = logit(toward_edges(share))
    return np.concatenate([first, promising(evaluate, problem, z, starts - 1, partial(report, CHOOSING))])


def promising(evaluate: Evaluator, problem: Problem, z: np.ndarray, count: int, tell: Callable) -> np.ndarray:
    """So many of the points z, (points, gains), by F with breaches of a limit charged: one of each valley first.

    A point that has no better one within `APART` of it, in the unit cube, is taken for the lowest of its valley (as in
    multi-level single linkage, Rinnooy Kan and Timmer, Math. Programming 39, 1987); the others follow, not too close.
    """
    found = []
    for k in range(0, len(z), 64):
        found.append(merit(evaluate.fly(problem, z[k : k + 64])))
        tell(min(k + 64, len(z)), len(z), np.nan, np.nan)
    merits, share = np.concatenate(found), share_of(z)
    order = np.asarray([k for k in np.argsort(merits, kind="stable") if np.isfinite(merits[k])], dtype=int)
    apart = np.abs(share[order, None] - share[None, order]).max(axis=2)  # row and column by merit
    lowest = [k for k in range(len(order)) if np.all(apart[k, :k] >= APART)]
    chosen: list[int] = []
    for candidates, distance in ((lowest, 0.0), (range(len(order)), APART), (range(len(order)), 0.0)):
        for k in candidates:
            if len(chosen) < count and k not in chosen and np.all(apart[k, chosen] >= distance):
                chosen.append(k)
    return z[order[chosen]]


def merit(flown: Measured, times: float = 1.0) -> np.ndarray:
    """(points,) F, with what the trials that end are beyond a limit charged, so many times as hard."""
    return flown.f + CHARGE * np.log1p(times * np.maximum(flown.beyond, 0.0))


def toward_edges(uniform: np.ndarray) -> np.ndarray:
    """Shares of the bounds' intervals, denser toward both ends (arcsine law): optima often lie near bounds."""
    return np.clip(0.5 - 0.5 * np.cos(np.pi * uniform), EDGE, 1.0 - EDGE)


def share_of(z: np.ndarray) -> np.ndarray:
    """Shares of the bounds' intervals of free reals."""
    return 1.0 / (1.0 + np.exp(-z))


def logit(share: np.ndarray) -> np.ndarray:
    """Free reals of shares of the bounds' intervals."""
    return np.log(share / (1.0 - share))
