"""Steady-state attitude filter, propagated with the gyro and corrected by the star tracker.

Read `attitude_filter` first, which builds the filter, then `AttitudeFilter`. `filter_between_samples` builds the filter
of a star tracker with its own clock, whose samples need not coincide with the control samples. The flight software uses
such a measurement at the next control sample, see `attitude_sensors.SampleTimes`.
"""

import math
from dataclasses import dataclass
from fractions import Fraction
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ptsmc_jax import programs
from ptsmc_jax.numerics import attitude, guards, matrices
from ptsmc_jax.numerics.pytrees import Leaf, Scalar, pytree

AGE_TOLERANCE = 1e-9  # tolerance for equal ages, as a fraction of a period
LONGEST_PATTERN = 1000  # largest number of control periods of a pattern


class Estimate(NamedTuple):
    """State of the attitude filter."""

    q: Array  # (4,) estimated attitude, a unit quaternion
    bias: Array  # (3,) estimated bias of the gyro [rad/s]


@pytree
@dataclass(frozen=True)
class AttitudeFilter:
    """Multiplicative attitude filter with constant gains, propagated with the gyro and corrected by the star tracker.

    The attitude error is a small rotation (Lefferts, Markley, Shuster, JGCD 5(5), 1982). The gains are constant as in
    Farrenkopf's steady state (J. Guidance and Control 1(4), 1978). `attitude_filter` computes them from a bandwidth.
    """

    attitude_gain: Leaf  # ratio of the attitude correction to the star tracker residual [-]
    bias_gain: Leaf  # ratio of the bias correction to the star tracker residual [1/s]
    # (every, 2, 2) Cholesky factors of the steady-state error covariance of each axis [rad, rad/s], just before each
    # control sample of a star tracker interval, beginning with the sample after the star tracker's
    spread: Leaf

    def begin(
        self, q: Float[Array, "4"], bias: Float[Array, "3"], normals: Float[Array, "6"], sample: Array, fraction: Scalar
    ) -> Estimate:
        """Return an estimate [-, rad/s] with random steady-state errors, because the filter has run before the slew.

        Args:
            q: true attitude, a unit quaternion (4,).
            bias: true bias of the gyro (3,) [rad/s].
            normals: standard normal numbers for the errors (6,).
            sample: number of the first sample; the estimate is the one just before it.
            fraction: length of a partial first period as a fraction of a full one, else 1. The error covariance is
                interpolated between this sample and the next one.
        """
        turn, drift = self.first_spread(sample, fraction) @ normals.reshape(2, 3)
        return Estimate(attitude.multiply(q, attitude.from_rotation_vector(turn)), bias + drift)

    def first_spread(self, sample: Any, fraction: Scalar) -> Float[Array, "2 2"]:
        """Return the covariance factor (2, 2) [rad, rad/s] of the errors in `begin`, which explains the arguments."""
        every = self.spread.shape[0]
        return guards.lerp(fraction, self.spread[(sample - 1) % every], self.spread[sample % every])

    def propagate(self, old: Estimate, w: Float[Array, "3"], w_next: Float[Array, "3"], dt: Scalar) -> Estimate:
        """Return the estimate after a control period, with the coning correction to second order.

        Args:
            old: estimate at the start of the period.
            w: rate measured at the start (3,) [rad/s].
            w_next: rate measured at the end (3,) [rad/s].
            dt: length of the period [s].
        """
        turn = rotation_over(w - old.bias, w_next - old.bias, dt)
        return Estimate(attitude.multiply(old.q, attitude.from_rotation_vector(turn)), old.bias)

    def correct(self, old: Estimate, measured: Float[Array, "4"], weight: Scalar) -> Estimate:
        """Return the estimate after a star tracker sample.

        Args:
            old: estimate before the sample.
            measured: measured attitude, a unit quaternion (4,).
            weight: weight of the correction [-]; 0 if there is no sample.
        """
        residual = attitude.small_rotation(old.q, measured)
        turn = self.attitude_gain * weight * residual
        q = attitude.normalise(attitude.multiply(old.q, attitude.from_rotation_vector(turn)))
        return Estimate(q, old.bias - self.bias_gain * weight * residual)

    def correct_between(
        self,
        old: Estimate,
        w: Float[Array, "3"],
        w_next: Float[Array, "3"],
        dt: Scalar,
        measured: Float[Array, "4"],
        age: Scalar,
        weight: Scalar,
    ) -> Estimate:
        """Return the estimate after a control period with a star tracker sample within the period.

        The gyro rate is interpolated linearly to the time of the sample.

        Args:
            old: estimate at the start of the period.
            w: rate measured at the start (3,) [rad/s].
            w_next: rate measured at the end (3,) [rad/s].
            dt: length of the period [s].
            measured: measured attitude, a unit quaternion (4,).
            age: time from the sample to the end of the period [s].
            weight: weight of the correction [-]; 0 if there is no sample.
        """
        fraction = 1.0 - age / jnp.where(dt > 0.0, dt, 1.0)
        w_at_sample = w + fraction * (w_next - w)
        corrected = self.correct(self.propagate(old, w, w_at_sample, dt - age), measured, weight)
        return self.propagate(corrected, w_at_sample, w_next, age)


