"""Quaternion PD."""

from dataclasses import dataclass
from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ptsmc_jax.laws.baseline import Baseline
from ptsmc_jax.numerics.pytrees import Leaf, pytree
from ptsmc_jax.plants.rigid_body import AttitudeState
from ptsmc_jax.signals.references import Target

Scalar = Float[Array, ""]
Vector = Float[Array, " m"]


@pytree
@dataclass(frozen=True)
class QuaternionPD(Baseline):
    """u = w x J w - d_hat + J (R w_f' - w_e x R w_f) - k_p J v - k_d J w_e.

    Wie, Weiss, Arapostathis, Quaternion feedback regulator for spacecraft eigenaxis rotations, J. Guidance, Control,
    and Dynamics 12(3), 1989, with the reference's motion fed forward. It has no singularity and no switching term; the
    angle to go then follows theta'' + k_d theta' + k_p sin(theta/2) = 0 about the eigenaxis.
    """

    k_p: Leaf  # [1/s^2]
    k_d: Leaf  # [1/s]
    tunable: ClassVar[tuple[str, ...]] = ("k_p", "k_d", "t_f")

    def clearance(self, x: AttitudeState, target: Target) -> Scalar:
        """1: it has no singularity."""
        return jnp.ones_like(self.t_f)

    def torque(
        self, t: Scalar, hold: Bool[Array, ""], x: AttitudeState, target: Target, d_hat: Vector, k2: Scalar
    ) -> tuple[Vector, Vector]:
        """Torque [N m], and v + (k_d/k_p) w_e, which it drives to zero, (3,) each."""
        q_e, w_e, _, feedforward = self.relative(x, target)
        known = feedforward - self.k_p * q_e[:3] - self.k_d * w_e
        u = self.model.gyroscopic(x.w) - d_hat + self.model.inertia @ known
        return u, q_e[:3] + self.k_d / self.k_p * w_e
