"""The base of the paper's prescribed-time laws: gains, phases, and the law of every second-order error motion."""

from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ptsmc_jax import formulas, programs
from ptsmc_jax.laws.closed_forms import exact_error
from ptsmc_jax.laws.error_motions import ErrorMotion
from ptsmc_jax.numerics import guards
from ptsmc_jax.numerics.pytrees import Leaf, Scalar, Vector


class SurfaceGains(NamedTuple):
    """Gains that both phases of the law have: s = c eps' + e eps, desired 2 eps'' = -a eps' - b s - switching."""

    c: Array  # [s] before the hand-over, [-] after
    e: Array  # [-] before the hand-over, [1/s] after
    a: Array  # [1/s]
    b: Array  # [1/s^2] before the hand-over, [1/s] after


class Motion(NamedTuple):
    """The motion of a plant whose error moves as prescribed."""

    x: Any  # state
    w_dot: Array  # (m,) derivative of its velocity
    clearance: Array  # how far from a singularity, positive on this side of it


class Sample(NamedTuple):
    """When a law is computed."""

    t: Scalar  # [s]
    hold: Bool[Array, ""]  # after the hand-over
    dt: Scalar  # length of the control period that begins, over which the input is held [s]


class Law(ErrorMotion):
    """A control law: besides the error that it drives to zero, all that the rollout asks of it."""

    t_f: Leaf  # prescribed time, or when the error is judged [s]
    delta: Leaf  # hand-over this long before t_f [s]
    tunable: ClassVar[tuple[str, ...]] = ()  # gains that tuning may move
    prescribed: ClassVar[bool] = False  # one of the paper's: its exact solution and its bounds are known

    @property
    def hand_over(self) -> Scalar:
        """t_s = t_f - delta [s]."""
        return self.t_f - self.delta

    def torque(
        self, t: Scalar, hold: Bool[Array, ""], x: Any, target: Any, d_hat: Vector, k2: Scalar
    ) -> tuple[Vector, Vector]:
        """Commanded input (m,) and sliding variable (m,).

        Args:
            t: time [s].
            hold: whether it is after the hand-over.
            x: state, as it is measured.
            target: of the reference at t.
            d_hat: estimated disturbance, (m,).
            k2: K2, bound on the 2-norm of its error.
        """
        raise NotImplementedError

    def begin(self) -> Any:
        """The law's memory before its first sample, a pytree of arrays; None: it never remembers anything."""
        return None

    def command(
        self, memory: Any, now: Sample, x: Any, target: Any, d_hat: Vector, k2: Scalar
    ) -> tuple[Vector, Vector, Any]:
        """The same as `torque` in the sampled loop, for laws that remember something, or look at the period ahead.

        Commanded input (m,), sliding variable, and the memory for the next sample.
        """
        u, s = self.torque(now.t, now.hold, x, target, d_hat, k2)
        return u, s, memory

    def in_hold(self, t: Array, t_next: Array, hold: Bool[Array, "..."]) -> Bool[Array, "..."]:
        """Which periods, from t to t_next [s], the hold's gains rule; hold: those that begin after the hand-over."""
        return hold

    @property
    def order(self) -> int:
        """Order n of the error's motion: 2, or that of a chain."""
        return 2