def rotation_over(a: Float[Array, "3"], b: Float[Array, "3"], dt: Scalar) -> Float[Array, "3"]:
    """Return the rotation vector (3,) [rad] over a time in which the rate changes linearly, with coning correction.

    Args:
        a: rate at the start (3,) [rad/s].
        b: rate at the end (3,) [rad/s].
        dt: length of the time [s].
    """
    return dt / 2 * (a + b) + dt * dt / 12 * attitude.cross(a, b)


def filter_gains(bandwidth: Any, interval: Any) -> tuple[Any, Any]:
    """Return the gains (attitude [-], bias [1/s]) that place both poles of the estimation error at the same p.

    With p = e^(-bandwidth interval) they are 1 - p^2 and (1 - p)^2 / interval.

    Args:
        bandwidth: bandwidth of the filter [rad/s].
        interval: time between star tracker samples [s].
    """
    pole = jnp.exp(-bandwidth * interval)
    return 1.0 - pole**2, (1.0 - pole) ** 2 / interval


@programs.jit(static_argnames="every")  # one compiled program instead of one for each operation
def attitude_filter(
    bandwidth: Any, attitude_noise: Any, rate_noise: Any, bias_walk: Any, period: Any, every: int
) -> AttitudeFilter:
    """Return a filter of given bandwidth, with its steady-state error covariance under these noises.

    Args:
        bandwidth: bandwidth of the filter [rad/s].
        attitude_noise: 1 sigma of a star tracker sample about each axis [rad].
        rate_noise: 1 sigma of a gyro sample, one in each control period [rad/s].
        bias_walk: random walk of the gyro's bias [rad/s/sqrt(s)].
        period: control period [s].
        every: control periods between star tracker samples.
    """
    k1, k2 = filter_gains(bandwidth, period * every)
    # The error e = (attitude, bias) just before a sample excludes the contribution of this gyro sample. It obeys
    # e+ = after(period) e, or e+ = corrected e if there is a star tracker sample, plus noises times the vectors `gyro`,
    # `walk` and `star`.
    zero, one, half = jnp.zeros_like(k1), jnp.ones_like(k1), period / 2

    def propagation(t: Any) -> Array:
        return jnp.array([[one, -t * one], [zero, one]])

    def noise_covariance(vector: Array, sigma: Any) -> Array:
        return jnp.outer(vector, vector) * sigma**2

    gyro, walk = jnp.stack([half * one, zero]), jnp.sqrt(period) * jnp.stack([half * one, -one])
    corrected = propagation(period) @ jnp.array([[1.0 - k1, zero], [k2, one]])
    star = propagation(period) @ jnp.stack([k1, -k2])
    noise = noise_covariance(2.0 * gyro, rate_noise) + noise_covariance(walk, bias_walk)
    steps = jax.vmap(propagation)(period * jnp.arange(every).astype(float))
    increments = jax.vmap(lambda step: step @ noise @ step.T)(steps)
    accumulated = jnp.cumsum(increments, axis=0) - increments  # covariance accumulated since the star tracker sample
    cycle_matrix = corrected @ steps[-1]
    noise = corrected @ accumulated[-1] @ corrected.T + noise_covariance(star, attitude_noise)
    noise = noise + noise_covariance(corrected @ gyro + gyro, rate_noise) + noise_covariance(walk, bias_walk)
    first_covariance = matrices.solve(jnp.eye(4) - jnp.kron(cycle_matrix, cycle_matrix), noise.reshape(4)).reshape(2, 2)

    def covariance_factor(step: Array, accumulated_here: Array) -> Array:
        return cholesky(step @ first_covariance @ step.T + accumulated_here + noise_covariance(gyro, rate_noise))

    return AttitudeFilter(k1, k2, jax.vmap(covariance_factor)(steps, accumulated))


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


def cholesky(covariance: Float[Array, "2 2"]) -> Float[Array, "2 2"]:
    """Return the lower Cholesky factor (2, 2) of a covariance matrix, in the units of its square roots.

    The derivatives are finite even for a zero covariance.
    """
    (a, b), (_, d) = covariance
    first = guards.sqrt(jnp.maximum(a, 0.0))
    off_diagonal = jnp.where(first > 0.0, b / jnp.where(first > 0.0, first, 1.0), 0.0)
    return jnp.array([[first, 0.0], [off_diagonal, guards.sqrt(jnp.maximum(d - off_diagonal * off_diagonal, 0.0))]])
