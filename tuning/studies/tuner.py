"""`ptsmc tune`: search for gains and judge them on held-out trials, against published and original gains.

If the gains break a limit on the held-out trials, the search is repeated with more distance from the limits. Read
`tune` first.
"""

import time
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from ptsmc_jax.campaigns import montecarlo
from ptsmc_jax.campaigns.montecarlo import Trials
from ptsmc_jax.scenario import custom_checks, free_gains, study
from ptsmc_jax.scenario.errors import ScenarioError
from ptsmc_jax.scenario.tables import Scenario
from ptsmc_jax.simulation.requirements import Verdict
from ptsmc_jax.theory import run_margins
from tuning.search import gains, global_check, simulations, trust
from tuning.search.design import ShortestTime, shortest_time
from tuning.search.global_check import Check
from tuning.search.journal import Journal
from tuning.search.local_searches import Step
from tuning.search.objective import T_F, Problem
from tuning.search.optimise import Search
from tuning.search.progress import Report, headed
from tuning.search.trust import Profile
from tuning.studies import judging, posing, stability
from tuning.studies.posing import TuningSetup

MOST_WIDENINGS = 3  # largest number of searches in wider bounds
TRIES = 3  # largest number of searches; each is judged on its own held-out trials
# a repeated search tightens a limit by its ratio of value to limit on the held-out trials, and by this factor
EXTRA_DISTANCE = 1.02
# metrics whose sensitivities to the gains are reported
SENSITIVITY_METRICS = ("window_error", "hold_error", "peak_torque", "effort", "chattering")


@dataclass(frozen=True)
class Trust:
    """Checks of a result: gradient errors, profiles, sensitivities and stability margins, see `trust`."""

    gradient_error: tuple[float, float] | None  # relative error at the first and last point; None: no gradients
    without_gradients: str | None  # reason in words for a search without gradients; None also for a discontinuous sign
    profiles: dict[str, Profile]  # objective along each gain
    sensitivities: dict[str, dict[str, float]]
    margins: dict[str, dict[str, Any]] | None  # stability margins of the tuned gains, see `stability.worst_margins`


@dataclass(frozen=True)
class BeyondBound:
    """The results on held-out trials after moving one gain from its bound to a value beyond."""

    value: float  # value of the gain, in its unit
    error_ratio: float | None  # RMS window error, relative to the tuned gains; None: an error is missing or zero
    broken: str | None  # violated requirement, in words; None: all requirements are met, and no trial failed

    @property
    def is_better(self) -> bool:
        """Whether the error decreases by more than 1 % beyond the bound, with all requirements met."""
        return self.broken is None and self.error_ratio is not None and self.error_ratio < 1.0 - trust.FLAT


@dataclass(frozen=True)
class RejectedSearch:
    """A search whose gains kept every limit on the training trials, but broke a limit on the held-out trials."""

    held_out_seed: int  # seed of the held-out trials
    gains: dict[str, float]
    margins: dict[str, float]  # distance from the limit of each metric in the search, as a fraction of the limit
    over: dict[str, float]  # judged value over the limit, for each metric that broke its limit on the held-out trials


@dataclass(frozen=True)
class _Judged:
    """The gains of a search, and their results on held-out trials."""

    search: Search
    search_end: float  # time of the monotonic clock at the end of the search [s]
    earlier: list[RejectedSearch]
    gains: dict[str, float]  # rounded gains by name
    tuned: Scenario  # scenario with the rounded gains, on the flight clock
    held_out_seed: int  # seed of the held-out trials
    trials: Trials  # held-out trials of these gains
    verdicts: list[Verdict]  # verdicts on these gains from the held-out trials


