"""Design rules from (57) and Theorem 2: initial torque, shortest t_f, residual errors.

Read `first_torque` and `shortest_time` first.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from ptsmc_jax.numerics import attitude
from ptsmc_jax.numerics.pytrees import Scalar


def first_torque(
    inertia: Float[Array, "3 3"], q: Float[Array, "4"], eta: Scalar, t_f: Scalar, q_f: Float[Array, "4"] | None = None
) -> Float[Array, "3"]:
    """Return the torque at t = 0 (3,) [N m] for a manoeuvre from rest to a fixed reference, with d_hat(0) = 0.

        u(0) = -2 eta^2 J T(q)^-1 (q_1 - q_1f) / t_f^2

    For the identity as reference this is -2 eta^2 J v / (q4 t_f^2). A rotation by theta about n thus needs
    2 eta^2 |(J n)_i| tan(theta/2) / t_f^2 about axis i, which grows like 1/q4.

    Args:
        inertia: J, (3, 3) [kg m^2].
        q: initial attitude (4,), scalar last [-].
        eta: exponent of the law [-].
        t_f: prescribed time [s].
        q_f: reference attitude (4,) [-], or None for the identity.
    """
    error = q[:3] if q_f is None else q[:3] - q_f[:3]
    return -2.0 * eta**2 * (inertia @ attitude.t_inverse_times(q, error)) / t_f**2


def later_peak_ratio(eta: Scalar) -> Scalar:
    """Return the ratio of the braking torque peak to the initial torque [-], for small angles and 2 < eta < 3.

    >>> [f"{later_peak_ratio(jnp.asarray(eta)):.2f}" for eta in (2.05, 2.2, 2.386, 2.5)]
    ['7.37', '1.87', '1.00', '0.79']

    R = (eta-1)/(eta-2) exp(-(2 eta-3)/(eta-1)), at ln r = -(2 eta-3)/((eta-1)(eta-2)).
    """
    return (eta - 1.0) / (eta - 2.0) * jnp.exp(-(2.0 * eta - 3.0) / (eta - 1.0))


def shortest_time(
    inertia: Float[Array, "3 3"],
    q: Float[Array, "4"],
    eta: Scalar,
    limit: Scalar,
    q_f: Float[Array, "4"] | None = None,
) -> Scalar:
    """Return the shortest t_f [s] that keeps the torque below a limit, from rest to a fixed reference.

        t_f = eta sqrt(2 max_i |(J n)_i| tan(theta/2) / limit) sqrt(max(1, R(eta)))

    R is `later_peak_ratio`. The rule neglects the disturbance.

    Args:
        inertia: J, (3, 3) [kg m^2].
        q: initial attitude (4,), scalar last [-].
        eta: exponent of the law [-].
        limit: torque limit of each axis [N m].
        q_f: reference attitude (4,) [-], or None for the identity.

    A 90 deg rotation about the axis with 14 kg m^2 and 0.5 N m needs 3 sqrt(2 14 tan(45 deg) / 0.5) = 22.4 s:

    >>> body, q = jnp.diag(jnp.array([10.0, 12.0, 14.0])), attitude.from_rotation_vector(jnp.array([0, 0, jnp.pi / 2]))
    >>> f"{shortest_time(body, q, eta=jnp.asarray(3.0), limit=jnp.asarray(0.5)):.4f}"
    '22.4499'
    """
    first = jnp.max(jnp.abs(first_torque(inertia, q, eta, jnp.ones_like(eta), q_f)))
    return jnp.sqrt(first / limit * jnp.maximum(1.0, later_peak_ratio(eta)))


def residual_error(acceleration: Scalar, eta: Scalar, delta: Scalar) -> tuple[Scalar, Scalar]:
    """Return the errors that a constant residual acceleration causes at the hand-over and, approximately, at t_f [-].

    Before the hand-over the error is a tau^2 / (eta-2)^2 for an acceleration a:

        at the hand-over: a delta^2 / (eta-2)^2
        at t_f:           a delta^2 (1/2 - 1/(eta-2)^2)

    The error at t_f happens to be zero near eta = 3.41. The metrics therefore evaluate runs over a window.

    Args:
        acceleration: a, residual acceleration of eps [1/s^2].
        eta: exponent of the law [-].
        delta: time between the hand-over and t_f [s].
    """
    factor = 1.0 / (eta - 2.0) ** 2
    return acceleration * delta**2 * factor, acceleration * delta**2 * (0.5 - factor)


def ramp_error(
    disturbance_rate: Scalar, gain: Scalar, k1: Scalar, switching: Scalar, width: Scalar, surface_rate: Scalar
) -> Scalar:
    """Return the approximate error of an axis in the hold phase under a ramp disturbance [-].

        |eps| = |d'| / (l c (K1 + |T J^-1| K2 / width))

    The observer's estimate of a ramp lags by J d' / l. The feedback of s = c eps compensates this lag.

    Args:
        disturbance_rate: |d'| [N m/s].
        gain: l of the observer [N m s].
        k1: K1 [1/s].
        switching: |T J^-1| K2 [1/s^2].
        width: thickness of the boundary layer [1/s].
        surface_rate: c [1/s].
    """
    return disturbance_rate / (gain * surface_rate * (k1 + switching / width))
