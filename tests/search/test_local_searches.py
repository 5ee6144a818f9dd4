"""Tests of local searches on problems with solutions in closed form."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.search.test_tuning import WITHIN, problem
from tuning.search import hand_overs, local_search, local_searches, normalisation, starts
from tuning.search.evaluate import Evaluator, MeasurementWithGradients


class RosenbrockEvaluator(Evaluator):
    """Rosenbrock function F = (x0 - 0.2)^2 + 100 (x1 - x0^2)^2 without limits. x2 has no effect. Points are counted."""

    def _answer(self, problem, normalised, *, with_gradients):
        """Return a dict of F, no limits, and their gradients if requested, at normalised gains (points, 3)."""
        x0, x1, _ = normalised.T
        f, c = (x0 - 0.2) ** 2 + 100 * (x1 - x0**2) ** 2, np.full((len(normalised), 0, 8), -1.0)
        slope = np.stack([2 * (x0 - 0.2) - 400 * x0 * (x1 - x0**2), 200 * (x1 - x0**2), 0.0 * x0], axis=1)
        values = {"gains": normalised, "f": f, "c": c, "value": f}
        return values | ({"f_gradient": slope, "c_gradient": np.zeros((*c.shape, 3))} if with_gradients else {})


THREE = normalisation.Bounds(("eta", "k1", "sign_width"), (2.05, 0.1, 1e-5), (6.0, 50.0, 1e-1))


def test_a_longer_local_search_continues_a_shorter_one_from_the_same_point():
    ends, counts = [], []
    for parts_of_it in ((7, 30), (30,)):
        evaluate, start = RosenbrockEvaluator(THREE), local_search.Start(np.array([0.9, 0.1, 0.5]))
        best, kept = local_search.Best(start.normalised, 0, 0.0), []
        for steps in parts_of_it:
            kept.clear()
            local_search.search_locally(
                partial(evaluate.measure_with_gradients, problem()), best, start, steps, kept.append
            )
        ends.append((best.f, best.normalised.tolist(), [float(one.f[0]) for one in kept]))
        counts.append(evaluate.gradients // problem().trials.size)
    assert ends[0] == ends[1]
    assert counts[0] == counts[1] > 7
    assert ends[0][0] < 1e-3


def test_a_local_search_from_the_same_point_of_the_same_problem_simulates_and_records_nothing():
    """With few steps, a search often ends at its starting point, and the next search begins there too."""
    evaluate, some = RosenbrockEvaluator(THREE), replace(problem(), names=THREE.names)
    run = local_searches.LocalSearches(evaluate, 0.0, 6, np.random.default_rng(0))
    counts = []
    for one in (some, some, replace(some, averaged=7)):
        run._search(one, 0, local_search.Start(np.array([0.9, 0.1, 0.5])), 6)
        counts.append((evaluate.gradients // some.trials.size, len(run.history)))
    assert counts == [(6, 3), (6, 3), (12, 3)]


def test_hand_over_is_moved_to_samples_by_delta_and_by_t_f_if_both_are_free():
    """If t_f is as short as possible, another delta may break a limit, so longer t_f are tried too."""
    some = replace(problem(2), names=("t_f", "delta"))
    evaluate = Evaluator(normalisation.Bounds(("t_f", "delta"), (10.0, 0.2), (20.0, 5.0)))
    run = local_searches.LocalSearches(evaluate, 0.0, 2, np.random.default_rng(0))
    scenario_gains = np.array([15.13, 0.79])  # the hand-over at 14.34 s lies between samples 71 and 72
    normalised = evaluate.bounds.normalise(scenario_gains)
    run._update_best(local_search.Best(normalised, 0, 0.0), some, 0, replace_best=True)
    moved = [
        np.asarray(evaluate.bounds.gains(jnp.asarray(one)))
        for one in hand_overs.points_on_samples(some, evaluate.bounds, run.normalised)
    ]
    on_samples = np.asarray([(t_f - delta) / 0.2 for t_f, delta in moved])
    np.testing.assert_allclose(on_samples, np.round(on_samples), atol=1e-9)
    with_delta = sorted(delta for t_f, delta in moved if abs(t_f - scenario_gains[0]) < 1e-9)
    np.testing.assert_allclose(with_delta, [0.73, 0.93], atol=1e-9)
    with_t_f = sorted(t_f for t_f, delta in moved if abs(delta - scenario_gains[1]) < 1e-9)
    np.testing.assert_allclose(with_t_f, 0.79 + 0.2 * np.arange(71, 71 + hand_overs.SAMPLES_AHEAD), atol=1e-9)


def test_hand_over_is_moved_to_samples_by_t_f_if_delta_is_not_free():
    """A flight computer would delay a hand-over between two samples to the next sample."""
    some = replace(problem(2), names=("t_f",))
    evaluate = Evaluator(normalisation.Bounds(("t_f",), (10.0,), (20.0,)))
    run = local_searches.LocalSearches(evaluate, 0.0, 2, np.random.default_rng(0))
    run._update_best(
        local_search.Best(evaluate.bounds.normalise(np.array([15.13])), 0, 0.0), some, 0, replace_best=True
    )
    moved = [
        float(evaluate.bounds.gains(jnp.asarray(one))[0])
        for one in hand_overs.points_on_samples(some, evaluate.bounds, run.normalised)
    ]
    delta = float(some.parts.controller.delta)
    before = np.floor((15.13 - delta) / 0.2)
    np.testing.assert_allclose(moved, delta + 0.2 * (before + np.arange(hand_overs.SAMPLES_AHEAD)), atol=1e-9)


class Conflicting(Evaluator):
    """F = x0, with the limits c = 2 (a - x0) + y and c = x0 - b + y, and a constant limit; y = (x1 - 0.3)^2.

    third: value of the constant limit. The first two limits are equally far exceeded at x0 = (2 a + b) / 3.
    """

    def __init__(self, a, b, third):
        super().__init__(normalisation.Bounds(("eta", "k1"), (1.0, 1.0), (2.0, 2.0)))
        self.a, self.b, self.third = a, b, third

    def measure_with_gradients(self, problem, normalised):
        """Return F and the three limits with their gradients at normalised gains (points, 2)."""
        (x0, x1), zero = normalised.T, np.zeros(len(normalised))
        y, along = (x1 - 0.3) ** 2, 2.0 * (x1 - 0.3)
        c = np.stack([2.0 * (self.a - x0) + y, x0 - self.b + y, zero + self.third], axis=1)
        by_share = np.stack(
            [np.stack(one, axis=1) for one in ((zero - 2.0, along), (zero + 1.0, along), (zero, zero))], axis=1
        )
        f_gradient = np.stack([zero + 1.0, zero], axis=1)
        gains = self.bounds.gains(normalised)
        return MeasurementWithGradients(gains, x0, c[:, :, None], x0, f_gradient, by_share[:, :, None])

    measure = measure_with_gradients


@pytest.mark.parametrize(
    ("third", "expected"),
    [
        (-0.5, {"peak_torque": 2.2, "effort": 1.6}),  # the first limit alone at x0 = 0.1, the second one at 0.7
        (0.4, {"peak_torque": None, "effort": None, "window_error": None}),  # no limit alone resolves the conflict
    ],
)
def test_a_search_ends_at_the_best_compromise_and_finds_the_limits_that_conflict(third, expected):
    """Limits at x0 >= 0.7 and x0 <= 0.1: the largest violation is least at x0 = 0.5, where it is 0.4."""
    evaluate = Conflicting(0.7, 0.1, third)
    some = replace(problem(2), names=evaluate.bounds.names)
    run = local_searches.LocalSearches(evaluate, 0.0, 60, np.random.default_rng(0))
    run.search_locally(some, {0: np.array([0.95, 0.8])})
    np.testing.assert_allclose(run.normalised, [0.5, 0.3], atol=1e-2)  # y is flat there
    np.testing.assert_allclose(run.best.worst.max(), 1.4, atol=1e-3)
    found = run.find_conflicts(some)
    assert list(found) == list(expected)
    for limit, alone in expected.items():
        assert found[limit] == (alone if alone is None else pytest.approx(alone, abs=2e-3))


class Saturating(Conflicting):
    """The limit c = 0.6 - x0 / 10, and a limit of 1 that saturates at 1.25 without gradients for x0 > 0.5."""

    def measure_with_gradients(self, problem, normalised):
        """Return F and the limits with their gradients at normalised gains (points, 2)."""
        measured = super().measure_with_gradients(problem, normalised)
        x0, saturated = normalised[:, 0], normalised[:, 0] > 0.5
        measured.c[:, :2, 0] = np.stack([0.6 - x0 / 10.0, np.where(saturated, 0.25, x0 - 0.4)], axis=1)
        measured.c_gradient[:, :2, 0, 0] = np.stack([np.full(x0.shape, -0.1), 1.0 - saturated], axis=1)
        measured.c_gradient[:, :2, 0, 1] = 0.0
        return measured

    measure = measure_with_gradients


def test_a_limit_of_a_conflict_is_found_from_measured_points_if_the_best_point_saturates():
    evaluate = Saturating(0.0, 0.0, -1.0)
    some, start = replace(problem(2), names=evaluate.bounds.names), np.array([0.9, 0.3])
    for scenario_gains, history in ((np.array([1.2, 1.3]), []), (None, [0.2]), (None, [])):
        run = local_searches.LocalSearches(evaluate, 0.0, 20, np.random.default_rng(0))
        run.search_locally(some, {0: start})
        run._scenario_gains = scenario_gains
        for x0 in history:
            run._record(1, evaluate.measure(some, np.array([[x0, 0.3]])))
        alone = run.find_conflicts(some)["peak_torque"]
        assert alone == (None if scenario_gains is None and not history else pytest.approx(1.56, abs=1e-3))


def test_the_other_limits_of_a_conflict_count_without_the_reserve_of_the_search():
    """The third limit cannot be met with its reserve of 3 %, but without it."""
    evaluate = Conflicting(1.2, 1.0, 0.02)
    some = replace(problem(2), names=evaluate.bounds.names)
    run = local_searches.LocalSearches(evaluate, [0.0, 0.0, 0.03], 60, np.random.default_rng(0))
    run.search_locally(some, {0: np.array([0.95, 0.8])})
    assert run.find_conflicts(some) == {"peak_torque": pytest.approx(1.4, abs=1e-3)}


@pytest.mark.parametrize(
    ("relaxed", "x0"),
    [
        (None, 0.3),  # F is least on the first limit
        (range(3), 0.4),  # both are 0.2 inside their limits
        ([0], 0.6),  # as far inside the first limit as the second one allows
        ([1], 0.3),
    ],
)
def test_a_local_search_minimises_the_objective_or_the_violation_of_some_limits(relaxed, x0):
    """Limits at x0 >= 0.3 and x0 <= 0.6. The search starts outside of them."""
    evaluate, start = Conflicting(0.3, 0.6, -1.0), local_search.Start(np.array([0.95, 0.3]))
    best, kept = local_search.Best(start.normalised, 3, 0.0), []
    asked = partial(evaluate.measure_with_gradients, problem(2))
    local_search.search_locally(asked, best, start, 60, kept.append, relaxed=relaxed)
    np.testing.assert_allclose(evaluate.bounds.normalise(kept[-1].gains[0]), [x0, 0.3], atol=1e-3)


def test_a_search_starts_from_the_best_design_if_that_is_better_than_the_scenarios_gains():
    evaluate = Conflicting(0.1, 0.7, -1.0)
    some, scenario_gains = replace(problem(2), names=evaluate.bounds.names), np.array([1.6, 1.3])
    designs = np.array([[1.9, 1.3], [1.2, 1.3], [1.65, 1.3]])
    for given, first in ((designs, designs[1]), (designs[::2], scenario_gains), (np.zeros((0, 2)), scenario_gains)):
        run = local_searches.LocalSearches(evaluate, 0.0, 2, np.random.default_rng(0))
        run.begin(some, scenario_gains, given)
        np.testing.assert_allclose(run.history[0].gains, first, rtol=1e-12)


class OfDelta(Evaluator):
    """Evaluates F and the largest c of every trial, which are functions of delta.

    f_and_c: function of delta [s] that returns F and c.
    """

    def __init__(self, f_and_c):
        super().__init__(normalisation.Bounds(("delta",), (0.2,), (5.0,)))
        self._f_and_c = f_and_c

    def measure_with_gradients(self, problem, normalised):
        """Return F and the c of all trials with their derivatives by the normalised delta (points, 1)."""

        def values(share):
            return jnp.stack(self._f_and_c(self.bounds.gains(share)[0]))

        shares = jnp.asarray(normalised)
        f, c = np.asarray(jax.vmap(values)(shares)).T
        f_slope, c_slope = np.asarray(jax.vmap(jax.jacfwd(values))(shares))[:, :, 0].T
        c, c_slope = (np.tile(v[:, None, None], (1, 1, problem.trials.size)) for v in (c, c_slope))
        gains = np.asarray(jax.vmap(self.bounds.gains)(shares))
        return MeasurementWithGradients(gains, f, c, f, f_slope[:, None], c_slope[..., None])

    measure = measure_with_gradients


def narrow(delta):
    """Return F and c: (delta - 1.1)^2 for delta < 2, else 1 + (delta - 3.5)^2, and c without its derivative.

    The period is 0.2 s. If delta < 2, the limit is broken within 0.3 periods of each sample.
    """
    near, off = delta < 2.0, jnp.abs(delta / 0.2 - jnp.round(delta / 0.2))
    f = jnp.where(near, (delta - 1.1) ** 2, 1.0 + (delta - 3.5) ** 2)
    return f, jax.lax.stop_gradient(jnp.where(near, 0.3 - off, -1.0))


def test_another_local_search_is_used_if_the_hand_over_on_a_sample_breaks_a_limit():
    """The search would otherwise end with gains that break a limit, although it has found gains that meet it."""
    some = replace(problem(peak_torque=1.0), names=("delta",))
    evaluate = OfDelta(narrow)
    run = local_searches.LocalSearches(evaluate, 0.0, 20, np.random.default_rng(0))
    run.search_locally(some, {k: evaluate.bounds.normalise(np.array([delta])) for k, delta in enumerate((1.1, 3.5))})
    assert run.best.violation == 0.0
    np.testing.assert_allclose(run.best.f, 1.01, rtol=1e-6)  # on the samples next to 3.5 s


def rippled(delta):
    """Return F and c: a parabola with ripples of period 0.6 s, and the limit c = 1.7 s - delta."""
    return 0.02 * (delta - 1.8) ** 2 + 0.01 * (1.0 - jnp.cos(2.0 * jnp.pi / 0.6 * delta)), 1.7 - delta


@pytest.mark.parametrize("delta", [3.0, 4.8])
def test_a_search_finds_the_best_local_minimum_among_ripples_over_delta(delta):
    """Two searches that differed only in rounding once ended 2.4 % apart, in different ripples."""
    some = replace(problem(peak_torque=1.0), names=("delta",))
    evaluate = OfDelta(rippled)
    run = local_searches.LocalSearches(evaluate, 0.0, 20, np.random.default_rng(0))
    run.search_locally(some, {0: evaluate.bounds.normalise(np.array([delta]))})
    np.testing.assert_allclose(run.gains, 1.8, rtol=1e-9)


def test_multipliers_of_the_limits_are_estimated_from_gradients():
    """F = x0 - 2 x1 subject to x1 - x0 / 2 <= 0, on the bound x0 = 0, with a second limit that is inactive."""
    f_gradient, c_gradient = np.array([[1.0, -2.0]]), np.array([[-0.5, 1.0], [3.0, 3.0]])
    c = np.array([[[-0.3, 0.0], [-0.5, -0.2]]])
    at = MeasurementWithGradients(
        np.zeros((1, 2)), np.zeros(1), c, np.zeros(1), f_gradient, np.stack([0 * c_gradient, c_gradient], axis=1)[None]
    )
    np.testing.assert_allclose(local_search.estimate_multipliers(at, np.array([0.0, 0.4])), [2.0, 0.0], rtol=1e-12)
    none = MeasurementWithGradients(
        np.zeros((1, 2)), np.zeros(1), c[:, :0], np.zeros(1), f_gradient, np.zeros((1, 0, 2, 2))
    )
    assert local_search.estimate_multipliers(none, np.array([0.0, 0.4])).size == 0


def test_other_hand_overs_lie_on_samples_within_the_bounds_and_a_factor_of_two():
    """A search tries other hand-over times t_f - delta, with the same t_f."""
    some = replace(problem(2), names=("t_f", "delta"))
    bounds = normalisation.Bounds(("t_f", "delta"), (10.0, 0.9), (20.0, 5.0))
    looked = hand_overs.other_hand_overs(some, bounds, bounds.normalise(np.array([15.13, 1.5])))
    t_f, delta = np.asarray([bounds.gains(jnp.asarray(one)) for one in looked]).T
    np.testing.assert_allclose(t_f, 15.13)
    np.testing.assert_allclose((t_f - delta) / 0.2, np.round((t_f - delta) / 0.2), atol=1e-9)
    np.testing.assert_allclose([delta.max(), delta.min()], [2.93, 0.93], atol=1e-9)
    assert (
        hand_overs.other_hand_overs(
            replace(some, names=("t_f",)), normalisation.Bounds(("t_f",), (10.0,), (20.0,)), np.ones(1)
        )
        == []
    )


def test_only_gains_without_effect_are_reset_to_the_scenarios_values():
    """This also holds if the lower bound of sign_width depends on the observer's gain and lies above the value."""
    hops = normalisation.Bounds(("observer_gain", *THREE.names[1:]), (2.05, 0.1, 1e-5), (600.0, 50.0, 1e-1), jump=5e-3)
    for bounds, width, kept in ((THREE, 2e-3, True), (THREE, 2e-3, False), (hops, 2e-3, True), (hops, 1e-3, True)):
        some, scenario_gains = replace(problem(), names=bounds.names), np.array([3.0, 5.0, width])
        run = local_searches.LocalSearches(RosenbrockEvaluator(bounds), 0.0, 40, np.random.default_rng(0))
        if kept:
            run.begin(some, scenario_gains, np.zeros((0, 3)))
        run.search_locally(some, {0: np.array([0.9, 0.1, 0.1])})
        np.testing.assert_allclose(run.normalised[:2], [0.2, 0.04], atol=0.02)
        np.testing.assert_allclose(run.gains[2], width if kept else 1e-5 * 1e4**0.1)


