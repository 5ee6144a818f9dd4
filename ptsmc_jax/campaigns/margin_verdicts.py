"""Whether loops have the margins that a scenario asks for: nominal, or over what is drawn and changes them."""

from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ptsmc_jax import configure, programs
from ptsmc_jax.batching import lapack
from ptsmc_jax.campaigns import montecarlo
from ptsmc_jax.dispersions import planned
from ptsmc_jax.dispersions.base import INERTIA, INITIAL_ATTITUDE, INITIAL_RATE, INITIAL_STATE, OWN, REFERENCE
from ptsmc_jax.dispersions.planned import Row
from ptsmc_jax.dispersions.quantities import QUANTITIES
from ptsmc_jax.dispersions.variation import Dispersion
from ptsmc_jax.scenario import Study
from ptsmc_jax.simulation.assembly import Parts
from ptsmc_jax.simulation.catalogues import MARGINS
from ptsmc_jax.simulation.requirements import Requirement, Verdict
from ptsmc_jax.theory import linear, margins, rest, run_margins

TRIALS = 256  # whose loops are looked at, where they differ
# quantities that change the linearised loop: hardware errors, the body, and the trajectory
OF_LOOPS = {INERTIA, OWN, INITIAL_ATTITUDE, INITIAL_RATE, INITIAL_STATE, REFERENCE}
OF_LOOPS |= {name for name, quantity in QUANTITIES.items() if quantity.hardware}
CALL = 32  # of them that are flown and linearised at once
JUDGED = 16  # loops judged in full at a time
DELAY = "delay_margin"  # the one margin that commands late within a period are looked at for
# how far off what `margins.roughly` reads is taken to be at first: in dB, deg, periods, dB; see `worst`
OFF = {"gain_margin": 0.06, "phase_margin": 0.12, "delay_margin": 0.2, "modulus_margin": 0.01}
# values that are not read between frequencies: of an unstable loop, or of one that no gain or phase makes unstable
BOUNDS = (0.0, margins.MOST, -margins.MOST, 180.0, -180.0)


def of_loop(parts: Parts, asked: Sequence[Requirement]) -> list[Verdict]:
    """One for each margin that is asked of the loop of these parts, see `run_margins.judged`.

    None is left where the nominal run does not come to rest, see `rest`.
    """
    if not asked:
        return []
    left, hold, history = jax.tree.map(np.asarray, run_margins.judged_jit(parts))
    if rest.swing(parts, history) is not None:
        left = rest.none_left(left, hold)
    return _verdicts(asked, left.worst())


def over_trials(ready: Study, seed: int, rows: np.ndarray | Row | None = None) -> list[Verdict]:
    """One for each margin that is asked for: of the nominal loop, or the worst of the first `TRIALS` trials' loops.

    rows: those of a plan, in place of the first trials. Whether runs come to rest is seen from the nominal one, which
    is none of those that the trials' loops are linearised about.
    """
    trials = _whose_loops_differ(ready, rows)
    if trials is None or rest.swing(ready.parts) is not None:
        return of_loop(ready.parts, ready.margins)
    limits = {requirement.metric: requirement.limit for requirement in ready.margins}
    return _verdicts(ready.margins, worst(ready.parts, ready.dispersion, seed, trials, limits))


def prepare(ready: Study, rows: np.ndarray | Row | None = None) -> None:
    """Begin to compile what `over_trials` needs, beside what is being done."""
    trials = _whose_loops_differ(ready, rows)
    if trials is not None:
        late = any(requirement.metric == DELAY for requirement in ready.margins)
        _look.prepare(*_looked_at(ready.parts, ready.dispersion, 0, trials, late))
    elif ready.margins:
        run_margins.judged_jit.prepare(ready.parts)


def _whose_loops_differ(ready: Study, rows: np.ndarray | Row | None) -> np.ndarray | Row | None:
    """Return the trials whose margins are required; None: only the nominal loop, or no margin is required."""
    planned_loops = isinstance(rows, Row) and not OF_LOOPS.isdisjoint(rows.given)
    if not ready.margins or not (planned_loops or differ(ready.dispersion)):
        return None
    return np.arange(TRIALS) if rows is None else rows


def _verdicts(asked: Sequence[Requirement], by_name: Mapping[str, Any]) -> list[Verdict]:
    """A verdict for each margin that is asked for, from its values by name, of one loop or of many."""
    values = [np.asarray(by_name[requirement.metric]) for requirement in asked]
    return [r.verdict(value, np.asarray(~np.isnan(value))) for r, value in zip(asked, values, strict=True)]


def differ(dispersion: Dispersion) -> bool:
    """Whether loops differ from trial to trial."""
    return not OF_LOOPS.isdisjoint(dispersion.kinds)


def nearness(value: Any, limit: Any, name: str) -> Any:
    """As `requirements.over`, but negative values stay: margins far from their limit can be put in order, too."""
    return 2.0 - value / limit if MARGINS[name].at_least else value / limit


