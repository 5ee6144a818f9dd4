"""The design rule that a torque limit asks for: the shortest t_f, by theory and confirmed by simulation."""

import contextlib
from collections.abc import Callable
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np

from ptsmc_jax import programs, scenario
from ptsmc_jax.batching import lapack
from ptsmc_jax.campaigns import montecarlo
from ptsmc_jax.dispersions.variation import Dispersion
from ptsmc_jax.scenario.errors import ScenarioError
from ptsmc_jax.scenario.tables import Scenario
from ptsmc_jax.simulation.requirements import Requirement, must_keep
from ptsmc_jax.simulation.rollout import Parts
from ptsmc_jax.theory import solutions
from tuning.search.gains import in_scenario, with_gains

FARTHEST = 100.0  # times the scenario's t_f: no longer one is looked at
CLOSE = 1e-3  # relative width at which the search by simulation ends
LONGEST = 12  # batches that it may fly


@dataclass(frozen=True)
class ShortestTime:
    """Shortest t_f [s] at which the largest input of every trial, or of a share of them, stays within the limit."""

    limit: float
    theory: float | None  # along the exact motions; None: the limit cannot be kept at any t_f
    simulated: float | None  # as flown; None: not found
    trials: int
    quantile: float | None = None  # share of trials that must keep it; None: every one
    unit: str | None = None  # of the limit


def shortest_time(flown: Scenario, asked: Requirement, seed: int, trials: np.ndarray) -> ShortestTime:
    """Shortest t_f of a scenario's gains for a limit on the commanded input, over these trials of the seed.

    As many of them keep it as the requirement's verdict asks for. By theory: the largest input along the exact motions
    of the trials (rule 3.5 for any start, reference and order). By simulation: the same search on flown trials, begun
    at what theory says.
    """
    ready = scenario.study(flown)
    drawn = ready.dispersion, jnp.uint32(seed), jnp.asarray(trials, dtype=jnp.uint32)
    limit, quantile = asked.limit, None if len(trials) == 1 else asked.implied_by.quantile
    told = len(trials), quantile, asked.unit
    deciding = (must_keep(len(trials), quantile, asked.confidence) or len(trials)) - 1  # of peaks in order

    def predicted(t_f: float) -> float:
        return float(np.sort(_predicted(ready.parts, *drawn, t_f))[deciding])

    own = float(ready.parts.controller.t_f)
    lowest = 1.05 * max(float(ready.parts.controller.delta), float(getattr(ready.parts.observer, "t_o", 0.0)))
    rule = _smallest(predicted, limit, own, lowest, FARTHEST * own, CLOSE, 60)
    if rule is None:
        return ShortestTime(limit, None, None, *told)

    def simulated_in(ready: scenario.Study, longest: float) -> float | None:
        def simulated(t_f: float) -> float:
            parts = with_gains(ready.parts, {"t_f": t_f})
            result = montecarlo.run(parts, ready.dispersion, seed, trials)
            peaks = np.where(result.finished, result.metrics.peak_torque, np.inf)
            return float(np.sort(peaks)[deciding])

        return _smallest(simulated, limit, rule, max(lowest, 0.2 * rule), longest, CLOSE, LONGEST)

    # in the scenario's own time, by the program that judges it; only where that is too short in a longer one
    shortest = simulated_in(ready, own) if rule <= own else None
    if shortest is None:
        longest = max(1.5 * rule, own)
        with contextlib.suppress(ScenarioError):  # a reference that runs into the law's singularity later, say
            roomy = scenario.study(in_scenario(flown, {"t_f": longest}))
            shortest = simulated_in(roomy, longest)
    return ShortestTime(limit, rule, shortest, *told)


@programs.jit
def _predicted(parts: Parts, dispersion: Dispersion, seed: jax.Array, trials: jax.Array, t_f: jax.Array) -> jax.Array:
    controller = replace(parts.controller, t_f=jnp.asarray(t_f, float))

    def peak(trial: jax.Array) -> jax.Array:
        return solutions.exact_peak(dispersion.apply(replace(parts, controller=controller), seed, trial))

    return lapack.vmap(peak)(trials)


def _smallest(
    peak: Callable[[float], float],
    limit: float,
    start: float,
    lowest: float,
    longest: float,
    close: float,
    most: int,
) -> float | None:
    """Smallest t_f at which peak(t_f) <= limit, the last crossing when t_f shrinks from where the limit is kept.

    Peaks fall about like 1 / t_f^2, so each guess is the last one times sqrt(peak / limit); every third one doubles it,
    or halves the bracket, whatever the peaks are like.

    Args:
        peak: of the input by t_f [s].
        limit: that it is to keep.
        start: the first t_f to look at [s].
        lowest: below which none is looked at [s].
        longest: beyond which none is looked at [s]; None is returned where it breaks the limit.
        close: relative width of the bracket at which the search ends.
        most: peaks that may be looked at.
    """
    over, kept = lowest, None  # t_f known to break the limit, and to keep it
    guess = start
    for looked in range(most):
        value = peak(guess)
        if value <= limit:
            kept = guess
        else:
            over = max(over, guess)
        if kept is not None and kept - over <= close * kept:
            break
        if kept is None and over >= longest:
            return None
        step = guess * (value / limit) ** 0.5 if np.isfinite(value) and value > 0 else 2 * guess
        step *= 1 - 0.5 * close if value <= limit else 1 + 0.2 * close  # to the other side of the limit
        bold = looked % 3 == 2
        if kept is None:
            guess = min(2 * over if bold else max(step, 1.001 * over), longest)
        else:
            guess = step if over < step < kept and not bold else 0.5 * (over + kept)
    return kept
