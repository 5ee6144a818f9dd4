"""Sensors: star tracker and gyro, raw or through a gyro-propagated attitude filter; a chain's states.

White noise is 1 sigma per sample, density / sqrt(period) (IEEE Std 952): attitudes in rad, rates in rad/s, a chain's
states in the states' own units. A sensor has a memory (noise of the sample, bias, estimate) that the rollout carries;
its noise belongs to (seed, trial, sample). In the partial first period of the anchored clock all effects of a sample
are weighted by the period's share, so that nothing jumps where that period vanishes.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ptsmc_jax.devices.attitude_filter import AttitudeFilter, Estimate, attitude_filter
from ptsmc_jax.devices.star_times import StarTimes, filter_between
from ptsmc_jax.devices.ticks import Ticks
from ptsmc_jax.numerics import attitude, draws, guards
from ptsmc_jax.numerics.draws import WholeNumber
from ptsmc_jax.numerics.pytrees import Leaf, Scalar, pytree
from ptsmc_jax.plants.rigid_body import AttitudeState

ATTITUDE_NOISE, RATE_NOISE, STATE_NOISE = "attitude_noise", "rate_noise", "state_noise"
RATE_BIAS, BIAS_WALK, FILTER_START = "rate_bias", "rate_bias_walk", "filter_start"


class Sensor(ABC):
    """A sensor, as the rollout, linear theory and campaigns ask for it; all numbers in SI units [rad, rad/s].

    A true state x is what sensors can see of it, `Plant.visible`.
    """

    perfect: ClassVar[bool] = False  # the law sees the true state

    @abstractmethod
    def begin(self, seed: WholeNumber, trial: WholeNumber, x0: Any, now: Ticks) -> Any:
        """Memory before the first sample of positive length [s], which is now; x0: true state."""

    @abstractmethod
    def measure(self, memory: Any, x: Any, now: Ticks, dt: Scalar, star_x: Any = None) -> tuple[Any, Any]:
        """The measured state, as the law uses it, and the memory.

        Args:
            memory: from `begin`, or from the sample before.
            x: true state.
            now: the control period that the sample begins.
            dt: length of the period just ended [s].
            star_x: true state when a star tracker with times of its own sampled in that period; None without one.
        """

    def sample(self, memory: Any, x: Any, now: Ticks, dt: Scalar, star_x: Any = None) -> tuple[Any, Any]:
        """The state as it is read before any filter, and the memory; arguments as in `measure`, dt in [s]."""
        return self.measure(memory, x, now, dt)

    def inputs(self, memory: Any, x: Any, now: Ticks, dt: Scalar, star_x: Any = None) -> tuple[dict[str, Array], Any]:
        """Return what exported C gets from the sensors at a sample, by the names of its inputs, and the memory.

        Arguments are those of `measure`.
        """
        read, memory = self.sample(memory, x, now, dt, star_x)
        named = {"attitude": read.q, "rate": read.w} if isinstance(read, AttitudeState) else {"x": read}
        return named, memory

    def remembered(self, memory: Any) -> dict[str, Array]:
        """Return the estimates of a filter as exported C remembers them, by the names of its state."""
        return {}

    @abstractmethod
    def quiet(self) -> Any:
        """The sensor without noise."""

    def in_step(self) -> Any:
        """The sensor as if all its samples were taken at control samples, for linear theory; see `Sensors`."""
        return self

    def taken_ago(self, sample: Array, dt: Scalar) -> Any:
        """Return how long before a control sample sensors with their own clock took their newest reading [s].

        Args:
            sample: number of the control sample.
            dt: length of the control period before it [s], the largest value.

        Returns:
            A pytree of times. `measure` gets the true states at these times, in the same pytree, as `star_x`. None: all
            sensors read at control samples.
        """
        return None

    def drawn(self, seed: WholeNumber, trial: WholeNumber) -> dict[str, Array]:
        """Numbers that the sensor draws once a trial, such as a bias [rad/s], by the names of a row's columns."""
        return {}


