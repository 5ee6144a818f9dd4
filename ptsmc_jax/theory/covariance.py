"""Effect of sensor noise on accuracy and torque, from the covariance of the linearised loop, without trials.

Read `noise` first; `predicts` reports whether it applies to a scenario.
"""

from typing import Any, NamedTuple

import jax
import numpy as np

from ptsmc_jax.simulation.assembly import Parts
from ptsmc_jax.theory import linear, lower_bound

ROUNDS = 8  # Largest number of iterations of the statistical linearisation.
LARGEST_SIGMA = 1e60  # Upper limit of 1 sigma of s, if the covariance overflows.
FLAT_WIDTH = 1e30  # Thickness of a boundary layer in which the switching term is practically zero.
_AT = np.linspace(-20.0, 20.0, 401)
_SLOPE, _GAUSS = 1.0 / np.cosh(_AT) ** 2, np.exp(-(_AT**2) / 2.0)


class Noise(NamedTuple):
    """Standard deviations (1 sigma) caused by noise alone."""

    window_error: float  # RMS of the error's 2-norm over the window, in the unit of the metric.
    torque: float  # Largest deviation of the command over time and axes [N m].
    s: float  # RMS deviation of the sliding variable over the window and its components.
    converged: bool = True  # Whether the statistical linearisation converged within `ROUNDS` iterations, see `noise`.


def predicts(parts: Parts) -> bool:
    """Return whether `noise` applies to these sampled parts.

    It needs sensors with a linear model (`reading`) and a linear observer. It does not apply to implicit sampling.
    With implicit sampling, s reaches zero in one period if the switching term can compensate the noise of s, and
    rarely otherwise. A linearisation about the noise-free run does not show which of the two cases occurs.
    """
    readable = hasattr(parts.sensors, "reading")
    return readable and parts.observer.linear and not getattr(parts.controller, "implicit", False)


def noise(parts: Parts) -> Noise:
    """Propagate the covariance of noise, bias and random walk along the nominal run of sampled parts.

    The parts must satisfy `predicts`. If there is an attitude filter, it starts with its steady-state covariance.

    Statistical linearisation replaces tanh(s / width) in each period by its mean derivative under the noise of s,
    E[sech^2(s / width)] / width. This derivative depends on the covariance and thus on the earlier periods. The
    function therefore iterates until the equivalent widths of two iterations agree to 1 %. After `ROUNDS` iterations
    it stops, and the result has `converged` = False.
    """
    run = linear.nominal_jit(parts)
    ticks = jax.tree.map(np.asarray, run.period.now)
    lasting = np.flatnonzero(ticks.t_next - ticks.t > 1e-9 * float(parts.period))  # nonzero, apart from rounding
    ticks = jax.tree.map(lambda v: v[lasting], ticks)
    simulated = getattr(parts.controller, "sign_width", None)
    if simulated is None:
        return _covariance(parts, ticks, linear.opened_in(parts, run, lasting, late=False))[0]
    flat = linear.opened_in(parts, run, lasting, np.full(lasting.size, FLAT_WIDTH), late=False)
    own = _State(parts, ticks, flat).rows(flat.s_command, flat.s_direct).noise  # effect of each sample's own noise on s
    units = np.ones(lasting.size)  # unit of s in each period, relative to its unit after the hand-over
    if parts.controller.prescribed:
        units[~ticks.hold] = float(parts.controller.layer_time) ** (parts.controller.order - 1)
    sigmas = [float(np.sqrt(np.sum(by**2) / len(by))) / unit for by, unit in zip(own, units, strict=True)]
    found = np.asarray([_mean_width(float(simulated), sigma) for sigma in sigmas])
    sizes, converged = None, False
    for _ in range(ROUNDS):
        widths = found
        sign = _Sign(linear.opened_in(parts, run, lasting, widths, late=False).loop, widths, float(simulated), units)
        sizes, found = _covariance(parts, ticks, flat, sign)
        converged = bool(np.allclose(found, widths, rtol=0.01, atol=0.0))
        if converged:
            break
    assert sizes is not None
    return sizes._replace(converged=converged)


class _Sign(NamedTuple):
    """Loops that are linearised with equivalent thicknesses of the boundary layer.

    `_covariance` interpolates the loops in 1/width. This is exact if s is zero in the noise-free run. Otherwise its
    error vanishes as the interpolated widths approach `widths`.
    """

    loops: Any
    widths: np.ndarray  # (periods,) equivalent widths.
    simulated: float  # Width in the scenario.
    units: np.ndarray  # (periods,) unit of s, relative to its unit after the hand-over.


