"""The floor: what no controller can beat, since no estimator knows the state better at the time of acting.

The true state differs from the target by at least what the samples do not say of it. With Gaussian noise and everything
else known, the covariance of the Kalman filter along the run is the least that any estimator leaves: the posterior
Cramer-Rao bound (Tichavsky, Muravchik, Nehorai, IEEE Trans. Signal Processing 46(5), 1998), at every sample
P+ = P - P H' (H P H' + R)^-1 H P and P <- F P F' + Q between them; F is the derivative of a period of the true plant.

Known are the plant, its true inertia, its flexible modes, which are at rest at t = 0, the disturbance but for its
random walk, the torque on the body, and how large every noise is. Attitude and rate are not, but by the samples: the
bound is on whoever does as well from every start. Behind an attitude filter its steady state is known at t = 0, a
gyro's bias by its 1 sigma. The torque in a period can use samples up to `delay` periods before its start: from there on
the error is predicted.

It bounds the mean over trials. A single run, or a small campaign, may come out below it by chance.
"""

from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ptsmc_jax import programs
from ptsmc_jax.batching import lapack
from ptsmc_jax.devices.sensors import Reading
from ptsmc_jax.devices.ticks import Ticks
from ptsmc_jax.numerics import integrators, stacking
from ptsmc_jax.simulation.control_period import PeriodMotion, star_state
from ptsmc_jax.simulation.interval import Criteria, integral_in_window
from ptsmc_jax.simulation.rollout import Log, Parts

UNKNOWN = 1e5  # 1 sigma of a state at t = 0, in those of its sensor: of no weight beside the first sample
EXACT = 1e-10  # 1 sigma of a sensor without noise, in those of what is read before the first sample


@dataclass(frozen=True)
class Floor:
    """What no controller can beat; 0 where nothing is unknown."""

    window_error: float  # RMS over the window after t_f, in the unit of the metric
    t: np.ndarray = field(repr=False)  # (time,) ends of the control periods [s]
    error: np.ndarray = field(repr=False)  # (time,) RMS of the error's 2-norm then


class Model(NamedTuple):
    """A linear-Gaussian model of `periods` control periods: z' = F (z + B v), y = H z + n; or those of several runs.

    In a period the sample comes first, then v acts, then the state moves. v, n: independent, of 1 sigma each as said.
    Runs, where there are several, have the axis after the periods, and the same samples.
    """

    start: np.ndarray  # (.., n, k) factor of the covariance before the first sample: S S'
    rows: np.ndarray  # (m, n) H, or (periods, .., m, n)
    noise: np.ndarray  # (periods, .., m) 1 sigma of each reading; infinite: there is none
    kick: np.ndarray  # (periods, .., n, v) B, times 1 sigma
    move: np.ndarray  # (periods, .., n, n) F
    output: np.ndarray  # (periods, .., outputs, n) what is asked, of z + B v


def along(parts: Parts, log: Log) -> Floor:
    """The floor along a run with this history (`rollout.simulate`, record=True)."""
    return along_each([(parts, log)])[0]


def along_each(runs: Sequence[tuple[Parts, Log]]) -> list[Floor]:
    """The floor along each of several runs of a scenario, side by side."""
    lasting = [(parts, *_lasting(parts, log)) for parts, log in runs]
    alike = dict[tuple, dict[int, Model]]()  # by the samples and the delay
    for k, (parts, ticks, log) in enumerate(lasting):
        if parts.clock.sampled and (not parts.sensors.perfect or parts.walk_rate is not None):  # something is unknown
            model = _model(parts, log, ticks)
            delay = parts.actuators.delay
            alike.setdefault((delay, np.isfinite(model.noise).tobytes(), *map(np.shape, model)), {})[k] = model
    squares = [np.zeros((len(ticks.t), 3)) for _, ticks, _ in lasting]
    for (delay, *_), models in alike.items():
        sizes = _unknown(_together([*models.values()]), delay)
        for number, k in enumerate(models):
            squares[k] = np.sum(sizes[:, number].reshape(len(sizes), 3, -1) ** 2, axis=2)
    return [_floor(parts, ticks, of_run) for (parts, ticks, _), of_run in zip(lasting, squares, strict=True)]


def _together(models: Sequence[Model]) -> Model:
    """The models of several runs as one."""
    start, *others = zip(*models, strict=True)
    return Model(np.stack(start), *(np.stack(some, axis=1) for some in others))


