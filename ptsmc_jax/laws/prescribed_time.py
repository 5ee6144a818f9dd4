"""The paper's prescribed-time sliding mode laws: spacecraft (56)-(60), own plants (29), chains (36)-(40), (52).

Order 2 of the chain is the second-order system (6) with (7), (9), (10) and (24).
"""

import math
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ptsmc_jax.batching import lapack
from ptsmc_jax.laws.base import Motion, PrescribedTimeLaw, Sample, SecondOrderLaw
from ptsmc_jax.laws.closed_forms import exact_chain, expansion
from ptsmc_jax.laws.error_motions import ErrorOfChain, ErrorOfSystem, ErrorQuaternion, ErrorVector
from ptsmc_jax.numerics import attitude, guards, matrices
from ptsmc_jax.numerics.pytrees import Leaf, Scalar, Vector, pytree
from ptsmc_jax.plants.integrator_chain import Chain
from ptsmc_jax.plants.rigid_body import AttitudeState, Spacecraft
from ptsmc_jax.plants.second_order import System
from ptsmc_jax.signals.references import Target

State = Float[Array, " twice"]


@dataclass(frozen=True)
class _Attitude(SecondOrderLaw):
    """The base of both laws for a spacecraft: K1 acts with an effective gain of K1/2 in (60)."""

    model: Spacecraft  # the nominal plant

    def reaching_gain(self) -> Scalar:
        """K1 of (60) [1/s]: half of what (29)'s K1 does."""
        return self.k1

    def switching_rate(self, k2: Scalar, visited: tuple[Any, Any] | None = None) -> Scalar:
        """|T J^-1| K2 / 2 at most: |T|_2 = 1 for a unit quaternion."""
        return 0.5 * guards.norm(self.model.inertia_inverse) * k2


@pytree
@dataclass(frozen=True)
class PrescribedTime(ErrorVector, _Attitude):
    """Disturbance-observer based law on the additive error eps_1 = q_1 - q_1f (4), handed over at t_f - delta.

    (56), (57) before and (59), (60) after the hand-over. Differences from the paper, besides those of `SecondOrderLaw`:
    `T` of (1) is both torque and matrix and q both quaternion and its scalar, here the torque is u and the scalar q4.
    The law is singular at q4 = 0, 180 degrees from the inertial frame's identity wherever the reference is, and cannot
    cross it: `align` chooses the sign of q, `clearance` says how far away the singularity is. So "bounded control" is
    not global: the bound grows like 1/q4. Between attitudes on either side of the identity the path leads past it,
    which may be the long way round: from 150 to -150 degrees about an axis the body turns by 300 degrees. After the
    hand-over nothing stays "at the origin": the rates are c (`surface_rate`, 1 1/s in the paper) and K1/2.
    """

    def motion(
        self, target: Target, start: AttitudeState, error: Vector, error_rate: Vector, acceleration: Vector
    ) -> Motion:
        """q4^2 = 1 - |v|^2 stands for the clearance; at or below 0 the path leaves the unit ball."""
        rate_f, acceleration_f = target.vector_rates()
        q, square = attitude.from_vector_part(target.q[:3] + error, target.q[3])
        w = 2.0 * attitude.t_inverse_times(q, rate_f + error_rate)
        turning = 2.0 * (acceleration_f + acceleration) + 0.5 * jnp.dot(w, w) * q[:3]
        return Motion(AttitudeState(q, w), attitude.t_inverse_times(q, turning), square)


