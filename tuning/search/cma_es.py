"""Search without slopes, as the exact sign asks for: evolution that learns the shape of its valley (CMA-ES)."""

from collections.abc import Callable

import numpy as np
from cmaes import CMA

from tuning.search.descent import SLACK, Best
from tuning.search.evaluate import Evaluator, Measured
from tuning.search.objective import Problem, failures
from tuning.search.starts import STEEP, merit

GENERATIONS = 40  # at most: `PATIENCE` ends it earlier
WIDELY = 128, 0.2  # points of a generation; spread of the first ones, in shares of the bounds' intervals
NEARBY = 32, 0.05  # the same from a point that is nearly the best
PATIENCE, GAINED = 12, 1e-4  # generations without this much less F end it
WORST = 1e9  # merit of a point that failed


def evolve(
    evaluate: Evaluator,
    problem: Problem,
    best: Best,
    share: np.ndarray,
    seed: int,
    tell: Callable,
    keep: Callable[[Measured], None],
    size: tuple[int, float] = WIDELY,
) -> None:
    """Look for better points around these shares, (gains,), and keep them in `best`; tell(generation, generations).

    Covariance matrix adaptation (Hansen and Ostermeier, Evol. Comput. 9(2), 2001). keep is called with the best point
    of each generation, as it was measured.
    """
    within = np.tile([0.0, 1.0], (len(problem.names), 1))
    population, spread = size
    evolution = CMA(share, spread, bounds=within, seed=seed, population_size=population)
    record = list[float]()
    for k in range(GENERATIONS):
        tell(k, GENERATIONS)
        share = np.asarray([evolution.ask() for _ in range(population)])
        seen = evaluate.fly(problem, share)
        merits = np.nan_to_num(merit(seen, STEEP), nan=WORST, posinf=WORST)
        evolution.tell(list(zip(share, merits.tolist(), strict=True)))
        over = np.maximum(seen.beyond - SLACK, 0.0)
        first = int(np.lexsort((seen.f, over, failures(seen.c)))[0])
        best.offer(share[first : first + 1], seen.at(first))
        keep(seen.at(first))
        record.append(best.f if best.over == 0.0 else np.inf)
        if k >= PATIENCE and record[k - PATIENCE] - record[k] < GAINED:
            return
