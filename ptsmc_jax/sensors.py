"""What the law sees: star tracker and gyro, raw or through a gyro-propagated attitude filter; a chain's states.

White noise is 1 sigma per sample, density / sqrt(period) (IEEE Std 952): attitudes in rad, rates in rad/s, a chain's
states in the states' own units. A sensor has a memory (noise of the sample, bias, estimate) that the rollout carries;
its noise belongs to (seed, trial, sample). In the partial first period of the anchored clock everything a sample does
is weighted by the period's share, so that nothing jumps where that period vanishes.
"""

from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ptsmc_jax import attitude, draws, numerics, programs
from ptsmc_jax.clock import Ticks
from ptsmc_jax.draws import Whole
from ptsmc_jax.numerics import Leaf, pytree
from ptsmc_jax.plants import AttitudeState

Scalar = Float[Array, ""]
ATTITUDE_NOISE, RATE_NOISE, STATE_NOISE = "attitude_noise", "rate_noise", "state_noise"
RATE_BIAS, BIAS_WALK, FILTER_START = "rate_bias", "rate_bias_walk", "filter_start"


class Sensor(Protocol):
    """What the rollout asks of a sensor."""

    def begin(self, seed: Whole, trial: Whole, x0: Any, now: Ticks) -> Any:
        """Memory before the first sample of positive length, which is now."""
        ...

    def measure(self, memory: Any, x: Any, now: Ticks, dt: Scalar) -> tuple[Any, Any]:
        """The state as the law sees it, and the memory; dt: length of the period just ended [s]."""
        ...


