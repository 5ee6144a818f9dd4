"""A sensor suite for tests: two star trackers with different mounting, noise per axis, rate and latency, and a gyro."""

import jax.numpy as jnp
import numpy as np

from ptsmc_jax.devices import attitude_sensors, kalman_filter, sensor_suite
from ptsmc_jax.numerics import attitude
from tests.helpers import vector

ARCSEC = np.pi / 180 / 3600
MOUNTINGS = [(0.3, 0.2, -0.5), (1.5, 0.1, 0.4)]  # rotation vectors [rad]
NOISES = [(8.0, 8.0, 40.0), (12.0, 10.0, 60.0)]  # [arcsec]


def star_tracker(k, interval, latency, period):
    """Return star tracker k, 0 or 1, of the tests; sample interval, latency and control period [s]."""
    mounting = attitude.from_rotation_vector(vector(MOUNTINGS[k]))
    times = attitude_sensors.sample_times(interval, latency, period)
    noise = ARCSEC * jnp.asarray(NOISES[k])
    return attitude_sensors.StarTracker(name=f"star_{k + 1}", noise=noise, mounting=mounting, times=times)


def suite(sensors, period, gyro=(1e-5, 2e-5, 1e-5), bias=1e-4, walk=1e-7):
    """Return a suite of attitude sensors and a gyro.

    gyro: 1 sigma [rad/s]. bias: 1 sigma of its bias [rad/s]. walk: random walk of its bias [rad/s/sqrt(s)].
    """
    drift = jnp.full(3, walk / np.sqrt(period))
    found = kalman_filter.kalman_filter(sensors, gyro, drift, bias, period)
    return sensor_suite.SensorSuite(
        sensors=tuple(sensors), rate_noise=vector(gyro), rate_bias=jnp.full(3, bias), bias_rate=drift, filter=found
    )


def two_star_trackers(period, intervals=(2.0, 2.5), latencies=(1.0, 0.7)):
    """Return the suite with two star trackers; period [s], intervals and latencies in control periods."""
    both = zip(intervals, latencies, strict=True)
    return suite([star_tracker(k, i * period, late * period, period) for k, (i, late) in enumerate(both)], period)
