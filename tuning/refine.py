"""Refinement without slopes around a good point: evolution that learns the shape of its valley (CMA-ES)."""

from collections.abc import Callable

import numpy as np
from cmaes import CMA

from tuning.evaluate import Evaluator
from tuning.objective import Problem
from tuning.polish import SLACK, Best
from tuning.starts import EDGE, logit, merit, share_of

GENERATIONS = 40
WIDELY = 128, 0.2  # points of a generation; spread of the first ones, in shares of the bounds' intervals
NEARBY = 32, 0.05  # the same from a point that is nearly the best
STEEP = 10.0  # times the charge for a breach of a limit among far-off points: here many points are close to one
PATIENCE, GAINED = 12, 1e-4  # generations without this much less F end it
WORST = 1e9  # merit of a point that failed


def refine(
    evaluate: Evaluator,
    problem: Problem,
    best: Best,
    start: int,
    seed: int,
    tell: Callable,
    size: tuple[int, float] = WIDELY,
) -> None:
    """Better points around a start's best iterate, kept in `best`; tell(generation, generations) is called.

    Covariance matrix adaptation (Hansen and Ostermeier, Evol. Comput. 9(2), 2001), in shares of the bounds' intervals.
    """
    within = np.tile([EDGE, 1.0 - EDGE], (len(problem.names), 1))
    middle = np.clip(share_of(best.z[start]), *within[0])
    population, spread = size
    evolution = CMA(middle, spread, bounds=within, seed=seed, population_size=population)
    record = list[float]()
    for k in range(GENERATIONS):
        tell(k, GENERATIONS)
        share = np.asarray([evolution.ask() for _ in range(population)])
        z = logit(share)
        seen = evaluate.fly(problem, z)
        merits = np.nan_to_num(merit(seen, STEEP), nan=WORST, posinf=WORST)
        evolution.tell(list(zip(share, merits.tolist(), strict=True)))
        over = np.maximum(seen.beyond - SLACK, 0.0)
        first = int(np.lexsort((seen.f, over))[0])
        best.offer(
            z[first : first + 1], seen.at(first), np.isfinite(seen.f[first : first + 1]), slice(start, start + 1)
        )
        record.append(float(best.f[start]) if best.over[start] == 0.0 else np.inf)
        if k >= PATIENCE and record[k - PATIENCE] - record[k] < GAINED:
            return
