"""The tables [hardware], [filter] and [wheels] of scenario files, and the parts that they build.

Start with `Hardware`. A new filter needs its physics in `devices`, a table here, and a row in `FILTERS`. New wheels
need a row in `WHEELS`.
"""

import dataclasses
import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import msgspec
import numpy as np
from msgspec import Meta

from ptsmc_jax import formulas
from ptsmc_jax.devices import command_filter
from ptsmc_jax.devices.actuators import Actuators as ActuatorsPart
from ptsmc_jax.devices.actuators import Wheels, wheels
from ptsmc_jax.devices.attitude_filter import AttitudeFilter, attitude_filter, filter_between_samples
from ptsmc_jax.devices.attitude_sensors import INTEGER_TOLERANCE, SampleTimes, sample_times
from ptsmc_jax.devices.sensors import PerfectSensors, Sensor, Sensors, StateSensor
from ptsmc_jax.numerics.pytrees import vector
from ptsmc_jax.scenario import errors
from ptsmc_jax.scenario.errors import ScenarioError, wrong
from ptsmc_jax.scenario.schema import PartTable, make_table
from ptsmc_jax.scenario.values import Kinds, Meaning, NotNegative, NotNegatives, Positive, Table, Three, rounded

if TYPE_CHECKING:
    from ptsmc_jax.scenario.tables import Scenario

ONE_FOR_EACH = "one for each axis, wheel or input"
PositiveEach = Annotated[
    tuple[Positive, ...], Meta(min_length=1, description=f"a list of numbers greater than 0, {ONE_FOR_EACH}")
]
ThreeEach = Annotated[
    tuple[Three, ...], Meta(min_length=1, description=f"a list of rows of three numbers, {ONE_FOR_EACH}")
]


class CommandFilterTable(PartTable, frozen=True):
    """A filter between the law and the actuators, in the flight computer."""

    prefix: ClassVar[str] = "command_"


COMMAND_FILTERS: Kinds = {
    "first_order": make_table(CommandFilterTable, command_filter.FirstOrder, "first_order"),
    "second_order": make_table(CommandFilterTable, command_filter.SecondOrder, "second_order"),
    "notch": make_table(CommandFilterTable, command_filter.Notch, "notch"),
}


class Actuators(Table, frozen=True):
    """Actuators between the commanded torque and the plant. A device without a key is off."""

    command_filter: Annotated[
        CommandFilterTable | None, Meaning("filter between the law and the actuators, an inline table with a kind")
    ] = None
    torque_limit: Annotated[Positive | None, Meaning("largest torque about an axis, or largest input", "unit of u")] = (
        None
    )
    torque_rate_limit: Annotated[Positive | None, Meaning("largest rate of torque or input", "unit of u/s")] = None
    torque_lag: Annotated[Positive | None, Meaning("time constant of a first-order lag", "s")] = None
    torque_step: Annotated[Positive | None, Meaning("quantisation of torque or input", "unit of u")] = None
    delay: Annotated[
        Annotated[int, Meta(ge=0, description="a whole number of control periods, at least 0")] | None,
        Meaning(
            "control periods from the measurement to the torque, the same for all sensors. It also delays"
            " the compensation of the wheels' momentum. The observer uses the delayed torque. The law "
            "does not predict over it"
        ),
    ] = None
    actuator_scale: Annotated[
        PositiveEach | None,
        Meaning("ratio of the true torque of each axis, wheel or input to the torque that the computer knows"),
    ] = None
    nominal_keys: ClassVar[Mapping[str, tuple[str, ...]]] = {}  # by dispersion key: the keys that set its nominal value
    noise_keys: ClassVar[tuple[str, ...]] = ()  # keys of sensor errors

    @property
    def delay_periods(self) -> int:
        """Control periods from the measurement to the torque."""
        return self.delay or 0

    def check(self, scenario: "Scenario") -> None:
        """Raise ScenarioError if keys contradict each other or the scenario."""
        step, limit = self.torque_step, self.torque_limit
        if step is not None and limit is not None and step >= 2.0 * limit and getattr(scenario, "wheels", None) is None:
            unit = " N m" if scenario.motion == "spacecraft" else ""
            allowed = f"less than twice hardware.torque_limit, {limit}{unit}: larger ones round every torque to zero"
            raise wrong("hardware.torque_step", step, allowed)
        wheels = scenario.reaction_wheels
        channels = scenario.inputs if wheels is None else len(wheels.spin_axes())
        each = "wheel" if wheels is not None else "axis" if scenario.motion == "spacecraft" else "input"
        for key, entry in (("actuator_scale", "number"), ("actuator_misalignment_deg", "row")):
            value = getattr(self, key, None)
            if value is not None and len(value) != channels:
                raise wrong(f"hardware.{key}", value, errors.list_of(channels, each, entry))

    def noise_of_error(self, scenario: "Scenario") -> tuple[float, float]:
        """Return the noise of the error and of its rate [1/s], 1 sigma per axis and raw sample."""
        raise NotImplementedError

    def noise_of_s(self, scenario: "Scenario") -> float:
        """Return the noise of the sliding variable in the hold phase, 1 sigma per axis and raw sample."""
        law = scenario.controller
        return law.law.noise_of_s(law, *self.noise_of_error(scenario))

    def actuators(self, wheels: Wheels | None) -> ActuatorsPart:
        """Return the actuators; `wheels`: the part of `devices.actuators`, or None."""
        values = (self.torque_limit, self.torque_rate_limit, self.torque_lag, self.torque_step)
        limit, rate_limit, lag, step = (None if v is None else vector(v) for v in values)
        scale = None if self.actuator_scale is None else vector(self.actuator_scale)
        return ActuatorsPart(limit, rate_limit, lag, step, wheels, self.delay_periods, scale)


