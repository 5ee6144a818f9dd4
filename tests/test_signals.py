import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ptsmc_jax import attitude, signals
from tests.helpers import vector

EPS = np.finfo(float).eps
START = Rotation.from_rotvec([0.4, -1.0, 2.0])
TIMES = [0.0, 1e-6, 0.3, 17.0, 400.0]
RATES = [(0.0, 0.0, 0.0), (1e-7, 0.0, -2e-7), (0.03, -0.02, 0.01), (1.0, 2.0, -0.5)]

target = jax.jit(lambda signal, t: signal(t))
position_and_rates = jax.jit(
    lambda signal, t: (
        signal(t).q,
        signals.time_derivative(lambda t: signal(t).q, t),
        signals.time_derivative(lambda t: signals.time_derivative(lambda t: signal(t).q, t), t),
        attitude.derivative(signal(t).q, signal(t).w),
        signal(t).vector_rates(),
    )
)


def test_fixed_does_not_move():
    q = START.as_quat()
    for t in TIMES:
        got = target(signals.Fixed(vector(q)), vector(t))
        np.testing.assert_array_equal(got.q, q)
        for rate in (got.w, got.w_dot, *got.vector_rates()):
            np.testing.assert_array_equal(rate, np.zeros(3))


@pytest.mark.parametrize("rate", RATES)
def test_spin_turns_about_its_own_axes(rate):
    spin = signals.Spin(vector(START.as_quat()), vector(rate))
    for t in TIMES:
        got = target(spin, vector(t))
        exact = (START * Rotation.from_rotvec(np.array(rate) * t)).as_matrix()
        # the angle |w| t is rounded relatively
        tolerance = 20 * EPS * (1 + np.linalg.norm(rate) * t)
        np.testing.assert_allclose(Rotation.from_quat(np.asarray(got.q)).as_matrix(), exact, rtol=0, atol=tolerance)
        assert abs(np.linalg.norm(got.q) - 1) <= 4 * EPS  # it stays unit: no integration
        np.testing.assert_array_equal(got.w, rate)
        np.testing.assert_array_equal(got.w_dot, np.zeros(3))


@pytest.mark.parametrize("rate", RATES)
def test_spin_solves_the_kinematics_and_vector_rates_are_its_derivatives(rate):
    spin, size = signals.Spin(vector(START.as_quat()), vector(rate)), np.linalg.norm(rate)
    for t in TIMES:
        _, first, second, kinematics, (v_dot, v_ddot) = position_and_rates(spin, vector(t))
        # w times numbers up to 1 whose angle |w| t is rounded relatively
        tolerance = 20 * EPS * size * (1 + size * t)
        np.testing.assert_allclose(first, kinematics, rtol=0, atol=tolerance)
        np.testing.assert_allclose(first[:3], v_dot, rtol=0, atol=tolerance)
        # twice through sin(a/2)/a: terms 1/a^2 above the result near the end of the series, a = 1e-3, cancel
        angle = max(size * t, 1e-3)
        np.testing.assert_allclose(second[:3], v_ddot, rtol=0, atol=20 * EPS * size**2 * (1 + size * t + 1 / angle**2))
        # for a constant rate q'' = -|w|^2 q / 4
        np.testing.assert_allclose(v_ddot, -(size**2) / 4 * spin(vector(t)).q[:3], rtol=0, atol=20 * EPS * size**2)


def test_vector_rates_of_a_target_with_acceleration():
    # a turn by the angle a(t) about a fixed axis n: v = n sin(a/2) from identity
    axis = np.array([2, -1, 2]) / 3
    a, a_dot, a_ddot = 1.3, 0.4, -0.2
    q = vector([*axis * math.sin(a / 2), math.cos(a / 2)])
    first, second = signals.Target(q, vector(axis * a_dot), vector(axis * a_ddot)).vector_rates()
    np.testing.assert_allclose(first, axis * math.cos(a / 2) * a_dot / 2, rtol=0, atol=8 * EPS)
    exact = axis * (math.cos(a / 2) * a_ddot / 2 - math.sin(a / 2) * a_dot**2 / 4)
    np.testing.assert_allclose(second, exact, rtol=0, atol=8 * EPS)


def test_sinusoid_and_its_time_derivative():
    amplitude, frequency = np.array([0.01, -0.02, 0.0]), np.array([0.1, 3.0, 7.0])
    phase, bias = np.array([0.0, 1.0, -2.0]), np.array([1e-3, 0.0, -5e-3])
    signal = signals.Sinusoid(vector(amplitude), vector(frequency), vector(phase), vector(bias))
    for t in (0.0, 0.7, 40.0):
        x = [f * t + p for f, p in zip(frequency, phase, strict=True)]
        # the argument is rounded relatively
        tolerance = 4 * EPS * (1 + np.abs(x).max())
        value = [b + a * math.sin(y) for a, y, b in zip(amplitude, x, bias, strict=True)]
        np.testing.assert_allclose(signal(vector(t)), value, rtol=0, atol=0.02 * tolerance)
        slope = [a * f * math.cos(y) for a, f, y in zip(amplitude, frequency, x, strict=True)]
        np.testing.assert_allclose(signals.time_derivative(signal, vector(t)), slope, rtol=0, atol=0.06 * tolerance)


def test_constant_has_no_derivative():
    signal = signals.Constant(vector([0.1, -0.2, 0.3]))
    np.testing.assert_array_equal(signal(vector(5.0)), [0.1, -0.2, 0.3])
    np.testing.assert_array_equal(signals.time_derivative(signal, vector(5.0)), np.zeros(3))


def test_time_derivative_takes_whole_numbers_too():
    signal = signals.Sinusoid(*(vector([x] * 3) for x in (1.0, 1.0, 0.0, 0.0)))
    np.testing.assert_allclose(signals.time_derivative(signal, jnp.asarray(2.0)), [math.cos(2)] * 3, rtol=4 * EPS)


@pytest.mark.parametrize(
    ("signal", "leaves"),
    [
        (signals.Fixed(jnp.ones(4)), 1),
        (signals.Spin(jnp.ones(4), jnp.ones(3)), 2),
        (signals.Constant(jnp.ones(3)), 1),
        (signals.Sinusoid(*[jnp.ones(3)] * 4), 4),
    ],
)
def test_signals_are_frozen_pytrees_and_every_number_is_a_leaf(signal, leaves):
    assert len(jax.tree.leaves(signal)) == leaves
    name = dataclasses.fields(signal)[0].name
    with pytest.raises(dataclasses.FrozenInstanceError):
        setattr(signal, name, jnp.zeros(3))
