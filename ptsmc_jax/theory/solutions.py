"""Exact motion of Theorems 1 to 3 before the hand-over: closed forms, motion of the plant, and torque of a scenario.

"Exact" means without sampling, noise and switching. Read `exact_error` first (closed form of the second-order law,
attitude), then `exact_chain` (any order), `exact_sizes` (error and s of a scenario) and `exact_path` (its torque). Here
tau = t_f - t and r = tau / t_f.
"""

import functools
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from ptsmc_jax import programs
from ptsmc_jax.batching import lapack
from ptsmc_jax.laws.kinematics import AdditiveKinematics, Kinematics, MultiplicativeKinematics, SecondOrderKinematics
from ptsmc_jax.laws.prescribed_time import (
    PrescribedTimeChain,
    PrescribedTimeLaw,
    rising_factorials,
    surface_coefficients,
)
from ptsmc_jax.numerics import attitude, guards, matrices
from ptsmc_jax.numerics.pytrees import Scalar, Vector
from ptsmc_jax.plants.rigid_body import AttitudeState
from ptsmc_jax.simulation.assembly import Parts

Derivatives = Float[Array, " n"]  # of an error, or the states of a chain
State = Float[Array, " twice"]
Errors = tuple[Vector, Vector, Vector]

VISITED = 64  # number of states on the exact motion, and number of states with zero error


class ExactError(NamedTuple):
    """Attitude error vector, its derivatives and s before the hand-over."""

    error: Array  # [-]
    error_rate: Array  # [1/s]
    s: Array  # [-]
    acceleration: Array  # [1/s^2]


class ChainMotion(NamedTuple):
    """States of a chain, s, and x_n'."""

    x: Array  # (n,)
    s: Array
    acceleration: Array  # x_n', which is the input if f = 0, g = 1 and d = 0


def exact_error(t: Scalar, t_f: Scalar, eta: Scalar, error: Vector, error_rate: Vector) -> ExactError:
    """Return the motion of each component of the attitude error vector under the second-order law.

        x(t) = r^eta (x(0) - s(0) ln r),  s(t) = s(0) r^eta,  s(0) = t_f x'(0) + eta x(0),  r = (t_f - t) / t_f

    Args:
        t: time since the start of the run [s], in the approach phase (below t_f).
        t_f: prescribed time [s].
        eta: exponent of the law [-].
        error: x(0), attitude error vector at t = 0, (m,) [-].
        error_rate: x'(0), its derivative at t = 0, (m,) [1/s].
    """
    tau = t_f - t
    r = tau / t_f
    s0 = t_f * error_rate + eta * error
    decay = r**eta
    x, s = decay * (error - s0 * jnp.log(r)), s0 * decay
    x_dot = (s - eta * x) / tau
    return ExactError(x, x_dot, s, -(eta - 1.0) * x_dot / tau - eta * s / tau**2)


def exact_chain(t: Scalar, t_f: Scalar, eta: Scalar, x0: Derivatives) -> ChainMotion:
    """Return the motion of an integrator chain of order n under law (52), with d = 0 and K = 0.

    The surface decays as s(t) = s(0) r^(eta+n-2). The function integrates y^(n-1) = s(0) t_f^-(eta+n-2) / tau for
    y = x_1 / tau^eta, n-1 times.

    Args:
        t: time since the start of the run [s], in the approach phase (below t_f).
        t_f: prescribed time [s].
        eta: exponent of the law [-].
        x0: states at t = 0, (n,), in the states' own units.
    """
    n = x0.shape[0]
    c = surface_coefficients(eta, n)
    s0 = sum((c[i] * t_f**i * x0[i] for i in range(n)), jnp.zeros_like(t_f))  # s of (37) at t = 0
    y = [free + s0 * forced for free, forced in zip(*scaled_responses(t, t_f, eta, x0), strict=True)]
    x = derivatives_from_scaled(t, t_f, eta, y)
    return ChainMotion(jnp.stack(x[:n]), s0 * ((t_f - t) / t_f) ** (eta + n - 2), x[n])


