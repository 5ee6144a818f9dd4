"""Tests of the gradient check, profiles, sensitivities, intervals and the global check against known results."""

from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from ptsmc_jax.devices import sensors
from ptsmc_jax.dispersions import variation
from ptsmc_jax.simulation import clock
from ptsmc_jax.simulation.requirements import Requirement
from tests.helpers import parts
from tests.search.test_tuning import problem
from tuning.search import global_check, objective, optimise, trust
from tuning.search.evaluate import Evaluator, Measurement
from tuning.search.normalisation import Bounds
from tuning.search.objective import FAILED

BOUNDS = Bounds(("eta", "delta", "t_f"), (2.5, 0.3, 15.0), (5.0, 4.0, 25.0))


def moved_in_time(**limits):
    """Return a problem of a double integrator with noise.

    limits: of metrics. Its clock covers all of `BOUNDS`, so that tests share one program.
    """
    noisy = problem(**limits)
    far = replace(noisy.parts, clock=replace(clock.anchored_clock(0.2, 21.0), count=140))
    return replace(noisy, parts=far, names=BOUNDS.names)


@pytest.fixture(scope="module")
def quiet():
    """Return a problem of a double integrator from rest without noise.

    The largest input is the first one, eta^2 |x| / t_f^2.
    """
    noisy = moved_in_time(peak_torque=0.9)
    return replace(noisy, parts=replace(noisy.parts, sensors=sensors.StateSensor(jnp.zeros(2))))


def test_sensitivities_of_the_peak_torque_are_its_exponents(quiet):
    """The peak torque is proportional to eta^2 / t_f^2, so that its relative sensitivities are 2 and -2."""
    found = trust.sensitivities(
        quiet, BOUNDS, np.array([3.3, 2.0, 19.0]), ("peak_torque", "window_error", "settling_time")
    )
    powers = found["peak_torque"]
    # central differences of an exponent p have the relative error h^2 / 3 for a relative step h of 0.01
    np.testing.assert_allclose([powers["eta"], powers["t_f"]], [2.0, -2.0], rtol=1e-4)
    assert abs(powers["delta"]) < 1e-4
    assert found["window_error"]["delta"] > 0.1


def test_the_profile_of_a_gain_without_effect_on_the_objective_is_flat(quiet):
    """The peak torque increases with eta^2 along the profile of eta, which has the final gain as one of its points."""
    evaluate = Evaluator(BOUNDS)
    problem = replace(quiet, objective="peak_torque")
    z = BOUNDS.normalise(np.array([3.3, 1.0, 19.0]))
    found = trust.profiles(evaluate, problem, z)
    assert {name: profile.is_flat for name, profile in found.items()} == {"eta": False, "delta": True, "t_f": False}
    eta = found["eta"]
    assert np.all(np.diff(eta.gain) > 0)
    np.testing.assert_allclose(np.min(np.abs(eta.gain - 3.3)), 0.0, atol=1e-9)  # the final gain is one of the points
    np.testing.assert_allclose(eta.value / eta.value[0], (eta.gain / eta.gain[0]) ** 2, rtol=1e-4)
    np.testing.assert_allclose(eta.violation_ratio / eta.violation_ratio[0], (eta.gain / eta.gain[0]) ** 2, rtol=1e-4)


def test_a_profile_varies_only_its_own_gain():
    """This also holds for sign_width, whose lower bound depends on the observer's gain."""
    names = ("eta", "observer_gain", "sign_width")
    bounds = Bounds(names, (2.5, 0.5, 1e-6), (5.0, 1000.0, 0.1), jump=1e-3)
    found = np.array([3.0, 20.0, 1e-3])

    def fly(problem: Any, normalised: np.ndarray) -> Measurement:
        gains, none = np.stack([bounds.gains(one) for one in normalised]), np.zeros(len(normalised))
        return Measurement(gains, none, np.zeros((len(normalised), 0, 1)), gains @ [0.0, 0.0, 1.0])

    evaluate: Any = SimpleNamespace(bounds=bounds, measure=fly)
    asked: Any = SimpleNamespace(rows=(), names=names)
    profiles = trust.profiles(evaluate, asked, bounds.normalise(found))
    for name in ("eta", "observer_gain"):
        np.testing.assert_allclose(np.log(profiles[name].value), 1e-3, rtol=1e-12)
    np.testing.assert_allclose(profiles["observer_gain"].gain[[0, -1]], [0.5, 1000.0])
    np.testing.assert_allclose(profiles["sign_width"].gain[[0, -1]], [1e-3 / 20.0, 0.1])


