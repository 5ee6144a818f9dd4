"""Reference attitudes with their rates, and the references of plants that are no spacecraft.

A reference is a function from the time to a `Target`. `Reference` is the base of custom reference attitudes.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ptsmc_jax.declare import Scaled, number
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


def target_of(path: Callable[[Scalar], Float[Array, "4"]], t: Scalar) -> Target:
    """Return the target at t [s] of an attitude path, which is a unit quaternion as a function of time.

    Rates are exact, by automatic differentiation: w = 2 vec(q* q') and w' = 2 vec(q* q''), because the product
    q*' q' = |q'|^2 has no vector part.
    """
    t = jnp.asarray(t, jnp.result_type(float))
    one = jnp.ones_like(t)
    # one nested jvp traces the path once, with its tangents
    (q, q_dot), (_, q_ddot) = jax.jvp(lambda t: jax.jvp(path, (t,), (one,)), (t,), (one,))
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

    q: Leaf  # (4,) attitude from which the reference rotates
    paced_by: ClassVar[str] = "code"  # scenario key that determines how fast the reference rotates

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
class Fixed(Reference):
    """A constant attitude."""

    def __call__(self, t: Scalar) -> Target:
        """Return the target at t [s]."""
        return Target(self.q, jnp.zeros(3), jnp.zeros(3))


@pytree
@dataclass(frozen=True)
class Spin(Reference):
    """A rotation at a constant body rate from the attitude at t = 0: q_f(t) = q(0) exp(w t)."""

    rate: Leaf = number((0.0, 0.0, 0.0), unit="rad/s", meaning="rate of the reference, in its own axes")
    paced_by: ClassVar[str] = "rate"

    def __call__(self, t: Scalar) -> Target:
        """Return the target at t [s]."""
        turned = attitude.multiply(self.q, attitude.from_rotation_vector(self.rate * t))
        return Target(turned, self.rate, jnp.zeros(3))

    def fastest(self) -> float:
        """Return its rate [rad/s]."""
        return float(np.linalg.norm(self.rate))


@pytree
@dataclass(frozen=True)
class Swing(Reference):
    """An oscillation about the attitude, with the rotation vector r = amplitude sin(frequency t + phase) per axis.

    q_f(t) = q exp(r(t)).
    """

    amplitude: Leaf = number((0.1, 0.1, 0.1), unit="rad", meaning="amplitude of the rotation vector on each axis")
    frequency: Leaf = number(
        Scaled((0.1, 0.1, 0.1), time=-1), unit="rad/s", meaning="per axis; default: 0.1 each, scaled to the mission"
    )
    phase: Leaf = number((0.0, 0.0, 0.0), unit="rad", meaning="per axis")
    paced_by: ClassVar[str] = "frequency"

    def fastest(self) -> float:
        """Return its largest rate plus its largest angular frequency [rad/s]."""
        turning = float(np.linalg.norm(np.multiply(self.amplitude, self.frequency)))
        return turning + float(np.max(np.abs(self.frequency)))

    def attitude(self, t: Scalar) -> Float[Array, "4"]:
        return attitude.from_rotation_vector(self.amplitude * jnp.sin(self.frequency * t + self.phase))


@pytree
@dataclass(frozen=True)
class Slew(Reference):
    """A slew about one axis, from rest to rest: q_f(t) = q exp(f(t / duration) turn).

    The fraction f(x) = 10 x^3 - 15 x^4 + 6 x^5 rises from 0 to 1, with zero first and second derivatives at both ends.
    """

    turn: Leaf  # (3,) rotation vector from the attitude at t = 0 to the attitude at t = duration and later [rad]
    duration: Leaf = number(
        Scaled(30.0, time=1), above=0.0, unit="s", meaning="duration of the slew; default: 30, scaled to the mission"
    )
    paced_by: ClassVar[str] = "duration"

    def fastest(self) -> float:
        """Return the largest rate of the quintic plus 2 pi / duration [rad/s]."""
        turning = 1.875 * float(np.linalg.norm(self.turn))
        return (turning + 2.0 * np.pi) / float(self.duration)

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
