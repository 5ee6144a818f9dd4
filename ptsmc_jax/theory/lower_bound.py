"""Lower bound on the pointing error: the posterior Cramer-Rao bound of the state along a run.

A controller cannot make the error smaller than the uncertainty of the state at the time when its torque acts. With
Gaussian noise, and under the assumptions below, the Kalman filter along the run has the smallest covariance P of all
estimators (Tichavsky, Muravchik, Nehorai, IEEE Trans. Signal Processing 46(5), 1998). At every sample
P+ = P - P H' (H P H' + R)^-1 H P, and between samples P <- F P F' + Q. F is the derivative of a period of the true
plant.

Assumptions:

- The plant, its true inertia and the torque on the body are known.
- Flexible modes are known, and they are at rest at t = 0.
- The disturbance is known except for its random walk. The intensity of every noise is known.
- Attitude and rate are unknown before the first sample, so that the bound applies to controllers that perform equally
  well from every initial state.
- An attitude filter starts with its steady-state covariance, and a gyro bias with its 1 sigma.
- The torque in a period uses samples up to `delay` periods before its start. The error is predicted from there on.

The bound applies to the mean over trials. A single run, or a small campaign, may be below it by chance. Read `along`
first.
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

UNKNOWN = 1e5  # Initial 1 sigma of an unknown state, relative to 1 sigma of its sensor: the first sample outweighs it.
EXACT = 1e-10  # 1 sigma of a sensor without noise, relative to the largest deviation of its reading so far.


@dataclass(frozen=True)
class LowerBound:
    """Lower bound on the error of a run; 0 if nothing is unknown."""

    window_error: float  # RMS over the window after t_f, in the unit of the metric
    t: np.ndarray = field(repr=False)  # (time,) ends of the control periods [s]
    error: np.ndarray = field(repr=False)  # (time,) RMS of the error's 2-norm at these times


class Model(NamedTuple):
    """Linear-Gaussian model of `periods` control periods: z' = F (z + B v), y = H z + n.

    Each period begins with the sample. Then the process noise v acts, and then the state moves. v and n are
    independent. If the model combines several runs, the axis of the runs follows the axis of the periods, and all runs
    have readings at the same samples.
    """

    start: np.ndarray  # (.., n, k) Factor S of the covariance S S' before the first sample.
    rows: np.ndarray  # (m, n) H, or (periods, .., m, n).
    noise: np.ndarray  # (periods, .., m) 1 sigma of each reading; infinite if the reading is not available.
    kick: np.ndarray  # (periods, .., n, v) B, times the 1 sigma of v.
    move: np.ndarray  # (periods, .., n, n) F.
    output: np.ndarray  # (periods, .., outputs, n) Derivatives of the outputs by z + B v.


def along(parts: Parts, log: Log) -> LowerBound:
    """Return the lower bound along a run with this history (`rollout.simulate`, record=True)."""
    return along_each([(parts, log)])[0]


def along_each(runs: Sequence[tuple[Parts, Log]]) -> list[LowerBound]:
    """Return the lower bound along each of several runs of a scenario; runs with equal shapes are computed together."""
    lasting = [(parts, *_lasting(parts, log)) for parts, log in runs]
    alike = dict[tuple, dict[int, Model]]()  # by delay, available samples and shapes
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
    # `squares` are mean squares of the error at the start, in the middle and at the end of each period
    return [
        LowerBound(window_error(parts, ticks, of_run), np.asarray(ticks.t_next), np.sqrt(of_run[:, 2]))
        for (parts, ticks, _), of_run in zip(lasting, squares, strict=True)
    ]


def _together(models: Sequence[Model]) -> Model:
    """Stack the models of several runs along an axis of the runs, see `Model`."""
    start, *others = zip(*models, strict=True)
    return Model(np.stack(start), *(np.stack(some, axis=1) for some in others))


def window_error(parts: Parts, ticks: Ticks, squares: np.ndarray) -> float:
    """Return the RMS error over the window, integrated as in the metric of a run.

    Args:
        parts: the scenario.
        ticks: control periods of the run.
        squares: mean squares of the error at start, middle and end of each period, (periods, 3).
    """
    times: Any = map(np.asarray, (parts.controller.t_f, parts.t_end, parts.window, parts.settling_angle))
    start, middle, end = squares.T
    total = np.sum(integral_in_window(ticks.t, ticks.t_next, (start, middle, end), Criteria(*times)))
    return float(np.sqrt(total / float(parts.window)))


def pooled(bounds: Iterable[LowerBound]) -> float | None:
    """Return the RMS of the bounds of several runs, pooled like window errors, or None without runs."""
    squares = [one.window_error**2 for one in bounds]
    return float(np.sqrt(np.mean(squares))) if squares else None


def _lasting(parts: Parts, log: Log) -> tuple[Any, Any]:
    """Return the control periods of nonzero length, and the `Log` at their starts and at t_end, as NumPy arrays.

    The ticks begin and end at the actual sample times, which may differ from the nominal times.
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
    """Return `deviations`, but 0 for a deviation that results only from the small noise `EXACT` of exact sensors."""
    sizes = deviations(model, delay)
    if np.all(model.noise > 0.0):
        return sizes
    # such deviations are proportional to the assumed noise, and a tenth of it leaves a tenth of them
    return np.where(sizes > 3.0 * deviations(model, delay, EXACT / 10.0), 0.0, sizes)


