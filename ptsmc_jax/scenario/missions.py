"""References that point body axes in directions of a mission: validation, and quantities along the run.

Start with `anchored`. The tables with the keys are in `reference_tables`.
"""

import functools
from typing import Annotated, Any, Literal, NamedTuple

import jax
import numpy as np
from msgspec import Meta

from ptsmc_jax.numerics.pytrees import vector
from ptsmc_jax.scenario import epochs
from ptsmc_jax.scenario.errors import ScenarioError, refused, wrong
from ptsmc_jax.signals import mission_references, orbits

DIRECTIONS = "a name, or three numbers in inertial axes"
Vector = Annotated[
    Literal["nadir", "velocity", "orbit_normal", "sun"] | tuple[float, float, float],
    Meta(description='"nadir", "velocity", "orbit_normal", "sun" or three numbers'),
]
IDENTITY = np.array([0.0, 0.0, 0.0, 1.0])
LEAST = np.deg2rad(0.1)  # smallest angle between the two directions, and between the two body axes [rad]
POINTS, MOST_POINTS = 2048, 2**17  # smallest and largest number of anchors along the run
FINE = 0.05  # largest rotation of the reference between two anchors [rad]


def check_axes(key: str, axis: tuple[float, ...], other: tuple[float, ...] | None = None) -> None:
    """Raise ScenarioError if a body axis (3,) is zero, or parallel to another one; key: of the axis."""
    if np.linalg.norm(axis) == 0.0:
        raise wrong(key, axis, "three numbers that are not all 0")
    if other is not None:
        sine = np.linalg.norm(np.cross(axis, other)) / (np.linalg.norm(axis) * np.linalg.norm(other))
        if sine < np.sin(LEAST):
            raise wrong(key, axis, f"an axis that is not parallel to reference.primary_axis = {list(other)}")


class Mission(NamedTuple):
    """The keys of a scenario that directions depend on."""

    orbit: Any  # `OrbitTable`, or None
    epoch: str | None  # `loop.epoch`
    end: float  # end of the run [s]


def build(scenario: Any) -> Mission:
    """Return the keys of a scenario that directions depend on."""
    return Mission(scenario.orbit, scenario.loop.epoch, scenario.end)


def orbit(mission: Mission, what: str) -> Any:
    """Return the orbit; raise ScenarioError if there is none. `what` needs it, such as a key with its value."""
    if mission.orbit is None:
        raise ScenarioError(f"{what}, which needs an orbit, but there is no [orbit] table")
    return mission.orbit.build(mission.epoch)


def direction(key: str, value: Any, mission: Mission) -> Any:
    """Return the direction of a key: a name, or a vector (3,); raise ScenarioError if another table is missing."""
    if not isinstance(value, str):
        check_axes(key, value)
        return orbits.Fixed(np.array(value, dtype=float))
    if value == "sun":
        if mission.epoch is None:
            raise ScenarioError(f'{key} is "sun", which needs loop.epoch, such as "2026-03-20T12:00:00"')
        return orbits.sun(epochs.of_key(mission.epoch).days)
    orbit(mission, f'{key} is "{value}"')
    return {"nadir": orbits.Nadir, "velocity": orbits.Velocity, "orbit_normal": orbits.OrbitNormal}[value]()


class Along(NamedTuple):
    """A reference with two directions along a run."""

    anchors: np.ndarray  # (n, 4) quaternions of the frame at equal intervals of `span`, see `TwoVectorReference`
    span: float  # time from the first to the last anchor [s]
    fastest: float  # largest rate, plus the root of the largest acceleration [rad/s]
    matrix: np.ndarray  # (3, 3) rotation at t = 0 from the axes of the frame to inertial axes


@functools.lru_cache(maxsize=32)
def along(table: Any, mission: Mission) -> Along:
    """Return a reference with two directions along the run, and for as long again if possible: tuning may move t_end.

    Raises:
        ScenarioError: the directions are parallel during the run.
    """
    part, ahead, count = _part(table, mission), 2, POINTS
    while True:
        step = ahead * mission.end / count
        times = step * np.arange(count)
        sines = np.linalg.norm(np.cross(*part.directions(times, np)), axis=1)
        least = int(np.argmin(sines))
        if sines[least] < np.sin(LEAST) and times[least] <= mission.end:
            raise _parallel(table, times[least], np.arcsin(sines[least]))
        if sines[least] < np.sin(LEAST):
            ahead = 1
            continue
        matrices = part.matrix(times, np)
        turns = mission_references.turns(matrices)
        if np.all(np.linalg.norm(turns, axis=1) < FINE) or count >= MOST_POINTS:
            break
        count *= 4
    rates = turns[: count // ahead] / step
    fastest = np.linalg.norm(rates, axis=1).max() + np.sqrt(np.linalg.norm(np.diff(rates, axis=0), axis=1).max() / step)
    return Along(mission_references.anchored(matrices), ahead * mission.end, float(fastest), matrices[0])


def _parallel(table: Any, t: float, angle: float) -> ScenarioError:
    return refused(
        "reference.secondary", table.secondary,
        f", but at t = {t:.6g} s that is {np.rad2deg(angle):.2g} deg from the primary direction or its opposite, and "
        f"at least {np.rad2deg(LEAST):.2g} deg are needed",
    )  # fmt: skip


def _part(table: Any, mission: Mission, anchors: np.ndarray = IDENTITY[None], rate: float = 0.0) -> Any:
    """Return the part of a table with two directions, with numbers of NumPy."""
    primary, secondary = table.directions(mission)
    needed = primary.needs_orbit or secondary.needs_orbit
    return table.made(
        q=IDENTITY, mount=table.mount, primary=primary, secondary=secondary,
        orbit=orbit(mission, "reference") if needed else None, anchors=anchors, anchor_rate=np.float64(rate),
    )  # fmt: skip


def anchored(table: Any, mission: Mission) -> Any:
    """Return the reference of a table with two directions, for a run of the mission."""
    found = along(table, mission)
    return jax.tree.map(vector, _part(table, mission, found.anchors, len(found.anchors) / found.span))


def lowest_elevation(table: Any, mission: Mission) -> tuple[float, float]:
    """Return the lowest elevation of the spacecraft above the horizon of a ground target [rad], and its time [s]."""
    times = np.linspace(0.0, mission.end, POINTS)
    to_target, _ = _part(table, mission).directions(times, np)
    angle = orbit(mission, "reference").earth_angle + orbits.EARTH_RATE * times + table.longitude
    across = np.cos(table.latitude)
    up = np.stack([across * np.cos(angle), across * np.sin(angle), np.full_like(angle, np.sin(table.latitude))], axis=1)
    sines = -np.sum(to_target * up, axis=1)
    return float(np.arcsin(sines.min())), float(times[np.argmin(sines)])


def turned(matrix: np.ndarray, mount: np.ndarray) -> np.ndarray:
    """Return the quaternion (4,) of a rotation matrix (3, 3) after a quaternion (4,)."""
    from scipy.spatial.transform import Rotation

    return (Rotation.from_matrix(matrix) * Rotation.from_quat(mount)).as_quat()
