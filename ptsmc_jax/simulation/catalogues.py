"""The metrics of a run by name, a row each for every kind of plant that has it: what `[requirements]` may ask for.

How each is computed is in `metric_rows`; this file needs no JAX.
"""

import math
from typing import NamedTuple


class Entry(NamedTuple):
    """A metric's unit and meaning."""

    unit: str
    meaning: str
    table: str | None = None  # table of the scenario without which a run lacks the metric


# pointing error indices (ECSS-E-ST-60-10C), see `pointing`; each metric is the largest in the observation
INDICES = {
    "ape": "APE, the error",
    "mpe": "MPE, the error's mean over a window",
    "rpe": "RPE, the error less its window's mean",
    "pde": "PDE, the difference of the means of two windows",
    "ake": "AKE, the error of the attitude that the law is given",
    "mke": "MKE, the mean over a window of the error of the attitude that the law is given",
    "rke": "RKE, the error of the attitude that the law is given less its window's mean",
}
AXES = {"x": "about x", "y": "about y", "z": "about z", "boresight": "half-cone of the boresight"}
TIMED = ("ape", "mpe", "rpe", "ake", "mke", "rke")  # those with a share of time
RELATIVE = ("rpe", "rke")  # among them those that need the samples of a window
AT_A_TIME = tuple(f"{index}_{axis}" for index in TIMED for axis in AXES)
WITHIN = "within_"  # prefix of the metric that is the share of the time in which a run keeps a limit
# prefixes of metrics that a run without noise lacks
KNOWLEDGE = tuple(f"{prefix}{index}" for prefix in ("", WITHIN) for index in ("ake", "mke", "rke"))

