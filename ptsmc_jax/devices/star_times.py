"""Times of a star tracker that samples by a clock of its own, which need not be those of the control samples.

It samples once in `interval`, which is at least a control period: at the first control sample of the clock's count
(t = 0, or the hand-over) and every interval from there. What it says is used at the next control sample.
"""

import math
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ptsmc_jax import programs
from ptsmc_jax.devices.attitude_filter import AttitudeFilter, cholesky, filter_gains
from ptsmc_jax.numerics import matrices
from ptsmc_jax.numerics.pytrees import Leaf, pytree

ROUNDING = 1e-9  # of a period: a sample so much late is on time
LONGEST = 1000  # control periods of a pattern


@pytree
@dataclass(frozen=True)
class StarTimes:
    """When a star tracker has sampled that goes by its own clock."""

    interval: Leaf  # between its samples [s]
    period: Leaf  # of control [s]
    pattern: tuple[int, int] = field(metadata={"static": True})  # control periods, and its samples in them, see below

    def age(self, sample: Any) -> Any:
        """How long before a control sample, by its number, its last one was [s]."""
        t = sample * self.period
        last = jnp.floor((t + ROUNDING * self.period) / self.interval) * self.interval
        return jnp.maximum(t - last, 0.0)

    def due(self, sample: Any) -> Any:
        """Whether it has sampled since the control sample before this one, by its number."""
        return self.age(sample) < (1.0 - ROUNDING) * self.period


def star_times(interval: float, period: float) -> StarTimes:
    """Times of a star tracker that samples once in an interval [s], beside control periods [s]."""
    return StarTimes(jnp.asarray(float(interval)), jnp.asarray(float(period)), pattern(interval / period))


def pattern(ratio: float) -> tuple[int, int]:
    """(periods, samples) after which the times repeat, or nearly so where that takes more than `LONGEST` periods.

    ratio: of the interval to the control period [-]. Only the errors of a filter at t = 0 are those of the pattern.

    >>> pattern(2.5), pattern(4.0)
    ((5, 2), (4, 1))
    """
    near = Fraction(ratio).limit_denominator(max(1, math.floor(LONGEST / ratio)))
    return near.numerator, near.denominator


@programs.jit(static_argnames="repeating")
def filter_between(
    bandwidth: Any, attitude_noise: Any, rate_noise: Any, bias_walk: Any, period: Any, interval: Any,
    repeating: tuple[int, int],
) -> AttitudeFilter:  # fmt: skip
    """The `attitude_filter` of a star tracker that samples by its own clock.

    bandwidth [rad/s]; attitude_noise [rad] a star tracker sample; rate_noise [rad/s] a control period [s]; bias_walk
    [rad/s/sqrt(s)]; interval between star tracker samples [s]; repeating: see `pattern`.
    """
    k1, k2 = filter_gains(bandwidth, interval)
    periods, samples = repeating
    count = np.arange(1, periods + 1)
    ages = count - (count * samples // periods) * (periods / samples)  # in periods
    sizes = jnp.stack([rate_noise, bias_walk * jnp.sqrt(period), attitude_noise])

    def moved(errors: Float[Array, "3"], noise: Float[Array, "3"], age: Any, weight: Any) -> Float[Array, "3"]:
        """Errors (attitude, bias, gyro) at the next control sample; between samples the gyro's is linear in time."""
        (turn, bias, gyro), (fresh, drift, star) = errors, sizes * noise
        before = period - age
        turn_rate = (fresh + drift - gyro) / period
        there = turn + before * (gyro - bias) + turn_rate * before**2 / 2
        residual = weight * (star - there)
        there, corrected = there + k1 * residual, bias - k2 * residual
        turn = there + age * (gyro - corrected) + turn_rate * (period**2 - before**2) / 2
        return jnp.stack([turn, corrected - drift, fresh])

    def linear(age: Any, weight: Any) -> tuple[Array, Array]:
        return jax.jacfwd(moved, argnums=(0, 1))(jnp.zeros(3), jnp.zeros(3), age, weight)

    def step(covariance: Array, by: tuple[Array, Array]) -> tuple[Array, Array]:
        move, enter = by
        after = move @ covariance @ move.T + enter @ enter.T
        return after, after

    at = jnp.asarray(np.minimum(ages, 1.0)) * period
    moves, enters = jax.vmap(linear)(at, jnp.asarray((ages < 1.0 - ROUNDING) * 1.0))
    whole = jax.lax.scan(lambda m, move: (move @ m, None), jnp.eye(3), moves)[0]
    # of the gyro's error, which is new at every sample, the covariance is known at once; the other block solves for it
    known = jax.lax.scan(step, jnp.zeros((3, 3)), (moves, enters))[0].at[:2, :2].set(0.0)
    once = jax.lax.scan(step, known, (moves, enters))[0][:2, :2]
    block = matrices.solve(jnp.eye(4) - jnp.kron(whole[:2, :2], whole[:2, :2]), once.reshape(4)).reshape(2, 2)
    first = known.at[:2, :2].set(block)
    after = jax.lax.scan(step, first, (moves, enters))[1]
    before = jnp.concatenate([first[None], after[:-1]])  # at the control samples of the pattern, the first one first
    move, enter = linear(jnp.zeros_like(period), 0.0)
    spread = jax.vmap(lambda known: cholesky((move @ known @ move.T + enter @ enter.T)[:2, :2]))(before)
    return AttitudeFilter(k1, k2, spread)