@dataclass(frozen=True)
class PrescribedTimeLaw(Law):
    """Base of the paper's laws: their gains, and the hand-over at t_f - delta (Remark 1).

    The paper's proofs call on LaSalle after t_f, but the system is not autonomous; V' <= -2 K1 V with V(t_f) = 0 is
    enough, and with delta > 0 V(t_f) is only small.
    """

    model: Any  # the nominal plant
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

    def layer(self, hold: Bool[Array, ""]) -> Scalar:
        """Thickness of the boundary layer, in the units of s before or after the hand-over.

        s has one more power of time before it, for each order above 1. The paper has the same number in both, with time
        in seconds: `layer_time` is that second.
        """
        return jnp.where(hold, self.sign_width, self.sign_width * self.layer_time ** (self.order - 1))

    def landing(
        self, now: Sample, s: Vector, at_hand_over: Vector, power: Scalar, rate: Scalar, switching: Scalar
    ) -> Vector:
        """The s (m,) at which implicit (backward Euler) sampling aims for the end of the period that begins.

        Where the law in continuous time would bring it, r^power s before the hand-over and e^(-rate h) s after it, and
        from there toward zero by what the switching term can do in the period, k = `switching`: s+ = target - k
        sign(s+), whose solution is sign(target) max(|target| - k, 0). Acary, Brogliato, Orlov, Chattering-free digital
        sliding-mode control with state observer and disturbance rejection, IEEE Trans. Automatic Control 57(5), 2012.
        There is no boundary layer to choose, and no border for delta.

        The surface is that of the period's end. In a period that the hand-over ends it is the hold's, where s is to be
        `at_hand_over`.
        """
        ends_in_hold = self.in_hold(now.t, now.t + now.dt, now.hold)
        before = jnp.where(ends_in_hold, at_hand_over, self.remaining_share(now) ** power * s)
        target = jnp.where(now.hold, jnp.exp(-rate * now.dt) * s, before)
        # slope 1 where there is nothing to switch against, at rest too
        return jnp.where(jnp.abs(target) < switching, 0.0, target - switching * jnp.sign(target))

    def in_hold(self, t: Array, t_next: Array, hold: Bool[Array, "..."]) -> Bool[Array, "..."]:
        """Which periods, from t to t_next [s], the hold's gains rule: with implicit sampling by where they end."""
        if not self.implicit:
            return hold
        by_rounding = guards.rounding(t_next - t, t_next)  # which must not cost a period
        return hold | (t_next > self.hand_over - by_rounding)

    def remaining_share(self, now: Sample) -> Scalar:
        """Share r of the time to t_f that is left at the end of the period that begins [-]; 1 in hold.

        At least 1e-9 of a period is left: powers of r, and what is divided by them, stay finite.
        """
        left = jnp.where(now.hold, 1.0, self.t_f - now.t)
        return jnp.where(now.hold, 1.0, jnp.maximum(left - now.dt, 1e-9 * now.dt) / left)

    def exact(self, t: Scalar, start: Float[Array, "m n"]) -> tuple[Vector, Vector]:
        """The error and s, (m,) each, of the exact motion at t [s] before the hand-over.

        start: each component of the error and its derivatives at t = 0, `derivatives`.
        """
        raise NotImplementedError

    def exact_motion(self, t: Scalar, target: Any, start: Any, errors: Float[Array, "m n"]) -> Motion:
        """The plant's motion at t in `exact`; target: at t, start: the initial state, errors: its `derivatives`."""
        raise NotImplementedError

    def switching_rate(self, k2: Scalar, visited: tuple[Any, Any] | None = None) -> Scalar:
        """Factor of -tau^(n-1) sign(s) in s' before the hand-over, and of -sign(s) after it, for K2 up to k2.

        visited: targets (points,) and states (points, ..) of a run, for a law whose factor depends on them.
        """
        raise NotImplementedError

    def boundary_layer(self, k2: Scalar, visited: tuple[Any, Any] | None = None) -> tuple[Scalar, Scalar]:
        """Fastest rate of the smooth sign's boundary layer before and after the hand-over [1/s], for K2 up to k2."""
        after = self.switching_rate(k2, visited) / self.sign_width
        return (self.t_f / self.layer_time) ** (self.order - 1) * after, after

    def reaching_rate(self) -> Scalar:
        """Rate at which s falls after the hand-over, but for the switching term [1/s]: K1 of (10), (29) and (40)."""
        return self.k1

    def surface(self) -> Float[Array, " roots"]:
        """a_1 .. a_(n-1) of the surface after the hand-over, s = x_n + a_(n-1) x_(n-1) + .. + a_1 x_1 [1/s^(n-i)]."""
        raise NotImplementedError

    def hold_rates(self) -> dict[str, float]:
        """Fastest decay after the hand-over [1/s], by the gain that sets it: toward the surface, and on it."""
        reaching, surface = _rates_of_hold(self)
        return {"k1": float(reaching), "surface_rate": float(np.max(np.abs(formulas.surface_roots(surface))))}


@programs.jit  # one program, where each of its operations would be one
def _rates_of_hold(law: PrescribedTimeLaw) -> tuple[Scalar, Float[Array, " roots"]]:
    return law.reaching_rate(), law.surface()


