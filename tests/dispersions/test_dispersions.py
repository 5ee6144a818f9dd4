"""Distributions of dispersed quantities, and the independence of their random streams."""

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
from ptsmc_jax.numerics import draws
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
    """Return the random initial attitude, a quaternion (4,), of a trial; kind: its distribution."""
    return Dispersion({"initial_attitude": kind}).apply(PARTS, seed, trial).initial.q


initial_attitudes = jax.jit(jax.vmap(initial_attitude, (None, None, 0)))
initial_attitude_jit = jax.jit(initial_attitude)


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


QUANTILES = {
    "normal": lambda c: c,
    "truncated_normal": stats.truncnorm(-3, 3).ppf,
    "uniform": lambda c: 2.0 * c - 1.0,
    "interval": lambda c: c,
}


@pytest.mark.parametrize("name", QUANTILES)
def test_random_numbers_are_quantiles_of_their_distribution(name):
    c = np.linspace(0.0, 1.0, 101)
    kind = RandomNumbers(name, vector(np.full(101, 0.1)), vector(np.full(101, 3.0)))
    assert kind.drawn == ("normal" if name == "normal" else "uniform")
    np.testing.assert_allclose(kind.at(vector(c)), 3.0 + 0.1 * QUANTILES[name](c), rtol=1e-13)


def parts_at(parts, given):
    """Return the parts of a trial with the nominal parts `parts`.

    given: {quantity: (distribution, coordinates)}. The coordinates are the random numbers of the trial, standard normal
    or uniform in 0 to 1 according to `drawn` of the distribution.
    """
    coordinates = {name: vector(c) for name, (_, c) in given.items()}
    return Dispersion({name: kind for name, (kind, _) in given.items()}).at(parts, coordinates)


@pytest.mark.parametrize("c", [(0.1, 0.2, 0.0), (0.5, 0.9, 0.3), (0.97, 0.6, 1.0)])
def test_initial_attitudes_are_rotated_from_the_random_reference_attitude(c):
    """The height on the sphere and the azimuth of a uniform axis are uniform (Archimedes)."""
    spread = RandomNumbers("normal", vector([0.05] * 3))
    got = parts_at(PARTS, {"initial_attitude": (KINDS["axis_angle"], c), "reference": (spread, [1.0, -2.0, 0.5])})
    q_f = REFERENCE * Rotation.from_rotvec([0.05, -0.1, 0.025])
    z, azimuth, angle = 2.0 * c[0] - 1.0, 2.0 * np.pi * c[1], np.radians(20.0 + 120.0 * c[2])
    axis = np.array([np.sqrt(1.0 - z**2) * np.cos(azimuth), np.sqrt(1.0 - z**2) * np.sin(azimuth), z])
    for found, expected in ((got.reference.q, q_f), (got.initial.q, q_f * Rotation.from_rotvec(angle * axis))):
        np.testing.assert_allclose(Rotation.from_quat(np.array(found)).as_matrix(), expected.as_matrix(), atol=1e-14)
    np.testing.assert_array_equal(got.reference.rate, PARTS.reference.rate)


def test_initial_attitudes_and_rates_equal_closed_forms_of_their_random_numbers():
    """A normalised vector of four normal numbers is a uniform attitude (Muller, 1959)."""
    rates = RandomNumbers("normal", vector([0.01] * 3))
    got = parts_at(PARTS, {"initial_attitude": (KINDS["normal"], [1.0, -2.0, 0.5]), "initial_rate": (rates, [0, 1, 0])})
    turn = (NOMINAL.inv() * Rotation.from_quat(np.array(got.initial.q))).as_rotvec()
    np.testing.assert_allclose(turn, [0.1, -0.2, 0.05], rtol=1e-13)
    np.testing.assert_allclose(got.initial.w, PARTS.initial.w + np.array([0.0, 0.01, 0.0]), rtol=1e-15)
    assert KINDS["uniform"].drawn == "normal"
    q = parts_at(PARTS, {"initial_attitude": (KINDS["uniform"], [1.0, -2.0, 0.5, 0.2])}).initial.q
    np.testing.assert_allclose(q, np.array([1.0, -2.0, 0.5, 0.2]) / np.sqrt(5.29), rtol=4 * EPS)


@pytest.mark.parametrize("kind", KINDS)
def test_random_initial_attitude_does_not_depend_on_the_batch(kind):
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


def test_initial_states_of_a_chain_use_their_random_stream():
    run, width, stream = chain_parts([5.0, 3.0, 2.0]), np.array([1.0, 0.5, 0.0]), draws.stream(3, 7, "initial_state")
    for name, standard in (("uniform", 2.0 * draws.uniforms(stream, 3) - 1.0), ("normal", draws.normals(stream, 3))):
        dispersion = Dispersion({"initial_state": RandomNumbers(name, vector(width))})
        assert dispersion.varies
        x0 = dispersion.apply(run, 3, 7).initial
        np.testing.assert_allclose(x0, run.initial + width * standard, rtol=8 * EPS)
    assert not Dispersion().varies


