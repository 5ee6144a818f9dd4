"""Reference attitudes of missions: local vertical and local horizontal, ground targets, two directions.

Start with `MissionReference`. Rates and accelerations are exact derivatives of the attitude.
"""

from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from ptsmc_jax.numerics import attitude
from ptsmc_jax.numerics.pytrees import Leaf, Scalar, pytree
from ptsmc_jax.signals import attitude_tables, orbits
from ptsmc_jax.signals.references import Reference, Target, target_of


@dataclass(frozen=True)
class MissionReference(Reference):
    """Base of mission references: q_f(t) = frame(t) mount q, with a moving frame and two constant rotations.

    The attitude q is the identity, unless dispersions turn it.
    """

    mount: Leaf  # (4,) rotation from body axes to the axes of the frame

    def frame(self, t: Scalar) -> Float[Array, "4"]:
        """Return the quaternion (4,) [-] from the axes of the frame to inertial axes at the time t [s]."""
        raise NotImplementedError

    def quaternion(self, t: Scalar) -> Float[Array, "4"]:
        """Return the quaternion (4,) [-] of the reference at the time t [s]."""
        return attitude.multiply(self.frame(t), attitude.multiply(self.mount, self.q))

    def __call__(self, t: Scalar) -> Target:
        """Return the target at the time t [s]."""
        return target_of(self.quaternion, t)


@pytree
@dataclass(frozen=True)
class NadirReference(MissionReference):
    """One body axis points to the Earth's centre, another one along the horizontal velocity."""

    orbit: Any  # `orbits.Orbit`

    def frame(self, t: Scalar) -> Float[Array, "4"]:
        return self.orbit.quaternion(t)


@pytree
@dataclass(frozen=True)
class TwoVectorReference(MissionReference):
    """One body axis points exactly in a primary direction, another one as near as possible to a secondary one."""

    primary: Any  # an `orbits.Direction`
    secondary: Any
    orbit: Any  # `orbits.Orbit`, or None if no direction depends on it
    anchors: Leaf  # (n, 4) quaternions of the frame, without jumps of their signs, see `anchor_quaternions`
    anchor_rate: Leaf  # number of anchors per second [1/s]

    def matrix(self, t: Any, xp: Any = jnp) -> Any:
        """Return the rotation matrices (.., 3, 3) from the axes of the frame to inertial axes.

        The columns are the primary direction, the normal of both directions, and their cross product (TRIAD; Black,
        AIAA Journal 2(7), 1964).

        Args:
            t: times (..,) [s].
            xp: JAX's or NumPy's functions.
        """
        first, second = self.directions(t, xp)
        second = orbits.unit(orbits.cross(first, second))
        return xp.stack([first, second, orbits.cross(first, second)], axis=-1)

    def directions(self, t: Any, xp: Any = jnp) -> tuple[Any, Any]:
        """Return the primary and the secondary direction, unit vectors (.., 3) in inertial axes; see `matrix`."""
        position = None if self.orbit is None else self.orbit(t, xp)
        primary, secondary = (
            orbits.unit(direction(t, position, self.orbit, xp)) for direction in (self.primary, self.secondary)
        )
        return primary, secondary

    def frame(self, t: Scalar) -> Float[Array, "4"]:
        last = self.anchors.shape[0] - 1
        index = jnp.clip(jnp.floor(t * self.anchor_rate), 0, last).astype(jnp.int32)
        return quaternion_near(self.matrix(t), lax.dynamic_index_in_dim(self.anchors, index, keepdims=False))


@pytree
@dataclass(frozen=True)
class GroundTargetReference(TwoVectorReference):
    """One body axis points to a ground target, another one as near as possible to a second direction."""


def quaternion_near(matrix: Float[Array, "3 3"], anchor: Float[Array, "4"]) -> Float[Array, "4"]:
    """Return the quaternion (4,) of a rotation matrix (3, 3) with the sign that is nearer to another quaternion (4,).

    The matrix q q' is linear in the rotation matrix, and q q' a = q (q.a). The result therefore has no branches. It is
    smooth unless the two attitudes are 180 degrees apart.
    """
    v, s = anchor[:3], anchor[3]
    trace = matrix[0, 0] + matrix[1, 1] + matrix[2, 2]
    antisymmetric = matrix - matrix.T
    axial = jnp.stack([antisymmetric[2, 1], antisymmetric[0, 2], antisymmetric[1, 0]])
    vector = (matrix + matrix.T) @ v + (1.0 - trace) * v + s * axial
    return attitude.normalise(jnp.append(vector, jnp.dot(axial, v) + (1.0 + trace) * s))


def mounting(primary: object, secondary: object) -> np.ndarray:
    """Return the quaternion (4,) from body axes to the axes of `TwoVectorReference.matrix`.

    Args:
        primary: body axis (3,) of the primary direction, of any length.
        secondary: body axis (3,) of the secondary direction.
    """
    from scipy.spatial.transform import Rotation

    first = np.asarray(primary, dtype=float) / np.linalg.norm(np.asarray(primary))
    second = np.cross(first, np.asarray(secondary, dtype=float))
    second /= np.linalg.norm(second)
    return Rotation.from_matrix(np.stack([first, second, np.cross(first, second)])).as_quat()


def nadir_mounting(primary: object, secondary: object) -> np.ndarray:
    """Return the quaternion (4,) from body axes to orbit axes. Nadir is -x and the horizontal velocity is y there.

    Args:
        primary: body axis (3,) that points to the Earth's centre, of any length.
        secondary: body axis (3,) along the velocity.
    """
    from scipy.spatial.transform import Rotation

    to_frame, orbit_to_frame = mounting(primary, secondary), mounting((-1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    return (Rotation.from_quat(orbit_to_frame).inv() * Rotation.from_quat(to_frame)).as_quat()


def anchor_quaternions(matrices: np.ndarray) -> np.ndarray:
    """Return quaternions (n, 4) of rotation matrices (m, 3, 3) at equal intervals of time, without jumps of sign.

    Each anchor is the attitude at the start of one of n equal intervals. m and n are powers of two. n is the smallest
    of them with turns of less than 90 degrees in all intervals, but at most m.
    """
    from scipy.spatial.transform import Rotation

    q = attitude_tables.with_continuous_signs(Rotation.from_matrix(matrices).as_quat())
    count = 1
    while count < len(q):
        intervals = q.reshape(count, -1, 4)
        if np.all(np.einsum("kij,kj->ki", intervals, intervals[:, 0]) > np.cos(np.pi / 4)):
            break
        count *= 2
    return q.reshape(count, -1, 4)[:, 0]