@dataclass(frozen=True)
class SecondOrderLaw(PrescribedTimeLaw):
    """The law of an error vector eps whose second derivative the input sets: (29), of which (57) and (60) are a case.

    s = tau eps' + eta eps and 2 eps'' = -2 (eta-1) eps'/tau - 2 eta s/tau^2 - N K2 sign(s) before the hand-over (26),
    s = eps' + c eps and 2 eps'' = -2 c eps' - b s - N K2 sign(s) after it (28), tau = t_f - t. N is the Frobenius norm
    of 2 d(eps'')/dd, |T J^-1| in (57) and 2 |dF/dx2| in (29): the paper names no norm; this one is smooth and not below
    the spectral norm that the proof needs where K2 bounds the 2-norm of the estimation error. c is `surface_rate`, in
    the paper 1 1/s, and b is `reaching_gain`.

    Differences from the paper: (29) lacks the x_1' of s = x_1 + x_1' after t_f and dF/dt for a moving reference; (60)
    and (57) have them. sign(s) is tanh(s / sign_width), per component (0: exact).
    """

    def reaching_gain(self) -> Scalar:
        """The coefficient b after the hand-over [1/s]: 2 K1 of (29)."""
        return 2.0 * self.k1

    def reaching_rate(self) -> Scalar:
        """Half of `reaching_gain` [1/s]: s' = -b/2 s but for the switching term."""
        return 0.5 * self.reaching_gain()

    def surface(self) -> Float[Array, "1"]:
        """(c,) [1/s]."""
        return jnp.reshape(self.surface_rate, 1)

    def exact(self, t: Scalar, start: Float[Array, "m 2"]) -> tuple[Vector, Vector]:
        """The error [-] and s, (m,) each."""
        exact = exact_error(t, self.t_f, self.eta, start[:, 0], start[:, 1])
        return exact.error, exact.s

    def exact_motion(self, t: Scalar, target: Any, start: Any, errors: Float[Array, "m 2"]) -> Motion:
        """State and w' by `motion`, for the error and derivatives of the closed form."""
        exact = exact_error(t, self.t_f, self.eta, errors[:, 0], errors[:, 1])
        return self.motion(target, start, exact.error, exact.error_rate, exact.acceleration)

    def motion(self, target: Any, start: Any, error: Vector, error_rate: Vector, acceleration: Vector) -> Motion:
        """State and w' for which the error and its derivatives are these; start: the initial state, for branches."""
        raise NotImplementedError

    def gains(self, t: Scalar, hold: Bool[Array, ""]) -> SurfaceGains:
        """Gains of the surfaces and of the law at t [s]; `hold`: after the hand-over."""
        tau = jnp.where(hold, 1.0, self.t_f - t)  # guarded: t_f - t may be 0 in hold
        return SurfaceGains(
            c=tau,
            e=jnp.where(hold, self.surface_rate, self.eta),
            a=jnp.where(hold, 2.0 * self.surface_rate, 2.0 * (self.eta - 1.0) / tau),
            b=jnp.where(hold, self.reaching_gain(), 2.0 * self.eta / tau**2),
        )

    def torque(
        self, t: Scalar, hold: Bool[Array, ""], x: Any, target: Any, d_hat: Vector, k2: Scalar
    ) -> tuple[Vector, Vector]:
        """Commanded input by the law above before and after the hand-over, and the sliding variable."""
        gains = self.gains(t, hold)
        error, error_rate = self.errors(x, target)
        s = gains.c * error_rate + gains.e * error
        switching = self.influence(x, target) * k2 * guards.smooth_sign(s, self.layer(hold))
        twice_acceleration = -switching - gains.a * error_rate - gains.b * s
        return self.invert(x, target, twice_acceleration, d_hat), s

    def command(
        self, memory: Any, now: Sample, x: Any, target: Any, d_hat: Vector, k2: Scalar
    ) -> tuple[Vector, Vector, Any]:
        """`torque`, or with implicit sampling the input that brings s to `landing`: s+ = s_0 + g eps''."""
        if not self.implicit:
            return super().command(memory, now, x, target, d_hat, k2)
        h, r = now.dt, self.remaining_share(now)
        start = self.gains(now.t, now.hold)
        ends_in_hold = self.in_hold(now.t, now.t + h, now.hold)
        end = self.gains(now.t + h, ends_in_hold)
        error, error_rate = self.errors(x, target)
        s = start.c * error_rate + start.e * error
        s_0 = end.c * error_rate + end.e * (error + h * error_rate)  # at the end, without acceleration
        g = h * end.c + end.e * h**2 / 2.0
        # Before the hand-over s = 0 lets eps fall like r^eta. The s handed over is made of the measured rate, not of
        # eta / delta times an attitude, whose noise that would multiply
        at_hand_over = r ** (self.eta - 1.0) * (error_rate + self.surface_rate * r * error)
        switching = g * 0.5 * self.influence(x, target) * k2
        s_end = self.landing(now, s, at_hand_over, self.eta, 0.5 * self.reaching_gain(), switching)
        return self.invert(x, target, 2.0 * (s_end - s_0) / g, d_hat), s, memory
