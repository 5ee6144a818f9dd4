"""Control laws. Here: the paper's prescribed-time sliding mode law for the spacecraft, (56), (57), (59), (60)."""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ptsmc_jax import attitude, numerics
from ptsmc_jax.numerics import Leaf
from ptsmc_jax.plants import AttitudeState, Spacecraft
from ptsmc_jax.signals import Target

Scalar = Float[Array, ""]
Vector = Float[Array, "3"]


class SurfaceGains(NamedTuple):
    """What both phases of the law share: s = c eps' + e eps, desired 2 eps'' = -a eps' - b s - switching."""

    c: Array  # [s]
    e: Array  # [-]
    a: Array  # [1/s]
    b: Array  # [1/s^2] before the hand-over, [1/s] after


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class PrescribedTime:
    """Disturbance-observer based law on the additive error eps_1 = q_1 - q_1f (4), handed over at t_f - delta.

    Differences from the paper: sign(s) is tanh(s / sign_width) (0: exact); `T` of (1) is both torque and matrix, here
    the torque is u; ||T J^-1||, whose norm the paper leaves open, is the Frobenius norm, which is smooth and not below
    the spectral norm that the proof needs; K1 acts with an effective gain of K1/2 in (60). The law is singular at
    q4 = 0, 180 degrees from the inertial frame's identity wherever the reference is, and cannot cross it: `align`
    chooses the sign of q, `clearance` says how far away the singularity is.
    """

    model: Spacecraft  # the nominal plant
    t_f: Leaf  # prescribed time [s]
    eta: Leaf  # eta > 2 [-]
    delta: Leaf  # hand-over this long before t_f, Remark 1 [s]
    k1: Leaf  # K1 of (60) [1/s]
    sign_width: Leaf  # boundary layer of the smooth sign, in the units of s [-]

    @property
    def hand_over(self) -> Scalar:
        """t_s = t_f - delta [s]."""
        return self.t_f - self.delta

    def align(self, x: AttitudeState, target: Target) -> AttitudeState:
        """The same attitude with the sign of q for which q4 q_f4 >= 0: the law cannot cross q4 = 0."""
        opposite = x.q[3] * target.q[3] < 0.0
        return AttitudeState(jnp.where(opposite, -x.q, x.q), x.w)

    def clearance(self, x: AttitudeState, target: Target) -> Scalar:
        """q4 counted positive on the reference's side [-]: at 0 the law is singular, beyond it cannot come back."""
        return jnp.where(target.q[3] < 0.0, -x.q[3], x.q[3])

    def errors(self, x: AttitudeState, target: Target) -> tuple[Vector, Vector]:
        """eps_1 [-] and its derivative [1/s], (4)."""
        reference_rate, _ = target.vector_rates()
        v_dot, _ = attitude.vector_rates(x.q, x.w, jnp.zeros(3))
        return x.q[:3] - target.q[:3], v_dot - reference_rate

    def angle(self, x: AttitudeState, target: Target) -> Scalar:
        """Angle between the attitude and its reference [rad]."""
        return attitude.angle(x.q, target.q)

    def gains(self, t: Scalar, hold: Bool[Array, ""]) -> SurfaceGains:
        """Gains of the surfaces (56) and (59) and of the laws (57) and (60) at t [s]; `hold`: after the hand-over."""
        tau = jnp.where(hold, 1.0, self.t_f - t)  # guarded: t_f - t may be 0 in hold
        return SurfaceGains(
            c=tau,
            e=jnp.where(hold, 1.0, self.eta),
            a=jnp.where(hold, 2.0, 2.0 * (self.eta - 1.0) / tau),
            b=jnp.where(hold, self.k1, 2.0 * self.eta / tau**2),
        )

    def torque(
        self, t: Scalar, hold: Bool[Array, ""], x: AttitudeState, target: Target, d_hat: Vector, k2: Scalar
    ) -> tuple[Vector, Vector]:
        """Commanded torque [N m] by (57) before and (60) after the hand-over, and the sliding variable s (56), (59).

        d_hat: estimated disturbance [N m]; k2: K2, bound on the 2-norm of its error [N m].
        """
        gains = self.gains(t, hold)
        error, error_rate = self.errors(x, target)
        s = gains.c * error_rate + gains.e * error
        _, reference_acceleration = target.vector_rates()
        t_dot_w = -0.5 * jnp.dot(x.w, x.w) * x.q[:3]  # T'(q) w of (58)
        switching = numerics.norm(attitude.t_matrix(x.q) @ self.model.inertia_inverse) * k2
        wanted = (
            2.0 * reference_acceleration
            - t_dot_w
            - switching * numerics.smooth_sign(s, self.sign_width)
            - gains.a * error_rate
            - gains.b * s
        )
        u = self.model.gyroscopic(x.w) - d_hat + self.model.inertia @ attitude.t_inverse_times(x.q, wanted)
        return u, s
