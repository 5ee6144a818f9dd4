"""PD."""

from dataclasses import dataclass
from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Bool

from ptsmc_jax.laws.acceleration import AccelerationLaw
from ptsmc_jax.laws.base import Law, Sample
from ptsmc_jax.laws.error_motions import ErrorQuaternion
from ptsmc_jax.numerics.pytrees import Leaf, Scalar, Vector, pytree
from ptsmc_jax.plants.rigid_body import AttitudeState, Spacecraft
from ptsmc_jax.signals.references import Target


@pytree
@dataclass(frozen=True)
class QuaternionPD(ErrorQuaternion, Law):
    """u = w x J w - d_hat + J (R w_f' - w_e x R w_f) - k_p J v - k_d J w_e.

    Wie, Weiss, Arapostathis, Quaternion feedback regulator for spacecraft eigenaxis rotations, J. Guidance, Control,
    and Dynamics 12(3), 1989, with the reference's motion fed forward. It has no singularity and no switching term; the
    angle to go then follows theta'' + k_d theta' + k_p sin(theta/2) = 0 about the eigenaxis.
    """

    model: Spacecraft  # the nominal plant
    t_f: Leaf  # when the error is judged [s]
    delta: Leaf  # a sample of the anchored clock falls on t_f - delta, as it does for the paper's law [s]
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
        q_e, w_e, feedforward = self.relative(x, target)
        w_dot = feedforward - self.k_p * q_e[:3] - self.k_d * w_e
        u = self.model.gyroscopic(x.w) - d_hat + self.model.inertia @ w_dot
        return u, q_e[:3] + self.k_d / self.k_p * w_e


@dataclass(frozen=True)
class PD(AccelerationLaw):
    """a = -k_p eps - k_d eps'; its s is eps + (k_d/k_p) eps'."""

    k_p: Leaf  # [1/s^2]
    k_d: Leaf  # [1/s]
    tunable: ClassVar[tuple[str, ...]] = ("k_p", "k_d", "t_f")

    def acceleration(self, now: Sample, error: Vector, error_rate: Vector, bound: Scalar) -> tuple[Vector, Vector]:
        """As the class says, (m,) each."""
        return -self.k_p * error - self.k_d * error_rate, error + self.k_d / self.k_p * error_rate
