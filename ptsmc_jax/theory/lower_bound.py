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

The bound applies to the mean over trials. A single run, or a small campaign, may be below it by chance.

Read `bound_along_run` first.
"""

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ptsmc_jax import programs
from ptsmc_jax.batching import lapack
from ptsmc_jax.devices.sensors import MeasurementModel
from ptsmc_jax.devices.ticks import Ticks
from ptsmc_jax.numerics import integrators, stacking
from ptsmc_jax.numerics.pytrees import Scalar
from ptsmc_jax.simulation.control_period import star_state, state_after
from ptsmc_jax.simulation.metrics import Criteria, integral_in_window
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

    z is the state, v the process noise, y are the readings, and n is their noise. Each period begins with the sample.
    Then v acts, and then the state moves. v and n are independent. If the model combines several runs, the axis of the
    runs follows the axis of the periods, and all runs have readings at the same samples.
    """

    start: np.ndarray  # (.., n, k) Factor S of the covariance S S' of z before the first sample.
    rows: np.ndarray  # (m, n) or (periods, .., m, n): H, derivatives of the readings by z.
    noise: np.ndarray  # (periods, .., m) 1 sigma of each reading; infinite if the reading is not available.
    process_noise: np.ndarray  # (periods, .., n, v) B, with each column times the 1 sigma of its component of v.
    transition: np.ndarray  # (periods, .., n, n) F, transition matrix of z over a period.
    output: np.ndarray  # (periods, .., outputs, n) Derivatives of the outputs, such as errors, by the state z + B v.


def bound_along_run(parts: Parts, log: Log) -> LowerBound:
    """Return the lower bound on the error along a run, from its history (`rollout.simulate`, record=True)."""
    return bounds_along_runs([(parts, log)])[0]


def bounds_along_runs(runs: Sequence[tuple[Parts, Log]]) -> list[LowerBound]:
    """Return the lower bound on the error along each of several runs; runs with equal shapes are computed together."""
    nonzero = [(parts, *_nonzero_periods(parts, log)) for parts, log in runs]
    groups = dict[tuple, dict[int, Model]]()  # by delay, available samples and shapes
    for k, (parts, ticks, log) in enumerate(nonzero):
        if parts.clock.sampled and (not parts.sensors.perfect or parts.walk_rate is not None):  # else the bound is 0
            model = _build_model(parts, log, ticks)
            delay = parts.actuators.delay
            groups.setdefault((delay, np.isfinite(model.noise).tobytes(), *map(np.shape, model)), {})[k] = model
    squares = [np.zeros((len(ticks.t), 3)) for _, ticks, _ in nonzero]
    for (delay, *_), models in groups.items():
        start, *others = zip(*models.values(), strict=True)  # stacked along an axis of the runs, see `Model`
        model = Model(np.stack(start), *(np.stack(arrays, axis=1) for arrays in others))
        sizes = deviations(model, delay)
        if not np.all(model.noise > 0.0):
            # deviations that result only from the noise assumed for exact sensors, see `EXACT`, are proportional to it
            sizes = np.where(sizes > 3.0 * deviations(model, delay, EXACT / 10.0), 0.0, sizes)
        for place, k in enumerate(models):
            squares[k] = np.sum(sizes[:, place].reshape(len(sizes), 3, -1) ** 2, axis=2)
    # `squares` are mean squares of the error at the start, in the middle and at the end of each period
    return [
        LowerBound(window_error(parts, ticks, of_run), np.asarray(ticks.t_next), np.sqrt(of_run[:, 2]))
        for (parts, ticks, _), of_run in zip(nonzero, squares, strict=True)
    ]


def window_error(parts: Parts, ticks: Ticks, squares: np.ndarray) -> float:
    """Return the RMS error over the window, integrated as in the metric of a run.

    Args:
        parts: the scenario.
        ticks: control periods of the run.
        squares: mean squares of the error at start, middle and end of each period, (periods, 3).

    Returns:
        The RMS error, in the unit of `window_error`: [-] for a spacecraft.
    """
    times: Any = map(np.asarray, (parts.controller.t_f, parts.t_end, parts.window, parts.settling_angle))
    start, middle, end = squares.T
    total = np.sum(integral_in_window(ticks.t, ticks.t_next, (start, middle, end), Criteria(*times)))
    return float(np.sqrt(total / float(parts.window)))


