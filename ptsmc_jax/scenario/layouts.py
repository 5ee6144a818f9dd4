"""The plants of scenario files, a row each; and the kinds of what may be drawn."""

from collections.abc import Mapping

from ptsmc_jax.scenario import dispersion_tables as dt
from ptsmc_jax.scenario import own_devices
from ptsmc_jax.scenario.device_tables import COMMAND_FILTERS
from ptsmc_jax.scenario.spacecraft_scenario import SpacecraftScenario
from ptsmc_jax.scenario.state_scenario import ChainScenario, SystemScenario
from ptsmc_jax.scenario.tables import Scenario
from ptsmc_jax.scenario.values import Kinds, Table

# by the kind of the plant, the default first
SCENARIOS: dict[str, type[Scenario]] = {
    "spacecraft": SpacecraftScenario,
    "chain": ChainScenario,
    "system": SystemScenario,
}
TABLES: dict[str, Mapping[str, type[Table] | Kinds]] = {kind: made.TABLES for kind, made in SCENARIOS.items()}
OPTIONAL = (
    "flexible",
    "hardware",
    "sensors",
    "wheels",
    "filter",
    "pointing",
    "dispersion",
    "requirements",
    "tune",
)  # off where absent
KINDS: dict[str, Kinds] = {"hardware.command_filter": COMMAND_FILTERS}  # of a key that is a table
_RELATIVE: Kinds = {"relative_normal": dt.RelativeNormal, "relative_uniform": dt.RelativeUniform}
_TURN: Kinds = {"normal": dt.NormalTurn, "uniform": dt.UniformTurn}
DISPERSIONS: dict[str, Kinds] = {
    "attitude": {"axis_angle": dt.AxisAngle, "uniform": dt.UniformAttitude, "normal": dt.NormalAttitude},
    "reference": {"normal": dt.NormalAttitude, "uniform": dt.UniformAttitude, "axis_angle": dt.AxisAngle},
    "rate": {"normal": dt.NormalRate, "uniform": dt.UniformRate},
    "inertia": {"relative_normal": dt.RelativeInertia},
    "disturbance_phase": {"uniform": dt.UniformPhase},
    "disturbance_amplitude": _RELATIVE,
    "disturbance_bias": {"normal": dt.NormalBias, "uniform": dt.UniformBias},
    **dict.fromkeys(("attitude_noise", "rate_noise", "state_noise", "torque_limit"), _RELATIVE),
    **dict.fromkeys(("actuator_scale", "gyro_scale", "mode_frequency", "mode_coupling"), _RELATIVE),
    **dict.fromkeys(("actuator_misalignment", "star_tracker_misalignment"), _TURN),
    "star_tracker_outage": {"uniform": dt.Outage},
    "wheel_failure": {"uniform": dt.Failure},
    "timing_jitter": {"uniform": dt.Jitter},
    "own": {"own": own_devices.OWN_DRAW},
    "x0": {"uniform": dt.UniformState, "normal": dt.NormalState},
}
