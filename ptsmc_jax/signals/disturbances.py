"""Disturbances d(t, x) of (2) and (25), alone or summed."""

from dataclasses import dataclass, replace
from typing import Any, Literal

import jax.numpy as jnp
from jaxtyping import Array, Float

from ptsmc_jax.numerics import attitude
from ptsmc_jax.numerics.pytrees import Leaf, pytree
from ptsmc_jax.plants.rigid_body import AttitudeState

Time = Float[Array, ""]


@dataclass(frozen=True)
class Disturbance:
    """What a disturbance of one's own is derived from: a function of time and of the true state."""

    def __call__(self, t: Time, x: Any) -> Float[Array, " m"]:
        """Disturbance at t [s] in the state x, (m,) [N m]."""
        raise NotImplementedError

    def fastest(self) -> float:
        """How fast it changes at most [rad/s], which the integration steps follow; 0: slowly."""
        return 0.0


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
class Bias(Constant):
    """A constant that is added to the disturbance of a scenario, see `with_bias`; its amplitude is none of theirs."""


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


def bias(disturbance: Any, inputs: int) -> Float[Array, " m"]:
    """What is added to a disturbance, (m,) [N m]; zero: nothing is."""
    last = disturbance.terms[-1] if isinstance(disturbance, Sum) else disturbance
    return last.value if isinstance(last, Bias) else jnp.zeros(inputs)


def with_bias(disturbance: Any, value: Float[Array, " m"]) -> Sum:
    """The disturbance with this added to it, (m,) [N m], in place of what was added before."""
    terms = disturbance.terms if isinstance(disturbance, Sum) else (disturbance,)
    return Sum((*(term for term in terms if not isinstance(term, Bias)), Bias(value)))


def on_body(disturbance: Any, inertia: Float[Array, "3 3"]) -> Any:
    """The disturbance as it acts on a body of this inertia [kg m^2]."""
    if isinstance(disturbance, Sum):
        return Sum(tuple(on_body(term, inertia) for term in disturbance.terms))
    return replace(disturbance, inertia=inertia) if isinstance(disturbance, GravityGradient) else disturbance
