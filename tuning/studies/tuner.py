"""What a tuning run hands its user: gains judged on fresh trials beside the paper's and the scenario's own."""

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
from tuning.search import flights, gains, global_check, trust
from tuning.search.descents import Step
from tuning.search.design import ShortestTime, shortest_time
from tuning.search.global_check import Check
from tuning.search.journal import Journal
from tuning.search.objective import T_F
from tuning.search.optimise import Search
from tuning.search.progress import Report
from tuning.search.trust import Profile
from tuning.studies import judging, posing, stability
from tuning.studies.posing import Posed

WIDENED = 3  # searches in larger bounds, at most
TRIES = 3  # searches at most, each of whose gains are judged on fresh trials of their own
FARTHER = 1.02  # a further search keeps so much more from the limits than what fresh trials found too little
SENSITIVE = ("window_error", "hold_error", "peak_torque", "effort", "chattering")  # metrics whose slopes are shown


@dataclass(frozen=True)
class Trust:
    """What makes the result believable, see `trust`."""

    slope_error: tuple[float, float] | None  # at the first start and at the end; None: flown with the exact sign
    profiles: dict[str, Profile]
    sensitivities: dict[str, dict[str, float]]
    margins: dict[str, dict[str, Any]] | None  # of the tuned gains, see `stability.worst`


@dataclass(frozen=True)
class Beyond:
    """What the fresh trials say of a gain that ended on its bound, a step beyond it, the others as they were found."""

    value: float
    times: float | None  # RMS window error there over that of the tuned gains; None: it has none
    broken: str | None  # what is broken there, in words; None: every requirement met, and no trial failed

    @property
    def better(self) -> bool:
        """Whether it is more accurate there, by more than counts as nothing, with every requirement kept."""
        return self.broken is None and self.times is not None and self.times < 1.0 - trust.FLAT


@dataclass(frozen=True)
class Try:
    """A search whose gains kept every limit, and broke one on fresh trials: another one went on from them."""

    fresh_seed: int
    gains: dict[str, float]
    margins: dict[str, float]  # share that it kept from the limit of each metric
    over: dict[str, float]  # how many times its limit each metric reached on the fresh trials, as it is judged


@dataclass(frozen=True)
class Tuning:
    """A finished tuning run."""

    tuned: Scenario  # as it was judged
    gains: dict[str, float]
    search: Search
    earlier: list[Try]
    at_bound: dict[str, str]
    training: Trials  # tuned gains on the training trials as they were trained on
    fresh: dict[str, Trials]  # by whose gains: "tuned" and those it is set `beside`
    paper_refused: str | None  # why the paper's are not among them
    seed: int
    fresh_seed: int
    judged_gains: dict[str, dict[str, float]]  # the gains of each of them
    floors: dict[str, float | None]  # RMS window error that no controller can beat, for each of them
    verdicts: list[Verdict]  # of the tuned gains on the fresh trials
    broken_by: dict[str, list[str]]  # of those more accurate than the tuned ones: whose requirements are not met
    shortest: ShortestTime | None  # t_f that the limit on the torque would allow; None without one
    trust: Trust | None  # None: interrupted before
    beyond: dict[str, Beyond]  # gains on a bound beyond which nothing is known, and what is there
    check: Check | None  # of a global search, if it was asked for
    rollouts: int  # trials flown in the search without slopes
    gradients: int  # and with
    seconds: float  # of the search

    @property
    def met(self) -> bool:
        """Whether the fresh trials meet every requirement, and none of them failed."""
        return judging.met(self.verdicts, self.fresh["tuned"])

    @property
    def status(self) -> str:
        """How it ended, in a word."""
        return "interrupted" if self.search.interrupted else "met" if self.met else "not met"


