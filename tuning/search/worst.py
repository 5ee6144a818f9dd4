"""The hardest trials: screened among many draws, then by gradient ascent inside what the dispersions can draw."""

from collections.abc import Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import optax
from scipy.stats import chi2

from ptsmc_jax import programs
from ptsmc_jax.batching import lanes
from ptsmc_jax.campaigns import montecarlo
from ptsmc_jax.dispersions.base import INERTIA, Coordinates
from ptsmc_jax.simulation import rollout
from ptsmc_jax.simulation.requirements import Requirement
from tuning.search.gains import with_gains
from tuning.search.objective import Problem, coordinates_of, judged

SCREENED = 4096  # trials looked through
CLIMBERS = 8  # of the hardest ones, from which is climbed
STEPS, RATE, LAST_RATE = 30, 0.1, 0.01  # of the ascent by Adam
HELD = 0.9999  # share of a normal dispersion that is searched
NEAR = 1e-3  # how far a worst case may be beyond a limit


@dataclass(frozen=True)
class Hardest:
    """The trial, as drawn or as climbed to, that comes nearest to a limit or is farthest beyond it."""

    metric: str
    ratio: float  # metric / limit
    screened: float  # the same of the hardest screened trial
    status: str
    trial: int  # which names its noise, and what was not moved
    coordinates: dict[str, list[float]]  # of what is drawn
    start: dict[str, float]  # what it flies with, see `Dispersion.values`
    moved: tuple[str, ...]  # what the ascent moved

    @property
    def unbounded(self) -> bool:
        """Whether the metric has no largest value inside the dispersions: the law's singularity is among them."""
        return self.status not in ("ok", "missed")

    @property
    def beyond(self) -> bool:
        """Whether it breaks its limit by more than `NEAR`."""
        return not self.ratio <= 1.0 + NEAR


Screened = tuple[np.ndarray, np.ndarray]  # trials, (trials,) metric / limit


def screen(problem: Problem, requirements: Sequence[Requirement], gains: np.ndarray) -> Screened:
    """Trials that no search has averaged, and how near each comes to its limits, (trials,) metric / limit."""
    parts = with_gains(problem.parts, dict(zip(problem.names, gains, strict=True)))
    trials = np.arange(problem.averaged, problem.averaged + SCREENED, dtype=np.uint32)
    flown = montecarlo.run(parts, problem.dispersion, int(problem.seed), trials)
    ratios = np.stack([getattr(flown.metrics, r.metric) / r.limit for r in requirements])
    return trials, np.max(np.where(flown.finished & ~np.isnan(ratios), ratios, np.inf), axis=0)


