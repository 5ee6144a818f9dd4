"""Where a search starts: points spread over the bounds, and the most promising of them that lie far apart."""

import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from tuning.search.evaluate import Evaluator, Measured, Sloped
from tuning.search.objective import FAILED, Problem, failures
from tuning.search.progress import Report

SWEPT = 64  # points flown, among which starts are chosen
CALL = 16  # of them between two reports
CHARGE = 3.0  # F is a logarithm: a metric at twice its limit counts like 2^3 times the error
APART = (0.5, 0.35, 0.2, 0.0)  # in the unit cube, along the gain in which two points differ most
STEEP = 10.0  # times the charge, where many points are close to a limit
CHOOSING, SPREADING = "choosing starts", "searching the whole box"
WIDELY, MARGINS_LOOKED = 2048, 256  # points of a global search, and how many of them margins are evaluated for
NEARLY = 0.05  # of a limit


def starting_points(
    evaluate: Evaluator,
    problem: Problem,
    first: np.ndarray,
    designs: np.ndarray,
    starts: int,
    seed: int,
    report: Report,
) -> np.ndarray:
    """Return `first`, then the most promising points of designs and a Sobol sweep that lie far apart.

    The sweep fixes the gain with the largest effect on each nearly active limit, such as eta for the peak torque.
    Otherwise most of its points would break the limit.

    Args:
        evaluate: measures the problem.
        problem: what is minimised.
        first: (gains,) shares of the first point.
        designs: (designs, gains) shares.
        starts: how many points to return.
        seed: of the sweep.
        report: is called after every few points.

    Returns:
        (starts, gains) shares.
    """
    share = spread(len(problem.names), max(SWEPT - len(designs), starts), np.random.default_rng(seed))
    held = held_by_limits(evaluate.slopes(problem, first[None]))
    share[:, held] = first[held]
    share = np.concatenate([designs.reshape(-1, first.size), share])
    chosen = promising(evaluate, problem, share, starts - 1, partial(report, CHOOSING))
    return np.concatenate([first[None], chosen])


def spread_widely(evaluate: Evaluator, problem: Problem, count: int, seed: int, report: Report) -> np.ndarray:
    """Return the most promising of `WIDELY` points of the whole box that lie far apart, (count, gains) shares.

    Margins take far longer than simulations and can only add to a violation. The points are sorted by their merit
    without margins, and margins are evaluated in this order. That stops when the next merit cannot be among the best,
    or after `MARGINS_LOOKED` points.
    """
    share = spread(len(problem.names), WIDELY, np.random.default_rng(seed))
    without = problem if problem.margins is None else replace(problem, margins=None)
    merits = np.zeros(0)
    for k in range(0, WIDELY, CALL):
        merits = np.append(merits, merit(evaluate.fly(without, share[k : k + CALL]), STEEP))
        report(SPREADING, k + CALL, WIDELY, np.nan, np.nan)
    order = np.argsort(merits, kind="stable")
    if without is not problem:
        known = np.full(WIDELY, np.inf)
        for k in range(0, MARGINS_LOOKED, CALL):
            some = order[k : k + CALL]
            if merits[some[0]] >= np.sort(known)[count]:
                break
            known[some] = merit(evaluate.fly(problem, share[some]), STEEP)
            report(SPREADING, WIDELY, WIDELY, np.nan, np.nan)
        merits = known
        order = np.argsort(merits, kind="stable")
    promising = [int(k) for k in order[: 8 * count] if np.isfinite(merits[k])]
    return share[far_apart(promising, distances(share), count)]


def held_by_limits(at: Sloped) -> list[int]:
    """For each limit that is nearly active at a point, the gain that it depends on most; at least two stay free."""
    nearest = at.c[0].argmax(axis=1)
    held: list[int] = []
    for row in np.argsort(-at.c[0].max(axis=1)):
        largest, slope = at.c[0, row, nearest[row]], np.abs(at.c_slope[0, row, nearest[row]])
        free = [k for k in np.argsort(-slope) if k not in held]
        if largest > -NEARLY and len(free) > 2 and slope[free[0]] > 0.0:
            held.append(int(free[0]))
    return held


def spread(gains: int, count: int, rng: np.random.Generator) -> np.ndarray:
    """(count, gains) shares spread evenly: Sobol's sequence, scrambled."""
    from scipy.stats import qmc  # takes half a second, in which a search flies

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # counts other than powers of 2 are a little less even
        return qmc.Sobol(gains, rng=rng).random(count)


def promising(evaluate: Evaluator, problem: Problem, share: np.ndarray, count: int, tell: Callable) -> np.ndarray:
    """Choose so many of the points, (points, gains), by F with breaches of a limit charged, those far apart first.

    By turns charged little and much: what is far beyond a limit may lead to better gains, and what keeps it is near.
    """
    flown = []
    for k in range(0, len(share), CALL):
        flown.append(evaluate.fly(problem, share[k : k + CALL]))
        tell(min(k + CALL, len(share)), len(share), np.nan, np.nan)
    apart = distances(share)
    orders = []
    for times in (1.0, STEEP):
        merits = np.concatenate([merit(one, times) for one in flown])
        orders.append([int(k) for k in np.argsort(merits, kind="stable") if np.isfinite(merits[k])])
    queue = [k for pair in zip(*orders, strict=True) for k in pair]
    return share[far_apart(queue, apart, count)]


def distances(share: np.ndarray) -> np.ndarray:
    """(points, points) how far apart points are, in the unit cube."""
    return np.abs(share[:, None] - share[None]).max(axis=2)


def far_apart(order: Sequence[int], apart: np.ndarray, count: int) -> list[int]:
    """Choose so many of the points in this order, those first that lie far from all before them.

    With few gains, or many points to choose, they cannot all lie far apart: then nearer ones, step by step.
    """
    chosen: list[int] = []
    for distance in APART:
        for k in order:
            if len(chosen) < count and k not in chosen and np.all(apart[k, chosen] >= distance):
                chosen.append(k)
    return chosen


def merit(flown: Measured, times: float = 1.0) -> np.ndarray:
    """(points,) F, with what the trials that end are beyond a limit charged so many times as hard, and each that fails.

    F knows of those alone that are averaged, and where t_f is minimised of none.
    """
    return charged(flown.f + math.log(FAILED) * failures(flown.c), flown.beyond, times)


def charged(f: Any, beyond: Any, times: float) -> Any:
    """F with a breach of a limit charged, so many times as hard."""
    return f + CHARGE * np.log1p(times * np.maximum(beyond, 0.0))
