"""Numerical pieces that the equations are written with: smooth sign, guarded norm, phi functions, integrators."""

from collections.abc import Callable, Iterable
from dataclasses import fields
from math import factorial
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

Scalar = Float[Array, ""]

# Type of a part's numbers: an array, alone or with batch axes; at run time anything, since JAX rebuilds pytrees
# around placeholders and a check of the type would refuse them.
if TYPE_CHECKING:
    Leaf = Array
else:
    Leaf = Any


_Class = TypeVar("_Class", bound=type)


def pytree(cls: _Class) -> _Class:
    """Registers a dataclass with JAX: its fields are children, those with the metadata `static` part of the structure.

    As `jax.tree_util.register_dataclass` does, which must not be used: up to jaxlib 0.10.2 two such classes whose
    fields have the same structure compare equal, so that where their hashes fall together, about once in thirty
    processes, `jit` runs the program compiled for the one on the numbers of the other.
    """
    static = tuple(f.name for f in fields(cls) if f.metadata.get("static"))
    names = tuple(f.name for f in fields(cls) if f.name not in static)
    keys = tuple(jax.tree_util.GetAttrKey(name) for name in names)

    def flatten(x: Any) -> tuple[tuple, tuple]:
        return tuple([getattr(x, name) for name in names]), tuple([getattr(x, name) for name in static])

    def with_keys(x: Any) -> tuple[tuple, tuple]:
        children, fixed = flatten(x)
        return tuple(zip(keys, children, strict=True)), fixed

    def unflatten(fixed: tuple, children: Iterable) -> Any:
        return cls(**dict(zip(names, children, strict=True)), **dict(zip(static, fixed, strict=True)))

    jax.tree_util.register_pytree_with_keys(cls, with_keys, unflatten, flatten)
    return cls


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


def norm(x: Float[Array, "..."]) -> Float[Array, ""]:
    """2-norm over all entries (Frobenius norm of a matrix), in the units of x; its gradient at x = 0 is set to 0."""
    return sqrt(jnp.sum(x * x))


def signed_root(x: Float[Array, "..."], width: Scalar) -> Float[Array, "..."]:
    """sign(x) |x|^(1/2) as x / (x^2 + width^2)^(1/4), whose slope at 0 is width^(-1/2); where width is 0, exact.

    The exact root's slope at 0, which has no value, is set to 0.
    """
    square = x * x + width * width
    at_zero = square == 0.0
    return jnp.where(at_zero, 0.0, x / jnp.sqrt(jnp.sqrt(jnp.where(at_zero, 1.0, square))))


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


def rk4(rate: Callable[[Scalar, Any], Any], t: Scalar, y: Any, dt: Scalar) -> Any:
    """State at t + dt by one step of the classical Runge-Kutta method of order 4.

    rate(t, y) returns dy/dt as a pytree like y; t, dt [s].
    """

    def ahead(slope: Any, step: Scalar) -> Any:
        return jax.tree.map(lambda y, k: y + step * k, y, slope)

    k1 = rate(t, y)
    k2 = rate(t + dt / 2, ahead(k1, dt / 2))
    k3 = rate(t + dt / 2, ahead(k2, dt / 2))
    k4 = rate(t + dt, ahead(k3, dt))
    return jax.tree.map(lambda y, a, b, c, d: y + dt / 6 * (a + 2 * (b + c) + d), y, k1, k2, k3, k4)


_TERMS = 15  # of the Taylor series at a norm of at most 1/2: the rest is below 2^-16 / 15!
_DOUBLINGS = 40  # norms up to 2^39
_FEW = 4  # of them


