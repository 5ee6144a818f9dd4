"""Stability margins of the linearised loop as constraints of a tuning problem.

Each axis, time and case has its own constraint. The smallest margin alone would not be differentiable where two margins
are equal. Read `build_required_margins` first, which selects the loops, and then `margin_constraints`.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ptsmc_jax import configure, programs
from ptsmc_jax.batching import lanes
from ptsmc_jax.campaigns import margin_verdicts, montecarlo
from ptsmc_jax.dispersions.base import Coordinates
from ptsmc_jax.dispersions.variation import Dispersion
from ptsmc_jax.numerics.pytrees import Leaf, pytree
from ptsmc_jax.scenario import Study
from ptsmc_jax.simulation.assembly import Parts
from ptsmc_jax.simulation.catalogues import MARGINS
from ptsmc_jax.simulation.requirements import violation_ratio
from ptsmc_jax.theory import linear, margins, run_margins
from ptsmc_jax.theory.linear import Loop
from tuning.search.gains import with_gains
from tuning.search.normalisation import Bounds, Scale

CASES = 1  # number of random trials whose loops are constrained: the trials with the worst margins
RATIO_OF_NAN = 2.0  # violation ratio of a loop without margins, as for a margin of zero


@pytree
@dataclass(frozen=True)
class RequiredMargins:
    """The required margins, and the loops that must have them."""

    parts: Parts
    dispersion: Dispersion
    seed: Leaf  # uint32
    coordinates: Coordinates  # random numbers of the dispersions, cases on the first axis; empty: the nominal loop only
    required: Leaf  # (margins,) the required limits in their units
    limits: Leaf  # (margins,) largest allowed `violation_ratio`: 1, or less if the search tightens its limits
    metrics: tuple[str, ...] = field(metadata={"static": True})
    names: tuple[str, ...] = field(metadata={"static": True})  # names of the free gains

    def tightened(self, factor: np.ndarray) -> "RequiredMargins":
        """Return a copy with every limit multiplied by its factor, (margins,) [-]."""
        return replace(self, limits=self.limits * factor)


def build_required_margins(ready: Study, bounds: Bounds, seed: int) -> RequiredMargins | None:
    """Return the margins that a scenario requires, or None if it requires none.

    If dispersions change the loop, the constrained loops are those of the first trials, until `select_hardest_trials`
    selects others. The programs of both are compiled in the background.

    Args:
        ready: the scenario with its parts.
        bounds: bounds of the free gains.
        seed: seed of the dispersions.
    """
    if not ready.margins:
        return None
    asked = RequiredMargins(
        parts=ready.parts,
        dispersion=ready.dispersion,
        seed=jnp.uint32(seed),
        coordinates={},
        required=jnp.asarray([one.limit for one in ready.margins]),
        limits=jnp.ones(len(ready.margins)),
        metrics=tuple(one.metric for one in ready.margins),
        names=bounds.names,
    )
    if margin_verdicts.has_different_loops(asked.dispersion):
        asked = _with_trials(asked, np.arange(CASES))
        margin_verdicts.prepare(ready)
    constraints_on_devices.prepare(asked, bounds.scale, np.zeros((len(configure.processors()), len(bounds.names))))
    return asked


def _with_trials(asked: RequiredMargins, trials: np.ndarray) -> RequiredMargins:
    """Return the required margins for the loops of these trials (cases,), which replace the earlier ones."""
    coordinates = montecarlo.coordinates(asked.dispersion, asked.seed, jnp.asarray(trials, dtype=jnp.uint32))
    return replace(asked, coordinates=coordinates)


def select_hardest_trials(asked: RequiredMargins, gains: Float[np.ndarray, " gains"]) -> tuple[RequiredMargins, float]:
    """Select the `CASES` trials with the worst margins for these gains, (gains,).

    If no dispersion changes the loop, all trials have the nominal loop, and nothing is selected.

    Returns:
        The required margins for the loops of these trials, and the largest violation ratio of all trials, at least 0.
    """
    if not margin_verdicts.has_different_loops(asked.dispersion):
        return asked, 0.0
    parts, seed = with_gains(asked.parts, dict(zip(asked.names, gains, strict=True))), int(asked.seed)
    limits = dict(zip(asked.metrics, np.asarray(asked.required).tolist(), strict=True))
    by_trial, _ = margin_verdicts.worst_margins(
        parts, asked.dispersion, seed, np.arange(margin_verdicts.TRIALS), limits, CASES
    )
    ratios = [margin_verdicts.signed_violation_ratio(by_trial[name], limit, name) for name, limit in limits.items()]
    ratio = np.max(np.nan_to_num(ratios, nan=RATIO_OF_NAN, neginf=-1e9), axis=0)
    return _with_trials(asked, np.argsort(-ratio, kind="stable")[:CASES]), max(float(ratio.max()), 0.0)


def margin_constraints(
    asked: RequiredMargins, gains: Float[Array, " gains"], runs: linear.NominalRun
) -> Float[Array, "margins entries"]:
    """Return the constraints c of the margins, which are met if c <= 0.

    c is the violation ratio of a margin, see `violation_ratio`, divided by `limits`, minus 1. A loop that has no finite
    derivatives, or is open in the hold phase, counts as a loop with a margin of zero.

    Args:
        asked: the required margins.
        gains: (gains,) values of the free gains.
        runs: the nominal run of each case, see `nominal_runs`.

    Returns:
        c, (margins, entries), with an entry for each case, axis and time.
    """
    with_delay = margin_verdicts.DELAY in asked.metrics

    def loops_of(parts: Parts, run: linear.NominalRun) -> Loop:
        return run_margins.judged_loops(parts, run, fractional_delays=with_delay)[0]

    loops_by_case = _map_cases(asked, gains, loops_of, runs)
    loops = jax.tree.map(lambda v: v.reshape(-1, *v.shape[2:]), loops_by_case)
    by_loop = margins.compute_each(loops, with_delay=with_delay)
    values, times = by_loop.by_name(), loops_by_case.period.shape[1]
    in_hold = jnp.arange(by_loop.phase.shape[0]) % times == times - 1
    has_no_margin = (by_loop.is_open & in_hold[:, None]).reshape(-1)
    ratios = [
        violation_ratio(values[name].reshape(-1), limit, at_least=MARGINS[name].at_least)
        for name, limit in zip(asked.metrics, asked.required, strict=True)
    ]
    finite_ratios = jnp.stack([jnp.where(has_no_margin | jnp.isnan(ratio), RATIO_OF_NAN, ratio) for ratio in ratios])
    return finite_ratios / asked.limits[:, None] - 1.0


def nominal_runs(asked: RequiredMargins, gains: Float[Array, " gains"]) -> linear.NominalRun:
    """Return the nominal run of each case, cases on the first axis, or the run of the nominal parts without cases."""
    return _map_cases(asked, gains, linear.simulate_nominal)


def _map_cases(
    asked: RequiredMargins, gains: Float[Array, " gains"], function: Callable[..., Any], *arguments: Any
) -> Any:
    """Apply `function` to the parts and the `arguments` of each case. Return arrays with cases on the first axis.

    The cases are computed one after the other. With a batch axis for the inertia, XLA aborts the process for some sets
    of gains.
    """
    parts = with_gains(asked.parts, dict(zip(asked.names, gains, strict=True)))
    if asked.coordinates:
        return jax.lax.map(
            lambda case: function(asked.dispersion.at(parts, case[0]), *case[1:]), (asked.coordinates, *arguments)
        )
    first = jax.tree.map(lambda v: v[0], arguments)
    return jax.tree.map(lambda v: v[None], function(parts, *first))


def constraints_with_derivatives(
    asked: RequiredMargins, scale: Scale, normalised: Float[Array, " gains"]
) -> tuple[Array, Array]:
    """Return the constraints `margin_constraints` and their derivatives with respect to normalised gains.

    The nominal runs are differentiated in lanes, one for each gain.

    Args:
        asked: the required margins.
        scale: map from normalised gains to gains.
        normalised: (gains,) normalised gains.

    Returns:
        c, (margins, entries), and its derivatives, (margins, entries, gains).
    """

    def differentiable_runs(normalised: Array) -> tuple[Any, Any]:
        runs = nominal_runs(asked, scale.gains(normalised))
        return tuple(
            jax.tree.map(lambda v, kept=kept: v if jnp.issubdtype(v.dtype, jnp.inexact) == kept else None, runs)
            for kept in (True, False)
        )

    def judge_runs(normalised: Array, inexact: Any) -> Array:
        runs = jax.tree.map(lambda a, b: b if a is None else a, inexact, constant, is_leaf=lambda v: v is None)
        return margin_constraints(asked, scale.gains(normalised), runs)

    axes = jnp.eye(normalised.size)
    each = lanes.vmap(lambda axis: jax.jvp(differentiable_runs, (normalised,), (axis,), has_aux=True))(axes)
    (inexact, constant), derivatives = jax.tree.map(lambda v: v[0], (each[0], each[2])), each[1]
    return jax.vmap(lambda *by: jax.jvp(judge_runs, (normalised, inexact), by), out_axes=(None, -1))(axes, derivatives)


def constraints_at_points(
    asked: RequiredMargins, scale: Scale, normalised: Float[np.ndarray, "points gains"]
) -> dict[str, np.ndarray]:
    """Return the constraints and their derivatives with respect to normalised gains, at many points.

    Args:
        asked: the required margins.
        scale: map from normalised gains to gains.
        normalised: (points, gains) normalised gains.

    Returns:
        "c", (points, margins, entries), and "c_gradient", (points, margins, entries, gains).
    """
    count = len(configure.processors())
    padded = np.resize(normalised, (-(-len(normalised) // count) * count, normalised.shape[1]))
    each = [constraints_on_devices(asked, scale, padded[k : k + count]) for k in range(0, len(padded), count)]
    return jax.tree.map(lambda *v: np.concatenate(v)[: len(normalised)], *each)


@programs.jit(title="the gradients of the margins")
def constraints_on_devices(asked: RequiredMargins, scale: Scale, normalised: Array) -> dict[str, Array]:
    """Return the result of `constraints_at_points` for one point on each device.

    Args:
        asked: the required margins.
        scale: map from normalised gains to gains.
        normalised: (devices, gains) normalised gains.

    Returns:
        "c", (devices, margins, entries), and "c_gradient", (devices, margins, entries, gains).
    """

    def constraints_on_device(normalised: Array) -> dict[str, Array]:
        c, gradient = constraints_with_derivatives(asked, scale, normalised[0])
        return {"c": c[None], "c_gradient": jnp.nan_to_num(gradient)[None]}

    return montecarlo.map_over_devices(constraints_on_device, normalised, normalised.shape[0])
