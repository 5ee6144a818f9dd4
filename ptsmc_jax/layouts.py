"""Which tables a scenario of each kind of plant has, and the defaults that no single key tells."""

import math
from collections.abc import Mapping
from typing import Any

from ptsmc_jax import dispersion_tables as dt
from ptsmc_jax import tables as t

# A table is a struct, or one for each kind, the default first.
Kinds = dict[str, type[t.Table]]
_STATE_OBSERVERS: Kinds = {
    "nonlinear": t.EachNonlinearObserver,
    "finite_time": t.EachFiniteTimeObserver,
    "prescribed_time": t.EachPrescribedTimeObserver,
}
_STATE_DISTURBANCES: Kinds = {
    "sinusoid": t.EachSinusoid,
    "constant": t.EachConstant,
    "random_walk": t.EachRandomWalk,
    "sum": t.SumDisturbance,
}
_STATE_LOOP: dict[str, type[t.Table] | Kinds] = {
    "loop": t.Loop,
    "hardware": t.StateHardware,
    "dispersion": t.StateDispersion,
    "tune": t.Tune,
}
TABLES: dict[str, dict[str, type[t.Table] | Kinds]] = {  # by the kind of the plant
    "spacecraft": {
        "plant": t.SpacecraftPlant,
        "spacecraft": t.Spacecraft,
        "initial": t.Initial,
        "reference": {
            "fixed": t.FixedReference,
            "spin": t.SpinReference,
            "sinusoid": t.SinusoidReference,
            "slew": t.SlewReference,
        },
        "disturbance": {
            "sinusoid": t.SinusoidDisturbance,
            "none": t.NoDisturbance,
            "constant": t.ConstantDisturbance,
            "gravity_gradient": t.GravityGradient,
            "random_walk": t.RandomWalk,
            "sum": t.SumDisturbance,
        },
        "controller": {
            "prescribed_time": t.Controller,
            "pd": t.PDController,
            "terminal": t.TerminalController,
            "fixed_time": t.FixedTimeController,
        },
        "observer": {
            "nonlinear": t.NonlinearObserver,
            "none": t.NoObserver,
            "finite_time": t.FiniteTimeObserver,
            "prescribed_time": t.PrescribedTimeObserver,
        },
        "loop": t.Loop,
        "hardware": t.Hardware,
        "wheels": {"pyramid": t.PyramidWheels, "axes": t.AxesWheels},
        "filter": {"steady_state": t.SteadyStateFilter, "none": t.NoFilter},
        "dispersion": t.Dispersion,
        "tune": t.Tune,
    },
    "chain": {
        "plant": t.ChainPlant,
        "disturbance": {"sinusoid": t.EachSinusoid, "none": t.NoDisturbance, **_STATE_DISTURBANCES},
        "controller": {"prescribed_time": t.ChainController},
        "observer": {"none": t.NoObserver, **_STATE_OBSERVERS},
        **_STATE_LOOP,
    },
    "system": {
        "plant": t.SystemPlant,
        "disturbance": {"none": t.NoDisturbance, **_STATE_DISTURBANCES},
        "controller": {"prescribed_time": t.SystemController},
        "observer": {"none": t.NoObserver, **_STATE_OBSERVERS},
        **_STATE_LOOP,
    },
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