class Reading(NamedTuple):
    """What a sensor says of a state near the true one, to first order, for `floor`.

    Of (x, own): the plant's local coordinates (n,), see `Plant.moved`, then states of the sensor's own, a gyro's bias.
    """

    rows: np.ndarray  # (m, n + own) what is read of them
    noise: np.ndarray  # (m,) 1 sigma of each reading, in its unit
    every: np.ndarray  # (m,) control periods from one reading to the next
    own: np.ndarray  # (own,) 1 sigma of its own states at t = 0
    own_drift: np.ndarray  # (own,) 1 sigma of their change in a control period, per second
    start: tuple[np.ndarray, np.ndarray] | None = None  # rows (k, n + own) and covariance (k, k) of what t = 0 knows


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

        sample: number of the first sample, before which this is; where its share is below 1, it is partly before the
        next one.
        """
        every = self.spread.shape[0]
        root = numerics.lerp(share, self.spread[(sample - 1) % every], self.spread[sample % every])
        turn, drift = root @ normals.reshape(2, 3)
        return Estimate(attitude.multiply(q, attitude.from_rotation_vector(turn)), bias + drift)

    def propagate(self, old: Estimate, w: Float[Array, "3"], w_next: Float[Array, "3"], dt: Scalar) -> Estimate:
        """The estimate dt [s] later, from the rates measured at both ends [rad/s], coning to second order included."""
        a, b = w - old.bias, w_next - old.bias
        turn = dt / 2 * (a + b) + dt * dt / 12 * jnp.cross(a, b)
        return Estimate(attitude.multiply(old.q, attitude.from_rotation_vector(turn)), old.bias)

    def correct(self, old: Estimate, measured: Float[Array, "4"], weight: Scalar) -> Estimate:
        """The estimate after a star tracker sample [-] that counts with this weight (0: none)."""
        off = attitude.multiply(attitude.conjugate(old.q), measured)
        residual = jnp.where(off[3] < 0.0, -2.0, 2.0) * off[:3]
        turn = self.attitude_gain * weight * residual
        q = attitude.normalise(attitude.multiply(old.q, attitude.from_rotation_vector(turn)))
        return Estimate(q, old.bias - self.bias_gain * weight * residual)


def filter_gains(bandwidth: Any, interval: Any) -> tuple[Any, Any]:
    """Gains (attitude [-], bias [1/s]) that put both poles of the estimation error at e^(-bandwidth interval).

    bandwidth [rad/s]; interval between star tracker samples [s]. With p that pole: 1 - p^2 and (1 - p)^2 / interval.
    """
    pole = jnp.exp(-bandwidth * interval)
    return 1.0 - pole**2, (1.0 - pole) ** 2 / interval


@programs.jit(static_argnames="every")  # one program, where each of its operations would be one
def attitude_filter(
    bandwidth: Any, attitude_noise: Any, rate_noise: Any, bias_walk: Any, period: Any, every: int
) -> AttitudeFilter:
    """Filter of this bandwidth [rad/s], its errors at t = 0 those of its steady state under these noises.

    attitude_noise [rad] a star tracker sample; rate_noise [rad/s] a control period [s]; bias_walk [rad/s/sqrt(s)];
    every: control periods between star tracker samples.
    """
    k1, k2 = filter_gains(bandwidth, period * every)
    # e: errors of attitude, less what the gyro's noise at the sample adds to it, and of bias, just before a sample.
    # One period later it is step e, after a star tracker sample step keep e, and noises times the vectors named so
    zero, one, half = jnp.zeros_like(k1), jnp.ones_like(k1), period / 2

    def after(t: Any) -> Array:
        return jnp.array([[one, -t * one], [zero, one]])

    def square(vector: Array, sigma: Any) -> Array:
        return jnp.outer(vector, vector) * sigma**2

    gyro, walk = jnp.stack([half * one, zero]), jnp.sqrt(period) * jnp.stack([half * one, -one])
    corrected = after(period) @ jnp.array([[1.0 - k1, zero], [k2, one]])
    star = after(period) @ jnp.stack([k1, -k2])
    drive = square(2.0 * gyro, rate_noise) + square(walk, bias_walk)
    steps = jax.vmap(after)(period * jnp.arange(every))
    each = jax.vmap(lambda step: step @ drive @ step.T)(steps)
    added = jnp.cumsum(each, axis=0) - each
    move = corrected @ steps[-1]
    drive = corrected @ added[-1] @ corrected.T + square(star, attitude_noise)
    drive = drive + square(corrected @ gyro + gyro, rate_noise) + square(walk, bias_walk)
    first = numerics.solve(jnp.eye(4) - jnp.kron(move, move), drive.reshape(4)).reshape(2, 2)

    def spread(step: Array, since: Array) -> Array:
        return _cholesky(step @ first @ step.T + since + square(gyro, rate_noise))

    return AttitudeFilter(k1, k2, jax.vmap(spread)(steps, added))


def _cholesky(covariance: Float[Array, "2 2"]) -> Float[Array, "2 2"]:
    """Lower factor of a covariance; without derivatives that are not finite where there is no noise."""
    (a, b), (_, d) = covariance
    first = numerics.sqrt(jnp.maximum(a, 0.0))
    along = jnp.where(first > 0.0, b / jnp.where(first > 0.0, first, 1.0), 0.0)
    return jnp.array([[first, 0.0], [along, numerics.sqrt(jnp.maximum(d - along * along, 0.0))]])


class Memory(NamedTuple):
    """What `Sensors` carries from sample to sample."""

    keys: tuple
    noise: tuple[Array, Array]  # of the sample to come
    bias: Any  # (3,) of the gyro [rad/s]; None without one
    estimate: Any  # Estimate; None without a filter
    rate: Any  # (3,) as last measured [rad/s]; None without a filter


@pytree
@dataclass(frozen=True)
class Sensors:
    """Star tracker [rad] and gyro [rad/s] sampled once a period, white noise, independent per axis and sample.

    Without a filter the law sees the samples themselves; with one, its attitude and the gyro's rate less its bias.
    """

    attitude_noise: Leaf  # 1 sigma of the small rotation about each body axis [rad]
    rate_noise: Leaf  # 1 sigma [rad/s]
    rate_bias: Leaf | None = None  # 1 sigma, constant over a run [rad/s]
    bias_rate: Leaf | None = None  # 1 sigma of the bias's change per second of a period: walk / sqrt(period) [rad/s^2]
    filter: AttitudeFilter | None = None
    every: int = field(default=1, metadata={"static": True})  # periods between star tracker samples, with a filter

    def with_bandwidth(self, bandwidth: Any, period: Any) -> "Sensors":
        """The same with a filter of another bandwidth [rad/s]; period: of control [s]."""
        walk = 0.0 if self.bias_rate is None else self.bias_rate * numerics.sqrt(period)
        noises = self.attitude_noise, self.rate_noise, walk
        return replace(self, filter=attitude_filter(bandwidth, *noises, period, self.every))

    def bandwidth(self, period: Any) -> Any:
        """Bandwidth of the filter [rad/s]."""
        assert self.filter is not None
        return -0.5 * jnp.log1p(-self.filter.attitude_gain) / (period * self.every)

    def keys(self, seed: Whole, trial: Whole) -> tuple[draws.Key, draws.Key, draws.Key]:
        """Streams of a trial's noise: attitude, rate, change of the bias."""
        return (
            draws.stream(seed, trial, ATTITUDE_NOISE),
            draws.stream(seed, trial, RATE_NOISE),
            draws.stream(seed, trial, BIAS_WALK),
        )

    def noise(self, keys: tuple, sample: Int[Array, ""]) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
        """Attitude [rad] and rate [rad/s] noise of one sample, (3,) each."""
        return (
            self.attitude_noise * draws.normals(keys[0], 3, sample),
            self.rate_noise * draws.normals(keys[1], 3, sample),
        )

    def first_bias(self, seed: Whole, trial: Whole) -> Float[Array, "3"]:
        """Bias of the gyro at the first sample, (3,) [rad/s]."""
        if self.rate_bias is None:
            return jnp.zeros(3)
        return self.rate_bias * draws.normals(draws.stream(seed, trial, RATE_BIAS), 3)

    def begin(self, seed: Whole, trial: Whole, x0: AttitudeState, now: Ticks) -> Memory:
        """Memory before the first sample of positive length, which is now."""
        keys, bias, estimate = self.keys(seed, trial), None, None
        if self.rate_bias is not None or self.bias_rate is not None:
            bias = self.first_bias(seed, trial)
        if self.filter is not None:
            normals = draws.normals(draws.stream(seed, trial, FILTER_START), 6)
            none = jnp.zeros(3) if bias is None else bias
            estimate = self.filter.begin(x0.q, none, normals, now.sample, now.noise_weight)
        return Memory(keys, self.noise(keys, now.sample), bias, estimate, None if estimate is None else x0.w)

    def measure(self, memory: Memory, x: AttitudeState, now: Ticks, dt: Scalar) -> tuple[AttitudeState, Memory]:
        """Attitude and rate as the law sees them, and the memory; dt: length of the period just ended [s]."""
        noise_next = self.noise(memory.keys, now.sample + 1)
        turn, shift = numerics.lerp(now.noise_weight, memory.noise, noise_next)
        bias, estimate = memory.bias, memory.estimate
        if self.bias_rate is not None:
            bias = bias + self.bias_rate * dt * draws.normals(memory.keys[2], 3, now.sample)
        w = jnp.add(x.w, shift)
        if bias is not None:
            w = w + bias
        q = attitude.multiply(x.q, attitude.from_rotation_vector(turn))
        if self.filter is None:
            return AttitudeState(q, w), memory._replace(noise=noise_next, bias=bias)
        weight = jnp.where(now.sample % self.every == 0, now.noise_weight, 0.0)
        estimate = self.filter.correct(self.filter.propagate(estimate, memory.rate, w, dt), q, weight)
        seen = AttitudeState(estimate.q, w - estimate.bias)
        return seen, Memory(memory.keys, noise_next, bias, estimate, w)

    def moved(self, memory: Memory, by: Float[Array, " n"]) -> Memory:
        """A memory near another one: the filter's attitude turned [rad], its bias and its rate changed [rad/s]."""
        if memory.estimate is None:
            return memory
        turn, bias, rate = by.reshape(3, 3)
        q = attitude.multiply(memory.estimate.q, attitude.from_rotation_vector(turn))
        return memory._replace(estimate=Estimate(q, memory.estimate.bias + bias), rate=memory.rate + rate)

    def apart(self, memory: Memory, other: Memory) -> Float[Array, " n"]:
        """What `moved` takes a memory to another one by, to first order."""
        if memory.estimate is None:
            return jnp.zeros(0)
        turn = 2.0 * attitude.multiply(attitude.conjugate(memory.estimate.q), other.estimate.q)[:3]
        return jnp.concatenate([turn, other.estimate.bias - memory.estimate.bias, other.rate - memory.rate])

    def reading(self, period: float) -> Reading:
        """Rotation [rad], every so many periods behind a filter, and rate with its bias [rad/s], every period [s]."""
        one, none = np.eye(3), np.zeros((3, 3))
        star, gyro = (float(v) for v in (self.attitude_noise, self.rate_noise))
        bias, drift = (0.0 if v is None else float(v) for v in (self.rate_bias, self.bias_rate))
        start, every = None, 1
        if self.filter is not None:
            root, every = np.asarray(self.filter.spread[-1]), self.every
            start = np.block([[one, none, none], [none, none, one]]), np.kron(root @ root.T, one)
        rows = np.block([[one, none, none], [none, one, one]])
        kept = np.repeat([every, 1], 3)
        return Reading(rows, np.repeat([star, gyro], 3), kept, np.full(3, bias), np.full(3, drift), start)


