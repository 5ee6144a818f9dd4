"""References that point body axes in directions of a mission: validation, and quantities along the run.

Start with `build_reference`. The tables with the keys are in `reference_tables`.
"""

import functools
from typing import Annotated, Any, Literal, NamedTuple

import jax
import numpy as np
from msgspec import Meta

from ptsmc_jax.numerics.pytrees import vector
from ptsmc_jax.scenario import epochs
from ptsmc_jax.scenario.errors import ScenarioError, value_error, wrong
from ptsmc_jax.signals import mission_references, orbits

DIRECTIONS = "a name, or three numbers in inertial axes"
Vector = Annotated[
    Literal["nadir", "velocity", "orbit_normal", "sun"] | tuple[float, float, float],
    Meta(description='"nadir", "velocity", "orbit_normal", "sun" or three numbers'),
]
IDENTITY = np.array([0.0, 0.0, 0.0, 1.0])
SMALLEST_ANGLE = np.deg2rad(0.1)  # smallest angle between the two directions, and between the two body axes [rad]
POINTS, MOST_POINTS = 2048, 2**17  # smallest and largest number of anchors along the run
LARGEST_TURN = 0.05  # largest rotation of the reference between two anchors [rad]


def check_axes(key: str, axis: tuple[float, ...], other: tuple[float, ...] | None = None) -> None:
    """Raise ScenarioError if a body axis (3,) is zero, or parallel to another one; key: its key."""
    if np.linalg.norm(axis) == 0.0:
        raise wrong(key, axis, "three numbers that are not all 0")
    if other is not None:
        sine = np.linalg.norm(np.cross(axis, other)) / (np.linalg.norm(axis) * np.linalg.norm(other))
        if sine < np.sin(SMALLEST_ANGLE):
            raise wrong(key, axis, f"an axis that is not parallel to reference.primary_axis = {list(other)}")


class Mission(NamedTuple):
    """The keys of a scenario that directions depend on."""

    orbit: Any  # `OrbitTable`, or None
    epoch: str | None  # `loop.epoch`
    end: float  # end of the run [s]


def from_scenario(scenario: Any) -> Mission:
    """Return the keys of a scenario that directions depend on."""
    return Mission(scenario.orbit, scenario.loop.epoch, scenario.end)


def require_orbit(mission: Mission, user: str) -> Any:
    """Return the orbit; raise ScenarioError if there is none. `user` is the key that needs it, for the error."""
    if mission.orbit is None:
        raise ScenarioError(f"{user}, which needs an orbit, but there is no [orbit] table")
    return mission.orbit.build(mission.epoch)


def build_direction(key: str, value: Any, mission: Mission) -> Any:
    """Return the direction of a key: a name, or a vector (3,); raise ScenarioError if another table is missing."""
    if not isinstance(value, str):
        check_axes(key, value)
        return orbits.Fixed(np.array(value, dtype=float))
    if value == "sun":
        if mission.epoch is None:
            raise ScenarioError(f'{key} is "sun", which needs loop.epoch, such as "2026-03-20T12:00:00"')
        return orbits.sun_direction(epochs.parse_key(mission.epoch).days)
    require_orbit(mission, f'{key} is "{value}"')
    return {"nadir": orbits.Nadir, "velocity": orbits.Velocity, "orbit_normal": orbits.OrbitNormal}[value]()


class SampledReference(NamedTuple):
    """A reference with two directions, sampled along a run."""

    anchors: np.ndarray  # (n, 4) quaternions of the frame at equal intervals of `span`, see `TwoVectorReference`
    span: float  # time from the first to the last anchor [s]
    fastest: float  # largest rate, plus the root of the largest acceleration [rad/s]
    matrix: np.ndarray  # (3, 3) rotation at t = 0 from the axes of the frame to inertial axes


@functools.lru_cache(maxsize=32)
def sample_reference(table: Any, mission: Mission) -> SampledReference:
    """Sample a reference with two directions over twice the run if possible, because tuning may move t_end.

    Raises:
        ScenarioError: the directions are parallel during the run.
    """
    part, run_lengths, anchor_count = _build_part(table, mission), 2, POINTS
    while True:
        step = run_lengths * mission.end / anchor_count
        times = step * np.arange(anchor_count)
        sines = np.linalg.norm(np.cross(*part.directions(times, np)), axis=1)
        closest = int(np.argmin(sines))
        if sines[closest] < np.sin(SMALLEST_ANGLE) and times[closest] <= mission.end:
            raise _parallel_error(table, times[closest], np.arcsin(sines[closest]))
        if sines[closest] < np.sin(SMALLEST_ANGLE):
            run_lengths = 1
            continue
        matrices = part.matrix(times, np)
        turns = mission_references.successive_rotations(matrices)
        if np.all(np.linalg.norm(turns, axis=1) < LARGEST_TURN) or anchor_count >= MOST_POINTS:
            break
        anchor_count *= 4
    rates = turns[: anchor_count // run_lengths] / step
    fastest = np.linalg.norm(rates, axis=1).max() + np.sqrt(np.linalg.norm(np.diff(rates, axis=0), axis=1).max() / step)
    span = run_lengths * mission.end
    return SampledReference(mission_references.anchor_quaternions(matrices), span, float(fastest), matrices[0])


def _parallel_error(table: Any, t: float, angle: float) -> ScenarioError:
    return value_error(
        "reference.secondary", table.secondary,
        f", but at t = {t:.6g} s that is {np.rad2deg(angle):.2g} deg from the primary direction or its opposite, and "
        f"at least {np.rad2deg(SMALLEST_ANGLE):.2g} deg are needed",
    )  # fmt: skip


def _build_part(table: Any, mission: Mission, anchors: np.ndarray = IDENTITY[None], rate: float = 0.0) -> Any:
    """Build the reference of a table with two directions, as NumPy numbers."""
    primary, secondary = table.directions(mission)
    needs_orbit = primary.needs_orbit or secondary.needs_orbit
    return table.part_class(
        q=IDENTITY, mount=table.mount, primary=primary, secondary=secondary,
        orbit=require_orbit(mission, "reference") if needs_orbit else None,
        anchors=anchors, anchor_rate=np.float64(rate),
    )  # fmt: skip


def build_reference(table: Any, mission: Mission) -> Any:
    """Return the reference of a table with two directions, for a run of the mission."""
    samples = sample_reference(table, mission)
    return jax.tree.map(vector, _build_part(table, mission, samples.anchors, len(samples.anchors) / samples.span))


def lowest_elevation(table: Any, mission: Mission) -> tuple[float, float]:
    """Return the lowest elevation of the spacecraft above the horizon of a ground target [rad], and its time [s]."""
    times = np.linspace(0.0, mission.end, POINTS)
    to_target, _ = _build_part(table, mission).directions(times, np)
    angle = require_orbit(mission, "reference").earth_angle + orbits.EARTH_RATE * times + table.longitude
    cos_lat = np.cos(table.latitude)
    sin_lat = np.full_like(angle, np.sin(table.latitude))
    up = np.stack([cos_lat * np.cos(angle), cos_lat * np.sin(angle), sin_lat], axis=1)
    sines = -np.sum(to_target * up, axis=1)
    return float(np.arcsin(sines.min())), float(times[np.argmin(sines)])


def mounted_quaternion(matrix: np.ndarray, mount: np.ndarray) -> np.ndarray:
    """Return the quaternion (4,) of the rotation `mount` (4,) followed by the rotation `matrix` (3, 3)."""
    from scipy.spatial.transform import Rotation

    return (Rotation.from_matrix(matrix) * Rotation.from_quat(mount)).as_quat()
