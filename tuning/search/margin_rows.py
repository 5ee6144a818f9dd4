"""Margins as constraints of a tuning problem: rows beside those of what is flown, by a program of their own.

One for each axis, time and case, so that what is the least of several has slopes where two of them change places.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ptsmc_jax import configure, programs
from ptsmc_jax.campaigns import margin_verdicts, montecarlo
from ptsmc_jax.dispersions.base import Coordinates
from ptsmc_jax.dispersions.variation import Dispersion
from ptsmc_jax.numerics.pytrees import Leaf, pytree
from ptsmc_jax.scenario import Study
from ptsmc_jax.simulation.assembly import Parts
from ptsmc_jax.simulation.catalogues import MARGINS
from ptsmc_jax.simulation.requirements import over
from ptsmc_jax.theory import linear, margins, run_margins
from ptsmc_jax.theory.linear import Loop
from tuning.search import gains as gain_names
from tuning.search.gains import with_gains
from tuning.search.shares import Bounds, Scale

CASES = 1  # drawn trials whose loops are constrained, those that come nearest to a limit
WITHOUT = 2.0  # how near to its limit a loop without slopes comes: as one without any margin


@pytree
@dataclass(frozen=True)
class Asked:
    """Margins that are asked for, and of which loops."""

    parts: Parts
    dispersion: Dispersion
    seed: Leaf  # uint32
    coordinates: Coordinates  # of what is drawn, arrays over the cases first; empty: the nominal loop alone
    wanted: Leaf  # (margins,) the limits in their units
    limits: Leaf  # (margins,) how near a loop may come, see `over`: 1, less what the search keeps from it
    metrics: tuple[str, ...] = field(metadata={"static": True})
    names: tuple[str, ...] = field(metadata={"static": True})  # of the free gains

    def tightened(self, factor: np.ndarray) -> "Asked":
        """Return the same with every limit multiplied by its factor, (margins,) [-]."""
        return replace(self, limits=self.limits * factor)


def ask(ready: Study, bounds: Bounds, seed: int) -> Asked | None:
    """The margins that a scenario asks for, or None; where loops differ, of the trials hardest by its gains.

    The program of a search's rows is compiled beside the one that finds these trials: each takes as long as a search.
    """
    if not ready.margins:
        return None
    asked = Asked(
        parts=ready.parts,
        dispersion=ready.dispersion,
        seed=jnp.uint32(seed),
        coordinates={},
        wanted=jnp.asarray([one.limit for one in ready.margins]),
        limits=jnp.ones(len(ready.margins)),
        metrics=tuple(one.metric for one in ready.margins),
        names=bounds.names,
    )
    some = _of_trials(asked, np.arange(CASES)) if margin_verdicts.differ(asked.dispersion) else asked
    sloped.prepare(some, bounds.scale, np.zeros((len(configure.processors()), len(bounds.names))))
    return hardest(asked, np.asarray(gain_names.own(ready.parts, bounds.names)))[0]


def _of_trials(asked: Asked, trials: np.ndarray) -> Asked:
    """With the loops of these trials."""
    drawn = montecarlo.coordinates(asked.dispersion, asked.seed, jnp.asarray(trials, dtype=jnp.uint32))
    return replace(asked, coordinates=drawn)


def hardest(asked: Asked, gains: Float[np.ndarray, " gains"]) -> tuple[Asked, float]:
    """With the `CASES` trials whose loops come nearest to a limit by these gains, and how near the nearest comes.

    As it is where nothing is drawn that changes them: all loops are one, which is among the rows.
    """
    if not margin_verdicts.differ(asked.dispersion):
        return asked, 0.0
    parts, seed = with_gains(asked.parts, dict(zip(asked.names, gains, strict=True))), int(asked.seed)
    limits = dict(zip(asked.metrics, np.asarray(asked.wanted).tolist(), strict=True))
    each = margin_verdicts.worst(parts, asked.dispersion, seed, np.arange(margin_verdicts.TRIALS), limits, CASES)
    shares = [margin_verdicts.nearness(each[name], limit, name) for name, limit in limits.items()]
    near = np.max(np.nan_to_num(shares, nan=WITHOUT, neginf=-1e9), axis=0)
    return _of_trials(asked, np.argsort(-near, kind="stable")[:CASES]), max(float(near.max()), 0.0)


def rows(asked: Asked, gains: Float[Array, " gains"], runs: linear.Nominal) -> Float[Array, "margins entries"]:
    """Constraints c, met where c <= 0: how near to its limit each margin comes, over `limits`, less 1.

    A loop without slopes is as far beyond as one without any margin. runs: see `nominal_runs`.
    """
    late = margin_verdicts.DELAY in asked.metrics

    def loops_of(parts: Parts, run: linear.Nominal) -> Loop:
        return run_margins.judged_loops(parts, run, late=late)[0]

    each = _by_case(asked, gains, loops_of, runs)
    loops = jax.tree.map(lambda v: v.reshape(-1, *v.shape[2:]), each)
    values = margins.of_each(loops, with_delay=late).each()
    shares = [
        over(values[name].reshape(-1), wanted, at_least=MARGINS[name].at_least)
        for name, wanted in zip(asked.metrics, asked.wanted, strict=True)
    ]
    near = jnp.stack([jnp.where(jnp.isnan(share), WITHOUT, share) for share in shares])
    return near / asked.limits[:, None] - 1.0


def nominal_runs(asked: Asked, gains: Float[Array, " gains"]) -> linear.Nominal:
    """The nominal run of each case, arrays over them first; of the parts alone where there is no case."""
    return _by_case(asked, gains, linear.nominal)


def _by_case(asked: Asked, gains: Float[Array, " gains"], of: Callable[..., Any], *by_case: Any) -> Any:
    """What `of` says of each case's parts, and of what is known of each; arrays over the cases first.

    One after the other: XLA aborts the process on products with an inertia of each case, with some sets of gains.
    """
    parts = with_gains(asked.parts, dict(zip(asked.names, gains, strict=True)))
    if asked.coordinates:
        return jax.lax.map(lambda one: of(asked.dispersion.at(parts, one[0]), *one[1:]), (asked.coordinates, *by_case))
    known = jax.tree.map(lambda v: v[0], by_case)
    return jax.tree.map(lambda v: v[None], of(parts, *known))


def with_slopes(asked: Asked, scale: Scale, share: Float[Array, " gains"]) -> tuple[Array, Array]:
    """The `rows` at a share of the bounds' intervals, and their slopes by it, (margins, entries, gains).

    The runs' own slopes along one gain after the other, which takes a quarter of the time: a loop over periods with all
    of them in it is one of many small products.
    """

    def flown(share: Array) -> tuple[Any, Any]:
        runs = nominal_runs(asked, scale.gains(share))
        return tuple(
            jax.tree.map(lambda v, kept=kept: v if _has_slopes(v) is kept else None, runs) for kept in (True, False)
        )

    def judged(share: Array, numbers: Any) -> Array:
        def either(one: Any, other: Any) -> Any:
            return other if one is None else one

        runs = jax.tree.map(either, numbers, others, is_leaf=lambda v: v is None)
        return rows(asked, scale.gains(share), runs)

    axes = jnp.eye(share.size)
    each = jax.lax.map(lambda axis: jax.jvp(flown, (share,), (axis,), has_aux=True), axes)
    (numbers, others), moved = jax.tree.map(lambda v: v[0], (each[0], each[2])), each[1]
    return jax.vmap(lambda *by: jax.jvp(judged, (share, numbers), by), out_axes=(None, -1))(axes, moved)


def _has_slopes(leaf: Any) -> bool:
    return bool(jnp.issubdtype(leaf.dtype, jnp.inexact))


def of_points(asked: Asked, scale: Scale, share: Float[np.ndarray, "points gains"]) -> dict[str, np.ndarray]:
    """The rows "c" at shares of the bounds' intervals, and "c_slope" by these, arrays over the points first."""
    count = len(configure.processors())
    padded = np.resize(share, (-(-len(share) // count) * count, share.shape[1]))
    each = [sloped(asked, scale, padded[k : k + count]) for k in range(0, len(padded), count)]
    return jax.tree.map(lambda *v: np.concatenate(v)[: len(share)], *each)


@programs.jit
def sloped(asked: Asked, scale: Scale, share: Array) -> dict[str, Array]:
    """See `of_points`; one point for each device."""

    def on_device(share: Array) -> dict[str, Array]:
        c, slope = with_slopes(asked, scale, share[0])
        return {"c": c[None], "c_slope": jnp.nan_to_num(slope)[None]}

    return montecarlo.spread(on_device, share, share.shape[0])
