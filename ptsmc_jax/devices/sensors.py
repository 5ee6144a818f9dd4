"""Sensors: star tracker and gyro, raw or with an attitude filter, and state sensors of a chain.

White noise is given as 1 sigma per sample, density / sqrt(period) (IEEE Std 952): attitudes in rad, rates in rad/s, a
chain's states in the states' own units. The simulation carries the memory of a sensor (noise of the sample, bias,
estimate). Noise depends on (seed, trial, sample). The first period of the anchored clock may be partial. All effects of
its sample are then weighted by the length of the period, so that results are continuous when that length goes to 0.

Read `Sensor` first, the interface of all sensors, then `Sensors`.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PyTree

from ptsmc_jax.devices.attitude_filter import AttitudeFilter, Estimate, attitude_filter, filter_between_samples
from ptsmc_jax.devices.attitude_sensors import SampleTimes
from ptsmc_jax.devices.ticks import Ticks
from ptsmc_jax.numerics import attitude, draws, guards
from ptsmc_jax.numerics.draws import WholeNumber
from ptsmc_jax.numerics.pytrees import Leaf, Scalar, pytree
from ptsmc_jax.plants.rigid_body import AttitudeState

ATTITUDE_NOISE, RATE_NOISE, STATE_NOISE = "attitude_noise", "rate_noise", "state_noise"
RATE_BIAS, BIAS_WALK, FILTER_START = "rate_bias", "rate_bias_walk", "filter_start"
# rows of `MeasurementModel.start` for a filter's errors of attitude and bias
ATTITUDE_AND_BIAS = np.eye(9)[np.r_[0:3, 6:9]]


class Sensor(ABC):
    """Interface of sensors for simulation, linear theory and campaigns; all numbers in SI units [rad, rad/s].

    A true state x is the part of the plant state that sensors can see, `Plant.visible`.
    """

    perfect: ClassVar[bool] = False  # whether the law gets the true state instead of a measured one

    @abstractmethod
    def begin(self, seed: WholeNumber, trial: WholeNumber, x0: PyTree, now: Ticks) -> PyTree:
        """Return the memory before the first sample of positive length [s].

        Args:
            seed: seed of the campaign.
            trial: number of the trial.
            x0: true state.
            now: the control period that this sample begins.

        Returns:
            The memory, a pytree of arrays, or None for sensors without it.
        """

    @abstractmethod
    def measure(
        self, memory: PyTree, x: PyTree, now: Ticks, dt: Scalar, star_x: PyTree = None
    ) -> tuple[PyTree, PyTree]:
        """Return the measured state for the law, and the memory.

        Args:
            memory: from `begin`, or from the last sample.
            x: true state.
            now: the control period that the sample begins.
            dt: length of the period that ends at the sample [s].
            star_x: true state at the time of `newest_reading_age`, for sensors with their own clock; None without them.

        Returns:
            The measured state, a pytree like `x`, and the memory for the next sample.
        """

    def sample(self, memory: PyTree, x: PyTree, now: Ticks, dt: Scalar, star_x: PyTree = None) -> tuple[PyTree, PyTree]:
        """Return the readings before any filter, and the memory.

        Args: those of `measure`.

        Returns:
            The readings, a pytree like `x`, and the memory for the next sample.
        """
        return self.measure(memory, x, now, dt)

    def inputs(
        self, memory: PyTree, x: PyTree, now: Ticks, dt: Scalar, star_x: PyTree = None
    ) -> tuple[dict[str, Array], PyTree]:
        """Return the sensor inputs of exported C at a sample, by name, and the memory.

        Args: those of `measure`.

        Returns:
            For a spacecraft "attitude" (4,) [-] and "rate" (3,) [rad/s], otherwise "x", the measured state. Then the
            memory for the next sample.
        """
        read, memory = self.sample(memory, x, now, dt, star_x)
        named = {"attitude": read.q, "rate": read.w} if isinstance(read, AttitudeState) else {"x": read}
        return named, memory

    def filter_state(self, memory: PyTree) -> dict[str, Array]:
        """Return the filter estimates that are part of the state of exported C, by name."""
        return {}

    @abstractmethod
    def without_noise(self) -> "Sensor":
        """Return the sensor without noise."""

    def at_control_samples(self) -> "Sensor":
        """Return an equivalent sensor with all samples at control samples, for linear theory; see `Sensors`."""
        return self

    def newest_reading_age(self, sample: Array, dt: Scalar) -> PyTree:
        """Return the ages [s] of the newest readings of sensors with their own clock at a control sample.

        Args:
            sample: number of the control sample.
            dt: length of the control period before it [s], the largest value.

        Returns:
            A pytree of times. The simulation passes the true states at these times to `measure` as `star_x`, in the
            same pytree. The result is None if all sensors read at control samples.
        """
        return None

    def trial_constants(self, seed: WholeNumber, trial: WholeNumber) -> dict[str, Array]:
        """Return random quantities that are constant in a trial, such as a bias [rad/s], by column name."""
        return {}


@pytree
@dataclass(frozen=True)
class PerfectSensors(Sensor):
    """No sensors: the law sees the true state."""

    perfect: ClassVar[bool] = True

    def begin(self, seed: WholeNumber, trial: WholeNumber, x0: PyTree, now: Ticks) -> None:
        """Return None, because there is no memory."""

    def measure(self, memory: None, x: PyTree, now: Ticks, dt: Scalar, star_x: None = None) -> tuple[PyTree, None]:
        """Return the true state; dt in [s]."""
        return x, None

    def without_noise(self) -> "PerfectSensors":
        """Return the sensors themselves."""
        return self


class MeasurementModel(NamedTuple):
    """Linear measurement model of a sensor near the true state, for `lower_bound`.

    The coordinates are the local coordinates (n,) of the plant, see `Plant.retract`, and the sensor's own states
    (own,), such as the gyro bias.
    """

    rows: np.ndarray  # (m, n + own) derivatives of the readings by the coordinates
    noise: np.ndarray  # (m,) 1 sigma of each reading, in its unit
    own: np.ndarray  # (own,) 1 sigma of the sensor's own states at t = 0
    own_drift: np.ndarray  # (own,) 1 sigma of their change in a control period, per second
    # prior knowledge at t = 0: rows (k, n + own), and a factor (k, k) of their covariance
    start: tuple[np.ndarray, np.ndarray] | None = None
    # (m,) bool: readings taken before the control sample, see `control_period.star_state`; None: there are none
    early: np.ndarray | None = None


class Memory(NamedTuple):
    """Memory of `Sensors` between samples."""

    keys: tuple[draws.Key, ...] | None  # random keys of each noise and of the bias drift; None without noise
    noise: tuple[Array, ...]  # noise of the next sample
    bias: Array | None  # (3,) gyro bias [rad/s]; None without bias
    estimate: Any  # `Estimate`; None without a filter
    rate: Any  # (3,) last measured rate [rad/s]; None without a filter


class SpacecraftSensors(Sensor):
    """Base class of attitude sensors with a gyro. Derived classes declare the fields, each described there."""

    rate_bias: Any
    bias_rate: Any
    given_bias: Leaf | None
    rate_scale: Leaf | None
    outage: Leaf | None
    noise_free: bool

    @property
    def noises(self) -> list[tuple[str, Leaf, int]]:
        """Return the stream, the 1 sigma and the number of components of each white noise, the gyro's last."""
        raise NotImplementedError

    def keys(self, seed: WholeNumber, trial: WholeNumber) -> tuple[draws.Key, ...] | None:
        """Return the random keys of a trial for each of `noises` and for the bias drift, or None without noise."""
        if self.noise_free:
            return None
        return tuple(draws.streams(seed, trial, [*(name for name, _, _ in self.noises), BIAS_WALK]))

    def noise(self, keys: tuple[draws.Key, ...] | None, sample: Int[Array, ""]) -> tuple[Array, ...]:
        """Return the noise of each of `noises` at one sample, in its unit; the gyro noise is (3,) [rad/s]."""
        if keys is None:
            return tuple(jnp.zeros(size) for _, _, size in self.noises)
        each = zip(self.noises, keys, strict=False)
        return tuple(sigma * draws.normals(key, size, sample) for (_, sigma, size), key in each)

    def first_bias(self, seed: WholeNumber, trial: WholeNumber) -> Float[Array, "3"]:
        """Return the gyro bias at the first sample, (3,) [rad/s]."""
        if self.given_bias is not None:
            return self.given_bias
        if self.rate_bias is None:
            return jnp.zeros(3)
        return self.rate_bias * draws.normals(draws.stream(seed, trial, RATE_BIAS), 3)

    def trial_constants(self, seed: WholeNumber, trial: WholeNumber) -> dict[str, Array]:
        """Return the gyro bias at the first sample [rad/s]."""
        if self.rate_bias is None and self.given_bias is None:
            return {}
        bias = self.first_bias(seed, trial)
        return {f"{RATE_BIAS}_{k + 1}": bias[k] for k in range(3)}

    def filter_errors(self, seed: WholeNumber, trial: WholeNumber) -> Float[Array, "6"]:
        """Return standard normal numbers for the initial errors of the filter (6,), or zeros without noise."""
        return jnp.zeros(6) if self.noise_free else draws.normals(draws.stream(seed, trial, FILTER_START), 6)

    def gyro_sample(
        self, memory: PyTree, w: Float[Array, "3"], noise: Float[Array, "3"], now: Ticks, dt: Scalar
    ) -> tuple[Float[Array, "3"], Array | None]:
        """Return the gyro sample (3,) [rad/s], and the gyro bias (3,) [rad/s] or None.

        Args:
            memory: memory of the sensors, with `keys` and `bias`.
            w: true body rate (3,) [rad/s].
            noise: noise of the sample (3,) [rad/s].
            now: the control period that the sample begins.
            dt: length of the period that ends at the sample [s].
        """
        bias = memory.bias
        if self.bias_rate is not None and memory.keys is not None:
            bias = bias + self.bias_rate * dt * draws.normals(memory.keys[-1], 3, now.sample)
        rate = (w if self.rate_scale is None else self.rate_scale * w) + noise
        return rate if bias is None else rate + bias, bias

    def gyro_rows(self) -> np.ndarray:
        """Return the derivatives (3, 9) of a gyro sample by rotation, rate and gyro bias."""
        scale = np.ones(3) if self.rate_scale is None else np.asarray(self.rate_scale)
        return np.hstack([np.zeros((3, 3)), np.diag(scale), np.eye(3)])

    def outside_outage(self, weight: Scalar, t: Scalar) -> Scalar:
        """Return the weight of a reading taken at t [s], or 0 in the outage."""
        if self.outage is None:
            return weight
        return jnp.where((t >= self.outage[0]) & (t < self.outage[1]), 0.0, weight)


