"""Prediction errors of a log: an extended Kalman filter over the true plant, with its actuators and disturbances.

The filter is multiplicative for a spacecraft (Lefferts, Markley, Shuster, JGCD 5(5), 1982). Its error state is a small
rotation about the body axes, and the errors of rate, modes, gyro bias and random-walk torque. Other plants have their
own states instead. The command is constant between samples, before delay and lag. The components of a sample have
independent noise and correct the state one after the other. Each innovation is therefore a scalar with a variance
(Bierman, Factorization Methods for Discrete Sequential Estimation, 1977, chapter 2). Read `filtered` first.
"""

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ptsmc_jax.campaigns.store import RefusedError
from ptsmc_jax.devices.actuators import Actuators, ActuatorState, Drive
from ptsmc_jax.identification.telemetry import Measurements
from ptsmc_jax.numerics import attitude, guards, integrators, matrices
from ptsmc_jax.numerics.pytrees import Leaf, Scalar, pytree
from ptsmc_jax.plants.rigid_body import AttitudeState

MOST_STEPS = 10_000_000  # largest number of integration steps of a log
WIDE = 10.0  # prior 1 sigma of a state without a reading in the first row, relative to its estimate


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
    bias: Leaf  # prior 1 sigma of the gyro bias; 0: no bias [rad/s]
    bias_walk: Leaf  # density of the gyro bias's random walk [rad/s/sqrt(s)]
    walk: Leaf  # (m,) density of the random-walk torque [N m/sqrt(s)]
    modes: Leaf  # (n,) prior 1 sigma of hidden coordinates at the first row
    slack: Leaf  # density of white noise on the acceleration, while a search is far from the estimate [rad/s^1.5]

    @property
    def spacecraft(self) -> bool:
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
    source: np.ndarray  # (rows,) row of the log, -1 for added rows


class Innovations(NamedTuple):
    """Prediction errors of all rows but the first, (rows - 1, components)."""

    value: Any  # reading minus prediction, given the readings before and the components before in this row
    variance: Any
    accepted: Any  # bool: there is a reading, and it is no outlier


class Track(NamedTuple):
    """Estimates of the filter after each row but the first."""

    x: Any  # state of the plant
    bias: Any  # (rows, 3) [rad/s]
    walk: Any  # (rows, m) [N m]
    covariance: Any  # (rows, n, n)


class _Carry(NamedTuple):
    x: Any
    bias: Any
    walk: Any
    p: Any
    actuators: ActuatorState


def rows_of(log: Measurements, step: float, bucket: int = 1) -> Rows:
    """Return a log for the filter. Intervals longer than the step [s] are divided.

    The rows are padded to a multiple of `bucket`, so that logs of similar lengths share a program. RefusedError is
    raised for a log that needs too many steps.
    """
    pieces = np.maximum(1, np.ceil(np.diff(log.t) / step * (1.0 - 1e-9)).astype(int))
    if pieces.sum() > MOST_STEPS:
        raise RefusedError(f"{log.name} needs {pieces.sum()} integration steps, but may need at most {MOST_STEPS}; "
                           f"check its times, which have a gap of {np.max(np.diff(log.t)):.3g} s")  # fmt: skip
    first = np.append(0, np.cumsum(pieces))
    count = int(first[-1]) + 1
    source = np.full(count, -1)
    source[first] = np.arange(len(log.t))
    t = np.interp(np.arange(count), first, log.t)
    before = np.searchsorted(first, np.arange(count), side="right") - 1
    command = log.command[before]
    if log.wheel_inertia is not None:  # wheel speeds change linearly
        command = np.stack([np.interp(t, log.t, column) for column in log.command.T], axis=1)
    valid, readings = [], {}
    for name, values in log.readings.items():
        there = (source >= 0)[:, None] & ~np.isnan(values[before])
        readings[name] = np.where(there, np.nan_to_num(values[before]), np.eye(4)[3] if values.shape[1] == 4 else 0.0)
        valid.append(there[:, :3] if name == "attitude" else there)
    more = -count % bucket

    def padded(values: np.ndarray) -> np.ndarray:
        return np.concatenate([values, np.repeat(values[-1:], more, axis=0)])

    return Rows(
        np.append(t, t[-1] + np.arange(1.0, more + 1.0)),  # increasing times, so that commands can be interpolated
        np.pad(np.diff(t), (0, 1 + more)),
        {name: padded(values) for name, values in readings.items()},
        np.pad(np.concatenate(valid, axis=1), ((0, more), (0, 0))),
        padded(command),
        _start_rate(log),
        np.pad(source, (0, more), constant_values=-1),
    )