def _floor(parts: Parts, ticks: Ticks, squares: np.ndarray) -> Floor:
    """From squares of the error (periods, 3) at start, middle and end of each period."""
    return Floor(window_error(parts, ticks, squares), np.asarray(ticks.t_next), np.sqrt(squares[:, 2]))


def window_error(parts: Parts, ticks: Ticks, squares: np.ndarray) -> float:
    """RMS over the window, from squares of the error (periods, 3) as the metric has it of a run."""
    times: Any = map(np.asarray, (parts.controller.t_f, parts.t_end, parts.window, parts.settling_angle))
    start, middle, end = squares.T
    total = np.sum(integral_in_window(ticks.t, ticks.t_next, (start, middle, end), Criteria(*times)))
    return float(np.sqrt(total / float(parts.window)))


def pooled(floors: Iterable[Floor]) -> float | None:
    """RMS of the floors of several runs, as window errors pool; None: there is no run."""
    squares = [one.window_error**2 for one in floors]
    return float(np.sqrt(np.mean(squares))) if squares else None


def _lasting(parts: Parts, log: Log) -> tuple[Any, Any]:
    """`Ticks` of a run that have a length, beyond rounding, its `Log` at their starts and at t_end; numpy arrays.

    They begin and end when samples came, which may be early or late.
    """
    ticks = jax.tree.map(np.asarray, _ticks(parts.clock, parts.controller.t_f, parts.controller.delta))
    lengths = ticks.t_next - ticks.t
    least = 1e-9 * float(np.max(lengths))
    at_starts = np.append(np.diff(np.asarray(log.t)) > least, True)
    lasting = jax.tree.map(lambda v: v[lengths > least], ticks)
    log = jax.tree.map(lambda v: np.asarray(v)[at_starts], log)
    return lasting._replace(t=log.t[:-1], t_next=log.t[1:]) if parts.clock.sampled else lasting, log


@programs.jit
def _ticks(clock: Any, t_f: Array, delta: Array) -> Ticks:
    return clock.ticks(t_f, delta)


def _unknown(model: Model, delay: int) -> np.ndarray:
    """`deviations`, those zero that are nothing but how exact sensors without noise are taken to be."""
    sizes = deviations(model, delay)
    if np.all(model.noise > 0.0):
        return sizes
    # ten times as exact, what is left of them is a tenth
    return np.where(sizes > 3.0 * deviations(model, delay, EXACT / 10.0), 0.0, sizes)


def deviations(model: Model, delay: int = 0, exact: float = EXACT) -> np.ndarray:
    """1 sigma of each output (periods, .., outputs) given all samples up to `delay` periods before.

    exact: `EXACT`, or another one.

    Factors S of P = S S' are carried by orthogonal transformations (Kaminski, Bryson, Schmidt, IEEE TAC 16(6), 1971):
    nothing is subtracted or inverted, so that noises of any sizes go together.
    """
    periods, sizes = len(model.move), np.zeros(model.output.shape[:-1])
    shape = (*model.move.shape[:-2], *model.rows.shape[-2:])
    rows, available = np.broadcast_to(model.rows, shape), np.isfinite(model.noise).reshape(periods, -1, shape[-2])
    factor, largest = model.start, np.zeros(shape[1:-1])
    known = deque([(0, factor)], maxlen=delay + 1)  # period, and what the samples up to it say

    def moved(k: int, factor: np.ndarray) -> np.ndarray:
        return model.move[k] @ np.concatenate([factor, model.kick[k]], axis=-1)

    for k in range(periods):
        read, there = rows[k] @ factor, available[k, 0]
        largest = np.maximum(largest, _sizes(read))
        noise = np.maximum(model.noise[k], exact * largest)[..., there]
        factor = _corrected(factor, read[..., there, :], noise[..., None] * np.eye(noise.shape[-1]))
        known.append((k, factor))
        period, late = known[0]
        for j in range(period, k):
            late = _triangular(moved(j, late))
        sizes[k] = _sizes(model.output[k] @ np.concatenate([late, model.kick[k]], axis=-1))
        factor = moved(k, factor)
    return sizes


def _triangular(factor: np.ndarray) -> np.ndarray:
    """A lower triangular factor (.., n, n) of the same covariance as a factor (.., n, k), k >= n."""
    return np.swapaxes(np.linalg.qr(np.swapaxes(factor, -1, -2), mode="r"), -1, -2)


