"""Prediction errors of a log: an extended Kalman filter over the true plant, with its actuators and disturbances.

The filter is multiplicative for a spacecraft (Lefferts, Markley, Shuster, JGCD 5(5), 1982). Its error state is a small
rotation about the body axes, and the errors of rate, modes, gyro bias and random-walk torque. Other plants have their
own states instead. The command is constant between samples, before delay and lag. The components of a sample have
independent noise and correct the state one after the other. Each innovation is therefore a scalar with a variance
(Bierman, Factorization Methods for Discrete Sequential Estimation, 1977, chapter 2). Read `run_filter` first.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ptsmc_jax.campaigns.store import RefusedError
from ptsmc_jax.devices.actuators import Actuators, Drive
from ptsmc_jax.identification.telemetry import Measurements
from ptsmc_jax.numerics import attitude, guards, integrators, matrices
from ptsmc_jax.numerics.pytrees import Leaf, Scalar, pytree
from ptsmc_jax.plants.base import Plant, State
from ptsmc_jax.plants.rigid_body import AttitudeState

MAX_STEPS = 10_000_000  # largest number of integration steps of a log
UNMEASURED_SIGMA = 10.0  # prior 1 sigma of a state without a reading in the first row, relative to its estimate


@pytree
@dataclass(frozen=True)
class Model:
    """The model of a log, with every parameter that can be estimated. Absent effects are zeros or None."""

    plant: Any  # true plant
    disturbance: Any
    actuators: Actuators  # actuators without their delay
    delay: Leaf  # time from a command to its effect [s]
    noises: dict[str, Leaf]  # 1 sigma of each component of a reading, by its name [rad, rad/s, unit of x]
    tracker_axes: Leaf  # (3, 3) axes of the star tracker in body axes, one per row; its noise is about them
    rate_scale: Leaf  # (3,) ratio of gyro reading to true rate [-]
    misalignment: Leaf  # (3,) rotation vector of the star tracker in the body [rad]
    bias_sigma: Leaf  # prior 1 sigma of the gyro bias; 0: no bias [rad/s]
    bias_walk: Leaf  # density of the gyro bias's random walk [rad/s/sqrt(s)]
    walk_density: Leaf  # (m,) density of the random-walk torque [N m/sqrt(s)]
    hidden_sigma: Leaf  # (n,) prior 1 sigma of the states without a sensor, such as modal coordinates, at the first row
    acceleration_noise: Leaf  # density of white noise on the acceleration; 0 if the model explains the log [rad/s^1.5]

    @property
    def is_spacecraft(self) -> bool:
        """Whether the plant has an attitude."""
        return hasattr(self.plant, "with_inertia")


class Rows(NamedTuple):
    """A log as arrays for the filter, one row for each integration step; the first row is at time 0."""

    t: Any  # (rows,) [s]
    dt: Any  # (rows,) time to the next row [s]; 0 in the last row and in padding
    readings: dict[str, Any]  # readings by name, (rows, size); the value of a missing component is arbitrary
    valid: Any  # (rows, components) bool
    command: Any  # (rows, channels), see `Measurements`
    start_rate: Any  # (3,) rate at the first row if the gyro has no reading there [rad/s]; (0,) for other plants
    log_row: np.ndarray  # (rows,) index of the row in the log, -1 for added rows


class Innovations(NamedTuple):
    """Prediction errors of all rows but the first, (rows - 1, components); 0 with variance 1 without a reading."""

    value: Any  # reading minus prediction, given the readings before and the components before in this row
    variance: Any
    accepted: Any  # bool: there is a reading, and it is no outlier


class FilterState(NamedTuple):
    """Estimates and covariance of the filter at a row, or at many rows with a leading axis."""

    x: State  # state of the plant
    bias: Any  # (3,) gyro bias [rad/s]
    walk: Any  # (m,) random-walk torque [N m]
    covariance: Any  # (n, n) of the errors of state, bias and torque
    actuators: Any  # `ActuatorState`; None in a stored track


def make_rows(log: Measurements, step: float, bucket: int = 1) -> Rows:
    """Return a log as rows for the filter. Long intervals are divided into several rows.

    Args:
        log: the measurements.
        step: largest integration step [s].
        bucket: the rows are padded to a multiple of this number, so that logs of similar lengths share a program.

    Raises:
        RefusedError: the log needs more than `MAX_STEPS` steps.
    """
    step_counts = np.maximum(1, np.ceil(np.diff(log.t) / step * (1.0 - 1e-9)).astype(int))
    if step_counts.sum() > MAX_STEPS:
        raise RefusedError(f"{log.name} needs {step_counts.sum()} integration steps, but may need at most {MAX_STEPS}; "
                           f"check its times, which have a gap of {np.max(np.diff(log.t)):.3g} s")  # fmt: skip
    first_steps = np.append(0, np.cumsum(step_counts))
    count = int(first_steps[-1]) + 1
    log_row = np.full(count, -1)
    log_row[first_steps] = np.arange(len(log.t))
    t = np.interp(np.arange(count), first_steps, log.t)
    previous_row = np.searchsorted(first_steps, np.arange(count), side="right") - 1
    command = log.command[previous_row]
    if log.wheel_inertia is not None:  # wheel speeds change linearly
        command = np.stack([np.interp(t, log.t, column) for column in log.command.T], axis=1)
    valid, readings = [], {}
    for name, values in log.readings.items():
        has_reading = (log_row >= 0)[:, None] & ~np.isnan(values[previous_row])
        missing = np.eye(4)[3] if values.shape[1] == 4 else 0.0  # an arbitrary value of the right kind
        readings[name] = np.where(has_reading, np.nan_to_num(values[previous_row]), missing)
        valid.append(has_reading[:, :3] if name == "attitude" else has_reading)
    padding = -count % bucket

    def pad(values: np.ndarray) -> np.ndarray:
        return np.concatenate([values, np.repeat(values[-1:], padding, axis=0)])

    return Rows(
        np.append(t, t[-1] + np.arange(1.0, padding + 1.0)),  # increasing times, so that commands can be interpolated
        np.pad(np.diff(t), (0, 1 + padding)),
        {name: pad(values) for name, values in readings.items()},
        np.pad(np.concatenate(valid, axis=1), ((0, padding), (0, 0))),
        pad(command),
        _estimate_start_rate(log),
        np.pad(log_row, (0, padding), constant_values=-1),
    )


def _estimate_start_rate(log: Measurements) -> np.ndarray:
    """Return the rate at the first row from the first two attitudes, zero without them [rad/s]."""
    if "x" in log.readings:
        return np.zeros(0)
    q = log.readings.get("attitude")
    attitude_rows = np.zeros(0, int) if q is None else np.flatnonzero(~np.isnan(q[:, 0]))
    if q is None or attitude_rows.size < 2:
        return np.zeros(3)
    rotation = np.asarray(attitude.small_rotation(jnp.asarray(q[attitude_rows[0]]), jnp.asarray(q[attitude_rows[1]])))
    return rotation / (log.t[attitude_rows[1]] - log.t[attitude_rows[0]])


def acting_command(model: Model, rows: Rows, wheel_inertia: float | None) -> Array:
    """Return the mean of the delayed command over each interval.

    The mean has the same impulse as the command, which may change within the interval. No command acts before the first
    row. If the log has wheel speeds, the command is the torque of the wheels on the body.

    Args:
        model: the model, whose delay acts on the command.
        rows: the log as rows.
        wheel_inertia: inertia of a wheel about its axis [kg m^2] if the command of the log is the wheel speeds [rad/s];
            None for torques.

    Returns:
        The mean (rows, channels), for a spacecraft in N m.
    """
    if wheel_inertia is not None:
        change = jnp.append(jnp.diff(rows.command, axis=0), jnp.zeros((1, rows.command.shape[1])), axis=0)
        return -wheel_inertia * change / jnp.where(rows.dt > 0.0, rows.dt, jnp.inf)[:, None]
    integral = jnp.cumsum(rows.command * rows.dt[:, None], axis=0)
    integral = jnp.concatenate([jnp.zeros((1, rows.command.shape[1])), integral[:-1]])

    def integrate_delayed_command(time: Array) -> Array:
        """Return the integral of the delayed command from the first row to these times, (times, channels)."""
        return jnp.stack([jnp.interp(time - model.delay, rows.t, column) for column in integral.T], axis=1)

    impulse = integrate_delayed_command(rows.t + rows.dt) - integrate_delayed_command(rows.t)
    mean = impulse / jnp.where(rows.dt > 0.0, rows.dt, jnp.inf)[:, None]
    return jnp.where(model.delay == 0.0, rows.command, mean)


class LogKind(NamedTuple):
    """The structure of a log, which a compiled program depends on."""

    by_channel: bool
    wheel_inertia: float | None


def use_wheel_speeds(model: Model, wheel_inertia: float | None) -> Model:
    """Return the model of a log that has wheel speeds instead of commands; None returns the model unchanged.

    The speeds are relative to the body, so that the wheels' spin inertia turns with it: J becomes J + sum I a a'. The
    wheels have no lag, because their speed is measured. A scale factor error is an error of their inertia.
    """
    if wheel_inertia is None:
        return model
    actuators = replace(model.actuators, lag=None, rate_limit=None)
    axes = actuators.directions if actuators.directions is not None else actuators.wheels.axes  # pyright: ignore
    scale = jnp.ones(axes.shape[1]) if actuators.scale is None else actuators.scale
    inertia = model.plant.inertia + wheel_inertia * (axes * scale[None, :]) @ axes.T
    plant = model.plant.with_inertia(inertia, matrices.solve(inertia, jnp.eye(3)))
    return replace(model, plant=plant, actuators=actuators)


def run_filter(
    model: Model,
    rows: Rows,
    kind: LogKind,
    gate: Scalar | float = jnp.inf,
    *,
    with_track: bool = True,
    covariance_derivatives: bool = True,
) -> tuple[Innovations, FilterState | None]:
    """Return the prediction errors of a log and the estimates of the filter.

    Args:
        model: the model.
        rows: the log.
        kind: structure of the log.
        gate: a group of readings whose normalised square exceeds this number times its size is rejected.
        with_track: whether the estimates are returned as well. They need memory for a covariance of each row.
        covariance_derivatives: whether derivatives of the innovations include those of the predicted covariance.

    Returns:
        The innovations, (rows - 1, components), and the states of the filter at all rows but the first, or None.
    """
    model = use_wheel_speeds(model, kind.wheel_inertia)
    acting = acting_command(model, rows, kind.wheel_inertia)
    carry = _initial_carry(model, rows)

    def step(carry: FilterState, row: tuple) -> tuple[FilterState, tuple[Innovations, FilterState | None]]:
        t, dt, command, acting, readings, valid = row
        carry = _predict(model, carry, t, dt, command, acting, kind)
        carry = carry if covariance_derivatives else carry._replace(covariance=jax.lax.stop_gradient(carry.covariance))
        carry, errors = _correct(model, carry, readings, valid, gate)
        return carry, (errors, carry._replace(actuators=None) if with_track else None)

    inputs = rows.t[:-1], rows.dt[:-1], rows.command[:-1], acting[:-1]
    next_readings = jax.tree.map(lambda v: v[1:], (rows.readings, rows.valid))
    _, outputs = jax.lax.scan(step, carry, (*inputs, *next_readings))
    return outputs


def _initial_carry(model: Model, rows: Rows) -> FilterState:
    """Return the filter at the first row. Its readings determine the state, which has no other prior knowledge."""
    readings = jax.tree.map(lambda v: v[0], rows.readings)
    walk = jnp.zeros(model.plant.inputs if model.walk_density is not None else 0)
    actuators = model.actuators.begin(model.plant.inputs)
    if not model.is_spacecraft:
        x = model.plant.with_hidden_at_rest(readings["x"])
        p = jnp.diag(jnp.concatenate([model.noises["x"] ** 2, model.hidden_sigma**2, jnp.zeros_like(walk)]))
        return FilterState(x, jnp.zeros(0), walk, p, actuators)
    inverse_turn = attitude.from_rotation_vector(-model.misalignment)
    identity = jnp.array([0.0, 0.0, 0.0, 1.0])
    q = attitude.multiply(readings["attitude"], inverse_turn) if "attitude" in readings else identity
    tracker_to_body = _rotation_matrix(model.misalignment) @ model.tracker_axes.T
    attitude_variance = model.noises["attitude"] ** 2 if "attitude" in readings else jnp.zeros(3)
    has_rate = rows.valid[0, -1] if "rate" in readings else False
    rate_variance = model.noises["rate"] ** 2 if "rate" in readings else jnp.zeros(3)
    bias_variance = model.bias_sigma**2 * jnp.ones(3)
    w = jnp.where(has_rate, readings["rate"] / model.rate_scale if "rate" in readings else 0.0, rows.start_rate)
    unknown_variance = (UNMEASURED_SIGMA * jnp.max(jnp.abs(rows.start_rate)) + 1e-3) ** 2 * jnp.ones(3)
    start_variance = jnp.where(has_rate, (rate_variance + bias_variance) / model.rate_scale**2, unknown_variance)
    n = 6 + model.hidden_sigma.size
    p = jnp.zeros((n + 3 + walk.size,) * 2)
    p = p.at[:3, :3].set(tracker_to_body @ jnp.diag(attitude_variance) @ tracker_to_body.T)
    p = p.at[3:6, 3:6].set(jnp.diag(start_variance))
    p = p.at[6:n, 6:n].set(jnp.diag(model.hidden_sigma**2)).at[n : n + 3, n : n + 3].set(jnp.diag(bias_variance))
    rate_bias_covariance = jnp.diag(jnp.where(has_rate, -bias_variance / model.rate_scale, 0.0))
    p = p.at[3:6, n : n + 3].set(rate_bias_covariance).at[n : n + 3, 3:6].set(rate_bias_covariance)
    x = model.plant.with_hidden_at_rest(AttitudeState(q, w))
    return FilterState(x, jnp.zeros(3), walk, p, actuators)


def _rotation_matrix(rotation_vector: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Return the rotation matrix (3, 3) of a rotation vector [rad]."""
    q = attitude.from_rotation_vector(rotation_vector)
    return jnp.stack([attitude.rotate(q, axis) for axis in jnp.eye(3)], axis=1)


