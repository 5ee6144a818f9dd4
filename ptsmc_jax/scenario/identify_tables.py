"""The tables [telemetry] and [identify] of scenario files: columns of a log, and parameters to estimate from it."""

from typing import Annotated, Literal

from msgspec import Meta

from ptsmc_jax.scenario.errors import ScenarioError, wrong
from ptsmc_jax.scenario.values import Count, Meaning, NotNegative, Positive, Table

Column = Annotated[str, Meta(min_length=1, description="the name of a column")]
Columns = Annotated[tuple[Column, ...], Meta(min_length=1, description="a list of names of columns")]
Quaternion = Annotated[
    tuple[Column, Column, Column, Column],
    Meta(description="a list of four names of columns, in the order of `quaternion_order`"),
]
RateUnit = Literal["rad/s", "mrad/s", "deg/s", "deg/h", "arcsec/s", "rpm"]
TorqueUnit = Literal["N m", "N cm", "mN m", "uN m"]
SpeedUnit = Literal["rad/s", "deg/s", "rpm"]
Axes = Annotated[tuple[Column, Column, Column], Meta(description="a list of three names of columns")]


class Telemetry(Table, frozen=True):
    """The columns of a log of a spacecraft. The defaults are the columns of `trajectory.csv`."""

    time: Annotated[Column, Meaning("time in s, or date and time in ISO 8601")] = "t"
    attitude: Annotated[
        Quaternion | None,
        Meaning("unit quaternion of the star tracker; default: measured_q1 to measured_q4, if logged"),
    ] = None
    quaternion_order: Annotated[Literal["xyzw", "wxyz"], Meaning("scalar part last or first")] = "xyzw"
    rotation: Annotated[
        Literal["body_to_inertial", "inertial_to_body"],
        Meaning("the axes that the quaternion rotates from and to"),
    ] = "body_to_inertial"
    attitude_age: Annotated[Column | None, Meaning("age of the attitude in s; default: measured_age, if logged")] = None
    rate: Annotated[Axes | None, Meaning("body rate of the gyro; default: measured_w1 to measured_w3, if logged")] = (
        None
    )
    rate_unit: Annotated[RateUnit, Meaning("unit of the rate columns")] = "rad/s"
    torque: Annotated[
        Axes | None,
        Meaning(
            "torque in body axes that the computer sends to the actuators, held until the next row; default: sent1 to "
            "sent3, if logged"
        ),
    ] = None
    wheel_torque: Annotated[
        Columns | None, Meaning("instead of torque: commanded torque of each wheel on the body about its axis")
    ] = None
    torque_unit: Annotated[TorqueUnit, Meaning("unit of the torque columns")] = "N m"
    wheel_speed: Annotated[
        Columns | None, Meaning("instead of torque: measured speed of each wheel relative to the body")
    ] = None
    speed_unit: Annotated[SpeedUnit, Meaning("unit of the speed columns")] = "rad/s"
    wheel_inertia: Annotated[
        Positive | None, Meaning("spin inertia of each wheel; needed with wheel_speed", "kg m^2")
    ] = None


class StateTelemetry(Table, frozen=True):
    """The columns of a log of a chain or a custom system. The defaults are the columns of `trajectory.csv`."""

    time: Annotated[Column, Meaning("time in s, or date and time in ISO 8601")] = "t"
    state: Annotated[
        Columns | None, Meaning("measured state, a column for each component; default: measured_x1, measured_x2, ..")
    ] = None
    input: Annotated[
        Columns | None,
        Meaning("commanded input, a column for each, held until the next row; default: sent1, sent2, .."),
    ] = None


class Identify(Table, frozen=True):
    """Parameters that `ptsmc identify` estimates, and how."""

    free: Annotated[
        Annotated[tuple[Column, ...], Meta(min_length=1, description="a list of names of parameters")] | None,
        Meaning(
            "parameters to estimate; default: inertia and gyro_bias, of other plants actuator_scale, and those that "
            '[dispersion] varies unless prior is "none"'
        ),
    ] = None
    prior: Annotated[
        Literal["dispersion", "none"],
        Meaning('prior knowledge of the parameters: "dispersion" takes it from [dispersion], "none" assumes none'),
    ] = "dispersion"
    torque_walk: Annotated[
        NotNegative | None,
        Meaning(
            "density of the white noise of a random-walk disturbance in the filter, for each input; default: that of "
            "[disturbance] with kind random_walk, or none",
            "unit of d/sqrt(s)",
        ),
    ] = None
    starts: Annotated[
        Count, Meaning("starting points, the scenario and random ones; more than one is used after a poor fit only")
    ] = 3
    outliers: Annotated[
        Annotated[float, Meta(ge=0, lt=1, description="a number from 0 to below 1")],
        Meaning("probability that a sample without error is rejected as an outlier; 0: no sample is rejected"),
    ] = 1e-6


def check(identify: Identify | None, telemetry: object) -> None:
    """Raise ScenarioError if keys of the tables contradict each other."""
    if identify is not None and identify.free is not None and len(set(identify.free)) < len(identify.free):
        raise wrong("identify.free", identify.free, "a list of different names")
    for key in getattr(telemetry, "__struct_fields__", ()):
        columns = getattr(telemetry, key)
        if isinstance(columns, tuple) and len(set(columns)) < len(columns):
            raise wrong(f"telemetry.{key}", columns, "a list of different columns")
    if not isinstance(telemetry, Telemetry):
        return
    input_keys = [key for key in ("torque", "wheel_torque", "wheel_speed") if getattr(telemetry, key) is not None]
    if len(input_keys) > 1:
        raise ScenarioError(f"telemetry has {' and '.join(input_keys)}, but must have one of them")
    if telemetry.wheel_speed is not None and telemetry.wheel_inertia is None:
        raise ScenarioError("telemetry.wheel_inertia is absent, but must be given with telemetry.wheel_speed")
