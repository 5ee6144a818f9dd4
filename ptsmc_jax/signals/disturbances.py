"""Disturbances d(t, x) of (2) and (25), and functions that read or replace their phases, amplitudes and biases.

Read `Disturbance` first, the base of all disturbances and of custom ones. `Sum` adds several of them.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ptsmc_jax.numerics import attitude
from ptsmc_jax.numerics.pytrees import Leaf, Scalar, pytree
from ptsmc_jax.plants.rigid_body import AttitudeState


@dataclass(frozen=True)
class Disturbance:
    """Base of the disturbances, and of custom ones: a function of time and of the state of the true plant."""

    def __call__(self, t: Scalar, x: Any) -> Float[Array, " m"]:
        """Return the disturbance (m,) [N m] at the time t [s] in the state x."""
        raise NotImplementedError

    # for "phase" and "amplitude", the name of the field that a dispersion of this quantity changes
    drawn: ClassVar[Mapping[str, str]] = {}

    def fastest(self) -> float:
        """Return the largest angular frequency [rad/s], for the choice of the integration step. 0: no limit."""
        return 0.0

    def on_body(self, inertia: Float[Array, "3 3"]) -> Any:
        """Return the disturbance of a body with this inertia [kg m^2]."""
        return self


@pytree
@dataclass(frozen=True)
class Constant(Disturbance):
    """A constant disturbance. The value zero means no disturbance."""

    value: Leaf  # (m,) [N m]
    drawn: ClassVar[Mapping[str, str]] = {"amplitude": "value"}

    def __call__(self, t: Scalar, x: Any = None) -> Float[Array, " m"]:
        return self.value


@pytree
@dataclass(frozen=True)
class Bias(Constant):
    """A constant that `with_bias` adds to the disturbance of a scenario. Dispersions of amplitudes do not change it."""

    drawn: ClassVar[Mapping[str, str]] = {}


def _sin_cos_of_sum(angle: Array, phase: Any) -> tuple[Array, Array]:
    """Return sin and cos of angle + phase by the addition theorems.

    If phases differ by trial, all trials of a batch use the same sin and cos of the angle, and the sin and cos of the
    phases are computed only once.
    """
    sine, cosine = jnp.sin(angle), jnp.cos(angle)
    sine_0, cosine_0 = jnp.sin(phase), jnp.cos(phase)
    return sine * cosine_0 + cosine * sine_0, cosine * cosine_0 - sine * sine_0


@pytree
@dataclass(frozen=True)
class Sinusoid(Disturbance):
    """A sinusoid for each axis: bias + amplitude sin(frequency t + phase)."""

    amplitude: Leaf  # (m,) [N m]
    frequency: Leaf  # (m,) [rad/s]
    phase: Leaf  # (m,) [rad]
    bias: Leaf  # (m,) [N m]
    drawn: ClassVar[Mapping[str, str]] = {"phase": "phase", "amplitude": "amplitude"}

    def __call__(self, t: Scalar, x: Any = None) -> Float[Array, " m"]:
        sine, _ = _sin_cos_of_sum(self.frequency * t, self.phase)
        return self.bias + self.amplitude * sine


@pytree
@dataclass(frozen=True)
class GravityGradient(Disturbance):
    """Gravity-gradient torque 3 n^2 c x J c on a circular orbit.

    c is the unit vector to the planet in body axes, which depends on the true attitude. Wie, Space Vehicle Dynamics and
    Control (2008), eq. (6.128).
    """

    inertia: Leaf  # (3, 3) inertia J of the true body [kg m^2]
    orbit: Leaf  # (4,) quaternion of the orbit frame: z is the orbit normal, x the direction of phase 0 [-]
    rate: Leaf  # orbital rate n [rad/s]
    phase: Leaf  # orbital phase at t = 0 [rad]
    drawn: ClassVar[Mapping[str, str]] = {"phase": "phase"}

    def __call__(self, t: Scalar, x: AttitudeState) -> Float[Array, "3"]:
        sine, cosine = _sin_cos_of_sum(self.rate * t, self.phase)
        radial = jnp.stack([cosine, sine, jnp.zeros_like(sine)])
        c = attitude.rotate(attitude.multiply(attitude.conjugate(x.q), self.orbit), radial)
        return 3.0 * self.rate**2 * attitude.cross(c, self.inertia @ c)

    def on_body(self, inertia: Float[Array, "3 3"]) -> Any:
        return replace(self, inertia=inertia)


@pytree
@dataclass(frozen=True)
class Sum(Disturbance):
    """The sum of several disturbances."""

    terms: tuple[Any, ...]

    def __call__(self, t: Scalar, x: Any) -> Float[Array, " m"]:
        total = self.terms[0](t, x)
        for term in self.terms[1:]:
            total = total + term(t, x)
        return total

    def on_body(self, inertia: Float[Array, "3 3"]) -> Any:
        return Sum(tuple(on_body(term, inertia) for term in self.terms))


def terms(disturbance: Any) -> tuple[Any, ...]:
    """Return the terms of a sum, or the disturbance itself as the only term."""
    return getattr(disturbance, "terms", (disturbance,))


def _field_name(term: Any, quantity: str) -> str | None:
    """Return the name of the field with the phase or amplitude, or None. A plain function has no such field."""
    return getattr(term, "drawn", {}).get(quantity)


def _field_values(disturbance: Any, quantity: str) -> list[Any]:
    """Return the phases or amplitudes of each term that has them."""
    fields = ((term, _field_name(term, quantity)) for term in terms(disturbance))
    return [getattr(term, field) for term, field in fields if field is not None]


def count(disturbance: Any, quantity: Literal["phase", "amplitude"]) -> int:
    """Return the number of phases or amplitudes of a disturbance."""
    return sum(map(np.size, _field_values(disturbance, quantity)))


def values(disturbance: Any, quantity: Literal["phase", "amplitude"]) -> Float[Array, " count"]:
    """Return all phases [rad] or amplitudes [N m] of a disturbance, (count,), in the order of terms and inputs."""
    return jnp.concatenate([jnp.zeros(0), *map(jnp.ravel, _field_values(disturbance, quantity))])


def with_values(disturbance: Any, quantity: Literal["phase", "amplitude"], new: Float[Array, " count"]) -> Any:
    """Return the disturbance with other phases or amplitudes. Terms without them are not changed.

    Args:
        disturbance: the disturbance.
        quantity: which values to replace.
        new: new phases [rad] or amplitudes [N m], (count,), in the order of `values`.
    """
    changed, used = [], 0
    for term in terms(disturbance):
        field = _field_name(term, quantity)
        if field is not None:
            old = jnp.asarray(getattr(term, field))
            term = replace(term, **{field: new[used : used + old.size].reshape(old.shape)})
            used += old.size
        changed.append(term)
    return Sum(tuple(changed)) if hasattr(disturbance, "terms") else changed[0]


def bias(disturbance: Any, inputs: int) -> Float[Array, " m"]:
    """Return the `Bias` of a disturbance, (inputs,) [N m]; zeros if it has none."""
    last = terms(disturbance)[-1]
    return last.value if isinstance(last, Bias) else jnp.zeros(inputs)


def with_bias(disturbance: Any, value: Float[Array, " m"]) -> Sum:
    """Return the disturbance with this `Bias` (m,) [N m] instead of its previous one."""
    return Sum((*(term for term in terms(disturbance) if not isinstance(term, Bias)), Bias(value)))


def on_body(disturbance: Any, inertia: Float[Array, "3 3"]) -> Any:
    """Return the disturbance of a body with this inertia [kg m^2]. A plain function does not depend on the body."""
    return disturbance.on_body(inertia) if hasattr(disturbance, "on_body") else disturbance
