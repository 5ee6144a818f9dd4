"""Actuators, between the commanded torque and the body: delay, quantisation, limits, lag, reaction wheels.

Each device is off where it is None. A channel is what makes torque: a body axis, or a wheel. Quantisation has the
derivative of its command.
"""

from dataclasses import dataclass, field, fields, replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ptsmc_jax.devices.reaction_wheels import Wheels
from ptsmc_jax.numerics import attitude, guards
from ptsmc_jax.numerics.pytrees import Leaf, Scalar, Vector, pytree


def quantise(u: Array, step: Scalar) -> Array:
    """The nearest multiple of step [N m], (m,), with the derivative of u: that of a staircase is 0 or infinite."""
    return u + jax.lax.stop_gradient(step * jnp.round(u / step) - u)


class ActuatorState(NamedTuple):
    """State of the actuators between control periods."""

    queue: Array | None  # (delay, m) commands on their way, the oldest first [N m]
    v: Array | None  # (channels,) torque at the end of the last period [N m]; None where nothing depends on it
    h: Array | None  # (wheels,) stored momentum [N m s]


class Drive(NamedTuple):
    """One control period of the actuators: their torques move from v toward the target c."""

    v: Array | None  # (channels,) [N m]; None: at c from the start
    c: Array  # (channels,) [N m]
    h: Array | None  # (wheels,) at the start of the period [N m s]; None without wheels
    limited: Array  # bool: a limit cuts the command
    works: Array | None = None  # (channels,) bool; None: all of them


class AppliedTorque(NamedTuple):
    """The torque on the body over a time dt inside a period, linear in time, and the momentum of the wheels."""

    mean: Array  # (m,) [N m]
    slope: Array | None  # (m,) about the middle [N m/s]; None where the torque is held
    stored: Array | None  # (m,) momentum A h at the start [N m s]; None without wheels
    dt: Array  # [s]

    def at(self, s: Scalar, w: Vector) -> Vector:
        """Torque on a body that turns at w [rad/s], s [s] from the start: u - w x A h [N m], with (A h)' = -u."""
        u, impulse = self.mean, self.mean * s
        if self.slope is not None:
            u = u + self.slope * (s - self.dt / 2)
            impulse = impulse + self.slope * (s * (s - self.dt) / 2)
        return u if self.stored is None else u - attitude.cross(w, self.stored - impulse)


