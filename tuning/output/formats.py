"""Numbers, units and counts as text."""

import math
from collections.abc import Callable, Iterator, Mapping


def format_number(value: float | None, format_spec: str, none: str = "-") -> str:
    """Return a number in this format, or `none` for None and NaN.

    Args:
        value: the number.
        format_spec: format as in f-strings, such as ".3g".
        none: text for None and NaN.

    >>> format_number(0.12345, ".3g"), format_number(None, ".3g"), format_number(float("nan"), ".3g", "never")
    ('0.123', '-', 'never')
    """
    return none if value is None or value != value else f"{value:{format_spec}}"


def format_ratio(times: float | None) -> str:
    """Return a ratio with three digits, below a million without an exponent.

    >>> (
    ...     format_ratio(0.98765),
    ...     format_ratio(999.4),
    ...     format_ratio(999.7),
    ...     format_ratio(1234.4),
    ...     format_ratio(999_999.7),
    ...     format_ratio(1.5e6),
    ...     format_ratio(None),
    ... )
    ('0.988', '999', '1000', '1234', '1000000', '1.5e+06', '-')
    """
    return format_number(times, ".0f" if times is not None and 999.5 <= times < 1e6 else ".3g")


def format_angle(value: float | None) -> str:
    """Return an angle [rad] in arcsec, from one degree on in degrees.

    >>> format_angle(1e-4), format_angle(0.1), format_angle(None)
    ('20.6 arcsec', '5.73 deg', '-')
    >>> [format_angle(math.radians(arcseconds / 3600.0)) for arcseconds in (-999.4, 999.7, 3599.4, 3601.0)]
    ['-999 arcsec', '1000 arcsec', '3599 arcsec', '1 deg']
    """
    if value is None or not math.isfinite(value):
        return "-"
    degrees = math.degrees(value)
    if abs(degrees) >= 1.0:
        return f"{degrees:.3g} deg"
    arcsec = 3600.0 * degrees
    return f"{arcsec:.0f} arcsec" if abs(arcsec) >= 999.5 else f"{arcsec:.3g} arcsec"


def in_readable_unit(name: str, unit: str, *values: float | None) -> tuple[str, list[float]]:
    """Return values in a readable unit: angles in arcsec, or in degrees if the largest one is at least one degree.

    Args:
        name: name of the metric or the input. The norm of an attitude error becomes an angle, see `as_angle`.
        unit: unit of the values.
        values: the values, None or NaN if there is none.

    Returns:
        The readable unit, and the values, NaN for None.

    >>> in_readable_unit("hold_angle", "rad", 1e-3, None)[0], in_readable_unit("hold_angle", "rad", 1e-3, 0.1)[0]
    ('arcsec', 'deg')
    >>> in_readable_unit("window_error", "-", 1e-6)[0], in_readable_unit("window_error", "x1", 1e-6)
    ('arcsec', ('x1', [1e-06]))
    """
    import numpy as np  # here, so that `ptsmc --help` does not import NumPy and JAX

    from ptsmc_jax.formulas import angle_unit
    from ptsmc_jax.simulation.catalogues import as_angle

    unit, numbers = as_angle(name, unit, np.array(values, dtype=float))
    if unit == "rad":
        unit, factor = angle_unit(np.max(np.abs(numbers[np.isfinite(numbers)]), initial=0.0))
        numbers = factor * numbers
    return unit, numbers.tolist()


def format_error(value: float | None, plant: str) -> str:
    """Return a window error as a pointing angle, or in the unit of the state of a plant that is no spacecraft.

    >>> format_error(1e-6, "spacecraft"), format_error(1e-6, "chain"), format_error(float("nan"), "chain")
    ('0.413 arcsec', '1e-06 x1', '-')
    """
    return "-" if value is None or math.isnan(value) else format_metric(value, "window_error", plant)


def error_name(plant: str) -> str:
    """Return the name of the window error that `format_error` shows."""
    return "pointing error" if plant == "spacecraft" else "error"


def format_named_error(value: float | None, plant: str, statistic: str = "") -> str:
    """Return the window error with its name, empty if there is none.

    Args:
        value: window error, in the unit of the metric, or None.
        plant: kind of the plant: "spacecraft", "chain" or "system".
        statistic: text before the name, such as "RMS ".

    >>> format_named_error(1e-6, "spacecraft", "RMS "), format_named_error(None, "chain")
    ('RMS pointing error 0.413 arcsec', '')
    """
    return "" if (text := format_error(value, plant)) == "-" else f"{statistic}{error_name(plant)} {text}"


