"""Quaternion algebra and kinematics against SciPy, NumPy and closed forms."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ptsmc_jax.numerics import attitude
from tests.helpers import time_derivative, vector

EPS = np.finfo(float).eps
TURNS = Rotation.random(24, rng=np.random.default_rng(0))
OTHERS = Rotation.random(24, rng=np.random.default_rng(1))
P, Q = TURNS.as_quat(), OTHERS.as_quat() * np.where(np.arange(24) % 2, 1, -1)[:, None]  # both signs
W, W_DOT = np.random.default_rng(2).normal(size=(2, 24, 3))

multiply_all = jax.jit(jax.vmap(attitude.multiply))


def skew(v):
    """Return the cross-product matrix (3, 3) of a vector."""
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])


# products


def test_cross_equals_numpy():
    # rounding: two products and their difference
    np.testing.assert_allclose(jax.vmap(attitude.cross)(vector(W), vector(W_DOT)), np.cross(W, W_DOT), atol=16 * EPS)


def test_multiply_equals_product_of_rotation_matrices():
    got = Rotation.from_quat(np.asarray(multiply_all(vector(P), vector(Q))))
    # about twelve rounding errors of numbers up to 1
    np.testing.assert_allclose(got.as_matrix(), TURNS.as_matrix() @ OTHERS.as_matrix(), rtol=0, atol=20 * EPS)


def test_multiply_is_the_hamilton_product():
    i, j, k, one = (vector(row) for row in np.eye(4))
    for a, b, product in ((i, j, k), (j, k, i), (k, i, j), (j, i, -k), (i, i, -one), (one, k, k), (k, one, k)):
        np.testing.assert_array_equal(attitude.multiply(a, b), product)


def test_conjugate_is_the_inverse():
    got = jax.vmap(attitude.conjugate)(vector(P))
    np.testing.assert_allclose(Rotation.from_quat(np.asarray(got)).as_matrix(), TURNS.inv().as_matrix(), atol=4 * EPS)
    identity = multiply_all(got, vector(P))
    np.testing.assert_allclose(identity, np.tile([0, 0, 0, 1], (24, 1)), rtol=0, atol=8 * EPS)


def test_normalise_divides_a_quaternion_by_its_norm():
    got = jax.vmap(attitude.normalise)(vector(3e-3 * P))
    np.testing.assert_allclose(got, P / np.linalg.norm(P, axis=1, keepdims=True), rtol=0, atol=4 * EPS)


# kinematics


def test_t_matrix_is_q4_identity_plus_cross_product_matrix():
    for q in P:
        np.testing.assert_array_equal(attitude.t_matrix(vector(q)), q[3] * np.eye(3) + skew(q[:3]))


@pytest.mark.parametrize("scale", [1.0, 0.7, 3.0])  # the closed form holds for any norm of q
def test_t_inverse_times_equals_linear_solve(scale):
    for q, y in zip(scale * P, W, strict=True):
        t = q[3] * np.eye(3) + skew(q[:3])
        got = attitude.t_inverse_times(vector(q), vector(y))
        expected = np.linalg.solve(t, y)
        # the condition number of the system is |q|/|q4|
        tolerance = 20 * EPS * np.linalg.cond(t) * np.abs(expected).max()
        np.testing.assert_allclose(got, expected, rtol=0, atol=tolerance)


def test_derivative_of_a_quaternion_equals_finite_differences_of_a_rotating_body():
    # Richardson extrapolation of central differences of q exp(w t): truncation (|w| h / 2)^4, rounding eps / h
    h = 1e-3
    for q, w in zip(P, W, strict=True):

        def rotated(t, q=q, w=w):
            out = (Rotation.from_quat(q) * Rotation.from_rotvec(w * t)).as_quat()
            return out * np.sign(out @ q)

        near, far = (rotated(h) - rotated(-h)) / (2 * h), (rotated(2 * h) - rotated(-2 * h)) / (4 * h)
        np.testing.assert_allclose(attitude.derivative(vector(q), vector(w)), (4 * near - far) / 3, rtol=0, atol=1e-11)


def test_vector_rates_equal_automatic_derivatives_of_a_moving_attitude():
    rng = np.random.default_rng(5)
    a, b = vector(rng.normal(size=4)), vector(rng.normal(size=(2, 4)))

    def q(t):
        x = a + b[0] * jnp.sin(t) + b[1] * jnp.cos(2 * t)
        return x / jnp.sqrt(jnp.sum(x * x))

    def rate(t):  # w = 2 (q* q')_v
        x, x_dot = q(t), time_derivative(q)(t)
        return 2 * (x[3] * x_dot[:3] - x_dot[3] * x[:3] - jnp.cross(x[:3], x_dot[:3]))

    @jax.jit
    def pair(t):
        got = attitude.vector_rates(q(t), rate(t), time_derivative(rate)(t))
        return got, (time_derivative(q)(t)[:3], time_derivative(time_derivative(q))(t)[:3])

    for t in np.linspace(0, 6, 13):
        got, expected = pair(vector(t))
        scale = 1 + max(float(jnp.max(jnp.abs(e))) for e in expected)
        # dozens of operations; if |x| is small, the terms are larger than the result
        np.testing.assert_allclose(got, expected, rtol=0, atol=1000 * EPS * scale)


# rotation vectors


def series(r):
    """Return [f, g] and their derivatives in |r|^2 [f', g'], with f = sin(|r|/2)/|r| and g = cos(|r|/2).

    All are exact Taylor series in |r|^2.
    """
    square = math.fsum(x * x for x in r)
    terms = [((-1) ** k / 2 ** (2 * k + 1) / math.factorial(2 * k + 1), (-1) ** k / 4**k / math.factorial(2 * k))
             for k in range(30)]  # fmt: skip
    values = [math.fsum(pair[n] * square**k for k, pair in enumerate(terms)) for n in (0, 1)]
    derivatives = [math.fsum(k * pair[n] * square ** (k - 1) for k, pair in enumerate(terms) if k) for n in (0, 1)]
    return values, derivatives


SIZES = [
    0.0,
    1e-160,
    1e-9,
    1e-6,
    *(1e-3 * (1 + x) for x in (-1e-6, -1e-15, 1e-15, 1e-6)),
    0.0099,
    0.5,
    3.0,
    math.pi,
    6.0,
]


jacobians = [jax.jit(jacobian(attitude.from_rotation_vector)) for jacobian in (jax.jacfwd, jax.jacrev)]


@pytest.mark.parametrize("size", SIZES)  # the function changes from the series to sine and cosine at 1e-3
def test_from_rotation_vector_and_its_jacobian_are_accurate_at_all_sizes(size):
    r = size * np.array([2, -1, 2]) / 3
    (scale, scalar), (scale_derivative, scalar_derivative) = series(r)
    # a few rounding errors of numbers up to 1; the truncation of the series is 1e-24, of its derivative 1e-17
    np.testing.assert_allclose(attitude.from_rotation_vector(vector(r)), [*scale * r, scalar], rtol=0, atol=4 * EPS)
    expected = np.vstack([scale * np.eye(3) + 2 * scale_derivative * np.outer(r, r), 2 * scalar_derivative * r])
    for jacobian in jacobians:
        got = jacobian(vector(r))
        np.testing.assert_allclose(got, expected, rtol=0, atol=10 * EPS)


@pytest.mark.parametrize("size", [1e-160, 1e-9, 1e-3])
def test_small_rotations_have_full_relative_accuracy(size):
    r = size * np.array([2, -1, 2]) / 3
    got = attitude.from_rotation_vector(vector(r))[:3]
    np.testing.assert_allclose(got, series(r)[0][0] * r, rtol=4 * EPS, atol=0)


# angle


def test_angle_equals_scipy_for_both_signs_of_a_quaternion():
    expected = (TURNS.inv() * OTHERS).magnitude()
    for p, q in ((P, Q), (-P, Q), (P, -Q)):
        np.testing.assert_allclose(jax.vmap(attitude.angle)(vector(q), vector(p)), expected, rtol=0, atol=20 * EPS)


@pytest.mark.parametrize("size", [0.0, 1e-15, 1e-9, 1e-5, 1.0, math.pi - 1e-9, math.pi])
def test_angle_is_accurate_from_0_to_pi(size):
    turn = Rotation.from_rotvec(size * np.array([2, -1, 2]) / 3).as_quat()
    # relative to the identity; near pi the accuracy is limited by the rounding of pi
    np.testing.assert_allclose(attitude.angle(vector(turn), vector([0, 0, 0, 1])), size, rtol=4 * EPS)
    for reference in P[:4]:  # relative to another attitude; the product has rounding errors of a few eps
        q = attitude.multiply(vector(reference), vector(turn))
        np.testing.assert_allclose(attitude.angle(q, vector(reference)), size, rtol=0, atol=10 * EPS)


def test_gradient_of_the_angle_is_the_rotation_axis():
    # a small rotation dr of q in body axes changes the angle by n . dr, with the rotation axis n
    def angle_after(r, size, axis):
        q = attitude.multiply(attitude.from_rotation_vector(size * axis), attitude.from_rotation_vector(r))
        return attitude.angle(attitude.multiply(vector(P[0]), q), vector(P[0]))

    axis = vector([2 / 3, -1 / 3, 2 / 3])
    gradient = jax.jit(jax.grad(angle_after))
    for size in (1e-3, 1.0, 3.0, -1.0):
        # a rounding error eps of q rotates the axis by eps / size
        tolerance = 20 * EPS * (1 + 1 / abs(size))
        np.testing.assert_allclose(gradient(jnp.zeros(3), size, axis), np.sign(size) * axis, rtol=0, atol=tolerance)


angle_jacobians = [jax.jit(jacobian(attitude.angle)) for jacobian in (jax.jacfwd, jax.jacrev)]


@pytest.mark.parametrize("q", [(0, 0, 0, 1), (0, 0, 0, -1), (1, 0, 0, 0), (0, -0.6, 0.8, 0)])
def test_gradient_of_the_angle_is_finite_at_0_and_180_degrees(q):
    gradients = [jacobian(vector(q), vector([0, 0, 0, 1])) for jacobian in angle_jacobians]
    assert np.all(np.isfinite(gradients))
    if abs(q[3]) == 1:
        np.testing.assert_array_equal(gradients, np.zeros((2, 4)))
