"""What varies with time alone: reference attitudes with their derivatives, and disturbance torques."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ptsmc_jax import attitude
from ptsmc_jax.numerics import Leaf

Time = Float[Array, ""]


class Target(NamedTuple):
    """Reference attitude and its motion at one time."""

    q: Array  # (4,) q_f, reference axes relative to inertial [-]
    w: Array  # (3,) w_f, rate of the reference in its own axes [rad/s]
    w_dot: Array  # (3,) [rad/s^2]

    def vector_rates(self) -> tuple[Array, Array]:
        """q_1f' and q_1f'' of (57), (3,) each [1/s, 1/s^2]."""
        return attitude.vector_rates(self.q, self.w, self.w_dot)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Fixed:
    """A constant reference attitude."""

    q: Leaf  # (4,) unit quaternion

    def __call__(self, t: Time) -> Target:
        """Target at t [s]."""
        return Target(self.q, jnp.zeros(3), jnp.zeros(3))


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Spin:
    """A reference that turns at a constant rate: q_f(t) = q(0) exp(w t)."""

    q: Leaf  # (4,) attitude at t = 0
    rate: Leaf  # (3,) [rad/s], in the reference's axes

    def __call__(self, t: Time) -> Target:
        """Target at t [s]."""
        turned = attitude.multiply(self.q, attitude.from_rotation_vector(self.rate * t))
        return Target(turned, self.rate, jnp.zeros(3))


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Origin:
    """The reference of an integrator chain: the origin, which needs no numbers."""

    def __call__(self, t: Time) -> None:
        """Nothing, at any time."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Constant:
    """A constant disturbance; zero serves as none."""

    value: Leaf  # (m,) [N m]

    def __call__(self, t: Time) -> Float[Array, " m"]:
        """Disturbance at t [s], (m,) [N m]."""
        return self.value


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Sinusoid:
    """bias + amplitude sin(frequency t + phase), per axis."""

    amplitude: Leaf  # (m,) [N m]
    frequency: Leaf  # (m,) [rad/s]
    phase: Leaf  # (m,) [rad]
    bias: Leaf  # (m,) [N m]

    def __call__(self, t: Time) -> Float[Array, " m"]:
        """Disturbance at t [s], (m,) [N m]."""
        return self.bias + self.amplitude * jnp.sin(self.frequency * t + self.phase)


def time_derivative(signal: Callable, t: Time) -> Array:
    """D signal / dt at t, exact (by automatic differentiation), in the signal's units per second."""
    t = jnp.asarray(t, jnp.result_type(float))
    return jax.jvp(signal, (t,), (jnp.ones_like(t),))[1]
