"""Reference attitudes and disturbances against SciPy and closed forms."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ptsmc_jax import scenario
from ptsmc_jax.numerics import attitude
from ptsmc_jax.signals import disturbances, references
from tests.helpers import time_derivative, vector

EPS = np.finfo(float).eps
START = Rotation.from_rotvec([0.4, -1.0, 2.0])
TIMES = [0.0, 1e-6, 0.3, 17.0, 400.0]
RATES = [(0.0, 0.0, 0.0), (1e-7, 0.0, -2e-7), (0.03, -0.02, 0.01), (1.0, 2.0, -0.5)]

target = jax.jit(lambda signal, t: signal(t))
position_and_rates = jax.jit(
    lambda signal, t: (
        signal(t).q,
        time_derivative(lambda t: signal(t).q)(t),
        time_derivative(time_derivative(lambda t: signal(t).q))(t),
        attitude.derivative(signal(t).q, signal(t).w),
        attitude.vector_rates(*signal(t)),
    )
)


def test_fixed_reference_has_no_rates():
    q = START.as_quat()
    for t in TIMES:
        got = target(references.Fixed(vector(q)), vector(t))
        np.testing.assert_array_equal(got.q, q)
        for rate in (got.w, got.w_dot, *attitude.vector_rates(*got)):
            np.testing.assert_array_equal(rate, np.zeros(3))


@pytest.mark.parametrize("rate", RATES)
def test_spin_rotates_about_body_fixed_axes(rate):
    spin = references.Spin(vector(START.as_quat()), vector(rate))
    for t in TIMES:
        got = target(spin, vector(t))
        exact = (START * Rotation.from_rotvec(np.array(rate) * t)).as_matrix()
        # rounding error of the angle |w| t
        tolerance = 20 * EPS * (1 + np.linalg.norm(rate) * t)
        np.testing.assert_allclose(Rotation.from_quat(np.asarray(got.q)).as_matrix(), exact, rtol=0, atol=tolerance)
        assert abs(np.linalg.norm(got.q) - 1) <= 4 * EPS  # closed form, without integration errors
        np.testing.assert_array_equal(got.w, rate)
        np.testing.assert_array_equal(got.w_dot, np.zeros(3))


@pytest.mark.parametrize("rate", RATES)
def test_spin_satisfies_the_kinematics_and_rates_of_its_vector_part_are_exact(rate):
    """The vector part v of the quaternion has exact first and second derivatives."""
    spin, size = references.Spin(vector(START.as_quat()), vector(rate)), np.linalg.norm(rate)
    for t in TIMES:
        _, first, second, kinematics, (v_dot, v_ddot) = position_and_rates(spin, vector(t))
        # w times numbers up to 1 with the rounding error of the angle |w| t
        tolerance = 20 * EPS * size * (1 + size * t)
        np.testing.assert_allclose(first, kinematics, rtol=0, atol=tolerance)
        np.testing.assert_allclose(first[:3], v_dot, rtol=0, atol=tolerance)
        # second derivative of sin(a/2)/a: terms larger than the result by 1/a^2 cancel, a >= 1e-3
        angle = max(size * t, 1e-3)
        np.testing.assert_allclose(second[:3], v_ddot, rtol=0, atol=20 * EPS * size**2 * (1 + size * t + 1 / angle**2))
        # for a constant rate q'' = -|w|^2 q / 4
        np.testing.assert_allclose(v_ddot, -(size**2) / 4 * spin(vector(t)).q[:3], rtol=0, atol=20 * EPS * size**2)


def test_sinusoid_and_its_time_derivative_equal_closed_forms():
    amplitude, frequency = np.array([0.01, -0.02, 0.0]), np.array([0.1, 3.0, 7.0])
    phase, bias = np.array([0.0, 1.0, -2.0]), np.array([1e-3, 0.0, -5e-3])
    signal = disturbances.Sinusoid(vector(amplitude), vector(frequency), vector(phase), vector(bias))
    for t in (0.0, 0.7, 40.0):
        x = [f * t + p for f, p in zip(frequency, phase, strict=True)]
        # rounding error of the argument
        tolerance = 4 * EPS * (1 + np.abs(x).max())
        value = [b + a * math.sin(y) for a, y, b in zip(amplitude, x, bias, strict=True)]
        np.testing.assert_allclose(signal(vector(t)), value, rtol=0, atol=0.02 * tolerance)
        derivative = [a * f * math.cos(y) for a, f, y in zip(amplitude, frequency, x, strict=True)]
        np.testing.assert_allclose(time_derivative(signal)(vector(t)), derivative, rtol=0, atol=0.06 * tolerance)


# oscillating references and slews


def body_rate(r, r_dot):
    """Return the body rate (3,) of exp(r): the right Jacobian of SO(3) times r' (Chirikjian 2011, eq. 10.86)."""
    zero = jnp.zeros(())
    x = jnp.stack([jnp.stack(row) for row in ([zero, -r[2], r[1]], [r[2], zero, -r[0]], [-r[1], r[0], zero])])
    angle = jnp.sqrt(r @ r)
    jacobian = jnp.eye(3) - (1 - jnp.cos(angle)) / angle**2 * x + (angle - jnp.sin(angle)) / angle**3 * (x @ x)
    return jacobian @ r_dot


