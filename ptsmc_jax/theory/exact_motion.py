"""Exact motion of a prescribed-time law before the hand-over, and the motion of the plant for a given error.

"Exact" means without sampling, noise and switching. Read `exact_error_and_s` first, then `exact_motion` (state of the
plant).
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ptsmc_jax.laws.kinematics import AdditiveKinematics, Kinematics, MultiplicativeKinematics, SecondOrderKinematics
from ptsmc_jax.laws.prescribed_time import PrescribedTimeChain, PrescribedTimeLaw
from ptsmc_jax.numerics import attitude, matrices
from ptsmc_jax.numerics.pytrees import Scalar, Vector
from ptsmc_jax.plants.rigid_body import AttitudeState
from ptsmc_jax.theory.closed_forms import exact_chain, exact_error

State = Float[Array, " twice"]
Errors = tuple[Vector, Vector, Vector]


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
    # q4^2 = 1 - |v|^2 is the distance to the singularity; at or below 0 the path leaves the unit ball
    error, error_rate, acceleration = errors
    rate_f, acceleration_f = target.vector_rates()
    q, square = attitude.from_vector_part(target.q[:3] + error, target.q[3])
    w = 2.0 * attitude.t_inverse_times(q, rate_f + error_rate)
    turning = 2.0 * (acceleration_f + acceleration) + 0.5 * jnp.dot(w, w) * q[:3]
    return Motion(AttitudeState(q, w), attitude.t_inverse_times(q, turning), square)


@plant_motion.register
def _(kinematics: MultiplicativeKinematics, target: Any, start: Any, errors: Errors) -> Motion:
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
    # Newton's method solves F(t, x_1, x_2) = x_1' for x_2 from the initial x_2, in one step if F is linear in x_2
    error, error_rate, acceleration = errors
    model, n = kinematics.model, kinematics.model.inputs

    def newton_step(_: Any, x: State) -> State:
        residual = model.position_rate(target, x) - error_rate
        return jnp.concatenate([error, x[n : 2 * n] - matrices.solve(model.rate_jacobian(target, x), residual)])

    x = jax.lax.fori_loop(0, 8, newton_step, jnp.concatenate([error, start[n : 2 * n]]))
    w_dot = matrices.solve(model.rate_jacobian(target, x), acceleration - model.coasting_acceleration(target, x))
    return Motion(x, w_dot, kinematics.singularity_distance(x, target))
