"""Laws to compare with, each of a few lines: PD, sliding modes, and prescribed time by scaling."""

from dataclasses import dataclass
from typing import ClassVar

import jax.numpy as jnp

from ptsmc_jax.laws.base import AccelerationLaw, Sample
from ptsmc_jax.laws.kinematics import MultiplicativeKinematics
from ptsmc_jax.numerics import guards
from ptsmc_jax.numerics.pytrees import Leaf, Scalar, Vector, pytree
from ptsmc_jax.plants.rigid_body import AttitudeState
from ptsmc_jax.signals.references import Target


@pytree
@dataclass(frozen=True)
class PD(AccelerationLaw):
    """a = -k_p eps - k_d eps'; its s is eps + (k_d/k_p) eps'."""

    k_p: Leaf  # [1/s^2]
    k_d: Leaf  # [1/s]
    tunable: ClassVar[tuple[str, ...]] = ("k_p", "k_d", "t_f")

    def acceleration(self, now: Sample, error: Vector, error_rate: Vector, bound: Scalar) -> tuple[Vector, Vector]:
        """Return a and s, (m,) each."""
        return -self.k_p * error - self.k_d * error_rate, error + self.k_d / self.k_p * error_rate


@pytree
@dataclass(frozen=True)
class QuaternionPD(AccelerationLaw):
    """u = w x J w - d_hat + J (R w_f' - w_e x R w_f) - k_p J v - k_d J w_e.

    Wie, Weiss, Arapostathis, Quaternion feedback regulator for spacecraft eigenaxis rotations, J. Guidance, Control,
    and Dynamics 12(3), 1989, with the reference's motion fed forward. It has no singularity and no switching term; the
    angle to go then follows theta'' + k_d theta' + k_p sin(theta/2) = 0 about the eigenaxis.
    """

    kinematics: MultiplicativeKinematics
    k_p: Leaf  # [1/s^2]
    k_d: Leaf  # [1/s]
    tunable: ClassVar[tuple[str, ...]] = ("k_p", "k_d", "t_f")

    @property
    def continuous(self) -> bool:
        """True: it has no memory."""
        return True

    def __call__(
        self, now: Sample, x: AttitudeState, target: Target, d_hat: Vector, k2: Scalar
    ) -> tuple[Vector, Vector, None]:
        """Return the torque [N m], and v + (k_d/k_p) w_e, which it drives to zero, (3,) each."""
        q_e, w_e, feedforward = self.kinematics.relative(x, target)
        w_dot = feedforward - self.k_p * q_e[:3] - self.k_d * w_e
        u = self.model.gyroscopic(x.w) - d_hat + self.model.inertia @ w_dot
        return u, q_e[:3] + self.k_d / self.k_p * w_e, None


@pytree
@dataclass(frozen=True)
class Terminal(AccelerationLaw):
    """s = v + sig^p(v')/b, alpha = -(b/p) sig^(2-p)(v') - k s - K sign(s), with sig^a(x) = sign(x) |x|^a, 1 < p < 2.

    Feng, Yu, Man, Non-singular terminal sliding mode control of rigid manipulators, Automatica 38(12), 2002. On s = 0 a
    component is at zero after |v|^(1 - 1/p) p / ((p - 1) b^(1/p)), the later the farther it starts.
    """

    p: Leaf  # [-]
    b: Leaf  # [1/s^p]
    k: Leaf  # [1/s^2]
    sign_width: Leaf
    tunable: ClassVar[tuple[str, ...]] = ("p", "b", "k", "sign_width", "t_f")

    def acceleration(self, now: Sample, error: Vector, error_rate: Vector, bound: Scalar) -> tuple[Vector, Vector]:
        """Return the acceleration, alpha, and s, (m,) each."""
        s = error + guards.signed_power(error_rate, self.p) / self.b
        equivalent = -self.b / self.p * guards.signed_power(error_rate, 2.0 - self.p) - self.k * s
        return equivalent - bound * guards.smooth_sign(s, self.sign_width), s


@pytree
@dataclass(frozen=True)
class FixedTime(AccelerationLaw):
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
    tunable: ClassVar[tuple[str, ...]] = ("a1", "b1", "a2", "b2", "p", "gamma", "m", "n", "sign_width", "t_f")

    def acceleration(self, now: Sample, error: Vector, error_rate: Vector, bound: Scalar) -> tuple[Vector, Vector]:
        """Return the acceleration, alpha, and s, (m,) each."""
        bend = self.gamma - 1.0 / self.p
        kappa = self.a1 * guards.signed_power(jnp.abs(error), bend) + self.b1
        kappa_slope = self.a1 * bend * guards.signed_power(error, bend - 1.0)
        s = error + guards.signed_power(error_rate / kappa, self.p)
        reaching = guards.signed_power(error_rate, 2.0 - self.p)
        reaching = reaching + self.a2 * guards.signed_power(s, self.m) + self.b2 * guards.signed_power(s, self.n)
        bending = kappa_slope * error_rate * error_rate / kappa
        equivalent = bending - guards.signed_power(kappa, self.p) / self.p * reaching
        return equivalent - bound * guards.smooth_sign(s, self.sign_width), s


