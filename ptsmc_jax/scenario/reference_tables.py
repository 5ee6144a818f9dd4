"""The tables [initial], [orbit] and [reference] of scenario files of a spacecraft, by kind in `ORBITS`, `REFERENCES`.

The numbers of a reference are declared in `signals`. Start with `ReferenceTable`.
"""

import dataclasses
import functools
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

import jax
import numpy as np
from msgspec import Meta

from ptsmc_jax.numerics.pytrees import vector
from ptsmc_jax.scenario import attitude_files, attitude_keys, epochs
from ptsmc_jax.scenario.attitude_keys import Attitude
from ptsmc_jax.scenario.custom import Custom, custom_kind, fastest_rate
from ptsmc_jax.scenario.errors import ScenarioError, show, value_error, wrong
from ptsmc_jax.scenario.schema import PartTable, make_table
from ptsmc_jax.scenario.values import Four, Kinds, Meaning, Number, Three
from ptsmc_jax.signals import orbits, references

if TYPE_CHECKING:
    from ptsmc_jax.scenario.spacecraft_scenario import SpacecraftScenario

Vector = Annotated[
    Literal["nadir", "velocity", "orbit_normal", "sun"] | tuple[float, float, float],
    Meta(description='"nadir", "velocity", "orbit_normal", "sun" or three numbers'),
]
IDENTITY = np.array([0.0, 0.0, 0.0, 1.0])
Angle = Annotated[float, Meta(ge=-orbits.TURN, le=orbits.TURN, description=orbits.ANGLE["allowed"])]
LARGEST_LATITUDE = np.pi / 2  # [rad]
SMALLEST_ANGLE = np.deg2rad(0.1)  # smallest angle between the two directions, and between the two body axes [rad]
POINTS, MOST_POINTS = 2048, 2**17  # smallest and largest number of anchors along the run
LARGEST_TURN = 0.05  # largest rotation of the reference between two anchors [rad]


class Initial(Attitude, frozen=True):
    """Initial state of the spacecraft: one attitude key and the body rate."""

    rate: Annotated[Three, Meaning("body rate at t = 0, body axes", "rad/s")] = (0.0, 0.0, 0.0)


class ReferenceTable(PartTable, frozen=True):
    """A reference attitude of a spacecraft."""

    def frequencies(self, scenario: "SpacecraftScenario") -> dict[str, float]:
        """Return the angular frequency of the reference [rad/s], by the key that determines it."""
        raise NotImplementedError

    def check(self, scenario: "SpacecraftScenario") -> None:
        """Raise ScenarioError if keys are not valid, or contradict other tables."""

    def check_reference_until(self, scenario: "SpacecraftScenario", last: float, key: str) -> None:
        """Raise an error if the reference ends before a run ends.

        Args:
            scenario: the scenario with this table.
            last: end of the run [s].
            key: key of the scenario that sets `last`, for the error.

        Raises:
            ScenarioError: the reference ends earlier.
        """

    def build(self, scenario: "SpacecraftScenario") -> references.Reference:
        """Return the part of `signals`."""
        raise NotImplementedError

    def initial_reference_attitude(self, scenario: "SpacecraftScenario") -> np.ndarray:
        """Return the unit quaternion (4,) of the reference at t = 0."""
        raise NotImplementedError


class AttitudeReference(Attitude, ReferenceTable, frozen=True):
    """An attitude that a spacecraft is to follow."""

    def frequencies(self, scenario: "SpacecraftScenario") -> dict[str, float]:
        part = self.build(scenario) if isinstance(self, Custom) else self
        return {f"reference.{self.part_class.paced_by}": fastest_rate(self, "reference", part)}

    def check(self, scenario: "SpacecraftScenario") -> None:
        self.initial_reference_attitude(scenario)

    def build(self, scenario: "SpacecraftScenario") -> references.Reference:
        return self.part(q=vector(self.initial_reference_attitude(scenario)))

    def initial_reference_attitude(self, scenario: "SpacecraftScenario") -> np.ndarray:
        return attitude_keys.quaternion(self, "reference")