def uniform_phases(count):
    """Return the distribution of `count` phases that are uniform from 0 to 2 pi."""
    return RandomNumbers("interval", vector(np.full(count, 2.0 * np.pi)))


def sample_inertias(moments, std, turn=0.0, axes=None):
    """Return two arrays (TRIALS, 3, 3): random inertias about these principal moments, and their inverses.

    std: relative, of the moments. turn: std [rad] of the rotation of the axes. axes: nominal principal axes (3, 3).
    """
    axes = np.eye(3) if axes is None else axes
    kind = numbers.RelativeInertia(vector(moments), vector(axes), vector(std), vector(turn))
    plant = plants_of(Dispersion({"inertia": kind}), jnp.arange(TRIALS, dtype=jnp.uint32))
    return np.asarray(plant.inertia), np.asarray(plant.inertia_inverse)


plants_of = jax.jit(jax.vmap(lambda whole, k: whole.apply(PARTS, 4, k).plant, (None, 0)))


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
def test_sampled_inertias_of_slender_bodies_have_the_stated_distribution(moments, std):
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
def test_fallback_samples_of_the_inertia_have_the_distribution_of_repeated_rejection(moments, std):
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


def test_sampled_inertia_is_the_first_physical_candidate():
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


def test_principal_axes_of_sampled_inertias_are_rotated_by_a_normal_rotation_vector():
    axes, moments = Rotation.from_rotvec([0.3, -0.2, 0.9]), np.array([5.0, 10.0, 14.0])
    kind = numbers.RelativeInertia(vector(moments), vector(axes.as_matrix()), vector(0.0), vector(0.01))
    c = np.zeros(kind.count)
    c[3 * numbers.CANDIDATES :][:3] = [1.0, -2.0, 0.5]
    turned = (axes * Rotation.from_rotvec([0.01, -0.02, 0.005])).as_matrix()
    np.testing.assert_allclose(kind.at(vector(c))[0], turned @ np.diag(moments) @ turned.T, atol=1e-13)


SINE = disturbances.Sinusoid(*(vector(v) for v in ([0.1] * 3, [0.2] * 3, [0.0, 0.5, 1.0], [0.0] * 3)))
ORBIT = disturbances.GravityGradient(PARTS.plant.inertia, vector([0.0, 0.0, 0.0, 1.0]), vector(1e-3), vector(0.25))


STILL = disturbances.Constant(vector([0.1, 0.2, 0.3]))
C = np.random.default_rng(0).uniform(size=7)


def test_random_phases_are_added_to_all_periodic_disturbances():
    run = replace(PARTS, disturbance=disturbances.Sum((SINE, STILL, ORBIT, SINE)))
    got = parts_at(run, {"disturbance_phase": (uniform_phases(7), C)}).disturbance.terms
    np.testing.assert_array_equal(got[1].amplitude, STILL.amplitude)
    for term, nominal, c in ((got[0], SINE, C[:3]), (got[2], ORBIT, C[3]), (got[3], SINE, C[4:])):
        np.testing.assert_allclose(term.phase, nominal.phase + 2.0 * np.pi * c, rtol=8 * EPS)


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


def test_relative_dispersions_scale_the_nominal_value():
    got = parts_at(LIMITED, {"torque_limit_level": (TENTH, C[:1]), "attitude_noise_level": (WIDE, C[1:2])})
    assert got.actuators.torque_limit is not None
    np.testing.assert_allclose(got.actuators.torque_limit, 0.5 * (1.0 + TENTH.at(vector(C[:1]))[0]), rtol=8 * EPS)
    np.testing.assert_allclose(got.sensors.attitude_noise, 1e-5 * (0.5 + C[1]), rtol=8 * EPS)
    np.testing.assert_array_equal(got.sensors.rate_noise, 1e-6)


def test_amplitudes_of_disturbances_are_scaled_independently_and_a_bias_is_added():
    """Terms without an amplitude do not change. The bias is also added to a single disturbance."""
    run = replace(PARTS, disturbance=disturbances.Sum((SINE, ORBIT, STILL)))
    added, factors = RandomNumbers("normal", vector([0.01] * 3)), RandomNumbers("uniform", vector([0.5] * 6))
    given = {"disturbance_bias": (added, [1.0, -2.0, 0.5]), "disturbance_amplitude": (factors, C[:6])}
    sine, orbit, constant, bias = parts_at(run, given).disturbance.terms
    np.testing.assert_allclose(sine.amplitude, 0.1 * (0.5 + C[:3]), rtol=8 * EPS)
    np.testing.assert_allclose(constant.amplitude, STILL.amplitude * (0.5 + C[3:6]), rtol=8 * EPS)
    np.testing.assert_allclose(bias.amplitude, [0.01, -0.02, 0.005], rtol=8 * EPS)
    assert orbit.phase == 0.25
    alone = parts_at(replace(PARTS, disturbance=SINE), {"disturbance_bias": given["disturbance_bias"]}).disturbance
    t = vector(3.7)
    np.testing.assert_allclose(alone(t, PARTS.initial), SINE(t) + bias.amplitude, rtol=1e-14)


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


def test_columns_of_dispersed_quantities_have_units():
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
