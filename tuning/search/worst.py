"""The worst case of gains: the hardest of many random trials, then gradient ascent within the dispersions.

Read `find_hardest` first. The ascent moves the random numbers of a trial, called coordinates, through unbounded
variables y.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import optax
from scipy import special  # `scipy.stats` takes half a second to import

from ptsmc_jax import programs
from ptsmc_jax.dispersions.base import Coordinates
from ptsmc_jax.dispersions.variation import Dispersion
from ptsmc_jax.simulation import rollout
from ptsmc_jax.simulation.requirements import Requirement, violation_ratio
from tuning.search import simulations
from tuning.search.objective import FAILED, Problem, mark_failures, needed_metrics
from tuning.search.simulations import Batch

SCREENED = 4096  # number of screened trials
ASCENTS = 8  # number of hardest screened trials where an ascent starts
STEPS, RATE, LAST_RATE = 30, 0.1, 0.01  # number of steps of the ascent; first and last learning rate
PROBABILITY = 0.9999  # probability content of the searched region of a normal dispersion
MEAN_VALUE_STEPS = 3  # steps of the advanced mean value method for normal dispersions, after the ascent
LIMIT_TOLERANCE = 1e-3  # the metric of a worst case may exceed its limit by this fraction

_ADAM = optax.adam(optax.cosine_decay_schedule(RATE, STEPS, LAST_RATE / RATE), b2=0.9)


@programs.jit
def _ascend(y: jax.Array, gradient: jax.Array, state: optax.OptState) -> tuple[jax.Array, optax.OptState]:
    """Return the variables after one step of Adam along the normalised gradient, and the new state of Adam.

    Args:
        y: (cases, variables) variables.
        gradient: (cases, variables) gradient.
        state: state of Adam.
    """
    size = jnp.linalg.norm(gradient, axis=1, keepdims=True)
    updates, state = _ADAM.update(-gradient / jnp.where(size > 0.0, size, 1.0), state)
    return jnp.asarray(optax.apply_updates(y, updates)), state


@dataclass(frozen=True)
class Hardest:
    """The trial with the largest violation ratio, as screened or after the ascent."""

    metric: str
    ratio: float  # metric / limit
    screened: float  # metric / limit of the hardest screened trial
    status: str
    trial: int  # number that selects the noise and the dispersions that the ascent did not move
    coordinates: dict[str, list[float]]  # random numbers of the dispersions, by name
    start: dict[str, float]  # values of the dispersed quantities, see `Dispersion.values`
    moved: tuple[str, ...]  # names of the dispersions that the ascent moved

    @property
    def unbounded(self) -> bool:
        """Whether the trial fails, because the dispersions contain the law's singularity. The metric is unbounded."""
        return self.status not in ("ok", "not_converged")

    @property
    def breaks_limit(self) -> bool:
        """Whether the trial breaks its limit by more than `LIMIT_TOLERANCE`."""
        return not self.ratio <= 1.0 + LIMIT_TOLERANCE


Screened = tuple[np.ndarray, np.ndarray]  # (trials,) numbers of the trials; (trials,) their largest metric / limit


def screen(problem: Problem, requirements: Sequence[Requirement], gains: np.ndarray) -> Screened:
    """Simulate `SCREENED` trials that are not among the averaged trials.

    Args:
        problem: the tuning problem.
        requirements: requirements on every trial.
        gains: (gains,) the gains.

    Returns:
        Numbers of the trials, (trials,), and their largest metric / limit, (trials,). It is infinite for a trial that
        fails or lacks a metric.
    """
    trials = np.arange(problem.averaged, problem.averaged + SCREENED, dtype=np.uint32)
    simulated = simulations.simulate_trials(problem.batch_of(trials), gains)
    ratios = np.stack(
        [violation_ratio(getattr(simulated.metrics, r.metric), r.limit, at_least=False) for r in requirements]
    )
    return trials, np.max(np.where(simulated.finished & ~np.isnan(ratios), ratios, np.inf), axis=0)


