"""Evaluates tuning problems at many gains: compiled once for each problem's shape, shared over devices, journaled."""

from dataclasses import dataclass
from functools import partial

import jax
import numpy as np

from ptsmc_jax import montecarlo
from tuning.bounds import Bounds
from tuning.journal import Journal
from tuning.objective import Problem, ended, measure

FLOWN = 16  # points without slopes in one call of the compiled program


@dataclass(frozen=True)
class Measured:
    """F, constraints and the goal's logarithm at many points, see `objective.measure`; arrays over the points first."""

    f: np.ndarray  # (points,)
    c: np.ndarray  # (points, requirements, trials)
    value: np.ndarray  # (points,)

    @property
    def beyond(self) -> np.ndarray:
        """(points,) largest c over the trials that end; -1 without a requirement."""
        return ended(self.c).max(axis=(1, 2), initial=-1.0)

    def at(self, point: int) -> "Measured":
        """One of the points."""
        one = slice(point, point + 1)
        return Measured(self.f[one], self.c[one], self.value[one])


@dataclass(frozen=True)
class Sloped(Measured):
    """The same with derivatives by the free reals."""

    gains: np.ndarray  # (points, gains)
    f_slope: np.ndarray  # (points, gains)
    c_slope: np.ndarray  # (points, requirements, trials, gains)

    @property
    def finite(self) -> np.ndarray:
        """Which points have numbers throughout, (points,) bool."""
        arrays = (self.f, self.c, self.f_slope, self.c_slope)
        return np.all([np.isfinite(a).reshape(len(a), -1).all(axis=1) for a in arrays], axis=0)


class Evaluator:
    """Flies a problem's trials at free reals z, (points, gains), and counts them."""

    def __init__(self, bounds: Bounds, journal: Journal | None = None):
        self.bounds, self._journal = bounds, journal or Journal()
        self.rollouts, self.gradients = 0, 0  # trials flown without and with slopes

    def fly(self, problem: Problem, z: np.ndarray) -> Measured:
        """Without slopes."""
        self.rollouts += len(z) * problem.trials.size
        found = self._journal.get(_question(b"fly", problem, z), lambda: self._in_calls(_fly, problem, z, FLOWN))
        return Measured(**found)

    def slopes(self, problem: Problem, z: np.ndarray) -> Sloped:
        """With slopes."""
        self.gradients += len(z) * problem.trials.size
        # one point for each device a call: the program that flies many starts also polishes a single one
        most = len(jax.local_devices())
        found = self._journal.get(_question(b"slopes", problem, z), lambda: self._in_calls(_slopes, problem, z, most))
        return Sloped(**found)

    def _in_calls(self, compiled, problem: Problem, z: np.ndarray, size: int) -> dict[str, np.ndarray]:
        devices = max(d for d in range(1, len(jax.local_devices()) + 1) if size % d == 0)
        padded = np.resize(z, (-(-len(z) // size) * size, z.shape[1]))
        # plain arrays in and out: what came back spread over the devices would be compiled for anew
        calls = [
            {name: np.asarray(v) for name, v in compiled(problem, self.bounds, padded[k : k + size], devices).items()}
            for k in range(0, len(padded), size)
        ]
        return {name: np.concatenate([call[name] for call in calls])[: len(z)] for name in calls[0]}


def _question(kind: bytes, problem: Problem, z: np.ndarray) -> bytes:
    leaves, structure = jax.tree.flatten(problem)
    return b"|".join([kind, z.tobytes(), str(structure).encode(), *(np.asarray(leaf).tobytes() for leaf in leaves)])


@partial(jax.jit, static_argnames=("bounds", "devices"))
def _fly(problem: Problem, bounds: Bounds, z: jax.Array, devices: int) -> dict[str, jax.Array]:
    def one(z: jax.Array) -> dict[str, jax.Array]:
        f, c, value = measure(problem, bounds.gains(z))
        return {"f": f, "c": c, "value": value}

    return montecarlo.spread(lambda z: jax.lax.map(one, z), z, devices)


@partial(jax.jit, static_argnames=("bounds", "devices"))
def _slopes(problem: Problem, bounds: Bounds, z: jax.Array, devices: int) -> dict[str, jax.Array]:
    """Tangents forward, as one more batch axis; point after point, so that a branch on the time stays a branch."""

    def one(z: jax.Array) -> dict[str, jax.Array]:
        def twice(z: jax.Array) -> tuple:
            f, c, value = measure(problem, bounds.gains(z))
            return (f, c), {"f": f, "c": c, "value": value}

        (f_slope, c_slope), measured = jax.jacfwd(twice, has_aux=True)(z)
        return {**measured, "gains": bounds.gains(z), "f_slope": f_slope, "c_slope": c_slope}

    return montecarlo.spread(lambda z: jax.lax.map(one, z), z, devices)