def phi_functions(x: Float[Array, "n n"], order: int, largest: Scalar | None = None) -> list[Float[Array, "n n"]]:
    """phi_0(x) = e^x and phi_1 .. phi_order, phi_k(x) = (phi_(k-1)(x) - I/(k-1)!) / x, of a square matrix [-].

    Scaling and doubling, phi_k(2x) = 2^-k (phi_0 phi_k + sum_(j=1..k) phi_j / (k-j)!) (Skaflestad and Wright, Applied
    Numerical Mathematics 59, 2009): nothing cancels for small x, eigenvalues may repeat, and no LAPACK is called, whose
    batched solves were seen to lock up when two of them shared a small thread pool. largest: `row_norm` of the largest
    of many matrices, which then take as many doublings as that one and no more.
    """
    one = jnp.eye(x.shape[-1], dtype=x.dtype)
    size = jax.lax.stop_gradient(row_norm(x) if largest is None else largest)
    doublings = jnp.clip(jnp.ceil(jnp.log2(jnp.maximum(size, 0.5))) + 1.0, 0.0, _DOUBLINGS)
    small = x * 2.0**-doublings
    top = one / float(factorial(order + _TERMS))
    for k in range(_TERMS - 1, -1, -1):
        top = one / float(factorial(order + k)) + small @ top
    phi = [top]
    for k in range(order - 1, -1, -1):
        phi.insert(0, one / factorial(k) + small @ phi[0])

    def step(k: Any, phi: list[Array]) -> list[Array]:
        return jax.lax.cond(k < doublings, _double, lambda phi: phi, phi)

    # a loop of fixed length can be run backwards; few matrices need more than the first doublings
    phi = jax.lax.fori_loop(0, _FEW, step, phi)
    return jax.lax.cond(
        doublings > _FEW, lambda phi: jax.lax.fori_loop(_FEW, _DOUBLINGS, step, phi), lambda phi: phi, phi
    )


def _double(phi: list[Array]) -> list[Array]:
    """phi_k(2x) from phi_k(x)."""
    return [
        (phi[0] @ phi[k] + sum((phi[j] / factorial(k - j) for j in range(1, k + 1)), 0.0 * phi[0])) / 2**k
        for k in range(len(phi))
    ]


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


class Decay(NamedTuple):
    """What one step of `etdrk4` needs of the linear part -A over a step dt: matrices (n, n) [- or s]."""

    half: Array  # e^(-A dt/2)
    full: Array  # e^(-A dt)
    stage: Array  # dt/2 phi_1(-A dt/2) [s]
    ends: tuple[Array, Array, Array]  # weights of the forcing at the start, the middle (twice) and the end [s]


def decay(a: Float[Array, "n n"], dt: Scalar, largest: Scalar | None = None) -> Decay:
    """Coefficients of Cox and Matthews, J. Comput. Phys. 176 (2002), eqs. (26)-(29), for m' = -A m + forcing.

    largest: `row_norm` of a dt for the largest of many steps that this one is among; see `phi_functions`.
    """
    halves = phi_functions(-a * dt / 2, 3, None if largest is None else largest / 2)
    half, phi_half, *_ = halves
    full, p1, p2, p3 = _double(halves)
    ends = (dt * (p1 - 3 * p2 + 4 * p3), dt * 2 * (p2 - 2 * p3), dt * (4 * p3 - p2))
    return Decay(half, full, dt / 2 * phi_half, ends)


def etdrk4(rate: Callable, linear: Decay, t: Scalar, y: Any, m: Float[Array, " n"], dt: Scalar) -> tuple:
    """One step of order 4 of y' = f(t, y, m), m' = -A m + g(t, y, m), exact in A: (y, m) at t + dt and stage outputs.

    rate(t, y, m) returns (f, g, aux). With A = 0 it is `rk4`; however stiff A is, the step stays stable and exact
    for a constant g. Returned besides: aux of the first and the third stage (start and middle of the step).
    """

    def ahead(slope: Any, step: Scalar) -> Any:
        return jax.tree.map(lambda y, k: y + step * k, y, slope)

    f1, g1, start = rate(t, y, m)
    m2 = linear.half @ m + linear.stage @ g1
    f2, g2, _ = rate(t + dt / 2, ahead(f1, dt / 2), m2)
    m3 = linear.half @ m + linear.stage @ g2
    f3, g3, middle = rate(t + dt / 2, ahead(f2, dt / 2), m3)
    m4 = linear.half @ m2 + linear.stage @ (2 * g3 - g1)
    f4, g4, _ = rate(t + dt, ahead(f3, dt), m4)
    w1, w2, w4 = linear.ends
    m_next = linear.full @ m + w1 @ g1 + w2 @ (g2 + g3) + w4 @ g4
    y_next = jax.tree.map(lambda y, a, b, c, d: y + dt / 6 * (a + 2 * (b + c) + d), y, f1, f2, f3, f4)
    return y_next, m_next, start, middle
