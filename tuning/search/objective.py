"""The tuning problem: objective over the training trials, and requirements as constraints on each trial.

`problem` builds a `Problem`, and `judge` computes F and the constraints from the metrics of the trials. Read `judge`
first.
"""

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
from ptsmc_jax.simulation.requirements import Requirement, violation_ratio
from ptsmc_jax.simulation.rollout import Parts
from tuning.search.gains import with_gains
from tuning.search.margin_rows import RequiredMargins
from tuning.search.simulations import Batch

FAILED = 1e9  # metric, and metric / limit, of a failed trial: larger than those of any completed trial
LEAST = 1e-300  # smallest argument of a logarithm, so that it is finite
CALL_SIZE = 128  # trials whose dispersions are computed in one call


@pytree
@dataclass(frozen=True, kw_only=True)
class Rules:
    """The rules that judge the metrics of the training trials. The objective covers the first `averaged` trials.

    Every trial that is `counted` must keep a limit. If the limit has a quantile, the trials in its `quantile_sample`
    must also keep it, except for the `may_break` worst of them.
    """

    limits: Leaf | np.ndarray  # (requirements,) in the metrics' units
    quantile_sample: Leaf | np.ndarray  # (requirements, trials) bool: the trial belongs to the sample of a quantile
    counted: Leaf | np.ndarray  # (requirements, trials) bool: the trial must keep the limit
    averaged: int = field(metadata={"static": True})  # number of trials that the objective covers
    names: tuple[str, ...] = field(metadata={"static": True})  # names of the free gains
    # largest number of trials of the sample that may break each limit; None: a limit on every trial
    may_break: tuple[int | None, ...] = field(metadata={"static": True})
    objective: str = field(default="window_error", metadata={"static": True})  # a metric, `T_F` or `LIMITS`
    # number of worst trials that the objective covers, such as for the CVaR; None: all averaged trials
    tail: int | None = field(default=None, metadata={"static": True})
    # key `statistic` of [tune]; a quantile is the smallest value of the tail, the worst case has a tail of one trial
    statistic: str = field(default="rms", metadata={"static": True})
    torque_weight: float = field(default=0.0, metadata={"static": True})  # weight of ln(RMS peak torque) in F


@pytree
@dataclass(frozen=True, kw_only=True)
class Problem(Rules):
    """A tuning problem: the `Rules`, and the data for the simulation of its trials.

    Arrays with a trial axis are NumPy arrays, so that `rounds` can replace trials without a new compilation.
    """

    parts: Parts
    dispersion: Dispersion
    seed: Leaf  # uint32
    trials: Leaf | np.ndarray  # (trials,) uint32 numbers that select the noise
    coordinates: dict[str, Any]  # random numbers of the dispersions, trials on the first axis
    metrics: tuple[str, ...] = field(metadata={"static": True})  # metrics of the requirements
    margins: RequiredMargins | None = (
        None  # margins of the loop; their rows follow the rows of the requirements, see `Evaluator`
    )

    @property
    def rows(self) -> tuple[str, ...]:
        """Names of the rows of c: metrics of the requirements, then margins."""
        return self.metrics + (() if self.margins is None else self.margins.metrics)

    @property
    def rules(self) -> Rules:
        """The rules without the simulation."""
        return Rules(**{one.name: getattr(self, one.name) for one in fields(Rules)})

    @property
    def batch(self) -> Batch:
        """The trials to simulate, with their parts and dispersions."""
        trials, coordinates = np.asarray(self.trials), jax.tree.map(np.asarray, self.coordinates)
        names = needed_metrics(self)
        pointing = tuple(name for name in POINTING if name in names)
        return Batch(self.parts, self.dispersion, self.seed, self.names, trials, coordinates, pointing)

    def batch_of(self, trials: np.ndarray) -> Batch:
        """Return a batch of other trials, (trials,), of the same seed."""
        coordinates = coordinates_of(self.dispersion, int(self.seed), trials)
        return self.batch._replace(trials=np.asarray(trials, dtype=np.uint32), coordinates=coordinates)

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
    """Build a problem over training trials.

    Args:
        parts: nominal parts.
        dispersion: dispersions about the nominal parts.
        seed: seed of the dispersions and the noise.
        trials: (trials,) numbers of the training trials, which are all averaged.
        names: names of the free gains.
        requirements: requirements on the metrics.
        may_break: number of trials that may break each limit, or None for a limit on every trial. By default, every
            trial must keep every limit.
        banded: whether a band of trials will represent each limit, see `confirm.allowed_in_training`. Every training
            trial must keep the limit until the band joins.
        others: further fields of `Problem`.
    """
    empty = Problem(
        parts=parts,
        dispersion=dispersion,
        seed=jnp.uint32(seed),
        trials=np.zeros(0, dtype=np.uint32),
        coordinates=coordinates_of(dispersion, seed, np.zeros(0)),
        limits=np.asarray([r.limit for r in requirements], dtype=float),
        quantile_sample=np.zeros((len(requirements), 0), dtype=bool),
        counted=np.zeros((len(requirements), 0), dtype=bool),
        averaged=len(trials),
        names=names,
        metrics=tuple(r.metric for r in requirements),
        may_break=may_break or (None,) * len(requirements),
    )
    kept_by_all = kept_by_every_trial(empty) | np.asarray(banded or False, dtype=bool)
    with_training_trials = with_trials(empty, trials, counted=kept_by_all)
    return replace(with_training_trials, quantile_sample=~with_training_trials.counted, **others)


