"""A global search of the same problem without slopes: how far the gradient search ended from it."""

from dataclasses import dataclass, replace

import jax.numpy as jnp
import numpy as np
from scipy.optimize import differential_evolution

from tuning.evaluate import Evaluator
from tuning.optimise import Search
from tuning.polish import SLACK, Best, polish
from tuning.starts import EDGE, Report, logit

POPULATION = 40  # points for each gain
GENERATIONS = 80
SPREAD = 1e-4  # of F in the population, at which it ends
FORBIDDEN = 100.0  # beside F, for a point that breaks a limit: beyond every F


@dataclass(frozen=True)
class Check:
    """What differential evolution found of the same problem."""

    gains: dict[str, float]
    value: float  # its goal
    distance: float  # the search's F less this one's: about the share by which the search is worse
    kept: bool  # whether it keeps every limit
    rollouts: int  # trials flown for it


def check(evaluate: Evaluator, found: Search, seed: int, report: Report = lambda *told: None) -> Check:
    """Differential evolution (Storn and Price, 1997; SciPy's, whole generations at once) with the same limits.

    Then the same polish as in the search: what is compared is the valley that each of them found.
    """
    problem = replace(found.problem, limits=found.problem.limits * (1.0 - found.margin))
    before, generation = evaluate.rollouts, 0

    def merit(share: np.ndarray) -> np.ndarray:
        flown = evaluate.fly(problem, logit(share.T))
        bad = FORBIDDEN * np.where(np.isfinite(flown.f), 1.0, 2.0) + np.log1p(np.maximum(flown.beyond, 0.0))
        return np.where((flown.beyond <= SLACK) & np.isfinite(flown.f), flown.f, bad)

    def tell(intermediate_result) -> None:
        nonlocal generation
        generation += 1
        best = float(intermediate_result.fun)
        report("differential evolution", generation, GENERATIONS, float(np.exp(best)), 0.0 if best < FORBIDDEN else 1.0)

    result = differential_evolution(
        merit,
        [(EDGE, 1.0 - EDGE)] * len(problem.names),
        popsize=POPULATION,
        maxiter=GENERATIONS,
        tol=0.0,
        atol=SPREAD,  # pyright: ignore[reportArgumentType]
        rng=np.random.default_rng(seed),
        polish=False,
        vectorized=True,
        updating="deferred",
        init="sobol",
        callback=tell,
    )
    # near a limit evolution goes slowly: from where it ends, along it
    best = Best(logit(result.x[None]), len(problem.metrics), found.margin)
    polish(evaluate, replace(found.smooth, limits=problem.limits), best, 0)
    z = np.concatenate([logit(result.x[None]), best.z])
    seen, own = evaluate.fly(problem, z), evaluate.fly(problem, found.z[None])
    first = int(np.lexsort((seen.f, seen.beyond > SLACK))[0])
    return Check(
        gains=dict(zip(problem.names, np.asarray(evaluate.bounds.gains(jnp.asarray(z[first]))).tolist(), strict=True)),
        value=float(np.exp(seen.value[first])),
        distance=float(own.f[0] - seen.f[first]),
        kept=bool(seen.c[first].max(initial=-1.0) <= SLACK),
        rollouts=evaluate.rollouts - before,
    )
