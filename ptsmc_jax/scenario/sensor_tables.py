"""The tables of [[sensors]]: any number of star trackers, vector sensors and gyros, which a Kalman filter combines.

Start with `SensorSuite`. `SENSORS` lists the classes by kind.
"""

import dataclasses
from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import jax.numpy as jnp
import msgspec
import numpy as np
from msgspec import Meta

from ptsmc_jax import formulas
from ptsmc_jax.devices import attitude_sensors, kalman_filter, sensor_suite
from ptsmc_jax.numerics.pytrees import vector
from ptsmc_jax.scenario import attitude_keys
from ptsmc_jax.scenario.custom import custom_kind
from ptsmc_jax.scenario.device_tables import Hardware
from ptsmc_jax.scenario.errors import ScenarioError, list_of, wrong
from ptsmc_jax.scenario.schema import PartTable
from ptsmc_jax.scenario.values import Kinds, Meaning, NotNegative, Positive, Table, Three

if TYPE_CHECKING:
    from ptsmc_jax.scenario.tables import Scenario

SUITE_MEANING = (
    "Any number of sensors, a table each: at least one gyro, and attitude sensors that determine the attitude "
    "together. A Kalman filter combines them. These tables replace the noise in [hardware] and [filter], which are "
    "the short form for one star tracker and one gyro."
)
MAX_LATENCY_PERIODS = 8  # control periods until a reading is used; the filter keeps an attitude for each
Size = Annotated[float, Meta(ge=1e-15, le=1e3, description="a number from 1e-15 to 1000")]
Sizes = Annotated[
    tuple[Size, ...],
    Meta(description="a list of numbers from 1e-15 to 1000, one for each component of a reading"),
]
Noise = Size | None
Bias = Annotated[float, Meta(ge=0, le=1e3, description="a number from 0 to 1000")]


class SensorTable(PartTable, frozen=True):
    """A table of [[sensors]]."""

    required: ClassVar[tuple[str, ...]] = ()  # keys without a default

    def check(self, place: str, scenario: "Scenario") -> None:
        """Raise ScenarioError if a key is missing, or if keys contradict each other; place: place in the file."""
        for key in self.required:
            if getattr(self, key) is None:
                raise ScenarioError(f"{place}.{key} is absent, but must be given")


class AttitudeSensorTable(SensorTable, frozen=True):
    """A sensor of the attitude. Its boresight is the z axis of sensor axes."""

    boresight: Annotated[Three | None, Meaning("direction of its boresight in body axes; default: the z axis")] = None
    rotvec_deg: Annotated[
        Three | None, Meaning("instead of boresight: rotation vector from the body axes to the sensor's axes", "deg")
    ] = None
    period: Annotated[
        Positive | None, Meaning("time between readings, at least loop.period; default: loop.period", "s")
    ] = None
    latency: Annotated[NotNegative, Meaning("time from a reading until the flight software receives it", "s")] = 0.0

    def check(self, place: str, scenario: "Scenario") -> None:
        """Raise ScenarioError also for a wrong mounting, and for a sensor that is too fast, too slow, or very late."""
        super().check(place, scenario)
        if self.boresight is not None and self.rotvec_deg is not None:
            raise wrong(f"{place}.rotvec_deg", self.rotvec_deg, "absent if boresight is given")
        if self.rotvec_deg is not None:
            attitude_keys.quaternion(attitude_keys.Attitude(rotvec_deg=self.rotvec_deg), place)
        attitude_keys.check_direction(f"{place}.boresight", self.boresight or (0.0, 0.0, 1.0))
        control_period = scenario.loop.period
        if self.period is not None and self.period < control_period * (1.0 - attitude_sensors.INTEGER_TOLERANCE):
            raise wrong(f"{place}.period", self.period, f"at least loop.period, {control_period} s")
        if self.period is not None and self.period > scenario.end:
            raise wrong(f"{place}.period", self.period, f"at most loop.t_end, {scenario.end} s")
        latest = MAX_LATENCY_PERIODS * control_period
        if self.latency > latest:
            raise wrong(
                f"{place}.latency", self.latency, f"at most {MAX_LATENCY_PERIODS} control periods, {latest:.6g} s"
            )

    def mounting(self) -> np.ndarray:
        """Return the unit quaternion (4,) of the rotation from body axes to sensor axes."""
        from scipy.spatial.transform import Rotation

        if self.rotvec_deg is not None:
            return Rotation.from_rotvec(np.array(self.rotvec_deg), degrees=True).as_quat(canonical=True)
        z = np.array(self.boresight or (0.0, 0.0, 1.0), dtype=float)
        x, y, cosine = z / np.linalg.norm(z)
        if cosine < -1.0 + 1e-12:
            return np.array([1.0, 0.0, 0.0, 0.0])
        quaternion = np.array([-y, x, 0.0, 1.0 + cosine])  # the shortest rotation of the z axis
        return quaternion / np.linalg.norm(quaternion)

    def interval(self, period: float) -> float:
        """Return the time between readings [s]; period: control period [s]."""
        return period if self.period is None else self.period

    def sigmas(self) -> tuple[float, ...]:
        """Return the noise of a reading, 1 sigma of each component."""
        raise NotImplementedError

    def information(self) -> np.ndarray:
        """Return the Fisher information (3, 3) of a reading about a small rotation about body axes [1/rad^2]."""
        raise NotImplementedError

    def build(self, name: str, period: float) -> attitude_sensors.AttitudeSensor:
        """Return the part of `devices.attitude_sensors`; name: its name, period: control period [s]."""
        times = attitude_sensors.sample_times(self.interval(period), self.latency, period)
        return self.part(name=name, noise=vector(self.sigmas()), mounting=vector(self.mounting()), times=times)