def format_objective(name: str, value: float, plant: str) -> str:
    """Return an objective with its name and unit, a window error as a pointing angle.

    Args:
        name: name of the objective, such as "RMS window error".
        value: value of the objective, in the unit of its metric, or in s for t_f.
        plant: kind of the plant: "spacecraft", "chain" or "system".

    >>> format_objective("RMS window error", 1e-6, "spacecraft"), format_objective("t_f", 30.0, "chain")
    ('RMS pointing error 0.413 arcsec', 't_f 30 s')
    >>> (
    ...     format_objective("mean effort", 2.0, "spacecraft"),
    ...     format_objective("largest metric over its limit", 0.9, "chain"),
    ... )
    ('mean effort 2 N m s', 'largest metric over its limit 0.9')
    """
    metric = objective_metric(name, plant)
    if not metric:
        return f"{name} {value:.4g}{' s' if name == 't_f' else ''}"
    return f"{name.replace('window error', error_name(plant))} {format_metric(value, metric, plant)}"


def objective_metric(name: str, plant: str) -> str:
    """Return the metric of an objective, from its name or its column in a file; "" if it is no metric.

    >>> objective_metric("90 % quantile of effort", "chain"), objective_metric("rms_window_error", "chain")
    ('effort', 'window_error')
    """
    from ptsmc_jax.simulation.catalogues import CATALOGUES  # imports JAX

    words = name.replace(" ", "_")
    return max((metric for metric in CATALOGUES[plant] if words.endswith(metric)), key=len, default="")


def format_metric(value: float, metric: str, plant: str) -> str:
    """Return a metric with its unit. Attitude errors and angles are in arcsec or degrees.

    Args:
        value: value of the metric, in the unit of the metric.
        metric: name of the metric.
        plant: kind of the plant: "spacecraft", "chain" or "system".

    >>> format_metric(0.2813, "peak_torque", "spacecraft"), format_metric(1e-5, "window_error", "spacecraft")
    ('0.281 N m', '4.13 arcsec')
    >>> format_metric(1e-4, "ape_boresight", "spacecraft")
    '20.6 arcsec'
    """
    from ptsmc_jax.simulation.catalogues import CATALOGUES, as_angle  # imports JAX

    unit, value = as_angle(metric, CATALOGUES[plant][metric].unit, value)
    return format_angle(value) if unit == "rad" else f"{value:.3g} {unit}".rstrip(" -")


def heading(name: str, unit: str) -> str:
    """Return the heading of a column with its unit.

    >>> heading("delay_margin", "s"), heading("saturated", "-"), heading("status", "")
    ('delay_margin [s]', 'saturated', 'status')
    """
    return f"{name} [{unit}]" if unit.strip("-") else name


def widened_lines(bounds: Mapping[str, tuple[float, float]]) -> Iterator[str]:
    """Return lines with the bounds that a search moved, which the scenario does not set.

    >>> list(widened_lines({"k_p": (0.01, 100.0)}))
    ['the search moved the bounds of k_p, which tune.bounds does not set, to 0.01 and 100']
    """
    for gain, (low, high) in bounds.items():
        yield f"the search moved the bounds of {gain}, which tune.bounds does not set, to {low:.4g} and {high:.4g}"


def list_gains(gains: Mapping[str, float], units: Mapping[str, str], digits: str) -> str:
    """Return gains with their units in one line.

    Args:
        gains: values by name. A gain with several components has names such as observer_gain_1.
        units: unit of each gain, by the name without the number of the component.
        digits: format of each value, such as ".4g".

    >>> list_gains({"eta": 3.0, "observer_gain_1": 0.5}, {"eta": "-", "observer_gain": "N m s"}, ".4g")
    'eta 3, observer_gain_1 0.5 N m s'
    """
    from ptsmc_jax.simulation.gains import base  # imports JAX

    return ", ".join(
        f"{name} {value:{digits}} {units.get(base(name), '')}".rstrip(" -") for name, value in gains.items()
    )


def ratio_to_bound(value: float | None, bound: float | None) -> float | None:
    """Return the ratio of an error to its lower bound, None without a bound."""
    return value / bound if value and bound else None


def format_interval(bounds: tuple[float, float] | None, format_bound: Callable[[float], str]) -> str:
    """Return " (95 % interval: LOW to HIGH)" with its leading blank, "" for None."""
    return "" if bounds is None else f" (95 % interval: {format_bound(bounds[0])} to {format_bound(bounds[1])})"


def format_count(count: int, noun: str) -> str:
    """Return a count and its noun.

    >>> format_count(1, "trial"), format_count(0, "trial")
    ('1 trial', '0 trials')
    """
    return f"{count} {noun}{'' if count == 1 else 's'}"


def list_counts(counts: Mapping[str, int]) -> str:
    """Return counts by status in one line, without those that are zero.

    >>> list_counts({"ok": 5, "not_converged": 2, "singular": 0})
    '5 ok, 2 not converged'
    """
    return ", ".join(f"{count} {status.replace('_', ' ')}" for status, count in counts.items() if count)


def failed_counts(counts: Mapping[str, int]) -> dict[str, int]:
    """Return the number of trials by status, a dict without the status "ok" and without zeros."""
    return {status: count for status, count in counts.items() if count and status != "ok"}


def parse_cell(cell: str) -> float | str:
    """Return the number in a cell of a CSV file, NaN for an empty cell, or its text."""
    try:
        return float(cell or "nan")
    except ValueError:
        return cell
