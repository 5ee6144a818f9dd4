"""What noise alone does to accuracy and torque: the covariance of the linearised loop, without flying a trial."""

from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ptsmc_jax.simulation.assembly import Parts
from ptsmc_jax.theory import error_floor, linear

ROUNDS = 24  # at most, in which the mean slope of a sign and the noise that it leaves of s are found
BEYOND = 1e60  # stands for a size of s that is no number any more


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

    Behind an attitude filter its steady state is known at t = 0. The smooth sign counts with the mean slope that it has
    under the noise of s, E[sech^2(s / width)] / width (statistical linearisation): a few rounds find both.
    """
    run = linear.nominal_jit(parts)
    sizes = _covariance(parts, run)
    flown = getattr(parts.controller, "sign_width", None)
    if flown is None:
        return sizes
    width, apart, low, high = float(flown), np.inf, 0.0, np.inf  # low, high: between which it lies
    for _ in range(ROUNDS):
        left = sizes.s if np.isfinite(sizes.s) else BEYOND
        before, wanted = apart, _mean_width(float(flown), left)
        if abs(wanted - width) <= 0.01 * wanted or high < 1.001 * low:
            break
        low, high = (width, high) if wanted > width else (low, width)
        apart = abs(np.log(wanted / width)) if width > 0.0 else np.inf
        # a slope that much noise leaves may let the loop come to rest, and the one that little leaves may not
        halved = low > 0.0 and high < np.inf and (apart > 0.1 * before or not low < wanted < high)
        width = float(np.sqrt(low * high)) if halved else wanted
        law = replace(parts.controller, sign_width=jnp.full_like(parts.controller.sign_width, width))
        sizes = _covariance(replace(parts, controller=law), run)
    return sizes


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
        self._seen = _Rows(np.zeros((k, self.size)), from_readings * reading.noise)
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


def _covariance(parts: Parts, run: linear.Nominal) -> Noise:
    """The covariance propagated along the run, and what it makes of error, command and s."""
    ticks = jax.tree.map(np.asarray, run.period.now)
    lengths = ticks.t_next - ticks.t
    lasting = np.flatnonzero(lengths > 1e-9 * float(parts.period))  # beyond rounding
    opened = linear.opened_in(parts, run, lasting)
    state = _State(parts, opened)
    p = state.start()
    squares, torque = np.zeros((len(lasting), 2)), 0.0  # of the error and of s
    for j, index in enumerate(lasting):
        row = jax.tree.map(lambda v, j=j: v[j], opened)
        command = state.rows(row.loop.command, row.loop.direct)
        s = state.rows(row.s_command, row.s_direct)
        torque = max(torque, float(np.sqrt(np.diag(command.covariance(p)).max())))
        squares[j, 0] = np.trace(row.error @ p[state.plant, state.plant] @ row.error.T)
        squares[j, 1] = np.mean(np.diag(s.covariance(p)))
        p = state.moved(row.loop, command).covariance(p) + np.diag((state.drift * lengths[index]) ** 2)
    t, t_f = ticks.t[lasting], float(parts.controller.t_f)
    in_window = (t >= t_f - 1e-9) & (t <= t_f + float(parts.window))
    error, s = np.sqrt(np.mean(squares[in_window], axis=0))
    return Noise(float(error), torque, float(s))
