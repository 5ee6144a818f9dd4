"""References from samples: exact at the samples, two continuous derivatives, and the accuracy of a sampled slew."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation, RotationSpline

from ptsmc_jax.batching import lanes, lapack
from ptsmc_jax.numerics.pytrees import vector
from ptsmc_jax.signals import references

START = Rotation.from_rotvec([0.4, -0.2, 0.9])
SLEW = references.Slew(vector(START.as_quat()), vector([0.5, -0.6, 0.7]), vector(60.0))  # 60 deg in 60 s
UNEVEN = np.array([0.0, 0.7, 1.0, 2.5, 2.9, 4.0, 7.0, 7.2, 9.0])


def wander(times):
    """Return attitudes (n, 4), scalar last, of a body that turns about a moving axis, at times (n,) [s]."""
    return Rotation.from_rotvec(
        np.stack([0.8 * np.sin(0.3 * times), 0.1 * times, np.cos(0.2 * times)], axis=1)
    ).as_quat()


def at(reference, times) -> Any:
    """Return attitude, rate and acceleration of a reference at times (n,) [s], as a `Target` of arrays."""
    return jax.tree.map(np.asarray, lapack.vmap(reference)(jnp.asarray(times)))


def apart(q, p):
    """Return the rotation angles (n,) [rad] between quaternions (n, 4)."""
    return (Rotation.from_quat(q).inv() * Rotation.from_quat(p)).magnitude()


def test_interpolation_of_a_slew_sampled_at_1_hz_agrees_with_the_analytic_slew():
    times, between = np.arange(0.0, 76.0), np.linspace(0.0, 75.0, 4001)
    reference = references.interpolate_attitude(times, at(SLEW, times).q)
    found, true = at(reference, between), at(SLEW, between)
    assert apart(found.q, true.q).max() < 1e-6
    assert np.abs(found.w - true.w).max() < 1e-6
    # the piecewise quintic has jumps of its third derivative at 0 and 60 s only, where the tables have samples
    assert np.abs(found.w_dot - true.w_dot).max() < 3e-6  # h^2 theta'''' / 12 and a half


def test_error_of_an_interpolated_attitude_falls_with_the_fourth_power_of_the_interval():
    def error(step):
        times = np.arange(0.0, 40.0 + step, step)
        between = np.linspace(10.0, 30.0, 501)
        return apart(at(references.interpolate_attitude(times, wander(times)), between).q, wander(between)).max()

    assert error(1.0) / error(0.5) == pytest.approx(16.0, rel=0.2)


def test_interpolated_quaternion_is_exact_at_the_samples_and_never_changes_its_sign():
    flipped = wander(UNEVEN) * np.array([1, -1, -1, 1, 1, -1, 1, -1, 1])[:, None]
    reference = references.interpolate_attitude(UNEVEN, flipped)
    q = at(reference, UNEVEN).q
    assert apart(q, wander(UNEVEN)).max() < 1e-15
    between = at(reference, np.linspace(0.0, 9.0, 301)).q
    assert np.einsum("ij,ij->i", between[1:], between[:-1]).min() > 0.99


def test_interpolated_attitude_rate_and_acceleration_are_continuous():
    reference = references.interpolate_attitude(UNEVEN, wander(UNEVEN))
    before, after = (at(reference, UNEVEN[1:-1] * (1.0 + side)) for side in (-1e-13, 1e-13))
    for name in ("q", "w", "w_dot"):
        np.testing.assert_allclose(getattr(before, name), getattr(after, name), rtol=0, atol=1e-11)


def test_interpolated_rates_are_the_derivatives_of_the_quaternion():
    reference = references.interpolate_attitude(UNEVEN, wander(UNEVEN))
    for t in (0.3, 2.5, 8.0):
        by_derivative = references.target_of(lambda t: reference(t).q, jnp.asarray(t))
        got = reference(jnp.asarray(t))
        for name in ("w", "w_dot"):
            np.testing.assert_allclose(getattr(got, name), getattr(by_derivative, name), rtol=0, atol=1e-13)


def test_interpolated_attitude_far_from_the_ends_equals_the_rotation_spline_of_scipy():
    times = np.arange(0.0, 40.0, 0.25)
    reference, other = (
        references.interpolate_attitude(times, wander(times)),
        RotationSpline(times, Rotation.from_quat(wander(times))),
    )
    between = np.linspace(15.0, 25.0, 201)
    assert apart(at(reference, between).q, other(between).as_quat()).max() < 2e-7  # both have errors of h^4
    np.testing.assert_allclose(at(reference, between).w, other(between, 1), atol=2e-6)


def test_interpolated_rates_at_both_ends_equal_the_given_rates():
    times = np.arange(0.0, 9.0)
    ends = np.array([[0.1, 0.0, 0.2], [0.0, -0.1, 0.0]])
    reference = references.interpolate_attitude(times, wander(times), ends)
    np.testing.assert_allclose(at(reference, times[[0, -1]]).w, ends, atol=1e-15)


def test_interpolated_reference_rests_outside_of_its_samples():
    reference = references.interpolate_attitude(UNEVEN, wander(UNEVEN))
    outside = at(reference, np.array([-1.0, 20.0]))
    assert apart(outside.q, wander(UNEVEN[[0, -1]])).max() < 1e-15
    np.testing.assert_array_equal(outside.w, np.zeros((2, 3)))
    np.testing.assert_array_equal(outside.w_dot, np.zeros((2, 3)))


def test_interpolation_of_a_batch_equals_single_ones_and_its_gradients_are_finite():
    """`lanes.vmap` evaluates the batch with batched components."""
    reference = references.interpolate_attitude(UNEVEN, wander(UNEVEN))
    times = jnp.asarray([0.0, 0.7, 3.3, 9.0])
    batched = lanes.vmap(reference)(times)
    single = [reference(t) for t in times]
    for name in ("q", "w", "w_dot"):
        np.testing.assert_allclose(getattr(batched, name), np.stack([getattr(one, name) for one in single]), atol=1e-15)
    slopes = jax.vmap(jax.jacfwd(lambda t: reference(t).w))(times)
    np.testing.assert_allclose(slopes, batched.w_dot, rtol=0, atol=1e-13)


@pytest.mark.parametrize(
    "times", [UNEVEN, np.linspace(0.0, 7.0, 50), np.array([0.0, 1e-3, 5.0]), np.array([-3.0, 4.0])]
)
def test_interpolation_uses_the_interval_that_contains_the_time(times):
    reference = references.interpolate_attitude(times, wander(times))
    inside = np.sort(np.concatenate([times, np.random.default_rng(0).uniform(times[0], times[-1], 500)]))
    exact = CubicHermiteSpline(times, np.asarray(reference.samples), np.asarray(reference.slopes))(inside)
    assert apart(at(reference, inside).q, exact).max() < 1e-12
