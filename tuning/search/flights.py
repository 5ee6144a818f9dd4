"""Flies trials at many gains, without slopes and with: by one program each, however many points and trials there are.

Sweeps, descents, screening, judging, profiles and the climb to the worst case all fly the same parts, but other numbers
of trials, at other gains, along other directions. What is compiled is rows of so many trials, each at gains of its own;
how many rows are flown is a number.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ptsmc_jax import programs
from ptsmc_jax.batching import lanes
from ptsmc_jax.campaigns import montecarlo
from ptsmc_jax.campaigns.montecarlo import Flown, Trials
from ptsmc_jax.dispersions.base import INERTIA, Coordinates
from ptsmc_jax.dispersions.variation import Dispersion
from ptsmc_jax.simulation.rollout import Parts
from tuning.search.gains import with_gains

ROW = 40  # trials in a row
ROWS, SLOPED = 64, 8  # rows in one call, of each device; with slopes


class Fleet(NamedTuple):
    """The trials that are flown at every point, and with what."""

    parts: Parts
    dispersion: Dispersion
    seed: Any
    names: tuple[str, ...]  # of the gains
    trials: np.ndarray  # (trials,) that name the noise
    coordinates: Mapping[str, np.ndarray]  # of what is drawn, arrays over the trials first


class Slopes(NamedTuple):
    """Metrics and statuses, with slopes along so many directions; arrays over points and trials first."""

    metrics: np.ndarray  # (points, trials, metrics)
    status: np.ndarray  # (points, trials) codes, see `rollout.STATUS`
    slopes: np.ndarray  # (points, trials, directions, metrics)


def movable(dispersion: Dispersion) -> tuple[str, ...]:
    """What is drawn and may be moved along a direction: all but the true inertia."""
    return tuple(name for name in dispersion.kinds if name != INERTIA)


def fly(fleet: Fleet, gains: np.ndarray) -> Flown:
    """The trials at every point of gains, (points, gains); arrays (points, trials)."""
    rows = _Rows(len(gains), fleet.trials, ROWS)
    what = {"gains": gains}, {"trial": fleet.trials, "coordinates": dict(fleet.coordinates)}
    return rows.flown(lambda some, needed: _fly(*_fixed(fleet), some, needed, fleet.names, rows.devices), *what)


def trials(fleet: Fleet, gains: np.ndarray) -> Trials:
    """The trials at one point of gains, (gains,)."""
    return Trials(np.asarray(fleet.trials), *jax.tree.map(lambda v: v[0], fly(fleet, gains[None])))


def sloped(
    fleet: Fleet,
    gains: np.ndarray,
    directions: np.ndarray,
    metrics: tuple[str, ...],
    shifts: Mapping[str, np.ndarray] | None = None,
) -> Slopes:
    """The trials at every point of gains, (points, gains), with slopes of these metrics along directions of its own.

    directions: (points, directions, gains); shifts: what moves the coordinates along each, (trials, directions,
    numbers) for each of `movable`; None: nothing.
    """
    rows, count = _Rows(len(gains), fleet.trials, SLOPED), directions.shape[1]
    if shifts is None:
        free = {name: np.shape(fleet.coordinates[name]) for name in movable(fleet.dispersion)}
        shifts = {name: np.zeros((shape[0], count, *shape[1:])) for name, shape in free.items()}
    by_trial = {"trial": fleet.trials, "coordinates": dict(fleet.coordinates), "shifts": dict(shifts)}
    values, slopes = rows.flown(
        lambda some, needed: _sloped(*_fixed(fleet), some, needed, fleet.names, metrics, rows.devices),
        {"gains": gains, "directions": directions},
        by_trial,
    )
    return Slopes(values[..., :-1], values[..., -1].astype(int), slopes[..., :-1])


def prepare(fleet: Fleet) -> None:
    """Begin to compile what `fly` needs, beside what is being done."""
    rows = _Rows(1, fleet.trials, ROWS)
    by_trial = {"trial": fleet.trials, "coordinates": dict(fleet.coordinates)}
    some = rows.some(rows.calls[0], {"gains": np.zeros((1, len(fleet.names)))}, by_trial)
    _fly.prepare(*_fixed(fleet), some, np.int32(0), fleet.names, rows.devices)


def _fixed(fleet: Fleet) -> tuple:
    return fleet.parts, fleet.dispersion, jnp.uint32(fleet.seed)


class _Rows:
    """All trials at all points as rows of `ROW` trials each, shared out over the devices."""

    def __init__(self, points: int, trials: np.ndarray, most: int):
        self.devices = len(jax.local_devices())
        self._count, each = len(trials), max(1, -(-len(trials) // ROW))
        self._trials = np.resize(np.arange(self._count), (each, ROW))  # of the rows at each point
        rows = np.arange(points * each)
        self._points, self._most = points, most
        self.calls = [rows[k : k + self.devices * most] for k in range(0, rows.size, self.devices * most)]

    def some(self, rows: np.ndarray, by_point: dict[str, Any], by_trial: dict[str, Any]) -> dict[str, Any]:
        """What (devices, rows) fly, those of one call first; by_point, by_trial: arrays over points, and trials."""
        places = np.zeros((self.devices, self._most), int)
        share = -(-rows.size // self.devices)
        places[:, :share] = np.resize(rows, (self.devices, share))
        point, row = np.divmod(places, len(self._trials))
        each = self._trials[row]
        return {
            **{name: np.asarray(v)[point] for name, v in by_point.items()},
            **jax.tree.map(lambda v: np.asarray(v)[each], by_trial),
        }

    def flown(self, program: Callable, by_point: dict[str, Any], by_trial: dict[str, Any]) -> Any:
        """What the program finds: arrays (points, trials, ..)."""
        found = []
        for rows in self.calls:
            share = -(-rows.size // self.devices)
            results = program(self.some(rows, by_point, by_trial), np.int32(share))
            found.append(jax.tree.map(lambda v, n=rows.size, share=share: self._of_rows(v, share)[:n], results))

        def joined(*calls: np.ndarray) -> np.ndarray:
            whole = np.concatenate(calls)
            return whole.reshape(self._points, -1, *whole.shape[2:])[:, : self._count]

        return jax.tree.map(joined, *found)

    @staticmethod
    def _of_rows(v: Any, share: int) -> np.ndarray:
        kept = np.asarray(v)[:, :share]
        return kept.reshape(-1, *kept.shape[2:])


@programs.jit(static_argnames=("names", "devices"))
def _fly(
    parts: Parts,
    dispersion: Dispersion,
    seed: jax.Array,
    rows: dict[str, Any],
    needed: jax.Array,
    names: tuple[str, ...],
    devices: int,
) -> Flown:
    """Results of (devices, rows, trials); rows from `needed` on are left zero."""

    def one(gains: jax.Array, trial: jax.Array, coordinates: Coordinates) -> Flown:
        moved = with_gains(parts, dict(zip(names, gains, strict=True)))
        return montecarlo.one(moved, dispersion, seed, trial, coordinates)

    def flown(row: dict[str, Any]) -> Flown:
        return lanes.vmap(one, (None, 0, 0))(row["gains"], row["trial"], row["coordinates"])

    first = jax.tree.map(lambda v: v[0, 0], rows)
    made = jax.eval_shape(one, first["gains"], *jax.tree.map(lambda v: v[0], (first["trial"], first["coordinates"])))
    return _row_by_row(flown, jax.tree.map(lambda v: jnp.zeros((ROW, *v.shape), v.dtype), made), rows, needed, devices)


@programs.jit(static_argnames=("names", "metrics", "devices"))
def _sloped(
    parts: Parts,
    dispersion: Dispersion,
    seed: jax.Array,
    rows: dict[str, Any],
    needed: jax.Array,
    names: tuple[str, ...],
    metrics: tuple[str, ...],
    devices: int,
) -> tuple[jax.Array, jax.Array]:
    """Metrics of (devices, rows, trials), with the status as the last of them, and their slopes."""

    def one(gains: jax.Array, trial: jax.Array, fixed: Coordinates, free: Coordinates) -> jax.Array:
        moved = with_gains(parts, dict(zip(names, gains, strict=True)))
        flown = montecarlo.one(moved, dispersion, seed, trial, {**fixed, **free})
        return jnp.stack([*(getattr(flown.metrics, name) for name in metrics), flown.status.astype(float)])

    def sloped(row: dict[str, Any]) -> tuple[jax.Array, jax.Array]:
        shifts = jax.tree.map(lambda v: jnp.moveaxis(v, 1, 0), row["shifts"])
        fixed = {name: v for name, v in row["coordinates"].items() if name not in shifts}
        free = {name: row["coordinates"][name] for name in shifts}
        values, slopes = lanes.jvp(one, (None, 0, 0, 0))(
            (row["gains"], row["trial"], fixed, free), (row["directions"], None, None, shifts)
        )
        return values, jnp.moveaxis(slopes, 0, 1)

    count = rows["directions"].shape[2]
    made = jnp.zeros((ROW, len(metrics) + 1)), jnp.zeros((ROW, count, len(metrics) + 1))
    return _row_by_row(sloped, made, rows, needed, devices)


def _row_by_row(flown: Callable, empty: Any, rows: dict[str, Any], needed: jax.Array, devices: int) -> Any:
    """`flown` of each of the first rows of each device; empty: what it is of a row that is not flown."""

    def of_device(rows: dict[str, Any]) -> Any:
        own = jax.tree.map(lambda v: v[0], rows)
        count = own["trial"].shape[0]

        def step(k: jax.Array, found: Any) -> Any:
            made = flown(jax.tree.map(lambda v: v[k], own))
            return jax.tree.map(lambda into, v: into.at[k].set(v), found, made)

        every = jax.tree.map(lambda v: jnp.broadcast_to(v, (count, *v.shape)), empty)
        return jax.tree.map(lambda v: v[None], jax.lax.fori_loop(0, needed, step, every))

    return montecarlo.spread(of_device, rows, devices)