@dataclass(frozen=True)
class Tuning(_Judged):
    """The results of a tuning run, which may have been interrupted."""

    at_bound: dict[str, str]
    widened_bounds: dict[
        str, tuple[float, float]
    ]  # default bounds that the search moved, see `_search_in_wider_bounds`
    training: Trials  # tuned gains on the training trials
    held_out: dict[str, Trials]  # held-out trials: "tuned" and the keys of `judging.reference_scenarios`
    published_unavailable: str | None  # reason why the published gains cannot be simulated
    seed: int  # seed of the training trials and the search
    judged_gains: dict[str, dict[str, float]]  # gains by name, for each key of `held_out`
    lower_bounds: dict[str, float | None]  # lower bound of the RMS window error, for each key of `held_out`
    broken_by: dict[str, list[str]]  # gains that are more accurate than the tuned ones, and the metrics that they break
    shortest: ShortestTime | None  # shortest t_f that the torque limit allows; None: no torque limit, or t_f is tuned
    trust: Trust | None  # None: interrupted, or not requested
    beyond: dict[str, BeyondBound]  # results beyond the bounds of gains that ended on a bound
    check: Check | None  # comparison with a global search, if requested
    rollouts: int  # simulations of the search without gradients
    gradients: int  # simulations of the search with gradients
    seconds: float  # duration of the search

    @property
    def met(self) -> bool:
        """Whether the held-out trials meet every requirement, and none of them failed."""
        return judging.meets_requirements(self.verdicts, self.trials)

    @property
    def status(self) -> str:
        """Return "interrupted", "met" or "not met"."""
        return "interrupted" if self.search.interrupted else "met" if self.met else "not met"


def tune(
    scenario: Scenario,
    seed: int,
    report: Report = lambda *_: None,
    journal: Journal | None = None,
    *,
    with_global_check: bool = False,
    with_checks: bool = True,
    tries: int = TRIES,
) -> Tuning:
    """Tune the scenario's free gains (table `tune`) and judge them on held-out trials.

    If the gains break a limit on the held-out trials that the search kept, the search starts again from these gains. It
    has as many starting points as before and keeps more distance from the limits. Its gains are judged on new held-out
    trials.

    Args:
        scenario: scenario with free gains.
        seed: seed of the training trials and the search. The seeds of the held-out trials follow from it.
        report: called with the progress after every step.
        journal: evaluations of an interrupted run, which then resumes.
        with_global_check: compare the result with a global search (differential evolution).
        with_checks: also check the gradients, and compute profiles, sensitivities and margins of the result.
        tries: largest number of searches. A search is repeated if its gains break a limit on the held-out trials.

    Returns:
        The gains, and their results on training and held-out trials.
    """
    started = time.monotonic()
    report("compiling", 0, 0, np.nan, 0.0)
    setup = posing.set_up_tuning(scenario, seed, journal)
    references, published_error = judging.reference_scenarios(scenario)
    first_bounds = setup.ready.scenario.search.bounds
    judged, setup = _search_and_judge(scenario, setup, journal, report, tries)
    evaluate, last_bounds = setup.evaluate, setup.ready.scenario.search.bounds
    outcome, rollouts, gradients = judged.search, evaluate.rollouts, evaluate.gradients
    check = None
    if with_global_check and not outcome.interrupted:
        check = global_check.check(evaluate, outcome, seed, report, with_gradients=outcome.with_gradients)
    problem = setup.problem
    training = simulations.simulate_trials(
        problem.batch_of(np.arange(problem.averaged)), np.asarray([*judged.gains.values()])
    )
    candidates = {"tuned": judged.tuned} | {name: judging.on_flight_clock(other) for name, other in references.items()}
    held_out = {"tuned": judged.trials} | {
        name: judging.judge(other, judged.held_out_seed, problem) for name, other in references.items()
    }
    shortest = _find_shortest_time(setup, judged)
    trust_checks, beyond_bounds, at_bound = None, {}, evaluate.bounds.at_bound(outcome.gains)
    if with_checks and not outcome.interrupted:
        report("profiles, sensitivities and margins of the gains found", 0, 0, outcome.value, outcome.violation)
        trust_checks = _check_result(setup, judged)
        profiles = trust_checks.profiles
        relevant = {name: side for name, side in at_bound.items() if not profiles[name].is_flat}
        beyond_bounds = _results_beyond_bounds(judged, relevant)
    return Tuning(
        **vars(judged),
        at_bound=at_bound,
        widened_bounds={name: bounds for name, bounds in last_bounds.items() if bounds != first_bounds[name]},
        training=training,
        held_out=held_out,
        published_unavailable=published_error,
        seed=seed,
        judged_gains={name: gains.gains_of(study(one).parts) for name, one in candidates.items()},
        lower_bounds={name: judging.rms_lower_bound(one, judged.held_out_seed) for name, one in candidates.items()},
        broken_by=_find_broken_requirements(candidates, held_out, judged.held_out_seed, problem),
        shortest=shortest,
        trust=trust_checks,
        beyond=beyond_bounds,
        check=check,
        rollouts=rollouts,
        gradients=gradients,
        seconds=judged.search_end - started,
    )


