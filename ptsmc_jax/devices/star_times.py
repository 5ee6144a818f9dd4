"""The attitude filter of a star tracker with its own clock, whose samples need not coincide with the control samples.

The flight software uses a measurement at the next control sample, see `attitude_sensors.SampleTimes`.
"""

import math
from fractions import Fraction
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ptsmc_jax import programs
from ptsmc_jax.devices.attitude_filter import AttitudeFilter, cholesky, filter_gains
from ptsmc_jax.numerics import matrices

AGE_TOLERANCE = 1e-9  # tolerance for equal ages, as a fraction of a period
LONGEST_PATTERN = 1000  # largest number of control periods of a pattern


def pattern(ratio: float) -> tuple[int, int]:
    """Return the number of control periods after which the times repeat, and the star tracker samples in them.

    The pattern has at most `LONGEST_PATTERN` control periods. If the times repeat later, or never, the result is an
    approximation, which only affects the error covariance of a filter at t = 0. `ratio` is the star tracker interval
    divided by the control period [-].

    >>> pattern(2.5), pattern(4.0)
    ((5, 2), (4, 1))
    """
    fraction = Fraction(ratio).limit_denominator(max(1, math.floor(LONGEST_PATTERN / ratio)))
    return fraction.numerator, fraction.denominator


@programs.jit(static_argnames="periods_and_samples")
def filter_between_samples(
    bandwidth: Any, attitude_noise: Any, rate_noise: Any, bias_walk: Any, period: Any, interval: Any,
    periods_and_samples: tuple[int, int],
) -> AttitudeFilter:  # fmt: skip
    """Return the `attitude_filter` for a star tracker with its own sample interval, not at control samples.

    Args:
        bandwidth: bandwidth of the filter [rad/s].
        attitude_noise: 1 sigma of a star tracker sample about each axis [rad].
        rate_noise: 1 sigma of a gyro sample, one in each control period [rad/s].
        bias_walk: random walk of the gyro's bias [rad/s/sqrt(s)].
        period: control period [s].
        interval: time between star tracker samples [s].
        periods_and_samples: control periods and star tracker samples after which the times repeat, see `pattern`.
    """
    k1, k2 = filter_gains(bandwidth, interval)
    periods, samples = periods_and_samples
    count = np.arange(1, periods + 1)
    ages = count - (count * samples // periods) * (
        periods / samples
    )  # since the newest star tracker sample, in control periods
    sigmas = jnp.stack([rate_noise, bias_walk * jnp.sqrt(period), attitude_noise])

    def errors_at_next_sample(
        errors: Float[Array, "3"], noise: Float[Array, "3"], age: Any, weight: Any
    ) -> Float[Array, "3"]:
        """Return the errors (attitude, bias, gyro) at the next control sample; the gyro error is linear in between."""
        (turn, bias, gyro), (gyro_next, drift, star) = errors, sigmas * noise
        time_to_reading = period - age
        turn_rate = (gyro_next + drift - gyro) / period
        at_star = turn + time_to_reading * (gyro - bias) + turn_rate * time_to_reading**2 / 2
        residual = weight * (star - at_star)
        at_star, corrected = at_star + k1 * residual, bias - k2 * residual
        turn = at_star + age * (gyro - corrected) + turn_rate * (period**2 - time_to_reading**2) / 2
        return jnp.stack([turn, corrected - drift, gyro_next])

    def linearise(age: Any, weight: Any) -> tuple[Array, Array]:
        """Return the derivatives of `errors_at_next_sample` by the errors and by the noise."""
        return jax.jacfwd(errors_at_next_sample, argnums=(0, 1))(jnp.zeros(3), jnp.zeros(3), age, weight)

    def step(covariance: Array, linear_step: tuple[Array, Array]) -> tuple[Array, Array]:
        a, b = linear_step
        covariance = a @ covariance @ a.T + b @ b.T
        return covariance, covariance

    ages_in_seconds = jnp.asarray(np.minimum(ages, 1.0)) * period
    steps = jax.vmap(linearise)(ages_in_seconds, jnp.asarray((ages < 1.0 - AGE_TOLERANCE) * 1.0))
    pattern_matrix = jax.lax.scan(lambda m, a: (a @ m, None), jnp.eye(3), steps[0])[0]
    # the gyro error is independent at each sample, so that its covariance is known; the other block needs a solution
    gyro_only = jax.lax.scan(step, jnp.zeros((3, 3)), steps)[0].at[:2, :2].set(0.0)
    noise_of_pattern = jax.lax.scan(step, gyro_only, steps)[0][:2, :2]
    block = matrices.solve(
        jnp.eye(4) - jnp.kron(pattern_matrix[:2, :2], pattern_matrix[:2, :2]), noise_of_pattern.reshape(4)
    ).reshape(2, 2)
    first = gyro_only.at[:2, :2].set(block)
    later_covariances = jax.lax.scan(step, first, steps)[1]
    covariances = jnp.concatenate([first[None], later_covariances[:-1]])  # at the control samples of the pattern
    a, b = linearise(jnp.zeros_like(period), 0.0)
    spread = jax.vmap(lambda covariance: cholesky((a @ covariance @ a.T + b @ b.T)[:2, :2]))(covariances)
    return AttitudeFilter(k1, k2, spread)
