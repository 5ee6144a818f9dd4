"""The hardest trials: screened among many draws, then by gradient ascent inside what the dispersions can draw."""

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
from ptsmc_jax.simulation.requirements import Requirement, over
from tuning.search import flights
from tuning.search.flights import Fleet
from tuning.search.objective import FAILED, Problem, judged, watched

SCREENED = 4096  # trials looked through
CLIMBERS = 8  # of the hardest ones, from which is climbed
STEPS, RATE, LAST_RATE = 30, 0.1, 0.01  # of the ascent
HELD = 0.9999  # share of a normal dispersion that is searched
TURNS = 3  # of what is normal towards its slopes, after the ascent
NEAR = 1e-3  # how far a worst case may be beyond a limit

_ADAM = optax.adam(optax.cosine_decay_schedule(RATE, STEPS, LAST_RATE / RATE), b2=0.9)


@programs.jit
def _ascended(y: jax.Array, slope: jax.Array, state: optax.OptState) -> tuple[jax.Array, optax.OptState]:
    """Free reals (cases, reals) a step of Adam's along their slopes, and what it remembers."""
    size = jnp.linalg.norm(slope, axis=1, keepdims=True)
    updates, state = _ADAM.update(-slope / jnp.where(size > 0.0, size, 1.0), state)
    return jnp.asarray(optax.apply_updates(y, updates)), state


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
    trials = np.arange(problem.averaged, problem.averaged + SCREENED, dtype=np.uint32)
    flown = flights.trials(problem.others(trials), gains)
    ratios = np.stack([over(getattr(flown.metrics, r.metric), r.limit, at_least=False) for r in requirements])
    return trials, np.max(np.where(flown.finished & ~np.isnan(ratios), ratios, np.inf), axis=0)


def hardest(
    problem: Problem, requirements: Sequence[Requirement], gains: np.ndarray, screened: Screened | None = None
) -> Hardest:
    """The worst trial for these gains inside the dispersions' support, by gradient ascent from the hardest drawn.

    Moved is all that is drawn but the true inertia, which stays as drawn, as noise does. A normal dispersion, which has
    no bounds, is searched where `HELD` of it lies.

    Args:
        problem: of the search.
        requirements: whose limits it is to come nearest to.
        gains: (gains,).
        screened: what `screen` says of these; None: it is asked.
    """
    trials, ratio = screened or screen(problem, requirements, gains)
    chosen = trials[np.argsort(-ratio, kind="stable")][:CLIMBERS]
    limits = {r.metric: r.limit for r in requirements}
    fleet = problem.others(chosen)
    moved = flights.movable(problem.dispersion)
    charted = [_charted(problem, name, fleet.coordinates[name]) for name in moved]
    y = np.concatenate([np.zeros((chosen.size, 0)), *charted], axis=1)
    best, best_y = np.full(len(y), -np.inf), y.copy()

    def look(y: np.ndarray) -> np.ndarray:
        value, slope = climb(fleet, gains, y, watched(problem), limits)
        better = value > best
        best[better], best_y[better] = value[better], y[better]
        return np.where(np.isfinite(slope), slope, 0.0)

    state = _ADAM.init(y)
    for _ in range(STEPS + 1 if moved else 0):
        ascended, state = _ascended(y, look(y), state)
        y = np.asarray(ascended)
    normal = _normal(problem, moved)
    y = _within(best_y, normal)
    for _ in range(TURNS + 1 if normal else 0):
        y = _within(y, normal, look(y))
    first = int(np.argmax(best))
    reached_at = {name: v[first : first + 1] for name, v in _moved_to(fleet, best_y)[0].items()}
    fleet_of_one = fleet._replace(trials=chosen[first : first + 1], coordinates=reached_at)
    flown = jax.tree.map(lambda v: v[0, 0], flights.fly(fleet_of_one, gains[None]))
    ratios = {m: float(over(getattr(flown.metrics, m), limit, at_least=False)) for m, limit in limits.items()}
    ratios = {m: np.inf if np.isnan(v) else v for m, v in ratios.items()}  # without a value: it never settles, say
    worst = max(ratios, key=ratios.__getitem__)
    return Hardest(
        metric=worst,
        ratio=ratios[worst],
        screened=float(ratio.max()),
        status=rollout.STATUS[int(flown.status)][0],
        trial=int(chosen[first]),
        coordinates={name: v[0].tolist() for name, v in reached_at.items()},
        start={name: float(v) for name, v in flown.drawn.items()},
        moved=moved,
    )


def _charted(problem: Problem, name: str, c: np.ndarray) -> np.ndarray:
    """Free reals of coordinates: of uniform ones u = (1 - cos pi y) / 2, which reaches both ends."""
    uniform = problem.dispersion.kinds[name].drawn == "uniform"
    return np.arccos(1.0 - 2.0 * c) / np.pi if uniform else c


def _places(coordinates: Coordinates, names: tuple[str, ...]) -> dict[str, slice]:
    """Where the free reals of each of these names stand, one after the other."""
    counts = [coordinates[name].shape[1] for name in names]
    ends = np.cumsum(counts, dtype=int).tolist()
    return {name: slice(end - count, end) for name, count, end in zip(names, counts, ends, strict=True)}


