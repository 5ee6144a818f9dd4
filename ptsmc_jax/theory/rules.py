"""Design rules that follow from (57) and Theorem 2: first torque, shortest t_f, what is left after the hand-over."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from ptsmc_jax.numerics import attitude
from ptsmc_jax.numerics.pytrees import Scalar


def first_torque(
    inertia: Float[Array, "3 3"], q: Float[Array, "4"], eta: Scalar, t_f: Scalar, q_f: Float[Array, "4"] | None = None
) -> Float[Array, "3"]:
    """Torque at t = 0 (3,) [N m] from rest to a fixed reference, d_hat(0) = 0.

    -2 eta^2 J T(q)^-1 (q_1 - q_1f) / t_f^2; for the identity -2 eta^2 J v / (q4 t_f^2), so a rotation by theta about n
    takes 2 eta^2 |(J n)_i| tan(theta/2) / t_f^2 about axis i: it grows like 1/q4.

    Args:
        inertia: J, (3, 3) [kg m^2].
        q: initial attitude (4,), scalar last [-].
        eta: exponent of the law [-].
        t_f: the prescribed time [s].
        q_f: the reference (4,) [-]; None: the identity.
    """
    error = q[:3] if q_f is None else q[:3] - q_f[:3]
    return -2.0 * eta**2 * (inertia @ attitude.t_inverse_times(q, error)) / t_f**2


def later_peak_ratio(eta: Scalar) -> Scalar:
    """The braking peak of the torque over its first value [-], for small angles and 2 < eta < 3.

    >>> [f"{later_peak_ratio(jnp.asarray(eta)):.2f}" for eta in (2.05, 2.2, 2.386, 2.5)]
    ['7.37', '1.87', '1.00', '0.79']

    R = (eta-1)/(eta-2) exp(-(2 eta-3)/(eta-1)), at ln r = -(2 eta-3)/((eta-1)(eta-2)): 1 at eta = 2.386, 7.4 at 2.05.
    """
    return (eta - 1.0) / (eta - 2.0) * jnp.exp(-(2.0 * eta - 3.0) / (eta - 1.0))


def later_peak_time(eta: Scalar, t_f: Scalar) -> Scalar:
    """When that peak comes [s], for small angles."""
    return t_f * (1.0 - jnp.exp(-(2.0 * eta - 3.0) / ((eta - 1.0) * (eta - 2.0))))


def shortest_time(
    inertia: Float[Array, "3 3"],
    q: Float[Array, "4"],
    eta: Scalar,
    limit: Scalar,
    q_f: Float[Array, "4"] | None = None,
) -> Scalar:
    """Shortest t_f [s] that keeps the torque below limit [N m], from rest to a fixed reference, disturbance small.

    eta sqrt(2 max_i |(J n)_i| tan(theta/2) / limit) sqrt(max(1, R(eta))), with R of `later_peak_ratio`. Arguments as
    `first_torque` has them.

    A turn by 90 degrees about the axis of 14 kg m^2 with 0.5 N m takes 3 sqrt(2 14 tan(45 deg) / 0.5) = 22.4 s:

    >>> body, q = jnp.diag(jnp.array([10.0, 12.0, 14.0])), attitude.from_rotation_vector(jnp.array([0, 0, jnp.pi / 2]))
    >>> f"{shortest_time(body, q, eta=jnp.asarray(3.0), limit=jnp.asarray(0.5)):.4f}"
    '22.4499'
    """
    first = jnp.max(jnp.abs(first_torque(inertia, q, eta, jnp.ones_like(eta), q_f)))
    return jnp.sqrt(first / limit * jnp.maximum(1.0, later_peak_ratio(eta)))


def residual_error(acceleration: Scalar, eta: Scalar, delta: Scalar) -> tuple[Scalar, Scalar]:
    """Error at the hand-over and, about, at t_f that a constant residual acceleration of eps leaves [-].

    a tau^2 / (eta-2)^2 before the hand-over, so a delta^2 / (eta-2)^2 at it and a delta^2 (1/2 - 1/(eta-2)^2) at t_f:
    the latter is zero near eta = 3.41 by accident, which is why runs are judged on a window. acceleration [1/s^2].
    """
    share = 1.0 / (eta - 2.0) ** 2
    return acceleration * delta**2 * share, acceleration * delta**2 * (0.5 - share)


def hold_floor(
    disturbance_rate: Scalar, gain: Scalar, k1: Scalar, switching: Scalar, width: Scalar, surface_rate: Scalar
) -> Scalar:
    """What an axis holds after the hand-over [-], about: |d'| / (l c (K1 + |T J^-1| K2 / width)).

    The estimate of a ramp lags by J d' / l, which s = c eps holds off.

    Args:
        disturbance_rate: |d'| [N m/s].
        gain: l of the observer [N m s].
        k1: K1 [1/s].
        switching: |T J^-1| K2 [1/s^2].
        width: of the smooth sign [1/s].
        surface_rate: c [1/s].
    """
    return disturbance_rate / (gain * surface_rate * (k1 + switching / width))
