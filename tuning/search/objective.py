"""What is minimised over the training trials, with requirements as constraints per trial."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from ptsmc_jax.campaigns import montecarlo
from ptsmc_jax.dispersions.base import Coordinates
from ptsmc_jax.dispersions.variation import Dispersion
from ptsmc_jax.numerics.pytrees import Leaf, pytree
from ptsmc_jax.scenario.tables import LIMITS as LIMITS
from ptsmc_jax.scenario.tables import T_F as T_F
from ptsmc_jax.simulation import rollout
from ptsmc_jax.simulation.catalogues import POINTING
from ptsmc_jax.simulation.requirements import Requirement
from ptsmc_jax.simulation.requirements import over as near
from ptsmc_jax.simulation.rollout import Parts
from tuning.search.flights import Fleet
from tuning.search.gains import with_gains
from tuning.search.margin_rows import Asked

FAILED = 1e9  # stands for the goal, and for metric / limit, of a trial that failed: beyond those of any that ends
LEAST = 1e-300  # of what a logarithm is taken of
DRAWN = 128  # trials whose coordinates are drawn in one call


@pytree
@dataclass(frozen=True, kw_only=True)
class Rules:
    """What metrics of the training trials are judged by. The first `averaged` trials make up the objective.

    A limit must be kept by every trial that is `counted`. One with a quantile must also be kept by the trials that are
    `among` its sample, except for the `may_break` of them that exceed it most.
    """

    limits: Leaf | np.ndarray  # (requirements,) in the metrics' units
    among: Leaf | np.ndarray  # (requirements, trials) bool: trials of which a share must keep a limit
    counted: Leaf | np.ndarray  # (requirements, trials) bool: trials that must keep it by themselves
    averaged: int = field(metadata={"static": True})
    names: tuple[str, ...] = field(metadata={"static": True})  # of the free gains
    # of those that are among, how many may break each limit; None: it is one on every trial
    may_break: tuple[int | None, ...] = field(metadata={"static": True})
    goal: str = field(default="window_error", metadata={"static": True})  # a metric, `T_F` or `LIMITS`
    tail: int | None = field(default=None, metadata={"static": True})  # the worst trials that count; None: all
    # as the key `statistic` of [tune]; a quantile is the smallest of the tail, the worst case its only trial
    statistic: str = field(default="rms", metadata={"static": True})
    torque_weight: float = field(default=0.0, metadata={"static": True})


@pytree
@dataclass(frozen=True, kw_only=True)
class Problem(Rules):
    """A tuning problem: its rules, and what flies. What is over trials is NumPy's: rounds put it together anew."""

    parts: Parts
    dispersion: Dispersion
    seed: Leaf  # uint32
    trials: Leaf | np.ndarray  # (trials,) uint32, that name the noise
    coordinates: dict[str, Any]  # of what is drawn, arrays over the trials first
    metrics: tuple[str, ...] = field(metadata={"static": True})  # of the requirements
    margins: Asked | None = None  # of the loop; their rows stand after those of the requirements, see `Evaluator`

    @property
    def rows(self) -> tuple[str, ...]:
        """What the rows of c are of."""
        return self.metrics + (() if self.margins is None else self.margins.metrics)

    @property
    def rules(self) -> Rules:
        """What its metrics are judged by, without what flies."""
        return Rules(**{one.name: getattr(self, one.name) for one in fields(Rules)})

    @property
    def fleet(self) -> Fleet:
        """What is flown of it."""
        trials, coordinates = np.asarray(self.trials), jax.tree.map(np.asarray, self.coordinates)
        names = watched(self)
        pointing = tuple(name for name in POINTING if name in names)
        return Fleet(self.parts, self.dispersion, self.seed, self.names, trials, coordinates, pointing)

    def others(self, trials: np.ndarray) -> Fleet:
        """What is flown with other trials of its seed."""
        coordinates = coordinates_of(self.dispersion, int(self.seed), trials)
        return self.fleet._replace(trials=np.asarray(trials, dtype=np.uint32), coordinates=coordinates)

    def tightened(self, factor: ArrayLike) -> "Problem":
        """Return the problem with every limit multiplied by its factor, (rows,) or one number [-]."""
        factors = np.broadcast_to(factor, len(self.rows))
        of_metrics, of_margins = factors[: len(self.metrics)], factors[len(self.metrics) :]
        margins = None if self.margins is None else self.margins.tightened(of_margins)
        return replace(self, limits=self.limits * of_metrics, margins=margins)


