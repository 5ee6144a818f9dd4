"""Attitude sensors of a suite: star trackers and others, each with mounting, noise per axis, sample times and latency.

A sensor takes readings at its own times, and the flight software receives a reading one latency later. The filter
compares a reading with the attitude at the time of the reading, see `kalman_filter`. Read `AttitudeSensor` first.
"""

import math
from dataclasses import dataclass, field, replace
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ptsmc_jax.devices.attitude_filter import pattern
from ptsmc_jax.numerics import attitude, guards
from ptsmc_jax.numerics.pytrees import Leaf, Scalar, pytree

INTEGER_TOLERANCE = 1e-9  # relative tolerance for a whole number of control periods


@pytree
@dataclass(frozen=True)
class SampleTimes:
    """The times at which a sensor takes readings, and those at which the flight software uses them.

    Readings are `interval` apart, one of them at control sample 0 (t = 0, or the hand-over). The flight software uses a
    reading at the first control sample that is not earlier than the reading plus `latency`. Build it with
    `sample_times`.
    """

    interval: Leaf  # time between readings, at least a control period [s]
    latency: Leaf  # time from a reading until the flight software receives it [s]
    period: Leaf  # control period [s]
    every: int | None = field(metadata={"static": True})  # control periods between readings; None if not a whole number
    wait: int = field(metadata={"static": True})  # smallest number of control samples between a reading and its use
    split: bool = field(metadata={"static": True})  # whether some readings wait for `wait` + 1 control samples
    # numbers of control periods and of readings after which the times repeat, see `attitude_filter.pattern`
    pattern: tuple[int, int] = field(metadata={"static": True})

    @property
    def longest_wait(self) -> int:
        """Return the largest number of control samples that a reading waits for."""
        return self.wait + self.split

    @property
    def past_samples(self) -> int:
        """Return how many past control samples the filter needs to know the attitude at a reading."""
        return self.longest_wait + (self.every is None)

    def is_reading_new(self, sample: Any) -> Any:
        """Return whether a reading was taken since the control sample before this one."""
        if self.every is not None:
            return sample % self.every == 0
        return self._newest_reading(sample) > self._newest_reading(sample - 1)

    def newest_reading_age(self, sample: Any, dt: Scalar) -> Any:
        """Return the time since the newest reading [s], at most the length dt [s] of the period before the sample."""
        age = self._time(sample) - self._newest_reading(sample) * self.interval
        return jnp.minimum(jnp.maximum(age, 0.0), dt)

    def is_reading_due(self, sample: Any) -> Any:
        """Return whether the flight software gets a reading at a control sample."""
        if self.every is not None:
            return (sample - self.wait) % self.every == 0
        return self._newest_reading(sample, self.latency) > self._newest_reading(sample - 1, self.latency)

    def delivered_age(self, sample: Any) -> Any:
        """Return the age of the newest reading that the flight software has at a control sample [s]."""
        if self.every is not None:
            return self.wait * self.period
        return jnp.maximum(
            self._time(sample) - self._newest_reading(sample, self.latency) * self.interval, self.latency
        )

    def split_age(self, age: Any) -> tuple[Any, Any]:
        """Return the age of a reading [s] as a number of whole control periods and the remaining time [s].

        The number of periods is an int if it is the same for all readings.
        """
        if self.every is not None:
            return self.wait, jnp.zeros_like(jnp.asarray(age, float))
        whole = self.wait
        if self.split:
            limit = (self.wait + 1) * self.period - guards.time_tolerance(self.period, self.period)
            whole = jnp.where(age >= limit, self.wait + 1, self.wait)
        return whole, jnp.clip(age - whole * self.period, 0.0, self.period)

    def at_control_samples(self) -> "SampleTimes":
        """Return times at which a reading is taken at every control sample, for a sensor with its own clock."""
        if self.every is not None:
            return self
        return replace(self, interval=self.period, every=1, wait=self.longest_wait, split=False, pattern=(1, 1))

    def _time(self, sample: Any) -> Any:
        """Return the time of a sample of the sensor [s] by its number."""
        return jnp.asarray(sample, float) * self.period

    def _newest_reading(self, sample: Any, latency: Any = 0.0) -> Any:
        """Return the number of the newest reading that is at least a latency [s] old at the control sample `sample`."""
        t = self._time(sample)
        return jnp.floor((t - latency + guards.time_tolerance(self.period, t)) / self.interval)