@pytree
@dataclass(frozen=True)
class PerfectSensors(Sensor):
    """No sensors: the law sees the true state."""

    perfect: ClassVar[bool] = True

    def begin(self, seed: WholeNumber, trial: WholeNumber, x0: Any, now: Ticks) -> None:
        """No memory."""

    def measure(self, memory: None, x: Any, now: Ticks, dt: Scalar, star_x: None = None) -> tuple[Any, None]:
        """Return the true state; dt in [s]."""
        return x, None

    def quiet(self) -> "PerfectSensors":
        """Return the same."""
        return self


class Reading(NamedTuple):
    """A sensor to first order, for `error_floor`: its readings of a state near the true one.

    Of (x, own): local coordinates (n,) of the plant, see `Plant.retract`, then the sensor's own states, a gyro's bias.
    """

    rows: np.ndarray  # (m, n + own) of the readings by these coordinates
    noise: np.ndarray  # (m,) 1 sigma of each reading, in its unit
    own: np.ndarray  # (own,) 1 sigma of its own states at t = 0
    own_drift: np.ndarray  # (own,) 1 sigma of their change in a control period, per second
    # rows (k, n + own) of what is known at t = 0, and a factor (k, k) of its covariance
    start: tuple[np.ndarray, np.ndarray] | None = None
    early: np.ndarray | None = None  # (m,) bool: readings at the time of `control_period.star_state`; None: no reading


class Memory(NamedTuple):
    """Memory of `Sensors` between samples."""

    keys: tuple[draws.Key, draws.Key, draws.Key] | None  # see `Sensors.keys`; None: without noise
    noise: tuple[Array, Array]  # of the next sample
    bias: Any  # (3,) of the gyro [rad/s]; None without one
    estimate: Any  # Estimate; None without a filter
    rate: Any  # (3,) as last measured [rad/s]; None without a filter


