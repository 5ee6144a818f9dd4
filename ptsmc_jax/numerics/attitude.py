"""Attitude kinematics with unit quaternions; the module defines the convention of the whole package.

A quaternion is q = [q1, q2, q3, q4] = [v, q4], scalar last, with the Hamilton product. It rotates from body axes to
inertial axes. The paper and SciPy use the same order. With the body rate w in body axes [rad/s], the kinematics are
equations (1) and (3) of the paper: v' = T(q) w / 2 and q4' = -v.w / 2 with T(q) = q4 I + [v]x. Start with `multiply`
and `rotate`.

Functions of several operations are jitted. A program that calls one of them many times traces it once.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ptsmc_jax.numerics import elementary, guards

Quaternion = Float[Array, "4"]
Vector = Float[Array, "3"]


@jax.jit
def cross(a: Vector, b: Vector) -> Vector:
    """Cross product a x b [unit of a times unit of b]. It has half as many operations to compile as `jnp.cross`."""

    def shift(v: Vector) -> Vector:
        return jnp.concatenate([v[1:], v[:1]])

    return shift(a * shift(b) - shift(a) * b)


@jax.jit
def multiply(p: Quaternion, q: Quaternion) -> Quaternion:
    """Hamilton product p q [-]. The rotation matrices satisfy R(p q) = R(p) R(q)."""
    v = p[3] * q[:3] + q[3] * p[:3] + cross(p[:3], q[:3])
    return jnp.append(v, p[3] * q[3] - jnp.dot(p[:3], q[:3]))


@jax.jit
def conjugate(q: Quaternion) -> Quaternion:
    """Inverse of a unit quaternion."""
    return jnp.append(-q[:3], q[3])


@jax.jit
def normalise(q: Quaternion) -> Quaternion:
    """Unit quaternion q / |q| [-]."""
    return q * (1.0 / jnp.sqrt(jnp.dot(q, q)))  # one division instead of four


def unit(q: Quaternion) -> Quaternion:
    """Return a measured quaternion with |q| = 1 [-]; q itself if it has that length to rounding."""
    square = jnp.dot(q, q)
    return jnp.where(jnp.abs(square - 1.0) > 1e-12, q / jnp.sqrt(square), q)


@jax.jit
def rotate(q: Quaternion, y: Vector) -> Vector:
    """Rotate a vector from body axes to inertial axes: R(q) y, in the units of y."""
    v, s = q[:3], q[3]
    # The formula has no nested cross product, because XLA repeats it at each use: programs had two million lines.
    return (1.0 - 2.0 * jnp.dot(v, v)) * y + 2.0 * (jnp.dot(v, y) * v + s * cross(v, y))


@jax.jit
def t_matrix(q: Quaternion) -> Float[Array, "3 3"]:
    """Matrix T(q) = q4 I + [v]x [-], equation (3) of the paper."""
    x, y, z, s = q
    return jnp.stack([jnp.stack([s, -z, y]), jnp.stack([z, s, -x]), jnp.stack([-y, x, s])])


@jax.jit
def t_inverse_times(q: Quaternion, y: Vector) -> Vector:
    """Solve T(q) z = y for z, in the units of y.

    The closed form is z = (q4^2 y + v (v.y) - q4 v x y) / (q4 (q4^2 + v.v)), which is singular at q4 = 0.
    """
    v, s = q[:3], q[3]
    scale = 1.0 / (s * (s * s + jnp.dot(v, v)))
    return scale * (s * s * y + v * jnp.dot(v, y) - s * cross(v, y))


@jax.jit
def derivative(q: Quaternion, w: Vector) -> Quaternion:
    """Time derivative of q [1/s] at the body rate w [rad/s], by equation (1) of the paper."""
    return 0.5 * jnp.append(q[3] * w + cross(q[:3], w), -jnp.dot(q[:3], w))


@jax.jit
def vector_rates(q: Quaternion, w: Vector, w_dot: Vector) -> tuple[Vector, Vector]:
    """Return the first and second time derivatives of the vector part v of q.

    Args:
        q: unit quaternion.
        w: body rate [rad/s].
        w_dot: its time derivative [rad/s^2].

    Returns:
        v' = T(q) w / 2 [1/s] and v'' = T(q) w' / 2 - |w|^2 v / 4 [1/s^2], (3,) each.
    """
    v, s = q[:3], q[3]
    first = 0.5 * (s * w + cross(v, w))
    second = 0.5 * (s * w_dot + cross(v, w_dot)) - 0.25 * jnp.dot(w, w) * v
    return first, second


@jax.jit
def from_vector_part(v: Vector, side: Float[Array, ""]) -> tuple[Quaternion, Float[Array, ""]]:
    """Return the unit quaternion with vector part v [-] and a scalar part with the sign of `side`, and 1 - |v|^2.

    Args:
        v: vector part [-], |v| < 1. If |v| >= 1 no such quaternion exists, and the scalar part is set to +-1e-6.
        side: number with the sign of the scalar part; 0 selects the positive sign.

    Returns:
        The quaternion (4,) [-], and 1 - |v|^2 [-], which is positive if the quaternion exists.
    """
    square = 1.0 - jnp.dot(v, v)
    scalar = jnp.sqrt(jnp.maximum(square, 1e-12))
    return jnp.append(v, jnp.where(side < 0.0, -scalar, scalar)), square


@jax.jit
def from_rotation_vector(r: Vector) -> Quaternion:
    """Unit quaternion of the rotation by the angle |r| [rad] about the axis r. It is smooth at r = 0.

    >>> q = from_rotation_vector(jnp.array([0.0, 0.0, jnp.pi / 2]))
    >>> [f"{part:.6f}" for part in q]  # scalar last
    ['0.000000', '0.000000', '0.707107', '0.707107']
    >>> body_x = rotate(q, jnp.array([1.0, 0.0, 0.0]))  # in inertial axes
    >>> bool(jnp.allclose(body_x, jnp.array([0.0, 1.0, 0.0])))
    True
    """
    square = jnp.dot(r, r)
    small = square < 1e-6  # the series of three terms then has an error of at most 2e-24
    angle = jnp.sqrt(jnp.where(small, 1.0, square))
    turns = angle * (0.25 / np.pi)  # half the angle, in full turns
    cosine, sine = elementary.cos_sin_turns(turns - jnp.floor(turns))
    scale = jnp.where(small, 0.5 - square / 48 + square**2 / 3840, sine / angle)
    scalar = jnp.where(small, 1 - square / 8 + square**2 / 384, cosine)
    return jnp.append(scale * r, scalar)


@jax.jit
def rotation_vector(v: Vector) -> Vector:
    """Rotation vector [rad] of the unit quaternion with the vector part v, |v| < 1, and a positive scalar part.

    It is smooth at v = 0.

    >>> bool(
    ...     jnp.allclose(rotation_vector(from_rotation_vector(jnp.array([0.1, 0.0, 2.0]))[:3]), jnp.array([0.1, 0, 2]))
    ... )
    True
    """
    square = jnp.dot(v, v)
    small = square < 1e-6  # the series of four terms then has an error of about 1e-24
    size = jnp.sqrt(jnp.where(small, 0.25, square))
    scalar = jnp.sqrt(jnp.maximum(1.0 - square, 1e-12))
    series = 2.0 + square / 3 + 3 * square**2 / 20 + 5 * square**3 / 56
    return v * jnp.where(small, series, 2.0 * elementary.arctan2(size, scalar) / size)


def small_rotation(q: Quaternion, other: Quaternion) -> Vector:
    """Return the small rotation [rad] from attitude q to attitude `other`, in body axes of q, to first order."""
    error = multiply(conjugate(q), other)
    return jnp.where(error[3] < 0.0, -2.0, 2.0) * error[:3]


@jax.jit
def angle(q: Quaternion, reference: Quaternion) -> Float[Array, ""]:
    """Angle of the rotation from one attitude to another, 0 to pi [rad]. Small angles are accurate.

    The gradient at equal attitudes is set to 0.

    >>> start, end = from_rotation_vector(jnp.array([0.0, 0.0, 0.0])), from_rotation_vector(jnp.array([0.0, 0.3, 0.4]))
    >>> f"{angle(start, end):.6f}"
    '0.500000'
    """
    return rotation_angle(multiply(conjugate(reference), q))


def rotation_angle(q: Quaternion) -> Float[Array, ""]:
    """Rotation angle of a quaternion of any norm, 0 to pi [rad]. The gradient at angle 0 is set to 0."""
    return 2.0 * elementary.arctan2(guards.norm(q[:3]), jnp.abs(q[3]))