def _nonzero_periods(parts: Parts, log: Log) -> tuple[Any, Any]:
    """Return the control periods of nonzero length, and the `Log` at their starts and at t_end, as NumPy arrays.

    The ticks begin and end at the actual sample times, which may differ from the nominal times.
    """
    ticks = jax.tree.map(np.asarray, _ticks(parts.clock, parts.controller.t_f, parts.controller.delta))
    lengths = ticks.t_next - ticks.t
    shortest = 1e-9 * float(np.max(lengths))
    kept = np.append(np.diff(np.asarray(log.t)) > shortest, True)
    nonzero = jax.tree.map(lambda v: v[lengths > shortest], ticks)
    log = jax.tree.map(lambda v: np.asarray(v)[kept], log)
    return nonzero._replace(t=log.t[:-1], t_next=log.t[1:]) if parts.clock.sampled else nonzero, log


@programs.jit
def _ticks(clock: Any, t_f: Array, delta: Array) -> Ticks:
    """Return all control periods of a clock, the first axis."""
    return clock.ticks(t_f, delta)


def deviations(model: Model, delay: int = 0, exact: float = EXACT) -> np.ndarray:
    """Return 1 sigma of each output (periods, .., outputs), given the samples up to `delay` periods earlier.

    The function propagates factors S of P = S S' by orthogonal transformations (Kaminski, Bryson, Schmidt, IEEE TAC
    16(6), 1971). It subtracts and inverts nothing, so that the noise levels may differ by many orders of magnitude.

    Args:
        model: linear-Gaussian model of one run or of several runs.
        delay: delay of the torque in whole periods.
        exact: relative 1 sigma of sensors without noise, see `EXACT`.
    """
    periods, sizes = len(model.transition), np.zeros(model.output.shape[:-1])
    shape = (*model.transition.shape[:-2], *model.rows.shape[-2:])
    rows, available = np.broadcast_to(model.rows, shape), np.isfinite(model.noise).reshape(periods, -1, shape[-2])
    factor, largest = model.start, np.zeros(shape[1:-1])
    factors = deque([(0, factor)], maxlen=delay + 1)  # period, and covariance factor given the samples up to it

    def propagate(k: int, factor: np.ndarray) -> np.ndarray:
        return model.transition[k] @ np.concatenate([factor, model.process_noise[k]], axis=-1)

    for k in range(periods):
        predicted, is_available = rows[k] @ factor, available[k, 0]
        largest = np.maximum(largest, _row_norms(predicted))
        noise = np.maximum(model.noise[k], exact * largest)[..., is_available]
        factor = _update_factor(factor, predicted[..., is_available, :], noise[..., None] * np.eye(noise.shape[-1]))
        factors.append((k, factor))
        period, delayed = factors[0]
        for j in range(period, k):
            delayed = _triangular(propagate(j, delayed))
        sizes[k] = _row_norms(model.output[k] @ np.concatenate([delayed, model.process_noise[k]], axis=-1))
        factor = propagate(k, factor)
    return sizes


def _triangular(factor: np.ndarray) -> np.ndarray:
    """Return a lower triangular factor (.., n, n) of the same covariance as a factor (.., n, k), k >= n."""
    return np.swapaxes(np.linalg.qr(np.swapaxes(factor, -1, -2), mode="r"), -1, -2)