def deviations(model: Model, delay: int = 0, exact: float = EXACT) -> np.ndarray:
    """Return 1 sigma of each output (periods, .., outputs), given the samples up to `delay` periods earlier.

    The function propagates factors S of P = S S' by orthogonal transformations (Kaminski, Bryson, Schmidt, IEEE TAC
    16(6), 1971). It subtracts and inverts nothing, so that the noise levels may differ by many orders of magnitude.

    Args:
        model: linear-Gaussian model of one run or of several runs.
        delay: delay of the torque in whole periods.
        exact: relative 1 sigma of sensors without noise, see `EXACT`.
    """
    periods, sizes = len(model.move), np.zeros(model.output.shape[:-1])
    shape = (*model.move.shape[:-2], *model.rows.shape[-2:])
    rows, available = np.broadcast_to(model.rows, shape), np.isfinite(model.noise).reshape(periods, -1, shape[-2])
    factor, largest = model.start, np.zeros(shape[1:-1])
    known = deque([(0, factor)], maxlen=delay + 1)  # period, and covariance factor given the samples up to it

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
    """Return a lower triangular factor (.., n, n) of the same covariance as a factor (.., n, k), k >= n."""
    return np.swapaxes(np.linalg.qr(np.swapaxes(factor, -1, -2), mode="r"), -1, -2)


