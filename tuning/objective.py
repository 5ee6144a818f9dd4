"""What is minimised: log of the RMS window error over the training trials, requirements as constraints per trial."""

from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ptsmc_jax import montecarlo, rollout
from ptsmc_jax.dispersions import Dispersion
from ptsmc_jax.numerics import Leaf
from ptsmc_jax.rollout import Parts
from tuning.bounds import with_gains

FAILED = 1e3  # stands for the window error, and for metric / limit, of a trial that failed


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Problem:
    """A tuning problem. The first `averaged` trials count in the RMS, all of them in the constraints."""

    parts: Parts
    dispersion: Dispersion
    seed: Leaf  # uint32
    trials: Leaf  # (trials,) uint32
    limits: Leaf  # (requirements,) in the metrics' units
    averaged: int = field(metadata={"static": True})
    names: tuple[str, ...] = field(metadata={"static": True})  # of the free gains
    metrics: tuple[str, ...] = field(metadata={"static": True})  # of the requirements


def measure(problem: Problem, gains: Float[Array, " gains"]) -> tuple[Array, Array]:
    """F = ln RMS window error [-] and c = metric / limit - 1, (requirements, trials): met where c <= 0.

    A trial that fails counts with a window error of `FAILED`, and as that many times over its limits.
    """
    parts = with_gains(problem.parts, dict(zip(problem.names, gains, strict=True)))

    def fly(trial: Array) -> tuple[Array, Array]:
        metrics, status, _, _ = montecarlo.one(parts, problem.dispersion, problem.seed, trial)
        ok = (status == rollout.OK) | (status == rollout.MISSED)
        error = jnp.where(ok, metrics.window_error, FAILED)
        over = [
            jnp.where(ok, getattr(metrics, name) / limit, FAILED) - 1.0
            for name, limit in zip(problem.metrics, problem.limits, strict=True)
        ]
        return error, jnp.stack(over) if over else jnp.zeros(0)

    errors, over = montecarlo.blocks(fly, problem.trials)
    return 0.5 * jnp.log(jnp.mean(errors[: problem.averaged] ** 2)), over.T
