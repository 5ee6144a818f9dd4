"""What a tuning run hands its user: gains judged on fresh trials beside the paper's and the scenario's own."""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from ptsmc_jax.campaigns import margin_verdicts, montecarlo, runs
from ptsmc_jax.campaigns.montecarlo import Trials
from ptsmc_jax.laws.base import Prescribed
from ptsmc_jax.numerics import draws
from ptsmc_jax.scenario import Study, free_gains, replace, study, tables
from ptsmc_jax.scenario.errors import ScenarioError
from ptsmc_jax.scenario.tables import Scenario
from ptsmc_jax.scenario.timing import Reach, reach_of
from ptsmc_jax.simulation.requirements import Requirement, Verdict, least_within
from ptsmc_jax.theory import margins
from tuning.search import confirm, evolution, flights, gains, margin_rows, objective, trust
from tuning.search import shares as gain_bounds
from tuning.search.design import ShortestTime, shortest_time
from tuning.search.evaluate import Evaluator
from tuning.search.evolution import Check
from tuning.search.journal import Journal
from tuning.search.objective import T_F, Problem
from tuning.search.optimise import Search, search
from tuning.search.starts import Report
from tuning.search.trust import Profile
from tuning.studies import stability

GOALS = {"rms": "RMS window error", "worst": "largest window error", "cvar": "CVaR of the window error", "t_f": "t_f"}
DIGITS = 6  # of the gains handed over; what is judged is what is handed over
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
    met: bool  # every requirement met there, and no trial failed

    @property
    def better(self) -> bool:
        """More accurate there by more than what counts as nothing, with every requirement kept."""
        return self.met and self.times is not None and self.times < 1.0 - trust.FLAT


@dataclass(frozen=True)
class Tuning:
    """A finished tuning run."""

    tuned: Scenario  # as it was judged
    gains: dict[str, float]
    search: Search
    at_bound: dict[str, str]
    training: Trials  # tuned gains on the training trials as they were trained on
    fresh: dict[str, Trials]  # by whose gains: "tuned" and those it is set `beside`
    paper_refused: str | None  # why the paper's are not among them
    seed: int
    fresh_seed: int
    judged_gains: dict[str, dict[str, float]]  # the gains of each of them
    floors: dict[str, float | None]  # RMS window error that no controller can beat, for each of them
    verdicts: list[Verdict]  # of the tuned gains on the fresh trials
    shortest: ShortestTime | None  # t_f that the limit on the torque would allow; None without one
    trust: Trust | None  # None: interrupted before
    beyond: dict[str, Beyond]  # gains on a bound beyond which nothing is known, and what is there
    check: Check | None  # of a global search, if it was asked for
    rollouts: int  # trials flown in the search without slopes
    gradients: int  # and with
    seconds: float  # of the search

    @property
    def met(self) -> bool:
        """Every requirement met on the fresh trials, and no fresh trial failed."""
        return all(v.met for v in self.verdicts) and bool(np.all(self.fresh["tuned"].ok))

    @property
    def status(self) -> str:
        """In a word."""
        return "interrupted" if self.search.interrupted else "met" if self.met else "not met"


