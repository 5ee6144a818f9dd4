"""Disturbances d(t, x) of (2) and (25), and functions that read or replace their phases, amplitudes and biases.

Read `Disturbance` first, the base of all disturbances and of custom ones. `Sum` adds several of them.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ptsmc_jax.declare import Scaled, number
from ptsmc_jax.numerics import attitude, elementary
from ptsmc_jax.numerics.pytrees import Leaf, Scalar, pytree
from ptsmc_jax.plants.base import State
from ptsmc_jax.plants.rigid_body import AttitudeState
from ptsmc_jax.signals.orbits import Orbit


@dataclass(frozen=True)
class Disturbance:
    """Base of the disturbances, and of custom ones: a function of time and of the state of the true plant."""

    def __call__(self, t: Scalar, x: State) -> Float[Array, " m"]:
        """Return the disturbance (m,) [N m] at the time t [s] in the state x."""
        raise NotImplementedError

    # name of the field that a dispersion of the quantity "phase" or "amplitude" changes
    drawn: ClassVar[Mapping[str, str]] = {}

    def fastest(self) -> float:
        """Return the largest angular frequency [rad/s], for the choice of the integration step. 0: no limit."""
        return 0.0

    def impulse(self, end: float) -> float:
        """Return a bound on the disturbance's integral until `end` [s], in N m s; 0: the disturbance is neglected."""
        return 0.0

    def bounds(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Return the largest size and rate of each component (m,) [N m, N m/s]; None: they are not known."""
        return None

    def on_body(self, inertia: Float[Array, "3 3"]) -> "Disturbance":
        """Return the disturbance of a body with this inertia [kg m^2]."""
        return self


@pytree
@dataclass(frozen=True)
class Constant(Disturbance):
    """A constant disturbance, of a spacecraft in body axes. The value zero means no disturbance."""

    amplitude: Leaf = number(
        Scaled(0.01, inertia=1, order=-1, each=True), unit="unit of d", each=True,
        meaning="of each component; default: 0.01 each, scaled to the mission",
    )  # fmt: skip
    drawn: ClassVar[Mapping[str, str]] = {"amplitude": "amplitude"}

    def __call__(self, t: Scalar, x: State = None) -> Float[Array, " m"]:
        """Return the disturbance at t [s], (m,) [N m]."""
        return self.amplitude

    def impulse(self, end: float) -> float:
        """Return |amplitude| times the duration [N m s]."""
        return float(np.linalg.norm(np.abs(self.amplitude) * end))

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Return its size (m,) [N m], and a rate of zero."""
        size = np.abs(self.amplitude)
        return size, np.zeros_like(size)


@pytree
@dataclass(frozen=True)
class Bias(Constant):
    """A constant that `with_bias` adds to the disturbance of a scenario. Dispersions of amplitudes do not change it."""

    drawn: ClassVar[Mapping[str, str]] = {}


def _sin_cos_of_sum(angle: Array, phase: Leaf) -> tuple[Array, Array]:
    """Return sin and cos of angle + phase by the addition theorems.

    If phases differ by trial, all trials of a batch use the same sin and cos of the angle, and the sin and cos of the
    phases are computed only once.
    """
    turns = angle / (2.0 * np.pi)
    cosine, sine = elementary.cos_sin_turns(turns - jnp.floor(turns))  # vector arithmetic if times differ by trial
    sine_0, cosine_0 = jnp.sin(phase), jnp.cos(phase)
    return sine * cosine_0 + cosine * sine_0, cosine * cosine_0 - sine * sine_0


@pytree
@dataclass(frozen=True)
class Sinusoid(Disturbance):
    """The disturbance bias + amplitude sin(frequency t + phase) of each component, of a spacecraft in body axes."""

    amplitude: Leaf = number(
        Scaled(0.01, inertia=1, order=-1, each=True), unit="unit of d", each=True,
        meaning="of each component; default: 0.01 each, scaled to the mission",
    )  # fmt: skip
    frequency: Leaf = number(
        Scaled(0.1, time=-1, each=True), unit="rad/s", each=True,
        meaning="of each component; default: scaled to the mission",
    )  # fmt: skip
    phase: Leaf = number(Scaled(0.0, each=True), unit="rad", each=True, meaning="of each component")
    bias: Leaf = number(Scaled(0.0, each=True), unit="unit of d", each=True, meaning="constant part of each component")
    drawn: ClassVar[Mapping[str, str]] = {"phase": "phase", "amplitude": "amplitude"}

    def __call__(self, t: Scalar, x: State = None) -> Float[Array, " m"]:
        """Return bias + amplitude sin(frequency t + phase) at t [s], (m,) in the unit of d."""
        sine, _ = _sin_cos_of_sum(self.frequency * t, self.phase)
        return self.bias + self.amplitude * sine

    def fastest(self) -> float:
        """Return the largest angular frequency of its components [rad/s]."""
        return float(np.max(np.abs(self.frequency)))

    def impulse(self, end: float) -> float:
        """Return a bound on the integral: at most half a period of the sinusoid, and the constant part [N m s]."""
        effective_time = np.minimum(end, 2.0 / np.maximum(np.abs(self.frequency), 1e-12))
        return float(np.linalg.norm(np.abs(self.amplitude) * effective_time) + np.linalg.norm(self.bias) * end)

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Return |bias| + |amplitude| and |amplitude frequency| of each component (m,) [N m, N m/s], at any phase."""
        size = np.abs(self.amplitude)
        return np.abs(self.bias) + size, size * np.abs(self.frequency)


@pytree
@dataclass(frozen=True)
class GravityGradient(Disturbance):
    """The gravity gradient torque on the true body, on the orbit of [orbit] or else on a circular orbit.

    The torque is 3 n^2 c x J c, with the unit vector c to the planet in body axes, which depends on the true attitude
    (Wie, Space Vehicle Dynamics and Control, 2008, eq. (6.128)). The attitude key defines the frame of the circular
    orbit: z is the orbit normal, and x is the direction in which the phase is zero.
    """

    inertia: Leaf  # (3, 3) inertia of the true body [kg m^2]
    orbit: Leaf  # (4,) quaternion of the orbit frame: z is the orbit normal, x the direction of phase zero
    orbit_rate: Leaf = number(
        None, above=0.0, at_most=1.0, unit="rad/s", meaning="mean motion n; default: 1.1e-3, or of [orbit]"
    )
    phase: Leaf = number(0.0, unit="rad", meaning="angle on the orbit at t = 0; 0 with [orbit]")
    drawn: ClassVar[Mapping[str, str]] = {"phase": "phase"}

    def __call__(self, t: Scalar, x: AttitudeState) -> Float[Array, "3"]:
        """Return the torque at t [s] in the state x, (3,) [N m]."""
        sine, cosine = _sin_cos_of_sum(self.orbit_rate * t, self.phase)
        radial = jnp.stack([cosine, sine, jnp.zeros_like(sine)])
        c = attitude.rotate(attitude.multiply(attitude.conjugate(x.q), self.orbit), radial)
        return 3.0 * self.orbit_rate**2 * attitude.cross(c, self.inertia @ c)

    def on_body(self, inertia: Float[Array, "3 3"]) -> "Disturbance":
        return replace(self, inertia=inertia)


@pytree
@dataclass(frozen=True)
class KeplerGravityGradient(Disturbance):
    """The gravity gradient torque on a Keplerian orbit, 3 mu / r^3 c x J c.

    c is the unit vector to the planet in body axes.
    """

    inertia: Leaf  # (3, 3) inertia of the true body [kg m^2]
    orbit: Orbit

    def __call__(self, t: Scalar, x: AttitudeState) -> Float[Array, "3"]:
        """Return the torque at t [s] in the state x, (3,) [N m]."""
        position = self.orbit(t)
        c = -attitude.rotate(attitude.conjugate(x.q), position.radial)
        strength = 3.0 * self.orbit.rate() ** 2 * (self.orbit.semi_major_axis / position.radius) ** 3
        return strength * attitude.cross(c, self.inertia @ c)

    def on_body(self, inertia: Float[Array, "3 3"]) -> "Disturbance":
        return replace(self, inertia=inertia)


@dataclass(frozen=True)
class RandomWalk(Disturbance):
    """A random walk from zero, with a new step each control period. It needs the sampled loop."""

    density: Leaf = number(
        Scaled(1e-4, inertia=1, time=-0.5, order=-1, each=True), at_least=0.0, unit="unit of d/sqrt(s)", each=True,
        meaning="noise density of each component; default: 1e-4 each, scaled to the mission",
    )  # fmt: skip


@pytree
@dataclass(frozen=True)
class Sum(Disturbance):
    """The sum of several disturbances."""

    terms: tuple[Any, ...]

    def __call__(self, t: Scalar, x: State) -> Float[Array, " m"]:
        """Return the sum (m,) of all terms at t [s] in the state x, in the plant's input unit."""
        total = self.terms[0](t, x)
        for term in self.terms[1:]:
            total = total + term(t, x)
        return total

    def on_body(self, inertia: Float[Array, "3 3"]) -> "Disturbance":
        return Sum(tuple(on_body(term, inertia) for term in self.terms))


def terms(disturbance: Callable) -> tuple[Any, ...]:
    """Return the terms of a sum, or the disturbance itself as the only term."""
    return disturbance.terms if isinstance(disturbance, Sum) else (disturbance,)


def _field_name(term: object, quantity: str) -> str | None:
    """Return the name of the field with the phase or amplitude, or None. A plain function has no such field."""
    return getattr(term, "drawn", {}).get(quantity)


def values(disturbance: Callable, quantity: Literal["phase", "amplitude"]) -> Float[Array, " count"]:
    """Return all phases [rad] or amplitudes [N m] of a disturbance, (count,), in the order of terms and inputs."""
    fields = ((term, _field_name(term, quantity)) for term in terms(disturbance))
    found = [jnp.ravel(getattr(term, field)) for term, field in fields if field is not None]
    return jnp.concatenate([jnp.zeros(0), *found])


def with_values(disturbance: Any, quantity: Literal["phase", "amplitude"], new_values: Float[Array, " count"]) -> Any:
    """Return the disturbance with other phases or amplitudes. Terms without them are not changed.

    Args:
        disturbance: the disturbance.
        quantity: which values to replace.
        new_values: new phases [rad] or amplitudes [N m], (count,), in the order of `values`.
    """
    changed, offset = [], 0
    for term in terms(disturbance):
        field = _field_name(term, quantity)
        if field is not None:
            old = jnp.asarray(getattr(term, field))
            term = replace(term, **{field: new_values[offset : offset + old.size].reshape(old.shape)})
            offset += old.size
        changed.append(term)
    return Sum(tuple(changed)) if isinstance(disturbance, Sum) else changed[0]


def bias(disturbance: Callable, inputs: int) -> Float[Array, " m"]:
    """Return the `Bias` of a disturbance, (inputs,) [N m]; zeros if it has none."""
    last = terms(disturbance)[-1]
    return last.amplitude if isinstance(last, Bias) else jnp.zeros(inputs)


def with_bias(disturbance: Callable, value: Float[Array, " m"]) -> Sum:
    """Return the disturbance with this `Bias` (m,) [N m] instead of its previous one."""
    return Sum((*(term for term in terms(disturbance) if not isinstance(term, Bias)), Bias(value)))


def on_body(disturbance: Any, inertia: Float[Array, "3 3"]) -> Any:
    """Return the disturbance of a body with this inertia [kg m^2]. A plain function does not depend on the body."""
    return disturbance.on_body(inertia) if hasattr(disturbance, "on_body") else disturbance
