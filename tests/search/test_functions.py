"""Tests of `minimise` on functions with known minima."""

import jax.numpy as jnp
import numpy as np
import pytest

from tuning.search import Settings, functions, minimise


def test_minimum_of_a_quadratic_is_its_projection_on_the_box():
    """With a diagonal matrix, the minimum in a box is the unconstrained minimum clipped to the box."""
    rng = np.random.default_rng(0)
    for count in (1, 3, 6):
        centre, weights = rng.uniform(-2.0, 2.0, count), rng.uniform(0.1, 100.0, count)
        found = minimise(lambda x, w=weights, c=centre: jnp.sum(w * (x - c) ** 2), None, [(-1.0, 1.5)] * count)
        np.testing.assert_allclose(found.x, np.clip(centre, -1.0, 1.5), atol=1e-5)
        assert found.feasible


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_the_best_of_several_local_minima_is_found(scale):
    """Six-hump camel function: two global minima of -1.0316 at +-(0.0898, -0.7126), four others."""

    def camel(z):
        x, y = z
        return scale * ((4.0 - 2.1 * x**2 + x**4 / 3.0) * x**2 + x * y + (4.0 * y**2 - 4.0) * y**2)

    found = minimise(camel, None, [(-3.0, 3.0), (-2.0, 2.0)], Settings(tolerance=1e-12 * scale))
    assert found.value / scale == pytest.approx(-1.0316284535, abs=1e-6)
    np.testing.assert_allclose(np.abs(found.x), [0.0898, 0.7126], atol=1e-3)
    values = [one.value for one in found.locals]
    assert values == sorted(values)
    assert len(values) == 8


def test_a_narrow_feasible_set_is_found_and_its_constraints_are_active():
    """Minimise the distance from (3, 0) on the arc |x|^2 in [1, 1.01], y >= 0.5. Two limits are active there."""

    def constraints(x):
        square = jnp.sum(x**2)
        return jnp.stack([1.0 - square, square - 1.01, 0.5 - x[1]])

    found = minimise(lambda x: jnp.sum((x - jnp.array([3.0, 0.0])) ** 2), constraints, [(-4.0, 4.0), (-4.0, 4.0)])
    assert found.feasible
    np.testing.assert_allclose(found.x, [np.sqrt(0.76), 0.5], atol=2e-4)


def test_contradictory_constraints_lead_to_the_smallest_violation():
    found = minimise(lambda x: x[0], lambda x: jnp.stack([1.0 - x[0], x[0] + 1.0]), [(-3.0, 3.0)])
    assert not found.feasible
    assert found.locals[0].violation == pytest.approx(1.0, abs=1e-3)  # x >= 1 and x <= -1
    np.testing.assert_allclose(found.x, 0.0, atol=1e-3)


def test_points_with_an_undefined_objective_are_avoided():
    found = minimise(lambda x: jnp.sum(x - jnp.log(x)), None, [(-1.0, 4.0)] * 2)
    np.testing.assert_allclose(found.x, 1.0, atol=1e-4)
    with pytest.raises(ValueError, match="finite at none of 64 points"):
        minimise(lambda x: jnp.log(x[0]), None, [(-2.0, -1.0)])


@pytest.mark.parametrize("bounds", [[(0.0, 0.0)], [(1.0, -1.0)], [(0.0, float("inf"))]])
def test_minimise_refuses_an_empty_or_infinite_box(bounds):
    with pytest.raises(ValueError, match="bounds are"):
        minimise(lambda x: x[0], None, bounds)


@pytest.mark.parametrize("bounds", [{"x": (0.0, 1.0)}, (0.0, 1.0), [(0.0, 0.5, 1.0)], [(0.0, 1.0), (0.0,)], []])
def test_minimise_refuses_bounds_that_are_no_list_of_pairs(bounds):
    with pytest.raises(TypeError, match=r"^bounds are .*, but must be a list with a pair"):
        functions._read_bounds(bounds)  # the type checker of the tests would refuse them in `minimise`


def test_minimise_refuses_an_objective_with_several_values():
    with pytest.raises(ValueError, match=r"returns an array of shape \(2,\), but must return one number"):
        minimise(lambda x: x, None, [(0.0, 1.0)] * 2)


@pytest.mark.parametrize(("constraint", "accepted"), [(5e-5, True), (2e-4, False)])
def test_a_constraint_of_at_most_1e_4_is_accepted(constraint, accepted):
    found = minimise(lambda x: x[0] ** 2, lambda x: 0.0 * x[0] + constraint, [(-1.0, 1.0)], Settings(starts=1))
    assert found.feasible == accepted


def test_results_of_minimise_depend_on_the_seed_only():
    one, again, other = (
        minimise(lambda x: jnp.sum(jnp.cos(3.0 * x) + 0.1 * x**2), None, [(-5.0, 5.0)] * 2, Settings(seed=seed))
        for seed in (1, 1, 2)
    )
    np.testing.assert_array_equal([e.x for e in one.locals], [e.x for e in again.locals])
    assert one.locals[0].x.tolist() != other.locals[0].x.tolist()
    assert one.value == pytest.approx(other.value, rel=1e-6)
