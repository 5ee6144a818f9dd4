"""Verdicts on required margins: of the nominal loop, or over the trials if dispersions change the loop."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from numpy.typing import ArrayLike

from ptsmc_jax import configure, programs
from ptsmc_jax.batching import lanes, lapack
from ptsmc_jax.campaigns import montecarlo
from ptsmc_jax.dispersions.base import CUSTOM, INERTIA, INITIAL_ATTITUDE, INITIAL_RATE, INITIAL_STATE, REFERENCE
from ptsmc_jax.dispersions.quantities import QUANTITIES
from ptsmc_jax.dispersions.variation import Dispersion, Row, trial_setup
from ptsmc_jax.scenario import Study
from ptsmc_jax.simulation.assembly import Parts
from ptsmc_jax.simulation.catalogues import MARGINS
from ptsmc_jax.simulation.requirements import Requirement, Verdict
from ptsmc_jax.theory import limit_cycles, linear, margins, run_margins

TRIALS = 256  # number of trials whose loops are judged if they differ
# quantities that change the linearised loop: hardware errors, the body, and the trajectory
LOOP_QUANTITIES = {INERTIA, CUSTOM, INITIAL_ATTITUDE, INITIAL_RATE, INITIAL_STATE, REFERENCE}
LOOP_QUANTITIES |= {name for name, quantity in QUANTITIES.items() if quantity.hardware}
LOOPS_PER_CALL = 32  # loops that are simulated and linearised at once
EXACT_PER_CALL = 16  # loops whose exact margins are computed at a time
DELAY = "delay_margin"  # the only margin that needs loops with a delay by a fraction of a period
# first guess for the error of `margins.estimate`, in dB, deg, periods, dB; see `worst_margins`
ASSUMED_ERROR = {"gain_margin": 0.06, "phase_margin": 0.12, "delay_margin": 0.2, "peak_sensitivity": 0.01}
# causes of a missing margin
FAILED = "the run failed"
OPEN = "the loop is open in the hold phase"
NOT_DIFFERENTIABLE = "the loop is not differentiable"
# exact results of `margins.estimate`: the loop is unstable, or no gain or phase makes it unstable
NOT_INTERPOLATED = (0.0, margins.LARGEST_MARGIN, -margins.LARGEST_MARGIN, 180.0, -180.0)


def judge_loop(parts: Parts, required: Sequence[Requirement], *, finished: ArrayLike = True) -> list[Verdict]:
    """Return the verdict on each required margin of the loop of these parts, see `run_margins.judge_run`.

    There are no margins if the nominal run does not come to rest, see `limit_cycles`. A loop that is open in the hold
    phase has no margins either.

    Args:
        parts: the sampled parts.
        required: the requirements on margins.
        finished: whether the runs of these parts reached their end, bool or (runs,). If one failed, no requirement is
            met.
    """
    if not required:
        return []
    no_margins, failed = {requirement.metric: np.nan for requirement in required}, ~np.asarray(finished)
    if failed.any():
        return _verdicts(required, no_margins, {FAILED: failed})
    values, hold, _ = run_margins.judge_run(parts, with_delay=_with_delay(required))
    is_open = (values.is_open & hold[:, None]).any()
    return _verdicts(required, no_margins if is_open else values.worst(), {OPEN: is_open})


def judge_trials(
    ready: Study, seed: int, rows: np.ndarray | Row | None = None, finished: ArrayLike = True
) -> list[Verdict]:
    """Return the verdict on each required margin: of the nominal loop, or the worst of the first `TRIALS` trials.

    A trial that failed meets no requirement. Trials after the first `TRIALS` ones do not matter.

    Args:
        ready: the scenario, ready to simulate.
        seed: seed of the dispersions.
        rows: rows of a run table, instead of the first trials.
        finished: whether each simulated trial reached its end, (trials,) bool from the first trial on.

    Returns:
        The verdicts. The nominal run decides whether runs come to rest.
    """
    trials, finished = _select_trials(ready, rows), np.atleast_1d(finished)[:TRIALS]
    if trials is None or limit_cycles.find(ready.parts) is not None:
        return judge_loop(ready.parts, ready.margins, finished=finished)
    limits = {requirement.metric: requirement.limit for requirement in ready.margins}
    by_name, is_open = worst_margins(ready.parts, ready.dispersion, seed, trials, limits)
    failed = np.zeros_like(is_open)
    failed[: finished.size] = ~finished
    by_name = {name: np.where(failed, np.nan, values) for name, values in by_name.items()}
    return _verdicts(ready.margins, by_name, {FAILED: failed, OPEN: is_open & ~failed})


def prepare(ready: Study, rows: np.ndarray | Row | None = None) -> None:
    """Start to compile the programs of `judge_trials` in the background."""
    trials = _select_trials(ready, rows)
    if trials is not None:
        arguments = _arguments(ready.parts, ready.dispersion, 0, trials, _with_delay(ready.margins))
        _loops_and_margins.prepare(*arguments)
    elif ready.margins:
        run_margins.judged_margins.prepare(ready.parts, _with_delay(ready.margins))


def _with_delay(required: Sequence[Requirement]) -> bool:
    """Return whether the delay margin is required."""
    return any(requirement.metric == DELAY for requirement in required)


def _select_trials(ready: Study, rows: np.ndarray | Row | None) -> np.ndarray | Row | None:
    """Return the trials whose loops are judged; None: only the nominal loop is judged, or no margin is required."""
    table_sets_loops = isinstance(rows, Row) and not LOOP_QUANTITIES.isdisjoint(rows.given)
    if not ready.margins or not (table_sets_loops or has_different_loops(ready.dispersion)):
        return None
    return np.arange(TRIALS) if rows is None else rows


def _verdicts(
    required: Sequence[Requirement], by_name: Mapping[str, ArrayLike], causes: Mapping[str, np.ndarray]
) -> list[Verdict]:
    """Return the verdict on each required margin.

    Args:
        required: the required margins.
        by_name: the margins of one loop, (), or of many loops, (loops,), by name; NaN if a loop has no margin.
        causes: for each cause, which trials have no margin because of it, bool. The other missing margins have the
            cause `NOT_DIFFERENTIABLE`.
    """
    results, trials = [], max(map(np.size, causes.values()))
    known = {cause: int(np.sum(mask)) for cause, mask in causes.items()}
    for requirement in required:
        values = np.asarray(by_name[requirement.metric])
        counts = {**known, NOT_DIFFERENTIABLE: int(np.sum(np.isnan(values))) - sum(known.values())}
        reason = " and ".join(
            cause if trials == 1 else f"{cause} in {count} trial{'s' if count > 1 else ''}"
            for cause, count in counts.items()
            if count > 0
        )
        results.append(replace(requirement.verdict(values, ~np.isnan(values)), reason=reason))
    return results


def has_different_loops(dispersion: Dispersion) -> bool:
    """Return whether the loops differ from trial to trial."""
    return not LOOP_QUANTITIES.isdisjoint(dispersion.kinds)


def signed_violation_ratio(value: Any, limit: Any, name: str) -> Any:
    """Return 1 for a margin at its limit, more for a violated limit, and less or a negative number on the safe side.

    Args:
        value: value of the margin, in the unit of `catalogues.MARGINS`, a number or an array of any shape.
        limit: required limit in the same unit, not 0.
        name: name of the margin in `MARGINS`, which decides whether the limit is the smallest or the largest allowed
            value.

    Returns:
        The ratio [-], in the shape of `value`.
    """
    return 2.0 - value / limit if MARGINS[name].at_least else value / limit


def worst_margins(
    parts: Parts,
    dispersion: Dispersion,
    seed: int,
    trials: np.ndarray | Row,
    limits: Mapping[str, float],
    places: int = 1,
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Return the worst margins of each trial over its axes and times, by name, and which loops are open in hold.

    A trial has NaN if its loop is open in the hold phase, or has no finite derivatives.

    The worst value of each margin is exact, and so are the margins of the `places` trials nearest to a limit. The other
    margins are interpolated: they are farther from their limits, and on the right side, as far as the error is known.

    First, the margins of every loop are interpolated between the frequencies of the exact search (`margins.estimate`).
    Then exact margins are computed, nearest to a limit first, until an error of `ASSUMED_ERROR` in the other loops can
    neither change the worst loop nor move a loop across a limit. Each exact margin shows the error of the
    interpolation. If it exceeds half of `ASSUMED_ERROR`, the assumed error becomes twice the observed error. Exact
    margins of all loops take about six times as long with the delay margin, and twice as long without it.

    Args:
        parts: the nominal parts.
        dispersion: the dispersions.
        seed: seed of the dispersions.
        trials: numbers of the trials, or rows of a run table.
        limits: limit of each required margin, by name.
        places: number of trials, nearest to a limit, whose margins are exact.

    Returns:
        The margins, (trials,), by name. Then whether the loop of each trial is open in the hold phase, (trials,) bool.
    """
    names, count = tuple(limits), jax.tree.leaves(trials)[0].shape[0]
    with_delay = DELAY in names
    padded_results = _loops_and_margins(*_arguments(parts, dispersion, seed, trials, with_delay))
    loops, estimates, is_open = jax.tree.map(lambda v: np.asarray(v)[:count].reshape(-1, *v.shape[2:]), padded_results)
    values = np.stack([estimates[name] for name in names])  # (margins, loops)
    limit = np.asarray([limits[name] for name in names])[:, None]
    error = np.asarray([[ASSUMED_ERROR[name] * (loops.period[0] if name == DELAY else 1.0)] for name in names]) / limit
    is_interpolated = np.isfinite(values) & ~np.isin(values, NOT_INTERPOLATED)
    while True:
        ratios = _violation_ratios(values, limit, names)
        low, high = ratios - np.where(is_interpolated, error, 0.0), ratios + np.where(is_interpolated, error, 0.0)
        by_trial = np.sort(low.reshape(len(names), count, -1).max(axis=(0, 2)))
        threshold = np.minimum(low.max(axis=1, keepdims=True), by_trial[-min(places, count)])
        is_undecided = is_interpolated & ((high >= threshold) | ((low <= 1.0) & (high >= 1.0)))
        order = np.argsort(-np.where(is_undecided, high, -np.inf).max(axis=0), kind="stable")
        chosen = order[: min(EXACT_PER_CALL, np.count_nonzero(is_undecided.any(axis=0)))]
        if not chosen.size:
            by_name = {name: _worst_value(name, v.reshape(count, -1)) for name, v in zip(names, values, strict=True)}
            return by_name, is_open.reshape(count, -1).any(axis=1)
        chosen = np.resize(chosen, EXACT_PER_CALL)  # always the same shape, so that one program is compiled
        chosen_loops = jax.tree.map(lambda v, chosen=chosen: v[chosen], loops)
        exact_by_name = margins.compute_each(chosen_loops, with_delay=with_delay).by_name()
        exact = np.stack([_worst_value(name, np.asarray(exact_by_name[name])) for name in names])
        deviation = np.abs(_violation_ratios(exact, limit, names) - ratios[:, chosen])
        deviation = np.where(np.isfinite(deviation), deviation, 0.0).max(axis=1, keepdims=True)
        error = np.where(deviation > error / 2.0, 2.0 * deviation, error)
        values[:, chosen], is_interpolated[:, chosen] = exact, False


