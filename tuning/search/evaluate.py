"""Evaluation of a tuning problem at many points: simulation by `flights`, judgement by `objective`, and a journal.

`Evaluator` does the evaluation. Its results are `Measured` and, with gradients, `Sloped`.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from ptsmc_jax import programs
from tuning.search import flights, margin_rows
from tuning.search.journal import Journal
from tuning.search.objective import FAILED, LEAST, LIMITS, Problem, Rules, ended, judge, watched
from tuning.search.shares import Bounds, Scale

TOGETHER = 16  # points of one call of the small compiled programs
M = TypeVar("M", bound="Measured")


@dataclass(frozen=True)
class Measured:
    """F, constraints c and logarithm of the objective at many points, see `objective.judge`."""

    gains: np.ndarray  # (points, gains)
    f: np.ndarray  # (points,)
    c: np.ndarray  # (points, rows, trials), see `Problem.rows`
    value: np.ndarray  # (points,) logarithm of the objective

    @property
    def goal(self) -> np.ndarray:
        """Objective over the completed trials, (points,). It is NaN if no trial completes."""
        return np.where(self.value < np.log(FAILED / 2.0), np.exp(self.value), np.nan)

    @property
    def beyond(self) -> np.ndarray:
        """Largest c over the completed trials, (points,). It is -1 without requirements."""
        return ended(self.c).max(axis=(1, 2), initial=-1.0)

    @property
    def nearest(self) -> np.ndarray:
        """Index of the row with the largest c over the completed trials, (points,). It is 0 without requirements."""
        largest = ended(self.c).max(axis=2, initial=-1.0)
        return largest.argmax(axis=1) if largest.shape[1] else np.zeros(len(largest), int)

    def at(self: M, point: int) -> M:
        """Return the measurement at one of the points."""
        return replace(self, **{f.name: getattr(self, f.name)[point : point + 1] for f in fields(self)})


@dataclass(frozen=True)
class Sloped(Measured):
    """Measurement with derivatives of F and c with respect to normalised gains."""

    f_slope: np.ndarray  # (points, gains)
    c_slope: np.ndarray  # (points, rows, trials, gains)

    @property
    def finite(self) -> np.ndarray:
        """Whether all numbers of each point are finite, (points,) bool."""
        arrays = (self.f, self.c, self.f_slope, self.c_slope)
        return np.all([np.isfinite(a).reshape(len(a), -1).all(axis=1) for a in arrays], axis=0)


class Evaluator:
    """Measures problems at points, (points, gains) normalised gains, and counts the rollouts."""

    def __init__(self, bounds: Bounds, journal: Journal | None = None):
        self.bounds, self._journal = bounds, journal or Journal()
        self.rollouts, self.gradients = 0, 0  # number of rollouts without and with gradients

    def count_on(self, other: "Evaluator") -> None:
        """Continue the counts of an evaluator of the same scenario with other bounds."""
        self.rollouts, self.gradients = other.rollouts, other.gradients

    def fly(self, problem: Problem, share: np.ndarray) -> Measured:
        """Return F, constraints and objective at points, (points, gains) normalised gains."""
        self.rollouts += len(share) * problem.trials.size
        asked = _question(b"fly", problem, share)
        return Measured(**self._journal.get(asked, lambda: self._measured(self._fly, problem, share)))

    def slopes(self, problem: Problem, share: np.ndarray) -> Sloped:
        """Return F, constraints and objective with gradients at points, (points, gains) normalised gains."""
        self.gradients += len(share) * problem.trials.size
        asked = _question(b"slopes", problem, share)
        return Sloped(**self._journal.get(asked, lambda: self._measured(self._slopes, problem, share)))

    def _measured(
        self, way: Callable[[Problem, np.ndarray], dict[str, np.ndarray]], problem: Problem, share: np.ndarray
    ) -> dict[str, np.ndarray]:
        flown = way(problem, share)
        if problem.margins is None:
            return flown
        # margins always come with gradients: the compilation of a second program would take longer than it saves
        of_loop = margin_rows.of_points(problem.margins, self.bounds.scale, share)
        wide = max(flown["c"].shape[2], of_loop["c"].shape[2])

        def padded(c: np.ndarray, fill: float) -> np.ndarray:  # every row as long as the longest
            widths = [(0, wide - c.shape[2] if k == 2 else 0) for k in range(c.ndim)]
            return np.pad(c, widths, constant_values=fill)

        for name, fill in (("c", -1.0), ("c_slope", 0.0)):
            if name in flown:
                flown[name] = np.concatenate([padded(flown[name], fill), padded(of_loop[name], fill)], axis=1)
        return _with_margins(flown) if problem.goal == LIMITS else flown

    def _fly(self, problem: Problem, share: np.ndarray) -> dict[str, np.ndarray]:
        gains = self._gains(share)[0]
        flown = flights.fly(problem.fleet, gains)
        metrics = np.stack([getattr(flown.metrics, name) for name in watched(problem)], axis=-1)
        return {"gains": gains, **_in_calls(partial(_judged, problem.rules), gains, metrics, np.asarray(flown.status))}

    def _slopes(self, problem: Problem, share: np.ndarray) -> dict[str, np.ndarray]:
        gains, along = self._gains(share)
        flown = flights.sloped(problem.fleet, gains, along, watched(problem))
        return {"gains": gains, **_in_calls(partial(_judged_slopes, problem.rules), gains, along, *flown)}

    def _gains(self, share: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the gains, (points, gains), and their derivatives by the normalised gains, (points, gains, gains)."""
        gains = _in_calls(partial(_gains, scale=self.bounds.scale), share)
        return gains["gains"], gains["along"]


