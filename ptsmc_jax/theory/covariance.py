"""Effect of sensor noise on accuracy and torque, from the covariance of the linearised loop, without trials.

Read `propagate_noise` first; `is_applicable` reports whether it applies to a scenario.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np

from ptsmc_jax.simulation.assembly import Parts
from ptsmc_jax.theory import linear, lower_bound

ROUNDS = 8  # Largest number of iterations of the statistical linearisation.
LARGEST_SIGMA = 1e60  # Upper limit of 1 sigma of s, if the covariance overflows.
FLAT_WIDTH = 1e30  # Thickness of a boundary layer in which the switching term is practically zero.
_GRID = np.linspace(-20.0, 20.0, 401)  # integration grid of expectations over Gaussian noise
_SECH_SQUARED, _GAUSSIAN = 1.0 / np.cosh(_GRID) ** 2, np.exp(-(_GRID**2) / 2.0)


class Noise(NamedTuple):
    """Standard deviations (1 sigma) caused by noise alone."""

    window_error: float  # RMS of the error's 2-norm over the window, in the unit of the metric.
    torque: float  # Largest 1 sigma of the command over time and axes [N m].
    s: float  # RMS deviation of the sliding variable over the window and its components.
    converged: bool = True  # Whether the iteration of `propagate_noise` converged within `ROUNDS` rounds.


def is_applicable(parts: Parts) -> bool:
    """Return whether `propagate_noise` applies to these sampled parts.

    It needs sensors with a linear `measurement_model` and a linear observer. It does not apply to implicit sampling.
    With implicit sampling, s reaches zero in one period if the switching term can compensate the noise of s, and
    rarely otherwise. A linearisation about the noise-free run does not show which of the two cases occurs.
    """
    readable = hasattr(parts.sensors, "measurement_model")
    return readable and parts.observer.linear and not getattr(parts.controller, "implicit", False)


def propagate_noise(parts: Parts) -> Noise:
    """Propagate the covariance of noise, bias and random walk along the nominal run of sampled parts.

    The parts must satisfy `is_applicable`. If there is an attitude filter, it starts with its steady-state covariance.

    Statistical linearisation replaces tanh(s / width) in each period by its mean derivative under the noise of s,
    E[sech^2(s / width)] / width. This derivative depends on the covariance and thus on the earlier periods. The
    function therefore iterates until the equivalent widths of two iterations agree to 1 %. After `ROUNDS` iterations
    it stops, and the result has `converged` = False.
    """
    run = linear.simulate_nominal_jit(parts)
    ticks = jax.tree.map(np.asarray, run.period.now)
    nonzero = np.flatnonzero(ticks.t_next - ticks.t > 1e-9 * float(parts.period))  # nonzero, apart from rounding
    ticks = jax.tree.map(lambda v: v[nonzero], ticks)
    linearise = partial(linear.linearise_periods, parts, run, nonzero, fractional_delays=False)
    scenario_width = getattr(parts.controller, "sign_width", None)
    if scenario_width is None:
        return _propagate_covariance(parts, ticks, linearise())[0]
    unswitched = linearise(np.full(nonzero.size, FLAT_WIDTH))
    sliding = _StateSpace(parts, ticks, unswitched).linear_map(unswitched.s_by_z, unswitched.s_by_seen)
    s_units = np.ones(nonzero.size)  # unit of s in each period, relative to its unit after the hand-over
    if parts.controller.prescribed:
        s_units[~ticks.hold] = float(parts.controller.layer_time) ** (parts.controller.order - 1)
    # effect on s of the noise in the same sample
    effects = [float(np.sqrt(np.sum(effect**2) / len(effect))) for effect in sliding.noise]
    sigmas = [effect / unit for effect, unit in zip(effects, s_units, strict=True)]
    next_widths = np.asarray([_equivalent_width(float(scenario_width), sigma) for sigma in sigmas])
    result, converged = None, False
    for _ in range(ROUNDS):
        widths = next_widths
        sign_loops = _SignLoops(linearise(widths).loop, widths, float(scenario_width), s_units)
        result, next_widths = _propagate_covariance(parts, ticks, unswitched, sign_loops)
        converged = bool(np.allclose(next_widths, widths, rtol=0.01, atol=0.0))
        if converged:
            break
    assert result is not None
    return result._replace(converged=converged)


class _SignLoops(NamedTuple):
    """Loops that are linearised with equivalent thicknesses of the boundary layer.

    `_propagate_covariance` interpolates the loops in 1/width. This is exact if s is zero in the noise-free run.
    Otherwise its error vanishes as the interpolated widths approach `widths`.
    """

    loops: Any  # a `linear.Loop` of NumPy arrays with a leading period axis
    widths: np.ndarray  # (periods,) equivalent thicknesses of the boundary layer.
    scenario_width: float  # Thickness of the boundary layer in the scenario.
    units: np.ndarray  # (periods,) unit of s, relative to its unit after the hand-over.


def _equivalent_width(width: float, sigma: float) -> float:
    """Return the equivalent width 1 / E[sech^2(s / width) / width] for Gaussian s with standard deviation sigma."""
    if sigma == 0.0:
        return width
    ratio = width / sigma
    if ratio < 1.0:  # the integration grid is in units of the narrower function, sech^2 or the Gaussian density
        integral = np.exp(-((ratio * _GRID) ** 2) / 2.0) @ _SECH_SQUARED
    else:
        integral = _GAUSSIAN @ (1.0 / np.cosh(_GRID / ratio) ** 2) / ratio
    return sigma / float(integral * (_GRID[1] - _GRID[0]) / np.sqrt(2.0 * np.pi))


class _LinearMap(NamedTuple):
    """Linear map from the propagated state and the noise of one sample to an output, for one or for all periods."""

    state: np.ndarray  # (rows, size) Derivative of the output by the propagated state.
    noise: np.ndarray  # (rows, readings) Derivative of the output by the noise of readings, times its 1 sigma.

    def covariance(self, p: np.ndarray) -> np.ndarray:
        """Return the output covariance (rows, rows), given p (size, size), the state covariance before the sample."""
        return self.state @ p @ self.state.T + self.noise @ self.noise.T

    def in_period(self, j: int, other: "_LinearMap | None" = None, fraction: float = 0.0) -> "_LinearMap":
        """Return the map of period j, interpolated linearly toward `other` by the fraction `fraction` (0: this map)."""
        this_map = _LinearMap(self.state[j], self.noise[j])
        if other is None:
            return this_map
        return _LinearMap(*(a + fraction * (b[j] - a) for a, b in zip(this_map, other, strict=True)))


class _StateSpace:
    """Layout and dynamics of the propagated state: z, delayed commands, sensor states (bias), random-walk torque."""

    def __init__(self, parts: Parts, ticks: Any, linearised: linear.LinearisedPeriod):
        loop: Any = linearised.loop
        self._n, self._m, k = loop.a.shape[1], loop.command.shape[1], loop.seen.shape[2]
        self.plant = slice(0, linearised.error.shape[2])
        sensors = parts.sensors.at_control_samples()
        self._reading = reading = lower_bound.reading_of(sensors, k, ticks)
        self._queue_size = loop.delay * self._m
        first_sensor_state = self._n + self._queue_size
        self._sensor_states = slice(first_sensor_state, first_sensor_state + reading.own.size)
        self.size = first_sensor_state + reading.own.size + self._m
        # A sensor suite has the noise of the next sample among the coordinates of its memory. Other sensors have as
        # many readings as the computer sees states, so that the error of a reading is an error of the seen state.
        self._seen_size = k
        self.memory = self.plant.stop + k  # in z the sensors' memory follows x and the last seen state
        noise = getattr(sensors, "noise_slice", None)
        self._noise_states = None if noise is None else slice(self.memory + noise.start, self.memory + noise.stop)
        self._from_readings = None if noise is not None else np.linalg.pinv(reading.rows[:, :k])
        # Process noise, 1 sigma per second. The random-walk torque changes at the start of a period and acts in that
        # period. The sensor states change after the sample.
        self.walk = np.concatenate([np.zeros(self.size - self._m), lower_bound.walk_intensity(parts)])
        self.drift = np.concatenate([np.zeros(first_sensor_state), reading.own_drift, np.zeros(self._m)])

    def start(self) -> np.ndarray:
        """Return the covariance (size, size) before the first sample."""
        reading = self._reading
        factor = np.zeros((self.size, reading.own.size))
        factor[self._sensor_states] = np.diag(reading.own)
        # a filter starts with errors of attitude and bias; its bias error depends on the gyro bias
        if reading.start is not None:
            start = np.zeros((self.size, 6))
            start[self.memory : self.memory + 6] = reading.start[1]
            factor[self.memory + 3 : self.memory + 6] = np.diag(reading.own)
            factor = np.hstack([factor, start])
        return factor @ factor.T

    def linear_map(self, by_z: Any, by_seen: Any) -> _LinearMap:
        """Return the linear map from the propagated state to an output, given the output's derivatives as NumPy arrays.

        Args:
            by_z: derivatives by z, (rows, n) or (periods, rows, n).
            by_seen: derivatives by the state that the computer sees, (rows, k) or (periods, rows, k).
        """
        by_state = np.pad(by_z, [(0, 0)] * (by_z.ndim - 1) + [(0, self.size - self._n)])
        by_errors = by_seen @ self._from_readings if self._noise_states is None else by_z[..., self._noise_states]
        by_state[..., : self._seen_size] += by_seen
        by_state[..., self._sensor_states] = by_errors @ self._reading.rows[:, self._seen_size :]
        return _LinearMap(by_state, by_errors * self._reading.noise)

    def transition_maps(self, loops: Any) -> tuple[_LinearMap, _LinearMap]:
        """Return the maps of each period to the command and to the whole state one period later.

        Args:
            loops: a `linear.Loop` of NumPy arrays with a leading period axis.
        """
        n, m, queue_size, new = self._n, self._m, self._queue_size, loops.new[:, 0]
        command = self.linear_map(loops.command, loops.direct)
        state = np.tile(np.eye(self.size), (len(new), 1, 1))
        noise = np.zeros((len(new), self.size, command.noise.shape[-1]))
        state[:, :n], noise[:, :n] = self.linear_map(loops.a, loops.seen)
        state[:, :n, self.size - m :] += loops.disturbed
        if queue_size:
            state[:, :n, n + queue_size - m : n + queue_size] += new
            state[:, n : n + queue_size] = np.eye(self.size)[n - m : n + queue_size - m]
            state[:, n : n + m], noise[:, n : n + m] = command
        else:
            state[:, :n] += new @ command.state
            noise[:, :n] += new @ command.noise
        return command, _LinearMap(state, noise)


def _propagate_covariance(
    parts: Parts, ticks: Any, linearised: linear.LinearisedPeriod, sign: _SignLoops | None = None
) -> tuple[Noise, np.ndarray]:
    """Propagate the covariance along the run; return the deviations and the equivalent sign widths (periods,)."""
    lengths = ticks.t_next - ticks.t
    state = _StateSpace(parts, ticks, linearised)
    p, sliding = state.start(), state.linear_map(linearised.s_by_z, linearised.s_by_seen)
    command, transition = state.transition_maps(linearised.loop)
    sign_maps = (None, None) if sign is None else state.transition_maps(sign.loops)
    # columns of `squares`: error at the start of a period, error in its middle, mean square of the components of s
    squares, torque, widths = np.zeros((len(lengths) + 1, 3)), 0.0, np.zeros(len(lengths))

    def mean_square(error: Any) -> float:
        return float(np.trace(error @ p[state.plant, state.plant] @ error.T))

    for j, length in enumerate(lengths):
        s = sliding.in_period(j).covariance(p)
        squares[j] = mean_square(linearised.error[j]), 0.0, np.mean(np.diag(s))
        fraction = 0.0
        if sign is not None:
            widths[j] = _equivalent_width(
                sign.scenario_width, min(float(np.sqrt(squares[j, 2])) / sign.units[j], LARGEST_SIGMA)
            )
            fraction = sign.widths[j] / widths[j] if widths[j] > 0.0 else 1.0
        commanded = command.in_period(j, sign_maps[0], fraction).covariance(p)
        torque = max(torque, float(np.sqrt(np.diag(commanded).max())))
        to_next = transition.in_period(j, sign_maps[1], fraction)
        p = p + np.diag((state.walk * length) ** 2)
        squares[j, 1] = np.trace(_map_to_middle(linearised, j, float(length), to_next, state.plant).covariance(p))
        p = to_next.covariance(p) + np.diag((state.drift * length) ** 2)
    squares[-1, 0] = mean_square(linearised.error[-1])
    error = lower_bound.window_error(parts, ticks, np.stack([squares[:-1, 0], squares[:-1, 1], squares[1:, 0]], axis=1))
    t, t_f = ticks.t, float(parts.controller.t_f)
    in_window = (t >= t_f - 1e-9 * float(parts.period)) & (t <= t_f + float(parts.window))
    return Noise(error, torque, float(np.sqrt(np.mean(squares[:-1][in_window, 2])))), widths


def _map_to_middle(
    linearised: linear.LinearisedPeriod, j: int, length: float, to_next: _LinearMap, plant: slice
) -> _LinearMap:
    """Return the map to the error in the middle of period j, by cubic Hermite interpolation as in the metrics.

    Args:
        linearised: linearised periods of the nominal run.
        j: number of the period.
        length: length of the period [s].
        to_next: map to the state one period later, without the drift of the sensor states.
        plant: place of the plant's local coordinates in the state.
    """
    after = min(j + 1, len(linearised.error) - 1)
    start = np.asarray(linearised.error[j] / 2 + length / 8 * linearised.error_rate[j])
    end = np.asarray(linearised.error[after] / 2 - length / 8 * linearised.error_rate[after])
    state = end @ to_next.state[plant]
    state[:, plant] += start
    return _LinearMap(state, end @ to_next.noise[plant])
