"""Exact motion and an envelope of s in the hold phase. Tests compare them with simulated runs.

Read `exact_hold` first. "Exact" means a perfect disturbance estimate and K2 = 0. The envelope holds for the continuous
loop without noise.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ptsmc_jax.numerics import integrators
from ptsmc_jax.numerics.pytrees import Scalar
from ptsmc_jax.simulation.rollout import Log, Parts
from ptsmc_jax.theory import envelopes
from ptsmc_jax.theory.solutions import ChainMotion

Vector = Float[Array, " n"]


def exact_hold(elapsed: Scalar, surface: Float[Array, " roots"], rate: Scalar, x: Vector) -> ChainMotion:
    """Return the motion of one component of the error in the hold phase, x(t) = e^(A t) x(0).

    A is the companion matrix of (p + rate)(p^(n-1) + a_(n-1) p^(n-2) + .. + a_1), so that s = x_n + .. + a_1 x_1 obeys
    s' = -rate s. Its eigenvalues may repeat.

    Args:
        elapsed: time t since the hand-over [s].
        surface: a_1 .. a_(n-1) [1/s^(n-i)]; (c,) for order 2.
        rate: K1 of a chain, or K1/2 of a spacecraft [1/s].
        x: the error and its derivatives at the hand-over, (n,), in the states' own units.
    """
    weights = jnp.append(surface, 1.0)
    last = -rate * weights - jnp.append(0.0, surface)
    now = integrators.phi_functions(jnp.eye(x.size, k=1).at[-1].set(last) * elapsed, 0)[0] @ x
    return ChainMotion(now, weights @ now, last @ now)


def sliding_bound(parts: Parts, log: Log) -> np.ndarray:
    """Return a bound (time,) on |s|_2 in each row of a history in the hold phase, which begins with the first row.

    Each component obeys s_i s_i' <= -k s_i^2 + beta with k = `reaching_rate` and
    beta = (factor of sign(s) in s') * 0.2785 width. With t counted from the first row, this gives

        s_i^2 <= s_i(0)^2 e^(-2 k t) + (beta/k) (1 - e^(-2 k t)).

    Equations (23) and (51) are the special case beta = 0, the discontinuous sign.
    """
    law = parts.controller
    beta = float(envelopes.switching_rates(parts)[0]) * envelopes.TANH_LOSS * float(law.sign_width)
    decay = np.exp(-2.0 * float(law.reaching_rate) * (log.t - log.t[0]))[:, None]
    limit = beta / float(law.reaching_rate)
    return np.sqrt(np.sum(log.s[0] ** 2 * decay + limit * (1.0 - decay), axis=1))