def scaled_responses(t: Scalar, t_f: Scalar, eta: Scalar, x0: Derivatives) -> tuple[list[Scalar], list[Scalar]]:
    """Return the two parts of y, y', .. y^(n) for y = x_1 / r^eta: the free response and the response to s(0) = 1.

    Args:
        t: time since the start of the run [s], in the approach phase.
        t_f: prescribed time [s].
        eta: exponent of the law [-].
        x0: states at t = 0, (n,), in the states' own units.

    Returns:
        The n + 1 values of the free response to x0 with s(0) = 0, and the n + 1 values that s(0) = 1 adds.
    """
    n, tau = x0.shape[0], t_f - t
    rising = rising_factorials(eta, n)
    initial = [
        sum((math.comb(k, j) * x0[j] * rising[k - j] * t_f ** (j - k) for j in range(k + 1)), jnp.zeros_like(t))
        for k in range(n - 1)
    ]
    free, forced = [], []
    for j in range(n + 1):
        terms = (initial[k] * t ** (k - j) / math.factorial(k - j) for k in range(j, n - 1))
        free.append(sum(terms, jnp.zeros_like(t)))
        integral = _integral(t, t_f, n - 2 - j) if j < n - 1 else tau ** (n - 2 - j)
        forced.append(t_f ** (2 - n) * integral)
    return free, forced


def _integral(t: Scalar, t_f: Scalar, p: int) -> Scalar:
    """Return the integral of (t - u)^p / p! / (t_f - u) over 0 < u < t [s^p]."""
    tau = t_f - t
    total = (-tau) ** p * jnp.log(t_f / tau)
    for j in range(1, p + 1):
        total += math.comb(p, j) * (-tau) ** (p - j) * (t_f**j - tau**j) / j
    return total / math.factorial(p)


def derivatives_from_scaled(t: Scalar, t_f: Scalar, eta: Scalar, y: list[Scalar], apply=lambda v: v) -> list[Scalar]:
    """Return x_1, x_1', .. of x_1 = r^eta y by Leibniz's rule, as many as y has values.

    Args:
        t: time since the start of the run [s], in the approach phase.
        t_f: prescribed time [s].
        eta: exponent of the law [-].
        y: y, y', .. at t, see `scaled_responses`.
        apply: function applied to each factor of y. With `abs`, bounds on y give bounds on x_1 and its derivatives.
    """
    r = (t_f - t) / t_f
    falling = [jnp.ones_like(eta)]
    for k in range(len(y)):
        falling.append(-falling[-1] * (eta - k))
    derivatives = [apply(falling[p] * r ** (eta - p) * t_f**-p) for p in range(len(y))]
    zero = jnp.zeros_like(r)
    return [sum((math.comb(k, j) * derivatives[k - j] * y[j] for j in range(k + 1)), zero) for k in range(len(y))]


class Motion(NamedTuple):
    """Motion of a plant whose error follows the closed form."""

    x: Any  # state
    w_dot: Array  # (m,) derivative of the velocity
    singularity_distance: Array  # distance to the singularity, positive until the motion reaches the singularity


def exact_error_and_s(law: PrescribedTimeLaw, t: Scalar, start: Float[Array, "m n"]) -> tuple[Vector, Vector]:
    """Return the error and s, (m,) each, of the exact motion at time t [s] in the approach phase.

    Args:
        law: the prescribed-time law.
        t: time since the start of the run [s], in the approach phase.
        start: each component of the error and its derivatives at t = 0, (m, n), see `Kinematics.derivatives`.
    """
    if isinstance(law, PrescribedTimeChain):
        chain = exact_chain(t, law.t_f, law.eta, start[0])
        return chain.x[:1], jnp.reshape(chain.s, 1)
    motion = exact_error(t, law.t_f, law.eta, start[:, 0], start[:, 1])
    return motion.error, motion.s


def exact_motion(law: PrescribedTimeLaw, t: Scalar, target: Any, start: Any, errors: Float[Array, "m n"]) -> Motion:
    """Return the motion of the plant that has the error of `exact_error_and_s`.

    Args:
        law: the prescribed-time law.
        t: time since the start of the run [s], in the approach phase.
        target: the reference at t.
        start: the initial state.
        errors: each component of the error and its derivatives at t = 0, (m, n).
    """
    if isinstance(law, PrescribedTimeChain):  # nowhere singular
        chain = exact_chain(t, law.t_f, law.eta, errors[0])
        return Motion(chain.x, jnp.reshape(chain.acceleration, 1), jnp.ones_like(t))
    motion = exact_error(t, law.t_f, law.eta, errors[:, 0], errors[:, 1])
    return plant_motion(law.kinematics, target, start, (motion.error, motion.error_rate, motion.acceleration))


@functools.singledispatch
def plant_motion(kinematics: Kinematics, target: Any, start: Any, errors: Errors) -> Motion:
    """Return the plant's state, w' and distance to the singularity for an error and its derivatives.

    Args:
        kinematics: error kinematics, which select the implementation.
        target: the reference.
        start: the initial state, near which the solution is selected if several states have this error.
        errors: eps, eps' [1/s] and eps'' [1/s^2], (m,) each.

    Raises:
        NotImplementedError: if there is no implementation for these kinematics.
    """
    raise NotImplementedError


