"""Envelopes of s and of the error before the hand-over by Theorems 1 to 3, and rates of a prescribed-time law.

Read `sliding_envelope` and `switching_rate` first. `hold` has the envelopes after the hand-over. Here tau = t_f - t and
r = tau / t_f.
"""

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from ptsmc_jax import formulas, programs
from ptsmc_jax.batching import lapack
from ptsmc_jax.laws.kinematics import AttitudeKinematics, ChainKinematics, SecondOrderKinematics
from ptsmc_jax.laws.prescribed_time import PrescribedTimeLaw
from ptsmc_jax.numerics import guards
from ptsmc_jax.numerics.pytrees import Scalar
from ptsmc_jax.simulation.rollout import Parts
from ptsmc_jax.theory.solutions import exact_error_and_s, initial_errors, state_envelope, visited_states

Vector = Float[Array, " n"]

TANH_LOSS = 0.2785  # max of x (1 - tanh x): loss of tanh(s / width) against sign(s) per component, in units of width


def sliding_envelope(parts: Parts) -> tuple[float, float]:
    """Return s0 and c of |s|_2^2 <= s0^2 r^(2 (eta+n-2)) + c tau^n, for the continuous loop without noise.

        c = 2 beta / (2 eta + n - 4),  beta = (factor of tau^(n-1) sign(s) in s') * components * 0.2785 width

    s0 is |s|_2 at t = 0, tau = t_f - t is the time to go [s], and r = tau / t_f. c is 0 for the discontinuous sign,
    which gives (15), (32) and (43) of the paper.
    """
    law, n = parts.controller, parts.controller.order
    beta = (
        float(switching_rates(parts)[0]) * parts.plant.inputs * TANH_LOSS * float(law.layer_width(jnp.asarray(False)))
    )
    s0 = math.hypot(*np.ravel(_s_at_start(parts)))  # finite even if its square overflows
    return s0, 2.0 * beta / (2.0 * float(law.eta) + n - 4.0)


@programs.jit
def _s_at_start(parts: Parts) -> Array:
    """Return s at t = 0, (m,)."""
    return exact_error_and_s(parts.controller, jnp.zeros_like(parts.t_end), initial_errors(parts))[1]


@programs.jit
def switching_rates(parts: Parts) -> tuple[Scalar, Scalar]:
    """Return the `switching_rate` for the largest K2, and for K2 at t_end (settled observer)."""
    law, bound = parts.controller, parts.observer.error_bound()
    run_states = visited_states(parts) if parts.plant.custom_functions else None
    largest, settled = (switching_rate(law, k2, run_states) for k2 in (bound.largest, bound(parts.t_end)))
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
    return (float(law.t_f) / float(law.layer_time)) ** (law.order - 1) * float(switching_rates(parts)[1]) * period


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
    """Return the bound of `error_bound` at times t (time,) [s]; `s0`, `residual`: from `sliding_envelope`."""
    law = parts.controller

    def component_bound(time: Scalar, x0: Vector) -> Scalar:
        centre, half = state_envelope(time, law.t_f, law.eta, x0, s0, residual)
        return jnp.abs(centre[0]) + half[0]

    bounds = jax.vmap(lambda time: jax.vmap(lambda x0: component_bound(time, x0))(initial_errors(parts)))(t)
    return jnp.sqrt(jnp.sum(bounds**2, axis=1))


def switching_rate(law: PrescribedTimeLaw, k2: Scalar, visited: tuple[Any, Any] | None = None) -> Scalar:
    """Return the factor of -tau^(n-1) sign(s) in s' before the hand-over, and of -sign(s) after it, for K2 up to k2.

    For an attitude it is at most |T J^-1| K2 / 2 [1/s^2] with |T|_2 = 1. For a second-order system it is the largest
    |dF/dx2 D| K2 over the states of a run. For a chain it is K2.

    Args:
        law: the prescribed-time law.
        k2: bound on the 2-norm of the estimation error.
        visited: targets (points,) and states (points, ..) of a run, for a second-order system.

    Raises:
        TypeError: if the law's kinematics are of another kind.
    """
    kinematics = law.kinematics
    if isinstance(kinematics, AttitudeKinematics):
        return 0.5 * guards.norm(kinematics.model.inertia_inverse) * k2
    if isinstance(kinematics, SecondOrderKinematics):
        assert visited is not None
        times, states = visited
        return jnp.max(lapack.vmap(kinematics.influence)(states, times)) * k2
    if isinstance(kinematics, ChainKinematics):
        return k2
    raise TypeError(f"the switching rate of {type(kinematics).__name__} is not known")


def boundary_layer(law: PrescribedTimeLaw, k2: Scalar, visited: tuple[Any, Any] | None = None) -> tuple[Scalar, Scalar]:
    """Return the fastest rates of the boundary layer before and after the hand-over [1/s], for K2 up to k2.

    The switching term s' = -c tanh(s / width) has the rate c / width near s = 0, with c of `switching_rate`.

    Args:
        law: the prescribed-time law.
        k2: bound on the 2-norm of the estimation error.
        visited: targets and states of a run, for a second-order system, see `switching_rate`.
    """
    after = switching_rate(law, k2, visited) / law.sign_width
    return (law.t_f / law.layer_time) ** (law.order - 1) * after, after


def hold_rates(law: PrescribedTimeLaw) -> dict[str, float]:
    """Return the decay rates in the hold phase [1/s]: toward the surface ("k1"), and fastest on it ("surface_rate")."""
    reaching, surface = _rates_of_hold(law)
    return {"k1": float(reaching), "surface_rate": float(np.max(np.abs(formulas.surface_roots(surface))))}


@programs.jit  # one compiled program instead of one for each operation
def _rates_of_hold(law: PrescribedTimeLaw) -> tuple[Scalar, Float[Array, " roots"]]:
    """Return the decay rate toward the surface [1/s], and the gains of the surface."""
    return law.reaching_rate, law.surface()
