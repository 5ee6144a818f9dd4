"""Sensor suites: sample times, the filter against batch conditioning, and the consistency of its covariance."""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats
from scipy.spatial.transform import Rotation

from ptsmc_jax.devices import attitude_sensors
from ptsmc_jax.devices.ticks import Ticks
from ptsmc_jax.numerics import attitude
from ptsmc_jax.plants.rigid_body import AttitudeState
from ptsmc_jax.simulation import gains
from tests import suites
from tests.helpers import equations, parts, vector

H = 0.1  # control period [s]
RATE = np.array([0.02, -0.03, 0.05])  # [rad/s], constant, so that the filter propagates it exactly


def tick(sample):
    """Return the control period after a sample with this number, of a clock that starts at t = 0."""
    t = sample * vector(H)
    return Ticks(t, t + H, jnp.asarray(False), jnp.asarray(sample), vector(1.0), jnp.asarray(False))


def state(t):
    """Return the true state, an `AttitudeState`, at a time [s] of a body that turns at a constant rate."""
    return AttitudeState(attitude.from_rotation_vector(t * vector(RATE)), vector(RATE))


def filtered(suite, trial, count):
    """Return errors (count, 9) after each sample, and the filter's covariances (count, 9, 9).

    The errors are attitude [rad], gyro bias [rad/s] and gyro noise [rad/s], three axes each.
    """

    def step(memory, k):
        dt = jnp.where(k > 0, H, 0.0)
        ages = suite.newest_reading_age(k, dt)
        star_x = jax.tree.map(lambda age: state(k * H - age), ages)
        x = state(k * H)
        _, memory = suite.measure(memory, x, tick(k), dt, star_x)
        found = memory.estimate
        turn = attitude.multiply(attitude.conjugate(found.q), x.q)
        turn = 2.0 * jnp.sign(turn[3]) * turn[:3]
        error = jnp.concatenate([turn, memory.bias - found.bias, found.rate - memory.bias - x.w])
        return memory, (error, found.covariance[:9, :9])

    return jax.lax.scan(step, suite.begin(3, trial, state(0.0), tick(0)), jnp.arange(count))[1]


def sun_and_field(period):
    """Return a suite of two vector sensors with different rates and latencies; period: of the control loop [s].

    Only both sensors together determine the attitude.
    """
    made = []
    for k, (direction, interval, latency) in enumerate([([0.6, 0.0, 0.8], 2, 1), ([0.0, 1.0, 0.0], 3, 0)]):
        made.append(
            attitude_sensors.VectorSensor(
                name=f"vector_{k + 1}",
                noise=vector([3e-4 * (1 + k)] * 3),
                mounting=attitude.from_rotation_vector(vector(suites.MOUNTINGS[k])),
                times=attitude_sensors.sample_times(interval * period, latency * period, period),
                direction=vector(direction),
            )
        )
    return suites.suite(made, period)


CASES = {
    "latency": lambda: suites.two_star_trackers(H, (2.0, 3.0), (2.0, 0.5)),
    "own clocks": lambda: suites.two_star_trackers(H, (2.5, 1.0), (0.7, 1.0)),
    "outage": lambda: dataclasses.replace(suites.two_star_trackers(H, (1.0, 8.0), (1.0, 0.0)), outage=vector([1, 3])),
    "vector sensors": lambda: sun_and_field(H),
}


@pytest.mark.parametrize("case", CASES)
def test_normalised_estimation_error_squared_is_within_its_95_percent_interval(case):
    suite, trials, count = CASES[case](), 1000, 48
    run = jax.jit(jax.vmap(lambda suite, trial: filtered(suite, trial, count), (None, 0)))
    errors, covariances = (np.asarray(v) for v in run(suite, jnp.arange(trials, dtype=jnp.uint32)))
    low, high = stats.chi2.ppf([0.025, 0.975], 9 * trials) / trials
    for k in (0, 13, 29, count - 1):  # far apart, so that the errors are nearly independent
        weighed = np.linalg.solve(covariances[:, k], errors[:, k, :, None])[..., 0]
        assert low < np.mean(np.sum(weighed * errors[:, k], axis=1)) < high


