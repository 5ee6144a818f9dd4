"""Logs of a spacecraft with wheels from an independent simulation in NumPy: integration, noise and devices."""

import numpy as np
import polars as pl

SPIN_INERTIA = 1e-5  # of each wheel [kg m^2]


def cross(a, b):
    """Return the cross products (.., 3) of vectors (.., 3)."""
    return np.stack([
        a[..., 1] * b[..., 2] - a[..., 2] * b[..., 1],
        a[..., 2] * b[..., 0] - a[..., 0] * b[..., 2],
        a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0],
    ], axis=-1)  # fmt: skip


def multiply(p, q):
    """Return the products (.., 4) of quaternions (.., 4), scalar last."""
    v = p[..., 3:] * q[..., :3] + q[..., 3:] * p[..., :3] + cross(p[..., :3], q[..., :3])
    return np.concatenate([v, p[..., 3:] * q[..., 3:] - np.sum(p[..., :3] * q[..., :3], -1, keepdims=True)], -1)


def small(turn):
    """Return the quaternions (.., 4), scalar last, of rotation vectors (.., 3) [rad]."""
    angle = np.linalg.norm(turn, axis=-1, keepdims=True)
    return np.concatenate([0.5 * np.sinc(angle / (2.0 * np.pi)) * turn, np.cos(angle / 2.0)], -1)


def logs(
    rng, inertia, count=1, *, dt=0.1, rows=600, torque=1e-3, slews=3, wheels=False, scale=(1.0, 1.0, 1.0), lag=0.0,
    star=5e-5, gyro=1.4e-4, bias=1e-4, walk=0.0, rate=(0.0, 0.0, 0.0),
    disturbance=lambda t: np.zeros(3), command=None,
):  # fmt: skip
    """Return frames with the columns of `trajectory.csv`, and the true gyro bias of each at its end [rad/s].

    The columns speed1 to speed3 have the speeds of the wheels relative to the body [rad/s].

    The torque has `slews` smooth slews about random axes, each with an acceleration and a deceleration.

    Args:
        rng: random numbers.
        inertia: true inertia (3, 3) [kg m^2].
        count: number of logs.
        dt: sample interval [s].
        rows: number of samples.
        torque: size of the torque [N m].
        slews: number of slews.
        wheels: the torque comes from three wheels, whose momentum couples with the rate.
        scale: ratio of true to commanded torque of each axis.
        lag: time constant of the torque [s].
        star: 1 sigma of the star tracker [rad].
        gyro: 1 sigma of the gyro [rad/s].
        bias: 1 sigma of its bias [rad/s].
        walk: density of the walk of its bias [rad/s/sqrt(s)].
        rate: body rate at the start [rad/s].
        disturbance: time [s] -> torque (3,) [N m].
        command: torque (rows, 3) of all logs instead of the slews [N m].
    """
    t, inverse = dt * np.arange(rows), np.linalg.inv(inertia)
    axes = rng.standard_normal((count, slews, 3))
    axes /= np.max(np.abs(axes), axis=2, keepdims=True)
    length = t[-1] / slews
    place = np.minimum((t / length).astype(int), slews - 1)
    slew_torque = torque * axes[:, place] * np.sin(2.0 * np.pi * (t - place * length) / length)[:, None]
    command = slew_torque if command is None else np.tile(command, (count, 1, 1))
    q, w, h = np.tile([0.0, 0.0, 0.0, 1.0], (count, 1)), np.tile(rate, (count, 1)), np.zeros((count, 3))
    v = np.zeros((count, 3))
    drift = bias * rng.standard_normal((count, 3))
    attitudes, rates, speeds = [], [], []
    steps = 4
    for k in range(rows):
        if k:
            drift = drift + walk * np.sqrt(dt) * rng.standard_normal((count, 3))
        attitudes.append(multiply(q, small(star * rng.standard_normal((count, 3)))))
        rates.append(w + drift + gyro * rng.standard_normal((count, 3)))
        speeds.append(h / SPIN_INERTIA - w)
        target = command[:, k]
        for j in range(steps):
            s = dt / steps

            def torques(time, target=target, v=v, s=s):
                return np.asarray(scale) * (target + (v - target) * np.exp(-time / lag) if lag else target)

            def derive(state, time, at=t[k] + j * s, torques=torques):
                q, w, h = state[:, :4], state[:, 4:7], state[:, 7:]
                u = torques(time)
                stored = h if wheels else 0.0 * h
                push = u + disturbance(at + time) - cross(w, w @ inertia.T + stored)
                q_dot = 0.5 * multiply(q, np.concatenate([w, 0.0 * w[:, :1]], 1))
                return np.concatenate([q_dot, push @ inverse.T, -u], 1)

            y = np.concatenate([q, w, h], 1)
            k1 = derive(y, 0.0)
            k2 = derive(y + s / 2 * k1, s / 2)
            k3 = derive(y + s / 2 * k2, s / 2)
            k4 = derive(y + s * k3, s)
            y = y + s / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
            q, w, h = y[:, :4] / np.linalg.norm(y[:, :4], axis=1, keepdims=True), y[:, 4:7], y[:, 7:]
            v = target + (v - target) * np.exp(-s / lag) if lag else target
    attitudes, rates, speeds = np.stack(attitudes, 1), np.stack(rates, 1), np.stack(speeds, 1)
    frames = []
    for k in range(count):
        columns = {"t": t}
        blocks = {"measured_q": attitudes[k], "measured_w": rates[k], "sent": command[k], "speed": speeds[k]}
        for name, block in blocks.items():
            columns |= {f"{name}{i + 1}": block[:, i] for i in range(block.shape[1])}
        frames.append(pl.DataFrame(columns))
    return frames, drift


def spoiled(frame, rng, outliers=0.01, missing=0.3):
    """Return a log with gross outliers and missing samples of star tracker and gyro.

    outliers, missing: fractions of the rows. Missing samples are NaN.
    """
    columns = {name: frame[name].to_numpy().copy() for name in frame.columns}
    for block, size in (("measured_q", 4), ("measured_w", 3)):
        names = [f"{block}{k + 1}" for k in range(size)]
        for row in rng.choice(frame.height, round(outliers * frame.height), replace=False):
            wild = rng.standard_normal(size)
            for name, value in zip(names, wild / np.linalg.norm(wild), strict=True):
                columns[name][row] = value
        for row in rng.choice(frame.height, int(missing * frame.height), replace=False):
            for name in names:
                columns[name][row] = np.nan
    return pl.DataFrame(columns)