class StarTracker(AttitudeSensorTable, frozen=True):
    """A star tracker."""

    kind: Literal["star_tracker"] = "star_tracker"
    part_class: ClassVar[type] = attitude_sensors.StarTracker
    noise_across: Annotated[Noise, Meaning("1 sigma of a reading about each axis across the boresight", "rad")] = None
    noise_about: Annotated[Noise, Meaning("1 sigma of a reading about the boresight; default: noise_across", "rad")] = (
        None
    )
    required: ClassVar[tuple[str, ...]] = ("noise_across",)

    def sigmas(self) -> tuple[float, ...]:
        """Return the noise about the x, y and z axis of the sensor [rad]."""
        across = self.noise_across or 0.0  # `check` refuses 0
        return across, across, self.noise_about or across

    def information(self) -> np.ndarray:
        """Return the Fisher information (3, 3) of a reading [1/rad^2]."""
        from scipy.spatial.transform import Rotation

        axes = Rotation.from_quat(self.mounting()).as_matrix()
        return axes @ np.diag(np.array(self.sigmas()) ** -2.0) @ axes.T


class VectorSensor(AttitudeSensorTable, frozen=True):
    """A sun sensor or magnetometer: it measures a direction that is known in inertial axes."""

    kind: Literal["vector_sensor"] = "vector_sensor"
    part_class: ClassVar[type] = attitude_sensors.VectorSensor
    direction: Annotated[Three | None, Meaning("measured direction, in inertial axes")] = None
    noise: Annotated[Noise, Meaning("1 sigma of each component of the direction, in the sensor's axes", "rad")] = None
    required: ClassVar[tuple[str, ...]] = ("direction", "noise")

    def check(self, place: str, scenario: "Scenario") -> None:
        """Raise ScenarioError also for a zero direction."""
        super().check(place, scenario)
        attitude_keys.check_direction(f"{place}.direction", self.direction)

    def sigmas(self) -> tuple[float, ...]:
        """Return the noise of each component [rad]."""
        return (self.noise or 0.0,) * 3

    def information(self) -> np.ndarray:
        """Return the Fisher information (3, 3) of a reading [1/rad^2], if body axes and inertial axes coincide."""
        return (np.eye(3) - np.outer(self.unit_direction, self.unit_direction)) / self.sigmas()[0] ** 2

    @property
    def unit_direction(self) -> np.ndarray:
        """Return the direction as a unit vector (3,)."""
        direction = np.array(self.direction, dtype=float)
        return direction / np.linalg.norm(direction)

    def build(self, name: str, period: float) -> attitude_sensors.AttitudeSensor:
        """Return the sensor with its unit direction; see the base class."""
        return dataclasses.replace(super().build(name, period), direction=vector(self.unit_direction))


