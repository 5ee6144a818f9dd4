"""Estimates of `ptsmc identify` from logs of an independent simulation, and the identified scenario."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ptsmc_jax import explore, formulas, plants, scenario
from ptsmc_jax.dispersions import numbers
from ptsmc_jax.dispersions.quantities import PAIRS
from ptsmc_jax.identification import design, estimation, filtering, parameters, results, telemetry
from ptsmc_jax.scenario import parsing
from ptsmc_jax.scenario.errors import ScenarioError
from tests.identification import synthetic

TRUE = np.array([[0.05, 0.002, -0.001], [0.002, 0.09, 0.003], [-0.001, 0.003, 0.11]])
ENTRIES = np.array([TRUE[i, j] for i, j in PAIRS])


def satellite(free=("inertia", "gyro_bias"), **tables):
    """Return a scenario of a small satellite whose inertia is up to 30 % off `TRUE`.

    free: the parameters to estimate. tables: other tables of the scenario.
    """
    return scenario.from_tables(
        {
            "spacecraft": {"inertia": [0.065, 0.072, 0.12]},
            "loop": {"mode": "sampled", "period": 0.25},
            "disturbance": {"kind": "none"},
            "hardware": {"attitude_noise": 5e-5, "rate_noise": 1.4e-4, "torque_lag": 0.05},
            "wheels": {"kind": "axes"},
            "identify": {"free": list(free), "prior": "none"},
            **tables,
        }
    )


def flight(rng, **others):
    """Return a simulated log (a data frame) of the satellite with its true inertia, and its gyro bias (3,) [rad/s].

    The simulation is independent of the code under test. others: arguments of `synthetic.logs`.
    """
    (frame,), drift = synthetic.logs(rng, TRUE, dt=0.25, rows=257, wheels=True, lag=0.05, **others)
    return frame, drift[0]


@pytest.fixture(scope="module")
def identified():
    """Return the result for a log with outliers and missing samples, and the true gyro bias (3,) [rad/s]."""
    rng = np.random.default_rng(5)
    frame, drift = flight(rng)
    found = explore.identify(satellite(), synthetic.spoiled(frame, rng), validate=[flight(rng)[0]])
    return found, drift


def test_outliers_and_missing_samples_do_not_spoil_the_estimates(identified):
    found, drift = identified
    assert found.is_identified, found.verdict
    assert np.all(np.abs(found.estimate - ENTRIES) < 3.5 * found.std)  # all of six within 3.5 sigma: 99.7 %
    assert np.all(found.std < 0.02 * 0.11)  # the start is 30 % off
    bias, std = found.gyro_bias()[0]
    assert np.all(np.abs(bias - drift) < 3.5 * std)
    assert found.fits[0].outlier_count >= 10  # 18 components were spoiled, some in rows that are blank


def test_a_tenth_of_outliers_does_not_spoil_the_estimates():
    """Regression: if more than 5 % of the readings of a sensor were outliers, none was rejected."""
    rng = np.random.default_rng(6)
    found = explore.identify(satellite(), synthetic.spoiled(flight(rng)[0], rng, outliers=0.1, missing=0.0))
    assert found.fits[0].outlier_count > 100  # 156 components were spoiled
    assert np.all(np.abs(found.estimate - ENTRIES) < 3.5 * found.std)  # all of six within 3.5 sigma: 99.7 %
    assert np.all(found.std < 0.02 * 0.11)  # the start is 30 % off


def test_the_identified_model_predicts_a_log_that_was_not_used(identified):
    found, _ = identified
    (fit,) = found.validation
    assert fit.is_white
    assert fit.outlier_count == 0
    assert 0.9 < fit.mean_square < 1.1  # the mean of 1500 squares has a standard deviation of 0.04


def test_the_identified_scenario_has_the_estimate_and_its_covariance(identified):
    """Standard deviations and a correlation of its random inertias agree, and all these inertias are physical."""
    found, _ = identified
    again = scenario.from_tables(parsing.dump(found.identified_scenario))  # as from identified.toml
    ready = scenario.study(again)
    np.testing.assert_allclose(np.asarray(ready.parts.plant.inertia)[np.triu_indices(3)], found.estimate, rtol=1e-12)
    draw = jax.jit(jax.vmap(lambda trial: ready.dispersion.apply(ready.parts, 0, trial).plant.inertia))
    bodies = np.asarray(draw(jnp.arange(4000)))
    assert formulas.is_rigid_body(bodies).all()
    # the covariance of 4000 random samples differs by a few per cent; the density is normal in other coordinates
    std = np.std(bodies, axis=0)[np.triu_indices(3)]
    np.testing.assert_allclose(std, found.std, rtol=0.1)
    correlation = np.corrcoef(bodies[:, 0, 0], bodies[:, 1, 1])[0, 1]
    expected = found.covariance[0, 3] / (found.std[0] * found.std[3])
    assert abs(correlation - expected) < 0.1


def test_the_summary_of_an_identification_has_status_parameters_and_logs(identified):
    found, _ = identified
    summary = results.summary(found)
    assert summary["status"] == "identified"
    assert [row["parameter"] for row in summary["parameters"]] == found.problem.labels
    assert len(summary["logs"]) == len(summary["validation"]) == 1


def test_the_verdict_names_estimates_far_from_their_prior_knowledge(identified):
    found, _ = identified
    prior_std = np.full(6, np.inf)
    prior_std[3] = abs(found.estimate - found.start)[3] / 6.0
    (sentence,) = set(results.verdict(replace(found, prior_std=prior_std))) - set(results.verdict(found))
    assert "inertia_22 (6)" in sentence
    assert results.verdict(replace(found, prior_std=2.0 * prior_std)) == results.verdict(found)


def test_a_notebook_shows_the_verdict_the_estimates_and_the_figures_of_each_log(identified):
    """A single figure can be selected. Innovations of angles are in arcsec."""
    found, _ = identified
    assert all(line in found._repr_html_() for line in found.verdict)
    assert all(label in repr(found) for label in found.problem.labels)
    each = ("innovations", "autocorrelation", "prediction")
    assert set(found.plot()) == {"estimates", *each, *(f"{name}_2" for name in each)}
    assert list(found.plot("prediction_2")) == ["prediction_2"]
    axes = found.plot("innovations")["innovations"].axes[0]
    assert axes.get_ylabel() == "attitude_x [arcsec]"
    first = results.innovations(found.fits[0])[0][0, 0]  # [rad]
    np.testing.assert_allclose(np.asarray(axes.lines[0].get_ydata())[0], np.rad2deg(first) * 3600.0, rtol=1e-12)


def test_the_figure_of_the_autocorrelation_has_the_limit_of_the_verdict(identified):
    found, _ = identified
    (band,) = found.plot("autocorrelation")["autocorrelation"].axes[0].patches
    readings = np.sum(np.isfinite(found.fits[0].whitened[:, 0]))
    limit = max(estimation.MAX_AUTOCORRELATION, estimation.MISFIT_SIGMAS / np.sqrt(readings))
    np.testing.assert_allclose((band.get_y(), band.get_height()), (-limit, 2.0 * limit))


def test_innovations_of_the_attitude_are_drawn_in_arcsec(identified):
    found, _ = identified
    panels = found.plot("innovations")["innovations"].axes
    labels = [panel.get_ylabel() for panel in panels]
    assert labels == [f"{name} [{unit}]" for name, unit in zip(
        results.component_names(found.fits[0]), 3 * ["arcsec"] + 3 * ["rad/s"], strict=True)]  # fmt: skip
    largest = [np.nanmax(np.abs(panel.lines[0].get_ydata())) for panel in panels]
    factors = [formulas.ARCSEC] * 3 + [1.0] * 3
    innovations, _ = results.innovations(found.fits[0])
    np.testing.assert_allclose(largest, np.nanmax(np.abs(innovations), axis=0) * factors, rtol=1e-12)


TORQUE, FREQUENCY, PHASES = 5e-6, 0.01, np.array([2.1, -0.6, 0.4])
DISPERSED = {
    "disturbance": {"kind": "sinusoid", "amplitude": 3 * [TORQUE], "frequency": 3 * [FREQUENCY]},
    "dispersion": {"disturbance_phase": {"kind": "uniform"}},
}


@pytest.fixture(scope="module")
def disturbed():
    """Return a log (a data frame) with a slow sinusoidal torque, whose phases are not those of the scenario."""
    return flight(
        np.random.default_rng(7), disturbance=lambda t: TORQUE * np.sin(FREQUENCY * t + PHASES)
    )[0]  # fmt: skip


def test_dispersed_phases_are_estimated_by_default_and_not_confused_with_their_mirror_images(disturbed):
    """An earlier version estimated the inertia only, with errors of 60 %, or ended near the phase pi - 2.1."""
    found = explore.identify(satellite(identify={}, **DISPERSED), disturbed)
    assert found.is_identified, found.verdict
    first = found.problem.labels.index("disturbance_phase_1")
    errors = found.estimate - np.concatenate([ENTRIES, PHASES])
    errors[first:] = (errors[first:] + np.pi) % (2.0 * np.pi) - np.pi
    assert np.all(np.abs(errors) < 3.5 * found.std)
    np.testing.assert_allclose(found.prior_std[first:], np.pi / np.sqrt(3.0))  # of a uniform angle
    written: Any = found.identified_scenario
    np.testing.assert_allclose(written.disturbance.phase, found.estimate[first:])
    assert written.dispersion.disturbance_phase is None


def test_an_amplitude_of_zero_is_fixed_and_does_not_change_the_verdict():
    """Regression: two amplitudes of zero were undetermined, and the sentence named the first amplitude."""
    term = {"kind": "sinusoid", "amplitude": [0.5 * TORQUE, 0.0, 0.0], "frequency": 3 * [FREQUENCY]}
    names = ("disturbance_amplitude", "disturbance_bias")
    loaded = satellite(names, disturbance=term, spacecraft={"inertia": TRUE.tolist()})
    (frame, _) = flight(
        np.random.default_rng(7), disturbance=lambda t: TORQUE * np.array([np.sin(FREQUENCY * t), 0.0, 0.0])
    )
    found = explore.identify(loaded, frame)
    assert found.is_identified, found.verdict
    assert abs(found.estimate[0] - TORQUE) < 3.5 * found.std[0] < 0.05 * TORQUE
    np.testing.assert_array_equal([found.estimate[1:3], found.std[1:3]], 0.0)
    none = scenario.replace(loaded, disturbance__amplitude=[0.0, 0.0, 0.0])
    with pytest.raises(ScenarioError, match=r"identify.free has disturbance_amplitude, which this scenario does not"):
        explore.identify(none, frame)


def test_only_phases_of_sinusoids_are_mirrored(disturbed):
    """Phases p and p + pi of a gravity gradient have the same torque, and p + pi is no mirror image."""
    terms = [{"kind": "gravity_gradient"}, DISPERSED["disturbance"]]
    loaded = satellite(("disturbance_phase",), disturbance={"kind": "sum", "terms": terms})
    problem = parameters.build(loaded, [telemetry.measurements(loaded, disturbed)])
    assert problem.labels == [f"disturbance_phase_{k}" for k in (1, 2, 3, 4)]
    assert problem.phases == [1, 2, 3]
    np.testing.assert_allclose(problem.numbers(problem.mirror_phase(np.zeros(4), 2)), [0.0, 0.0, -np.pi, 0.0])


def test_a_phase_that_the_log_does_not_tell_from_its_mirror_image_is_named():
    """The result counts as not identified, and the written scenario keeps the dispersion of the phase."""
    frame = flight(np.random.default_rng(7), disturbance=lambda t: TORQUE * np.sin(PHASES))[0]
    slow = {"kind": "sinusoid", "amplitude": 3 * [TORQUE], "frequency": 3 * [1e-6]}
    found = explore.identify(satellite(identify={}, **{**DISPERSED, "disturbance": slow}), frame)
    assert found.fits[0].is_white
    assert not found.is_identified
    sentences = [f"the data do not tell disturbance_phase_{k} from its mirrored value" for k in (1, 2, 3)]
    assert found.undetermined == sentences
    written: Any = found.identified_scenario
    assert written.dispersion.disturbance_phase is not None  # the identified phase may be the wrong one


def test_a_wrong_model_does_not_reject_correct_readings_and_has_wide_intervals(disturbed):
    """An earlier version rejected the attitudes as outliers, and its errors were up to 75 standard deviations."""
    found = explore.identify(satellite(**DISPERSED), disturbed)
    assert not found.is_identified
    assert found.fits[0].outlier_count == 0
    assert np.all(np.abs(found.estimate - ENTRIES) < 3.5 * found.std)
    assert "free disturbance_phase, which [dispersion] varies" in found.verdict[0]


class ScriptedSearch(estimation.Search):
    """A search of one phase with given results.

    local: results of successive local searches. mirrored: results or exceptions of successive searches from a mirrored
    phase. `tolerances` records the tolerances of the latter.
    """

    def __init__(self, local, mirrored):
        problem: Any = SimpleNamespace(
            phases=[0], labels=["disturbance_phase"], parameters=[], size=1, has_prior=lambda: np.zeros(1),
            mirror_phase=lambda z, k: np.pi - z, numbers=lambda z: z,
            derivatives=lambda z: np.eye(1),
        )  # fmt: skip
        super().__init__(problem, [], np.inf, lambda text: None)
        self.local, self.mirrored = list(local), list(mirrored)
        self.tolerances = []

    def search_locally(self, z, acceleration):
        """Return the next result of `local`, and set the acceleration noise to that of the result."""
        result = self.local.pop(0)
        self.acceleration_noise = result.acceleration_noise
        return result

    def _screen_and_maximise(self, z, screenings=1, tolerance=1e-3):
        """Record the tolerance, and return or raise the next given result from a mirrored phase."""
        self.tolerances.append(tolerance)
        result = self.mirrored.pop(0)
        if isinstance(result, BaseException):
            raise result
        return result


def local_result(phase, log_likelihood, noise=0.0, mean_square=1.0):
    """Return the result of a local search that converged to this phase [rad].

    noise: acceleration noise of the filter [rad/s^1.5]. mean_square: of the innovations, relative to their variance.
    """
    return estimation.SearchResult(np.array([phase]), log_likelihood, np.eye(1), mean_square, True, 1, noise)


@pytest.mark.parametrize(("gain", "noise"), [(5.0, 0.0), (9.0, 0.1)])
def test_noise_on_the_acceleration_is_kept_only_for_a_large_gain_of_the_likelihood(gain, noise):
    """The search compares a result with noise on the acceleration in the filter and a result without."""
    noisy, quiet = local_result(0.4, 100.0 + gain, 0.1), local_result(0.4, 100.0)
    search = ScriptedSearch([noisy, quiet], 2 * [local_result(2.7, 0.0)])
    assert search.find_best(np.zeros(1), 1.0, 2).acceleration_noise == noise


def test_phases_of_a_better_starting_point_are_mirrored_too():
    """A disturbance with the mirrored phase pi - p may be more likely than one with the phase p of a result."""
    first, second = local_result(0.4, 0.0, mean_square=9.0), local_result(-0.8, 100.0)
    mirrored = local_result(-2.3, 200.0)
    search = ScriptedSearch([first, second], [local_result(2.7, -1.0), mirrored, mirrored, second])
    best = search.find_best(np.zeros(1), 1.0, 2)
    assert best.z == -2.3
    assert not best.ambiguities  # the mirrored phase of the first starting point is ambiguous


def test_only_a_mirrored_phase_that_is_more_likely_is_searched_with_the_full_accuracy():
    """Regression: searches from mirrored phases took 90 % of the evaluations of a log of a flexible satellite."""
    mirrored = local_result(2.7, 100.0)
    search = ScriptedSearch([local_result(0.4, 0.0)], [mirrored, mirrored, local_result(0.4, 0.0)])
    assert search.find_best(np.zeros(1), 1.0, 3).z == 2.7
    assert [tolerance <= estimation.STEP_TOLERANCE for tolerance in search.tolerances] == [False, True, False]


def test_the_search_ends_after_a_second_starting_point_that_is_about_as_likely():
    noisy = [local_result(0.4, 100.0, 0.1), local_result(0.4, 97.0, 0.1), local_result(0.4, 500.0)]
    search = ScriptedSearch(noisy, 3 * [local_result(2.7, 0.0)])
    assert search.find_best(np.zeros(1), 1.0, 3).log_likelihood == 100.0
    assert len(search.local) == 1


def test_an_interrupted_search_keeps_its_first_result_as_not_converged():
    """Regression: Ctrl-C discarded all estimates."""
    search = ScriptedSearch([local_result(0.4, 100.0)], [KeyboardInterrupt()])
    best = search.find_best(np.zeros(1), 1.0, 3)
    assert best.z == 0.4
    assert not best.converged


class RuggedSearch(ScriptedSearch):
    """A search whose likelihood increases at every third evaluation only, without end."""

    def derivatives(self, z, logs, *, exact=True):
        """Return a likelihood that increases at every third evaluation, and constant derivatives.

        Gradient (1,), information (1, 1) and mean square of the innovations are 1.
        """
        self._evaluations += 1
        return float(self._evaluations) if self._evaluations % 3 == 1 else -1.0, np.ones(1), np.eye(1), 1.0


@pytest.mark.parametrize("tolerance", [estimation.STEP_TOLERANCE, estimation.COARSE_TOLERANCE])
def test_a_search_ends_after_a_limited_number_of_evaluations(tolerance):
    """Regression: the number of steps was limited, but not their evaluations. The progress states their number."""
    search, reports = RuggedSearch([], []), []
    search.report = reports.append
    assert not search.maximise_likelihood(np.zeros(1), [], tolerance).converged
    limit = estimation.MAX_EVALUATIONS if tolerance == estimation.STEP_TOLERANCE else estimation.MAX_COARSE_EVALUATIONS
    assert limit - 3 < int(reports[-1].split(" evaluations")[0].split()[-1]) <= limit + 2


@pytest.mark.parametrize("length", [1, 10, 100])
def test_intervals_are_wider_if_innovations_are_not_white(length):
    """Regression: correlations over more than 25 readings did not count."""
    rng, count = np.random.default_rng(0), 20_000
    noise = rng.standard_normal((count + length, 3))
    value = sum(noise[k : count + k] for k in range(length)) / np.sqrt(length)  # sums: `length`
    t, there = np.arange(count + 1.0), np.ones((count + 1, 3), bool)
    log = telemetry.Measurements("a log", t, {}, np.zeros((count + 1, 3)))
    rows = filtering.Rows(t, np.ones(count + 1), {}, there, log.command, np.zeros(3), np.arange(count + 1))
    none = filtering.FilterState(None, None, None, None, None)
    fit = estimation.Fit(log, rows, filtering.Innovations(value, np.ones_like(value), there[1:]), none)
    assert fit.variance_factor == 1.0 if length == 1 else 0.8 * length < fit.variance_factor < 1.5 * length  # of three


def test_the_search_converges_if_a_log_hardly_determines_some_moments():
    """A slew about one axis. An earlier version crept along a narrow curved ridge of the likelihood."""
    loaded = scenario.from_tables({
        "spacecraft": {"inertia": [0.05, 0.09, 0.11]},
        "initial": {"rotvec_deg": [40.0, 0.0, 0.0]},
        "controller": {"error": "multiplicative", "t_f": 60.0},
        "loop": {"mode": "sampled", "period": 0.25, "t_end": 85.0},
        "disturbance": {"kind": "none"},
        "hardware": {"torque_lag": 0.05, "attitude_noise": 5e-5, "rate_noise": 1.4e-4, "rate_bias": 1e-4},
        "wheels": {"kind": "axes"},
    })  # fmt: skip
    frame = explore.simulate(loaded).to_polars()
    found = explore.identify(scenario.replace(loaded, spacecraft__inertia=[0.055, 0.085, 0.11]), frame)
    assert found.is_identified, found.verdict
    true = np.array([0.05, 0.0, 0.0, 0.09, 0.0, 0.11])
    assert np.all(np.abs(found.estimate - true) < 3.5 * found.std)


def test_the_search_converges_if_the_axes_of_all_slews_are_nearly_in_a_plane():
    """The log hardly determines the moment about the normal. An earlier version blamed the model and did not converge.

    Its steps were straight in the coordinates of the inertia. The ridge of the likelihood is curved there.
    """
    rng = np.random.default_rng(2)
    axes = (
        np.array([[1.0, 0.2, 0.0], [0.3, 1.0, 0.0], [-0.7, 0.6, 3e-4]]) @ np.linalg.qr(rng.standard_normal((3, 3)))[0]
    )
    command = np.zeros((601, 3))
    command[:600] = 1e-3 * np.kron(axes, np.sin(2.0 * np.pi * np.arange(200) / 200.0)[:, None])
    (frame,), _ = synthetic.logs(rng, TRUE, dt=0.25, rows=601, wheels=True, lag=0.05, command=command)
    found = explore.identify(satellite(wheels={"kind": "axes"}), frame)
    assert found.is_identified, found.verdict
    assert np.max(found.std / np.abs(ENTRIES)) > 0.1  # it is the difficult case
    assert np.all(np.abs(found.estimate - ENTRIES) < 3.5 * found.std)


@pytest.mark.long
def test_a_proposed_manoeuvre_is_within_the_limits_and_as_accurate_as_expected():
    """It is more accurate than plain slews, and reaches one of the limits. It starts and ends at rest."""
    limits = {"torque_limit": 2e-3, "momentum_limit": 4e-3}
    loaded = satellite(spacecraft={"inertia": TRUE.tolist()}, wheels={"kind": "axes", **limits})
    proposed = design.design(loaded, 60.0, rate=0.05)
    command = proposed.frame.select("^sent.$").to_numpy()
    momentum = 0.25 * np.cumsum(command, axis=0)
    rate = np.max(np.abs(proposed.frame.select("^measured_w.$").to_numpy()))
    ratios = np.array([np.max(np.abs(command)) / 2e-3, np.max(np.abs(momentum)) / 4e-3, rate / 0.05])
    assert 0.9 < np.max(ratios) <= 1.0
    assert np.max(np.abs(momentum[-1])) < 1e-12  # from rest to rest
    assert np.linalg.norm(proposed.std) < np.linalg.norm(proposed.plain_std)
    (frame,), _ = synthetic.logs(
        np.random.default_rng(1), TRUE, dt=0.25, rows=241, wheels=True, lag=0.05, command=command
    )
    start = satellite(telemetry={"wheel_torque": ["sent1", "sent2", "sent3"]})
    found = explore.identify(start, frame)
    assert found.is_identified, found.verdict
    np.testing.assert_allclose(found.std, proposed.std, rtol=0.1)
    assert np.all(np.abs(found.estimate - ENTRIES) < 3.5 * proposed.std)


def test_fast_rotation_of_a_log_is_integrated_accurately():
    rng = np.random.default_rng(1)
    (frame,), _ = synthetic.logs(rng, TRUE, dt=0.1, rows=300, wheels=True, lag=0.05, rate=(3.0, 2.0, -3.0))
    found = explore.identify(satellite(), frame)
    assert found.fits[0].is_white
    assert np.all(np.abs(found.estimate - ENTRIES) < 3.5 * found.std)


@pytest.mark.parametrize("samples", [11, 20, 60, 300])
def test_the_verdict_on_short_logs_is_calibrated(samples):
    """Hardly any verdict on a right model is negative. Noise of twice the stated size is always detected."""
    rng, wrong, detected = np.random.default_rng(samples), 0, 0
    t, there = np.arange(samples + 1.0), np.ones((samples + 1, 6), bool)
    log = telemetry.Measurements("a log", t, {}, np.zeros((samples + 1, 3)))
    rows = filtering.Rows(t, np.ones(samples + 1), {}, there, log.command, np.zeros(3), np.arange(samples + 1))
    none = filtering.FilterState(None, None, None, None, None)
    for _ in range(200):
        value = rng.standard_normal((samples, 6))
        fits = [
            estimation.Fit(log, rows, filtering.Innovations(factor * value, np.ones_like(value), there[1:]), none)
            for factor in (1.0, 2.0)
        ]
        wrong, detected = wrong + (not fits[0].is_white), detected + (not fits[1].is_white)
    assert wrong <= 8  # of 200; 1 % of the verdicts are wrong, so that more has a probability of 2e-4
    assert detected == 200  # the noise is twice as large as in the model


def test_every_value_of_the_search_coordinates_is_the_inertia_of_a_rigid_body():
    rng = np.random.default_rng(0)
    root = jnp.asarray(numbers.pseudo_root(np.diag([0.05, 0.09, 0.1399])))  # nearly flat
    many = jax.vmap(lambda c: numbers.from_coordinates(root, c))(3.0 * rng.standard_normal((500, 6)))
    moments = np.linalg.eigvalsh(np.asarray(many))
    assert np.all(moments[:, 0] > 0.0)
    assert np.all(moments[:, 2] <= (moments[:, 0] + moments[:, 1]) * (1.0 + 1e-12))
    np.testing.assert_allclose(numbers.from_coordinates(root, jnp.zeros(6)), np.diag([0.05, 0.09, 0.1399]), rtol=1e-12)


@pytest.mark.parametrize(
    ("moments", "dispersion"),
    [
        ([0.05, 0.09, 0.11], {"std": 0.03}),
        ([0.05, 0.09, 0.11], {"std": 0.03, "axes_deg": 2.0}),
        ([0.05, 0.09, 0.09], {"std": 0.05, "axes_deg": 5.0}),
        ([[0.07, 0.02, 0.0], [0.02, 0.07, 0.0], [0.0, 0.0, 0.11]], {"std": 0.03}),
        ([0.05, 0.09, 0.11], {"kind": "correlated"}),
    ],
)
def test_the_prior_knowledge_of_the_inertia_is_that_of_its_dispersion(moments, dispersion):
    """Regression: products of inertia were uncertain even if the dispersion keeps the principal axes."""
    loaded = satellite(("inertia",), spacecraft={"inertia": moments}, dispersion={"inertia": dispersion})
    loaded = scenario.replace(loaded, identify__prior="dispersion")
    frame, _ = flight(np.random.default_rng(2))
    problem = parameters.build(loaded, [telemetry.measurements(loaded, frame)])
    ready = scenario.study(loaded)
    draw = jax.jit(jax.vmap(lambda trial: ready.dispersion.apply(ready.parts, 0, trial).plant.inertia))
    drawn = np.asarray(draw(jnp.arange(4000)))[:, *np.triu_indices(3)]
    prior_std = np.linalg.norm(problem.derivatives(np.zeros(problem.size)), axis=1)
    np.testing.assert_allclose(prior_std, np.std(drawn, axis=0), rtol=0.1, atol=1e-12)


def test_principal_axes_without_a_dispersion_are_kept_and_the_verdict_names_them():
    frame, _ = flight(np.random.default_rng(2), rate=(0.02, -0.01, 0.03))
    loaded = satellite(identify={"free": ["inertia", "gyro_bias"]}, dispersion={"inertia": {"std": 0.3}})
    found = explore.identify(loaded, frame)
    products = [label in ("inertia_12", "inertia_13", "inertia_23") for label in found.problem.labels]
    assert np.all(found.estimate[products] == 0.0)
    assert np.all(found.std[products] == 0.0)
    assert "axes_deg" in found.verdict[0]  # the log has products of inertia
    written: Any = found.identified_scenario
    np.testing.assert_array_equal(np.array(written.dispersion.inertia.matrix())[3:], 0.0)  # those of the products


def test_the_variance_of_the_data_but_not_of_prior_knowledge_is_inflated():
    data, factor = np.array([1e-9, 0.5, 50.0, 1e4]), 100.0
    # variance of the mean of a measurement with variance factor / data and of prior knowledge with variance 1
    expected = (data**2 * (factor / data) + 1.0) / (data + 1.0) ** 2
    found = estimation.inflated_covariance(np.diag(data + 1.0), np.eye(4), factor)
    np.testing.assert_allclose(found, np.diag(expected), rtol=1e-12, atol=1e-12)
    without_prior = estimation.inflated_covariance(np.diag(data), np.zeros((4, 4)), factor)
    np.testing.assert_allclose(np.diag(without_prior)[2:], factor / data[2:])


def test_prior_knowledge_determines_what_the_data_do_not():
    """`determines_all` judges the Fisher information of the data, without and with the prior.

    An earlier version denied that the prior determines all for half of the matrices, because of rounding errors.
    """
    for seed in range(20):
        derivatives = 1e3 * np.random.default_rng(seed).standard_normal((500, 4))
        derivatives[:, 3] = -np.sum(derivatives[:, :3], axis=1)  # equal changes of all coordinates have no effect
        data = derivatives.T @ derivatives
        assert estimation.determines_all(data + np.eye(4))
        assert not estimation.determines_all(data)


@pytest.mark.long
def test_identify_states_that_only_the_ratio_of_inertia_to_actuator_scale_is_determined():
    frame, _ = flight(np.random.default_rng(2))
    body = {"hardware": {"attitude_noise": 5e-5, "rate_noise": 1.4e-4, "torque_lag": 0.05}}
    found = explore.identify(satellite(("inertia", "actuator_scale", "gyro_bias"), **body), frame)
    assert any("only the ratio of inertia to actuator_scale" in line for line in found.undetermined)
    assert not found.is_identified


@pytest.mark.long
def test_wheel_speeds_of_a_log_replace_its_commanded_torque():
    frame, _ = flight(np.random.default_rng(4))
    table = {"wheel_speed": ["speed1", "speed2", "speed3"], "wheel_inertia": synthetic.SPIN_INERTIA}
    found = explore.identify(satellite(telemetry=table), frame.drop("sent1", "sent2", "sent3"))
    assert found.is_identified, results.verdict(found)
    assert np.all(np.abs(found.estimate - ENTRIES) < 3.5 * found.std)


@pytest.mark.long
def test_a_flexible_mode_is_identified_from_a_simulated_run():
    loaded = scenario.from_tables({
        "spacecraft": {"inertia": [4.0, 5.0, 6.0]},
        "flexible": {"frequency": [3.0], "damping": [0.0], "coupling": [[0.7, 0.0, 0.0]]},
        "controller": {"t_f": 15.0, "error": "multiplicative"},
        "loop": {"mode": "sampled", "period": 0.1},
        "disturbance": {"kind": "none"},
        "hardware": {"attitude_noise": 2e-5, "rate_noise": 1e-5},
        "identify": {"free": ["mode_frequency", "mode_coupling", "mode_damping", "inertia"], "prior": "none"},
    })  # fmt: skip
    frame = explore.simulate(loaded).to_polars()
    off = scenario.replace(loaded, flexible__frequency=[3.3], flexible__coupling=[[0.6, 0.0, 0.0]])
    found = explore.identify(scenario.replace(off, flexible__damping=[0.01]), frame)
    true = np.array([3.0, 0.7, 0.0, 0.0, 0.0, 4.0, 0.0, 0.0, 5.0, 0.0, 6.0])
    assert found.fits[0].is_white
    assert np.all(np.abs(found.estimate - true) < 3.5 * found.std + 1e-12)
    written: Any = results.identified_scenario(found)
    (damping,) = written.flexible.damping
    assert damping == max(found.estimate[4], 0.0)  # an estimate of zero may be negative


@pytest.mark.long
def test_parameters_of_actuators_sensors_and_disturbance_are_identified_from_a_simulated_run():
    hardware = {
        "torque_lag": 0.2, "delay": 1, "actuator_scale": [1.04, 0.97, 1.02],
        "actuator_misalignment_deg": [[0.0, 0.5, -0.8], [0.6, 0.0, 0.4], [-0.5, 0.7, 0.0]],
        "gyro_scale": [1.004, 0.997, 1.002], "star_tracker_misalignment_deg": [0.2, -0.3, 0.1],
        "attitude_noise": 2e-5, "rate_noise": 3e-5,
    }  # fmt: skip
    true: Any = scenario.from_tables({
        "spacecraft": {"inertia": [3.0, 4.0, 5.0]},
        "loop": {"mode": "sampled", "period": 0.25, "t_end": 50.0},
        "initial": {"rotvec_deg": [40.0, -50.0, 30.0], "rate": [0.03, -0.02, 0.04]},
        "controller": {"t_f": 40.0, "delta": 2.0},
        "disturbance": {"kind": "sinusoid", "amplitude": [2e-3, 3e-3, 1e-3], "frequency": [0.5, 0.7, 0.9]},
        "hardware": hardware,
        "identify": {
            "free": [*(name.removesuffix("_deg") for name in hardware), "disturbance_amplitude"], "prior": "none",
        },
    })  # fmt: skip
    start = scenario.replace(true, hardware={"torque_lag": 0.1, "attitude_noise": 4e-5, "rate_noise": 2e-5})
    start = scenario.replace(start, disturbance__amplitude=[1e-3, 1e-3, 1e-3])
    found = explore.identify(start, explore.simulate(true).to_polars())
    assert found.is_identified, found.verdict
    written: Any = found.identified_scenario
    (delay,) = (index for index, label in enumerate(found.problem.labels) if label == "delay")
    assert abs(found.estimate[delay] - 0.25) < 3.5 * found.std[delay]
    for key, value in hardware.items():
        name = key.removesuffix("_deg")
        std = max(s for label, s in zip(found.problem.labels, found.std, strict=True) if label.startswith(name))
        std = np.rad2deg(std) if key.endswith("_deg") else std
        np.testing.assert_allclose(getattr(written.hardware, key), value, rtol=0.0, atol=3.5 * std + 1e-12)
    np.testing.assert_allclose(written.disturbance.amplitude, true.disturbance.amplitude, rtol=0.02)


def test_numbers_of_a_custom_plant_are_identified_and_named_by_function_and_argument():
    def acceleration(stiffness, t, x_1, x_2, drag):
        return -stiffness * jnp.sin(x_1) - drag * x_2

    def pendulum(stiffness, drag):
        numbers = jax.tree_util.Partial(acceleration, jnp.asarray(stiffness), drag=jnp.asarray(drag))
        system = plants.system(1, lambda t, x_1, x_2: x_2, numbers, lambda t, x_1, x_2: jnp.eye(1) / 0.5)
        return scenario.from_tables({
            "plant": {"kind": "system", "system": system, "x0": [1.0, 0.0]},
            "controller": {"t_f": 4.0},
            "disturbance": {"kind": "none"},
            "loop": {"mode": "sampled", "period": 0.05},
            "hardware": {"state_noise": [1e-3, 1e-3]},
            "identify": {"free": ["plant.H[0]", "plant.H['drag']"], "prior": "none"},
        })  # fmt: skip

    found = explore.identify(pendulum(8.0, 0.2), explore.simulate(pendulum(9.81, 0.1)).to_polars())
    assert found.is_identified, found.verdict
    assert np.all(np.abs(found.estimate - [9.81, 0.1]) < 3.5 * found.std)
    assert np.all(found.std < [0.01, 0.01])


def test_numbers_of_a_custom_pytree_in_a_custom_plant_have_different_names():
    """Classes without keys number their leaves. Earlier, all of them had one name, and only the first was known."""

    @jax.tree_util.register_pytree_node_class
    class Pendulum:
        def __init__(self, stiffness, drag):
            self.numbers = stiffness, drag

        def __call__(self, t, x_1, x_2):
            stiffness, drag = self.numbers
            return -stiffness * jnp.sin(x_1) - drag * x_2

        def tree_flatten(self):
            return self.numbers, None

        @classmethod
        def tree_unflatten(cls, _, numbers):
            return cls(*numbers)

    pendulum = Pendulum(jnp.asarray(9.81), jnp.asarray(0.1))
    loaded = scenario.from_tables({
        "plant": {
            "kind": "system",
            "system": plants.system(1, lambda t, x_1, x_2: x_2, pendulum, lambda t, x_1, x_2: jnp.eye(1)),
            "x0": [1.0, 0.0],
        },
        "loop": {"mode": "sampled"},
        "hardware": {"state_noise": [1e-3, 1e-3]},
    })  # fmt: skip
    log = telemetry.measurements(loaded, explore.simulate(loaded).to_polars())
    names = ["plant.H[<flat index 0>]", "plant.H[<flat index 1>]"]
    problem = parameters.build(loaded, [log], names)
    np.testing.assert_allclose(problem.numbers(np.zeros(2)), pendulum.numbers, rtol=1e-12)


def test_noise_of_a_star_tracker_is_about_its_own_axes():
    """A run with a tilted star tracker, whose noise about the boresight is 10 times as large as across it."""
    tables = {
        "spacecraft": {"inertia": [3.0, 4.0, 5.0]},
        "loop": {"mode": "sampled", "period": 0.25, "t_end": 80.0},
        "initial": {"rotvec_deg": [20.0, -25.0, 15.0]},
        "controller": {"t_f": 40.0, "delta": 2.0},
        "disturbance": {"kind": "none"},
        "sensors": [
            {"kind": "star_tracker", "boresight": [1.0, 1.0, 0.5], "noise_across": 2e-5, "noise_about": 2e-4},
            {"kind": "gyro", "rate_noise": 2e-5},
        ],
        "identify": {"prior": "none"},
    }
    loaded = scenario.from_tables(tables)
    frame = explore.simulate(loaded, trial=3).to_polars()
    found = explore.identify(loaded, frame)
    (fit,) = found.fits
    assert fit.is_white
    each = np.nanmean(fit.whitened**2, axis=0)
    assert np.all(np.abs(each - 1.0) < 4.0 * np.sqrt(2.0 / len(fit.whitened)))  # 4 sigma of a mean of squares
    with pytest.raises(ScenarioError, match=r"identify.free has gyro_scale, which this scenario does not have"):
        explore.identify(loaded, frame, free=["inertia", "gyro_scale"])


def test_unknown_parameters_and_logs_with_different_readings_are_refused():
    frame, _ = flight(np.random.default_rng(2))
    with pytest.raises(ScenarioError, match=r"identify.free has inertias, which this scenario does not have; the near"):
        explore.identify(satellite(["inertias"]), frame)
    with pytest.raises(ScenarioError, match=r"identify.free has mode_frequency, which this scenario does not have"):
        explore.identify(satellite(["mode_frequency"]), frame)
    without = frame.drop("measured_q1", "measured_q2", "measured_q3", "measured_q4")
    with pytest.raises(ScenarioError, match="log 2 has other readings than log 1"):
        explore.identify(satellite(), [frame, without])
