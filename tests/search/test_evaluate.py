"""Tests of the evaluation of a problem, with rows of simulated trials and rows of margins."""

import math
from types import SimpleNamespace
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

import ptsmc_jax as ptsmc
from ptsmc_jax import scenario
from ptsmc_jax.simulation import rollout
from tuning.search import evaluate
from tuning.search.evaluate import Evaluator, Measurement, MeasurementWithGradients
from tuning.search.local_search import Best
from tuning.search.local_searches import LocalSearches
from tuning.search.normalisation import Bounds
from tuning.search.objective import FAILED, Rules, judge, problem


def with_margins(monkeypatch, simulated, of_loop, objective):
    """Return the measurement with gradients at two points.

    simulated, of_loop: {"c": (2, rows, trials), "c_gradient": (2, rows, trials, gains)} of the metrics and of the
    margins. objective: its name.
    """
    monkeypatch.setattr(evaluate.margin_rows, "constraints_at_points", lambda margins, scale, normalised: of_loop)
    some: Any = SimpleNamespace(margins=object(), objective=objective)
    evaluator, at = Evaluator(Bounds(("eta", "delta"), (2.0, 0.1), (3.0, 1.0))), np.array([[0.0, 0.0], [1.0, 1.0]])
    rest = {"gains": at, "f": np.zeros(2), "value": np.zeros(2), "f_gradient": np.zeros((2, 2))}
    return MeasurementWithGradients(**evaluator._add_margins({**rest, **simulated}, some, at))


@pytest.mark.parametrize(("trials", "loops"), [(2, 5), (5, 2)])
def test_rows_of_trials_and_of_margins_are_padded_without_changing_the_result(monkeypatch, trials, loops):
    """Two limits have entries for each trial, and one margin has entries for each loop. Padding is c = -1.

    The largest c is therefore a measured one, and the padding has a gradient of zero.
    """
    rng = np.random.default_rng(0)
    simulated = {"c": rng.uniform(-0.9, -0.5, (2, 2, trials)), "c_gradient": rng.normal(size=(2, 2, trials, 2))}
    of_loop = {"c": rng.uniform(-0.9, -0.5, (2, 1, loops)), "c_gradient": rng.normal(size=(2, 1, loops, 2))}
    found = with_margins(monkeypatch, simulated, of_loop, "window_error")
    assert found.c.shape == (2, 3, 5)
    for name, filled in (("c", -1.0), ("c_gradient", 0.0)):
        seen = getattr(found, name)
        for rows, expected, size in ((seen[:, :2], simulated[name], trials), (seen[:, 2:], of_loop[name], loops)):
            np.testing.assert_array_equal(rows[:, :, :size], expected)
            assert np.all(rows[:, :, size:] == filled)
    largest = np.maximum(simulated["c"].max(axis=(1, 2)), of_loop["c"].max(axis=(1, 2)))
    np.testing.assert_array_equal(found.largest_c, largest)


def test_the_torque_term_of_f_covers_the_averaged_trials_only():
    """Trials that joined for a limit are hard ones and count only in the constraints."""
    none = np.zeros((0, 3), dtype=bool)
    rules = Rules(limits=np.zeros(0), quantile_sample=none, counted=none, averaged=2, names=("eta",), may_break=(),
                  torque_weight=0.3)  # fmt: skip
    metrics, status = jnp.asarray([[3.0, 0.3], [4.0, 0.4], [40.0, 9.0]]), jnp.zeros(3, jnp.int32)
    f, c, value = judge(rules, jnp.asarray([3.0]), metrics, status)
    assert float(value) == pytest.approx(math.log(math.sqrt(12.5)), rel=1e-12)
    assert float(f) == pytest.approx(float(value) + 0.3 * math.log(math.sqrt(0.125)), rel=1e-12)
    assert c.shape == (0, 3)


@pytest.mark.parametrize(
    ("statistic", "tail", "expected"),
    [
        ("rms", None, lambda v: np.sqrt(np.mean(v**2))),
        ("mean", None, np.mean),
        ("rms", 1, np.max),
        ("quantile", 3, lambda v: np.quantile(v, 0.75, method="inverted_cdf")),  # the third worst of eight
        ("rms", 3, lambda v: np.sqrt(np.mean(np.sort(v)[-3:] ** 2))),
    ],
    ids=["rms", "mean", "worst", "quantile", "cvar"],
)
def test_f_is_the_logarithm_of_the_statistic_of_the_averaged_trials(statistic, tail, expected):
    """The last of nine trials joined for a limit, so it does not count. NumPy computes the expected values."""
    values = np.random.default_rng(5).lognormal(size=9)
    values[8] = 1e3
    none = np.zeros((0, 9), dtype=bool)
    rules = Rules(limits=np.zeros(0), quantile_sample=none, counted=none, averaged=8, names=("eta",), may_break=(),
                  tail=tail, statistic=statistic)  # fmt: skip
    metrics = jnp.asarray(np.stack([values, np.ones(9)], axis=1))
    f, _, value = judge(rules, jnp.asarray([3.0]), metrics, jnp.zeros(9, jnp.int32))
    np.testing.assert_allclose(np.exp([f, value]), expected(values[:8]), rtol=1e-12)


