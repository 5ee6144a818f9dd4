"""Gradient search over many starts at once, then a polish; the best admissible iterate is kept.

All starts together by Adam on the augmented Lagrangian for inequalities,
L = f + sum (max(0, m + p c)^2 - m^2) / (2 p) (Nocedal and Wright, Numerical Optimization, 2006, eq. 17.65),
then the most promising ones one by one by sequential quadratic programming (SciPy's SLSQP).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optax
from scipy.optimize import minimize
from scipy.stats import qmc

from ptsmc_jax import montecarlo
from ptsmc_jax.requirements import Requirement
from tuning.bounds import Bounds, with_gains
from tuning.objective import Problem, measure

PENALTY = 20.0
UPDATE_FROM, UPDATE_EVERY = 0.25, 5  # multipliers: updated from this share of the steps on, at this distance
LARGEST_UPDATE = 0.02  # violations beyond this count as this much: far-off gains say nothing about multipliers
POLISHED = 3  # starts that are polished
POLISH_STEPS = 40  # iterations of each, at most
RATE, LAST_RATE = 0.15, 0.01  # Adam's learning rate in the free reals, cosine decay
LARGEST_SLOPE = 1.0
CANDIDATES = 32  # points flown for each start that is chosen
CHARGE, APART = 3.0, 0.15
MARGIN = 0.03  # kept from a limit in the search: fresh trials hold some that are harder than any screened one
SCREENED = 4096  # trials looked through for those that a limit depends on
HARDEST = 8  # of them that join the constraints
DIFFERENCE = 1e-3  # of the free reals, for slopes by differences
FLAT = 1e-6  # slopes of the log error below this are none
ROUNDS = 2  # searches again with hardest trials added, at most


@dataclass(frozen=True)
class Step:
    """One step of all starts, arrays over starts first; kept as the history."""

    gains: np.ndarray  # (starts, gains)
    rms: np.ndarray  # (starts,) RMS window error of the training trials [-]
    worst: np.ndarray  # (starts, requirements) largest metric / limit


@dataclass(frozen=True)
class Search:
    """Outcome of a search."""

    gains: np.ndarray  # (gains,) the best admissible iterate
    rms: float  # its RMS window error over the training trials
    worst: np.ndarray  # (requirements,) its largest metric / limit
    history: list[Step]
    dropped: list[int]  # starts that met a number that is not finite
    rounds: int  # searches again with harder trials
    slope_error: tuple[float, float]  # of the objective's slopes at the first start and at the end, see `slope_error`
    trials: np.ndarray  # training trials and the hardest ones


def starting_points(problem: Problem, bounds: Bounds, own: np.ndarray, starts: int, seed: int) -> np.ndarray:
    """(starts, gains) free reals: the scenario's own gains first, then the most promising of a Latin hypercube.

    Each is flown once without gradients; chosen are the lowest errors, breaches of a limit charged, none nearer than
    `APART` to another in the unit cube: the valleys of this problem are narrow, and one of them can hide another.
    """
    first = bounds.free(own)[None]
    if starts == 1:
        return first
    share = qmc.LatinHypercube(len(bounds.names), rng=np.random.default_rng(seed)).random(CANDIDATES * starts)
    share = 0.02 + 0.96 * share
    z = np.log(share / (1.0 - share))
    f, c = map(np.asarray, _fly(problem, bounds, z, _divisor(len(z))))
    merit = f + CHARGE * np.log1p(c.max(axis=(1, 2), initial=0.0))
    order = [k for k in np.argsort(merit) if np.isfinite(merit[k])]
    chosen: list[int] = []
    for apart in (APART, 0.0):
        for k in order:
            distances = [np.abs(share[k] - share[j]).max() for j in chosen]
            if len(chosen) < starts - 1 and k not in chosen and min(distances, default=1.0) >= apart:
                chosen.append(k)
    return np.concatenate([first, z[chosen]])


def search(
    problem: Problem,
    bounds: Bounds,
    requirements: tuple[Requirement, ...],
    own: np.ndarray,
    starts: int,
    steps: int,
    seed: int,
    report: Callable[[int, int, float, bool], None] = lambda done, total, rms, admissible: None,
) -> Search:
    """Minimise the window error with every requirement met on the training trials.

    A limit on the worst case hangs on the few hardest trials, which a training set need not hold: the hardest of
    `SCREENED` further ones join the constraints first, and again after a search whose gains some of them still break.
    own: (gains,) the scenario's gains, the first start. report(steps done, in all, best RMS, admissible) is called
    after every step.
    """
    requirements = tuple(r for r in requirements if r.quantile is None)  # those that hang on the hardest trials
    problem = _add_hardest(problem, requirements, np.asarray(bounds.gains(jnp.zeros(len(bounds.names)))))
    z = starting_points(problem, bounds, own, starts, seed)
    found = _descend(problem, bounds, z, steps, report)
    rounds, checked = 0, slope_error(problem, bounds, z[0], len(z))
    while requirements and rounds < ROUNDS and not _holds(problem, requirements, found.gains):
        rounds += 1
        problem = _add_hardest(problem, requirements, found.gains)
        again = _descend(problem, bounds, bounds.free(found.gains, edge=1e-6)[None], max(20, steps // 3), report)
        found = replace(again, history=[*found.history, *again.history], dropped=found.dropped, rounds=rounds)
    end = bounds.free(found.gains, edge=1e-6)
    return replace(found, slope_error=(checked, slope_error(problem, bounds, end, len(z))))


def slope_error(problem: Problem, bounds: Bounds, z: np.ndarray, batch: int) -> float:
    """Largest difference of the objective's slopes, by automatic differentiation, from central differences.

    Over the largest slope, in the free reals; differences of order 4 over +-`DIFFERENCE`. batch: points flown at once.
    """
    count = z.size
    offsets = np.concatenate([k * DIFFERENCE * np.eye(count) for k in (-2, -1, 1, 2)])
    points = np.concatenate([z[None], z + offsets])
    points = np.resize(points, (-(-len(points) // batch) * batch, count))
    flown = [_evaluate(problem, bounds, points[k : k + batch]) for k in range(0, len(points), batch)]
    f = np.concatenate([f for _, f, *_ in flown])[1 : 1 + 4 * count].reshape(4, count)
    numeric = (f[0] - 8 * f[1] + 8 * f[2] - f[3]) / (12 * DIFFERENCE)
    exact = flown[0][3][0]
    return float(np.abs(exact - numeric).max() / max(np.abs(exact).max(), FLAT))


def _screen(problem: Problem, requirements, gains: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Trials that no search has seen and how near each comes to its limits (largest metric / limit)."""
    parts = with_gains(problem.parts, dict(zip(problem.names, gains, strict=True)))
    trials = np.arange(problem.averaged, problem.averaged + SCREENED, dtype=np.uint32)
    flown = montecarlo.run(parts, problem.dispersion, int(problem.seed), trials)
    ratios = [np.where(flown.finished, getattr(flown.metrics, r.metric) / r.limit, np.inf) for r in requirements]
    return trials, np.max(ratios, axis=0)