def problem(
    parts: Parts,
    dispersion: Dispersion,
    seed: int,
    trials: np.ndarray,
    names: tuple[str, ...],
    requirements: Sequence[Requirement] = (),
    may_break: tuple[int | None, ...] | None = None,
    banded: tuple[bool, ...] | None = None,
    **others: object,
) -> Problem:
    """A problem over training trials.

    Args:
        parts: the nominal ones.
        dispersion: what is drawn about them.
        seed: of the draws and the noise.
        trials: numbers of the training trials, all of which are averaged.
        names: of the free gains.
        requirements: that are kept.
        may_break: how many trials may break each of them, None for those on every trial, as all are by default.
        banded: whether these are trials of a band that joins later, until when every training trial must keep it.
        others: fields of `Problem`.
    """
    empty = Problem(
        parts=parts,
        dispersion=dispersion,
        seed=jnp.uint32(seed),
        trials=np.zeros(0, dtype=np.uint32),
        coordinates=coordinates_of(dispersion, seed, np.zeros(0)),
        limits=np.asarray([r.limit for r in requirements], dtype=float),
        among=np.zeros((len(requirements), 0), dtype=bool),
        counted=np.zeros((len(requirements), 0), dtype=bool),
        averaged=len(trials),
        names=names,
        metrics=tuple(r.metric for r in requirements),
        may_break=may_break or (None,) * len(requirements),
    )
    alone = kept_by_every_trial(empty) | np.asarray(banded or False, dtype=bool)
    posed = with_trials(empty, trials, counted=alone)
    return replace(posed, among=~posed.counted, **others)


