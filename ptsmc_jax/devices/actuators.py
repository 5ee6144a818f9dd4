"""Actuators, between the commanded torque and the body: delay, quantisation, limits, lag, reaction wheels.

An effect is disabled if its field is None. A channel is a source of torque: a body axis or a wheel. The derivative of
quantisation is taken as 1. Read `Actuators` first, then `Actuators.command`. `wheels` builds a set of reaction wheels.
"""

from dataclasses import dataclass, field, fields, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ptsmc_jax.formulas import wheel_axes
from ptsmc_jax.numerics import attitude, guards
from ptsmc_jax.numerics.pytrees import Leaf, Scalar, Vector, pytree, vector


def quantise(u: Array, step: Scalar) -> Array:
    """Return the nearest multiple of step [N m], (m,), with derivative 1 by u instead of 0 or infinity."""
    return u + jax.lax.stop_gradient(step * jnp.round(u / step) - u)


@pytree
@dataclass(frozen=True)
class Wheels:
    """Reaction wheels: torque A v on the body, stored momentum h' = -v, allocation by the pseudo-inverse of A.

    The momentum h is absolute: spin inertia times (wheel speed + a . w). The inertia J of the body therefore excludes
    the spin inertia of each wheel, J = J_total - sum I a a' (Hughes, Spacecraft Attitude Dynamics, 1986).
    """

    axes: Leaf  # (3, n) A: spin axes in body axes, unit columns
    allocation: Leaf  # (n, 3) pseudo-inverse of A
    initial: Leaf  # (n,) momentum at t = 0 [N m s]
    torque_limit: Leaf | None = None  # limit of each wheel's torque [N m]
    momentum_limit: Leaf | None = None  # limit of each wheel's momentum [N m s]


class ActuatorState(NamedTuple):
    """State of the actuators between control periods."""

    queue: Array | None  # (delay, m) delayed commands, the oldest first [N m]
    v: Array | None  # (channels,) torque at the end of the last period [N m]; None if nothing depends on it
    h: Array | None  # (wheels,) stored momentum [N m s]


class Drive(NamedTuple):
    """One control period of the actuators: their torques move from v toward the target c."""

    v: Array | None  # (channels,) torque at the start [N m]; None if it is c from the start
    c: Array  # (channels,) target torque [N m]
    h: Array | None  # (wheels,) momentum at the start of the period [N m s]; None without wheels
    limited: Array  # bool: whether a limit reduces the command
    works: Array | None = None  # (channels,) bool: channels without failure; None if no channel can fail


class AppliedTorque(NamedTuple):
    """The torque on the body over a time dt inside a period, linear in time, and the momentum of the wheels."""

    mean: Array  # (m,) [N m]
    slope: Array | None  # (m,) rate of change [N m/s]; None if the torque is held
    stored: Array | None  # (m,) momentum A h of the wheels at the start of the time dt [N m s]; None without wheels
    dt: Array  # [s]

    def torque_at(self, s: Scalar, w: Vector) -> Vector:
        """Return the torque u - w x A h [N m] at s [s] from the start, with (A h)' = -u and body rate w [rad/s]."""
        u, impulse = self.mean, self.mean * s
        if self.slope is not None:
            u = u + self.slope * (s - self.dt / 2)
            impulse = impulse + self.slope * (s * (s - self.dt) / 2)
        return u if self.stored is None else u - attitude.cross(w, self.stored - impulse)