@pytree
@dataclass(frozen=True)
class PrescribedTimeMultiplicative(ErrorQuaternion, _Attitude):
    """The same law on the vector part v of the error quaternion q_e = q_f* q, whatever the inertial frame.

    With R the rotation from the reference's axes to the body's and w_e = w - R w_f: v' = T(q_e) w_e / 2, and

        u = w x J w - d_hat + J (R w_f' - w_e x R w_f) + J T(q_e)^-1 (wanted + |w_e|^2 v / 2).

    Singular only at q_e4 = 0, a true error of 180 degrees, which a run from rest below that never meets; with an
    initial rate |v(0)| + t_f |v'(0)| / (e eta) < 1 is enough. `align` makes q_e4 positive at t = 0, and it stays so: v
    and -v lead along the same path, the short way round.
    """

    def motion(
        self, target: Target, start: AttitudeState, error: Vector, error_rate: Vector, acceleration: Vector
    ) -> Motion:
        """q_e4^2 = 1 - |v|^2 stands for the clearance."""
        q_e, square = attitude.from_vector_part(error, jnp.ones_like(self.t_f))
        w_e = 2.0 * attitude.t_inverse_times(q_e, error_rate)
        q = attitude.multiply(target.q, q_e)
        w_f = attitude.rotate(attitude.conjugate(q_e), target.w)
        x = AttitudeState(q, w_e + w_f)
        turning = attitude.t_inverse_times(q_e, 2.0 * acceleration + 0.5 * jnp.dot(w_e, w_e) * q_e[:3])
        return Motion(x, self.relative(x, target).feedforward + turning, square)


@pytree
@dataclass(frozen=True)
class PrescribedTimeSystem(ErrorOfSystem, SecondOrderLaw):
    """Law (29) for a second-order system (25) of one's own; the Jacobians of F and dF/dt by automatic differentiation.

    x_1 is the error, so F may know the time: a moving reference is part of it. dF/dx2 G must be invertible along the
    run, and F(t, 0, x_2) = 0 must hold for one x_2 only, which x_2 then goes to. (57) is this law with dF/dx2 = T/2,
    the disturbance's input matrix J^-1 and its K1 twice the K1 of (29); (29)'s K |dF/dx2| is `influence` / 2 times K2,
    with the disturbance's own input matrix inside the norm: K2 bounds d, not what it does to x_2'.
    """

    model: System  # the nominal plant

    def motion(self, target: Scalar, start: State, error: Vector, error_rate: Vector, acceleration: Vector) -> Motion:
        """x_2 from F(t, x_1, x_2) = x_1' by Newton's method from the initial x_2: one step where F is linear in x_2."""
        n = self.model.inputs

        def newton(_: Any, x: State) -> State:
            off = self.model.position_rate(target, x) - error_rate
            return jnp.concatenate([error, x[n : 2 * n] - matrices.solve(self.model.slope(target, x), off)])

        x = jax.lax.fori_loop(0, 8, newton, jnp.concatenate([error, start[n : 2 * n]]))
        w_dot = matrices.solve(self.model.slope(target, x), acceleration - self.model.coasting_acceleration(target, x))
        return Motion(x, w_dot, self.clearance(x, target))

    def switching_rate(self, k2: Scalar, visited: tuple[Any, Any] | None = None) -> Scalar:
        """|dF/dx2 D| K2, the largest over the states that are visited."""
        assert visited is not None
        times, states = visited
        return 0.5 * jnp.max(lapack.vmap(self.influence)(states, times)) * k2