CATALOGUE = {
    "terminal_error": Entry("-", "2-norm of the attitude error vector at t_f"),
    "terminal_angle": Entry("rad", "angle to the reference attitude at t_f"),
    "window_error": Entry("-", "RMS of the attitude error vector's 2-norm over the window after t_f"),
    "hold_error": Entry("-", "largest 2-norm of the attitude error vector from t_f to t_end, at ends of periods"),
    "window_angle": Entry("rad", "RMS of the angle to the reference attitude over the window after t_f"),
    "hold_angle": Entry("rad", "largest angle to the reference attitude from t_f to t_end, at ends of periods"),
    "peak_torque": Entry("N m", "largest commanded torque about one axis, before the actuator"),
    "peak_torque_delivered": Entry("N m", "largest delivered torque about one axis"),
    "saturated": Entry("-", "fraction of the time in which a limit of the actuators cuts the command"),
    "effort": Entry("N m s", "integral of the 1-norm of the delivered torque"),
    "settling_time": Entry(
        "s", "time from which the angle stays below settling_angle, interpolated between ends of periods"
    ),
    "chattering": Entry("N m/s", "total variation of the delivered torque per second after t_f, largest axis"),
    "peak_rate": Entry("rad/s", "largest 2-norm of the body rate"),
    "peak_momentum": Entry("N m s", "largest 2-norm of the body's angular momentum"),
    "peak_wheel_momentum": Entry("N m s", "largest momentum stored in one reaction wheel", "wheels"),
    "peak_wheel_torque": Entry("N m", "largest torque of one reaction wheel", "wheels"),
    "peak_modal": Entry(
        "sqrt(kg) m", "largest size of the flexible modes' motion, (sum of e^2 + (e'/W)^2)^1/2", "flexible"
    ),
    "residual_modal": Entry("sqrt(kg) m", "the same from t_f to t_end", "flexible"),
    **{
        f"{index}_{axis}": Entry("rad", f"{what}, {where}: largest in the observation", "pointing")
        for index, what in INDICES.items()
        for axis, where in AXES.items()
    },
    **{
        f"{WITHIN}{name}": Entry("-", f"share of the observation in which {name} is within its limit", "pointing")
        for name in AT_A_TIME
    },
}
POINTING = tuple(name for name, entry in CATALOGUE.items() if entry.table == "pointing")
# The same for other plants, whose x_1 is the error, in the states' own units; what they lack is left out.
STATE_CATALOGUE = {
    "terminal_error": Entry("x1", "|x_1| at t_f"),
    "window_error": Entry("x1", "RMS of |x_1| over the window after t_f"),
    "hold_error": Entry("x1", "largest |x_1| from t_f to t_end, at ends of periods"),
    "peak_torque": Entry("u", "largest commanded component of the input, before the actuator"),
    "peak_torque_delivered": Entry("u", "largest delivered component of the input"),
    "saturated": Entry("-", "fraction of the time in which a limit of the actuators cuts the command"),
    "effort": Entry("u s", "integral of the 1-norm of the delivered input"),
    "settling_time": Entry(
        "s", "time from which |x_1| stays below settling_angle, interpolated between ends of periods"
    ),
    "chattering": Entry("u/s", "total variation of the delivered input per second after t_f, largest component"),
    "peak_rate": Entry("x2", "largest |x_2|"),
}
MAY_BE_ZERO = ("saturated",)  # a limit of zero on these can be kept
LARGER_IS_BETTER = tuple(f"{WITHIN}{name}" for name in AT_A_TIME)  # a run that failed has 0; of others less is better
# units that a limit may be stated in, by the unit of its metric or key: name -> value in that unit
UNITS: dict[str, dict[str, float]] = {
    "rad": {"rad": 1.0, "mrad": 1e-3, "urad": 1e-6, "deg": math.pi / 180, "arcmin": math.pi / 10_800,
            "arcsec": math.pi / 648_000},
    "rad/s": {"rad/s": 1.0, "deg/s": math.pi / 180, "deg/h": math.pi / 648_000, "arcsec/s": math.pi / 648_000},
    "rad/s/sqrt(Hz)": {"rad/s/sqrt(Hz)": 1.0, "deg/s/sqrt(Hz)": math.pi / 180, "deg/sqrt(h)": math.pi / 10_800},
    "rad/s/sqrt(s)": {"rad/s/sqrt(s)": 1.0, "deg/s/sqrt(s)": math.pi / 180, "deg/h/sqrt(h)": math.pi / 38_880_000},
    "N m": {"N m": 1.0, "mN m": 1e-3, "uN m": 1e-6},
    "N m s": {"N m s": 1.0, "mN m s": 1e-3, "uN m s": 1e-6},
    "N m/s": {"N m/s": 1.0, "mN m/s": 1e-3, "uN m/s": 1e-6},
    "s": {"s": 1.0, "ms": 1e-3, "min": 60.0},
    "sqrt(kg) m": {"sqrt(kg) m": 1.0},
}  # fmt: skip
CATALOGUES = {"spacecraft": CATALOGUE, "chain": STATE_CATALOGUE, "system": STATE_CATALOGUE}  # by the kind of the plant


class Margin(NamedTuple):
    """A margin of the loop, see `margins`."""

    unit: str
    meaning: str
    at_least: bool = True  # a requirement is the least that is allowed


MARGINS = {
    "gain_margin": Margin("dB", "factor on the gain, up or down, to the border of stability"),
    "phase_margin": Margin("deg", "phase, either way, to the border of stability"),
    "delay_margin": Margin("s", "further delay to the border of stability"),
    "modulus_margin": Margin("dB", "largest sensitivity, 1 / the distance of L from -1", at_least=False),
}
NO_SIGN = "the exact sign has no slope: margins are those of the loop without its switching term"


def units(kind: str) -> dict[str, str]:
    """The unit of each metric of this kind of plant."""
    return {name: entry.unit for name, entry in CATALOGUES[kind].items()}


def percent(share: float) -> str:
    """A share in per cent, in three digits of it or of what is left to 100 %: how near that is, is what is asked.

    >>> percent(59 / 60), percent(0.99973), percent(1.0), percent(0.000412), percent(0.5)
    ('98.33', '99.973', '100', '0.0412', '50')
    """
    nearest = 100.0 * min(share, 1.0 - share)
    decimals = min(2 - math.floor(math.log10(nearest)), 8) if nearest > 0.0 else 1
    return f"{100.0 * share:.{decimals}f}".rstrip("0").rstrip(".")
