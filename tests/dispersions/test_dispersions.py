"""Distributions of dispersed quantities by statistical tests, and the independence of their random streams."""

import itertools
import math
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats
from scipy.spatial.transform import Rotation

from ptsmc_jax import scenario
from ptsmc_jax.batching import lanes
from ptsmc_jax.devices import actuators
from ptsmc_jax.dispersions import base, numbers, quantities
from ptsmc_jax.dispersions.numbers import RandomNumbers
from ptsmc_jax.dispersions.variation import Dispersion
from ptsmc_jax.signals import disturbances, references
from tests import helpers
from tests.helpers import chain_parts, short, vector

ALARM = 1e-6  # probability of a false alarm of one statistical check; the seeds are fixed
EPS = np.finfo(float).eps
TRIALS = 2**14
REFERENCE = Rotation.from_rotvec([1.0, 2.0, -0.5])
NOMINAL = Rotation.from_rotvec([-0.4, 0.1, 1.9])
PARTS = helpers.parts(
    q=NOMINAL.as_quat(),
    rate=(0.01, -0.02, 0.03),
    reference=references.Spin(vector(REFERENCE.as_quat()), vector([0.1, 0.0, 0.2])),
)
KINDS = {
    "uniform": numbers.any_attitude(),
    "axis_angle": numbers.axis_angle(np.radians(20.0), np.radians(140.0)),
    "normal": RandomNumbers("normal", vector([0.1] * 3)),
}


def initial_attitude(kind, seed, trial):
    return Dispersion({"initial_attitude": kind}).apply(PARTS, seed, trial).initial.q


initial_attitudes = jax.jit(jax.vmap(initial_attitude, (None, None, 0)))
initial_attitude_jit = jax.jit(initial_attitude)


def sample_rotations(kind, seed=1):
    return Rotation.from_quat(np.asarray(initial_attitudes(KINDS[kind], seed, jnp.arange(TRIALS, dtype=jnp.uint32))))


def is_uniform(values, low, high):
    return stats.kstest(values, "uniform", (low, high - low)).pvalue > ALARM


def is_on_the_sphere(directions):
    """Return whether directions are uniform: by their components (Archimedes) and the azimuth."""
    components = [is_uniform(component, -1, 1) for component in directions.T]
    return all(components) and is_uniform(np.arctan2(directions[:, 1], directions[:, 0]), -math.pi, math.pi)


def test_empty_dispersion_returns_the_same_parts():
    assert Dispersion().apply(PARTS, 1, 2) is PARTS


@pytest.mark.parametrize("kind", KINDS)
def test_dispersion_of_the_initial_attitude_changes_nothing_else(kind):
    got = Dispersion({"initial_attitude": KINDS[kind]}).apply(PARTS, 1, 2)
    before, after = (dict(jax.tree_util.tree_leaves_with_path(parts)) for parts in (PARTS, got))
    changed = [path for path in before if before[path] is not after[path]]
    assert before.keys() == after.keys()
    assert [jax.tree_util.keystr(path) for path in changed] == [".initial.q"]
    assert abs(np.linalg.norm(got.initial.q) - 1) < 8 * EPS


def test_axis_angle_attitudes_are_relative_to_the_reference():
    turn = REFERENCE.inv() * sample_rotations("axis_angle")
    angles, low, high = turn.magnitude(), math.radians(20), math.radians(140)
    assert low - 8 * EPS <= angles.min()
    assert angles.max() <= high + 8 * EPS
    assert is_uniform(angles, low, high)
    axes = turn.as_rotvec() / angles[:, None]
    assert is_on_the_sphere(axes)
    # axis and angle are independent: six correlations
    limit = -stats.norm.ppf(ALARM / 2 / 6) / math.sqrt(TRIALS)
    for axis in axes.T:
        assert abs(np.corrcoef(axis, angles)[0, 1]) < limit
        assert abs(np.corrcoef(axis**2, angles)[0, 1]) < limit


def test_axis_angle_with_equal_limits_has_a_constant_angle():
    q = initial_attitudes(numbers.axis_angle(0.7, 0.7), 5, jnp.arange(64, dtype=jnp.uint32))
    turn = REFERENCE.inv() * Rotation.from_quat(np.asarray(q))
    np.testing.assert_allclose(turn.magnitude(), 0.7, rtol=20 * EPS)