def _start_rate(log: Measurements) -> np.ndarray:
    """Return the rate at the first row from the first two attitudes, zero without them [rad/s]."""
    if "x" in log.readings:
        return np.zeros(0)
    q = log.readings.get("attitude")
    there = np.zeros(0, int) if q is None else np.flatnonzero(~np.isnan(q[:, 0]))
    if q is None or there.size < 2:
        return np.zeros(3)
    turn = np.asarray(attitude.small_rotation(jnp.asarray(q[there[0]]), jnp.asarray(q[there[1]])))
    return turn / (log.t[there[1]] - log.t[there[0]])


def acting(model: Model, rows: Rows, wheel_inertia: float | None) -> Array:
    """Return the command that acts in each interval after the delay, (rows, channels), as the mean over the interval.

    The mean has the impulse of a command that changes within the interval. No command acts before the first row. If
    the log has wheel speeds, the command is the torque of the wheels on the body.
    """
    if wheel_inertia is not None:
        change = jnp.append(jnp.diff(rows.command, axis=0), jnp.zeros((1, rows.command.shape[1])), axis=0)
        return -wheel_inertia * change / jnp.where(rows.dt > 0.0, rows.dt, jnp.inf)[:, None]
    integral = jnp.cumsum(rows.command * rows.dt[:, None], axis=0)
    integral = jnp.concatenate([jnp.zeros((1, rows.command.shape[1])), integral[:-1]])

    def at(time: Array) -> Array:
        return jnp.stack([jnp.interp(time - model.delay, rows.t, column) for column in integral.T], axis=1)

    mean = (at(rows.t + rows.dt) - at(rows.t)) / jnp.where(rows.dt > 0.0, rows.dt, jnp.inf)[:, None]
    return jnp.where(model.delay > 0.0, mean, rows.command)


class Kind(NamedTuple):
    """The structure of a log, which a compiled program depends on."""

    by_channel: bool
    wheel_inertia: float | None

    @staticmethod
    def of(log: Measurements) -> "Kind":
        """Return the structure of a log."""
        return Kind(log.by_channel, log.wheel_inertia)


def with_wheels(model: Model, wheel_inertia: float | None) -> Model:
    """Return the model for measured wheel speeds.

    The speeds are relative to the body, so that the wheels' spin inertia turns with it: J becomes J + sum I a a'. The
    wheels have no lag, because their speed is measured. A scale factor error is an error of their inertia.
    """
    if wheel_inertia is None:
        return model
    actuators = replace(model.actuators, lag=None, rate_limit=None)
    axes = actuators.directions if actuators.directions is not None else actuators.wheels.axes  # pyright: ignore
    scale = jnp.ones(axes.shape[1]) if actuators.scale is None else actuators.scale
    inertia = model.plant.inertia + wheel_inertia * (axes * scale) @ axes.T
    plant = model.plant.with_inertia(inertia, matrices.solve(inertia, jnp.eye(3)))
    return replace(model, plant=plant, actuators=actuators)


def innovations(
    model: Model, rows: Rows, kind: Kind, gate: Any = jnp.inf, *, covariance_derivatives: bool = True
) -> Innovations:
    """Return the prediction errors of a log; see `filtered`."""
    return filtered(model, rows, kind, gate, tracked=False, covariance_derivatives=covariance_derivatives)[0]


def filtered(
    model: Model,
    rows: Rows,
    kind: Kind,
    gate: Any = jnp.inf,
    *,
    tracked: bool = True,
    covariance_derivatives: bool = True,
) -> tuple[Innovations, Track | None]:
    """Return the prediction errors of a log and the estimates of the filter.

    Args:
        model: the model.
        rows: the log.
        kind: its structure.
        gate: a group of readings whose normalised square exceeds this number times its size is rejected.
        tracked: whether the estimates are returned, which need the memory of a covariance for each row.
        covariance_derivatives: whether derivatives of the innovations include those of the predicted covariance.
    """
    model = with_wheels(model, kind.wheel_inertia)
    due = acting(model, rows, kind.wheel_inertia)
    carry = _start(model, rows)

    def step(carry: _Carry, row: Any) -> tuple[_Carry, tuple[Innovations, Track | None]]:
        t, dt, command, due, readings, valid = row
        carry = _predicted(model, carry, t, dt, command, due, kind)
        carry = carry if covariance_derivatives else carry._replace(p=jax.lax.stop_gradient(carry.p))
        carry, found = _corrected(model, carry, readings, valid, gate)
        return carry, (found, Track(carry.x, carry.bias, carry.walk, carry.p) if tracked else None)

    inputs = rows.t[:-1], rows.dt[:-1], rows.command[:-1], due[:-1]
    later = jax.tree.map(lambda v: v[1:], (rows.readings, rows.valid))
    _, found = jax.lax.scan(step, carry, (*inputs, *later))
    return found


