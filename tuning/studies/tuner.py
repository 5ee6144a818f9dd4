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
from ptsmc_jax.scenario import free_gains, study
from ptsmc_jax.scenario.errors import ScenarioError
from ptsmc_jax.scenario.tables import Scenario
from ptsmc_jax.simulation.requirements import Verdict
from ptsmc_jax.theory import run_margins
from tuning.search import gains, global_check, simulations, trust
from tuning.search.design import ShortestTime, shortest_time
from tuning.search.global_check import Check
from tuning.search.journal import Journal
from tuning.search.local_searches import Step
from tuning.search.objective import T_F
from tuning.search.optimise import Search
from tuning.search.progress import Report
from tuning.search.trust import Profile
from tuning.studies import judging, posing, stability
from tuning.studies.posing import Posed

WIDENED = 3  # largest number of searches in wider bounds
TRIES = 3  # largest number of searches; each is judged on its own held-out trials
FARTHER = 1.02  # a repeated search tightens a limit by its ratio of value to limit on held-out trials and this factor
SENSITIVE = ("window_error", "hold_error", "peak_torque", "effort", "chattering")  # metrics with sensitivities to gains


@dataclass(frozen=True)
class Trust:
    """Checks of a result: gradient errors, profiles, sensitivities and stability margins, see `trust`."""

    gradient_error: tuple[float, float] | None  # relative error at the first and last point; None: discontinuous sign
    profiles: dict[str, Profile]  # objective along each gain
    sensitivities: dict[str, dict[str, float]]
    margins: dict[str, dict[str, Any]] | None  # stability margins of the tuned gains, see `stability.worst`


@dataclass(frozen=True)
class BeyondBound:
    """The results on held-out trials after moving one gain from its bound to a value beyond."""

    value: float  # value of the gain, in its unit
    times: float | None  # RMS window error, relative to the tuned gains; None: an error is missing or zero
    broken: str | None  # violated requirement, in words; None: all requirements are met, and no trial failed

    @property
    def better(self) -> bool:
        """Whether the error decreases by more than 1 % beyond the bound, with all requirements met."""
        return self.broken is None and self.times is not None and self.times < 1.0 - trust.FLAT


@dataclass(frozen=True)
class Try:
    """A search whose gains kept every limit on the training trials, but broke a limit on the held-out trials."""

    held_out_seed: int  # seed of the held-out trials
    gains: dict[str, float]
    margins: dict[str, float]  # distance from the limit of each metric in the search, as a fraction of the limit
    over: dict[str, float]  # judged value over the limit, for each metric that broke its limit on the held-out trials


@dataclass(frozen=True)
class Tuning:
    """The results of a tuning run, which may have been interrupted."""

    tuned: Scenario  # scenario with the tuned gains, on the flight clock
    gains: dict[str, float]
    search: Search
    earlier: list[Try]
    at_bound: dict[str, str]
    training: Trials  # tuned gains on the training trials
    held_out: dict[str, Trials]  # held-out trials: "tuned" and the keys of `judging.beside`
    published_unavailable: str | None  # reason why the published gains cannot be simulated
    seed: int  # seed of the training trials and the search
    held_out_seed: int  # seed of the held-out trials
    judged_gains: dict[str, dict[str, float]]  # gains by name, for each key of `held_out`
    lower_bounds: dict[str, float | None]  # lower bound of the RMS window error, for each key of `held_out`
    verdicts: list[Verdict]  # verdicts on the tuned gains from the held-out trials
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
        return judging.met(self.verdicts, self.held_out["tuned"])

    @property
    def status(self) -> str:
        """Return "interrupted", "met" or "not met"."""
        return "interrupted" if self.search.interrupted else "met" if self.met else "not met"


@dataclass(frozen=True)
class _Judged:
    """The gains of a search, and their results on held-out trials."""

    search: Search
    gains: dict[str, float]  # rounded gains by name
    scenario: Scenario  # scenario with the rounded gains, on the flight clock
    seed: int  # seed of the held-out trials
    trials: Trials
    verdicts: list[Verdict]
    begun: float  # time of the monotonic clock after the search [s]


