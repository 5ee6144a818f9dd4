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
MAY_BE_ZERO = ("saturated",)  # metrics that a requirement may limit to zero
LARGER_IS_BETTER = tuple(f"{WITHIN}{name}" for name in TIME_FRACTION_METRICS)  # all other metrics are better if smaller
# units that a limit may be stated in, by the unit of its metric or key: name -> value in that unit
UNITS: dict[str, dict[str, float]] = {
    "rad": {"rad": 1.0, "mrad": 1e-3, "urad": 1e-6, "deg": math.pi / 180, "arcmin": math.pi / 10_800,
            "arcsec": math.pi / 648_000},
    "rad/s": {"rad/s": 1.0, "deg/s": math.pi / 180, "deg/h": math.pi / 648_000, "arcsec/s": math.pi / 648_000,
              "rpm": math.pi / 30, "Hz": 2.0 * math.pi},
    "rad/s/sqrt(Hz)": {"rad/s/sqrt(Hz)": 1.0, "deg/s/sqrt(Hz)": math.pi / 180, "deg/sqrt(h)": math.pi / 10_800},
    "rad/s/sqrt(s)": {"rad/s/sqrt(s)": 1.0, "deg/s/sqrt(s)": math.pi / 180, "deg/h/sqrt(h)": math.pi / 38_880_000},
    "N m": {"N m": 1.0, "mN m": 1e-3, "uN m": 1e-6, "Nm": 1.0, "mNm": 1e-3, "uNm": 1e-6},
    "N m s": {"N m s": 1.0, "mN m s": 1e-3, "uN m s": 1e-6, "Nms": 1.0, "mNms": 1e-3, "uNms": 1e-6},
    "N m/s": {"N m/s": 1.0, "mN m/s": 1e-3, "uN m/s": 1e-6, "Nm/s": 1.0, "mNm/s": 1e-3, "uNm/s": 1e-6},
    "s": {"s": 1.0, "ms": 1e-3, "min": 60.0, "h": 3600.0},
    "m": {"m": 1.0, "km": 1e3},
    "kg m^2": {"kg m^2": 1.0, "kg cm^2": 1e-4, "kg mm^2": 1e-6, "g m^2": 1e-3, "g cm^2": 1e-7, "g mm^2": 1e-9},
    "sqrt(kg) m": {"sqrt(kg) m": 1.0},
    "deg": {"deg": 1.0, "rad": 180 / math.pi},
    "dB": {"dB": 1.0},
}  # fmt: skip
# usual numbers in usual units, for error messages
EXAMPLES = {
    "rad": '"10 arcsec" or "0.5 deg"', "rad/s": '"0.3 deg/h" or "2 deg/s"', "rad/s/sqrt(Hz)": '"0.02 deg/sqrt(h)"',
    "rad/s/sqrt(s)": '"0.1 deg/h/sqrt(h)"', "N m": '"5 mN m"', "N m s": '"20 mN m s"', "N m/s": '"1 mN m/s"',
    "s": '"200 ms" or "2 min"', "m": '"500 km"', "kg m^2": '"350 kg cm^2"',
    "sqrt(kg) m": '"0.8 sqrt(kg) m"', "deg": '"30 deg"', "dB": '"6 dB"',
}  # fmt: skip
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
