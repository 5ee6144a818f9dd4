"""Minimisation of any JAX function in a box, with constraints, by the local search of the tuner. See `minimise`.

The examples minimise a sphere, Rosenbrock's function inside a disc, and a custom loss:

>>> import jax.numpy as jnp
>>> from tuning.search import Settings, minimise
>>> def sphere(x):
...     return jnp.sum(x**2)
>>> found = minimise(sphere, None, [(-5.0, 4.0)] * 3)
>>> found.feasible, bool(found.value < 1e-9)
(True, True)

>>> def rosenbrock(x):
...     return (1.0 - x[0]) ** 2 + 100.0 * (x[1] - x[0] ** 2) ** 2
>>> def outside_the_disc(x):
...     return jnp.sum(x**2) - 1.0
>>> found = minimise(rosenbrock, outside_the_disc, [(-2.0, 2.0), (-2.0, 2.0)])
>>> found.x.round(3).tolist(), round(found.value, 3)
([0.786, 0.618], 0.046)

>>> t = jnp.linspace(0.0, 5.0, 40)
>>> measured = 2.0 * jnp.exp(-0.7 * t)
>>> def loss(x):
...     return jnp.mean((x[0] * jnp.exp(-x[1] * t) - measured) ** 2)
>>> found = minimise(loss, None, [(0.1, 10.0), (0.01, 5.0)], Settings(starts=3))
>>> found.x.round(4).tolist()
[2.0, 0.7]
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from tuning.search.evaluate import Measurement, MeasurementWithGradients
from tuning.search.local_search import Best, Start, search_locally
from tuning.search.starts import choose_far_apart, distances, penalise, sobol_points

Function = Callable[[Float[Array, " n"]], Float[Array, ""]]
Constraints = Callable[[Float[Array, " n"]], Float[Array, "..."]]


@dataclass(frozen=True)
class Settings:
    """Numbers of points, steps and the tolerance of `minimise`."""

    starts: int = 8  # number of starting points of local searches
    sampled: int = 64  # number of sampled candidates for starting points
    steps: int = 200  # largest number of evaluations with gradients from each starting point
    tolerance: float = 1e-12  # change of the objective at which a local search ends
    seed: int = 0  # seed of the sampled points


@dataclass(frozen=True)
class Local:
    """The best point of one local search."""

    x: np.ndarray  # (n,)
    value: float  # objective
    violation: float  # largest constraint minus the tolerance 1e-4, at least 0


@dataclass(frozen=True)
class Search:
    """The result of `minimise`."""

    locals: list[Local]  # results of the local searches, the best first
    evaluations: int  # number of evaluations of the objective without gradients
    gradients: int  # number of evaluations with gradients

    @property
    def x(self) -> np.ndarray:
        """Return the best point, (n,)."""
        return self.locals[0].x

    @property
    def value(self) -> float:
        """Return the objective at the best point."""
        return self.locals[0].value

    @property
    def feasible(self) -> bool:
        """Return whether no constraint is larger than 1e-4 at the best point."""
        return self.locals[0].violation == 0.0


def minimise(
    objective: Function,
    constraints: Constraints | None,
    bounds: Sequence[tuple[float, float]],
    settings: Settings = Settings(),
) -> Search:
    """Minimise a function in a box subject to constraints, by SQP from the most promising of many points.

    Sobol points of the box are ranked by objective and violation. Local searches, see `local_search.search_locally`,
    start from the best of these points that lie far apart. If a starting point is far outside the constraints, the
    local search first minimises the violation.

    Args:
        objective: differentiable function of x (n,) that returns one number. It returns NaN or infinity where it is
            undefined.
        constraints: another differentiable function of x (n,), with values of any shape. The search aims at values of
            at most 0 and accepts values up to 1e-4. Scale each constraint so that 0.1 is a large violation. None: no
            constraints.
        bounds: a pair (lower, upper) for each element of x.
        settings: numbers of points, steps and the tolerance.

    Returns:
        The best point of each local search.

    Raises:
        TypeError: The bounds are not a list of pairs.
        ValueError: A bound is not finite, a lower bound is not below its upper bound, or the objective does not return
            one number. It is also raised if the objective is finite at no sampled point, or no starting point has a
            finite gradient.
    """
    lower, upper = _read_bounds(bounds)
    if not np.all(np.isfinite(upper - lower) & (lower < upper)):
        raise ValueError(f"bounds are {list(bounds)}, but must be finite, each lower one below its upper one")

    def to_box(normalised: Any) -> Any:
        return lower + (upper - lower) * normalised

    def evaluate(normalised: Array) -> tuple[Array, Array]:
        x = to_box(normalised)
        f = jnp.asarray(objective(x), dtype=float)
        if f.shape:
            raise ValueError(f"the objective returns an array of shape {f.shape}, but must return one number")
        c = jnp.zeros(0) if constraints is None else jnp.ravel(constraints(x))
        return f, c[None][: min(1, c.size)]  # one row of c, or none

    differentiate = jax.jit(lambda normalised: (evaluate(normalised), jax.jacfwd(evaluate)(normalised)))

    measured = 0  # number of points with gradients

    def measure_with_gradients(normalised: np.ndarray) -> MeasurementWithGradients:
        """Return the values and gradients at one point, (1, n)."""
        nonlocal measured
        measured += 1
        (f, c), gradients = jax.tree.map(lambda v: np.asarray(v)[None], differentiate(normalised[0]))
        return MeasurementWithGradients(normalised, f, c, np.zeros_like(f), *gradients)

    points = sobol_points(lower.size, settings.sampled, np.random.default_rng(settings.seed))
    f, c = map(np.asarray, jax.jit(jax.vmap(evaluate))(points))
    finite = np.flatnonzero(np.isfinite(f))
    if not finite.size:
        raise ValueError(f"the objective is finite at none of {settings.sampled} points of the box")
    scale = max(float(np.median(f[finite]) - f[finite].min()), np.finfo(float).tiny)
    largest_c = Measurement(points, f, c, np.zeros_like(f)).largest_c[finite]
    merits = penalise((f[finite] - f[finite].min()) / scale, largest_c, 1.0)
    order = finite[np.argsort(merits, kind="stable")].tolist()
    starts = [Start(points[k]) for k in choose_far_apart(order, distances(points), settings.starts)]
    bests = [Best(start.normalised, 1, 0.0) for start in starts]
    for best, start in zip(bests, starts, strict=True):
        search_locally(
            measure_with_gradients, best, start, settings.steps, tolerance=settings.tolerance, steepest=np.inf
        )
    successful = sorted((best for best in bests if np.isfinite(best.f)), key=lambda best: best.rank)
    if not successful:  # no starting point has a finite gradient
        raise ValueError("the objective has a finite gradient at no starting point")
    results = [Local(to_box(best.normalised), best.f, best.violation) for best in successful]
    return Search(results, settings.sampled, measured)


def _read_bounds(bounds: object) -> tuple[np.ndarray, np.ndarray]:
    """Return the lower and the upper bounds, (n,) each; raise TypeError if `bounds` is not a list of pairs."""
    try:
        box = np.asarray(bounds, dtype=float)
    except (TypeError, ValueError):
        box = np.zeros(0)
    if box.shape[1:] != (2,) or not box.size:
        raise TypeError(f"bounds are {bounds!r}, but must be a list with a pair (lower, upper) for each element of x")
    return box[:, 0], box[:, 1]
