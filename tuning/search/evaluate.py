"""Evaluation of a tuning problem at many points, with a journal. `simulations` simulates and `objective` judges.

`Evaluator` does the evaluation. Its results are `Measurement` and, with gradients, `MeasurementWithGradients`.
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
from tuning.search import margin_rows, simulations
from tuning.search.journal import Journal
from tuning.search.normalisation import Bounds, Scale
from tuning.search.objective import FAILED, LEAST, LIMITS, Problem, Rules, ignore_failures, judge, needed_metrics

POINTS_PER_CALL = 16  # number of points in one call of the compiled programs below, which do not simulate
M = TypeVar("M", bound="Measurement")


@dataclass(frozen=True)
class Measurement:
    """F, constraints c and logarithm of the objective at many points, see `objective.judge`."""

    gains: np.ndarray  # (points, gains)
    f: np.ndarray  # (points,)
    c: np.ndarray  # (points, rows, trials), see `Problem.rows`
    value: np.ndarray  # (points,) logarithm of the objective

    @property
    def objective(self) -> np.ndarray:
        """Objective over the completed trials, (points,). It is NaN if no trial completes."""
        return np.where(self.value < np.log(FAILED / 2.0), np.exp(self.value), np.nan)

    @property
    def largest_c(self) -> np.ndarray:
        """Largest c over the completed trials, (points,). It is -1 without requirements."""
        return ignore_failures(self.c).max(axis=(1, 2), initial=-1.0)

    def at(self: M, point: int) -> M:
        """Return the measurement at one of the points."""
        return replace(self, **{f.name: getattr(self, f.name)[point : point + 1] for f in fields(self)})


@dataclass(frozen=True)
class MeasurementWithGradients(Measurement):
    """Measurement with derivatives of F and c with respect to normalised gains."""

    f_gradient: np.ndarray  # (points, gains)
    c_gradient: np.ndarray  # (points, rows, trials, gains)

    @property
    def finite(self) -> np.ndarray:
        """Whether all numbers of each point are finite, (points,) bool."""
        arrays = (self.f, self.c, self.f_gradient, self.c_gradient)
        return np.all([np.isfinite(a).reshape(len(a), -1).all(axis=1) for a in arrays], axis=0)


class Evaluator:
    """Measures problems at points, (points, gains) normalised gains, and counts the rollouts."""

    def __init__(self, bounds: Bounds, journal: Journal | None = None):
        self.bounds, self._journal = bounds, journal or Journal()
        self.rollouts, self.gradients = 0, 0  # number of rollouts without and with gradients
        # measurements with gradients by point, of the problem that was measured last
        self._known_problem, self._known = b"", dict[bytes, MeasurementWithGradients]()

    def continue_counts(self, other: "Evaluator") -> None:
        """Continue the counts of an evaluator of the same scenario with other bounds."""
        self.rollouts, self.gradients = other.rollouts, other.gradients

    def measure(self, problem: Problem, normalised: np.ndarray) -> Measurement:
        """Return F, constraints and objective at points, (points, gains) normalised gains."""
        self.rollouts += len(normalised) * _count_trials(problem)
        return Measurement(**self._answer(problem, normalised, with_gradients=False))

    def measure_with_gradients(self, problem: Problem, normalised: np.ndarray) -> MeasurementWithGradients:
        """Return F, constraints and objective with gradients at points of normalised gains, (points, gains).

        Points of the problem that was measured last are not simulated again.
        """
        encoded, keys = _encode(problem), [point.tobytes() for point in normalised]
        if encoded != self._known_problem:
            self._known_problem, self._known = encoded, {}
        new = [k for k, key in enumerate(keys) if key not in self._known]
        if new:
            self.gradients += len(new) * _count_trials(problem)
            measured = MeasurementWithGradients(**self._answer(problem, normalised[new], with_gradients=True))
            self._known |= {keys[k]: measured.at(place) for place, k in enumerate(new)}
        known = [vars(self._known[key]) for key in keys]
        return MeasurementWithGradients(**{name: np.concatenate([one[name] for one in known]) for name in known[0]})

    def _answer(self, problem: Problem, normalised: np.ndarray, *, with_gradients: bool) -> dict[str, np.ndarray]:
        """Return the fields of a measurement (points, ..), by name, from the journal or from new simulations."""

        def compute() -> dict[str, np.ndarray]:
            values = self._simulate_and_judge(problem, normalised, with_gradients)
            return values if problem.margins is None else self._add_margins(values, problem, normalised)

        kind = b"gradients" if with_gradients else b"values"
        return self._journal.get(b"|".join([kind, normalised.tobytes(), _encode(problem)]), compute)

    def _simulate_and_judge(
        self, problem: Problem, normalised: np.ndarray, with_gradients: bool
    ) -> dict[str, np.ndarray]:
        """Return the fields of a measurement (points, ..), by name, without the rows of the margins."""
        scaled = _apply_in_calls(partial(_gains_with_derivatives, scale=self.bounds.scale), normalised)
        gains, directions, metrics = scaled["gains"], scaled["along"], needed_metrics(problem)
        if with_gradients:
            differentiated = simulations.simulate_with_derivatives(problem.batch, gains, directions, metrics)
            judged = _apply_in_calls(partial(_judge_gradients, problem.rules), gains, directions, *differentiated)
        else:
            simulated = simulations.simulate(problem.batch, gains)
            values_by_trial = np.stack([getattr(simulated.metrics, name) for name in metrics], axis=-1)
            status = np.asarray(simulated.status)
            judged = _apply_in_calls(partial(_judge_points, problem.rules), gains, values_by_trial, status)
        return {"gains": gains, **judged}

    def _add_margins(
        self, values: dict[str, np.ndarray], problem: Problem, normalised: np.ndarray
    ) -> dict[str, np.ndarray]:
        """Return a measurement (by field) with the stability margins as further rows of its constraints c."""
        assert problem.margins is not None
        # margins always come with gradients: the compilation of a second program would take longer than it saves
        of_margins = margin_rows.constraints_at_points(problem.margins, self.bounds.scale, normalised)
        longest = max(values["c"].shape[2], of_margins["c"].shape[2])

        def pad(c: np.ndarray, fill: float) -> np.ndarray:  # all rows get the length of the longest row
            widths = [(0, longest - c.shape[2] if k == 2 else 0) for k in range(c.ndim)]
            return np.pad(c, widths, constant_values=fill)

        for name, fill in (("c", -1.0), ("c_gradient", 0.0)):
            if name in values:
                values[name] = np.concatenate([pad(values[name], fill), pad(of_margins[name], fill)], axis=1)
        if problem.objective == LIMITS:  # F is ln of the largest metric / limit, including the rows of the margins
            c = ignore_failures(values["c"]).reshape(len(values["c"]), -1)
            nearest, points = c.argmax(axis=1), np.arange(len(c))
            largest = np.maximum(1.0 + c[points, nearest], LEAST)
            values["f"] = values["value"] = np.log(largest)
            if "c_gradient" in values:
                values["f_gradient"] = values["c_gradient"].reshape(*c.shape, -1)[points, nearest] / largest[:, None]
        return values


def _apply_in_calls(program: Callable[..., dict[str, jax.Array]], *arrays: np.ndarray) -> dict[str, np.ndarray]:
    """Apply a program for `POINTS_PER_CALL` points to arrays with any number of points on the first axis.

    Returns:
        The arrays of the program (points, ..), by name.
    """
    count = len(arrays[0])
    padded = [np.resize(v, (-(-count // POINTS_PER_CALL) * POINTS_PER_CALL, *v.shape[1:])) for v in arrays]
    calls = [
        {name: np.asarray(v) for name, v in program(*(v[k : k + POINTS_PER_CALL] for v in padded)).items()}
        for k in range(0, len(padded[0]), POINTS_PER_CALL)
    ]
    return {name: np.concatenate([call[name] for call in calls])[:count] for name in calls[0]}


def _count_trials(problem: Problem) -> int:
    """Return the number of trials that are simulated at a point: repeated trials count once."""
    return len(problem.batch.distinct()[0].trials)


_ADDRESS = re.compile("0x[0-9a-f]+")  # address of a custom function, different in each process


def _encode(problem: Problem) -> bytes:
    """Return bytes that are equal for equal problems, also in another process."""
    leaves, structure = jax.tree.flatten(problem)
    structure_text = _ADDRESS.sub("", str(structure)).encode()
    return b"|".join([structure_text, *(np.asarray(leaf).tobytes() for leaf in leaves)])


@programs.jit(compiler_options=programs.FAST_COMPILE)
def _gains_with_derivatives(normalised: jax.Array, scale: Scale) -> dict[str, jax.Array]:
    """Return "gains" (points, gains) in their units, and "along", the direction of the gains for each normalised gain.

    "along" has the shape (points, normalised gains, gains).
    """
    derivatives = jax.vmap(jax.jacfwd(scale.gains))(normalised)
    return {"gains": jax.vmap(scale.gains)(normalised), "along": jnp.swapaxes(derivatives, 1, 2)}


@programs.jit(compiler_options=programs.FAST_COMPILE)
def _judge_points(rules: Rules, gains: jax.Array, metrics: jax.Array, status: jax.Array) -> dict[str, jax.Array]:
    """Judge points by the rules; all other arguments have a leading axis of points.

    Returns:
        By name: "f", which is minimised, (points,); constraints "c", (points, rows, trials); "value", the logarithm of
        the objective, (points,).
    """
    return dict(zip(("f", "c", "value"), jax.vmap(partial(judge, rules))(gains, metrics, status), strict=True))


@programs.jit(compiler_options=programs.FAST_COMPILE)
def _judge_gradients(
    rules: Rules, gains: jax.Array, directions: jax.Array, metrics: jax.Array, status: jax.Array, derivatives: jax.Array
) -> dict[str, jax.Array]:
    """Judge points with gradients by the chain rule; all arguments but `rules` have a leading axis of points.

    Returns:
        The arrays of `_judge_points`, and the gradients "f_gradient" and "c_gradient" with a last axis of gains.
    """

    def judge_point(
        gains: jax.Array, directions: jax.Array, metrics: jax.Array, status: jax.Array, derivatives: jax.Array
    ) -> dict:
        def f_and_c(gains: jax.Array, metrics: jax.Array) -> tuple:
            f, c, value = judge(rules, gains, metrics, status)
            return (f, c), value

        (f, c), value = f_and_c(gains, metrics)
        f_gradient, c_gradient = jax.vmap(
            lambda direction, change: jax.jvp(f_and_c, (gains, metrics), (direction, change), has_aux=True)[1],
            in_axes=(0, 1),
            out_axes=-1,
        )(directions, derivatives)
        return {"f": f, "c": c, "value": value, "f_gradient": f_gradient, "c_gradient": c_gradient}

    return jax.vmap(judge_point)(gains, directions, metrics, status, derivatives)