class SlewTable(AttitudeReference, frozen=True):
    """A turn to another attitude."""

    to_quat_xyzw: Annotated[Four, Meaning("the attitude at the end, unit quaternion, scalar last")] = (
        0.0,
        0.0,
        0.0,
        1.0,
    )
    way: Annotated[Literal["short", "long"], Meaning("rotate by the smaller or by the larger angle")] = "short"

    @property
    def turn(self) -> np.ndarray:
        """Rotation vector (3,) [rad] from the initial attitude to `to_quat_xyzw`, by the short or the long way."""
        from scipy.spatial.transform import Rotation

        start = Rotation.from_quat(attitude_keys.quaternion(self, "reference"))
        end = Rotation.from_quat(attitude_keys.unit_quaternion("reference.to_quat_xyzw", self.to_quat_xyzw))
        short = (start.inv() * end).as_rotvec()
        angle = np.linalg.norm(short)
        return short * (1.0 - 2.0 * np.pi / angle) if self.way == "long" and angle > 0.0 else short

    def check(self, scenario: "SpacecraftScenario") -> None:
        """Raise ScenarioError if the attitude at the start or at the end is not valid."""
        super().check(scenario)
        attitude_keys.unit_quaternion("reference.to_quat_xyzw", self.to_quat_xyzw)


class FileReference(ReferenceTable, frozen=True):
    """Samples of an attitude in a file."""

    file: Annotated[
        Annotated[str, Meta(description="the path of a file")] | None,
        Meaning("CSV, Parquet or CCSDS attitude ephemeris message (AEM); a relative path starts at the scenario file"),
    ] = None
    quaternion_order: Annotated[
        Literal["xyzw", "wxyz"] | None,
        Meaning("scalar last or first, for columns whose names do not label it; default: scalar last"),
    ] = None
    direction: Annotated[
        Literal["body_to_inertial", "inertial_to_body"] | None,
        Meaning("of the rotation, for CSV and Parquet; default: body_to_inertial, as [initial] has it"),
    ] = None
    interpolation: Annotated[
        Literal["file", "spline"],
        Meaning("refuse a file that states another interpolation than a spline, or use the spline in spite of it"),
    ] = "file"

    def _samples(self, scenario: "SpacecraftScenario") -> attitude_files.Samples:
        """Return the samples of the file; raise ScenarioError if it is absent or cannot be used."""
        if self.file is None:
            raise ScenarioError("reference.file is absent, but must be given: a CSV, Parquet or AEM file")
        try:
            return attitude_files.read(self.file, self.quaternion_order, self.direction, self.interpolation,
                                       scenario.loop.epoch)  # fmt: skip
        except ValueError as error:
            raise value_error("reference.file", self.file, f", {error}") from None

    def frequencies(self, scenario: "SpacecraftScenario") -> dict[str, float]:
        return {"reference.file": self._samples(scenario).fastest}

    def check(self, scenario: "SpacecraftScenario") -> None:
        """Raise ScenarioError if the samples of the file do not cover the run."""
        samples = self._samples(scenario)
        first, last = samples.times[0], samples.usable_until
        if first > 0.0 or last < 0.0:
            zero = "t = 0" if scenario.loop.epoch is None else f"loop.epoch = {show(scenario.loop.epoch)}"
            raise value_error("reference.file", self.file, f", whose attitudes are from {first:.9g} to {last:.9g} s "
                              f"after {zero}, which must be in between")  # fmt: skip
        self.check_reference_until(scenario, scenario.end, "loop.t_end")

    def check_reference_until(self, scenario: "SpacecraftScenario", last: float, key: str) -> None:
        end = self._samples(scenario).usable_until
        if last > end * (1.0 + 1e-9):
            value = scenario.loop.t_end if key == "loop.t_end" else scenario.search.bounds.get("t_f")
            raise value_error(key, value, f", which needs the attitude until {last:.12g} s, but {self.file} ends at "
                          f"{end:.12g} s")  # fmt: skip

    def build(self, scenario: "SpacecraftScenario") -> references.Reference:
        samples = self._samples(scenario)
        return references.interpolate_attitude(samples.times, samples.quaternions, samples.end_rates)

    def initial_reference_attitude(self, scenario: "SpacecraftScenario") -> np.ndarray:
        """Return the quaternion (4,) of the sample that is nearest to t = 0."""
        self.check(scenario)
        samples = self._samples(scenario)
        k = int(np.argmin(np.abs(samples.times)))  # the nearest sample is accurate enough for a default
        return samples.quaternions[k]


