"""Closed-form motions of Theorems 1 to 3 before the hand-over, without sampling, noise and switching.

Read `exact_error` first (second-order law, attitude), then `exact_chain` (any order). Here tau = t_f - t and
r = tau / t_f.
"""

import math
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from ptsmc_jax.laws.prescribed_time import rising_factorials, surface_coefficients
from ptsmc_jax.numerics.pytrees import Scalar

Vector = Float[Array, " n"]


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


def exact_chain(t: Scalar, t_f: Scalar, eta: Scalar, x0: Vector) -> ChainMotion:
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
    s0 = surface_at_start(t_f, eta, x0)
    y = [free + s0 * forced for free, forced in zip(*scaled_responses(t, t_f, eta, x0), strict=True)]
    x = derivatives_from_scaled(t, t_f, eta, y)
    return ChainMotion(jnp.stack(x[:n]), s0 * ((t_f - t) / t_f) ** (eta + n - 2), x[n])


def surface_at_start(t_f: Scalar, eta: Scalar, x: Vector) -> Scalar:
    """Return the sliding variable s of (37) at t = 0.

    Args:
        t_f: prescribed time [s].
        eta: exponent of the law [-].
        x: states at t = 0, (n,), in the states' own units.
    """
    c = surface_coefficients(eta, x.shape[0])
    return sum((c[i] * t_f**i * x[i] for i in range(x.shape[0])), jnp.zeros_like(t_f))


def scaled_responses(t: Scalar, t_f: Scalar, eta: Scalar, x0: Vector) -> tuple[list[Scalar], list[Scalar]]:
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