def coordinates_of(dispersion: Dispersion, seed: int, trials: np.ndarray) -> dict[str, np.ndarray]:
    """Coordinates of these trials, arrays over the trials first; drawn so many at a time, by one program."""
    numbers = np.resize(np.asarray(trials, dtype=np.uint32), max(1, -(-len(trials) // DRAWN)) * DRAWN)
    calls = [
        montecarlo.coordinates(dispersion, jnp.uint32(seed), jnp.asarray(numbers[k : k + DRAWN]))
        for k in range(0, numbers.size, DRAWN)
    ]
    return jax.tree.map(lambda *many: np.concatenate(many)[: len(trials)], *calls)


def replaced(array: Leaf | np.ndarray, at: Any, values: Any) -> np.ndarray:
    """A copy of one of the problem's arrays with other values there."""
    changed = np.array(array)
    changed[at] = values
    return changed


def with_trials(problem: Problem, trials: np.ndarray, counted: np.ndarray | None = None) -> Problem:
    """The problem with these trials added, which count in the constraints.

    counted: (requirements,) bool, which limits they must keep; by default those that every trial must keep.
    """
    coordinates = coordinates_of(problem.dispersion, int(problem.seed), trials)
    rows = np.asarray(kept_by_every_trial(problem) if counted is None else counted, dtype=bool)
    return replace(
        problem,
        trials=np.concatenate([problem.trials, np.asarray(trials, dtype=np.uint32)]),
        among=np.pad(problem.among, [(0, 0), (0, len(trials))]),
        counted=np.concatenate([problem.counted, np.tile(rows[:, None], (1, len(trials)))], axis=1),
        coordinates={name: np.concatenate([v, coordinates[name]]) for name, v in problem.coordinates.items()},
    )


def fewer_trials(problem: Problem, averaged: int) -> Problem:
    """The problem averaged over the first so many trials only, with those that were added; shares of them as before."""
    if averaged >= problem.averaged:
        return problem
    fewer = np.r_[:averaged, problem.averaged : problem.trials.size]

    def share(count: int) -> int:
        return max(1, math.ceil(count * averaged / problem.averaged))

    def allowed(count: int | None, averaged_are_among: bool) -> int | None:
        return averaged - share(problem.averaged - count) if count is not None and averaged_are_among else count

    return replace(
        problem,
        trials=problem.trials[fewer],
        among=problem.among[:, fewer],
        counted=problem.counted[:, fewer],
        coordinates={name: v[fewer] for name, v in problem.coordinates.items()},
        averaged=averaged,
        may_break=tuple(map(allowed, problem.may_break, np.asarray(problem.among)[:, 0].tolist())),
        tail=None if problem.tail is None else share(problem.tail),
    )


def kept_by_every_trial(problem: Problem) -> np.ndarray:
    """(requirements,) bool: limits that every trial must keep."""
    return np.asarray([allowed is None for allowed in problem.may_break], dtype=bool)


def watched(problem: Problem) -> tuple[str, ...]:
    """Metrics that a problem is judged by: that of the goal, the peak torque, those of its requirements."""
    goal = "window_error" if problem.goal in (T_F, LIMITS) else problem.goal
    return (goal, "peak_torque", *problem.metrics)


def measure(problem: Problem, gains: Float[Array, " gains"]) -> tuple[Array, Array, Array]:
    """F that is minimised, c = metric / limit - 1, (requirements, trials), met where c <= 0, and ln of the goal.

    See `judge`; pure, for any transformation.
    """
    parts, names = with_gains(problem.parts, dict(zip(problem.names, gains, strict=True))), watched(problem)

    def fly(case: tuple[Array, Coordinates]) -> tuple[Array, Array]:
        trial, coordinates = case
        metrics, status, *_ = montecarlo.one(parts, problem.dispersion, problem.seed, trial, coordinates)
        return jnp.stack([getattr(metrics, name) for name in names]), status

    return judge(problem.rules, gains, *montecarlo.blocks(fly, (problem.trials, problem.coordinates)))


def judge(
    rules: Rules, gains: Float[Array, " gains"], metrics: Float[Array, "trials watched"], status: Array
) -> tuple[Array, Array, Array]:
    """F, c and ln of the goal, see `measure`, from the metrics that are `watched`, and the statuses, of all trials.

    The goal is a statistic of a metric over the averaged trials, or over the `tail` worst of them: CVaR, or with one
    the worst case; or t_f; or the largest metric over its limit, to which `Evaluator` adds the margins. F is its
    logarithm, plus `torque_weight` times that of the RMS peak torque (Remark 1). Where only some trials must keep a
    limit, c of the others is cut down to that of the last one that must. Where a trial fails, or has no value, c is
    `FAILED` - 1; the goal is that of the others, and each such trial adds ln `FAILED` to F.
    """
    goal, torque, *limited = metrics.T
    values, torques = (judged(v, status)[: rules.averaged] for v in (goal, torque))
    over = [judged(near(one, rules.limits[k], at_least=False), status) - 1.0 for k, one in enumerate(limited)]
    rows = [_asked(rules, k, one) for k, one in enumerate(over)]
    constraints = jnp.stack(rows) if rows else jnp.zeros((0, metrics.shape[0]))
    if rules.goal == T_F:
        value = jnp.log(gains[rules.names.index(T_F)])
        return value, constraints, value
    if rules.goal == LIMITS:
        value = log_largest(constraints)
        return value, constraints, value
    value = _log_statistic(values, rules.tail, rules.statistic)
    weighted = value + jnp.sum(values >= FAILED) * math.log(FAILED)
    if rules.torque_weight:
        weighted = weighted + rules.torque_weight * _log_statistic(torques, rules.tail, "rms")
    return weighted, constraints, value


def log_largest(constraints: Array) -> Array:
    """Return ln of the largest metric over its limit among the trials that end, from c (rows, trials)."""
    ended = jnp.where(constraints < FAILED - 1.0, constraints, -1.0)
    return jnp.log(jnp.maximum(1.0 + jnp.max(ended, initial=-1.0), LEAST))


def judged(value: Array, status: Array) -> Array:
    """A trial's metric, or its share of a limit, as it counts: `FAILED` where the trial failed or has no value."""
    ended = (status == rollout.OK) | (status == rollout.MISSED)
    return jnp.where(ended & ~jnp.isnan(value), value, FAILED)


def ended(c: np.ndarray) -> np.ndarray:
    """Constraints, where a trial that fails or has no value is as if it kept its limit: no gain may change that."""
    return np.where(c < FAILED - 1.0, c, -1.0)


def failures(c: np.ndarray) -> np.ndarray:
    """(points,) how many trials fail or have no value, of constraints c (points, requirements, trials)."""
    return np.sum(np.any(c >= FAILED - 1.0, axis=1), axis=1)


def _log_statistic(values: Float[Array, " trials"], tail: int | None, statistic: str) -> Float[Array, ""]:
    """Return ln of a statistic of the trials that end, or of the `tail` worst of them; ln `FAILED` if none ends."""
    ends = values < FAILED
    count = jnp.sum(ends)
    counted = jnp.where(ends, values, 0.0)
    if tail is not None:
        counted, count = jax.lax.top_k(counted, tail)[0], jnp.minimum(count, tail)
    if statistic == "quantile":
        return jnp.log(jnp.where(count > 0, jnp.maximum(counted[-1], LEAST), FAILED))
    power = 1 if statistic == "mean" else 2
    mean = jnp.sum(counted**power) / jnp.maximum(count, 1)
    return jnp.log(jnp.where(count > 0, mean, FAILED**power)) / power


def _asked(rules: Rules, row: int, over: Float[Array, " trials"]) -> Float[Array, " trials"]:
    """What is asked of c: of the trials that are counted, and of those among which so many may break the limit."""
    alone, may_break = jnp.where(rules.counted[row], over, -1.0), rules.may_break[row]
    if may_break is None:
        return alone
    together = jnp.where(rules.among[row], over, -1.0)
    last = jax.lax.top_k(together, may_break + 1)[0][-1]
    return jnp.maximum(alone, jnp.minimum(together, last))