@dataclass(frozen=True)
class _Judged:
    """Gains that a search found, and what fresh trials say of them."""

    search: Search
    gains: dict[str, float]  # rounded as they are handed over
    scenario: Scenario  # with these gains, as it is flown
    seed: int  # of the fresh trials
    trials: Trials
    verdicts: list[Verdict]
    begun: float  # when judging them began, by the monotonic clock


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
    """Tune the scenario's free gains (`tune` table) and judge them on trials the search never saw.

    Where these break a limit that the search kept, it goes on from the gains it found, and from as many starts as
    before, with more distance from the limits, and is judged on others.

    Args:
        scenario: what is tuned.
        seed: of training trials and search; fresh trials have one that follows from it.
        report: is called after every step.
        journal: of evaluations, from which an interrupted run goes on.
        globally: compare with differential evolution.
        trusted: find out what makes the result believable too.
        tries: searches, at most.
    """
    started = time.monotonic()
    report("compiling", 0, 0, np.nan, 0.0)
    posed = posing.pose(scenario, seed, journal)
    others, refused = judging.beside(scenario)
    judged, earlier, posed = _search_and_judge(scenario, posed, journal, report, tries)
    evaluate = posed.evaluate
    outcome, rollouts, gradients = judged.search, evaluate.rollouts, evaluate.gradients
    check = None
    if globally and not outcome.interrupted:
        check = global_check.check(evaluate, outcome, seed, report, sloped=posed.sloped)
    problem = posed.problem
    training = flights.trials(problem.others(np.arange(problem.averaged)), np.asarray([*judged.gains.values()]))
    candidates = {"tuned": judged.scenario} | {name: judging.as_flown(other) for name, other in others.items()}
    fresh = {"tuned": judged.trials} | {name: judging.judge(other, judged.seed) for name, other in others.items()}
    shortest = _shortest(posed, judged)
    trust_in_it, beyond, at_bound = None, {}, evaluate.bounds.at_bound(outcome.gains)
    if trusted and not outcome.interrupted:
        report("profiles, sensitivities and margins of the gains found", 0, 0, outcome.value, outcome.over)
        trust_in_it = _trust(posed, judged)
        profiles = trust_in_it.profiles
        beyond = _beyond(judged, {name: side for name, side in at_bound.items() if not profiles[name].flat})
    return Tuning(
        tuned=judged.scenario,
        gains=judged.gains,
        search=outcome,
        earlier=earlier,
        at_bound=at_bound,
        training=training,
        fresh=fresh,
        paper_refused=refused,
        seed=seed,
        fresh_seed=judged.seed,
        judged_gains={name: gains.gains_of(study(one).parts) for name, one in candidates.items()},
        floors={name: judging.floor_of(one, judged.seed) for name, one in candidates.items()},
        verdicts=judged.verdicts,
        broken_by=_broken_by(candidates, fresh, judged.seed),
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
    starts = scenario.search.starts  # of a further search too: near the gains found there may be none that keep more
    outcome = posed.search(posed.problem, posed.own, starts, report=report, prepare=partial(_prepare, scenario))
    outcome, posed = _in_larger_bounds(outcome, posed, journal, report)
    look, seed = partial(posed.search, posed.problem, report=report), posed.seed
    scenario = posed.ready.scenario
    earlier = list[Try]()
    while True:
        report("judging on fresh trials", 0, 0, outcome.value, outcome.over)
        judged = _judge(scenario, posed, outcome, judging.seed_of_judge(seed, len(earlier)))
        over = _over(outcome, judged.verdicts)
        if not over or outcome.interrupted or len(earlier) + 1 >= tries:
            return judged, earlier, posed
        earlier.append(Try(judged.seed, judged.gains, outcome.margins, over))
        reached = dict(zip(outcome.problem.rows, outcome.worst, strict=True))  # on the trials of the search
        margins = {name: 1.0 - float(reached[name]) / (FARTHER * over[name]) for name in over}
        more = look(outcome.gains, starts, margins=outcome.margins | margins)
        outcome = replace(more, history=[*outcome.history, *_after(outcome.history, more.history)])


def _in_larger_bounds(outcome: Search, posed: Posed, journal: Journal | None, report: Report) -> tuple[Search, Posed]:
    """Search on in larger bounds as long as gains end on default bounds that matter, several gains at once."""
    defaulted = posed.ready.scenario.defaulted
    for _ in range(WIDENED):
        if outcome.interrupted or not posed.sloped:
            break
        sides = _that_matter(posed, outcome, posed.evaluate.bounds.at_bound(outcome.gains))
        scenario = posed.ready.scenario
        moved = free_gains.widened(scenario, {gains.base(name): side for name, side in sides.items()}, defaulted)
        if not moved:
            break
        report(f"searching beyond the bounds of {', '.join(moved)}", 0, 0, outcome.value, outcome.over)
        larger = posing.pose(posing.with_bounds(scenario, moved), posed.seed, journal)
        larger.evaluate.count_on(posed.evaluate)
        more = larger.search(larger.problem, outcome.gains, 1, report=report)
        history = [*outcome.history, *_after(outcome.history, more.history)]
        better = (more.over, more.value) < (outcome.over, outcome.value * (1.0 - trust.FLAT))
        if not better:
            posed.evaluate.count_on(larger.evaluate)
            return replace(outcome, history=history), posed
        outcome, posed = replace(more, history=history), larger
    return outcome, posed


def _that_matter(posed: Posed, outcome: Search, sides: dict[str, str]) -> dict[str, str]:
    """Return the gains on a bound that matters.

    It matters if moving the gain inwards by a tenth of its interval changes F or the violation by more than 0.01.
    """
    names, found = posed.evaluate.bounds.names, outcome.share
    points = np.asarray([found, *(np.where(np.isin(names, name), np.abs(found - 0.1), found) for name in sides)])
    seen = posed.evaluate.fly(outcome.problem, points)
    changes = np.abs(seen.f - seen.f[0]) + np.abs(seen.beyond - seen.beyond[0])
    return {name: side for (name, side), change in zip(sides.items(), changes[1:], strict=True) if change > trust.FLAT}


def _judge(scenario: Scenario, posed: Posed, outcome: Search, fresh_seed: int) -> _Judged:
    """The gains that a search found, as they are handed over, on fresh trials."""
    begun = time.monotonic()
    rounded = posed.named(outcome.share)
    flown = judging.as_flown(gains.in_scenario(scenario, rounded))
    trials = judging.judge(flown, fresh_seed)
    return _Judged(outcome, rounded, flown, fresh_seed, trials, judging.verdicts_of(flown, trials, fresh_seed), begun)


def _shortest(posed: Posed, judged: _Judged) -> ShortestTime | None:
    """The shortest t_f that the limit on the torque would allow; None without one, or where t_f itself is tuned."""
    asked = next((one for one in posed.ready.requirements if one.metric == "peak_torque"), None)
    if asked is None or T_F in posed.problem.names or not judged.scenario.controller.law.prescribed:
        return None
    return shortest_time(judged.scenario, asked, judged.seed, judged.trials.trial)


def _broken_by(candidates: dict[str, Scenario], fresh: dict[str, Trials], seed: int) -> dict[str, list[str]]:
    """The metrics whose requirements are not met by gains more accurate than the tuned ones, by whose they are."""

    def more_accurate(trials: Trials) -> bool:
        both = trials.finished & fresh["tuned"].finished
        there, here = (np.sum(np.asarray(t.metrics.window_error)[both] ** 2) for t in (trials, fresh["tuned"]))
        return bool(there < here)

    return {
        name: [one.metric for one in judging.verdicts_of(candidates[name], trials, seed) if not one.met]
        for name, trials in fresh.items()
        if more_accurate(trials)
    }


def _trust(posed: Posed, judged: _Judged) -> Trust:
    """What makes the gains found believable."""
    outcome, evaluate = judged.search, posed.evaluate
    slope_error = None
    if posed.sloped:
        at_start = trust.slope_error(evaluate, outcome.problem, evaluate.bounds.share(posed.own))
        slope_error = at_start, trust.slope_error(evaluate, outcome.problem, outcome.share)
    metrics = tuple(dict.fromkeys([*SENSITIVE, *outcome.problem.metrics]))
    return Trust(
        slope_error=slope_error,
        profiles=trust.profiles(evaluate, outcome.problem, outcome.share),
        sensitivities=trust.sensitivities(outcome.problem, evaluate.bounds, outcome.gains, metrics),
        margins=stability.worst(study(judged.scenario)),
    )


def _over(outcome: Search, verdicts: list[Verdict]) -> dict[str, float]:
    """How many times its limit each metric reached that broke it on fresh trials; empty: more distance is no help.

    It is one where the search kept every limit, came near those that are broken, and every value is a number.
    """
    # what is asked for a share of the time is searched for as a limit
    over = {one.metric: one.margin if one.interpretation == "ensemble" else one.worst / one.limit
            for one in verdicts if not one.met and one.limit}  # fmt: skip
    helped = bool(np.all(outcome.worst <= 1.0)) and all(np.isfinite(share) and share > 1.0 for share in over.values())
    reached = dict(zip(outcome.problem.rows, outcome.worst, strict=True))  # 0: trials of the search saw nothing of it
    # a loop that swings by itself has no margin left, see `theory.rest`, whatever the search keeps
    swings = any(one.at_least and one.worst == 0.0 for one in verdicts)
    return over if helped and not swings and all(reached[name] > 0.0 for name in over) else {}


def _after(history: list[Step], more: list[Step]) -> list[Step]:
    """The steps of a search that goes on, as from one start more."""
    first = 1 + max((step.start for step in history), default=-1)
    return [replace(step, start=first + step.start) for step in more]


def _beyond(judged: _Judged, at_bound: dict[str, str]) -> dict[str, Beyond]:
    """What the fresh trials say of each gain that ended on a bound, a step beyond that bound, where it may go there.

    Of the sampled loop, where what is minimised is an error.
    """
    beyond, tuned = dict[str, Beyond](), judged.scenario
    if not tuned.sampled or tuned.search.minimise != "window_error":
        return beyond
    for name, side in at_bound.items():
        value = free_gains.beyond(tuned, gains.base(name), side)
        if value is None:
            continue
        try:
            other = judging.as_flown(gains.in_scenario(tuned, {**judged.gains, name: value}))
            trials = judging.judge(other, judged.seed)
        except ScenarioError:  # it may not
            continue
        both = trials.finished & judged.trials.finished
        there, here = (trust.rms(np.asarray(t.metrics.window_error)[both]) for t in (trials, judged.trials))
        broken = _broken(judging.verdicts_of(other, trials, judged.seed), trials)
        beyond[name] = Beyond(value, float(there / here) if both.any() and here > 0.0 else None, broken)
    return beyond


def _broken(verdicts: list[Verdict], trials: Trials) -> str | None:
    """The first requirement that is broken, or how many trials fail, in words."""
    for one in verdicts:
        if not one.met:
            return str(one)
    lost = int(np.count_nonzero(~trials.ok))
    return f"{lost} of {trials.status.size} fresh trials do not arrive" if lost else None


def _prepare(scenario: Scenario) -> None:
    """Begin to compile what judges a scenario's gains."""
    flown = study(judging.as_flown(scenario))
    montecarlo.prepare(flown.parts, flown.dispersion, judging.fresh_trials(flown))
    if scenario.sampled:
        run_margins.judged_jit.prepare(flown.parts)