def _with_margins(flown: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Set F to ln of the largest metric / limit, including the rows of the margins, and update its gradient."""
    c = ended(flown["c"]).reshape(len(flown["c"]), -1)
    at, points = c.argmax(axis=1), np.arange(len(c))
    largest = np.maximum(1.0 + c[points, at], LEAST)
    flown["f"] = flown["value"] = np.log(largest)
    if "c_slope" in flown:
        flown["f_slope"] = flown["c_slope"].reshape(*c.shape, -1)[points, at] / largest[:, None]
    return flown


def _in_calls(program: Callable[..., dict[str, jax.Array]], *arrays: np.ndarray) -> dict[str, np.ndarray]:
    """Apply a program for `TOGETHER` points to arrays with any number of points on the first axis."""
    count = len(arrays[0])
    padded = [np.resize(v, (-(-count // TOGETHER) * TOGETHER, *v.shape[1:])) for v in arrays]
    calls = [
        {name: np.asarray(v) for name, v in program(*(v[k : k + TOGETHER] for v in padded)).items()}
        for k in range(0, len(padded[0]), TOGETHER)
    ]
    return {name: np.concatenate([call[name] for call in calls])[:count] for name in calls[0]}


_ADDRESS = re.compile("0x[0-9a-f]+")  # address of a custom function, different in each process


def _question(kind: bytes, problem: Problem, share: np.ndarray) -> bytes:
    leaves, structure = jax.tree.flatten(problem)
    said = _ADDRESS.sub("", str(structure)).encode()
    return b"|".join([kind, share.tobytes(), said, *(np.asarray(leaf).tobytes() for leaf in leaves)])


@programs.jit(compiler_options=programs.QUICKLY)
def _gains(share: jax.Array, scale: Scale) -> dict[str, jax.Array]:
    slopes = jax.vmap(jax.jacfwd(scale.gains))(share)
    return {"gains": jax.vmap(scale.gains)(share), "along": jnp.swapaxes(slopes, 1, 2)}


@programs.jit(compiler_options=programs.QUICKLY)
def _judged(rules: Rules, gains: jax.Array, metrics: jax.Array, status: jax.Array) -> dict[str, jax.Array]:
    return dict(zip(("f", "c", "value"), jax.vmap(partial(judge, rules))(gains, metrics, status), strict=True))


@programs.jit(compiler_options=programs.QUICKLY)
def _judged_slopes(
    rules: Rules, gains: jax.Array, along: jax.Array, metrics: jax.Array, status: jax.Array, slopes: jax.Array
) -> dict[str, jax.Array]:
    """Return F, constraints and objective with gradients, by the chain rule from gradients of gains and metrics."""

    def one(gains: jax.Array, along: jax.Array, metrics: jax.Array, status: jax.Array, slopes: jax.Array) -> dict:
        def of(gains: jax.Array, metrics: jax.Array) -> tuple:
            f, c, value = judge(rules, gains, metrics, status)
            return (f, c), value

        (f, c), value = of(gains, metrics)
        f_slope, c_slope = jax.vmap(
            lambda by, slope: jax.jvp(of, (gains, metrics), (by, slope), has_aux=True)[1], in_axes=(0, 1), out_axes=-1
        )(along, slopes)
        return {"f": f, "c": c, "value": value, "f_slope": f_slope, "c_slope": c_slope}

    return jax.vmap(one)(gains, along, metrics, status, slopes)