def _start(model: Model, rows: Rows) -> _Carry:
    """Return the filter at the first row. Its readings determine the state, which has no other prior knowledge."""
    first = jax.tree.map(lambda v: v[0], rows.readings)
    walk = jnp.zeros(model.plant.inputs if model.walk is not None else 0)
    actuators = model.actuators.begin(model.plant.inputs)
    if not model.spacecraft:
        x = model.plant.with_hidden_at_rest(first["x"])
        p = jnp.diag(jnp.concatenate([model.noises["x"] ** 2, model.modes**2, jnp.zeros_like(walk)]))
        return _Carry(x, jnp.zeros(0), walk, p, actuators)
    still = attitude.from_rotation_vector(-model.misalignment)
    q = attitude.multiply(first["attitude"], still) if "attitude" in first else jnp.array([0.0, 0.0, 0.0, 1.0])
    turn = _axes(model.misalignment) @ model.tracker_axes.T
    star = model.noises["attitude"] ** 2 if "attitude" in first else jnp.zeros(3)
    has_rate = rows.valid[0, -1] if "rate" in first else False
    gyro = model.noises["rate"] ** 2 if "rate" in first else jnp.zeros(3)
    known = model.bias**2 * jnp.ones(3)
    w = jnp.where(has_rate, first["rate"] / model.rate_scale if "rate" in first else 0.0, rows.start_rate)
    wide = (WIDE * jnp.max(jnp.abs(rows.start_rate)) + 1e-3) ** 2 * jnp.ones(3)
    spread = jnp.where(has_rate, (gyro + known) / model.rate_scale**2, wide)
    n = 6 + model.modes.size
    p = jnp.zeros((n + 3 + walk.size,) * 2)
    p = p.at[:3, :3].set(turn @ jnp.diag(star) @ turn.T).at[3:6, 3:6].set(jnp.diag(spread))
    p = p.at[6:n, 6:n].set(jnp.diag(model.modes**2)).at[n : n + 3, n : n + 3].set(jnp.diag(known))
    both = jnp.diag(jnp.where(has_rate, -known / model.rate_scale, 0.0))
    p = p.at[3:6, n : n + 3].set(both).at[n : n + 3, 3:6].set(both)
    x = model.plant.with_hidden_at_rest(AttitudeState(q, w))
    return _Carry(x, jnp.zeros(3), walk, p, actuators)


