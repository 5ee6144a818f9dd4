"""The paper's prescribed-time sliding mode laws: spacecraft (56), (57), (59), (60); chains (36)-(40), (52).

Order 2 of the chain is the second-order system (6) with (7), (9), (10) and (24).
"""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ptsmc_jax import attitude, numerics
from ptsmc_jax.numerics import Leaf
from ptsmc_jax.plants import AttitudeState, Chain, Spacecraft
from ptsmc_jax.signals import Target

Scalar = Float[Array, ""]
Vector = Float[Array, " m"]


class SurfaceGains(NamedTuple):
    """What both phases of the law share: s = c eps' + e eps, desired 2 eps'' = -a eps' - b s - switching."""

    c: Array  # [s]
    e: Array  # [-]
    a: Array  # [1/s]
    b: Array  # [1/s^2] before the hand-over, [1/s] after


@dataclass(frozen=True)
class Law:
    """What the paper's laws share: gains, and a hand-over at t_f - delta (Remark 1).

    The paper's proofs call on LaSalle after t_f, but the system is not autonomous; V' <= -2 K1 V with V(t_f) = 0 is
    enough, and with delta > 0 V(t_f) is only small.
    """

    model: Any  # the nominal plant
    t_f: Leaf  # prescribed time [s]
    eta: Leaf  # eta > 2, and greater than the order of a chain [-]
    delta: Leaf  # hand-over this long before t_f, Remark 1 [s]
    k1: Leaf  # K1 of (10), (40) and (60) [1/s]
    sign_width: Leaf  # boundary layer of the smooth sign, in the units of s

    @property
    def hand_over(self) -> Scalar:
        """t_s = t_f - delta [s]."""
        return self.t_f - self.delta

    def align(self, x: Any, target: Any) -> Any:
        """The initial state in the form that the law can bring to the target."""
        return x

    def clearance(self, x: Any, target: Any) -> Scalar:
        """How far the law is from a singularity of its own [-]; 1 where it has none."""
        return jnp.ones_like(self.t_f)

    def torque(
        self, t: Scalar, hold: Bool[Array, ""], x: Any, target: Any, d_hat: Vector, k2: Scalar
    ) -> tuple[Vector, Vector]:
        """Commanded input (m,) and sliding variable; d_hat: estimated disturbance, k2: K2, bound on its error."""
        raise NotImplementedError

    @property
    def order(self) -> int:
        """Order n of the error's motion: 2, or that of a chain."""
        return 2

    def switching_rate(self, k2: Scalar) -> Scalar:
        """Factor of -tau^(n-1) sign(s) in s' before the hand-over, and of -sign(s) after it, for K2 up to k2."""
        raise NotImplementedError

    def boundary_layer(self, k2: Scalar) -> tuple[Scalar, Scalar]:
        """Fastest rate of the smooth sign's boundary layer before and after the hand-over [1/s], for K2 up to k2."""
        after = self.switching_rate(k2) / self.sign_width
        return self.t_f ** (self.order - 1) * after, after

    def hold_rate(self) -> float:
        """Fastest decay after the hand-over [1/s]."""
        raise NotImplementedError

    def errors(self, x: Any, target: Any) -> tuple[Vector, Vector]:
        """What is driven to zero, (m,), and its derivative."""
        raise NotImplementedError

    def angle(self, x: Any, target: Any) -> Scalar:
        """What settles: the angle to the reference [rad], for a chain |x_1|."""
        raise NotImplementedError


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class PrescribedTime(Law):
    """Disturbance-observer based law on the additive error eps_1 = q_1 - q_1f (4), handed over at t_f - delta.

    Differences from the paper: sign(s) is tanh(s / sign_width) (0: exact); `T` of (1) is both torque and matrix and
    q both quaternion and its scalar, here the torque is u and the scalar q4; (29), which this law is a case of, lacks
    the x_1' of s = x_1 + x_1' after t_f and dF/dt for a moving reference, (60) and (57) have them; ||T J^-1||, whose
    norm the paper leaves open, is the Frobenius norm, which is smooth and not below the spectral norm that the proof
    needs; K1 acts with an effective gain of K1/2 in (60). The law is singular at q4 = 0, 180 degrees from the inertial
    frame's identity wherever the reference is, and cannot cross it: `align` chooses the sign of q, `clearance` says
    how far away the singularity is. So "bounded control" is not global: the bound grows like 1/q4. After the
    hand-over nothing stays "at the origin": the rates are 1 and K1/2.
    """

    model: Spacecraft  # the nominal plant

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

    def switching_rate(self, k2: Scalar) -> Scalar:
        """|T J^-1| K2 / 2 at most: |T|_2 = 1 for a unit quaternion."""
        return 0.5 * numerics.norm(self.model.inertia_inverse) * k2

    def hold_rate(self) -> float:
        """Fastest decay after the hand-over [1/s]: 1 on the surface (59), K1/2 toward it."""
        return max(1.0, float(self.k1) / 2)


