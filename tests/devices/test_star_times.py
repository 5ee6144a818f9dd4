"""A star tracker with its own clock, compared with an independent computation for each sample."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ptsmc_jax import scenario
from ptsmc_jax.campaigns import runs
from ptsmc_jax.devices import attitude_filter, attitude_sensors, sensors
from ptsmc_jax.devices.ticks import Ticks
from ptsmc_jax.onboard import vectors
from ptsmc_jax.plants import rigid_body
from tests.helpers import fly, vector
from tests.onboard.flights import FILTER, flight

SIGMAS = 6.0


def study_of(**hardware):
    """Return the study of a short scenario with an attitude filter and these keys of [hardware].

    The control periods are on the flight clock.
    """
    case_one = {"amplitude": [0.01] * 3, "frequency": [0.1] * 3}
    tables = flight(**FILTER, hardware=hardware, loop={"clock": "flight"}, disturbance=case_one)
    return scenario.study(scenario.from_tables({**tables, "dispersion": {}}))


@pytest.mark.parametrize("interval", [0.25, 1 / 3, 0.1 * math.pi])
def test_star_tracker_samples_are_used_at_the_same_times_in_32_bits(interval):
    times, count = attitude_sensors.sample_times(interval, 0.0, 0.1), 18_000
    for first in (0, -count):  # half an hour, after which the resolution of 32 bits is a thousandth of a period
        due = times.is_reading_due(jnp.arange(first, first + count))
        with jax.enable_x64(False):
            short = jax.tree.map(lambda v: v.astype(jnp.float32), times)
            off = np.cumsum(short.is_reading_due(jnp.arange(first, first + count))) - np.cumsum(due)
        # rounding may shift a sample by one if times nearly coincide
        assert np.abs(off).max() <= (times.pattern[0] > 10)


def by_hand(parts, simulated):
    """Return [(attitude as a `Rotation`, bias (3,) [rad/s]) after each sample], computed with NumPy and SciPy.

    simulated: the samples of a run of the parts.
    """
    known = parts.sensors.filter
    k1, k2 = float(known.attitude_gain), float(known.bias_gain)
    said = [(Rotation.from_quat(simulated.before["attitude"][0]), simulated.before["bias"][0])]
    gyro = simulated.inputs["rate"]
    rates = np.concatenate([gyro[:1], gyro])  # entry k: rate at the previous sample, for the first its own
    moments = np.concatenate([simulated.t[:1], simulated.t])
    for k in range(len(simulated.t)):
        q, bias = said[-1]
        t0, t1, w0, w1 = moments[k], moments[k + 1], rates[k], rates[k + 1]
        taken = 0.25 * math.floor(t1 / 0.25 + 1e-6)
        stops = [(t1, False)] if taken <= t0 and k > 0 else [(taken, True), (t1, False)]
        at, w = t0, w0
        for stop, star in stops:
            there = w0 if t1 == t0 else w0 + (stop - t0) / (t1 - t0) * (w1 - w0)
            a, b, h = w - bias, there - bias, stop - at
            q = q * Rotation.from_rotvec(h / 2 * (a + b) + h * h / 12 * np.cross(a, b))
            at, w = stop, there
            if star:
                residual = 2 * (q.inv() * Rotation.from_quat(simulated.inputs["attitude"][k])).as_quat()
                residual = residual[:3] * np.sign(residual[3])
                q, bias = q * Rotation.from_rotvec(k1 * residual), bias - k2 * residual
        said.append((q, bias))
    return said[1:]


@pytest.fixture(scope="module")
def run():
    """Return the parts of a scenario at 10 Hz with a star tracker at 4 Hz, and the samples of a run."""
    ready = study_of(star_tracker_period=0.25, rate_bias=1e-4)
    parts = dataclasses.replace(ready.parts, walk_rate=None)
    simulated = vectors.simulate_many(parts, ready.dispersion, jnp.uint32(3), jnp.arange(1, dtype=jnp.uint32))
    return parts, vectors.single_trial(simulated, 0)


def test_attitude_filter_with_a_star_tracker_clock_equals_an_independent_computation(run):
    parts, simulated = run
    valid = simulated.inputs["attitude_valid"] > 0.0
    assert np.flatnonzero(valid[:12]).tolist() == [0, 3, 5, 8, 10]
    np.testing.assert_allclose(simulated.inputs["attitude_age"][valid][:4], [0.0, 0.05, 0.0, 0.05], atol=1e-12)
    said = by_hand(parts, simulated)
    for k, (q, bias) in enumerate(said):
        off = (q.inv() * Rotation.from_quat(simulated.state["attitude"][k])).magnitude()
        assert off < 1e-12, k
        np.testing.assert_allclose(simulated.state["bias"][k], bias, rtol=0, atol=1e-12)


def test_star_tracker_measures_the_attitude_at_its_own_sample_time(run):
    """An independent RK4 integration gives the true attitude at 0.25, 0.5, .. s. The test subtracts the noise."""
    parts, simulated = run
    inertia, steps = np.array([10.0, 12.0, 14.0]), parts.substeps

    def rate(t, x, u):
        q, w = x[:4], x[4:]
        turn = 0.5 * np.append(q[3] * w + np.cross(q[:3], w), -q[:3] @ w)
        d = 0.01 * np.sin(0.1 * t)  # Case I's
        return np.concatenate([turn, (u + d - np.cross(w, inertia * w)) / inertia])

    def moved(t, x, u, length):
        h = length / steps
        for _ in range(steps):
            a = rate(t, x, u)
            b = rate(t + h / 2, x + h / 2 * a, u)
            c = rate(t + h / 2, x + h / 2 * b, u)
            x = x + h / 6 * (a + 2 * b + 2 * c + rate(t + h, x + h * c, u))
            t += h
        return np.concatenate([x[:4] / np.linalg.norm(x[:4]), x[4:]])

    keys = parts.sensors.keys(jnp.uint32(3), jnp.uint32(0))
    x, looked_at = np.concatenate([parts.initial.q, parts.initial.w]), 0
    for k in range(30):
        if k > 0:
            t, u, h = simulated.t[k - 1], simulated.outputs["torque"][k - 1], simulated.t[k] - simulated.t[k - 1]
            there = moved(t, x, u, h - simulated.inputs["attitude_age"][k])
            x = moved(t, x, u, h)
            if simulated.inputs["attitude_valid"][k]:
                noise, _ = parts.sensors.noise(keys, jnp.asarray(k))
                off = Rotation.from_quat(there[:4]) * Rotation.from_rotvec(np.array(noise))
                off = off.inv() * Rotation.from_quat(simulated.inputs["attitude"][k])
                assert off.magnitude() < 1e-12, k
                looked_at += 1
    assert looked_at == 11  # 0.25 to 2.75 s


def test_a_star_tracker_period_of_five_control_periods_equals_star_tracker_every_5():
    one, other = study_of(star_tracker_period=0.5).parts, study_of(star_tracker_every=5).parts
    assert jax.tree.structure(one) == jax.tree.structure(other)
    jax.tree.map(np.testing.assert_array_equal, one, other)


NOISES = {"bandwidth": 0.15, "attitude_noise": 2e-5, "rate_noise": 2e-6, "bias_walk": 1e-7, "period": 0.25}


@pytest.mark.parametrize("every", [1, 4])
def test_filter_for_a_star_tracker_clock_equals_attitude_filter_for_an_integer_ratio(every):
    found = attitude_filter.filter_between_samples(
        *NOISES.values(), interval=0.25 * every, periods_and_samples=(every, 1)
    )
    known = attitude_filter.attitude_filter(*NOISES.values(), every)
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(known), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-10, atol=1e-20)


def test_filter_errors_have_the_steady_state_covariance_from_the_first_sample():
    """4 000 trials of a body at rest. The sample times repeat after five periods with two star tracker samples."""
    times = attitude_sensors.sample_times(0.625, 0.0, 0.25)
    found = attitude_filter.filter_between_samples(*NOISES.values(), times.interval, times.pattern)
    walk = NOISES["bias_walk"] / np.sqrt(NOISES["period"])
    sensor = sensors.Sensors(vector(NOISES["attitude_noise"]), vector(NOISES["rate_noise"]), vector(1e-4),
                             vector(walk), found, own_times=times)  # fmt: skip
    rest = rigid_body.AttitudeState(vector([0.0, 0.0, 0.0, 1.0]), vector([0.0] * 3))

    def tick(k):
        return Ticks(0.25 * k, 0.25 * (k + 1), jnp.asarray(True), k, jnp.asarray(1.0), jnp.asarray(False))

    @jax.jit
    @jax.vmap
    def errors(trial):
        def one(memory, k):
            dt = jnp.where(k > 0, 0.25, 0.0)
            ahead = found.propagate(memory.estimate, memory.rate, sensor.sample(memory, rest, tick(k), dt)[0].w, dt)
            _, after = sensor.measure(memory, rest, tick(k), dt, rest)
            return after, jnp.stack([2 * ahead.q[:3], ahead.bias - after.bias])

        return jax.lax.scan(one, sensor.begin(7, trial, rest, tick(jnp.asarray(0))), jnp.arange(40))[1]

    got = np.asarray(errors(jnp.arange(4000, dtype=jnp.uint32))).transpose(1, 2, 0, 3).reshape(40, 2, -1)
    spread = np.asarray(found.spread)
    covariance = spread @ spread.swapaxes(1, 2)  # covariance at a control sample before the star tracker correction
    for k, sample in enumerate(got):
        wanted = covariance[(k - 1) % 5]
        size = np.sqrt(np.diag(wanted))
        np.testing.assert_allclose(
            sample.std(axis=1) / size, 1.0, rtol=0, atol=SIGMAS / np.sqrt(24_000), err_msg=str(k)
        )
        assert abs(np.corrcoef(sample)[0, 1] - wanted[0, 1] / size.prod()) < SIGMAS / np.sqrt(12_000)


def test_in_an_outage_the_filter_propagates_the_whole_period_at_once(run):
    """Exported C does the same. A split at the lost sample would change the coning correction."""
    parts, _ = run
    seen = dataclasses.replace(parts.sensors, outage=vector([0.0, 9.0]))
    x = rigid_body.AttitudeState(vector([0.0, 0.0, 0.0, 1.0]), vector([0.3, -0.2, 0.1]))
    now = Ticks(vector(0.8), vector(0.9), jnp.asarray(True), jnp.int32(8), vector(1.0), jnp.asarray(False))
    memory = seen.begin(7, 0, x, now)._replace(rate=vector([-0.2, 0.3, 0.25]))
    assert seen.own_times.is_reading_due(8)  # at 0.75 s
    found, after = seen.measure(memory, x, now, vector(0.1), x)
    alone = seen.filter.propagate(memory.estimate, memory.rate, after.rate, vector(0.1))
    np.testing.assert_allclose(found.q, alone.q, rtol=0, atol=1e-15)


def test_an_outage_removes_the_star_tracker_samples_taken_during_it():
    """The time of the measurement, 0.25 s, counts, and not the time of its use, 0.3 s."""
    own = study_of(star_tracker_period=0.25).parts.sensors
    now = Ticks(vector(0.3), vector(0.4), jnp.asarray(False), jnp.int32(3), vector(1.0), jnp.asarray(False))
    for outage, weight in (([0.2, 0.27], 0.0), ([0.28, 0.4], 1.0)):
        assert float(dataclasses.replace(own, outage=vector(outage)).star_weight(now)) == weight


@pytest.fixture(scope="module")
def anchored():
    """Return the parts of a scenario with a star tracker at 4 Hz on the anchored clock."""
    tables = {**flight(**FILTER, hardware={"star_tracker_period": 0.25}), "dispersion": {}}
    return scenario.study(scenario.from_tables(tables)).parts


def test_metrics_are_continuous_when_the_partial_first_period_vanishes(anchored):
    """The hand-over is slightly before, at and slightly after a whole number of periods from t = 0."""
    found = []
    for off in (1e-7, 0.0, -1e-7):
        law = dataclasses.replace(anchored.controller, delta=vector(0.5 + off))
        result = fly(dataclasses.replace(anchored, controller=law), 3)
        found.append([float(v) for v in (result.metrics.window_error, result.metrics.peak_torque)])
    np.testing.assert_allclose(found[0], found[1], rtol=1e-4)
    np.testing.assert_allclose(found[2], found[1], rtol=1e-4)


def test_star_tracker_moved_to_control_samples_has_the_same_correction_and_noise_per_interval():
    """The sum of the corrections in an interval is the same, and so is the sum of their noise variances."""
    own = study_of(star_tracker_period=0.25).parts.sensors
    often, share = own.at_control_samples(), 0.1 / 0.25
    assert often.own_times is None
    for name in ("attitude_gain", "bias_gain"):
        gain, each = (float(getattr(one.filter, name)) for one in (own, often))
        np.testing.assert_allclose(each / share, gain, rtol=1e-12)
        noise, noises = float(gain * own.attitude_noise) ** 2, float(each * often.attitude_noise) ** 2
        np.testing.assert_allclose(noises / share, noise, rtol=1e-12)
    whole = study_of(star_tracker_every=2).parts.sensors
    assert whole.at_control_samples() is whole


def test_a_constant_gyro_bias_has_no_effect_with_the_filter():
    """The filter starts in its steady state, so that the error of its bias estimate does not depend on the bias."""
    small, large = (runs.simulate(study_of(star_tracker_period=0.25, rate_bias=bias), 3, 2) for bias in (1e-9, 1e-3))
    np.testing.assert_allclose(large.metrics["window_error"], small.metrics["window_error"], rtol=1e-6)
