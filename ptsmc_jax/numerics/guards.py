"""Smooth or guarded versions of functions that have no finite derivative at some points.

`smooth_sign` is the boundary-layer form of sign(s). `norm`, `signed_root` and `signed_power` have derivatives that are
finite everywhere. `time_tolerance` is the tolerance for comparisons of times.
"""

from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ptsmc_jax.numerics.pytrees import Scalar

Tree = TypeVar("Tree")  # a pytree of arrays


@jax.jit
def smooth_sign(s: Float[Array, "..."], width: Float[Array, ""]) -> Float[Array, "..."]:
    """Return tanh(s / width) [-], the boundary-layer form of sign(s).

    Args:
        s: sliding variable, of any shape.
        width: thickness of the boundary layer, at least 0, in the units of s. If it is 0, the sign is discontinuous and
            its derivative is 0.
    """
    discontinuous = width <= 0.0
    steepness = 1.0 / jnp.where(discontinuous, 1.0, width)
    return jnp.where(discontinuous, jnp.sign(s), jnp.tanh(s * steepness))


@jax.custom_jvp
def sqrt(square: Float[Array, "..."]) -> Float[Array, "..."]:
    """Square root whose derivative at 0, which is infinite, is replaced by 0."""
    return jnp.sqrt(square)


@sqrt.defjvp
def _sqrt_jvp(primals: tuple, tangents: tuple) -> tuple:
    """Return the root and its derivative, which is 0 at zero."""
    root = sqrt(*primals)
    at_zero = root == 0.0
    return root, jnp.where(at_zero, 0.0, tangents[0] * 0.5 / jnp.where(at_zero, 1.0, root))


@jax.jit
def norm(x: Float[Array, "..."]) -> Float[Array, ""]:
    """2-norm over all entries (Frobenius norm of a matrix), in the units of x. Its gradient at x = 0 is set to 0."""
    return sqrt(jnp.sum(x * x))


@jax.jit
def signed_root(x: Float[Array, "..."], width: Scalar) -> Float[Array, "..."]:
    """Return the smooth signed root x / (x^2 + width^2)^(1/4) of x.

    If the width is 0, it equals sign(x) |x|^(1/2), whose derivative at 0 is infinite and is replaced by 0.
    """
    square = x * x + width * width
    at_zero = square == 0.0
    return jnp.where(at_zero, 0.0, x / jnp.sqrt(jnp.sqrt(jnp.where(at_zero, 1.0, square))))


@jax.jit
def signed_power(x: Float[Array, "..."], power: Scalar) -> Float[Array, "..."]:
    """Return sign(x) |x|^power for power > 0. The derivatives at 0, which may be infinite, are replaced by 0."""
    at_zero = x == 0.0
    size = jnp.where(at_zero, 1.0, jnp.abs(x))
    return jnp.where(at_zero, 0.0, jnp.sign(x) * size**power)


def lerp(weight: Scalar, a: Tree, b: Tree) -> Tree:
    """Interpolate linearly between two pytrees.

    Args:
        weight: scalar; 1 returns a, 0 returns b.
        a: pytree of arrays.
        b: pytree like a.
    """
    return jax.tree.map(lambda x, y: y + weight * (x - y), a, b)


def select(condition: Array, a: Tree, b: Tree) -> Tree:
    """Return one of two pytrees. The other one has no influence on tangents.

    Args:
        condition: scalar; True selects a, False selects b.
        a: pytree of arrays.
        b: pytree like a.
    """
    return jax.tree.map(lambda x, y: jnp.where(condition, x, y), a, b)


def time_tolerance(period: Any, t: Any) -> Any:
    """Return the tolerance for comparisons of times near t [s].

    It is the sum of 1e-9 periods and the rounding error of t. With 64 bits the rounding error is the smaller term. With
    32 bits it is 4e-5 periods of 0.01 s after half a minute.

    Args:
        period: control period [s].
        t: time [s]; negative if it is counted from the hand-over.
    """
    return 1e-9 * period + resolution() * jnp.abs(t)


def resolution() -> float:
    """Return the relative rounding error [-] of a few operations, 4 eps of the floating-point type in use."""
    return 4.0 * float(jnp.finfo(jnp.result_type(float)).eps)
