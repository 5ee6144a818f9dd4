import itertools

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ptsmc_jax import formulas
from ptsmc_jax.plants import base, integrator_chain, rigid_body, second_order
from tests.helpers import FULL_INERTIA, PAPER_INERTIA, vector

EPS = np.finfo(float).eps


def random_body(seed):
    """Return the inertia (3, 3) of random point masses, the sum of m (|r|^2 I - r r')."""
    points = np.random.default_rng(seed).normal(size=(6, 3)) * [1.0, 2.0, 0.5]
    return sum((r @ r) * np.eye(3) - np.outer(r, r) for r in points)


INERTIAS = [np.diag(PAPER_INERTIA), np.array(FULL_INERTIA), random_body(0), random_body(1)]


# motion


@pytest.mark.parametrize("inertia", INERTIAS)
def test_rates_of_a_rigid_body_follow_eulers_equation_and_the_kinematics(inertia):
    """Gyroscopic torque and momentum are compared too."""
    rng = np.random.default_rng(4)
    body = rigid_body.spacecraft(inertia)
    for _ in range(5):
        q, w, u, d = rng.normal(size=4), *rng.normal(size=(3, 3))
        x = rigid_body.AttitudeState(vector(q), vector(w))
        got = body.rate(vector(0.0), x, vector(u), vector(d))
        momentum = inertia @ w
        gyroscopic = [
            w[1] * momentum[2] - w[2] * momentum[1],
            w[2] * momentum[0] - w[0] * momentum[2],
            w[0] * momentum[1] - w[1] * momentum[0],
        ]
        scale = np.linalg.norm(w) ** 2 * np.linalg.norm(inertia)
        tolerance = 10 * EPS * np.linalg.norm(inertia) * np.linalg.norm(w)
        np.testing.assert_allclose(body.gyroscopic(vector(w)), gyroscopic, rtol=0, atol=10 * EPS * scale)
        np.testing.assert_allclose(
            body.momentum(rigid_body.AttitudeState(vector(q), vector(w))), momentum, rtol=0, atol=tolerance
        )
        w_dot = np.linalg.solve(inertia, u + d - gyroscopic)
        tolerance = 20 * EPS * np.linalg.cond(inertia) * (np.abs(w_dot).max() + scale / np.linalg.norm(inertia))
        np.testing.assert_allclose(got.w, w_dot, rtol=0, atol=tolerance)
        v, s = q[:3], q[3]
        np.testing.assert_allclose(got.q[:3], (s * w + np.cross(v, w)) / 2, rtol=0, atol=20 * EPS)
        np.testing.assert_allclose(got.q[3], -v @ w / 2, rtol=0, atol=20 * EPS)


@pytest.mark.parametrize("dt", [0.02, 0.5, 4.0])
def test_a_rotation_of_more_than_a_radian_per_step_is_too_fast(dt):
    body, still = rigid_body.spacecraft(PAPER_INERTIA), vector([0.0, 0.0, 0.0, 1.0])
    for turn, too_fast in ((0.99, False), (1.01, True)):
        w = turn / dt * vector([0.6, 0.0, -0.8])
        assert bool(body.is_too_fast(rigid_body.AttitudeState(still, w), vector(dt))) == too_fast


def test_normalise_changes_only_the_norm_of_the_quaternion():
    x = rigid_body.AttitudeState(vector([0.1, 0.2, -0.3, 0.4]), vector([1.0, 2.0, 3.0]))
    got = rigid_body.spacecraft(PAPER_INERTIA).normalise(x)
    np.testing.assert_allclose(got.q, np.array([1, 2, -3, 4]) / np.sqrt(30), rtol=4 * EPS)
    np.testing.assert_array_equal(got.w, x.w)


# as a part


def test_three_moments_of_inertia_give_a_diagonal_tensor():
    np.testing.assert_array_equal(formulas.check_inertia([1, 2, 2.5]), np.diag([1, 2, 2.5]))


# possible inertias

