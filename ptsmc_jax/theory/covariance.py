"""What noise alone does to accuracy and torque: the covariance of the linearised loop, without flying a trial."""

from typing import Any, NamedTuple

import jax
import numpy as np

from ptsmc_jax.simulation.assembly import Parts
from ptsmc_jax.theory import error_floor, linear

ROUNDS = 8  # at most, in which the mean slope of a sign is found where s is not zero in the quiet run
BEYOND = 1e60  # stands for a size of s that is no number any more
FLAT = 1e30  # width of a sign without slope


class Noise(NamedTuple):
    """What noise alone does, 1 sigma."""

    window_error: float  # RMS over the window of the error's 2-norm, in the unit of the metric
    torque: float  # largest over time and axes of the command [N m]
    s: float  # of the sliding variable, RMS over the window and its components


def predicts(parts: Parts) -> bool:
    """Whether `noise` says what such sampled parts do under the noise of s, of any size [-].

    Not of implicit sampling: s lands at once where the noise is within what switching reaches in a period, and hardly
    beyond; which of these rules, no slope about the quiet run tells.
    """
    readable = parts.sensors is not None and hasattr(parts.sensors, "reading")
    return readable and parts.observer.linear and not getattr(parts.controller, "implicit", False)


def noise(parts: Parts) -> Noise:
    """Linear covariance along the nominal run of sampled parts that it `predicts`: what noise, bias, random walk cost.

    Behind an attitude filter its steady state is known at t = 0. The smooth sign counts in each period with the mean
    slope that it has under the noise of s there, E[sech^2(s / width)] / width (statistical linearisation), which the
    noise before it makes.
    """
    run = linear.nominal_jit(parts)
    ticks = jax.tree.map(np.asarray, run.period.now)
    lasting = np.flatnonzero(ticks.t_next - ticks.t > 1e-9 * float(parts.period))  # beyond rounding
    flown = getattr(parts.controller, "sign_width", None)
    if flown is None:
        return _covariance(parts, ticks, lasting, linear.opened_in(parts, run, lasting))[0]
    flat = linear.opened_in(parts, run, lasting, np.full(lasting.size, FLAT))
    noises = _State(parts, flat).seen_noise
    widths = np.asarray([_mean_width(float(flown), _size((by @ noises) ** 2)) for by in flat.s_direct])

    def with_slopes_of(widths: np.ndarray) -> tuple[Noise, np.ndarray]:
        sloped = linear.opened_in(parts, run, lasting, widths).loop
        return _covariance(parts, ticks, lasting, flat, _Sign(sloped, widths, float(flown)))

    sizes, found = with_slopes_of(widths)
    for _ in range(ROUNDS):
        if np.allclose(found, widths, rtol=0.01, atol=0.0):
            break
        widths = found
        sizes, found = with_slopes_of(widths)
    return sizes


class _Sign(NamedTuple):
    """The loops with a smooth sign of these widths, (periods,), and the width that is flown."""

    loops: Any
    widths: np.ndarray
    flown: float

    def loop(self, flat: Any, j: int, sigma: float) -> tuple[Any, float]:
        """The loop of a period under this noise of s, and the sign's width there: slopes of u go by 1/width.

        That is exact where s is zero in the quiet run, and else as near as the widths of these loops are.
        """
        width = _mean_width(self.flown, min(sigma, BEYOND))
        share = self.widths[j] / width if width > 0.0 else 1.0
        return jax.tree.map(lambda a, b: a + share * (b[j] - a), flat, self.loops), width


def _mean_width(width: float, sigma: float) -> float:
    """Width of the smooth sign whose slope at 0 is the mean slope under Gaussian noise of this size."""
    if sigma == 0.0:
        return width
    share = width / sigma
    at = np.linspace(-20.0, 20.0, 401) / max(1.0, share)  # in widths: steps of a tenth of what falls off sooner
    mean = np.trapezoid(np.exp(-((share * at) ** 2) / 2.0) / np.cosh(at) ** 2, at) / np.sqrt(2.0 * np.pi)
    return sigma / float(mean)


class _Rows(NamedTuple):
    """How something follows from the state that is propagated, and from the noise of this sample."""

    state: np.ndarray  # (rows, size)
    noise: np.ndarray  # (rows, readings), times 1 sigma

    def covariance(self, p: np.ndarray) -> np.ndarray:
        """Covariance (rows, rows), from that of the state before the sample, (size, size)."""
        return self.state @ p @ self.state.T + self.noise @ self.noise.T