def test_uniform_attitudes_are_uniform_on_so3():
    attitudes = sample_rotations("uniform")
    left, right = Rotation.from_rotvec([0.3, 1.0, -2.0]), Rotation.from_rotvec([2.0, 0.1, 0.7])
    for rotated in (attitudes, left * attitudes, attitudes * right, attitudes.inv(), REFERENCE.inv() * attitudes):
        # the angle has the density (1 - cos a)/pi
        assert stats.kstest(rotated.magnitude(), lambda a: (a - np.sin(a)) / np.pi).pvalue > ALARM
        for vector_ in ([0, 0, 1], [0.6, -0.8, 0]):
            assert is_on_the_sphere(rotated.apply(vector_))


def test_normal_attitudes_have_a_normal_rotation_vector_from_the_nominal_attitude():
    r = (NOMINAL.inv() * sample_rotations("normal")).as_rotvec() / 0.1  # 180 degrees is more than 10 sigma
    for axis in r.T:
        assert stats.kstest(axis, "norm").pvalue > ALARM
    sigmas = -stats.norm.ppf(ALARM / 2)
    assert np.all(np.abs(r.mean(axis=0)) < sigmas / math.sqrt(TRIALS))
    assert np.all(np.abs(r.var(axis=0) - 1) < sigmas * math.sqrt(2 / TRIALS))
    assert np.abs(np.corrcoef(r.T) - np.eye(3)).max() < sigmas / math.sqrt(TRIALS)


@pytest.mark.parametrize("kind", KINDS)
def test_trial_does_not_depend_on_the_batch(kind):
    trials = jnp.asarray([0, 1, 5, 2**32 - 1], dtype=jnp.uint32)
    alone = np.stack([initial_attitude_jit(KINDS[kind], 9, trial) for trial in trials])
    for batch in (
        np.stack([initial_attitude(KINDS[kind], 9, 0), *alone[1:]]),  # without jit, with an int
        initial_attitudes(KINDS[kind], 9, trials[::-1])[::-1],
        jax.jit(lanes.vmap(lambda k: initial_attitude(KINDS[kind], 9, k)))(trials),
    ):
        np.testing.assert_allclose(batch, alone, rtol=0, atol=10 * EPS)  # products of sines up to 1
    assert np.abs(np.diff(alone, axis=0)).min() > 1e-6  # no two trials are equal


@pytest.mark.parametrize("kind", KINDS)
def test_random_numbers_depend_only_on_seed_trial_and_quantity(kind):
    """Parts with another loop and other sensors have the same random numbers."""
    other = helpers.parts(
        q=NOMINAL.as_quat(), reference=references.Fixed(vector(REFERENCE.as_quat())), period=0.05, noise=(1e-5, 1e-6)
    )
    got = Dispersion({"initial_attitude": KINDS[kind]}).apply(other, 3, 4).initial.q
    np.testing.assert_array_equal(got, initial_attitude(KINDS[kind], 3, 4))


def test_initial_states_of_a_chain_have_their_distribution():
    run = chain_parts([5.0, 3.0, 2.0])
    width = vector([1.0, 0.5, 0.0])
    trials = jnp.arange(TRIALS, dtype=jnp.uint32)
    samples = {}
    for name in ("uniform", "normal"):
        dispersion = Dispersion({"initial_state": RandomNumbers(name, width)})
        assert dispersion.varies
        x0 = np.asarray(jax.jit(jax.vmap(lambda k, dispersion=dispersion: dispersion.apply(run, 3, k).initial))(trials))
        np.testing.assert_array_equal(x0[:, 2], 2.0)
        samples[name] = (x0[:, :2] - [5.0, 3.0]) / [1.0, 0.5]
        np.testing.assert_array_equal(dispersion.apply(run, 3, 7).initial, x0[7])
    uniform, normal = samples["uniform"], samples["normal"]
    assert np.abs(uniform).max() <= 1.0
    for k in range(2):
        assert stats.kstest(uniform[:, k], "uniform", (-1.0, 2.0)).pvalue > ALARM
        assert stats.kstest(normal[:, k], "norm").pvalue > ALARM
    limit = -stats.norm.ppf(ALARM / 2) / math.sqrt(TRIALS)
    assert abs(np.corrcoef(uniform.T)[0, 1]) < limit
    assert not Dispersion().varies


