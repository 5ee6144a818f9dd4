"""Many trials of one set of parts: in blocks, over all local devices."""

from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec

from ptsmc_jax import lanes, rollout
from ptsmc_jax.dispersions import Dispersion
from ptsmc_jax.metrics import Metrics
from ptsmc_jax.rollout import Parts

BLOCK = 128  # trials in one block: their state stays in the cache


@dataclass(frozen=True)
class Trials:
    """Results of many trials, (trials,) arrays."""

    trial: np.ndarray  # numbers of the trials
    metrics: Metrics  # of arrays
    status: np.ndarray  # codes, see rollout.STATUS
    bad_time: np.ndarray  # first bad time [s], NaN if none
    initial_q: np.ndarray  # (trials, 4) initial attitude as flown

    @property
    def ok(self) -> np.ndarray:
        """Which trials ended well."""
        return self.status == rollout.OK

    def counts(self) -> dict[str, int]:
        """How many trials ended with each status."""
        names = dict.fromkeys(status for status, _ in rollout.STATUS.values())
        return {name: sum(int(np.sum(self.status == c)) for c, (s, _) in rollout.STATUS.items() if s == name)
                for name in names}  # fmt: skip


def one(parts: Parts, dispersion: Dispersion, seed, trial) -> tuple:
    """Metrics, status, bad time and initial attitude of one trial: pure, for any transformation."""
    drawn = dispersion.apply(parts, seed, trial)
    result = rollout.simulate(drawn, seed, trial)
    return result.metrics, result.status, result.bad_time, drawn.initial.q


def run(parts: Parts, dispersion: Dispersion, seed: int, trials: np.ndarray) -> Trials:
    """Fly these trials (whole numbers below 2^32); results do not depend on the blocks, the devices or the order.

    A trial that fails is marked by its status and kept.
    """
    trials = np.asarray(trials, dtype=np.uint32)
    devices = jax.local_devices()
    block = min(BLOCK, -(-trials.size // len(devices)))
    rows = -(-trials.size // (block * len(devices))) * len(devices)
    padded = np.resize(trials, rows * block).reshape(rows, block)
    results = _blocks(parts, dispersion, jnp.uint32(seed), jnp.asarray(padded), len(devices))
    flat = jax.tree.map(lambda v: np.asarray(v).reshape(rows * block, *v.shape[2:])[: trials.size], results)
    return Trials(trials, *flat)


@partial(jax.jit, static_argnames="devices")
def _blocks(parts: Parts, dispersion: Dispersion, seed: jax.Array, trials: jax.Array, devices: int) -> tuple:
    def share(parts, dispersion, seed, rows):
        fly = lanes.vmap(lambda trial: one(parts, dispersion, seed, trial))
        return jax.lax.map(fly, rows)

    mesh = Mesh(np.asarray(jax.local_devices()[:devices]), ("device",))
    spread, whole = PartitionSpec("device"), PartitionSpec()
    return jax.shard_map(share, mesh=mesh, in_specs=(whole, whole, whole, spread), out_specs=spread, check_vma=False)(
        parts, dispersion, seed, trials
    )