@pytree
@dataclass(frozen=True)
class Sensors(Sensor):
    """Star tracker [rad] and gyro [rad/s] sampled once a period, white noise, independent per axis and sample.

    Without a filter the law sees the samples themselves; with one, its attitude and the gyro's rate less its bias.
    """

    attitude_noise: Leaf  # 1 sigma of the small rotation about each body axis [rad]
    rate_noise: Leaf  # 1 sigma [rad/s]
    rate_bias: Leaf | None = None  # 1 sigma, constant over a run [rad/s]
    bias_rate: Leaf | None = None  # 1 sigma of the bias's change per second of a period: walk / sqrt(period) [rad/s^2]
    filter: AttitudeFilter | None = None
    every: int = field(default=1, metadata={"static": True})  # periods between star tracker samples, with a filter
    given_bias: Leaf | None = None  # (3,) at the first sample, where it is not drawn [rad/s]
    # misfits: how the true sensors differ from those that the flight software knows
    misalignment: Leaf | None = None  # (3,) rotation vector of the star tracker in the body [rad]
    rate_scale: Leaf | None = None  # (3,) reading of the gyro over the true rate [-]
    outage: Leaf | None = None  # (2,) start and end of the time without star tracker samples [s]; with a filter
    own_times: StarTimes | None = None  # of the star tracker where `every` is no whole number, with a filter
    noise_free: bool = field(default=False, metadata={"static": True})  # no random number is computed, see `quiet`

    def star_attitude(self, q: Float[Array, "4"]) -> Float[Array, "4"]:
        """The attitude (4,) of the star tracker, a unit quaternion, for that of the body."""
        if self.misalignment is None:
            return q
        return attitude.multiply(q, attitude.from_rotation_vector(self.misalignment))

    def with_bandwidth(self, bandwidth: Any, period: Any) -> "Sensors":
        """The sensors with a filter of another bandwidth [rad/s]; period: of control [s]."""
        bias_walk = 0.0 if self.bias_rate is None else self.bias_rate * guards.sqrt(period)
        noises = self.attitude_noise, self.rate_noise, bias_walk
        if self.own_times is None:
            return replace(self, filter=attitude_filter(bandwidth, *noises, period, self.every))
        times = self.own_times
        return replace(self, filter=filter_between(bandwidth, *noises, period, times.interval, times.pattern))

    def bandwidth(self, period: Any) -> Any:
        """Bandwidth of the filter [rad/s]."""
        assert self.filter is not None
        interval = period * self.every if self.own_times is None else self.own_times.interval
        return -0.5 * jnp.log1p(-self.filter.attitude_gain) / interval

    def keys(self, seed: WholeNumber, trial: WholeNumber) -> tuple[draws.Key, draws.Key, draws.Key] | None:
        """Keys of a trial's noise: attitude, rate, change of the bias; None without noise."""
        if self.noise_free:
            return None
        attitude, rate, walk = draws.streams(seed, trial, (ATTITUDE_NOISE, RATE_NOISE, BIAS_WALK))
        return attitude, rate, walk

    def noise(self, keys: tuple | None, sample: Int[Array, ""]) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
        """Attitude [rad] and rate [rad/s] noise of one sample, (3,) each."""
        if keys is None:
            return jnp.zeros(3), jnp.zeros(3)
        return (
            self.attitude_noise * draws.normals(keys[0], 3, sample),
            self.rate_noise * draws.normals(keys[1], 3, sample),
        )

    def first_bias(self, seed: WholeNumber, trial: WholeNumber) -> Float[Array, "3"]:
        """Bias of the gyro at the first sample, (3,) [rad/s]."""
        if self.given_bias is not None:
            return self.given_bias
        if self.rate_bias is None:
            return jnp.zeros(3)
        return self.rate_bias * draws.normals(draws.stream(seed, trial, RATE_BIAS), 3)

    def begin(self, seed: WholeNumber, trial: WholeNumber, x0: AttitudeState, now: Ticks) -> Memory:
        """Memory before the first sample of positive length, which is now."""
        keys, bias, estimate = self.keys(seed, trial), None, None
        if any(source is not None for source in (self.rate_bias, self.bias_rate, self.given_bias)):
            bias = self.first_bias(seed, trial)
        if self.filter is not None:
            drawn = not self.noise_free
            normals = draws.normals(draws.stream(seed, trial, FILTER_START), 6) if drawn else jnp.zeros(6)
            true_bias = jnp.zeros(3) if bias is None else bias
            estimate = self.filter.begin(self.star_attitude(x0.q), true_bias, normals, now.sample, now.noise_weight)
        return Memory(keys, self.noise(keys, now.sample), bias, estimate, None if estimate is None else x0.w)

    def sample(
        self, memory: Memory, x: AttitudeState, now: Ticks, dt: Scalar, star_x: AttitudeState | None = None
    ) -> tuple[AttitudeState, Memory]:
        """Attitude and rate as star tracker and gyro measure them, and the memory."""
        noise_next = self.noise(memory.keys, now.sample + 1)
        turn, shift = guards.lerp(now.noise_weight, memory.noise, noise_next)
        bias = memory.bias
        if self.bias_rate is not None and memory.keys is not None:
            bias = bias + self.bias_rate * dt * draws.normals(memory.keys[2], 3, now.sample)
        w = jnp.add(x.w if self.rate_scale is None else self.rate_scale * x.w, shift)
        if bias is not None:
            w = w + bias
        q = self.star_attitude(x.q if star_x is None else star_x.q)
        if not self.noise_free:
            q = attitude.multiply(q, attitude.from_rotation_vector(turn))
        return AttitudeState(q, w), memory._replace(noise=noise_next, bias=bias)

    def star_weight(self, now: Ticks) -> Scalar:
        """The weight of a star tracker measurement at this sample; 0: there is none."""
        due, t = now.sample % self.every == 0, now.t
        if self.own_times is not None:
            due, t = self.own_times.due(now.sample), now.t - self.own_times.age(now.sample)
        weight = jnp.where(due, now.noise_weight, 0.0)
        if self.outage is not None:
            weight = jnp.where((t >= self.outage[0]) & (t < self.outage[1]), 0.0, weight)
        return weight

    def taken_ago(self, sample: Int[Array, ""], dt: Scalar) -> Scalar | None:
        """Return the age of the star tracker's measurement at a sample [s]; dt: length of the period before it [s].

        Older ones, from before t = 0 or used already, count as old as the period. None: it has no times of its own.
        """
        return None if self.own_times is None else jnp.minimum(self.own_times.age(sample), dt)

    def inputs(
        self, memory: Memory, x: AttitudeState, now: Ticks, dt: Scalar, star_x: AttitudeState | None = None
    ) -> tuple[dict[str, Array], Memory]:
        """Return the inputs of exported C, with whether there is an attitude, and its age [s], for the filter."""
        named, memory = super().inputs(memory, x, now, dt, star_x)
        if self.filter is not None:
            age = self.taken_ago(now.sample, dt)
            named["attitude_valid"] = (self.star_weight(now) > 0.0).astype(float)
            named |= {} if age is None else {"attitude_age": age}
        return named, memory

    def remembered(self, memory: Memory) -> dict[str, Array]:
        """Return attitude and bias by the filter, and the last gyro sample [rad/s], as exported C has them."""
        if memory.estimate is None:
            return {}
        return {"attitude": memory.estimate.q, "bias": memory.estimate.bias, "gyro": memory.rate}

    def measure(
        self, memory: Memory, x: AttitudeState, now: Ticks, dt: Scalar, star_x: AttitudeState | None = None
    ) -> tuple[AttitudeState, Memory]:
        """Attitude and rate for the law: the samples, or the filter's attitude and the rate less its bias."""
        read, memory_next = self.sample(memory, x, now, dt, star_x)
        if self.filter is None:
            return read, memory_next
        old, rate, weight = memory.estimate, memory.rate, self.star_weight(now)
        if self.own_times is None:
            estimate = self.filter.correct(self.filter.propagate(old, rate, read.w, dt), read.q, weight)
        else:
            # where there is none, all of the period lies behind it, as the C has it
            age = jnp.where(weight > 0.0, jnp.minimum(self.own_times.age(now.sample), dt), dt)
            estimate = self.filter.correct_between(old, rate, read.w, dt, read.q, age, weight)
        return AttitudeState(estimate.q, read.w - estimate.bias), memory_next._replace(estimate=estimate, rate=read.w)

    def quiet(self) -> "Sensors":
        """The sensors without noise and bias; the filter keeps its gains."""
        exact = self.filter and replace(self.filter, spread=0.0 * self.filter.spread)
        zero = jnp.zeros_like(jnp.asarray(self.attitude_noise))
        quiet = replace(self, attitude_noise=zero, rate_noise=zero, filter=exact, noise_free=True)
        return replace(quiet, rate_bias=None, bias_rate=None, given_bias=None)

    def drawn(self, seed: WholeNumber, trial: WholeNumber) -> dict[str, Array]:
        """Bias of the gyro at the first sample [rad/s]."""
        if self.rate_bias is None and self.given_bias is None:
            return {}
        bias = self.first_bias(seed, trial)
        return {f"{RATE_BIAS}_{k + 1}": bias[k] for k in range(3)}

    def retract(self, memory: Memory, by: Float[Array, " n"]) -> Memory:
        """The memory near another one at local coordinates: rotation of the filter's attitude [rad], bias and rate."""
        if memory.estimate is None:
            return memory
        turn, bias, rate = by.reshape(3, 3)
        q = attitude.multiply(memory.estimate.q, attitude.from_rotation_vector(turn))
        return memory._replace(estimate=Estimate(q, memory.estimate.bias + bias), rate=memory.rate + rate)

    def local_coordinates(self, memory: Memory, other: Memory) -> Float[Array, " n"]:
        """Local coordinates (n,) [rad, rad/s] of a memory near another one, to first order."""
        if memory.estimate is None or other.estimate is None:
            return jnp.zeros(0)
        turn = 2.0 * attitude.multiply(attitude.conjugate(memory.estimate.q), other.estimate.q)[:3]
        return jnp.concatenate([turn, other.estimate.bias - memory.estimate.bias, other.rate - memory.rate])

    def reading(self, sample: int = 0, share: float = 1.0) -> Reading:
        """Rotation [rad] and rate with its bias [rad/s], at each control sample.

        sample: number of the first one; share: its weight, see `AttitudeFilter.begin`.
        """
        one, zero = np.eye(3), np.zeros((3, 3))
        star, gyro = (float(v) for v in (self.attitude_noise, self.rate_noise))
        bias, drift = (0.0 if v is None else float(v) for v in (self.rate_bias, self.bias_rate))
        scale = one if self.rate_scale is None else np.diag(np.asarray(self.rate_scale))
        start = early = None
        if self.filter is not None:
            root = np.asarray(self.filter.first_spread(sample, jnp.asarray(share)))
            start = np.block([[one, zero, zero], [zero, zero, one]]), np.kron(root, one)
        if self.own_times is not None:
            early = np.repeat([True, False], 3)
        rows, noise = np.block([[one, zero, zero], [zero, scale, one]]), np.repeat([star, gyro], 3)
        return Reading(rows, noise, np.full(3, bias), np.full(3, drift), start, early)

    def available(self, now: Ticks) -> np.ndarray:
        """Whether control samples have each of the readings, (N, 6) bool."""
        star = np.asarray(jax.vmap(self.star_weight)(now)) > 0.0
        return np.repeat(np.stack([star, np.ones_like(star)], axis=1), 3, axis=1)

    def in_step(self) -> "Sensors":
        """The sensors with a star tracker of weaker measurements at every control sample, where it has its own times.

        With the share of a sample in a period as weight, and white noise in proportion, they tell as much in the mean.
        """
        if self.own_times is None or self.filter is None:
            return self
        share, old = self.own_times.period / self.own_times.interval, self.filter
        weaker = replace(old, attitude_gain=share * old.attitude_gain, bias_gain=share * old.bias_gain)
        return replace(self, attitude_noise=self.attitude_noise / jnp.sqrt(share), filter=weaker, own_times=None)


