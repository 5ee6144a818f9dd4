"""Disturbances d(t, x) of (2) and (25), alone or summed."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ptsmc_jax.numerics import attitude
from ptsmc_jax.numerics.pytrees import Leaf, pytree
from ptsmc_jax.plants.rigid_body import AttitudeState

Time = Float[Array, ""]


@dataclass(frozen=True)
class Disturbance:
    """The base of a disturbance of one's own: a function of time and of the true state."""

    def __call__(self, t: Time, x: Any) -> Float[Array, " m"]:
        """Disturbance at t [s] in the state x, (m,) [N m]."""
        raise NotImplementedError

    drawn: ClassVar[Mapping[str, str]] = {}  # "phase", "amplitude" -> the field that holds what a dispersion draws

    def fastest(self) -> float:
        """Its largest angular frequency [rad/s], which the integration steps follow; 0: slower than all else."""
        return 0.0

    def on_body(self, inertia: Float[Array, "3 3"]) -> Any:
        """The disturbance as it acts on a body of this inertia [kg m^2]."""
        return self


@pytree
@dataclass(frozen=True)
class Constant(Disturbance):
    """A constant disturbance; zero serves as none."""

    value: Leaf  # (m,) [N m]
    drawn: ClassVar[Mapping[str, str]] = {"amplitude": "value"}

    def __call__(self, t: Time, x: Any = None) -> Float[Array, " m"]:
        """Disturbance at t [s], (m,) [N m]."""
        return self.value


@pytree
@dataclass(frozen=True)
class Bias(Constant):
    """A constant that is added to the disturbance of a scenario, see `with_bias`; it is not among the amplitudes."""

    drawn: ClassVar[Mapping[str, str]] = {}


def _shifted(angle: Array, phase: Any) -> tuple[Array, Array]:
    """Return sin and cos of angle + phase.

    In a batch of trials with drawn phases, sin and cos of the angle are shared, and those of the phase are constant.
    """
    sine, cosine = jnp.sin(angle), jnp.cos(angle)
    sine_0, cosine_0 = jnp.sin(phase), jnp.cos(phase)
    return sine * cosine_0 + cosine * sine_0, cosine * cosine_0 - sine * sine_0


@pytree
@dataclass(frozen=True)
class Sinusoid(Disturbance):
    """bias + amplitude sin(frequency t + phase), per axis."""

    amplitude: Leaf  # (m,) [N m]
    frequency: Leaf  # (m,) [rad/s]
    phase: Leaf  # (m,) [rad]
    bias: Leaf  # (m,) [N m]
    drawn: ClassVar[Mapping[str, str]] = {"phase": "phase", "amplitude": "amplitude"}

    def __call__(self, t: Time, x: Any = None) -> Float[Array, " m"]:
        """Disturbance at t [s], (m,) [N m]."""
        swing, _ = _shifted(self.frequency * t, self.phase)
        return self.bias + self.amplitude * swing


@pytree
@dataclass(frozen=True)
class GravityGradient(Disturbance):
    """Gravity-gradient torque on a circular orbit, 3 n^2 c x J c, c the unit vector to the planet in body axes.

    Wie, Space Vehicle Dynamics and Control (2008), eq. (6.128). It depends on the true attitude.
    """

    inertia: Leaf  # (3, 3) of the true body [kg m^2]
    orbit: Leaf  # (4,) quaternion of the orbit's frame: z along its normal, x to where the phase counts from
    rate: Leaf  # n [rad/s]
    phase: Leaf  # of the body at t = 0 [rad]
    drawn: ClassVar[Mapping[str, str]] = {"phase": "phase"}

    def __call__(self, t: Time, x: AttitudeState) -> Float[Array, "3"]:
        """Torque at t [s] in the state x, (3,) [N m]."""
        sine, cosine = _shifted(self.rate * t, self.phase)
        radial = jnp.stack([cosine, sine, jnp.zeros_like(sine)])
        c = attitude.rotate(attitude.multiply(attitude.conjugate(x.q), self.orbit), radial)
        return 3.0 * self.rate**2 * attitude.cross(c, self.inertia @ c)

    def on_body(self, inertia: Float[Array, "3 3"]) -> Any:
        """The gravity gradient on another body [kg m^2]."""
        return replace(self, inertia=inertia)


@pytree
@dataclass(frozen=True)
class Sum(Disturbance):
    """The sum of several disturbances."""

    terms: tuple[Any, ...]

    def __call__(self, t: Time, x: Any) -> Float[Array, " m"]:
        """Disturbance at t [s] in the state x, (m,) [N m]."""
        total = self.terms[0](t, x)
        for term in self.terms[1:]:
            total = total + term(t, x)
        return total

    def on_body(self, inertia: Float[Array, "3 3"]) -> Any:
        """Each term on that body [kg m^2]."""
        return Sum(tuple(on_body(term, inertia) for term in self.terms))


def terms(disturbance: Any) -> tuple[Any, ...]:
    """The terms of a sum of disturbances; of another disturbance itself alone."""
    return getattr(disturbance, "terms", (disturbance,))


def _drawn_field(term: Any, what: str) -> str | None:
    """The field of a term that holds its phase or amplitude; None where it has none, or is a plain function."""
    return getattr(term, "drawn", {}).get(what)


def _drawn(disturbance: Any, what: str) -> list[Any]:
    """The phases or amplitudes of each term that has some."""
    fields = ((term, _drawn_field(term, what)) for term in terms(disturbance))
    return [getattr(term, field) for term, field in fields if field is not None]


def count(disturbance: Any, what: Literal["phase", "amplitude"]) -> int:
    """How many phases or amplitudes a disturbance has."""
    return sum(map(np.size, _drawn(disturbance, what)))


def values(disturbance: Any, what: Literal["phase", "amplitude"]) -> Float[Array, " count"]:
    """Every phase [rad] or amplitude [N m] of a disturbance, (count,): term after term, input after input."""
    return jnp.concatenate([jnp.zeros(0), *map(jnp.ravel, _drawn(disturbance, what))])


def with_values(disturbance: Any, what: Literal["phase", "amplitude"], new: Float[Array, " count"]) -> Any:
    """The disturbance with these phases [rad] or amplitudes [N m], as `values` gives them; what has none stays."""
    changed, used = [], 0
    for term in terms(disturbance):
        field = _drawn_field(term, what)
        if field is not None:
            old = jnp.asarray(getattr(term, field))
            term = replace(term, **{field: new[used : used + old.size].reshape(old.shape)})
            used += old.size
        changed.append(term)
    return Sum(tuple(changed)) if hasattr(disturbance, "terms") else changed[0]


def bias(disturbance: Any, inputs: int) -> Float[Array, " m"]:
    """The `Bias` of a disturbance, (m,) [N m]; zero where it has none."""
    last = terms(disturbance)[-1]
    return last.value if isinstance(last, Bias) else jnp.zeros(inputs)


def with_bias(disturbance: Any, value: Float[Array, " m"]) -> Sum:
    """The disturbance with this `Bias` added, (m,) [N m], in place of the one before."""
    return Sum((*(term for term in terms(disturbance) if not isinstance(term, Bias)), Bias(value)))


def on_body(disturbance: Any, inertia: Float[Array, "3 3"]) -> Any:
    """The disturbance as it acts on a body of this inertia [kg m^2]; a plain function acts alike on all."""
    return disturbance.on_body(inertia) if hasattr(disturbance, "on_body") else disturbance
