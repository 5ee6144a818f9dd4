"""The attitude filter: propagated by the gyro, corrected by the star tracker, in its steady state."""

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

    q: Array  # (4,)
    bias: Array  # (3,) of the gyro [rad/s]


@pytree
@dataclass(frozen=True)
class AttitudeFilter:
    """Steady-state multiplicative filter: propagated by the gyro, corrected by star tracker samples.

    The error is a rotation (Lefferts, Markley, Shuster, JGCD 5(5), 1982) and the gains are constant, as in Farrenkopf's
    steady state (J. Guidance and Control 1(4), 1978); build it with `attitude_filter`, which chooses them by bandwidth.
    """

    attitude_gain: Leaf  # share of a star tracker residual that corrects the attitude [-]
    bias_gain: Leaf  # of it, per second, that corrects the bias [1/s]
    # (every, 2, 2) Cholesky factors of the covariance per axis of its errors [rad, rad/s] in the steady state, just
    # before the sample after the star tracker's, the one after that, and so on to the next one of the star tracker
    spread: Leaf

    def begin(
        self, q: Float[Array, "4"], bias: Float[Array, "3"], normals: Float[Array, "6"], sample: Array, share: Scalar
    ) -> Estimate:
        """An estimate [-, rad/s] whose errors are those of the steady state: the filter has run before the slew.

        Args:
            q: true attitude.
            bias: true bias of the gyro [rad/s].
            normals: standard normal numbers that the errors are made of.
            sample: number of the first sample; the estimate is that just before it.
            share: below 1 in a partial first period, where the errors are between those before this sample and before
                the next one.
        """
        turn, drift = self.first_spread(sample, share) @ normals.reshape(2, 3)
        return Estimate(attitude.multiply(q, attitude.from_rotation_vector(turn)), bias + drift)

    def first_spread(self, sample: Any, share: Scalar) -> Float[Array, "2 2"]:
        """The factor of `spread` that `begin` draws errors by, (2, 2) [rad, rad/s]; arguments as there."""
        every = self.spread.shape[0]
        return guards.lerp(share, self.spread[(sample - 1) % every], self.spread[sample % every])

    def propagate(self, old: Estimate, w: Float[Array, "3"], w_next: Float[Array, "3"], dt: Scalar) -> Estimate:
        """The estimate dt [s] later, from the rates measured at both ends [rad/s], coning to second order included."""
        turn = rotation_over(w - old.bias, w_next - old.bias, dt)
        return Estimate(attitude.multiply(old.q, attitude.from_rotation_vector(turn)), old.bias)

    def correct(self, old: Estimate, measured: Float[Array, "4"], weight: Scalar) -> Estimate:
        """The estimate after a star tracker sample [-] that counts with this weight (0: none)."""
        error = attitude.multiply(attitude.conjugate(old.q), measured)
        residual = jnp.where(error[3] < 0.0, -2.0, 2.0) * error[:3]
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
        """The estimate dt [s] later, corrected on the way: by a star tracker sample taken age [s] before the end.

        w, w_next: rates measured at both ends [rad/s], linear in time between; measured [-] counts with this weight.
        """
        share = 1.0 - age / jnp.where(dt > 0.0, dt, 1.0)
        w_at_sample = w + share * (w_next - w)
        corrected = self.correct(self.propagate(old, w, w_at_sample, dt - age), measured, weight)
        return self.propagate(corrected, w_at_sample, w_next, age)


def rotation_over(a: Float[Array, "3"], b: Float[Array, "3"], dt: Scalar) -> Float[Array, "3"]:
    """Return the rotation vector (3,) [rad] of a body in dt [s] whose rate goes from a to b [rad/s], with coning."""
    return dt / 2 * (a + b) + dt * dt / 12 * attitude.cross(a, b)


def filter_gains(bandwidth: Any, interval: Any) -> tuple[Any, Any]:
    """Gains (attitude [-], bias [1/s]) that put both poles of the estimation error at e^(-bandwidth interval).

    bandwidth [rad/s]; interval between star tracker samples [s]. With p that pole: 1 - p^2 and (1 - p)^2 / interval.
    """
    pole = jnp.exp(-bandwidth * interval)
    return 1.0 - pole**2, (1.0 - pole) ** 2 / interval


@programs.jit(static_argnames="every")  # one program; else each of its operations would be compiled by itself
def attitude_filter(
    bandwidth: Any, attitude_noise: Any, rate_noise: Any, bias_walk: Any, period: Any, every: int
) -> AttitudeFilter:
    """Filter of a bandwidth whose errors at t = 0 are those of its steady state under these noises.

    Args:
        bandwidth: [rad/s].
        attitude_noise: 1 sigma of a star tracker sample about each axis [rad].
        rate_noise: 1 sigma of a gyro sample, one in each control period [rad/s].
        bias_walk: random walk of the gyro's bias [rad/s/sqrt(s)].
        period: of control [s].
        every: control periods between star tracker samples.
    """
    k1, k2 = filter_gains(bandwidth, period * every)
    # The error e just before a sample is (attitude, without what this sample of the gyro adds to it; bias). It obeys
    # e+ = after(period) e, or `corrected` e where the star tracker has a sample, plus noises times the vectors `gyro`,
    # `walk` and `star`
    zero, one, half = jnp.zeros_like(k1), jnp.ones_like(k1), period / 2

    def after(t: Any) -> Array:
        return jnp.array([[one, -t * one], [zero, one]])

    def square(vector: Array, sigma: Any) -> Array:
        return jnp.outer(vector, vector) * sigma**2

    gyro, walk = jnp.stack([half * one, zero]), jnp.sqrt(period) * jnp.stack([half * one, -one])
    corrected = after(period) @ jnp.array([[1.0 - k1, zero], [k2, one]])
    star = after(period) @ jnp.stack([k1, -k2])
    drive = square(2.0 * gyro, rate_noise) + square(walk, bias_walk)
    steps = jax.vmap(after)(period * jnp.arange(every).astype(float))
    increments = jax.vmap(lambda step: step @ drive @ step.T)(steps)
    added = jnp.cumsum(increments, axis=0) - increments  # covariance since the star tracker's sample
    move = corrected @ steps[-1]
    drive = corrected @ added[-1] @ corrected.T + square(star, attitude_noise)
    drive = drive + square(corrected @ gyro + gyro, rate_noise) + square(walk, bias_walk)
    first = matrices.solve(jnp.eye(4) - jnp.kron(move, move), drive.reshape(4)).reshape(2, 2)

    def spread(step: Array, since: Array) -> Array:
        return cholesky(step @ first @ step.T + since + square(gyro, rate_noise))

    return AttitudeFilter(k1, k2, jax.vmap(spread)(steps, added))


def cholesky(covariance: Float[Array, "2 2"]) -> Float[Array, "2 2"]:
    """Lower factor (2, 2) of a covariance, in the units of its roots; its derivatives are finite without noise, too."""
    (a, b), (_, d) = covariance
    first = guards.sqrt(jnp.maximum(a, 0.0))
    along = jnp.where(first > 0.0, b / jnp.where(first > 0.0, first, 1.0), 0.0)
    return jnp.array([[first, 0.0], [along, guards.sqrt(jnp.maximum(d - along * along, 0.0))]])
