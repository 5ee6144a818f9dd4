"""The sampled loop linearised, an axis at a time: stability, margins, and what sensor noise does to accuracy.

Near the reference each component of the attitude error obeys eps'' = a + d / (2 J), with the law's
a = -kp eps - kd eps' - d_hat / (2 J) computed from samples and held (zero-order hold), whole periods late where there
is a delay. The gains are (57)'s and (60)'s with the smooth sign's slope; raw samples, no filter, no actuator but delay.
"""

import typing
from dataclasses import dataclass
from typing import Any

import numpy as np

from ptsmc_jax.rollout import Parts


def gains(
    t: np.ndarray, t_f: float, eta: float, delta: float, k1: float, slope: float, surface_rate: float
) -> tuple[np.ndarray, np.ndarray]:
    """Gains kp [1/s^2] and kd [1/s], (times,), at times t [s]; slope: |T J^-1| K2 / width of the smooth sign [1/s^2].

    eta^2/tau^2 + slope eta/2 and (2 eta - 1)/tau + slope tau/2 before the hand-over; c k and c + k after it, with
    k = (K1 + slope)/2 and c the surface_rate [1/s].
    """
    tau = t_f - np.asarray(t, dtype=float)
    hold = tau <= delta * (1 + 1e-9)
    safe = np.where(hold, 1.0, tau)
    after = (k1 + slope) / 2
    kp = np.where(hold, surface_rate * after, eta**2 / safe**2 + slope * eta / 2)
    kd = np.where(hold, surface_rate + after, (2 * eta - 1) / safe + slope * safe / 2)
    return kp, kd


def _closed(kp: float, kd: float, h: float, late: float) -> np.ndarray:
    """Matrix of a period of the frozen loop; late: delay in periods, any number of at least 0."""
    whole = int(np.floor(late))
    part = late - whole  # the command of `whole` periods ago acts from here on, the one before until then
    n = 2 + whole + (part > 0)
    move = np.eye(n)
    move[0, 1] = h

    def push(share_from: float, share_to: float) -> tuple[float, float]:
        """Effect on eps and eps' of a unit acceleration between two shares of the period."""
        a, b = share_from * h, share_to * h
        return (h - a) ** 2 / 2 - (h - b) ** 2 / 2, b - a

    late_push, early_push = push(part, 1.0), push(0.0, part)
    feedback = np.array([-kp, -kd])
    columns = list(range(2, n))  # commands waiting, the newest first
    if whole == 0:
        move[:2, :2] += np.outer(late_push, feedback)
    else:
        move[:2, columns[whole - 1]] += late_push
    if part > 0:
        move[:2, columns[whole]] += early_push
    for k in reversed(range(len(columns))):
        move[columns[k], :] = 0.0
        if k == 0:
            move[columns[k], :2] = feedback
        else:
            move[columns[k], columns[k - 1]] = 1.0
    return move


def radius(kp: float, kd: float, h: float, late: float = 0.0) -> float:
    """Largest modulus of the frozen loop's poles: below 1 it is stable. h: period [s]; late: delay in periods."""
    return float(np.abs(np.linalg.eigvals(_closed(kp, kd, h, late))).max())


def _last(stable, low: float, high: float) -> float:
    """Largest number at which `stable` still holds, by bisection; inf where it holds at `high`."""
    if stable(high):
        return float("inf")
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if stable(middle) else (low, middle)
    return low


def largest_index(eta: float, late: float = 0.0) -> float:
    """Largest (2 eta - 1) h / tau at which the frozen loop before the hand-over is stable: 2 without delay."""

    def stable(index: float) -> bool:
        tau = (2 * eta - 1) / index
        return radius((eta / tau) ** 2, (2 * eta - 1) / tau, 1.0, late) < 1.0

    return _last(stable, 1e-6, 4.0)


def smallest_delta(eta: float, h: float, late: float = 0.0, *, anchored: bool = True) -> float:
    """Smallest delta [s] for which the last sample before the hand-over is stable.

    On the anchored clock it lies at tau = delta + h: without delay (eta - 3/2) h, never below 0. On the flight clock it
    may lie at the hand-over itself: (eta - 1/2) h.
    """
    return max(0.0, ((2 * eta - 1) / largest_index(eta, late) - float(anchored)) * h)


def largest_reaching(surface: float, late: float = 0.0) -> float:
    """Largest k h at which the frozen loop after the hand-over is stable for c h = surface [-]; k = K1/2 (60).

    2 - c h without delay, 0 where c h alone is beyond the border; k and c may change places. late: delay in periods.
    The slope of a smooth sign counts as part of K1. A digital observer moves nothing: its error falls by e^(-l J^-1 h)
    a period whatever the loop does, as long as it knows the torque that acts.
    """

    def stable(reaching: float) -> bool:
        return radius(surface * reaching, surface + reaching, 1.0, late) < 1.0

    return _last(stable, 1e-6, 4.0) if stable(1e-6) else 0.0


