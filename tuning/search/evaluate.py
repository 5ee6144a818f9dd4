"""Evaluates tuning problems at many gains: compiled once for each problem's shape, shared over devices, journaled."""

from dataclasses import dataclass, fields, replace
from typing import TypeVar

import jax
import numpy as np

from ptsmc_jax import programs
from ptsmc_jax.campaigns import montecarlo
from tuning.search import margin_rows
from tuning.search.journal import Journal
from tuning.search.objective import Problem, ended, measure
from tuning.search.shares import Bounds

FLOWN = 16  # points without slopes in one call of the compiled program


M = TypeVar("M", bound="Measured")


@dataclass(frozen=True)
class Measured:
    """F, constraints and the goal's logarithm at many points, see `objective.measure`; arrays over the points first."""

    gains: np.ndarray  # (points, gains)
    f: np.ndarray  # (points,)
    c: np.ndarray  # (points, rows, trials), see `Problem.rows`
    value: np.ndarray  # (points,)

    @property
    def beyond(self) -> np.ndarray:
        """(points,) largest c over the trials that end; -1 without a requirement."""
        return ended(self.c).max(axis=(1, 2), initial=-1.0)

    def at(self: M, point: int) -> M:
        """One of the points."""
        return replace(self, **{f.name: getattr(self, f.name)[point : point + 1] for f in fields(self)})


@dataclass(frozen=True)
class Sloped(Measured):
    """The same with derivatives by the shares of the bounds' intervals."""

    f_slope: np.ndarray  # (points, gains)
    c_slope: np.ndarray  # (points, rows, trials, gains)

    @property
    def finite(self) -> np.ndarray:
        """Which points have numbers throughout, (points,) bool."""
        arrays = (self.f, self.c, self.f_slope, self.c_slope)
        return np.all([np.isfinite(a).reshape(len(a), -1).all(axis=1) for a in arrays], axis=0)


class Evaluator:
    """Flies a problem's trials at shares of the bounds' intervals, (points, gains), and counts them."""

    def __init__(self, bounds: Bounds, journal: Journal | None = None):
        self.bounds, self._journal = bounds, journal or Journal()
        self.rollouts, self.gradients = 0, 0  # trials flown without and with slopes

    def fly(self, problem: Problem, share: np.ndarray) -> Measured:
        """Without slopes."""
        self.rollouts += len(share) * problem.trials.size
        asked = _question(b"fly", problem, share)
        return Measured(**self._journal.get(asked, lambda: self._measured(_fly, problem, share, FLOWN)))

    def slopes(self, problem: Problem, share: np.ndarray) -> Sloped:
        """With slopes."""
        self.gradients += len(share) * problem.trials.size
        # one point for each device a call
        most = len(jax.local_devices())
        asked = _question(b"slopes", problem, share)
        return Sloped(**self._journal.get(asked, lambda: self._measured(_slopes, problem, share, most)))

    def prepare(self, few: Problem, whole: Problem) -> None:
        """Begin to compile what a search needs after its first steps, in that order, beside what is being done."""
        devices, gains = len(jax.local_devices()), len(self.bounds.names)
        for compiled, problem, size in ((_fly, few, FLOWN), (_slopes, whole, devices), (_fly, whole, FLOWN)):
            shared = max(d for d in range(1, devices + 1) if size % d == 0)
            compiled.prepare(replace(problem, margins=None), self.bounds, np.zeros((size, gains)), shared)

    def _measured(self, compiled, problem: Problem, share: np.ndarray, size: int) -> dict[str, np.ndarray]:
        found = self._in_calls(compiled, replace(problem, margins=None), share, size)
        if problem.margins is None:
            return found
        # slopes or not, by the one program: another takes longer to compile than most searches would save by it
        each = [margin_rows.sloped(problem.margins, self.bounds, one) for one in share]
        of_loop = {name: np.stack([np.asarray(one[name]) for one in each]) for name in each[0]}
        wide = max(found["c"].shape[2], of_loop["c"].shape[2])

        def padded(c: np.ndarray, kept: float) -> np.ndarray:  # every row as long as the longest
            widths = [(0, wide - c.shape[2] if k == 2 else 0) for k in range(c.ndim)]
            return np.pad(c, widths, constant_values=kept)

        both = {name: kept for name, kept in (("c", -1.0), ("c_slope", 0.0)) if name in found}
        return found | {
            name: np.concatenate([padded(found[name], kept), padded(of_loop[name], kept)], axis=1)
            for name, kept in both.items()
        }

    def _in_calls(self, compiled, problem: Problem, share: np.ndarray, size: int) -> dict[str, np.ndarray]:
        devices = max(d for d in range(1, len(jax.local_devices()) + 1) if size % d == 0)
        padded = np.resize(share, (-(-len(share) // size) * size, share.shape[1]))
        # plain arrays in and out: what came back spread over the devices would be compiled for anew
        calls = [
            {name: np.asarray(v) for name, v in compiled(problem, self.bounds, padded[k : k + size], devices).items()}
            for k in range(0, len(padded), size)
        ]
        return {name: np.concatenate([call[name] for call in calls])[: len(share)] for name in calls[0]}


def _question(kind: bytes, problem: Problem, share: np.ndarray) -> bytes:
    leaves, structure = jax.tree.flatten(problem)
    return b"|".join([kind, share.tobytes(), str(structure).encode(), *(np.asarray(leaf).tobytes() for leaf in leaves)])


@programs.jit(static_argnames=("bounds", "devices"))
def _fly(problem: Problem, bounds: Bounds, share: jax.Array, devices: int) -> dict[str, jax.Array]:
    def one(share: jax.Array) -> dict[str, jax.Array]:
        gains = bounds.gains(share)
        f, c, value = measure(problem, gains)
        return {"gains": gains, "f": f, "c": c, "value": value}

    return montecarlo.spread(lambda share: jax.lax.map(one, share), share, devices)


@programs.jit(static_argnames=("bounds", "devices"))
def _slopes(problem: Problem, bounds: Bounds, share: jax.Array, devices: int) -> dict[str, jax.Array]:
    """Tangents forward, as one more batch axis; point after point, so that a branch on the time stays a branch."""

    def one(share: jax.Array) -> dict[str, jax.Array]:
        def twice(share: jax.Array) -> tuple:
            gains = bounds.gains(share)
            f, c, value = measure(problem, gains)
            return (f, c), {"gains": gains, "f": f, "c": c, "value": value}

        (f_slope, c_slope), measured = jax.jacfwd(twice, has_aux=True)(share)
        return {**measured, "f_slope": f_slope, "c_slope": c_slope}

    return montecarlo.spread(lambda share: jax.lax.map(one, share), share, devices)
