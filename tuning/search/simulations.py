"""Simulation of trials at many gains, with or without gradients. Read `simulate` first.

All steps of the tuner simulate the same parts with other gains, numbers of trials and directions of derivatives. One
compiled program without gradients and one with gradients serve all of them. A program simulates rows of `ROW` trials.
Each row has its own gains, and the number of rows is a run-time argument.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ptsmc_jax import configure, programs
from ptsmc_jax.batching import lanes
from ptsmc_jax.campaigns import montecarlo
from ptsmc_jax.campaigns.montecarlo import Simulated, Trials
from ptsmc_jax.dispersions.base import INERTIA, Coordinates
from ptsmc_jax.dispersions.variation import Dispersion
from ptsmc_jax.numerics.draws import WholeNumber
from ptsmc_jax.simulation.catalogues import POINTING
from ptsmc_jax.simulation.metrics import Metrics
from ptsmc_jax.simulation.rollout import Parts
from tuning.search.gains import with_gains

ROW = 40  # number of trials that a program simulates together, with the same gains
ROWS, ROWS_WITH_DERIVATIVES = 64, 8  # largest number of rows that a device simulates in a call; with gradients


class Batch(NamedTuple):
    """The trials to simulate at every point, with their parts and dispersions."""

    parts: Parts
    dispersion: Dispersion
    seed: WholeNumber
    names: tuple[str, ...]  # names of the gains
    trials: np.ndarray  # (trials,) numbers that select the noise
    coordinates: Mapping[str, np.ndarray]  # random numbers of the dispersions, trials on the first axis
    pointing: tuple[str, ...]  # pointing metrics to compute; results lack all other pointing metrics

    @property
    def by_trial(self) -> dict[str, Any]:
        """Arguments with trials on the first axis."""
        return {"trial": self.trials, "coordinates": dict(self.coordinates)}

    def distinct(self) -> tuple["Batch", np.ndarray]:
        """Return the batch without repeated trials, and the index of each trial of this batch in it, (trials,).

        Slots of a problem repeat its first trial until other trials join, see `rounds`.
        """
        columns = [np.asarray(self.trials), *self.coordinates.values()]
        rows = np.concatenate([np.asarray(v, dtype=float).reshape(len(self.trials), -1) for v in columns], axis=1)
        _, first, places = np.unique(rows, axis=0, return_index=True, return_inverse=True)
        order = np.argsort(first)  # in the order of this batch
        coordinates = {name: np.asarray(v)[first[order]] for name, v in self.coordinates.items()}
        distinct = self._replace(trials=np.asarray(self.trials)[first[order]], coordinates=coordinates)
        return distinct, np.argsort(order)[places.ravel()]

    @property
    def shared(self) -> tuple[Parts, Dispersion, jax.Array]:
        """Arguments that all trials share."""
        return self.parts, self.dispersion, jnp.uint32(self.seed)


class Derivatives(NamedTuple):
    """Metrics and statuses, with derivatives of the metrics along directions."""

    metrics: np.ndarray  # (points, trials, metrics)
    status: np.ndarray  # (points, trials) codes, see `rollout.STATUS`
    derivatives: np.ndarray  # (points, trials, directions, metrics) derivatives


def differentiable_dispersions(dispersion: Dispersion) -> tuple[str, ...]:
    """Return the names of the dispersions with derivatives: all except for the true inertia."""
    return tuple(name for name in dispersion.kinds if name != INERTIA)


def simulate(batch: Batch, gains: np.ndarray) -> Simulated:
    """Simulate the trials at every point of gains, (points, gains). Return arrays (points, trials)."""
    batch, places = batch.distinct()
    rows = _Rows({"gains": gains}, batch.by_trial, ROWS)
    results = rows.apply(
        lambda *arguments: _simulate(*batch.shared, *arguments, batch.names, batch.pointing, rows.devices)
    )
    return jax.tree.map(lambda v: v[:, places], results)


def simulate_trials(batch: Batch, gains: np.ndarray) -> Trials:
    """Simulate the trials at one point of gains, (gains,)."""
    return Trials(np.asarray(batch.trials), *jax.tree.map(lambda v: v[0], simulate(batch, gains[None])))


def simulate_with_derivatives(
    batch: Batch,
    gains: np.ndarray,
    directions: np.ndarray,
    metrics: tuple[str, ...],
    shifts: Mapping[str, np.ndarray] | None = None,
) -> Derivatives:
    """Simulate the trials at every point of gains, with derivatives of the metrics along directions.

    Args:
        batch: the trials.
        gains: (points, gains) gains.
        directions: (points, directions, gains) derivative of the gains along each direction.
        metrics: names of the metrics.
        shifts: derivative of the random numbers along each direction, (trials, directions, numbers) for each name of
            `differentiable_dispersions`. None: zero.

    Returns:
        Metrics, statuses and derivatives.
    """
    places = np.arange(len(batch.trials))
    if shifts is None:
        batch, places = batch.distinct()
        shifts = _no_shifts(batch, directions.shape[1])
    by_point = {"gains": gains, "directions": directions}
    rows = _Rows(by_point, {**batch.by_trial, "shifts": dict(shifts)}, ROWS_WITH_DERIVATIVES)
    values, derivatives = rows.apply(
        lambda *arguments: _simulate_with_derivatives(*batch.shared, *arguments, batch.names, metrics, rows.devices)
    )
    values, derivatives = values[:, places], derivatives[:, places]
    return Derivatives(values[..., :-1], values[..., -1].astype(int), derivatives[..., :-1])


def _no_shifts(batch: Batch, directions: int) -> dict[str, np.ndarray]:
    """Return zero shifts (trials, directions, numbers) of each differentiable dispersion, by name."""
    return {
        name: np.zeros((len(v), directions, *np.shape(v)[1:]))
        for name, v in batch.coordinates.items()
        if name in differentiable_dispersions(batch.dispersion)
    }


def prepare(batch: Batch, metrics: tuple[str, ...]) -> None:
    """Compile the programs of `simulate`, and of `simulate_with_derivatives` along all gains, in the background."""
    count = len(batch.names)
    gains = {"gains": np.zeros((1, count))}
    rows = _Rows(gains, batch.by_trial, ROWS)
    _simulate.prepare(*batch.shared, *rows.call_arguments(0), batch.names, batch.pointing, rows.devices)
    by_point = {**gains, "directions": np.zeros((1, count, count))}
    rows = _Rows(by_point, {**batch.by_trial, "shifts": _no_shifts(batch, count)}, ROWS_WITH_DERIVATIVES)
    _simulate_with_derivatives.prepare(*batch.shared, *rows.call_arguments(0), batch.names, metrics, rows.devices)


class _Rows:
    """Splits the trials of all points into rows of `ROW` trials, and the rows into calls of a program.

    A call has at most `max_rows` rows for each device. The arguments of the program have points on the first axis
    (`by_point`), or trials (`by_trial`).
    """

    def __init__(self, by_point: dict[str, Any], by_trial: dict[str, Any], max_rows: int):
        self.devices = len(configure.devices())
        self._by_point, self._by_trial, self._max_rows = by_point, by_trial, max_rows
        self._points, self._count = len(by_point["gains"]), len(by_trial["trial"])
        # indices of the trials in the rows of one point
        self._trials = np.resize(np.arange(self._count), (max(1, -(-self._count // ROW)), ROW))
        self._rows = self._points * len(self._trials)

    def call_arguments(self, first: int) -> tuple[dict[str, Any], np.int32]:
        """Return the arguments of the call from row `first` on, (devices, rows, ..), and the rows of each device."""
        count = min(self._rows - first, self.devices * self._max_rows)
        places, needed_rows = montecarlo.scatter(count, self.devices, self._max_rows)
        point, row = np.divmod(first + places, len(self._trials))
        trial = self._trials[row]
        by_row = {name: np.asarray(v)[point] for name, v in self._by_point.items()}
        by_row |= jax.tree.map(lambda v: np.asarray(v)[trial], self._by_trial)
        return by_row, np.int32(needed_rows)

    def apply(self, program: Callable) -> Any:
        """Apply a program to all rows. Return arrays (points, trials, ..).

        The program gets the arguments of one call and the number of rows of each device that it must simulate.
        """
        calls = []
        for first in range(0, self._rows, self.devices * self._max_rows):
            arguments, needed_rows = self.call_arguments(first)
            results = program(arguments, needed_rows)
            calls.append(jax.tree.map(lambda v, rows=int(needed_rows): montecarlo.gather(v, rows), results))

        def join_calls(*calls: np.ndarray) -> np.ndarray:
            rows = np.concatenate(calls)[: self._rows]
            return rows.reshape(self._points, -1, *rows.shape[2:])[:, : self._count]

        return jax.tree.map(join_calls, *calls)


@programs.jit(static_argnames=("names", "pointing", "devices"), batch=True, title="the simulations of the search")
def _simulate(
    parts: Parts,
    dispersion: Dispersion,
    seed: jax.Array,
    rows: dict[str, Any],
    needed_rows: jax.Array,
    names: tuple[str, ...],
    pointing: tuple[str, ...],
    devices: int,
) -> Simulated:
    """Simulate rows and return arrays (devices, rows, trials). Rows from index `needed_rows` on are zero.

    The 52 pointing metrics make up half of the program. It therefore contains only the pointing metrics in `pointing`.
    """
    skipped = {*POINTING} - {*pointing}

    def simulate_trial(gains: jax.Array, trial: jax.Array, coordinates: Coordinates) -> Simulated:
        tuned_parts = with_gains(parts, dict(zip(names, gains, strict=True)))
        simulated = montecarlo.one(tuned_parts, dispersion, seed, trial, coordinates)
        metrics = Metrics({name: value for name, value in simulated.metrics.items() if name not in skipped})
        return simulated._replace(metrics=metrics)

    def simulate_row(row: dict[str, Any]) -> Simulated:
        return lanes.vmap(simulate_trial, (None, 0, 0), kernel=montecarlo.uses_kernel())(
            row["gains"], row["trial"], row["coordinates"]
        )

    first = jax.tree.map(lambda v: v[0, 0, 0], {name: rows[name] for name in ("trial", "coordinates")})
    result = jax.eval_shape(simulate_trial, rows["gains"][0, 0], first["trial"], first["coordinates"])
    return montecarlo.evaluate_rows(simulate_row, result, ROW, rows, needed_rows, devices)


@programs.jit(static_argnames=("names", "metrics", "devices"), batch=True, title="the gradients of the simulations")
def _simulate_with_derivatives(
    parts: Parts,
    dispersion: Dispersion,
    seed: jax.Array,
    rows: dict[str, Any],
    needed_rows: jax.Array,
    names: tuple[str, ...],
    metrics: tuple[str, ...],
    devices: int,
) -> tuple[jax.Array, jax.Array]:
    """Simulate rows with derivatives. Rows from index `needed_rows` on are zero.

    Returns:
        Metrics, (devices, rows, trials, metrics + 1), with the status as the last one, and their derivatives,
        (devices, rows, trials, directions, metrics + 1).
    """

    def simulate_trial(gains: jax.Array, trial: jax.Array, fixed: Coordinates, free: Coordinates) -> jax.Array:
        tuned_parts = with_gains(parts, dict(zip(names, gains, strict=True)))
        simulated = montecarlo.one(tuned_parts, dispersion, seed, trial, {**fixed, **free})
        return jnp.stack([*(getattr(simulated.metrics, name) for name in metrics), simulated.status.astype(float)])

    def simulate_row(row: dict[str, Any]) -> tuple[jax.Array, jax.Array]:
        shifts = jax.tree.map(lambda v: jnp.moveaxis(v, 1, 0), row["shifts"])
        fixed = {name: v for name, v in row["coordinates"].items() if name not in shifts}
        free = {name: row["coordinates"][name] for name in shifts}
        values, derivatives = lanes.jvp(simulate_trial, (None, 0, 0, 0), kernel=montecarlo.uses_kernel())(
            (row["gains"], row["trial"], fixed, free), (row["directions"], None, None, shifts)
        )
        return values, jnp.moveaxis(derivatives, 0, 1)

    values = len(metrics) + 1
    result = jax.eval_shape(lambda: (jnp.zeros(values), jnp.zeros((rows["directions"].shape[2], values))))
    return montecarlo.evaluate_rows(simulate_row, result, ROW, rows, needed_rows, devices)