def _normal(problem: Problem, moved: tuple[str, ...]) -> list[tuple[slice, float]]:
    """Where among the free reals the normal numbers of each kind stand, and how far they are searched."""
    places, kinds = _places(problem.coordinates, moved), problem.dispersion.kinds
    return [(place, _farthest(place.stop - place.start))
            for name, place in places.items() if kinds[name].drawn != "uniform"]  # fmt: skip


def _farthest(count: int) -> float:
    """Radius of the ball that holds `HELD` of so many normal numbers."""
    return float(np.sqrt(2.0 * special.gammaincinv(count / 2.0, HELD)))  # of chi square


def _within(y: np.ndarray, normal: list[tuple[slice, float]], slope: np.ndarray | None = None) -> np.ndarray:
    """Free reals with normal ones a hair inside their balls, where slopes are whole; with slopes, turned towards them.

    The advanced mean value step (Wu, Millwater and Cruse, AIAA J. 28, 1990). Adam moves all numbers alike, and those
    that hardly count are far out then, at the expense of those that do.
    """
    y = y.copy()
    for place, farthest in normal:
        part, edge = y[:, place], (1.0 - 1e-9) * farthest
        size = np.linalg.norm(part, axis=1, keepdims=True)
        part = part * np.minimum(1.0, edge / np.maximum(size, 1e-12))
        if slope is not None:
            steep = np.linalg.norm(slope[:, place], axis=1, keepdims=True)
            part = np.where(steep > 0.0, edge * slope[:, place] / np.where(steep > 0.0, steep, 1.0), part)
        y[:, place] = part
    return y


def climb(
    fleet: Fleet, gains: np.ndarray, y: np.ndarray, metrics: tuple[str, ...], limits: Mapping[str, float]
) -> tuple[np.ndarray, np.ndarray]:
    """Largest metric / limit of each case, (cases,), and its slopes by the free reals y, (cases, reals).

    metrics: those of the search, `limits` among them: its program finds the slopes, along as many reals at a time as
    there are gains.
    """
    coordinates, shifts = _moved_to(fleet, y)
    fleet, count, width = fleet._replace(coordinates=coordinates), y.shape[1], len(fleet.names)
    columns, limit = [metrics.index(name) for name in limits], np.asarray([*limits.values()], dtype=float)
    value, slopes = np.zeros(len(y)), list[np.ndarray]()
    for k in range(0, count, width):
        shift = {name: _filled(v[:, k : k + width], width) for name, v in shifts.items()}
        flown = jax.tree.map(
            lambda v: v[0], flights.sloped(fleet, gains[None], np.zeros((1, width, width)), metrics, shift)
        )
        shares = jnp.asarray(over(flown.metrics[:, columns], limit, at_least=False))
        ratios = np.asarray(judged(shares, jnp.asarray(flown.status[:, None])))
        nearest, value = ratios.argmax(axis=1), ratios.max(axis=1)
        slope = np.take_along_axis(flown.slopes[:, :, columns], nearest[:, None, None], axis=2)[:, :, 0]
        slopes.append(np.where(value[:, None] < FAILED, slope / (limit + (limit == 0.0))[nearest][:, None], 0.0))
    return value, np.concatenate(slopes, axis=1)[:, :count]


def _filled(v: np.ndarray, width: int) -> np.ndarray:
    """With zeros for directions that there are not, (cases, directions, ..)."""
    return np.concatenate([v, np.zeros((v.shape[0], width - v.shape[1], *v.shape[2:]))], axis=1)


def _moved_to(fleet: Fleet, y: np.ndarray) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Coordinates of free reals, and by what each real moves them, (cases, reals, numbers) of each that moves."""
    names = flights.movable(fleet.dispersion)
    moved, shifts = jax.tree.map(np.asarray, _moved(fleet.dispersion, dict(fleet.coordinates), y, names))
    return {**fleet.coordinates, **moved}, shifts


@programs.jit(static_argnames="names", compiler_options=programs.QUICKLY)
def _moved(dispersion: Dispersion, coordinates: Coordinates, y: jax.Array, names: tuple[str, ...]) -> tuple[dict, dict]:
    """Coordinates of free reals y (cases, reals), those of these names, and their derivatives by each of them."""

    def of(y: jax.Array) -> Coordinates:
        moved = {}
        for name, place in _places(coordinates, names).items():
            part = y[place]
            if dispersion.kinds[name].drawn == "uniform":
                moved[name] = 0.5 - 0.5 * jnp.cos(jnp.pi * part)
            else:
                moved[name] = part * jnp.minimum(1.0, _farthest(part.size) / jnp.maximum(jnp.linalg.norm(part), 1e-12))
        return moved

    slopes = jax.vmap(jax.jacfwd(of))(y)
    return jax.vmap(of)(y), {name: jnp.swapaxes(v, 1, 2) for name, v in slopes.items()}
