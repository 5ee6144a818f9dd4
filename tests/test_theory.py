import numpy as np
import pytest
from scipy.integrate import solve_ivp

from ptsmc_jax import rollout, signals, theory
from tests.helpers import FULL_INERTIA, PAPER_ATTITUDE, parts, vector


@pytest.mark.parametrize("eta", [2.1, 3.0, 5.5])
def test_exact_error_solves_the_second_order_system(eta):
    """x'' = -(eta-1) x'/tau - eta (tau x' + eta x)/tau^2: the law (10) on (6) with d = 0, K = 0."""

    def rate(t, y):
        tau = 7.0 - t
        return [y[1], -(eta - 1) / tau * y[1] - eta * (tau * y[1] + eta * y[0]) / tau**2]

    times = np.array([0.0, 1.0, 4.0, 6.9])
    y = solve_ivp(rate, (0.0, 6.9), [0.7, -0.3], t_eval=times, rtol=1e-12, atol=1e-14).y
    for k, t in enumerate(times):
        exact = theory.exact_error(vector(t), vector(7.0), vector(eta), vector([0.7]), vector([-0.3]))
        np.testing.assert_allclose(exact.error[0], y[0, k], atol=1e-9)
        np.testing.assert_allclose(exact.error_rate[0], y[1, k], atol=1e-8)
        np.testing.assert_allclose(exact.s[0], (7.0 - t) * y[1, k] + eta * y[0, k], atol=1e-8)


def test_first_torque_against_the_run_and_in_angles():
    body = np.asarray(FULL_INERTIA)
    run = parts(25.0, 3.5, 0.5, inertia=FULL_INERTIA)
    log = rollout.simulate_jit(run, record=True).log
    assert log is not None
    first = theory.first_torque(vector(body), vector(PAPER_ATTITUDE), vector(3.5), vector(25.0))
    np.testing.assert_allclose(log.u[0], first, rtol=1e-12)
    angle, axis = 2 * np.arccos(PAPER_ATTITUDE[3]), PAPER_ATTITUDE[:3] / np.linalg.norm(PAPER_ATTITUDE[:3])
    np.testing.assert_allclose(np.abs(first), 2 * 3.5**2 * np.abs(body @ axis) * np.tan(angle / 2) / 25.0**2)


@pytest.mark.parametrize("eta", [2.05, 2.1, 2.2, 2.3])
def test_later_peak_of_small_eta(eta):
    """A small slew without disturbance: the braking peak, its size over the first torque and its time."""
    small = np.array([0.0, 0.0, np.sin(0.01), np.cos(0.01)])
    quiet = signals.Constant(vector([0.0] * 3))
    run = parts(30.0, eta, 1e-9, q=small, disturbance=quiet, rate_bound=0.0, t_end=31.0)
    log = rollout.simulate_jit(run, record=True).log
    assert log is not None
    u, t = np.asarray(log.u[:, 2]), np.asarray(log.t)
    first, k = abs(u[0]), int(np.argmax(u))  # it brakes with the opposite sign
    # small-angle formula: corrections of (0.01)^2; the peak is read off nodes some tau/10 apart, flat at the top
    np.testing.assert_allclose(u[k] / first, theory.later_peak_ratio(vector(eta)), rtol=2e-3)
    remaining = (30.0 - t[k]) / (30.0 - float(theory.later_peak_time(vector(eta), vector(30.0))))
    assert 0.93 < remaining < 1.07


def test_later_peak_ratio_published_values():
    for eta, ratio in ((2.05, 7.4), (2.1, 3.7), (2.2, 1.87), (2.3, 1.27), (2.5, 0.79), (3.0, 0.45)):
        np.testing.assert_allclose(theory.later_peak_ratio(vector(eta)), ratio, atol=0.006 * ratio + 0.005)
    np.testing.assert_allclose(theory.later_peak_ratio(vector(2.386)), 1.0, atol=1e-3)


@pytest.mark.parametrize("eta", [2.2, 3.0, 5.0])
@pytest.mark.parametrize("width", [0.0, 1e-3, 0.05])
def test_sliding_variable_stays_inside_its_envelope(eta, width):
    run = parts(30.0, eta, 0.05, inertia=FULL_INERTIA, sign_width=max(width, 1e-4) if width else 1e-4)
    log = rollout.simulate_jit(run, record=True).log
    assert log is not None
    t = np.asarray(log.t)
    before = t < 29.95
    size = np.linalg.norm(np.asarray(log.s)[before], axis=1)
    allowed = theory.sliding_envelope(run, t[before])
    assert np.all(size <= allowed * (1 + 1e-6) + 1e-9)


def test_predicted_path_is_the_path_of_the_run():
    rate = (0.02, -0.03, 0.05)
    run = parts(30.0, 3.0, 0.05, rate=rate)
    quiet = parts(30.0, 3.0, 0.05, rate=rate, disturbance=signals.Constant(vector([0.0] * 3)), rate_bound=0.0)
    log = rollout.simulate_jit(quiet, record=True).log
    assert log is not None
    t, square = theory.predicted_path(run)
    before = np.asarray(log.t) < 29.9
    flown = np.asarray(log.x.q[:, 3]) ** 2
    np.testing.assert_allclose(np.interp(log.t[before], t, square), flown[before], atol=1e-4)  # interpolation
