"""Times of a star tracker that samples by a clock of its own, which need not be those of the control samples.

It samples once in `interval`, which is at least a control period: at control sample 0 of the clock (t = 0, or the
hand-over) and every interval from there. Its measurement is used at the next control sample.
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
from ptsmc_jax.numerics import guards, matrices
from ptsmc_jax.numerics.pytrees import Leaf, pytree

ROUNDING = 1e-9  # share of a period by which ages may differ and still count as equal
LONGEST = 1000  # control periods of a pattern at most


@pytree
@dataclass(frozen=True)
class StarTimes:
    """When a star tracker samples that goes by its own clock."""

    interval: Leaf  # between its samples [s]
    period: Leaf  # of control [s]
    pattern: tuple[int, int] = field(metadata={"static": True})  # see the function `pattern`

    def age(self, sample: Any) -> Any:
        """How long before a control sample, given by its number, the star tracker's last sample was [s]."""
        return jnp.maximum(self._time(sample) - self._last(sample) * self.interval, 0.0)

    def due(self, sample: Any) -> Any:
        """Whether it has sampled since the control sample before this one, given by its number."""
        return self._last(sample) > self._last(sample - 1)  # none twice, none never, however times are rounded

    def _time(self, sample: Any) -> Any:
        return jnp.asarray(sample, float) * self.period

    def _last(self, sample: Any) -> Any:
        """Number of the star tracker's last sample."""
        t = self._time(sample)
        return jnp.floor((t + guards.rounding(self.period, t)) / self.interval)


def star_times(interval: float, period: float) -> StarTimes:
    """Times of a star tracker that samples once in an interval [s], beside control periods [s]."""
    return StarTimes(jnp.asarray(float(interval)), jnp.asarray(float(period)), pattern(interval / period))


def pattern(ratio: float) -> tuple[int, int]:
    """(control periods, star tracker samples in them) after which the times repeat, at most `LONGEST` periods.

    ratio: of the interval to the control period [-]. Where the times repeat later, or never, these are nearly so; only
    the errors of a filter at t = 0 are made of them.

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
    [rad/s/sqrt(s)]; interval between star tracker samples [s]; repeating: the `pattern` of its times.
    """
    k1, k2 = filter_gains(bandwidth, interval)
    periods, samples = repeating
    count = np.arange(1, periods + 1)
    ages = count - (count * samples // periods) * (periods / samples)  # in periods
    sizes = jnp.stack([rate_noise, bias_walk * jnp.sqrt(period), attitude_noise])

    def after(errors: Float[Array, "3"], noise: Float[Array, "3"], age: Any, weight: Any) -> Float[Array, "3"]:
        """Errors (attitude, bias, gyro) at the next control sample; between samples the gyro's is linear in time."""
        (turn, bias, gyro), (gyro_next, drift, star) = errors, sizes * noise
        before = period - age
        turn_rate = (gyro_next + drift - gyro) / period
        at_star = turn + before * (gyro - bias) + turn_rate * before**2 / 2
        residual = weight * (star - at_star)
        at_star, corrected = at_star + k1 * residual, bias - k2 * residual
        turn = at_star + age * (gyro - corrected) + turn_rate * (period**2 - before**2) / 2
        return jnp.stack([turn, corrected - drift, gyro_next])

    def linear(age: Any, weight: Any) -> tuple[Array, Array]:
        """Matrices of the errors and of the noise in `after`."""
        return jax.jacfwd(after, argnums=(0, 1))(jnp.zeros(3), jnp.zeros(3), age, weight)

    def step(covariance: Array, linear_step: tuple[Array, Array]) -> tuple[Array, Array]:
        a, b = linear_step
        covariance = a @ covariance @ a.T + b @ b.T
        return covariance, covariance

    at = jnp.asarray(np.minimum(ages, 1.0)) * period
    steps = jax.vmap(linear)(at, jnp.asarray((ages < 1.0 - ROUNDING) * 1.0))
    whole = jax.lax.scan(lambda m, a: (a @ m, None), jnp.eye(3), steps[0])[0]
    # of the gyro's error, which is new at every sample, the covariance is known at once; the other block solves for it
    gyro_only = jax.lax.scan(step, jnp.zeros((3, 3)), steps)[0].at[:2, :2].set(0.0)
    once = jax.lax.scan(step, gyro_only, steps)[0][:2, :2]
    block = matrices.solve(jnp.eye(4) - jnp.kron(whole[:2, :2], whole[:2, :2]), once.reshape(4)).reshape(2, 2)
    first = gyro_only.at[:2, :2].set(block)
    ends = jax.lax.scan(step, first, steps)[1]
    starts = jnp.concatenate([first[None], ends[:-1]])  # at the control samples of the pattern, the first one first
    a, b = linear(jnp.zeros_like(period), 0.0)
    spread = jax.vmap(lambda covariance: cholesky((a @ covariance @ a.T + b @ b.T)[:2, :2]))(starts)
    return AttitudeFilter(k1, k2, spread)