class CustomTable(AttitudeSensorTable, frozen=True):
    """A custom sensor of the attitude."""

    noise: Annotated[Sizes | None, Meaning("1 sigma of each component of a reading")] = None
    required: ClassVar[tuple[str, ...]] = ("noise",)

    def sigmas(self) -> tuple[float, ...]:
        """Return the noise of each component."""
        return self.noise or ()

    def information(self) -> np.ndarray:
        """Return the Fisher information (3, 3) of a reading [1/rad^2], if body axes and inertial axes coincide.

        Before the code has run, the sensor counts as a sensor of the whole attitude.
        """
        if self.part_class is None:
            return np.eye(3) / max(self.sigmas(), default=1.0) ** 2
        rows = np.asarray(self.build("custom", 1.0).sensitivity(jnp.array([0.0, 0.0, 0.0, 1.0])))
        return rows.T @ (rows / np.array(self.sigmas())[:, None] ** 2)

    def build(self, name: str, period: float) -> attitude_sensors.AttitudeSensor:
        """Return the sensor; raise ScenarioError if the numbers of noises and of components of a reading differ."""
        sensor = super().build(name, period)
        reading = sensor.read(jnp.array([0.0, 0.0, 0.0, 1.0]))
        component_count = np.size(sensor.change(reading, reading))
        if component_count != len(self.sigmas()):
            raise wrong("sensors.noise", self.noise, list_of(component_count, "component"))
        return sensor


class Gyro(SensorTable, frozen=True):
    """A gyro of three axes that samples once a control period. Several are averaged with weights 1/noise^2."""

    kind: Literal["gyro"] = "gyro"
    rate_noise: Annotated[Noise, Meaning("1 sigma per axis and sample", "rad/s")] = None
    rate_noise_density: Annotated[
        Noise, Meaning('angle random walk instead of rate_noise, such as "0.02 deg/sqrt(h)"', "rad/s/sqrt(Hz)")
    ] = None
    rate_bias: Annotated[
        Bias,
        Meaning(
            "bias at t = 0, 1 sigma per axis; it has no effect, because the filter starts in its steady state", "rad/s"
        ),
    ] = 0.0
    rate_bias_walk: Annotated[Bias, Meaning("random walk of the bias", "rad/s/sqrt(s)")] = 0.0

    def check(self, place: str, scenario: "Scenario") -> None:
        """Raise ScenarioError unless exactly one noise is given."""
        if self.rate_noise is None and self.rate_noise_density is None:
            raise ScenarioError(f"{place}.rate_noise is absent, but must be given, or rate_noise_density")
        if self.rate_noise is not None and self.rate_noise_density is not None:
            raise wrong(f"{place}.rate_noise_density", self.rate_noise_density, "absent if rate_noise is given")

    def noise(self, period: float) -> float:
        """Return the noise of a sample [rad/s]; period: control period [s]."""
        return self.rate_noise or formulas.noise_per_sample(self.rate_noise_density or 0.0, period)


SENSORS: Kinds = {
    "star_tracker": StarTracker,
    "vector_sensor": VectorSensor,
    "gyro": Gyro,
    "custom": custom_kind(
        CustomTable, attitude_sensors.AttitudeSensor, ("read",),
        "A custom sensor, a class derived from ptsmc_jax.AttitudeSensor; its fields are further keys.",
    ),
}  # fmt: skip


