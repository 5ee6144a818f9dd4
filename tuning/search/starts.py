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

from tuning.search.evaluate import Evaluator, Measurement, MeasurementWithGradients
from tuning.search.objective import FAILED, Problem, count_failures
from tuning.search.progress import Report

CANDIDATES = 64  # points that are simulated to choose starting points
REPORT_EVERY = 16  # points between two reports
PENALTY = 3.0  # F is a logarithm: a metric at twice its limit counts like 2^3 times the error
DISTANCES = (0.5, 0.35, 0.2, 0.0)  # smallest distances in the unit cube (maximum norm), tried in this order
STEEP = 10.0  # weight of the violation in a steep penalty, for points close to a limit
GLOBAL_STEP = "searching the whole box"  # name of the step in progress reports
GLOBAL_CANDIDATES, CANDIDATES_WITH_MARGINS = 2048, 256  # points of a global search; largest number of them with margins
NEARLY_ACTIVE = 0.05  # a limit is nearly active if c > -NEARLY_ACTIVE


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
    normalised = sobol_points(len(problem.names), max(CANDIDATES - len(designs), starts), np.random.default_rng(seed))
    decisive = find_decisive_gains(evaluate.measure_with_gradients(problem, first[None]))
    normalised[:, decisive] = first[decisive]
    normalised = np.concatenate([designs.reshape(-1, first.size), normalised])
    chosen = choose_promising(evaluate, problem, normalised, starts - 1, partial(report, "ranking starting points"))
    return np.concatenate([first[None], chosen])


def global_starting_points(evaluate: Evaluator, problem: Problem, count: int, seed: int, report: Report) -> np.ndarray:
    """Return the most promising of `GLOBAL_CANDIDATES` points of the whole box that lie far apart.

    Margins take far longer than simulations and can only increase a violation. The points are therefore sorted by
    their merit without margins, and margins are evaluated in this order. The evaluation ends when the next point
    cannot be among the best, or after `CANDIDATES_WITH_MARGINS` points.

    Args:
        evaluate: measures the problem.
        problem: the tuning problem.
        count: number of points to return.
        seed: seed of the Sobol sequence.
        report: is called after every `REPORT_EVERY` points.

    Returns:
        Normalised gains, (count, gains).
    """
    normalised = sobol_points(len(problem.names), GLOBAL_CANDIDATES, np.random.default_rng(seed))
    without_margins = problem if problem.margins is None else replace(problem, margins=None)
    merits = np.zeros(0)
    for k in range(0, GLOBAL_CANDIDATES, REPORT_EVERY):
        merits = np.append(merits, merit(evaluate.measure(without_margins, normalised[k : k + REPORT_EVERY]), STEEP))
        report(GLOBAL_STEP, k + REPORT_EVERY, GLOBAL_CANDIDATES, np.nan, np.nan)
    order = np.argsort(merits, kind="stable")
    if without_margins is not problem:
        with_margins = np.full(GLOBAL_CANDIDATES, np.inf)
        for k in range(0, CANDIDATES_WITH_MARGINS, REPORT_EVERY):
            batch = order[k : k + REPORT_EVERY]
            if merits[batch[0]] >= np.sort(with_margins)[count]:
                break
            with_margins[batch] = merit(evaluate.measure(problem, normalised[batch]), STEEP)
            report(GLOBAL_STEP, GLOBAL_CANDIDATES, GLOBAL_CANDIDATES, np.nan, np.nan)
        merits = with_margins
        order = np.argsort(merits, kind="stable")
    candidates = [int(k) for k in order[: 8 * count] if np.isfinite(merits[k])]
    return normalised[choose_far_apart(candidates, distances(normalised), count)]


def find_decisive_gains(measured: MeasurementWithGradients) -> list[int]:
    """Return the indices of decisive gains, at most one for each nearly active limit, the most active limit first.

    It is the gain that the limit depends on most and that is not in the list yet. At least two gains stay free.
    """
    nearest = measured.c[0].argmax(axis=1)
    decisive: list[int] = []
    for row in np.argsort(-measured.c[0].max(axis=1)):
        largest, gradient = measured.c[0, row, nearest[row]], np.abs(measured.c_gradient[0, row, nearest[row]])
        free = [k for k in np.argsort(-gradient) if k not in decisive]
        if largest > -NEARLY_ACTIVE and len(free) > 2 and gradient[free[0]] > 0.0:
            decisive.append(int(free[0]))
    return decisive


def sobol_points(gains: int, count: int, rng: np.random.Generator) -> np.ndarray:
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


def choose_promising(
    evaluate: Evaluator, problem: Problem, normalised: np.ndarray, count: int, report_progress: Callable
) -> np.ndarray:
    """Choose points by their merit, with points that lie far apart first.

    The points are ranked twice, with a weak and with a strong penalty on violations, and are taken from both rankings
    in turn. Points far beyond a limit may lead to better gains. Points that meet every limit need few further steps.

    Args:
        evaluate: measures the problem.
        problem: the tuning problem.
        normalised: (points, gains) normalised gains to choose from.
        count: number of points to choose.
        report_progress: is called after every `REPORT_EVERY` points, as a `Report` without its first argument.

    Returns:
        Normalised gains, (count, gains).
    """
    measured = []
    for k in range(0, len(normalised), REPORT_EVERY):
        measured.append(evaluate.measure(problem, normalised[k : k + REPORT_EVERY]))
        report_progress(min(k + REPORT_EVERY, len(normalised)), len(normalised), np.nan, np.nan)
    pairwise = distances(normalised)
    orders = []
    for weight in (1.0, STEEP):
        merits = np.concatenate([merit(one, weight) for one in measured])
        orders.append([int(k) for k in np.argsort(merits, kind="stable") if np.isfinite(merits[k])])
    queue = [k for pair in zip(*orders, strict=True) for k in pair]
    return normalised[choose_far_apart(queue, pairwise, count)]


def distances(normalised: np.ndarray) -> np.ndarray:
    """Return the distances of points (points, gains) in the maximum norm, (points, points)."""
    return np.abs(normalised[:, None] - normalised[None]).max(axis=2)


def choose_far_apart(order: Sequence[int], pairwise: np.ndarray, count: int) -> list[int]:
    """Choose points that lie far from all points chosen before.

    If not enough points lie far apart, the required distance is reduced step by step, see `DISTANCES`.

    Args:
        order: indices of the points, the most promising first.
        pairwise: (points, points) distances.
        count: number of points to choose.

    Returns:
        Indices of the chosen points.
    """
    chosen: list[int] = []
    for distance in DISTANCES:
        for k in order:
            if len(chosen) < count and k not in chosen and np.all(pairwise[k, chosen] >= distance):
                chosen.append(k)
    return chosen


def merit(measured: Measurement, weight: float = 1.0) -> np.ndarray:
    """Return F plus penalties for violated limits and for failed trials, (points,).

    F itself only counts failures of the averaged trials, and counts no failures if t_f is minimised.

    Args:
        measured: the measurement at the points.
        weight: factor on the violation in the penalty, see `penalise`.
    """
    return penalise(measured.f + math.log(FAILED) * count_failures(measured.c), measured.largest_c, weight)


def penalise(f: Any, largest_c: Any, weight: float) -> Any:
    """Return F plus a penalty on the violation, F + `PENALTY` ln(1 + weight max(largest_c, 0)).

    Args:
        f: F at the points, (points,) or one number.
        largest_c: largest c at the points, of the same shape.
        weight: factor on the violation [-].

    Returns:
        The sum, in the shape of `f`.
    """
    return f + PENALTY * np.log1p(weight * np.maximum(largest_c, 0.0))