class Hardware(Actuators, frozen=True):
    """Actuators, star tracker and gyro of the sampled loop. A device without a key is off."""

    attitude_noise: Annotated[
        NotNegative | None,
        Meaning(
            "noise of the star tracker: 1 sigma of a small rotation about each axis, at each sample. If "
            "the axes differ, use the largest, or [[sensors]]",
            "rad",
        ),
    ] = None
    rate_noise: Annotated[NotNegative | None, Meaning("noise of the gyro, 1 sigma per axis and sample", "rad/s")] = None
    rate_noise_density: Annotated[
        NotNegative | None,
        Meaning(
            'angle random walk of the gyro, such as "0.02 deg/sqrt(h)"; it replaces rate_noise, which is '
            "then rate_noise_density / sqrt(period)",
            "rad/s/sqrt(Hz)",
        ),
    ] = None
    rate_bias: Annotated[
        NotNegative | None,
        Meaning(
            "constant bias of the gyro in each run, 1 sigma per axis; it has no effect with [filter], "
            "which has estimated a constant bias before t = 0",
            "rad/s",
        ),
    ] = None
    rate_bias_walk: Annotated[NotNegative | None, Meaning("random walk of the bias", "rad/s/sqrt(s)")] = None
    star_tracker_every: Annotated[
        Annotated[int, Meta(ge=1, description="a whole number of control periods, at least 1")] | None,
        Meaning("control periods between star tracker samples, with a filter"),
    ] = None
    star_tracker_period: Annotated[
        Positive | None,
        Meaning(
            "instead of star_tracker_every: time between star tracker samples, at least loop.period; "
            "it need not be a multiple of it",
            "s",
        ),
    ] = None
    actuator_misalignment_deg: Annotated[
        ThreeEach | None,
        Meaning("rotation vector of each axis, or wheel, from the axis that the computer knows", "deg"),
    ] = None
    gyro_scale: Annotated[Three | None, Meaning("ratio of the reading of the gyro to the true rate, by axis")] = None
    star_tracker_misalignment_deg: Annotated[
        Three | None, Meaning("rotation vector of the star tracker in the body that the computer does not know", "deg")
    ] = None
    nominal_keys: ClassVar[Mapping[str, tuple[str, ...]]] = {
        "attitude_noise": ("attitude_noise",),
        "rate_noise": ("rate_noise", "rate_noise_density"),
        "torque_limit": ("torque_limit",),
    }
    noise_keys: ClassVar[tuple[str, ...]] = (
        "attitude_noise", "rate_noise", "rate_noise_density", "rate_bias", "rate_bias_walk"
    )  # fmt: skip

    def gyro_noise(self, period: float) -> float:
        """Return the noise of the gyro, 1 sigma per sample [rad/s]; `period`: control period [s]."""
        return self.rate_noise or formulas.noise_per_sample(self.rate_noise_density or 0.0, period)

    def interval(self, period: float) -> float:
        """Return the time between two samples of the star tracker [s]; `period`: control period [s]."""
        return period * (self.star_tracker_every or 1) if self.star_tracker_period is None else self.star_tracker_period

    def periods_per_sample(self, period: float) -> int | None:
        """Return the number of control periods between two star tracker samples, None if it is not whole."""
        ratio = self.interval(period) / period
        nearest = ratio if math.isinf(ratio) else round(ratio)  # `checks` refuses an interval longer than the run
        return int(nearest) if abs(ratio - nearest) < INTEGER_TOLERANCE * ratio else None

    def check(self, scenario: "Scenario") -> None:
        """Raise ScenarioError for two gyro noises, or for a slow star tracker without a filter."""
        super().check(scenario)
        if self.rate_noise is not None and self.rate_noise_density is not None:
            raise wrong("hardware.rate_noise_density", self.rate_noise_density, "absent if rate_noise is given")
        tracker_period, every, period = self.star_tracker_period, self.star_tracker_every, scenario.loop.period
        if tracker_period is not None and every is not None:
            raise wrong("hardware.star_tracker_period", tracker_period, "absent if star_tracker_every is given")
        if tracker_period is not None and tracker_period < period * (1.0 - INTEGER_TOLERANCE):
            raise wrong("hardware.star_tracker_period", tracker_period, f"at least loop.period, {period} s")
        if self.periods_per_sample(period) != 1 and not scenario.estimator.on:
            key, value, smallest = "period", tracker_period, f"{period} s"
            if tracker_period is None:
                key, value, smallest = "every", every, "1"
            allowed = f'{smallest}, or [filter] with kind = "steady_state"'
            reason = f", but without a filter the law needs a sample every period; allowed is {allowed}"
            raise errors.value_error(f"hardware.star_tracker_{key}", value, reason, allowed)
        for key in ("gyro_scale", "star_tracker_misalignment_deg"):
            if getattr(self, key) is not None and not scenario.uses_measurements:
                raise ScenarioError(
                    f"hardware.{key} needs noise of the sensors: without it the law sees the true state"
                )

    def actuators(self, wheels: Wheels | None) -> ActuatorsPart:
        """Return the actuators; `wheels`: the part of `devices.actuators`, or None."""
        actuators = super().actuators(wheels)
        if self.actuator_misalignment_deg is None:
            return actuators
        from scipy.spatial.transform import Rotation  # the import takes 0.15 s, and most scenarios do not need it

        rotations = Rotation.from_rotvec(np.deg2rad(self.actuator_misalignment_deg))
        axes = np.eye(3) if wheels is None else np.asarray(wheels.axes)
        return dataclasses.replace(actuators, directions=vector(rotations.apply(axes.T).T))

    def noise_of_error(self, scenario: "Scenario") -> tuple[float, float]:
        """Return the noise of the error [-] and of its rate [1/s]: half of the noise of star tracker and gyro.

        The error is half an angle. The additive error has at most this noise, depending on the attitude of the
        reference in the inertial frame.
        """
        return 0.5 * (self.attitude_noise or 0.0), 0.5 * self.gyro_noise(scenario.loop.period)

    def sensors(self, scenario: "Scenario") -> Sensor:
        """Return star tracker, gyro and filter."""
        if not scenario.uses_measurements:
            return PerfectSensors()
        period, bias_walk, misalignment = scenario.loop.period, self.rate_bias_walk, self.star_tracker_misalignment_deg
        return Sensors(
            vector(self.attitude_noise or 0.0),
            vector(self.gyro_noise(period)),
            None if self.rate_bias is None else vector(self.rate_bias),
            None if bias_walk is None else vector(formulas.noise_per_sample(bias_walk, period)),
            scenario.estimator.build(scenario),
            self.periods_per_sample(period) or 1,
            own_times=self.star_times(period),
            rate_scale=None if self.gyro_scale is None else vector(self.gyro_scale),
            misalignment=None if misalignment is None else vector(np.deg2rad(misalignment)),
        )

    def star_times(self, period: float) -> SampleTimes | None:
        """Return the sample times of the star tracker, None if its interval is a whole number of control periods."""
        return sample_times(self.interval(period), 0.0, period) if self.periods_per_sample(period) is None else None


