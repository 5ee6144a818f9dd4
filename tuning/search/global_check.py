"""A global search of the same problem without slopes: how far the gradient search ended from it."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import differential_evolution

from tuning.search.descent import SLACK, Best
from tuning.search.descents import Descents
from tuning.search.evaluate import Evaluator
from tuning.search.objective import Problem
from tuning.search.optimise import Search
from tuning.search.progress import Report

POPULATION = 40  # points for each gain
GENERATIONS = 80  # at most: `SPREAD` ends it earlier
STEPS = 100  # of the descent from what it found
SPREAD = 1e-4  # of F in the population, at which it ends
FORBIDDEN = 100.0  # beside F, for a point that breaks a limit: beyond every F


@dataclass(frozen=True)
class Check:
    """What differential evolution found of the same problem."""

    gains: dict[str, float]
    value: float  # its goal
    distance: float  # the search's F less this one's: ln of how many times its goal the search's is
    kept: bool  # whether it keeps every limit
    rollouts: int  # trials flown for it


def check(
    evaluate: Evaluator, searched: Search, seed: int, report: Report = lambda *_: None, *, sloped: bool = True
) -> Check:
    """Differential evolution (Storn and Price, 1997; SciPy's, whole generations at once) with the same limits.

    Then the same descent as in the search, where F has slopes: what is compared is the valley that each of them found.
    """
    margin = np.asarray([*searched.margins.values()])
    problem = searched.problem.tightened(1.0 - margin)
    without = problem if problem.margins is None else replace(problem, margins=None)
    before, generation, replaced = evaluate.rollouts, 0, np.asarray(np.inf)

    def merit_of(problem: Problem, share: np.ndarray) -> np.ndarray:
        flown = evaluate.fly(problem, share)
        bad = FORBIDDEN * np.where(np.isfinite(flown.f), 1.0, 2.0) + np.log1p(np.maximum(flown.beyond, 0.0))
        return np.where((flown.beyond <= SLACK) & np.isfinite(flown.f), flown.f, bad)

    def merit(share: np.ndarray) -> np.ndarray:
        found = merit_of(without, share.T)
        # margins, which take far longer, can only add to it: of what is not chosen anyway they are not asked for
        chosen = found <= replaced
        if without is not problem and chosen.any():
            found[chosen] = merit_of(problem, share.T[chosen])
        return found

    def tell(intermediate_result) -> None:
        nonlocal generation, replaced
        generation, replaced = generation + 1, intermediate_result.population_energies.copy()
        best = float(intermediate_result.fun)
        report("differential evolution", generation, GENERATIONS, float(np.exp(best)), 0.0 if best < FORBIDDEN else 1.0)

    result = differential_evolution(
        merit,
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
        callback=tell,
    )
    best = Best(result.x, len(problem.rows), margin)
    best.offer(result.x[None], evaluate.fly(problem, result.x[None]))
    if sloped:  # near a limit evolution goes slowly: from where it ends, along it
        run = Descents(evaluate, margin, STEPS, np.random.default_rng(seed))
        run.descend(searched.problem, {0: result.x})
        best = run.best
    at_search, at_best = evaluate.fly(problem, searched.share[None]), evaluate.fly(problem, best.share[None])
    return Check(
        gains=dict(zip(problem.names, at_best.gains[0].tolist(), strict=True)),
        value=best.value,
        distance=float(at_search.f[0]) - best.f,
        kept=not best.failed and bool(np.all(best.worst <= 1.0)),  # the limits themselves, as the search is judged
        rollouts=evaluate.rollouts - before,
    )