@pytree
@dataclass(frozen=True)
class Sensors(SpacecraftSensors):
    """Star tracker [rad] and gyro [rad/s] sampled once a period, white noise, independent per axis and sample.

    Without a filter the law receives the samples. With a filter it receives the filter's attitude, and the gyro's rate
    less the estimated bias.
    """

    attitude_noise: Leaf  # 1 sigma of the small rotation about each body axis [rad]
    rate_noise: Leaf  # 1 sigma of a gyro sample [rad/s]
    rate_bias: Leaf | None = None  # 1 sigma of the initial bias [rad/s]
    bias_rate: Leaf | None = None  # 1 sigma of the bias's change per second of a period: walk / sqrt(period) [rad/s^2]
    filter: AttitudeFilter | None = None
    every: int = field(default=1, metadata={"static": True})  # periods between star tracker samples, with a filter
    given_bias: Leaf | None = None  # (3,) bias at the first sample, if it is not random [rad/s]
    # hardware errors: differences between the true sensors and those that the flight software knows
    misalignment: Leaf | None = None  # (3,) rotation vector of the star tracker in the body [rad]
    rate_scale: Leaf | None = None  # (3,) ratio of gyro reading to true rate [-]
    outage: Leaf | None = None  # (2,) start and end of an outage of the star tracker [s]; with a filter
    own_times: SampleTimes | None = None  # sample times of a star tracker with its own clock, with a filter
    noise_free: bool = field(default=False, metadata={"static": True})  # whether no noise is generated

    def star_attitude(self, q: Float[Array, "4"]) -> Float[Array, "4"]:
        """Return the true attitude (4,) of the misaligned star tracker for a body attitude, both unit quaternions."""
        if self.misalignment is None:
            return q
        return attitude.multiply(q, attitude.from_rotation_vector(self.misalignment))

    def with_bandwidth(self, bandwidth: Leaf | float, period: Leaf) -> "Sensors":
        """Return the sensors with a filter of another bandwidth [rad/s], for a control period [s]."""
        bias_walk = 0.0 if self.bias_rate is None else self.bias_rate * guards.sqrt(period)
        noises = self.attitude_noise, self.rate_noise, bias_walk
        if self.own_times is None:
            return replace(self, filter=attitude_filter(bandwidth, *noises, period, self.every))
        times = self.own_times
        return replace(self, filter=filter_between_samples(bandwidth, *noises, period, times.interval, times.pattern))

    def bandwidth(self, period: Leaf) -> Array:
        """Return the bandwidth of the filter [rad/s] for a control period [s]."""
        assert self.filter is not None
        interval = period * self.every if self.own_times is None else self.own_times.interval
        return -0.5 * jnp.log1p(-self.filter.attitude_gain) / interval

    @property
    def noises(self) -> list[tuple[str, Leaf, int]]:
        """Return the noise of the attitude [rad] and of the gyro [rad/s]; see `SpacecraftSensors.noises`."""
        return [(ATTITUDE_NOISE, self.attitude_noise, 3), (RATE_NOISE, self.rate_noise, 3)]

    def begin(self, seed: WholeNumber, trial: WholeNumber, x0: AttitudeState, now: Ticks) -> Memory:
        """Return the memory before the first sample; see `Sensor.begin`."""
        keys, bias, estimate = self.keys(seed, trial), None, None
        if any(source is not None for source in (self.rate_bias, self.bias_rate, self.given_bias)):
            bias = self.first_bias(seed, trial)
        if self.filter is not None:
            true_bias, errors = jnp.zeros(3) if bias is None else bias, self.filter_errors(seed, trial)
            estimate = self.filter.begin(self.star_attitude(x0.q), true_bias, errors, now.sample, now.noise_weight)
        return Memory(keys, self.noise(keys, now.sample), bias, estimate, None if estimate is None else x0.w)

    def sample(
        self, memory: Memory, x: AttitudeState, now: Ticks, dt: Scalar, star_x: AttitudeState | None = None
    ) -> tuple[AttitudeState, Memory]:
        """Return the attitude and rate that star tracker and gyro measure, and the memory."""
        noise_next = self.noise(memory.keys, now.sample + 1)
        turn, shift = guards.lerp(now.noise_weight, memory.noise, noise_next)
        w, bias = self.gyro_sample(memory, x.w, shift, now, dt)
        q = self.star_attitude(x.q if star_x is None else star_x.q)
        if not self.noise_free:
            q = attitude.multiply(q, attitude.from_rotation_vector(turn))
        return AttitudeState(q, w), memory._replace(noise=noise_next, bias=bias)

    def star_weight(self, now: Ticks) -> Scalar:
        """Return the weight of the star tracker measurement at this sample; 0 if there is none."""
        due, t = now.sample % self.every == 0, now.t
        if self.own_times is not None:
            due, t = self.own_times.is_reading_due(now.sample), now.t - self.own_times.delivered_age(now.sample)
        return self.outside_outage(jnp.where(due, now.noise_weight, 0.0), t)

    def newest_reading_age(self, sample: Int[Array, ""], dt: Scalar) -> Scalar | None:
        """Return the age of the star tracker's newest measurement at a sample [s], at most dt [s].

        dt is the length of the period before the sample. The result is None for a star tracker without its own clock.
        """
        return None if self.own_times is None else self.own_times.newest_reading_age(sample, dt)

    def inputs(
        self, memory: Memory, x: AttitudeState, now: Ticks, dt: Scalar, star_x: AttitudeState | None = None
    ) -> tuple[dict[str, Array], Memory]:
        """Return the inputs of exported C. A filter also needs a flag for a valid attitude, and its age [s]."""
        named, memory = super().inputs(memory, x, now, dt, star_x)
        if self.filter is not None:
            age = self.newest_reading_age(now.sample, dt)
            named["attitude_valid"] = (self.star_weight(now) > 0.0).astype(float)
            named |= {} if age is None else {"attitude_age": age}
        return named, memory

    def filter_state(self, memory: Memory) -> dict[str, Array]:
        """Return the filter's attitude and bias, and the last gyro sample [rad/s], by their names in exported C."""
        if memory.estimate is None:
            return {}
        return {"attitude": memory.estimate.q, "bias": memory.estimate.bias, "gyro": memory.rate}

    def measure(
        self, memory: Memory, x: AttitudeState, now: Ticks, dt: Scalar, star_x: AttitudeState | None = None
    ) -> tuple[AttitudeState, Memory]:
        """Return attitude and rate for the law, and the memory."""
        read, memory_next = self.sample(memory, x, now, dt, star_x)
        if self.filter is None:
            return read, memory_next
        old, rate, weight = memory.estimate, memory.rate, self.star_weight(now)
        if self.own_times is None:
            estimate = self.filter.correct(self.filter.propagate(old, rate, read.w, dt), read.q, weight)
        else:
            # if no star tracker sample is due, its age is set to the length of the period, as in exported C
            age = jnp.where(weight > 0.0, self.own_times.newest_reading_age(now.sample, dt), dt)
            estimate = self.filter.correct_between(old, rate, read.w, dt, read.q, age, weight)
        return AttitudeState(estimate.q, read.w - estimate.bias), memory_next._replace(estimate=estimate, rate=read.w)

    def without_noise(self) -> "Sensors":
        """Return the sensors without noise and bias; the filter gains are unchanged."""
        exact_filter = self.filter and replace(self.filter, spread=0.0 * self.filter.spread)
        zero = jnp.zeros_like(jnp.asarray(self.attitude_noise))
        noiseless = replace(self, attitude_noise=zero, rate_noise=zero, filter=exact_filter, noise_free=True)
        return replace(noiseless, rate_bias=None, bias_rate=None, given_bias=None)

    def retract(self, memory: Memory, by: Float[Array, " n"]) -> Memory:
        """Return the memory at local coordinates (n,) relative to another memory.

        The coordinates are the rotation of the filter's attitude [rad], the bias and the rate [rad/s].
        """
        if memory.estimate is None:
            return memory
        turn, bias, rate = by.reshape(3, 3)
        q = attitude.multiply(memory.estimate.q, attitude.from_rotation_vector(turn))
        return memory._replace(estimate=Estimate(q, memory.estimate.bias + bias), rate=memory.rate + rate)

    def local_coordinates(self, memory: Memory, other: Memory) -> Float[Array, " n"]:
        """Return local coordinates (n,) [rad, rad/s] of another memory, to first order: the inverse of `retract`."""
        if memory.estimate is None or other.estimate is None:
            return jnp.zeros(0)
        turn = attitude.small_rotation(memory.estimate.q, other.estimate.q)
        return jnp.concatenate([turn, other.estimate.bias - memory.estimate.bias, other.rate - memory.rate])

    def measurement_model(self, sample: int = 0, fraction: float = 1.0) -> MeasurementModel:
        """Return the linear measurement model: rotation [rad] and rate with bias [rad/s], at each control sample.

        Args:
            sample: number of the first control sample.
            fraction: length of a partial first period as a fraction of a full one, else 1.
        """
        star, gyro = (float(v) for v in (self.attitude_noise, self.rate_noise))
        bias, drift = (0.0 if v is None else float(v) for v in (self.rate_bias, self.bias_rate))
        start = between_samples = None
        if self.filter is not None:
            factor = np.asarray(self.filter.first_spread(sample, jnp.asarray(fraction)))
            start = ATTITUDE_AND_BIAS, np.kron(factor, np.eye(3))
        if self.own_times is not None:
            between_samples = np.repeat([True, False], 3)
        rows, noise = np.vstack([np.eye(3, 9), self.gyro_rows()]), np.repeat([star, gyro], 3)
        return MeasurementModel(rows, noise, np.full(3, bias), np.full(3, drift), start, between_samples)

    def available(self, now: Ticks) -> np.ndarray:
        """Return whether each reading is available at each control sample, (N, 6) bool."""
        star = np.asarray(jax.vmap(self.star_weight)(now)) > 0.0
        return np.repeat(np.stack([star, np.ones_like(star)], axis=1), 3, axis=1)

    def at_control_samples(self) -> "Sensors":
        """Return sensors whose star tracker samples at every control sample, if it has its own clock.

        The weight of a measurement is multiplied by period / interval, and its noise is increased, so that the mean
        information per time is the same.
        """
        if self.own_times is None or self.filter is None:
            return self
        fraction, old = self.own_times.period / self.own_times.interval, self.filter
        weaker = replace(old, attitude_gain=fraction * old.attitude_gain, bias_gain=fraction * old.bias_gain)
        return replace(self, attitude_noise=self.attitude_noise / jnp.sqrt(fraction), filter=weaker, own_times=None)