def test_kalman_filter_of_a_sensor_suite_equals_batch_conditioning_on_all_readings():
    """At rest the errors are linear. The test conditions a Gaussian vector of all unknowns on every received reading.

    The unknowns are the initial errors of attitude and bias, and in each period the drift and the gyro noise.
    """
    intervals, latencies, count = (2, 3), (2, 1), 9
    suite = suites.two_star_trackers(H, intervals, latencies)
    rest = AttitudeState(vector([0.0, 0.0, 0.0, 1.0]), vector([0.0] * 3))
    memory, total = suite.begin(3, 5, rest, tick(0)), 6 + 6 * count
    rng = np.random.default_rng(1)
    truth = rng.normal(size=total) * 1e-8  # so small that all is linear
    readings = []  # (k, sensor, noise) by the sample at which they are taken
    factor, sigmas = np.asarray(suite.filter.first_factor(0, 1.0)), np.asarray(suite.rate_noise)
    prior = np.zeros((total, total))
    prior[:6, :6] = factor @ factor.T
    prior[range(6, total), range(6, total)] = np.tile([*(np.asarray(suite.bias_rate) * H) ** 2, *sigmas**2], count)
    # linear maps from the unknowns to attitude, bias and gyro noise at each sample; true attitude and rate are zero
    turn, bias, noise = np.eye(3, total), np.eye(3, total, 3), np.zeros((3, total))
    turns, p, mean, first = [], prior, np.zeros(total), memory.estimate
    for k in range(count):
        noise_next = np.eye(3, total, 6 + 6 * k + 3)
        if k:
            bias_next = bias + np.eye(3, total, 6 + 6 * k)
            turn = turn - H / 2 * (bias + noise + bias_next + noise_next)
            bias = bias_next
        noise = noise_next
        turns.append(turn)
        values = {}
        for j in range(2):
            taken = k - latencies[j]
            axes = Rotation.from_rotvec(suites.MOUNTINGS[j]).as_matrix().T
            size = suites.ARCSEC * np.array(suites.NOISES[j])
            if k % intervals[j] == 0:
                values[j] = rng.normal(size=3) * size * 1e-2
                readings.append((k, j, values[j]))
            for at, sensor, error in readings:
                if at == taken and sensor == j:
                    rows = axes @ turns[at]
                    for row, sigma, seen in zip(rows, size, rows @ truth + error, strict=True):
                        gain = p @ row / (row @ p @ row + sigma**2)
                        mean, p = mean + gain * (seen - row @ mean), p - np.outer(gain, row @ p)
        # the same numbers for the filter: noise of the readings, and gyro errors of the true vector
        drift = np.asarray(bias @ truth)
        noises = (*(vector(values.get(j, np.zeros(3))) for j in range(2)), vector(noise @ truth))
        # the body turns so that the gyro reads the initial bias estimate; only corrections change the estimate
        true = AttitudeState(attitude.from_rotation_vector(vector(turn @ truth)), -vector((bias + noise) @ truth))
        ready = memory._replace(keys=None, noise=noises, bias=first.bias + vector(drift))
        still = dataclasses.replace(suite, noise_free=True)
        # the filter starts at `first`, the origin of all errors
        seen = AttitudeState(attitude.multiply(first.q, true.q), true.w)
        _, memory = still.measure(ready, seen, tick(k), vector(H if k else 0.0))
        found = memory.estimate
        maps = np.vstack([turn, bias, noise])
        wanted = maps @ p @ maps.T
        scale = np.sqrt(np.diag(wanted))
        np.testing.assert_allclose(
            found.covariance[:9, :9] / np.outer(scale, scale), wanted / np.outer(scale, scale), rtol=0, atol=1e-9
        )
        off = 2 * np.asarray(attitude.multiply(attitude.conjugate(first.q), found.q))[:3]
        np.testing.assert_allclose(off, turn @ mean, rtol=0, atol=1e-13)
        np.testing.assert_allclose(found.bias - first.bias, bias @ mean, rtol=0, atol=1e-13)


@pytest.mark.parametrize(
    ("interval", "latency"), list(itertools.product([1.0, 2.0, 2.5, 1.6, np.pi], [0.0, 0.3, 1.0, 2.75]))
)
def test_each_reading_is_used_once_at_the_first_sample_after_its_latency(interval, latency):
    """Readings are taken at whole multiples of the interval, and not longer ago than `past_samples`."""
    times = attitude_sensors.sample_times(interval * H, latency * H, H)
    samples = jnp.arange(-40, 60)
    due, age = (
        np.broadcast_to(v, samples.shape) for v in (times.is_reading_due(samples), times.delivered_age(samples))
    )
    taken = (np.asarray(samples) - age / H)[due]
    np.testing.assert_allclose(np.diff(taken), interval, rtol=0, atol=1e-9)
    numbers = taken / interval
    np.testing.assert_allclose(numbers, np.round(numbers), rtol=0, atol=1e-9)
    used = np.asarray(samples)[due]
    np.testing.assert_array_equal(used, np.ceil(taken + latency - 1e-9))
    assert np.all(used - taken < times.past_samples + 1e-9)