@plant_motion.register
def _(kinematics: AdditiveKinematics, target: Any, start: Any, errors: Errors) -> Motion:
    """Return the motion for the error q_1 - q_1f; see `plant_motion`."""
    # q4^2 = 1 - |v|^2 is the distance to the singularity; at or below 0 the path leaves the unit ball
    error, error_rate, acceleration = errors
    rate_f, acceleration_f = attitude.vector_rates(*target)
    q, square = attitude.from_vector_part(target.q[:3] + error, target.q[3])
    w = 2.0 * attitude.t_inverse_times(q, rate_f + error_rate)
    turning = 2.0 * (acceleration_f + acceleration) + 0.5 * jnp.dot(w, w) * q[:3]
    return Motion(AttitudeState(q, w), attitude.t_inverse_times(q, turning), square)


@plant_motion.register
def _(kinematics: MultiplicativeKinematics, target: Any, start: Any, errors: Errors) -> Motion:
    """Return the motion for the vector part of q_f* q; see `plant_motion`."""
    # q_e4^2 = 1 - |v|^2 is the distance to the singularity
    error, error_rate, acceleration = errors
    q_e, square = attitude.from_vector_part(error, jnp.ones(()))
    w_e = 2.0 * attitude.t_inverse_times(q_e, error_rate)
    q = attitude.multiply(target.q, q_e)
    w_f = attitude.rotate(attitude.conjugate(q_e), target.w)
    x = AttitudeState(q, w_e + w_f)
    turning = attitude.t_inverse_times(q_e, 2.0 * acceleration + 0.5 * jnp.dot(w_e, w_e) * q_e[:3])
    return Motion(x, kinematics.relative(x, target).feedforward + turning, square)


@plant_motion.register
def _(kinematics: SecondOrderKinematics, target: Any, start: Any, errors: Errors) -> Motion:
    """Return the motion of a custom second-order system; see `plant_motion`."""
    # Newton's method solves F(t, x_1, x_2) = x_1' for x_2 from the initial x_2, in one step if F is linear in x_2
    error, error_rate, acceleration = errors
    model, n = kinematics.model, kinematics.model.inputs

    def newton_step(_: Any, x: State) -> State:
        residual = model.position_rate(target, x) - error_rate
        return jnp.concatenate([error, x[n : 2 * n] - matrices.solve(model.rate_jacobian(target, x), residual)])

    x = jax.lax.fori_loop(0, 8, newton_step, jnp.concatenate([error, start[n : 2 * n]]))
    w_dot = matrices.solve(model.rate_jacobian(target, x), acceleration - model.coasting_acceleration(target, x))
    return Motion(x, w_dot, kinematics.singularity_distance(x, target))


def state_envelope(
    t: Scalar, t_f: Scalar, eta: Scalar, x0: Derivatives, s0: Scalar, residual: Scalar
) -> tuple[Derivatives, Derivatives]:
    """Return centre and half width, (n,) each, of the interval that contains x_1 .. x_n before the hand-over.

    The interval follows from |s|^2 <= s0^2 r^(2 (eta+n-2)) + c tau^n of `envelopes.sliding_envelope`. The centre is
    the exact solution without s. Each of the n-1 integrations of |y^(n-1)| <= |s| / tau^(eta+n-1) adds to the width.
    The result generalises (20)-(22) and (47)-(50), with explicit constants.

    Args:
        t: time since the start of the run [s], in the approach phase.
        t_f: prescribed time [s].
        eta: exponent of the law [-].
        x0: states at t = 0, (n,), in the states' own units.
        s0: bound on |s| at t = 0, see `envelopes.sliding_envelope`.
        residual: coefficient c of tau^n, see `envelopes.sliding_envelope`.
    """
    n, tau = x0.shape[0], t_f - t
    free, forced = scaled_responses(t, t_f, eta, x0)
    scale = jnp.sqrt(residual) * tau ** (n / 2)  # bound on |s| inside the boundary layer
    widths = []
    for j in range(n):
        p = n - 2 - j
        factor = 1.0 / ((eta - n / 2 + j) * math.factorial(p)) if p >= 0 else 1.0
        layer_width = scale * factor * tau**-j * (t_f / tau) ** eta
        widths.append(jnp.abs(s0 * forced[j]) + layer_width)
    centre = derivatives_from_scaled(t, t_f, eta, free)[:n]
    half = derivatives_from_scaled(t, t_f, eta, [*widths, jnp.zeros_like(tau)], jnp.abs)[:n]
    return jnp.stack(centre), jnp.stack(half)


