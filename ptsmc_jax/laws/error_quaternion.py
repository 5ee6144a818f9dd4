"""What the laws on the error quaternion share."""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from ptsmc_jax.numerics import attitude, guards
from ptsmc_jax.plants.rigid_body import AttitudeState
from ptsmc_jax.signals.references import Target

Scalar = Float[Array, ""]
Vector = Float[Array, " m"]


class ErrorQuaternion:
    """Laws on the vector part v of the error quaternion q_e = q_f* q, whatever the inertial frame.

    With R the rotation from the reference's axes to the body's and w_e = w - R w_f: v' = T(q_e) w_e / 2.
    """

    model: Any  # the nominal plant

    def align(self, x: AttitudeState, target: Target) -> AttitudeState:
        """The same attitude with the sign of q for which q_e4 >= 0."""
        opposite = jnp.dot(x.q, target.q) < 0.0
        return AttitudeState(jnp.where(opposite, -x.q, x.q), x.w)

    def clearance(self, x: AttitudeState, target: Target) -> Scalar:
        """q_e4 [-]: at 0, a true error of 180 degrees, the law is singular."""
        return jnp.dot(x.q, target.q)

    def angle(self, x: AttitudeState, target: Target) -> Scalar:
        """Angle between the attitude and its reference [rad]."""
        return attitude.angle(x.q, target.q)

    def relative(self, x: AttitudeState, target: Target) -> tuple[Array, Vector, Vector, Vector]:
        """Of the relative motion q_e [-], w_e, R w_f [rad/s] and (R w_f)' = R w_f' - w_e x R w_f [rad/s^2]."""
        q_e = attitude.multiply(attitude.conjugate(target.q), x.q)
        back = attitude.conjugate(q_e)
        carried = attitude.rotate(back, target.w)
        w_e = x.w - carried
        return q_e, w_e, carried, attitude.rotate(back, target.w_dot) - jnp.cross(w_e, carried)

    def errors(self, x: AttitudeState, target: Target) -> tuple[Vector, Vector]:
        """The vector part v [-] and its derivative [1/s]."""
        q_e, w_e, _, _ = self.relative(x, target)
        v_dot, _ = attitude.vector_rates(q_e, w_e, jnp.zeros(3))
        return q_e[:3], v_dot

    def influence(self, x: AttitudeState, target: Target) -> Scalar:
        """|T(q_e) J^-1| [1/(kg m^2)]."""
        q_e, *_ = self.relative(x, target)
        return guards.norm(attitude.t_matrix(q_e) @ self.model.inertia_inverse)

    def invert(self, x: AttitudeState, target: Target, wanted: Vector, d_hat: Vector) -> Vector:
        """Torque [N m] for 2 v'' = wanted [1/s^2]."""
        q_e, w_e, _, feedforward = self.relative(x, target)
        turned = attitude.t_inverse_times(q_e, wanted + 0.5 * jnp.dot(w_e, w_e) * q_e[:3])
        return self.model.gyroscopic(x.w) - d_hat + self.model.inertia @ (feedforward + turned)