def _mean_width(width: float, sigma: float) -> float:
    """Return the equivalent width 1 / E[sech^2(s / width) / width] for Gaussian s with standard deviation sigma."""
    if sigma == 0.0:
        return width
    ratio = width / sigma
    if ratio < 1.0:  # the integration grid _AT is in units of the narrower function, sech^2 or the Gaussian density
        weighed = np.exp(-((ratio * _AT) ** 2) / 2.0) @ _SLOPE
    else:
        weighed = _GAUSS @ (1.0 / np.cosh(_AT / ratio) ** 2) / ratio
    return sigma / float(weighed * (_AT[1] - _AT[0]) / np.sqrt(2.0 * np.pi))


class _Rows(NamedTuple):
    """Linear map from the propagated state and the noise of one sample to an output, for one or for all periods."""

    state: np.ndarray  # (rows, size).
    noise: np.ndarray  # (rows, readings), multiplied by 1 sigma.

    def covariance(self, p: np.ndarray) -> np.ndarray:
        """Return the output covariance (rows, rows), given p (size, size), the state covariance before the sample."""
        return self.state @ p @ self.state.T + self.noise @ self.noise.T

    def at(self, j: int, other: "_Rows | None" = None, fraction: float = 0.0) -> "_Rows":
        """Return the map of period j, interpolated linearly toward `other` by the fraction `fraction` (0: this map)."""
        mine = _Rows(self.state[j], self.noise[j])
        if other is None:
            return mine
        return _Rows(*(a + fraction * (b[j] - a) for a, b in zip(mine, other, strict=True)))


class _State:
    """Layout and dynamics of the propagated state: z, delayed commands, sensor states (bias), random-walk torque."""

    def __init__(self, parts: Parts, ticks: Any, opened: linear.Opened):
        loop: Any = opened.loop
        self._n, self._m, k = loop.a.shape[1], loop.command.shape[1], loop.seen.shape[2]
        self.plant = slice(0, opened.error.shape[2])
        sensors = parts.sensors.in_step()
        self._reading = reading = lower_bound.reading_of(sensors, k, ticks)
        self._waiting = loop.delay * self._m
        before = self._n + self._waiting
        self._own = slice(before, before + reading.own.size)
        self.size = before + reading.own.size + self._m
        # A sensor suite has the noise of the next sample among the coordinates of its memory. Other sensors have as
        # many readings as the computer sees states, so that the error of a reading is an error of the seen state.
        self._seen, self.memory = k, self.plant.stop + k  # in z the sensors' memory follows x and the last seen state
        place = getattr(sensors, "noise_place", None)
        self._noise = None if place is None else slice(self.memory + place.start, self.memory + place.stop)
        self._from_readings = None if place is not None else np.linalg.pinv(reading.rows[:, :k])
        # Process noise, 1 sigma per second. The random-walk torque changes at the start of a period and acts in that
        # period. The sensor states change after the sample.
        self.walk = np.concatenate([np.zeros(self.size - self._m), lower_bound.walk_intensity(parts)])
        self.drift = np.concatenate([np.zeros(before), reading.own_drift, np.zeros(self._m)])

    def start(self) -> np.ndarray:
        """Return the covariance (size, size) before the first sample."""
        reading = self._reading
        factor = np.zeros((self.size, reading.own.size))
        factor[self._own] = np.diag(reading.own)
        # a filter starts with errors of attitude and bias; its bias error depends on the gyro bias
        if reading.start is not None:
            start = np.zeros((self.size, 6))
            start[self.memory : self.memory + 6] = reading.start[1]
            factor[self.memory + 3 : self.memory + 6] = np.diag(reading.own)
            factor = np.hstack([factor, start])
        return factor @ factor.T

    def rows(self, by_z: Any, by_seen: Any) -> _Rows:
        """Return the linear map from the propagated state to an output, given the output's derivatives as NumPy arrays.

        Args:
            by_z: derivatives by z, (rows, n) or (periods, rows, n).
            by_seen: derivatives by the state that the computer sees, (rows, k) or (periods, rows, k).
        """
        by_state = np.pad(by_z, [(0, 0)] * (by_z.ndim - 1) + [(0, self.size - self._n)])
        by_errors = by_seen @ self._from_readings if self._noise is None else by_z[..., self._noise]
        by_state[..., : self._seen] += by_seen
        by_state[..., self._own] = by_errors @ self._reading.rows[:, self._seen :]
        return _Rows(by_state, by_errors * self._reading.noise)

    def moved(self, loops: Any) -> tuple[_Rows, _Rows]:
        """Return the maps of each period to the command and to the whole state one period later.

        Args:
            loops: a `linear.Loop` of NumPy arrays with a leading period axis.
        """
        n, m, waiting, new = self._n, self._m, self._waiting, loops.new[:, 0]
        command = self.rows(loops.command, loops.direct)
        state = np.tile(np.eye(self.size), (len(new), 1, 1))
        noise = np.zeros((len(new), self.size, command.noise.shape[-1]))
        state[:, :n], noise[:, :n] = self.rows(loops.a, loops.seen)
        state[:, :n, self.size - m :] += loops.disturbed
        if waiting:
            state[:, :n, n + waiting - m : n + waiting] += new
            state[:, n : n + waiting] = np.eye(self.size)[n - m : n + waiting - m]
            state[:, n : n + m], noise[:, n : n + m] = command
        else:
            state[:, :n] += new @ command.state
            noise[:, :n] += new @ command.noise
        return command, _Rows(state, noise)


