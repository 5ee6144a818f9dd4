"""Exact solutions of Theorems 1 to 3 for a scenario: motion and torque without sampling and noise.

Read `exact_sizes` (error and s) and `exact_path` (torque) first.
"""

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from ptsmc_jax import programs
from ptsmc_jax.batching import lapack
from ptsmc_jax.numerics import guards
from ptsmc_jax.numerics.pytrees import Scalar
from ptsmc_jax.simulation.assembly import Setup
from ptsmc_jax.theory.closed_forms import derivatives_from_scaled, scaled_responses
from ptsmc_jax.theory.closed_forms import exact_chain as exact_chain
from ptsmc_jax.theory.closed_forms import exact_error as exact_error
from ptsmc_jax.theory.exact_motion import exact_error_and_s, exact_motion, plant_motion

Vector = Float[Array, " n"]

VISITED = 64  # number of states on the exact motion, and number of states with zero error


def state_envelope(
    t: Scalar, t_f: Scalar, eta: Scalar, x0: Vector, s0: Scalar, residual: Scalar
) -> tuple[Vector, Vector]:
    """Return centre and half width, (n,) each, of the interval that contains x_1 .. x_n before the hand-over.

    The interval follows from |s|^2 <= s0^2 r^(2 (eta+n-2)) + c tau^n of `envelopes.sliding_envelope`. The centre is
    the exact solution without s. Each of the n-1 integrations of |y^(n-1)| <= |s| / tau^(eta+n-1) adds to the width.
    The result generalises (20)-(22) and (47)-(50), with explicit constants.

    Args:
        t: time since the start of the run [s], in the approach phase.
        t_f: prescribed time [s].
        eta: exponent of the law [-].
        x0: states at t = 0, (n,), in the states' own units.
        s0: bound on |s| at t = 0, see `envelopes.sliding_envelope`.
        residual: coefficient c of tau^n, see `envelopes.sliding_envelope`.
    """
    n, tau = x0.shape[0], t_f - t
    free, forced = scaled_responses(t, t_f, eta, x0)
    scale = jnp.sqrt(residual) * tau ** (n / 2)  # bound on |s| inside the boundary layer
    widths = []
    for j in range(n):
        p = n - 2 - j
        factor = 1.0 / ((eta - n / 2 + j) * math.factorial(p)) if p >= 0 else 1.0
        layer_width = scale * factor * tau**-j * (t_f / tau) ** eta
        widths.append(jnp.abs(s0 * forced[j]) + layer_width)
    centre = derivatives_from_scaled(t, t_f, eta, free)[:n]
    half = derivatives_from_scaled(t, t_f, eta, [*widths, jnp.zeros_like(tau)], jnp.abs)[:n]
    return jnp.stack(centre), jnp.stack(half)


def without_devices(parts: Setup) -> Setup:
    """Return the parts without clock and devices.

    The exact motion does not depend on them, so that one compiled program serves all scenarios.
    """
    names = "plant", "disturbance", "reference", "controller", "initial", "t_end", "window", "settling_angle"
    return Setup(**{name: getattr(parts, name) for name in names}, observer=None)


def initial_errors(parts: Setup) -> Float[Array, "m n"]:
    """Return each component of the error and its derivatives x_1 .. x_n at t = 0, in the states' own units."""
    kinematics, target = parts.controller.kinematics, parts.reference(jnp.zeros_like(parts.t_end))
    return kinematics.derivatives(parts.aligned_initial, target)


def exact_sizes(parts: Setup, t: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Return the 2-norms of the error and of s along the exact motion at times t (time,) [s] in the approach phase."""
    error, s = _exact_sizes(without_devices(parts), jnp.asarray(t))
    return np.asarray(error), np.asarray(s)


@programs.jit
def _exact_sizes(parts: Setup, t: Array) -> tuple[Array, Array]:
    """Return the 2-norms of the error and of s at times t, see `exact_sizes`."""

    def norms(time: Scalar) -> tuple[Scalar, Scalar]:
        error, s = exact_error_and_s(parts.controller, time, initial_errors(parts))
        return guards.norm(error), guards.norm(s)

    return jax.vmap(norms)(t)


def exact_input(parts: Setup, t: Scalar) -> tuple[Array, Scalar]:
    """Return the input (m,) [N m] of the exact motion at t [s], and the distance to the singularity.

    For attitudes this distance is 1 - |v|^2 [-], the square of the scalar part. The motion does not exist if it is 0
    or less.
    """
    motion = exact_motion(parts.controller, t, parts.reference(t), parts.initial, initial_errors(parts))
    d = parts.disturbance(t, parts.plant.with_hidden_at_rest(motion.x))
    plant = parts.plant.planning_plant(parts.controller.model)
    return plant.input_for(t, motion.x, motion.w_dot, d), motion.singularity_distance


def visited_states(parts: Setup) -> tuple[Array, Any]:
    """Return targets and states of a second-order run, (2 VISITED,) each, in the states' own units.

    The first half is on the exact motion, at times that become denser toward the hand-over. In the second half the
    error is zero.
    """
    return _visited_states(without_devices(parts))


@programs.jit
def _visited_states(parts: Setup) -> tuple[Array, Any]:
    law, fractions = parts.controller, jnp.linspace(0.0, 1.0, VISITED)
    zero_errors = (jnp.zeros(parts.plant.inputs),) * 3

    def on_exact_motion(t: Scalar) -> tuple[Any, Any]:
        target = parts.reference(t)
        return target, exact_motion(law, t, target, parts.initial, initial_errors(parts)).x

    def at_zero_error(t: Scalar) -> tuple[Any, Any]:
        target = parts.reference(t)
        return target, plant_motion(law.kinematics, target, parts.initial, zero_errors).x

    early = lapack.vmap(on_exact_motion)(law.t_f - law.t_f * (law.delta / law.t_f) ** fractions)
    late = lapack.vmap(at_zero_error)(parts.t_end * fractions)
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), early, late)


def exact_path(parts: Setup, points: int = 2000) -> tuple[Array, Array, Array]:
    """Return times in the approach phase [s], inputs (points, m) and distances to the singularity of the exact motion.

    The times become denser toward the hand-over. `exact_input` defines inputs and distances.
    """
    return _exact_path(without_devices(parts), points)


@programs.jit(static_argnames="points")
def _exact_path(parts: Setup, points: int) -> tuple[Array, Array, Array]:
    """Return times (points,) [s], inputs and distances to the singularity, see `exact_path`."""
    law = parts.controller
    t = law.t_f - law.t_f * (law.delta / law.t_f) ** jnp.linspace(0.0, 1.0, points)
    u, singularity_distance = lapack.vmap(lambda time: exact_input(parts, time))(t)
    return t, u, singularity_distance


def exact_peak(parts: Setup, points: int = 400) -> Scalar:
    """Return the largest input of the exact motion before the hand-over [N m].

    This generalises rule 3.5 to any initial state, reference and order.
    """
    _, u, _ = exact_path(parts, points)
    return jnp.max(jnp.abs(u))