@pytree
@dataclass(frozen=True)
class Actuators:
    """The limit per axis, delay, then per axis or per wheel: quantisation, limits, rate limit and first-order lag."""

    torque_limit: Leaf | None = None  # per body axis [N m]
    rate_limit: Leaf | None = None  # [N m/s]
    lag: Leaf | None = None  # time constant [s]
    step: Leaf | None = None  # quantisation [N m]
    wheels: Wheels | None = None
    delay: int = field(default=0, metadata={"static": True})  # whole control periods
    # misfits: how the true actuators differ from those that the flight software knows
    scale: Leaf | None = None  # (channels,) true torque over the nominal one [-]
    directions: Leaf | None = None  # (m, channels) unit vectors along which they act
    failure_times: Leaf | None = None  # (channels,) from the first sample not before it on a channel has no torque [s]
    spare_allocations: Leaf | None = None  # (wheels, wheels, 3) without each wheel, where failures are known

    @property
    def ideal(self) -> bool:
        """Whether they deliver every command at once and exactly."""
        return not self.delay and all(getattr(self, one.name) is None for one in fields(self) if one.name != "delay")

    @property
    def nominal(self) -> "Actuators":
        """The actuators as the flight software knows them: without their misfits."""
        return replace(self, scale=None, directions=None, failure_times=None)

    def assumed(self, drive: Drive, dt: Scalar) -> tuple[Vector, Vector | None]:
        """Return what the flight software knows of a period of dt [s].

        That is the mean torque (m,) [N m], and the wheels' momentum in its middle (m,) [N m s] or None.
        """
        if self.spare_allocations is None:  # then it does not know of failures
            drive = drive._replace(works=None)
        torque = self.nominal.over(drive, jnp.zeros_like(dt), dt)
        return torque.mean, None if torque.stored is None else torque.stored - torque.mean * dt / 2

    def delivered(self, drive: Drive, v: Array) -> Array:
        """True torques of the channels for nominal ones [N m], or of anything linear in them, (channels,)."""
        scaled = v if self.scale is None else self.scale * v
        return scaled if drive.works is None else jnp.where(drive.works, scaled, 0.0)

    def on_body(self, v: Array) -> Vector:
        """The vector (m,) in body axes of numbers (channels,) along the channels' directions, such as torques [N m]."""
        axes = self.directions
        if axes is None and self.wheels is not None:
            axes = self.wheels.axes
        return v if axes is None else axes @ v

    @property
    def moves(self) -> bool:
        """Whether the torque changes within a period."""
        return self.rate_limit is not None or self.lag is not None

    @property
    def holds(self) -> bool:
        """Whether the torque on the body is the target from the start of a period to its end."""
        fits = self.scale is None and self.directions is None and self.failure_times is None
        return fits and not self.moves and self.wheels is None

    def begin(self, inputs: int) -> ActuatorState:
        """The state at rest: no torque acts, no command is on its way."""
        queue = jnp.zeros((self.delay, inputs)) if self.delay else None
        momentum = None if self.wheels is None else self.wheels.initial
        rest = jnp.zeros(inputs) if momentum is None else jnp.zeros_like(momentum)
        return ActuatorState(queue, None if self.holds else rest, momentum)

    def command(
        self, state: ActuatorState, u: Vector, w: Vector, t: Scalar, dt: Scalar, weight: Scalar
    ) -> tuple[Drive, Array | None]:
        """Return the drive of a control period, and the queue of commands after it.

        Args:
            state: at the start of the period.
            u: command of the law, (m,) [N m].
            w: measured rate, (m,) [rad/s].
            t: start of the period [s].
            dt: its length [s].
            weight: share that a partial first period is of a whole one; its command counts that much on its way
                through the queue, so that nothing jumps where the period vanishes.
        """
        sent, limited = self.send(state, u, w)
        queue, due = state.queue, sent
        if queue is not None:
            due = queue[0]
            advanced = jnp.concatenate([queue[1:], guards.lerp(weight, sent, queue[-1])[None]])
            queue = jnp.where(dt > 0.0, advanced, queue)
        drive = self.drive(state, due, t, dt)
        return drive._replace(limited=limited | drive.limited), queue

    def send(self, state: ActuatorState, u: Vector, w: Vector) -> tuple[Vector, Array]:
        """Return what the flight computer sends at a sample, (m,) [N m], and whether the torque limit cuts it.

        It adds w x A h, which compensates the wheels' momentum h by the measured rate w. All of it takes the delay.
        """
        sent = u if self.torque_limit is None else jnp.clip(u, -self.torque_limit, self.torque_limit)
        limited = jnp.any(sent != u)
        if self.wheels is not None:
            assert state.h is not None
            sent = sent + attitude.cross(w, self.wheels.axes @ state.h)
        return sent, limited

    def drive(self, state: ActuatorState, due: Vector, t: Scalar, dt: Scalar) -> Drive:
        """Return the drive of a control period by the command that arrives in it, (m,) [N m], see `send`."""
        target = due
        if self.wheels is not None:
            target = self._allocation(self.wheels, t) @ target
        if self.step is not None:
            target = quantise(target, self.step)
            if self.torque_limit is not None and self.wheels is None:  # a step may lie beyond it
                target = jnp.clip(target, -self.torque_limit, self.torque_limit)
        c = target
        if self.wheels is not None:
            c = self._within_wheels(self.wheels, target, state, dt)
        limited = jnp.any(c != target)
        if self.rate_limit is not None:
            assert state.v is not None
            farthest = self.rate_limit * (dt if self.lag is None else dt + self.lag)
            limited = limited | jnp.any(jnp.abs(c - state.v) > farthest)
        works = None if self.failure_times is None else t < self.failure_times
        return Drive(state.v if self.moves else None, c, state.h, limited, works)

    def _allocation(self, device: Wheels, t: Scalar) -> Float[Array, "wheels 3"]:
        """The matrix that allots a torque to the wheels at t [s]: without a wheel that is known to have failed."""
        if self.failure_times is None or self.spare_allocations is None:
            return device.allocation
        failed = t >= self.failure_times
        spare = jnp.sum(jnp.where(failed[:, None, None], self.spare_allocations, 0.0), axis=0)
        return jnp.where(jnp.any(failed), spare, device.allocation)

    def _within_wheels(self, device: Wheels, v: Array, state: ActuatorState, dt: Scalar) -> Array:
        """Wheel torques that keep the momentum limit at the end of the period, and the torque limit in any case.

        A lag is taken into account: the impulse of the period is c (dt - a) + v a, a = lag (1 - e^(-dt/lag)). A rate
        limit is not, and the torque limit comes last: these two may let the momentum exceed its limit.
        """
        if device.momentum_limit is not None:
            assert state.h is not None
            h, a = state.h, jnp.zeros_like(dt)
            if self.lag is not None and state.v is not None:
                a = self.lag * -jnp.expm1(-dt / self.lag)
                h = h - a * state.v
            per_span = 1.0 / jnp.where(dt > a, dt - a, 1.0)  # one division, which all trials and wheels share
            v = jnp.clip(v, per_span * (h - device.momentum_limit), per_span * (h + device.momentum_limit))
        if device.torque_limit is not None:
            v = jnp.clip(v, -device.torque_limit, device.torque_limit)
        return v

    def channels(self, drive: Drive, s: Scalar) -> tuple[Array, Array, Array]:
        """Nominal torque of each channel s [s] into the period, its integral from the start and the integral of that.

        [N m, N m s, N m s^2]; v' = (c - v) / lag, |v'| at most the rate limit: a ramp until |c - v| is rate limit times
        lag, then the lag.
        """
        v, c = drive.v, drive.c
        if v is None:
            return c, c * s, c * (s * s / 2)
        # with a rate limit each channel has a ramp of its own duration; without one all channels share their times
        gap, span, first, second = c - v, s, 0.0, 0.0
        ramping, torque_on_ramp = None, c
        if self.rate_limit is not None:
            ramp_rate = self.rate_limit * jnp.sign(gap)
            by_lag = 0.0 * self.rate_limit if self.lag is None else self.rate_limit * self.lag
            lag_gap = jnp.clip(gap, -by_lag, by_lag)
            ramp = jnp.abs(gap - lag_gap) / self.rate_limit
            ramping, gap, span = s < ramp, lag_gap, jnp.maximum(s - ramp, 0.0)
            on_ramp = jnp.where(ramping, s, ramp)
            torque_on_ramp = v + ramp_rate * s
            first = on_ramp * (v + ramp_rate * on_ramp / 2)
            second = on_ramp * on_ramp * (v / 2 + ramp_rate * on_ramp / 6)
        left = area = twice = 0.0  # the gap that the lag leaves, and its two integrals
        if self.lag is not None:
            left = gap * jnp.exp(-span / self.lag)
            area = gap * (self.lag * -jnp.expm1(-span / self.lag))
            twice = self.lag * (gap * span - area)
        torque = c - left if ramping is None else jnp.where(ramping, torque_on_ramp, c - left)
        return torque, first + c * span - area, second + first * span + c * (span * span / 2) - twice

    def at(self, drive: Drive, s: Scalar) -> tuple[Array, Array | None]:
        """True torque of each channel s [s] into the period [N m], and the momentum of each wheel [N m s] or None."""
        v, impulse, _ = self.channels(drive, s)
        momentum = None if drive.h is None else drive.h - self.delivered(drive, impulse)
        return self.delivered(drive, v), momentum

    def over(self, drive: Drive, start: Scalar, dt: Scalar) -> AppliedTorque:
        """The torque over dt [s] from `start` in the period, whose impulse and first moment are exact.

        So momentum is, and to leading order the attitude, whatever a lag or a rate limit does within a step.
        """
        v, slope, has_length = drive.c, None, dt > 0.0
        _, first, _ = self.channels(drive, start)
        if drive.v is not None:
            # with a lag alone all channels move alike: by their gap times the motion of one from 1 to 0
            gap, moving = drive.v - drive.c, drive
            if self.rate_limit is None:
                moving = drive._replace(v=jnp.ones_like(dt), c=jnp.zeros_like(dt))
            _, begun, begun_twice = self.channels(moving, start)
            _, ended, ended_twice = self.channels(moving, start + dt)
            per_length = 1.0 / jnp.where(has_length, dt, 1.0)
            mean = (ended - begun) * per_length
            moment = (begun + ended) / 2 * dt - (ended_twice - begun_twice)  # of the torque about the middle
            tilt = jnp.where(has_length, 12.0 * moment * per_length**3, 0.0)
            if self.rate_limit is None:
                mean, tilt = drive.c + gap * mean, gap * tilt
            v, slope = jnp.where(has_length, mean, drive.v), tilt
        stored = None if drive.h is None else self.on_body(drive.h - self.delivered(drive, first))
        mean = self.on_body(self.delivered(drive, v))
        return AppliedTorque(mean, None if slope is None else self.on_body(self.delivered(drive, slope)), stored, dt)

    def end(self, state: ActuatorState, drive: Drive, queue: Array | None, dt: Scalar) -> ActuatorState:
        """State after a period of dt [s]; one of length zero changes nothing."""
        v, impulse, _ = self.channels(drive, dt)
        v = None if state.v is None else jnp.where(dt > 0.0, v, state.v)
        return ActuatorState(queue, v, None if drive.h is None else drive.h - self.delivered(drive, impulse))
