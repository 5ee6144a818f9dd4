"""Laws to compare with: quaternion PD, nonsingular terminal and fixed-time sliding mode, on the error quaternion.

Written for the multiplicative error of `controllers.ErrorQuaternion`: v'' = alpha is what the sliding modes ask for,

    u = w x J w - d_hat + J (R w_f' - w_e x R w_f) + J T(q_e)^-1 (2 alpha + |w_e|^2 v / 2),

and K of theirs is |T J^-1| K2 / 2, as in the paper's law: the same observer, the same bound, the same smooth sign. None
has a hand-over or a prescribed time; t_f is when they are judged. They fly in the sampled loop.
"""

from dataclasses import dataclass
from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ptsmc_jax import numerics
from ptsmc_jax.controllers import ErrorQuaternion
from ptsmc_jax.laws import Law
from ptsmc_jax.numerics import Leaf, pytree
from ptsmc_jax.plants import AttitudeState, Spacecraft
from ptsmc_jax.signals import Target

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
        return numerics.smooth_sign(s, self.sign_width)  # pyright: ignore[reportAttributeAccessIssue]


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
    free: ClassVar[tuple[str, ...]] = ("k_p", "k_d", "t_f")

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


@pytree
@dataclass(frozen=True)
class Terminal(Baseline):
    """s = v + sig^p(v')/b, alpha = -(b/p) sig^(2-p)(v') - k s - K sign(s), with sig^a(x) = sign(x) |x|^a, 1 < p < 2.

    Feng, Yu, Man, Non-singular terminal sliding mode control of rigid manipulators, Automatica 38(12), 2002. On s = 0 a
    component is at zero after |v|^(1 - 1/p) p / ((p - 1) b^(1/p)), the later the farther it starts.
    """

    p: Leaf  # [-]
    b: Leaf  # [1/s^p]
    k: Leaf  # [1/s^2]
    sign_width: Leaf
    free: ClassVar[tuple[str, ...]] = ("p", "b", "k", "sign_width", "t_f")

    def surface(self, v: Vector, v_dot: Vector) -> tuple[Vector, Vector]:
        """As the class says, without K sign(s)."""
        s = v + numerics.signed_power(v_dot, self.p) / self.b
        return s, -self.b / self.p * numerics.signed_power(v_dot, 2.0 - self.p) - self.k * s


@pytree
@dataclass(frozen=True)
class FixedTime(Baseline):
    """s = v + sig^p(v'/kappa), kappa = a1 |v|^(gamma-1/p) + b1; 1 < p < 2, gamma - 1/p > 1, m > 1 > n > 0.

    alpha = kappa' v'^2/kappa - (kappa^p/p) (sig^(2-p)(v') + a2 sig^m(s) + b2 sig^n(s)) - K sign(s). Surface: Zuo,
    Non-singular fixed-time terminal sliding mode control of non-linear systems, IET Control Theory and Applications
    9(4), 2015; for attitudes Jiang, Hu, Friswell, IEEE Trans. Control Systems Technology 24(5), 2016. On s = 0 a
    component obeys v' = -a1 sig^gamma(v) - b1 sig^(1/p)(v): at zero before 1/(a1 (gamma-1)) + p/(b1 (p-1)), wherever it
    starts.
    """

    a1: Leaf  # [1/s]
    b1: Leaf  # [1/s]
    a2: Leaf  # [1/s^(2-p)]
    b2: Leaf  # [1/s^(2-p)]
    p: Leaf
    gamma: Leaf
    m: Leaf
    n: Leaf
    sign_width: Leaf
    free: ClassVar[tuple[str, ...]] = ("a1", "b1", "a2", "b2", "p", "gamma", "m", "n", "sign_width", "t_f")

    def surface(self, v: Vector, v_dot: Vector) -> tuple[Vector, Vector]:
        """As the class says, without K sign(s)."""
        bend = self.gamma - 1.0 / self.p
        kappa = self.a1 * numerics.signed_power(jnp.abs(v), bend) + self.b1
        kappa_slope = self.a1 * bend * numerics.signed_power(v, bend - 1.0)
        s = v + numerics.signed_power(v_dot / kappa, self.p)
        pull = numerics.signed_power(v_dot, 2.0 - self.p)
        pull = pull + self.a2 * numerics.signed_power(s, self.m) + self.b2 * numerics.signed_power(s, self.n)
        return s, kappa_slope * v_dot * v_dot / kappa - numerics.signed_power(kappa, self.p) / self.p * pull
