"""The tables of a scenario file that name devices: actuators, sensors, wheels and the attitude filter."""

from typing import Annotated, Literal

from msgspec import Meta

from ptsmc_jax.scenario.values import Count, NotNegative, NotNegatives, Positive, Table, Three


class Actuators(Table, frozen=True):
    """Between the command and the plant; each device is off where it is absent.

    Attributes:
        torque_limit: largest torque per body axis [N m]
        torque_rate_limit: largest rate of the torque [N m/s]
        torque_lag: time constant of a first-order lag [s]
        torque_step: quantisation of the torque [N m]
        delay: control periods from measuring to acting
    """

    torque_limit: Positive | None = None
    torque_rate_limit: Positive | None = None
    torque_lag: Positive | None = None
    torque_step: Positive | None = None
    delay: Annotated[int, Meta(ge=0, description="a whole number, at least 0")] | None = None


class Hardware(Actuators, frozen=True):
    """Actuators, star tracker and gyro of the sampled loop; each device is off where it is absent.

    Attributes:
        attitude_noise: of the star tracker, 1 sigma per axis and sample, a small rotation [rad]
        rate_noise: of the gyro, 1 sigma per axis and sample [rad/s]
        rate_noise_density: instead of rate_noise, which is then this / sqrt(period) [rad/s/sqrt(Hz)]
        rate_bias: of the gyro, 1 sigma per axis, constant over a run [rad/s]
        rate_bias_walk: random walk of that bias [rad/s/sqrt(s)]
        star_tracker_every: control periods between star tracker samples, with a filter
    """

    attitude_noise: NotNegative | None = None
    rate_noise: NotNegative | None = None
    rate_noise_density: NotNegative | None = None
    rate_bias: NotNegative | None = None
    rate_bias_walk: NotNegative | None = None
    star_tracker_every: Count | None = None


class StateHardware(Actuators, frozen=True):
    """Actuators and noise of the sampled loop; each device is off where it is absent.

    Attributes:
        torque_limit: largest input [unit of u]
        torque_rate_limit: largest rate of the input [unit of u/s]
        torque_step: quantisation of the input [unit of u]
        state_noise: 1 sigma per sample, one number for each state
    """

    state_noise: NotNegatives | None = None


class NoFilter(Table, frozen=True):
    """None: the law sees the samples themselves."""

    kind: Literal["none"] = "none"


class SteadyStateFilter(Table, frozen=True):
    """A steady-state attitude filter, propagated by the gyro, corrected by the star tracker.

    Attributes:
        bandwidth: of the corrections; default: where star tracker and gyro noise weigh the same [rad/s]
    """

    kind: Literal["steady_state"] = "steady_state"
    bandwidth: Positive | None = None


class WheelLimits(Table, frozen=True):
    """What reaction wheels have besides their axes; lag, step and rate limit of [hardware] are then theirs.

    Attributes:
        torque_limit: of each wheel [N m]
        momentum_limit: of each wheel [N m s]
        momentum: at t = 0, one number for each wheel, absolute: spin inertia times the sum of wheel speed and body rate
            about its axis; default: 0 each [N m s]
    """

    torque_limit: Positive | None = None
    momentum_limit: Positive | None = None
    momentum: Annotated[tuple[float, ...], Meta(description="a list of numbers, one for each wheel")] | None = None


class PyramidWheels(WheelLimits, frozen=True):
    """Four reaction wheels, 90 degrees apart about z; lag, step and rate limit of [hardware] are theirs.

    Attributes:
        cant_deg: by which their axes are tilted toward +z; by default equally strong about all axes [deg]
    """

    kind: Literal["pyramid"] = "pyramid"
    cant_deg: Annotated[float, Meta(gt=0, lt=90, description="an angle between 0 and 90 degrees")] = 35.264389682754654


class AxesWheels(WheelLimits, frozen=True):
    """Any number of reaction wheels; lag, step and rate limit of [hardware] are theirs.

    Attributes:
        axes: spin axes in body axes, three numbers each, of any length
    """

    kind: Literal["axes"] = "axes"
    axes: Annotated[tuple[Three, ...], Meta(description="a list of spin axes, three numbers each")] = (
        (1.0, 0.0, 0.0),
        (0.0, 1.0, 0.0),
        (0.0, 0.0, 1.0),
    )
