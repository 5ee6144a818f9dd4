"""Numbers, units and counts as text."""

import math
import re
from collections.abc import Callable, Mapping
from typing import Any

from ptsmc_jax.simulation import catalogues
from ptsmc_jax.simulation.catalogues import CATALOGUES


def digits(value: float | None, form: str, none: str = "-") -> str:
    """Return a number in this format, or `none` for None and NaN.

    >>> digits(0.12345, ".3g"), digits(None, ".3g"), digits(float("nan"), ".3g", "never")
    ('0.123', '-', 'never')
    """
    return none if value is None or value != value else f"{value:{form}}"


def ratio(times: float | None) -> str:
    """Return a ratio with three digits, below a million without an exponent.

    >>> ratio(0.98765), ratio(999.4), ratio(999.7), ratio(1234.4), ratio(999_999.7), ratio(1.5e6), ratio(None)
    ('0.988', '999', '1000', '1234', '1000000', '1.5e+06', '-')
    """
    return digits(times, ".0f" if times is not None and 999.5 <= times < 1e6 else ".3g")


def angle(value: float | None) -> str:
    """Return an angle [rad] in arcsec, from one degree on in degrees.

    >>> angle(1e-4), angle(0.1), angle(None)
    ('20.6 arcsec', '5.73 deg', '-')
    >>> [angle(math.radians(arcseconds / 3600.0)) for arcseconds in (-999.4, 999.7, 3599.4, 3601.0)]
    ['-999 arcsec', '1000 arcsec', '3599 arcsec', '1 deg']
    """
    if value is None or not math.isfinite(value):
        return "-"
    degrees = math.degrees(value)
    return f"{degrees:.3g} deg" if abs(degrees) >= 1.0 else f"{arcsec(degrees)} arcsec"


def arcsec(degrees: float) -> str:
    """Return an angle below one degree [deg] as a number of arcsec."""
    seconds = 3600.0 * degrees
    return f"{seconds:.0f}" if abs(seconds) >= 999.5 else f"{seconds:.3g}"


def error(value: float | None, plant: str) -> str:
    """Return a window error as a pointing angle, or in the unit of the state of a plant that is no spacecraft.

    >>> error(1e-6, "spacecraft"), error(1e-6, "chain"), error(float("nan"), "chain")
    ('0.413 arcsec', '1e-06 x1', '-')
    """
    if value is None or math.isnan(value):
        return "-"
    if plant != "spacecraft":
        return valued(value, "window_error", plant)
    return angle(2.0 * math.asin(min(value, 1.0)))  # as `pointing_angle`, which would import NumPy for `ptsmc --help`


def error_name(plant: str) -> str:
    """Return the name of the window error that `error` shows."""
    return "pointing error" if plant == "spacecraft" else "error"


def named_error(value: float | None, plant: str, statistic: str = "") -> str:
    """Return the window error with its name, empty if there is none.

    >>> named_error(1e-6, "spacecraft", "RMS "), named_error(None, "chain")
    ('RMS pointing error 0.413 arcsec', '')
    """
    return "" if (text := error(value, plant)) == "-" else f"{statistic}{error_name(plant)} {text}"


def objective(name: str, value: float, plant: str) -> str:
    """Return an objective with its name, a window error as a pointing angle.

    >>> objective("RMS window error", 1e-6, "spacecraft"), objective("t_f", 30.0, "chain")
    ('RMS pointing error 0.413 arcsec', 't_f 30')
    """
    if name.endswith("window error"):
        return f"{name.removesuffix('window error')}{error_name(plant)} {error(value, plant)}"
    return f"{name} {value:.4g}"


def valued(value: float, metric: str, plant: str) -> str:
    """Return a metric of this kind of plant with its unit.

    >>> valued(0.2813, "peak_torque", "spacecraft"), valued(3.1e-5, "window_error", "spacecraft")
    ('0.281 N m', '3.1e-05')
    >>> valued(1e-4, "ape_boresight", "spacecraft")
    '20.6 arcsec'
    """
    unit = CATALOGUES[plant][metric].unit
    return angle(value) if unit == "rad" else f"{value:.3g} {unit}".rstrip(" -")


def with_unit(name: str, plant: str) -> str:
    """Return the name of a column of rows or of a map with its unit. Gain margins of a map are factors.

    >>> with_unit("largest_peak_torque", "spacecraft"), with_unit("delay_margin", "chain"), with_unit("status", "chain")
    ('largest_peak_torque [N m]', 'delay_margin [s]', 'status')
    >>> with_unit("initial_angle", "spacecraft"), with_unit("initial_angle", "chain")
    ('initial_angle [rad]', 'initial_angle [x1]')
    """
    units = catalogues.units(plant)
    start = "rad" if plant == "spacecraft" else units["window_error"]  # of other plants the column has |x_1|
    units |= {"torque": units["peak_torque"], "delay_margin": "s", "initial_angle": start}
    unit = units.get(re.sub("^(linear|largest|hold)_(?=torque|peak|window|delay)", "", name), "-")
    return name if unit == "-" else f"{name} [{unit}]"


def over_bound(value: float | None, bound: float | None) -> float | None:
    """Return the ratio of an error to its lower bound, None without a bound."""
    return value / bound if value and bound else None


def interval(bounds: tuple[float, float] | None, text: Callable[[float], str]) -> str:
    """Return a 95 % interval in parentheses, empty for None."""
    return "" if bounds is None else f" (95 % interval: {text(bounds[0])} to {text(bounds[1])})"


def many(count: int, thing: str) -> str:
    """Return a count and its noun.

    >>> many(1, "trial"), many(0, "trial")
    ('1 trial', '0 trials')
    """
    return f"{count} {thing}{'' if count == 1 else 's'}"


def listed(counts: Mapping[str, int]) -> str:
    """Return counts by status in one line, without those that are zero.

    >>> listed({"ok": 5, "not_converged": 2, "singular": 0})
    '5 ok, 2 not converged'
    """
    return ", ".join(f"{count} {status.replace('_', ' ')}" for status, count in counts.items() if count)


def failed(counts: Mapping[str, int]) -> dict[str, int]:
    """Return the counts of the trials that failed or did not converge at t_f."""
    return {status: count for status, count in counts.items() if count and status != "ok"}


def number(cell: str) -> Any:
    """Return the number in a cell of a CSV file, NaN for an empty cell, or its text."""
    try:
        return float(cell or "nan")
    except ValueError:
        return cell