def _search_and_judge(
    scenario: Scenario, setup: TuningSetup, journal: Journal | None, report: Report, tries: int
) -> tuple[_Judged, TuningSetup]:
    """Search for gains, in wider bounds if gains end on default bounds, and judge them on held-out trials.

    If the gains break a limit there that the search kept, search again with more distance from the limits. `tries` is
    the largest number of searches.

    Returns:
        The judged gains, and the tuning problem with the bounds of the last search.
    """
    # A repeated search uses all starting points: gains with more distance from the limits may be far from these gains.
    starts = scenario.search.starts
    outcome = setup.search(
        setup.problem, setup.scenario_gains, starts, report=report, prepare=partial(_compile_judging, scenario)
    )
    outcome, setup = _search_in_wider_bounds(outcome, setup, journal, report)
    search_again = partial(setup.search, setup.problem)
    earlier = list[RejectedSearch]()
    while True:
        report("verifying on held-out trials", 0, 0, outcome.value, outcome.violation)
        search_end, rounded = time.monotonic(), setup.rounded_gains(outcome.normalised)
        tuned = judging.on_flight_clock(gains.in_scenario(setup.ready.scenario, rounded))
        held_out_seed = judging.derive_held_out_seed(setup.settings.seed, len(earlier))
        trials = judging.judge(tuned, held_out_seed, setup.problem)
        verdicts = judging.verdicts_of(tuned, trials, held_out_seed, setup.problem)
        broken_ratios = _broken_ratios(outcome, verdicts)
        if not broken_ratios or outcome.interrupted or len(earlier) + 1 >= tries:
            return _Judged(outcome, search_end, earlier, rounded, tuned, held_out_seed, trials, verdicts), setup
        earlier.append(RejectedSearch(held_out_seed, rounded, outcome.margins, broken_ratios))
        reached = dict(zip(outcome.problem.rows, outcome.worst, strict=True))  # value over limit on the training trials
        margins = {name: 1.0 - float(reached[name]) / (EXTRA_DISTANCE * broken_ratios[name]) for name in broken_ratios}
        heading = f"search {len(earlier) + 1} of at most {tries}"
        reason = f"held-out trials broke {', '.join(broken_ratios)}, so it keeps more distance from the limit"
        report(f"{heading}: {reason}", 0, 0, outcome.value, outcome.violation)
        margins = outcome.margins | margins
        repeated = search_again(outcome.gains, starts, margins=margins, report=headed(report, heading))
        outcome = replace(repeated, history=[*outcome.history, *_renumber_starts(outcome.history, repeated.history)])


def _search_in_wider_bounds(
    outcome: Search, setup: TuningSetup, journal: Journal | None, report: Report
) -> tuple[Search, TuningSetup]:
    """Repeat the search in wider bounds while gains end on default bounds that affect the result.

    `_relevant_bounds` selects these gains. The bounds of several gains may be widened at the same time. A search
    without improvement ends the repetition.

    Returns:
        The best result with the history of all searches, and its tuning problem.
    """
    default_bounds = setup.ready.scenario.defaulted
    for k in range(MOST_WIDENINGS):
        if outcome.interrupted or not outcome.with_gradients:
            break
        sides = _relevant_bounds(setup, outcome, setup.evaluate.bounds.at_bound(outcome.gains))
        scenario = setup.ready.scenario
        new_bounds = free_gains.widen_bounds(
            scenario, {gains.base(name): side for name, side in sides.items()}, default_bounds
        )
        if not new_bounds:
            break
        heading = f"beyond the bounds of {', '.join(new_bounds)}, search {k + 1} of at most {MOST_WIDENINGS}"
        report(heading, 0, 0, outcome.value, outcome.violation)
        wider = posing.set_up_tuning(posing.with_bounds(scenario, new_bounds), setup.settings.seed, journal)
        wider.evaluate.continue_counts(setup.evaluate)
        repeated = wider.search(wider.problem, outcome.gains, 1, report=headed(report, heading))
        history = [*outcome.history, *_renumber_starts(outcome.history, repeated.history)]
        is_better = (repeated.violation, repeated.value) < (outcome.violation, outcome.value * (1.0 - trust.FLAT))
        if not is_better:
            setup.evaluate.continue_counts(wider.evaluate)
            return replace(outcome, history=history), setup
        outcome, setup = replace(repeated, history=history), wider
    return outcome, setup


