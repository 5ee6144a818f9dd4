"""The search for gains: local searches with gradients from a few starting points. Read `search` first.

Sobol points are simulated to choose the starting points. Sequential quadratic programming (SciPy's SLSQP) then follows
the gradients of the simulation. Differential evolution replaces it if there are no useful gradients, for example with a
discontinuous sign.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from ptsmc_jax.simulation.requirements import Requirement
from tuning.search import confirm
from tuning.search.evaluate import Evaluator
from tuning.search.evolution import NEAR_BEST
from tuning.search.local_searches import LocalSearches, Step
from tuning.search.objective import Problem
from tuning.search.progress import Report
from tuning.search.rounds import ROUNDS, Rounds
from tuning.search.worst import Hardest

Announce = Callable[[str], None]  # reports the name of the current step

HOPELESS = 1.1  # if the best gains have a larger metric / limit, no harder trials are added, because they cannot help


@dataclass(frozen=True)
class Settings:
    """Options of a search."""

    starts: int  # number of starting points
    steps: int  # largest number of measured points of each local search
    seed: int  # seed of the candidates for starting points
    with_gradients: bool = True  # whether F has useful gradients
    robust: bool = False  # whether the worst case inside the support of the dispersions is added to the constraints
    judged: bool = True  # whether to find the worst case of the final gains, and requirements that conflict
    # relative tightening of the limit of each metric, if larger than the default
    margins: Mapping[str, float] = field(default_factory=dict)
    designs: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))  # (designs, gains) further starting points


@dataclass(frozen=True)
class Search:
    """Result of a search."""

    gains: np.ndarray  # (gains,) the best admissible point
    normalised: np.ndarray  # (gains,) normalised gains of the best point
    value: float  # objective over the training trials
    worst: np.ndarray  # (requirements,) largest metric / limit of the best point; infinite if a trial fails
    worst_completed: np.ndarray  # (requirements,) largest metric / limit over the completed trials
    ends: list[np.ndarray]  # normalised gains of the final points of the local searches, the best first
    history: list[Step]  # measured points, by local search and step
    problem: Problem  # tuning problem with the trials that joined
    rounds: int = 0  # number of searches that were repeated with harder trials
    margins: dict[str, float] = field(default_factory=dict)  # relative tightening of the limit of each metric
    violation: float = 0.0  # relative violation of the tightened limits at the best point, as in progress reports
    # if no gains meet every requirement: the limits that conflict, see `LocalSearches.find_conflicts`
    conflict: dict[str, float | None] = field(default_factory=dict)
    searched_globally: bool = False  # whether a global search of the whole box followed
    with_gradients: bool = True  # whether the search used gradients; False: differential evolution found the gains
    hardest: Hardest | None = None  # worst case of the gains; None: no requirement on every trial
    counts: list[confirm.Count] = field(default_factory=list)  # confirmations of quantile requirements
    interrupted: bool = False


def search(
    evaluate: Evaluator,
    problem: Problem,
    requirements: Sequence[Requirement],
    scenario_gains: np.ndarray,
    settings: Settings,
    *,
    report: Report = lambda *_: None,
    prepare: Callable[[], None] = lambda: None,
) -> Search:
    """Minimise F subject to the requirements on the training trials.

    `LocalSearches` runs the local searches. After each search, `Rounds` adds harder trials to the constraints, and the
    search continues. If the search is interrupted, it returns the best point so far.

    Args:
        evaluate: measures the problem.
        problem: the tuning problem over the training trials, see `objective.judge` for F.
        requirements: the requirements of its limits.
        scenario_gains: (gains,) gains of the scenario, the first starting point.
        settings: options of the search.
        report: is called after every step.
        prepare: is called as soon as the programs of the search are being compiled, to compile later programs too.

    Raises:
        KeyboardInterrupt: The search was interrupted before the first point was measured.
    """
    with_gradients = settings.with_gradients
    rounds = Rounds(evaluate, problem, requirements, robust=settings.robust)
    margins = {row: max(settings.margins.get(row, 0.0), rounds.margin) for row in rounds.problem.rows}
    tightening = np.asarray([*margins.values()])
    local_searches = LocalSearches(evaluate, tightening, settings.steps, np.random.default_rng(settings.seed), report)
    interrupted, conflict = False, dict[str, float | None]()

    def announce(what: str) -> None:
        report(what, 0, 0, *local_searches.progress)

    try:
        if with_gradients:
            prepare()
            with_gradients = _search_with_gradients(rounds, local_searches, scenario_gains, settings, announce)
        if not with_gradients:
            _search_without_gradients(rounds, local_searches, scenario_gains, announce)
        if settings.judged:
            rounds.find_worst_case(local_searches.gains, announce)
            if with_gradients and local_searches.best.violation > 0.0 and not local_searches.best.failed:
                announce("finding the conflicting requirements")
                conflict = local_searches.find_conflicts(rounds.problem)
    except KeyboardInterrupt:
        if not local_searches.started:
            raise
        interrupted = True
    announce("end of the search")
    best = local_searches.best
    return Search(
        gains=local_searches.gains,
        normalised=best.normalised,
        value=best.value,
        worst=np.where(best.failed, np.inf, best.worst),
        worst_completed=best.worst,
        ends=local_searches.ends,
        history=local_searches.history,
        problem=local_searches.problem,
        rounds=rounds.count,
        margins=margins,
        violation=best.violation,
        conflict=conflict,
        searched_globally=local_searches.searched_globally,
        with_gradients=with_gradients,
        hardest=rounds.hardest,
        counts=[] if interrupted else rounds.counts,
        interrupted=interrupted,
    )


def _search_with_gradients(
    rounds: Rounds, local_searches: LocalSearches, scenario_gains: np.ndarray, settings: Settings, announce: Announce
) -> bool:
    """Run local searches from several starting points, and search again with harder trials.

    If no gains meet every requirement, search globally. The results are in `local_searches`.

    Returns:
        Whether gradients are finite at some starting point. If not, there are no results.
    """
    starts, seed = settings.starts, settings.seed
    local_searches.begin(rounds.problem, scenario_gains, settings.designs)
    rounds.begin(local_searches.gains)
    best = local_searches.explore(rounds.problem, starts, seed) if starts > 1 else {0: local_searches.normalised}
    if not local_searches.started:
        announce("no finite gradients: searching without gradients")
        return False
    local_searches.search_locally(rounds.problem, best)
    _repeat_with_harder_trials(rounds, local_searches, local_searches.continue_best, announce)
    if starts > 1 and local_searches.best.violation > 0.0:
        announce("no gains that meet every requirement are found yet: searching globally")
        local_searches.search_globally(rounds.problem, starts, seed + 1)
        _repeat_with_harder_trials(rounds, local_searches, local_searches.continue_best, announce)
    return True


def _search_without_gradients(
    rounds: Rounds, local_searches: LocalSearches, scenario_gains: np.ndarray, announce: Announce
) -> None:
    """Search by differential evolution from the best of Sobol points, and again near the best point with harder trials.

    The results are in `local_searches`.
    """
    local_searches.measure_sobol_points(rounds.problem, scenario_gains)
    rounds.begin(local_searches.gains)
    local_searches.evolve(rounds.problem, local_searches.normalised)
    _repeat_with_harder_trials(
        rounds,
        local_searches,
        lambda problem: local_searches.evolve(problem, local_searches.normalised, NEAR_BEST),
        announce,
    )


def _repeat_with_harder_trials(
    rounds: Rounds, local_searches: LocalSearches, continue_search: Callable[[Problem], None], announce: Announce
) -> None:
    """Repeat the search as long as harder trials join, unless the limits are out of reach."""
    while np.all(local_searches.best.worst <= HOPELESS) and rounds.add_harder_trials(local_searches.gains, announce):
        announce(f"harder trials, round {rounds.count} of at most {ROUNDS}")
        continue_search(rounds.problem)