def tune(
    scenario: Scenario,
    seed: int,
    report: Report = lambda *_: None,
    journal: Journal | None = None,
    *,
    globally: bool = False,
    trusted: bool = True,
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
        globally: compare the result with a global search (differential evolution).
        trusted: compute gradient checks, profiles, sensitivities and margins of the result too.
        tries: largest number of searches.

    Returns:
        The gains, and their results on training and held-out trials.
    """
    started = time.monotonic()
    report("compiling", 0, 0, np.nan, 0.0)
    posed = posing.tuning_problem(scenario, seed, journal)
    others, refused = judging.beside(scenario)
    judged, earlier, posed = _search_and_judge(scenario, posed, journal, report, tries)
    evaluate = posed.evaluate
    outcome, rollouts, gradients = judged.search, evaluate.rollouts, evaluate.gradients
    check = None
    if globally and not outcome.interrupted:
        check = global_check.check(evaluate, outcome, seed, report, with_gradients=posed.with_gradients)
    problem = posed.problem
    training = simulations.simulate_trials(
        problem.batch_of(np.arange(problem.averaged)), np.asarray([*judged.gains.values()])
    )
    candidates = {"tuned": judged.scenario} | {name: judging.on_flight_clock(other) for name, other in others.items()}
    held_out = {"tuned": judged.trials} | {name: judging.judge(other, judged.seed) for name, other in others.items()}
    shortest = _shortest(posed, judged)
    trust_in_it, beyond, at_bound = None, {}, evaluate.bounds.at_bound(outcome.gains)
    if trusted and not outcome.interrupted:
        report("profiles, sensitivities and margins of the gains found", 0, 0, outcome.value, outcome.violation)
        trust_in_it = _trust(posed, judged)
        profiles = trust_in_it.profiles
        relevant = {name: side for name, side in at_bound.items() if not profiles[name].flat}
        beyond = _results_beyond_bounds(judged, relevant)
    return Tuning(
        tuned=judged.scenario,
        gains=judged.gains,
        search=outcome,
        earlier=earlier,
        at_bound=at_bound,
        training=training,
        held_out=held_out,
        published_unavailable=refused,
        seed=seed,
        held_out_seed=judged.seed,
        judged_gains={name: gains.gains_of(study(one).parts) for name, one in candidates.items()},
        lower_bounds={name: judging.rms_lower_bound(one, judged.seed) for name, one in candidates.items()},
        verdicts=judged.verdicts,
        broken_by=_broken_by(candidates, held_out, judged.seed),
        shortest=shortest,
        trust=trust_in_it,
        beyond=beyond,
        check=check,
        rollouts=rollouts,
        gradients=gradients,
        seconds=judged.begun - started,
    )


def _search_and_judge(
    scenario: Scenario, posed: Posed, journal: Journal | None, report: Report, tries: int
) -> tuple[_Judged, list[Try], Posed]:
    """Search, in larger bounds if gains end on default ones, and verify on held-out trials.

    If these break a limit that the search kept, search again with more distance from the limits.
    """
    # a repeated search has all starting points again: gains that keep more distance may not be near those found
    starts = scenario.search.starts
    outcome = posed.search(
        posed.problem, posed.scenario_gains, starts, report=report, prepare=partial(_prepare, scenario)
    )
    outcome, posed = _in_larger_bounds(outcome, posed, journal, report)
    look, seed = partial(posed.search, posed.problem, report=report), posed.seed
    scenario = posed.ready.scenario
    earlier = list[Try]()
    while True:
        report("verifying on held-out trials", 0, 0, outcome.value, outcome.violation)
        judged = _judge(scenario, posed, outcome, judging.seed_of_judge(seed, len(earlier)))
        over = _broken_ratios(outcome, judged.verdicts)
        if not over or outcome.interrupted or len(earlier) + 1 >= tries:
            return judged, earlier, posed
        earlier.append(Try(judged.seed, judged.gains, outcome.margins, over))
        reached = dict(zip(outcome.problem.rows, outcome.worst, strict=True))  # value over limit on the training trials
        margins = {name: 1.0 - float(reached[name]) / (FARTHER * over[name]) for name in over}
        more = look(outcome.gains, starts, margins=outcome.margins | margins)
        outcome = replace(more, history=[*outcome.history, *_renumbered(outcome.history, more.history)])


def _in_larger_bounds(outcome: Search, posed: Posed, journal: Journal | None, report: Report) -> tuple[Search, Posed]:
    """Repeat the search in wider bounds while gains end on default bounds that affect the result.

    `_relevant_bounds` selects these gains. The bounds of several gains may be widened at the same time. A search
    without improvement ends the repetition.
    """
    defaulted = posed.ready.scenario.defaulted
    for _ in range(WIDENED):
        if outcome.interrupted or not posed.with_gradients:
            break
        sides = _relevant_bounds(posed, outcome, posed.evaluate.bounds.at_bound(outcome.gains))
        scenario = posed.ready.scenario
        moved = free_gains.widened(scenario, {gains.base(name): side for name, side in sides.items()}, defaulted)
        if not moved:
            break
        report(f"searching beyond the bounds of {', '.join(moved)}", 0, 0, outcome.value, outcome.violation)
        larger = posing.tuning_problem(posing.with_bounds(scenario, moved), posed.seed, journal)
        larger.evaluate.count_on(posed.evaluate)
        more = larger.search(larger.problem, outcome.gains, 1, report=report)
        history = [*outcome.history, *_renumbered(outcome.history, more.history)]
        better = (more.violation, more.value) < (outcome.violation, outcome.value * (1.0 - trust.FLAT))
        if not better:
            posed.evaluate.count_on(larger.evaluate)
            return replace(outcome, history=history), posed
        outcome, posed = replace(more, history=history), larger
    return outcome, posed


def _relevant_bounds(posed: Posed, outcome: Search, sides: dict[str, str]) -> dict[str, str]:
    """Return those gains on a bound whose change affects the result.

    The change moves the gain inwards by a tenth of its interval. It must change F or the violation by more than 0.01.
    """
    names, found = posed.evaluate.bounds.names, outcome.normalised
    points = np.asarray([found, *(np.where(np.isin(names, name), np.abs(found - 0.1), found) for name in sides)])
    seen = posed.evaluate.measure(outcome.problem, points)
    changes = np.abs(seen.f - seen.f[0]) + np.abs(seen.largest_c - seen.largest_c[0])
    return {name: side for (name, side), change in zip(sides.items(), changes[1:], strict=True) if change > trust.FLAT}


def _judge(scenario: Scenario, posed: Posed, outcome: Search, held_out_seed: int) -> _Judged:
    """Simulate the rounded gains of a search on held-out trials."""
    begun = time.monotonic()
    rounded = posed.named(outcome.normalised)
    simulated = judging.on_flight_clock(gains.in_scenario(scenario, rounded))
    trials = judging.judge(simulated, held_out_seed)
    return _Judged(
        outcome, rounded, simulated, held_out_seed, trials, judging.verdicts_of(simulated, trials, held_out_seed), begun
    )


def _shortest(posed: Posed, judged: _Judged) -> ShortestTime | None:
    """Return the shortest t_f [s] that the torque limit allows.

    The result is None if there is no torque limit, t_f is tuned, or the law has no prescribed time.
    """
    asked = next((one for one in posed.ready.requirements if one.metric == "peak_torque"), None)
    if asked is None or T_F in posed.problem.names or not judged.scenario.controller.law.prescribed:
        return None
    return shortest_time(judged.scenario, asked, judged.seed, judged.trials.trial)


def _broken_by(candidates: dict[str, Scenario], held_out: dict[str, Trials], seed: int) -> dict[str, list[str]]:
    """Return the gains that are more accurate than the tuned gains, and the metrics whose requirements they break.

    Accuracy is compared over the trials that reach their end with both sets of gains.

    Args:
        candidates: scenario of each set of gains, by name.
        held_out: their held-out trials, with the tuned gains as "tuned".
        seed: seed of these trials.
    """

    def more_accurate(trials: Trials) -> bool:
        both = trials.finished & held_out["tuned"].finished
        there, here = (np.sum(np.asarray(t.metrics.window_error)[both] ** 2) for t in (trials, held_out["tuned"]))
        return bool(there < here)

    return {
        name: [one.metric for one in judging.verdicts_of(candidates[name], trials, seed) if not one.met]
        for name, trials in held_out.items()
        if more_accurate(trials)
    }


def _trust(posed: Posed, judged: _Judged) -> Trust:
    """Compute gradient errors, profiles, sensitivities and margins of the gains found."""
    outcome, evaluate = judged.search, posed.evaluate
    gradient_error = None
    if posed.with_gradients:
        at_start = trust.gradient_error(evaluate, outcome.problem, evaluate.bounds.normalise(posed.scenario_gains))
        gradient_error = at_start, trust.gradient_error(evaluate, outcome.problem, outcome.normalised)
    metrics = tuple(dict.fromkeys([*SENSITIVE, *outcome.problem.metrics]))
    return Trust(
        gradient_error=gradient_error,
        profiles=trust.profiles(evaluate, outcome.problem, outcome.normalised),
        sensitivities=trust.sensitivities(outcome.problem, evaluate.bounds, outcome.gains, metrics),
        margins=stability.worst(study(judged.scenario)),
    )


def _broken_ratios(outcome: Search, verdicts: list[Verdict]) -> dict[str, float]:
    """Return value over limit for each metric that breaks its limit on the held-out trials.

    The result is empty if a search with more distance from the limits cannot help. It can help if the search kept every
    limit, if each broken limit had an effect in the search, and if every value is finite.
    """
    # the search treats a requirement on a fraction of time as a limit at all times
    over = {one.metric: one.margin if one.interpretation == "ensemble" else one.worst / one.limit
            for one in verdicts if not one.met and one.limit}  # fmt: skip
    helped = bool(np.all(outcome.worst <= 1.0)) and all(np.isfinite(ratio) and ratio > 1.0 for ratio in over.values())
    reached = dict(zip(outcome.problem.rows, outcome.worst, strict=True))  # 0 if no training trial depends on the limit
    # a loop with a limit cycle has no margins, see `theory.limit_cycles`; more distance from the limits does not help
    swings = any(one.at_least and one.worst == 0.0 for one in verdicts)
    return over if helped and not swings and all(reached[name] > 0.0 for name in over) else {}


def _renumbered(history: list[Step], more: list[Step]) -> list[Step]:
    """Return the steps of a repeated search with new numbers of starting points, which follow those of the history."""
    first = 1 + max((step.start for step in history), default=-1)
    return [replace(step, start=first + step.start) for step in more]


def _results_beyond_bounds(judged: _Judged, at_bound: dict[str, str]) -> dict[str, BeyondBound]:
    """Simulate each gain that ended on a bound at a value beyond the bound, with the other gains unchanged.

    The result is empty for the continuous loop, and if the objective is not the window error. Gains without a valid
    value beyond their bound are left out.

    Args:
        judged: the tuned gains.
        at_bound: "lower" or "upper" for each gain on a bound, by its name.
    """
    beyond, tuned = dict[str, BeyondBound](), judged.scenario
    if not tuned.sampled or tuned.search.minimise != "window_error":
        return beyond
    for name, side in at_bound.items():
        value = free_gains.beyond(tuned, gains.base(name), side)
        if value is None:
            continue
        try:
            other = judging.on_flight_clock(gains.in_scenario(tuned, {**judged.gains, name: value}))
            trials = judging.judge(other, judged.seed)
        except ScenarioError:  # no valid scenario beyond the bound
            continue
        both = trials.finished & judged.trials.finished
        there, here = (trust.rms(np.asarray(t.metrics.window_error)[both]) for t in (trials, judged.trials))
        broken = _broken(judging.verdicts_of(other, trials, judged.seed), trials)
        beyond[name] = BeyondBound(value, float(there / here) if both.any() and here > 0.0 else None, broken)
    return beyond


def _broken(verdicts: list[Verdict], trials: Trials) -> str | None:
    """Return the first broken requirement, or the number of failed trials, in words; None: neither."""
    for one in verdicts:
        if not one.met:
            return str(one)
    failures = int(np.count_nonzero(~trials.ok))
    return f"{failures} of {trials.status.size} held-out trials fail" if failures else None


def _prepare(scenario: Scenario) -> None:
    """Start to compile the programs that judge gains, in the background."""
    simulated = study(judging.on_flight_clock(scenario))
    montecarlo.prepare(simulated.parts, simulated.dispersion, judging.held_out_trials(simulated))
    if scenario.sampled:
        run_margins.judged_margins_jit.prepare(simulated.parts)