@pytree
@dataclass(frozen=True)
class Scaling(AccelerationLaw):
    """a = -2 p eps'/r - p (p+1) eps/r^2 - k1 (eps' + p eps/r) - k z, p = 2 + m, r = t_f - t, from r = delta on held.

    z = mu (eps' + (p/r + k1) eps) with mu = (t_f/r)^p is xi' + k1 xi of the scaled error xi = mu eps, and the law is
    z' = mu (-k z + d): |z| stays below the larger of |d|/k and what it began with, while eps falls like r^p. Song,
    Wang, Holloway, Krstic, Time-varying feedback for regulation of normal-form nonlinear systems in prescribed finite
    time, Automatica 83, 2017. Its gains grow without bound toward t_f: those of r = delta are held, which makes a PD.
    """

    m: Leaf  # >= 1 [-]
    k1: Leaf  # [1/s]
    k: Leaf  # [1/s]
    tunable: ClassVar[tuple[str, ...]] = ("m", "k1", "k", "delta", "t_f")

    def acceleration(self, now: Sample, error: Vector, error_rate: Vector, bound: Scalar) -> tuple[Vector, Vector]:
        """Return a, and z / mu for a sliding variable [1/s], (m,) each."""
        p, r = 2.0 + self.m, jnp.where(now.hold, self.delta, self.t_f - now.t)
        s = error_rate + (p / r + self.k1) * error
        steady = 2.0 * p / r * error_rate + p * (p + 1.0) / r**2 * error + self.k1 * (error_rate + p / r * error)
        return -steady - self.k * (self.t_f / r) ** p * s, s


def phi(x: Vector, q: Scalar, settling: Scalar) -> Vector:
    """Phi = pi/(2 q T) (sig^(1+q)(x) + sig^(1-q)(x)) [1/s]: x' = -Phi is at zero after T [s], wherever it starts."""
    return jnp.pi / (2.0 * q * settling) * (guards.signed_power(x, 1.0 + q) + guards.signed_power(x, 1.0 - q))


@pytree
@dataclass(frozen=True)
class PredefinedTime(AccelerationLaw):
    """s = eps' + sig^(1/2)(sig^2(eps') + 2 sig^2(Phi_1(eps))), a = -Phi_2(s) - (K + 2 Phi_1 Phi_1'(eps)) sign(s).

    Phi_i is `phi` of q_i and T_i. On s = 0 the error obeys eps' = -Phi_1(eps): s is at zero within T_2, the error
    within T_1 after it, whatever the start and a disturbance |d| <= K. Sanchez-Torres, Gomez-Gutierrez, Lopez,
    Loukianov, A class of predefined-time stable dynamical systems, IMA J. Mathematical Control and Information 35,
    2018; of second order Jimenez-Rodriguez, Munoz-Vazquez, Sanchez-Torres, Defoort, Loukianov, A Lyapunov-like
    characterization of predefined-time stability, IEEE Trans. Automatic Control 65(11), 2020. Here T_1 = share t_f and
    T_2 = (1 - share) t_f.
    """

    share: Leaf  # of t_f that is T_1 [-]
    q1: Leaf  # 0 < q1 <= 1/2 [-]
    q2: Leaf  # 0 < q2 < 1 [-]
    sign_width: Leaf  # [1/s]
    tunable: ClassVar[tuple[str, ...]] = ("share", "q1", "q2", "sign_width", "t_f")

    def acceleration(self, now: Sample, error: Vector, error_rate: Vector, bound: Scalar) -> tuple[Vector, Vector]:
        """Return a and s, (m,) each."""
        first, second = self.share * self.t_f, (1.0 - self.share) * self.t_f
        surface = phi(error, self.q1, first)
        squares = error_rate * jnp.abs(error_rate) + 2.0 * surface * jnp.abs(surface)
        s = error_rate + guards.signed_root(squares, jnp.zeros_like(bound))
        size = jnp.abs(error)
        # Phi_1 Phi_1' as a product without a negative power, which at zero would have no value; |x|^0 of q1 = 1/2 is 1
        power = guards.signed_power(size, 2.0 * self.q1)
        at_zero = (size == 0.0) & (self.q1 >= 0.5)
        quotient = size + jnp.where(at_zero, 1.0, guards.signed_power(size, 1.0 - 2.0 * self.q1))
        factor = (jnp.pi / (2.0 * self.q1 * first)) ** 2
        phi_slope = factor * ((1.0 + self.q1) * power + 1.0 - self.q1) * quotient
        switching = (bound + 2.0 * phi_slope) * guards.smooth_sign(s, self.sign_width)
        return -phi(s, self.q2, second) - switching, s


@pytree
@dataclass(frozen=True)
class SuperTwisting(AccelerationLaw):
    """s = eps' + c eps, a = -c eps' - 1.5 sqrt(L) sig^(1/2)(s) + v, v' = -1.1 L sign(s).

    Levant, Robust exact differentiation via sliding mode technique, Automatica 34(3), 1998, whose gains these are;
    Moreno, Osorio, Strict Lyapunov functions for the super-twisting algorithm, IEEE Trans. Automatic Control 57(4),
    2012. Where |d'| <= L for each component s is at zero after a finite time, without a switching input; v then is -d.
    The error follows at the rate c: no time is prescribed. v is summed up sample by sample.
    """

    surface_rate: Leaf  # c [1/s]
    lipschitz: Leaf  # bound L on each component of d' [1/s^3]
    sign_width: Leaf  # [1/s]
    tunable: ClassVar[tuple[str, ...]] = ("surface_rate", "lipschitz", "sign_width", "t_f")

    def begin(self) -> Vector:
        """V = 0 [1/s^2], (m,)."""
        return jnp.zeros(self.model.inputs)

    def acceleration(
        self, now: Sample, error: Vector, error_rate: Vector, bound: Scalar
    ) -> tuple[Vector, Vector, Vector]:
        """Return a, s and the next v, (m,) each; `bound` is not used: v finds the disturbance."""
        s = error_rate + self.surface_rate * error
        root = 1.5 * jnp.sqrt(self.lipschitz) * guards.signed_root(s, self.sign_width)
        a = now.memory - self.surface_rate * error_rate - root
        return a, s, now.memory - now.dt * 1.1 * self.lipschitz * guards.smooth_sign(s, self.sign_width)