def uniform_phases(count):
    return RandomNumbers("interval", vector(np.full(count, 2.0 * np.pi)))


def parts_of_trials(dispersion, run=PARTS, count=TRIALS, seed=4):
    """Return the parts of many trials, with a leading axis."""
    return jax.jit(jax.vmap(lambda k: dispersion.apply(run, seed, k)))(jnp.arange(count, dtype=jnp.uint32))


def sample_inertias(moments, std, turn=0.0, axes=None):
    axes = np.eye(3) if axes is None else axes
    kind = numbers.RelativeInertia(vector(moments), vector(axes), vector(std), vector(turn))
    plant = plants_of(Dispersion({"inertia": kind}), jnp.arange(TRIALS, dtype=jnp.uint32))
    return np.asarray(plant.inertia), np.asarray(plant.inertia_inverse)


plants_of = jax.jit(jax.vmap(lambda whole, k: whole.apply(PARTS, 4, k).plant, (None, 0)))


def test_principal_moments_are_truncated_normal():
    """For these moments, every sample within three sigma is physical, so that no sample is rejected."""
    inertia, inverse = sample_inertias([10.0, 12.0, 14.0], 0.05)
    assert np.abs(inertia - inertia * np.eye(3)).max() == 0.0
    np.testing.assert_allclose(inertia @ inverse, np.broadcast_to(np.eye(3), inertia.shape), atol=1e-14)
    standard = (np.diagonal(inertia, axis1=1, axis2=2) / [10.0, 12.0, 14.0] - 1.0) / 0.05
    assert 2.9 < np.abs(standard).max() <= 3.0 + 1e-9  # without truncation 44 of 16 384 samples would exceed it
    for axis in standard.T:
        assert stats.kstest(axis, stats.truncnorm(-3, 3).cdf).pvalue > ALARM
    limit = -stats.norm.ppf(ALARM / 2) / math.sqrt(TRIALS)
    assert np.abs(np.corrcoef(standard.T) - np.eye(3)).max() < limit


@pytest.mark.parametrize("moments", [[1.0, 1.0, 2.0], [5.0, 9.0, 13.9], [10.0, 12.0, 14.0]])
def test_every_sampled_inertia_is_physical(moments):
    """For the flat body (1, 1, 2) half of the samples are unphysical. They are rejected, not clipped."""
    rotation = Rotation.from_rotvec([0.3, -0.2, 0.9]).as_matrix()
    inertia, inverse = sample_inertias(moments, 0.2, turn=0.1, axes=rotation)
    np.testing.assert_allclose(inertia, inertia.swapaxes(1, 2), atol=1e-14 * max(moments))
    np.testing.assert_allclose(inertia @ inverse, np.broadcast_to(np.eye(3), inertia.shape), atol=1e-13)
    found = np.linalg.eigvalsh(inertia)
    assert found.min() > 0.0
    assert np.all(found[:, 2] <= (found[:, 0] + found[:, 1]) * (1 + 1e-12))
    on_the_edge = np.mean(found[:, 2] > (found[:, 0] + found[:, 1]) * (1 - 1e-9))
    assert on_the_edge < 1e-3  # clipping would put half of the samples on the limit