class OrbitTable(PartTable, frozen=True):
    """The orbit of references that point to the Earth, and of the gravity gradient."""

    true_anomaly: Annotated[Angle, Meaning("angle from perigee to the spacecraft at t = 0", "rad")] = 0.0

    @property
    def mean_anomaly(self) -> float:
        """Mean anomaly at t = 0 [rad]."""
        return orbits.mean_anomaly(self.true_anomaly, float(self.eccentricity))  # pyright: ignore

    def check(self) -> None:
        """Raise ScenarioError for an Earth orbit inside the Earth: its size is probably in km, or an altitude."""
        numbers: Any = self
        size, radius = numbers.semi_major_axis, orbits.EQUATORIAL_RADIUS
        if numbers.gravitational_parameter == orbits.EARTH_GRAVITY and size < radius:
            allowed = f'at least {radius:.0f} m, the radius of the Earth, or with its unit, such as "6878 km"'
            raise wrong("orbit.semi_major_axis", size, allowed)

    def build(self, epoch: str | None) -> orbits.Orbit:
        """Build the orbit with NumPy numbers; epoch: value of `loop.epoch`."""
        numbers = {field.name: getattr(self, field.name) for field in dataclasses.fields(orbits.Orbit)}
        if numbers["earth_angle"] is None:
            numbers["earth_angle"] = 0.0 if epoch is None else orbits.earth_angle(epochs.parse_key(epoch).days)
        return self.part_class(**{name: np.float64(value) for name, value in numbers.items()})


ORBITS: Kinds = {"kepler": make_table(OrbitTable, orbits.Orbit, "kepler")}


class Mission(NamedTuple):
    """The keys of a scenario that directions depend on."""

    orbit: OrbitTable | None
    epoch: str | None  # `loop.epoch`
    end: float  # end of the run [s]

    @classmethod
    def of(cls, scenario: "SpacecraftScenario") -> "Mission":
        """Return the mission of a scenario."""
        return cls(scenario.orbit, scenario.loop.epoch, scenario.end)

    def build_orbit(self, user: str) -> orbits.Orbit:
        """Return the orbit; raise ScenarioError without [orbit]. `user` is the key that needs it, for the error."""
        if self.orbit is None:
            raise ScenarioError(f"{user}, which needs an orbit, but there is no [orbit] table")
        return self.orbit.build(self.epoch)

    def direction(self, key: str, value: str | tuple[float, ...]) -> orbits.Direction:
        """Return the direction of a key: a name, or a vector (3,); raise ScenarioError if another table is missing."""
        if not isinstance(value, str):
            _check_axis(key, value)
            return orbits.Fixed(np.array(value, dtype=float))
        if value == "sun":
            if self.epoch is None:
                raise ScenarioError(f'{key} is "sun", which needs loop.epoch, such as "2026-03-20T12:00:00"')
            return orbits.sun_direction(epochs.parse_key(self.epoch).days)
        self.build_orbit(f'{key} is "{value}"')
        return orbits.OrbitDirection(value)


def _check_axis(key: str, axis: tuple[float, ...], other: tuple[float, ...] | None = None) -> None:
    """Raise ScenarioError if a body axis (3,) is zero, or parallel to another one; key: its key."""
    attitude_keys.check_direction(key, axis)
    if other is not None:
        sine = np.linalg.norm(np.cross(axis, other)) / (np.linalg.norm(axis) * np.linalg.norm(other))
        if sine < np.sin(SMALLEST_ANGLE):
            raise wrong(key, axis, f"an axis that is not parallel to reference.primary_axis = {list(other)}")


class MissionTable(ReferenceTable, frozen=True):
    """A reference that points body axes in directions of the mission."""

    primary_axis: Annotated[Three, Meaning("body axis that points exactly in the primary direction")] = (0.0, 0.0, 1.0)
    secondary_axis: Annotated[
        Three, Meaning("body axis that points as near as possible to the secondary direction")
    ] = (1.0, 0.0, 0.0)

    @property
    def mount(self) -> np.ndarray:
        """Quaternion (4,) from body axes to the axes of the frame."""
        return orbits.mounting(self.primary_axis, self.secondary_axis)

    def check(self, scenario: "SpacecraftScenario") -> None:
        """Raise ScenarioError if body axes are zero or parallel, or if the directions are not known."""
        _check_axis("reference.primary_axis", self.primary_axis)
        _check_axis("reference.secondary_axis", self.secondary_axis, self.primary_axis)
        self.initial_frame(scenario)

    def initial_frame(self, scenario: "SpacecraftScenario") -> np.ndarray:
        """Return the rotation matrix (3, 3) at t = 0 from the axes of the frame to inertial axes.

        It raises ScenarioError if the scenario does not determine the directions.
        """
        raise NotImplementedError

    def initial_reference_attitude(self, scenario: "SpacecraftScenario") -> np.ndarray:
        from scipy.spatial.transform import Rotation

        self.check(scenario)
        return (Rotation.from_matrix(self.initial_frame(scenario)) * Rotation.from_quat(self.mount)).as_quat()


