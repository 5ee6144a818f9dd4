"""A sensor suite: any number of attitude sensors and a gyro, combined by a Kalman filter of the attitude.

Read `SensorSuite.measure` first.
"""

from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ptsmc_jax.devices.attitude_sensors import AttitudeSensor, StarTracker
from ptsmc_jax.devices.kalman_filter import KalmanFilter, Track
from ptsmc_jax.devices.sensors import ATTITUDE_AND_BIAS, RATE_NOISE, Reading, SpacecraftSensors
from ptsmc_jax.devices.ticks import Ticks
from ptsmc_jax.numerics import guards
from ptsmc_jax.numerics.draws import WholeNumber
from ptsmc_jax.numerics.pytrees import Leaf, Scalar, pytree
from ptsmc_jax.plants.rigid_body import AttitudeState


class Delivery(NamedTuple):
    """Reading of one sensor for the flight software at a control sample."""

    reading: Array  # (size,)
    weight: Scalar  # 1, or 0 for no reading; in a partial first period between them, see `KalmanFilter.correct`


class Readings(NamedTuple):
    """Readings of all sensors at a control sample."""

    delivered: tuple[Delivery, ...]  # one for each attitude sensor
    ages: tuple[Array, ...]  # ages of these readings [s]
    rate: Array  # (3,) gyro sample [rad/s]


