"""What stands between the commanded torque and the body: delay, quantisation, limits, lag, reaction wheels.

Each device is off where it is None. Quantisation has the derivative of the command it is given.
"""

from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from ptsmc_jax.devices.reaction_wheels import Wheels
from ptsmc_jax.numerics import guards
from ptsmc_jax.numerics.pytrees import Leaf, Scalar, Vector, pytree


def quantise(u: Array, step: Scalar) -> Array:
    """The nearest multiple of step [N m], (m,). Its derivative is that of the command: a staircase has none to use."""
    return u + jax.lax.stop_gradient(step * jnp.round(u / step) - u)


class ActuatorState(NamedTuple):
    """What actuators carry from period to period."""

    queue: Array | None  # (delay, m) commands on their way, the oldest first [N m]
    v: Array | None  # (channels,) torque at the end of the last period [N m]; None where nothing depends on it
    h: Array | None  # (wheels,) stored momentum [N m s]


class Drive(NamedTuple):
    """One period: channels move from v toward the target c."""

    v: Array | None  # (channels,) [N m]; None: at c from the start
    c: Array
    h: Any  # (wheels,) at the start of the period [N m s]; None without wheels
    limited: Array  # bool: a limit cuts the command
    works: Array | None = None  # (channels,) bool; None: all of them


class Push(NamedTuple):
    """What acts on the body over a time dt inside a period: a torque linear in time, and the momentum of wheels."""

    mean: Array  # (m,) torque on the body [N m]
    slope: Array | None  # (m,) of the torque, about the middle [N m/s]; None where it is held
    stored: Array | None  # (m,) momentum A h at the start [N m s]; None without wheels
    dt: Array  # [s]

    def at(self, s: Scalar, w: Vector) -> Vector:
        """Torque on a body that turns at w [rad/s], s [s] from the start: u - w x A h [N m], with (A h)' = -u."""
        u, gone = self.mean, self.mean * s
        if self.slope is not None:
            u, gone = u + self.slope * (s - self.dt / 2), gone + self.slope * (s * (s - self.dt) / 2)
        return u if self.stored is None else u - jnp.cross(w, self.stored - gone)

    @property
    def middle(self) -> Array | None:
        """Mean of the momentum A h at both ends [N m s]; None without wheels."""
        return None if self.stored is None else self.stored - self.mean * self.dt / 2