class StateHardware(Actuators, frozen=True):
    """Actuators and measurement noise of the sampled loop. A device without a key is off."""

    state_noise: Annotated[NotNegatives | None, Meaning("1 sigma per sample, one number for each state")] = None
    nominal_keys: ClassVar[Mapping[str, tuple[str, ...]]] = {
        "state_noise": ("state_noise",),
        "torque_limit": ("torque_limit",),
    }
    noise_keys: ClassVar[tuple[str, ...]] = ("state_noise",)

    def check(self, scenario: "Scenario") -> None:
        """Raise ScenarioError unless the noise has one number for each state."""
        super().check(scenario)
        states = len(scenario.plant.x0)
        if self.state_noise is not None and len(self.state_noise) != states:
            raise wrong("hardware.state_noise", self.state_noise, errors.list_of(states, "state in plant.x0"))

    def noise_of_error(self, scenario: "Scenario") -> tuple[float, float]:
        """Return the noise of the first state and of its derivative; for a system, of the noisiest components."""
        inputs = scenario.inputs  # a system has its positions first, then its rates
        noises = self.state_noise or (0.0,) * (2 * inputs)
        return max(noises[:inputs]), max(noises[inputs : 2 * inputs])

    def noise_of_s(self, scenario: "Scenario") -> float:
        """Return the weights of the surface times the noises; for a system, of its noisiest component."""
        law, noises = scenario.controller, self.state_noise
        if scenario.order == 2 or noises is None:
            return super().noise_of_s(scenario)
        a, rate = getattr(law, "a", (1.0,)), getattr(law, "surface_rate", None) or 1.0 / law.t_f
        surface_weights = [weight * rate ** (len(a) - i) for i, weight in enumerate([*a, 1.0])]
        return math.hypot(*(w * noise for w, noise in zip(surface_weights, noises, strict=False)))

    def sensors(self, scenario: "Scenario") -> Sensor:
        """Return `sensors.StateSensor`, or `PerfectSensors` without noise."""
        return PerfectSensors() if self.state_noise is None else StateSensor(vector(self.state_noise))


