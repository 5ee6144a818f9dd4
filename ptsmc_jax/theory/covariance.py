"""What noise alone does to accuracy and torque: the covariance of the linearised loop, without flying a trial."""

from typing import Any, NamedTuple

import jax
import numpy as np

from ptsmc_jax.simulation.assembly import Parts
from ptsmc_jax.theory import error_floor, linear

ROUNDS = 8  # largest number of rounds that find the mean slope of a sign if s is not zero in the quiet run
BEYOND = 1e60  # stands for a size of s that is no number any more
FLAT = 1e30  # width of a sign without slope
_AT = np.linspace(-20.0, 20.0, 401)
_SLOPE, _GAUSS = 1.0 / np.cosh(_AT) ** 2, np.exp(-(_AT**2) / 2.0)


class Noise(NamedTuple):
    """What noise alone does, 1 sigma."""

    window_error: float  # RMS over the window of the error's 2-norm, in the unit of the metric
    torque: float  # largest over time and axes of the command [N m]
    s: float  # of the sliding variable, RMS over the window and its components
    converged: bool = True  # whether the mean slope of the sign converged within `ROUNDS` rounds, see `noise`


def predicts(parts: Parts) -> bool:
    """Whether `noise` says what such sampled parts do under the noise of s, of any size [-].

    Not of implicit sampling: s lands at once where the noise is within what switching reaches in a period, and hardly
    beyond; which of these rules, no slope about the quiet run tells.
    """
    readable = hasattr(parts.sensors, "reading")
    return readable and parts.observer.linear and not getattr(parts.controller, "implicit", False)


def noise(parts: Parts) -> Noise:
    """Linear covariance along the nominal run of sampled parts that it `predicts`: what noise, bias, random walk cost.

    Behind an attitude filter its steady state is known at t = 0. The smooth sign counts in each period with the mean
    slope that it has under the noise of s there, E[sech^2(s / width)] / width (statistical linearisation), which the
    noise before it makes. The iteration repeats until the widths of two rounds agree to 1 %. After `ROUNDS` rounds it
    stops, and the result has `converged` = False.
    """
    run = linear.nominal_jit(parts)
    ticks = jax.tree.map(np.asarray, run.period.now)
    lasting = np.flatnonzero(ticks.t_next - ticks.t > 1e-9 * float(parts.period))  # beyond rounding
    ticks = jax.tree.map(lambda v: v[lasting], ticks)
    flown = getattr(parts.controller, "sign_width", None)
    if flown is None:
        return _covariance(parts, ticks, linear.opened_in(parts, run, lasting, late=False))[0]
    flat = linear.opened_in(parts, run, lasting, np.full(lasting.size, FLAT), late=False)
    own = _State(parts, ticks, flat).rows(flat.s_command, flat.s_direct).noise  # of this sample alone
    units = np.ones(lasting.size)  # of s in each period, over those after the hand-over
    if parts.controller.prescribed:
        units[~ticks.hold] = float(parts.controller.layer_time) ** (parts.controller.order - 1)
    sigmas = [float(np.sqrt(np.sum(by**2) / len(by))) / unit for by, unit in zip(own, units, strict=True)]
    found = np.asarray([_mean_width(float(flown), sigma) for sigma in sigmas])
    sizes, converged = None, False
    for _ in range(ROUNDS):
        widths = found
        sign = _Sign(linear.opened_in(parts, run, lasting, widths, late=False).loop, widths, float(flown), units)
        sizes, found = _covariance(parts, ticks, flat, sign)
        converged = bool(np.allclose(found, widths, rtol=0.01, atol=0.0))
        if converged:
            break
    assert sizes is not None
    return sizes._replace(converged=converged)


class _Sign(NamedTuple):
    """The loops with a smooth sign of these widths, (periods,), and the width that is flown.

    Slopes of u go by 1/width: exactly where s is zero in the quiet run, else as nearly as the widths of these loops.
    """

    loops: Any
    widths: np.ndarray
    flown: float
    units: np.ndarray  # (periods,) of s, over those after the hand-over


def _mean_width(width: float, sigma: float) -> float:
    """Width of the smooth sign whose slope at 0 is the mean slope under Gaussian noise of this size."""
    if sigma == 0.0:
        return width
    share = width / sigma
    if share < 1.0:  # at _AT widths, else at _AT sigmas: steps of a tenth of what falls off sooner
        weighed = np.exp(-((share * _AT) ** 2) / 2.0) @ _SLOPE
    else:
        weighed = _GAUSS @ (1.0 / np.cosh(_AT / share) ** 2) / share
    return sigma / float(weighed * (_AT[1] - _AT[0]) / np.sqrt(2.0 * np.pi))


class _Rows(NamedTuple):
    """How something follows from the state that is propagated, and from the noise of this sample; or in each period."""

    state: np.ndarray  # (rows, size)
    noise: np.ndarray  # (rows, readings), times 1 sigma

    def covariance(self, p: np.ndarray) -> np.ndarray:
        """Covariance (rows, rows), from that of the state before the sample, (size, size)."""
        return self.state @ p @ self.state.T + self.noise @ self.noise.T

    def at(self, j: int, other: "_Rows | None" = None, share: float = 0.0) -> "_Rows":
        """Those of the j-th period, of rows (periods, rows, ..), so far on the way to other ones."""
        mine = _Rows(self.state[j], self.noise[j])
        if other is None:
            return mine
        return _Rows(*(a + share * (b[j] - a) for a, b in zip(mine, other, strict=True)))


