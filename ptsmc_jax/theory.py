"""Exact solutions, envelopes and bounds: what theory says a run must do."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from ptsmc_jax import numerics
from ptsmc_jax.rollout import Parts

Scalar = Float[Array, ""]
Vector = Float[Array, " n"]


class ErrorMotion(NamedTuple):
    """Attitude error vector, its derivative and s before the hand-over."""

    error: Array  # [-]
    error_rate: Array  # [1/s]
    s: Array  # [-]


def exact_error(t: Scalar, t_f: Scalar, eta: Scalar, error: Vector, error_rate: Vector) -> ErrorMotion:
    """Closed form of the second-order law before the hand-over for a perfect disturbance estimate and K2 = 0.

    x(t) = r^eta (x(0) + s(0) L), s(t) = s(0) r^eta, with r = (t_f - t)/t_f, L = ln(1/r), s(0) = t_f x'(0) + eta x(0):
    each component of the attitude error vector, and the system (6). t, t_f [s], t < t_f; error, error_rate at t = 0.
    """
    r = (t_f - t) / t_f
    log = -jnp.log(r)
    s0 = t_f * error_rate + eta * error
    decay = r**eta
    x = decay * (error + s0 * log)
    return ErrorMotion(x, (s0 * decay - eta * x) / (t_f - t), s0 * decay)


def first_torque(inertia: Float[Array, "3 3"], q: Float[Array, "4"], eta: Scalar, t_f: Scalar) -> Float[Array, "3"]:
    """Torque at t = 0 [N m] from rest to the fixed reference identity, d_hat(0) = 0: -2 eta^2 J v / (q4 t_f^2).

    inertia [kg m^2], t_f [s]. For a rotation by theta about n: 2 eta^2 |(J n)_i| tan(theta/2) / t_f^2 about axis i.
    """
    return -2.0 * eta**2 * (inertia @ q[:3]) / (q[3] * t_f**2)


def later_peak_ratio(eta: Scalar) -> Scalar:
    """The braking peak of the torque over its first value [-], for small angles and 2 < eta < 3.

    R = (eta-1)/(eta-2) exp(-(2 eta-3)/(eta-1)), at ln r = -(2 eta-3)/((eta-1)(eta-2)): 1 at eta = 2.386, 7.4 at 2.05.
    """
    return (eta - 1.0) / (eta - 2.0) * jnp.exp(-(2.0 * eta - 3.0) / (eta - 1.0))


def later_peak_time(eta: Scalar, t_f: Scalar) -> Scalar:
    """When that peak comes [s], for small angles."""
    return t_f * (1.0 - jnp.exp(-(2.0 * eta - 3.0) / ((eta - 1.0) * (eta - 2.0))))


def sliding_envelope(parts: Parts, t: ArrayLike) -> np.ndarray:
    """Bound on |s|_2 before the hand-over for the continuous loop with the smooth sign and no noise; t (time,) [s].

    |s|^2 <= |s(0)|^2 r^(2 eta) + beta tau^2 / (eta - 1), beta = sup(|T J^-1| K2)/2 * 3 * 0.2785 width, r = tau/t_f:
    0.2785 = max of x (1 - tanh x), the most that the smooth sign gives away per component.
    """
    controller = parts.controller
    target = parts.reference(jnp.zeros_like(parts.t_end))
    x0 = controller.align(parts.initial, target)
    error, error_rate = controller.errors(x0, target)
    t_f, eta = float(controller.t_f), float(controller.eta)
    s0 = np.linalg.norm(t_f * np.asarray(error_rate) + eta * np.asarray(error))
    bound = parts.observer.error_bound()
    # |T J^-1|_F <= |T|_2 |J^-1|_F = |J^-1|_F for a unit quaternion
    switching = float(numerics.norm(controller.model.inertia_inverse) * jnp.maximum(bound.start, bound.floor))
    beta = switching / 2 * 3 * 0.2785 * float(controller.sign_width)
    tau = np.maximum(t_f - np.asarray(t), 0.0)
    return np.sqrt(s0**2 * (tau / t_f) ** (2 * eta) + beta * tau**2 / (eta - 1.0))


def predicted_path(parts: Parts, points: int = 2000) -> tuple[Array, Array]:
    """Times before the hand-over [s] and q4^2 along the exact error motion at them, (points,) each.

    The additive error law works in v alone; q4^2 = 1 - |v|^2 at or below 0 means that its path leaves the unit ball.
    """
    controller = parts.controller
    target = parts.reference(jnp.zeros_like(parts.t_end))
    x0 = controller.align(parts.initial, target)
    error, error_rate = controller.errors(x0, target)
    tau = controller.t_f * (controller.delta / controller.t_f) ** jnp.linspace(0.0, 1.0, points)
    t = controller.t_f - tau

    def square(time: Scalar) -> Scalar:
        motion = exact_error(time, controller.t_f, controller.eta, error, error_rate)
        return 1.0 - jnp.sum((parts.reference(time).q[:3] + motion.error) ** 2)

    return t, jax.vmap(square)(t)