def find_hardest(
    problem: Problem, requirements: Sequence[Requirement], gains: np.ndarray, screened: Screened | None = None
) -> Hardest:
    """Find the worst trial for these gains by gradient ascent (Adam) from the hardest screened trials.

    The ascent maximises metric / limit within the support of the dispersions. It moves all dispersions except for the
    true inertia, which keeps its random value, as the noise does. A normal dispersion has no bounds. Its numbers are
    kept in the ball that has the probability `PROBABILITY`.

    Args:
        problem: the tuning problem.
        requirements: requirements on every trial.
        gains: (gains,) the gains.
        screened: result of `screen` for these gains. None: the trials are screened first.
    """
    trials, ratio = screened or screen(problem, requirements, gains)
    chosen = trials[np.argsort(-ratio, kind="stable")][:ASCENTS]
    limits = {r.metric: r.limit for r in requirements}
    batch = problem.batch_of(chosen)
    moved = simulations.differentiable_dispersions(problem.dispersion)
    variables = [_to_variables(problem, name, batch.coordinates[name]) for name in moved]
    y = np.concatenate([np.zeros((chosen.size, 0)), *variables], axis=1)
    best, best_y = np.full(len(y), -np.inf), y.copy()

    def evaluate(y: np.ndarray) -> np.ndarray:
        value, gradient = ratio_with_gradient(batch, gains, y, needed_metrics(problem), limits)
        better = value > best
        best[better], best_y[better] = value[better], y[better]
        return np.where(np.isfinite(gradient), gradient, 0.0)

    state = _ADAM.init(y)
    for _ in range(STEPS + 1 if moved else 0):
        ascended, state = _ascend(y, evaluate(y), state)
        y = np.asarray(ascended)
    places, kinds = _variable_slices(problem.coordinates, moved), problem.dispersion.kinds
    # slice of the variables of each normal dispersion, and radius of its ball
    balls = [(place, _ball_radius(place.stop - place.start))
             for name, place in places.items() if kinds[name].drawn != "uniform"]  # fmt: skip
    y = _move_into_balls(best_y, balls)
    for _ in range(MEAN_VALUE_STEPS + 1 if balls else 0):
        y = _move_into_balls(y, balls, evaluate(y))
    first = int(np.argmax(best))
    reached = {name: v[first : first + 1] for name, v in _coordinates_at(batch, best_y)[0].items()}
    batch_of_one = batch._replace(trials=chosen[first : first + 1], coordinates=reached)
    simulated = jax.tree.map(lambda v: v[0, 0], simulations.simulate(batch_of_one, gains[None]))
    ratios = {
        m: float(violation_ratio(getattr(simulated.metrics, m), limit, at_least=False)) for m, limit in limits.items()
    }
    # a metric is NaN if it has no value, such as the settling time of a run that never settles
    ratios = {m: np.inf if np.isnan(v) else v for m, v in ratios.items()}
    worst_metric = max(ratios, key=ratios.__getitem__)
    return Hardest(
        metric=worst_metric,
        ratio=ratios[worst_metric],
        screened=float(ratio.max()),
        status=rollout.STATUS[int(simulated.status)][0],
        trial=int(chosen[first]),
        coordinates={name: v[0].tolist() for name, v in reached.items()},
        start={name: float(v) for name, v in simulated.drawn.items()},
        moved=moved,
    )


def _to_variables(problem: Problem, name: str, c: np.ndarray) -> np.ndarray:
    """Map the random numbers c of a dispersion, called coordinates, to unbounded variables y.

    A uniform c is (1 - cos pi y) / 2, which reaches both ends of its interval. Other c are equal to y.
    """
    uniform = problem.dispersion.kinds[name].drawn == "uniform"
    return np.arccos(1.0 - 2.0 * c) / np.pi if uniform else c


def _variable_slices(coordinates: Coordinates, names: tuple[str, ...]) -> dict[str, slice]:
    """Return the slice of the variables that belongs to each of these names, by name, in their order."""
    counts = [coordinates[name].shape[1] for name in names]
    ends = np.cumsum(counts, dtype=int).tolist()
    return {name: slice(end - count, end) for name, count, end in zip(names, counts, ends, strict=True)}


def _ball_radius(count: int) -> float:
    """Return the radius of the ball that contains normal random numbers with probability `PROBABILITY`."""
    return float(
        np.sqrt(2.0 * special.gammaincinv(count / 2.0, PROBABILITY))
    )  # quantile of the chi-squared distribution


def _move_into_balls(y: np.ndarray, balls: list[tuple[slice, float]], gradient: np.ndarray | None = None) -> np.ndarray:
    """Return the variables with the normal ones moved just inside their balls, where gradients are not clipped.

    If a gradient is given, the normal variables move to the point of the sphere in its direction. This is a step of the
    advanced mean value method (Wu, Millwater and Cruse, AIAA J. 28, 1990). Adam moves all numbers by similar steps.
    Without this step, numbers with little effect would use up a large part of the radius.

    Args:
        y: (cases, variables) variables.
        balls: slice and radius of each normal dispersion.
        gradient: (cases, variables) gradient, or None.
    """
    y = y.copy()
    for place, radius in balls:
        part, edge = y[:, place], (1.0 - 1e-9) * radius
        norm = np.linalg.norm(part, axis=1, keepdims=True)
        part = part * np.minimum(1.0, edge / np.maximum(norm, 1e-12))
        if gradient is not None:
            length = np.linalg.norm(gradient[:, place], axis=1, keepdims=True)
            part = np.where(length > 0.0, edge * gradient[:, place] / np.where(length > 0.0, length, 1.0), part)
        y[:, place] = part
    return y


