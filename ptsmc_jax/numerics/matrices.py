"""Linear algebra of small matrices by elementwise arithmetic, for use inside loops, where LAPACK calls are slow."""

from itertools import combinations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ptsmc_jax.numerics.guards import norm


def solve(a: Float[Array, "n n"], b: Float[Array, "n ..."]) -> Float[Array, "n ..."]:
    """Solve a x = b by Gauss-Jordan elimination with partial pivoting; b is (n,) or (n, columns).

    If the matrix is singular, the result is not finite.
    """
    return _eliminate(a, b)[0]


def determinant(a: Float[Array, "n n"]) -> Float[Array, ""]:
    """Return the determinant by Gauss-Jordan elimination."""
    _, product = _eliminate(a, jnp.zeros_like(a[:, 0]))
    return jnp.where(jnp.isfinite(product), product, 0.0)  # not finite if a column has no pivot


@jax.jit
def _eliminate(a: Array, b: Array) -> tuple[Array, Array]:
    """Return a^-1 b and the determinant of a."""
    n = a.shape[0]
    sizes = [jnp.where(size > 0.0, size, 1.0) for size in map(norm, a)]
    scales = [1.0 / size for size in sizes]
    rows = [a[i] * scales[i] for i in range(n)]
    right = [b[i] * scales[i] for i in range(n)]
    determinant = jnp.prod(jnp.stack(sizes))
    for k in range(n):
        for i in range(k + 1, n):  # move the row with the largest entry of column k to row k
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


SWEEPS = 8  # Jacobi sweeps over all pairs of axes; 5 or 6 reach full precision, as the convergence is quadratic


@jax.jit
def smallest_eigenvalue(a: Float[Array, "n n"]) -> Float[Array, ""]:
    """Return the smallest eigenvalue of a symmetric matrix by Jacobi rotations, in the units of the matrix.

    Each rotation makes one pair of off-diagonal entries zero (Golub and Van Loan, Matrix Computations, 2013, 8.5).
    Unlike the closed form for 3 x 3 matrices, the method is accurate for equal eigenvalues.
    """

    def rotate_all_pairs(_: Array | int, a: Array) -> Array:  # the index is an int under `jax.disable_jit`
        for p, q in combinations(range(a.shape[0]), 2):
            a = _rotate_pair(a, p, q)
        return a

    return jnp.min(jnp.diagonal(jax.lax.fori_loop(0, SWEEPS, rotate_all_pairs, a)))


def _rotate_pair(a: Array, p: int, q: int) -> Array:
    """Return R' a R, where R rotates axes p and q by at most 45 degrees so that entry (p, q) becomes zero."""
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
    """Return the infinity norm, the largest sum of magnitudes in a row."""
    return jnp.max(jnp.sum(jnp.abs(x), axis=1))
