"""Stability limits of the sampled double integrator under proportional and derivative feedback.

Near the reference each component of the attitude error obeys eps'' = a with a = -kp eps - kd eps'. The command a is
computed from a sample, may be delayed and is then held for a period. The gains follow from (57) and (60), with the time
to go tau and k = (K1 + g)/2, where g is the derivative of the switching term in the boundary layer:

    before the hand-over: kp = eta^2/tau^2 + g eta/2,  kd = (2 eta - 1)/tau + g tau/2
    after the hand-over:  kp = c k,                    kd = c + k

The tuner derives its gain bounds, and maps their stability lines, from these limits; the linearised loop (`linear`) is
not needed for them.
"""

from collections.abc import Callable

import numpy as np


def _transition_matrix(kp: float, kd: float, h: float, delay: float) -> np.ndarray:
    """Return the transition matrix (n, n) of the frozen loop over one period.

    Args:
        kp: proportional gain [1/s^2].
        kd: derivative gain [1/s].
        h: control period [s].
        delay: delay of the command in periods, whole or fractional, at least 0.
    """
    whole = int(np.floor(delay))
    # after this fraction of the period, the command of `whole` periods ago replaces the older command
    fraction = delay - whole
    n = 2 + whole + (fraction > 0)
    move = np.eye(n)
    move[0, 1] = h

    def acceleration_effect(begin: float, end: float) -> tuple[float, float]:
        """Return the changes of eps and eps' at the end of the period by a unit acceleration from `begin` to `end`."""
        a, b = begin * h, end * h
        return (h - a) ** 2 / 2 - (h - b) ** 2 / 2, b - a

    late_push, early_push = acceleration_effect(fraction, 1.0), acceleration_effect(0.0, fraction)
    feedback = np.array([-kp, -kd])
    # the state is eps, eps' and the delayed commands, newest first
    if whole == 0:
        move[:2, :2] += np.outer(late_push, feedback)
    else:
        move[:2, 1 + whole] += late_push
    if fraction > 0:
        move[:2, 2 + whole] += early_push
    move[2:] = np.eye(n - 2, n, k=1)
    move[2:3, :2] = feedback
    return move


def spectral_radius(kp: float, kd: float, h: float, delay: float = 0.0) -> float:
    """Return the spectral radius of the frozen loop [-]. The loop is stable below 1.

    Args:
        kp: proportional gain [1/s^2].
        kd: derivative gain [1/s].
        h: control period [s].
        delay: delay of the command in periods, whole or fractional, at least 0.
    """
    return float(np.abs(np.linalg.eigvals(_transition_matrix(kp, kd, h, delay))).max())


def _largest_stable(is_stable: Callable[[float], bool], low: float, high: float) -> float:
    """Return the largest number for which `is_stable` is true, by bisection, or infinity if it is true at `high`."""
    if is_stable(high):
        return float("inf")
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if is_stable(middle) else (low, middle)
    return low


def implicit_gains(eta: float, tau: float) -> tuple[float, float]:
    """Return kp and kd before the hand-over for implicit sampling without switching term, with the period as unit.

    They solve (1 - 1/tau)^eta s = s_0 + g a, see `laws.prescribed_time.PrescribedTimeLaw.next_s`:

        kp = eta (1 - decay) / g,  kd = (tau - 1 + eta - decay tau) / g,  decay = (1 - 1/tau)^eta,  g = tau - 1 + eta/2

    On s = 0 a period multiplies the error by

        (1 - eta/(2 tau)) / (1 + eta/(2 (tau - 1))),

    whose modulus is below 1 for every tau >= 1.

    Args:
        eta: exponent of the law [-].
        tau: time to go in periods.
    """
    decay, g = (1.0 - 1.0 / tau) ** eta, tau - 1.0 + eta / 2
    return eta * (1.0 - decay) / g, (tau - 1.0 + eta - decay * tau) / g


