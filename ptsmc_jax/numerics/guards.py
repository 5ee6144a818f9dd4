"""Functions with a derivative where the plain ones have none: smooth sign, guarded norm, signed powers.

And by how much times may differ that count as equal.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

Scalar = Float[Array, ""]


@jax.jit
def smooth_sign(s: Float[Array, "..."], width: Float[Array, ""]) -> Float[Array, "..."]:
    """tanh(s / width), the boundary-layer form of sign(s) [-]; where width is 0, the exact sign.

    s: any shape; width: scalar in the units of s, at least 0. The slope at s = 0 is 1/width, and 0 for the exact sign.
    """
    exact = width <= 0.0
    steepness = 1.0 / jnp.where(exact, 1.0, width)
    return jnp.where(exact, jnp.sign(s), jnp.tanh(s * steepness))


@jax.custom_jvp
def sqrt(square: Float[Array, "..."]) -> Float[Array, "..."]:
    """Square root whose derivative at 0 is set to 0, where that of a norm has no value."""
    return jnp.sqrt(square)


@sqrt.defjvp
def _sqrt_jvp(primals: tuple, tangents: tuple) -> tuple:
    root = sqrt(*primals)
    at_zero = root == 0.0
    return root, jnp.where(at_zero, 0.0, tangents[0] * 0.5 / jnp.where(at_zero, 1.0, root))


@jax.jit
def norm(x: Float[Array, "..."]) -> Float[Array, ""]:
    """2-norm over all entries (Frobenius norm of a matrix), in the units of x; its gradient at x = 0 is set to 0."""
    return sqrt(jnp.sum(x * x))


@jax.jit
def signed_root(x: Float[Array, "..."], width: Scalar) -> Float[Array, "..."]:
    """sign(x) |x|^(1/2) as x / (x^2 + width^2)^(1/4), whose slope at 0 is width^(-1/2); where width is 0, exact.

    The exact root's slope at 0, which has no value, is set to 0.
    """
    square = x * x + width * width
    at_zero = square == 0.0
    return jnp.where(at_zero, 0.0, x / jnp.sqrt(jnp.sqrt(jnp.where(at_zero, 1.0, square))))


@jax.jit
def signed_power(x: Float[Array, "..."], power: Scalar) -> Float[Array, "..."]:
    """sign(x) |x|^power, power > 0; its slopes at 0, infinite for a power below 1, are set to 0."""
    at_zero = x == 0.0
    size = jnp.where(at_zero, 1.0, jnp.abs(x))
    return jnp.where(at_zero, 0.0, jnp.sign(x) * size**power)


def lerp(weight: Scalar, a: Any, b: Any) -> Any:
    """Leaf by leaf b + weight (a - b): a at weight 1, b at weight 0."""
    return jax.tree.map(lambda x, y: y + weight * (x - y), a, b)


def select(condition: Array, a: Any, b: Any) -> Any:
    """Leaf by leaf a where the scalar condition holds, b elsewhere; the side not taken leaks no tangent."""
    return jax.tree.map(lambda x, y: jnp.where(condition, x, y), a, b)


def rounding(period: Any, t: Any) -> Any:
    """By how much times about t [s] may differ and still count as equal [s]: 1e-9 of a period, and what numbers lose.

    With 64 bits the latter is less; with 32 a period of 0.01 s is known to 4e-5 of it after half a minute. Times may be
    negative, of samples that are counted from the hand-over.
    """
    return 1e-9 * period + resolution() * jnp.abs(t)


def resolution() -> float:
    """By how much numbers of the type in use may be off in a few operations, relative [-]: 4 eps."""
    return 4.0 * float(jnp.finfo(jnp.result_type(float)).eps)
