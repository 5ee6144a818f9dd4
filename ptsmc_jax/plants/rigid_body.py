"""The rigid spacecraft of (1), (2), with reaction wheels."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.typing import ArrayLike
from jaxtyping import Array, Float, PyTree

from ptsmc_jax.formulas import check_inertia
from ptsmc_jax.numerics import attitude, guards, matrices
from ptsmc_jax.numerics.pytrees import Leaf, Scalar, pytree, vector
from ptsmc_jax.plants.base import Chart, Plant


class AttitudeState(NamedTuple):
    """State of a spacecraft. Sensors and laws know its attitude and rate only."""

    q: Array  # (4,) unit quaternion, scalar last, body relative to inertial [-]
    w: Array  # (3,) body rate in body axes [rad/s]
    modes: Any = None  # modal coordinates of a flexible body, see `flexible_body.Modes`


@pytree
@dataclass(frozen=True)
class Spacecraft(Plant):
    """Rigid spacecraft, J w' = -w x J w + u + d (2); build it with `spacecraft`, which checks the inertia."""

    input_name: ClassVar[str] = "torque"
    input_unit: ClassVar[str] = "N m"
    signals: ClassVar[dict[str, str]] = {
        "attitude": "unit quaternion, scalar last, body relative to inertial [-]",
        "rate": "of the body in body axes [rad/s]",
    }
    largest_measurement: ClassVar[float] = 1e6
    error_rounding: ClassVar[float] = 4.0  # the largest measured value is 1.5
    charts: ClassVar[tuple[Chart, ...]] = (
        Chart("attitude", "Attitude", "quaternion component [-]", "q", with_reference=True),
        Chart("rate", "Body rate", "rate [rad/s]", "w"),
    )
    inertia: Leaf  # (3, 3) J [kg m^2]
    inertia_inverse: Leaf  # (3, 3) [1/(kg m^2)], computed once, so that the loop solves no equations

    def gyroscopic(self, w: Float[Array, "3"]) -> Float[Array, "3"]:
        """Return the torque w x J w [N m]."""
        return attitude.cross(w, self.inertia @ w)

    def velocity(self, x: AttitudeState) -> Float[Array, "3"]:
        """Return the rate w [rad/s] of a state, or w' [rad/s^2] of a derivative of a state."""
        return x.w

    def generalised_force(self, t: Scalar, x: AttitudeState, u: Float[Array, "3"]) -> Float[Array, "3"]:
        """Return J w' without the disturbance, u - w x J w [N m]."""
        return u - self.gyroscopic(x.w)

    def rate(self, t: Scalar, x: AttitudeState, u: Float[Array, "3"], disturbance: Float[Array, "3"]) -> AttitudeState:
        """Return the time derivative of the state under torque and disturbance [N m], (1) and (2)."""
        w_dot = self.inertia_inverse @ (u + disturbance - self.gyroscopic(x.w))
        return AttitudeState(attitude.derivative(x.q, x.w), w_dot)

    def input_for(
        self, t: Scalar, x: AttitudeState, w_dot: Float[Array, "3"], d: Float[Array, "3"]
    ) -> Float[Array, "3"]:
        """Return the torque J w' + w x J w - d [N m]."""
        return self.inertia @ w_dot + self.gyroscopic(x.w) - d

    @property
    def input_labels(self) -> list[str]:
        """The body axes."""
        return ["x", "y", "z"]

    @property
    def state_shapes(self) -> dict[str, tuple[int, ...]]:
        """Attitude and rate."""
        return {"q": (4,), "w": (3,)}

    def signal_labels(self, x: AttitudeState) -> list[str]:
        """Return the names of the attitude and rate components about each body axis."""
        return [f"{name} {axis}" for name in self.signals for axis in "xyz"]

    def signals_of(self, x: AttitudeState) -> dict[str, PyTree]:
        """Return attitude (4,) [-] and rate (3,) [rad/s] by name."""
        return {"attitude": x.q, "rate": x.w}

    def state_of(self, signals: Mapping[str, PyTree]) -> AttitudeState:
        """Return the state with this attitude [-] and rate [rad/s]."""
        return AttitudeState(signals["attitude"], signals["rate"])

    def normalise_measurement(self, measured: AttitudeState) -> AttitudeState:
        """Return the measured state with |q| = 1."""
        return measured._replace(q=attitude.unit(measured.q))

    def nearest_representation(self, x: AttitudeState, other: AttitudeState) -> AttitudeState:
        """Return the state with the sign of q that is nearer to the q of another state."""
        return x._replace(q=jnp.where(jnp.dot(x.q, other.q) < 0.0, -x.q, x.q))

    def normalise(self, x: AttitudeState) -> AttitudeState:
        """Return the state with |q| = 1."""
        return x._replace(q=attitude.normalise(x.q))

    def retract(self, x: AttitudeState, by: Float[Array, "6"]) -> AttitudeState:
        """Return the state after a small rotation in body axes [rad] and a change of its rate [rad/s]."""
        return AttitudeState(attitude.multiply(x.q, attitude.from_rotation_vector(by[:3])), x.w + by[3:])

    def local_coordinates(self, x: AttitudeState, other: AttitudeState) -> Float[Array, "6"]:
        """Return the small rotation in body axes [rad] and the change of the rate [rad/s]."""
        return jnp.concatenate([2.0 * attitude.multiply(attitude.conjugate(x.q), other.q)[:3], other.w - x.w])

    def speed(self, x: AttitudeState) -> Scalar:
        """Return |w| [rad/s]."""
        return guards.norm(x.w)

    def momentum(self, x: AttitudeState) -> Float[Array, "3"]:
        """Return the angular momentum in body axes, J w [N m s]."""
        return self.inertia @ x.w

    def is_too_fast(self, x: AttitudeState, dt: Scalar) -> Array:
        """Return whether the body turns more than 1 rad in a step of dt [s]."""
        return jnp.sum(x.w * x.w) * dt * dt > 1.0

    def with_inertia(self, inertia: Float[Array, "3 3"], inverse: Float[Array, "3 3"]) -> "Spacecraft":
        """Return the same body with another inertia [kg m^2], (3, 3), and its inverse."""
        return replace(self, inertia=inertia, inertia_inverse=inverse)

    def columns(self, x: AttitudeState) -> dict[str, ArrayLike]:
        """Return quaternion q1..q4 and body rate w1..w3 [rad/s]."""
        return {"q": x.q, "w": x.w}


def spacecraft(inertia: object) -> Spacecraft:
    """Return a spacecraft from three principal moments or a symmetric (3, 3) tensor [kg m^2].

    A traced inertia is not checked.

    Raises:
        ValueError: no rigid body can have this inertia: it is not symmetric, not positive definite, or one principal
            moment is larger than the sum of the other two.
    """
    if isinstance(inertia, Tracer):
        tensor = jnp.diag(inertia) if inertia.shape == (3,) else inertia
        return Spacecraft(tensor, matrices.solve(tensor, jnp.eye(3)))
    tensor = check_inertia(inertia)
    return Spacecraft(vector(tensor), vector(np.linalg.inv(tensor)))
