"""Small matrices by plain arithmetic, which traces to plain primitives."""

from itertools import combinations

import jax
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
    _, product = _eliminated(a, jnp.zeros_like(a[:, 0]))
    return jnp.where(jnp.isfinite(product), product, 0.0)  # a column without a pivot


@jax.jit
def _eliminated(a: Array, b: Array) -> tuple[Array, Array]:
    """a^-1 b, and the determinant of a."""
    n = a.shape[0]
    sizes = [jnp.where(size > 0.0, size, 1.0) for size in map(norm, a)]
    scales = [1.0 / size for size in sizes]
    rows = [a[i] * scales[i] for i in range(n)]
    right = [b[i] * scales[i] for i in range(n)]
    determinant = jnp.prod(jnp.stack(sizes))
    for k in range(n):
        for i in range(k + 1, n):  # the largest entry of the column rises to row k
            larger = jnp.abs(rows[i][k]) > jnp.abs(rows[k][k])
            rows[k], rows[i] = jnp.where(larger, rows[i], rows[k]), jnp.where(larger, rows[k], rows[i])
            right[k], right[i] = jnp.where(larger, right[i], right[k]), jnp.where(larger, right[k], right[i])
            determinant = jnp.where(larger, -determinant, determinant)
        determinant = determinant * rows[k][k]
        inverse = 1.0 / rows[k][k]
        rows[k], right[k] = rows[k] * inverse, right[k] * inverse
        for i in range(n):
            if i != k:
                factor = rows[i][k]
                rows[i], right[i] = rows[i] - factor * rows[k], right[i] - factor * right[k]
    return jnp.stack(right), determinant


SWEEPS = 8  # over all pairs of axes: they converge quadratically, to all digits in 5 or 6


@jax.jit
def smallest_eigenvalue(a: Float[Array, "n n"]) -> Float[Array, ""]:
    """Smallest eigenvalue of a small symmetric matrix, in its unit, by Jacobi's rotations.

    Each rotation makes one pair of entries beside the diagonal zero (Golub and Van Loan, Matrix Computations, 2013,
    8.5). Good to all digits where eigenvalues fall together, too, which the closed form for three of them is not.
    """

    def sweep(_: Array | int, a: Array) -> Array:  # a whole number where nothing is compiled
        for p, q in combinations(range(a.shape[0]), 2):
            a = _rotated(a, p, q)
        return a

    return jnp.min(jnp.diagonal(jax.lax.fori_loop(0, SWEEPS, sweep, a)))


def _rotated(a: Array, p: int, q: int) -> Array:
    """R' a R with the rotation R in the plane of p and q, by less than 45 degrees, that makes a_pq zero."""
    gap, off = a[q, q] - a[p, p], 2.0 * a[p, q]
    size = norm(jnp.stack([gap, off]))
    tangent = jnp.where(gap < 0.0, -off, off) / jnp.where(size > 0.0, jnp.abs(gap) + size, 1.0)
    cosine = 1.0 / jnp.sqrt(1.0 + tangent**2)
    sine = tangent * cosine
    for _ in range(2):  # rows, then columns
        rows = list(a)
        rows[p], rows[q] = cosine * a[p] - sine * a[q], sine * a[p] + cosine * a[q]
        a = jnp.stack(rows).T
    return a


def row_norm(x: Float[Array, "n n"]) -> Float[Array, ""]:
    """Largest sum of magnitudes in a row."""
    return jnp.max(jnp.sum(jnp.abs(x), axis=1))