class NadirTable(MissionTable, frozen=True):
    """Local vertical, local horizontal."""

    def _orbit(self, scenario: "SpacecraftScenario") -> orbits.Orbit:
        """Return the orbit of the scenario; raise ScenarioError if there is no [orbit] table."""
        return Mission.of(scenario).build_orbit('reference.kind is "nadir"')

    def frequencies(self, scenario: "SpacecraftScenario") -> dict[str, float]:
        return {"reference.kind": float(self._orbit(scenario).fastest())}

    @property
    def mount(self) -> np.ndarray:
        """Quaternion (4,) from body axes to orbit axes."""
        return orbits.nadir_mounting(self.primary_axis, self.secondary_axis)

    def build(self, scenario: "SpacecraftScenario") -> references.Reference:
        return jax.tree.map(vector, self.part_class(q=IDENTITY, mount=self.mount, orbit=self._orbit(scenario)))

    def initial_frame(self, scenario: "SpacecraftScenario") -> np.ndarray:
        """Return the matrix (3, 3) from orbit axes (radial, along-track, normal) to inertial axes at t = 0."""
        place = self._orbit(scenario)(np.zeros(()), np)
        return np.stack([place.radial, place.along, place.normal], axis=1)


class DirectionsTable(MissionTable, frozen=True):
    """References with a primary and a secondary direction."""

    def directions(self, mission: Mission) -> tuple[orbits.Direction, orbits.Direction]:
        """Return the primary and the secondary direction, parts of `signals.orbits`."""
        raise NotImplementedError

    def numpy_part(
        self, mission: Mission, anchors: np.ndarray = IDENTITY[None], rate: float = 0.0
    ) -> orbits.TwoVectorReference:
        """Build the reference with NumPy numbers.

        Args:
            mission: orbit and epoch of the scenario.
            anchors: quaternions of the frame (n, 4) at equal intervals, see `TwoVectorReference`.
            rate: number of anchors per second [1/s].
        """
        primary, secondary = self.directions(mission)
        needs_orbit = any(isinstance(one, orbits.OrbitDirection | orbits.GroundPoint) for one in (primary, secondary))
        return self.part_class(
            q=IDENTITY, mount=self.mount, primary=primary, secondary=secondary,
            orbit=mission.build_orbit("reference") if needs_orbit else None,
            anchors=anchors, anchor_rate=np.float64(rate),
        )  # fmt: skip

    def frequencies(self, scenario: "SpacecraftScenario") -> dict[str, float]:
        return {"reference.kind": _sample(self, Mission.of(scenario)).fastest}

    def build(self, scenario: "SpacecraftScenario") -> references.Reference:
        mission = Mission.of(scenario)
        samples = _sample(self, mission)
        part = self.numpy_part(mission, samples.anchors, len(samples.anchors) / samples.span)
        return jax.tree.map(vector, part)

    def initial_frame(self, scenario: "SpacecraftScenario") -> np.ndarray:
        return _sample(self, Mission.of(scenario)).matrix


class SampledReference(NamedTuple):
    """A reference with two directions, sampled along a run."""

    anchors: np.ndarray  # (n, 4) quaternions of the frame at equal intervals of `span`, see `TwoVectorReference`
    span: float  # time from the first to the last anchor [s]
    fastest: float  # largest rate, plus the root of the largest acceleration [rad/s]
    matrix: np.ndarray  # (3, 3) rotation at t = 0 from the axes of the frame to inertial axes


