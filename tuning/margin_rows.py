"""Margins as constraints of a tuning problem: rows beside those of what is flown, by a program of their own.

One for each axis, time and case, so that what is the least of several has slopes where two of them change places.
"""

from dataclasses import dataclass, field, replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ptsmc_jax import margin_verdicts, margins
from ptsmc_jax.assembly import Parts
from ptsmc_jax.dispersions import Coordinates, Dispersion
from ptsmc_jax.layouts import MARGINS
from ptsmc_jax.numerics import Leaf, pytree
from ptsmc_jax.requirements import over
from ptsmc_jax.scenario import Study
from tuning.bounds import Bounds
from tuning.gains import with_gains

CASES = 2  # loops with drawn inertias, those of the screened trials that come nearest to a limit


@pytree
@dataclass(frozen=True)
class Asked:
    """Margins that are asked for, and of which loops."""

    parts: Parts
    dispersion: Dispersion
    coordinates: Coordinates  # of what is drawn, arrays over the cases first; empty: the nominal loop alone
    wanted: Leaf  # (margins,) the limits in their units
    limits: Leaf  # (margins,) how near a loop may come, see `over`: 1, less what the search keeps from it
    metrics: tuple[str, ...] = field(metadata={"static": True})
    names: tuple[str, ...] = field(metadata={"static": True})  # of the free gains

    def tightened(self, factor: float) -> "Asked":
        """With limits so many times as large."""
        return replace(self, limits=self.limits * factor)


def ask(ready: Study, names: tuple[str, ...], seed: int) -> Asked | None:
    """The margins that a scenario asks for, or None; where inertias are drawn, of the trials hardest by its gains."""
    if not ready.margins:
        return None
    coordinates: Coordinates = {}
    if margin_verdicts.differ(ready.dispersion):
        trials = np.arange(margin_verdicts.TRIALS)
        found = margin_verdicts.worst(ready.parts, ready.dispersion, seed, trials)
        shares = [over(found[one.metric], one.limit, at_least=one.at_least) for one in ready.margins]
        near = np.nan_to_num(shares, nan=np.inf)
        hardest = np.argsort(-np.max(near, axis=0), kind="stable")[:CASES]
        own = jax.vmap(lambda trial: ready.dispersion.coordinates(jnp.uint32(seed), trial))
        coordinates = own(jnp.asarray(trials[hardest], dtype=jnp.uint32))
    return Asked(
        parts=ready.parts,
        dispersion=ready.dispersion,
        coordinates=coordinates,
        wanted=jnp.asarray([one.limit for one in ready.margins]),
        limits=jnp.ones(len(ready.margins)),
        metrics=tuple(one.metric for one in ready.margins),
        names=names,
    )


def rows(asked: Asked, gains: Float[Array, " gains"]) -> Float[Array, "margins entries"]:
    """Constraints c, met where c <= 0: how near to its limit each margin comes, over `limits`, less 1.

    A loop without slopes is as far beyond as one without any margin.
    """
    parts = with_gains(asked.parts, dict(zip(asked.names, gains, strict=True)))

    def near(parts: Parts) -> Array:
        found = margins.judged(parts)[0].each()
        each = []
        for name, wanted in zip(asked.metrics, asked.wanted, strict=True):
            share = over(found[name].reshape(-1), wanted, at_least=MARGINS[name][2])
            each.append(jnp.where(jnp.isnan(share), 2.0, share))
        return jnp.stack(each)

    if asked.coordinates:
        cases = jax.lax.map(lambda c: near(asked.dispersion.at(parts, c)), asked.coordinates)
        found = jnp.concatenate(list(cases), axis=1)
    else:
        found = near(parts)
    return found / asked.limits[:, None] - 1.0


@partial(jax.jit, static_argnames="bounds")
def sloped(asked: Asked, bounds: Bounds, share: Array) -> dict[str, Array]:
    """The rows "c" at shares (gains,) of the bounds' intervals, and "c_slope" by these."""

    def twice(share: Array) -> tuple[Array, Array]:
        c = rows(asked, bounds.gains(share))
        return c, c

    slope, c = jax.jacfwd(twice, has_aux=True)(share)
    return {"c": c, "c_slope": jnp.nan_to_num(slope)}
