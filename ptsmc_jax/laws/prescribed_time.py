"""The paper's prescribed-time sliding mode laws: spacecraft (56)-(60), systems (29), chains (36)-(40), (52).

Order 2 of the chain is the second-order system (6) with (7), (9), (10) and (24).
"""

import math
from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ptsmc_jax.laws.base import Law, Sample
from ptsmc_jax.laws.kinematics import ChainKinematics, Kinematics
from ptsmc_jax.numerics import guards
from ptsmc_jax.numerics.pytrees import Leaf, Scalar, Vector, pytree


@dataclass(frozen=True)
class PrescribedTimeLaw(Law):
    """Base of the paper's laws: their gains, and the hand-over at t_f - delta (Remark 1).

    The paper's proofs call on LaSalle after t_f, but the system is not autonomous; V' <= -2 K1 V with V(t_f) = 0 is
    enough, and with delta > 0 V(t_f) is only small.
    """

    kinematics: Kinematics
    t_f: Leaf
    eta: Leaf  # eta > 2, and greater than the order of a chain [-]
    delta: Leaf
    k1: Leaf  # K1 of (10), (29), (40) and (60) [1/s]
    sign_width: Leaf  # thickness of the boundary layer after the hand-over, in the units of s there
    surface_rate: Leaf  # c, decay of the error on the surface after the hand-over; the paper's is 1 [1/s]
    # whether the held input is chosen for s at the end of the period, see `landing`, and not for its rate at the sample
    implicit: bool = field(default=False, metadata={"static": True}, kw_only=True)
    # before t_f - delta, the boundary layer of s is sign_width times this [s]
    layer_time: Leaf | np.float64 = field(default=np.float64(1.0), kw_only=True)
    tunable: ClassVar[tuple[str, ...]] = ("eta", "delta", "k1", "sign_width", "surface_rate", "t_f")
    prescribed: ClassVar[bool] = True

    @property
    def continuous(self) -> bool:
        """Whether the continuous loop can simulate the law: implicit sampling needs samples."""
        return not self.implicit

    @property
    def reaching_rate(self) -> Scalar:
        """Rate at which s falls after the hand-over, but for the switching term [1/s]: K1, or K1/2 in (60)."""
        return self.kinematics.reaching_factor * self.k1

    def surface(self) -> Float[Array, " roots"]:
        """a_1 .. a_(n-1) of the surface after the hand-over, s = x_n + a_(n-1) x_(n-1) + .. + a_1 x_1 [1/s^(n-i)]."""
        raise NotImplementedError

    def layer(self, hold: Bool[Array, ""]) -> Scalar:
        """Thickness of the boundary layer, in the units of s before or after the hand-over.

        s has one more power of time before it, for each order above 1. The paper has the same number in both, with time
        in seconds: `layer_time` is that second.
        """
        return jnp.where(hold, self.sign_width, self.sign_width * self.layer_time ** (self.order - 1))

    def landing(self, now: Sample, s: Vector, at_hand_over: Vector, power: Scalar, switching: Scalar) -> Vector:
        """The s (m,) at which implicit (backward Euler) sampling aims for the end of the period that begins.

        The law in continuous time would bring s to the target r^power s before the hand-over and e^(-rate h) s after
        it, with `reaching_rate`. The switching term moves s from there toward zero by at most k = `switching`: s+ =
        target - k sign(s+), whose solution is sign(target) max(|target| - k, 0). Acary, Brogliato, Orlov,
        Chattering-free digital sliding-mode control with state observer and disturbance rejection, IEEE Trans.
        Automatic Control 57(5), 2012. There is no boundary layer to choose, and no stability limit for delta.

        The surface is that of the period's end. In a period that the hand-over ends it is the surface of the hold
        phase, and the target is `at_hand_over`.

        Args:
            now: the sample.
            s: sliding variable at the sample, (m,).
            at_hand_over: target at the hand-over, (m,).
            power: exponent of the decay of s before the hand-over [-].
            switching: largest change of s by the switching term in the period.
        """
        ends_in_hold = self.in_hold(now.t, now.t + now.dt, now.hold)
        before = jnp.where(ends_in_hold, at_hand_over, self.remaining_share(now) ** power * s)
        target = jnp.where(now.hold, jnp.exp(-self.reaching_rate * now.dt) * s, before)
        # slope 1 where there is nothing to switch against, at rest too
        return jnp.where(jnp.abs(target) < switching, 0.0, target - switching * jnp.sign(target))

    def in_hold(self, t: Array, t_next: Array, hold: Bool[Array, "..."]) -> Bool[Array, "..."]:
        """Return which periods use the gains of the hold phase: with implicit sampling those that end in it."""
        if not self.implicit:
            return hold
        by_rounding = guards.rounding(t_next - t, t_next)  # which must not cost a period
        return hold | (t_next > self.hand_over - by_rounding)

    def time_left(self, t: Scalar, hold: Bool[Array, ""]) -> Scalar:
        """Return t_f - t [s] before the hand-over, and 1 after it, where t_f - t may be 0."""
        return jnp.where(hold, 1.0, self.t_f - t)

    def remaining_share(self, now: Sample) -> Scalar:
        """Return the fraction r of the time to t_f that remains at the end of this period [-]; 1 in the hold phase.

        At least 1e-9 of a period remains, so powers of r and quotients by them stay finite.
        """
        left = self.time_left(now.t, now.hold)
        return jnp.where(now.hold, 1.0, jnp.maximum(left - now.dt, 1e-9 * now.dt) / left)