def _relevant_bounds(setup: TuningSetup, outcome: Search, sides: dict[str, str]) -> dict[str, str]:
    """Return those gains on a bound whose change affects the result: "lower" or "upper", by name.

    The change moves the gain inwards by a tenth of its interval. It must change F or the violation by more than 0.01.
    """
    names, normalised = setup.evaluate.bounds.names, outcome.normalised
    inwards = (np.where(np.isin(names, name), np.abs(normalised - 0.1), normalised) for name in sides)
    points = np.asarray([normalised, *inwards])
    results = setup.evaluate.measure(outcome.problem, points)
    changes = np.abs(results.f - results.f[0]) + np.abs(results.largest_c - results.largest_c[0])
    return {name: side for (name, side), change in zip(sides.items(), changes[1:], strict=True) if change > trust.FLAT}


def _find_shortest_time(setup: TuningSetup, judged: _Judged) -> ShortestTime | None:
    """Return the shortest t_f [s] that the torque limit allows.

    The result is None if there is no torque limit, t_f is tuned, or the law has no prescribed time.
    """
    torque_limit = next((r for r in setup.ready.requirements if r.metric == "peak_torque"), None)
    if torque_limit is None or T_F in setup.problem.names or not judged.tuned.controller.law.prescribed:
        return None
    return shortest_time(judged.tuned, torque_limit, judged.held_out_seed, judged.trials.trial)


def _find_broken_requirements(
    candidates: dict[str, Scenario], held_out: dict[str, Trials], seed: int, problem: Problem
) -> dict[str, list[str]]:
    """Return the metrics whose requirements other gains break, if these gains are more accurate than the tuned gains.

    Accuracy is compared over the trials that reach their end with both sets of gains.

    Args:
        candidates: scenario of each set of gains, by name.
        held_out: held-out trials of each set of gains, by the same names; "tuned" are the tuned gains.
        seed: seed of these trials.
        problem: the tuning problem of the search.

    Returns:
        A list of metrics for each more accurate set of gains, by its name. The list is empty if they meet everything.
    """

    def more_accurate(trials: Trials) -> bool:
        both = trials.finished & held_out["tuned"].finished
        other, tuned = (np.sum(np.asarray(t.metrics.window_error)[both] ** 2) for t in (trials, held_out["tuned"]))
        return bool(other < tuned)

    return {
        name: [
            verdict.metric
            for verdict in judging.verdicts_of(candidates[name], trials, seed, problem)
            if not verdict.met
        ]
        for name, trials in held_out.items()
        if more_accurate(trials)
    }


def _check_result(setup: TuningSetup, judged: _Judged) -> Trust:
    """Compute gradient errors, profiles, sensitivities and margins of the gains found."""
    outcome, evaluate = judged.search, setup.evaluate
    gradient_error = None
    if outcome.with_gradients:
        at_start = trust.gradient_error(evaluate, outcome.problem, evaluate.bounds.normalise(setup.scenario_gains))
        gradient_error = at_start, trust.gradient_error(evaluate, outcome.problem, outcome.normalised)
    metrics = tuple(dict.fromkeys([*SENSITIVITY_METRICS, *outcome.problem.metrics]))
    return Trust(
        gradient_error=gradient_error,
        without_gradients=None if outcome.with_gradients else _describe_missing_gradients(setup),
        profiles=trust.profiles(evaluate, outcome.problem, outcome.normalised),
        sensitivities=trust.sensitivities(outcome.problem, evaluate.bounds, outcome.gains, metrics),
        margins=stability.worst_margins(study(judged.tuned)),
    )