@dataclass(frozen=True)
class Margins:
    """Of the frozen loop at one instant."""

    index: float  # (2 eta - 1) h / tau, kd h in hold
    radius: float  # largest modulus of the poles
    gain: float  # factor on the gains up to which it is stable
    delay: float  # further delay up to which it is stable [s]


def margins(parts: Parts) -> dict[str, Margins]:
    """Stability margins of a sampled run's law: at the last sample before the hand-over and in hold."""
    law, clock = parts.controller, typing.cast(Any, parts.clock)
    h, late = float(clock.period), float(0 if parts.actuators is None else parts.actuators.delay)
    t_f, eta, delta, k1, rate = (float(v) for v in (law.t_f, law.eta, law.delta, law.k1, law.surface_rate))
    found = {}
    for name, tau in (("hand_over", delta + h), ("hold", 0.0)):
        kp, kd = (float(v) for v in gains(np.asarray(t_f - tau), t_f, eta, delta, k1, 0.0, rate))
        gain = _last(lambda g, kp=kp, kd=kd: radius(g * kp, g * kd, h, late) < 1.0, 1e-6, 1e6)
        delay = _last(lambda d, kp=kp, kd=kd: radius(kp, kd, h, late + d) < 1.0, 0.0, 200.0) * h
        if not np.isfinite(delay):  # beyond 200 periods the loop is as good as continuous: its phase margin
            square = (kd**2 + np.sqrt(kd**4 + 4 * kp**2)) / 2
            delay = float(np.arctan2(kd * np.sqrt(square), kp) / np.sqrt(square) - h / 2 - late * h)
        stable = radius(kp, kd, h, late)
        found[name] = Margins(kd * h, stable, gain, delay if stable < 1.0 else 0.0)
    return found


@dataclass(frozen=True)
class Noise:
    """What sensor noise alone does, 1 sigma."""

    window_error: float  # RMS over the window of the error vector's 2-norm [-]
    torque: float  # largest over time and axes [N m]


def noise(parts: Parts) -> Noise:
    """Linear covariance of a sampled run with raw samples: accuracy and torque that its noise costs.

    The covariance of (eps, eps', estimate, last measured rate, commands on their way) is carried from sample to
    sample, once per axis of a diagonal inertia (of a full one: its diagonal).
    """
    law, clock, sensors = parts.controller, typing.cast(Any, parts.clock), parts.sensors
    h, late = float(clock.period), 0 if parts.actuators is None else int(parts.actuators.delay)
    t_f, eta, delta, k1, width = (float(v) for v in (law.t_f, law.eta, law.delta, law.k1, law.sign_width))
    rate = float(law.surface_rate)
    bound = parts.observer.error_bound()
    k2 = float(bound.floor)
    push = float(np.linalg.norm(np.asarray(law.model.inertia_inverse)))
    slope = push * k2 / width if width > 0.0 else 0.0
    t = np.arange(int(np.ceil((t_f + float(parts.window)) / h)) + 1) * h
    kp, kd = gains(t, t_f, eta, delta, k1, slope, rate)
    inertia = np.diag(np.asarray(law.model.inertia))
    gain = np.asarray(getattr(parts.observer, "gain", np.zeros(3)))
    variance, torque = np.zeros(len(t)), 0.0
    drive = np.diag([(float(sensors.attitude_noise) / 2) ** 2, (float(sensors.rate_noise) / 2) ** 2])
    for axis in range(3):
        keep = float(np.exp(-gain[axis] / inertia[axis] * h))
        n = 5 + late  # eps, eps', estimate, last measured eps', command that acts, commands waiting (newest last)
        p = np.zeros((n, n))
        for k in range(len(t)):
            variance[k] += p[0, 0]
            sample, enter = np.eye(n), np.zeros((n, 2))
            # the estimate from the period just ended
            sample[2] = 0.0
            sample[2, 2], sample[2, 1], sample[2, 3], sample[2, 4] = keep, (1 - keep) / h, -(1 - keep) / h, -(1 - keep)
            enter[2, 1] = (1 - keep) / h
            sample[3] = 0.0
            sample[3, 1], enter[3, 1] = 1.0, 1.0
            command = -sample[2] - kp[k] * np.eye(n)[0] - kd[k] * np.eye(n)[1]
            noisy = -enter[2] - np.array([kp[k], kd[k]])
            if late == 0:
                sample[4], enter[4] = command, noisy
            else:
                sample[4] = np.eye(n)[5]
                for j in range(5, n - 1):
                    sample[j] = np.eye(n)[j + 1]
                sample[n - 1], enter[n - 1] = command, noisy
            spread = command @ p @ command + noisy @ drive @ noisy
            torque = max(torque, 2 * inertia[axis] * float(np.sqrt(spread)))
            fly = np.eye(n)
            fly[0, 1], fly[0, 4], fly[1, 4] = h, h * h / 2, h
            p = fly @ (sample @ p @ sample.T + enter @ drive @ enter.T) @ fly.T
    late_on = t >= t_f - 1e-9
    return Noise(float(np.sqrt(np.mean(variance[late_on]))), torque)