@pytest.mark.parametrize("std", [0.05, 0.2])
@pytest.mark.parametrize("moments", [[20.0, 0.02, 20.0], [10.0, 10.0, 0.1], [1e-4, 100.0, 100.0]])
def test_slender_bodies_have_the_stated_distribution(moments, std):
    """The two large moments a and b may differ by at most the small one, c, which few samples satisfy.

    c is small compared with the spread of a - b. So (a - b) / c is nearly uniform, c has its normal density times c,
    and the mean of a and b is normal. The relative error of this approximation is at most 0.3 %. The test detects 2 %.
    """
    inertia, _ = sample_inertias(moments, std)
    found = np.diagonal(inertia, axis1=1, axis2=2)[:, np.argsort(moments)]
    assert np.all(2.0 * found.max(axis=1) <= found.sum(axis=1))
    c, a, b = ((found / np.sort(moments) - 1.0) / std).T
    assert np.abs([a, b, c]).max() <= numbers.TRUNCATION_SIGMAS * (1 + 1e-9)

    def cdf(s):
        def antiderivative(s):  # integral of (1 + std s) times the normal density
            return stats.norm.cdf(s) - std * stats.norm.pdf(s)

        return (antiderivative(s) - antiderivative(-3.0)) / (antiderivative(3.0) - antiderivative(-3.0))

    difference = (found[:, 1] - found[:, 2]) / found[:, 0]
    assert stats.kstest(c, cdf).pvalue > ALARM
    assert stats.kstest(difference, "uniform", (-1.0, 2.0)).pvalue > ALARM
    assert stats.kstest((a + b) / math.sqrt(2.0), "norm").pvalue > ALARM
    limit = -stats.norm.ppf(ALARM / 2) / math.sqrt(TRIALS)
    assert np.abs(np.corrcoef([c, a + b, difference]) - np.eye(3)).max() < limit


inertia_of = jax.jit(jax.vmap(lambda kind, c: kind.at(c)[0], (None, 0)))


MOMENTS = ([10.0, 10.0, 20.0], [20.0, 19.5, 1.0], [2.0, 20.0, 20.0], [10.0, 12.0, 14.0])
BODIES = list(itertools.product(MOMENTS, (0.05, 0.3)))


@pytest.mark.parametrize(("moments", "std"), short(BODIES, [BODIES[0], BODIES[4], BODIES[7]]))
def test_fallback_samples_have_the_distribution_of_repeated_rejection(moments, std):
    """All candidates are set beyond three sigma, so that only the fallback for slender bodies is used."""
    rng = np.random.default_rng(1)
    kind = numbers.RelativeInertia(vector(moments), vector(np.eye(3)), vector(std), vector(0.0))
    c = rng.standard_normal((1 << 15, kind.count))
    c[:, : 3 * numbers.CANDIDATES] = 9.0
    found = np.diagonal(np.asarray(inertia_of(kind, vector(c))), axis1=1, axis2=2)
    standard = rng.standard_normal((1 << 19, 3))
    expected = np.array(moments) * (1.0 + std * standard)
    is_physical = (2.0 * expected.max(axis=1) <= expected.sum(axis=1)) & (expected.min(axis=1) > 0.0)
    expected = expected[is_physical & (np.abs(standard).max(axis=1) <= numbers.TRUNCATION_SIGMAS)]
    assert len(expected) > 1 << 15
    for weights in ([1, 0, 0], [0, 1, 0], [0, 0, 1], [1, -1, 0], [0, 1, -1], [1, 1, -1], [1, 1, 1]):
        one, other = found @ np.array(weights), expected @ np.array(weights)
        assert np.asarray(stats.ks_2samp(one, other))[1] > ALARM, weights
    assert not np.any(np.all(found == moments, axis=1))


def test_first_physical_candidate_is_used():
    rng, moments, std = np.random.default_rng(2), np.array([10.0, 12.0, 20.0]), 0.2
    kind = numbers.RelativeInertia(vector(moments), vector(np.eye(3)), vector(std), vector(0.0))
    c = rng.standard_normal((1 << 15, kind.count))
    found = np.diagonal(np.asarray(inertia_of(kind, vector(c))), axis1=1, axis2=2)
    standard = c[:, : 3 * numbers.CANDIDATES].reshape(len(c), -1, 3)
    candidates = moments * (1.0 + std * standard)
    is_valid = 2.0 * candidates.max(axis=2) <= candidates.sum(axis=2)
    is_valid &= np.abs(standard).max(axis=2) <= numbers.TRUNCATION_SIGMAS
    some, first = is_valid.any(axis=1), is_valid.argmax(axis=1)
    assert {0, 1, 2, 3} <= set(first[some])
    np.testing.assert_allclose(found[some], candidates[some, first[some]], rtol=1e-14)


inertia_jacobians = jax.jit(jax.jacfwd(lambda kind, c: kind.at(c), (0, 1)))