class _State:
    """The state that is propagated: z, the commands on their way, the sensors' own states, the random walk's torque."""

    def __init__(self, parts: Parts, opened: linear.Opened):
        loop: Any = opened.loop
        self._n, self._m, k = loop.a.shape[1], loop.command.shape[1], loop.seen.shape[2]
        self.plant = slice(0, opened.error.shape[2])
        sensors = None if parts.sensors is None else parts.sensors.in_step()
        self._reading = reading = error_floor.reading_of(sensors, k, float(parts.period))
        self._waiting = loop.delay * self._m
        before = self._n + self._waiting
        self._own = slice(before, before + reading.own.size)
        self.size = before + reading.own.size + self._m
        # what the computer sees, by the state and by the noise
        from_readings = np.linalg.pinv(reading.rows[:, :k])
        self.seen_noise = from_readings * reading.noise  # (k, readings) of this sample alone, 1 sigma
        self._seen = _Rows(np.zeros((k, self.size)), self.seen_noise)
        self._seen.state[:, :k] = np.eye(k)
        self._seen.state[:, self._own] = from_readings @ reading.rows[:, k:]
        # by how much the state moves by itself in a second, 1 sigma
        self.drift = np.concatenate([np.zeros(before), reading.own_drift, error_floor.walk_of(parts)])

    def start(self) -> np.ndarray:
        """Covariance (size, size) before the first sample."""
        reading = self._reading
        factor = np.zeros((self.size, reading.own.size))
        factor[self._own] = np.diag(reading.own)
        if reading.start is not None:  # the filter's errors: of its attitude, and of its bias beside the gyro's
            start = np.zeros((self.size, 6))
            first = self.plant.stop + len(self._seen.state)  # after x and what the computer saw of it
            start[first : first + 6] = error_floor.root(reading.start[1])
            factor[first + 3 : first + 6] = np.diag(reading.own)
            factor = np.hstack([factor, start])
        return factor @ factor.T

    def rows(self, by_z: np.ndarray, by_seen: np.ndarray) -> _Rows:
        """Rows of something that follows from z, and from what the computer sees."""
        padded = np.pad(by_z, [(0, 0), (0, self.size - self._n)])
        return _Rows(padded + by_seen @ self._seen.state, by_seen @ self._seen.noise)

    def moved(self, loop: Any, command: _Rows) -> _Rows:
        """The whole state a period later; loop: a `linear.Loop` of numpy arrays."""
        n, m, waiting, new = self._n, self._m, self._waiting, loop.new[0]
        state, noise = np.eye(self.size), np.zeros((self.size, command.noise.shape[1]))
        state[:n], noise[:n] = self.rows(loop.a, loop.seen)
        state[:n, self.size - m :] += loop.disturbed
        if waiting:
            state[:n, n + waiting - m : n + waiting] += new
            state[n : n + waiting] = np.eye(self.size)[n - m : n + waiting - m]
            state[n : n + m], noise[n : n + m] = command
        else:
            state[:n] += new @ command.state
            noise[:n] += new @ command.noise
        return _Rows(state, noise)


def _covariance(
    parts: Parts, ticks: Any, lasting: np.ndarray, opened: linear.Opened, sign: _Sign | None = None
) -> tuple[Noise, np.ndarray]:
    """The covariance propagated along the run, and what it makes of error, command and s; widths of the sign."""
    lengths = ticks.t_next - ticks.t
    state = _State(parts, opened)
    p = state.start()
    squares, torque, widths = np.zeros((len(lasting), 2)), 0.0, np.zeros(len(lasting))  # of the error and of s
    for j, index in enumerate(lasting):
        row = jax.tree.map(lambda v, j=j: v[j], opened)
        s, loop = state.rows(row.s_command, row.s_direct).covariance(p), row.loop
        squares[j] = np.trace(row.error @ p[state.plant, state.plant] @ row.error.T), np.mean(np.diag(s))
        if sign is not None:
            loop, widths[j] = sign.loop(loop, j, float(np.sqrt(squares[j, 1])))
        command = state.rows(loop.command, loop.direct)
        torque = max(torque, float(np.sqrt(np.diag(command.covariance(p)).max())))
        p = state.moved(loop, command).covariance(p) + np.diag((state.drift * lengths[index]) ** 2)
    t, t_f = ticks.t[lasting], float(parts.controller.t_f)
    in_window = (t >= t_f - 1e-9) & (t <= t_f + float(parts.window))
    error, s_size = np.sqrt(np.mean(squares[in_window], axis=0))
    return Noise(float(error), torque, float(s_size)), widths


def _size(squares: np.ndarray) -> float:
    """RMS over components, (m,), from the shares (m, k) of what each is made of."""
    return float(np.sqrt(squares.sum(axis=1).mean()))
