"""Reference attitudes with their rates, and the references of plants that are no spacecraft.

A reference is a function from the time to a `Target`. `Reference` is the base of custom reference attitudes.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ptsmc_jax.numerics import attitude
from ptsmc_jax.numerics.pytrees import Function, Leaf, Scalar, pytree


class Target(NamedTuple):
    """Reference attitude, rate and acceleration at one time."""

    q: Array  # (4,) q_f, rotation from reference axes to inertial axes [-]
    w: Array  # (3,) w_f, rate of the reference in reference axes [rad/s]
    w_dot: Array  # (3,) time derivative of w [rad/s^2]

    def vector_rates(self) -> tuple[Array, Array]:
        """Return q_1f' [1/s] and q_1f'' [1/s^2] of (57), (3,) each."""
        return attitude.vector_rates(self.q, self.w, self.w_dot)


@pytree
@dataclass(frozen=True)
class Fixed:
    """A constant reference attitude."""

    q: Leaf  # (4,) unit quaternion

    def __call__(self, t: Scalar) -> Target:
        """Return the target at the time t [s]."""
        return Target(self.q, jnp.zeros(3), jnp.zeros(3))


@pytree
@dataclass(frozen=True)
class Spin:
    """A reference that rotates at a constant rate: q_f(t) = q(0) exp(w t)."""

    q: Leaf  # (4,) attitude at t = 0 [-]
    rate: Leaf  # (3,) rate in reference axes [rad/s]

    def __call__(self, t: Scalar) -> Target:
        """Return the target at the time t [s]."""
        q = attitude.multiply(self.q, attitude.from_rotation_vector(self.rate * t))
        return Target(q, self.rate, jnp.zeros(3))


def target_of(path: Callable[[Scalar], Float[Array, "4"]], t: Scalar) -> Target:
    """Return the target at the time t [s] for a path, a function from the time to a unit quaternion.

    Rates are exact, by automatic differentiation: w = 2 vec(q* q') and w' = 2 vec(q* q''), because the product
    q*' q' = |q'|^2 has no vector part.
    """
    q = path(t)
    q_dot, q_ddot = time_derivative(path, t), time_derivative(lambda t: time_derivative(path, t), t)
    inverse = attitude.conjugate(q)
    return Target(q, 2.0 * attitude.multiply(inverse, q_dot)[:3], 2.0 * attitude.multiply(inverse, q_ddot)[:3])


@pytree
@dataclass(frozen=True)
class TurningFunction(Function):
    """A custom function of time [s] as a reference. It returns a `Target`, or a quaternion (4,) of any norm [-]."""

    function: Callable  # a pytree such as `jax.tree_util.Partial`, whose numbers are leaves

    def __call__(self, t: Scalar) -> Target:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Return the target at the time t [s]. The rates of a quaternion are its derivatives.

        Raises:
            TypeError: The function returns neither a `Target` nor a quaternion.
        """
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
    """Base of references that define an attitude as a function of time, also of custom ones: q_f(t) = q attitude(t)."""

    q: Leaf  # (4,) constant attitude that the motion starts from [-]

    def attitude(self, t: Scalar) -> Float[Array, "4"]:
        """Return the unit quaternion (4,) [-] at the time t [s]. It must be twice differentiable for the rates."""
        raise NotImplementedError

    def fastest(self) -> float:
        """Return the largest rate or angular frequency [rad/s], for the choice of the integration step. 0: no limit."""
        return 0.0

    def __call__(self, t: Scalar) -> Target:
        """Return the target at the time t [s]."""
        return target_of(lambda t: attitude.multiply(self.q, self.attitude(t)), t)


@pytree
@dataclass(frozen=True)
class Swing(Reference):
    """A reference that oscillates about an attitude: q_f(t) = q exp(r(t)), r = amplitude sin(frequency t + phase)."""

    amplitude: Leaf  # (3,) amplitude of the rotation vector r for each axis [rad]
    frequency: Leaf  # (3,) [rad/s]
    phase: Leaf  # (3,) [rad]

    def attitude(self, t: Scalar) -> Float[Array, "4"]:
        return attitude.from_rotation_vector(self.amplitude * jnp.sin(self.frequency * t + self.phase))


@pytree
@dataclass(frozen=True)
class Slew(Reference):
    """A rotation about a fixed axis from rest to rest: q_f(t) = q exp(f(t / duration) turn).

    The fraction f(x) = 10 x^3 - 15 x^4 + 6 x^5 rises from 0 to 1, with zero first and second derivatives at both ends.
    """

    turn: Leaf  # (3,) rotation vector of the whole slew [rad]
    duration: Leaf  # [s]

    def attitude(self, t: Scalar) -> Float[Array, "4"]:
        x = jnp.clip(t / self.duration, 0.0, 1.0)
        fraction = x * x * x * (10.0 + x * (6.0 * x - 15.0))
        return attitude.from_rotation_vector(fraction * self.turn)


@pytree
@dataclass(frozen=True)
class Origin:
    """The reference of an integrator chain: the origin."""

    def __call__(self, t: Scalar) -> None:
        """Return None, because the origin needs no numbers."""


@pytree
@dataclass(frozen=True)
class CurrentTime:
    """The reference of a custom second-order system: the time itself, because F(t, x) defines the error."""

    def __call__(self, t: Scalar) -> Scalar:
        """Return t [s]."""
        return t


def time_derivative(signal: Callable, t: Scalar) -> Array:
    """Return the time derivative [1/s] of a signal at the time t [s], (its shape), by automatic differentiation."""
    t = jnp.asarray(t, jnp.result_type(float))
    return jax.jvp(signal, (t,), (jnp.ones_like(t),))[1]