class SensorSuite(Table, frozen=True):
    """The tables of [[sensors]]."""

    each: tuple[Any, ...]
    gains: ClassVar[Mapping[str, object]] = {}

    def tables_by_name(self, name: str) -> dict[str, SensorTable]:
        """Return the tables by their place in a file, such as sensors[0]; name: key of the list."""
        return {f"{name}[{k}]": table for k, table in enumerate(self.each)}

    @property
    def gyros(self) -> list[Gyro]:
        """Return the gyros."""
        return [table for table in self.each if isinstance(table, Gyro)]

    @property
    def attitude(self) -> dict[str, AttitudeSensorTable]:
        """Return the attitude sensors by name, such as star_tracker_1; exported C uses the same names for inputs."""
        sensors, counts = dict[str, AttitudeSensorTable](), dict[str, int]()
        for table in self.each:
            kind = table.kind
            counts[kind] = counts.get(kind, 0) + 1
            if isinstance(table, AttitudeSensorTable):
                sensors[f"{kind}_{counts[kind]}"] = table
        return sensors

    @property
    def places(self) -> dict[str, str]:
        """Return the places in a file of the attitude sensors, such as sensors[0], by their names."""
        places = [place for place, one in self.tables_by_name("sensors").items() if not isinstance(one, Gyro)]
        return dict(zip(self.attitude, places, strict=True))

    def check(self, scenario: "Scenario") -> None:
        """Raise ScenarioError if a sensor is not valid or if the sensors together do not determine the attitude."""
        for place, table in self.tables_by_name("sensors").items():
            table.check(place, scenario)
        if not self.gyros:
            raise ScenarioError(
                "[[sensors]] has no gyro, but must have one: the filter propagates the attitude with gyro readings"
            )
        information = sum((table.information() for table in self.attitude.values()), np.zeros((3, 3)))
        eigenvalues = np.linalg.eigvalsh(information)
        if not eigenvalues[0] > 1e-9 * eigenvalues[-1]:
            raise ScenarioError(
                "[[sensors]] does not determine the attitude, but must have a star tracker, or two vector sensors with "
                "different directions"
            )

    def mean_gyro(self, period: float) -> tuple[float, float, float]:
        """Return noise [rad/s], bias [rad/s] and random walk of the bias [rad/s/sqrt(s)] of the mean of all gyros."""
        information = np.array([gyro.noise(period) ** -2.0 for gyro in self.gyros])
        weights = information / np.sum(information)
        errors = [[gyro.noise(period), gyro.rate_bias, gyro.rate_bias_walk] for gyro in self.gyros]
        noise, bias, walk = (float(np.linalg.norm(weights * values)) for values in zip(*errors, strict=True))
        return noise, bias, walk

    def equivalent_hardware(self, table: Hardware, period: float) -> Hardware:
        """Return [hardware] with one star tracker and one gyro of about the same accuracy, for defaults and bounds.

        Args:
            table: [hardware] of the scenario.
            period: control period [s].
        """
        intervals = {name: max(sensor.interval(period), period) for name, sensor in self.attitude.items()}
        interval = min(intervals.values())
        information_rate = sum(sensor.information() / intervals[name] for name, sensor in self.attitude.items())
        sigma = float(1.0 / np.sqrt(max(np.linalg.eigvalsh(information_rate)[0], 1e-30) * interval))
        noise, bias, walk = self.mean_gyro(period)
        return msgspec.structs.replace(
            table, attitude_noise=sigma, rate_noise=noise, rate_bias=bias, rate_bias_walk=walk,
            star_tracker_period=interval,
        )  # fmt: skip

    def build(self, model: object, period: float) -> sensor_suite.SensorSuite:
        """Return the sensors of `devices.sensor_suite`; model: not used, period: control period [s]."""
        sensors = [table.build(name, period) for name, table in self.attitude.items()]
        noise, bias, walk = self.mean_gyro(period)
        gyro, bias_rate = jnp.full(3, noise), jnp.full(3, formulas.noise_per_sample(walk, period))
        estimator = kalman_filter.kalman_filter(sensors, gyro, bias_rate, bias, period)
        return sensor_suite.SensorSuite(
            sensors=tuple(sensors), rate_noise=gyro, rate_bias=jnp.full(3, bias), bias_rate=bias_rate, filter=estimator
        )