class _State:
    """The state that is propagated: z, the commands on their way, the sensors' own states, the random walk's torque."""

    def __init__(self, parts: Parts, ticks: Any, opened: linear.Opened):
        loop: Any = opened.loop
        self._n, self._m, k = loop.a.shape[1], loop.command.shape[1], loop.seen.shape[2]
        self.plant = slice(0, opened.error.shape[2])
        sensors = parts.sensors.in_step()
        self._reading = reading = error_floor.reading_of(sensors, k, ticks)
        self._waiting = loop.delay * self._m
        before = self._n + self._waiting
        self._own = slice(before, before + reading.own.size)
        self.size = before + reading.own.size + self._m
        # errors of the readings: of a suite the noise of the next sample is among the coordinates of its memory, other
        # sensors have as many readings as the computer sees states
        self._seen, self.memory = k, self.plant.stop + k  # the memory of the sensors follows x and what was seen of it
        place = getattr(sensors, "noise_place", None)
        self._noise = None if place is None else slice(self.memory + place.start, self.memory + place.stop)
        self._from_readings = None if place is not None else np.linalg.pinv(reading.rows[:, :k])
        # by how much the state moves by itself in a second, 1 sigma: the random walk as a period begins, in which it
        # acts, the sensors' own states after its sample
        self.walk = np.concatenate([np.zeros(self.size - self._m), error_floor.walk_of(parts)])
        self.drift = np.concatenate([np.zeros(before), reading.own_drift, np.zeros(self._m)])

    def start(self) -> np.ndarray:
        """Covariance (size, size) before the first sample."""
        reading = self._reading
        factor = np.zeros((self.size, reading.own.size))
        factor[self._own] = np.diag(reading.own)
        if reading.start is not None:  # the filter's errors: of its attitude, and of its bias beside the gyro's
            start = np.zeros((self.size, 6))
            start[self.memory : self.memory + 6] = reading.start[1]
            factor[self.memory + 3 : self.memory + 6] = np.diag(reading.own)
            factor = np.hstack([factor, start])
        return factor @ factor.T

    def rows(self, by_z: Any, by_seen: Any) -> _Rows:
        """Rows of something by z and by what the computer sees, of NumPy; in each period where these are so."""
        by_state = np.pad(by_z, [(0, 0)] * (by_z.ndim - 1) + [(0, self.size - self._n)])
        by_errors = by_seen @ self._from_readings if self._noise is None else by_z[..., self._noise]
        by_state[..., : self._seen] += by_seen
        by_state[..., self._own] = by_errors @ self._reading.rows[:, self._seen :]
        return _Rows(by_state, by_errors * self._reading.noise)

    def moved(self, loops: Any) -> tuple[_Rows, _Rows]:
        """The command, and the whole state a period later, in each period; loops: a `linear.Loop` of numpy arrays."""
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
    """The covariance propagated along the run, and what it makes of error, command and s; widths of the sign."""
    lengths = ticks.t_next - ticks.t
    state = _State(parts, ticks, opened)
    p, sliding = state.start(), state.rows(opened.s_command, opened.s_direct)
    command, moved = state.moved(opened.loop)
    sloped = (None, None) if sign is None else state.moved(sign.loops)
    # of the error at the start of a period and in its middle, of s
    squares, torque, widths = np.zeros((len(lengths) + 1, 3)), 0.0, np.zeros(len(lengths))

    def square(error: Any) -> float:
        return float(np.trace(error @ p[state.plant, state.plant] @ error.T))

    for j, length in enumerate(lengths):
        s = sliding.at(j).covariance(p)
        squares[j] = square(opened.error[j]), 0.0, np.mean(np.diag(s))
        share = 0.0
        if sign is not None:
            widths[j] = _mean_width(sign.flown, min(float(np.sqrt(squares[j, 2])) / sign.units[j], BEYOND))
            share = sign.widths[j] / widths[j] if widths[j] > 0.0 else 1.0
        commanded = command.at(j, sloped[0], share).covariance(p)
        torque = max(torque, float(np.sqrt(np.diag(commanded).max())))
        later = moved.at(j, sloped[1], share)
        p = p + np.diag((state.walk * length) ** 2)
        squares[j, 1] = np.trace(_middle(opened, j, float(length), later, state.plant).covariance(p))
        p = later.covariance(p) + np.diag((state.drift * length) ** 2)
    squares[-1, 0] = square(opened.error[-1])
    error = error_floor.window_error(parts, ticks, np.stack([squares[:-1, 0], squares[:-1, 1], squares[1:, 0]], axis=1))
    t, t_f = ticks.t, float(parts.controller.t_f)
    in_window = (t >= t_f - 1e-9 * float(parts.period)) & (t <= t_f + float(parts.window))
    return Noise(error, torque, float(np.sqrt(np.mean(squares[:-1][in_window, 2])))), widths


def _middle(opened: linear.Opened, j: int, length: float, later: _Rows, plant: slice) -> _Rows:
    """The error in the middle of the j-th period, by the cubic that metrics draw, `integrators.hermite_middle`.

    later: the state a period later, without what the sensors' own states drift by then.
    """
    after = min(j + 1, len(opened.error) - 1)
    start = np.asarray(opened.error[j] / 2 + length / 8 * opened.error_rate[j])
    end = np.asarray(opened.error[after] / 2 - length / 8 * opened.error_rate[after])
    state = end @ later.state[plant]
    state[:, plant] += start
    return _Rows(state, end @ later.noise[plant])