def ratio_with_gradient(
    batch: Batch, gains: np.ndarray, y: np.ndarray, metrics: tuple[str, ...], limits: Mapping[str, float]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the largest metric / limit of each case and its gradient with respect to the variables y.

    The compiled program of the search computes the gradients. It differentiates along as many directions at a time as
    there are gains.

    Args:
        batch: the trials, one for each case.
        gains: (gains,) the gains.
        y: (cases, variables) variables of the dispersions.
        metrics: names of the metrics of the search, which include the names in `limits`.
        limits: limit of each constrained metric.

    Returns:
        The ratio, (cases,), and its gradient, (cases, variables). A failed case has the ratio `FAILED` and no gradient.
    """
    coordinates, shifts = _coordinates_at(batch, y)
    batch, count, width = batch._replace(coordinates=coordinates), y.shape[1], len(batch.names)
    columns, limit = [metrics.index(name) for name in limits], np.asarray([*limits.values()], dtype=float)
    value, gradients = np.zeros(len(y)), list[np.ndarray]()
    # zeros for the unused directions of the last call
    padded_shifts = {name: np.pad(v, [(0, 0), (0, -count % width), (0, 0)]) for name, v in shifts.items()}
    for k in range(0, count, width):
        shift = {name: v[:, k : k + width] for name, v in padded_shifts.items()}
        simulated = jax.tree.map(
            lambda v: v[0],
            simulations.simulate_with_derivatives(batch, gains[None], np.zeros((1, width, width)), metrics, shift),
        )
        ratios_or_nan = jnp.asarray(violation_ratio(simulated.metrics[:, columns], limit, at_least=False))
        ratios = np.asarray(mark_failures(ratios_or_nan, jnp.asarray(simulated.status[:, None])))
        closest, value = ratios.argmax(axis=1), ratios.max(axis=1)
        gradient = np.take_along_axis(simulated.derivatives[:, :, columns], closest[:, None, None], axis=2)[:, :, 0]
        gradients.append(np.where(value[:, None] < FAILED, gradient / (limit + (limit == 0.0))[closest][:, None], 0.0))
    return value, np.concatenate(gradients, axis=1)[:, :count]


def _coordinates_at(batch: Batch, y: np.ndarray) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Return the coordinates (cases, numbers) of variables y (cases, variables), by name of each dispersion.

    The second result has their derivatives (cases, variables, numbers), by name of each moved dispersion.
    """
    names = simulations.differentiable_dispersions(batch.dispersion)
    moved, shifts = jax.tree.map(np.asarray, _to_coordinates(batch.dispersion, dict(batch.coordinates), y, names))
    return {**batch.coordinates, **moved}, shifts


@programs.jit(static_argnames="names", compiler_options=programs.FAST_COMPILE)
def _to_coordinates(
    dispersion: Dispersion, coordinates: Coordinates, y: jax.Array, names: tuple[str, ...]
) -> tuple[dict, dict]:
    """Map the unbounded variables y of the ascent to random numbers within the searched region.

    Args:
        dispersion: the dispersions.
        coordinates: coordinates (cases, numbers) of all names; only their shapes matter.
        y: (cases, variables) variables.
        names: names of the moved dispersions.

    Returns:
        The coordinates (cases, numbers) and their derivatives (cases, variables, numbers), by name.
    """

    def to_coordinates(y: jax.Array) -> Coordinates:
        moved = {}
        for name, place in _variable_slices(coordinates, names).items():
            part = y[place]
            if dispersion.kinds[name].drawn == "uniform":
                moved[name] = 0.5 - 0.5 * jnp.cos(jnp.pi * part)
            else:
                moved[name] = part * jnp.minimum(
                    1.0, _ball_radius(part.size) / jnp.maximum(jnp.linalg.norm(part), 1e-12)
                )
        return moved

    gradients = jax.vmap(jax.jacfwd(to_coordinates))(y)
    return jax.vmap(to_coordinates)(y), {name: jnp.swapaxes(v, 1, 2) for name, v in gradients.items()}