@pytree
@dataclass(frozen=True)
class Actuators:
    """Delay, the limit per axis, then per axis or per wheel: quantisation, limits, rate limit and first-order lag."""

    torque_limit: Leaf | None = None  # per body axis [N m]
    rate_limit: Leaf | None = None  # [N m/s]
    lag: Leaf | None = None  # time constant [s]
    step: Leaf | None = None  # quantisation [N m]
    wheels: Wheels | None = None
    delay: int = field(default=0, metadata={"static": True})  # whole control periods
    # as they are, where that is not as the flight software knows them
    scale: Leaf | None = None  # (channels,) what each axis, or wheel, gives of its torque [-]
    directions: Leaf | None = None  # (m, channels) unit vectors along which they act
    fails: Leaf | None = None  # (channels,) times from whose next sample on they give nothing [s]
    spares: Leaf | None = None  # (wheels, wheels, 3) allocation without each of them, where a failure is known

    @property
    def known(self) -> "Actuators":
        """The actuators as the flight software knows them: without their misfits."""
        return replace(self, scale=None, directions=None, fails=None)

    def assumed(self, drive: Drive, dt: Scalar) -> Push:
        """What acted in a period dt [s] as far as flight software knows, torques in N m: `over` of `known`."""
        return self.known.over(drive if self.spares is not None else drive._replace(works=None), jnp.zeros_like(dt), dt)

    def given(self, drive: Drive, v: Array) -> Array:
        """What channels give of their torques [N m], or of anything linear in them, (channels,)."""
        given = v if self.scale is None else self.scale * v
        return given if drive.works is None else jnp.where(drive.works, given, 0.0)

    def on_body(self, v: Array) -> Vector:
        """A vector in body axes (m,) of numbers along the channels' directions (channels,), torques [N m] or others."""
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
        fits = self.scale is None and self.directions is None and self.fails is None
        return fits and not self.moves and self.wheels is None

    def begin(self, inputs: int) -> ActuatorState:
        """The state at rest: no torque acts, no command is on its way."""
        queue = jnp.zeros((self.delay, inputs)) if self.delay else None
        momentum = None if self.wheels is None else self.wheels.initial
        rest = jnp.zeros(inputs) if momentum is None else jnp.zeros_like(momentum)
        return ActuatorState(queue, None if self.holds else rest, momentum)

    def command(
        self, state: ActuatorState, u: Vector, w: Vector, t: Scalar, dt: Scalar, weight: Scalar
    ) -> tuple[Drive, Any]:
        """Drive of a period dt at t [s], and the queue after it, for the command u [N m] at the rate seen w [rad/s].

        The flight software knows the wheels' momentum and adds w x A h. weight: share of a partial first period; its
        command counts that much of the way, so that nothing jumps where the period vanishes.
        """
        queue, now = state.queue, u
        if queue is not None:
            now = queue[0]
            pushed = jnp.concatenate([queue[1:], guards.lerp(weight, u, queue[-1])[None]])
            queue = jnp.where(dt > 0.0, pushed, queue)
        wanted = now if self.torque_limit is None else jnp.clip(now, -self.torque_limit, self.torque_limit)
        limited = jnp.any(wanted != now)
        if self.wheels is not None:
            assert state.h is not None
            allocation = self.wheels.allocation
            if self.fails is not None and self.spares is not None:
                failed = t >= self.fails
                spare = jnp.sum(jnp.where(failed[:, None, None], self.spares, 0.0), axis=0)
                allocation = jnp.where(jnp.any(failed), spare, allocation)
            wanted = allocation @ (wanted + jnp.cross(w, self.wheels.axes @ state.h))
        if self.step is not None:
            wanted = quantise(wanted, self.step)
            if self.torque_limit is not None and self.wheels is None:  # a step may lie beyond it
                wanted = jnp.clip(wanted, -self.torque_limit, self.torque_limit)
        cut = wanted
        if self.wheels is not None:
            cut = self._within_wheels(self.wheels, wanted, state, dt)
        limited = limited | jnp.any(cut != wanted)
        if self.rate_limit is not None:
            assert state.v is not None
            farthest = self.rate_limit * (dt if self.lag is None else dt + self.lag)
            limited = limited | jnp.any(jnp.abs(cut - state.v) > farthest)
        works = None if self.fails is None else t < self.fails
        return Drive(state.v if self.moves else None, cut, state.h, limited, works), queue

    def _within_wheels(self, device: Wheels, v: Array, state: ActuatorState, dt: Scalar) -> Array:
        """Wheel torques that keep the momentum limit at the end of the period, and the torque limit in any case.

        A lag is reckoned with: c (dt - a) + v a flows in the period, a = lag (1 - e^(-dt/lag)). A rate limit is not,
        and the torque limit has the last word: beyond the momentum limit by what they take is possible.
        """
        if device.momentum_limit is not None:
            assert state.h is not None
            left, slow = state.h, jnp.zeros_like(dt)
            if self.lag is not None and state.v is not None:
                slow = self.lag * -jnp.expm1(-dt / self.lag)
                left = left - slow * state.v
            span = jnp.where(dt > slow, dt - slow, 1.0)
            v = jnp.clip(v, (left - device.momentum_limit) / span, (left + device.momentum_limit) / span)
        if device.torque_limit is not None:
            v = jnp.clip(v, -device.torque_limit, device.torque_limit)
        return v

    def channels(self, drive: Drive, s: Scalar) -> tuple[Array, Array, Array]:
        """Torque of each channel s [s] into the period, its integral from the start and the integral of that.

        [N m, N m s, N m s^2]; v' = (c - v) / lag, |v'| at most the rate limit: a ramp until |c - v| is rate limit times
        lag, then the lag.
        """
        v, c = drive.v, drive.c
        if v is None:
            return c, c * s, c * (s * s / 2)
        gap = c - v
        near = gap  # what the lag closes, after a ramp of this length and slope
        ramp, slope = jnp.zeros_like(gap), jnp.zeros_like(gap)
        if self.rate_limit is not None:
            by_lag = 0.0 * self.rate_limit if self.lag is None else self.rate_limit * self.lag
            near = jnp.clip(gap, -by_lag, by_lag)
            ramp = jnp.abs(gap - near) / self.rate_limit
            slope = self.rate_limit * jnp.sign(gap)
        ramping = s < ramp
        still = jnp.maximum(s - ramp, 0.0)
        left, area, twice = (jnp.zeros_like(gap),) * 3  # of the lag: what is not yet closed, and its two integrals
        if self.lag is not None:
            left = near * jnp.exp(-still / self.lag)
            area = near * self.lag * -jnp.expm1(-still / self.lag)
            twice = self.lag * (near * still - area)
        ramped = jnp.where(ramping, s, ramp)  # time spent on the ramp
        torque = jnp.where(ramping, v + slope * s, c - left)
        first = ramped * (v + slope * ramped / 2)
        second = ramped * ramped * (v / 2 + slope * ramped / 6)
        return torque, first + c * still - area, second + first * still + c * (still * still / 2) - twice

    def torque(self, drive: Drive, s: Scalar) -> Vector:
        """Torque on the body s [s] into the period [N m]."""
        v, *_ = self.channels(drive, s)
        return self.on_body(self.given(drive, v))

    def wheels_at(self, drive: Drive, s: Scalar) -> tuple[Array, Array]:
        """Momentum [N m s] and torque [N m] of each wheel s [s] into the period, (wheels,) each."""
        v, impulse, _ = self.channels(drive, s)
        return drive.h - self.given(drive, impulse), self.given(drive, v)

    def over(self, drive: Drive, start: Scalar, dt: Scalar) -> Push:
        """What acts over dt [s] from `start` in the period: the torque's impulse and first moment are exact.

        So momentum is, and to leading order the attitude, whatever a lag or a rate limit does within a step.
        """
        v, slope, has_length = drive.c, None, dt > 0.0
        if drive.v is not None:
            (_, first, second), (_, first_next, second_next) = (self.channels(drive, s) for s in (start, start + dt))
            long = jnp.where(has_length, dt, 1.0)
            v = jnp.where(has_length, (first_next - first) / long, drive.v)
            moment = (first + first_next) / 2 * dt - (second_next - second)  # of the torque about the middle
            slope = jnp.where(has_length, 12.0 * moment / long**3, 0.0)
        stored = None if self.wheels is None else self.on_body(self.wheels_at(drive, start)[0])
        mean = self.on_body(self.given(drive, v))
        return Push(mean, None if slope is None else self.on_body(self.given(drive, slope)), stored, dt)

    def end(self, state: ActuatorState, drive: Drive, queue: Any, dt: Scalar) -> ActuatorState:
        """State after a period of dt [s]; one of length zero changes nothing."""
        v, impulse, _ = self.channels(drive, dt)
        v = None if state.v is None else jnp.where(dt > 0.0, v, state.v)
        return ActuatorState(queue, v, None if drive.h is None else drive.h - self.given(drive, impulse))
