"""Independent check of a search: differential evolution on the same problem, and the distance between both results."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import differential_evolution

from tuning.search.evaluate import Evaluator
from tuning.search.local_search import SLACK, Best
from tuning.search.local_searches import LocalSearches
from tuning.search.objective import Problem
from tuning.search.optimise import Search
from tuning.search.progress import Report

POPULATION = 40  # points for each gain
GENERATIONS = 80  # largest number of generations of differential evolution; `SPREAD` can end it earlier
STEPS = 100  # steps of the local search from the result of differential evolution
SPREAD = 1e-4  # standard deviation of F in the population at which differential evolution ends
FORBIDDEN = 100.0  # merit of a point that breaks a limit, larger than every F


@dataclass(frozen=True)
class Check:
    """The result of differential evolution on the same problem."""

    gains: dict[str, float]
    value: float  # objective
    distance: float  # F of the checked search minus F of this result: ln of the ratio of the objectives
    kept: bool  # whether these gains keep every limit
    rollouts: int  # number of rollouts


def check(
    evaluate: Evaluator, searched: Search, seed: int, report: Report = lambda *_: None, *, with_gradients: bool = True
) -> Check:
    """Check a search by differential evolution (Storn and Price, 1997; SciPy) with the same tightened limits.

    If F has gradients, a local search follows, as in the checked search. The check thus compares the local minima that
    both methods find.

    Args:
        evaluate: measures the problem.
        searched: result of the search to check.
        seed: seed of the random numbers.
        report: is called after every generation.
        with_gradients: whether F has gradients.
    """
    margin = np.asarray([*searched.margins.values()])
    problem = searched.problem.tightened(1.0 - margin)
    without_margins = problem if problem.margins is None else replace(problem, margins=None)
    rollouts_before, generation, population_merits = evaluate.rollouts, 0, np.asarray(np.inf)

    def compute_merits(problem: Problem, normalised: np.ndarray) -> np.ndarray:
        measured = evaluate.measure(problem, normalised)
        bad = FORBIDDEN * np.where(np.isfinite(measured.f), 1.0, 2.0) + np.log1p(np.maximum(measured.largest_c, 0.0))
        return np.where((measured.largest_c <= SLACK) & np.isfinite(measured.f), measured.f, bad)

    def evaluate_population(normalised: np.ndarray) -> np.ndarray:
        merits = compute_merits(without_margins, normalised.T)
        # margins take far longer and can only increase the merit, so only points that survive without them need margins
        improved = merits <= population_merits
        if without_margins is not problem and improved.any():
            merits[improved] = compute_merits(problem, normalised.T[improved])
        return merits

    def report_generation(intermediate_result) -> None:
        nonlocal generation, population_merits
        generation, population_merits = generation + 1, intermediate_result.population_energies.copy()
        best = float(intermediate_result.fun)
        report("differential evolution", generation, GENERATIONS, float(np.exp(best)), 0.0 if best < FORBIDDEN else 1.0)

    result = differential_evolution(
        evaluate_population,
        [(0.0, 1.0)] * len(problem.names),
        popsize=POPULATION,
        maxiter=GENERATIONS,
        tol=0.0,
        atol=SPREAD,
        rng=np.random.default_rng(seed),
        polish=False,
        vectorized=True,
        updating="deferred",
        init="sobol",
        callback=report_generation,
    )
    best = Best(result.x, len(problem.rows), margin)
    best.offer(result.x[None], evaluate.measure(problem, result.x[None]))
    if with_gradients:  # differential evolution converges slowly along a limit, so a local search follows
        local_searches = LocalSearches(evaluate, margin, STEPS, np.random.default_rng(seed))
        local_searches.search_locally(searched.problem, {0: result.x})
        best = local_searches.best
    at_search, at_best = (
        evaluate.measure(problem, searched.normalised[None]),
        evaluate.measure(problem, best.normalised[None]),
    )
    return Check(
        gains=dict(zip(problem.names, at_best.gains[0].tolist(), strict=True)),
        value=best.value,
        distance=float(at_search.f[0]) - best.f,
        kept=not best.failed and bool(np.all(best.worst <= 1.0)),  # with the original limits, which the verdict uses
        rollouts=evaluate.rollouts - rollouts_before,
    )