def test_objective_limits_is_the_largest_ratio_of_a_metric_to_its_limit():
    """A trial that fails does not count in F, and its c stays that of a failure."""
    limits, status = np.array([0.5, 8.0]), np.array([rollout.OK, rollout.OK, rollout.DIVERGED])
    limited = np.array([[0.3, 5.0], [0.4, 7.0], [2.0, 90.0]])
    rules = Rules(
        limits=limits,
        quantile_sample=np.zeros((2, 3), bool),
        counted=np.ones((2, 3), bool),
        averaged=3,
        names=("eta",),
        may_break=(None, None),
        objective="limits",
    )
    metrics = jnp.asarray(np.concatenate([np.ones((3, 2)), limited], axis=1))
    f, c, value = judge(rules, jnp.asarray([3.0]), metrics, jnp.asarray(status, jnp.int32))
    np.testing.assert_allclose(np.exp([f, value]), np.max(limited[:2] / limits), rtol=1e-12)
    np.testing.assert_allclose(c[:, :2], (limited[:2] / limits).T - 1.0, rtol=1e-12)
    assert np.all(c[:, 2] == FAILED - 1.0)


def test_objective_limits_includes_the_margins(monkeypatch):
    """F and its gradient follow the largest row: a metric's at the first point, a margin's at the second point."""
    simulated = {"c": np.array([[[0.3, -0.2]], [[-0.5, -0.4]]]), "c_gradient": np.arange(8.0).reshape(2, 1, 2, 2)}
    of_loop = {"c": np.array([[[-0.1]], [[0.6]]]), "c_gradient": 10.0 + np.arange(4.0).reshape(2, 1, 1, 2)}
    found = with_margins(monkeypatch, simulated, of_loop, "limits")
    np.testing.assert_allclose(np.exp(found.f), [1.3, 1.6], rtol=1e-12)
    np.testing.assert_array_equal(found.value, found.f)
    np.testing.assert_allclose(found.f_gradient, [[0.0, 1.0 / 1.3], [12.0 / 1.6, 13.0 / 1.6]], rtol=1e-12)


def test_the_objective_is_nan_if_no_trial_completes():
    """F then contains the penalty `FAILED`, which must not appear as an error of 1e9 in histories and progress."""
    shape = {"limits": np.array([0.5]), "quantile_sample": np.zeros((1, 2), bool), "counted": np.ones((1, 2), bool)}
    rules = Rules(averaged=2, names=("eta",), may_break=(None,), **shape)
    status = jnp.asarray([[rollout.OK, rollout.DIVERGED], [rollout.DIVERGED] * 2], jnp.int32)
    judged = [judge(rules, jnp.asarray([3.0]), jnp.asarray([[4.0, 0.3, 0.3], [5.0, 0.2, 0.2]]), one) for one in status]
    f, c, value = map(np.asarray, zip(*judged, strict=True))
    seen = Measurement(gains=np.array([[3.0], [3.0]]), f=f, c=c, value=value)
    np.testing.assert_allclose(seen.objective, [4.0, np.nan], rtol=1e-12)
    run = LocalSearches(Evaluator(Bounds(("eta",), (2.0,), (4.0,))), 0.0, 2, np.random.default_rng(0))
    best = Best(np.array([0.5]), 1, 0.0)
    best.offer(np.array([[0.5]]), seen.at(1))
    assert np.isnan(best.value)
    assert best.failed
    for point in (0, 1):
        run._record(point, seen.at(point))
    np.testing.assert_allclose([step.value for step in run.history], [4.0, np.nan], rtol=1e-12)
    assert [step.worst.tolist() for step in run.history] == [[np.inf], [np.inf]]


def test_a_custom_system_has_the_same_journal_questions_in_another_process():
    """Its functions have other memory addresses there. A resumed search must still find its journal entries."""

    def question():
        pendulum = ptsmc.system(
            1, F=lambda t, x_1, x_2: x_2, H=lambda t, x_1, x_2: -jnp.sin(x_1), G=lambda t, x_1, x_2: jnp.eye(1)
        )
        tables = {"plant": {"kind": "system", "system": pendulum, "x0": [1.0, 0.0]}, "loop": {"mode": "sampled"}}
        ready = scenario.study(scenario.from_tables(tables))
        posed = problem(ready.parts, ready.dispersion, 0, np.arange(2), ("eta",))
        return pendulum, evaluate._encode(posed)

    (one, asked), (other, again) = question(), question()
    assert one != other
    assert asked == again