def _corrected(factor: np.ndarray, read: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Return a factor (.., n, n) of the covariance after readings.

    Args:
        factor: factor of the covariance before the readings, (.., n, k), k >= n.
        read: H times the factor, (.., m, k).
        noise: a factor of the covariance of the reading noise, (.., m, m).
    """
    *many, m, k = read.shape
    both = np.zeros((*many, m + factor.shape[-2], m + k))
    both[..., :m, :m], both[..., :m, m:], both[..., m:, m:] = noise, read, factor
    return _triangular(both)[..., m:, m:]


def _sizes(rows: np.ndarray) -> np.ndarray:
    """Return the 2-norms of the rows."""
    return np.sqrt(np.einsum("...ij,...ij->...i", rows, rows))


def _model(parts: Parts, log: Log, ticks: Ticks) -> Model:
    """Return the linear-Gaussian model of a run.

    Its states are the plant's local coordinates, the sensor states (bias), the random-walk torque, and readings that
    were taken but are not used yet.
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
        seen = rows.shape[-1] - own  # the flexible modes, which no sensor reads, follow the seen states
        rows = np.insert(rows, [seen] * (n - seen), 0.0, axis=-1)
        return np.pad(rows, [*[(0, 0)] * (rows.ndim - 1), (0, size - rows.shape[-1])])

    # derivatives by the state at the start of a period: `now` for a reading then, `taken` for one at its actual time
    now, suite = np.tile(wide(reading.rows), (periods, 1, 1)), linear.now.shape[1] > 0
    if suite:
        now[:, :, :n] = linear.now
    taken = now.copy()
    if np.any(early):
        by_seen = np.eye(count) if suite else reading.rows[:, : linear.early.shape[1]]
        taken[:, early, :n] = by_seen[early] @ linear.early
        taken[:, early, torque] = by_seen[early] @ linear.early_push

    # `UNKNOWN` is relative to the 1 sigma of the reading, noise and bias; a state that is read without noise is known
    off = np.hypot(reading.noise, np.linalg.norm(now[0, :, n : n + own] * reading.own, axis=1))
    unknown = UNKNOWN * np.max(np.abs(now[0, :, :n]) * off[:, None], axis=0)
    start = np.diag(np.concatenate([unknown, reading.own, np.zeros(size - n - own)]))
    lengths = np.asarray(ticks.t_next - ticks.t)
    drift = np.diag(np.concatenate([np.zeros(n), reading.own_drift, walk_intensity(parts), np.zeros(len(places))]))
    move = np.tile(np.eye(size), (periods, 1, 1))
    move[:, :n, :n], move[:, :n, torque] = linear.move, linear.push
    output = np.zeros((periods, linear.error.shape[1], size))
    output[:, :, :n], output[:, :, torque] = linear.error, linear.error_push
    # a reading that is used at a later sample is stored in extra states, which form a shift register
    rows = now.copy()
    for (k, number), place in places.items():
        move[:, place] = taken[:, k] if number == 1 else np.eye(size)[places[k, number - 1]]
        if number == 1 and early[k]:
            start[place] = now[0, k] @ start  # the readings of the first sample are taken at the sample itself
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
    """Return the index of each state that stores a delayed reading, by (reading, position in its shift register).

    Args:
        lag: number of control periods between a reading and its use, (periods, readings). A reading between two
            samples counts from the later sample.
        early: whether readings are taken between control samples (readings,).
        first: index of the first state that stores a reading.
    """
    numbers = np.max(lag, axis=0) + early
    waiting = [(k, number) for k, depth in enumerate(numbers) for number in range(1, depth + 1)]
    return {one: first + k for k, one in enumerate(waiting)}


def reading_of(sensors: Any, size: int, ticks: Ticks) -> Reading:
    """Return the linear measurement model of the sensors. Perfect sensors read the whole state exactly.

    Args:
        sensors: the sensors of the scenario.
        size: number of states that the sensors see.
        ticks: control periods of nonzero length; the first one gives the initial conditions.
    """
    if sensors.perfect:
        return Reading(np.eye(size), np.zeros(size), np.zeros(0), np.zeros(0))
    return sensors.reading(int(ticks.sample[0]), float(ticks.noise_weight[0]))


def walk_intensity(parts: Parts) -> np.ndarray:
    """Return the intensity r of the random-walk torque, (m,) [N m/s], or zeros without a random walk.

    At the start of a period of length h the torque changes by a Gaussian step with 1 sigma r h.
    """
    return np.zeros(parts.plant.inputs) if parts.walk_rate is None else np.asarray(parts.walk_rate)


class _Linear(NamedTuple):
    """Jacobians of each control period with respect to the initial state and to a constant torque.

    z (n,) are the plant's local coordinates at the start of the period. p (m,) is a torque on the plant that is
    constant in the period [N m].
    """

    move: Array  # (periods, n, n) State at the end by z.
    push: Array  # (periods, n, m) State at the end by p.
    error: Array  # (periods, 3 m, n) Error at the start, in the middle (interpolated) and at the end by z.
    error_push: Array  # (periods, 3 m, m) The same errors by p.
    early: Array  # (periods, k, n) Measured quantities at sample times within the period by z; k = 0 without them.
    early_push: Array  # (periods, k, m) The same quantities by p.
    now: Array  # (periods, readings, n) Readings of a sensor suite at the start of the period by z; else no rows.


@programs.jit(compiler_options=programs.QUICKLY)
def _linear(parts: Parts, log: Log, ticks: Ticks) -> _Linear:
    """Linearise the simulation code of every period of a run."""
    actuators, kinematics, plant = parts.actuators, parts.controller.kinematics, parts.plant
    before, after = (jax.tree.map(lambda v, k=k: v[k : v.shape[0] - 1 + k], log.x) for k in (0, 1))

    def acted(state: Any, now: tuple) -> tuple:
        tick, x, commanded = now
        dt = tick.t_next - tick.t
        drive, queue = actuators.command(state, commanded, plant.velocity(x), tick.t, dt, tick.noise_weight)
        return actuators.end(state, drive, queue, dt), drive

    _, drives = stacking.scan(acted, actuators.begin(plant.inputs), (ticks, before, log.commanded[:-1]))

    def period(tick: Ticks, x: Any, x_next: Any, drive: Any, disturbance: Array) -> _Linear:
        dt, target, target_next = tick.t_next - tick.t, parts.reference(tick.t), parts.reference(tick.t_next)
        pushed = disturbance - parts.disturbance(tick.t, x)

        def motion(x: Any, push: Array) -> PeriodMotion:
            return PeriodMotion(parts, tick.t, x, drive, pushed + push)

        taken = star_state(parts, tick, motion(x, jnp.zeros_like(pushed)).at)
        change = getattr(parts.sensors, "change", None)

        def simulated(z: Float[Array, " n"], push: Float[Array, " m"]) -> tuple[Array, Array, Array, Array]:
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
        by = jax.jacfwd(simulated, argnums=(0, 1))(still, jnp.zeros(plant.inputs))
        (move, push), (error, error_push), (early, early_push), (now, _) = by
        return _Linear(move, push, error, error_push, early, early_push, now)

    return lapack.vmap(period)(ticks, before, after, drives, log.disturbance[:-1])
