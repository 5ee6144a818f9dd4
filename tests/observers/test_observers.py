"""The nonlinear disturbance observer: digital and continuous form against closed forms, and its error bound."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm

from ptsmc_jax.observers import nonlinear
from ptsmc_jax.plants import rigid_body
from tests.helpers import FULL_INERTIA, PAPER_INERTIA, vector

NOW = vector(0.0)


def observer(inertia=FULL_INERTIA, gain=(10.0, 4.0, 25.0), c=1e-3, start=0.0):
    """Return a nonlinear observer of a rigid body.

    gain: of each axis. c: bound on the rate of d. start: bound on the initial estimation error.
    """
    return nonlinear.NonlinearObserver(rigid_body.spacecraft(inertia), jnp.asarray(gain), vector(c), vector(start))


@pytest.mark.parametrize("dt", [0.0, 1e-9, 0.05, 1.0, 1e3])
def test_update_matrix_of_the_digital_observer_equals_its_closed_form(dt):
    found = observer()
    a = np.diag([10.0, 4.0, 25.0]) @ np.linalg.inv(FULL_INERTIA)
    expected = a if dt == 0.0 else (np.eye(3) - expm(-a * dt)) / dt
    rounding = 1e-6 if dt == 1e-9 else 1e-14  # the expected value has a cancellation error of 1e-16/(a dt)
    np.testing.assert_allclose(found.update_matrix(vector(dt)), expected, rtol=1e-12, atol=rounding)


def body_state(w):
    """Return a state at the identity attitude with the body rate w (3,) [rad/s]."""
    return rigid_body.AttitudeState(vector(0.0, 0.0, 0.0, 1.0), vector(w))


def held_motion(inertia, torque, seconds, steps=2000):
    """Return the body rates at both ends of a period with constant torque, by RK4 in NumPy with many steps.

    seconds: length of the period. The rate at its start is fixed.
    """
    inverse = np.linalg.inv(inertia)
    w = np.array([0.05, -0.1, 0.08])
    start, h = w, seconds / steps

    def rate(w):
        return inverse @ (torque - np.cross(w, inertia @ w))

    for _ in range(steps):
        k1 = rate(w)
        k2 = rate(w + h / 2 * k1)
        k3 = rate(w + h / 2 * k2)
        w = w + h / 6 * (k1 + 2 * k2 + 2 * k3 + rate(w + h * k3))
    return start, w


@pytest.mark.parametrize("gain", [0.5, 10.0, 300.0])
def test_digital_estimate_of_a_constant_disturbance_is_unbiased(gain):
    found = observer(gain=(gain,) * 3)
    d, u, h = np.array([0.02, -0.03, 0.01]), np.array([0.1, 0.3, -0.2]), 0.05
    w, w_next = held_motion(np.asarray(FULL_INERTIA), u + d, h)
    matrix = found.update_matrix(vector(h))
    impulse = found.model.implied_disturbance_impulse(
        vector(h), body_state(w), body_state(w_next), vector(u), vector(h)
    )
    d_hat = found.update(matrix, vector(d), impulse, vector(h), vector(h))
    # the correct estimate does not change; the trapezoidal rule for the gyroscopic torque has an error of order h^2/12
    np.testing.assert_allclose(d_hat, d, atol=1e-6)


@pytest.mark.parametrize("inertia", [PAPER_INERTIA, FULL_INERTIA, (1e-3, 1.2e-3, 1.5e-3)])
@pytest.mark.parametrize("dt", [1e-3, 0.05, 10.0])
def test_digital_observer_is_stable_for_any_gain_and_period(inertia, dt):
    for gain in (0.5, 10.0, 300.0):
        found = observer(inertia, (gain,) * 3)
        matrix = np.asarray(found.update_matrix(vector(dt)))
        modes = np.linalg.eigvals(np.eye(3) - matrix * dt).real
        assert np.all((modes >= -1e-12) & (modes < 1.0))


def test_continuous_estimation_error_obeys_equation_54():
    """For the motion of the plant, d_hat' = forcing - A d_hat equals -A (d_hat - d)."""
    found = observer()
    w, u, d, d_hat = (vector(np.random.default_rng(k).normal(size=3)) for k in range(4))
    x_dot = rigid_body.spacecraft(FULL_INERTIA).rate(NOW, body_state(w), u, d)
    a = np.diag([10.0, 4.0, 25.0]) @ np.linalg.inv(FULL_INERTIA)
    np.testing.assert_allclose(found.decay_matrix(NOW, NOW), a, rtol=1e-12)
    found_rate = (
        found.forcing(NOW, (NOW, NOW), d_hat, found.model.implied_disturbance(NOW, body_state(w), x_dot, u))
        - found.decay_matrix(NOW, NOW) @ d_hat
    )
    np.testing.assert_allclose(found_rate, -a @ np.asarray(d_hat - d), atol=1e-12)