def _add_hardest(problem: Problem, requirements, gains: np.ndarray) -> Problem:
    if not requirements or not problem.dispersion.varies:
        return problem
    trials, ratio = _screen(problem, requirements, gains)
    known = set(np.asarray(problem.trials).tolist())
    order = [t for t in trials[np.argsort(-ratio)] if int(t) not in known][:HARDEST]
    return replace(problem, trials=jnp.concatenate([problem.trials, jnp.asarray(order, dtype=jnp.uint32)]))


def _holds(problem: Problem, requirements, gains: np.ndarray) -> bool:
    if not problem.dispersion.varies:
        return True
    return bool(np.all(_screen(problem, requirements, gains)[1] <= 1.0))


class _Best:
    """The best iterate so far of each start: admissible ones by their error, others by how far they are over."""

    def __init__(self, starts: int, gains: int):
        self.z = np.zeros((starts, gains))
        self.rms, self.over = np.full(starts, np.inf), np.full(starts, np.inf)

    def offer(self, z: np.ndarray, rms: np.ndarray, worst: np.ndarray, allowed: np.ndarray) -> None:
        """Keep what is better; arrays over starts. Admissible is what keeps nearly the whole margin from the limits."""
        over = np.maximum(worst.max(axis=1, initial=0.0) - (1.0 - 0.9 * MARGIN), 0.0)
        better = allowed & ((over < self.over) | ((over == self.over) & (rms < self.rms)))
        self.z[better], self.rms[better], self.over[better] = z[better], rms[better], over[better]

    def order(self) -> np.ndarray:
        """Starts from the best to the worst."""
        return np.lexsort((self.rms, self.over))