class SurfaceGains(NamedTuple):
    """Gains of both phases of the law: s = c eps' + e eps, and eps'' = -a eps' - b s - switching."""

    c: Array  # [s] before the hand-over, [-] after
    e: Array  # [-] before the hand-over, [1/s] after
    a: Array  # [1/s]
    b: Array  # [1/s^2] before the hand-over, [1/s] after


@pytree
@dataclass(frozen=True)
class PrescribedTime(PrescribedTimeLaw):
    """The law of an error vector eps whose second derivative the input sets: (29), with the cases (57) and (60).

    Before the hand-over (26), with tau = t_f - t:
        s = tau eps' + eta eps, eps'' = -(eta-1) eps'/tau - eta s/tau^2 - N K2 sign(s) / 2.
    After it (28):
        s = eps' + c eps, eps'' = -c eps' - b s - N K2 sign(s) / 2.

    c is `surface_rate`, in the paper 1 1/s. b is `reaching_rate`: K1 in (29) and K1/2 in (60). N is the Frobenius norm
    of 2 d(eps'')/dd: |T J^-1| in (57) and 2 |dF/dx2 D| in (29). The disturbance's input matrix D is inside the norm,
    because K2 bounds d. The paper names no norm. This one is smooth and not below the spectral norm that the proof
    needs if K2 bounds the 2-norm of the estimation error.

    With `AdditiveKinematics` it is the paper's law of a spacecraft, (56) and (57) before and (59) and (60) after the
    hand-over. With `MultiplicativeKinematics` the same law does not depend on the inertial frame. With
    `SecondOrderKinematics` it is (29).

    Differences from the paper: (29) lacks the x_1' of s = x_1 + x_1' after t_f and dF/dt for a moving reference; (60)
    and (57) have them. sign(s) is tanh(s / sign_width), per component (0: exact). `T` of (1) is both torque and matrix
    and q both quaternion and its scalar, here the torque is u and the scalar q4. After the hand-over nothing stays "at
    the origin": the rates are c and b.
    """

    def gains(self, t: Scalar, hold: Bool[Array, ""]) -> SurfaceGains:
        """Gains of the surfaces and of the law at t [s]; `hold`: after the hand-over."""
        tau = self.time_left(t, hold)
        return SurfaceGains(
            c=tau,
            e=jnp.where(hold, self.surface_rate, self.eta),
            a=jnp.where(hold, self.surface_rate, (self.eta - 1.0) / tau),
            b=jnp.where(hold, self.reaching_rate, self.eta / tau**2),
        )

    def acceleration(self, now: Sample, error: Vector, error_rate: Vector, bound: Scalar) -> tuple[Vector, Vector]:
        """Return eps'' by (26) and (28), or by `landing` with implicit sampling, and s, (m,) each."""
        gains = self.gains(now.t, now.hold)
        s = gains.c * error_rate + gains.e * error
        if self.implicit:
            return self._landing_acceleration(now, error, error_rate, s, bound), s
        switching = bound * guards.smooth_sign(s, self.layer(now.hold))
        return -switching - gains.a * error_rate - gains.b * s, s

    def _landing_acceleration(self, now: Sample, error: Vector, error_rate: Vector, s: Vector, bound: Scalar) -> Vector:
        """The eps'' (m,) for which s is `landing` at the end of the period: s+ = s_0 + g eps''."""
        h, r = now.dt, self.remaining_share(now)
        end = self.gains(now.t + h, self.in_hold(now.t, now.t + h, now.hold))
        s_0 = end.c * error_rate + end.e * (error + h * error_rate)  # at the end, without acceleration
        g = h * end.c + end.e * h**2 / 2.0
        # Before the hand-over s = 0 lets eps fall like r^eta. The s handed over is made of the measured rate, not of
        # eta / delta times an attitude, whose noise that would multiply
        at_hand_over = r ** (self.eta - 1.0) * (error_rate + self.surface_rate * r * error)
        return (self.landing(now, s, at_hand_over, self.eta, g * bound) - s_0) / g

    def surface(self) -> Float[Array, "1"]:
        """(c,) [1/s]."""
        return jnp.reshape(self.surface_rate, 1)


