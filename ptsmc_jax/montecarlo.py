"""Many trials of one set of parts: in blocks, over all local devices."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec

from ptsmc_jax import lanes, rollout
from ptsmc_jax.dispersions import Dispersion
from ptsmc_jax.metrics import Metrics
from ptsmc_jax.rollout import Parts

BLOCK = 128  # trials in one block: what a step works on stays in the cache (benchmarks/README.md)


@dataclass(frozen=True)
class Trials:
    """Results of many trials, (trials,) arrays."""

    trial: np.ndarray  # numbers of the trials
    metrics: Metrics  # of arrays
    status: np.ndarray  # codes, see rollout.STATUS
    bad_time: np.ndarray  # first bad time [s], NaN if none
    initial: Any  # initial states as flown, arrays (trials, component)

    @property
    def ok(self) -> np.ndarray:
        """Which trials ended well."""
        return self.status == rollout.OK

    @property
    def finished(self) -> np.ndarray:
        """Which trials were flown to the end, whether or not t_f was met: their metrics are averaged."""
        return np.isin(self.status, rollout.FINISHED)

    def counts(self) -> dict[str, int]:
        """How many trials ended with each status."""
        names = dict.fromkeys(status for status, _ in rollout.STATUS.values())
        return {name: sum(int(np.sum(self.status == c)) for c, (s, _) in rollout.STATUS.items() if s == name)
                for name in names}  # fmt: skip


def one(parts: Parts, dispersion: Dispersion, seed, trial) -> tuple:
    """Metrics, status, bad time and initial state of one trial: pure, for any transformation."""
    drawn = dispersion.apply(parts, seed, trial)
    result = rollout.simulate(drawn, seed, trial)
    return result.metrics, result.status, result.bad_time, drawn.initial


def run(parts: Parts, dispersion: Dispersion, seed: int, trials: np.ndarray, block: int = BLOCK) -> Trials:
    """Fly these trials (whole numbers below 2^32); results do not depend on the blocks, the devices or the order.

    block: trials that a device flies at a time. A trial that fails is marked by its status and kept.
    """
    trials = np.asarray(trials, dtype=np.uint32)
    devices = len(jax.local_devices())
    padded = np.resize(trials, -(-trials.size // devices) * devices)
    results = _fly(parts, dispersion, jnp.uint32(seed), jnp.asarray(padded), devices, block)
    return Trials(trials, *jax.tree.map(lambda v: np.asarray(v)[: trials.size], results))


@partial(jax.jit, static_argnames=("devices", "block"))
def _fly(parts: Parts, dispersion: Dispersion, seed: jax.Array, trials: jax.Array, devices: int, block: int) -> tuple:
    def mine(trials: jax.Array) -> tuple:
        return blocks(lambda trial: one(parts, dispersion, seed, trial), trials, block)

    return spread(mine, trials, devices)


def blocks(fly: Callable, trials: jax.Array, block: int = BLOCK) -> Any:
    """`lanes.vmap(fly)(trials)`, evaluated in blocks of equal size, of at most `block` trials each."""
    count = trials.shape[0]
    rows = max(1, -(-count // block))
    size = -(-count // rows)
    if rows == 1:
        return lanes.vmap(fly)(trials)
    padded = jnp.concatenate([trials, trials[: rows * size - count]])
    results = jax.lax.map(lanes.vmap(fly), padded.reshape(rows, size))
    return jax.tree.map(lambda v: v.reshape(rows * size, *v.shape[2:])[:count], results)


def spread(function: Callable, shared: jax.Array, devices: int) -> Any:
    """function(shared) with the first axis of `shared`, and of the results, shared out over that many devices."""
    mesh = Mesh(np.asarray(jax.local_devices()[:devices]), ("device",))
    axis = PartitionSpec("device")
    return jax.shard_map(function, mesh=mesh, in_specs=axis, out_specs=axis, check_vma=False)(shared)
