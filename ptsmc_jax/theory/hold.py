"""After the hand-over: the exact motion, and envelopes of s and of the error, for every order.

"Exact" means: a perfect estimate of the disturbance and K2 = 0. Envelopes: the continuous loop without noise.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from ptsmc_jax import programs
from ptsmc_jax.formulas import surface_roots
from ptsmc_jax.numerics import guards, integrators
from ptsmc_jax.numerics.pytrees import Scalar
from ptsmc_jax.simulation.rollout import Parts
from ptsmc_jax.theory import envelopes, solutions
from ptsmc_jax.theory.closed_forms import ChainMotion

Vector = Float[Array, " n"]


def hold_matrix(surface: Float[Array, " roots"], rate: Scalar) -> Float[Array, "n n"]:
    """Matrix A of x' = A x after the hand-over, of the error and its derivatives x_1 .. x_n; d = 0 and K = 0.

    Companion matrix of (p + rate)(p^(n-1) + a_(n-1) p^(n-2) + .. + a_1): s' = -rate s with s = x_n + .. + a_1 x_1.
    surface: a_1 .. a_(n-1), (c,) for order 2 [1/s^(n-i)]; rate: K1 of a chain, K1/2 of a spacecraft [1/s].
    """
    weights = jnp.append(surface, 1.0)
    last = -rate * weights - jnp.concatenate([jnp.zeros(1), surface])
    n = weights.shape[0]
    return jnp.eye(n, k=1).at[-1].set(last)


def exact_hold(after: Scalar, surface: Float[Array, " roots"], rate: Scalar, x: Vector) -> ChainMotion:
    """Closed form after the hand-over, `after` seconds later, of the error and its derivatives x (n,) there.

    x(t) = e^(A t) x(0) with A of `hold_matrix`, whose roots may repeat. For order 2, of each component of the error:
    s(t) = s(0) e^(-k t), s(0) = x'(0) + c x(0), and x(t) = e^(-c t) x(0) + s(0) (e^(-k t) - e^(-c t)) / (c - k), where
    k = c: s(0) t e^(-c t); c is the `surface_rate` and k = K1/2 for a spacecraft. after [s]; x in the states' own
    units; surface and rate as `hold_matrix` has them.

    From rest at 1, with c = k = 2 1/s, half a second later (1 + 2 0.5) e^(-1) is left:

    >>> motion = exact_hold(jnp.asarray(0.5), jnp.array([2.0]), jnp.asarray(2.0), jnp.array([1.0, 0.0]))
    >>> f"{motion.x[0]:.6f}"
    '0.735759'
    """
    matrix = hold_matrix(surface, rate)
    now = integrators.phi_functions(matrix * after, 0)[0] @ x
    return ChainMotion(now, jnp.append(surface, 1.0) @ now, matrix[-1] @ now)


def sliding_bound(parts: Parts, t: ArrayLike) -> np.ndarray:
    """Bound on |s|_2 at times t (time,) [s] from the hand-over on.

    With s_i s_i' <= -k s_i^2 + beta, k = `reaching_rate` and beta = (factor of sign(s) in s') * 0.2785 width, each
    component keeps s_i^2 <= s_i(t_s)^2 e^(-2 k t) + (beta/k) (1 - e^(-2 k t)), t counted from the hand-over t_s; what
    it is at most there follows from `solutions.state_envelope`. (23) and (51) are beta = 0, the exact sign.
    """
    law, (_, _, s, floor) = parts.controller, _at_hand_over(parts)
    fallen = np.exp(-2.0 * float(law.reaching_rate) * (np.asarray(t) - float(law.hand_over)))[:, None]
    return np.sqrt(np.sum(np.asarray(s) ** 2 * fallen + float(floor) ** 2 * (1.0 - fallen), axis=1))


def error_bound(parts: Parts, t: ArrayLike) -> np.ndarray:
    """Bound on |error|_2, the attitude error vector's or |x_1|, at times t (time,) [s] from the hand-over on.

    The error answers to what it is at the hand-over and to s as a chain of lags, the roots p_i of the surface (39); no
    more than the chain of the lags Re p_i answers to the bound |s(t_s)| e^(-k t) + (beta/k)^(1/2) of `sliding_bound`.
    """
    known = _at_hand_over(parts)
    lags = np.poly(np.real(surface_roots(parts.controller.surface())))[1:][::-1]
    return np.asarray(_error_bound(parts, known, jnp.asarray(lags), jnp.asarray(t)))


class _HandOver(NamedTuple):
    """What is known at the hand-over, of each component of the error."""

    centre: Array  # (m, n) the error and its derivatives lie between centre - half and centre + half
    half: Array  # (m, n)
    s: Array  # (m,) bound on |s|
    floor: Array  # what the smooth sign leaves of |s| in the end, (beta/k)^(1/2)


def _at_hand_over(parts: Parts) -> _HandOver:
    law = parts.controller
    beta = envelopes.switching_rate(parts) * envelopes.GIVEN_AWAY * float(law.sign_width)
    floor = np.sqrt(beta / float(law.reaching_rate))
    return _handed(parts, *(jnp.asarray(v) for v in (*envelopes.sliding_envelope(parts), floor)))


@programs.jit
def _handed(parts: Parts, s0: Scalar, floor_before: Scalar, floor: Scalar) -> _HandOver:
    law = parts.controller

    def component(x0: Vector) -> tuple[Vector, Vector]:
        return solutions.state_envelope(law.hand_over, law.t_f, law.eta, x0, s0, floor_before)

    centre, half = jax.vmap(component)(solutions.starts(parts))
    weights = jnp.append(law.surface(), 1.0)
    return _HandOver(centre, half, jnp.abs(centre @ weights) + half @ jnp.abs(weights), floor)


@programs.jit
def _error_bound(parts: Parts, known: _HandOver, lags: Vector, t: Array) -> Array:
    law, n = parts.controller, parts.controller.order
    surface, rate = law.surface(), law.reaching_rate
    on_it = jnp.eye(n, n - 1).at[-1].set(-surface)  # s = 0: x_n follows from the others
    off_it = jnp.eye(n)[-1]  # s = 1, nothing else

    def size(after: Scalar) -> Scalar:
        slid = integrators.phi_functions(hold_matrix(surface, rate) * after, 0)[0][0] @ on_it
        falling, staying = (exact_hold(after, lags, k, off_it).x[0] for k in (rate, jnp.zeros_like(rate)))
        each = jnp.abs(known.centre[:, :-1] @ slid) + known.half[:, :-1] @ jnp.abs(slid)
        return guards.norm(each + known.s * falling + known.floor * staying)

    return jax.vmap(size)(t - law.hand_over)
