"""Gradient search over many starts at once, then a polish; the best admissible iterate is kept.

All starts together by Adam on the augmented Lagrangian for inequalities,
L = f + sum (max(0, m + p c)^2 - m^2) / (2 p) (Nocedal and Wright, Numerical Optimization, 2006, eq. 17.65),
then each by sequential quadratic programming (SciPy's SLSQP), and the best of them, as it is judged, without slopes.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import jax.numpy as jnp
import numpy as np
import optax

from ptsmc_jax.requirements import Requirement
from tuning import confirm
from tuning import worst as worst_case
from tuning.evaluate import Evaluator
from tuning.objective import FAILED, Problem, coordinates_of, failures, whole_rows, with_sign, with_trials
from tuning.polish import BROKEN, POLISH_STEPS, Best, largest, polish
from tuning.refine import GENERATIONS, NEARBY, WIDELY, refine
from tuning.starts import (
    CANDIDATES,
    CHOOSING,
    Report,
    logit,
    promising,
    share_of,
    starting_points,
    toward_edges,
)
from tuning.work import ROUND, SLOPED, Work
from tuning.worst import Hardest

PENALTY = 20.0
UPDATE_FROM, UPDATE_EVERY = 0.25, 5  # multipliers: updated from this share of the steps on, at this distance
LARGEST_UPDATE = 0.02  # violations beyond this count as this much: far-off gains say nothing about multipliers
SAME = 0.01  # of the bounds: starts as near to a polished one are not polished
RATE, LAST_RATE = 0.15, 0.01  # Adam's learning rate in the free reals, cosine decay
LARGEST_SLOPE = 1.0
PATIENCE, GAINED = 30, 1e-3  # steps without this much less F in any start end the descent
SPREAD, FOLLOWED = 512, 4  # points over the bounds, flown under the exact sign; those that count beside the starts
MARGIN = 0.03  # kept from a limit in the search: fresh trials hold some that are harder than any screened one
SURE_MARGIN = 0.003  # where there is no harder one: the worst case is searched for, or nothing is drawn
HARDEST = 8  # of the screened trials, that join the constraints
SPARE = 8  # places for those that later rounds add: a trial more would be another program to compile
ROUNDS = 6  # searches again with hardest trials added, at most

SEARCHING, POLISHING = "searching", "polishing"
SPREADING, REFINING = "looking for a better valley", "refining"


@dataclass(frozen=True)
class Step:
    """One step of all starts, arrays over starts first; kept as the history."""

    gains: np.ndarray  # (starts, gains)
    value: np.ndarray  # (starts,) the goal over the training trials
    worst: np.ndarray  # (starts, requirements) largest metric / limit, `FAILED` where a trial fails


@dataclass(frozen=True)
class Search:
    """Outcome of a search."""

    gains: np.ndarray  # (gains,) the best admissible iterate
    z: np.ndarray  # its free reals
    value: float  # its goal over the training trials
    worst: np.ndarray  # (requirements,) its largest metric / limit, infinite where a trial fails
    ended: np.ndarray  # (requirements,) the same over the trials that end
    history: list[Step]
    problem: Problem  # that is judged, with the hardest trials: under the exact sign, if that was asked for
    smooth: Problem  # that the descent went by
    dropped: list[int] = field(default_factory=list)  # starts that met a number that is not finite
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
    exact: bool = False,
    robust: bool = False,
    judged: bool = True,
    report: Report = lambda *told: None,
) -> Search:
    """Minimise F with every requirement met on the training trials.

    A limit on every trial hangs on the few hardest ones, which a training set need not hold: the hardest of many
    screened ones join the constraints first, and again after a search whose gains some of them still break; robust:
    not those drawn, but the worst case inside the dispersions' support. A limit on a share of the trials is confirmed
    on others after each search: where more of them break it than may, the hardest of the rest join. own:
    (gains,) the scenario's gains, the first start. exact: what is found goes on under the exact sign, see `Run.settle`.
    judged: say how hard the worst case is. report is called after every step. Interrupted, it returns the best so far
    once there is one.
    """
    sure = [r for r in requirements if r.quantile is None] if problem.dispersion.varies else []
    shares = [r for r in requirements if r.quantile is not None] if problem.trials.size > 1 else []
    margin = SURE_MARGIN if (robust and sure) or problem.trials.size == 1 else MARGIN
    again = max(20, steps // 3)
    report = Work(report, evaluate, *_planned(problem, starts, steps, again, exact=exact))
    run = Run(evaluate, margin, exact, report)
    interrupted, hardest, counts = False, None, list[confirm.Count]()

    def flown(problem: Problem) -> Problem:
        return with_sign(problem, 0.0) if exact else problem

    def counted(requirement: Requirement) -> np.ndarray:
        return np.asarray([metric == requirement.metric for metric in problem.metrics])

    try:
        if sure:  # screened as flown
            middle = np.asarray(evaluate.bounds.gains(jnp.zeros(len(problem.names))))
            harder = _hardest(problem, *worst_case.screen(problem, sure, middle))
            problem = _with_room(with_trials(problem, harder))
        elif shares:
            problem = _with_room(problem)
        z = starting_points(evaluate, problem, own, starts, seed, report)
        run.descend(problem, z, steps, SEARCHING)
        run.settle(problem, np.random.default_rng(seed))
        rounds = joined = 0
        while sure or shares:
            found, joining = run.gains, list[Joining]()
            if shares:  # each time on other trials, which those screened are not among
                report("confirming on other trials", 0, 0, *run.best_so_far)
                counts = confirm.count(flown(problem), shares, found, problem.averaged + worst_case.SCREENED, rounds)
                joining += [
                    Joining(one.harder[:HARDEST], counted(requirement))
                    for requirement, one in zip(shares, counts, strict=True)
                    if not one.held
                ]
            if sure and robust:
                report("looking for the worst case", 0, 0, *run.best_so_far)
                hardest = worst_case.hardest(flown(problem), sure, found)
                if hardest.beyond and not hardest.unbounded:
                    joining.append(Joining(np.asarray([hardest.trial]), whole_rows(problem), hardest.coordinates))
            elif sure:
                trials, ratio = worst_case.screen(flown(problem), sure, found)
                if np.any(ratio > 1.0):
                    joining.append(Joining(_hardest(problem, trials, ratio), whole_rows(problem)))
            if not joining or rounds == ROUNDS:
                break
            for more in joining:
                problem, joined = _add(problem, joined, more), joined + more.trials.size
            hardest = None  # it was the worst case of gains that are searched on from
            rounds += 1
            run.descend(problem, evaluate.bounds.free(found, edge=1e-6)[None], again, f"{ROUND}, round {rounds}")
            run.settle(problem, np.random.default_rng(seed))
            run.rounds = rounds
        if sure and judged and hardest is None:
            report("looking for the worst case", 0, 0, *run.best_so_far)
            hardest = worst_case.hardest(flown(problem), sure, run.gains)
    except KeyboardInterrupt:
        if not run.started:
            raise
        interrupted = True
    report("done", 0, 0, *run.best_so_far)
    counts = [] if interrupted else counts
    return replace(run.outcome(), hardest=hardest, counts=counts, seconds=report.seconds, interrupted=interrupted)


def _planned(problem: Problem, starts: int, steps: int, again: int, *, exact: bool) -> tuple[dict, dict]:
    """What each step of a search flies at most, in rollouts, and each of a further round; see `Work`."""
    trials = float(problem.trials.size)
    sloped = SLOPED * trials
    settling = {SPREADING: SPREAD * trials} if exact else {}
    settling[REFINING] = GENERATIONS * WIDELY[0] * trials
    first = {CHOOSING: starts * CANDIDATES * trials, SEARCHING: starts * (steps + 1) * sloped}
    return (
        {**first, POLISHING: starts * POLISH_STEPS * sloped, **settling},
        {ROUND: (again + 1) * sloped, POLISHING: POLISH_STEPS * sloped, **settling},
    )


def _with_room(problem: Problem) -> Problem:
    """With `SPARE` places more, that hold the first trial again: it must keep what every trial must keep, twice."""
    return with_trials(problem, np.repeat(np.asarray(problem.trials)[:1], SPARE))


def _add(problem: Problem, joined: int, more: Joining) -> Problem:
    """The problem with more trials in the places left for them, and then in those of the ones that joined first.

    joined: how many have been added to `_with_room`'s.
    """
    places = problem.trials.size - problem.averaged
    at = problem.averaged + (places - SPARE + joined + np.arange(more.trials.size)) % places
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


class Run:
    """Descents and what they leave: the best iterate, the history."""

    def __init__(self, evaluate: Evaluator, margin: float, exact: bool, report: Report):
        self._evaluate, self._margin, self._exact, self._report = evaluate, margin, exact, report
        self._best: Best | None = None
        self._problem: Problem | None = None
        self._history: list[Step] = []
        self._dropped: list[int] = []
        self._sign = (0.0, 0.0)  # the smooth one of the descent
        self.rounds = 0

    @property
    def started(self) -> bool:
        """Whether there is an iterate at all."""
        return self._best is not None and bool(np.isfinite(self._best.f).any())

    @property
    def best_so_far(self) -> tuple[float, float]:
        """The goal of the best iterate, and how far it is beyond a limit."""
        assert self._best is not None
        first = self._best.order()[0]
        return float(self._best.value[first]), float(self._best.over[first])

    @property
    def best_point(self) -> tuple[float, float, np.ndarray]:
        """F, goal and free reals of the best iterate."""
        assert self._best is not None
        first = self._best.order()[0]
        return float(self._best.f[first]), float(self._best.value[first]), self._best.z[first]

    @property
    def gains(self) -> np.ndarray:
        """(gains,) of the best iterate."""
        assert self._best is not None
        return np.asarray(self._evaluate.bounds.gains(jnp.asarray(self._best.z[self._best.order()[0]])))

    def descend(self, problem: Problem, z: np.ndarray, steps: int, what: str) -> None:
        """All starts by Adam, then a polish of the best ones."""
        tightened = self._tightened(problem)
        self._sign = (float(getattr(problem.parts.controller, "sign_width", 0.0)), float(problem.widened))
        best, alive = Best(z, len(problem.metrics), self._margin), np.ones(len(z), dtype=bool)
        # slopes range over decades as limits are crossed: clipped, and with a short memory of their size
        rate = optax.cosine_decay_schedule(RATE, steps, LAST_RATE / RATE)
        optimiser = optax.chain(optax.clip(LARGEST_SLOPE), optax.adam(rate, b2=0.9))
        multipliers = np.zeros((len(z), len(problem.metrics), problem.trials.size))
        state, record = optimiser.init(jnp.asarray(z)), list[tuple[float, float]]()
        for step in range(steps + 1):
            seen = self._evaluate.slopes(tightened, z)
            alive &= seen.finite
            best.offer(z, seen, alive)
            if not self._history or np.isfinite(best.f).any():
                self._best, self._problem = best, tightened
            worst = np.where(failures(seen.c)[:, None] > 0, FAILED, largest(seen.c, self._margin))
            self._history.append(Step(seen.gains, np.exp(seen.value), worst))
            first = best.order()[0]
            self._report(what, step, steps, float(best.value[first]), float(best.over[first]))
            record.append((float(best.over[first]), float(best.f[first])))
            if step == steps or not alive.any() or _stalled(record, UPDATE_FROM * steps):
                break
            if step >= UPDATE_FROM * steps and step % UPDATE_EVERY == 0:
                multipliers += PENALTY * np.clip(seen.c, -LARGEST_UPDATE, LARGEST_UPDATE)
                multipliers = np.maximum(0.0, multipliers)
            force = np.maximum(0.0, multipliers + PENALTY * seen.c)
            slope = seen.f_slope + np.einsum("srt,srtg->sg", force, seen.c_slope)
            updates, state = optimiser.update(jnp.where(alive[:, None], slope, 0.0), state)
            z = np.asarray(optax.apply_updates(jnp.asarray(z), updates))
        if not self._dropped and len(z) > 1:
            self._dropped = np.flatnonzero(~alive).tolist()
        # all of them: the best start of a descent need not lie in the best valley
        self._polish(tightened, best, [int(start) for start in best.order() if np.isfinite(best.f[start])])

    def settle(self, problem: Problem, rng: np.random.Generator) -> None:
        """From what the descent found to the best gains as they are judged.

        Where the exact sign judges, F has no slopes to go by: it is flown at the gains found and at points spread over
        the bounds, and refined around the best of these. Otherwise what the refinement finds is polished like a start.
        """
        if not self.started:
            return
        assert self._best is not None
        tightened = self._tightened(with_sign(problem, 0.0) if self._exact else problem)
        if self._exact:
            spread = logit(toward_edges(rng.random((SPREAD, len(problem.names)))))
            far = promising(self._evaluate, tightened, spread, FOLLOWED, partial(self._report, SPREADING))
            self._as_judged(tightened, np.concatenate([self._best.z, far]))
        self._refine(tightened, rng)
        if not self._exact:
            self._polish(tightened, self._best, [int(self._best.order()[0])])

    def _tightened(self, problem: Problem) -> Problem:
        return replace(problem, limits=problem.limits * (1.0 - self._margin))

    def _as_judged(self, tightened: Problem, z: np.ndarray) -> None:
        best, flown = Best(z, len(tightened.metrics), self._margin), self._evaluate.fly(tightened, z)
        best.offer(z, flown, np.isfinite(flown.f))
        if np.isfinite(best.f).any():
            self._best, self._problem = best, tightened

    def _refine(self, tightened: Problem, rng: np.random.Generator, size: tuple[int, float] = WIDELY) -> None:
        best = self._best
        assert best is not None
        refine(self._evaluate, tightened, best, int(best.order()[0]), int(rng.integers(2**31)),
               lambda done, steps: self._report(REFINING, done, steps, *self.best_so_far), size)  # fmt: skip

    def step(self, problem: Problem, known: np.ndarray, rng: np.random.Generator) -> None:
        """The best gains that keep these limits, from known ones (points, gains): polished, then refined as judged."""
        tightened = self._tightened(problem)
        self._best, self._problem = Best(known, len(problem.metrics), self._margin), tightened
        self._polish(tightened, self._best, list(range(len(known))))
        if self._exact:
            tightened = self._tightened(with_sign(problem, 0.0))
            self._as_judged(tightened, np.concatenate([self._best.z, known]))
        self._refine(tightened, rng, NEARBY)

    def _polish(self, tightened: Problem, best: "Best", starts: list[int]) -> None:
        done: list[np.ndarray] = []  # shares of the bounds at which a polish ended
        for k, start in enumerate(starts):
            self._report(POLISHING, k, len(starts), *self.best_so_far)
            if all(np.abs(share_of(best.z[start]) - other).max() >= SAME for other in done):
                polish(self._evaluate, tightened, best, start)
                done.append(share_of(best.z[start]))

    def outcome(self) -> Search:
        """The best iterate."""
        assert self._best is not None
        assert self._problem is not None
        best = self._best.order()[0]
        return Search(
            gains=self.gains,
            z=self._best.z[best],
            value=float(self._best.value[best]),
            worst=np.where(self._best.over[best] >= BROKEN, np.inf, self._best.worst[best]),
            ended=self._best.worst[best],
            history=self._history,
            problem=(judged := replace(self._problem, limits=self._problem.limits / (1.0 - self._margin))),
            smooth=with_sign(judged, *self._sign),
            dropped=self._dropped,
            rounds=self.rounds,
            margin=self._margin,
        )


def _stalled(record: list[tuple[float, float]], earliest: float) -> bool:
    """Whether the best of all starts has hardly become better over the last `PATIENCE` steps."""
    if len(record) <= max(earliest, PATIENCE):
        return False
    (over_before, f_before), (over, f) = record[-1 - PATIENCE], record[-1]
    return over_before == over == 0.0 and f_before - f < GAINED