def test_profiles_and_gradient_check_handle_failed_trials():
    """The first of two trials fails for gains below 0.5, the second one below 0.25. Completed trials keep the limit.

    A failed trial breaks the limit. If both fail, the objective and the gradient error are NaN.
    """
    bounds = Bounds(("k",), (0.01,), (1.0,))

    def fly(problem: Any, normalised: np.ndarray) -> Measurement:
        gains = np.stack([bounds.gains(one) for one in normalised])
        c = np.where(gains[:, None, :] < [0.5, 0.25], FAILED - 1.0, -0.5)
        value = np.log(np.where(gains[:, 0] < 0.25, FAILED, 1e-3))
        return Measurement(gains, value + np.log(FAILED) * (c[:, 0] > 0.0).sum(axis=1), c, value)

    def measure_with_gradients(problem: Any, normalised: np.ndarray) -> Any:
        return SimpleNamespace(f_gradient=np.zeros_like(normalised))

    evaluate: Any = SimpleNamespace(bounds=bounds, measure=fly, measure_with_gradients=measure_with_gradients)
    asked: Any = SimpleNamespace(rows=("peak_torque",), names=("k",))
    found = trust.profiles(evaluate, asked, bounds.normalise(np.array([0.7])))["k"]
    np.testing.assert_array_equal(found.violation_ratio <= 1.0, found.gain >= 0.5)
    np.testing.assert_array_equal(np.isnan(found.value), found.gain < 0.25)
    assert found.has_value
    assert not found.is_flat
    assert np.isnan(trust.gradient_error(evaluate, asked, bounds.normalise(np.array([0.1]))))
    assert trust.gradient_error(evaluate, asked, bounds.normalise(np.array([0.7]))) == 0.0


def test_correct_gradients_of_a_sharp_objective_agree_with_finite_differences():
    """F is a sine with 700 periods between the bounds. An earlier step of 3e-4 had a truncation error of 12 %."""
    bounds = Bounds(("k",), (0.0,), (1.0,))

    def fly(problem: Any, normalised: np.ndarray) -> Measurement:
        f = np.sin(4500.0 * normalised[:, 0])
        return Measurement(normalised, f, np.zeros((len(f), 0, 1)), f)

    asked: Any = SimpleNamespace(names=bounds.names)
    for scale, error in ((1.0, 0.0), (1.1, 0.1 / 1.1)):

        def measure_with_gradients(problem: Any, normalised: np.ndarray, scale: float = scale) -> Any:
            return SimpleNamespace(f_gradient=scale * 4500.0 * np.cos(4500.0 * normalised))

        evaluate: Any = SimpleNamespace(bounds=bounds, measure=fly, measure_with_gradients=measure_with_gradients)
        np.testing.assert_allclose(trust.gradient_error(evaluate, asked, np.array([0.5])), error, atol=1e-4)


def test_sensitivities_at_a_bound_use_points_inside_it(quiet):
    """The clock has no samples beyond the bound. One-sided differences in logarithms are accurate for powers."""
    for at in (0, 1):
        gains = np.array([3.3, (BOUNDS.lower, BOUNDS.upper)[at][1], (BOUNDS.upper, BOUNDS.lower)[at][2]])
        powers = trust.sensitivities(quiet, BOUNDS, gains, ("peak_torque",))["peak_torque"]
        np.testing.assert_allclose([powers["eta"], powers["t_f"]], [2.0, -2.0], rtol=1e-4)


def test_a_zero_gain_has_no_sensitivity_and_the_other_gains_have_one(monkeypatch):
    """The error is the square of the first gain. The second gain is zero and has no effect."""

    def fly(_, gains):
        errors = np.tile(gains[:, :1] ** 2, (1, 4))
        return SimpleNamespace(status=np.zeros((len(gains), 4), int), metrics=SimpleNamespace(window_error=errors))

    monkeypatch.setattr(trust.simulations, "simulate", fly)
    problem: Any = SimpleNamespace(batch_of=lambda trials: trials, trials=np.arange(4), averaged=4, names=("k", "lead"))
    bounds = Bounds(problem.names, (1.0, -1.0), (3.0, 1.0))
    found = trust.sensitivities(problem, bounds, np.array([2.0, 0.0]), ("window_error",))
    assert list(found["window_error"]) == ["k"]
    np.testing.assert_allclose(found["window_error"]["k"], 2.0, rtol=1e-4)  # error of the finite differences, as above


