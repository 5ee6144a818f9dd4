"""What noise alone does to accuracy and torque: the covariance of the linearised loop, without flying a trial."""

from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ptsmc_jax.devices.sensors import Reading
from ptsmc_jax.simulation.assembly import Parts
from ptsmc_jax.theory import error_floor, linear


class Noise(NamedTuple):
    """What noise alone does, 1 sigma."""

    window_error: float  # RMS over the window of the error's 2-norm, in the unit of the metric
    torque: float  # largest over time and axes of the command [N m]
    s: float  # of the sliding variable, RMS over the window and its components


def noise(parts: Parts) -> Noise:
    """Linear covariance along the nominal run of sampled parts: what sensor noise, bias and random walk cost.

    Behind an attitude filter its steady state is known at t = 0. The smooth sign counts with the mean slope that it has
    under the noise of s, E[sech^2(s / width)] / width (statistical linearisation): a few rounds find both.
    """
    run = linear.nominal_jit(parts)
    sizes = _covariance(parts, run)
    flown = getattr(parts.controller, "sign_width", None)
    if flown is None:
        return sizes
    width = float(flown)
    for _ in range(4):
        before, width = width, _mean_width(float(flown), sizes.s)
        if np.isclose(width, before, rtol=0.01):
            break
        law = replace(parts.controller, sign_width=jnp.full_like(parts.controller.sign_width, width))
        sizes = _covariance(replace(parts, controller=law), run)
    return sizes


def _mean_width(width: float, sigma: float) -> float:
    """Width of the smooth sign whose slope at 0 is the mean slope under Gaussian noise of this size."""
    if sigma == 0.0:
        return width
    at, weight = np.polynomial.hermite_e.hermegauss(101)
    if width < 0.05 * sigma:  # as good as the exact sign
        return float(np.sqrt(np.pi / 2) * np.hypot(sigma, width))
    mean = np.sum(weight / np.cosh(np.minimum(np.abs(at) * sigma / width, 300.0)) ** 2) / np.sum(weight)
    return width / float(mean)


def _covariance(parts: Parts, run: linear.Nominal) -> Noise:
    """Propagated: z, the commands on their way, the sensor's own states and the random walk's torque."""
    ticks = jax.tree.map(np.asarray, run.period.now)
    h = float(parts.period)
    lasting = np.flatnonzero(ticks.t_next - ticks.t > 1e-9 * h)
    rows: Any = linear.opened_in(parts, run, lasting)
    loops = rows.loop
    n, m, k, whole = loops.a.shape[1], loops.command.shape[1], loops.seen.shape[2], rows.error.shape[2]
    none = Reading(np.eye(k), np.zeros(k), np.ones(k, int), np.zeros(0), np.zeros(0))
    sensors = None if parts.sensors is None else parts.sensors.in_step()
    reading: Reading = none if sensors is None else sensors.reading(h)
    waiting, own = loops.delay * m, reading.own.size
    size = n + waiting + own + m
    own_states, walk = slice(n + waiting, n + waiting + own), slice(size - m, size)
    walked = np.zeros(m) if parts.walk_rate is None else np.asarray(parts.walk_rate)
    factor = np.zeros((size, own))
    factor[own_states] = np.diag(reading.own)
    if reading.start is not None:  # the filter's errors: of its attitude, and of its bias beside the gyro's
        start = np.zeros((size, 6))
        first = whole + k  # after x and what the computer saw of it
        start[first : first + 6] = error_floor.root(reading.start[1])
        factor[first + 3 : first + 6] = np.diag(reading.own)
        factor = np.hstack([factor, start])
    p = factor @ factor.T
    reads = np.zeros((k, size))  # x_seen
    from_readings = np.linalg.pinv(reading.rows[:, :k])
    reads[:, :k], reads[:, own_states] = np.eye(k), from_readings @ reading.rows[:, k:]
    noisy = from_readings * reading.noise
    squares, torque = np.zeros((len(lasting), 2)), 0.0
    for j, index in enumerate(lasting):
        row = jax.tree.map(lambda v, j=j: v[j], rows)
        loop, dt = row.loop, float(ticks.t_next[index] - ticks.t[index])

        def wide(by_z: np.ndarray, by_seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            """Rows by the whole state, and by this sample's noise."""
            return np.pad(by_z, [(0, 0), (0, size - n)]) + by_seen @ reads, by_seen @ noisy

        (sends, sent), (slides, slid), (moved, entered) = (
            wide(*both) for both in ((loop.command, loop.direct), (row.s_command, row.s_direct), (loop.a, loop.seen))
        )
        moves, enters = np.eye(size), np.zeros((size, noisy.shape[1]))
        moves[:n], enters[:n] = moved, entered
        moves[:n, walk] += loop.disturbed
        if waiting:
            moves[:n, n + waiting - m : n + waiting] += loop.new[0]
            moves[n : n + waiting] = np.eye(size)[n - m : n + waiting - m]
            moves[n : n + m], enters[n : n + m] = sends, sent
        else:
            moves[:n], enters[:n] = moves[:n] + loop.new[0] @ sends, enters[:n] + loop.new[0] @ sent
        torque = max(torque, float(np.sqrt(np.diag(sends @ p @ sends.T + sent @ sent.T).max())))
        squares[j] = (
            np.trace(row.error @ p[:whole, :whole] @ row.error.T),
            np.mean(np.diag(slides @ p @ slides.T + slid @ slid.T)),
        )
        drift = np.concatenate([np.zeros(n + waiting), reading.own_drift * dt, walked * dt])
        p = moves @ p @ moves.T + enters @ enters.T + np.diag(drift**2)
    t, t_f = ticks.t[lasting], float(parts.controller.t_f)
    late = (t >= t_f - 1e-9) & (t <= t_f + float(parts.window))
    error, s = np.sqrt(np.mean(squares[late], axis=0))
    return Noise(float(error), torque, float(s))
