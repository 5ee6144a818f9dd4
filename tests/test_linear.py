"""Linear theory of the sampled loop against brute force, the law itself and flown trials."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ptsmc_jax import hardware, linear, montecarlo, scenario
from ptsmc_jax.plants import AttitudeState
from tests.helpers import FIRST_FLIGHT, parts, vector


@pytest.mark.parametrize("t", [3.0, 18.9, 19.6])
def test_gains_are_the_slopes_of_the_law(t):
    """Acceleration of eps by eps and eps' at the reference, by automatic differentiation of the closed loop."""
    run = parts(20.0, 3.4, 1.0, inertia=(10.0,) * 3, k1=1.7, sign_width=0.05, surface_rate=2.3)
    law, k2 = run.controller, vector(0.02)
    hold = jnp.asarray(t >= 19.0)

    def acceleration(eps, rate):
        x = AttitudeState(jnp.append(eps, jnp.sqrt(1 - jnp.dot(eps, eps))), 2 * rate)
        u, _ = law.torque(vector(t), hold, x, run.reference(vector(t)), jnp.zeros(3), k2)
        return run.plant.rate(vector(t), x, u, jnp.zeros(3)).w / 2

    by_error, by_rate = jax.jacfwd(acceleration, (0, 1))(jnp.zeros(3), jnp.zeros(3))
    slope = np.sqrt(3.0) / 10.0 * 0.02 / 0.05
    kp, kd = (float(v) for v in linear.gains(np.asarray(t), 20.0, 3.4, 1.0, 1.7, slope, 2.3))
    np.testing.assert_allclose(by_error, -kp * np.eye(3), atol=1e-9 * kp)
    np.testing.assert_allclose(by_rate, -kd * np.eye(3), atol=1e-9 * kd)


def flown_radius(kp, kd, h, late):
    """Growth per period of a double integrator under sampled feedback that acts late, by stepping it."""
    fine = 20
    state, commands = np.array([1.0, 0.3]), [0.0] * 10
    sizes = []
    for _ in range(400):
        commands.append(-kp * state[0] - kd * state[1])
        for j in range(fine):
            back = int(np.ceil(late - (j + 0.5) / fine)) if late > 0 else 0
            a, dt = commands[-1 - max(back, 0)], h / fine
            state = np.array([state[0] + dt * state[1] + dt * dt / 2 * a, state[1] + dt * a])
        sizes.append(np.linalg.norm([state[0], h * state[1]]))
    return np.exp(np.polyfit(np.arange(200), np.log(np.array(sizes[200:]) + 1e-300), 1)[0])


@pytest.mark.parametrize("late", [0.0, 1.0, 2.0, 0.25, 1.5])
def test_poles_are_those_of_the_loop_stepped_by_hand(late):
    for kp, kd in ((0.2, 0.5), (1.0, 0.9), (0.05, 0.2)):
        np.testing.assert_allclose(linear.radius(kp, kd, 1.0, late), flown_radius(kp, kd, 1.0, late), rtol=0.03)


def test_borders_are_those_of_the_theory_notes():
    for eta in (2.2, 3.0, 5.0, 8.0):
        np.testing.assert_allclose(linear.largest_index(eta), 2.0, rtol=1e-9)
        np.testing.assert_allclose(linear.smallest_delta(eta, 0.05), max(0.0, (eta - 1.5) * 0.05), rtol=1e-8)
        np.testing.assert_allclose(linear.smallest_delta(eta, 0.05, anchored=False), (eta - 0.5) * 0.05, rtol=1e-8)
        assert 0.74 < linear.largest_index(eta, 1.0) < 0.85  # "about 0.75"
        assert linear.largest_index(eta, 2.0) < linear.largest_index(eta, 1.0)


def test_margins_end_where_the_loop_does():
    run = parts(20.0, 3.0, 0.5, period=0.05)
    run = dataclasses.replace(run, actuators=hardware.Actuators(delay=1))
    for name, at in linear.margins(run).items():
        tau = 0.55 if name == "hand_over" else 0.0
        kp, kd = (float(v) for v in linear.gains(np.asarray(20.0 - tau), 20.0, 3.0, 0.5, 1.0, 0.0, 1.0))
        assert at.radius == linear.radius(kp, kd, 0.05, 1.0) < 1.0
        for share in (0.999, 1.001):
            assert (linear.radius(share * at.gain * kp, share * at.gain * kd, 0.05, 1.0) < 1.0) == (share < 1)
            assert (linear.radius(kp, kd, 0.05, 1.0 + share * at.delay / 0.05) < 1.0) == (share < 1)


def test_delay_margin_of_a_short_period_is_that_of_continuous_time():
    found = [linear.margins(parts(20.0, 3.0, 3.0, period=h, t_end=21.0))["hold"].delay for h in (0.02, 0.01, 0.002)]
    assert np.all(np.isfinite(found))
    # half a period of the hold is part of the delay
    np.testing.assert_allclose(np.array(found) + np.array([0.01, 0.005, 0.001]), found[-1] + 0.001, rtol=2e-3)


# eta, delta, observer gain, period, delay: from the paper's side to the tuned one
POINTS = [(3.0, 0.5, 10.0, 0.05, 0), (5.0, 0.5, 10.0, 0.05, 0), (4.0, 1.0, 40.0, 0.05, 0), (2.86, 2.06, 299.0, 0.05, 0),
          (3.0, 1.0, 10.0, 0.1, 0), (3.0, 0.8, 10.0, 0.05, 2)]  # fmt: skip


@pytest.mark.parametrize(("eta", "delta", "gain", "period", "delay"), POINTS)
def test_linear_covariance_predicts_the_accuracy_of_two_thousand_trials(eta, delta, gain, period, delay):
    changes = {"controller__eta": eta, "controller__delta": delta, "observer__gain": [gain] * 3, "loop__period": period,
               "hardware__delay": delay, "loop__clock": "flight", "tune": None}  # fmt: skip
    noisy = scenario.replace(scenario.read(FIRST_FLIGHT), **changes)
    # without a disturbance and with the error all noise: what is left of it is the noise's share
    quiet = scenario.replace(noisy, hardware__attitude_noise=0.0, hardware__rate_noise=0.0)
    rms = []
    for case in (noisy, quiet):
        ready = scenario.study(case)
        trials = montecarlo.run(ready.parts, ready.dispersion, 0, np.arange(2000))
        assert np.all(trials.ok)
        rms.append(float(np.sqrt(np.mean(trials.metrics.window_error**2))))
    expected = linear.noise(scenario.study(noisy).parts)
    np.testing.assert_allclose(np.hypot(rms[1], expected.window_error), rms[0], rtol=0.1)
    share = np.sqrt(rms[0] ** 2 - rms[1] ** 2)
    if share > 0.3 * rms[0]:  # where the noise can be told from the rest
        np.testing.assert_allclose(expected.window_error, share, rtol=0.1)
