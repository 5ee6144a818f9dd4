"""Many trials of one set of parts: in blocks, over all local devices."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import Array, PyTree
from numpy.typing import ArrayLike

from ptsmc_jax import configure, programs
from ptsmc_jax.batching import lanes
from ptsmc_jax.devices.sensors import RATE_BIAS
from ptsmc_jax.dispersions.base import CUSTOM, Coordinates
from ptsmc_jax.dispersions.variation import Dispersion, Row, TrialSetup, check_dispersion, trial_setup
from ptsmc_jax.numerics.draws import WholeNumber, check_whole_number
from ptsmc_jax.numerics.pytrees import listing
from ptsmc_jax.simulation import rollout
from ptsmc_jax.simulation.assembly import Parts, check_parts
from ptsmc_jax.simulation.computer import PYTHON_SOFTWARE, Software
from ptsmc_jax.simulation.metrics import Metrics

FEW = 64  # smaller numbers of trials use a program for this many, because a step of one trial costs nearly as much
CAPACITY = 4096  # largest number of trials in one call of a program
BLOCK = 128  # number of trials in one block, whose states stay in the cache (benchmarks/README.md)
BLOCK_ON_GPU = 65_536  # `BLOCK` on an accelerator, where kernel launches dominate the cost of a step
FINISHED = tuple(rollout.STATUS[code][0] for code in rollout.FINISHED)  # statuses of runs that reached the end


@dataclass(frozen=True)
class Trials:
    """Results of many trials, (trials,) arrays."""

    trial: np.ndarray  # numbers of the trials
    metrics: Metrics  # metrics, each an array (trials,)
    status: np.ndarray  # codes of `rollout.STATUS`
    bad_time: np.ndarray  # time of the first failure, at which the status changed [s]; NaN if the status is ok
    drawn: dict[str, np.ndarray]  # dispersed quantities by name, see `values`
    custom_metrics: dict[str, np.ndarray] = field(default_factory=dict)  # custom metrics
    samples: dict[str, np.ndarray] = field(default_factory=dict)  # see `rollout.Result`

    __repr__ = listing

    @property
    def ok(self) -> np.ndarray:
        """Which trials succeeded."""
        return self.status == rollout.OK

    @property
    def finished(self) -> np.ndarray:
        """Which trials reached the end, converged at t_f or not: their metrics are averaged."""
        return np.isin(self.status, rollout.FINISHED)

    def vectors(self, name: str) -> np.ndarray:
        """Return a dispersed vector (trials, components): `initial_q1` to `initial_q4` for the name `initial_q`."""
        numbers = [v for key, v in self.drawn.items() if key.startswith(name) and key[len(name) :].isdigit()]
        return np.stack(numbers, axis=1)

    def counts(self) -> dict[str, int]:
        """Return the number of trials with each status."""
        counts = dict.fromkeys((status for status, _ in rollout.STATUS.values()), 0)
        for code, (status, _) in rollout.STATUS.items():
            counts[status] += int(np.sum(self.status == code))
        return counts


# a custom metric: (run with its history, its parts) -> named numbers
CustomMetrics = Callable[[rollout.Result, Parts], dict[str, jax.Array]]


class Simulated(NamedTuple):
    """The result of one trial, see `Trials`."""

    metrics: Metrics
    status: jax.Array
    bad_time: jax.Array
    drawn: dict[str, jax.Array]
    custom_metrics: dict[str, jax.Array]
    samples: dict[str, jax.Array]

    __repr__ = listing


def one(
    parts: Parts,
    dispersion: Dispersion,
    seed: WholeNumber,
    trial: WholeNumber | Row,
    coordinates: Coordinates | None = None,
    custom_metrics: CustomMetrics | None = None,
    software: Software = PYTHON_SOFTWARE,
) -> Simulated:
    """Simulate one trial: a pure function, for any transformation.

    Args:
        parts: the nominal parts.
        dispersion: the dispersions.
        seed: seed of the dispersions and the noise, a whole number.
        trial: number of the trial, or a `Row` of a run table, which states its seed.
        coordinates: random numbers of the dispersions; None: those of the trial. The noise is always the trial's.
        custom_metrics: custom metrics; the run's history is recorded for them.
        software: flight software: the simulated law, or exported C code.

    Returns:
        Metrics, status and dispersed quantities.

    Raises:
        TypeError: `parts` or `dispersion` is something else.
    """
    check_parts(parts)
    check_dispersion(dispersion)
    trial_parts = trial_setup(parts, dispersion, seed, trial)
    if coordinates is None:
        coordinates = trial_parts.dispersion.coordinates(trial_parts.seed, trial_parts.trial)
    drawn = trial_parts.dispersion.at(trial_parts.parts, coordinates)
    result = rollout.simulate(
        drawn, trial_parts.seed, trial_parts.trial, record=custom_metrics is not None, software=software
    )
    custom_values = {} if custom_metrics is None else custom_metrics(result, drawn)
    dispersed_values = _read_dispersed_values(dispersion, drawn, trial_parts, coordinates)
    return Simulated(result.metrics, result.status, result.bad_time, dispersed_values, custom_values, result.samples)


@programs.jit
def coordinates(dispersion: Dispersion, seed: jax.Array, trials: jax.Array) -> Coordinates:
    """Return the random numbers of the dispersions for many trials.

    Args:
        dispersion: the dispersions.
        seed: seed of the dispersions, a whole number.
        trials: numbers of the trials, (trials,).

    Returns:
        The numbers of each dispersion by name, (trials, count) [-].
    """
    return jax.vmap(lambda trial: dispersion.coordinates(seed, trial))(trials)


def values(parts: Parts, dispersion: Dispersion, seed: WholeNumber, trial: WholeNumber | Row) -> dict[str, jax.Array]:
    """Return the dispersed quantities of a trial by name, without simulating it.

    Args:
        parts: the nominal parts.
        dispersion: the dispersions.
        seed: seed of the dispersions, a whole number.
        trial: number of the trial, or a `Row` of a run table, which states its seed.

    Returns:
        A scalar for each component, by the name of its column in the rows, in SI units.
    """
    trial_parts = trial_setup(parts, dispersion, seed, trial)
    coordinates = trial_parts.dispersion.coordinates(trial_parts.seed, trial_parts.trial)
    return _read_dispersed_values(
        dispersion, trial_parts.dispersion.at(trial_parts.parts, coordinates), trial_parts, coordinates
    )


def _read_dispersed_values(
    dispersion: Dispersion, drawn: Parts, trial_parts: TrialSetup, coordinates: Coordinates
) -> dict[str, jax.Array]:
    """Return the dispersed quantities of a trial, its gyro bias, and the numbers of custom dispersions, by column.

    `drawn` has the dispersed values. `trial_parts` has the nominal parts, the seed and the number of the trial.
    """
    by_column = dispersion.values(drawn, set(trial_parts.given) - {RATE_BIAS})
    if dispersion.custom is not None:
        by_column |= dispersion.custom.values(coordinates[CUSTOM])
    return by_column | drawn.sensors.trial_constants(trial_parts.seed, trial_parts.trial)


def run(
    parts: Parts,
    dispersion: Dispersion,
    seed: int,
    trials: Sequence[int] | np.ndarray | Array | Row,
    block: int | None = None,
    custom_metrics: CustomMetrics | None = None,
    kernel: bool | None = None,
    software: Software = PYTHON_SOFTWARE,
) -> Trials:
    """Simulate these trials, or rows of a run table. Results do not depend on blocks, devices and order.

    A trial that fails is marked by its status and kept. One program simulates any number of trials below `FEW`, another
    any larger number.

    Args:
        parts: the nominal parts.
        dispersion: the dispersions.
        seed: seed of the dispersions and the noise.
        trials: numbers of the trials, whole numbers below 2^32, or rows of a run table.
        block: trials that a device simulates at a time; None: `block_size()`.
        custom_metrics: custom metrics, see `one`.
        kernel: whether the loop over time is one kernel, see `batching.kernel`; None: `uses_kernel()`. A
            processor interprets the kernel, slowly.
        software: flight software: the simulated law, or exported C code.

    Returns:
        The results, arrays (trials,).

    Raises:
        ValueError: seed or trials are not such numbers.
        TypeError: `parts` or `dispersion` is something else.
    """
    if software.on_processor and configure.backend() != "cpu":
        with jax.default_device(configure.processors()[0]):
            return run(
                parts, dispersion, seed, trials, block, custom_metrics=custom_metrics, kernel=kernel, software=software
            )
    check_parts(parts)
    check_whole_number("seed", seed)
    check_dispersion(dispersion)
    check_whole_number("block", 1 if block is None else block, 1)
    trials = trials if isinstance(trials, Row) else _check_trial_numbers(trials)
    trial_numbers = np.asarray(trials.trial if isinstance(trials, Row) else trials)
    count = trial_numbers.shape[0]
    devices, rows, block = _program_shape(count, block)
    size = devices * rows * block
    kernel = uses_kernel() if kernel is None else kernel
    calls = []
    for k in range(0, count, size):
        items, per_device = scatter(min(size, count - k), devices, rows * block)
        item_indices = k + items.reshape(devices, rows, block)
        numbers = jax.tree.map(lambda v, item_indices=item_indices: jnp.asarray(v[item_indices]), trials)
        used_rows = jnp.int32(-(-per_device // block))
        results = _simulate_rows(
            parts, dispersion, jnp.uint32(seed), numbers, used_rows, devices, custom_metrics, kernel, software
        )
        flat = jax.tree.map(lambda v: np.asarray(v).reshape(devices, rows * block, *v.shape[3:]), results)
        calls.append(jax.tree.map(lambda v, k=k, per_device=per_device: gather(v, per_device)[: count - k], flat))
    return Trials(trial_numbers, *jax.tree.map(lambda *many: np.concatenate(many), *calls))


def _check_trial_numbers(trials: ArrayLike) -> np.ndarray:
    """Return checked numbers of trials. A cast alone would accept fractions and negative numbers."""
    numbers = np.asarray(trials)
    if numbers.ndim != 1 or not numbers.size:
        raise ValueError(f"trials is of shape {numbers.shape}, but must be the numbers of one trial or more, (N,)")
    is_whole = np.issubdtype(numbers.dtype, np.integer)
    if not is_whole or numbers.min() < 0 or numbers.max() >= 2**32:
        description = f"between {numbers.min()} and {numbers.max()}" if is_whole else f"of type {numbers.dtype}"
        raise ValueError(f"trials are {description}, but must be whole numbers from 0 to {2**32 - 1}")
    return numbers.astype(np.uint32)


def scatter(count: int, devices: int, slots: int) -> tuple[np.ndarray, int]:
    """Distribute items over devices.

    Args:
        count: number of items.
        devices: number of devices.
        slots: number of slots of a device.

    Returns:
        The item in each slot, (devices, slots), and the number of used slots of a device. Other slots repeat items.
    """
    per_device = -(-count // devices)
    items = np.zeros((devices, slots), int)
    items[:, :per_device] = np.resize(np.arange(count), (devices, per_device))
    return items, per_device


def gather(results: np.ndarray, per_device: int) -> np.ndarray:
    """Return the results in the order of the items of `scatter`, (devices, slots, ..) -> (devices * per_device, ..)."""
    used = np.asarray(results)[:, :per_device]
    return used.reshape(-1, *used.shape[2:])


def _program_shape(count: int, block: int | None = None) -> tuple[int, int, int]:
    """Return the shape (devices, rows, block) of the program that simulates `count` trials, see `_simulate_rows`."""
    devices = len(configure.devices())
    if count < FEW:
        return devices, 1, -(-FEW // devices)
    block = block_size() if block is None else block
    return devices, max(1, CAPACITY // (devices * block)), block


def prepare(parts: Parts, dispersion: Dispersion, count: int) -> None:
    """Start to compile the program of `run` in the background.

    Args:
        parts: the nominal parts; only the shapes of their arrays matter.
        dispersion: the dispersions.
        count: number of trials of the later call of `run`.
    """
    shape = _program_shape(count)
    numbers = np.zeros(shape, dtype=np.uint32)
    _simulate_rows.prepare(
        parts, dispersion, jnp.uint32(0), numbers, jnp.int32(0), shape[0], None, uses_kernel(), PYTHON_SOFTWARE
    )


@programs.jit(
    static_argnames=("devices", "custom_metrics", "kernel", "software"),
    batch=True,
    title="the simulations of many trials",
)
def _simulate_rows(
    parts: Parts,
    dispersion: Dispersion,
    seed: jax.Array,
    trials: jax.Array | Row,
    needed_rows: jax.Array,
    devices: int,
    custom_metrics: CustomMetrics | None,
    kernel: bool,
    software: Software,
) -> Simulated:
    """Return the results of (devices, rows, block) trials; rows from `needed_rows` on are zero."""

    def simulate_one(trial: jax.Array | Row) -> Simulated:
        return one(parts, dispersion, seed, trial, custom_metrics=custom_metrics, software=software)

    result = jax.eval_shape(simulate_one, jax.tree.map(lambda v: v[0, 0, 0], trials))
    width = jax.tree.leaves(trials)[0].shape[2]
    return evaluate_rows(lanes.vmap(simulate_one, kernel=kernel), result, width, trials, needed_rows, devices)


def evaluate_rows(
    simulate_row: Callable, result: PyTree, width: int, rows: PyTree, needed_rows: jax.Array, devices: int
) -> PyTree:
    """Evaluate one row after the other on each device.

    Args:
        simulate_row: simulates a row of trials.
        result: shapes and types of the result of one trial; tracing a whole row for them takes long.
        width: number of trials in a row.
        rows: arrays (devices, rows, ..).
        needed_rows: number of rows to evaluate on each device.
        devices: number of devices.

    Returns:
        The results, (devices, rows, width, ..); rows from `needed_rows` on are zero.
    """

    def evaluate_on_device(rows: PyTree) -> PyTree:
        device_rows = jax.tree.map(lambda v: v[0], rows)
        count = jax.tree.leaves(device_rows)[0].shape[0]
        empty = jax.tree.map(lambda v: jnp.zeros((count, width, *v.shape), v.dtype), result)

        def step(k: jax.Array, results: PyTree) -> PyTree:
            row = simulate_row(jax.tree.map(lambda v: v[k], device_rows))
            return jax.tree.map(lambda array, v: jax.lax.dynamic_update_index_in_dim(array, v, k, 0), results, row)

        return jax.tree.map(lambda v: v[None], jax.lax.fori_loop(0, needed_rows, step, empty))

    return map_over_devices(evaluate_on_device, rows, devices)


def block_size() -> int:
    """Return the default number of trials that a device simulates at a time."""
    return BLOCK if configure.backend() == "cpu" else BLOCK_ON_GPU


def uses_kernel() -> bool:
    """Return whether the loop over time is one kernel: on a GPU, where each step would cost launches."""
    return configure.backend() == "gpu"


def map_in_blocks(function: Callable, trials: PyTree) -> PyTree:
    """Return `lanes.vmap(function)(trials)`, evaluated in blocks of equal size of at most `block_size()` trials.

    trials: arguments of `function`, with a leading axis over trials.
    """
    count = jax.tree.leaves(trials)[0].shape[0]
    rows = max(1, -(-count // block_size()))
    size = -(-count // rows)
    if rows == 1:
        return lanes.vmap(function)(trials)

    def split(v: jax.Array) -> jax.Array:
        return jnp.concatenate([v, v[: rows * size - count]]).reshape(rows, size, *v.shape[1:])

    results = jax.lax.map(lanes.vmap(function), jax.tree.map(split, trials))
    return jax.tree.map(lambda v: v.reshape(rows * size, *v.shape[2:])[:count], results)


def map_over_devices(function: Callable, shared: PyTree, devices: int) -> PyTree:
    """Return function(shared), with the first axes of argument and result distributed over the devices.

    Args:
        function: function of a pytree of arrays, which runs once on each device with its entries of the first axes.
        shared: argument of the function, arrays (devices, ..).
        devices: number of devices.

    Returns:
        The results of all devices, arrays (devices, ..).
    """
    if devices == 1:
        return function(shared)
    mesh = Mesh(np.asarray(configure.devices()[:devices]), ("device",))
    axis = PartitionSpec("device")
    return jax.shard_map(function, mesh=mesh, in_specs=axis, out_specs=axis, check_vma=False)(shared)
