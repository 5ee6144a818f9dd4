"""Gradient search from a few starts, each to the optimum next to it; the best admissible point is kept.

A small sweep chooses the starts, and sequential quadratic programming on the slopes of what flies (SciPy's SLSQP) goes
on from each of them. Gains flown with the exact sign have no slopes: they are looked for by evolution instead.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import jax.numpy as jnp
import numpy as np

from ptsmc_jax.simulation.requirements import Requirement
from tuning.search import confirm, margin_rows
from tuning.search import worst as worst_case
from tuning.search.descent import BROKEN
from tuning.search.descents import Descents, Step, planned
from tuning.search.evaluate import Evaluator
from tuning.search.objective import Problem, coordinates_of, kept_by_every_trial, with_trials
from tuning.search.progress import Report
from tuning.search.refine import NEARBY
from tuning.search.work import ROUND, Work
from tuning.search.worst import Hardest

MARGIN = 0.03  # kept from a limit in the search: fresh trials hold some that are harder than any screened one
SURE_MARGIN = 0.003  # where there is no harder one: the worst case is searched for, or nothing is drawn
HARDEST = 8  # of the screened trials, that join the constraints
SPARE = 8  # places for those that later rounds add: a trial more would be another program to compile
ROUNDS = 6  # searches again with hardest trials added, at most


@dataclass(frozen=True)
class Search:
    """Outcome of a search."""

    gains: np.ndarray  # (gains,) the best admissible point
    share: np.ndarray  # its shares of the bounds' intervals
    value: float  # its goal over the training trials
    worst: np.ndarray  # (requirements,) its largest metric / limit, infinite where a trial fails
    ended: np.ndarray  # (requirements,) the same over the trials that end
    history: list[Step]  # in the order of the starts, and of each start's steps
    problem: Problem  # with the hardest trials
    rounds: int = 0  # searches again with harder trials
    margin: float = MARGIN  # that was kept from the limits
    hardest: Hardest | None = None  # for the gains found; None: no requirement hangs on the hardest trial
    counts: list[confirm.Count] = field(default_factory=list)  # of requirements on a share, on other trials
    seconds: dict[str, float] = field(default_factory=dict)  # that each step of the search took
    interrupted: bool = False


@dataclass(frozen=True)
class Joining:
    """Trials that join the constraints."""

    trials: np.ndarray  # that name the noise
    counted: np.ndarray  # (requirements,) bool: the limits that they must keep
    coordinates: dict[str, list[float]] | None = None  # of a single one, where they are not its own


def search(
    evaluate: Evaluator,
    problem: Problem,
    requirements: Sequence[Requirement],
    own: np.ndarray,
    starts: int,
    steps: int,
    seed: int,
    *,
    sloped: bool = True,
    robust: bool = False,
    judged: bool = True,
    report: Report = lambda *told: None,
    prepare: Callable[[], None] = lambda: None,
) -> Search:
    """Minimise F with every requirement met on the training trials.

    A limit on every trial hangs on the few hardest ones, which a training set need not hold: the hardest of many
    screened ones join the constraints first, and again after a search whose gains some of them still break; robust:
    not those drawn, but the worst case inside the dispersions' support. A limit on a share of the trials is confirmed
    on others after each search: where more of them break it than may, the hardest of the rest join. own:
    (gains,) the scenario's gains, the first start. steps: points that may be looked at from each start. sloped: F has
    slopes to go by. judged: say how hard the worst case is. report is called after every step; prepare once the
    search's own programs are being compiled, for those of what comes after it. Interrupted, it returns the best so far
    once there is one.
    """
    sure = [r for r in requirements if r.quantile is None] if problem.dispersion.varies else []
    shares = [r for r in requirements if r.quantile is not None] if problem.trials.size > 1 else []
    margin = SURE_MARGIN if (robust and sure) or problem.trials.size == 1 else MARGIN
    if sure or shares:
        problem = _with_room(problem, HARDEST + SPARE if sure else SPARE)
    report = Work(report, evaluate, *planned(problem, starts, steps, sloped=sloped))
    run = Descents(evaluate, margin, steps, np.random.default_rng(seed), report)
    interrupted, hardest, counts, known, rounds = False, None, list[confirm.Count](), None, 0

    def counted(requirement: Requirement) -> np.ndarray:
        return np.asarray([metric == requirement.metric for metric in problem.metrics])

    def screened(gains: np.ndarray) -> worst_case.Screened:
        evaluate.rollouts += worst_case.SCREENED
        return worst_case.screen(problem, sure, gains)

    try:
        if sloped:
            run.prepare(problem)
            prepare()
            run.set_out(problem, own)
        else:
            run.sweep(problem, own)
        joined = 0
        problem, _ = _harder_margins(problem, run.gains)
        if sure:  # what is hardest for gains that are about right
            harder = _hardest(problem, *screened(run.gains))
            problem, joined = _add(problem, joined, Joining(harder, kept_by_every_trial(problem))), harder.size
        if sloped:
            run.descend(problem, run.explore(problem, starts, seed) if starts > 1 else {0: run.share})
        else:
            run.evolve(problem, run.share)
        while sure or shares or problem.margins is not None:
            found, joining = run.gains, list[Joining]()
            others, beyond = _harder_margins(problem, found)
            if shares:  # each time on other trials, which those screened are not among
                report("confirming on other trials", 0, 0, *run.best_so_far)
                counts = confirm.count(problem, shares, found, problem.averaged + worst_case.SCREENED, rounds)
                evaluate.rollouts += counts[0].trials
                joining += [
                    Joining(one.harder[:HARDEST], counted(requirement))
                    for requirement, one in zip(shares, counts, strict=True)
                    if not one.held
                ]
            if sure and robust:
                report("looking for the worst case", 0, 0, *run.best_so_far)
                hardest = worst_case.hardest(problem, sure, found, screened(found))
                if hardest.beyond and not hardest.unbounded:
                    joining.append(
                        Joining(np.asarray([hardest.trial]), kept_by_every_trial(problem), hardest.coordinates)
                    )
            elif sure:
                known = screened(found)
                if np.any(known[1] > 1.0):
                    joining.append(Joining(_hardest(problem, *known), kept_by_every_trial(problem)))
            if not (joining or beyond) or rounds == ROUNDS:
                break
            problem = others if beyond else problem
            for more in joining:
                problem, joined = _add(problem, joined, more), joined + more.trials.size
            hardest = None  # it was the worst case of gains that are searched on from
            rounds += 1
            report(f"{ROUND}, round {rounds}", 0, 0, *run.best_so_far)
            if sloped:
                run.again(problem)
            else:
                run.evolve(problem, run.share, NEARBY)
        if sure and judged and hardest is None:
            report("looking for the worst case", 0, 0, *run.best_so_far)
            hardest = worst_case.hardest(problem, sure, run.gains, known)
    except KeyboardInterrupt:
        if not run.started:
            raise
        interrupted = True
    report("done", 0, 0, *run.best_so_far)
    best = run.best
    return Search(
        gains=run.gains,
        share=best.share,
        value=best.value,
        worst=np.where(best.over >= BROKEN, np.inf, best.worst),
        ended=best.worst,
        history=run.history,
        problem=run.problem,
        rounds=rounds,
        margin=margin,
        hardest=hardest,
        counts=[] if interrupted else counts,
        seconds=report.seconds,
        interrupted=interrupted,
    )


def _with_room(problem: Problem, places: int) -> Problem:
    """With so many places more, that hold the first trial again: it must keep what every trial must keep, twice."""
    return with_trials(problem, np.repeat(np.asarray(problem.trials)[:1], places))


def _harder_margins(problem: Problem, gains: np.ndarray) -> tuple[Problem, bool]:
    """With the loops whose margins are least by these gains, and whether one of them breaks a limit."""
    if problem.margins is None:
        return problem, False
    asked, near = margin_rows.hardest(problem.margins, gains)
    return replace(problem, margins=asked), near > 1.0


def _add(problem: Problem, joined: int, more: Joining) -> Problem:
    """The problem with more trials in the places left for them, and then in those of the ones that joined first.

    joined: how many have been added to `_with_room`'s.
    """
    places = problem.trials.size - problem.averaged
    at = problem.averaged + (joined + np.arange(more.trials.size)) % places
    if more.coordinates is None:
        own = coordinates_of(problem.dispersion, int(problem.seed), more.trials)
    else:
        own = {name: jnp.asarray(v)[None] for name, v in more.coordinates.items()}
    return replace(
        problem,
        trials=problem.trials.at[at].set(jnp.asarray(more.trials, dtype=jnp.uint32)),
        counted=problem.counted.at[:, at].set(jnp.asarray(more.counted)[:, None]),
        coordinates={name: v.at[at].set(own[name]) for name, v in problem.coordinates.items()},
    )


def _hardest(problem: Problem, trials: np.ndarray, ratio: np.ndarray) -> np.ndarray:
    """Of screened trials those nearest to a limit that are not in the problem yet."""
    known = set(np.asarray(problem.trials).tolist())
    return np.asarray([t for t in trials[np.argsort(-ratio)] if int(t) not in known][:HARDEST], dtype=np.uint32)