def _predict(
    model: Model, carry: FilterState, t: Scalar, dt: Scalar, command: Array, acting: Array, kind: LogKind
) -> FilterState:
    """Return the filter predicted for the end of an interval, before it is corrected by the readings there.

    Args:
        model: the model.
        carry: the filter at the start of the interval.
        t: start of the interval [s].
        dt: length of the interval [s].
        command: entry of `Rows.command` at the start, used only if the log has wheel speeds.
        acting: mean of the delayed command over the interval, see `acting_command`.
        kind: structure of the log.
    """
    plant, actuators = model.plant, model.actuators
    if kind.wheel_inertia is not None:  # the wheels' momentum is measured
        scale = 1.0 if actuators.scale is None else actuators.scale
        drive = Drive(None, acting, scale * kind.wheel_inertia * command, jnp.asarray(False))
    else:
        state = carry.actuators._replace(queue=None)
        drive = actuators.drive(state, jnp.zeros(plant.inputs) if kind.by_channel else acting, t, dt)
        drive = drive._replace(c=acting) if kind.by_channel else drive
    torque = actuators.torque_over(drive, jnp.zeros_like(dt), dt)

    def state_rate(time: Scalar, y: State, walk: Array) -> State:
        d = model.disturbance(time, y)
        return plant.rate(time, y, torque.torque_at(time - t, plant.velocity(y)), d + walk if walk.size else d)

    after = integrators.rk4(lambda time, y: state_rate(time, y, carry.walk), t, carry.x, dt, rolled=True)
    after = plant.normalise(after)
    m, b = carry.walk.size, carry.bias.size
    n = carry.covariance.shape[0] - b - m
    transition = _transition_matrix(plant, state_rate, carry, after, t, dt)
    f = jnp.eye(n + b + m).at[:n, :n].set(transition[:n, :n])
    f = f.at[:n, n + b :].set(transition[:n, n:]) if m else f
    # the random walks change at the start of the interval, as in a simulation
    velocity = 3 if model.is_spacecraft else n - model.hidden_sigma.size - plant.inputs  # first index of the velocity
    hidden_count = n - velocity - plant.inputs
    hidden_factors = jnp.zeros(hidden_count)
    if hasattr(plant, "coupling"):  # the noise also drives the flexible modes
        hidden_factors = hidden_factors.at[hidden_count // 2 :].set(jnp.sum(plant.coupling**2, axis=1))
    noise_factors = jnp.concatenate([jnp.ones(plant.inputs), hidden_factors])
    noise = [jnp.zeros(velocity), model.acceleration_noise**2 * dt * noise_factors]
    noise += [model.bias_walk**2 * dt * jnp.ones(b)]
    noise += [jnp.broadcast_to(model.walk_density**2 * dt, (m,))] if m else []
    p = f @ (carry.covariance + jnp.diag(jnp.concatenate(noise))) @ f.T
    state = carry.actuators if kind.wheel_inertia is not None else actuators.end(carry.actuators, drive, None, dt)
    return carry._replace(x=after, covariance=p, actuators=state)


def _transition_matrix(
    plant: Plant, rate: Callable[[Scalar, State, Array], State], carry: FilterState, after: State, t: Scalar, dt: Scalar
) -> Array:
    """Return the transition matrix of the state and the random-walk torque over an interval.

    It is e^(A dt) to fourth order. A has the derivatives of the rate of the local coordinates in the middle of the
    interval. The last rows belong to the torque. It is constant, so these rows are equal to rows of the identity.
    """
    middle = plant.retract(carry.x, 0.5 * plant.local_coordinates(carry.x, after))
    time, m = t + dt / 2, carry.walk.size
    middle_rate = rate(time, middle, carry.walk)
    n = carry.covariance.shape[0] - carry.bias.size - m

    def local_rate(offset: Array) -> Array:
        shifted = plant.retract(middle, offset[:n])
        rates = middle_rate, rate(time, shifted, carry.walk + offset[n:])
        return jax.jvp(plant.local_coordinates, (middle, shifted), rates)[1]

    a = jnp.zeros((n + m, n + m)).at[:n].set(jax.jacfwd(local_rate)(jnp.zeros(n + m)))
    identity = exponential = jnp.eye(n + m)
    for k in (4, 3, 2, 1):
        exponential = identity + (dt / k) * a @ exponential
    return exponential


def _correct(
    model: Model, carry: FilterState, readings: dict[str, Array], valid: Array, gate: Scalar | float
) -> tuple[FilterState, Innovations]:
    """Return the filter corrected by the readings of a row, one component after the other, and the innovations."""
    residuals, derivatives, noise = _compute_residuals(model, carry, readings)
    correction, p = jnp.zeros(carry.covariance.shape[0]), carry.covariance
    values, variances, accepted_components = [], [], []
    size = 1 if "x" in readings else 3  # components that are rejected together
    for begin in range(0, residuals.size, size):
        new_correction, new_p, square = correction, p, jnp.zeros(())
        for k in range(begin, begin + size):
            gain = new_p @ derivatives[k]
            variance = derivatives[k] @ gain + noise[k] ** 2
            value = residuals[k] - derivatives[k] @ new_correction
            is_valid = valid[k]
            square = square + jnp.where(is_valid, value**2 / variance, 0.0)
            values.append(value)
            variances.append(variance)
            applied_gain = jnp.where(is_valid, 1.0 / variance, 0.0) * gain
            new_correction = new_correction + applied_gain * value
            new_p = new_p - applied_gain[:, None] * gain[None, :]
        accepted = ~(square > gate * size)  # NaN is no outlier, so that the likelihood of an overflow is not finite
        accepted_components += [valid[k] & accepted for k in range(begin, begin + size)]
        correction, p = guards.select(accepted, (new_correction, new_p), (correction, p))
    p = 0.5 * (p + p.T)
    n = p.shape[0] - carry.bias.size - carry.walk.size
    state_correction, bias_correction, walk_correction = jnp.split(correction, [n, n + carry.bias.size])
    x = model.plant.normalise(model.plant.retract(carry.x, state_correction))
    corrected = carry._replace(x=x, bias=carry.bias + bias_correction, walk=carry.walk + walk_correction, covariance=p)
    # missing readings have an innovation of 0 with variance 1, so that they do not change the likelihood
    value, variance = jnp.where(valid, jnp.stack(values), 0.0), jnp.where(valid, jnp.stack(variances), 1.0)
    return corrected, Innovations(value, variance, jnp.stack(accepted_components))


def _compute_residuals(model: Model, carry: FilterState, readings: dict[str, Array]) -> tuple[Array, Array, Array]:
    """Compare the readings with their predictions.

    Returns:
        Readings minus predictions (m,), the derivatives of the predictions by the state of the filter (m, n), and the
        1 sigma of the noise of the readings (m,).
    """
    n = carry.covariance.shape[0]
    if not model.is_spacecraft:
        predicted = model.plant.visible(carry.x)
        return readings["x"] - predicted, jnp.eye(predicted.size, n), model.noises["x"]
    residuals, rows, noise = [], [], []
    if "attitude" in readings:
        q = attitude.multiply(carry.x.q, attitude.from_rotation_vector(model.misalignment))
        error = attitude.multiply(attitude.conjugate(q), readings["attitude"])
        rotation_error = attitude.rotation_vector(jnp.where(error[3] < 0.0, -1.0, 1.0) * error[:3])
        residuals.append(model.tracker_axes @ rotation_error)
        rows.append(jnp.zeros((3, n)).at[:, :3].set(model.tracker_axes @ _rotation_matrix(model.misalignment).T))
        noise.append(model.noises["attitude"])
    if "rate" in readings:
        residuals.append(readings["rate"] - model.rate_scale * carry.x.w - carry.bias)
        bias = n - carry.walk.size - 3
        rows.append(jnp.zeros((3, n)).at[:, 3:6].set(jnp.diag(model.rate_scale)).at[:, bias : bias + 3].set(jnp.eye(3)))
        noise.append(model.noises["rate"])
    return jnp.concatenate(residuals), jnp.concatenate(rows), jnp.concatenate(noise)