def test_starting_points_are_the_best_far_apart_points_and_then_nearer_ones():
    normalised = np.array([[0.1, 0.1], [0.1, 0.15], [0.9, 0.1], [0.12, 0.45], [0.1, 0.1]])
    apart = starts.distances(normalised)
    np.testing.assert_allclose(apart[0], [0.0, 0.05, 0.8, 0.35, 0.0], atol=1e-12)
    assert [starts.choose_far_apart([1, 0, 2, 3], apart, count) for count in (1, 2, 3, 4)] == [
        [1], [1, 2], [1, 2, 3], [1, 2, 3, 0],
    ]  # fmt: skip


def test_a_local_search_keeps_its_number_of_points_with_wrong_or_nan_gradients():
    """F = ln(1 + |x - a|^2), whose gradient is scaled by 1e30 at the first point and is NaN at the third point."""

    class Bowl(Evaluator):
        def measure_with_gradients(self, problem, normalised):
            self.gradients += 1
            off = normalised[0] - np.array([0.3, 0.8])
            f = np.log1p(off @ off)
            slope = 2 * off / (1 + off @ off) * (1e30 if self.gradients == 1 else 1.0)
            slope = np.where(self.gradients == 3, np.nan, slope)
            c = np.full((1, 0, 8), -1.0)
            return MeasurementWithGradients(
                normalised, np.array([f]), c, np.array([f]), slope[None], np.zeros((1, 0, 8, 2))
            )

    for steps, near in ((3, 1.0), (40, 1e-4)):
        start = local_search.Start(np.array([0.9, 0.1]))
        evaluate, best, path = Bowl(WITHIN), local_search.Best(start.normalised, 0, 0.0), []
        local_search.search_locally(
            partial(evaluate.measure_with_gradients, problem()), best, start, steps, path.append, tolerance=1e-12
        )
        assert evaluate.gradients <= steps
        assert best.f < near
        assert len(path) <= evaluate.gradients