def _covariance(parts: Parts, ticks: Any, opened: linear.Opened, sign: _Sign | None = None) -> tuple[Noise, np.ndarray]:
    """Propagate the covariance along the run; return the deviations and the equivalent sign widths (periods,)."""
    lengths = ticks.t_next - ticks.t
    state = _State(parts, ticks, opened)
    p, sliding = state.start(), state.rows(opened.s_command, opened.s_direct)
    command, moved = state.moved(opened.loop)
    with_sign = (None, None) if sign is None else state.moved(sign.loops)
    # columns of `squares`: error at the start of a period, error in its middle, mean square of the components of s
    squares, torque, widths = np.zeros((len(lengths) + 1, 3)), 0.0, np.zeros(len(lengths))

    def square(error: Any) -> float:
        return float(np.trace(error @ p[state.plant, state.plant] @ error.T))

    for j, length in enumerate(lengths):
        s = sliding.at(j).covariance(p)
        squares[j] = square(opened.error[j]), 0.0, np.mean(np.diag(s))
        fraction = 0.0
        if sign is not None:
            widths[j] = _mean_width(sign.simulated, min(float(np.sqrt(squares[j, 2])) / sign.units[j], LARGEST_SIGMA))
            fraction = sign.widths[j] / widths[j] if widths[j] > 0.0 else 1.0
        commanded = command.at(j, with_sign[0], fraction).covariance(p)
        torque = max(torque, float(np.sqrt(np.diag(commanded).max())))
        later = moved.at(j, with_sign[1], fraction)
        p = p + np.diag((state.walk * length) ** 2)
        squares[j, 1] = np.trace(_middle(opened, j, float(length), later, state.plant).covariance(p))
        p = later.covariance(p) + np.diag((state.drift * length) ** 2)
    squares[-1, 0] = square(opened.error[-1])
    error = lower_bound.window_error(parts, ticks, np.stack([squares[:-1, 0], squares[:-1, 1], squares[1:, 0]], axis=1))
    t, t_f = ticks.t, float(parts.controller.t_f)
    in_window = (t >= t_f - 1e-9 * float(parts.period)) & (t <= t_f + float(parts.window))
    return Noise(error, torque, float(np.sqrt(np.mean(squares[:-1][in_window, 2])))), widths


def _middle(opened: linear.Opened, j: int, length: float, later: _Rows, plant: slice) -> _Rows:
    """Return the map to the error in the middle of period j, by cubic Hermite interpolation as in the metrics.

    Args:
        opened: linearised periods of the nominal run.
        j: number of the period.
        length: length of the period [s].
        later: map to the state one period later, without the drift of the sensor states.
        plant: place of the plant's local coordinates in the state.
    """
    after = min(j + 1, len(opened.error) - 1)
    start = np.asarray(opened.error[j] / 2 + length / 8 * opened.error_rate[j])
    end = np.asarray(opened.error[after] / 2 - length / 8 * opened.error_rate[after])
    state = end @ later.state[plant]
    state[:, plant] += start
    return _Rows(state, end @ later.noise[plant])
