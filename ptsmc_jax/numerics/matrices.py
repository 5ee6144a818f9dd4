"""Small linear systems by plain arithmetic, which traces to plain primitives."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from ptsmc_jax.numerics.guards import norm


def solve(a: Float[Array, "n n"], b: Float[Array, "n ..."]) -> Float[Array, "n ..."]:
    """a^-1 b for a small matrix, b (n,) or (n, columns), written out: Gauss-Jordan elimination, the larger pivot first.

    For the inside of a loop, where LAPACK has no place. A singular matrix gives numbers that are not finite.
    """
    return _eliminated(a, b)[0]


def determinant(a: Float[Array, "n n"]) -> Float[Array, ""]:
    """Determinant of a small matrix, written out."""
    _, found = _eliminated(a, jnp.zeros_like(a[:, 0]))
    return jnp.where(jnp.isfinite(found), found, 0.0)  # a column without a pivot


def _eliminated(a: Array, b: Array) -> tuple[Array, Array]:
    """a^-1 b, and the determinant of a."""
    n = a.shape[0]
    sizes = [jnp.where(size > 0.0, size, 1.0) for size in (norm(row) for row in a)]
    scales = [1.0 / size for size in sizes]
    rows = [a[i] * scales[i] for i in range(n)]
    right = [b[i] * scales[i] for i in range(n)]
    found = jnp.prod(jnp.stack(sizes))
    for k in range(n):
        for i in range(k + 1, n):  # the largest entry of the column rises to row k
            larger = jnp.abs(rows[i][k]) > jnp.abs(rows[k][k])
            rows[k], rows[i] = jnp.where(larger, rows[i], rows[k]), jnp.where(larger, rows[k], rows[i])
            right[k], right[i] = jnp.where(larger, right[i], right[k]), jnp.where(larger, right[k], right[i])
            found = jnp.where(larger, -found, found)
        found = found * rows[k][k]
        inverse = 1.0 / rows[k][k]
        rows[k], right[k] = rows[k] * inverse, right[k] * inverse
        for i in range(n):
            if i != k:
                factor = rows[i][k]
                rows[i], right[i] = rows[i] - factor * rows[k], right[i] - factor * right[k]
    return jnp.stack(right), found


def row_norm(x: Float[Array, "n n"]) -> Float[Array, ""]:
    """Largest sum of magnitudes in a row."""
    return jnp.max(jnp.sum(jnp.abs(x), axis=1))