def coordinates_of(dispersion: Dispersion, seed: int, trials: np.ndarray) -> dict[str, np.ndarray]:
    """Return the random numbers of the dispersions for trials. One program computes `CALL_SIZE` trials at a time.

    Args:
        dispersion: the dispersions.
        seed: seed of the dispersions.
        trials: (trials,) numbers of the trials.

    Returns:
        Random numbers by the name of the dispersion, (trials, numbers).
    """
    numbers = np.resize(np.asarray(trials, dtype=np.uint32), max(1, -(-len(trials) // CALL_SIZE)) * CALL_SIZE)
    calls = [
        montecarlo.coordinates(dispersion, jnp.uint32(seed), jnp.asarray(numbers[k : k + CALL_SIZE]))
        for k in range(0, numbers.size, CALL_SIZE)
    ]
    return jax.tree.map(lambda *many: np.concatenate(many)[: len(trials)], *calls)


def replace_entries(array: Leaf | np.ndarray, index: Any, values: Any) -> np.ndarray:
    """Return a copy of an array with other values at some indices.

    Args:
        array: array of a problem.
        index: index into the array, as in `array[index]`.
        values: the new values.
    """
    changed = np.array(array)
    changed[index] = values
    return changed


def with_trials(problem: Problem, trials: np.ndarray, counted: np.ndarray | None = None) -> Problem:
    """Return the problem with additional trials in the constraints.

    Args:
        problem: the problem.
        trials: (trials,) numbers of the additional trials.
        counted: (requirements,) bool, the limits that each of these trials must keep. By default these are the limits
            on every trial.
    """
    coordinates = coordinates_of(problem.dispersion, int(problem.seed), trials)
    rows = np.asarray(kept_by_every_trial(problem) if counted is None else counted, dtype=bool)
    return replace(
        problem,
        trials=np.concatenate([problem.trials, np.asarray(trials, dtype=np.uint32)]),
        quantile_sample=np.pad(problem.quantile_sample, [(0, 0), (0, len(trials))]),
        counted=np.concatenate([problem.counted, np.tile(rows[:, None], (1, len(trials)))], axis=1),
        coordinates={name: np.concatenate([v, coordinates[name]]) for name, v in problem.coordinates.items()},
    )


def fewer_trials(problem: Problem, averaged: int) -> Problem:
    """Return the problem with fewer averaged trials, and with all trials that were added.

    The fractions of trials in tails and quantiles stay the same, up to rounding.
    """
    if averaged >= problem.averaged:
        return problem
    selected = np.r_[:averaged, problem.averaged : problem.trials.size]

    def scale_count(count: int) -> int:  # the same fraction of the fewer trials, rounded up
        return max(1, math.ceil(count * averaged / problem.averaged))

    def scale_may_break(may_break: int | None, sample_is_averaged: bool) -> int | None:
        """Return how many of the fewer trials may break a limit. The number does not change for a band of trials."""
        if may_break is None or not sample_is_averaged:
            return may_break
        return averaged - scale_count(problem.averaged - may_break)

    return replace(
        problem,
        trials=problem.trials[selected],
        quantile_sample=problem.quantile_sample[:, selected],
        counted=problem.counted[:, selected],
        coordinates={name: v[selected] for name, v in problem.coordinates.items()},
        averaged=averaged,
        may_break=tuple(map(scale_may_break, problem.may_break, np.asarray(problem.quantile_sample)[:, 0].tolist())),
        tail=None if problem.tail is None else scale_count(problem.tail),
    )


def kept_by_every_trial(problem: Problem) -> np.ndarray:
    """Return which limits every trial must keep, (requirements,) bool."""
    return np.asarray([allowed is None for allowed in problem.may_break], dtype=bool)


def needed_metrics(problem: Problem) -> tuple[str, ...]:
    """Return the names of the metrics of a problem: objective, peak torque, then requirements."""
    objective = "window_error" if problem.objective in (T_F, LIMITS) else problem.objective
    return (objective, "peak_torque", *problem.metrics)


def measure(problem: Problem, gains: Float[Array, " gains"]) -> tuple[Array, Array, Array]:
    """Simulate all trials. Return F, the constraints c, (requirements, trials), and ln(objective), see `judge`.

    This is a pure function for any transformation of JAX.

    Args:
        problem: the tuning problem.
        gains: (gains,) values of the free gains.
    """
    parts, names = with_gains(problem.parts, dict(zip(problem.names, gains, strict=True))), needed_metrics(problem)

    def simulate_trial(trial_and_coordinates: tuple[Array, Coordinates]) -> tuple[Array, Array]:
        """Return the metrics and status of a trial, given its number and the random numbers of its dispersions."""
        trial, coordinates = trial_and_coordinates
        metrics, status, *_ = montecarlo.one(parts, problem.dispersion, problem.seed, trial, coordinates)
        return jnp.stack([getattr(metrics, name) for name in names]), status

    return judge(problem.rules, gains, *montecarlo.map_in_blocks(simulate_trial, (problem.trials, problem.coordinates)))


def judge(
    rules: Rules, gains: Float[Array, " gains"], metrics: Float[Array, "trials metrics"], status: Array
) -> tuple[Array, Array, Array]:
    """Return F, which the search minimises, the constraints c, and ln(objective), from the results of all trials.

    c = metric / limit - 1 is met if c <= 0. The objective is one of three quantities:

    - a statistic of a metric over the completed averaged trials, or over the `tail` worst of them, such as the CVaR.
      Then F = ln(objective) + w ln(RMS peak torque) + n ln(`FAILED`), with w = `torque_weight` (Remark 1). n is the
      number of averaged trials that failed.
    - t_f, with F = ln(t_f).
    - the largest metric / limit, with F as its logarithm. `Evaluator` includes the margins.

    If some trials may break a limit, their c is reduced to the c of the worst trial that must keep it. If a trial fails
    or lacks a metric, its c is `FAILED` - 1.

    Args:
        rules: the rules.
        gains: (gains,) values of the free gains.
        metrics: (trials, metrics) metrics of all trials, in the order of `needed_metrics`.
        status: (trials,) status codes, see `rollout.STATUS`.

    Returns:
        F, c (requirements, trials), and ln of the objective.
    """
    objective, torque, *limited = metrics.T
    values, torques = (mark_failures(v, status)[: rules.averaged] for v in (objective, torque))
    excesses = [
        mark_failures(violation_ratio(one, rules.limits[k], at_least=False), status) - 1.0
        for k, one in enumerate(limited)
    ]
    rows = [_constraint(rules, k, one) for k, one in enumerate(excesses)]
    constraints = jnp.stack(rows) if rows else jnp.zeros((0, metrics.shape[0]))
    if rules.objective == T_F:
        value = jnp.log(gains[rules.names.index(T_F)])
        return value, constraints, value
    if rules.objective == LIMITS:
        completed = jnp.where(constraints < FAILED - 1.0, constraints, -1.0)
        value = jnp.log(jnp.maximum(1.0 + jnp.max(completed, initial=-1.0), LEAST))
        return value, constraints, value
    value = _log_statistic(values, rules.tail, rules.statistic)
    weighted = value + jnp.sum(values >= FAILED) * math.log(FAILED)
    if rules.torque_weight:
        weighted = weighted + rules.torque_weight * _log_statistic(torques, rules.tail, "rms")
    return weighted, constraints, value


def mark_failures(value: Array, status: Array) -> Array:
    """Return the values of completed trials, and `FAILED` for trials that failed or lack a value, (trials,)."""
    return jnp.where(rollout.has_finished(status) & ~jnp.isnan(value), value, FAILED)


def ignore_failures(c: np.ndarray) -> np.ndarray:
    """Return constraints with c = -1 for failed trials. Gains may be unable to change a failure."""
    return np.where(c < FAILED - 1.0, c, -1.0)


def count_failures(c: np.ndarray) -> np.ndarray:
    """Return the number of trials that fail or lack a metric, (points,), from c, (points, requirements, trials)."""
    return np.sum(np.any(c >= FAILED - 1.0, axis=1), axis=1)


def _log_statistic(values: Float[Array, " trials"], tail: int | None, statistic: str) -> Float[Array, ""]:
    """Return ln of a statistic of the completed trials, or of the `tail` worst of them, or ln `FAILED` without any."""
    completed = values < FAILED
    count = jnp.sum(completed)
    counted = jnp.where(completed, values, 0.0)
    if tail is not None:
        counted, count = jax.lax.top_k(counted, tail)[0], jnp.minimum(count, tail)
    if statistic == "quantile":
        return jnp.log(jnp.where(count > 0, jnp.maximum(counted[-1], LEAST), FAILED))
    power = 1 if statistic == "mean" else 2
    mean = jnp.sum(counted**power) / jnp.maximum(count, 1)
    return jnp.log(jnp.where(count > 0, mean, FAILED**power)) / power


def _constraint(rules: Rules, row: int, constraints: Float[Array, " trials"]) -> Float[Array, " trials"]:
    """Return c of one limit. It is unchanged for counted trials, and reduced for sampled trials that may break it."""
    of_counted, may_break = jnp.where(rules.counted[row], constraints, -1.0), rules.may_break[row]
    if may_break is None:
        return of_counted
    of_sample = jnp.where(rules.quantile_sample[row], constraints, -1.0)
    last = jax.lax.top_k(of_sample, may_break + 1)[0][-1]
    return jnp.maximum(of_counted, jnp.minimum(of_sample, last))