def _arguments(parts: Parts, dispersion: Dispersion, seed: int, trials: np.ndarray | Row, with_delay: bool) -> tuple:
    """Return the arguments of `_loops_and_margins`; trials are repeated to fill the last call on every device."""
    devices = len(configure.processors())
    trials_per_round = LOOPS_PER_CALL * devices

    def pad(v: np.ndarray) -> Array:
        return jnp.asarray(np.resize(v, (-(-v.shape[0] // trials_per_round) * trials_per_round, *v.shape[1:])))

    padded_trials = jax.tree.map(pad, trials if isinstance(trials, Row) else np.asarray(trials, dtype=np.uint32))
    return parts, dispersion, jnp.uint32(seed), padded_trials, devices, with_delay


def _violation_ratios(values: np.ndarray, limit: np.ndarray, names: Sequence[str]) -> np.ndarray:
    """Return the `signed_violation_ratio` of each margin, (margins, loops); -inf for a loop without a value."""
    ratios = np.stack([signed_violation_ratio(v, one, name) for v, one, name in zip(values, limit, names, strict=True)])
    return np.where(np.isnan(ratios), -np.inf, ratios)


def _worst_value(name: str, values: Any) -> Any:
    """Return the worst value of a margin along the last axis: the smallest, or the largest of a peak sensitivity."""
    return values.min(axis=-1) if MARGINS[name].at_least else values.max(axis=-1)


@programs.jit(static_argnames=("devices", "with_delay"), title="the margins of many trials")
def _loops_and_margins(
    parts: Parts, dispersion: Dispersion, seed: Array, trials: Array | Row, devices: int, with_delay: bool
) -> tuple[linear.Loop, dict[str, Array], Array]:
    """Return the loops of each trial, (trials, times, ..), their interpolated margins, and which are open in hold.

    The margins are arrays (trials, times) by name, the worst over the axes. A loop that is open in the hold phase has
    NaN. The last result is bool, (trials, times).

    with_delay: the loops allow delays by a fraction of a period, see `linear.linearise_period`.
    """

    def interpolate_margins(loop: linear.Loop) -> tuple[dict[str, Array], Array]:
        values = margins.estimate(loop)
        is_open = (values["gain_margin"] == jnp.inf) & (jnp.abs(values["peak_sensitivity"]) < 1e-9)
        return {name: _worst_value(name, v) for name, v in values.items()}, jnp.any(is_open)

    def simulate_trial(trial: Array | Row) -> tuple[Parts, linear.NominalRun]:
        drawn = trial_setup(parts, dispersion, seed, trial).dispersed_parts
        return drawn, linear.simulate_nominal(drawn)

    def loops_of_trial(drawn: Parts, run: linear.NominalRun) -> linear.Loop:
        return run_margins.judged_loops(drawn, run, fractional_delays=with_delay)[0]

    def analyse_trials(trials: Array | Row) -> tuple[linear.Loop, dict[str, Array], Array]:
        loops = lapack.vmap(loops_of_trial)(*lanes.vmap(simulate_trial)(trials))
        by_loop = jax.lax.map(interpolate_margins, jax.tree.map(lambda v: v.reshape(-1, *v.shape[2:]), loops))
        values, is_open = jax.tree.map(lambda v: v.reshape(LOOPS_PER_CALL, -1), by_loop)
        is_open = is_open.at[:, :-1].set(False)  # the last loop of a trial is in the hold phase
        return loops, {name: jnp.where(is_open, jnp.nan, v) for name, v in values.items()}, is_open

    def analyse_on_device(trials: Array | Row) -> tuple[linear.Loop, dict[str, Array], Array]:
        calls = jax.lax.map(analyse_trials, jax.tree.map(lambda v: v.reshape(-1, LOOPS_PER_CALL, *v.shape[1:]), trials))
        return jax.tree.map(lambda v: v.reshape(-1, *v.shape[2:]), calls)

    return montecarlo.map_over_devices(analyse_on_device, trials, devices)
