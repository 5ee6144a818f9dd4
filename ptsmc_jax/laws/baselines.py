"""Control laws from the literature for comparison: PD, sliding modes, and prescribed-time control by scaling.

Each class docstring has the law, its source and what it guarantees. sig^a(x) is sign(x) |x|^a.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import jax.numpy as jnp

from ptsmc_jax.declare import Rates, Scaled, gain
from ptsmc_jax.laws.base import ComparisonLaw, Sample, boundary_layer
from ptsmc_jax.laws.kinematics import MultiplicativeKinematics
from ptsmc_jax.numerics import guards
from ptsmc_jax.numerics.pytrees import Leaf, Scalar, Vector, pytree
from ptsmc_jax.plants.rigid_body import AttitudeState
from ptsmc_jax.signals.references import Target


@pytree
@dataclass(frozen=True)
class PD(ComparisonLaw):
    """PD on the error and its rate (Wie, Weiss, Arapostathis 1989).

    The commanded acceleration is a = -k_p eps - k_d eps', and the sliding variable is s = eps + (k_d/k_p) eps'.
    """

    k_p: Leaf = gain(
        Scaled(0.2, time=-2),
        Rates(2.0, 2000.0, 2),
        unit="1/s^2",
        meaning="gain on the vector part of the error quaternion",
    )
    k_d: Leaf = gain(Scaled(0.6, time=-1), Rates(0.3, 100.0), unit="1/s", meaning="gain on the rate error")
    switches: ClassVar[bool] = False

    def acceleration(self, now: Sample, error: Vector, error_rate: Vector, bound: Scalar) -> tuple[Vector, Vector]:
        """Return the commanded eps'' and the sliding variable s, (m,) each."""
        return -self.k_p * error - self.k_d * error_rate, error + self.k_d / self.k_p * error_rate

    def half_turn_rate(self, t_f: float) -> tuple[str, Scalar | float]:
        """Return "k_p", and the body rate [rad/s] at zero error after half a turn without damping."""
        return "k_p", 2.0 * math.sqrt(self.k_p)


@pytree
@dataclass(frozen=True)
class QuaternionPD(PD):
    """Quaternion PD with the reference's motion fed forward (Wie, Weiss, Arapostathis 1989).

    u = w x J w - d_hat + J (R w_f' - w_e x R w_f) - k_p J v - k_d J w_e.

    Wie, Weiss, Arapostathis, Quaternion feedback regulator for spacecraft eigenaxis rotations, J. Guidance, Control,
    and Dynamics 12(3), 1989. The motion of the reference is fed forward. The law has no singularity and no switching
    term. From rest, the body rotates about the eigenaxis, and its error angle obeys
    theta'' + k_d theta' + k_p sin(theta/2) = 0.
    """

    kinematics: MultiplicativeKinematics

    @property
    def continuous(self) -> bool:
        """True, because the law has no memory."""
        return True

    def __call__(
        self, now: Sample, x: AttitudeState, target: Target, d_hat: Vector, k2: Scalar
    ) -> tuple[Vector, Vector, None]:
        """Return the torque (3,) [N m], the sliding variable v + (k_d/k_p) w_e (3,), and None.

        Args:
            now: not used.
            x: measured state.
            target: target of the reference.
            d_hat: estimated disturbance torque, (3,) [N m].
            k2: not used.
        """
        q_e, w_e, feedforward = self.kinematics.relative(x, target)
        w_dot = feedforward - self.k_p * q_e[:3] - self.k_d * w_e
        u = self.kinematics.model.gyroscopic(x.w) - d_hat + self.kinematics.model.inertia @ w_dot
        return u, q_e[:3] + self.k_d / self.k_p * w_e, None


@pytree
@dataclass(frozen=True)
class Terminal(ComparisonLaw):
    """Nonsingular terminal sliding mode, s = v + sig^p(v') / b (Feng, Yu, Man 2002).

    s = v + sig^p(v')/b, alpha = -(b/p) sig^(2-p)(v') - k s - K sign(s), with sig^a(x) = sign(x) |x|^a, 1 < p < 2.

    Feng, Yu, Man, Non-singular terminal sliding mode control of rigid manipulators, Automatica 38(12), 2002. On s = 0 a
    component of v reaches zero after the time |v|^(1 - 1/p) p / ((p - 1) b^(1/p)), which grows with the initial error.
    """

    p: Leaf = gain(1.3, (1.05, 1.95), above=1.0, below=2.0, meaning="exponent of the surface")
    b: Leaf = gain(
        Scaled(0.1, time=lambda table: -table.p), "terminal_surface", unit="1/s^p", meaning="scale of the surface"
    )
    k: Leaf = gain(Scaled(0.1, time=-2), Rates(2.0, 2000.0, 2), unit="1/s^2", meaning="reaching gain")
    sign_width: Leaf = boundary_layer(1e-3)

    def acceleration(self, now: Sample, error: Vector, error_rate: Vector, bound: Scalar) -> tuple[Vector, Vector]:
        """Return the commanded eps'' and the sliding variable s, (m,) each."""
        s = error + guards.signed_power(error_rate, self.p) / self.b
        equivalent = -self.b / self.p * guards.signed_power(error_rate, 2.0 - self.p) - self.k * s
        return equivalent - bound * guards.smooth_sign(s, self.sign_width), s

    def noise_of_s(self, position: float, velocity: float) -> float:
        """Return the noise of s = v + sig^p(v') / b [-]."""
        return math.hypot(position, velocity**self.p / self.b)

    def half_turn_rate(self, t_f: float) -> tuple[str, Scalar | float]:
        """Return "b", and the body rate [rad/s] on the sliding surface at the error |v| = 1."""
        return "b", 2.0 * self.b ** (1.0 / self.p)


@pytree
@dataclass(frozen=True)
class FixedTime(ComparisonLaw):
    """Fixed-time sliding mode (Zuo 2015; Jiang, Hu, Friswell 2016), gamma - 1/p > 1.

    The law for the error v, with 1 < p < 2, gamma - 1/p > 1 and m > 1 > n > 0, is

        s = v + sig^p(v'/kappa),  kappa = a1 |v|^(gamma-1/p) + b1
        a = kappa' v'^2/kappa - (kappa^p/p) (sig^(2-p)(v') + a2 sig^m(s) + b2 sig^n(s)) - K sign(s).

    The surface is by Zuo, Non-singular fixed-time terminal sliding mode control of non-linear systems, IET Control
    Theory and Applications 9(4), 2015. Its use for attitudes is by Jiang, Hu, Friswell, IEEE Trans. Control Systems
    Technology 24(5), 2016. On s = 0 a component obeys v' = -a1 sig^gamma(v) - b1 sig^(1/p)(v). It reaches zero within
    the time 1/(a1 (gamma-1)) + p/(b1 (p-1)) from any initial error.
    """

    a1: Leaf = gain(
        Scaled(0.1, time=-1),
        Rates(0.01, 100.0),
        unit="1/s",
        meaning="surface, weight of |v|^gamma, far from the target",
    )
    b1: Leaf = gain(
        Scaled(0.2, time=-1), Rates(0.01, 100.0), unit="1/s", meaning="surface, weight of |v|^(1/p), near the target"
    )
    a2: Leaf = gain(
        Scaled(1.0, time=lambda table: table.p - 2.0), "fixed_time_reaching", unit="1/s^(2-p)",
        meaning="reaching law, weight of |s|^m, far from the surface",
    )  # fmt: skip
    b2: Leaf = gain(
        Scaled(1.0, time=lambda table: table.p - 2.0), "fixed_time_reaching", unit="1/s^(2-p)",
        meaning="reaching law, weight of |s|^n, near the surface",
    )  # fmt: skip
    p: Leaf = gain(1.25, "fixed_time_p", above=1.0, below=2.0, meaning="exponent of the surface")
    gamma: Leaf = gain(2.0, "fixed_time_gamma", above=1.0, meaning="exponent of the surface")
    m: Leaf = gain(1.5, (1.05, 3.0), above=1.0, meaning="exponent of the reaching law")
    n: Leaf = gain(0.5, (0.05, 0.95), below=1.0, meaning="exponent of the reaching law")
    sign_width: Leaf = boundary_layer(1e-3)

    def acceleration(self, now: Sample, error: Vector, error_rate: Vector, bound: Scalar) -> tuple[Vector, Vector]:
        """Return the commanded eps'' and the sliding variable s, (m,) each."""
        exponent = self.gamma - 1.0 / self.p
        kappa = self.a1 * guards.signed_power(jnp.abs(error), exponent) + self.b1
        kappa_derivative = self.a1 * exponent * guards.signed_power(error, exponent - 1.0)
        s = error + guards.signed_power(error_rate / kappa, self.p)
        reaching = guards.signed_power(error_rate, 2.0 - self.p)
        reaching = reaching + self.a2 * guards.signed_power(s, self.m) + self.b2 * guards.signed_power(s, self.n)
        curvature = kappa_derivative * error_rate * error_rate / kappa
        equivalent = curvature - guards.signed_power(kappa, self.p) / self.p * reaching
        return equivalent - bound * guards.smooth_sign(s, self.sign_width), s

    def half_turn_rate(self, t_f: float) -> tuple[str, Scalar | float]:
        """Return "a1", and the body rate [rad/s] on the sliding surface at the error |v| = 1."""
        return "a1", 2.0 * (self.a1 + self.b1)

    def noise_of_s(self, position: float, velocity: float) -> float:
        """Return the noise of s = v + sig^p(v' / b1) near the reference [-]."""
        return math.hypot(position, (velocity / self.b1) ** self.p)

    def refusal(self, order: int) -> tuple[str, str] | None:
        """Check gamma - 1/p > 1, without which the surface is singular; see `Law.refusal`."""
        is_nonsingular = self.gamma - 1.0 / self.p > 1.0
        return None if is_nonsingular else ("gamma", f"greater than 1 + 1/p, {1.0 + 1.0 / self.p:.6g}")


@pytree
@dataclass(frozen=True)
class Scaling(ComparisonLaw):
    """Prescribed time by scaling with (t_f/(t_f - t))^(2+m) (Song, Wang, Holloway, Krstic 2017).

    The scaled error is xi = mu eps with mu = (t_f/r)^p, p = 2 + m and r = t_f - t. The law is

        z = xi' + k1 xi = mu (eps' + (p/r + k1) eps)
        a = -2 p eps'/r - p (p+1) eps/r^2 - k1 (eps' + p eps/r) - k z,

    so that z' = mu (-k z + d). Then |z| is at most the larger of |d|/k and its initial value, and eps decays like r^p.
    Song, Wang, Holloway, Krstic, Time-varying feedback for regulation of normal-form nonlinear systems in prescribed
    finite time, Automatica 83, 2017. The gains grow without bound towards t_f. So r is held at delta in the hold phase,
    where the law is a PD law.
    """

    delta: Leaf = gain(
        Scaled(2.0, time=1), "delta", unit="s", meaning="time before t_f at which the gains become constant"
    )
    m: Leaf = gain(1.0, (1.0, 5.0), at_least=1.0, meaning="m of the scaling exponent 2 + m")
    k1: Leaf = gain(Scaled(1.0, time=-1), Rates(0.3, 0.5, sampled=True), unit="1/s", meaning="rate of the scaled error")
    k: Leaf = gain(
        Scaled(1e-3, time=-1), Rates(1e-5, 10.0), unit="1/s", meaning="rate of the surface when the scaling is 1"
    )
    switches: ClassVar[bool] = False

    def acceleration(self, now: Sample, error: Vector, error_rate: Vector, bound: Scalar) -> tuple[Vector, Vector]:
        """Return a and the sliding variable z / mu [1/s], (m,) each; see `Law.acceleration`."""
        p, r = 2.0 + self.m, jnp.where(now.hold, self.delta, self.t_f - now.t)
        s = error_rate + (p / r + self.k1) * error
        scaled_feedback = (
            2.0 * p / r * error_rate + p * (p + 1.0) / r**2 * error + self.k1 * (error_rate + p / r * error)
        )
        return -scaled_feedback - self.k * (self.t_f / r) ** p * s, s

    @staticmethod
    def designed(design: Any, published: Mapping[str, float]) -> Mapping[str, float]:
        """Return k1 and delta for the designed pole in the hold phase and at the end of the approach phase."""
        return {**published, "delta": design.delta, "k1": design.pole}

    def half_turn_rate(self, t_f: float) -> tuple[str, Scalar | float]:
        """Return "m", and the body rate [rad/s] at t = 0 for |v| = 1 and eps' = -(p / t_f) eps."""
        return "m", 2.0 * (2.0 + self.m) / t_f


def phi(x: Vector, q: Scalar, settling: Scalar) -> Vector:
    """Return Phi = pi/(2 q T) (sig^(1+q)(x) + sig^(1-q)(x)) [1/s]. The solution of x' = -Phi is zero after the time T.

    Args:
        x: error, of any shape.
        q: exponent, 0 < q < 1 [-].
        settling: T, an upper bound of the settling time for any initial error [s].
    """
    return jnp.pi / (2.0 * q * settling) * (guards.signed_power(x, 1.0 + q) + guards.signed_power(x, 1.0 - q))


@pytree
@dataclass(frozen=True)
class PredefinedTime(ComparisonLaw):
    """Predefined-time sliding mode (Sanchez-Torres and others 2018; Jimenez-Rodriguez and others 2020).

    The law, with Phi_i the function `phi` with q_i and T_i, is

        s = eps' + sig^(1/2)(sig^2(eps') + 2 sig^2(Phi_1(eps)))
        a = -Phi_2(s) - (K + 2 Phi_1 Phi_1'(eps)) sign(s).

    On s = 0 the error obeys eps' = -Phi_1(eps). From any initial error and for |d| <= K, s reaches zero within T_2 and
    the error within a further T_1. Here T_1 = share t_f and T_2 = (1 - share) t_f. Sanchez-Torres, Gomez-Gutierrez,
    Lopez, Loukianov, A class of predefined-time stable dynamical systems, IMA J. Mathematical Control and Information
    35, 2018. The form of second order is by Jimenez-Rodriguez, Munoz-Vazquez, Sanchez-Torres, Defoort, Loukianov, A
    Lyapunov-like characterization of predefined-time stability, IEEE Trans. Automatic Control 65(11), 2020.
    """

    share: Leaf = gain(
        0.6, (0.05, 0.95), below=1.0,
        meaning="fraction of t_f for the motion on the surface; the rest is for reaching the surface",
    )  # fmt: skip
    q1: Leaf = gain(0.3, (0.05, 0.49), at_most=0.5, meaning="exponent of the surface")
    q2: Leaf = gain(0.3, (0.05, 0.95), below=1.0, meaning="exponent of the reaching law")
    sign_width: Leaf = boundary_layer(Scaled(1e-2, time=-1), "1/s")

    def acceleration(self, now: Sample, error: Vector, error_rate: Vector, bound: Scalar) -> tuple[Vector, Vector]:
        """Return the commanded eps'' and the sliding variable s, (m,) each."""
        surface_time, reaching_time = self.share * self.t_f, (1.0 - self.share) * self.t_f
        surface = phi(error, self.q1, surface_time)
        squares = error_rate * jnp.abs(error_rate) + 2.0 * surface * jnp.abs(surface)
        s = error_rate + guards.signed_root(squares, jnp.zeros_like(bound))
        magnitude = jnp.abs(error)
        # The product Phi_1 Phi_1' of `phi` and its derivative, written without a negative power of |eps|, which would
        # be infinite at zero. For q1 = 1/2, the factor |eps|^(1 - 2 q1) is 1.
        power = guards.signed_power(magnitude, 2.0 * self.q1)
        at_zero = (magnitude == 0.0) & (self.q1 >= 0.5)
        quotient = magnitude + jnp.where(at_zero, 1.0, guards.signed_power(magnitude, 1.0 - 2.0 * self.q1))
        factor = (jnp.pi / (2.0 * self.q1 * surface_time)) ** 2
        phi_product = factor * ((1.0 + self.q1) * power + 1.0 - self.q1) * quotient
        switching = (bound + 2.0 * phi_product) * guards.smooth_sign(s, self.sign_width)
        return -phi(s, self.q2, reaching_time) - switching, s

    @staticmethod
    def designed(design: Any, published: Mapping[str, float]) -> Mapping[str, float]:
        """Return no gains, because the defaults follow from t_f in the sampled loop too."""
        return {}

    def half_turn_rate(self, t_f: float) -> tuple[str, Scalar | float]:
        """Return "q1", and the body rate [rad/s] on the sliding surface at the error |v| = 1."""
        return "q1", 2.0 * math.pi / (self.q1 * self.share * t_f)


@pytree
@dataclass(frozen=True)
class SuperTwisting(ComparisonLaw):
    """Super-twisting, s = eps' + c eps (Levant 1998; Moreno, Osorio 2012).

    The law is

        s = eps' + c eps
        a = -c eps' - 1.5 sqrt(L) sig^(1/2)(s) + v,  v' = -1.1 L sign(s).

    The gains 1.5 and 1.1 are by Levant, Robust exact differentiation via sliding mode technique, Automatica 34(3),
    1998. The stability proof is by Moreno, Osorio, Strict Lyapunov functions for the super-twisting algorithm, IEEE
    Trans. Automatic Control 57(4), 2012. If each component of the disturbance has |d'| <= L, s reaches zero after a
    finite time with a continuous input, and v then equals -d. The error decays at the rate c; the law has no prescribed
    time. v is integrated by one Euler step in each period.
    """

    surface_rate: Leaf = gain(
        Scaled(0.4, time=-1), Rates(3.0, 0.2, sampled=True), unit="1/s", meaning="c, rate of the error on the surface"
    )
    lipschitz: Leaf = gain(
        Scaled(0.01, time=-3), Rates(0.1, 1e4, 3), unit="1/s^3",
        meaning="bound L on each component of the disturbance's contribution to eps'''",
    )  # fmt: skip
    sign_width: Leaf = boundary_layer(Scaled(1e-3, time=-1), "1/s")
    switches: ClassVar[bool] = False

    def begin(self) -> Vector:
        """Return the initial value of v, zero, (m,) [1/s^2]."""
        return jnp.zeros(self.model.inputs)

    def acceleration(
        self, now: Sample, error: Vector, error_rate: Vector, bound: Scalar
    ) -> tuple[Vector, Vector, Vector]:
        """Return a, s and the next v, (m,) each; see `Law.acceleration`.

        `bound` is not used, because v estimates -d.
        """
        s = error_rate + self.surface_rate * error
        root = 1.5 * jnp.sqrt(self.lipschitz) * guards.signed_root(s, self.sign_width)
        a = now.memory - self.surface_rate * error_rate - root
        return a, s, now.memory - now.dt * 1.1 * self.lipschitz * guards.smooth_sign(s, self.sign_width)

    @staticmethod
    def designed(design: Any, published: Mapping[str, float]) -> Mapping[str, float]:
        """Return published gains within the bandwidth, and a boundary layer [1/s] thicker than the noise."""
        return {**published, "sign_width": design.width}

    def half_turn_rate(self, t_f: float) -> tuple[str, Scalar | float]:
        """Return "surface_rate", and the body rate [rad/s] on the sliding surface at the error |v| = 1."""
        return "surface_rate", 2.0 * self.surface_rate
