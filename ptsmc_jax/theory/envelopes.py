"""Envelopes of s and of the error before the hand-over by Theorems 1 to 3, and the smallest boundary layer.

Read `sliding_envelope` first. `hold` has the envelopes after the hand-over. Here tau = t_f - t and r = tau / t_f.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from ptsmc_jax import programs
from ptsmc_jax.numerics.pytrees import Scalar
from ptsmc_jax.simulation.rollout import Parts
from ptsmc_jax.theory import rates
from ptsmc_jax.theory.exact_motion import exact_error_and_s
from ptsmc_jax.theory.solutions import initial_errors, state_envelope, visited_states

Vector = Float[Array, " n"]

TANH_LOSS = 0.2785  # max of x (1 - tanh x): loss of tanh(s / width) against sign(s) per component, in units of width


def sliding_envelope(parts: Parts) -> tuple[float, float]:
    """Return s0 and c of |s|_2^2 <= s0^2 r^(2 (eta+n-2)) + c tau^n, for the continuous loop without noise.

        c = 2 beta / (2 eta + n - 4),  beta = (factor of tau^(n-1) sign(s) in s') * components * 0.2785 width

    s0 is |s|_2 at t = 0, tau = t_f - t is the time to go [s], and r = tau / t_f. c is 0 for the discontinuous sign,
    which gives (15), (32) and (43) of the paper.
    """
    law, n = parts.controller, parts.controller.order
    beta = switching_rate(parts) * parts.plant.inputs * TANH_LOSS * float(law.layer_width(jnp.asarray(False)))
    s0 = math.hypot(*np.ravel(_s_at_start(parts)))  # finite even if its square overflows
    return s0, 2.0 * beta / (2.0 * float(law.eta) + n - 4.0)


@programs.jit
def _s_at_start(parts: Parts) -> Array:
    """Return s at t = 0, (m,)."""
    return exact_error_and_s(parts.controller, jnp.zeros_like(parts.t_end), initial_errors(parts))[1]


def switching_rate(parts: Parts) -> float:
    """Return the largest factor of -tau^(n-1) sign(s) in s' before the hand-over, and of -sign(s) after it."""
    return float(_switching_rates(parts)[0])


@programs.jit
def _switching_rates(parts: Parts) -> tuple[Scalar, Scalar]:
    """Return the factor of -tau^(n-1) sign(s) in s' for the largest K2, and for K2 at t_end (settled observer)."""
    law, bound = parts.controller, parts.observer.error_bound()
    run_states = visited_states(parts) if parts.plant.custom_functions else None
    largest, settled = (rates.switching_rate(law, k2, run_states) for k2 in (bound.largest, bound(parts.t_end)))
    return largest, settled


def smallest_sign_width(parts: Parts, period: float) -> float:
    """Return the boundary layer thickness below which the sampled s overshoots, in the units of s in the hold phase.

    The switching term alone gives s' = -c tanh(s / width), with c = tau^(n-1) times `switching_rate`, held for a period
    h. If width = c h, s reaches 0 in one period from inside the boundary layer. If width < c h / 2, the sign of s
    alternates, and sensitivities grow from period to period. The function uses the largest c, at t = 0, with the K2 of
    a settled observer.

    Args:
        parts: the scenario.
        period: control period h [s].
    """
    law = parts.controller
    return (float(law.t_f) / float(law.layer_time)) ** (law.order - 1) * float(_switching_rates(parts)[1]) * period


def sliding_bound(parts: Parts, t: ArrayLike) -> np.ndarray:
    """Return the bound on |s|_2 of `sliding_envelope` at times t (time,) [s] in the approach phase."""
    law, n = parts.controller, parts.controller.order
    s0, residual = sliding_envelope(parts)
    tau = np.maximum(float(law.t_f) - np.asarray(t), 0.0)
    falling = s0 * (tau / float(law.t_f)) ** (float(law.eta) + n - 2.0)
    return np.hypot(falling, np.sqrt(residual * tau**n))


def error_bound(parts: Parts, t: ArrayLike) -> np.ndarray:
    """Return a bound on the error at times t (time,) [s] in the approach phase.

    The error is |v|_2 of the attitude error vector v, or |x_1| of a chain.
    """
    s0, residual = (jnp.asarray(v) for v in sliding_envelope(parts))
    return np.asarray(_error_bound(parts, jnp.asarray(t), s0, residual))


@programs.jit
def _error_bound(parts: Parts, t: Array, s0: Scalar, residual: Scalar) -> Array:
    law = parts.controller

    def component_bound(time: Scalar, x0: Vector) -> Scalar:
        centre, half = state_envelope(time, law.t_f, law.eta, x0, s0, residual)
        return jnp.abs(centre[0]) + half[0]

    bounds = jax.vmap(lambda time: jax.vmap(lambda x0: component_bound(time, x0))(initial_errors(parts)))(t)
    return jnp.sqrt(jnp.sum(bounds**2, axis=1))
