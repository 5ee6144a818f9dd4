"""Rates of a prescribed-time law: switching term, boundary layer and hold phase. Read `switching_rate` first."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ptsmc_jax import formulas, programs
from ptsmc_jax.batching import lapack
from ptsmc_jax.laws.kinematics import AttitudeKinematics, ChainKinematics, SecondOrderKinematics
from ptsmc_jax.laws.prescribed_time import PrescribedTimeLaw
from ptsmc_jax.numerics import guards
from ptsmc_jax.numerics.pytrees import Scalar


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
    return law.reaching_rate, law.surface()
