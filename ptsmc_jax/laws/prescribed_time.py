"""The prescribed-time sliding mode laws of the paper.

`PrescribedTime` is the law for a spacecraft, (56) to (60), and for a second-order system, (29). `PrescribedTimeChain`
is the law for an integrator chain, (52). A chain of order 2 is the system (6) with the law (24). Read
`PrescribedTime.acceleration` first.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ptsmc_jax import declare, formulas
from ptsmc_jax.declare import Scaled, gain
from ptsmc_jax.laws.base import Law, Sample
from ptsmc_jax.laws.kinematics import ChainKinematics, Kinematics
from ptsmc_jax.numerics import guards
from ptsmc_jax.numerics.pytrees import Leaf, Scalar, Vector, pytree


@dataclass(frozen=True)
class PrescribedTimeLaw(Law):
    """Base of the laws of the paper: their gains, and the hand-over at t_f - delta (Remark 1).

    For t > t_f the proofs of the paper use LaSalle's invariance principle, which requires an autonomous system. The
    inequality V' <= -2 K1 V of the Lyapunov function V proves the same: V stays 0 if V(t_f) = 0. With delta > 0, V(t_f)
    is small but not zero.
    """

    kinematics: Kinematics
    t_f: Leaf
    eta: Leaf = gain(
        Scaled(3.0), "eta", above=2.0, allowed="a number greater than 2 (Theorem 2)",
        meaning="exponent of the approach phase: the error decreases like (t_f - t)^eta, up to a "
                "logarithm; 3 in the paper",
    )  # fmt: skip
    delta: Leaf = gain(
        Scaled(0.05, time=1), "delta", unit="s",
        meaning="time before t_f at which the gains become constant (Remark 1); 0.05 in the paper",
    )  # fmt: skip
    k1: Leaf = gain(
        Scaled(1.0, time=-1), "k1", unit="1/s", free="sampled",
        meaning="reaching gain K1 of the hold phase; (60) halves it for a spacecraft; 1 in the paper",
    )  # fmt: skip
    sign_width: Leaf = gain(
        Scaled(1e-3, time=-1), "sign_width", at_least=0.0, unit=("1/s", "unit of s"), free="sampled",
        meaning="thickness of the boundary layer, tanh(s / sign_width); 0 is the discontinuous sign",
    )  # fmt: skip
    surface_rate: Leaf = gain(
        Scaled(1.0, time=-1), "surface_rate", unit="1/s", free="sampled",
        meaning="c of the surface s = eps' + c eps in the hold phase: the error decays like exp(-c t); 1 "
                "in the paper",
    )  # fmt: skip
    # whether the law computes the constant input of a period from s at the end of the period (implicit Euler, see
    # `next_s`), not from the derivative of s at the sample
    implicit: bool = field(default=False, metadata={"static": True}, kw_only=True)
    layer_time: Leaf = declare.number(
        Scaled(1.0, time=1), above=0.0, unit="s", kw_only=True,
        meaning="time that converts the thickness of the boundary layer into the units of s before the hand-over; "
        "1 in the paper",
    )  # fmt: skip
    prescribed: ClassVar[bool] = True

    @staticmethod
    def designed(design: Any, published: Mapping[str, float]) -> Mapping[str, float]:
        """Return gains that put both poles of the hold phase at the designed pole.

        The decay rates of s and of the error on the surface are then equal: K1 is `design.reaching` times the pole, 2
        for a spacecraft by (60), and `surface_rate` is the pole.
        """
        pole = design.pole
        gains = {"k1": design.reaching * pole, "sign_width": design.width, "surface_rate": pole}
        return {"eta": design.eta, "delta": design.delta, **gains}

    def half_turn_rate(self, t_f: float) -> tuple[str, Scalar | float]:
        """Return "eta", and the body rate [rad/s] on the sliding surface at t = 0 with the error |v| = 1."""
        return "eta", 2.0 * self.eta / t_f

    @property
    def continuous(self) -> bool:
        """Whether the continuous loop can simulate the law, which excludes implicit sampling."""
        return not self.implicit

    @property
    def reaching_rate(self) -> Scalar:
        """Decay rate of s in the hold phase without the switching term [1/s]: K1, or K1/2 for (60)."""
        return self.kinematics.reaching_factor * self.k1

    def surface(self) -> Float[Array, " roots"]:
        """Return the coefficients of the surface of the hold phase.

        They are a_1 to a_(n-1) [1/s^(n-i)] of s = x_n + a_(n-1) x_(n-1) + .. + a_1 x_1.
        """
        raise NotImplementedError

    def layer_width(self, hold: Bool[Array, ""]) -> Scalar:
        """Return the thickness of the boundary layer, in the units of s in the present phase.

        The unit of s in the approach phase is s^(n-1) times its unit in the hold phase. The paper uses the same number
        for the thickness in both phases, with time in seconds. Therefore `layer_time` is 1 s by default.
        """
        return jnp.where(hold, self.sign_width, self.sign_width * self.layer_time ** (self.order - 1))

    def next_s(self, now: Sample, s: Vector, at_hand_over: Vector, power: Scalar, switching: Scalar) -> Vector:
        """Return the sliding variable that implicit (backward Euler) sampling commands for the end of the period.

        Without the switching term, the law in continuous time would bring s to a target in this period: r^power s in
        the approach phase, and e^(-rate h) s with the `reaching_rate` in the hold phase. The switching term reduces |s|
        further by at most k = `switching`. So s+ = target - k sign(s+), with the solution s+ = sign(target)
        max(|target| - k, 0). Acary, Brogliato, Orlov, Chattering-free digital sliding-mode control with state observer
        and disturbance rejection, IEEE Trans. Automatic Control 57(5), 2012. The method needs no boundary layer and has
        no stability limit for delta.

        s+ is on the surface that is valid at the end of the period. If the period ends in the hold phase but begins in
        the approach phase, the target is `at_hand_over`.

        Args:
            now: the sample.
            s: sliding variable at the sample, (m,).
            at_hand_over: target in the period of the hand-over, (m,).
            power: exponent of the decay of s in the approach phase [-].
            switching: largest change of s by the switching term in the period.

        Returns:
            s+ (m,), in the units of s at the end of the period.
        """
        ends_in_hold = self.in_hold(now.t, now.t + now.dt, now.hold)
        before = jnp.where(ends_in_hold, at_hand_over, self.remaining_fraction(now) ** power * s)
        target = jnp.where(now.hold, jnp.exp(-self.reaching_rate * now.dt) * s, before)
        # in this form the derivative by the target is 1 without a switching term, also at target = 0
        return jnp.where(jnp.abs(target) < switching, 0.0, target - switching * jnp.sign(target))

    def in_hold(self, t: Array, t_next: Array, hold: Bool[Array, "..."]) -> Bool[Array, "..."]:
        """Return which periods use the gains of the hold phase. With implicit sampling, also periods that end in it."""
        if not self.implicit:
            return hold
        tolerance = guards.time_tolerance(t_next - t, t_next)  # rounding errors must not shift the change by a period
        return hold | (t_next > self.hand_over - tolerance)

    def time_left(self, t: Scalar, hold: Bool[Array, ""]) -> Scalar:
        """Return t_f - t [s] in the approach phase. Return 1 in the hold phase, because t_f - t may be 0 there."""
        return jnp.where(hold, 1.0, self.t_f - t)

    def remaining_fraction(self, now: Sample) -> Scalar:
        """Return the ratio r of the times to t_f at the end and at the start of the period [-]; 1 in the hold phase.

        The remaining time is at least 1e-9 periods, so that powers of r and divisions by them are finite.
        """
        time_left = self.time_left(now.t, now.hold)
        return jnp.where(now.hold, 1.0, jnp.maximum(time_left - now.dt, 1e-9 * now.dt) / time_left)


class SurfaceGains(NamedTuple):
    """Gains of the law in the present phase: s = c eps' + e eps, and eps'' = -a eps' - b s - switching term."""

    c: Array  # factor of eps' in s: t_f - t [s] in the approach phase, 1 in the hold phase
    e: Array  # factor of eps in s, [-] in the approach phase, [1/s] in the hold phase
    a: Array  # factor of -eps' in eps'' [1/s]
    b: Array  # factor of -s in eps'', [1/s^2] in the approach phase, [1/s] in the hold phase


@pytree
@dataclass(frozen=True)
class PrescribedTime(PrescribedTimeLaw):
    """The paper's law: (56) and (57) for a spacecraft before the hand-over, (59) and (60) after it; (29) for a system.

    The law computes the second derivative of an error vector eps. In the approach phase (26), with tau = t_f - t:

        s = tau eps' + eta eps
        eps'' = -(eta-1) eps'/tau - eta s/tau^2 - N K2 sign(s) / 2.

    In the hold phase (28):

        s = eps' + c eps
        eps'' = -c eps' - b s - N K2 sign(s) / 2.

    c is `surface_rate`, 1 1/s in the paper. b is `reaching_rate`, K1 in (29) and K1/2 in (60). N is the Frobenius norm
    of the matrix 2 d(eps'')/dd, where d is the disturbance: |T J^-1| in (57) and 2 |dF/dx2 D| in (29). The norm
    includes the input matrix D of the disturbance, because K2 bounds d. The paper does not define its norm. The proof
    needs at least the spectral norm if K2 bounds the 2-norm of the estimation error. The Frobenius norm is not less
    than the spectral norm, and it is smooth.

    With `AdditiveKinematics` it is the law of the paper for a spacecraft, (56) and (57) in the approach phase, (59) and
    (60) in the hold phase. With `MultiplicativeKinematics` the law does not depend on the inertial frame. With
    `SecondOrderKinematics` it is (29).

    Differences from the paper:

    - After t_f, (29) lacks the term x_1' that follows from s = x_1 + x_1', and dF/dt for a moving reference. (57) and
      (60) have both terms.
    - sign(s) is tanh(s / sign_width) for each component; sign_width = 0 is the discontinuous sign.
    - The paper uses T for the torque and a matrix, and q for the quaternion and its scalar. Here the torque is u and
      the scalar q4.
    - In the hold phase the state does not remain exactly at the origin. The error decays with the rates c and b.
    """

    def gains(self, t: Scalar, hold: Bool[Array, ""]) -> SurfaceGains:
        """Return the gains at the time t [s]; hold: whether t is in the hold phase."""
        tau = self.time_left(t, hold)
        return SurfaceGains(
            c=tau,
            e=jnp.where(hold, self.surface_rate, self.eta),
            a=jnp.where(hold, self.surface_rate, (self.eta - 1.0) / tau),
            b=jnp.where(hold, self.reaching_rate, self.eta / tau**2),
        )

    def acceleration(self, now: Sample, error: Vector, error_rate: Vector, bound: Scalar) -> tuple[Vector, Vector]:
        """Return the commanded eps'' and s, (m,) each; see the class, and `next_s` for implicit sampling."""
        gains = self.gains(now.t, now.hold)
        s = gains.c * error_rate + gains.e * error
        if self.implicit:
            return self._implicit_acceleration(now, error, error_rate, s, bound), s
        switching = bound * guards.smooth_sign(s, self.layer_width(now.hold))
        return -switching - gains.a * error_rate - gains.b * s, s

    def _implicit_acceleration(
        self, now: Sample, error: Vector, error_rate: Vector, s: Vector, bound: Scalar
    ) -> Vector:
        """Return eps'' (m,), constant in the period, that makes s equal to `next_s` at its end: s+ = s_0 + g eps''."""
        h, r = now.dt, self.remaining_fraction(now)
        end = self.gains(now.t + h, self.in_hold(now.t, now.t + h, now.hold))
        s_0 = end.c * error_rate + end.e * (error + h * error_rate)  # s at the end without acceleration
        g = h * end.c + end.e * h**2 / 2.0
        # On s = 0, eps decays like r^eta in the approach phase, and its rate is -eta / tau times eps. The target of s
        # at the hand-over uses the measured rate, because this product would amplify the noise of the attitude.
        at_hand_over = r ** (self.eta - 1.0) * (error_rate + self.surface_rate * r * error)
        return (self.next_s(now, s, at_hand_over, self.eta, g * bound) - s_0) / g

    def surface(self) -> Float[Array, "1"]:
        """Return (c,) [1/s]."""
        return jnp.reshape(self.surface_rate, 1)


@pytree
@dataclass(frozen=True)
class PrescribedTimeChain(PrescribedTimeLaw):
    """The paper's law (52) for the integrator chain (35); without an observer it is (36) to (40).

    The surface is (37) in the approach phase and (39) in the hold phase. For order 2 the law is (24) for the system
    (6). `surface_rate` c multiplies the poles of (39), because a_i is replaced by a_i c^(n-i). The paper has c = 1.

    Differences from the paper:

    - The sums of (38), (40) and (52) end at i = n-2 instead of n-1, because x_(n+1) does not exist.
    - The s of Theorem 3 lacks the factor (t_f - t)^(eta+n-1) of (36).
    - In (51), "-K s s" must be -K1 s^2.
    - sign(s) is tanh(s / sign_width); sign_width = 0 is the discontinuous sign.
    - The law of the paper has no observer: d_hat = 0 and K2 = K. With an observer (Remark 3), its estimate and its
      bound are used.
    """

    kinematics: ChainKinematics
    eta: Leaf = gain(
        Scaled(3.0), "eta", allowed="a number greater than the order (Theorems 1 and 3)",
        meaning="exponent of the approach phase; default: order + 1",
    )  # fmt: skip
    sign_width: Leaf = gain(
        Scaled(1e-3, time=1, order=-1), "sign_width", at_least=0.0, unit="unit of s", free="sampled",
        meaning="thickness of the boundary layer, tanh(s / sign_width); 0 is the discontinuous sign",
    )  # fmt: skip
    a: Leaf = declare.number(
        (1.0,), any_length=True, allowed="a list of numbers, a_1 to a_(order-1) of (39)",
        meaning="a_1 to a_(order-1) of the surface (39), stable; default: all poles at -1",
    )  # fmt: skip

    def refusal(self, order: int) -> tuple[str, str] | None:
        """Check the condition on eta (Theorems 1 and 3) and the stability of the surface (39); see `Law.refusal`."""
        if not self.eta > order:
            return "eta", f"greater than plant.order, {order} ({'Theorem 1' if order == 2 else 'Theorem 3'})"
        if len(self.a) != order - 1:
            return "a", f"a list of plant.order - 1 = {order - 1} number{'s' * (order > 2)}"
        stable = "such that all roots of p^(n-1) + a_(n-1) p^(n-2) + .. + a_1 are stable (39)"
        return None if formulas.is_hurwitz(self.a) else ("a", stable)

    def __call__(
        self, now: Sample, x: Float[Array, " n"], target: Any, d_hat: Vector, k2: Scalar
    ) -> tuple[Vector, Vector, None]:
        """Return the input by (52), or with implicit sampling by `next_s`.

        Args:
            now: the sample.
            x: measured state, (n,).
            target: not used, because the target is the origin.
            d_hat: estimated disturbance, (1,).
            k2: bound on the error of d_hat; K of Assumption 1 without an observer.

        Returns:
            The input (1,), the sliding variable by (37) or (39) (1,), and None.
        """
        tau = self.time_left(now.t, now.hold)
        c, a = surface_coefficients(self.eta, self.order), self.surface()
        s = jnp.reshape(jnp.dot(_surface_weights(c, [*a, 1.0], tau, now.hold), x), 1)
        x_n_dot = self._implicit_rate(now, x, s, k2) if self.implicit else self._explicit_rate(now, x, s, k2)
        return self.kinematics.invert(x, target, x_n_dot, d_hat), s, None

    def _explicit_rate(self, now: Sample, x: Float[Array, " n"], s: Vector, k2: Scalar) -> Vector:
        """Return the commanded x_n' (1,) by the first case of (52) before the hand-over, else by the second."""
        n, c, a = self.order, surface_coefficients(self.eta, self.order), self.surface()
        tau = self.time_left(now.t, now.hold)
        rates = [jnp.where(now.hold, a[i], (c[i] - (i + 1) * c[i + 1]) * tau ** (i - n + 1)) for i in range(n - 1)]
        reaching = jnp.where(now.hold, self.k1, (self.eta + n - 2) / tau**n)
        equivalent = jnp.dot(jnp.stack(rates), x[1:]) + reaching * s
        return -equivalent - k2 * guards.smooth_sign(s, self.layer_width(now.hold))

    def _implicit_rate(self, now: Sample, x: Float[Array, " n"], s: Vector, k2: Scalar) -> Vector:
        """Return x_n' (1,), constant in the period, that makes s equal to `next_s` at its end: s+ = s_0 + g x_n'."""
        n, h, c, r = self.order, now.dt, surface_coefficients(self.eta, self.order), self.remaining_fraction(now)
        # the state at the end of the period is free + x_n' forced, by the Taylor series of a chain
        free = [sum(h ** (j - i) / math.factorial(j - i) * x[j] for j in range(i, n)) for i in range(n)]
        forced = jnp.stack([h ** (n - i) / math.factorial(n - i) for i in range(n)])
        a, time_left = [*self.surface(), 1.0], self.time_left(now.t, now.hold)
        weights_end = _surface_weights(c, a, r * time_left, self.in_hold(now.t, now.t + h, now.hold))
        # in the approach phase, x_1 decays like r^eta on s = 0
        at_hand_over = jnp.reshape(sum(a[i] * r ** (self.eta - i) * x[i] for i in range(n)), 1)
        s_0 = jnp.reshape(jnp.dot(weights_end, jnp.stack(free)), 1)
        g = jnp.dot(weights_end, forced)
        s_end = self.next_s(now, s, at_hand_over, self.eta + n - 2, g * k2)
        return (s_end - s_0) / g

    def surface(self) -> Float[Array, " roots"]:
        """Return a_i c^(n-i) [1/s^(n-i)]: the poles of (39) times c."""
        n = self.order
        return jnp.stack([self.a[i] * self.surface_rate ** (n - 1 - i) for i in range(n - 1)])


def _surface_weights(c: list[Scalar], a: list, tau: Scalar, hold: Bool[Array, ""]) -> Float[Array, " n"]:
    """Return the weights (n,) of the states in s: a_i by (39) in the hold phase, c_i tau^i by (37) before it."""
    return jnp.stack([jnp.where(hold, a[i], c[i] * tau**i) for i in range(len(c))])


def surface_coefficients(eta: Scalar, order: int) -> list[Scalar]:
    """Return the parameters c_0 .. c_(n-1) of (37) for order n [-].

    They are c_i = C(n-1, i) eta (eta+1) .. (eta+n-2-i), from the derivatives of (36). The paper does not state them.
    For order 2 they are (eta, 1), as in (7).
    """
    rising = rising_factorials(eta, order - 1)
    return [math.comb(order - 1, i) * rising[order - 1 - i] for i in range(order)]


def rising_factorials(eta: Scalar, largest: int) -> list[Scalar]:
    """Return 1, eta, eta (eta+1), .. eta (eta+1) .. (eta+largest-1) [-]."""
    rising = [jnp.ones_like(eta)]
    for k in range(largest):
        rising.append(rising[-1] * (eta + k))
    return rising
