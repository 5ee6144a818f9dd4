"""Reference attitudes with their derivatives, and the origin of other plants."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ptsmc_jax.numerics import attitude
from ptsmc_jax.numerics.pytrees import Function, Leaf, pytree

Time = Float[Array, ""]


class Target(NamedTuple):
    """Reference attitude and its motion at one time."""

    q: Array  # (4,) q_f, reference axes relative to inertial [-]
    w: Array  # (3,) w_f, rate of the reference in its own axes [rad/s]
    w_dot: Array  # (3,) [rad/s^2]

    def vector_rates(self) -> tuple[Array, Array]:
        """q_1f' and q_1f'' of (57), (3,) each [1/s, 1/s^2]."""
        return attitude.vector_rates(self.q, self.w, self.w_dot)


@pytree
@dataclass(frozen=True)
class Fixed:
    """A constant reference attitude."""

    q: Leaf  # (4,) unit quaternion

    def __call__(self, t: Time) -> Target:
        """Target at t [s]."""
        return Target(self.q, jnp.zeros(3), jnp.zeros(3))


@pytree
@dataclass(frozen=True)
class Spin:
    """A reference that turns at a constant rate: q_f(t) = q(0) exp(w t)."""

    q: Leaf  # (4,) attitude at t = 0
    rate: Leaf  # (3,) [rad/s], in the reference's axes

    def __call__(self, t: Time) -> Target:
        """Target at t [s]."""
        turned = attitude.multiply(self.q, attitude.from_rotation_vector(self.rate * t))
        return Target(turned, self.rate, jnp.zeros(3))


def target_of(path: Callable[[Time], Float[Array, "4"]], t: Time) -> Target:
    """Target at t [s] of an attitude path, a unit quaternion as a function of time; its derivatives are exact.

    w = 2 vec(q* q') and w' = 2 vec(q* q''), since q*' q' = |q'|^2 has no vector part.
    """
    q = path(t)
    q_dot, q_ddot = time_derivative(path, t), time_derivative(lambda t: time_derivative(path, t), t)
    inverse = attitude.conjugate(q)
    return Target(q, 2.0 * attitude.multiply(inverse, q_dot)[:3], 2.0 * attitude.multiply(inverse, q_ddot)[:3])


@pytree
@dataclass(frozen=True)
class TurningFunction(Function):
    """A function of time [s] as a reference attitude: of a `Target`, or of a quaternion (4,) of any length."""

    function: Callable  # a pytree, as `jax.tree_util.Partial` is: its numbers are leaves

    def __call__(self, t: Time) -> Target:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Target at t [s]; a quaternion's rates are its derivatives. Raises TypeError where it is neither."""
        value = self.function(t)
        if isinstance(value, Target):
            return value
        value = jnp.asarray(value) if isinstance(value, list | tuple) else value
        if jnp.shape(value) != (4,):
            raise TypeError(
                f"the reference function returns {value!r}, but must return a quaternion (4,), scalar last, or a Target"
            )
        return target_of(lambda t: attitude.normalise(jnp.asarray(self.function(t))), t)


@dataclass(frozen=True)
class Reference:
    """A reference given by an attitude as a function of time, q_f(t) = q attitude(t); the base of one's own, too."""

    q: Leaf  # (4,) the attitude that it turns from

    def attitude(self, t: Time) -> Float[Array, "4"]:
        """Unit quaternion at t [s], twice differentiable: the rates that the law needs are its derivatives."""
        raise NotImplementedError

    def fastest(self) -> float:
        """How fast it turns and changes at most [rad/s], which the integration steps follow."""
        return 0.0

    def __call__(self, t: Time) -> Target:
        """Target at t [s]."""
        return target_of(lambda t: attitude.multiply(self.q, self.attitude(t)), t)


@pytree
@dataclass(frozen=True)
class Swing(Reference):
    """A reference that swings about an attitude: q_f(t) = q exp(r(t)), r = amplitude sin(frequency t + phase)."""

    amplitude: Leaf  # (3,) of the rotation vector r, per axis [rad]
    frequency: Leaf  # (3,) [rad/s]
    phase: Leaf  # (3,) [rad]

    def attitude(self, t: Time) -> Float[Array, "4"]:
        """The unit quaternion exp(r(t)) at t [s]."""
        return attitude.from_rotation_vector(self.amplitude * jnp.sin(self.frequency * t + self.phase))


@pytree
@dataclass(frozen=True)
class Slew(Reference):
    """A reference that turns about a fixed axis from rest to rest: q_f(t) = q exp(share(t / duration) turn).

    share(x) = 10 x^3 - 15 x^4 + 6 x^5, 0 before and 1 after: its first two derivatives vanish at both ends.
    """

    turn: Leaf  # (3,) rotation vector from the attitude at t = 0 to that from t = duration on [rad]
    duration: Leaf  # [s]

    def attitude(self, t: Time) -> Float[Array, "4"]:
        """The unit quaternion exp(share turn) at t [s]."""
        x = jnp.clip(t / self.duration, 0.0, 1.0)
        share = x * x * x * (10.0 + x * (6.0 * x - 15.0))
        return attitude.from_rotation_vector(share * self.turn)


@pytree
@dataclass(frozen=True)
class Origin:
    """The reference of an integrator chain: the origin."""

    def __call__(self, t: Time) -> None:
        """None: the origin needs no numbers."""


@pytree
@dataclass(frozen=True)
class CurrentTime:
    """The reference of a system of one's own: the time itself, since F says how far from its target the system is."""

    def __call__(self, t: Time) -> Time:
        """The time t itself [s]."""
        return t


def time_derivative(signal: Callable, t: Time) -> Array:
    """The derivative of a signal at t [s], (its shape), per second; exact, by automatic differentiation."""
    t = jnp.asarray(t, jnp.result_type(float))
    return jax.jvp(signal, (t,), (jnp.ones_like(t),))[1]