@pytree
@dataclass(frozen=True)
class Actuators:
    """Torque limit per axis, delay, then per channel: quantisation, limits, rate limit and first-order lag."""

    torque_limit: Leaf | None = None  # limit per body axis [N m]
    rate_limit: Leaf | None = None  # limit on the rate of change of each channel's torque [N m/s]
    lag: Leaf | None = None  # time constant of each channel [s]
    step: Leaf | None = None  # quantisation step of the torque [N m]
    wheels: Wheels | None = None
    delay: int = field(default=0, metadata={"static": True})  # delay of the command in whole control periods
    # hardware errors: differences between the true actuators and those that the flight software knows
    scale: Leaf | None = None  # (channels,) ratio of true to nominal torque [-]
    directions: Leaf | None = None  # (m, channels) true unit vectors of the channels in body axes
    failure_times: Leaf | None = None  # (channels,) time of failure; no torque from the first sample at or after it [s]
    spare_allocations: Leaf | None = None  # (wheels, wheels, 3) allocation without each wheel, if failures are known

    @property
    def is_ideal(self) -> bool:
        """Whether the actuators deliver every command immediately and exactly."""
        return not self.delay and all(getattr(self, f.name) is None for f in fields(self) if f.name != "delay")

    @property
    def nominal(self) -> "Actuators":
        """The actuators as the flight software knows them, without hardware errors."""
        return replace(self, scale=None, directions=None, failure_times=None)

    def assumed_torque(self, drive: Drive, dt: Scalar) -> tuple[Vector, Vector | None]:
        """Return the torque and momentum that the flight software assumes for a period of dt [s].

        The result is the mean torque (m,) [N m], and the wheels' momentum in the middle of the period (m,) [N m s], or
        None without wheels.
        """
        if self.spare_allocations is None:  # the flight software does not know of failures
            drive = drive._replace(works=None)
        torque = self.nominal.torque_over(drive, jnp.zeros_like(dt), dt)
        return torque.mean, None if torque.stored is None else torque.stored - torque.mean * dt / 2

    def true_torque(self, drive: Drive, v: Array) -> Array:
        """Return the true torques of the channels (channels,) [N m] from nominal torques, or from their integrals."""
        scaled = v if self.scale is None else self.scale * v
        return scaled if drive.works is None else jnp.where(drive.works, scaled, 0.0)

    def on_body(self, v: Array) -> Vector:
        """Return the sum (m,) in body axes of channel values (channels,), such as torques [N m]."""
        axes = self.directions
        if axes is None and self.wheels is not None:
            axes = self.wheels.axes
        return v if axes is None else axes @ v

    @property
    def has_dynamics(self) -> bool:
        """Whether the torque changes within a period."""
        return self.rate_limit is not None or self.lag is not None

    @property
    def is_exact_hold(self) -> bool:
        """Whether the torque on the body is the target from the start of a period to its end."""
        has_no_errors = self.scale is None and self.directions is None and self.failure_times is None
        return has_no_errors and not self.has_dynamics and self.wheels is None

    def begin(self, inputs: int) -> ActuatorState:
        """Return the initial state: no torque acts, and no command is delayed."""
        queue = jnp.zeros((self.delay, inputs)) if self.delay else None
        momentum = None if self.wheels is None else self.wheels.initial
        no_torque = jnp.zeros(inputs) if momentum is None else jnp.zeros_like(momentum)
        return ActuatorState(queue, None if self.is_exact_hold else no_torque, momentum)

    def command(
        self, state: ActuatorState, u: Vector, w: Vector, t: Scalar, dt: Scalar, weight: Scalar
    ) -> tuple[Drive, Array | None]:
        """Return the drive of a control period, and the queue of commands after it.

        Args:
            state: state at the start of the period.
            u: command of the law, (m,) [N m].
            w: measured rate, (m,) [rad/s].
            t: start of the period [s].
            dt: length of the period [s].
            weight: length of a partial first period as a fraction of a full one. The command has this weight in the
                queue, so that the result is continuous when the length goes to 0.
        """
        sent, limited = self.send(state, u, w)
        queue, command_now = state.queue, sent
        if queue is not None:
            command_now = queue[0]
            next_queue = jnp.concatenate([queue[1:], guards.lerp(weight, sent, queue[-1])[None]])
            queue = jnp.where(dt > 0.0, next_queue, queue)
        drive = self.drive(state, command_now, t, dt)
        return drive._replace(limited=limited | drive.limited), queue

    def send(self, state: ActuatorState, u: Vector, w: Vector) -> tuple[Vector, Array]:
        """Return the torque that the flight computer sends at a sample, (m,) [N m], and whether the torque limit acts.

        The flight computer adds w x A h to compensate the gyroscopic torque of the wheels' momentum h. The delay
        applies to the sum.

        Args:
            state: state at the start of the period.
            u: command of the law, (m,) [N m].
            w: measured rate, (m,) [rad/s].
        """
        sent = u if self.torque_limit is None else jnp.clip(u, -self.torque_limit, self.torque_limit)
        limited = jnp.any(sent != u)
        if self.wheels is not None:
            assert state.h is not None
            sent = sent + attitude.cross(w, self.wheels.axes @ state.h)
        return sent, limited

    def drive(self, state: ActuatorState, due: Vector, t: Scalar, dt: Scalar) -> Drive:
        """Return the drive of a control period.

        Args:
            state: state at the start of the period.
            due: command that acts in the period, after the delay, (m,) [N m]; see `send`.
            t: start of the period [s].
            dt: length of the period [s].
        """
        target = due
        if self.wheels is not None:
            target = self._allocation(self.wheels, t) @ target
        if self.step is not None:
            target = quantise(target, self.step)
            if self.torque_limit is not None and self.wheels is None:  # rounding may exceed the limit
                target = jnp.clip(target, -self.torque_limit, self.torque_limit)
        c = target
        if self.wheels is not None:
            c = self._limit_wheel_torques(self.wheels, target, state, dt)
        limited = jnp.any(c != target)
        if self.rate_limit is not None:
            assert state.v is not None
            largest_change = self.rate_limit * (dt if self.lag is None else dt + self.lag)
            limited = limited | jnp.any(jnp.abs(c - state.v) > largest_change)
        works = None if self.failure_times is None else t < self.failure_times
        return Drive(state.v if self.has_dynamics else None, c, state.h, limited, works)

    def _allocation(self, device: Wheels, t: Scalar) -> Float[Array, "wheels 3"]:
        """Return the matrix that allocates a torque to the wheels at t [s], except to a wheel with a known failure."""
        if self.failure_times is None or self.spare_allocations is None:
            return device.allocation
        failed = t >= self.failure_times
        spare = jnp.sum(jnp.where(failed[:, None, None], self.spare_allocations, 0.0), axis=0)
        return jnp.where(jnp.any(failed), spare, device.allocation)

    def _limit_wheel_torques(self, device: Wheels, v: Array, state: ActuatorState, dt: Scalar) -> Array:
        """Return wheel torques within the torque limit and, at the end of the period, within the momentum limit.

        With a lag the impulse of the period is c (dt - a) + v a, where a = lag (1 - e^(-dt/lag)). The momentum may
        exceed its limit in two cases: the function ignores a rate limit, and it applies the torque limit last.
        """
        if device.momentum_limit is not None:
            assert state.h is not None
            h, lag_span = state.h, jnp.zeros_like(dt)
            if self.lag is not None and state.v is not None:
                lag_span = self.lag * -jnp.expm1(-dt / self.lag)
                h = h - lag_span * state.v
            # two multiplications by the inverse are faster than two divisions
            inverse_span = 1.0 / jnp.where(dt > lag_span, dt - lag_span, 1.0)
            v = jnp.clip(v, inverse_span * (h - device.momentum_limit), inverse_span * (h + device.momentum_limit))
        if device.torque_limit is not None:
            v = jnp.clip(v, -device.torque_limit, device.torque_limit)
        return v

    def channel_torques(self, drive: Drive, s: Scalar) -> tuple[Array, Array, Array]:
        """Return the nominal torque of each channel s [s] into the period, its integral, and its double integral.

        The units are [N m, N m s, N m s^2]. The torque obeys v' = (c - v) / lag with |v'| at most the rate limit. It is
        a ramp until |c - v| equals rate limit times lag, and then an exponential.
        """
        v, c = drive.v, drive.c
        if v is None:
            return c, c * s, c * (s * s / 2)
        # with a rate limit each channel has a ramp of its own duration; without one all channels share their times
        gap, span, ramp_integral, ramp_double_integral = c - v, s, 0.0, 0.0
        is_ramping, torque_on_ramp = None, c
        if self.rate_limit is not None:
            ramp_rate = self.rate_limit * jnp.sign(gap)
            largest_lag_gap = 0.0 * self.rate_limit if self.lag is None else self.rate_limit * self.lag
            lag_gap = jnp.clip(gap, -largest_lag_gap, largest_lag_gap)
            ramp_duration = jnp.abs(gap - lag_gap) / self.rate_limit
            is_ramping, gap, span = s < ramp_duration, lag_gap, jnp.maximum(s - ramp_duration, 0.0)
            ramp_time = jnp.where(is_ramping, s, ramp_duration)
            torque_on_ramp = v + ramp_rate * s
            ramp_integral = ramp_time * (v + ramp_rate * ramp_time / 2)
            ramp_double_integral = ramp_time * ramp_time * (v / 2 + ramp_rate * ramp_time / 6)
        lag_gap_left = gap_integral = gap_double_integral = 0.0  # remaining gap c - v of the lag, and its integrals
        if self.lag is not None:
            lag_gap_left = gap * jnp.exp(-span / self.lag)
            gap_integral = gap * (self.lag * -jnp.expm1(-span / self.lag))
            gap_double_integral = self.lag * (gap * span - gap_integral)
        torque = c - lag_gap_left if is_ramping is None else jnp.where(is_ramping, torque_on_ramp, c - lag_gap_left)
        return (
            torque,
            ramp_integral + c * span - gap_integral,
            ramp_double_integral + ramp_integral * span + c * (span * span / 2) - gap_double_integral,
        )

    def torque_and_momentum(self, drive: Drive, s: Scalar) -> tuple[Array, Array | None]:
        """Return true torques of the channels [N m] and the wheels' momentum [N m s] at s [s] into the period."""
        v, impulse, _ = self.channel_torques(drive, s)
        momentum = None if drive.h is None else drive.h - self.true_torque(drive, impulse)
        return self.true_torque(drive, v), momentum

    def torque_over(self, drive: Drive, start: Scalar, dt: Scalar) -> AppliedTorque:
        """Return the torque over a part of the period, linear in time, with exact impulse and first moment.

        The momentum after an integration step is therefore exact, and the attitude is exact to leading order, even if
        a lag or a rate limit changes the torque within the step.

        Args:
            drive: the drive of the period.
            start: start of the part, from the start of the period [s].
            dt: length of the part [s].
        """
        v, slope, has_length = drive.c, None, dt > 0.0
        _, impulse_before, _ = self.channel_torques(drive, start)
        if drive.v is not None:
            # with a lag alone the torque of each channel is c plus its gap times a common decay from 1 to 0
            gap, unit_drive = drive.v - drive.c, drive
            if self.rate_limit is None:
                unit_drive = drive._replace(v=jnp.ones_like(dt), c=jnp.zeros_like(dt))
            _, integral_0, double_integral_0 = self.channel_torques(unit_drive, start)
            _, integral_1, double_integral_1 = self.channel_torques(unit_drive, start + dt)
            inverse_length = 1.0 / jnp.where(has_length, dt, 1.0)
            mean = (integral_1 - integral_0) * inverse_length
            # first moment of the torque about the middle
            moment = (integral_0 + integral_1) / 2 * dt - (double_integral_1 - double_integral_0)
            rate = jnp.where(has_length, 12.0 * moment * inverse_length**3, 0.0)
            if self.rate_limit is None:
                mean, rate = drive.c + gap * mean, gap * rate
            v, slope = jnp.where(has_length, mean, drive.v), rate
        stored = None if drive.h is None else self.on_body(drive.h - self.true_torque(drive, impulse_before))
        mean = self.on_body(self.true_torque(drive, v))
        return AppliedTorque(mean, None if slope is None else self.on_body(self.true_torque(drive, slope)), stored, dt)

    def end(self, state: ActuatorState, drive: Drive, queue: Array | None, dt: Scalar) -> ActuatorState:
        """Return the state after a period; a period of length zero changes nothing.

        Args:
            state: state at the start of the period.
            drive: the drive of the period.
            queue: delayed commands after the period, see `command`.
            dt: length of the period [s].
        """
        v, impulse, _ = self.channel_torques(drive, dt)
        v = None if state.v is None else jnp.where(dt > 0.0, v, state.v)
        return ActuatorState(queue, v, None if drive.h is None else drive.h - self.true_torque(drive, impulse))


def wheels(axes: Any, initial: Any = None, torque_limit: Any = None, momentum_limit: Any = None) -> Wheels:
    """Return reaction wheels.

    Args:
        axes: spin axes (n, 3) in body axes, of any length.
        initial: momenta at t = 0 (n,) [N m s]; default 0.
        torque_limit: limit of each wheel [N m], or None.
        momentum_limit: limit of each wheel [N m s], or None.

    Raises:
        ValueError: if the axes do not span all directions.
    """
    unit = wheel_axes(axes)
    start = np.zeros(len(unit)) if initial is None else np.asarray(initial, dtype=float)
    limits = (None if v is None else vector(v) for v in (torque_limit, momentum_limit))
    return Wheels(vector(unit.T), vector(np.linalg.pinv(unit.T)), vector(start), *limits)


def spare_allocations(device: Wheels) -> Float[Array, "n n 3"]:
    """Return the allocation matrices (n, n, 3) without each of the wheels [-].

    Entry k is the pseudo-inverse of A with column k set to 0.
    """
    axes, numbers = np.asarray(device.axes), np.arange(device.axes.shape[1])
    return jnp.stack([jnp.asarray(np.linalg.pinv(axes * (numbers != k), rcond=1e-6)) for k in numbers])
