"""Starting points of local searches: the most promising of many points within the bounds that lie far apart.

Points are normalised gains, 0 at the lower bound and 1 at the upper bound. Read `starting_points` first.
"""

import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from tuning.search.evaluate import Evaluator, Measured, MeasuredWithGradients
from tuning.search.objective import FAILED, Problem, failures
from tuning.search.progress import Report

SWEPT = 64  # points that are simulated to choose starting points
REPORT_EVERY = 16  # points between two reports
PENALTY = 3.0  # F is a logarithm: a metric at twice its limit counts like 2^3 times the error
APART = (0.5, 0.35, 0.2, 0.0)  # smallest distances in the unit cube (maximum norm), tried in this order
STEEP = 10.0  # factor on the violation in the penalty, if many points are close to a limit
SPREADING = "searching the whole box"
WIDELY, MARGINS_LOOKED = 2048, 256  # points of a global search; largest number of them with margins
NEARLY = 0.05  # a limit is nearly active if c > -NEARLY


def starting_points(
    evaluate: Evaluator,
    problem: Problem,
    first: np.ndarray,
    designs: np.ndarray,
    starts: int,
    seed: int,
    report: Report,
) -> np.ndarray:
    """Return `first`, then the most promising points of designs and a Sobol sequence that lie far apart.

    The gain with the largest effect on each nearly active limit has the same value at all points of the sequence. An
    example is eta for the peak torque. Otherwise most of these points would break the limit.

    Args:
        evaluate: measures the problem.
        problem: the tuning problem.
        first: (gains,) normalised gains of the first point.
        designs: (designs, gains) normalised gains of designs that follow from the mission.
        starts: number of points to return.
        seed: seed of the Sobol sequence.
        report: is called after every `REPORT_EVERY` points.

    Returns:
        Normalised gains, (starts, gains).
    """
    normalised = spread(len(problem.names), max(SWEPT - len(designs), starts), np.random.default_rng(seed))
    held = held_by_limits(evaluate.measure_with_gradients(problem, first[None]))
    normalised[:, held] = first[held]
    normalised = np.concatenate([designs.reshape(-1, first.size), normalised])
    chosen = promising(evaluate, problem, normalised, starts - 1, partial(report, "ranking starting points"))
    return np.concatenate([first[None], chosen])


def global_starting_points(evaluate: Evaluator, problem: Problem, count: int, seed: int, report: Report) -> np.ndarray:
    """Return the most promising of `WIDELY` points of the whole box that lie far apart.

    Margins take far longer than simulations and can only increase a violation. The points are therefore sorted by
    their merit without margins, and margins are evaluated in this order. The evaluation ends when the next point
    cannot be among the best, or after `MARGINS_LOOKED` points.

    Args:
        evaluate: measures the problem.
        problem: the tuning problem.
        count: number of points to return.
        seed: seed of the Sobol sequence.
        report: is called after every `REPORT_EVERY` points.

    Returns:
        Normalised gains, (count, gains).
    """
    normalised = spread(len(problem.names), WIDELY, np.random.default_rng(seed))
    without = problem if problem.margins is None else replace(problem, margins=None)
    merits = np.zeros(0)
    for k in range(0, WIDELY, REPORT_EVERY):
        merits = np.append(merits, merit(evaluate.measure(without, normalised[k : k + REPORT_EVERY]), STEEP))
        report(SPREADING, k + REPORT_EVERY, WIDELY, np.nan, np.nan)
    order = np.argsort(merits, kind="stable")
    if without is not problem:
        known = np.full(WIDELY, np.inf)
        for k in range(0, MARGINS_LOOKED, REPORT_EVERY):
            some = order[k : k + REPORT_EVERY]
            if merits[some[0]] >= np.sort(known)[count]:
                break
            known[some] = merit(evaluate.measure(problem, normalised[some]), STEEP)
            report(SPREADING, WIDELY, WIDELY, np.nan, np.nan)
        merits = known
        order = np.argsort(merits, kind="stable")
    promising = [int(k) for k in order[: 8 * count] if np.isfinite(merits[k])]
    return normalised[far_apart(promising, distances(normalised), count)]


