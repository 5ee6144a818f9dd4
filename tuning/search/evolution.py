"""Search without gradients by differential evolution, for laws with a discontinuous sign. See `evolve`."""

from collections.abc import Callable

import numpy as np
from scipy.optimize import differential_evolution

from tuning.search.evaluate import Evaluator, Measurement
from tuning.search.local_search import SLACK, Best
from tuning.search.objective import Problem, count_failures
from tuning.search.starts import STEEP, merit, sobol_points

GENERATIONS = 80  # largest number of generations; `PATIENCE` can end the search earlier
WHOLE_BOX = 64, np.inf  # points of a generation; standard deviation of the first generation, in normalised gains
NEAR_BEST = 32, 0.05  # `WHOLE_BOX` for a search from a point near the best
PATIENCE, LEAST_DECREASE = 24, 1e-4  # the search ends if F decreases by less than this in `PATIENCE` generations
FAILED_MERIT = 1e9  # merit of a point that failed


def evolve(
    evaluate: Evaluator,
    problem: Problem,
    best: Best,
    normalised: np.ndarray,
    seed: int,
    report_progress: Callable[[int, int], None],
    record_best: Callable[[Measurement], None],
    size: tuple[int, float] = WHOLE_BOX,
) -> None:
    """Search for better gains by differential evolution (Storn and Price, J. Global Optim. 11, 1997; SciPy).

    Args:
        evaluate: measures the problem.
        problem: the tuning problem. Violations are penalised, see `starts.merit`.
        best: is offered the best point of each generation.
        normalised: (gains,) normalised gains of one point of the first generation.
        seed: seed of the random numbers.
        report_progress: is called with the number of the generation and the largest number of generations.
        record_best: is called with the measurement of the best point of each generation.
        size: points of a generation, and standard deviation of the first generation around `normalised`. If it is
            infinite, the first generation is spread over the whole box.
    """
    population, deviation = size
    rng = np.random.default_rng(seed)
    if np.isfinite(deviation):
        first = np.clip(rng.normal(normalised, deviation, (population, normalised.size)), 0.0, 1.0)
    else:
        first = sobol_points(normalised.size, population, rng)
    first[0] = normalised
    best_values = list[float]()

    def compute_merits(points: np.ndarray) -> np.ndarray:
        report_progress(len(best_values), GENERATIONS)
        measured = evaluate.measure(problem, points.T)
        violation = np.maximum(measured.largest_c - SLACK, 0.0)
        chosen = int(np.lexsort((measured.f, violation, count_failures(measured.c)))[0])
        best.offer(points.T[chosen : chosen + 1], measured.at(chosen))
        record_best(measured.at(chosen))
        best_values.append(best.f if best.violation == 0.0 else np.inf)
        return np.nan_to_num(merit(measured, STEEP), nan=FAILED_MERIT, posinf=FAILED_MERIT)

    def has_stalled(intermediate_result: object) -> bool:
        del intermediate_result
        return len(best_values) > PATIENCE and best_values[-1 - PATIENCE] - best_values[-1] < LEAST_DECREASE

    box = [(0.0, 1.0)] * normalised.size
    differential_evolution(
        compute_merits, box, init=first, maxiter=GENERATIONS - 1, tol=0.0, rng=rng, polish=False, vectorized=True,
        updating="deferred", callback=has_stalled,
    )  # fmt: skip