@pytree
@dataclass(frozen=True)
class StateSensor:
    """All states sampled once a period, white noise in the states' own units, independent per state and sample."""

    sigma: Leaf  # (n,) 1 sigma of each state

    def key(self, seed: Whole, trial: Whole) -> draws.Key:
        """Stream of a trial's noise."""
        return draws.stream(seed, trial, STATE_NOISE)

    def noise(self, key: draws.Key, sample: Int[Array, ""]) -> Float[Array, " n"]:
        """Noise of one sample, (n,)."""
        return self.sigma * draws.normals(key, self.sigma.shape[-1], sample)

    def begin(self, seed: Whole, trial: Whole, x0: Float[Array, " n"], now: Ticks) -> tuple:
        """Memory before the first sample of positive length, which is now."""
        key = self.key(seed, trial)
        return key, self.noise(key, now.sample)

    def measure(self, memory: tuple, x: Float[Array, " n"], now: Ticks, dt: Scalar) -> tuple[Float[Array, " n"], tuple]:
        """The states as measured, and the memory."""
        key, noise = memory
        noise_next = self.noise(key, now.sample + 1)
        return x + numerics.lerp(now.noise_weight, noise, noise_next), (key, noise_next)

    def reading(self, period: float) -> Reading:
        """Every state, every period [s]."""
        sigma = np.asarray(self.sigma)
        return Reading(np.eye(sigma.size), sigma, np.ones(sigma.size, int), np.zeros(0), np.zeros(0))
