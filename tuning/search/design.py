"""The shortest t_f that keeps a torque limit, by theory and by simulation. Read `shortest_time` first."""

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

LONGEST_RATIO = 100.0  # largest t_f to examine, relative to the t_f of the scenario
TOLERANCE = 1e-3  # relative width at which the search by simulation ends
MOST_BATCHES = 12  # largest number of simulated batches


@dataclass(frozen=True)
class ShortestTime:
    """Shortest t_f [s] that keeps the largest input of all trials, or of a fraction of them, within the limit."""

    limit: float
    theory: float | None  # shortest t_f from the exact motions [s]; None: no t_f keeps the limit
    simulated: float | None  # shortest t_f found by simulation [s]; None: not found
    trials: int
    quantile: float | None = None  # fraction of trials that must keep the limit; None: all trials
    unit: str | None = None  # unit of the limit


def shortest_time(loaded: Scenario, requirement: Requirement, seed: int, trials: np.ndarray) -> ShortestTime:
    """Return the shortest t_f that keeps a limit on the commanded input. All other gains do not change.

    The quantile and the confidence of the requirement determine how many trials must keep the limit. Theory uses the
    largest input along the exact motion of each trial. The search by simulation begins at the t_f from theory.

    Args:
        loaded: the scenario.
        requirement: the requirement with the limit.
        seed: seed of the dispersions and the noise.
        trials: (trials,) numbers of the trials.
    """
    ready = scenario.study(loaded)
    trial_arguments = ready.dispersion, jnp.uint32(seed), jnp.asarray(trials, dtype=jnp.uint32)
    limit, quantile = requirement.limit, None if len(trials) == 1 else requirement.implied_by.quantile
    context = len(trials), quantile, requirement.unit
    # index of the trial that decides, in ascending order
    deciding = (must_keep(len(trials), quantile, requirement.confidence) or len(trials)) - 1

    def predict_peak(t_f: float) -> float:
        return float(np.sort(_predict_peaks(ready.parts, *trial_arguments, t_f))[deciding])

    present_t_f = float(ready.parts.controller.t_f)
    lowest = 1.05 * max(float(ready.parts.controller.delta), float(getattr(ready.parts.observer, "t_o", 0.0)))
    theory = _shortest_t_f(predict_peak, limit, present_t_f, lowest, LONGEST_RATIO * present_t_f, TOLERANCE, 60)
    if theory is None:
        return ShortestTime(limit, None, None, *context)

    def search_shortest_t_f(ready: scenario.Study, longest: float) -> float | None:
        def simulate_peak(t_f: float) -> float:
            parts = with_gains(ready.parts, {"t_f": t_f})
            result = montecarlo.run(parts, ready.dispersion, seed, trials)
            peaks = np.where(result.finished, result.metrics.peak_torque, np.inf)
            return float(np.sort(peaks)[deciding])

        return _shortest_t_f(simulate_peak, limit, theory, max(lowest, 0.2 * theory), longest, TOLERANCE, MOST_BATCHES)

    # first on the clock of the scenario, because its program is compiled anyway; a longer t_f needs a longer clock
    shortest = search_shortest_t_f(ready, present_t_f) if theory <= present_t_f else None
    if shortest is None:
        longest = max(1.5 * theory, present_t_f)
        with contextlib.suppress(ScenarioError):  # for example a reference that reaches the law's singularity later
            longer_study = scenario.study(in_scenario(loaded, {"t_f": longest}))
            shortest = search_shortest_t_f(longer_study, longest)
    return ShortestTime(limit, theory, shortest, *context)


@programs.jit
def _predict_peaks(
    parts: Parts, dispersion: Dispersion, seed: jax.Array, trials: jax.Array, t_f: jax.Array
) -> jax.Array:
    """Return the largest commanded input along the exact motion of each trial, (trials,), without a simulation."""
    controller = replace(parts.controller, t_f=jnp.asarray(t_f, float))

    def peak(trial: jax.Array) -> jax.Array:
        return solutions.exact_peak(dispersion.apply(replace(parts, controller=controller), seed, trial))

    return lapack.vmap(peak)(trials)


def _shortest_t_f(
    peak: Callable[[float], float],
    limit: float,
    start: float,
    lowest: float,
    longest: float,
    tolerance: float,
    max_evaluations: int,
) -> float | None:
    """Return the smallest t_f with peak(t_f) <= limit, or None.

    The limit is kept at the returned t_f. It is broken at a slightly shorter t_f, or `lowest` is reached there. Peaks
    decrease about as 1 / t_f^2, so each guess is the previous guess times sqrt(peak / limit). Every third guess doubles
    t_f or halves the bracket, regardless of the peaks.

    Args:
        peak: largest input as a function of t_f [s].
        limit: limit on the peak.
        start: first t_f to examine [s].
        lowest: smallest t_f to examine [s].
        longest: largest t_f to examine [s]. If it breaks the limit, None is returned.
        tolerance: relative width of the bracket at which the search ends.
        max_evaluations: largest number of peaks to compute.
    """
    too_short, long_enough = lowest, None  # largest t_f that breaks the limit, and smallest t_f that keeps it
    guess = start
    for attempt in range(max_evaluations):
        value = peak(guess)
        if value <= limit:
            long_enough = guess
        else:
            too_short = max(too_short, guess)
        if long_enough is not None and long_enough - too_short <= tolerance * long_enough:
            break
        if long_enough is None and too_short >= longest:
            return None
        step = guess * (value / limit) ** 0.5 if np.isfinite(value) and value > 0 else 2 * guess
        step *= 1 - 0.5 * tolerance if value <= limit else 1 + 0.2 * tolerance  # aim just beyond the crossing
        halve_or_double = attempt % 3 == 2
        if long_enough is None:
            guess = min(2 * too_short if halve_or_double else max(step, 1.001 * too_short), longest)
        else:
            guess = step if too_short < step < long_enough and not halve_or_double else 0.5 * (too_short + long_enough)
    return long_enough
