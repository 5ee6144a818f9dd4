"""The tables [initial] and [reference] of scenario files of a spacecraft, with the references by kind in `REFERENCES`.

The numbers of a reference are declared in `signals.references`. Start with `ReferenceTable`.
"""

from typing import Annotated, Any, Literal

import jax
import numpy as np
from msgspec import Meta

from ptsmc_jax.numerics.pytrees import vector
from ptsmc_jax.scenario import attitude_files, attitude_keys, missions
from ptsmc_jax.scenario.attitude_keys import Attitude
from ptsmc_jax.scenario.custom import Custom, custom_kind, fastest_rate
from ptsmc_jax.scenario.errors import ScenarioError, show, value_error, wrong
from ptsmc_jax.scenario.missions import DIRECTIONS, Vector
from ptsmc_jax.scenario.schema import PartTable, make_table
from ptsmc_jax.scenario.values import Four, Kinds, Meaning, Number, Three
from ptsmc_jax.signals import attitude_tables, mission_references, orbits, references

LARGEST_LATITUDE = np.pi / 2  # [rad]


class Initial(Attitude, frozen=True):
    """Initial state of the spacecraft: one attitude key and the body rate."""

    rate: Annotated[Three, Meaning("body rate at t = 0, body axes", "rad/s")] = (0.0, 0.0, 0.0)


class ReferenceTable(PartTable, frozen=True):
    """A reference attitude of a spacecraft."""

    def frequencies(self, scenario: Any) -> dict[str, float]:
        """Return the angular frequency of the reference [rad/s], by the key that determines it."""
        raise NotImplementedError

    def check(self, scenario: Any) -> None:
        """Raise ScenarioError if keys are not valid, or contradict other tables."""

    def check_reference_until(self, scenario: Any, last: float, key: str) -> None:
        """Raise ScenarioError if the reference ends before a run until `last` [s]; key: determines that time."""

    def build(self, scenario: Any) -> Any:
        """Return the part of `signals`."""
        raise NotImplementedError

    def initial_reference_attitude(self, scenario: Any) -> np.ndarray:
        """Return the unit quaternion (4,) of the reference at t = 0."""
        raise NotImplementedError


class AttitudeReference(Attitude, ReferenceTable, frozen=True):
    """An attitude that a spacecraft is to follow."""

    def frequencies(self, scenario: Any) -> dict[str, float]:
        part = self.build(scenario) if isinstance(self, Custom) else self
        return {f"reference.{self.part_class.paced_by}": fastest_rate(self, "reference", part)}

    def check(self, scenario: Any) -> None:
        self.initial_reference_attitude(scenario)

    def build(self, scenario: Any) -> Any:
        return self.part(q=vector(self.initial_reference_attitude(scenario)))

    def initial_reference_attitude(self, scenario: Any) -> np.ndarray:
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

    def check(self, scenario: Any) -> None:
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

    def _samples(self, scenario: Any) -> attitude_files.Samples:
        if self.file is None:
            raise ScenarioError("reference.file is absent, but must be given: a CSV, Parquet or AEM file")
        try:
            return attitude_files.read(self.file, self.quaternion_order, self.direction, self.interpolation,
                                       scenario.loop.epoch)  # fmt: skip
        except ValueError as error:
            raise value_error("reference.file", self.file, f", {error}") from None

    def frequencies(self, scenario: Any) -> dict[str, float]:
        return {"reference.file": self._samples(scenario).fastest}

    def check(self, scenario: Any) -> None:
        samples = self._samples(scenario)
        first, last = samples.times[0], samples.usable_until
        if first > 0.0 or last < 0.0:
            zero = "t = 0" if scenario.loop.epoch is None else f"loop.epoch = {show(scenario.loop.epoch)}"
            raise value_error("reference.file", self.file, f", whose attitudes are from {first:.9g} to {last:.9g} s "
                              f"after {zero}, which must be in between")  # fmt: skip
        self.check_reference_until(scenario, scenario.end, "loop.t_end")

    def check_reference_until(self, scenario: Any, last: float, key: str) -> None:
        end = self._samples(scenario).usable_until
        if last > end * (1.0 + 1e-9):
            value = scenario.loop.t_end if key == "loop.t_end" else scenario.search.bounds.get("t_f")
            raise value_error(key, value, f", which needs the attitude until {last:.12g} s, but {self.file} ends at "
                          f"{end:.12g} s")  # fmt: skip

    def build(self, scenario: Any) -> Any:
        samples = self._samples(scenario)
        return attitude_tables.interpolate_attitude(samples.times, samples.quaternions, samples.end_rates)

    def initial_reference_attitude(self, scenario: Any) -> np.ndarray:
        self.check(scenario)
        samples = self._samples(scenario)
        k = int(np.argmin(np.abs(samples.times)))  # the nearest sample is accurate enough for a default
        return samples.quaternions[k]


class MissionTable(ReferenceTable, frozen=True):
    """A reference that points body axes in directions of the mission."""

    primary_axis: Annotated[Three, Meaning("body axis that points exactly in the primary direction")] = (0.0, 0.0, 1.0)
    secondary_axis: Annotated[
        Three, Meaning("body axis that points as near as possible to the secondary direction")
    ] = (1.0, 0.0, 0.0)

    @property
    def mount(self) -> np.ndarray:
        """Quaternion (4,) from body axes to the axes of the frame."""
        return mission_references.mounting(self.primary_axis, self.secondary_axis)

    def check(self, scenario: Any) -> None:
        missions.check_axes("reference.primary_axis", self.primary_axis)
        missions.check_axes("reference.secondary_axis", self.secondary_axis, self.primary_axis)