def tune(
    scenario: Scenario,
    seed: int,
    report: Report = lambda *told: None,
    journal: Journal | None = None,
    *,
    globally: bool = False,
    trusted: bool = True,
) -> Tuning:
    """Tune the scenario's free gains (`tune` table) and judge them on trials the search never saw.

    journal: of evaluations, from which an interrupted run goes on; globally: compare with differential evolution;
    trusted: find out what makes the result believable too.
    """
    table = scenario.tune
    assert table is not None
    started = time.monotonic()
    report("compiling", 0, 0, np.nan, 0.0)
    posed = pose(scenario, seed, journal)
    ready, problem, evaluate, own = posed.ready, posed.problem, posed.evaluate, posed.own
    others, refused = beside(scenario)
    found = search(
        evaluate,
        problem,
        ready.requirements,
        own,
        table.starts,
        table.steps,
        seed,
        sloped=posed.sloped,
        robust=table.worst_case,
        report=report,
        prepare=partial(_prepare, scenario),
    )
    seconds, rollouts, gradients = time.monotonic() - started, evaluate.rollouts, evaluate.gradients
    check = None
    if globally and not found.interrupted:
        check = evolution.check(evaluate, found, seed, report, sloped=posed.sloped)

    report("judging on fresh trials", 0, 0, found.value, 0.0)
    named = evaluate.bounds.rounded(found.gains, DIGITS)
    tuned = as_flown(gains.in_scenario(scenario, named))
    training = flights.trials(problem.others(np.arange(problem.averaged)), np.asarray([*named.values()]))
    fresh_seed = seed_of_judge(seed)
    fresh, judged_gains, floors = {}, {}, {}
    for name, candidate in {"tuned": tuned, **others}.items():
        fresh[name] = judge(candidate, fresh_seed, ready.requirements)
        judged_gains[name] = gains.gains_of(study(as_flown(candidate)).parts)
        floors[name] = floor_of(candidate, fresh_seed)
    verdicts = verdicts_of(tuned, fresh["tuned"], fresh_seed)
    limit = next((r.limit for r in ready.requirements if r.metric == "peak_torque"), None)
    shortest = None
    if limit is not None and T_F not in problem.names and isinstance(ready.parts.controller, Prescribed):
        shortest = shortest_time(tuned, limit, fresh_seed, fresh["tuned"].trial)
    believed, beyond = None, {}
    at_bound = evaluate.bounds.at_bound(found.gains)
    if trusted and not found.interrupted:
        wanted = tuple(dict.fromkeys([*SENSITIVE, *problem.metrics]))
        believed = Trust(
            slope_error=(
                trust.slope_error(evaluate, found.problem, evaluate.bounds.share(own)),
                trust.slope_error(evaluate, found.problem, found.share),
            )
            if posed.sloped
            else None,
            profiles=trust.profiles(evaluate, found.problem, found.share),
            sensitivities=trust.sensitivities(found.problem, evaluate.bounds, found.gains, wanted),
            margins=stability.worst(study(tuned)),
        )
        beyond = _beyond(tuned, {name: side for name, side in at_bound.items() if not believed.profiles[name].flat},
                         named, fresh["tuned"], fresh_seed)  # fmt: skip
    return Tuning(
        tuned=tuned,
        gains=named,
        search=found,
        at_bound=at_bound,
        training=training,
        fresh=fresh,
        paper_refused=refused,
        seed=seed,
        fresh_seed=fresh_seed,
        judged_gains=judged_gains,
        floors=floors,
        verdicts=verdicts,
        shortest=shortest,
        trust=believed,
        beyond=beyond,
        check=check,
        rollouts=rollouts,
        gradients=gradients,
        seconds=seconds,
    )


def _beyond(
    tuned: Scenario, at_bound: dict[str, str], named: dict[str, float], judged: Trials, fresh_seed: int
) -> dict[str, Beyond]:
    """Each gain on a bound that nothing is known of, a step beyond it on the fresh trials, where it may go there.

    Of the sampled loop, where what is minimised is an error.
    """
    found = {}
    assert tuned.tune is not None
    if tuned.loop.mode != "sampled" or tuned.tune.objective == T_F:
        return found
    for name, side in at_bound.items():
        gain = gains.base(name)
        value = free_gains.beyond(tuned, gain, side)
        if value is None:
            continue
        try:
            other = gains.in_scenario(tuned, {**named, name: value})
            study(as_flown(other))
        except ScenarioError:  # it may not
            continue
        trials = judge(other, fresh_seed, study(as_flown(other)).requirements)
        both = trials.finished & judged.finished
        there, here = (trust.rms(np.asarray(t.metrics.window_error)[both]) for t in (trials, judged))
        met = all(v.met for v in verdicts_of(other, trials, fresh_seed)) and bool(np.all(trials.ok))
        found[name] = Beyond(value, float(there / here) if both.any() and here > 0.0 else None, met)
    return found


def _prepare(scenario: Scenario) -> None:
    """Begin to compile what judges a scenario's gains."""
    flown = study(as_flown(scenario))
    montecarlo.prepare(flown.parts, flown.dispersion)
    if scenario.loop.mode == "sampled":
        margins.judged_jit.prepare(flown.parts)


@dataclass(frozen=True)
class Posed:
    """A scenario's tuning problem over its training trials, and what evaluates it."""

    ready: Study
    problem: Problem
    evaluate: Evaluator
    own: np.ndarray  # (gains,) of the scenario
    sloped: bool  # F has slopes to go by: no gain is flown with the exact sign


def pose(scenario: Scenario, seed: int, journal: Journal | None = None) -> Posed:
    """The tuning problem of a scenario."""
    table = scenario.tune
    assert table is not None
    ready = study(scenario, reach=_reach(scenario, table))
    bounds = gain_bounds.of_scenario(scenario, ready.parts)
    trained = trials_of(ready, confirm.training_trials(ready.requirements, table.trials))
    problem = objective.problem(
        ready.parts,
        ready.dispersion,
        seed,
        np.arange(trained),
        bounds.names,
        ready.requirements,
        least=tuple(_least(r, trained) for r in ready.requirements),
        goal=T_F if table.objective == T_F else "window_error",
        tail=_tail(table, trained),
        torque_weight=table.torque_weight,
        margins=margin_rows.ask(ready, bounds.names, seed),
    )
    own = np.asarray(gains.own(ready.parts, bounds.names))
    exact = getattr(scenario.controller, "sign_width", None) == 0.0 and "sign_width" not in bounds.names
    return Posed(ready, problem, Evaluator(bounds, journal), own, sloped=not exact)


