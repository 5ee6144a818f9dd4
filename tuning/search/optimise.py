"""Gradient search from a few starts, each to the optimum next to it; the best admissible point is kept.

A small sweep chooses the starts, and sequential quadratic programming on the slopes of what flies (SciPy's SLSQP) goes
on from each of them. Gains flown with the exact sign have no slopes: they are looked for by evolution instead.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from ptsmc_jax.simulation.requirements import Requirement
from tuning.search import confirm
from tuning.search.descents import Descents, Step, planned
from tuning.search.evaluate import Evaluator
from tuning.search.evolution import NEARBY
from tuning.search.objective import Problem
from tuning.search.progress import Report
from tuning.search.rounds import Rounds
from tuning.search.work import ROUND, Work
from tuning.search.worst import Hardest

Tell = Callable[[str], None]  # says what is being done

GLOBALLY = "no gains so far meet every requirement: searching globally"
HOPELESS = 1.1  # times a limit that the best gains reach: harder trials would bring them no nearer


@dataclass(frozen=True)
class Settings:
    """How a search is run."""

    starts: int  # from which it descends
    steps: int  # points that may be looked at from each of them
    seed: int  # of the points that starts are chosen among
    sloped: bool = True  # F has slopes to go by
    robust: bool = False  # what joins is the worst case inside the dispersions' support
    judged: bool = True  # say how hard the worst case is
    # share to keep from the limit of each metric, if it is more than the search's own
    margins: Mapping[str, float] = field(default_factory=dict)
    designs: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))  # (designs, gains) besides the scenario's


@dataclass(frozen=True)
class Search:
    """Outcome of a search."""

    gains: np.ndarray  # (gains,) the best admissible point
    share: np.ndarray  # its shares of the bounds' intervals
    value: float  # its goal over the training trials
    worst: np.ndarray  # (requirements,) its largest metric / limit, infinite where a trial fails
    ended: np.ndarray  # (requirements,) the same over the trials that end
    ends: list[np.ndarray]  # shares where the starts ended that were followed, the best first
    history: list[Step]  # in the order of the starts, and of each start's steps
    problem: Problem  # with the hardest trials
    rounds: int = 0  # searches again with harder trials
    margins: dict[str, float] = field(default_factory=dict)  # share that was kept from the limit of each metric
    over: float = 0.0  # how far the best point is beyond a limit less that margin, as progress tells it
    # if no gains meet every requirement: the limits that conflict, see `Descents.conflict`
    conflict: dict[str, float | None] = field(default_factory=dict)
    globally: bool = False  # the whole box was searched too
    hardest: Hardest | None = None  # for the gains found; None: no requirement hangs on the hardest trial
    counts: list[confirm.Count] = field(default_factory=list)  # of requirements on a share, on other trials
    seconds: dict[str, float] = field(default_factory=dict)  # that each step of the search took
    interrupted: bool = False


def search(
    evaluate: Evaluator,
    problem: Problem,
    requirements: Sequence[Requirement],
    own: np.ndarray,
    settings: Settings,
    *,
    report: Report = lambda *_: None,
    prepare: Callable[[], None] = lambda: None,
) -> Search:
    """Minimise F with every requirement met on the training trials.

    `Descents` finds gains, `Rounds` says which trials they must meet besides those that are drawn: after each search,
    harder ones join, and the search goes on. Interrupted, it returns the best so far once there is one.

    Args:
        evaluate: measures the problem.
        problem: what is minimised over the training trials.
        requirements: those of its limits.
        own: (gains,) the scenario's gains, the first start.
        settings: how it is run.
        report: is called after every step.
        prepare: is called once the search's own programs are being compiled, for those of what comes after it.
    """
    sloped = settings.sloped
    rounds = Rounds(evaluate, problem, requirements, robust=settings.robust)
    margins = {row: max(settings.margins.get(row, 0.0), rounds.margin) for row in rounds.problem.rows}
    report = Work(report, evaluate, *planned(rounds.problem, settings.starts, settings.steps, sloped=sloped))
    kept = np.asarray([*margins.values()])
    descents = Descents(evaluate, kept, settings.steps, np.random.default_rng(settings.seed), report)
    interrupted, conflict = False, dict[str, float | None]()

    def tell(what: str) -> None:
        report(what, 0, 0, *descents.so_far)

    try:
        if sloped:
            evaluate.prepare(rounds.problem)
            prepare()
            _by_slopes(rounds, descents, own, settings, tell)
        else:
            _by_evolution(rounds, descents, own, tell)
        if settings.judged:
            rounds.judge(descents.gains, tell)
            if sloped and descents.best.over > 0.0 and not descents.best.failed:
                tell("finding the conflicting requirements")
                conflict = descents.conflict(rounds.problem)
    except KeyboardInterrupt:
        if not descents.started:
            raise
        interrupted = True
    tell("done")
    best = descents.best
    return Search(
        gains=descents.gains,
        share=best.share,
        value=best.value,
        worst=np.where(best.failed, np.inf, best.worst),
        ended=best.worst,
        ends=descents.ends,
        history=descents.history,
        problem=descents.problem,
        rounds=rounds.count,
        margins=margins,
        over=best.over,
        conflict=conflict,
        globally=descents.globally,
        hardest=rounds.hardest,
        counts=[] if interrupted else rounds.counts,
        seconds=report.seconds,
        interrupted=interrupted,
    )


def _by_slopes(rounds: Rounds, descents: Descents, own: np.ndarray, settings: Settings, tell: Tell) -> None:
    starts, seed = settings.starts, settings.seed
    descents.set_out(rounds.problem, own, settings.designs)
    rounds.begin(descents.gains)
    shares = descents.explore(rounds.problem, starts, seed) if starts > 1 else {0: descents.share}
    descents.descend(rounds.problem, shares)
    _go_on(rounds, descents, descents.again, tell)
    if starts > 1 and descents.best.over > 0.0:
        tell(GLOBALLY)
        descents.search_globally(rounds.problem, starts, seed + 1)
        _go_on(rounds, descents, descents.again, tell)


def _by_evolution(rounds: Rounds, descents: Descents, own: np.ndarray, tell: Tell) -> None:
    descents.sweep(rounds.problem, own)
    rounds.begin(descents.gains)
    descents.evolve(rounds.problem, descents.share)
    _go_on(rounds, descents, lambda problem: descents.evolve(problem, descents.share, NEARBY), tell)


def _go_on(rounds: Rounds, descents: Descents, again: Callable[[Problem], None], tell: Tell) -> None:
    """Search on from what was found while harder trials join, or until these are out of reach."""
    while np.all(descents.best.worst <= HOPELESS) and rounds.harder(descents.gains, tell):
        tell(f"{ROUND}, round {rounds.count}")
        again(rounds.problem)
