"""Convert the attitude keys of scenario files to unit quaternions and validate them.

A table gives an attitude by one of the keys in `ATTITUDE_KEYS`. Start with `quaternion`.
"""

from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from msgspec import Meta

from ptsmc_jax.scenario import errors
from ptsmc_jax.scenario.errors import ScenarioError, wrong
from ptsmc_jax.scenario.values import Four, Matrix, Meaning, Table, Three

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation


class Attitude(Table, frozen=True):
    """Exactly one attitude key, of the body relative to the inertial frame; `sequence` belongs to `euler_deg`."""

    quat_xyzw: Annotated[Four | None, Meaning("unit quaternion, scalar last")] = None
    quat_wxyz: Annotated[Four | None, Meaning("unit quaternion, scalar first")] = None
    rotvec_deg: Annotated[Three | None, Meaning("rotation vector", "deg")] = None
    mrp: Annotated[Three | None, Meaning("modified Rodrigues parameters")] = None
    dcm_body_to_inertial: Annotated[
        Matrix | None, Meaning("rotation matrix, by rows, that takes body components to inertial ones")
    ] = None
    euler_deg: Annotated[Three | None, Meaning("three angles of the axes in `sequence`", "deg")] = None
    sequence: Annotated[
        Annotated[str, Meta(description='three axes in SciPy\'s notation, such as "ZYX" or "zyx"')] | None,
        Meaning("three axes: capitals for intrinsic rotations about body axes, small letters for extrinsic rotations"),
    ] = None


ATTITUDE_KEYS = ("quat_xyzw", "quat_wxyz", "rotvec_deg", "mrp", "dcm_body_to_inertial", "euler_deg")


def unit_quaternion(key: str, value: object) -> np.ndarray:
    """Return a quaternion (4,) divided by its norm; raise ScenarioError if the norm is not 1 within 1e-6.

    The order of the components does not change. `key` is the full key for errors, such as "initial.quat_xyzw".
    """
    array = np.array(value, dtype=float)
    norm = np.linalg.norm(array)
    if abs(norm - 1.0) > 1e-6:
        raise wrong(key, value, f"a unit quaternion (its norm is {norm:.9g}, allowed is 1 within 1e-6)")
    return array / norm


def quaternion(table: Attitude, name: str) -> np.ndarray:
    """Return the unit quaternion [q1 q2 q3 q4] (4,) of a table's attitude key.

    It raises ScenarioError if the value is not an attitude. `name` is the table's name, for errors.
    """
    key, value = attitude_key(table)
    full_key = f"{name}.{key}"
    if table.sequence is not None and key != "euler_deg":
        raise ScenarioError(
            f"{name}.sequence is {errors.brief(table.sequence)}, but is allowed only together with euler_deg"
        )
    if key in ("quat_xyzw", "quat_wxyz"):
        unit = unit_quaternion(full_key, value)
        return unit if key == "quat_xyzw" else np.roll(unit, -1)
    with np.errstate(all="ignore"):  # the norm below detects an overflow
        converted = _rotation(table, name, key, np.array(value, dtype=float)).as_quat(canonical=True)
    if not abs(np.linalg.norm(converted) - 1.0) < 1e-6:
        raise wrong(full_key, value, "an attitude in numbers whose squares are finite")
    return converted


def _rotation(table: Attitude, name: str, key: str, array: np.ndarray) -> "Rotation":
    """Return the `Rotation` of an attitude key that is no quaternion, from its numbers."""
    from scipy.spatial.transform import Rotation  # the import takes 0.15 s, and most scenarios do not need it

    if key == "rotvec_deg":
        return Rotation.from_rotvec(array, degrees=True)
    if key == "mrp":
        return Rotation.from_mrp(array)
    if key == "dcm_body_to_inertial":
        deviation = np.abs(array @ array.T - np.eye(3)).max()
        if not deviation <= 1e-6 or np.linalg.det(array) < 0:
            raise wrong(f"{name}.{key}", array.tolist(), "a rotation matrix (orthonormal within 1e-6, determinant +1)")
        return Rotation.from_matrix(array)
    if table.sequence is None:
        raise ScenarioError(
            f'{name}.{key} needs {name}.sequence beside it, three axes in SciPy\'s notation, such as "ZYX"'
        )
    try:
        return Rotation.from_euler(table.sequence, array, degrees=True)
    except ValueError:
        raise wrong(
            f"{name}.sequence", table.sequence, 'three axes in SciPy\'s notation, such as "ZYX" or "zyx"'
        ) from None


def check_direction(key: str, value: Any) -> None:
    """Raise ScenarioError if a vector (3,) has no direction; `key`: its full key."""
    if not 1e-100 < max(map(abs, value)) < 1e100:
        raise wrong(key, value, "a direction, three numbers that are not all 0, huge or tiny")


def stated_keys(table: Attitude) -> list[str]:
    """Return the attitude keys that a table states."""
    return [key for key in ATTITUDE_KEYS if getattr(table, key) is not None]


def attitude_key(table: Attitude) -> tuple[str, object]:
    """Return the attitude key that a table uses, and its value."""
    key, *_ = stated_keys(table)
    return key, getattr(table, key)


def check_single_attitude(name: str, table: Attitude) -> None:
    """Raise ScenarioError if a table has more than one attitude key; `name`: the table's name."""
    present = stated_keys(table)
    if len(present) > 1:
        shown, allowed = " and ".join(present), ", ".join(ATTITUDE_KEYS)
        raise ScenarioError(f"{name} has the attitude keys {shown}, but must have exactly one of {allowed}")