def _update_factor(factor: np.ndarray, read: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Return a factor (.., n, n) of the covariance after readings.

    Args:
        factor: factor of the covariance before the readings, (.., n, k), k >= n.
        read: H times the factor, (.., m, k).
        noise: a factor of the covariance of the reading noise, (.., m, m).
    """
    *leading, m, k = read.shape
    combined = np.zeros((*leading, m + factor.shape[-2], m + k))
    combined[..., :m, :m], combined[..., :m, m:], combined[..., m:, m:] = noise, read, factor
    return _triangular(combined)[..., m:, m:]


def _row_norms(rows: np.ndarray) -> np.ndarray:
    """Return the 2-norms of the rows."""
    return np.sqrt(np.einsum("...ij,...ij->...i", rows, rows))


def _build_model(parts: Parts, log: Log, ticks: Ticks) -> Model:
    """Return the linear-Gaussian model of a run.

    Its states are the plant's local coordinates, the sensor states (bias), the random-walk torque, and readings that
    were taken but are not used yet.
    """
    jacobians: Any = jax.tree.map(np.asarray, _linearise_run(parts, log, ticks))
    periods, n, m = jacobians.push.shape
    reading = reading_of(parts.sensors, n, ticks)
    sensor_states, count = reading.own.size, reading.noise.size
    lag = (
        parts.sensors.sample_delays(ticks)
        if hasattr(parts.sensors, "sample_delays")
        else np.zeros((periods, count), int)
    )
    early = np.zeros(count, bool) if reading.early is None else reading.early
    places = _register_places(lag, early, n + sensor_states + m)
    size, torque = n + sensor_states + m + len(places), slice(n + sensor_states, n + sensor_states + m)

    def widen_rows(rows: np.ndarray) -> np.ndarray:
        """Return derivatives by seen states and sensor states as derivatives by all states, with zeros elsewhere."""
        seen = rows.shape[-1] - sensor_states  # flexible modes follow the seen states; no sensor reads them
        rows = np.insert(rows, [seen] * (n - seen), 0.0, axis=-1)
        return np.pad(rows, [*[(0, 0)] * (rows.ndim - 1), (0, size - rows.shape[-1])])

    # derivatives by the state at the start of a period: `now` of readings at the start, `rows_at_sample` of readings at
    # their actual sample times
    now, has_suite = np.tile(widen_rows(reading.rows), (periods, 1, 1)), jacobians.now.shape[1] > 0
    if has_suite:
        now[:, :, :n] = jacobians.now
    rows_at_sample = now.copy()
    if np.any(early):
        by_seen = np.eye(count) if has_suite else reading.rows[:, : jacobians.early.shape[1]]
        rows_at_sample[:, early, :n] = by_seen[early] @ jacobians.early
        rows_at_sample[:, early, torque] = by_seen[early] @ jacobians.early_push

    # `UNKNOWN` is relative to the 1 sigma of the reading, noise and bias; a state that is read without noise is known
    reading_sigma = np.hypot(reading.noise, np.linalg.norm(now[0, :, n : n + sensor_states] * reading.own, axis=1))
    initial_sigma = UNKNOWN * np.max(np.abs(now[0, :, :n]) * reading_sigma[:, None], axis=0)
    start = np.diag(np.concatenate([initial_sigma, reading.own, np.zeros(size - n - sensor_states)]))
    lengths = np.asarray(ticks.t_next - ticks.t)
    drift = np.diag(np.concatenate([np.zeros(n), reading.own_drift, walk_intensity(parts), np.zeros(len(places))]))
    transition = np.tile(np.eye(size), (periods, 1, 1))
    transition[:, :n, :n], transition[:, :n, torque] = jacobians.transition, jacobians.push
    output = np.zeros((periods, jacobians.error.shape[1], size))
    output[:, :, :n], output[:, :, torque] = jacobians.error, jacobians.error_push
    # a reading that is used at a later sample is stored in extra states, which form a shift register
    rows = now.copy()
    for (k, stage), place in places.items():
        transition[:, place] = rows_at_sample[:, k] if stage == 1 else np.eye(size)[places[k, stage - 1]]
        if stage == 1 and early[k]:
            start[place] = now[0, k] @ start  # the readings of the first sample are taken at the sample itself
        rows[lag[:, k] + early[k] == stage, k] = np.eye(size)[place]
    if reading.start is not None:
        known_rows, factor = reading.start
        start = _update_factor(start, widen_rows(known_rows) @ start, factor)
    available = np.ones((periods, count), bool) if parts.sensors.perfect else parts.sensors.available(ticks)
    return Model(
        start=start,
        rows=rows,
        noise=np.where(available, reading.noise, np.inf),
        process_noise=lengths[:, None, None] * drift[:, n : n + sensor_states + m],
        transition=transition,
        output=output,
    )


def _register_places(lag: np.ndarray, early: np.ndarray, first: int) -> dict[tuple[int, int], int]:
    """Return the index of each state that stores a delayed reading, by (reading, position in its shift register).

    Args:
        lag: number of control periods between a reading and its use, (periods, readings). A reading between two
            samples counts from the later sample.
        early: whether readings are taken between control samples (readings,).
        first: index of the first state that stores a reading.
    """
    stages = np.max(lag, axis=0) + early
    stored = [(k, stage) for k, depth in enumerate(stages) for stage in range(1, depth + 1)]
    return {reading_and_stage: first + k for k, reading_and_stage in enumerate(stored)}


def reading_of(sensors: Any, size: int, ticks: Ticks) -> MeasurementModel:
    """Return the linear measurement model of the sensors. Perfect sensors read the whole state exactly.

    Args:
        sensors: the sensors of the scenario.
        size: number of states that the sensors see.
        ticks: control periods of nonzero length; the first one gives the initial conditions.
    """
    if sensors.perfect:
        return MeasurementModel(np.eye(size), np.zeros(size), np.zeros(0), np.zeros(0))
    return sensors.measurement_model(int(ticks.sample[0]), float(ticks.noise_weight[0]))


def walk_intensity(parts: Parts) -> np.ndarray:
    """Return the intensity r of the random-walk torque, (m,) [N m/s], or zeros without a random walk.

    At the start of a period of length h the torque changes by a Gaussian step with 1 sigma r h.
    """
    return np.zeros(parts.plant.inputs) if parts.walk_rate is None else np.asarray(parts.walk_rate)


class _RunJacobians(NamedTuple):
    """Derivatives of states, errors and readings in each control period by z and p, along a run.

    z (n,) are the plant's local coordinates at the start of the period. p (m,) is a torque on the plant that is
    constant in the period [N m].
    """

    transition: Array  # (periods, n, n) Derivative of the state at the end of the period by z.
    push: Array  # (periods, n, m) Derivative of the same state by p.
    error: Array  # (periods, 3 m, n) Derivative by z of the error at start, middle and end; middle is interpolated.
    error_push: Array  # (periods, 3 m, m) Derivative of the error at start, middle and end by the torque p.
    early: Array  # (periods, k, n) Derivative by z of quantities measured within the period; k = 0 without them.
    early_push: Array  # (periods, k, m) Derivative of the same quantities by p.
    now: Array  # (periods, readings, n) Derivative by z of a sensor suite's readings at the start; else no rows.


@programs.jit(compiler_options=programs.FAST_COMPILE)
def _linearise_run(parts: Parts, log: Log, ticks: Ticks) -> _RunJacobians:
    """Linearise the simulation code of every period of a run."""
    actuators, kinematics, plant = parts.actuators, parts.controller.kinematics, parts.plant
    before, after = (jax.tree.map(lambda v, k=k: v[k : v.shape[0] - 1 + k], log.x) for k in (0, 1))

    def step_actuators(state: Any, entry: tuple) -> tuple:
        tick, x, commanded = entry
        dt = tick.t_next - tick.t
        drive, queue = actuators.command(state, commanded, plant.velocity(x), tick.t, dt, tick.noise_weight)
        return actuators.end(state, drive, queue, dt), drive

    _, drives = stacking.scan(step_actuators, actuators.begin(plant.inputs), (ticks, before, log.commanded[:-1]))

    def linearise_period(tick: Ticks, x: Any, x_next: Any, drive: Any, disturbance: Array) -> _RunJacobians:
        dt, target, target_next = tick.t_next - tick.t, parts.reference(tick.t), parts.reference(tick.t_next)
        extra_torque = disturbance - parts.disturbance(tick.t, x)

        def motion(x: Any, push: Array) -> Callable[[Scalar], Any]:
            return partial(state_after, parts, tick.t, x, drive, extra_torque + push)

        sampled = star_state(parts, tick, motion(x, jnp.zeros_like(extra_torque)))
        change = getattr(parts.sensors, "change", None)

        def simulate_period(z: Float[Array, " n"], push: Float[Array, " m"]) -> tuple[Array, Array, Array, Array]:
            near = plant.retract(x, z)
            near_motion, early, now = motion(near, push), jnp.zeros(0), jnp.zeros(0)
            near_next = near_motion(dt)
            (start, rate), (end, rate_next) = kinematics.errors(near, target), kinematics.errors(near_next, target_next)
            middle = integrators.hermite_middle(start, rate, end, rate_next, dt)
            near_sampled = star_state(parts, tick, near_motion)
            if change is not None:
                seen, near_seen = plant.visible(x), plant.visible(near)
                early, now = change(seen, near_seen, sampled, near_sampled), change(seen, near_seen)
            elif sampled is not None:
                early = parts.observer.model.local_coordinates(sampled, near_sampled)
            return plant.local_coordinates(x_next, near_next), jnp.concatenate([start, middle, end]), early, now

        zero = jnp.zeros_like(plant.local_coordinates(x, x))
        jacobians = jax.jacfwd(simulate_period, argnums=(0, 1))(zero, jnp.zeros(plant.inputs))
        (transition, push), (error, error_push), (early, early_push), (now, _) = jacobians
        return _RunJacobians(transition, push, error, error_push, early, early_push, now)

    return lapack.vmap(linearise_period)(ticks, before, after, drives, log.disturbance[:-1])
