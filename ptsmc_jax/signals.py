"""What the loop is given: reference attitudes with their derivatives, and disturbance torques."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ptsmc_jax import attitude
from ptsmc_jax.numerics import Leaf, pytree
from ptsmc_jax.plants import AttitudeState

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
        """Nothing, at any time."""


@pytree
@dataclass(frozen=True)
class Now:
    """The reference of a system of one's own: the time itself, since F says how far from its target the system is."""

    def __call__(self, t: Time) -> Time:
        """T [s]."""
        return t


@pytree
@dataclass(frozen=True)
class Constant:
    """A constant disturbance; zero serves as none."""

    value: Leaf  # (m,) [N m]

    def __call__(self, t: Time, x: Any = None) -> Float[Array, " m"]:
        """Disturbance at t [s], (m,) [N m]."""
        return self.value


@pytree
@dataclass(frozen=True)
class Sinusoid:
    """bias + amplitude sin(frequency t + phase), per axis."""

    amplitude: Leaf  # (m,) [N m]
    frequency: Leaf  # (m,) [rad/s]
    phase: Leaf  # (m,) [rad]
    bias: Leaf  # (m,) [N m]

    def __call__(self, t: Time, x: Any = None) -> Float[Array, " m"]:
        """Disturbance at t [s], (m,) [N m]."""
        return self.bias + self.amplitude * jnp.sin(self.frequency * t + self.phase)


@pytree
@dataclass(frozen=True)
class GravityGradient:
    """Gravity-gradient torque on a circular orbit, 3 n^2 c x J c, c the unit vector to the planet in body axes.

    Wie, Space Vehicle Dynamics and Control (2008), eq. (6.128). It depends on the true attitude.
    """

    inertia: Leaf  # (3, 3) of the true body [kg m^2]
    orbit: Leaf  # (4,) quaternion of the orbit's frame: z along its normal, x to where the phase counts from
    rate: Leaf  # n [rad/s]
    phase: Leaf  # of the body at t = 0 [rad]

    def __call__(self, t: Time, x: AttitudeState) -> Float[Array, "3"]:
        """Torque at t [s] in the state x, (3,) [N m]."""
        along = self.rate * t + self.phase
        radial = jnp.stack([jnp.cos(along), jnp.sin(along), jnp.zeros_like(along)])
        c = attitude.rotate(attitude.multiply(attitude.conjugate(x.q), self.orbit), radial)
        return 3.0 * self.rate**2 * jnp.cross(c, self.inertia @ c)


@pytree
@dataclass(frozen=True)
class Sum:
    """The sum of several disturbances."""

    terms: tuple[Any, ...]

    def __call__(self, t: Time, x: Any) -> Float[Array, " m"]:
        """Disturbance at t [s] in the state x, (m,) [N m]."""
        total = self.terms[0](t, x)
        for term in self.terms[1:]:
            total = total + term(t, x)
        return total


# the fields that can be drawn, by the kind of the disturbance
_FIELDS: dict[str, dict[type, str]] = {
    "phase": {Sinusoid: "phase", GravityGradient: "phase"},
    "amplitude": {Sinusoid: "amplitude", Constant: "value"},
}


def values(disturbance: Any, what: Literal["phase", "amplitude"]) -> Float[Array, " count"]:
    """Every phase [rad] or amplitude [N m] of a disturbance, (count,): term after term, input after input."""
    terms = disturbance.terms if isinstance(disturbance, Sum) else (disturbance,)
    fields = [(term, _FIELDS[what].get(type(term))) for term in terms]
    return jnp.concatenate([jnp.zeros(0), *(jnp.ravel(getattr(term, field)) for term, field in fields if field)])


def with_values(disturbance: Any, what: Literal["phase", "amplitude"], new: Float[Array, " count"]) -> Any:
    """The disturbance with these phases [rad] or amplitudes [N m], as `values` gives them; what has none stays."""
    terms, used = [], 0
    for term in disturbance.terms if isinstance(disturbance, Sum) else (disturbance,):
        field = _FIELDS[what].get(type(term))
        if field is not None:
            old = jnp.asarray(getattr(term, field))
            term = replace(term, **{field: new[used : used + old.size].reshape(old.shape)})
            used += old.size
        terms.append(term)
    return Sum(tuple(terms)) if isinstance(disturbance, Sum) else terms[0]


def on_body(disturbance: Any, inertia: Float[Array, "3 3"]) -> Any:
    """The disturbance as it acts on a body of this inertia [kg m^2]."""
    if isinstance(disturbance, Sum):
        return Sum(tuple(on_body(term, inertia) for term in disturbance.terms))
    return replace(disturbance, inertia=inertia) if isinstance(disturbance, GravityGradient) else disturbance


def time_derivative(signal: Callable, t: Time) -> Array:
    """The derivative of a signal at t [s], (its shape), per second; exact, by automatic differentiation."""
    t = jnp.asarray(t, jnp.result_type(float))
    return jax.jvp(signal, (t,), (jnp.ones_like(t),))[1]