def test_bound_on_the_estimation_error_equals_the_corrected_equation_55():
    bound = observer(PAPER_INERTIA, (10.0,) * 3).error_bound()
    rate = 10.0 / 14.0
    for t in (0.0, 0.7, 5.0, 100.0):
        expected = np.sqrt(3) * 1e-3 / rate * (1 - np.exp(-rate * t))  # (55) lacks the factor sqrt(3)
        np.testing.assert_allclose(bound(vector(t)), expected, atol=1e-17)


def worst_error(a, sign_pattern, c, seconds):
    """Return the exact estimation error (3,) for constant d' = +-c with this sign pattern (3,): A^-1 (I - E) c.

    a: the decay matrix A. seconds: time t since an error of zero; E is e^(-A t).
    """
    return np.linalg.solve(a, (np.eye(3) - expm(-a * seconds)) @ (c * sign_pattern))


@pytest.mark.parametrize("inertia", [PAPER_INERTIA, FULL_INERTIA])
@pytest.mark.parametrize("gain", [(10.0, 10.0, 10.0), (30.0, 3.0, 10.0)])
def test_largest_estimation_error_is_between_a_quarter_of_its_bound_and_the_bound(inertia, gain):
    found = observer(inertia, gain)
    bound, a = found.error_bound(), np.asarray(found.decay_matrix(NOW, NOW))
    signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
    ratios = [
        np.linalg.norm(worst_error(a, sign, 1e-3, t)) / float(bound(vector(t)))
        for t in (0.1, 1.0, 10.0, 100.0)
        for sign in signs
    ]
    assert max(ratios) <= 1.0 + 1e-12
    assert max(ratios) > 0.25  # the bound is not too large
    initial = observer(inertia, gain, c=0.0, start=0.05).error_bound()
    for t in (0.0, 0.5, 3.0):
        largest = np.linalg.norm(expm(-a * t) @ np.eye(3), axis=0).max() * 0.05
        assert largest <= float(initial(vector(t))) * (1 + 1e-12)


def test_bound_for_unequal_gains_has_the_factor_root_of_their_condition_number():
    """If J is not diagonal, the bound without this factor is less than the error for a ramp disturbance."""
    inertia, gain = np.array([[0.5, 1.0, 0.0], [1.0, 6.5, 0.0], [0.0, 0.0, 6.9]]), np.array([10.0, 5e3, 1e4])
    found = observer(inertia, gain)
    error = np.linalg.norm(worst_error(np.asarray(found.decay_matrix(NOW, NOW)), np.ones(3), 1e-3, 100.0))
    slowest = np.linalg.eigvalsh(np.linalg.inv(inertia) * np.sqrt(np.outer(gain, gain))).min()
    without_factor = np.sqrt(3.0) * 1e-3 / slowest
    assert error > 1.25 * without_factor
    bound = found.error_bound()
    np.testing.assert_allclose(bound.floor, np.sqrt(1e3) * without_factor, rtol=1e-12)
    np.testing.assert_allclose(observer(inertia, gain, start=0.2).error_bound().start, np.sqrt(1e3) * 0.2, rtol=1e-12)
    assert error < float(bound(vector(100.0)))


def test_derivative_of_the_error_bound_by_the_gain_is_finite_for_equal_moments_of_inertia():
    def bound_for_long_times(gain):
        return observer((5.0, 5.0, 5.0), jnp.full(3, gain)).error_bound().floor

    derivative = jax.jit(jax.jacfwd(bound_for_long_times))(vector(10.0))
    np.testing.assert_allclose(derivative, -np.sqrt(3) * 1e-3 * 5.0 / 100.0, rtol=1e-10)
