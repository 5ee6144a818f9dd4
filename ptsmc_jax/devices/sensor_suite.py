"""A sensor suite: any number of attitude sensors and a gyro, combined by a Kalman filter of the attitude.

Read `SensorSuite.measure` first.
"""

from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from ptsmc_jax.devices.attitude_sensors import AttitudeSensor, StarTracker
from ptsmc_jax.devices.kalman_filter import KalmanFilter, Track
from ptsmc_jax.devices.sensors import ATTITUDE_AND_BIAS, RATE_NOISE, MeasurementModel, SpacecraftSensors
from ptsmc_jax.devices.ticks import Ticks
from ptsmc_jax.numerics import guards
from ptsmc_jax.numerics.draws import WholeNumber
from ptsmc_jax.numerics.pytrees import Leaf, Scalar, pytree
from ptsmc_jax.plants.rigid_body import AttitudeState


class Delivery(NamedTuple):
    """Reading of one sensor for the flight software at a control sample."""

    reading: Array  # (size,) reading of the sensor, see `AttitudeSensor.read`
    weight: Scalar  # 1, or 0 for no reading; in a partial first period between them, see `KalmanFilter.correct`


class SuiteMemory(NamedTuple):
    """Memory of a `SensorSuite` between control samples."""

    keys: Any  # random keys: noise of each attitude sensor, gyro noise, gyro drift; None for no noise
    noise: tuple[Array, ...]  # noise of the next sample: each attitude sensor (m,), then the gyro (3,) [rad/s]
    bias: Array  # (3,) gyro bias [rad/s]
    # readings that each attitude sensor delivers later, as `Delivery` (queue, ..), newest first; None without latency
    waiting: tuple[Any, ...]
    estimate: Track  # state of the Kalman filter


