"""Steady-state attitude filter, propagated with the gyro and corrected by the star tracker.

Read `attitude_filter` first, which builds the filter, then `AttitudeFilter`.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ptsmc_jax import programs
from ptsmc_jax.numerics import attitude, guards, matrices
from ptsmc_jax.numerics.pytrees import Leaf, Scalar, pytree


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


def cholesky(covariance: Float[Array, "2 2"]) -> Float[Array, "2 2"]:
    """Return the lower Cholesky factor (2, 2) of a covariance matrix, in the units of its square roots.

    The derivatives are finite even for a zero covariance.
    """
    (a, b), (_, d) = covariance
    first = guards.sqrt(jnp.maximum(a, 0.0))
    off_diagonal = jnp.where(first > 0.0, b / jnp.where(first > 0.0, first, 1.0), 0.0)
    return jnp.array([[first, 0.0], [off_diagonal, guards.sqrt(jnp.maximum(d - off_diagonal * off_diagonal, 0.0))]])
