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


def moving(path: Callable[[Time], Float[Array, "4"]], t: Time) -> Target:
    """Target at t [s] of a reference attitude given as a function of time; its derivatives are exact (autodiff).

    w = 2 vec(q* q') and w' = 2 vec(q* q''), since q*' q' = |q'|^2 has no vector part.
    """
    q = path(t)
    q_dot, q_ddot = time_derivative(path, t), time_derivative(lambda t: time_derivative(path, t), t)
    inverse = attitude.conjugate(q)
    return Target(q, 2.0 * attitude.multiply(inverse, q_dot)[:3], 2.0 * attitude.multiply(inverse, q_ddot)[:3])


@pytree
@dataclass(frozen=True)
class TurningFunction(Function):
    """A plain function of time [s] as a reference attitude: of a `Target`, or of a quaternion (4,) of any length."""

    def __call__(self, t: Time) -> Target:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Target at t [s]; a quaternion's rates are its derivatives. Raises TypeError where it is neither."""
        found = self.function(t)
        if isinstance(found, Target):
            return found
        if jnp.shape(found) != (4,):
            raise TypeError(
                f"the reference function returns {found!r}, but must return a quaternion (4,), scalar last, or a Target"
            )
        return moving(lambda t: attitude.normalise(jnp.asarray(self.function(t))), t)


@dataclass(frozen=True)
class Reference:
    """What a reference attitude of one's own is derived from: q_f(t) = q attitude(t)."""

    q: Leaf  # (4,) the attitude that it turns from

    def attitude(self, t: Time) -> Float[Array, "4"]:
        """Unit quaternion at t [s], twice differentiable: the rates that the law needs are its derivatives."""
        raise NotImplementedError

    def fastest(self) -> float:
        """How fast it turns and changes at most [rad/s], which the integration steps follow."""
        return 0.0

    def __call__(self, t: Time) -> Target:
        """Target at t [s]."""
        return moving(lambda t: attitude.multiply(self.q, self.attitude(t)), t)


@pytree
@dataclass(frozen=True)
class Swing:
    """A reference that swings about an attitude: q_f(t) = q exp(r(t)), r = amplitude sin(frequency t + phase)."""

    q: Leaf  # (4,) the attitude it swings about
    amplitude: Leaf  # (3,) of the rotation vector, per axis [rad]
    frequency: Leaf  # (3,) [rad/s]
    phase: Leaf  # (3,) [rad]

    def __call__(self, t: Time) -> Target:
        """Target at t [s]."""

        def path(t: Time) -> Float[Array, "4"]:
            turn = self.amplitude * jnp.sin(self.frequency * t + self.phase)
            return attitude.multiply(self.q, attitude.from_rotation_vector(turn))

        return moving(path, t)


@pytree
@dataclass(frozen=True)
class Slew:
    """A reference that turns about a fixed axis from rest to rest: q_f(t) = q exp(share(t / duration) turn).

    share(x) = 10 x^3 - 15 x^4 + 6 x^5, 0 before and 1 after: its first two derivatives vanish at both ends.
    """

    q: Leaf  # (4,) attitude until t = 0
    turn: Leaf  # (3,) rotation vector to the attitude from t = duration on [rad]
    duration: Leaf  # [s]

    def __call__(self, t: Time) -> Target:
        """Target at t [s]."""

        def path(t: Time) -> Float[Array, "4"]:
            x = jnp.clip(t / self.duration, 0.0, 1.0)
            share = x * x * x * (10.0 + x * (6.0 * x - 15.0))
            return attitude.multiply(self.q, attitude.from_rotation_vector(share * self.turn))

        return moving(path, t)


@pytree
@dataclass(frozen=True)
class Origin:
    """The reference of an integrator chain: the origin, which needs no numbers."""

    def __call__(self, t: Time) -> None:
        """None: a chain's target needs no numbers."""


@pytree
@dataclass(frozen=True)
class Now:
    """The reference of a system of one's own: the time itself, since F says how far from its target the system is."""

    def __call__(self, t: Time) -> Time:
        """T [s]."""
        return t


def time_derivative(signal: Callable, t: Time) -> Array:
    """The derivative of a signal at t [s], (its shape), per second; exact, by automatic differentiation."""
    t = jnp.asarray(t, jnp.result_type(float))
    return jax.jvp(signal, (t,), (jnp.ones_like(t),))[1]
