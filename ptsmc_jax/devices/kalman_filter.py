"""A multiplicative extended Kalman filter of the attitude: any number of attitude sensors, and a gyro.

The estimation error has the components e = (a, b, n) and past attitude errors. Here a is a small rotation about body
axes [rad], b is the error of the gyro bias [rad/s], and n is the noise of the newest gyro sample [rad/s]. Over a
control period h with the body rotation R, the trapezoidal rule for the rate gives

    a+ = R' (a - h/2 (b + n)) - h/2 (b+ + n+),    b+ = b + drift,    n+ = noise of the next gyro sample

(Lefferts, Markley, Shuster, JGCD 5(5), 1982). The noise n is a state because each gyro sample acts in two periods.

The filter compares a reading of age L with its attitude estimate for that time. The state therefore includes the
attitudes at the last control samples, and every correction updates them too (stochastic cloning, Roumeliotis and
Burdick, ICRA 2002). This is exact for a linear system. Propagating a reading to the present with the gyro is not exact,
because it ignores the gyro noise in between. The components of a reading are processed one by one (Bierman,
Factorization Methods for Discrete Sequential Estimation, 1977), so that no matrix is inverted.

Read `kalman_filter` first, which builds the filter, then `KalmanFilter`.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ptsmc_jax import programs
from ptsmc_jax.devices.attitude_filter import rotation_over
from ptsmc_jax.devices.attitude_sensors import AttitudeSensor
from ptsmc_jax.numerics import attitude, guards
from ptsmc_jax.numerics.pytrees import Leaf, Scalar, pytree

# largest number of control periods in a cycle of the sensors' sample times; of a longer cycle, `KalmanFilter.first` has
# the factors of the covariance for only this many periods
LONGEST_CYCLE = 1000
DOUBLINGS = 60  # largest number of doublings of the number of cycles until the steady state
# 1 sigma of the attitude at switch-on [rad], because the body may turn before the first reading arrives
SWITCH_ON_SIGMA = 0.1
TURN, BIAS, NOISE = slice(0, 3), slice(3, 6), slice(6, 9)


class Track(NamedTuple):
    """The state of the filter."""

    q: Array  # (4,) estimated attitude, a unit quaternion
    bias: Array  # (3,) estimated gyro bias [rad/s]
    rate: Array  # (3,) last gyro sample, less its estimated noise [rad/s]
    past_q: Any  # (past, 4) attitudes at the last control samples, newest first; None if no sensor needs them
    past_w: Any  # (past, 3) body rates at these samples [rad/s]; None if all sensors read at control samples
    covariance: Array  # (9 + 3 past, 9 + 3 past) covariance of the errors (a, b, n, past a ..) [rad, rad/s]

    @property
    def w(self) -> Array:
        """Return the estimated body rate (3,) [rad/s]."""
        return self.rate - self.bias

    @property
    def by_name(self) -> dict[str, Array]:
        """Return the state by the names of the fields in exported C."""
        named = {"attitude": self.q, "bias": self.bias, "gyro": self.rate, "past_attitude": self.past_q,
                 "past_rate": self.past_w, "covariance": self.covariance}  # fmt: skip
        return {name: value for name, value in named.items() if value is not None}


@pytree
@dataclass(frozen=True)
class KalmanFilter:
    """The filter, with the sensors as the flight software knows them. Build it with `kalman_filter`.

    The estimation errors are: attitude [rad], gyro bias [rad/s], last gyro sample [rad/s] and past attitudes [rad].
    """

    sensors: tuple[AttitudeSensor, ...]
    rate_noise: Leaf  # (3,) 1 sigma of a gyro sample [rad/s]
    drift: Leaf  # (3,) 1 sigma of the change of the bias per second of a period [rad/s^2]
    rate_bias: Leaf  # (3,) 1 sigma of the gyro bias when the gyro is switched on [rad/s]
    period: Leaf  # control period [s]
    # (cycle, 6, 6) factors of the covariance of (a, b) in the steady state at rest, just before a control sample
    first: Leaf

    @property
    def past_samples(self) -> int:
        """Return the number of past control samples that the filter keeps."""
        return max((sensor.times.past_samples for sensor in self.sensors), default=0)

    @property
    def has_readings_between_samples(self) -> bool:
        """Return whether a sensor reads between control samples."""
        return any(sensor.times.every is None for sensor in self.sensors)

    def first_factor(self, sample: Any, weight: Any) -> Float[Array, "6 6"]:
        """Return a factor (6, 6) of the initial covariance of (a, b) in `begin`, which explains the arguments."""
        count = len(self.first)
        return guards.lerp(jnp.asarray(weight), self.first[sample % count], self.first[(sample + 1) % count])

    def begin(
        self, q: Float[Array, "4"], bias: Float[Array, "3"], w: Float[Array, "3"], normals: Float[Array, "6"],
        sample: Array, weight: Scalar,
    ) -> Track:  # fmt: skip
        """Return the state of a filter that has run before the slew, with random steady-state errors.

        Args:
            q: true attitude, a unit quaternion (4,).
            bias: true bias of the gyro (3,) [rad/s].
            w: true body rate (3,) [rad/s].
            normals: standard normal numbers for the errors (6,).
            sample: number of the first control sample; the state is the one just before it.
            weight: weight of this sample, below 1 in a partial first period.
        """
        factor, past = self.first_factor(sample, weight), self.past_samples
        error = factor @ normals
        q = attitude.multiply(q, attitude.from_rotation_vector(error[TURN]))
        bias = bias + error[BIAS]
        past_q = jnp.tile(q, (past, 1)) if past else None
        past_w = jnp.tile(w, (past, 1)) if self.has_readings_between_samples else None
        return Track(q, bias, w + bias, past_q, past_w, self.covariance(factor))

    def covariance(self, factor: Float[Array, "6 6"]) -> Float[Array, "n n"]:
        """Return the covariance (n, n) of all errors from a factor (6, 6) of the covariance of (a, b)."""
        other_errors = 3 + 3 * self.past_samples
        return jnp.pad(factor @ factor.T, ((0, other_errors), (0, other_errors)))

    def covariance_at_switch_on(self) -> Float[Array, "n n"]:
        """Return the covariance (n, n) of all errors before the first reading, assuming that the body hardly turned."""
        covariance = self.covariance(self.first[0])
        attitudes = np.r_[0:3, 9 : 9 + 3 * self.past_samples]
        prior = np.zeros(covariance.shape)
        prior[np.ix_(attitudes, attitudes)] = SWITCH_ON_SIGMA**2 * np.tile(np.eye(3), (1 + self.past_samples,) * 2)
        bias = jnp.pad(self.rate_bias**2, (3, 3 + 3 * self.past_samples))
        return covariance + jnp.asarray(prior) + jnp.diag(bias)

    def propagate(self, old: Track, gyro: Float[Array, "3"], dt: Scalar) -> Track:
        """Return the state a control period later.

        Args:
            old: state at the control sample before.
            gyro: gyro sample at the end of the period (3,) [rad/s].
            dt: length of the period [s].
        """
        turn = attitude.from_rotation_vector(rotation_over(old.w, gyro - old.bias, dt))
        past_q, past_w = old.past_q, old.past_w
        if past_q is not None:
            past_q = jnp.concatenate([old.q[None], past_q[:-1]])
        if past_w is not None:
            past_w = jnp.concatenate([old.w[None], past_w[:-1]])
        covariance = self._propagate_covariance(old.covariance, turn, dt)
        return Track(attitude.multiply(old.q, turn), old.bias, gyro, past_q, past_w, covariance)

    def _propagate_covariance(self, p: Array, turn: Array, dt: Scalar) -> Array:
        """Return the covariance a control period later.

        Args:
            p: covariance at the start (n, n).
            turn: rotation of the body in the period, a unit quaternion (4,).
            dt: length of the period [s].
        """
        half, zero = dt / 2, jnp.zeros((3, 3))
        inverse_rotation = jax.vmap(partial(attitude.rotate, turn))(jnp.eye(3))  # R'
        gyro_noise, drift = jnp.diag(self.rate_noise**2), jnp.diag((self.drift * dt) ** 2)

        def propagate_attitude_rows(rows: Array) -> Array:
            """Return the rows of a+, without new noise, from the rows of all errors."""
            return inverse_rotation @ (rows[TURN] - half * (rows[BIAS] + rows[NOISE])) - half * rows[BIAS]

        attitude_by_old = propagate_attitude_rows(p)  # covariance of a+ and the old errors
        turn_turn = propagate_attitude_rows(attitude_by_old.T) + half**2 * (gyro_noise + drift)
        turn_bias, turn_noise = attitude_by_old[:, BIAS] - half * drift, -half * gyro_noise
        rows = [
            [turn_turn, turn_bias, turn_noise],
            [turn_bias.T, p[BIAS, BIAS] + drift, zero],
            [turn_noise, zero, gyro_noise],
        ]
        if not self.past_samples:
            return jnp.block(rows)
        # the current attitude error becomes a past one, and the oldest past one is dropped
        kept_places = np.r_[0:3, 9 : 6 + 3 * self.past_samples]
        past_columns = [attitude_by_old[:, kept_places], p[BIAS, kept_places], jnp.zeros((3, len(kept_places)))]
        rows = [[*row, column] for row, column in zip(rows, past_columns, strict=True)]
        return jnp.block([*rows, [*(column.T for column in past_columns), p[kept_places][:, kept_places]]])

    def correct(self, old: Track, k: int, reading: Array, age: Scalar, weight: Scalar) -> Track:
        """Return the state after a reading.

        Args:
            old: state at this control sample.
            k: index of the sensor.
            reading: reading of the sensor (size,).
            age: time since the reading was taken [s].
            weight: 1 for a reading, 0 for none. A weight between 0 and 1 multiplies the noise by 1/sqrt(weight).
        """
        sensor = self.sensors[k]
        q, rows_at_reading, fraction = self._estimate_at_reading(old, sensor, age)
        rows, residual = sensor.sensitivity(q), sensor.change(sensor.read(q), reading)
        # between control samples the errors are interpolated linearly; this is the variance of the remaining gyro noise
        gyro_factor = (self.period * fraction * (1.0 - fraction)) ** 2 / 2 if sensor.times.every is None else 0.0
        p, correction = old.covariance, jnp.zeros(len(old.covariance))
        for row, difference, noise in zip(rows, residual, sensor.noise, strict=True):
            by_all = row @ rows_at_reading(p)
            variance = noise**2 + gyro_factor * jnp.sum((row * self.rate_noise) ** 2)
            gain = weight / (weight * (row @ rows_at_reading(by_all)) + variance)
            correction = correction + gain * (difference - row @ rows_at_reading(correction)) * by_all
            p = p - gain * jnp.outer(by_all, by_all)
        return self.retract(old, correction)._replace(covariance=p)

    def _estimate_at_reading(self, old: Track, sensor: AttitudeSensor, age: Scalar) -> tuple[Array, Any, Scalar]:
        """Return the estimated attitude at the time of a reading, a function for its error, and a fraction.

        Args:
            old: state at this control sample.
            sensor: the sensor.
            age: time since the reading was taken [s].

        Returns:
            The attitude (4,); a function that extracts the rows of its error (3, ..) from an array (errors, ..); the
            fraction of a control period between the reading and the control sample after it.
        """
        periods, rest = sensor.times.split_age(age)
        fraction = rest / self.period

        def entry_back(values: Array, further: int = 0) -> Array:
            """Return the entry `periods` + `further` control samples back; entry 0 is the current one."""
            if isinstance(periods, int):
                return values[periods + further]
            index = sensor.times.wait + further
            return jnp.where(periods == sensor.times.wait, values[index], values[index + 1])

        def rows_at_reading(values: Array) -> Array:
            """Return the rows (3, ..) of the attitude error at the time of the reading, from rows of all errors."""
            blocks = jnp.concatenate([values[TURN], values[9:]]).reshape(self.past_samples + 1, 3, *values.shape[1:])
            rows = entry_back(blocks)
            return rows if sensor.times.every is not None else rows + fraction * (entry_back(blocks, 1) - rows)

        q = old.q if self.past_samples == 0 else entry_back(jnp.concatenate([old.q[None], old.past_q]))
        if sensor.times.every is None:
            rates = jnp.concatenate([old.w[None], old.past_w])
            w, w_before = entry_back(rates), entry_back(rates, 1)
            turn = rest * w - rest * fraction / 2 * (w - w_before)
            q = attitude.multiply(q, attitude.from_rotation_vector(-turn))
        return q, rows_at_reading, fraction

    def retract(self, track: Track, by: Float[Array, " n"]) -> Track:
        """Return the state with its estimate changed by local coordinates (9 + 3 past,), the errors of the filter."""

        def rotated(q: Array, turn: Array) -> Array:
            return attitude.normalise(attitude.multiply(q, attitude.from_rotation_vector(turn)))

        past_q = track.past_q
        if past_q is not None:
            past_q = jax.vmap(rotated)(past_q, by[9:].reshape(-1, 3))
        q, bias, rate = rotated(track.q, by[TURN]), track.bias + by[BIAS], track.rate - by[NOISE]
        return track._replace(q=q, bias=bias, rate=rate, past_q=past_q)

    def at_control_samples(self) -> "KalmanFilter":
        """Return the filter for sensors that all read at control samples, for linear theory."""
        return replace(self, sensors=tuple(sensor.at_control_samples() for sensor in self.sensors))

    def local_coordinates(self, track: Track, other: Track) -> Float[Array, " n"]:
        """Return local coordinates (9 + 3 past,) [rad, rad/s] of `other` relative to `track`, to first order."""
        turn = attitude.small_rotation
        past = [] if track.past_q is None else [jax.vmap(turn)(track.past_q, other.past_q).reshape(-1)]
        return jnp.concatenate([turn(track.q, other.q), other.bias - track.bias, track.rate - other.rate, *past])


def kalman_filter(
    sensors: Sequence[AttitudeSensor], rate_noise: Any, bias_drift: Any, switch_on_bias: Any, period: float
) -> KalmanFilter:
    """Return a filter that starts in its steady state at rest.

    The sensors together must determine the attitude; the function does not check this.

    Args:
        sensors: attitude sensors.
        rate_noise: 1 sigma of a gyro sample (3,) [rad/s].
        bias_drift: 1 sigma of the change of the bias per second of a period (3,) [rad/s^2].
        switch_on_bias: 1 sigma of the gyro bias when the gyro is switched on (3,) [rad/s].
        period: control period [s].

    Raises:
        ValueError: if a sensor has no noise.
    """
    if any(np.any(np.asarray(sensor.noise) <= 0.0) for sensor in sensors):
        raise ValueError("every attitude sensor must have noise greater than 0")
    each = (rate_noise, bias_drift, switch_on_bias)
    gyro, change, bias = (jnp.broadcast_to(jnp.asarray(v, float), (3,)) for v in each)
    kalman = KalmanFilter(tuple(sensors), gyro, change, bias, jnp.asarray(float(period)), jnp.zeros((1, 6, 6)))
    return replace(kalman, first=jnp.asarray(_steady_state(kalman)))


class _CovarianceMap(NamedTuple):
    """Map of a covariance p over several filter steps, a p (1 + c p)^-1 a' + b.

    Source: Särkkä and García-Fernández, IEEE Trans. Automatic Control 66(1), 2021.
    """

    a: np.ndarray
    b: np.ndarray
    c: np.ndarray

    def followed_by(self, other: "_CovarianceMap") -> "_CovarianceMap":
        """Return the map of these steps followed by other steps."""
        left = other.a @ np.linalg.inv(np.eye(len(self.a)) + self.b @ other.c)
        right = self.a.T @ np.linalg.inv(np.eye(len(self.a)) + other.c @ self.b)
        return _CovarianceMap(left @ self.a, left @ self.b @ other.a.T + other.b, right @ other.c @ self.a + self.c)


def _steady_state(kalman: KalmanFilter) -> np.ndarray:
    """Return factors (cycle, 6, 6) of the covariance of (a, b) just before each control sample of a cycle, at rest.

    The function doubles the number of cycles until the covariance converges (Anderson and Moore, Optimal Filtering,
    1979, section 6.7).
    """
    count = min(math.lcm(*(sensor.times.pattern[0] for sensor in kalman.sensors)), LONGEST_CYCLE)
    size, identity = 9 + 3 * kalman.past_samples, np.eye(9 + 3 * kalman.past_samples)
    noise = np.asarray(_noise_of_period(kalman))
    half = float(kalman.period) / 2
    transition = np.zeros((size, size))
    transition[TURN, :9] = np.hstack([np.eye(3), -2 * half * np.eye(3), -half * np.eye(3)])
    transition[BIAS, BIAS] = np.eye(3)
    if kalman.past_samples:
        transition[9:12, TURN] = np.eye(3)
        transition[12:, 9:-3] = np.eye(size - 12)
    prediction = _CovarianceMap(transition, noise, np.zeros((size, size)))
    information = _information_per_sample(kalman, count)
    cycle = _CovarianceMap(identity, np.zeros((size, size)), np.zeros((size, size)))
    for readings in information:
        cycle = cycle.followed_by(prediction)
        for rows in readings:
            cycle = cycle.followed_by(_CovarianceMap(identity, np.zeros((size, size)), rows))
    for _ in range(DOUBLINGS):
        cycle, previous = cycle.followed_by(cycle), cycle
        if np.allclose(cycle.b, previous.b, rtol=1e-12, atol=0.0):
            break
    covariance, factors = cycle.b, np.zeros((count, 6, 6))
    for number, readings in enumerate(information, start=1):
        covariance = transition @ covariance @ transition.T + noise
        factors[number % count] = _square_root(covariance[:6, :6])
        for rows in readings:
            covariance = covariance @ np.linalg.inv(identity + rows @ covariance)
    return factors


@programs.jit  # filters with sensors of the same kinds and sample times share one compiled program
def _noise_of_period(kalman: KalmanFilter) -> Array:
    """Return the covariance (errors, errors) that a control period at rest adds."""
    size = 9 + 3 * kalman.past_samples
    return kalman._propagate_covariance(jnp.zeros((size, size)), jnp.array([0.0, 0.0, 0.0, 1.0]), kalman.period)


def _information_per_sample(kalman: KalmanFilter, count: int) -> list[list[np.ndarray]]:
    """Return the information (errors, errors) of the readings due at each control sample 1 .. count, at rest."""
    samples, size = jnp.arange(1, count + 1), 9 + 3 * kalman.past_samples
    attitude_slices = [TURN, *(slice(k, k + 3) for k in range(9, size, 3))]
    information: list[list[np.ndarray]] = [[] for _ in range(count)]
    for sensor in kalman.sensors:
        axes = np.asarray(sensor.sensitivity(jnp.array([0.0, 0.0, 0.0, 1.0])))
        periods, rest = sensor.times.split_age(sensor.times.delivered_age(samples))
        periods, fractions = (
            np.broadcast_to(v, count) for v in (periods, np.asarray(rest) / np.asarray(kalman.period))
        )
        for k in np.flatnonzero(sensor.times.is_reading_due(samples)):
            fraction, rows = float(fractions[k]), np.zeros((len(sensor.noise), size))
            rows[:, attitude_slices[periods[k]]] = (1.0 - fraction) * axes
            if fraction > 0.0:
                rows[:, attitude_slices[periods[k] + 1]] = fraction * axes
            interpolation_variance = (float(kalman.period) * fraction * (1.0 - fraction)) ** 2 / 2
            variance = np.asarray(sensor.noise) ** 2 + interpolation_variance * np.sum(
                (axes * np.asarray(kalman.rate_noise)) ** 2, axis=1
            )
            information[k].append(rows.T @ (rows / variance[:, None]))
    return information


def _square_root(covariance: np.ndarray) -> np.ndarray:
    """Return a square root (n, n) of a positive semidefinite covariance; eigenvalues below zero are rounding."""
    scale = np.sqrt(np.maximum(np.diag(covariance), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    return scale[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
