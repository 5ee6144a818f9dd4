"""The tables of a scenario file that name devices: actuators, sensors, wheels and the attitude filter."""

from typing import Annotated, Literal

from msgspec import Meta

from ptsmc_jax.values import (
    Count,
    NotNegative,
    NotNegatives,
    Positive,
    Table,
    Three,
)


class Actuators(Table, frozen=True):
    torque_limit: Positive | None = None
    torque_rate_limit: Positive | None = None
    torque_lag: Positive | None = None
    torque_step: Positive | None = None
    delay: Annotated[int, Meta(ge=0, description="a whole number, at least 0")] | None = None


class Hardware(Actuators, frozen=True):
    attitude_noise: NotNegative | None = None
    rate_noise: NotNegative | None = None
    rate_noise_density: NotNegative | None = None
    rate_bias: NotNegative | None = None
    rate_bias_walk: NotNegative | None = None
    star_tracker_every: Count | None = None


class StateHardware(Actuators, frozen=True):
    state_noise: NotNegatives | None = None


class NoFilter(Table, frozen=True):
    kind: Literal["none"] = "none"


class SteadyStateFilter(Table, frozen=True):
    kind: Literal["steady_state"] = "steady_state"
    bandwidth: Positive | None = None


class WheelLimits(Table, frozen=True):
    torque_limit: Positive | None = None
    momentum_limit: Positive | None = None
    momentum: Annotated[tuple[float, ...], Meta(description="a list of numbers, one for each wheel")] | None = None


class PyramidWheels(WheelLimits, frozen=True):
    kind: Literal["pyramid"] = "pyramid"
    cant_deg: Annotated[float, Meta(gt=0, lt=90, description="an angle between 0 and 90 degrees")] = 35.264389682754654


class AxesWheels(WheelLimits, frozen=True):
    kind: Literal["axes"] = "axes"
    axes: Annotated[tuple[Three, ...], Meta(description="a list of spin axes, three numbers each")] = (
        (1.0, 0.0, 0.0),
        (0.0, 1.0, 0.0),
        (0.0, 0.0, 1.0),
    )