@pytree
@dataclass(frozen=True)
class PrescribedTimeChain(PrescribedTimeLaw):
    """Law (52) for the integrator chain (35), with the surfaces (37) before and (39) after the hand-over.

    For order 2 it is (24) on (6). Differences from the paper: its sums of (38), (40) and (52) run to n-1, but x_(n+1)
    does not exist: they end at n-2; the s of Theorem 3 lacks the factor (t_f - t)^(eta+n-1) of (36); in (51) "-K s s"
    must read -K1 s^2; sign(s) is tanh(s / sign_width) (0: exact). The paper's law has no observer, d_hat = 0 and
    K2 = K; with an observer (Remark 3) its estimate and its bound take their place. With `surface_rate` c the poles of
    (39) are c times those of a: a_i c^(n-i) stands for a_i, and c = 1 is the paper's.
    """

    kinematics: ChainKinematics
    a: Leaf  # (n-1,) a_1 .. a_(n-1) of (39), whose matrix must be Hurwitz [1/s^(n-i)]

    def __call__(
        self, now: Sample, x: Float[Array, " n"], target: Any, d_hat: Vector, k2: Scalar
    ) -> tuple[Vector, Vector, None]:
        """Return the input (1,) by (52), or by `landing` with implicit sampling, and s (37), (39), (1,).

        Args:
            now: the sample.
            x: state.
            target: not used: the origin.
            d_hat: estimated disturbance, (1,).
            k2: bound on the error of d_hat, K if nothing is estimated.
        """
        tau = self.time_left(now.t, now.hold)
        c, a = expansion(self.eta, self.order), self.surface()
        s = jnp.reshape(jnp.dot(_surface_weights(c, [*a, 1.0], tau, now.hold), x), 1)
        x_n_dot = self._landing_rate(now, x, s, k2) if self.implicit else self._rate(now, x, s, k2)
        return self.kinematics.invert(x, target, x_n_dot, d_hat), s, None

    def _rate(self, now: Sample, x: Float[Array, " n"], s: Vector, k2: Scalar) -> Vector:
        """x_n' by the first branch of (52) before and the second after the hand-over."""
        n, c, a = self.order, expansion(self.eta, self.order), self.surface()
        tau = self.time_left(now.t, now.hold)
        rates = [jnp.where(now.hold, a[i], (c[i] - (i + 1) * c[i + 1]) * tau ** (i - n + 1)) for i in range(n - 1)]
        reaching = jnp.where(now.hold, self.k1, (self.eta + n - 2) / tau**n)
        equivalent = jnp.dot(jnp.stack(rates), x[1:]) + reaching * s
        return -equivalent - k2 * guards.smooth_sign(s, self.layer(now.hold))

    def _landing_rate(self, now: Sample, x: Float[Array, " n"], s: Vector, k2: Scalar) -> Vector:
        """The x_n' for which s is `landing` at the end of the period: s+ = s_0 + g x_n'."""
        n, h, c, r = self.order, now.dt, expansion(self.eta, self.order), self.remaining_share(now)
        # the states at the end of the period are drifted + x_n' pushed: Taylor's series of a chain
        drifted = [sum(h ** (j - i) / math.factorial(j - i) * x[j] for j in range(i, n)) for i in range(n)]
        pushed = jnp.stack([h ** (n - i) / math.factorial(n - i) for i in range(n)])
        a, left = [*self.surface(), 1.0], self.time_left(now.t, now.hold)
        weights_end = _surface_weights(c, a, r * left, self.in_hold(now.t, now.t + h, now.hold))
        # before the hand-over s = 0 lets x_1 fall like r^eta
        at_hand_over = jnp.reshape(sum(a[i] * r ** (self.eta - i) * x[i] for i in range(n)), 1)
        s_0 = jnp.reshape(jnp.dot(weights_end, jnp.stack(drifted)), 1)
        g = jnp.dot(weights_end, pushed)
        s_end = self.landing(now, s, at_hand_over, self.eta + n - 2, g * k2)
        return (s_end - s_0) / g

    def surface(self) -> Float[Array, " roots"]:
        """a_i c^(n-i) [1/s^(n-i)]: time runs c times as fast on the surface."""
        n = self.order
        return jnp.stack([self.a[i] * self.surface_rate ** (n - 1 - i) for i in range(n - 1)])


def _surface_weights(c: list[Scalar], a: list, tau: Scalar, hold: Bool[Array, ""]) -> Float[Array, " n"]:
    """Weights of a chain's states in s: a where `hold` (39), else c_i tau^i (37), tau = t_f - t [s]."""
    return jnp.stack([jnp.where(hold, a[i], c[i] * tau**i) for i in range(len(c))])


def expansion(eta: Scalar, order: int) -> list[Scalar]:
    """c_0 .. c_(n-1) of (37) for order n, c_i = C(n-1, i) eta (eta+1) .. (eta+n-2-i) [-].

    The paper only calls them expansion parameters (and says "expand (35)" for (36)). Order 2: (eta, 1), which is (7).
    """
    rising = rising_factorials(eta, order - 1)
    return [math.comb(order - 1, i) * rising[order - 1 - i] for i in range(order)]


def rising_factorials(eta: Scalar, largest: int) -> list[Scalar]:
    """Return 1, eta, eta (eta+1), .. eta (eta+1) .. (eta+largest-1) [-]."""
    rising = [jnp.ones_like(eta)]
    for k in range(largest):
        rising.append(rising[-1] * (eta + k))
    return rising