def without_devices(parts: Parts) -> Parts:
    """Return the parts without clock and devices.

    The exact motion does not depend on them, so that one compiled program serves all scenarios.
    """
    names = "plant", "disturbance", "reference", "controller", "initial", "t_end", "window", "settling_angle"
    return Parts(**{name: getattr(parts, name) for name in names}, observer=None)


def initial_errors(parts: Parts) -> Float[Array, "m n"]:
    """Return each component of the error and its derivatives x_1 .. x_n at t = 0, in the states' own units."""
    kinematics, target = parts.controller.kinematics, parts.reference(jnp.zeros_like(parts.t_end))
    return kinematics.derivatives(parts.aligned_initial, target)


def exact_sizes(parts: Parts, t: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Return the 2-norms of the error and of s along the exact motion at times t (time,) [s] in the approach phase."""
    error, s = _exact_sizes(without_devices(parts), jnp.asarray(t))
    return np.asarray(error), np.asarray(s)


@programs.jit
def _exact_sizes(parts: Parts, t: Array) -> tuple[Array, Array]:
    """Return the 2-norms of the error and of s at times t, see `exact_sizes`."""

    def norms(time: Scalar) -> tuple[Scalar, Scalar]:
        error, s = exact_error_and_s(parts.controller, time, initial_errors(parts))
        return guards.norm(error), guards.norm(s)

    return jax.vmap(norms)(t)


def exact_input(parts: Parts, t: Scalar) -> tuple[Array, Scalar]:
    """Return the input (m,) [N m] of the exact motion at t [s], and the distance to the singularity.

    For attitudes this distance is 1 - |v|^2 [-], the square of the scalar part. The motion does not exist if it is 0
    or less.
    """
    motion = exact_motion(parts.controller, t, parts.reference(t), parts.initial, initial_errors(parts))
    d = parts.disturbance(t, parts.plant.with_hidden_at_rest(motion.x))
    plant = parts.plant.planning_plant(parts.controller.model)
    return plant.input_for(t, motion.x, motion.w_dot, d), motion.singularity_distance


def visited_states(parts: Parts) -> tuple[Array, Any]:
    """Return targets and states that a run of a second-order plant visits, (2 VISITED,) each, in the states' units.

    They are samples for estimates of rates and bounds. The first half is on the exact motion, at times that become
    denser toward the hand-over. The second half is at the same targets with zero error.
    """
    return _visited_states(without_devices(parts))


@programs.jit
def _visited_states(parts: Parts) -> tuple[Array, Any]:
    """Return targets and states at 2 `VISITED` points of a run, see `visited_states`."""
    law, fractions = parts.controller, jnp.linspace(0.0, 1.0, VISITED)
    zero_errors = (jnp.zeros(parts.plant.inputs),) * 3

    def on_exact_motion(t: Scalar) -> tuple[Any, Any]:
        target = parts.reference(t)
        return target, exact_motion(law, t, target, parts.initial, initial_errors(parts)).x

    def at_zero_error(t: Scalar) -> tuple[Any, Any]:
        target = parts.reference(t)
        return target, plant_motion(law.kinematics, target, parts.initial, zero_errors).x

    early = lapack.vmap(on_exact_motion)(law.t_f - law.t_f * (law.delta / law.t_f) ** fractions)
    late = lapack.vmap(at_zero_error)(parts.t_end * fractions)
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), early, late)


def exact_path(parts: Parts, points: int = 2000) -> tuple[Array, Array, Array]:
    """Return times in the approach phase [s], and the law's input and distance to its singularity at these times.

    They belong to the exact motion, without noise, devices and disturbance; see `exact_input`. The times become denser
    toward the hand-over to the hold phase. Shapes: (points,), (points, m) and (points,).
    """
    return _exact_path(without_devices(parts), points)


@programs.jit(static_argnames="points")
def _exact_path(parts: Parts, points: int) -> tuple[Array, Array, Array]:
    """Return times (points,) [s], inputs and distances to the singularity, see `exact_path`."""
    law = parts.controller
    t = law.t_f - law.t_f * (law.delta / law.t_f) ** jnp.linspace(0.0, 1.0, points)
    u, singularity_distance = lapack.vmap(lambda time: exact_input(parts, time))(t)
    return t, u, singularity_distance


def exact_peak(parts: Parts, points: int = 400) -> Scalar:
    """Return the largest input of the exact motion before the hand-over [N m].

    The initial state, the reference and the order of the system may be any.
    """
    _, u, _ = exact_path(parts, points)
    return jnp.max(jnp.abs(u))