def sample_times(interval: float, latency: float, period: float) -> SampleTimes:
    """Return when a sensor takes readings and when the flight software receives them.

    Args:
        interval: time between readings, at least a control period [s].
        latency: time from a reading until the flight software receives it [s].
        period: control period [s].
    """
    ratio, delay = interval / period, latency / period
    every = round(ratio) if abs(ratio - round(ratio)) < INTEGER_TOLERANCE * ratio else None
    is_whole = abs(delay - round(delay)) < INTEGER_TOLERANCE * max(delay, 1.0)
    wait = round(delay) if is_whole else math.ceil(delay) if every is not None else math.floor(delay)
    interval_s, latency_s, period_s = (jnp.asarray(float(v)) for v in (interval, latency, period))
    return SampleTimes(interval_s, latency_s, period_s, every, wait, every is None and not is_whole, pattern(ratio))


@dataclass(frozen=True, kw_only=True)
class AttitudeSensor:
    """A sensor whose reading depends on the attitude alone. Derived classes define `read`.

    Its axes follow from the body axes by the rotation `mounting`: a vector with components y in sensor axes has the
    components R(mounting) y in body axes. A reading is an array [-]. Its noise is a small rotation about the sensor's
    axes [rad], or additive, and its components are independent.
    """

    name: str = field(metadata={"static": True})  # name of the sensor, its random numbers and its input in exported C
    noise: Leaf  # (m,) 1 sigma of each component of a reading
    mounting: Leaf  # (4,) unit quaternion
    times: SampleTimes

    def read(self, q: Float[Array, "4"]) -> Float[Array, " size"]:
        """Return the reading without noise at a body attitude q, a unit quaternion (4,)."""
        raise NotImplementedError

    def changed(self, reading: Float[Array, " size"], change: Float[Array, " m"]) -> Float[Array, " size"]:
        """Return the reading plus a small change with components (m,), such as noise."""
        return reading + change

    def change(self, reading: Float[Array, " size"], other: Float[Array, " size"]) -> Float[Array, " m"]:
        """Return the difference (m,) of another reading from a reading."""
        return other - reading

    def sensitivity(self, q: Float[Array, "4"]) -> Float[Array, "m 3"]:
        """Return the derivative (m, 3) of a reading by a small rotation [rad] about the body axes at attitude q."""

        def change_by_rotation(turn: Array) -> Array:
            return self.change(self.read(q), self.read(attitude.multiply(q, attitude.from_rotation_vector(turn))))

        return jax.jacfwd(change_by_rotation)(jnp.zeros(3))

    def axes(self) -> Float[Array, "3 3"]:
        """Return the sensor's axes in body axes, one per row (3, 3)."""
        return jax.vmap(lambda axis: attitude.rotate(self.mounting, axis))(jnp.eye(3))

    def at_control_samples(self) -> "AttitudeSensor":
        """Return a sensor that reads at every control sample, with noise that gives the same information per time.

        A sensor without its own clock is returned unchanged.
        """
        if self.times.every is not None:
            return self
        fraction = self.times.period / self.times.interval
        return replace(self, noise=self.noise / jnp.sqrt(fraction), times=self.times.at_control_samples())


@pytree
@dataclass(frozen=True, kw_only=True)
class StarTracker(AttitudeSensor):
    """Star tracker: its reading is its own attitude relative to inertial axes, a unit quaternion, scalar last.

    The noise is a small rotation about its own axes [rad]. z is its boresight, about which the noise is largest.
    """

    def read(self, q: Float[Array, "4"]) -> Float[Array, "4"]:
        """Return the attitude of the tracker's axes (4,)."""
        return attitude.multiply(q, self.mounting)

    def body(self, reading: Float[Array, "4"]) -> Float[Array, "4"]:
        """Return the attitude of the body (4,) for a reading."""
        return attitude.multiply(reading, attitude.conjugate(self.mounting))

    def changed(self, reading: Float[Array, "4"], change: Float[Array, "3"]) -> Float[Array, "4"]:
        """Return an attitude turned by a small rotation (3,) [rad] about the tracker's axes."""
        return attitude.multiply(reading, attitude.from_rotation_vector(change))

    def change(self, reading: Float[Array, "4"], other: Float[Array, "4"]) -> Float[Array, "3"]:
        """Return the small rotation (3,) [rad] about the tracker's axes from one attitude to another."""
        return attitude.small_rotation(reading, other)

    def sensitivity(self, q: Float[Array, "4"]) -> Float[Array, "3 3"]:
        """Return the tracker's axes in body axes (3, 3), which convert a body rotation [rad] to the tracker's axes."""
        return self.axes()


@pytree
@dataclass(frozen=True, kw_only=True)
class VectorSensor(AttitudeSensor):
    """Sun sensor or magnetometer: its reading is a known inertial direction, a unit vector in its own axes.

    It does not measure the rotation about that direction.
    """

    direction: Leaf  # (3,) unit vector in inertial axes

    def read(self, q: Float[Array, "4"]) -> Float[Array, "3"]:
        """Return the direction in the sensor's axes (3,)."""
        return attitude.rotate(attitude.conjugate(attitude.multiply(q, self.mounting)), self.direction)