SWING = references.Swing(
    vector(START.as_quat()), vector(0.4, -0.2, 0.7), vector(0.1, 0.3, 0.05), vector(0.2, 1.0, -0.5)
)


@pytest.mark.parametrize("t", [0.0, 3.0, 41.0])
def test_rates_of_an_oscillating_reference_equal_those_of_its_rotation_vector(t):
    def rotation_vector_at(t):
        return SWING.amplitude * jnp.sin(SWING.frequency * t + SWING.phase)

    def rate_at(t):
        return body_rate(
            rotation_vector_at(t), SWING.amplitude * SWING.frequency * jnp.cos(SWING.frequency * t + SWING.phase)
        )

    got = target(SWING, vector(t))
    exact = (START * Rotation.from_rotvec(np.array(rotation_vector_at(t)))).as_matrix()
    np.testing.assert_allclose(Rotation.from_quat(np.asarray(got.q)).as_matrix(), exact, rtol=0, atol=20 * EPS)
    np.testing.assert_allclose(got.w, rate_at(t), rtol=0, atol=1e-14)
    _, w_dot = jax.jvp(rate_at, (vector(t),), (vector(1.0),))
    np.testing.assert_allclose(got.w_dot, w_dot, rtol=0, atol=1e-13)


ROTATION_VECTOR = np.array([0.5, -1.5, 2.0])


@pytest.mark.parametrize("t", [-5.0, 0.0, 0.02, 7.0, 20.0, 39.9, 40.0, 60.0])
def test_slew_is_a_quintic_rotation_about_a_fixed_axis(t):
    slew = references.Slew(vector(START.as_quat()), vector(ROTATION_VECTOR), vector(40.0))
    got, x = target(slew, vector(t)), np.clip(t / 40.0, 0.0, 1.0)
    fraction, rate = x**3 * (10 - 15 * x + 6 * x**2), 30 * x**2 * (1 - x) ** 2 / 40.0
    second = 60 * x * (1 - x) * (1 - 2 * x) / 40.0**2
    exact = (START * Rotation.from_rotvec(fraction * ROTATION_VECTOR)).as_matrix()
    np.testing.assert_allclose(Rotation.from_quat(np.asarray(got.q)).as_matrix(), exact, rtol=0, atol=20 * EPS)
    np.testing.assert_allclose(got.w, rate * ROTATION_VECTOR, rtol=0, atol=1e-14)
    np.testing.assert_allclose(got.w_dot, second * ROTATION_VECTOR, rtol=0, atol=1e-13)


