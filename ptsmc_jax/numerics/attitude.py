"""Attitude as a unit quaternion, the convention in one place.

q = [q1, q2, q3, q4] = [v, q4], scalar last, Hamilton product, body relative to inertial: the paper's and SciPy's order.
T(q) = q4 I + [v]x, v' = T(q) w / 2, q4' = -v.w / 2 with the body rate w in body axes [rad/s]: (1), (3).
What takes several operations is jitted, so that a program that calls it many times traces it once.
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
    """Cross product a x b [unit of a times unit of b], by half as many operations as `jnp.cross`: fewer to compile."""

    def turned(v: Vector) -> Vector:
        return jnp.concatenate([v[1:], v[:1]])

    return turned(a * turned(b) - turned(a) * b)


@jax.jit
def multiply(p: Quaternion, q: Quaternion) -> Quaternion:
    """Hamilton product p q [-]: R(p q) = R(p) R(q)."""
    v = p[3] * q[:3] + q[3] * p[:3] + cross(p[:3], q[:3])
    return jnp.append(v, p[3] * q[3] - jnp.dot(p[:3], q[:3]))


@jax.jit
def conjugate(q: Quaternion) -> Quaternion:
    """Inverse of a unit quaternion."""
    return jnp.append(-q[:3], q[3])


@jax.jit
def normalise(q: Quaternion) -> Quaternion:
    """The unit quaternion q / |q| [-]."""
    return q * (1.0 / jnp.sqrt(jnp.dot(q, q)))  # one division, not four


@jax.jit
def rotate(q: Quaternion, y: Vector) -> Vector:
    """The vector y, given in the axes that q turns to, in the axes that it turns from: R(q) y, in the units of y."""
    v, s = q[:3], q[3]
    # one cross product: XLA writes out nested ones again for every use, two million lines behind a moving reference
    return (1.0 - 2.0 * jnp.dot(v, v)) * y + 2.0 * (jnp.dot(v, y) * v + s * cross(v, y))


@jax.jit
def t_matrix(q: Quaternion) -> Float[Array, "3 3"]:
    """T(q) of (3) [-]."""
    x, y, z, s = q
    return jnp.stack([jnp.stack([s, -z, y]), jnp.stack([z, s, -x]), jnp.stack([-y, x, s])])


@jax.jit
def t_inverse_times(q: Quaternion, y: Vector) -> Vector:
    """T(q)^-1 y in closed form, in the units of y: (q4^2 y + v (v.y) - q4 v x y) / (q4 (q4^2 + v.v))."""
    v, s = q[:3], q[3]
    scale = 1.0 / (s * (s * s + jnp.dot(v, v)))
    return scale * (s * s * y + v * jnp.dot(v, y) - s * cross(v, y))


@jax.jit
def derivative(q: Quaternion, w: Vector) -> Quaternion:
    """dq/dt [1/s] at body rate w [rad/s], (1)."""
    return 0.5 * jnp.append(q[3] * w + cross(q[:3], w), -jnp.dot(q[:3], w))


@jax.jit
def vector_rates(q: Quaternion, w: Vector, w_dot: Vector) -> tuple[Vector, Vector]:
    """First and second derivative of the vector part v of q [1/s, 1/s^2]: T w / 2 and T w' / 2 - |w|^2 v / 4."""
    v, s = q[:3], q[3]
    first = 0.5 * (s * w + cross(v, w))
    second = 0.5 * (s * w_dot + cross(v, w_dot)) - 0.25 * jnp.dot(w, w) * v
    return first, second


@jax.jit
def from_vector_part(v: Vector, side: Float[Array, ""]) -> tuple[Quaternion, Float[Array, ""]]:
    """Unit quaternion with this vector part [-] and a scalar of the sign of `side` (0: positive), and 1 - |v|^2.

    Where |v| >= 1 no such quaternion exists: its scalar is then +-1e-6.
    """
    square = 1.0 - jnp.dot(v, v)
    scalar = jnp.sqrt(jnp.maximum(square, 1e-12))
    return jnp.append(v, jnp.where(side < 0.0, -scalar, scalar)), square


@jax.jit
def from_rotation_vector(r: Vector) -> Quaternion:
    """Unit quaternion of the rotation by |r| [rad] about r; smooth at r = 0.

    >>> q = from_rotation_vector(jnp.array([0.0, 0.0, jnp.pi / 2]))
    >>> [f"{part:.6f}" for part in q]  # scalar last
    ['0.000000', '0.000000', '0.707107', '0.707107']
    >>> body_x = rotate(q, jnp.array([1.0, 0.0, 0.0]))  # seen from outside
    >>> bool(jnp.allclose(body_x, jnp.array([0.0, 1.0, 0.0])))
    True
    """
    square = jnp.dot(r, r)
    small = square < 1e-6  # beyond the series' three terms: 1e-6^3 / 2^7 / 7! = 1e-24
    angle = jnp.sqrt(jnp.where(small, 1.0, square))
    turns = angle * (0.25 / np.pi)  # of half the angle
    cosine, sine = elementary.cos_sin_turns(turns - jnp.floor(turns))
    scale = jnp.where(small, 0.5 - square / 48 + square**2 / 3840, sine / angle)
    scalar = jnp.where(small, 1 - square / 8 + square**2 / 384, cosine)
    return jnp.append(scale * r, scalar)


@jax.jit
def rotation_vector(v: Vector) -> Vector:
    """Rotation vector [rad] of the unit quaternion with the vector part v, |v| < 1, and a scalar that is positive.

    Smooth at v = 0.

    >>> bool(
    ...     jnp.allclose(rotation_vector(from_rotation_vector(jnp.array([0.1, 0.0, 2.0]))[:3]), jnp.array([0.1, 0, 2]))
    ... )
    True
    """
    square = jnp.dot(v, v)
    small = square < 1e-6  # beyond the series' four terms: 1e-6^4
    size = jnp.sqrt(jnp.where(small, 0.25, square))
    scalar = jnp.sqrt(jnp.maximum(1.0 - square, 1e-12))
    series = 2.0 + square / 3 + 3 * square**2 / 20 + 5 * square**3 / 56
    return v * jnp.where(small, series, 2.0 * elementary.arctan2(size, scalar) / size)


@jax.jit
def angle(q: Quaternion, reference: Quaternion) -> Float[Array, ""]:
    """Angle of the rotation from one attitude to another [rad], 0 to pi, accurate down to 0; gradient 0 there.

    >>> start, end = from_rotation_vector(jnp.array([0.0, 0.0, 0.0])), from_rotation_vector(jnp.array([0.0, 0.3, 0.4]))
    >>> f"{angle(start, end):.6f}"
    '0.500000'
    """
    return rotation_angle(multiply(conjugate(reference), q))


def rotation_angle(q: Quaternion) -> Float[Array, ""]:
    """Angle that a quaternion of any length turns by [rad], 0 to pi, accurate down to 0; gradient 0 there."""
    return 2.0 * elementary.arctan2(guards.norm(q[:3]), jnp.abs(q[3]))