class FilterTable(PartTable, frozen=True):
    """An attitude filter, or none."""

    on: ClassVar[bool] = True
    prefix: ClassVar[str] = "filter_"

    def immediate_noise_fraction(self, scenario: "Scenario") -> float:
        """Return the fraction of a star tracker sample's noise that reaches the law at once."""
        return 1.0

    def check(self, scenario: "Scenario") -> None:
        """Raise ScenarioError if keys contradict each other or the scenario."""

    def build(self, scenario: "Scenario") -> AttitudeFilter | None:
        """Return the filter, a part of `devices`, or None if the law uses the raw samples."""


class NoFilter(FilterTable, frozen=True):
    """No filter: the law uses the raw samples."""

    kind: Literal["none"] = "none"
    on: ClassVar[bool] = False


class SteadyStateFilter(FilterTable, frozen=True):
    """A steady-state attitude filter, propagated by the gyro, corrected by the star tracker."""

    kind: Literal["steady_state"] = "steady_state"
    bandwidth: Annotated[
        Positive | None,
        Meaning("bandwidth of the corrections; default: star tracker and gyro noise contribute equally", "rad/s"),
    ] = None
    gains: ClassVar[tuple[str, ...]] = ("filter_bandwidth",)
    usual: ClassVar[Mapping[str, str]] = {"bandwidth": "bandwidth"}

    def fill_defaults(self, scenario: "Scenario") -> Any:
        """Fill an absent bandwidth if both noises are greater than 0: they have equal weight at this bandwidth."""
        table, period = scenario.devices, scenario.loop.period
        noises = table.attitude_noise or 0.0, table.gyro_noise(period)
        if self.bandwidth is not None or not all(noises):
            return self
        bandwidth = formulas.best_bandwidth(*noises, period, table.interval(period))
        return msgspec.structs.replace(self, bandwidth=rounded(bandwidth))

    def immediate_noise_fraction(self, scenario: "Scenario") -> float:
        """Return the attitude gain of a correction, see `devices.attitude_filter.filter_gains`."""
        bandwidth = self.fill_defaults(scenario).bandwidth
        return -math.expm1(-2.0 * bandwidth * scenario.devices.interval(scenario.loop.period))

    def check(self, scenario: "Scenario") -> None:
        """Raise ScenarioError if the bandwidth is absent and a noise that determines its default is 0."""
        if self.fill_defaults(scenario).bandwidth is None:
            raise ScenarioError(
                "filter.bandwidth is absent, but must be given where attitude_noise or rate_noise of [hardware] is 0"
            )

    def build(self, scenario: "Scenario") -> AttitudeFilter | None:
        """Return a filter of `devices.attitude_filter`, with its own sample times or at control samples."""
        table, period = scenario.devices, scenario.loop.period
        star, gyro, walk = table.attitude_noise or 0.0, table.gyro_noise(period), table.rate_bias_walk or 0.0
        arguments = tuple(vector(v) for v in (self.bandwidth, star, gyro, walk, period))
        periods, times = table.periods_per_sample(period), table.star_times(period)
        if times is None:
            return attitude_filter(*arguments, periods)
        return filter_between_samples(*arguments, times.interval, times.pattern)