@pytest.mark.parametrize(("ratio", "flat"), [(1.0, True), (1.005, True), (1.02, False), (3.0, False)])
def test_a_gain_is_flat_if_objective_and_limits_change_by_less_than_one_percent(ratio, flat):
    ones, moved = np.ones(3), np.array([2.0, 2.0 * ratio, 2.0])
    assert trust.Profile(ones, moved, ones, np.log(moved)).is_flat == flat
    assert trust.Profile(ones, ones, moved, 0.0 * ones).is_flat == flat  # constant objective such as t_f
    assert trust.Profile(ones, ones, ones, np.log(moved)).is_flat == flat  # torque term of F
    assert trust.Profile(ones, moved, 0.0 * ones, np.log(moved)).is_flat == flat  # no requirements


def test_gradient_error_is_the_deviation_from_finite_differences():
    noisy = moved_in_time()
    # t_f - delta is not a multiple of the period, because the noise of the first period has a kink there
    evaluate, z = Evaluator(BOUNDS), BOUNDS.normalise(np.array([3.3, 1.07, 19.0]))
    assert trust.gradient_error(evaluate, noisy, z) < 1e-6  # differences of order 4

    class Wrong(Evaluator):
        def measure_with_gradients(self, problem, normalised):
            seen = super().measure_with_gradients(problem, normalised)
            return replace(seen, f_gradient=seen.f_gradient * np.array([1.0, 1.01, 1.0]))

    behind = z + 3 * max(trust.DIFFERENCE_STEPS) * np.array([0.0, 1.0, 1.0])  # point of the gradients
    normalised = np.abs(evaluate.measure_with_gradients(noisy, behind[None]).f_gradient[0])
    expected = 0.01 * normalised[1] / (normalised * [1.0, 1.01, 1.0]).max()
    np.testing.assert_allclose(trust.gradient_error(Wrong(BOUNDS), noisy, z), expected, rtol=1e-3)


def test_confidence_intervals_of_mean_and_rms_agree_with_large_sample_theory():
    values = np.random.default_rng(1).normal(5.0, 1.0, 4000)
    low, high = trust.interval(values) or (0.0, 0.0)
    half = stats.norm.ppf(0.975) * values.std() / np.sqrt(values.size)
    np.testing.assert_allclose([low, high], [values.mean() - half, values.mean() + half], atol=0.1 * half)
    low, high = trust.interval(values, trust.rms) or (0.0, 0.0)
    squares, rms = values**2, np.sqrt(np.mean(values**2))
    half = stats.norm.ppf(0.975) * squares.std() / np.sqrt(values.size) / (2 * rms)
    np.testing.assert_allclose([low, high], [rms - half, rms + half], atol=0.1 * half)


def test_a_ratio_over_the_same_trials_has_a_narrow_confidence_interval():
    rng = np.random.default_rng(3)
    common = rng.lognormal(0.0, 0.5, 500)
    low, high = trust.ratio_interval(10.0 * common, common * rng.normal(1.0, 0.01, 500)) or (0.0, 0.0)
    assert low < 10.0 < high
    assert high - low < 0.05  # each single RMS has an uncertainty of 5 %


def test_equal_or_too_few_values_have_no_confidence_interval():
    assert trust.interval(np.full(100, 2.0)) is None
    assert trust.interval(np.arange(7.0)) is None
    assert trust.interval(np.arange(8.0)) is not None


@pytest.mark.long
def test_differential_evolution_finds_the_optimum_of_the_search_with_gradients(monkeypatch):
    """The distance is large for a search that has not left its starting point."""
    monkeypatch.setattr(global_check, "GENERATIONS", 30)
    run = parts(20.0, 3.0, 0.5, period=0.2, noise=(2e-5, 1e-6), t_end=21.0)
    run = replace(run, clock=clock.anchored_clock(0.2, 21.0))
    nothing = variation.Dispersion()
    some = objective.problem(run, nothing, 3, np.arange(4), ("eta", "delta"), [Requirement("peak_torque", 0.6)])
    evaluate = Evaluator(Bounds(("eta", "delta"), (2.05, 0.2), (6.0, 5.0)))
    settings = optimise.Settings(4, 40, 1)
    found = optimise.search(evaluate, some, [Requirement("peak_torque", 0.6)], np.array([3.0, 0.5]), settings)
    checked = global_check.check(evaluate, found, 0)
    assert abs(checked.distance) < 1e-3
    np.testing.assert_allclose(np.log(found.value / checked.value), checked.distance, atol=1e-12)
    assert checked.rollouts >= 30 * 4
    # the distance is large for a search that has not left its starting point
    lost = replace(found, normalised=evaluate.bounds.normalise(np.array([2.3, 3.0])))
    assert global_check.check(evaluate, lost, 0).distance > 0.5