def largest_index(eta: float, delay: float = 0.0, *, implicit: bool = False) -> float:
    """Return the largest (2 eta - 1) h / tau with a stable frozen loop before the hand-over [-]; 2 without delay.

    Args:
        eta: exponent of the law [-].
        delay: delay of the command in periods.
        implicit: whether the law uses implicit sampling. The result is then infinite if the loop is stable until one
            period before t_f.
    """

    def is_stable(index: float) -> bool:
        tau = (2 * eta - 1) / index
        kp, kd = implicit_gains(eta, tau) if implicit else ((eta / tau) ** 2, (2 * eta - 1) / tau)
        return spectral_radius(kp, kd, 1.0, delay) < 1.0

    return _largest_stable(is_stable, 1e-6, (2 * eta - 1) * (1 - 1e-9) if implicit else 4.0)


def smallest_delta(eta: float, h: float, delay: float = 0.0, *, anchored: bool = True, implicit: bool = False) -> float:
    """Return the smallest delta [s] that keeps the frozen loop stable at the last sample before the hand-over.

    The limit depends on the time to go tau at that sample. The anchored clock has tau = delta + h, so that the smallest
    delta is (eta - 3/2) h without delay. The flight clock may have tau = delta, so that it is (eta - 1/2) h.

    With implicit sampling, tau is one period longer on both clocks: a period that ends in the hold phase already uses
    the gains of the hold phase. Without delay the loop is then stable for every tau, and the result is 0.

    Args:
        eta: exponent of the law [-].
        h: control period [s].
        delay: delay of the command in periods.
        anchored: whether the clock is the anchored one; otherwise it is the flight clock.
        implicit: whether the law uses implicit sampling.
    """
    extra_periods = float(anchored) + float(implicit)
    return max(0.0, ((2 * eta - 1) / largest_index(eta, delay, implicit=implicit) - extra_periods) * h)


def largest_surface(delay: int = 0, *, implicit: bool = False) -> float:
    """Return the upper limit of c h for a stable frozen loop after the hand-over, if k may be arbitrarily small [-].

    For k -> 0 one pole is 1, and any positive k moves it inwards. The other poles are the roots of z^d (z - 1) + c h.
    They are inside the unit circle below c h = 2 sin(pi / (4 d + 2)), which is 2 without delay. Implicit sampling
    replaces c h by c h / (1 + c h/2), and the limit without delay is then infinite.

    Args:
        delay: d, delay of the command in whole periods.
        implicit: whether the law uses implicit sampling.
    """
    limit = 2.0 * float(np.sin(np.pi / (4 * delay + 2)))
    if not implicit:
        return limit
    return limit / (1.0 - limit / 2) if delay else float("inf")


def largest_reaching(surface: float, delay: float = 0.0, *, implicit: bool = False) -> float:
    """Return the largest k h with a stable frozen loop after the hand-over [-], where k = K1/2 (60).

    Without delay it is 2 - c h. It is 0 if c h alone exceeds its limit (`largest_surface`). The condition is symmetric
    in k and c. The derivative of the switching term in the boundary layer counts as part of K1. A digital observer does
    not change the limit: if it knows the applied torque, its error decays by e^(-l J^-1 h) per period in every loop.

    Args:
        surface: c h [-].
        delay: delay of the command in periods.
        implicit: whether the law uses implicit sampling, which multiplies s by e^(-k h) per period. The result is then
            infinite without delay.
    """

    def is_stable(reaching: float) -> bool:
        kp, kd = surface * reaching, surface + reaching
        if implicit:
            decrease = -np.expm1(-reaching)
            kp, kd = surface * decrease / (1 + surface / 2), (surface + decrease) / (1 + surface / 2)
        return spectral_radius(kp, kd, 1.0, delay) < 1.0

    return _largest_stable(is_stable, 1e-6, 40.0 if implicit else 4.0) if is_stable(1e-6) else 0.0
