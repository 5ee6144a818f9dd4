"""Judge gains on held-out trials: simulate them on the flight clock and check the requirements.

The tuned gains are compared with the published gains and with the scenario's original gains. Read `judge` first, then
`verdicts_of`.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np

from ptsmc_jax.campaigns import margin_verdicts, montecarlo, runs
from ptsmc_jax.campaigns.montecarlo import Trials
from ptsmc_jax.numerics import draws, statistics
from ptsmc_jax.scenario import Study, replace, study
from ptsmc_jax.scenario.errors import ScenarioError
from ptsmc_jax.scenario.tables import Limit, Scenario
from ptsmc_jax.scenario.timing import Reach
from ptsmc_jax.simulation import requirements
from ptsmc_jax.simulation.assembly import Parts
from ptsmc_jax.simulation.catalogues import POINTING
from ptsmc_jax.simulation.gains import paths_of
from ptsmc_jax.simulation.requirements import Verdict
from tuning.search import confirm, gains, simulations, trust
from tuning.search.objective import Problem, coordinates_of


def derive_held_out_seed(seed: int, turn: int = 0) -> int:
    """Return the seed of the held-out trials.

    Args:
        seed: seed of the search.
        turn: number of earlier searches whose gains broke a limit on their held-out trials.
    """
    return draws.derive(seed, f"fresh trials {turn}" if turn else "fresh trials")


def reference_scenarios(scenario: Scenario) -> tuple[dict[str, Scenario], str | None]:
    """Return the scenario with the published gains and with its original gains, for comparison with tuned gains.

    Returns:
        First a dictionary: "published" is the scenario with the published gains, and "before" is the scenario itself if
        its gains differ from the published ones. Then the reason why the published gains are not valid in the
        scenario, or None. In this case "published" is missing.
    """
    try:
        published = gains.published_scenario(scenario)
        study(on_flight_clock(published))
    except ScenarioError as error:
        return {"before": scenario}, str(error)
    return {"published": published} | ({"before": scenario} if gains.controls_differ(scenario, published) else {}), None


def judge(scenario: Scenario, held_out_seed: int, problem: Problem | None = None, reach: Reach | None = None) -> Trials:
    """Simulate a scenario on its held-out trials. A sampled loop gets the flight clock.

    If the compiled program of the search can simulate the scenario, it is used again. The results then have only the
    pointing metrics that the problem and the requirements need.

    Args:
        scenario: scenario with the gains.
        held_out_seed: seed of the held-out trials.
        problem: the tuning problem of the search; None: there was no search.
        reach: ranges of the gains that share a compiled program; None: those of the scenario.
    """
    simulated = _on_flight_clock(scenario, problem, reach)
    trials = np.arange(count_held_out_trials(simulated))
    if problem is None or not _is_served(simulated.parts, problem):
        return montecarlo.run(simulated.parts, simulated.dispersion, held_out_seed, trials)
    batch = problem.batch
    # a limit on a fraction of the time is a limit at all times in the search, but not in the verdict
    judged = {*batch.pointing, *(name for r in simulated.requirements for name in (r.metric, r.timed))}
    batch = batch._replace(
        parts=simulated.parts,
        dispersion=simulated.dispersion,
        seed=held_out_seed,
        trials=trials.astype(np.uint32),
        coordinates=coordinates_of(simulated.dispersion, held_out_seed, trials),
        pointing=tuple(name for name in POINTING if name in judged),
    )
    return simulations.simulate_trials(batch, np.asarray(gains.present_values(simulated.parts, problem.names)))


def _is_served(parts: Parts, problem: Problem) -> bool:
    """Return whether the program of the search simulates these parts with their gains.

    Published gains may belong to another law, or differ by axis where the search tunes one gain for all axes.
    """
    if not parts.clock.sampled or not set(problem.names) <= paths_of(parts).keys():
        return False
    values = dict(zip(problem.names, gains.present_values(parts, problem.names), strict=True))
    return gains.gains_of(gains.with_gains(parts, values)) == gains.gains_of(parts)


def _on_flight_clock(scenario: Scenario, problem: Problem | None, reach: Reach | None = None) -> Study:
    """Return the study of a scenario on the flight clock, with at least as many samples as the problem.

    With equal numbers of samples, both use one compiled program.
    """
    simulated = study(on_flight_clock(scenario), reach=reach)
    if problem is None or not scenario.sampled:
        return simulated
    parts = simulated.parts
    parts = dataclasses.replace(parts, clock=parts.clock.long_enough_for([parts.clock, problem.parts.clock]))
    return dataclasses.replace(simulated, parts=parts)


def rms_lower_bound(scenario: Scenario, held_out_seed: int) -> float | None:
    """Return the lower bound of the RMS window error on the flight clock, see `runs.rms_lower_bound`."""
    return runs.rms_lower_bound(study(on_flight_clock(scenario)), held_out_seed)


def verdicts_of(
    scenario: Scenario,
    trials: Trials,
    held_out_seed: int,
    problem: Problem | None = None,
    reach: Reach | None = None,
) -> list[Verdict]:
    """Return the verdicts on the requirements, and on the required margins of the loop.

    Args:
        scenario: scenario with the requirements and the gains.
        trials: the held-out trials of these gains.
        held_out_seed: seed of these trials.
        problem: the tuning problem of the search, see `judge`.
        reach: ranges of the gains that share a compiled program, see `judge`.
    """
    ready = _on_flight_clock(scenario, problem, reach)
    # one nominal trial is judged as a number, because a required fraction of the trials has no meaning for it
    selection = 0 if trials.status.size == 1 else slice(None)

    def values(name: str) -> np.ndarray:
        return trials.metrics[name][selection]  # KeyError instead of NaN if the trials lack a required metric

    simulated = requirements.verdicts(ready.requirements, values, trials.finished[selection])
    return [*simulated, *margin_verdicts.judge_trials(ready, held_out_seed, None, trials.finished)]


def meets_requirements(verdicts: Sequence[Verdict], trials: Trials) -> bool:
    """Return whether every requirement is met, every trial reaches its end, and every trial converges by t_f."""
    return all(v.met for v in verdicts) and bool(np.all(trials.ok))


def rms_window_error(trials: Trials) -> tuple[float | None, tuple[float, float] | None]:
    """Return the RMS window error of the trials that reached their end, and its confidence interval.

    The error is None if no trial reached its end.
    """
    errors = np.asarray(trials.metrics.window_error)[trials.finished]
    return float(trust.rms(errors)) if errors.size else None, trust.interval(errors, trust.rms)


def required_quantile(name: str, scenario: Scenario, trials: Trials) -> float:
    """Return the value that a metric stays below in the required fraction of the trials, in the metric's unit.

    Failed trials count as larger than all others, as in the verdict. If more trials fail than the fraction allows, the
    result is the largest value of the trials that reach their end.

    Args:
        name: name of the metric.
        scenario: scenario whose requirement on the metric defines the fraction; it is 1 without a requirement.
        trials: the trials.

    Returns:
        The value; NaN if no trial reaches its end.
    """
    values = np.sort(np.asarray(getattr(trials.metrics, name))[trials.finished])
    requirement = scenario.requirements.get(name)
    fraction = (requirement.fraction if isinstance(requirement, Limit) else None) or 1.0
    return (
        statistics.sample_quantile(values, min(1.0, fraction * trials.status.size / values.size))
        if values.size
        else np.nan
    )


def on_flight_clock(scenario: Scenario) -> Scenario:
    """Return the scenario on the flight clock. A scenario with the continuous loop does not change."""
    return replace(scenario, loop__clock="flight") if scenario.sampled else scenario


def describe_simulation(simulated: Scenario) -> str:
    """Return the clock and the sign function of the simulations in words, for reports."""
    if not simulated.sampled:
        return "the continuous loop"
    if getattr(simulated.controller, "implicit", False):
        return "flight clock, implicit sampling"
    sign_width = getattr(simulated.controller, "sign_width", None)
    if sign_width is None:
        return "flight clock"
    return "flight clock, " + (f"boundary layer of {sign_width:g}" if sign_width else "discontinuous sign")


def count_needed_trials(ready: Study, count: int) -> int:
    """Return the number of trials to simulate: 1 if all trials are equal, else `count`."""
    return count if ready.drawn else 1


def count_held_out_trials(ready: Study) -> int:
    """Return the number of held-out trials of a judgement."""
    return count_needed_trials(ready, confirm.held_out_trials(ready.requirements))