@pytest.mark.parametrize(("normalised", "kept"), [(0.985, True), (1.01, False)])
def test_the_global_check_reports_the_original_limits(monkeypatch, normalised, kept):
    """Gains that keep the original limit, but not the tightened limit, count as keeping it."""
    monkeypatch.setattr(global_check, "GENERATIONS", 1)
    monkeypatch.setattr(global_check, "POPULATION", 4)
    bounds = Bounds(BOUNDS.names, (3.0, 0.5, 20.0), (3.0001, 0.5001, 20.0001))  # one torque for all gains
    evaluate = Evaluator(bounds)
    peak = float(evaluate.measure(moved_in_time(peak_torque=1.0), np.full((1, 3), 0.5)).largest_c[0]) + 1.0
    settings, limit = optimise.Settings(1, 2, 1, judged=False, margins={"peak_torque": 0.03}), peak / normalised
    found = optimise.search(evaluate, moved_in_time(peak_torque=limit), (), np.array([3.0, 0.5, 20.0]), settings)
    assert bool(found.worst[0] <= 1.0) is kept
    assert global_check.check(evaluate, found, 0).kept is kept


@dataclass(frozen=True)
class OneLimit:
    """A problem with one gain and one requirement, with or without margins."""

    limit: float = 1.0
    margins: Any = None
    names, rows = ("eta",), ("peak_torque",)

    def tightened(self, factor):
        """Return the problem with its limit times this factor."""
        return replace(self, limit=self.limit * factor)


class Steps:
    """Evaluates F = 3 + normalised gain, infinite above 0.9, and a given c. It counts the points with margins.

    c: function of the problem and the normalised gains.
    """

    def __init__(self, c):
        self.c, self.rollouts, self.judged = c, 0, 0

    def measure(self, problem, normalised):
        """Return the `Measurement` of F and c at normalised gains (points, 1)."""
        self.rollouts += len(normalised)
        self.judged += len(normalised) * (problem.margins is not None)
        f = np.where(normalised[:, 0] > 0.9, np.inf, 3.0 + normalised[:, 0])
        return Measurement(2.0 + normalised, f, self.c(problem, normalised)[:, :, None], f)


def test_the_global_check_uses_the_tightened_limits_of_the_search(monkeypatch):
    """The metric is a step function, and only its last step keeps the limit of 1 tightened by 10 %.

    F is smaller at points that break the limit slightly, and infinite at others. Neither may be the result.
    """
    monkeypatch.setattr(global_check, "POPULATION", 10)
    metric = [1.05, 0.95, 0.8]
    evaluate: Any = Steps(
        lambda problem, normalised: (
            np.select([normalised < 0.3, normalised < 0.6], metric[:2], 0.8) / problem.limit - 1.0
        )
    )
    searched: Any = SimpleNamespace(problem=OneLimit(), margins={"peak_torque": 0.1}, normalised=np.array([0.8]))
    found = global_check.check(evaluate, searched, 1, with_gradients=False)
    assert found.kept
    assert 2.6 <= found.gains["eta"] < 2.6 + 10.0 * global_check.SPREAD  # spread of F in the final population
    np.testing.assert_allclose(np.log(found.value), found.gains["eta"] + 1.0, rtol=1e-12)
    np.testing.assert_allclose(found.distance, 2.8 - found.gains["eta"], rtol=1e-12)
    assert found.rollouts == evaluate.rollouts


def test_the_global_check_computes_margins_only_for_surviving_points(monkeypatch):
    """The result equals the result with margins at every point, which a row of the metrics represents here."""
    monkeypatch.setattr(global_check, "POPULATION", 10)

    def lazily(problem, normalised):  # the requirement is broken below 0.2, and the margins below 0.6
        rows = [0.2 - normalised, 0.6 - normalised] if problem.margins else [0.2 - normalised]
        return np.concatenate(rows, axis=1)

    ends = {}
    for told, c in (
        (OneLimit(margins="gain_margin"), lazily),
        (OneLimit(), lambda _, normalised: np.concatenate([0.2 - normalised, 0.6 - normalised], axis=1)),
    ):
        evaluate: Any = Steps(c)
        searched: Any = SimpleNamespace(problem=told, margins={"peak_torque": 0.1}, normalised=np.array([0.8]))
        ends[told.margins] = global_check.check(evaluate, searched, 1, with_gradients=False), evaluate
    (found, lazy), (eager, every) = ends["gain_margin"], ends[None]
    assert (found.gains, found.value) == (eager.gains, eager.value)
    assert found.kept
    assert lazy.rollouts - lazy.judged == every.rollouts - 3  # 3 single points have margins in both cases
    assert lazy.judged < 0.9 * every.rollouts  # fewer than all points
