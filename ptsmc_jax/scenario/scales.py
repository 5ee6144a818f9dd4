"""Ranges of the gains of a sampled run that are stable and have an influence.

Every gain of the hold phase is dimensionless in units of the control period h, the moment of inertia J and the noise
sigma_s of s: l h / J, K1 h, c h, width / sigma_s, delta / h. A search uses these numbers on log scales. The functions
here return the ends of their ranges.
"""

import math

from ptsmc_jax.declare import Scaled
from ptsmc_jax.scenario import mission
from ptsmc_jax.scenario.tables import Scenario
from ptsmc_jax.theory import stability_limits

DEADBEAT_REMAINDER = 5e-5  # remaining fraction of an error after one period that counts as deadbeat
NEGLIGIBLE = 0.05  # relative change of the mean derivative of the sign at s = 0 that counts as no influence
WIDEST_TO_NOISE = 1e4  # thickest boundary layer relative to the noise of s: the switching term then nearly vanishes
NOISELESS_RANGE = (1e-2, 1e2)  # thinnest and thickest boundary layer without noise, relative to the default thickness


def dead_beat_gain(scenario: Scenario) -> float:
    """Return the gain l [N m s] of a deadbeat observer, equal on all axes.

    It decreases the error about the axis of the largest principal moment J to the fraction `DEADBEAT_REMAINDER` in one
    period: l h / J = -ln(`DEADBEAT_REMAINDER`) = 9.9. A larger gain has no influence. Without a body J = 1.
    """
    _, largest = scenario.moments
    return math.log(1.0 / DEADBEAT_REMAINDER) * (1.0 if largest is None else largest) / scenario.loop.period


def largest_k1(scenario: Scenario, surface_rate: float) -> float:
    """Return the largest K1 [1/s] that stabilises the sampled hold phase, 0 if no K1 does.

    The function `stability_limits.largest_reaching` returns the limit of K1 h / 2 for a spacecraft (60), and of K1 h
    for the K1 of (10) and (29). Without delay the limit is 2 - c h. Implicit sampling without delay has no stability
    limit. Its largest K1 decreases s to the fraction `DEADBEAT_REMAINDER` in one period. For an order above 2 the limit
    is an estimate from the slowest pole of the surface.

    Args:
        scenario: a scenario with a sampled loop.
        surface_rate: c [1/s].
    """
    h = scenario.loop.period
    delay = float(scenario.devices.delay_periods)
    implicit = scenario.controller.implicit
    limit = stability_limits.largest_reaching(surface_rate * h, delay, implicit=implicit)
    reaching = min(limit, math.log(1.0 / DEADBEAT_REMAINDER)) / h
    return scenario.reaching * reaching


def narrowest_useful_width(noise: float) -> float:
    """Return the thickness of the boundary layer below which noise hides it, in the units of s.

    Averaged over Gaussian noise n, tanh((s + n) / width) has the derivative sqrt(2 / pi) / noise at s = 0, times
    1 - (pi^2 / 24) (width / noise)^2. The first factor belongs to the discontinuous sign. The function returns the
    width at which the second factor is 1 - `NEGLIGIBLE`.
    """
    return math.sqrt(24.0 * NEGLIGIBLE) / math.pi * noise


def largest_surface_rate(scenario: Scenario) -> float:
    """Return half of the stability limit of the surface rate c [1/s] in the sampled hold phase, at the best K1."""
    h, delay = scenario.loop.period, scenario.devices.delay_periods
    limit = stability_limits.largest_surface(delay, implicit=scenario.controller.implicit)
    return 0.5 * min(limit, math.log(1.0 / DEADBEAT_REMAINDER)) / h


def noiseless_width_range(scenario: Scenario) -> tuple[float, float]:
    """Return widths of the boundary layer to search without noise, in the units of s."""
    width = mission.scales(scenario).scaled_value(scenario.controller.scaled.get("sign_width", Scaled(1e-3)))
    return NOISELESS_RANGE[0] * width, NOISELESS_RANGE[1] * width


def width_range(scenario: Scenario) -> tuple[float, float]:
    """Return the smallest and largest useful boundary layer in the units of s, from the noise of s if it is not 0."""
    noise = scenario.devices.noise_of_s(scenario)
    return (narrowest_useful_width(noise), WIDEST_TO_NOISE * noise) if noise > 0.0 else noiseless_width_range(scenario)
