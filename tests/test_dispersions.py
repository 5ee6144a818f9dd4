import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats
from scipy.spatial.transform import Rotation

from ptsmc_jax import dispersions, lanes, signals
from tests import helpers
from tests.helpers import chain_parts, vector

ALARM = 1e-6  # with other seeds a check would fail once in a million; they are fixed
EPS = np.finfo(float).eps
TRIALS = 2**14
REFERENCE = Rotation.from_rotvec([1.0, 2.0, -0.5])
NOMINAL = Rotation.from_rotvec([-0.4, 0.1, 1.9])
PARTS = helpers.parts(
    q=NOMINAL.as_quat(),
    rate=(0.01, -0.02, 0.03),
    reference=signals.Spin(vector(REFERENCE.as_quat()), vector([0.1, 0.0, 0.2])),
)
KINDS = {
    "uniform": dispersions.UniformAttitude(),
    "axis_angle": dispersions.AxisAngle(vector(np.radians(20.0)), vector(np.radians(140.0))),
    "normal": dispersions.NormalAttitude(vector(0.1)),
}


def one(kind, seed, trial):
    return dispersions.Dispersion(kind).apply(PARTS, seed, trial).initial.q


many = jax.jit(jax.vmap(one, (None, None, 0)))
single = jax.jit(one)


def drawn(kind, seed=1):
    return Rotation.from_quat(np.asarray(many(KINDS[kind], seed, jnp.arange(TRIALS, dtype=jnp.uint32))))


def is_uniform(values, low, high):
    return stats.kstest(values, "uniform", (low, high - low)).pvalue > ALARM


def is_on_the_sphere(directions):
    """Uniform directions: heights above three planes uniform (Archimedes), and the azimuth."""
    heights = [is_uniform(heights, -1, 1) for heights in directions.T]
    return all(heights) and is_uniform(np.arctan2(directions[:, 1], directions[:, 0]), -math.pi, math.pi)


def test_nothing_drawn_leaves_the_parts():
    assert dispersions.Dispersion().apply(PARTS, 1, 2) is PARTS


@pytest.mark.parametrize("kind", KINDS)
def test_only_the_initial_attitude_is_drawn(kind):
    got = dispersions.Dispersion(KINDS[kind]).apply(PARTS, 1, 2)
    before, after = (dict(jax.tree_util.tree_leaves_with_path(parts)) for parts in (PARTS, got))
    changed = [path for path in before if before[path] is not after[path]]
    assert before.keys() == after.keys()
    assert [jax.tree_util.keystr(path) for path in changed] == [".initial.q"]
    assert abs(np.linalg.norm(got.initial.q) - 1) < 8 * EPS


def test_axis_angle_turns_away_from_the_reference_at_the_start():
    turn = REFERENCE.inv() * drawn("axis_angle")
    angles, low, high = turn.magnitude(), math.radians(20), math.radians(140)
    assert low - 8 * EPS <= angles.min()
    assert angles.max() <= high + 8 * EPS
    assert is_uniform(angles, low, high)
    axes = turn.as_rotvec() / angles[:, None]
    assert is_on_the_sphere(axes)
    # the axis tells nothing about the angle: six correlations
    limit = -stats.norm.ppf(ALARM / 2 / 6) / math.sqrt(TRIALS)
    for axis in axes.T:
        assert abs(np.corrcoef(axis, angles)[0, 1]) < limit
        assert abs(np.corrcoef(axis**2, angles)[0, 1]) < limit


def test_axis_angle_of_one_angle_keeps_it():
    angle = vector(0.7)
    q = many(dispersions.AxisAngle(angle, angle), 5, jnp.arange(64, dtype=jnp.uint32))
    turn = REFERENCE.inv() * Rotation.from_quat(np.asarray(q))
    np.testing.assert_allclose(turn.magnitude(), 0.7, rtol=20 * EPS)


def test_uniform_attitudes_have_haar_measure():
    attitudes = drawn("uniform")
    left, right = Rotation.from_rotvec([0.3, 1.0, -2.0]), Rotation.from_rotvec([2.0, 0.1, 0.7])
    for seen in (attitudes, left * attitudes, attitudes * right, attitudes.inv(), REFERENCE.inv() * attitudes):
        # density (1 - cos a)/pi of the angle
        assert stats.kstest(seen.magnitude(), lambda a: (a - np.sin(a)) / np.pi).pvalue > ALARM
        for vector_ in ([0, 0, 1], [0.6, -0.8, 0]):
            assert is_on_the_sphere(seen.apply(vector_))