ALLOWED = {
    "sphere": (1, 1, 1),
    "plate": (1, 1, 2),  # flat: the largest is the sum
    "nearly a rod": (1e-6, 1, 1),
    "uneven": (2, 3, 4.9),
}
REFUSED = {
    "more than a plate": ((1, 1, 2.001), "must not exceed"),
    "rod": ((0, 1, 1), "positive definite"),
    "point": ((0, 0, 0), "positive definite"),
    "negative": ((-1, 2, 2), "positive definite"),
    "two negative": ((-1, -2, 2), "positive definite"),
    "thin and not a rod": ((1e-6, 1, 1.1), "must not exceed"),
}
ROTATIONS = [np.eye(3), *Rotation.random(3, rng=np.random.default_rng(8)).as_matrix()]


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize("moments", ALLOWED.values(), ids=list(ALLOWED))
def test_possible_inertias_are_accepted_at_any_scale_and_orientation(moments, scale):
    for order in itertools.permutations(moments):
        for rotation in ROTATIONS:
            tensor = scale * rotation @ np.diag(order) @ rotation.T
            # the tensor may be made symmetric, a change of one eps
            rounding = 8 * EPS * scale * max(order)
            np.testing.assert_allclose(formulas.check_inertia(tensor), tensor, rtol=0, atol=rounding)


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize(("moments", "reason"), REFUSED.values(), ids=list(REFUSED))
def test_impossible_inertias_are_refused_at_any_scale_and_orientation(moments, reason, scale):
    for order in itertools.permutations(moments):
        for rotation in ROTATIONS:
            tensor = scale * rotation @ np.diag(order) @ rotation.T
            for build in (formulas.check_inertia, rigid_body.spacecraft):
                with pytest.raises(ValueError, match=reason):
                    build((tensor + tensor.T) / 2)


@pytest.mark.parametrize(
    ("inertia", "reason"),
    [
        (5.0, "three principal moments or a symmetric 3x3"),
        ([1.0, 2.0], "three principal moments or a symmetric 3x3"),
        (np.eye(4), "three principal moments or a symmetric 3x3"),
        ([[1.0, 2.0, 3.0]], "three principal moments or a symmetric 3x3"),
        ([1.0, np.nan, 1.0], "finite"),
        ([1.0, np.inf, 1.0], "finite"),
        ([[2.0, 0.1, 0], [0.0, 2.0, 0], [0, 0, 2.0]], "symmetric"),
        ([[2e-7, 1e-9, 0], [0.0, 2e-7, 0], [0, 0, 2e-7]], "symmetric"),
    ],
)
def test_values_that_are_no_inertia_are_refused(inertia, reason):
    for build in (formulas.check_inertia, rigid_body.spacecraft):
        with pytest.raises(ValueError, match=reason):
            build(inertia)


def test_an_inertia_that_is_symmetric_except_for_rounding_becomes_symmetric():
    tensor = np.array(FULL_INERTIA)
    tensor[0, 1] *= 1 + 1e-15
    got = formulas.check_inertia(tensor)
    np.testing.assert_array_equal(got, got.T)


# all plants


ARM = second_order.system(
    2,
    F=lambda t, a, b: b + jnp.sin(t),
    H=lambda t, a, b: -b * jnp.abs(b) + a[::-1],
    G=lambda t, a, b: jnp.stack([jnp.stack([2.0 + jnp.cos(a[1]), a[0]]), jnp.stack([0.3 * a[0], 1.5 + b[0] ** 2])]),
    D=lambda t, a, b: jnp.eye(2) + 0.2 * jnp.outer(a, a),
)
PLANTS = {
    "body": (
        rigid_body.spacecraft(FULL_INERTIA),
        rigid_body.AttitudeState(vector([0.5, -0.5, 0.1, 0.7]), vector([0.2, -0.1, 0.3])),
    ),
    "chain": (
        integrator_chain.chain(3, lambda x: -x[0] * x[1], lambda x: 2.0 + jnp.cos(x[2])), vector([0.4, -1.2, 0.7]),
    ),
    "system": (ARM, vector([0.4, -0.3, 0.9, 0.2])),
}  # fmt: skip


@pytest.mark.parametrize("name", PLANTS)
def test_the_input_for_an_acceleration_and_the_unexplained_torque_are_consistent(name):
    """The input gives the requested acceleration, and the disturbance computed from the motion is the true one."""
    plant, x = PLANTS[name]
    t, (w_dot, d) = vector(0.6), np.random.default_rng(5).normal(size=(2, plant.inputs))
    u = plant.input_for(t, x, vector(w_dot), vector(d))
    x_dot = plant.rate(t, x, u, vector(d))
    unit = 100 * EPS * np.linalg.norm(plant.inertia)  # rounding of about ten sums of such numbers
    np.testing.assert_allclose(plant.velocity(x_dot), w_dot, rtol=0, atol=unit)
    np.testing.assert_allclose(plant.implied_disturbance(t, x, x_dot, u), d, rtol=0, atol=unit)


def test_check_indices_refuses_only_indices_out_of_range():
    given = {"a": vector([1.0, 2.0, 3.0])}, 2.0
    for beyond in (3, -4):
        with pytest.raises(IndexError, match=f"index {beyond} is out of bounds"):
            base.check_indices(lambda x, k, at=beyond: k * x["a"][at], *given)
    base.check_indices(lambda x, k: k * x["a"][jnp.argmax(x["a"])] + x["a"][-3], *given)
    base.check_indices(lambda x, k: x["a"].at[0].set(k), *given)  # NumPy has none