def _axes(turn: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Return the rotation matrix (3, 3) of a rotation vector [rad]."""
    q = attitude.from_rotation_vector(turn)
    return jnp.stack([attitude.rotate(q, axis) for axis in jnp.eye(3)], axis=1)


def _predicted(model: Model, carry: _Carry, t: Scalar, dt: Scalar, command: Array, due: Array, kind: Kind) -> _Carry:
    """Return the filter after an interval, before the readings at its end."""
    plant, actuators = model.plant, model.actuators
    if kind.wheel_inertia is not None:  # the wheels' momentum is measured
        scale = 1.0 if actuators.scale is None else actuators.scale
        drive = Drive(None, due, scale * kind.wheel_inertia * command, jnp.asarray(False))
    else:
        state = carry.actuators._replace(queue=None)
        drive = actuators.drive(state, jnp.zeros(plant.inputs) if kind.by_channel else due, t, dt)
        drive = drive._replace(c=due) if kind.by_channel else drive
    torque = actuators.torque_over(drive, jnp.zeros_like(dt), dt)

    def rate(time: Scalar, y: Any, walk: Array) -> Any:
        d = model.disturbance(time, y)
        return plant.rate(time, y, torque.torque_at(time - t, plant.velocity(y)), d + walk if walk.size else d)

    after = integrators.rk4(lambda time, y: rate(time, y, carry.walk), t, carry.x, dt, rolled=True)
    after = plant.normalise(after)
    m, b = carry.walk.size, carry.bias.size
    sizes = carry.p.shape[0] - b - m
    moved = _transition(plant, rate, carry, after, t, dt)
    f = jnp.eye(sizes + b + m).at[:sizes, :sizes].set(moved[:sizes, :sizes])
    f = f.at[:sizes, sizes + b :].set(moved[:sizes, sizes:]) if m else f
    # the steps of the random walks come at the start of the interval, as in a simulation
    first = 3 if model.spacecraft else sizes - model.modes.size - plant.inputs  # first index of the velocity
    hidden = sizes - first - plant.inputs
    rates = jnp.zeros(hidden)
    if hasattr(plant, "coupling"):  # the noise drives the flexible modes, too
        rates = rates.at[hidden // 2 :].set(jnp.sum(plant.coupling**2, axis=1))
    noise = [jnp.zeros(first), model.slack**2 * dt * jnp.concatenate([jnp.ones(plant.inputs), rates])]
    noise += [model.bias_walk**2 * dt * jnp.ones(b)]
    noise += [jnp.broadcast_to(model.walk**2 * dt, (m,))] if m else []
    p = f @ (carry.p + jnp.diag(jnp.concatenate(noise))) @ f.T
    ended = carry.actuators if kind.wheel_inertia is not None else actuators.end(carry.actuators, drive, None, dt)
    return carry._replace(x=after, p=p, actuators=ended)


def _transition(plant: Any, rate: Any, carry: _Carry, after: Any, t: Scalar, dt: Scalar) -> Array:
    """Return the derivatives of the state's change over an interval by the state and the random-walk torque.

    They are e^(A dt) to fourth order, with the derivatives A of the local coordinates' rate in the middle of the
    interval. The last rows belong to the torque, which is constant, and are equal to rows of the identity.
    """
    middle = plant.retract(carry.x, 0.5 * plant.local_coordinates(carry.x, after))
    time, m = t + dt / 2, carry.walk.size
    own = rate(time, middle, carry.walk)
    n = carry.p.shape[0] - carry.bias.size - m

    def local_rate(by: Array) -> Array:
        near = plant.retract(middle, by[:n])
        rates = own, rate(time, near, carry.walk + by[n:])
        return jax.jvp(plant.local_coordinates, (middle, near), rates)[1]

    a = jnp.zeros((n + m, n + m)).at[:n].set(jax.jacfwd(local_rate)(jnp.zeros(n + m)))
    one = power = jnp.eye(n + m)
    for k in (4, 3, 2, 1):
        power = one + (dt / k) * a @ power
    return power


def _corrected(
    model: Model, carry: _Carry, readings: dict[str, Array], valid: Array, gate: Any
) -> tuple[_Carry, Innovations]:
    """Return the filter after the readings of a row, one component after the other."""
    residual, rows, noise = _residuals(model, carry, readings)
    shift, p = jnp.zeros(carry.p.shape[0]), carry.p
    values, variances, taken = [], [], []
    size = 1 if "x" in readings else 3  # components that are rejected together
    for at in range(0, residual.size, size):
        new_shift, new_p, square = shift, p, jnp.zeros(())
        for k in range(at, at + size):
            gain = new_p @ rows[k]
            variance = rows[k] @ gain + noise[k] ** 2
            value = residual[k] - rows[k] @ new_shift
            used = valid[k]
            square = square + jnp.where(used, value**2 / variance, 0.0)
            values.append(value)
            variances.append(variance)
            gain_or_none = jnp.where(used, 1.0 / variance, 0.0) * gain
            new_shift = new_shift + gain_or_none * value
            new_p = new_p - gain_or_none[:, None] * gain[None, :]
        accepted = square <= gate * size
        taken += [valid[k] & accepted for k in range(at, at + size)]
        shift, p = guards.select(accepted, (new_shift, new_p), (shift, p))
    p = 0.5 * (p + p.T)
    n = p.shape[0] - carry.bias.size - carry.walk.size
    by_state, by_bias, by_walk = jnp.split(shift, [n, n + carry.bias.size])
    x = model.plant.normalise(model.plant.retract(carry.x, by_state))
    after = carry._replace(x=x, bias=carry.bias + by_bias, walk=carry.walk + by_walk, p=p)
    accepted = jnp.stack(taken)
    # missing and rejected readings have an innovation of 0 with variance 1, which do not change the likelihood
    found = Innovations(
        jnp.where(accepted, jnp.stack(values), 0.0), jnp.where(accepted, jnp.stack(variances), 1.0), accepted
    )
    return after, found


def _residuals(model: Model, carry: _Carry, readings: dict[str, Array]) -> tuple[Array, Array, Array]:
    """Return readings minus predictions (m,), their derivatives by the state of the filter (m, n), and their noise."""
    n = carry.p.shape[0]
    if not model.spacecraft:
        seen = model.plant.visible(carry.x)
        return readings["x"] - seen, jnp.eye(seen.size, n), model.noises["x"]
    residuals, rows, noise = [], [], []
    if "attitude" in readings:
        q = attitude.multiply(carry.x.q, attitude.from_rotation_vector(model.misalignment))
        error = attitude.multiply(attitude.conjugate(q), readings["attitude"])
        turn = attitude.rotation_vector(jnp.where(error[3] < 0.0, -1.0, 1.0) * error[:3])
        residuals.append(model.tracker_axes @ turn)
        rows.append(jnp.zeros((3, n)).at[:, :3].set(model.tracker_axes @ _axes(model.misalignment).T))
        noise.append(model.noises["attitude"])
    if "rate" in readings:
        residuals.append(readings["rate"] - model.rate_scale * carry.x.w - carry.bias)
        at = n - carry.walk.size - 3
        rows.append(jnp.zeros((3, n)).at[:, 3:6].set(jnp.diag(model.rate_scale)).at[:, at : at + 3].set(jnp.eye(3)))
        noise.append(model.noises["rate"])
    return jnp.concatenate(residuals), jnp.concatenate(rows), jnp.concatenate(noise)