@pytree
@dataclass(frozen=True)
class PrescribedTimeChain(ErrorOfChain, PrescribedTimeLaw):
    """Law (52) for the integrator chain (35), with the surfaces (37) before and (39) after the hand-over.

    For order 2 it is (24) on (6). Differences from the paper: its sums of (38), (40) and (52) run to n-1, but x_(n+1)
    does not exist: they end at n-2; the s of Theorem 3 lacks the factor (t_f - t)^(eta+n-1) of (36); in (51) "-K s s"
    must read -K1 s^2; sign(s) is tanh(s / sign_width) (0: exact). The paper's law has no observer, d_hat = 0 and
    K2 = K; with an observer (Remark 3) its estimate and its bound take their place. With `surface_rate` c the poles of
    (39) are c times those of a: a_i c^(n-i) stands for a_i, and c = 1 is the paper's.
    """

    model: Chain  # the nominal plant
    a: Leaf  # (n-1,) a_1 .. a_(n-1) of (39), whose matrix must be Hurwitz [1/s^(n-i)]

    @property
    def order(self) -> int:
        """Order n of the chain."""
        return self.model.order

    def torque(
        self, t: Scalar, hold: Bool[Array, ""], x: Float[Array, " n"], target: Any, d_hat: Vector, k2: Scalar
    ) -> tuple[Vector, Vector]:
        """Input (1,) by the first branch of (52) before and the second after the hand-over, and s (37), (39), (1,).

        k2: bound on the error of d_hat, K where nothing is estimated.
        """
        n = self.order
        tau = jnp.where(hold, 1.0, self.t_f - t)  # guarded: t_f - t may be 0 in hold
        c = expansion(self.eta, n)
        a = self.surface()
        s = jnp.dot(_surface_weights(c, [*a, 1.0], tau, hold), x)
        rates = [jnp.where(hold, a[i], (c[i] - (i + 1) * c[i + 1]) * tau ** (i - n + 1)) for i in range(n - 1)]
        reaching = jnp.where(hold, self.k1, (self.eta + n - 2) / tau**n)
        equivalent = jnp.dot(jnp.stack(rates), x[1:]) + reaching * s
        x_n_dot = -equivalent - k2 * guards.smooth_sign(s, self.layer(hold))
        u = (x_n_dot - self.model.drift(x) - d_hat) / self.model.input_gain(x)
        return u, jnp.reshape(s, 1)

    def command(
        self, memory: Any, now: Sample, x: Float[Array, " n"], target: Any, d_hat: Vector, k2: Scalar
    ) -> tuple[Vector, Vector, Any]:
        """`torque`, or with implicit sampling the input (1,) that brings s to `landing`: s+ = s_0 + g x_n'."""
        if not self.implicit:
            return super().command(memory, now, x, target, d_hat, k2)
        n, h, c, r = self.order, now.dt, expansion(self.eta, self.order), self.remaining_share(now)
        # the states at the end of the period are drifted + x_n' pushed: Taylor's series of a chain
        drifted = [sum(h ** (j - i) / math.factorial(j - i) * x[j] for j in range(i, n)) for i in range(n)]
        pushed = jnp.stack([h ** (n - i) / math.factorial(n - i) for i in range(n)])
        a, left = [*self.surface(), 1.0], jnp.where(now.hold, 1.0, self.t_f - now.t)
        weights_end = _surface_weights(c, a, r * left, self.in_hold(now.t, now.t + h, now.hold))
        # before the hand-over s = 0 lets x_1 fall like r^eta
        at_hand_over = jnp.reshape(sum(a[i] * r ** (self.eta - i) * x[i] for i in range(n)), 1)
        s = jnp.reshape(jnp.dot(_surface_weights(c, a, left, now.hold), x), 1)
        s_0 = jnp.reshape(jnp.dot(weights_end, jnp.stack(drifted)), 1)
        g = jnp.dot(weights_end, pushed)
        s_end = self.landing(now, s, at_hand_over, self.eta + n - 2, self.k1, g * k2)
        u = ((s_end - s_0) / g - self.model.drift(x) - d_hat) / self.model.input_gain(x)
        return u, s, memory

    def exact(self, t: Scalar, start: Float[Array, "1 n"]) -> tuple[Vector, Vector]:
        """x_1 and s, (1,) each."""
        motion = exact_chain(t, self.t_f, self.eta, start[0])
        return motion.x[:1], jnp.reshape(motion.s, 1)

    def exact_motion(self, t: Scalar, target: Any, start: Float[Array, " n"], errors: Float[Array, "1 n"]) -> Motion:
        """State and x_n'; a chain is nowhere singular."""
        motion = exact_chain(t, self.t_f, self.eta, errors[0])
        return Motion(motion.x, jnp.reshape(motion.acceleration, 1), jnp.ones_like(t))

    def switching_rate(self, k2: Scalar, visited: tuple[Any, Any] | None = None) -> Scalar:
        """K2."""
        return k2

    def surface(self) -> Float[Array, " roots"]:
        """a_i c^(n-i) [1/s^(n-i)]: time runs c times as fast on the surface."""
        n = self.order
        return jnp.stack([self.a[i] * self.surface_rate ** (n - 1 - i) for i in range(n - 1)])


def _surface_weights(c: list[Scalar], a: list, tau: Scalar, hold: Bool[Array, ""]) -> Float[Array, " n"]:
    """Weights of a chain's states in s: a where `hold` (39), else c_i tau^i (37), tau = t_f - t [s]."""
    return jnp.stack([jnp.where(hold, a[i], c[i] * tau**i) for i in range(len(c))])
