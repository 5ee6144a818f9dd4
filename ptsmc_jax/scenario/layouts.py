"""Which tables a scenario of each kind of plant has, and the defaults that no single key tells."""

import math
from collections.abc import Mapping
from typing import Any

from ptsmc_jax.scenario import device_tables, law_tables, plant_tables, signal_tables, values
from ptsmc_jax.scenario import dispersion_tables as dt
from ptsmc_jax.scenario import tables as t

# A table is a struct, or one for each kind, the default first.
Kinds = dict[str, type[values.Table]]
_STATE_OBSERVERS: Kinds = {
    "nonlinear": law_tables.EachNonlinearObserver,
    "finite_time": law_tables.EachFiniteTimeObserver,
    "prescribed_time": law_tables.EachPrescribedTimeObserver,
}
_STATE_DISTURBANCES: Kinds = {
    "sinusoid": signal_tables.EachSinusoid,
    "constant": signal_tables.EachConstant,
    "random_walk": signal_tables.EachRandomWalk,
    "sum": signal_tables.SumDisturbance,
}
_STATE_LOOP: dict[str, type[values.Table] | Kinds] = {
    "loop": t.Loop,
    "hardware": device_tables.StateHardware,
    "dispersion": dt.StateDispersion,
    "tune": t.Tune,
}
TABLES: dict[str, dict[str, type[values.Table] | Kinds]] = {  # by the kind of the plant
    "spacecraft": {
        "plant": plant_tables.SpacecraftPlant,
        "spacecraft": plant_tables.Spacecraft,
        "initial": signal_tables.Initial,
        "reference": {
            "fixed": signal_tables.FixedReference,
            "spin": signal_tables.SpinReference,
            "sinusoid": signal_tables.SinusoidReference,
            "slew": signal_tables.SlewReference,
        },
        "disturbance": {
            "sinusoid": signal_tables.SinusoidDisturbance,
            "none": signal_tables.NoDisturbance,
            "constant": signal_tables.ConstantDisturbance,
            "gravity_gradient": signal_tables.GravityGradient,
            "random_walk": signal_tables.RandomWalk,
            "sum": signal_tables.SumDisturbance,
        },
        "controller": {
            "prescribed_time": law_tables.Controller,
            "pd": law_tables.PDController,
            "terminal": law_tables.TerminalController,
            "fixed_time": law_tables.FixedTimeController,
        },
        "observer": {
            "nonlinear": law_tables.NonlinearObserver,
            "none": law_tables.NoObserver,
            "finite_time": law_tables.FiniteTimeObserver,
            "prescribed_time": law_tables.PrescribedTimeObserver,
        },
        "loop": t.Loop,
        "hardware": device_tables.Hardware,
        "wheels": {"pyramid": device_tables.PyramidWheels, "axes": device_tables.AxesWheels},
        "filter": {"steady_state": device_tables.SteadyStateFilter, "none": device_tables.NoFilter},
        "dispersion": dt.Dispersion,
        "tune": t.Tune,
    },
    "chain": {
        "plant": plant_tables.ChainPlant,
        "disturbance": {
            "sinusoid": signal_tables.EachSinusoid,
            "none": signal_tables.NoDisturbance,
            **_STATE_DISTURBANCES,
        },
        "controller": {"prescribed_time": law_tables.ChainController},
        "observer": {"none": law_tables.NoObserver, **_STATE_OBSERVERS},
        **_STATE_LOOP,
    },
    "system": {
        "plant": plant_tables.SystemPlant,
        "disturbance": {"none": signal_tables.NoDisturbance, **_STATE_DISTURBANCES},
        "controller": {"prescribed_time": law_tables.SystemController},
        "observer": {"none": law_tables.NoObserver, **_STATE_OBSERVERS},
        **_STATE_LOOP,
    },
}
# margins of the loop, see `margins`: name: (unit, what it is, whether a requirement is the least that is allowed)
MARGINS = {
    "gain_margin": ("dB", "factor on the gain, up or down, to the border of stability", True),
    "phase_margin": ("deg", "phase, either way, to the border of stability", True),
    "delay_margin": ("s", "further delay to the border of stability", True),
    "modulus_margin": ("dB", "largest sensitivity, 1 / the distance of L from -1", False),
}
OPTIONAL = ("hardware", "wheels", "filter", "dispersion", "requirements", "tune")  # off where absent
_RELATIVE: Kinds = {"relative_normal": dt.RelativeNormal, "relative_uniform": dt.RelativeUniform}
DISPERSIONS: dict[str, Kinds] = {
    "attitude": {"axis_angle": dt.AxisAngle, "uniform": dt.UniformAttitude, "normal": dt.NormalAttitude},
    "reference": {"normal": dt.NormalAttitude, "uniform": dt.UniformAttitude, "axis_angle": dt.AxisAngle},
    "rate": {"normal": dt.NormalRate, "uniform": dt.UniformRate},
    "inertia": {"relative_normal": dt.RelativeInertia},
    "disturbance_phase": {"uniform": dt.UniformPhase},
    "disturbance_amplitude": _RELATIVE,
    "disturbance_bias": {"normal": dt.NormalBias, "uniform": dt.UniformBias},
    **dict.fromkeys(("attitude_noise", "rate_noise", "state_noise", "torque_limit"), _RELATIVE),
    "x0": {"uniform": dt.UniformState, "normal": dt.NormalState},
}

_CASE_I: dict[str, Mapping[str, Any]] = {
    "initial": {"quat_xyzw": [0.4714045207910317, -0.3333333333333333, 0.5773502691896258, 0.5773502691896258]},
    "reference": {"quat_xyzw": [0.0, 0.0, 0.0, 1.0]},
}


# What lists of one number for each input hold where they are absent: table and kind -> key -> number.
EACH: dict[tuple[str, str], dict[str, float]] = {
    ("disturbance", "random_walk"): {"density": 1e-4},
    ("disturbance", "constant"): {"amplitude": 0.01},
    ("disturbance", "sinusoid"): {"amplitude": 0.01, "frequency": 1.0, "phase": 0.0, "bias": 0.0},
    ("observer", "nonlinear"): {"gain": 10.0},
    ("observer", "prescribed_time"): {"gain": 10.0},
    ("observer", "finite_time"): {"gain": 20.0},  # times controller.disturbance_rate_bound
}


def defaults(kind: str, order: int) -> dict[str, Mapping[str, Any]]:
    """Defaults that no single key tells: the paper's Case I; a chain's, Figs. 1 and 2 for order 2 and 3."""
    if kind == "spacecraft":
        return _CASE_I
    if kind == "system":
        return {}
    x0 = [*(5.0, 3.0, 2.0)[:order], *[0.0] * (order - 3)]
    poles_at_minus_one = [float(math.comb(order - 1, i)) for i in range(order - 1)]  # (p + 1)^(n-1); order 2: (9)
    return {"plant": {"x0": x0}, "controller": {"eta": order + 1.0, "a": poles_at_minus_one}}