def test_a_delayed_reading_is_the_attitude_at_its_own_time():
    """Without noise the reading is the attitude when it was taken, and the estimate stays exact."""
    suite = suites.two_star_trackers(H, (2.5, 3.0), (1.2, 2.0)).without_noise()
    memory, seen = suite.begin(0, 0, state(0.0), tick(0)), None
    for k in range(12):
        dt = vector(H if k else 0.0)
        star_x = jax.tree.map(lambda age, k=k: state(k * H - age), suite.newest_reading_age(jnp.asarray(k), dt))
        found, _ = suite.inputs(memory, state(vector(k * H)), tick(k), dt, star_x)
        seen, memory = suite.measure(memory, state(vector(k * H)), tick(k), dt, star_x)
        for sensor in suite.sensors:
            if found[f"{sensor.name}_valid"] > 0.0:
                wanted = sensor.read(state(vector(k * H) - found[f"{sensor.name}_age"]).q)
                np.testing.assert_allclose(found[sensor.name], wanted, rtol=0, atol=1e-14)
        np.testing.assert_allclose(seen.q, state(vector(k * H)).q, rtol=0, atol=1e-13)
        np.testing.assert_allclose(seen.w, RATE, rtol=0, atol=1e-13)


@pytest.mark.parametrize("case", ["latency", "own clocks", "outage"])
def test_predicted_times_and_delays_of_readings_equal_the_simulated_ones(case):
    """The gyro is always available. An outage removes readings of one star tracker only."""
    suite, count = CASES[case]().without_noise(), 40
    ticks = jax.vmap(tick)(jnp.arange(count))
    available, lag = suite.available(ticks), suite.sample_delays(ticks)
    memory = suite.begin(0, 0, state(0.0), tick(0))
    for k in range(count):
        dt = vector(H if k else 0.0)
        star_x = jax.tree.map(lambda age, k=k: state(k * H - age), suite.newest_reading_age(jnp.asarray(k), dt))
        found, memory = suite.inputs(memory, state(vector(k * H)), tick(k), dt, star_x)
        for j, sensor in enumerate(suite.sensors):
            valid = bool(found[f"{sensor.name}_valid"] > 0.0)
            np.testing.assert_array_equal(available[k, 3 * j : 3 * j + 3], valid)
            if valid:
                np.testing.assert_array_equal(lag[k, 3 * j : 3 * j + 3], int(found[f"{sensor.name}_age"] / H + 1e-9))
    assert np.all(available[:, 6:])
    if case == "outage":  # from 1 s to 3 s, and a period of latency later
        first, second = available[:, 0], available[:, 3]
        np.testing.assert_array_equal(np.flatnonzero(~first), [0, *range(11, 31)])
        np.testing.assert_array_equal(np.flatnonzero(second), range(0, count, 8))


def test_a_sensor_suite_without_noise_generates_no_random_numbers():
    quiet = suites.two_star_trackers(H).without_noise()
    trace = jax.make_jaxpr(lambda seed: quiet.begin(seed, 0, state(0.0), tick(0)))(jnp.uint32(3))
    assert not any(one.primitive.name == "shift_left" for one in equations(trace))  # every random number needs it


def test_a_sensor_suite_refuses_a_star_tracker_without_noise():
    tracker = suites.star_tracker(0, H, 0.0, H)
    with pytest.raises(ValueError, match="noise greater than 0"):
        suites.suite([dataclasses.replace(tracker, noise=vector([1e-5, 1e-5, 0.0]))], H)


def test_the_kalman_filter_of_a_sensor_suite_has_no_bandwidth_to_tune():
    made = dataclasses.replace(parts(), sensors=suites.two_star_trackers(H))
    assert "filter_bandwidth" not in gains.gains_of(made)
    with pytest.raises(ValueError, match="filter_bandwidth is no gain of these parts"):
        gains.with_gains(made, {"filter_bandwidth": 0.3})