def hardest(
    problem: Problem, requirements: Sequence[Requirement], gains: np.ndarray, screened: Screened | None = None
) -> Hardest:
    """The worst trial for these gains inside the dispersions' support, by gradient ascent from the hardest drawn.

    Moved are initial attitude or state, initial rate and disturbance phase; true inertia and noise stay as drawn. A
    normal dispersion, which has no bounds, is searched where `HELD` of it lies. screened: what `screen` found for them.
    """
    trials, ratio = screened or screen(problem, requirements, gains)
    chosen = trials[np.argsort(-ratio, kind="stable")][:CLIMBERS]
    names, limits = tuple(r.metric for r in requirements), jnp.asarray([r.limit for r in requirements])
    coordinates = coordinates_of(problem.dispersion, int(problem.seed), chosen)
    moved = tuple(name for name in coordinates if name != INERTIA)
    parts = with_gains(problem.parts, dict(zip(problem.names, gains, strict=True)))
    charted = [_charted(problem, name, np.asarray(coordinates[name])) for name in moved]
    y = np.concatenate([np.zeros((chosen.size, 0)), *charted], axis=1)
    case = (parts, problem.dispersion, problem.seed, jnp.asarray(chosen), coordinates, limits)
    optimiser = optax.adam(optax.cosine_decay_schedule(RATE, STEPS, LAST_RATE / RATE), b2=0.9)
    state, best, best_y = optimiser.init(jnp.asarray(y)), np.full(len(y), -np.inf), y.copy()
    for _ in range(STEPS + 1 if moved else 0):
        value, slope = (np.asarray(v) for v in _climb(*case, jnp.asarray(y), moved, names))
        better = value > best
        best[better], best_y[better] = value[better], y[better]
        size = np.linalg.norm(slope, axis=1, keepdims=True)
        size = np.where(np.isfinite(size) & (size > 0.0), size, 1.0)
        updates, state = optimiser.update(jnp.nan_to_num(-slope / size), state)
        y = np.asarray(optax.apply_updates(jnp.asarray(y), updates))
    first = int(np.argmax(best))
    found = {**coordinates, **_moved(problem.dispersion, coordinates, jnp.asarray(best_y), moved)}
    one = {name: v[first] for name, v in found.items()}
    metrics, code, _, values, _ = _fly(parts, problem.dispersion, problem.seed, jnp.uint32(chosen[first]), one)
    reached = [float(getattr(metrics, name)) / float(limit) for name, limit in zip(names, limits, strict=True)]
    ratios = [np.inf if np.isnan(one) else one for one in reached]  # it has no value: it never settles, say
    worst = int(np.argmax(ratios))
    return Hardest(
        metric=names[worst],
        ratio=ratios[worst],
        screened=float(ratio.max()),
        status=rollout.STATUS[int(code)][0],
        trial=int(chosen[first]),
        coordinates={name: np.asarray(v).tolist() for name, v in one.items()},
        start={name: float(v) for name, v in values.items()},
        moved=moved,
    )


def _charted(problem: Problem, name: str, c: np.ndarray) -> np.ndarray:
    """Free reals of coordinates: of uniform ones u = (1 - cos pi y) / 2, which reaches both ends."""
    uniform = problem.dispersion.kinds[name].drawn == "uniform"
    return np.arccos(1.0 - 2.0 * c) / np.pi if uniform else c


def _moved(dispersion, coordinates: Coordinates, y: jax.Array, moved: tuple[str, ...]) -> Coordinates:
    """Coordinates of free reals, both (cases, count)."""
    found, used = {}, 0
    for name in moved:
        count = coordinates[name].shape[1]
        part, used = y[:, used : used + count], used + count
        if dispersion.kinds[name].drawn == "uniform":
            found[name] = 0.5 - 0.5 * jnp.cos(jnp.pi * part)
        else:
            farthest = float(np.sqrt(chi2.ppf(HELD, count)))
            size = jnp.linalg.norm(part, axis=1, keepdims=True)
            found[name] = part * jnp.minimum(1.0, farthest / jnp.maximum(size, 1e-12))
    return found


@programs.jit
def _fly(parts, dispersion, seed, trial, coordinates) -> montecarlo.Flown:
    return montecarlo.one(parts, dispersion, seed, trial, coordinates)


@programs.jit(static_argnames=("moved", "names"))
def _climb(parts, dispersion, seed, trials, coordinates, limits, y, moved, names) -> tuple[jax.Array, jax.Array]:
    """Largest metric / limit of each case, (cases,), and its slopes by the free reals, (cases, reals)."""

    def values(y: jax.Array) -> jax.Array:
        def fly(case: tuple) -> jax.Array:
            trial, own = case
            metrics, status, *_ = montecarlo.one(parts, dispersion, seed, trial, own)
            ratios = jnp.stack([judged(getattr(metrics, name) / limits[k], status) for k, name in enumerate(names)])
            return jnp.max(ratios)

        return lanes.vmap(fly)((trials, {**coordinates, **_moved(dispersion, coordinates, y, moved)}))

    # cases do not depend on each other: one tangent along a real moves it in all of them at once
    along = jnp.broadcast_to(jnp.eye(y.shape[1])[:, None, :], (y.shape[1], *y.shape))
    value, slopes = jax.vmap(lambda e: jax.jvp(values, (y,), (e,)), out_axes=(None, -1))(along)
    return value, slopes