@pytree
@dataclass(frozen=True)
class StateSensor(Sensor):
    """All states sampled once a period, white noise in the states' own units, independent per state and sample."""

    sigma: Leaf  # (n,) 1 sigma of each state

    def key(self, seed: WholeNumber, trial: WholeNumber) -> draws.Key:
        """Return the random key of a trial."""
        return draws.stream(seed, trial, STATE_NOISE)

    def noise(self, key: draws.Key, sample: Int[Array, ""]) -> Float[Array, " n"]:
        """Return the noise of one sample, (n,)."""
        return self.sigma * draws.normals(key, self.sigma.shape[-1], sample)

    def begin(self, seed: WholeNumber, trial: WholeNumber, x0: Float[Array, " n"], now: Ticks) -> tuple:
        """Return the memory before the first sample; see `Sensor.begin`."""
        key = self.key(seed, trial)
        return key, self.noise(key, now.sample)

    def measure(
        self, memory: tuple, x: Float[Array, " n"], now: Ticks, dt: Scalar, star_x: None = None
    ) -> tuple[Float[Array, " n"], tuple]:
        """Return the measured states, and the memory."""
        key, noise = memory
        noise_next = self.noise(key, now.sample + 1)
        return x + guards.lerp(now.noise_weight, noise, noise_next), (key, noise_next)

    def without_noise(self) -> "StateSensor":
        """Return the sensor without noise."""
        return replace(self, sigma=0.0 * self.sigma)

    def measurement_model(self, sample: int = 0, fraction: float = 1.0) -> MeasurementModel:
        """Return the linear measurement model: every state, at each control sample."""
        sigma = np.asarray(self.sigma)
        return MeasurementModel(np.eye(sigma.size), sigma, np.zeros(0), np.zeros(0))

    def available(self, now: Ticks) -> np.ndarray:
        """Return whether each reading is available at each control sample, (N, n) bool."""
        return np.ones((len(now.t), self.sigma.shape[-1]), bool)