@pytest.mark.parametrize("moments", [[20.0, 20.0, 0.02], [10.0, 12.0, 14.0], [1.0, 1.0, 2.0]])
def test_sampled_inertias_have_finite_derivatives(moments):
    """This includes a standard deviation of zero and extreme random numbers."""
    for std, first in itertools.product((0.0, 0.05), (0.5, 9.0)):
        for size in (0.3, 6.7):
            kind = numbers.RelativeInertia(vector(moments), vector(np.eye(3)), vector(std), vector(0.1))
            c = jnp.full(kind.count, size).at[: 3 * numbers.CANDIDATES].set(first)
            assert all(np.all(np.isfinite(jacobian)) for jacobian in jax.tree.leaves(inertia_jacobians(kind, c)))


def test_principal_axes_are_rotated_by_a_normal_rotation_vector():
    rotation = Rotation.from_rotvec([0.3, -0.2, 0.9])
    inertia, _ = sample_inertias([5.0, 10.0, 14.0], 0.0, turn=0.01, axes=rotation.as_matrix())
    # to first order J' = A (D + [r]x D - D [r]x) A': off-diagonal (i, j) of A' J' A is r_k (D_i - D_j), up to sign
    inner = rotation.as_matrix().T @ inertia @ rotation.as_matrix()
    for i, j in ((0, 1), (0, 2), (1, 2)):
        turn = inner[:, i, j] / ([5.0, 10.0, 14.0][j] - [5.0, 10.0, 14.0][i]) / 0.01
        assert abs(np.std(turn) - 1.0) < 0.04  # sampling error 0.006, second order 0.01
    np.testing.assert_allclose(np.linalg.eigvalsh(inertia), [[5.0, 10.0, 14.0]] * TRIALS, rtol=1e-12)


SINE = disturbances.Sinusoid(*(vector(v) for v in ([0.1] * 3, [0.2] * 3, [0.0, 0.5, 1.0], [0.0] * 3)))
ORBIT = disturbances.GravityGradient(PARTS.plant.inertia, vector([0.0, 0.0, 0.0, 1.0]), vector(1e-3), vector(0.25))


def test_phases_are_uniform_and_independent():
    still = disturbances.Constant(vector([0.1, 0.2, 0.3]))
    run = replace(PARTS, disturbance=disturbances.Sum((SINE, still, ORBIT, SINE)))
    got = parts_of_trials(Dispersion({"disturbance_phase": uniform_phases(7)}), run).disturbance.terms
    np.testing.assert_array_equal(got[1].amplitude, np.broadcast_to(still.amplitude, (TRIALS, 3)))
    turns = np.column_stack(
        [
            np.asarray(got[0].phase) - np.asarray(SINE.phase),
            np.asarray(got[2].phase) - 0.25,
            np.asarray(got[3].phase) - np.asarray(SINE.phase),
        ]
    )
    assert turns.shape == (TRIALS, 7)
    for axis in turns.T:
        assert is_uniform(axis, 0.0, 2 * math.pi)
    limit = -stats.norm.ppf(ALARM / 2) / math.sqrt(TRIALS)
    assert np.abs(np.corrcoef(turns.T) - np.eye(7)).max() < limit


def test_gravity_gradient_acts_on_the_sampled_inertia():
    kind = numbers.RelativeInertia(vector([10.0, 12.0, 14.0]), vector(np.eye(3)), vector(0.05), vector(0.0))
    run = replace(PARTS, disturbance=disturbances.Sum((ORBIT, SINE)))
    got = jax.jit(lambda: Dispersion({"inertia": kind}).apply(run, 1, 2))()
    np.testing.assert_array_equal(got.disturbance.terms[0].inertia, got.plant.inertia)
    assert np.abs(got.plant.inertia - PARTS.plant.inertia).max() > 0.01
    np.testing.assert_array_equal(got.controller.model.inertia, PARTS.controller.model.inertia)  # nominal


NOISY = helpers.parts(
    q=NOMINAL.as_quat(), reference=references.Fixed(vector(REFERENCE.as_quat())), period=0.05, noise=(1e-5, 1e-6),
    disturbance=SINE,
)  # fmt: skip
LIMITED = replace(NOISY, actuators=actuators.Actuators(torque_limit=vector(0.5)))
TENTH = RandomNumbers("truncated_normal", vector([0.1]))
WIDE = RandomNumbers("uniform", vector([0.5]))


