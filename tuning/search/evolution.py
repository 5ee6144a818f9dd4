"""Search without gradients by differential evolution, for laws with a discontinuous sign. See `evolve`."""

from collections.abc import Callable

import numpy as np
from scipy.optimize import differential_evolution

from tuning.search.evaluate import Evaluator, Measured
from tuning.search.local_search import SLACK, Best
from tuning.search.objective import Problem, failures
from tuning.search.starts import STEEP, merit, spread

GENERATIONS = 80  # largest number of generations; `PATIENCE` can end the search earlier
WIDELY = 64, np.inf  # points of a generation; standard deviation of the first generation, in normalised gains
NEARBY = 32, 0.05  # the same for a search from a point near the best
PATIENCE, GAINED = 24, 1e-4  # the search ends if F decreases by less than `GAINED` in `PATIENCE` generations
FAILED_MERIT = 1e9  # merit of a point that failed


def evolve(
    evaluate: Evaluator,
    problem: Problem,
    best: Best,
    normalised: np.ndarray,
    seed: int,
    tell: Callable[[int, int], None],
    keep: Callable[[Measured], None],
    size: tuple[int, float] = WIDELY,
) -> None:
    """Search for better gains by differential evolution (Storn and Price, J. Global Optim. 11, 1997; SciPy).

    Args:
        evaluate: measures the problem.
        problem: the tuning problem. Violations are penalised, see `starts.merit`.
        best: is offered the best point of each generation.
        normalised: (gains,) normalised gains of one point of the first generation.
        seed: seed of the random numbers.
        tell: is called with the number of the generation and the largest number of generations.
        keep: is called with the measurement of the best point of each generation.
        size: points of a generation, and standard deviation of the first generation around `normalised`. If it is
            infinite, the first generation is spread over the whole box.
    """
    population, around = size
    rng = np.random.default_rng(seed)
    if np.isfinite(around):
        first = np.clip(rng.normal(normalised, around, (population, normalised.size)), 0.0, 1.0)
    else:
        first = spread(normalised.size, population, rng)
    first[0] = normalised
    record = list[float]()

    def merits(points: np.ndarray) -> np.ndarray:
        tell(len(record), GENERATIONS)
        seen = evaluate.measure(problem, points.T)
        violation = np.maximum(seen.largest_c - SLACK, 0.0)
        chosen = int(np.lexsort((seen.f, violation, failures(seen.c)))[0])
        best.offer(points.T[chosen : chosen + 1], seen.at(chosen))
        keep(seen.at(chosen))
        record.append(best.f if best.violation == 0.0 else np.inf)
        return np.nan_to_num(merit(seen, STEEP), nan=FAILED_MERIT, posinf=FAILED_MERIT)

    def stop(intermediate_result: object) -> bool:
        del intermediate_result
        return len(record) > PATIENCE and record[-1 - PATIENCE] - record[-1] < GAINED

    box = [(0.0, 1.0)] * normalised.size
    differential_evolution(
        merits, box, init=first, maxiter=GENERATIONS - 1, tol=0.0, rng=rng, polish=False, vectorized=True,
        updating="deferred", callback=stop,
    )  # fmt: skip
