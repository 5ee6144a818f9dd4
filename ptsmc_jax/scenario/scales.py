"""Between which values the gains of a sampled run matter and are stable.

A period h, a moment of inertia J and the noise sigma_s of s turn every gain that acts after the hand-over into a
number: l h / J, K1 h, c h, width / sigma_s, delta / h. On the log scales that a search goes by, these are its
coordinates; their ends are here.
"""

import math
from typing import Any

import numpy as np

from ptsmc_jax import formulas
from ptsmc_jax.scenario import device_tables
from ptsmc_jax.theory import borders

LEFT = 5e-5  # share of the observer's error that a dead-beat one leaves after a period
SHARE = 0.05  # of the slope toward s = 0: what changes less does not matter
WIDEST = 1e4  # times the noise of s: hardly a switching term any more
QUIET = (1e-5, 1e-1)  # widths of the smooth sign without noise, in the units of s


def gyro_noise(table: device_tables.Hardware, period: float) -> float:
    """Noise of the gyro, 1 sigma a sample [rad/s]."""
    return table.rate_noise or formulas.per_sample(table.rate_noise_density or 0.0, period)


def dead_beat_gain(scenario: Any, left: float = LEFT) -> float:
    """Gain l [N m s], the same on all axes, from which on at most this share of the observer's error is left.

    After one period, and of the error about the axis of the largest principal moment J: l h / J = ln(1 / left), which
    is 9.9 for 5e-5. A larger gain has no influence. Without a body J = 1.
    """
    moment = 1.0
    if scenario.spacecraft is not None:
        values = np.asarray(scenario.spacecraft.inertia, dtype=float)
        moment = float(values.max() if values.ndim == 1 else np.linalg.eigvalsh(values).max())
    return math.log(1.0 / left) * moment / scenario.loop.period


def largest_k1(scenario: Any) -> float:
    """K1 [1/s] at which the sampled loop after the hand-over ends to be stable, with this delay and `surface_rate`.

    `borders.largest_reaching` = K1 h / 2 for a spacecraft (60), K1 h for what has the K1 of (10), (29); without delay
    it is 2 - c h, and with implicit sampling, which has no border then, where `LEFT` of s is left after a period. Of an
    order above 2 that of the slowest pole of its surface: an estimate. 0: there is none.
    """
    h = scenario.loop.period
    late = float(getattr(scenario.hardware, "delay", None) or 0)
    implicit = scenario.controller.implicit
    border = borders.largest_reaching(scenario.controller.surface_rate * h, late, implicit=implicit)
    reaching = min(border, math.log(1.0 / LEFT)) / h
    return 2.0 * reaching if scenario.spacecraft is not None else reaching


def noise_of_s(scenario: Any) -> float:
    """Noise sigma_s of s after the hand-over [1/s], 1 sigma an axis and raw sample; otherwise in the states' units.

    The error is half an angle: s = eps' + c eps has sigma_s = (sigma_w^2 + c^2 sigma_q^2)^(1/2) / 2; of the additive
    error at most that, where the reference is turned away from the inertial axes. A chain's states have the weights of
    its surface.
    """
    table, law = scenario.hardware, scenario.controller
    if isinstance(table, device_tables.StateHardware):
        a = getattr(law, "a", (1.0,))  # of a chain's surface
        rate = getattr(law, "surface_rate", 1.0)
        weights = [one * rate ** (len(a) - i) for i, one in enumerate([*a, 1.0])]
        noises = table.state_noise or [0.0] * len(weights)
        if len(noises) == len(weights):
            return math.hypot(*(w * noise for w, noise in zip(weights, noises, strict=True)))
        inputs = len(noises) // 2  # a system's positions and rates: the noisiest of its surfaces
        return max(math.hypot(weights[0] * x, weights[1] * v) for x, v in zip(noises, noises[inputs:], strict=False))
    if not isinstance(table, device_tables.Hardware):
        return 0.0
    rate = getattr(law, "surface_rate", 1.0)
    return 0.5 * math.hypot(gyro_noise(table, scenario.loop.period), rate * (table.attitude_noise or 0.0))


def narrowest_that_matters(noise: float, share: float = SHARE) -> float:
    """Width of the smooth sign below which it is as good as the exact one under this noise, in the units of s.

    The mean slope at s = 0 of tanh((s + n) / width), n Gaussian, is the exact sign's (2 / pi)^(1/2) / noise but for
    this share: 1 - (pi^2/24) (width / noise)^2.
    """
    return math.sqrt(24.0 * share) / math.pi * noise


def widths(scenario: Any) -> tuple[float, float]:
    """Between which the width of the smooth sign matters, in the units of s: by the noise of s, if there is any."""
    noise = noise_of_s(scenario)
    return (narrowest_that_matters(noise), WIDEST * noise) if noise > 0.0 else QUIET