def expansion(eta: Scalar, order: int) -> list[Scalar]:
    """c_0 .. c_(n-1) of (37) for order n, c_i = C(n-1, i) eta (eta+1) .. (eta+n-2-i) [-].

    The paper only calls them expansion parameters (and says "expand (35)" for (36)). Order 2: (eta, 1), which is (7).
    """
    rising = [jnp.ones_like(eta)]
    for k in range(order - 1):
        rising.append(rising[-1] * (eta + k))
    return [math.comb(order - 1, i) * rising[order - 1 - i] for i in range(order)]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class PrescribedTimeChain(Law):
    """Law (52) for the integrator chain (35), with the surfaces (37) before and (39) after the hand-over.

    For order 2 it is (24) on (6). Differences from the paper: its sums of (38), (40) and (52) run to n-1, but x_(n+1)
    does not exist: they end at n-2; the s of Theorem 3 lacks the factor (t_f - t)^(eta+n-1) of (36); in (51) "-K s s"
    must read -K1 s^2; sign(s) is tanh(s / sign_width) (0: exact). The paper's law has no observer, d_hat = 0 and
    K2 = K; with an observer (Remark 3) its estimate and its bound take their place.
    """

    model: Chain  # the nominal plant
    a: Leaf  # (n-1,) a_1 .. a_(n-1) of (39), whose matrix must be Hurwitz [1/s^(n-i)]

    @property
    def order(self) -> int:
        """Order n of the chain."""
        return self.model.order

    def errors(self, x: Float[Array, " n"], target: Any) -> tuple[Float[Array, "1"], Float[Array, "1"]]:
        """x_1 and x_2, (1,) each: the origin is the target."""
        return x[:1], x[1:2]

    def angle(self, x: Float[Array, " n"], target: Any) -> Scalar:
        """|x_1|."""
        return jnp.abs(x[0])

    def torque(
        self, t: Scalar, hold: Bool[Array, ""], x: Float[Array, " n"], target: Any, d_hat: Vector, k2: Scalar
    ) -> tuple[Vector, Vector]:
        """Input (1,) by the first branch of (52) before and the second after the hand-over, and s (37), (39), (1,).

        d_hat: estimated disturbance; k2: bound on its error, K where nothing is estimated.
        """
        n = self.order
        tau = jnp.where(hold, 1.0, self.t_f - t)  # guarded: t_f - t may be 0 in hold
        c = expansion(self.eta, n)
        weights = [jnp.where(hold, held, c[i] * tau**i) for i, held in enumerate([*self.a, 1.0])]
        s = jnp.dot(jnp.stack(weights), x)
        rates = [jnp.where(hold, self.a[i], (c[i] - (i + 1) * c[i + 1]) * tau ** (i - n + 1)) for i in range(n - 1)]
        pull = jnp.where(hold, self.k1, (self.eta + n - 2) / tau**n)
        known = jnp.dot(jnp.stack(rates), x[1:]) + pull * s
        wanted = -known - k2 * numerics.smooth_sign(s, self.sign_width)
        u = (wanted - self.model.drift(x) - d_hat) / self.model.input_gain(x)
        return u, jnp.reshape(s, 1)

    def switching_rate(self, k2: Scalar) -> Scalar:
        """K2."""
        return k2

    def hold_rate(self) -> float:
        """Fastest decay after the hand-over [1/s]: the roots of (39) on the surface, K1 toward it."""
        return max(float(self.k1), float(np.max(np.abs(_surface_roots(self.a)))))


def hurwitz(a: Any) -> bool:
    """Whether the matrix of (39) is Hurwitz: all roots of p^(n-1) + a_(n-1) p^(n-2) + .. + a_1 left of the axis."""
    return bool(np.all(np.real(_surface_roots(a)) < 0.0))


def _surface_roots(a: Any) -> np.ndarray:
    return np.roots([1.0, *reversed([float(v) for v in a])])