def _describe_missing_gradients(setup: TuningSetup) -> str | None:
    """Return in words why a search had no gradients, or None for a discontinuous sign."""
    ready = setup.ready
    if setup.settings.with_gradients:
        cause = custom_checks.describe_infinite_derivative(ready.parts, ready.scenario)
        return "no measured gains have finite gradients" + ("" if cause is None else f"; {cause}")
    return ready.missing_derivative


def _broken_ratios(outcome: Search, verdicts: list[Verdict]) -> dict[str, float]:
    """Return value over limit for each metric that breaks its limit on the held-out trials, by metric.

    The result is empty if a search with more distance from the limits cannot help. It can help if the search kept every
    limit, if each broken limit had an effect in the search, and if every value is finite.
    """
    # the search treats a requirement on a fraction of time as a limit at all times
    ratios = {v.metric: v.margin if v.interpretation == "ensemble" else v.worst / v.limit
              for v in verdicts if not v.met and v.limit}  # fmt: skip
    can_help = bool(np.all(outcome.worst <= 1.0)) and all(np.isfinite(r) and r > 1.0 for r in ratios.values())
    reached = dict(zip(outcome.problem.rows, outcome.worst, strict=True))  # 0 if no training trial depends on the limit
    # a loop with a limit cycle has no margins, see `theory.limit_cycles`; more distance from the limits does not help
    has_limit_cycle = any(verdict.at_least and verdict.worst == 0.0 for verdict in verdicts)
    return ratios if can_help and not has_limit_cycle and all(reached[name] > 0.0 for name in ratios) else {}


def _renumber_starts(history: list[Step], repeated: list[Step]) -> list[Step]:
    """Return the steps of a repeated search with new numbers of starting points, which follow those of the history."""
    first = 1 + max((step.start for step in history), default=-1)
    return [replace(step, start=first + step.start) for step in repeated]


def _results_beyond_bounds(judged: _Judged, at_bound: dict[str, str]) -> dict[str, BeyondBound]:
    """Simulate each gain that ended on a bound at a value beyond the bound, with the other gains unchanged.

    Args:
        judged: the tuned gains.
        at_bound: "lower" or "upper" for each gain on a bound, by its name.

    Returns:
        The results by the name of the gain, without gains that have no valid value beyond their bound. There are none
        for the continuous loop, and if the objective is not the window error.
    """
    beyond, tuned = dict[str, BeyondBound](), judged.tuned
    if not tuned.sampled or tuned.search.minimise != "window_error":
        return beyond
    for name, side in at_bound.items():
        value = free_gains.value_beyond_bound(tuned, gains.base(name), side)
        if value is None:
            continue
        try:
            other = judging.on_flight_clock(gains.in_scenario(tuned, {**judged.gains, name: value}))
            trials = judging.judge(other, judged.held_out_seed, judged.search.problem)
        except ScenarioError:  # no valid scenario beyond the bound
            continue
        both = trials.finished & judged.trials.finished
        error, tuned_error = (trust.rms(np.asarray(t.metrics.window_error)[both]) for t in (trials, judged.trials))
        verdicts = judging.verdicts_of(other, trials, judged.held_out_seed, judged.search.problem)
        failures = int(np.count_nonzero(~trials.ok))
        broken = next((str(verdict) for verdict in verdicts if not verdict.met), None)
        if broken is None and failures:
            broken = f"{failures} of {trials.status.size} held-out trials fail"
        beyond[name] = BeyondBound(
            value, float(error / tuned_error) if both.any() and tuned_error > 0.0 else None, broken
        )
    return beyond


def _compile_judging(scenario: Scenario) -> None:
    """Start to compile the programs that judge gains and that the search does not need, in the background."""
    simulated = study(judging.on_flight_clock(scenario))
    if not scenario.sampled:
        montecarlo.prepare(simulated.parts, simulated.dispersion, judging.count_held_out_trials(simulated))
    else:
        run_margins.judged_margins.prepare(simulated.parts, True)
