"""The metrics and margins by name, with unit and meaning. `[requirements]` may limit each of them.

The functions that compute them are in `metrics` and `pointing`.
"""

import math
from collections.abc import Iterable
from typing import Any, NamedTuple

from ptsmc_jax.formulas import pointing_angle
from ptsmc_jax.simulation import pointing
from ptsmc_jax.simulation.metrics import METRICS
from ptsmc_jax.simulation.pointing import AXES as AXES
from ptsmc_jax.simulation.pointing import INDICES as INDICES
from ptsmc_jax.simulation.pointing import RELATIVE_INDICES as RELATIVE_INDICES
from ptsmc_jax.simulation.pointing import TIME_FRACTION_METRICS as TIME_FRACTION_METRICS
from ptsmc_jax.simulation.pointing import WITHIN as WITHIN


class Entry(NamedTuple):
    """A metric's unit and meaning."""

    unit: str
    meaning: str
    table: str | None = None  # only runs with this table in the scenario have the metric; None: all runs


# prefixes of the knowledge errors, which are metrics of runs with measurement noise only
KNOWLEDGE = tuple(f"{prefix}{index}" for prefix in ("", WITHIN) for index in ("ake", "mke", "rke"))

CATALOGUE = {
    **{name: Entry(metric.unit, metric.meaning, metric.table) for name, metric in METRICS.items()},
    **{name: Entry(*entry, "pointing") for name, entry in pointing.METRICS.items()},
}
POINTING = tuple(pointing.METRICS)
# metrics of other plants, whose x_1 is the error, in the units of their states and inputs
STATE_CATALOGUE = {name: Entry(*metric.of_states) for name, metric in METRICS.items() if metric.of_states is not None}
# norms |v| of attitude errors [-], and the metrics with the same errors as angles
ANGLE_METRICS = {"terminal_error": "terminal_angle", "window_error": "window_angle", "hold_error": "hold_angle"}
# torque metrics, and their names in tables and figures
TORQUES = {
    "peak_torque": "peak commanded torque",
    "peak_torque_delivered": "peak delivered torque",
    "peak_wheel_torque": "peak wheel torque",
}
MAY_BE_ZERO = ("saturated",)  # metrics that a requirement may limit to zero
LARGER_IS_BETTER = tuple(f"{WITHIN}{name}" for name in TIME_FRACTION_METRICS)  # all other metrics are better if smaller
CATALOGUES = {"spacecraft": CATALOGUE, "chain": STATE_CATALOGUE, "system": STATE_CATALOGUE}  # by the kind of the plant
ANGLE_UNITS = {"spacecraft": "rad", "chain": "x1", "system": "x1"}  # unit of the column `initial_angle`


class Margin(NamedTuple):
    """Unit and meaning of a stability margin, see `theory.margins`."""

    unit: str
    meaning: str
    at_least: bool = True  # the limit of a requirement is the smallest allowed value


MARGINS = {
    "gain_margin": Margin("dB", "factor on the gain, up or down, to the stability limit"),
    "phase_margin": Margin("deg", "phase, either way, to the stability limit"),
    "delay_margin": Margin("s", "further delay to the stability limit"),
    "peak_sensitivity": Margin(
        "dB", "peak sensitivity M_s = max |S|: 1 / the smallest distance of L from -1", at_least=False
    ),
}
NO_SIGN = "the discontinuous sign has no derivative: margins are those of the loop without its switching term"


def units(kind: str) -> dict[str, str]:
    """Return the unit of each metric, and of `initial_angle`, for this kind of plant."""
    return {name: entry.unit for name, entry in CATALOGUES[kind].items()} | {"initial_angle": ANGLE_UNITS[kind]}


def as_angle(metric: str, unit: str, value: Any) -> tuple[str, Any]:
    """Return the unit and the value of a metric. A norm |v| of an attitude error becomes the angle 2 asin |v| [rad].

    Texts and figures show these angles. Files have the metrics themselves.

    Args:
        metric: name of the metric.
        unit: unit of `value`.
        value: value or values of the metric, in any shape.

    Returns:
        "rad" and the angle, in the shape of `value`. For a metric that is no such norm, `unit` and `value`.
    """
    return ("rad", pointing_angle(value)) if metric in ANGLE_METRICS and unit == "-" else (unit, value)


def without_norms(metrics: Iterable[str]) -> list[str]:
    """Return the different metrics, without those whose angle is also among them.

    >>> without_norms(["window_error", "peak_torque", "window_angle"]), without_norms(["window_error"])
    (['peak_torque', 'window_angle'], ['window_error'])
    """
    names = list(dict.fromkeys(metrics))
    return [name for name in names if ANGLE_METRICS.get(name) not in names]


def explained_metrics(required: Iterable[str]) -> list[str]:
    """Return the metrics whose strongest inputs a campaign shows: the window error and the required metrics."""
    return without_norms(("window_error", *required))


def percent(fraction: float) -> str:
    """Return a fraction in per cent, with three digits of it or of its difference to 100 %.

    >>> percent(59 / 60), percent(0.99973), percent(1.0), percent(0.000412), percent(0.5)
    ('98.33', '99.973', '100', '0.0412', '50')
    """
    nearest = 100.0 * min(fraction, 1.0 - fraction)
    decimals = min(2 - math.floor(math.log10(nearest)), 8) if nearest > 0.0 else 1
    return f"{100.0 * fraction:.{decimals}f}".rstrip("0").rstrip(".")