def _descend(problem: Problem, bounds: Bounds, z: np.ndarray, steps: int, report: Callable) -> Search:
    # slopes range over decades as limits are crossed: clipped, and with a short memory of their size
    rate = optax.cosine_decay_schedule(RATE, steps, LAST_RATE / RATE)
    optimiser = optax.chain(optax.clip(LARGEST_SLOPE), optax.adam(rate, b2=0.9))
    tightened = replace(problem, limits=problem.limits * (1.0 - MARGIN))
    starts = len(z)
    multipliers = np.zeros((starts, len(problem.metrics), problem.trials.size))
    state = optimiser.init(jnp.asarray(z))
    history: list[Step] = []
    best, alive = _Best(*z.shape), np.ones(starts, dtype=bool)
    for step in range(steps + 1):
        gains, f, c, f_slope, c_slope = _evaluate(tightened, bounds, z)
        rms, worst = np.exp(f), (c.max(axis=2, initial=-1.0) + 1.0) * (1.0 - MARGIN)
        alive &= np.isfinite(rms) & np.all(np.isfinite(f_slope), axis=1) & np.all(np.isfinite(c_slope), axis=(1, 2, 3))
        history.append(Step(gains, rms, worst))
        best.offer(z, rms, worst, alive)
        first = best.order()[0]
        report(step, steps, float(best.rms[first]), bool(best.over[first] == 0.0))
        if step == steps or not alive.any():
            break
        if step >= UPDATE_FROM * steps and step % UPDATE_EVERY == 0:
            multipliers = np.maximum(0.0, multipliers + PENALTY * np.clip(c, -LARGEST_UPDATE, LARGEST_UPDATE))
        force = np.maximum(0.0, multipliers + PENALTY * c)
        slope = f_slope + np.einsum("srt,srtg->sg", force, c_slope)
        updates, state = optimiser.update(jnp.where(alive[:, None], slope, 0.0), state)
        z = np.asarray(optax.apply_updates(z, updates))
    for start in best.order()[:POLISHED]:
        if np.isfinite(best.rms[start]):
            _polish(tightened, bounds, best, int(start))
    chosen = best.order()[0]
    gains, f, c, _, _ = _evaluate(tightened, bounds, best.z[chosen : chosen + 1])
    worst = (c[0].max(axis=1, initial=-1.0) + 1.0) * (1.0 - MARGIN)
    dropped = np.flatnonzero(~alive).tolist()
    unchecked = (np.nan, np.nan)
    return Search(gains[0], float(np.exp(f[0])), worst, history, dropped, 0, unchecked, np.asarray(problem.trials))


def _polish(problem: Problem, bounds: Bounds, best: _Best, start: int) -> None:
    """Follow the active limits to the optimum next to a start's best iterate; what is better is kept in `best`."""
    seen: dict[bytes, tuple] = {}

    def at(z: np.ndarray) -> tuple:
        key = z.tobytes()
        if key not in seen:
            seen[key] = _evaluate(problem, bounds, z[None])
            _, f, c, _, _ = seen[key]
            worst = (c.max(axis=2, initial=-1.0) + 1.0) * (1.0 - MARGIN)
            one = _Best(1, z.size)
            one.z, one.rms, one.over = (v[start : start + 1] for v in (best.z, best.rms, best.over))
            one.offer(z[None], np.exp(f), worst, np.isfinite(f))
        return seen[key]

    limits = {
        "type": "ineq",
        "fun": lambda z: -at(z)[2].reshape(-1),
        "jac": lambda z: -at(z)[4].reshape(-1, z.size),
    }
    minimize(
        lambda z: float(at(z)[1][0]),
        best.z[start].copy(),
        jac=lambda z: at(z)[3][0],
        method="SLSQP",
        bounds=[(-8.0, 8.0)] * best.z.shape[1],
        constraints=[limits] if problem.metrics else [],
        options={"maxiter": POLISH_STEPS, "ftol": 1e-7},
    )


@partial(jax.jit, static_argnames=("bounds", "devices"))
def _fly(problem: Problem, bounds: Bounds, z: jax.Array, devices: int) -> tuple:
    """Measures f and c of (points, gains) free reals, without derivatives, point after point."""

    def share(z: jax.Array) -> tuple:
        return jax.lax.map(lambda z: measure(problem, bounds.gains(z)), z)

    return montecarlo.spread(share, z, devices)


def _divisor(count: int) -> int:
    """The most local devices that share `count` things evenly."""
    return max(d for d in range(1, len(jax.local_devices()) + 1) if count % d == 0)


def _evaluate(problem: Problem, bounds: Bounds, z: np.ndarray) -> tuple[np.ndarray, ...]:
    """For each start: gains, f, c and their derivatives by z; starts shared out over as many devices as divide them."""
    devices = _divisor(len(z))
    # plain arrays in and out: what came back spread over the devices would be compiled for anew
    gains, f, c, f_slope, c_slope = map(np.asarray, _compiled(problem, bounds, z, devices))
    return gains, f, c, f_slope, c_slope


@partial(jax.jit, static_argnames=("bounds", "devices"))
def _compiled(problem: Problem, bounds: Bounds, z: jax.Array, devices: int) -> tuple:
    """Tangents forward, as one more batch axis; start after start, so that a branch on the time stays a branch."""

    def one(z: jax.Array) -> tuple:
        def twice(z: jax.Array) -> tuple:
            measured = measure(problem, bounds.gains(z))
            return measured, measured

        (f_slope, c_slope), (f, c) = jax.jacfwd(twice, has_aux=True)(z)
        return bounds.gains(z), f, c, f_slope, c_slope

    return montecarlo.spread(lambda z: jax.lax.map(one, z), z, devices)