def test_relative_dispersions_are_truncated_not_clipped():
    """The factors have the truncated normal or the uniform distribution, without repeated values at the ends."""
    got = parts_of_trials(Dispersion({"torque_limit_level": TENTH, "attitude_noise_level": WIDE}), LIMITED)
    normal = (np.asarray(got.actuators.torque_limit) / 0.5 - 1.0) / 0.1
    uniform = np.asarray(got.sensors.attitude_noise) / 1e-5
    assert stats.kstest(normal, stats.truncnorm(-3, 3).cdf).pvalue > ALARM
    assert is_uniform(uniform, 0.5, 1.5)
    assert 2.9 < np.abs(normal).max() < 3.0
    assert len(np.unique(normal)) == len(np.unique(uniform)) == TRIALS
    np.testing.assert_array_equal(got.sensors.rate_noise, np.full(TRIALS, 1e-6))
    limit = -stats.norm.ppf(ALARM / 2) / math.sqrt(TRIALS)
    assert abs(np.corrcoef(normal, uniform)[0, 1]) < limit


def test_amplitudes_are_scaled_independently_and_a_bias_is_added():
    still = disturbances.Constant(vector([0.1, 0.2, 0.3]))
    run = replace(PARTS, disturbance=disturbances.Sum((SINE, ORBIT, still)))
    added = RandomNumbers("normal", vector([0.01] * 3))
    factors = RandomNumbers("uniform", vector([0.5] * 6))
    spread = Dispersion({"disturbance_bias": added, "disturbance_amplitude": factors})
    sine, orbit, constant, bias = parts_of_trials(spread, run).disturbance.terms
    factors = np.column_stack([np.asarray(sine.amplitude) / 0.1, np.asarray(constant.amplitude) / [0.1, 0.2, 0.3]])
    for column in factors.T:
        assert is_uniform(column, 0.5, 1.5)
    for column in np.asarray(bias.amplitude).T:
        assert stats.kstest(column / 0.01, "norm").pvalue > ALARM
    columns = np.column_stack([factors, np.asarray(bias.amplitude)])
    limit = -stats.norm.ppf(ALARM / 2) / math.sqrt(TRIALS)
    assert np.abs(np.corrcoef(columns.T) - np.eye(9)).max() < limit
    np.testing.assert_array_equal(orbit.phase, np.full(TRIALS, 0.25))
    alone = Dispersion({"disturbance_bias": added}).apply(replace(PARTS, disturbance=SINE), 4, 9).disturbance
    np.testing.assert_array_equal(alone.terms[-1].amplitude, bias.amplitude[9])
    t = vector(3.7)
    np.testing.assert_allclose(alone(t, PARTS.initial), SINE(t) + bias.amplitude[9], rtol=1e-14)


def test_initial_attitude_is_relative_to_the_random_reference():
    spread = RandomNumbers("normal", vector([0.05] * 3))
    dispersion = Dispersion({"initial_attitude": KINDS["axis_angle"], "reference": spread})
    got = parts_of_trials(dispersion)
    q_f = Rotation.from_quat(np.asarray(got.reference.q))
    for axis in ((REFERENCE.inv() * q_f).as_rotvec() / 0.05).T:
        assert stats.kstest(axis, "norm").pvalue > ALARM
    same = sample_rotations("axis_angle", seed=4)  # the rotation from the reference does not depend on the reference
    turn = (q_f.inv() * Rotation.from_quat(np.asarray(got.initial.q))).as_quat(canonical=True)
    np.testing.assert_allclose(turn, (REFERENCE.inv() * same).as_quat(canonical=True), atol=1e-14)
    np.testing.assert_array_equal(got.reference.rate, np.broadcast_to([0.1, 0.0, 0.2], (TRIALS, 3)))


