"""What is minimised: the window error over the training trials, with requirements as constraints per trial."""

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
    # of the averaged trials, how many must keep each limit; None: every trial must
    least: tuple[int | None, ...] = field(default=(), metadata={"static": True})
    tail: int | None = field(default=None, metadata={"static": True})  # the worst trials that count; None: all


def measure(problem: Problem, gains: Float[Array, " gains"]) -> tuple[Array, Array]:
    """F = ln RMS window error [-] and c = metric / limit - 1, (requirements, trials): met where c <= 0.

    The RMS is over the averaged trials, or the `tail` worst of them: CVaR, or with one the worst case. Where only some
    must keep a limit, c of the others is cut down to that of the last one that must. A trial that fails counts with a
    window error of `FAILED`, and as that many times over its limits.
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
    squares = errors[: problem.averaged] ** 2
    if problem.tail is not None:
        squares = jax.lax.top_k(squares, problem.tail)[0]
    rows = [
        row if least is None else _cut(row, least, problem.averaged)
        for row, least in zip(over.T, problem.least or (None,) * len(problem.metrics), strict=True)
    ]
    constraints = jnp.stack(rows) if rows else jnp.zeros((0, problem.trials.shape[0]))
    return 0.5 * jnp.log(jnp.mean(squares)), constraints


def _cut(over: Float[Array, " trials"], least: int, averaged: int) -> Float[Array, " trials"]:
    """Cut off above the `least`-th smallest of the averaged trials; the trials added to them say nothing of a share."""
    first = over[:averaged]
    allowed = -jax.lax.top_k(-first, least)[0][-1]
    return jnp.concatenate([jnp.minimum(first, allowed), jnp.full(over.shape[0] - averaged, -1.0)])
