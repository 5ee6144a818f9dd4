"""The filter of `ptsmc identify` against independent filters, closed forms and finite differences."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import polars as pl
import pytest
from scipy.linalg import expm

from ptsmc_jax import explore, scenario
from ptsmc_jax.identification import estimation, filtering, parameters, telemetry
from tests.identification import synthetic

NOISE, WALK = (2e-3, 5e-3), 0.02


def chain(free, **identify):
    """Return the scenario of a noisy double integrator.

    free: parameters to estimate. identify: other keys of [identify].
    """
    return scenario.from_tables(
        {
            "plant": {"kind": "chain", "order": 2, "x0": [1.0, 0.0]},
            "controller": {"t_f": 5.0},
            "disturbance": {"kind": "none"},
            "loop": {"mode": "sampled", "period": 0.1},
            "hardware": {"state_noise": list(NOISE)},
            "identify": {"free": free, "prior": "none", "outliers": 0.0, **identify},
        }
    )


def chain_log(rows=60, bias=0.3, walk=0.0, scale=1.0):
    """Return a log (a data frame) of a double integrator at irregular times, and its columns t, u and y (rows, 2).

    Some samples of y are missing (NaN). bias, walk: of the disturbance. scale: ratio of true to commanded input.
    """
    rng = np.random.default_rng(3)
    dt = rng.uniform(0.03, 0.12, rows)
    t = np.cumsum(dt) - dt[0]
    u = np.sin(1.3 * t) + 0.2 * rng.standard_normal(rows)
    x, d, states = np.array([1.0, -0.4]), bias, []
    for k in range(rows):
        states.append(x + np.asarray(NOISE) * rng.standard_normal(2))
        if k + 1 < rows:
            h = t[k + 1] - t[k]
            d = d + walk * np.sqrt(h) * rng.standard_normal()
            x = np.array([[1.0, h], [0.0, 1.0]]) @ x + np.array([h**2 / 2, h]) * (scale * u[k] + d)
    y = np.stack(states)
    y[5:8, 0], y[20:22] = np.nan, np.nan
    columns = {"t": t, "measured_x1": y[:, 0], "measured_x2": y[:, 1], "sent1": u}
    return pl.DataFrame(columns), t, u, y


def prepared(loaded, frame):
    """Return the estimation problem of a scenario and its log, and the log prepared for the filter."""
    log = telemetry.measurements(loaded, frame)
    problem = parameters.build(loaded, [log])
    return problem, estimation.prepare_log(problem, log)


def test_innovations_are_those_of_an_independent_kalman_filter():
    frame, t, u, y = chain_log()
    problem, (rows, kind) = prepared(chain(["actuator_scale"], torque_walk=WALK), frame)
    found, track = jax.jit(lambda rows: filtering.run_filter(problem.model, rows, kind))(
        jax.tree.map(jnp.asarray, rows)
    )
    # exact discretisation by the matrix exponential, joint update of both readings, covariance form of Joseph
    whitened = np.where(found.accepted, found.value / np.sqrt(found.variance), np.nan)[rows.log_row[1:] >= 0]
    z, p = np.append(y[0], 0.0), np.diag([*np.square(NOISE), 0.0])
    expected, ends = np.full((len(t) - 1, 2), np.nan), np.flatnonzero(rows.log_row[1:] >= 0)
    steps = np.append(rows.t, np.nan)
    row = 0
    for k in range(1, len(t)):
        while rows.log_row[row + 1] != k:
            row += 1
        last = next(j for j in range(row, -1, -1) if rows.log_row[j] == k - 1)
        for j in range(last, row + 1):
            h = steps[j + 1] - steps[j]
            f = expm(h * np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]]))
            g = expm(h * np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]]))[:, 2]
            p = p + np.diag([0.0, 0.0, WALK**2 * h])
            z, p = f @ z + np.append(g[:2], 0.0) * u[k - 1], f @ p @ f.T
        there = ~np.isnan(y[k])
        c, r = np.eye(2, 3)[there], np.diag(np.square(NOISE))[there][:, there]
        if there.any():
            s = c @ p @ c.T + r
            error = y[k, there] - c @ z
            expected[k - 1, there] = np.linalg.solve(np.linalg.cholesky(s), error)
            gain = p @ c.T @ np.linalg.inv(s)
            keep = np.eye(3) - gain @ c
            z, p = z + gain @ error, keep @ p @ keep.T + gain @ r @ gain.T
    # rounding of 60 updates; the squares of the innovations add up to about 100
    np.testing.assert_allclose(whitened, expected, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(np.asarray(track.covariance)[ends[-1]], p, rtol=1e-8, atol=1e-14)


def test_a_linear_gaussian_estimate_is_that_of_generalised_least_squares():
    frame, t, u, y = chain_log()
    found = explore.identify(chain(["disturbance_bias"]), frame)
    # unknown initial state and constant disturbance: a linear regression with known noise
    design, forced, state = [], [], np.zeros(2)
    response = np.eye(2, 3)
    for k in range(len(t)):
        if k:
            h = t[k] - t[k - 1]
            f, b = np.array([[1.0, h], [0.0, 1.0]]), np.array([h**2 / 2, h])
            response = f @ response + np.outer(b, [0.0, 0.0, 1.0])
            state = f @ state + b * u[k - 1]
        design.append(response / np.asarray(NOISE)[:, None])
        forced.append((y[k] - state) / NOISE)
    a, b = np.concatenate(design), np.concatenate(forced)
    a, b = a[np.isfinite(b)], b[np.isfinite(b)]
    estimate, covariance = np.linalg.lstsq(a, b, rcond=None)[0], np.linalg.inv(a.T @ a)
    np.testing.assert_allclose(found.estimate, estimate[2:], rtol=1e-6)  # the search stops at 1e-3 sigma
    np.testing.assert_allclose(found.std, np.sqrt(covariance[2, 2]), rtol=1e-6)
    assert found.is_identified


@pytest.mark.parametrize("delays", [(1, 0), (0, 1)])
def test_a_delay_is_identified_from_a_scenario_without_a_delay_and_the_other_way_round(delays):
    """Regression: the likelihood had no derivative at delays of zero and below, and the search ended there."""
    true, start = (
        scenario.replace(chain(["delay", "disturbance_bias"]), hardware={"state_noise": list(NOISE), "delay": delay})
        for delay in delays
    )
    found = explore.identify(start, explore.simulate(true).to_polars())
    assert found.is_identified, found.verdict
    assert abs(found.estimate[0] - 0.1 * delays[0]) < 3.5 * found.std[0] < 0.01
    assert found.identified_scenario.hardware.delay == delays[0]


@pytest.mark.parametrize(("hardware", "sentences"), [({"state_noise": [4e-3, 5e-3]}, 1), ({}, 0)])
def test_the_verdict_states_the_ratio_of_an_estimated_noise_to_that_of_the_scenario(hardware, sentences):
    """The innovations fit an estimated noise. Without a noise in the scenario, there is nothing to compare."""
    loaded = scenario.replace(chain(["disturbance_bias", "state_noise"]), hardware=hardware)
    found = explore.identify(loaded, chain_log()[0])
    lines = [line for line in found.verdict if "ratio of the estimated noise to its value in the scenario" in line]
    assert len(lines) == sentences
    ratio = found.estimate[found.problem.labels.index("state_noise_1")] / 4e-3
    assert all(f"state_noise_1 {ratio:.3g}, state_noise_2 " in line for line in lines)
    assert abs(ratio - 0.5) < 0.2


def test_the_gradient_of_the_likelihood_agrees_with_finite_differences():
    frame, *_ = chain_log(scale=1.1)
    names = ["actuator_scale", "state_noise", "disturbance_bias", "delay"]
    problem, log = prepared(chain(names, torque_walk=WALK), frame)
    search = estimation.Search(problem, [log], np.inf, lambda text: None)
    z = 0.3 * np.random.default_rng(1).standard_normal(problem.size)
    z[-1] = 0.37  # a delay between two nodes of the command, where its derivative is continuous

    def value(z):
        return search.derivatives(z, search.logs)[0]

    _, gradient, information, _ = search.derivatives(z, search.logs)
    found = search.innovations(z, log)
    of_log = -0.5 * np.sum(found.accepted * (found.value**2 / found.variance + np.log(found.variance)))
    assert value(z) == pytest.approx(of_log - 0.5 * search.prior_weight @ z**2, rel=1e-12)
    step = 1e-5
    differences = [(value(z + step * one) - value(z - step * one)) / (2.0 * step) for one in np.eye(problem.size)]
    # the truncation error of the differences is about step^2 = 1e-10, their rounding error 1e-16 * value / step
    np.testing.assert_allclose(gradient, differences, rtol=1e-6, atol=1e-6 * np.max(np.abs(gradient)))
    assert np.linalg.eigvalsh(information)[0] > 0.0


@pytest.mark.long
def test_the_gradient_for_a_flexible_spacecraft_agrees_with_finite_differences():
    names = ["inertia", "gyro_scale", "star_tracker_misalignment", "attitude_noise", "torque_lag", "mode_frequency"]
    inertia = np.array([[0.05, 0.002, -0.001], [0.002, 0.09, 0.003], [-0.001, 0.003, 0.11]])
    (frame,), _ = synthetic.logs(np.random.default_rng(3), inertia, dt=0.25, rows=100, wheels=True, lag=0.05)
    loaded = scenario.from_tables({
        "spacecraft": {"inertia": inertia.tolist()},
        "flexible": {"frequency": [3.0], "damping": [0.01], "coupling": [[0.05, 0.0, 0.02]]},
        "loop": {"mode": "sampled", "period": 0.25},
        "disturbance": {"kind": "none"},
        "hardware": {"attitude_noise": 5e-5, "rate_noise": 1.4e-4, "torque_lag": 0.05},
        "wheels": {"kind": "axes"},
        "identify": {"free": [*names, "gyro_bias"], "prior": "none"},
    })  # fmt: skip
    problem, log = prepared(loaded, frame)
    search = estimation.Search(problem, [log], np.inf, lambda text: None)
    z = 0.1 * np.random.default_rng(1).standard_normal(problem.size)
    _, gradient, _, _ = search.derivatives(z, search.logs)
    step = 1e-5
    differences = []
    for one in step * np.eye(problem.size):
        high, low = (search.log_likelihood(z + sign * one) for sign in (1.0, -1.0))
        differences.append((high - low) / (2.0 * step))
    # the log-likelihood is about 1e8, so that the differences have rounding errors of 1e-16 * 1e8 / step = 1e-3
    np.testing.assert_allclose(gradient, differences, rtol=1e-6, atol=1e-9 * np.max(np.abs(gradient)))


def test_the_likelihood_does_not_jump_if_a_reading_is_rejected():
    """Regression: a rejected reading did not count, and the gain or loss depended on the unit of the readings."""
    problem, (rows, kind) = prepared(chain(["actuator_scale"]), chain_log(bias=0.0)[0])
    last = np.flatnonzero(rows.valid[:, 1])[-1]
    found = estimation.Search(problem, [(rows, kind)], 30.0, lambda text: None).innovations(np.zeros(1), (rows, kind))
    likelihoods = []
    for size in (0.999, 1.001):
        x = rows.readings["x"].copy()
        x[last, 1] += size * np.sqrt(30.0 * found.variance[last - 1, 1]) - found.value[last - 1, 1]
        search = estimation.Search(problem, [(rows._replace(readings={"x": x}), kind)], 30.0, lambda text: None)
        rejected = rows.valid[1:] & ~search.reject_outliers(np.zeros(1), search.logs[0])[0].valid[1:]
        assert rejected.sum() == (size > 1.0)
        likelihoods.append(search.log_likelihood(np.zeros(1)))
    assert likelihoods[1] == pytest.approx(likelihoods[0], abs=0.1)


def test_derivatives_without_those_of_the_covariance_are_good_enough_for_a_first_search():
    rng = np.random.default_rng(3)
    inertia = np.array([[0.05, 0.002, -0.001], [0.002, 0.09, 0.003], [-0.001, 0.003, 0.11]])
    (frame,), _ = synthetic.logs(rng, inertia, dt=0.25, rows=257, wheels=True, lag=0.05)
    loaded = scenario.from_tables({
        "spacecraft": {"inertia": inertia.tolist()},
        "loop": {"mode": "sampled", "period": 0.25},
        "disturbance": {"kind": "none"},
        "hardware": {"attitude_noise": 5e-5, "rate_noise": 1.4e-4, "torque_lag": 0.05},
        "wheels": {"kind": "axes"},
        "identify": {"free": ["inertia"], "prior": "none"},
    })  # fmt: skip
    problem, log = prepared(loaded, frame)
    search = estimation.Search(problem, [log], np.inf, lambda text: None)
    z = 0.1 * rng.standard_normal(problem.size)
    exact, approximate = (search.derivatives(z, search.logs, exact=is_exact) for is_exact in (True, False))
    assert approximate[0] == exact[0]
    step = [np.linalg.solve(information, gradient) for _, gradient, information, _ in (exact, approximate)]
    # a search with noise on the acceleration ends at 0.3 sigma, so an error of 5 % of a step is small
    error = step[1] - step[0]
    assert 0.0 < np.sqrt(error @ exact[2] @ error) < 0.05 * np.sqrt(step[0] @ exact[2] @ step[0])


def flexible_body():
    """Return the problem of a spacecraft with two modes, and its prepared log at rest with an interval of 0.1 ms."""
    loaded = scenario.from_tables({
        "spacecraft": {"inertia": [4.0, 5.0, 6.0]},
        "flexible": {"frequency": [3.0, 4.0], "damping": [0.01, 0.01], "coupling": [[0.7, 0.0, 0.2], [0.0, -0.4, 0.1]]},
        "loop": {"mode": "sampled", "period": 0.1},
        "disturbance": {"kind": "none"},
        "hardware": {"attitude_noise": 2e-5},
        "identify": {"free": ["inertia", "mode_frequency"], "prior": "none"},
    })  # fmt: skip
    still = {f"measured_q{k + 1}": np.full(20, float(k == 3)) for k in range(4)}
    silent = {f"sent{k + 1}": np.zeros(20) for k in range(3)}
    return prepared(loaded, pl.DataFrame({"t": 1e-4 * np.arange(20), **still, **silent}))


def test_noise_on_the_acceleration_of_the_body_excites_the_flexible_modes_too():
    problem, (rows, kind) = flexible_body()
    model = replace(problem.model, acceleration_noise=jnp.asarray(0.3), hidden_sigma=jnp.zeros(4))
    _, track = filtering.run_filter(model, jax.tree.map(jnp.asarray, rows), kind)
    assert track is not None
    variance = np.diag(np.asarray(track.covariance)[9])[8:10]
    # white noise n on the acceleration of the body is -D n on that of the modes; other terms are of order dt
    coupling = np.asarray(model.plant.coupling)
    np.testing.assert_allclose(variance, 0.3**2 * 1e-3 * np.sum(coupling**2, axis=1), rtol=1e-2)


@pytest.mark.parametrize(("gate", "coordinate"), [(np.inf, 300.0), (10.0, 2000.0)])
def test_a_local_search_from_parameters_whose_motion_overflows_does_not_converge(gate, coordinate):
    """The frequency is 3e26 rad/s, or infinite. `find_best` continues from a random start.

    An earlier version rejected all readings of the second motion.
    """
    problem, log = flexible_body()
    problem = replace(problem, model=replace(problem.model, hidden_sigma=1e-3 * jnp.ones(4)))
    search = estimation.Search(problem, [log], gate, lambda text: None)
    start = np.append(np.zeros(6), [coordinate, 0.0])
    found = search.search_locally(start, 0.0)
    assert not found.converged
    assert found.log_likelihood == -np.inf
    assert search.find_best(start, 0.0, 2).log_likelihood > -np.inf  # from a random start