def _corrected(factor: np.ndarray, read: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Factor (.., n, n) of the covariance after readings.

    Args:
        factor: of the covariance before, (.., n, k), k >= n.
        read: the readings' rows by the factor, (.., m, k).
        noise: a factor of the readings' covariance, (.., m, m).
    """
    *many, m, k = read.shape
    both = np.zeros((*many, m + factor.shape[-2], m + k))
    both[..., :m, :m], both[..., :m, m:], both[..., m:, m:] = noise, read, factor
    return _triangular(both)[..., m:, m:]


def _sizes(rows: np.ndarray) -> np.ndarray:
    """2-norms of the rows."""
    return np.sqrt(np.einsum("...ij,...ij->...i", rows, rows))


def _model(parts: Parts, log: Log, ticks: Ticks) -> Model:
    """What a run's samples say, and its error, of these states.

    The plant's local coordinates, the sensor's, the walk's torque, and readings that wait until they are used.
    """
    linear: Any = jax.tree.map(np.asarray, _linear(parts, log, ticks))
    periods, n, m = linear.push.shape
    reading = reading_of(parts.sensors, n, ticks)
    own, count = reading.own.size, reading.noise.size
    lag = parts.sensors.lag(ticks) if hasattr(parts.sensors, "lag") else np.zeros((periods, count), int)
    early = np.zeros(count, bool) if reading.early is None else reading.early
    places = _places(lag, early, n + own + m)
    size, torque = n + own + m + len(places), slice(n + own, n + own + m)

    def wide(rows: np.ndarray) -> np.ndarray:
        seen = rows.shape[-1] - own  # what no sensor reads, the modes of a flexible body, comes after it
        rows = np.insert(rows, [seen] * (n - seen), 0.0, axis=-1)
        return np.pad(rows, [*[(0, 0)] * (rows.ndim - 1), (0, size - rows.shape[-1])])

    # derivatives of each reading by the state at the start of a period: as it is then, and as it is when it is taken
    now, suite = np.tile(wide(reading.rows), (periods, 1, 1)), linear.now.shape[1] > 0
    if suite:
        now[:, :, :n] = linear.now
    taken = now.copy()
    if np.any(early):
        by_seen = np.eye(count) if suite else reading.rows[:, : linear.early.shape[1]]
        taken[:, early, :n] = by_seen[early] @ linear.early
        taken[:, early, torque] = by_seen[early] @ linear.early_push

    # how far a reading may be off tells what "unknown" is in its unit; a state read without noise is known
    off = np.hypot(reading.noise, np.linalg.norm(now[0, :, n : n + own] * reading.own, axis=1))
    unknown = UNKNOWN * np.max(np.abs(now[0, :, :n]) * off[:, None], axis=0)
    start = np.diag(np.concatenate([unknown, reading.own, np.zeros(size - n - own)]))
    lengths = np.asarray(ticks.t_next - ticks.t)
    drift = np.diag(np.concatenate([np.zeros(n), reading.own_drift, walk_of(parts), np.zeros(len(places))]))
    move = np.tile(np.eye(size), (periods, 1, 1))
    move[:, :n, :n], move[:, :n, torque] = linear.move, linear.push
    output = np.zeros((periods, linear.seen.shape[1], size))
    output[:, :, :n], output[:, :, torque] = linear.seen, linear.seen_push
    # a reading that is not of the sample at which it is used waits in states of its own, moved on at every sample
    rows = now.copy()
    for (k, number), place in places.items():
        move[:, place] = taken[:, k] if number == 1 else np.eye(size)[places[k, number - 1]]
        if number == 1 and early[k]:
            start[place] = now[0, k] @ start  # the first sample's readings are of its own time
        rows[lag[:, k] + early[k] == number, k] = np.eye(size)[place]
    if reading.start is not None:
        known, factor = reading.start
        start = _corrected(start, wide(known) @ start, factor)
    there = np.ones((periods, count), bool) if parts.sensors.perfect else parts.sensors.available(ticks)
    return Model(
        start=start,
        rows=rows,
        noise=np.where(there, reading.noise, np.inf),
        kick=lengths[:, None, None] * drift[:, n : n + own + m],
        move=move,
        output=output,
    )


def _places(lag: np.ndarray, early: np.ndarray, first: int) -> dict[tuple[int, int], int]:
    """Return the places, from `first` on, of the states in which readings wait, by (reading, number).

    Args:
        lag: whole control samples between a reading, or the sample after it, and its use, (periods, readings).
        early: whether readings are taken between control samples (readings,).
        first: place of the first one.
    """
    numbers = np.max(lag, axis=0) + early
    waiting = [(k, number) for k, depth in enumerate(numbers) for number in range(1, depth + 1)]
    return {one: first + k for k, one in enumerate(waiting)}


def reading_of(sensors: Any, size: int, ticks: Ticks) -> Reading:
    """What sensors read of a state of this size at each control sample; where there are none, all of it, exactly.

    ticks: periods that have a length, of which the first is asked for what is known then.
    """
    if sensors.perfect:
        return Reading(np.eye(size), np.zeros(size), np.zeros(0), np.zeros(0))
    return sensors.reading(int(ticks.sample[0]), float(ticks.noise_weight[0]))


def walk_of(parts: Parts) -> np.ndarray:
    """1 sigma of the random walk's change per second, (m,) [N m/s]; zero without one."""
    return np.zeros(parts.plant.inputs) if parts.walk_rate is None else np.asarray(parts.walk_rate)


class _Linear(NamedTuple):
    """Derivatives of a period by the plant's local coordinates z at its start and by a torque p held through it.

    seen: of the error at the start, in the middle and at the end, one after the other; in the middle it is that of the
    cubic that `window_error` uses. early: of what sensors can see at the times of `star_state`; of a sensor suite the
    readings that are taken then. now: of a sensor suite all readings, if they are taken at the start of the period.
    """

    move: Array  # (periods, n, n)
    push: Array  # (periods, n, m)
    seen: Array  # (periods, 3 m, n)
    seen_push: Array  # (periods, 3 m, m)
    early: Array  # (periods, k, n); of no rows where there is no such time
    early_push: Array  # (periods, k, m)
    now: Array  # (periods, readings, n); of no rows without a sensor suite


@programs.jit(compiler_options=programs.QUICKLY)
def _linear(parts: Parts, log: Log, ticks: Ticks) -> _Linear:
    """Every period of a run linearised, by the code that flies it."""
    actuators, kinematics, plant = parts.actuators, parts.controller.kinematics, parts.plant
    before, after = (jax.tree.map(lambda v, k=k: v[k : v.shape[0] - 1 + k], log.x) for k in (0, 1))

    def acted(state: Any, now: tuple) -> tuple:
        tick, x, wanted = now
        dt = tick.t_next - tick.t
        drive, queue = actuators.command(state, wanted, plant.velocity(x), tick.t, dt, tick.noise_weight)
        return actuators.end(state, drive, queue, dt), drive

    _, drives = stacking.scan(acted, actuators.begin(plant.inputs), (ticks, before, log.commanded[:-1]))

    def period(tick: Ticks, x: Any, x_next: Any, drive: Any, disturbance: Array) -> _Linear:
        dt, target, target_next = tick.t_next - tick.t, parts.reference(tick.t), parts.reference(tick.t_next)
        pushed = disturbance - parts.disturbance(tick.t, x)

        def motion(x: Any, push: Array) -> PeriodMotion:
            return PeriodMotion(parts, tick.t, x, drive, pushed + push)

        taken = star_state(parts, tick, motion(x, jnp.zeros_like(pushed)).at)
        change = getattr(parts.sensors, "change", None)

        def flown(z: Float[Array, " n"], push: Float[Array, " m"]) -> tuple[Array, Array, Array, Array]:
            near = plant.retract(x, z)
            moving, early, now = motion(near, push), jnp.zeros(0), jnp.zeros(0)
            near_next = moving.after(dt)
            (start, rate), (end, rate_next) = kinematics.errors(near, target), kinematics.errors(near_next, target_next)
            middle = integrators.hermite_middle(start, rate, end, rate_next, dt)
            near_taken = star_state(parts, tick, moving.at)
            if change is not None:
                seen, near_seen = plant.visible(x), plant.visible(near)
                early, now = change(seen, near_seen, taken, near_taken), change(seen, near_seen)
            elif taken is not None:
                early = parts.observer.model.local_coordinates(taken, near_taken)
            return plant.local_coordinates(x_next, near_next), jnp.concatenate([start, middle, end]), early, now

        still = jnp.zeros_like(plant.local_coordinates(x, x))
        by = jax.jacfwd(flown, argnums=(0, 1))(still, jnp.zeros(plant.inputs))
        (move, push), (seen, seen_push), (early, early_push), (now, _) = by
        return _Linear(move, push, seen, seen_push, early, early_push, now)

    return lapack.vmap(period)(ticks, before, after, drives, log.disturbance[:-1])
