"""Exact motion, and envelopes of s and of the error, in the hold phase. Tests compare them with simulated runs.

Read `exact_hold` first. "Exact" means a perfect disturbance estimate and K2 = 0. The envelopes hold for the continuous
loop without noise.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from ptsmc_jax.formulas import surface_roots
from ptsmc_jax.numerics import guards, integrators
from ptsmc_jax.numerics.pytrees import Scalar
from ptsmc_jax.simulation.rollout import Parts
from ptsmc_jax.theory import envelopes, solutions
from ptsmc_jax.theory.solutions import ChainMotion

Vector = Float[Array, " n"]


def hold_matrix(surface: Float[Array, " roots"], rate: Scalar) -> Float[Array, "n n"]:
    """Return the matrix A of x' = A x in the hold phase, for the error and its derivatives x_1 .. x_n.

    Here d = 0 and K2 = 0. A is the companion matrix of (p + rate)(p^(n-1) + a_(n-1) p^(n-2) + .. + a_1), so that
    s = x_n + .. + a_1 x_1 obeys s' = -rate s.

    Args:
        surface: a_1 .. a_(n-1) [1/s^(n-i)]; (c,) for order 2.
        rate: K1 of a chain, or K1/2 of a spacecraft [1/s].
    """
    weights = jnp.append(surface, 1.0)
    last = -rate * weights - jnp.concatenate([jnp.zeros(1), surface])
    n = weights.shape[0]
    return jnp.eye(n, k=1).at[-1].set(last)


def exact_hold(elapsed: Scalar, surface: Float[Array, " roots"], rate: Scalar, x: Vector) -> ChainMotion:
    """Return the motion of one component of the error in the hold phase, x(t) = e^(A t) x(0) with A of `hold_matrix`.

    The eigenvalues of A may repeat. For order 2, with c = `surface_rate` and k = K1/2 of a spacecraft:

        s(t) = s(0) e^(-k t),  s(0) = x'(0) + c x(0)
        x(t) = e^(-c t) x(0) + s(0) (e^(-k t) - e^(-c t)) / (c - k),  or with s(0) t e^(-c t) as last term if k = c

    Args:
        elapsed: time t since the hand-over [s].
        surface: a_1 .. a_(n-1) [1/s^(n-i)], see `hold_matrix`.
        rate: decay rate of s [1/s], see `hold_matrix`.
        x: the error and its derivatives at the hand-over, (n,), in the states' own units.

    From x(0) = 1 and x'(0) = 0 with c = k = 2 1/s the error after half a second is (1 + 2 0.5) e^(-1):

    >>> motion = exact_hold(jnp.asarray(0.5), jnp.array([2.0]), jnp.asarray(2.0), jnp.array([1.0, 0.0]))
    >>> f"{motion.x[0]:.6f}"
    '0.735759'
    """
    matrix = hold_matrix(surface, rate)
    now = integrators.phi_functions(matrix * elapsed, 0)[0] @ x
    return ChainMotion(now, jnp.append(surface, 1.0) @ now, matrix[-1] @ now)


def sliding_bound(parts: Parts, t: ArrayLike) -> np.ndarray:
    """Return a bound on |s|_2 at times t (time,) [s] in the hold phase.

    Each component obeys s_i s_i' <= -k s_i^2 + beta with k = `reaching_rate` and
    beta = (factor of sign(s) in s') * 0.2785 width. With t counted from the hand-over t_s, this gives

        s_i^2 <= s_i(t_s)^2 e^(-2 k t) + (beta/k) (1 - e^(-2 k t)).

    The bound on |s_i(t_s)| follows from `solutions.state_envelope`. Equations (23) and (51) are the special case
    beta = 0, the discontinuous sign.
    """
    law, (_, _, s, limit) = parts.controller, _hand_over_bounds(parts)
    decay = np.exp(-2.0 * float(law.reaching_rate) * (np.asarray(t) - float(law.hand_over)))[:, None]
    return np.sqrt(np.sum(np.asarray(s) ** 2 * decay + float(limit) ** 2 * (1.0 - decay), axis=1))


def error_bound(parts: Parts, t: ArrayLike) -> np.ndarray:
    """Return a bound on the error at times t (time,) [s] in the hold phase.

    The error is |v|_2 of the attitude error vector v, or |x_1| of a chain. It is the response of a chain of first-order
    lags to its initial state and to s. The poles of the lags are the roots p_i of the surface (39). Lags with the poles
    Re p_i, driven by the bound |s(t_s)| e^(-k t) + (beta/k)^(1/2) of `sliding_bound`, bound the response to s.
    """
    lags = np.poly(np.real(surface_roots(parts.controller.surface())))[1:][::-1]
    return np.asarray(_error_bound(parts, *_hand_over_bounds(parts), jnp.asarray(lags), jnp.asarray(t)))


def _hand_over_bounds(parts: Parts) -> tuple[Array, Array, Array, Array]:
    """Return bounds at the hand-over, and the limit of the bound on |s_i| for t -> infinity, (beta/k)^(1/2).

    The error and its derivatives are between centre - half and centre + half, (m, n) each. The third result is a bound
    on |s|, (m,).
    """
    law = parts.controller
    beta = float(envelopes.switching_rates(parts)[0]) * envelopes.TANH_LOSS * float(law.sign_width)
    limit = jnp.asarray(np.sqrt(beta / float(law.reaching_rate)))
    return *_bounds_at_hand_over(parts, *map(jnp.asarray, envelopes.sliding_envelope(parts))), limit


@jax.jit
def _bounds_at_hand_over(parts: Parts, s0: Scalar, residual_before: Scalar) -> tuple[Array, Array, Array]:
    law = parts.controller

    def component_interval(x0: Vector) -> tuple[Vector, Vector]:
        return solutions.state_envelope(law.hand_over, law.t_f, law.eta, x0, s0, residual_before)

    centre, half = jax.vmap(component_interval)(solutions.initial_errors(parts))
    weights = jnp.append(law.surface(), 1.0)
    return centre, half, jnp.abs(centre @ weights) + half @ jnp.abs(weights)


@jax.jit
def _error_bound(
    parts: Parts, centre: Array, half: Array, s_bound: Array, s_limit: Array, lags: Vector, t: Array
) -> Array:
    law, n = parts.controller, parts.controller.order
    surface, rate = law.surface(), law.reaching_rate
    on_surface = jnp.eye(n, n - 1).at[-1].set(-surface)  # basis (columns) of the states with s = 0
    off_surface = jnp.eye(n)[-1]  # the state with s = 1 and all other states 0

    def error_bound_after(elapsed: Scalar) -> Scalar:
        """Return the bound on the 2-norm of the error, `elapsed` [s] after the hand-over."""
        surface_response = integrators.phi_functions(hold_matrix(surface, rate) * elapsed, 0)[0][0] @ on_surface
        decaying_response, constant_response = (
            exact_hold(elapsed, lags, k, off_surface).x[0] for k in (rate, jnp.zeros_like(rate))
        )
        free_bound = jnp.abs(centre[:, :-1] @ surface_response) + half[:, :-1] @ jnp.abs(surface_response)
        return guards.norm(free_bound + s_bound * decaying_response + s_limit * constant_response)

    return jax.vmap(error_bound_after)(t - law.hand_over)