def seed_of_judge(seed: int) -> int:
    """The seed of the fresh trials."""
    return draws.derive(seed, "fresh trials")


def beside(scenario: Scenario) -> tuple[dict[str, Scenario], str | None]:
    """What tuned gains are set beside: "paper", the paper's, and "before", the scenario's own where they differ.

    And why the scenario cannot be flown with the paper's, which are then not among them.
    """
    try:
        found, refused = {"paper": gains.papers(scenario)}, None
        study(as_flown(found["paper"]))
    except ScenarioError as error:
        return {"before": scenario}, str(error)
    return found | ({"before": scenario} if gains.differ(scenario, found["paper"]) else {}), refused


def judge(scenario: Scenario, fresh_seed: int, requirements: Sequence[Requirement]) -> Trials:
    """A scenario's gains on fresh trials, as flown; as many as every quantile that is asked for takes."""
    flown = study(as_flown(scenario))
    trials = np.arange(trials_of(flown, confirm.fresh_trials(requirements)))
    return montecarlo.run(flown.parts, flown.dispersion, fresh_seed, trials)


def floor_of(scenario: Scenario, fresh_seed: int) -> float | None:
    """RMS window error that no controller can beat where a scenario is judged, see `runs.floor`."""
    return runs.floor(study(as_flown(scenario)), fresh_seed)


def verdicts_of(scenario: Scenario, trials: Trials, fresh_seed: int) -> list[Verdict]:
    """One for each of the scenario's requirements over these trials, and for each margin asked of its loop."""
    ready = study(as_flown(scenario))
    requirements = ready.requirements
    alone = trials.status.size == 1  # nothing is drawn: no share of the trials to speak of
    finished = trials.finished[0] if alone else trials.finished
    values = [getattr(trials.metrics, r.metric) for r in requirements]
    flown = [r.verdict(v[0] if alone else v, finished) for r, v in zip(requirements, values, strict=True)]
    return [*flown, *margin_verdicts.over_trials(ready, fresh_seed)]


def as_flown(scenario: Scenario) -> Scenario:
    """The scenario on the flight clock; a continuous loop as it is."""
    return replace(scenario, loop__clock="flight") if scenario.loop.mode == "sampled" else scenario


def judged_on(flown: Scenario) -> str:
    """What a scenario was flown on to be judged, in words."""
    if flown.loop.mode != "sampled":
        return "the continuous loop"
    width = getattr(flown.controller, "sign_width", None)
    if width is None:
        return "flight clock"
    return "flight clock, " + (f"sign {width:g} wide" if width else "exact sign")


def trials_of(ready: Study, wanted: int) -> int:
    """How many trials differ at all: one where nothing is drawn."""
    return wanted if ready.drawn else 1


def _reach(scenario: Scenario, table: tables.Tune) -> Reach:
    own = reach_of(scenario)

    def interval(name: str, lower: float, upper: float | None = None) -> tuple[float, float]:
        low, high = table.bounds.get(name, (lower, lower))
        return min(low, lower), max(high, lower if upper is None else upper)

    smallest_delta, delta = interval("delta", own.delta)
    smallest_t_f, t_f = interval("t_f", own.t_f)
    gain, largest_gain = interval("observer_gain", own.gain, own.largest_gain)
    return Reach(
        smallest_t_f=smallest_t_f,
        t_f=t_f,
        delta=delta,
        smallest_delta=smallest_delta,
        gain=gain,
        largest_gain=largest_gain,
        k1=interval("k1", own.k1)[1],
        sign_width=interval("sign_width", own.sign_width)[0],
        surface_rate=interval("surface_rate", own.surface_rate)[1],
    )


def _least(requirement: Requirement, trials: int) -> int | None:
    """How many training trials must keep a limit."""
    if requirement.quantile is None:
        return None
    return least_within(trials, requirement.quantile, requirement.confidence) or trials


def _tail(table: tables.Tune, trials: int) -> int | None:
    """How many of the worst training trials are averaged."""
    if table.objective in ("rms", T_F):
        return None
    assert table.level is not None or table.objective == "worst"
    return 1 if table.level is None else max(1, round((1.0 - table.level) * trials))
