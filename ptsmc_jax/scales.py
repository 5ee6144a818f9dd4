"""What the gains of a sampled run are measured in, and between which values they matter and are stable.

A period h, a moment of inertia J and the noise sigma_s of s turn every gain that acts after the hand-over into a
number: l h / J, K1 h, c h, width / sigma_s, delta / h.
"""

import math

import numpy as np
from jaxtyping import Float

from ptsmc_jax import device_tables, law_tables, linear, plant_tables, sensors
from ptsmc_jax.tables import Scenario

LEFT = 5e-5  # share of the observer's error that a dead-beat one leaves after a period
SHARE = 0.05  # of the slope toward s = 0: what adds less does not matter


def gyro_noise(table: device_tables.Hardware, period: float) -> float:
    """Noise of the gyro, 1 sigma a sample [rad/s]."""
    return table.rate_noise or sensors.per_sample(table.rate_noise_density or 0.0, period)


def units(scenario: Scenario) -> dict[str, float]:
    """What each gain is divided by to become dimensionless: J/h of the largest moment J, 1/h, sigma_s and h.

    Without noise the width of the smooth sign has none, and is left out. Raises ValueError for a system of one's own.
    """
    h, noise = scenario.loop.period, noise_of_s(scenario)
    found = {"delta": h, "observer_gain": _largest_moment(scenario) / h, "k1": 1.0 / h, "surface_rate": 1.0 / h}
    return found if noise == 0.0 else {**found, "sign_width": noise}


def observer_decay(scenario: Scenario) -> Float[np.ndarray, " axes"]:
    """Diagonal of l J^-1 h [-], a number for each axis: the digital observer keeps E = e^(-l J^-1 h) of its error."""
    gain = np.asarray(getattr(scenario.observer, "gain", 0.0), dtype=float)
    return gain * np.diag(np.linalg.inv(_inertia(scenario))) * scenario.loop.period


def dead_beat_gain(scenario: Scenario, left: float = LEFT) -> float:
    """Gain l [N m s], the same on all axes, from which on at most this share of the observer's error is left.

    After one period, and of the error about the axis of the largest principal moment J: l h / J = ln(1 / left), which
    is 9.9 for 5e-5. A larger gain has no influence.
    """
    return math.log(1.0 / left) * _largest_moment(scenario) / scenario.loop.period


def largest_k1(scenario: Scenario) -> float:
    """K1 [1/s] at which the sampled loop after the hand-over ends to be stable, with this delay and `surface_rate`.

    `linear.largest_reaching` = K1 h / 2 for a spacecraft (60), K1 h for what has the K1 of (10) and (29); without delay
    it is 2 - c h. Raises ValueError for a chain of an order above 2.
    """
    table, h, law = scenario.plant, scenario.loop.period, scenario.controller
    if isinstance(table, plant_tables.ChainPlant) and table.order > 2:
        raise ValueError(f"the border is known for order 2, not for {table.order}")
    late = float(getattr(scenario.hardware, "delay", None) or 0)
    reaching = linear.largest_reaching(law.surface_rate * h, late) / h
    return 2.0 * reaching if scenario.spacecraft is not None else reaching


def noise_of_s(scenario: Scenario) -> float:
    """Noise sigma_s of s after the hand-over [1/s], 1 sigma an axis and raw sample; of a chain in its states' units.

    The error is half an angle: s = eps' + c eps has sigma_s = (sigma_w^2 + c^2 sigma_q^2)^(1/2) / 2; of the additive
    error at most that, where the reference is turned away from the inertial axes. A chain's states have the weights of
    its surface. Raises ValueError for a system of one's own.
    """
    table, law = scenario.hardware, scenario.controller
    _refuse_system(scenario)
    if isinstance(table, device_tables.StateHardware) and isinstance(law, law_tables.ChainController):
        n = len(law.a) + 1
        weights = [a * law.surface_rate ** (n - 1 - i) for i, a in enumerate([*law.a, 1.0])]
        return math.hypot(*(w * noise for w, noise in zip(weights, table.state_noise or [0.0] * n, strict=True)))
    if not isinstance(table, device_tables.Hardware):
        return 0.0
    return 0.5 * math.hypot(gyro_noise(table, scenario.loop.period), law.surface_rate * (table.attitude_noise or 0.0))


def smooth_slope(width: float, noise: float) -> float:
    """Mean slope at s = 0 of tanh((s + n) / width), n Gaussian with this sigma: what N K2 times it adds to K1.

    E[sech^2(n / width)] / width, in 1/(the unit of s): 1 / width far above the noise, and far below it, whatever the
    width, the exact sign's (2 / pi)^(1/2) / noise.
    """
    z, ratio = np.linspace(-12.0, 12.0, 2401), noise / width
    if ratio > 1.0:  # the narrower factor sets the grid: off by less than e^-24
        mean = np.trapezoid(np.exp(-0.5 * (z / ratio) ** 2) / np.cosh(z) ** 2, z) / ratio
    else:
        mean = np.trapezoid(np.exp(-0.5 * z**2) / np.cosh(ratio * z) ** 2, z)
    return float(mean) / math.sqrt(2.0 * math.pi) / width


def widths_that_matter(switching: float, k1: float, noise: float, share: float = SHARE) -> tuple[float, float]:
    """Widths of the smooth sign between which it matters, in the units of s: narrowest and widest.

    Below the narrowest its mean slope is the exact sign's but for this share: 1 - (pi^2/24) (width / noise)^2. Above
    the widest it adds less than this share to K1: N K2 / width. switching: N K2 [1/s^2], 2 `theory.switching_rate` for
    a spacecraft. Where the first is above the second the term matters at no width.
    """
    return math.sqrt(24.0 * share) / math.pi * noise, switching / (share * k1)


def _inertia(scenario: Scenario) -> Float[np.ndarray, "axes axes"]:
    _refuse_system(scenario)
    if scenario.spacecraft is None:
        return np.eye(1)
    values = np.asarray(scenario.spacecraft.inertia, dtype=float)
    return np.diag(values) if values.ndim == 1 else values


def _refuse_system(scenario: Scenario) -> None:
    if isinstance(scenario.plant, plant_tables.SystemPlant):
        raise ValueError("a system of one's own has its inertia and F in its functions, which a scenario does not show")


def _largest_moment(scenario: Scenario) -> float:
    return float(np.linalg.eigvalsh(_inertia(scenario)).max())