def worst(
    parts: Parts,
    dispersion: Dispersion,
    seed: int,
    trials: np.ndarray | Row,
    limits: Mapping[str, float],
    places: int = 1,
) -> dict[str, np.ndarray]:
    """Margins of each trial, (trials,), those that have a limit; the worst over its axes and times; NaN without slopes.

    Exact are the worst of each margin, and the margins of the `places` trials that come nearest to a limit. All others
    are rough: farther from their limits than these, and on the right side of them, as far as the error is known.

    Args:
        parts: the nominal ones.
        dispersion: what is drawn about them.
        seed: of the draws.
        trials: their numbers, or rows of a plan.
        limits: of each margin that is wanted, by its name.
        places: how many trials nearest to a limit are to be exact.

    First the margins of every loop are read roughly, by straight lines between the frequencies that exact margins are
    found by. Then loops are judged exactly, the nearest first, as long as an error of `OFF` could make one of the
    others count, or could move it across a limit. Each exact margin also shows how large the error of the lines was:
    where it is more than half of `OFF`, twice as much is reckoned with from then on. No bound holds for all loops: of
    the tests' rigid bodies the error is below half of `OFF`; of a flexible one, and of two inputs, with gains at random
    it was up to 0.8 deg, 0.4 periods and 0.02 dB of the sensitivity, and 10 dB of one gain, far from any limit.
    """
    names, count = tuple(limits), jax.tree.leaves(trials)[0].shape[0]
    late = DELAY in names
    looks = _look(*_looked_at(parts, dispersion, seed, trials, late))
    loops, rough = jax.tree.map(lambda v: np.asarray(v)[:count].reshape(-1, *v.shape[2:]), looks)
    values = np.stack([rough[name] for name in names])  # (names, loops)
    limit = np.asarray([limits[name] for name in names])[:, None]
    off = np.asarray([[OFF[name] * (loops.period[0] if name == DELAY else 1.0)] for name in names]) / limit
    unsure = np.isfinite(values) & ~np.isin(values, BOUNDS)
    while True:
        near = _nearness(values, limit, names)
        low, high = near - np.where(unsure, off, 0.0), near + np.where(unsure, off, 0.0)
        by_trial = np.sort(low.reshape(len(names), count, -1).max(axis=(0, 2)))
        least = np.minimum(low.max(axis=1, keepdims=True), by_trial[-min(places, count)])
        unsettled = unsure & ((high >= least) | ((low <= 1.0) & (high >= 1.0)))
        order = np.argsort(-np.where(unsettled, high, -np.inf).max(axis=0), kind="stable")
        chosen = order[: min(JUDGED, np.count_nonzero(unsettled.any(axis=0)))]
        if not chosen.size:
            return {name: _over(name, v.reshape(count, -1)) for name, v in zip(names, values, strict=True)}
        chosen = np.resize(chosen, JUDGED)  # one shape, one program
        some = jax.tree.map(lambda v, chosen=chosen: v[chosen], loops)
        full = margins.of_each(some, with_delay=late).each()
        exact = np.stack([_over(name, np.asarray(full[name])) for name in names])
        apart = np.abs(_nearness(exact, limit, names) - near[:, chosen])
        apart = np.where(np.isfinite(apart), apart, 0.0).max(axis=1, keepdims=True)
        off = np.where(apart > off / 2.0, 2.0 * apart, off)
        values[:, chosen], unsure[:, chosen] = exact, False


def _looked_at(parts: Parts, dispersion: Dispersion, seed: int, trials: np.ndarray | Row, late: bool) -> tuple:
    """What `_look` is called with: the trials, and some of them again, as many as whole calls on every device take."""
    devices = len(configure.processors())
    together = CALL * devices

    def padded(v: Any) -> Array:
        return jnp.asarray(np.resize(v, (-(-v.shape[0] // together) * together, *v.shape[1:])))

    some = jax.tree.map(padded, trials if isinstance(trials, Row) else np.asarray(trials, dtype=np.uint32))
    return parts, dispersion, jnp.uint32(seed), some, devices, late


def _nearness(values: np.ndarray, limit: np.ndarray, names: Sequence[str]) -> np.ndarray:
    """`nearness` of each margin, arrays over them first; a loop without a value counts as behind all others."""
    near = np.stack([nearness(v, one, name) for v, one, name in zip(values, limit, names, strict=True)])
    return np.where(np.isnan(near), -np.inf, near)


def _over(name: str, values: Any) -> Any:
    """The worst along the last axis."""
    return values.min(axis=-1) if MARGINS[name].at_least else values.max(axis=-1)


@programs.jit(static_argnames=("devices", "late"))
def _look(
    parts: Parts, dispersion: Dispersion, seed: Array, trials: Array | Row, devices: int, late: bool
) -> tuple[linear.Loop, dict[str, Array]]:
    """Loops of each trial, (trials, times, ..), and what is roughly their margins, the worst over the axes.

    late: see `linear.opened`.
    """

    def rough(loop: linear.Loop) -> dict[str, Array]:
        return {name: _over(name, v) for name, v in margins.roughly(loop).items()}

    def one(trial: Array | Row) -> linear.Loop:
        return run_margins.judged_loops(planned.about(parts, dispersion, seed, trial).drawn, late=late)[0]

    def some(trials: Array | Row) -> tuple[linear.Loop, dict[str, Array]]:
        loops = lapack.vmap(one)(trials)
        values = jax.lax.map(rough, jax.tree.map(lambda v: v.reshape(-1, *v.shape[2:]), loops))
        return loops, {name: v.reshape(CALL, -1) for name, v in values.items()}

    def on_device(trials: Array | Row) -> tuple[linear.Loop, dict[str, Array]]:
        calls = jax.lax.map(some, jax.tree.map(lambda v: v.reshape(-1, CALL, *v.shape[1:]), trials))
        return jax.tree.map(lambda v: v.reshape(-1, *v.shape[2:]), calls)

    return montecarlo.spread(on_device, trials, devices)