def test_normal_attitudes_are_turned_from_the_nominal_one():
    r = (NOMINAL.inv() * drawn("normal")).as_rotvec() / 0.1  # 10 sigma short of wrapping
    for axis in r.T:
        assert stats.kstest(axis, "norm").pvalue > ALARM
    sigmas = -stats.norm.ppf(ALARM / 2)
    assert np.all(np.abs(r.mean(axis=0)) < sigmas / math.sqrt(TRIALS))
    assert np.all(np.abs(r.var(axis=0) - 1) < sigmas * math.sqrt(2 / TRIALS))
    assert np.abs(np.corrcoef(r.T) - np.eye(3)).max() < sigmas / math.sqrt(TRIALS)


@pytest.mark.parametrize("kind", KINDS)
def test_a_trial_is_the_same_alone_and_in_any_batch(kind):
    trials = jnp.asarray([0, 1, 5, 2**32 - 1], dtype=jnp.uint32)
    alone = np.stack([single(KINDS[kind], 9, trial) for trial in trials])
    for batch in (
        np.stack([one(KINDS[kind], 9, 0), *alone[1:]]),  # without jit, a whole number
        many(KINDS[kind], 9, trials[::-1])[::-1],
        jax.jit(lanes.vmap(lambda k: one(KINDS[kind], 9, k)))(trials),
    ):
        np.testing.assert_allclose(batch, alone, rtol=0, atol=10 * EPS)  # products of sines up to 1
    assert np.abs(np.diff(alone, axis=0)).min() > 1e-6  # and no two are equal


@pytest.mark.parametrize("kind", KINDS)
def test_another_seed_draws_other_attitudes(kind):
    trials = jnp.arange(64, dtype=jnp.uint32)
    first, second = (np.asarray(many(KINDS[kind], seed, trials)) for seed in (1, 2))
    assert np.abs(first - second).max(axis=1).min() > 1e-6


@pytest.mark.parametrize("kind", KINDS)
def test_the_draw_belongs_to_its_own_stream(kind):
    """Trial and seed name it, and nothing of the nominal run does: same numbers with another loop and law."""
    other = helpers.parts(
        q=NOMINAL.as_quat(), reference=signals.Fixed(vector(REFERENCE.as_quat())), period=0.05, noise=(1e-5, 1e-6)
    )
    got = dispersions.Dispersion(KINDS[kind]).apply(other, 3, 4).initial.q
    np.testing.assert_array_equal(got, one(KINDS[kind], 3, 4))


def test_initial_states_of_a_chain_are_drawn_about_the_nominal_one():
    run = chain_parts([5.0, 3.0, 2.0])
    width = vector([1.0, 0.5, 0.0])
    trials = jnp.arange(TRIALS, dtype=jnp.uint32)
    drawn_states = {}
    for spread in (dispersions.UniformState(width), dispersions.NormalState(width)):
        whole = dispersions.Dispersion(state=spread)
        assert whole.varies
        x0 = np.asarray(jax.jit(jax.vmap(lambda k, whole=whole: whole.apply(run, 3, k).initial))(trials))
        np.testing.assert_array_equal(x0[:, 2], 2.0)
        drawn_states[type(spread)] = (x0[:, :2] - [5.0, 3.0]) / [1.0, 0.5]
        np.testing.assert_array_equal(whole.apply(run, 3, 7).initial, x0[7])
    uniform, normal = drawn_states[dispersions.UniformState], drawn_states[dispersions.NormalState]
    assert np.abs(uniform).max() <= 1.0
    for k in range(2):
        assert stats.kstest(uniform[:, k], "uniform", (-1.0, 2.0)).pvalue > ALARM
        assert stats.kstest(normal[:, k], "norm").pvalue > ALARM
    limit = -stats.norm.ppf(ALARM / 2) / math.sqrt(TRIALS)
    assert abs(np.corrcoef(uniform.T)[0, 1]) < limit
    assert not dispersions.Dispersion().varies
