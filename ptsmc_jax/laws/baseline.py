"""Laws to compare with: quaternion PD, nonsingular terminal and fixed-time sliding mode, on the error quaternion.

Written for the multiplicative error of `ErrorQuaternion`: v'' = alpha is what the sliding modes ask for,

    u = w x J w - d_hat + J (R w_f' - w_e x R w_f) + J T(q_e)^-1 (2 alpha + |w_e|^2 v / 2),

and K of theirs is |T J^-1| K2 / 2, as in the paper's law: the same observer, the same bound, the same smooth sign. None
has a hand-over or a prescribed time; t_f is when they are judged. They fly in the sampled loop.
"""

from dataclasses import dataclass

from jaxtyping import Array, Bool, Float

from ptsmc_jax.laws.base import Law
from ptsmc_jax.laws.error_quaternion import ErrorQuaternion
from ptsmc_jax.numerics import guards
from ptsmc_jax.numerics.pytrees import Leaf
from ptsmc_jax.plants.rigid_body import AttitudeState, Spacecraft
from ptsmc_jax.signals.references import Target

Scalar = Float[Array, ""]
Vector = Float[Array, " m"]


@dataclass(frozen=True)
class Baseline(ErrorQuaternion, Law):
    """What the laws here share."""

    model: Spacecraft  # the nominal plant
    t_f: Leaf  # when the error is judged [s]
    delta: Leaf  # a sample of the anchored clock falls on t_f - delta, as it does for the paper's law [s]

    def torque(
        self, t: Scalar, hold: Bool[Array, ""], x: AttitudeState, target: Target, d_hat: Vector, k2: Scalar
    ) -> tuple[Vector, Vector]:
        """Torque [N m] and sliding variable, (3,) each; d_hat: estimated disturbance, k2: bound on its error."""
        error, error_rate = self.errors(x, target)
        s, known = self.surface(error, error_rate)
        switching = 0.5 * self.influence(x, target) * k2 * self.sign(s)
        return self.invert(x, target, 2.0 * (known - switching), d_hat), s

    def surface(self, v: Vector, v_dot: Vector) -> tuple[Vector, Vector]:
        """Sliding variable s, and v'' [1/s^2] without what switches, (3,) each."""
        raise NotImplementedError

    def sign(self, s: Vector) -> Vector:
        """Smooth sign tanh(s / sign_width) [-]; the exact one for a width of 0."""
        return guards.smooth_sign(s, self.sign_width)  # pyright: ignore[reportAttributeAccessIssue]
