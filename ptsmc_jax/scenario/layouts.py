"""Which tables a scenario of each kind of plant has, and the defaults that no single key tells."""

import math
from collections.abc import Mapping
from typing import Any

from ptsmc_jax.scenario import device_tables, plant_tables, reference_tables
from ptsmc_jax.scenario import dispersion_tables as dt
from ptsmc_jax.scenario import tables as t
from ptsmc_jax.scenario.disturbance_tables import DISTURBANCES
from ptsmc_jax.scenario.law_tables import LAWS
from ptsmc_jax.scenario.observer_tables import OBSERVERS
from ptsmc_jax.scenario.reference_tables import REFERENCES
from ptsmc_jax.scenario.values import Kinds, Table

# A table is a struct, or one for each kind, the default first.
_STATE_LOOP: dict[str, type[Table] | Kinds] = {
    "loop": t.Loop,
    "hardware": device_tables.StateHardware,
    "dispersion": dt.StateDispersion,
    "tune": t.Tune,
}
TABLES: dict[str, dict[str, type[Table] | Kinds]] = {  # by the kind of the plant
    "spacecraft": {
        "plant": plant_tables.SpacecraftPlant,
        "spacecraft": plant_tables.Spacecraft,
        "initial": reference_tables.Initial,
        "reference": REFERENCES,
        "disturbance": DISTURBANCES["spacecraft"],
        "controller": LAWS["spacecraft"],
        "observer": OBSERVERS["spacecraft"],
        "loop": t.Loop,
        "hardware": device_tables.Hardware,
        "wheels": {"pyramid": device_tables.PyramidWheels, "axes": device_tables.AxesWheels},
        "filter": {"steady_state": device_tables.SteadyStateFilter, "none": device_tables.NoFilter},
        "dispersion": dt.Dispersion,
        "tune": t.Tune,
    },
    "chain": {
        "plant": plant_tables.ChainPlant,
        "disturbance": DISTURBANCES["chain"],
        "controller": LAWS["chain"],
        "observer": OBSERVERS["chain"],
        **_STATE_LOOP,
    },
    "system": {
        "plant": plant_tables.SystemPlant,
        "disturbance": DISTURBANCES["system"],
        "controller": LAWS["system"],
        "observer": OBSERVERS["system"],
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


def defaults(kind: str, order: int, law: object) -> dict[str, Mapping[str, Any]]:
    """Defaults that no single key tells: the paper's Case I; a chain's, Figs. 1 and 2 for order 2 and 3."""
    if kind == "spacecraft":
        return _CASE_I
    others: Mapping[str, Any] = {} if law == "prescribed_time" else {"t_f": 5.0}  # the paper's, for every law
    if kind == "system":
        return {"controller": others}
    x0 = [*(5.0, 3.0, 2.0)[:order], *[0.0] * (order - 3)]
    poles_at_minus_one = [float(math.comb(order - 1, i)) for i in range(order - 1)]  # (p + 1)^(n-1); order 2: (9)
    return {"plant": {"x0": x0}, "controller": others or {"eta": order + 1.0, "a": poles_at_minus_one}}