@pytest.mark.parametrize(
    "signal", [SWING, references.Slew(vector(START.as_quat()), vector(ROTATION_VECTOR), vector(40.0))]
)
def test_moving_references_satisfy_the_kinematics(signal):
    for t in (0.5, 11.0, 39.0):
        _, first, second, kinematics, (v_dot, v_ddot) = position_and_rates(signal, vector(t))
        np.testing.assert_allclose(first, kinematics, rtol=0, atol=1e-14)
        np.testing.assert_allclose(v_dot, first[:3], rtol=0, atol=1e-14)
        np.testing.assert_allclose(v_ddot, second[:3], rtol=0, atol=1e-13)


def test_moving_references_are_built_from_their_tables():
    swing = scenario.study(scenario.from_tables({"reference": {"kind": "sinusoid", "mrp": [0.1, 0.0, 0.0]}}))
    half = 4 * np.arctan(0.1) / 2
    np.testing.assert_allclose(swing.parts.reference.q, [np.sin(half), 0.0, 0.0, np.cos(half)], atol=1e-15)
    np.testing.assert_array_equal(swing.parts.reference.amplitude, [0.1] * 3)
    table = {"kind": "slew", "quat_xyzw": [0.6, 0.0, 0.0, 0.8], "to_quat_xyzw": [0.0, 0.0, 0.0, -1.0], "duration": 20.0}
    slew = scenario.study(scenario.from_tables({"reference": table})).parts.reference
    np.testing.assert_allclose(slew.turn, [-2 * np.arcsin(0.6), 0.0, 0.0], atol=1e-15)  # the shorter rotation
    end = slew(jnp.asarray(20.0)).q
    np.testing.assert_allclose(end * np.sign(end[3]), [0.0, 0.0, 0.0, 1.0], atol=1e-15)


def test_slew_can_take_the_longer_rotation():
    table = {"kind": "slew", "quat_xyzw": [0.6, 0.0, 0.0, 0.8], "to_quat_xyzw": [0.0, 0.0, 0.0, -1.0], "duration": 20.0}
    ways = [scenario.study(scenario.from_tables({"reference": {**table, "way": way}, **MULTIPLICATIVE})).parts.reference
            for way in ("short", "long")]  # fmt: skip
    short, long = (np.asarray(way.turn) for way in ways)
    np.testing.assert_allclose(np.linalg.norm(long) + np.linalg.norm(short), 2 * np.pi, rtol=1e-14)
    assert short @ long < 0
    ends = [np.asarray(way(jnp.asarray(20.0)).q) for way in ways]
    np.testing.assert_allclose(abs(ends[0] @ ends[1]), 1.0, rtol=1e-14)  # the same attitude


MULTIPLICATIVE = {"controller": {"error": "multiplicative"}}


def test_a_custom_disturbance_can_have_a_number_called_terms():
    """An earlier version took it for a sum, and a dispersion of its amplitude ended in a traceback."""

    @dataclasses.dataclass(frozen=True)
    class Push(disturbances.Disturbance):
        terms: float = 2.0
        size: float = 0.1
        drawn = {"amplitude": "size"}  # noqa: RUF012

    assert disturbances.values(Push(), "amplitude").tolist() == [0.1]
    changed = disturbances.with_values(Push(), "amplitude", jnp.array([0.2]))
    assert (type(changed), float(changed.size), changed.terms) == (Push, 0.2, 2.0)


def test_with_bias_replaces_the_previous_bias_of_a_disturbance():
    """A row of a run table may give a bias to a disturbance that has one already."""
    constant = disturbances.Constant(vector([0.1, -0.2, 0.3]))
    biased = constant
    for value in ([0.01, 0.02, 0.03], [1e-3, 0.0, -1e-3]):
        biased = disturbances.with_bias(biased, vector(value))
        np.testing.assert_array_equal(disturbances.bias(biased, 3), value)
        np.testing.assert_allclose(biased(vector(2.0), None), np.add([0.1, -0.2, 0.3], value), rtol=1e-15)
    np.testing.assert_array_equal(disturbances.bias(constant, 3), np.zeros(3))
