"""Whether loops have the margins that a scenario asks for: nominal, or over the inertias that are drawn."""

from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ptsmc_jax import programs
from ptsmc_jax.dispersions.base import INERTIA
from ptsmc_jax.dispersions.variation import Dispersion
from ptsmc_jax.scenario import Study
from ptsmc_jax.simulation.assembly import Parts
from ptsmc_jax.simulation.requirements import Requirement, Verdict
from ptsmc_jax.theory import margins

TRIALS = 256  # loops that are looked at, where inertias are drawn


def of_loop(parts: Parts, asked: Sequence[Requirement]) -> list[Verdict]:
    """One for each margin that is asked of the loop of these parts, see `margins.judged`."""
    if not asked:
        return []
    return _verdicts(asked, margins.judged_jit(parts)[0].worst())


def over_trials(ready: Study, seed: int) -> list[Verdict]:
    """One for each margin that is asked for: of the nominal loop, or the worst of the first `TRIALS` trials' loops."""
    if not ready.margins or not differ(ready.dispersion):
        return of_loop(ready.parts, ready.margins)
    return _verdicts(ready.margins, worst(ready.parts, ready.dispersion, seed, np.arange(TRIALS)))


def _verdicts(asked: Sequence[Requirement], found: Mapping[str, Any]) -> list[Verdict]:
    """From each margin by its name, of one loop or of many."""
    values = [np.asarray(found[one.metric]) for one in asked]
    return [one.verdict(value, np.asarray(~np.isnan(value))) for one, value in zip(asked, values, strict=True)]


def differ(dispersion: Dispersion) -> bool:
    """Whether loops differ from trial to trial."""
    return INERTIA in dispersion.kinds


def worst(parts: Parts, dispersion: Dispersion, seed: int, trials: np.ndarray) -> dict[str, np.ndarray]:
    """`catalogues.MARGINS` of each trial's loop, (trials,), the worst over axes and times; NaN without slopes."""
    found = _worst(parts, dispersion, jnp.uint32(seed), jnp.asarray(trials, dtype=jnp.uint32))
    return {name: np.asarray(v) for name, v in found.items()}


@programs.jit
def _worst(parts: Parts, dispersion: Dispersion, seed: Array, trials: Array) -> dict[str, Array]:
    def one(trial: Array) -> dict[str, Array]:
        return margins.judged(dispersion.apply(parts, seed, trial))[0].worst()

    return jax.lax.map(one, trials)  # not shared over devices: solving on two of a processor's at once never ends
