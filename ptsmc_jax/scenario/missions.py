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
POINTS, MOST_POINTS = 2048, 2**17  # smallest and largest number of times along the run
FINE = 0.05  # largest rotation of the reference between them [rad]


def check_axes(key: str, axis: tuple[float, ...], other: tuple[float, ...] | None = None) -> None:
    """Raise ScenarioError if a body axis (3,) is zero, or parallel to another one; key: of the axis."""
    if np.linalg.norm(axis) == 0.0:
        raise wrong(key, axis, "three numbers that are not all 0")
    if other is not None:
        sine = np.linalg.norm(np.cross(axis, other)) / (np.linalg.norm(axis) * np.linalg.norm(other))
        if sine < np.sin(LEAST):
            raise wrong(key, axis, f"an axis that is not parallel to reference.primary_axis = {list(other)}")


def orbit(scenario: Any, what: str) -> Any:
    """Return the orbit of a scenario; raise ScenarioError if it has none. `what` needs it, such as a key."""
    if scenario.orbit is None:
        raise ScenarioError(f"{what}, which needs an orbit, but there is no [orbit] table")
    return scenario.orbit.build(scenario.loop.epoch)


def direction(key: str, value: Any, scenario: Any) -> Any:
    """Return the direction of a key: a name, or a vector (3,); raise ScenarioError if another table is missing."""
    if not isinstance(value, str):
        check_axes(key, value)
        return orbits.Fixed(np.array(value, dtype=float))
    if value == "sun":
        epoch = scenario.loop.epoch
        if epoch is None:
            raise ScenarioError(f'{key} is "sun", which needs loop.epoch, such as "2026-03-20T12:00:00"')
        return orbits.sun(epochs.of_key(epoch).days)
    orbit(scenario, f'{key} is "{value}"')
    return {"nadir": orbits.Nadir, "velocity": orbits.Velocity, "orbit_normal": orbits.OrbitNormal}[value]()


class Along(NamedTuple):
    """A reference with two directions along a run."""

    anchors: np.ndarray  # (n, 4) quaternions of the frame at equal intervals of `span`, see `TwoVectorReference`
    span: float  # [s]
    fastest: float  # largest rate, plus the root of the largest acceleration [rad/s]
    least_angle: float  # between the two directions [rad]
    when: float  # time of the least angle [s]
    matrix: np.ndarray  # (3, 3) rotation at t = 0 from the axes of the frame to inertial axes


def along(table: Any, scenario: Any) -> Along:
    """Return a reference with two directions along the run, and for as long again, since tuning may move t_end."""
    return _along(table, scenario.orbit, scenario.loop.epoch, scenario.end)


class _Known(NamedTuple):
    """The keys of a scenario that determine directions."""

    orbit: Any
    loop: Any


class _Epoch(NamedTuple):
    epoch: str | None


@functools.lru_cache(maxsize=32)
def _along(table: Any, orbit_table: Any, epoch: str | None, end: float) -> Along:
    part, span, count = _part(table, _Known(orbit_table, _Epoch(epoch))), 2.0 * end, POINTS
    while True:
        step = span / count
        times = step * np.arange(count)
        sines = np.linalg.norm(np.cross(*part.directions(times, np)), axis=1)
        least = int(np.argmin(sines[: count // 2 + 1]))  # of the run
        if sines[least] < np.sin(LEAST):
            return Along(IDENTITY[None], span, 0.0, float(np.arcsin(sines[least])), least * step, np.eye(3))
        matrices = part.matrix(times, np)
        turns = mission_references.turns(matrices)
        if np.all(np.linalg.norm(turns, axis=1) < FINE) or count >= MOST_POINTS:
            break
        count *= 4
    rates = turns[: count // 2] / step
    fastest = np.linalg.norm(rates, axis=1).max() + np.sqrt(np.linalg.norm(np.diff(rates, axis=0), axis=1).max() / step)
    anchors = mission_references.anchored(matrices)
    least_angle = float(np.arcsin(min(sines[least], 1.0)))
    return Along(anchors, span, float(fastest), least_angle, least * step, matrices[0])


def _part(table: Any, scenario: Any, anchors: np.ndarray = IDENTITY[None], rate: float = 0.0) -> Any:
    """Return the part of a table with two directions, with numbers of NumPy."""
    primary, secondary = table.directions(scenario)
    needed = primary.needs_orbit or secondary.needs_orbit
    return table.made(
        q=IDENTITY, mount=table.mount, primary=primary, secondary=secondary,
        orbit=orbit(scenario, "reference") if needed else None, anchors=anchors, anchor_rate=np.float64(rate),
    )  # fmt: skip


def anchored(table: Any, scenario: Any) -> Any:
    """Return the reference of a table with two directions, for a run of the scenario."""
    found = along(table, scenario)
    return jax.tree.map(vector, _part(table, scenario, found.anchors, len(found.anchors) / found.span))


def first(table: Any, scenario: Any) -> np.ndarray:
    """Return the quaternion (4,) of a reference with two directions at t = 0."""
    return turned(along(table, scenario).matrix, table.mount)


def turned(matrix: np.ndarray, mount: np.ndarray) -> np.ndarray:
    """Return the quaternion (4,) of a rotation matrix (3, 3) after a quaternion (4,)."""
    from scipy.spatial.transform import Rotation

    return (Rotation.from_matrix(matrix) * Rotation.from_quat(mount)).as_quat()


def check_apart(table: Any, scenario: Any) -> None:
    """Raise ScenarioError if the two directions of a reference are parallel during the run."""
    found = along(table, scenario)
    if found.least_angle < LEAST:
        raise refused(
            "reference.secondary", table.secondary,
            f", but at t = {found.when:.6g} s that is {np.rad2deg(found.least_angle):.2g} deg from the primary "
            f"direction or its opposite, and at least {np.rad2deg(LEAST):.2g} deg are needed",
        )  # fmt: skip
