"""Borders of stability of the sampled double integrator under proportional and derivative feedback, in closed form.

Near the reference each component of the attitude error obeys eps'' = a, with the law's a = -kp eps - kd eps' computed
from samples and held, periods later where there is a delay: kp and kd are (57)'s and (60)'s with the smooth sign's
slope. What bounds of gains and the lines of a map are drawn from, before there is a loop to linearise (`linear`).
"""

from collections.abc import Callable

import numpy as np


def gains(
    t: np.ndarray, t_f: float, eta: float, delta: float, k1: float, slope: float, surface_rate: float
) -> tuple[np.ndarray, np.ndarray]:
    """Gains kp [1/s^2] and kd [1/s], (times,) each.

    eta^2/tau^2 + slope eta/2 and (2 eta - 1)/tau + slope tau/2 before the hand-over; c k and c + k after it, with
    k = (K1 + slope)/2.

    Args:
        t: (times,) [s].
        t_f: the prescribed time [s].
        eta: exponent of the law [-].
        delta: how long before t_f it hands over [s].
        k1: K1 of (60) [1/s].
        slope: |T J^-1| K2 / width of the smooth sign [1/s^2].
        surface_rate: c [1/s].
    """
    tau = t_f - np.asarray(t, dtype=float)
    hold = tau <= delta * (1 + 1e-9)
    safe = np.where(hold, 1.0, tau)
    after = (k1 + slope) / 2
    kp = np.where(hold, surface_rate * after, eta**2 / safe**2 + slope * eta / 2)
    kd = np.where(hold, surface_rate + after, (2 * eta - 1) / safe + slope * safe / 2)
    return kp, kd


def _closed(kp: float, kd: float, h: float, delay: float) -> np.ndarray:
    """Matrix of a period of the frozen loop; delay: in periods, any number of at least 0."""
    whole = int(np.floor(delay))
    part = delay - whole  # the command of `whole` periods ago acts from here on, the one before until then
    n = 2 + whole + (part > 0)
    move = np.eye(n)
    move[0, 1] = h

    def push(share_from: float, share_to: float) -> tuple[float, float]:
        """Effect on eps and eps' of a unit acceleration between two shares of the period."""
        a, b = share_from * h, share_to * h
        return (h - a) ** 2 / 2 - (h - b) ** 2 / 2, b - a

    late_push, early_push = push(part, 1.0), push(0.0, part)
    feedback = np.array([-kp, -kd])
    # behind eps and eps' stand the commands waiting, the newest first
    if whole == 0:
        move[:2, :2] += np.outer(late_push, feedback)
    else:
        move[:2, 1 + whole] += late_push
    if part > 0:
        move[:2, 2 + whole] += early_push
    move[2:] = np.eye(n - 2, n, k=1)
    move[2:3, :2] = feedback
    return move


def radius(kp: float, kd: float, h: float, delay: float = 0.0) -> float:
    """Largest modulus of the frozen loop's poles: below 1 it is stable. h: period [s]; delay: in periods."""
    return float(np.abs(np.linalg.eigvals(_closed(kp, kd, h, delay))).max())


def _last(stable: Callable[[float], bool], low: float, high: float) -> float:
    """Largest number at which `stable` still holds, by bisection; inf where it holds at `high`."""
    if stable(high):
        return float("inf")
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if stable(middle) else (low, middle)
    return low


def implicit_gains(eta: float, tau: float) -> tuple[float, float]:
    """Gains kp, kd before the hand-over with implicit sampling and no switching term; tau: time to go in periods.

    From (1 - 1/tau)^eta s = s_0 + g a, see `laws.prescribed_time.PrescribedTimeLaw.next_s`: eta (1 - share) / g and
    (tau - 1 + eta - share tau) / g, g = tau - 1 + eta/2. On s = 0 the error falls by
    (1 - eta/(2 tau)) / (1 + eta/(2 (tau - 1))) in a period, below 1 in size for every tau >= 1.
    """
    share, g = (1.0 - 1.0 / tau) ** eta, tau - 1.0 + eta / 2
    return eta * (1.0 - share) / g, (tau - 1.0 + eta - share * tau) / g


def largest_index(eta: float, delay: float = 0.0, *, implicit: bool = False) -> float:
    """Largest (2 eta - 1) h / tau at which the frozen loop before the hand-over is stable: 2 without delay.

    implicit: with implicit sampling; infinite where it is stable down to a period before t_f.
    """

    def stable(index: float) -> bool:
        tau = (2 * eta - 1) / index
        kp, kd = implicit_gains(eta, tau) if implicit else ((eta / tau) ** 2, (2 * eta - 1) / tau)
        return radius(kp, kd, 1.0, delay) < 1.0

    return _last(stable, 1e-6, (2 * eta - 1) * (1 - 1e-9) if implicit else 4.0)


def smallest_delta(eta: float, h: float, delay: float = 0.0, *, anchored: bool = True, implicit: bool = False) -> float:
    """Smallest delta [s] for which the last sample before the hand-over is stable.

    On the anchored clock it lies at tau = delta + h: without delay (eta - 3/2) h, never below 0. On the flight clock it
    may lie at the hand-over itself: (eta - 1/2) h. With implicit sampling, whose last such period ends before the
    hand-over, it lies a period earlier on either; without delay there is no border: 0.
    """
    before = float(anchored) + float(implicit)
    return max(0.0, ((2 * eta - 1) / largest_index(eta, delay, implicit=implicit) - before) * h)


def largest_surface(delay: int = 0, *, implicit: bool = False) -> float:
    """Largest c h for which some k, however small, leaves the frozen loop after the hand-over stable [-].

    As k goes to 0 its poles are 1, which any k moves inwards, and those of z^d (z - 1) + c h: inside the unit circle up
    to c h = 2 sin(pi / (4 d + 2)), which is 2 without delay. With implicit sampling c h / (1 + c h/2) stands in place
    of c h: infinite without delay. delay: d, in periods.
    """
    border = 2.0 * float(np.sin(np.pi / (4 * delay + 2)))
    if not implicit:
        return border
    return border / (1.0 - border / 2) if delay else float("inf")


def largest_reaching(surface: float, delay: float = 0.0, *, implicit: bool = False) -> float:
    """Largest k h at which the frozen loop after the hand-over is stable for c h = surface [-]; k = K1/2 (60).

    2 - c h without delay, 0 where c h alone is beyond the border; k and c may change places. delay: in periods.
    The slope of a smooth sign counts as part of K1. A digital observer moves nothing: its error falls by e^(-l J^-1 h)
    a period whatever the loop does, as long as it knows the torque that acts.

    implicit: with implicit sampling, in which e^(-k h) of s is left after a period: infinite without delay.
    """

    def stable(reaching: float) -> bool:
        kp, kd = surface * reaching, surface + reaching
        if implicit:
            moved = -np.expm1(-reaching)
            kp, kd = surface * moved / (1 + surface / 2), (surface + moved) / (1 + surface / 2)
        return radius(kp, kd, 1.0, delay) < 1.0

    return _last(stable, 1e-6, 40.0 if implicit else 4.0) if stable(1e-6) else 0.0