def held_by_limits(at: MeasuredWithGradients) -> list[int]:
    """Return the index of the gain that each nearly active limit depends on most. At least two gains stay free."""
    nearest = at.c[0].argmax(axis=1)
    held: list[int] = []
    for row in np.argsort(-at.c[0].max(axis=1)):
        largest, gradient = at.c[0, row, nearest[row]], np.abs(at.c_gradient[0, row, nearest[row]])
        free = [k for k in np.argsort(-gradient) if k not in held]
        if largest > -NEARLY and len(free) > 2 and gradient[free[0]] > 0.0:
            held.append(int(free[0]))
    return held


def spread(gains: int, count: int, rng: np.random.Generator) -> np.ndarray:
    """Return points of a scrambled Sobol sequence in the unit cube.

    Args:
        gains: dimension of the cube.
        count: number of points.
        rng: random generator of the scrambling.

    Returns:
        Normalised gains, (count, gains).
    """
    from scipy.stats import qmc  # imported here because the import takes half a second

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # counts other than powers of 2 are a little less even
        return qmc.Sobol(gains, rng=rng).random(count)


def promising(evaluate: Evaluator, problem: Problem, normalised: np.ndarray, count: int, tell: Callable) -> np.ndarray:
    """Choose points by their merit, with points that lie far apart first.

    The points are ranked twice, with a weak and with a strong penalty on violations, and are taken from both rankings
    in turn. Points far beyond a limit may lead to better gains. Points that meet every limit need few further steps.

    Args:
        evaluate: measures the problem.
        problem: the tuning problem.
        normalised: (points, gains) normalised gains to choose from.
        count: number of points to choose.
        tell: is called after every `REPORT_EVERY` points, as a `Report` without its first argument.

    Returns:
        Normalised gains, (count, gains).
    """
    measured = []
    for k in range(0, len(normalised), REPORT_EVERY):
        measured.append(evaluate.measure(problem, normalised[k : k + REPORT_EVERY]))
        tell(min(k + REPORT_EVERY, len(normalised)), len(normalised), np.nan, np.nan)
    apart = distances(normalised)
    orders = []
    for times in (1.0, STEEP):
        merits = np.concatenate([merit(one, times) for one in measured])
        orders.append([int(k) for k in np.argsort(merits, kind="stable") if np.isfinite(merits[k])])
    queue = [k for pair in zip(*orders, strict=True) for k in pair]
    return normalised[far_apart(queue, apart, count)]


def distances(normalised: np.ndarray) -> np.ndarray:
    """Return the distances of points (points, gains) in the maximum norm, (points, points)."""
    return np.abs(normalised[:, None] - normalised[None]).max(axis=2)


def far_apart(order: Sequence[int], apart: np.ndarray, count: int) -> list[int]:
    """Choose points that lie far from all points chosen before.

    If not enough points lie far apart, the required distance is reduced step by step, see `APART`.

    Args:
        order: indices of the points, the most promising first.
        apart: (points, points) distances.
        count: number of points to choose.

    Returns:
        Indices of the chosen points.
    """
    chosen: list[int] = []
    for distance in APART:
        for k in order:
            if len(chosen) < count and k not in chosen and np.all(apart[k, chosen] >= distance):
                chosen.append(k)
    return chosen


def merit(measured: Measured, times: float = 1.0) -> np.ndarray:
    """Return F plus penalties for violated limits and for failed trials, (points,).

    F itself only counts failures of the averaged trials, and counts no failures if t_f is minimised.

    Args:
        measured: the measurement at the points.
        times: factor on the violation in the penalty, see `penalised`.
    """
    return penalised(measured.f + math.log(FAILED) * failures(measured.c), measured.largest_c, times)


def penalised(f: Any, largest_c: Any, times: float) -> Any:
    """Return F plus a penalty on the violation, F + `PENALTY` ln(1 + times max(largest_c, 0)).

    Args:
        f: F at the points, (points,) or one number.
        largest_c: largest c at the points, of the same shape.
        times: factor on the violation [-].
    """
    return f + PENALTY * np.log1p(times * np.maximum(largest_c, 0.0))
