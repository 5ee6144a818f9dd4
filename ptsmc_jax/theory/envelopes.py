"""Envelopes of s and of the error by Theorems 1 to 3, and how narrow the smooth sign may be."""

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
from ptsmc_jax.theory.exact_motion import exact
from ptsmc_jax.theory.solutions import starts, state_envelope, visited

Vector = Float[Array, " n"]

GIVEN_AWAY = 0.2785  # max of x (1 - tanh x): what the smooth sign gives away per component, in units of its width


def sliding_envelope(parts: Parts) -> tuple[float, float]:
    """s0 and floor of |s|_2^2 <= s0^2 r^(2 (eta+n-2)) + floor tau^n before the hand-over, continuous and noise-free.

    floor = 2 beta / (2 eta + n - 4), beta = (factor of tau^(n-1) sign(s) in s') * components * 0.2785 width; it is 0
    for the exact sign, which gives the paper's (15), (32) and (43).
    """
    law, n = parts.controller, parts.controller.order
    beta = switching_rate(parts) * parts.plant.inputs * GIVEN_AWAY * float(law.layer(jnp.asarray(False)))
    s0 = math.hypot(*np.ravel(_outset(parts)))  # a number where its square is none
    return s0, 2.0 * beta / (2.0 * float(law.eta) + n - 4.0)


@programs.jit
def _outset(parts: Parts) -> Array:
    """What s is at t = 0, (m,)."""
    return exact(parts.controller, jnp.zeros_like(parts.t_end), starts(parts))[1]


def switching_rate(parts: Parts) -> float:
    """Largest factor of -tau^(n-1) sign(s) in s' before the hand-over, and of -sign(s) after it, along the run."""
    return float(_switching_rates(parts)[0])


@programs.jit
def _switching_rates(parts: Parts) -> tuple[Scalar, Scalar]:
    """The largest factor under the largest K2, and under the K2 that is left when the observer has settled."""
    law, bound = parts.controller, parts.observer.error_bound()
    seen = visited(parts) if parts.plant.of_own_functions else None
    return rates.switching_rate(law, bound.largest, seen), rates.switching_rate(law, bound(parts.t_end), seen)


def narrowest_sign(parts: Parts, period: float) -> float:
    """Width below which a sampled smooth sign overshoots, in the units of s after the hand-over.

    s' = -c tanh(s / width), c = tau^(n-1) times `switching_rate`, held for a period h, reaches s = 0 in one period from
    inside the boundary layer at width = c h; below c h / 2 it hops from side to side, and slopes grow from hop to hop.
    Of the largest c before the hand-over, at t = 0, under the K2 that is left when the observer has settled.
    """
    law = parts.controller
    return (float(law.t_f) / float(law.layer_time)) ** (law.order - 1) * float(_switching_rates(parts)[1]) * period


def sliding_bound(parts: Parts, t: ArrayLike) -> np.ndarray:
    """Bound on |s|_2 at times t (time,) [s] before the hand-over by `sliding_envelope`."""
    law, n = parts.controller, parts.controller.order
    s0, floor = sliding_envelope(parts)
    tau = np.maximum(float(law.t_f) - np.asarray(t), 0.0)
    falling = s0 * (tau / float(law.t_f)) ** (float(law.eta) + n - 2.0)
    return np.hypot(falling, np.sqrt(floor * tau**n))


def error_bound(parts: Parts, t: ArrayLike) -> np.ndarray:
    """Bound on |error|_2, the attitude error vector's or |x_1|, at times t (time,) [s] before the hand-over."""
    s0, floor = (jnp.asarray(v) for v in sliding_envelope(parts))
    return np.asarray(_error_bound(parts, jnp.asarray(t), s0, floor))


@programs.jit
def _error_bound(parts: Parts, t: Array, s0: Scalar, floor: Scalar) -> Array:
    law = parts.controller

    def component(time: Scalar, x0: Vector) -> Scalar:
        centre, half = state_envelope(time, law.t_f, law.eta, x0, s0, floor)
        return jnp.abs(centre[0]) + half[0]

    sizes = jax.vmap(lambda time: jax.vmap(lambda x0: component(time, x0))(starts(parts)))(t)
    return jnp.sqrt(jnp.sum(sizes**2, axis=1))
