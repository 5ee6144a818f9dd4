"""Elementary functions against 80-bit arithmetic: their errors are a few eps of float64."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ptsmc_jax.numerics import elementary

WIDE = np.longdouble
EPS = 2.0**-52
RNG = np.random.default_rng(7)

if np.finfo(WIDE).eps > 1e-18:  # pragma: no cover
    pytest.skip("no 80-bit numbers here", allow_module_level=True)


def relative_error(got, expected):
    """Return the largest relative error of results against expected 80-bit numbers, all different from 0."""
    return float(np.max(np.abs((np.asarray(got).astype(WIDE) - expected) / expected)))


def test_log_is_accurate_for_all_sizes():
    words = np.concatenate([RNG.integers(0, 2**32, 200_000), [0, 1, 2**31, 2**32 - 1]])
    wide = 10.0 ** RNG.uniform(-300, 300, 100_000)
    near = 1.0 + RNG.uniform(-1e-6, 1e-6, 10_000)
    x = np.concatenate([(words + 0.5) / 2**32, wide, near])
    assert relative_error(elementary.log(jnp.asarray(x)), np.log(WIDE(1) * x)) < 1.0 * EPS
    assert float(elementary.log(jnp.asarray(1.0))) == 0.0


def test_cos_sin_turns_is_accurate_over_a_full_turn():
    u = np.concatenate([RNG.uniform(0, 1, 200_000), np.arange(17) / 16, (np.arange(9) / 8)[1:] - 1e-17])
    angle = 2 * np.arccos(WIDE(-1)) * u
    cosine, sine = (np.asarray(v) for v in elementary.cos_sin_turns(jnp.asarray(u)))
    assert np.abs(cosine - np.cos(angle)).max() < EPS  # absolute error
    assert np.abs(sine - np.sin(angle)).max() < EPS
    np.testing.assert_array_equal(
        elementary.cos_sin_turns(jnp.asarray([0.0, 0.25, 0.5, 0.75, 1.0]))[0], [1, 0, -1, 0, 1]
    )


def test_arctan2_is_accurate_in_the_first_quadrant():
    y, x = (np.abs(RNG.normal(size=200_000)) * 10.0 ** RNG.uniform(-9, 0, 200_000) for _ in range(2))
    assert (
        relative_error(elementary.arctan2(jnp.asarray(y), jnp.asarray(x)), np.arctan2(WIDE(1) * y, WIDE(1) * x))
        < 2 * EPS
    )
    corners = elementary.arctan2(jnp.asarray([0.0, 1.0, 0.0, np.nan]), jnp.asarray([0.0, 0.0, 2.0, 1.0]))
    np.testing.assert_array_equal(corners, [0.0, np.pi / 2, 0.0, np.nan])


def test_derivatives_of_elementary_functions_equal_closed_forms():
    x = jnp.asarray(RNG.uniform(0.01, 5.0, 1000))
    gradients = jax.jit(jax.vmap(jax.grad(elementary.log)))(x)
    np.testing.assert_allclose(gradients, 1 / x, rtol=1e-13)
    u = jnp.asarray(RNG.uniform(0, 1, 1000))
    derivative = jax.jit(jax.vmap(jax.jacfwd(elementary.cos_sin_turns)))(u)
    np.testing.assert_allclose(derivative[0], -2 * np.pi * np.sin(2 * np.pi * u), rtol=0, atol=1e-13)
    np.testing.assert_allclose(derivative[1], 2 * np.pi * np.cos(2 * np.pi * u), rtol=0, atol=1e-13)
    y = jnp.asarray(RNG.uniform(0, 5.0, 1000))
    by_y, by_x = jax.jit(jax.vmap(jax.grad(elementary.arctan2, (0, 1))))(y, x)
    np.testing.assert_allclose(by_y, x / (x**2 + y**2), rtol=1e-14)
    np.testing.assert_allclose(by_x, -y / (x**2 + y**2), rtol=1e-14)
    at_zero = jax.grad(elementary.arctan2, (0, 1))(jnp.zeros(()), jnp.zeros(()))
    np.testing.assert_array_equal(at_zero, [0.0, 0.0])


def test_single_precision_uses_the_functions_of_jax_numpy():
    x = jnp.asarray([0.1, 0.7, 0.9], jnp.float32)
    for got in (elementary.log(x), *elementary.cos_sin_turns(x), elementary.arctan2(x, x)):
        assert got.dtype == jnp.float32
    np.testing.assert_allclose(elementary.cos_sin_turns(x)[1], np.sin(2 * np.pi * np.asarray(x)), atol=1e-6)