@functools.lru_cache(maxsize=32)
def _sample(table: Any, mission: Mission) -> SampledReference:
    """Sample a reference with two directions over twice the run if possible, because tuning may move t_end.

    Raises:
        ScenarioError: the directions are parallel during the run.
    """
    from scipy.spatial.transform import Rotation

    part, run_lengths, anchor_count = table.numpy_part(mission), 2, POINTS
    while True:
        step = run_lengths * mission.end / anchor_count
        times = step * np.arange(anchor_count)
        sines = np.linalg.norm(np.cross(*part.directions(times, np)), axis=1)
        closest = int(np.argmin(sines))
        if sines[closest] < np.sin(SMALLEST_ANGLE) and times[closest] <= mission.end:
            angle = np.rad2deg(np.arcsin(sines[closest]))
            raise value_error(
                "reference.secondary", table.secondary,
                f", but at t = {times[closest]:.6g} s that is {angle:.2g} deg from the primary direction or its "
                f"opposite, and at least {np.rad2deg(SMALLEST_ANGLE):.2g} deg are needed",
            )  # fmt: skip
        if sines[closest] < np.sin(SMALLEST_ANGLE):
            run_lengths = 1
            continue
        matrices = part.matrix(times, np)
        turns = Rotation.from_matrix(np.swapaxes(matrices[:-1], 1, 2) @ matrices[1:]).as_rotvec()
        if np.all(np.linalg.norm(turns, axis=1) < LARGEST_TURN) or anchor_count >= MOST_POINTS:
            break
        anchor_count *= 4
    rates = turns[: anchor_count // run_lengths] / step
    fastest = np.linalg.norm(rates, axis=1).max() + np.sqrt(np.linalg.norm(np.diff(rates, axis=0), axis=1).max() / step)
    span = run_lengths * mission.end
    return SampledReference(orbits.anchor_quaternions(matrices), span, float(fastest), matrices[0])


SECONDARY = Meaning("direction of `secondary_axis`: a name, or three numbers in inertial axes")


class GroundTargetTable(DirectionsTable, frozen=True):
    """One body axis points to a ground target on the rotating Earth, another one as near as possible to a direction."""

    latitude: Annotated[Number, Meaning("geodetic, WGS-84", "rad")] = 0.0
    longitude: Annotated[Angle, Meaning("east of Greenwich", "rad")] = 0.0
    height: Annotated[Number, Meaning("above the WGS-84 ellipsoid", "m")] = 0.0
    secondary: Annotated[Vector, SECONDARY] = "velocity"

    def check(self, scenario: "SpacecraftScenario") -> None:
        """Raise ScenarioError if the latitude or an axis is not allowed, or if there is no orbit."""
        if abs(self.latitude) > LARGEST_LATITUDE:
            raise wrong("reference.latitude", self.latitude, 'from -pi/2 to pi/2 [rad], or with its unit, as "48 deg"')
        super().check(scenario)

    def lowest_elevation(self, scenario: "SpacecraftScenario") -> tuple[float, float]:
        """Return the lowest elevation of the spacecraft above the target's horizon [rad], and its time [s]."""
        part, times = self.numpy_part(Mission.of(scenario)), np.linspace(0.0, scenario.end, POINTS)
        to_target, _ = part.directions(times, np)
        angle = part.orbit.earth_angle + orbits.EARTH_RATE * times + self.longitude
        cos_lat = np.cos(self.latitude)
        sin_lat = np.full_like(angle, np.sin(self.latitude))
        up = np.stack([cos_lat * np.cos(angle), cos_lat * np.sin(angle), sin_lat], axis=1)
        sines = -np.sum(to_target * up, axis=1)
        return float(np.arcsin(sines.min())), float(times[np.argmin(sines)])

    def directions(self, mission: Mission) -> tuple[orbits.Direction, orbits.Direction]:
        """Return the direction to the ground target, and the secondary direction."""
        point = orbits.ground_point(self.latitude, self.longitude, self.height)
        return orbits.GroundPoint(point), mission.direction("reference.secondary", self.secondary)


class TwoVectorTable(DirectionsTable, frozen=True):
    """One body axis points exactly in a direction, another one as near as possible to a second direction."""

    primary: Annotated[
        Vector, Meaning("direction of `primary_axis`: a name, or three numbers in inertial axes")
    ] = "sun"  # fmt: skip
    secondary: Annotated[Vector, SECONDARY] = (0.0, 0.0, 1.0)

    def directions(self, mission: Mission) -> tuple[orbits.Direction, orbits.Direction]:
        """Return the directions of the keys `primary` and `secondary`."""
        primary = mission.direction("reference.primary", self.primary)
        return primary, mission.direction("reference.secondary", self.secondary)


# by kind, the default first
REFERENCES: Kinds = {
    "fixed": make_table(AttitudeReference, references.Fixed, "fixed"),
    "spin": make_table(AttitudeReference, references.Spin, "spin"),
    "sinusoid": make_table(AttitudeReference, references.Swing, "sinusoid"),
    "slew": make_table(SlewTable, references.Slew, "slew"),
    "table": make_table(FileReference, references.TableReference, "table"),
    "nadir": make_table(NadirTable, orbits.NadirReference, "nadir"),
    "ground_target": make_table(GroundTargetTable, orbits.GroundTargetReference, "ground_target"),
    "two_vector": make_table(TwoVectorTable, orbits.TwoVectorReference, "two_vector"),
    "custom": custom_kind(
        AttitudeReference, references.Reference, ("attitude",),
        "A custom reference, a class derived from ptsmc_jax.Reference; its fields are further keys.",
    ),
}  # fmt: skip
