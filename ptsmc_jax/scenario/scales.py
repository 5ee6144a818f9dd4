"""Between which values the gains of a sampled run matter and are stable.

A period h, a moment of inertia J and the noise sigma_s of s turn every gain that acts after the hand-over into a
number: l h / J, K1 h, c h, width / sigma_s, delta / h. On the log scales that a search goes by, these are its
coordinates; their ends are here.
"""

import math
from typing import Any

from ptsmc_jax.declare import Scaled
from ptsmc_jax.scenario import mission
from ptsmc_jax.theory import borders

LEFT = 5e-5  # share of the observer's error that a dead-beat one leaves after a period
SHARE = 0.05  # of the slope toward s = 0: what changes less does not matter
WIDEST = 1e4  # times the noise of s: hardly a switching term any more
QUIET = (1e-2, 1e2)  # widths without noise, over the default one of the paper's case, scaled


def dead_beat_gain(scenario: Any) -> float:
    """Gain l [N m s], the same on all axes, from which on at most `LEFT` of the observer's error is left.

    After one period, and of the error about the axis of the largest principal moment J: l h / J = ln(1 / LEFT) = 9.9. A
    larger gain has no influence. Without a body J = 1.
    """
    _, largest = scenario.moments
    return math.log(1.0 / LEFT) * (1.0 if largest is None else largest) / scenario.loop.period


def largest_k1(scenario: Any, surface_rate: float) -> float:
    """The largest K1 [1/s] with which the sampled loop is stable after the hand-over, by delay and `surface_rate`.

    `borders.largest_reaching` is K1 h / 2 for a spacecraft (60), K1 h for laws with the K1 of (10) and (29); without
    delay it is 2 - c h. Implicit sampling without delay has no border: there the largest K1 is the one that leaves
    `LEFT` of s after a period. For an order above 2 it is an estimate, by the slowest pole of the surface. 0: no K1 is
    stable.
    """
    h = scenario.loop.period
    delay = float(scenario.devices.delay_periods)
    implicit = scenario.controller.implicit
    border = borders.largest_reaching(surface_rate * h, delay, implicit=implicit)
    reaching = min(border, math.log(1.0 / LEFT)) / h
    return scenario.reaching * reaching


def narrowest_that_matters(noise: float) -> float:
    """Width of the smooth sign below which it is as good as the exact one under this noise, in the units of s.

    The mean slope at s = 0 of tanh((s + n) / width), n Gaussian, is the exact sign's (2 / pi)^(1/2) / noise but for
    `SHARE`: 1 - (pi^2/24) (width / noise)^2.
    """
    return math.sqrt(24.0 * SHARE) / math.pi * noise


def largest_rate(scenario: Any) -> float:
    """Return half of the stability limit of the surface rate c [1/s] in the sampled hold phase, at the best K1."""
    h, delay = scenario.loop.period, scenario.devices.delay_periods
    limit = borders.largest_surface(delay, implicit=scenario.controller.implicit)
    return 0.5 * min(limit, math.log(1.0 / LEFT)) / h


def quiet(scenario: Any) -> tuple[float, float]:
    """Return widths of the boundary layer to search without noise, in the units of s."""
    width = mission.scales(scenario).of(scenario.controller.scaled.get("sign_width", Scaled(1e-3)))
    return QUIET[0] * width, QUIET[1] * width


def widths(scenario: Any) -> tuple[float, float]:
    """Between which the width of the smooth sign matters, in the units of s: by the noise of s, if there is any."""
    noise = scenario.devices.noise_of_s(scenario)
    return (narrowest_that_matters(noise), WIDEST * noise) if noise > 0.0 else quiet(scenario)
