"""Which tables a scenario of each kind of plant has, and the defaults that no single key tells."""

import math
from collections.abc import Mapping
from typing import Any

from ptsmc_jax import tables as t

# A table is a struct, or one for each kind, the default first; a kind without a struct is not available yet.
Kinds = dict[str, type[t.Table] | None]
_LAWS: Kinds = {"pd": None, "terminal": None, "fixed_time": None}
_OBSERVERS: Kinds = {"finite_time": None, "prescribed_time": None}
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
        "controller": {"prescribed_time": t.Controller, **_LAWS},
        "observer": {"nonlinear": t.NonlinearObserver, "none": t.NoObserver, **_OBSERVERS},
        "loop": t.Loop,
        "hardware": t.Hardware,
        "wheels": {"pyramid": t.PyramidWheels, "axes": t.AxesWheels},
        "filter": {"steady_state": t.SteadyStateFilter, "none": t.NoFilter},
        "dispersion": t.Dispersion,
        "tune": t.Tune,
    },
    "chain": {
        "plant": t.ChainPlant,
        "disturbance": {
            "sinusoid": t.ChainSinusoidDisturbance,
            "none": t.NoDisturbance,
            "constant": t.ChainConstantDisturbance,
            "random_walk": t.ChainRandomWalk,
            "sum": t.SumDisturbance,
        },
        "controller": {"prescribed_time": t.ChainController, **_LAWS},
        "observer": {"none": t.NoObserver, "nonlinear": t.ChainNonlinearObserver, **_OBSERVERS},
        "loop": t.Loop,
        "hardware": t.ChainHardware,
        "dispersion": t.ChainDispersion,
        "tune": t.Tune,
    },
}
OPTIONAL = ("hardware", "wheels", "filter", "dispersion", "requirements", "tune")  # off where absent
DISPERSIONS: dict[str, Kinds] = {
    "attitude": {"axis_angle": t.AxisAngle, "uniform": t.UniformAttitude, "normal": t.NormalAttitude},
    "rate": {"normal": t.NormalRate},
    "inertia": {"relative_normal": t.RelativeInertia},
    "disturbance_phase": {"uniform": t.UniformPhase},
    "x0": {"uniform": t.UniformState, "normal": t.NormalState},
}

_CASE_I: dict[str, Mapping[str, Any]] = {
    "initial": {"quat_xyzw": [0.4714045207910317, -0.3333333333333333, 0.5773502691896258, 0.5773502691896258]},
    "reference": {"quat_xyzw": [0.0, 0.0, 0.0, 1.0]},
}


def defaults(kind: str, order: int) -> dict[str, Mapping[str, Any]]:
    """Defaults that no single key tells: the paper's Case I; a chain's, Figs. 1 and 2 for order 2 and 3."""
    if kind == "spacecraft":
        return _CASE_I
    x0 = [*(5.0, 3.0, 2.0)[:order], *[0.0] * (order - 3)]
    poles_at_minus_one = [float(math.comb(order - 1, i)) for i in range(order - 1)]  # (p + 1)^(n-1); order 2: (9)
    return {"plant": {"x0": x0}, "controller": {"eta": order + 1.0, "a": poles_at_minus_one}}
