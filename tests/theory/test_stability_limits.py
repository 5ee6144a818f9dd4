"""Closed-form stability limits of the sampled double integrator, checked by time stepping and against the law."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ptsmc_jax.plants.rigid_body import AttitudeState
from ptsmc_jax.theory import stability_limits
from tests.helpers import commanded, parts, vector


@pytest.mark.parametrize("t", [3.0, 18.9, 19.6])
def test_linear_gains_are_the_derivatives_of_the_law(t):
    """Automatic differentiation of the closed loop gives the derivatives of eps'' by eps and eps' at the reference."""
    run = parts(20.0, 3.4, 1.0, inertia=(10.0,) * 3, k1=1.7, sign_width=0.05, surface_rate=2.3)
    law, k2 = run.controller, vector(0.02)
    hold = jnp.asarray(t >= 19.0)

    def acceleration(eps, rate):
        x = AttitudeState(jnp.append(eps, jnp.sqrt(1 - jnp.dot(eps, eps))), 2 * rate)
        u, _ = commanded(law, vector(t), hold, x, run.reference(vector(t)), jnp.zeros(3), k2)
        return run.plant.rate(vector(t), x, u, jnp.zeros(3)).w / 2

    by_error, by_rate = jax.jacfwd(acceleration, (0, 1))(jnp.zeros(3), jnp.zeros(3))
    slope = np.sqrt(3.0) / 10.0 * 0.02 / 0.05
    tau, k = 20.0 - t, (1.7 + slope) / 2
    kp, kd = 3.4**2 / tau**2 + slope * 3.4 / 2, (2 * 3.4 - 1) / tau + slope * tau / 2
    if t >= 19.0:
        kp, kd = 2.3 * k, 2.3 + k
    np.testing.assert_allclose(by_error, -kp * np.eye(3), atol=1e-9 * kp)
    np.testing.assert_allclose(by_rate, -kd * np.eye(3), atol=1e-9 * kd)


def simulated_radius(kp, kd, h, late):
    """Return the growth factor per period of a double integrator under delayed sampled feedback, by time stepping.

    kp, kd: gains. h: period [s]. late: delay in periods.
    """
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
def test_spectral_radius_equals_growth_of_time_stepping(late):
    for kp, kd in ((0.2, 0.5), (1.0, 0.9), (0.05, 0.2)):
        np.testing.assert_allclose(
            stability_limits.spectral_radius(kp, kd, 1.0, late), simulated_radius(kp, kd, 1.0, late), rtol=0.03
        )


def test_stability_limits_equal_the_documented_values():
    for eta in (2.2, 3.0, 5.0, 8.0):
        np.testing.assert_allclose(stability_limits.largest_index(eta), 2.0, rtol=1e-9)
        np.testing.assert_allclose(stability_limits.smallest_delta(eta, 0.05), max(0.0, (eta - 1.5) * 0.05), rtol=1e-8)
        np.testing.assert_allclose(
            stability_limits.smallest_delta(eta, 0.05, anchored=False), (eta - 0.5) * 0.05, rtol=1e-8
        )
        assert 0.74 < stability_limits.largest_index(eta, 1.0) < 0.85  # "about 0.75"
        assert stability_limits.largest_index(eta, 2.0) < stability_limits.largest_index(eta, 1.0)


@pytest.mark.parametrize("implicit", [False, True])
@pytest.mark.parametrize("delay", [0, 1, 2, 5])
def test_no_reaching_rate_is_stable_above_the_largest_surface_rate(delay, implicit):
    border = stability_limits.largest_surface(delay, implicit=implicit)
    if implicit and not delay:
        assert border == np.inf
        assert stability_limits.largest_reaching(1e3, 0.0, implicit=True) > 0.0
        return
    assert stability_limits.largest_reaching(0.999 * border, float(delay), implicit=implicit) > 0.0
    assert stability_limits.largest_reaching(1.001 * border, float(delay), implicit=implicit) == 0.0


@pytest.mark.parametrize("anchored", [False, True])
@pytest.mark.parametrize("implicit", [False, True])
def test_smallest_delta_puts_the_last_sample_before_the_hand_over_at_the_stability_limit(implicit, anchored):
    """Its time to go is delta on the flight clock, one period more on the anchored clock, one more if implicit."""
    eta, h = 4.0, 0.05
    delta = stability_limits.smallest_delta(eta, h, 1.0, anchored=anchored, implicit=implicit)
    tau = delta / h + anchored + implicit
    kp, kd = stability_limits.implicit_gains(eta, tau) if implicit else ((eta / tau) ** 2, (2 * eta - 1) / tau)
    assert delta > 0.0
    assert stability_limits.spectral_radius(kp, kd, 1.0, 1.0) == pytest.approx(1.0, abs=1e-6)