@pytree
@dataclass(frozen=True, kw_only=True)
class SensorSuite(SpacecraftSensors):
    """Attitude sensors and a gyro. The law sees the attitude [-] and the rate [rad/s] that the filter estimates."""

    sensors: tuple[AttitudeSensor, ...]
    rate_noise: Leaf  # (3,) 1 sigma of a gyro sample about each body axis [rad/s]
    rate_bias: Leaf  # (3,) 1 sigma of the gyro bias at the first sample [rad/s]
    bias_rate: Leaf  # (3,) 1 sigma of the change of the bias per second of a period: walk / sqrt(period) [rad/s^2]
    filter: KalmanFilter
    given_bias: Leaf | None = None  # (3,) gyro bias at the first sample, if it is not random [rad/s]
    rate_scale: Leaf | None = None  # (3,) ratio of gyro reading to true rate [-]
    outage: Leaf | None = None  # (2,) start and end of an outage of the first attitude sensor [s]
    noise_free: bool = field(default=False, metadata={"static": True})  # whether no noise is generated

    @property
    def star_tracker(self) -> StarTracker | None:
        """Return the first star tracker, whose readings telemetry has; None if there is none."""
        return next((sensor for sensor in self.sensors if isinstance(sensor, StarTracker)), None)

    @property
    def every(self) -> int:
        """Return the number of control periods after which the sample times repeat, for means in linear theory."""
        return int(np.lcm.reduce([sensor.times.every or 1 for sensor in self.sensors]))

    def newest_reading_age(self, sample: Array, dt: Scalar) -> PyTree:
        """Return the age [s] of the newest reading of each sensor with its own clock, None for others; see `Sensor`."""
        if not self.filter.has_readings_between_samples:
            return None
        clocks = (None if sensor.times.every is not None else sensor.times for sensor in self.sensors)
        return tuple(None if times is None else times.newest_reading_age(sample, dt) for times in clocks)

    @property
    def noises(self) -> list[tuple[str, Leaf, int]]:
        """Return the noise of each attitude sensor, and of the gyro [rad/s]; see `SpacecraftSensors.noises`."""
        each = [(f"{sensor.name}_noise", sensor.noise, sensor.noise.shape[-1]) for sensor in self.sensors]
        return [*each, (RATE_NOISE, self.rate_noise, 3)]

    def begin(self, seed: WholeNumber, trial: WholeNumber, x0: AttitudeState, now: Ticks) -> SuiteMemory:
        """Return the memory before the first sample of positive length. No delayed reading is pending."""
        keys = self.keys(seed, trial)
        bias = jnp.zeros(3) if self.noise_free else self.first_bias(seed, trial)
        errors = self.filter_errors(seed, trial)
        estimate = self.filter.begin(x0.q, bias, x0.w, errors, now.sample, now.noise_weight)
        waiting = []
        for sensor in self.sensors:
            count, reading = sensor.times.longest_wait, sensor.read(x0.q)
            waiting.append(Delivery(jnp.tile(reading, (count, 1)), jnp.zeros(count)) if count else None)
        return SuiteMemory(keys, self.noise(keys, now.sample), bias, tuple(waiting), estimate)

    def readings(
        self, memory: SuiteMemory, x: AttitudeState, now: Ticks, dt: Scalar, star_x: PyTree = None
    ) -> tuple[list[tuple[Array, Scalar, Array]], Array, SuiteMemory]:
        """Return the readings at a sample, and the memory.

        Args:
            memory: from `begin`, or from the last sample.
            x: true attitude and rate.
            now: the control period that the sample begins.
            dt: length of the period that ends at the sample [s].
            star_x: true states at the times of `newest_reading_age`, one for each attitude sensor, None for sensors
                without their own clock; None if no sensor has one.

        Returns:
            For each attitude sensor the delivered reading (size,), its weight and its age [s]. Then the gyro sample
            (3,) [rad/s], and the memory for the next sample.
        """
        noise_next = self.noise(memory.keys, now.sample + 1)
        *noises, shift = guards.lerp(now.noise_weight, memory.noise, noise_next)
        rate, bias = self.gyro_sample(memory, x.w, shift, now, dt)
        delivered, waiting = [], []
        for k, (sensor, noise) in enumerate(zip(self.sensors, noises, strict=True)):
            x_taken = x if star_x is None or star_x[k] is None else star_x[k]
            weight = jnp.where(sensor.times.is_reading_new(now.sample), now.noise_weight, 0.0)
            if k == 0:
                t = now.t if sensor.times.every is not None else now.t - sensor.times.newest_reading_age(now.sample, dt)
                weight = self.outside_outage(weight, t)
            age = jnp.asarray(sensor.times.delivered_age(now.sample), float)
            received, queue = _delay_reading(
                Delivery(sensor.changed(sensor.read(x_taken.q), noise), weight), memory.waiting[k], sensor, now, age
            )
            delivered.append((*received, age))
            waiting.append(queue)
        return delivered, rate, memory._replace(noise=noise_next, bias=bias, waiting=tuple(waiting))

    def inputs(
        self, memory: SuiteMemory, x: AttitudeState, now: Ticks, dt: Scalar, star_x: PyTree = None
    ) -> tuple[dict[str, Array], SuiteMemory]:
        """Return the inputs of exported C at a sample, by name, and the memory; see `Sensor.inputs`."""
        delivered, rate, memory = self.readings(memory, x, now, dt, star_x)
        named: dict[str, Array] = {"rate": rate}
        for sensor, (reading, weight, age) in zip(self.sensors, delivered, strict=True):
            named[sensor.name] = reading
            named[f"{sensor.name}_valid"] = (weight > 0.0).astype(float)
            named[f"{sensor.name}_age"] = age
        return named, memory

    def filter_state(self, memory: SuiteMemory) -> dict[str, Array]:
        """Return the state of the Kalman filter by the names of the fields in exported C."""
        return memory.estimate.by_name

    def measure(
        self, memory: SuiteMemory, x: AttitudeState, now: Ticks, dt: Scalar, star_x: PyTree = None
    ) -> tuple[AttitudeState, SuiteMemory]:
        """Return the attitude and rate that the filter estimates, and the memory."""
        delivered, rate, memory_next = self.readings(memory, x, now, dt, star_x)
        estimate = self.filter.propagate(memory.estimate, rate, dt)
        for k, (reading, weight, age) in enumerate(delivered):
            estimate = self.filter.correct(estimate, k, reading, age, weight)
        return AttitudeState(estimate.q, estimate.w), memory_next._replace(estimate=estimate)

    def without_noise(self) -> "SensorSuite":
        """Return the suite without noise and gyro bias. The filter still assumes them, so its gains are unchanged."""
        return replace(self, noise_free=True, given_bias=None)

    def at_control_samples(self) -> "SensorSuite":
        """Return a suite whose sensors all read at control samples, with the same information per time."""
        sensors = tuple(sensor.at_control_samples() for sensor in self.sensors)
        return replace(self, sensors=sensors, filter=self.filter.at_control_samples())

    def measurement_model(self, sample: int = 0, fraction: float = 1.0) -> MeasurementModel:
        """Return the readings of the attitude sensors and the gyro to first order, and the gyro bias.

        Args:
            sample: number of the first control sample.
            fraction: weight of this sample, below 1 in a partial first period.
        """
        identity = jnp.array([0.0, 0.0, 0.0, 1.0])
        axes = [np.pad(sensor.sensitivity(identity), ((0, 0), (0, 6))) for sensor in self.sensors]
        rows = np.vstack([*axes, self.gyro_rows()])
        noise = np.concatenate([sigma for _, sigma, _ in self.noises])
        early = self._per_component([sensor.times.every is None for sensor in self.sensors], False)
        start = ATTITUDE_AND_BIAS, np.asarray(self.filter.first_factor(sample, fraction))
        return MeasurementModel(rows, noise, np.asarray(self.rate_bias), np.asarray(self.bias_rate), start, early)

    def change(self, x: AttitudeState, near: AttitudeState, taken: PyTree = None, near_taken: PyTree = None) -> Array:
        """Return the differences of all readings (m,) between two true states.

        Args:
            x: first true state at the control sample.
            near: second true state at the control sample.
            taken: first true states at the times of `newest_reading_age`; None: all readings are at the control sample.
            near_taken: second true states at these times, or None.
        """
        changes = []
        for k, sensor in enumerate(self.sensors):
            state, near_state = (x, near) if taken is None or taken[k] is None else (taken[k], near_taken[k])
            changes.append(sensor.change(sensor.read(state.q), sensor.read(near_state.q)))
        return jnp.concatenate([*changes, (near.w - x.w) * (1.0 if self.rate_scale is None else self.rate_scale)])

    def sample_delays(self, now: Ticks) -> np.ndarray:
        """Return the age of each component of the readings in control samples, (N, m), at N control samples.

        A reading between two control samples counts from the later one.
        """
        delays = [np.broadcast_to(sensor.times.split_age(sensor.times.delivered_age(now.sample))[0], now.sample.shape)
                 for sensor in self.sensors]  # fmt: skip
        return self._per_component(delays, np.zeros(now.sample.shape, int)).T

    def available(self, now: Ticks) -> np.ndarray:
        """Return whether each reading is available at each control sample, (N, m) bool."""
        availability = []
        for k, sensor in enumerate(self.sensors):
            times = sensor.times
            fresh = np.asarray(now.sample) - np.asarray(times.split_age(times.delivered_age(now.sample))[0]) >= int(
                now.sample[0]
            )
            due = np.asarray(times.is_reading_due(now.sample)) & fresh
            if k == 0 and self.outage is not None:
                t, (begin, end) = np.asarray(now.t - times.delivered_age(now.sample)), np.asarray(self.outage)
                due &= ~((t >= begin) & (t < end))
            availability.append(due)
        return self._per_component(availability, np.ones(now.sample.shape, bool)).T

    def _per_component(self, values: list[Any], of_gyro: Any) -> np.ndarray:
        """Return values of the attitude sensors, and one of the gyro, repeated for each component (m, ..)."""
        sizes = [sensor.noise.shape[-1] for sensor in self.sensors]
        return np.repeat(np.stack([*values, of_gyro]), [*sizes, 3], axis=0)

    @property
    def _queues(self) -> list[int]:
        """For each sensor, the number of local coordinates of its delayed readings."""
        return [sensor.times.longest_wait * sensor.noise.shape[-1] for sensor in self.sensors]

    @property
    def noise_slice(self) -> slice:
        """The place of the noise of the next sample in the coordinates of `retract`."""
        first = 9 + 3 * self.filter.past_samples + sum(self._queues)
        return slice(first, first + sum(sensor.noise.shape[-1] for sensor in self.sensors) + 3)

    def retract(self, memory: SuiteMemory, by: Float[Array, " n"]) -> SuiteMemory:
        """Return the memory at local coordinates relative to another memory.

        Args:
            memory: the memory at coordinates 0.
            by: coordinates (n,): filter [rad, rad/s], delayed readings, noise of the next sample.
        """
        size = 9 + 3 * self.filter.past_samples
        filter_part, *waiting, noise = jnp.split(by, np.cumsum([size, *self._queues]))
        near_queues = []
        for sensor, queue, shift in zip(self.sensors, memory.waiting, waiting, strict=True):
            if queue is not None:
                shifts = shift.reshape(sensor.times.longest_wait, -1)
                queue = queue._replace(reading=jax.vmap(sensor.changed)(queue.reading, shifts))
            near_queues.append(queue)
        changes = jnp.split(noise, np.cumsum([v.shape[-1] for v in memory.noise])[:-1])
        noise = tuple(jnp.add(v, change) for v, change in zip(memory.noise, changes, strict=True))
        estimate = self.filter.retract(memory.estimate, filter_part)
        return memory._replace(estimate=estimate, waiting=tuple(near_queues), noise=noise)

    def local_coordinates(self, memory: SuiteMemory, other: SuiteMemory) -> Float[Array, " n"]:
        """Return the local coordinates (n,) of another memory relative to a memory, to first order; see `retract`."""
        shifts = [
            jax.vmap(sensor.change)(queue.reading, other_queue.reading).reshape(-1)
            for sensor, queue, other_queue in zip(self.sensors, memory.waiting, other.waiting, strict=True)
            if queue is not None
        ]
        noise = [v_other - v for v, v_other in zip(memory.noise, other.noise, strict=True)]
        filter_part = self.filter.local_coordinates(memory.estimate, other.estimate)
        return jnp.concatenate([filter_part, *shifts, *noise])


def _delay_reading(
    new: Delivery, waiting: Delivery | None, sensor: AttitudeSensor, now: Ticks, age: Scalar
) -> tuple[Delivery, Delivery | None]:
    """Return the reading that the flight software receives at a sample, and the new queue of delayed readings.

    Args:
        new: reading taken at this sample; its weight is 0 if there is none.
        waiting: delayed readings, newest first, or None without latency.
        sensor: the sensor.
        now: the control period that the sample begins.
        age: age of the received reading [s].
    """
    times = sensor.times
    if waiting is None:
        return new, None
    all_readings = jax.tree.map(lambda one, queue: jnp.concatenate([one[None], queue]), new, waiting)
    received = jax.tree.map(lambda v: v[times.wait], all_readings)
    if times.split:
        older = jax.tree.map(lambda v: v[times.wait + 1], all_readings)
        received = guards.select(times.split_age(age)[0] == times.wait, received, older)
    if times.every is None:
        received = received._replace(weight=jnp.where(times.is_reading_due(now.sample), received.weight, 0.0))
    return received, jax.tree.map(lambda v: v[:-1], all_readings)
