"""The tables of a scenario file that say what is drawn for each trial."""

from typing import Annotated, Literal

from msgspec import Meta

from ptsmc_jax.values import NotNegative, NotNegatives, Table


class UniformAttitude(Table, frozen=True):
    kind: Literal["uniform"] = "uniform"


class AxisAngle(Table, frozen=True):
    kind: Literal["axis_angle"] = "axis_angle"
    min_deg: Annotated[float, Meta(ge=0, le=180, description="an angle from 0 to 180 degrees")] = 20.0
    max_deg: Annotated[float, Meta(ge=0, le=180, description="an angle from 0 to 180 degrees")] = 140.0


class NormalAttitude(Table, frozen=True):
    kind: Literal["normal"] = "normal"
    std_deg: NotNegative = 1.0


class NormalRate(Table, frozen=True):
    kind: Literal["normal"] = "normal"
    std: NotNegative = 0.01


class UniformRate(Table, frozen=True):
    """Each axis uniform within half_width of initial.rate."""

    kind: Literal["uniform"] = "uniform"
    half_width: NotNegative = 0.01


class RelativeInertia(Table, frozen=True):
    """Principal moments off by a normal share, truncated at three standard deviations, their axes turned."""

    kind: Literal["relative_normal"] = "relative_normal"
    std: Annotated[float, Meta(ge=0, le=0.3, description="a number from 0 to 0.3")] = 0.05
    axes_deg: NotNegative = 0.0


class UniformPhase(Table, frozen=True):
    kind: Literal["uniform"] = "uniform"


class RelativeNormal(Table, frozen=True):
    """Off by a normal share, truncated at three standard deviations."""

    kind: Literal["relative_normal"] = "relative_normal"
    std: Annotated[float, Meta(ge=0, le=0.3, description="a number from 0 to 0.3")] = 0.1


class RelativeUniform(Table, frozen=True):
    """Off by a share of at most half_width."""

    kind: Literal["relative_uniform"] = "relative_uniform"
    half_width: Annotated[float, Meta(ge=0, lt=1, description="a number from 0 to below 1")] = 0.2


class NormalBias(Table, frozen=True):
    kind: Literal["normal"] = "normal"
    std: NotNegative = 1e-3


class UniformBias(Table, frozen=True):
    """Each input's within half_width of what [disturbance] says."""

    kind: Literal["uniform"] = "uniform"
    half_width: NotNegative = 1e-3


class UniformState(Table, frozen=True):
    """Every state uniform within half_width of x0."""

    kind: Literal["uniform"] = "uniform"
    half_width: NotNegatives = ()  # 1 for each state


class NormalState(Table, frozen=True):
    """Every state normal about x0."""

    kind: Literal["normal"] = "normal"
    std: NotNegatives = ()  # 1 for each state


class Dispersion(Table, frozen=True):
    attitude: UniformAttitude | AxisAngle | NormalAttitude | None = None
    rate: NormalRate | UniformRate | None = None
    inertia: RelativeInertia | None = None
    reference: UniformAttitude | AxisAngle | NormalAttitude | None = None
    disturbance_phase: UniformPhase | None = None
    disturbance_amplitude: RelativeNormal | RelativeUniform | None = None
    disturbance_bias: NormalBias | UniformBias | None = None
    attitude_noise: RelativeNormal | RelativeUniform | None = None
    rate_noise: RelativeNormal | RelativeUniform | None = None
    torque_limit: RelativeNormal | RelativeUniform | None = None


class StateDispersion(Table, frozen=True):
    x0: UniformState | NormalState | None = None
    disturbance_phase: UniformPhase | None = None
    disturbance_amplitude: RelativeNormal | RelativeUniform | None = None
    disturbance_bias: NormalBias | UniformBias | None = None
    state_noise: RelativeNormal | RelativeUniform | None = None
    torque_limit: RelativeNormal | RelativeUniform | None = None
