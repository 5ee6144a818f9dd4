"""Many trials of one set of parts: in blocks, over all local devices."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec

from ptsmc_jax import programs
from ptsmc_jax.batching import lanes
from ptsmc_jax.devices.sensors import RATE_BIAS
from ptsmc_jax.dispersions import planned
from ptsmc_jax.dispersions.base import OWN, Coordinates
from ptsmc_jax.dispersions.planned import Row
from ptsmc_jax.dispersions.variation import Dispersion
from ptsmc_jax.simulation import rollout
from ptsmc_jax.simulation.metrics import Metrics
from ptsmc_jax.simulation.rollout import Parts

FEW = 64  # fewer trials are flown at once, by a program for this many: a step of one costs nearly as much
CAPACITY = 4096  # trials in one call
BLOCK = 128  # trials in one block: what a step works on stays in the cache (benchmarks/README.md)
BLOCK_ON_GPU = 65_536  # the same on an accelerator, where a step costs launches whatever it works on


@dataclass(frozen=True)
class Trials:
    """Results of many trials, (trials,) arrays."""

    trial: np.ndarray  # numbers of the trials
    metrics: Metrics  # of arrays
    status: np.ndarray  # codes, see rollout.STATUS
    bad_time: np.ndarray  # first bad time [s], NaN if none
    drawn: dict[str, np.ndarray]  # what each flew with, by name, see `values`
    own: dict[str, np.ndarray] = field(default_factory=dict)  # metrics of one's own

    @property
    def ok(self) -> np.ndarray:
        """Which trials ended well."""
        return self.status == rollout.OK

    @property
    def finished(self) -> np.ndarray:
        """Which trials were flown to the end, whether or not t_f was met: their metrics are averaged."""
        return np.isin(self.status, rollout.FINISHED)

    def vectors(self, name: str) -> np.ndarray:
        """What is drawn by this name and a number, `initial_q1` to `initial_q4` for `initial_q`, (trials, numbers)."""
        numbers = [v for key, v in self.drawn.items() if key.startswith(name) and key[len(name) :].isdigit()]
        return np.stack(numbers, axis=1)

    def counts(self) -> dict[str, int]:
        """How many trials ended with each status."""
        names = dict.fromkeys(status for status, _ in rollout.STATUS.values())
        return {name: sum(int(np.sum(self.status == c)) for c, (s, _) in rollout.STATUS.items() if s == name)
                for name in names}  # fmt: skip


# a metric of one's own: the run with its history, and the parts that flew it -> named numbers
OwnMetrics = Callable[[rollout.Result, Parts], dict[str, jax.Array]]


class Flown(NamedTuple):
    """What is known of one trial, see `Trials`."""

    metrics: Metrics
    status: jax.Array
    bad_time: jax.Array
    drawn: dict[str, jax.Array]
    own: dict[str, jax.Array]


def one(
    parts: Parts,
    dispersion: Dispersion,
    seed,
    trial,
    coordinates: Coordinates | None = None,
    own: OwnMetrics | None = None,
) -> Flown:
    """Fly one trial: pure, for any transformation.

    trial: its number, or a `Row` of a plan, which brings its own seed. coordinates: of what is drawn, where they are
    not those of the trial, which then names its noise alone. own: metrics besides the usual ones, for which the run's
    history is recorded.
    """
    about = planned.about(parts, dispersion, seed, trial)
    if coordinates is None:
        coordinates = about.dispersion.coordinates(about.seed, about.trial)
    drawn = about.dispersion.at(about.parts, coordinates)
    result = rollout.simulate(drawn, about.seed, about.trial, record=own is not None)
    more = {} if own is None else own(result, drawn)
    return Flown(result.metrics, result.status, result.bad_time, _values(dispersion, drawn, about, coordinates), more)


def values(parts: Parts, dispersion: Dispersion, seed, trial) -> dict[str, jax.Array]:
    """What a trial flies with, by name, without flying it; trial: see `one`."""
    about = planned.about(parts, dispersion, seed, trial)
    coordinates = about.dispersion.coordinates(about.seed, about.trial)
    return _values(dispersion, about.dispersion.at(about.parts, coordinates), about, coordinates)


def _values(
    dispersion: Dispersion, drawn: Parts, about: planned.About, coordinates: Coordinates
) -> dict[str, jax.Array]:
    """Read from the parts of a trial, the gyro's bias from its sensors, and what draws of one's own say of theirs."""
    found = dispersion.values(drawn, set(about.given) - {RATE_BIAS})
    if dispersion.own is not None:
        found |= dispersion.own.values(coordinates[OWN])
    return found if drawn.sensors is None else found | drawn.sensors.drawn(about.seed, about.trial)


def run(
    parts: Parts,
    dispersion: Dispersion,
    seed: int,
    trials: np.ndarray | Row,
    block: int | None = None,
    own: OwnMetrics | None = None,
    kernel: bool = False,
) -> Trials:
    """Fly these trials (whole numbers below 2^32), or rows of a plan, whatever the blocks, the devices and the order.

    block: trials that a device flies at a time. A trial that fails is marked by its status and kept. One program flies
    any number of trials below `FEW`, another any number from there on. own: see `one`. kernel: whole runs in one
    kernel, see `kernel`; on a processor it is interpreted, slowly.
    """
    trials = trials if isinstance(trials, Row) else np.asarray(trials, dtype=np.uint32)
    number = np.asarray(trials.trial if isinstance(trials, Row) else trials)
    count, devices = number.shape[0], len(jax.local_devices())
    block = -(-FEW // devices) if count < FEW else block_size() if block is None else block
    rows = max(1, CAPACITY // (devices * block)) if count >= FEW else 1
    size = devices * rows * block
    calls = []
    for k in range(0, count, size):
        few = min(size, count - k)
        share = -(-few // devices)  # of each device

        def spaced(v: np.ndarray, k: int = k, few: int = few, share: int = share) -> jax.Array:
            padded = np.zeros((devices, rows * block, *v.shape[1:]), v.dtype)
            padded[:, :share] = np.resize(v[k : k + few], (devices, share, *v.shape[1:]))
            return jnp.asarray(padded.reshape(devices, rows, block, *v.shape[1:]))

        needed = jnp.int32(-(-share // block))
        numbers = jax.tree.map(spaced, trials)
        found = _fly(parts, dispersion, jnp.uint32(seed), numbers, needed, devices, own, kernel)
        calls.append(jax.tree.map(lambda v, share=share, n=few: _joined(np.asarray(v), share)[:n], found))
    return Trials(number, *jax.tree.map(lambda *many: np.concatenate(many), *calls))


def prepare(parts: Parts, dispersion: Dispersion) -> None:
    """Begin to compile what flies many trials of such parts, beside what is being done."""
    devices, block = len(jax.local_devices()), block_size()
    numbers = jnp.zeros((devices, max(1, CAPACITY // (devices * block)), block), dtype=jnp.uint32)
    _fly.prepare(parts, dispersion, jnp.uint32(0), numbers, jnp.int32(0), devices, None, kernel=False)


def _joined(v: np.ndarray, share: int) -> np.ndarray:
    """The trials that count of (devices, rows, block, ...)."""
    flat = v.reshape(v.shape[0], -1, *v.shape[3:])[:, :share]
    return flat.reshape(-1, *flat.shape[2:])


@programs.jit(static_argnames=("devices", "own", "kernel"))
def _fly(
    parts: Parts,
    dispersion: Dispersion,
    seed: jax.Array,
    trials: jax.Array | Row,
    needed: jax.Array,
    devices: int,
    own: OwnMetrics | None,
    kernel: bool,
) -> Flown:
    """Results of (devices, rows, block) trials; rows from `needed` on are left zero, a kernel flies them too."""

    def fly(trial: jax.Array | Row) -> Flown:
        return one(parts, dispersion, seed, trial, own=own)

    def in_blocks(trials: jax.Array | Row) -> Flown:
        flown, row = lanes.vmap(fly), jax.tree.map(lambda v: v[0], trials)
        shape = jax.tree.leaves(row)[0].shape[:2]
        # of one trial: to trace the lanes a second time takes longer
        first = jax.tree.map(lambda v: v[0, 0], row)
        empty = jax.tree.map(lambda v: jnp.zeros((*shape, *v.shape), v.dtype), jax.eval_shape(fly, first))

        def step(k: jax.Array, found: Flown) -> Flown:
            each = flown(jax.tree.map(lambda v: v[k], row))
            return jax.tree.map(lambda into, v: into.at[k].set(v), found, each)

        return jax.tree.map(lambda v: v[None], jax.lax.fori_loop(0, needed, step, empty))

    def in_one_kernel(trials: jax.Array | Row) -> Flown:
        from ptsmc_jax.batching.kernel import vmap  # which nothing else needs

        flown, shape = vmap(fly, interpret=jax.default_backend() == "cpu"), jax.tree.leaves(trials)[0].shape[:3]
        found = flown(jax.tree.map(lambda v: v.reshape(-1, *v.shape[3:]), trials))
        return jax.tree.map(lambda v: v.reshape(shape), found)

    return spread(in_one_kernel if kernel else in_blocks, trials, devices)


def block_size() -> int:
    """How many trials a device flies at a time, where a caller does not say."""
    return BLOCK if jax.default_backend() == "cpu" else BLOCK_ON_GPU


def blocks(fly: Callable, trials: Any) -> Any:
    """`lanes.vmap(fly)(trials)`, evaluated in blocks of equal size, of at most `block_size()` trials each.

    trials: what `fly` takes, a number or a tree of arrays, with a leading axis over the trials.
    """
    count = jax.tree.leaves(trials)[0].shape[0]
    rows = max(1, -(-count // block_size()))
    size = -(-count // rows)
    if rows == 1:
        return lanes.vmap(fly)(trials)

    def split(v: jax.Array) -> jax.Array:
        return jnp.concatenate([v, v[: rows * size - count]]).reshape(rows, size, *v.shape[1:])

    results = jax.lax.map(lanes.vmap(fly), jax.tree.map(split, trials))
    return jax.tree.map(lambda v: v.reshape(rows * size, *v.shape[2:])[:count], results)


def spread(function: Callable, shared: Any, devices: int) -> Any:
    """function(shared) with the first axes of `shared`, and of the results, shared out over that many devices."""
    mesh = Mesh(np.asarray(jax.local_devices()[:devices]), ("device",))
    axis = PartitionSpec("device")
    return jax.shard_map(function, mesh=mesh, in_specs=axis, out_specs=axis, check_vma=False)(shared)