class SuiteMemory(NamedTuple):
    """Memory of a `SensorSuite` between control samples."""

    keys: Any  # random keys: noise of each attitude sensor, gyro noise, gyro drift; None for no noise
    noise: tuple[Array, ...]  # noise of the next sample: each attitude sensor (m,), then the gyro (3,) [rad/s]
    bias: Array  # (3,) gyro bias [rad/s]
    waiting: tuple[Any, ...]  # for each attitude sensor: `Delivery` (queue, ..) of the last samples, newest first
    estimate: Track


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
    noise_free: bool = field(default=False, metadata={"static": True})  # whether no noise is generated, see `quiet`

    @property
    def star_tracker(self) -> StarTracker | None:
        """Return the first star tracker, whose readings telemetry has; None if there is none."""
        return next((one for one in self.sensors if isinstance(one, StarTracker)), None)

    @property
    def every(self) -> int:
        """Return the number of control periods after which the sample times repeat, for means in linear theory."""
        return int(np.lcm.reduce([sensor.times.every or 1 for sensor in self.sensors]))

    def taken_ago(self, sample: Array, dt: Scalar) -> Any:
        """Return the age [s] of the newest reading of each sensor with its own clock, None for others; see `Sensor`."""
        if not self.filter.between:
            return None
        clocks = (None if sensor.times.every is not None else sensor.times for sensor in self.sensors)
        return tuple(None if times is None else times.taken_ago(sample, dt) for times in clocks)

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
            count, reading = sensor.times.queue, sensor.read(x0.q)
            waiting.append(Delivery(jnp.tile(reading, (count, 1)), jnp.zeros(count)) if count else None)
        return SuiteMemory(keys, self.noise(keys, now.sample), bias, tuple(waiting), estimate)

    def readings(
        self, memory: SuiteMemory, x: AttitudeState, now: Ticks, dt: Scalar, star_x: Any = None
    ) -> tuple[Readings, SuiteMemory]:
        """Return the readings at a sample, and the memory; see `Sensor.measure` for the arguments."""
        noise_next = self.noise(memory.keys, now.sample + 1)
        *noises, shift = guards.lerp(now.noise_weight, memory.noise, noise_next)
        rate, bias = self.gyro_sample(memory, x.w, shift, now, dt)
        delivered, ages, waiting = [], [], []
        for k, (sensor, noise) in enumerate(zip(self.sensors, noises, strict=True)):
            seen = x if star_x is None or star_x[k] is None else star_x[k]
            weight = jnp.where(sensor.times.taken(now.sample), now.noise_weight, 0.0)
            if k == 0:
                t = now.t if sensor.times.every is not None else now.t - sensor.times.taken_ago(now.sample, dt)
                weight = self.outside_outage(weight, t)
            age = jnp.asarray(sensor.times.age(now.sample), float)
            new, queue = _passed(
                Delivery(sensor.changed(sensor.read(seen.q), noise), weight), memory.waiting[k], sensor, now, age
            )
            delivered.append(new)
            ages.append(age)
            waiting.append(queue)
        found = Readings(tuple(delivered), tuple(ages), rate)
        return found, memory._replace(noise=noise_next, bias=bias, waiting=tuple(waiting))

    def inputs(
        self, memory: SuiteMemory, x: AttitudeState, now: Ticks, dt: Scalar, star_x: Any = None
    ) -> tuple[dict[str, Array], SuiteMemory]:
        """Return the inputs of exported C at a sample, by name, and the memory; see `Sensor.inputs`."""
        found, memory = self.readings(memory, x, now, dt, star_x)
        named: dict[str, Array] = {"rate": found.rate}
        for sensor, (reading, weight), age in zip(self.sensors, found.delivered, found.ages, strict=True):
            named[sensor.name] = reading
            named[f"{sensor.name}_valid"] = (weight > 0.0).astype(float)
            named[f"{sensor.name}_age"] = age
        return named, memory

    def remembered(self, memory: SuiteMemory) -> dict[str, Array]:
        """Return the state of the filter as exported C has it, by name."""
        track = memory.estimate
        named = {"attitude": track.q, "bias": track.bias, "gyro": track.rate, "covariance": track.covariance}
        past = {"past_attitude": track.past_q, "past_rate": track.past_w}
        return named | {name: value for name, value in past.items() if value is not None}

    def measure(
        self, memory: SuiteMemory, x: AttitudeState, now: Ticks, dt: Scalar, star_x: Any = None
    ) -> tuple[AttitudeState, SuiteMemory]:
        """Return the attitude and rate that the filter estimates, and the memory."""
        found, memory_next = self.readings(memory, x, now, dt, star_x)
        estimate = self.filter.propagate(memory.estimate, found.rate, dt)
        for k, ((reading, weight), age) in enumerate(zip(found.delivered, found.ages, strict=True)):
            estimate = self.filter.correct(estimate, k, reading, age, weight)
        return AttitudeState(estimate.q, estimate.w), memory_next._replace(estimate=estimate)

    def quiet(self) -> "SensorSuite":
        """Return the suite without noise and bias; the filter keeps its covariance."""
        return replace(self, noise_free=True, given_bias=None)

    def in_step(self) -> "SensorSuite":
        """Return a suite whose sensors all read at control samples, with the same information per time."""
        sensors = tuple(sensor.in_step() for sensor in self.sensors)
        return replace(self, sensors=sensors, filter=self.filter.in_step())

    def reading(self, sample: int = 0, fraction: float = 1.0) -> Reading:
        """Return the readings of the attitude sensors and the gyro to first order, and the gyro bias.

        Args:
            sample: number of the first control sample.
            fraction: its weight, see `KalmanFilter.begin`.
        """
        still = jnp.array([0.0, 0.0, 0.0, 1.0])
        axes = [np.pad(sensor.sensitivity(still), ((0, 0), (0, 6))) for sensor in self.sensors]
        rows = np.vstack([*axes, self.gyro_rows()])
        noise = np.concatenate([sigma for _, sigma, _ in self.noises])
        early = self._each([sensor.times.every is None for sensor in self.sensors], False)
        start = ATTITUDE_AND_BIAS, np.asarray(self.filter.first_factor(sample, fraction))
        return Reading(rows, noise, np.asarray(self.rate_bias), np.asarray(self.bias_rate), start, early)

    def change(self, x: AttitudeState, near: AttitudeState, taken: Any = None, near_taken: Any = None) -> Array:
        """Return the differences of all readings (m,) between two true states.

        Args:
            x: first true state at the control sample.
            near: second true state at the control sample.
            taken: first true states at the times of `taken_ago`, or None if all readings are taken at the control
                sample.
            near_taken: second true states at these times, or None.
        """
        changes = []
        for k, sensor in enumerate(self.sensors):
            here, there = (x, near) if taken is None or taken[k] is None else (taken[k], near_taken[k])
            changes.append(sensor.change(sensor.read(here.q), sensor.read(there.q)))
        return jnp.concatenate([*changes, (near.w - x.w) * (1.0 if self.rate_scale is None else self.rate_scale)])

    def lag(self, now: Ticks) -> np.ndarray:
        """Return how many control samples ago each reading was taken, (N, m).

        A reading between two control samples counts from the later one.
        """
        whole = [np.broadcast_to(sensor.times.place(sensor.times.age(now.sample))[0], now.sample.shape)
                 for sensor in self.sensors]  # fmt: skip
        return self._each(whole, np.zeros(now.sample.shape, int)).T

    def available(self, now: Ticks) -> np.ndarray:
        """Return whether each reading is available at each control sample, (N, m) bool."""
        there = []
        for k, sensor in enumerate(self.sensors):
            times = sensor.times
            fresh = np.asarray(now.sample) - np.asarray(times.place(times.age(now.sample))[0]) >= int(now.sample[0])
            due = np.asarray(times.due(now.sample)) & fresh
            if k == 0 and self.outage is not None:
                t, (begin, end) = np.asarray(now.t - times.age(now.sample)), np.asarray(self.outage)
                due &= ~((t >= begin) & (t < end))
            there.append(due)
        return self._each(there, np.ones(now.sample.shape, bool)).T

    def _each(self, values: list[Any], of_gyro: Any) -> np.ndarray:
        """Return values of the attitude sensors, and one of the gyro, repeated for each component (m, ..)."""
        sizes = [sensor.noise.shape[-1] for sensor in self.sensors]
        return np.repeat(np.stack([*values, of_gyro]), [*sizes, 3], axis=0)

    @property
    def _queues(self) -> list[int]:
        """For each sensor, the number of local coordinates of its delayed readings."""
        return [sensor.times.queue * sensor.noise.shape[-1] for sensor in self.sensors]

    @property
    def noise_place(self) -> slice:
        """The place of the noise of the next sample in the coordinates of `retract`."""
        first = 9 + 3 * self.filter.past + sum(self._queues)
        return slice(first, first + sum(sensor.noise.shape[-1] for sensor in self.sensors) + 3)

    def retract(self, memory: SuiteMemory, by: Float[Array, " n"]) -> SuiteMemory:
        """Return the memory at local coordinates relative to another memory.

        Args:
            memory: the memory at coordinates 0.
            by: coordinates (n,): filter [rad, rad/s], delayed readings, noise of the next sample.
        """
        size = 9 + 3 * self.filter.past
        own, *waiting, noise = jnp.split(by, np.cumsum([size, *self._queues]))
        near = []
        for sensor, queue, shift in zip(self.sensors, memory.waiting, waiting, strict=True):
            if queue is not None:
                shifts = shift.reshape(sensor.times.queue, -1)
                queue = queue._replace(reading=jax.vmap(sensor.changed)(queue.reading, shifts))
            near.append(queue)
        changes = jnp.split(noise, np.cumsum([v.shape[-1] for v in memory.noise])[:-1])
        noise = tuple(jnp.add(v, change) for v, change in zip(memory.noise, changes, strict=True))
        estimate = self.filter.retract(memory.estimate, own)
        return memory._replace(estimate=estimate, waiting=tuple(near), noise=noise)

    def local_coordinates(self, memory: SuiteMemory, other: SuiteMemory) -> Float[Array, " n"]:
        """Return the local coordinates (n,) of another memory relative to a memory, to first order; see `retract`."""
        shifts = [
            jax.vmap(sensor.change)(mine.reading, theirs.reading).reshape(-1)
            for sensor, mine, theirs in zip(self.sensors, memory.waiting, other.waiting, strict=True)
            if mine is not None
        ]
        noise = [theirs - mine for mine, theirs in zip(memory.noise, other.noise, strict=True)]
        own = self.filter.local_coordinates(memory.estimate, other.estimate)
        return jnp.concatenate([own, *shifts, *noise])


def _passed(
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
    line = jax.tree.map(lambda one, queue: jnp.concatenate([one[None], queue]), new, waiting)
    out = jax.tree.map(lambda v: v[times.wait], line)
    if times.split:
        later = jax.tree.map(lambda v: v[times.wait + 1], line)
        out = guards.select(times.place(age)[0] == times.wait, out, later)
    if times.every is None:
        out = out._replace(weight=jnp.where(times.due(now.sample), out.weight, 0.0))
    return out, jax.tree.map(lambda v: v[:-1], line)
