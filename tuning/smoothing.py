"""How wide a smooth sign training may fly, for its gains to be as good under the exact one, which judges them."""

from dataclasses import dataclass, replace

import jax.numpy as jnp
import numpy as np
from scipy.stats import qmc

from ptsmc_jax.rollout import Parts
from tuning.evaluate import Evaluator
from tuning.objective import Problem
from tuning.optimise import CHARGE, logit, toward_edges

POINTS, PROMISING = 127, 16  # gains looked at besides the scenario's own, and those of them that count
CLOSE = 0.1  # difference of ln F from that of the exact sign, at most, in the median
DECADES = 4  # below the scenario's own width, at most
WIDEST = 1e-3  # where the scenario flies the exact sign


@dataclass(frozen=True)
class Smoothing:
    """The width that is trained with, and what F then differs by from the exact sign's."""

    width: float
    own: float  # the scenario's
    difference: float  # median over the most promising points
    own_difference: float  # with the scenario's width


def narrowed(evaluate: Evaluator, problem: Problem, own: np.ndarray, seed: int) -> tuple[Problem, Smoothing]:
    """The problem with the widest smooth sign whose F is close to the exact sign's where that is lowest.

    own: (gains,) of the scenario. Gains that let the switching term do the work look far better, or worse, under a wide
    smooth sign than they fly: training would go for them, or stay away.
    """
    share = toward_edges(qmc.LatinHypercube(len(problem.names), rng=np.random.default_rng(seed)).random(POINTS))
    z = np.concatenate([evaluate.bounds.free(own)[None], logit(share)])
    exact = evaluate.fly(with_width(problem, 0.0), z)
    merit = exact.f + CHARGE * np.log1p(exact.c.max(axis=(1, 2), initial=0.0))
    chosen = z[np.argsort(merit, kind="stable")[:PROMISING]]
    lowest = evaluate.fly(with_width(problem, 0.0), chosen).f
    first = float(problem.parts.controller.sign_width)
    width, differences = first or WIDEST, []
    for decade in range(DECADES + 1):
        width = float(f"{(first or WIDEST) * 10.0**-decade:.6g}")
        flown = evaluate.fly(with_width(problem, width), chosen).f
        differences.append(float(np.median(np.abs(flown - lowest))))
        if differences[-1] <= CLOSE:
            break
    return with_width(problem, width), Smoothing(width, first, differences[-1], differences[0])


def with_width(problem: Problem, width: float) -> Problem:
    """The problem flown with another width of the smooth sign; 0 is the exact one."""
    parts: Parts = problem.parts
    controller = replace(parts.controller, sign_width=jnp.asarray(float(width)))
    return replace(problem, parts=replace(parts, controller=controller))