def test_random_numbers_of_a_quantity_do_not_depend_on_other_quantities():
    inertia = numbers.RelativeInertia(vector([10.0, 12.0, 14.0]), vector(np.eye(3)), vector(0.05), vector(0.1))
    tenths = RandomNumbers("uniform", vector([0.5] * 3))
    kinds = {
        "initial_attitude": (KINDS["normal"], lambda p: p.initial.q),
        "initial_rate": (RandomNumbers("normal", vector([0.01] * 3)), lambda p: p.initial.w),
        "inertia": (inertia, lambda p: p.plant.inertia),
        "disturbance_phase": (uniform_phases(3), lambda p: disturbances.values(p.disturbance, "phase")),
        "disturbance_amplitude": (tenths, lambda p: disturbances.values(p.disturbance, "amplitude")[:3]),
        "disturbance_bias": (tenths, lambda p: p.disturbance.terms[-1].amplitude),
        "reference": (KINDS["uniform"], lambda p: p.reference.q),
        "torque_limit_level": (TENTH, lambda p: p.actuators.torque_limit),
        "rate_noise_level": (WIDE, lambda p: p.sensors.rate_noise),
    }
    dispersion = Dispersion({name: kind for name, (kind, _) in kinds.items()})
    got = dispersion.apply(LIMITED, 7, 8)
    for name, (kind, read) in kinds.items():
        alone = Dispersion({name: kind}).apply(LIMITED, 7, 8)
        np.testing.assert_array_equal(read(got), read(alone), err_msg=name)
        assert not np.array_equal(read(alone), read(Dispersion({"disturbance_bias": tenths}).apply(LIMITED, 1, 1)))
    c = dispersion.coordinates(7, 8)
    assert len({float(v[0]) for v in c.values()}) == len(c) == 9


def test_at_with_the_coordinates_of_a_trial_equals_apply():
    rates = RandomNumbers("normal", vector([0.01] * 3))
    dispersion = Dispersion({"initial_attitude": KINDS["axis_angle"], "initial_rate": rates})
    at = dispersion.at(PARTS, dispersion.coordinates(3, 9))
    applied = dispersion.apply(PARTS, 3, 9)
    jax.tree.map(np.testing.assert_array_equal, at.initial, applied.initial)
    middle = dispersion.at(
        PARTS, {"initial_attitude": vector([0.5, 0.0, 1.0]), "initial_rate": vector([0.0, 1.0, 0.0])}
    )
    turn = (REFERENCE.inv() * Rotation.from_quat(np.asarray(middle.initial.q))).as_rotvec()
    np.testing.assert_allclose(turn, [math.radians(140.0), 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(middle.initial.w, PARTS.initial.w + np.array([0.0, 0.01, 0.0]), rtol=1e-15)


def test_columns_of_quantities_have_units():
    tables = {
        "flexible": {"frequency": [3.0], "damping": [0.01], "coupling": [[0.5, 0.0, 0.0]]},
        "loop": {"mode": "sampled"}, "hardware": {"attitude_noise": 1e-5, "torque_limit": 1.0}, "wheels": {},
    }  # fmt: skip
    named = quantities.units(scenario.study(scenario.from_tables(tables)).parts)
    for column, unit in {
        "initial_angle": "rad", "initial_q4": "-", "initial_w1": "rad/s", "inertia_12": "kg m^2",
        "disturbance_bias_3": "N m", "attitude_noise": "rad", "wheel_failure_time": "s", "wheel_failure_wheel": "-",
        "mode_frequency_1": "rad/s", "mode_coupling_11": "sqrt(kg) m", "actuator_scale_1": "-", "timing_jitter": "-",
    }.items():  # fmt: skip
        assert named[column] == unit, column
    chain = quantities.units(chain_parts([1.0, 0.0]))
    assert (chain["initial_angle"], chain["initial_x2"], chain["disturbance_bias_1"]) == ("x1", "", "")


def test_quaternions_of_a_run_table_are_normalised_and_unit_quaternions_are_not_changed():
    """The norm may differ from 1 by the rounding of decimal digits in a table, up to 1e-6."""
    q = REFERENCE.as_quat()
    rounded = np.nextafter(q, 1.0)
    rows = np.stack([rounded, (1.0 + 5e-8) * q, (1.0 - 9e-7) * q])
    found = quantities._normalise(rows)
    np.testing.assert_array_equal(found[0], rounded)
    np.testing.assert_allclose(found[1:], [q, q], rtol=0, atol=4 * EPS)
    with pytest.raises(base.UnfitError, match="a unit quaternion") as refused:
        quantities._normalise(np.stack([q, (1.0 + 1.1e-6) * q]))
    assert refused.value.row == 1