class NadirTable(MissionTable, frozen=True):
    """Local vertical, local horizontal."""

    def _require_orbit(self, scenario: Any) -> Any:
        """Return the orbit of the scenario; raise ScenarioError if there is no [orbit] table."""
        return missions.require_orbit(missions.from_scenario(scenario), 'reference.kind is "nadir"')

    def frequencies(self, scenario: Any) -> dict[str, float]:
        return {"reference.kind": float(self._require_orbit(scenario).fastest())}

    def check(self, scenario: Any) -> None:
        super().check(scenario)
        self._require_orbit(scenario)

    @property
    def mount(self) -> np.ndarray:
        return mission_references.nadir_mounting(self.primary_axis, self.secondary_axis)

    def build(self, scenario: Any) -> Any:
        part = self.part_class(q=missions.IDENTITY, mount=self.mount, orbit=self._require_orbit(scenario))
        return jax.tree.map(vector, part)

    def initial_reference_attitude(self, scenario: Any) -> np.ndarray:
        self.check(scenario)
        axes = self._require_orbit(scenario)(np.zeros(()), np)
        return missions.mounted_quaternion(np.stack([axes.radial, axes.along, axes.normal], axis=1), self.mount)


class DirectionsTable(MissionTable, frozen=True):
    """References with a primary and a secondary direction."""

    def directions(self, mission: missions.Mission) -> tuple[Any, Any]:
        """Return the primary and the secondary direction, parts of `signals.orbits`."""
        raise NotImplementedError

    def frequencies(self, scenario: Any) -> dict[str, float]:
        return {"reference.kind": missions.sample_reference(self, missions.from_scenario(scenario)).fastest}

    def check(self, scenario: Any) -> None:
        super().check(scenario)
        missions.sample_reference(self, missions.from_scenario(scenario))

    def build(self, scenario: Any) -> Any:
        return missions.build_reference(self, missions.from_scenario(scenario))

    def initial_reference_attitude(self, scenario: Any) -> np.ndarray:
        self.check(scenario)
        return missions.mounted_quaternion(
            missions.sample_reference(self, missions.from_scenario(scenario)).matrix, self.mount
        )


SECONDARY = Meaning("direction of `secondary_axis`: a name, or three numbers in inertial axes")


class GroundTargetTable(DirectionsTable, frozen=True):
    """One body axis points to a ground target on the rotating Earth, another one as near as possible to a direction."""

    latitude: Annotated[Number, Meaning("geodetic, WGS-84", "rad")] = 0.0
    longitude: Annotated[Number, Meaning("east of Greenwich", "rad")] = 0.0
    height: Annotated[Number, Meaning("above the WGS-84 ellipsoid", "m")] = 0.0
    secondary: Annotated[Vector, SECONDARY] = "velocity"

    def check(self, scenario: Any) -> None:
        if abs(self.latitude) > LARGEST_LATITUDE:
            raise wrong("reference.latitude", self.latitude, 'from -pi/2 to pi/2 [rad], or with its unit, as "48 deg"')
        super().check(scenario)

    def lowest_elevation(self, scenario: Any) -> tuple[float, float]:
        """Return the lowest elevation above the horizon of the target [rad], and its time [s]."""
        return missions.lowest_elevation(self, missions.from_scenario(scenario))

    def directions(self, mission: missions.Mission) -> tuple[Any, Any]:
        point = orbits.ground_point(self.latitude, self.longitude, self.height)
        return orbits.GroundPoint(point), missions.build_direction("reference.secondary", self.secondary, mission)


class TwoVectorTable(DirectionsTable, frozen=True):
    """One body axis points exactly in a direction, another one as near as possible to a second direction."""

    primary: Annotated[Vector, Meaning(f"direction of `primary_axis`: {DIRECTIONS}")] = "sun"
    secondary: Annotated[Vector, SECONDARY] = (0.0, 0.0, 1.0)

    def directions(self, mission: missions.Mission) -> tuple[Any, Any]:
        key_values = ("reference.primary", self.primary), ("reference.secondary", self.secondary)
        primary, secondary = (missions.build_direction(*each, mission) for each in key_values)
        return primary, secondary


# by kind, the default first
REFERENCES: Kinds = {
    "fixed": make_table(AttitudeReference, references.Fixed, "fixed"),
    "spin": make_table(AttitudeReference, references.Spin, "spin"),
    "sinusoid": make_table(AttitudeReference, references.Swing, "sinusoid"),
    "slew": make_table(SlewTable, references.Slew, "slew"),
    "table": make_table(FileReference, attitude_tables.TableReference, "table"),
    "nadir": make_table(NadirTable, mission_references.NadirReference, "nadir"),
    "ground_target": make_table(GroundTargetTable, mission_references.GroundTargetReference, "ground_target"),
    "two_vector": make_table(TwoVectorTable, mission_references.TwoVectorReference, "two_vector"),
    "custom": custom_kind(
        AttitudeReference, references.Reference, ("attitude",),
        "A custom reference, a class derived from ptsmc_jax.Reference; its fields are further keys.",
    ),
}  # fmt: skip