class KalmanFilter(SteadyStateFilter, frozen=True):
    """The filter of [[sensors]], about as fast as a steady-state filter. It has no keys: the sensors determine it."""

    gains: ClassVar[tuple[str, ...]] = ()


class WheelLimits(Table, frozen=True):
    """Limits and initial momentum of reaction wheels. Lag, step and rate limit of [hardware] then act on each wheel."""

    torque_limit: Annotated[Positive | None, Meaning("of each wheel", "N m")] = None
    momentum_limit: Annotated[Positive | None, Meaning("of each wheel", "N m s")] = None
    momentum: Annotated[
        Annotated[tuple[float, ...], Meta(description="a list of numbers, one for each wheel")] | None,
        Meaning(
            "absolute momentum of each wheel at t = 0: spin inertia times the sum of wheel speed and body"
            " rate about its axis; default: 0 each",
            "N m s",
        ),
    ] = None

    axes_key: ClassVar[str] = ""  # the key that determines the spin axes

    def spin_axes(self) -> np.ndarray:
        """Return the spin axis of each wheel in body axes (wheels, 3)."""
        raise NotImplementedError

    def check(self) -> None:
        """Raise ScenarioError if keys contradict each other."""
        axes = self.spin_axes()
        try:
            formulas.wheel_axes(axes)
        except ValueError as error:
            raise errors.value_error(f"wheels.{self.axes_key}", getattr(self, self.axes_key), f": {error}") from None
        if self.momentum is not None and len(self.momentum) != len(axes):
            raise wrong("wheels.momentum", self.momentum, errors.list_of(len(axes), "wheel"))
        limit = self.momentum_limit
        if limit is not None and any(abs(h) > limit for h in self.momentum or ()):
            raise wrong("wheels.momentum", self.momentum, f"within wheels.momentum_limit, {limit} N m s")

    def build(self) -> Wheels:
        """Return the reaction wheels of this table, a `devices.actuators.Wheels`."""
        return wheels(self.spin_axes(), self.momentum, self.torque_limit, self.momentum_limit)


class PyramidWheels(WheelLimits, frozen=True):
    """Four reaction wheels at 45, 135, 225 and 315 degrees about z, with the lag, step and rate limit of [hardware]."""

    kind: Literal["pyramid"] = "pyramid"
    cant_deg: Annotated[
        Annotated[float, Meta(gt=0, lt=90, description="an angle between 0 and 90")],
        Meaning("tilt of the spin axes toward +z; the default gives equal torque about all axes", "deg"),
    ] = 35.264389682754654
    axes_key: ClassVar[str] = "cant_deg"

    def spin_axes(self) -> np.ndarray:
        """Return the spin axes of four wheels (4, 3), tilted toward +z."""
        return formulas.pyramid(np.deg2rad(self.cant_deg))


class AxesWheels(WheelLimits, frozen=True):
    """Any number of reaction wheels. Lag, step and rate limit of [hardware] apply to the wheels."""

    kind: Literal["axes"] = "axes"
    axes: Annotated[
        Annotated[tuple[Three, ...], Meta(description="a list of spin axes, three numbers each")],
        Meaning("spin axes in body axes, three numbers each, of any length"),
    ] = (
        (1.0, 0.0, 0.0),
        (0.0, 1.0, 0.0),
        (0.0, 0.0, 1.0),
    )
    axes_key: ClassVar[str] = "axes"

    def spin_axes(self) -> np.ndarray:
        """Return `axes` as an array (wheels, 3)."""
        return np.asarray(self.axes)


# by kind, the default first
FILTERS: Kinds = {"steady_state": SteadyStateFilter, "none": NoFilter}
WHEELS: Kinds = {"pyramid": PyramidWheels, "axes": AxesWheels}