@pytree
@dataclass(frozen=True)
class StateSensor(Sensor):
    """All states sampled once a period, white noise in the states' own units, independent per state and sample."""

    sigma: Leaf  # (n,) 1 sigma of each state

    def key(self, seed: WholeNumber, trial: WholeNumber) -> draws.Key:
        """Key of a trial's noise."""
        return draws.stream(seed, trial, STATE_NOISE)

    def noise(self, key: draws.Key, sample: Int[Array, ""]) -> Float[Array, " n"]:
        """Noise of one sample, (n,)."""
        return self.sigma * draws.normals(key, self.sigma.shape[-1], sample)

    def begin(self, seed: WholeNumber, trial: WholeNumber, x0: Float[Array, " n"], now: Ticks) -> tuple:
        """Memory before the first sample of positive length, which is now."""
        key = self.key(seed, trial)
        return key, self.noise(key, now.sample)

    def measure(
        self, memory: tuple, x: Float[Array, " n"], now: Ticks, dt: Scalar, star_x: None = None
    ) -> tuple[Float[Array, " n"], tuple]:
        """The states as measured, and the memory."""
        key, noise = memory
        noise_next = self.noise(key, now.sample + 1)
        return x + guards.lerp(now.noise_weight, noise, noise_next), (key, noise_next)

    def quiet(self) -> "StateSensor":
        """The sensor without noise."""
        return replace(self, sigma=0.0 * self.sigma)

    def reading(self, sample: int = 0, share: float = 1.0) -> Reading:
        """Every state, at each control sample."""
        sigma = np.asarray(self.sigma)
        return Reading(np.eye(sigma.size), sigma, np.zeros(0), np.zeros(0))

    def available(self, now: Ticks) -> np.ndarray:
        """Whether control samples have each of the readings, (N, n) bool."""
        return np.ones((len(now.t), self.sigma.shape[-1]), bool)
