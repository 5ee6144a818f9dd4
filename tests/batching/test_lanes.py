"""`lanes.vmap` and `lanes.jvp` against `jax.vmap` and `jax.jvp`, for a table of functions."""

from contextlib import nullcontext
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from jax.flatten_util import ravel_pytree

from ptsmc_jax.batching import lanes
from tests.helpers import short

TRIALS = 5
scan, cond, while_loop, fori_loop = lax.scan, lax.cond, lax.while_loop, lax.fori_loop
einsum, tensordot, dot_general = jnp.einsum, jnp.tensordot, lax.dot_general


def draw(*shape, low=-2.0, high=2.0, seed=0, trials=TRIALS):
    """Return random numbers from `low` to `high`, (trials, *shape).

    All numbers differ, so that exchanged components are detected.
    """
    return jnp.asarray(np.random.default_rng([seed, *shape]).uniform(low, high, (trials, *shape)))


def integers(*shape, low=-9, high=10, dtype: Any = jnp.int64, seed=0):
    """Return random integers (TRIALS, *shape) from `low` to `high` - 1."""
    return jnp.asarray(np.random.default_rng([seed, *shape]).integers(low, high, (TRIALS, *shape)), dtype)


def agree(got, expected):
    """Check that structure, shapes and dtypes of two pytrees are equal, and numbers are equal up to rounding errors.

    The tolerance is 1e-14 of the largest number of an array. Sums in another order, multiply-adds and vectorised
    functions differ by a few eps. NaN and infinities must be at the same places.
    """
    assert jax.tree.structure(got) == jax.tree.structure(expected)
    for a, b in zip(jax.tree.leaves(got), jax.tree.leaves(expected), strict=True):
        assert (a.shape, a.dtype, a.weak_type) == (b.shape, b.dtype, b.weak_type)
        a, b = np.asarray(a), np.asarray(b)
        if not np.issubdtype(b.dtype, np.inexact):
            np.testing.assert_array_equal(a, b)
            continue
        finite = np.isfinite(b)
        np.testing.assert_array_equal(np.where(finite, 0, a), np.where(finite, 0, b))
        tolerance = 1e-14 if b.dtype in (np.float64, np.complex128) else 1e-6
        scale = np.abs(b[finite]).max(initial=0.0)
        assert np.abs(a[finite] - b[finite]).max(initial=0.0) <= tolerance * scale


def in_loop(function):
    """Return a function with equal results that calls `function` in a loop of one step.

    In a loop, lanes evaluate it by components.
    """

    def run(*args):
        results = lax.scan(lambda carry, _: (carry, function(*args)), 0, None, length=1)[1]
        return jax.tree.map(lambda v: v[0], results)

    return run


def check(function, *args, in_axes: Any = 0):
    """Assert that `lanes.vmap` and `jax.vmap` of a function have equal results; in_axes: as for `jax.vmap`."""
    mapped = lanes.vmap(function, in_axes), jax.vmap(function, in_axes)
    agree(*jax.jit(lambda *args: [one(*args) for one in mapped])(*args))  # one program compiles faster than two


TABLE = jnp.linspace(-1, 1, 12).reshape(3, 4)
FIXED = jnp.asarray([0.3, -0.7, 1.1])
X, Y, S, POSITIVE = draw(3), draw(3, seed=1), draw(), draw(3, low=0.1, high=0.9)
M, N = draw(3, 3), draw(3, 2)
MESH = jax.sharding.Mesh(np.asarray(jax.devices()[:1]), ("device",), axis_types=(jax.sharding.AxisType.Explicit,))
ALONE = jax.NamedSharding(MESH, jax.P())
K, J = integers(3), integers(3, low=1, seed=1)
U = integers(3, low=0, high=2**32, dtype=jnp.uint32)
F = X.astype(jnp.float32)
BYTES = integers(3, low=-128, high=128, dtype=jnp.int8)
CUBE = draw(2, 3, 4)
Q = draw(4)

# name: (function, arguments)
ELEMENTWISE: dict[str, tuple] = {
    "arithmetic with scalars": (lambda x, s: (2 * x + s, s * x - 1, x / s, -x, x % 0.3, s + 1), X, S),
    "arithmetic with constants": (lambda x: (x + FIXED, FIXED * x, FIXED / x, x**FIXED), POSITIVE),
    "matrix and scalar": (lambda m, s: (m * s, m + 1, jnp.maximum(m, s)), M, S),
    "exponentials": (lambda x: (jnp.exp(x), jnp.exp2(x), jnp.expm1(x), jnp.log(x), jnp.log1p(x)), POSITIVE),
    "logarithm of two": (jnp.log2, POSITIVE),
    "trigonometry": (lambda x: (lax.sin(x), lax.cos(x), lax.tan(x), lax.asin(x), lax.acos(x), lax.atan(x)), POSITIVE),
    "hyperbolics": (lambda x: (jnp.sinh(x), jnp.cosh(x), jnp.tanh(x), jnp.arcsinh(x), jnp.arctanh(x)), POSITIVE),
    "arccosh": (lambda x: jnp.arccosh(1 + x), POSITIVE),
    "two arguments": (lambda x, y: (jnp.arctan2(x, y), jnp.hypot(x, y), jnp.fmod(x, y), jnp.copysign(x, y)), X, Y),
    "powers": (lambda x: (x**2, x**3, x**-1, x**2.7, lax.sqrt(x), lax.rsqrt(x), lax.cbrt(x), lax.square(x)), POSITIVE),
    "power by the trial": (lambda x, y: x**y, POSITIVE, Y),
    "integer powers": (lambda i, x, j: (i**3, x**j, lax.integer_pow(i, 2)), K, X, J),
    "rounding": (lambda x: (jnp.floor(x), jnp.ceil(x), jnp.round(x), jnp.trunc(x), jnp.sign(x), jnp.abs(x)), X),
    "error function": (lambda x: (lax.erf(x), lax.erfc(x), lax.erf_inv(x)), POSITIVE),
    "logistic and gamma": (lambda x: (lax.logistic(x), lax.lgamma(x), lax.digamma(x)), POSITIVE),
    "nextafter": (lambda x, y: jnp.nextafter(x, y), X, Y),
    "comparisons": (lambda x, y: (x < y, x <= y, x > y, x >= y, x == x, x != y, x > 0), X, Y),
    "extremes": (lambda x, y: (jnp.maximum(x, y), jnp.minimum(x, 0.1), jnp.maximum(FIXED, y)), X, Y),
    "logic": (lambda x, y: ((x > 0) & (y > 0), (x > 0) | (y > 0), ~(x > 0), (x > 0) ^ (y > 0), jnp.isfinite(x)), X, Y),
    "NaN and infinity": (lambda x: (jnp.log(x), 1 / (x - x), jnp.sqrt(x), jnp.maximum(jnp.sqrt(x), 0)), X),
    "where": (lambda x, y, s: (jnp.where(x > y, x, y), jnp.where(s > 0, x, y), jnp.where(x > 0, x, 0.0)), X, Y, S),
    "where on a table": (lambda x: jnp.where(jnp.asarray([True, False, True]), x, FIXED), X),
    "select_n of three": (lambda x, y: lax.select_n(jnp.asarray([0, 1, 2]), x, y, x * y), X, Y),
    "select_n by the trial": (lambda i, x, y: lax.select_n(i % 3, x, y, FIXED), integers(3, dtype=jnp.int32), X, Y),
    "clip": (lambda x, s: (jnp.clip(x, -0.5, 0.5), jnp.clip(x, -abs(s), abs(s)), lax.clamp(-1.0, x, 0.0)), X, S),
    "clamp between arrays": (lambda x, y: lax.clamp(-jnp.abs(y), x, jnp.abs(y)), X, Y),
    "conversions": (lambda x, i: (x.astype(int), i.astype(float), x.astype(jnp.float32), (x > 0).astype(int)), X, K),
    "reduce_precision": (lambda x: lax.reduce_precision(x, 8, 10), X),
    "stop_gradient and copy": (lambda x: (lax.stop_gradient(x), jnp.copy(x), jnp.array(x)), X),
    "single precision": (lambda f: (f * 2.0 + 1, f @ f, jnp.sin(f), f / 3, jnp.where(f > 0, f, 0.0)), F),
    "complex": (lambda x, y: (lax.complex(x, y), abs(x + 1j * y), jnp.exp(1j * x).real, jnp.conj(1j * x)), X, Y),
    "scalars alone": (lambda s: (s, s * s, jnp.sin(s) + 1, s.astype(jnp.float32)), S),
    "reshard": (lambda x: 2.0 * jax.sharding.reshard(x, ALONE), X),
    "optimization_barrier": (lambda x, s: lax.optimization_barrier((x, s)), X, S),
}  # fmt: skip

INTEGERS: dict[str, tuple] = {
    "arithmetic": (lambda i, j: (i + j, i * j, i // j, i % j, lax.div(i, j), lax.rem(i, j), -i, abs(i)), K, J),
    "32 bits": (lambda i: (i + 1, i * 3, i // 2, i % 4, jnp.maximum(i, 0), jnp.sum(i)), K.astype(jnp.int32)),
    "8 bits wrap": (lambda i: (i * i, i + 100, i - 100), BYTES),
    "unsigned": (lambda u: (u + jnp.uint32(1), u * jnp.uint32(2654435761), u // 7, u % 10, u > 5), U),
    "bits": (lambda u: (u & 255, u | 15, u ^ jnp.uint32(0x1BD11BDA), ~u, lax.population_count(u), lax.clz(u)), U),
    "shifts": (lambda u, i: (u << 13, u >> 19, i >> 2, i << 3, lax.shift_right_logical(i, 60)), U, K),
    "shifts by the trial": (lambda u, i: u >> i.astype(jnp.uint32), U, jnp.abs(K)),
    "bitcast": (lambda u, x: (lax.bitcast_convert_type(u, jnp.int32), lax.bitcast_convert_type(x, jnp.int64)), U, X),
    "bitcast to smaller": (lambda x: lax.bitcast_convert_type(x, jnp.uint32), X),
    "bitcast to larger": (lambda u: lax.bitcast_convert_type(u, jnp.uint64), integers(3, 2, low=0, dtype=jnp.uint32)),
    "bitcast of a pair": (lambda x: lax.bitcast_convert_type(x, jnp.uint32), draw(2)),
}

STRUCTURE: dict[str, tuple] = {
    "reshape": (lambda m: (m.reshape(9), m.reshape(1, 9, 1), m.ravel(), m.reshape(3, 3, order="F")), M),
    "reshape by columns": (lambda n: (n.ravel(order="F"), n[None].reshape(2, 3, order="F")), N),
    "transpose": (lambda n: (n.T, jnp.swapaxes(n, 0, 1), jnp.moveaxis(n[None], 0, 2)), N),
    "transpose of three": (lambda t: jnp.transpose(t, (2, 0, 1)), CUBE),
    "concatenate": (lambda x, n: (jnp.concatenate([x, FIXED, x]), jnp.concatenate([n, n[:, :1]], axis=1)), X, N),
    "stack": (lambda x, y, s: (jnp.stack([x, y]), jnp.stack([x, FIXED], -1), jnp.stack([s, s * s, 1.0 * s])), X, Y, S),
    "append and hstack": (lambda x, s: (jnp.append(x, s), jnp.hstack([x, s]), jnp.vstack([x, x])), X, S),
    "slices": (lambda t: (t[1], t[:, 1:], t[..., -1], t[::2, ::-1], t[1:, 0, ::3], t[None], t[()]), CUBE),
    "rev": (lambda n: (n[::-1], n[:, ::-1], jnp.flip(n)), N),
    "broadcast": (lambda x, s: (jnp.broadcast_to(x, (2, 3)), jnp.full((2, 2), s), x[:, None] * jnp.ones((3, 2))), X, S),
    "squeeze": (lambda x: (jnp.squeeze(x[None, :, None]), jnp.squeeze(x[None, :, None], 0)), X),
    "pad": (lambda n, s: (jnp.pad(n, 1), lax.pad(n, s, ((1, 0, 1), (-1, 2, 0)))), N, S),
    "split": (lambda x: jnp.split(x, [1]), X),
    "tile and repeat": (lambda x: (jnp.tile(x, 2), jnp.repeat(x, 2), jnp.roll(x, 1)), X),
    "diagonals": (lambda x, m: (jnp.diag(x), jnp.diag(m), jnp.trace(m), jnp.tril(m)), X, M),
    "of booleans": (lambda x: ((x > 0)[::-1], jnp.stack([x > 0, x > 1])), X),
    "empty": (lambda x: (x[:0], jnp.concatenate([x[:0], x])), X),
    "empty sum": (lambda x: jnp.sum(x[:0]), X),
    "ravel_pytree": (lambda x, s: ravel_pytree({"a": x, "b": s})[0], X, S),
}  # fmt: skip

REDUCTIONS: dict[str, tuple] = {
    "sums": (lambda t: (t.sum(), t.sum(0), t.sum((0, 2)), t.sum(-1, keepdims=True), t.mean(1), t.var()), CUBE),
    "products": (lambda n: (n.prod(), n.prod(0), n.prod(1)), N),
    "extremes": (lambda n: (n.max(), n.max(0), n.min(1), jnp.ptp(n)), N),
    "extremes with NaN": (lambda x: (jnp.max(jnp.sqrt(x)), jnp.min(jnp.sqrt(x)), jnp.nanmax(jnp.sqrt(x))), X),
    "all and any": (lambda n: ((n > 0).all(), (n > 0).any(0), (n > 1).all(1)), N),
    "positions": (lambda n: (n.argmax(), n.argmin(1)), N),
    "of integers": (lambda i: (i.sum(), i.prod(), i.max(), (i > 0).sum(), jnp.bitwise_xor.reduce(i)), K),
    "of 8 bits": (lambda i: (i.sum(), jnp.sum(i, dtype=jnp.int8), i.max()), BYTES),
    "norms": (lambda x, m: (jnp.linalg.norm(x), jnp.linalg.norm(m), jnp.linalg.norm(m, axis=0)), X, M),
    "over no axis": (lambda x: (jnp.sum(x, axis=()), jnp.max(x, axis=())), X),
    "of a constant part": (lambda x: jnp.sum(jnp.concatenate([FIXED, x, FIXED])), X),
    "cumulative": (lambda n: (jnp.cumsum(n, 0), jnp.cumprod(n, 1), lax.cummax(n), jnp.diff(n, axis=0)), N),
}  # fmt: skip

CONTRACTIONS: dict[str, tuple] = {
    "matrix and vector": (lambda m, x: (m @ x, x @ m, x @ x, jnp.dot(m, x)), M, X),
    "matrices": (lambda m, n: (m @ m, m @ n, n.T @ m, n.T @ n), M, N),
    "with constants": (lambda x, m: (TABLE.T @ x, x @ TABLE, FIXED @ x, m @ TABLE, m @ FIXED), X, M),
    "row and column": (lambda x: (x[None, :] @ x[:, None], x[:, None] @ x[None, :]), X),
    "vdot and inner": (lambda x, y, m: (jnp.vdot(x, y), jnp.inner(m, m)), X, Y, M),
    "outer": (lambda x, y: (jnp.outer(x, y), x[:, None] * y[None, :]), X, Y),
    "tensordot": (lambda t, m: (tensordot(t, m, 1), tensordot(t, t, 3), tensordot(m, t, (0, 1))), draw(2, 3, 3), M),
    "tensordot over nothing": (lambda x, y: tensordot(x, y, 0), X, Y),
    "tensordot over nothing, unequal": (lambda x, n: tensordot(x, n, 0), X, N),
    "outer by einsum": (lambda x, n: einsum("i,jk->ijk", x, n), X, N),
    "outer by lax": (lambda x, y: dot_general(x, y, (((), ()), ((), ()))), X, Y),
    "product of scalars by lax": (lambda s: dot_general(s, s, (((), ()), ((), ()))), S),
    "einsum": (lambda m, x: (einsum("ij,j->i", m, x), einsum("ij,ij->", m, m), einsum("i,ij,j", x, m, x)), M, X),
    "einsum with batches": (lambda t, n: (einsum("bij,jb->bi", t, n), einsum("bij,bjk->bik", t, t)), draw(2, 3, 3), N),
    "two axes at once": (lambda t: dot_general(t, t, (((0, 2), (0, 2)), ((), ()))), CUBE),
    "axes in another order": (lambda t, u: dot_general(t, u, (((2, 0), (0, 1)), ((), ()))), CUBE, draw(4, 2, 5)),
    "cross": (lambda x, y: (jnp.cross(x, y), jnp.cross(FIXED, y)), X, Y),
    "kron": (lambda m: jnp.kron(m, m[:2, :2]), M),
    "integers": (lambda i: (i @ i, jnp.outer(i, i)), K),
    "8 bits summed in 32": (lambda i: lax.dot(i, i, preferred_element_type=jnp.int32), BYTES),
    "single summed in double": (lambda f: lax.dot(f, f, preferred_element_type=jnp.float64), F),
    "of booleans": (lambda x: (x > 0) @ (x > 0), X),
    "over a length of 0": (lambda n: n[:, :0] @ n[:0], draw(3, 3)),
    "matrix_power": (lambda m: jnp.linalg.matrix_power(m, 3), M),
}  # fmt: skip


def scanned(x, m, length=7, **options):
    """Scan x -> tanh(m x) + 0.1 k over k = 0 .. length - 1.

    Return the last x, and x, x[0] and k before each step. options: of `scan`.
    """
    return scan(lambda x, k: (jnp.tanh(m @ x) + 0.1 * k, (x, x[0], k)), x, jnp.arange(length), **options)


def scans_of_rows(x, rows):
    """Scan over the rows of a table {"a", "b"}; return the last carry and a dict of the outputs of all rows.

    The carry is x and a counter, which starts at 0.
    """

    def step(carry, row):
        total, count = carry
        return (total + row["a"] * jnp.sin(total), count + 1), {
            "sum": row["a"].sum(),
            "b": row["b"] * total,
            "n": count,
        }

    return scan(step, (x, 0), rows)


def nested(x, m):
    """Run a scan in each step of a scan; return the last vector and one number of each of the four steps."""

    def outer(x, k):
        inner, ys = scan(lambda y, j: (y + 0.1 * jnp.cos(x) * j, y @ x), x, jnp.arange(3))
        return jnp.sin(m @ inner) + k, ys.sum()

    return scan(outer, x, jnp.linspace(0, 1, 4))


def late(s):
    """Scan with carries that depend on each other in a chain; return the last carries and the carries before each step.

    The last carry depends on the trial from step 4 on.
    """
    one = jnp.ones(())
    return scan(lambda c, k: ((s, c[0], c[1] * 2, c[2] + k, c[4] + 1), c), (one, one, one, one, 0), jnp.arange(8))


def time_and_state(s):
    """Scan with a time, which does not depend on the trial, and a state, which does.

    Return the last time and state, and both before each step.
    """

    def step(carry, _):
        t, x = carry
        return (t + 0.1, x + jnp.exp(-t) * x), (t, x)

    return scan(step, (0.0, s), None, 6)


def late_in_call(x):
    """Scan with a dependence on the trial that passes through a jitted function and a checkpoint.

    Return both last carries, and both carries before each step.
    """
    double = jax.jit(lambda a, b: (a * 2, b + 1))
    halve = jax.checkpoint(lambda a: jnp.sin(a) / 2)
    return scan(lambda c, _: (double(*(halve(c[0]), c[1])), c), (x, jnp.zeros(3)), None, 3)


def swap(x):
    """Exchange a carry that differs by trial with a constant carry in each step of a scan.

    Return both last carries, and both carries before each step.
    """
    return scan(lambda c, _: ((c[1], c[0]), c), (x, FIXED), None, 3)


def used_in_a_loop_and_after(x, m):
    """Use the same matrix m in a loop and after it; return a vector."""
    x = fori_loop(0, 3, lambda k, x: jnp.tanh(m @ x), x)
    return m @ x


def made_used_in_a_loop_and_after(x, y):
    """Use the same computed value in a loop and after it; return two vectors."""
    made = x * y  # computed as components, but sort needs the array
    total = fori_loop(0, 3, lambda k, t: t + jnp.sort(made), x)
    return total, jnp.sort(made) * made


def used_in_two_loops(x, m):
    """Use the same matrix m in two loops, one after the other; return a vector."""
    x = fori_loop(0, 3, lambda k, x: jnp.tanh(m @ x), x)
    return fori_loop(0, 2, lambda k, x: jnp.sin(m @ x), x)


def used_in_an_inner_loop_and_after(x, m):
    """Use the same matrix m in an inner loop and after it, in each step of a scan.

    Return the last vector, and the vector of each step.
    """

    def outer(x, _):
        x = fori_loop(0, 2, lambda k, x: jnp.tanh(m @ x), x)
        return m @ x, x

    return scan(outer, x, None, 3)


def stepping(a, s):
    """Increase numbers `a` until their sum reaches a limit that depends on s; return them and the number of steps."""
    return while_loop(
        lambda c: jnp.sum(c[0]) < 3 + jnp.sin(s), lambda c: (c[0] + 0.7 * jnp.abs(s) + 0.1, c[1] + 1), (a, 0)
    )


LOOPS: dict[str, tuple] = {
    "argument used in a loop and after": (used_in_a_loop_and_after, X, M),
    "value used in a loop and after": (made_used_in_a_loop_and_after, X, Y),
    "argument used in two loops": (used_in_two_loops, X, M),
    "argument used in an inner loop and after": (used_in_an_inner_loop_and_after, X, M),
    "scan": (scanned, X, M),
    "scan backwards": (partial(scanned, reverse=True), X, M),
    "scan unrolled": (partial(scanned, unroll=3), X, M),
    "scan of length 0": (partial(scanned, length=0), X, M),
    "scan over rows": (scans_of_rows, X, {"a": draw(6, 3), "b": draw(6)}),
    "scan over rows backwards": (lambda r: scan(lambda c, y: (c / 2 + y, c), FIXED, r, reverse=True), draw(6, 3)),
    "scan over rows of a table": (lambda x: scan(lambda c, r: (c + r * c, c @ r), x, TABLE.T), X),
    "scan nested": (nested, X, M),
    "scan, late dependence": (late, S),
    "scan, swapped carries": (swap, X),
    "scan, late dependence in a call": (late_in_call, X),
    "scan with a time that is shared": (time_and_state, S),
    "scan, output of the constant only": (lambda s: scan(lambda c, k: (c, (k * 2, s)), 0, jnp.arange(4)), S),
    "scan of matrices": (lambda m: scan(lambda c, _: (c @ m / 3, c.T), m, None, 4), M),
    "scan of integers and booleans": (lambda i: scan(lambda c, _: ((c[0] + 1, ~c[1]), c), (i, i > 0), None, 3), K),
    "scan in single precision": (lambda f: scan(lambda c, _: (c * 1.5, c), f, None, 3), F),
    "scan with an empty carry": (lambda x: scan(lambda c, r: (c, r * 2), (), x), X),
    "scan of an empty array": (lambda x: scan(lambda c, _: ((c[0] + 1, c[1] * 2), c[0][0]), (x, x[:0]), None, 3), X),
    "map": (lambda x: lax.map(lambda r: jnp.sin(r) * x, x), X),
    "associative_scan": (lambda x: lax.associative_scan(jnp.multiply, x), X),
    "fori_loop": (lambda x: fori_loop(0, 5, lambda k, x: jnp.cos(x) + k, x), X),
    "fori_loop by trial": (lambda x, i: fori_loop(0, jnp.abs(i), lambda k, x: jnp.cos(x) + k, x), X, integers()),
    "while, uniform": (lambda x: while_loop(lambda c: c[0] < 4, lambda c: (c[0] + 1, jnp.sin(c[1])), (0, x)), X),
    "while, by trial": (lambda s: while_loop(lambda c: c[1] < 3, lambda c: (c[0] + 1, c[1] + 0.7), (0, s)), S),
    "while, by row": (jax.vmap(stepping, (0, None)), X, S),
    "while, by row of a table": (lambda s: jax.vmap(stepping, (0, None))(TABLE, s), S),
    "while, by row, shared": (lambda x: x * jnp.sum(jax.vmap(stepping, (0, None))(FIXED, 0.5)[1]), X),
    "while in a scan": (lambda s: scan(lambda c, _: (while_loop(lambda v: v > 1, jnp.sin, c * 3), c), s, None, 5), S),
}  # fmt: skip

BRANCHES: dict[str, tuple] = {
    "cond, uniform": (lambda x: cond(FIXED[0] > 0, jnp.sin, jnp.cos, x), X),
    "cond, by the trial": (lambda x, s: cond(s > 0, lambda x: (jnp.sin(x), x[0]), lambda x: (x * 2, s), x), X, S),
    "switch, uniform": (lambda x: lax.switch(jnp.int32(1), [jnp.sin, jnp.cos, jnp.tan], x), X),
    "switch, by the trial": (lambda x, i: lax.switch(i, [jnp.sin, jnp.cos, jnp.exp], x), X, integers(low=-1, high=4)),
    "cond in a scan by its counter": (lambda x: scan(lambda c, k: (cond(k > 0, jnp.sin, jnp.exp, c), c), x, FIXED), X),
    "cond in a scan by trial": (lambda x: scan(lambda c, _: (cond(c[0] > 0, jnp.sin, jnp.exp, c), c), x, None, 4), X),
    "scan in a cond": (lambda s: cond(s > 0, lambda s: fori_loop(0, 3, lambda k, v: v * s, s), jnp.cos, s), S),
    "clamped cond with no operands": (lambda s: cond(s > 0, lambda: 1.0, lambda: 2.0), S),
}  # fmt: skip


@jax.custom_jvp
def cubed(x):
    """Return x^3 with a wrong custom derivative, see `_cubed_jvp`."""
    return x**3


@cubed.defjvp
def _cubed_jvp(primals, tangents):
    """Return x^3 and a wrong tangent, 100 x dx; primals: (x,), tangents: (dx,)."""
    return cubed(*primals), 100.0 * tangents[0] * primals[0]  # a wrong derivative on purpose, to detect its use


@jax.custom_vjp
def squared(x):
    """Return x^2 with a wrong custom gradient, 50 x."""
    return x * x


squared.defvjp(lambda x: (x * x, x), lambda x, g: (50.0 * x * g,))

SYMMETRIC = lambda m: m + m.T + 10 * jnp.eye(3)  # noqa: E731

OTHERS: dict[str, tuple] = {
    "jit inside": (lambda x, m: jax.jit(lambda a: (m @ a, jnp.sin(a)))(x), X, M),
    "vmap inside": (lambda x, n: jax.vmap(lambda a, row: a * row, (0, 0))(x, n), X, N),
    "grad inside": (lambda x, m: jax.grad(lambda a: jnp.sum(jnp.tanh(m @ a) ** 2))(x), X, M),
    "jacfwd inside": (lambda x: jax.jacfwd(lambda a: jnp.outer(a, jnp.sin(a)))(x), X),
    "hessian inside": (lambda x: jax.hessian(lambda a: jnp.prod(jnp.sin(a)))(x), X),
    "grad of a scan inside": (lambda x, m: jax.grad(lambda a: scanned(a, m)[0].sum())(x), X, M),
    "checkpoint": (lambda x: jax.grad(lambda a: jax.checkpoint(lambda b: jnp.sum(jnp.sin(jnp.sin(b))))(a))(x), X),
    "custom_jvp": (lambda x: (cubed(x), jax.jacfwd(cubed)(x), jax.nn.relu(x), jax.nn.softplus(x)), X),
    "custom_vjp": (lambda x: (squared(x), jax.grad(lambda a: squared(a).sum())(x)), X),
    "logsumexp and softmax": (lambda x: (jax.nn.logsumexp(x), jax.nn.softmax(x)), X),
    "gather": (lambda x, i: (x[i % 3], TABLE[i % 3], x[jnp.asarray([2, 0])], jnp.take(x, 1)), X, integers()),
    "gather of a constant": (lambda i: TABLE[i % 3, 1], K),
    "dynamic_slice": (lambda x, i: [lax.dynamic_slice(v, (i % 2,), (2,)) for v in (x, FIXED)], X, integers()),
    "dynamic_slice at a constant": (lambda x: lax.dynamic_slice(x, (jnp.int32(1),), (2,)), X),
    "scatter": (lambda x, i, s: x.at[i % 3].set(s), X, integers(), S),
    "scatter to a constant place": (lambda x, s: x.at[0].add(s), X, S),
    "scatter over a slice": (lambda x: x.at[1:].multiply(2), X),
    "scatter into a constant": (lambda i, s: FIXED.at[i % 3].set(s), integers(), S),
    "sort": (lambda x, n: (jnp.sort(x), jnp.argsort(x), jnp.sort(n, axis=0), jnp.median(x), lax.top_k(x, 2)), X, N),
    "sort of pairs": (lambda x, y: lax.sort((x, y), num_keys=1), X, Y),
    "searchsorted and interp": (lambda s: (jnp.searchsorted(FIXED[::-1], s), jnp.interp(s, jnp.arange(3.0), FIXED)), S),
    "solve": (lambda m, x: jnp.linalg.solve(SYMMETRIC(m), x), M, X),
    "inverse and determinant": (lambda m: (jnp.linalg.inv(SYMMETRIC(m)), jnp.linalg.det(m)), M),
    "cholesky and eigh": (lambda m: (jnp.linalg.cholesky(SYMMETRIC(m)), jnp.linalg.eigvalsh(SYMMETRIC(m))), M),
    "solve with a constant matrix": (lambda x: jnp.linalg.solve(SYMMETRIC(TABLE[:, :3]), x), X),
    "svd": (lambda m: jnp.linalg.svd(m, compute_uv=False), M),
    "fft": (lambda x: jnp.abs(jnp.fft.fft(x)), X),
    "convolve": (lambda x: jnp.convolve(x, FIXED), X),
    "polyval": (lambda s: jnp.polyval(FIXED, s), S),
    "large array": (lambda t, s: (t * s, t.sum(0), t @ t.T, jnp.where(t > 0, t, s)), draw(9, 8), S),
    "large table made small": (lambda s: (s * jnp.arange(100.0))[::40], S),
    "large carry": (lambda t: scan(lambda c, _: (jnp.sin(c), c[0]), t, None, 3), draw(70)),
    "large table, small state": (lambda x: (jnp.ones((100, 3)) @ x, jnp.concatenate([jnp.zeros(80), x])), X),
    "random numbers": (lambda i: jax.random.normal(jax.random.key(i), (3,)), integers(low=0)),
}  # fmt: skip

OUTPUTS: dict[str, tuple] = {
    "outputs that do not depend on the trial": (lambda x: (1.0, FIXED, jnp.arange(3), x[0]), X),
    "Python numbers": (lambda x: (1, 2.5, True, np.float32(3), x), X),
    "the input itself": (lambda x: x, X),
    "the same output twice": (lambda x: (x * 2, x * 2, [x, x]), X),
    "None and pytrees": (lambda x: {"a": None, "b": (x, [x + 1]), "c": ()}, X),
    "an argument that is not used": (lambda x, y: y, X, Y),
    "pytrees": (lambda tree: jax.tree.map(jnp.sin, tree), {"a": X, "b": (S, None, [M])}),
    "integers and booleans": (lambda i, b: (i, b, jnp.where(b, i, 0)), K, X > 0),
}

CASES = {
    f"{group}: {name}": row
    for group, table in {
        "elementwise": ELEMENTWISE, "integers": INTEGERS, "structure": STRUCTURE, "reductions": REDUCTIONS,
        "contractions": CONTRACTIONS, "loops": LOOPS, "branches": BRANCHES, "others": OTHERS, "outputs": OUTPUTS,
    }.items()
    for name, row in table.items()
}  # fmt: skip


# functions with primitives without a rule
WITHOUT_RULE = {
    f"others: {name}"
    for name in (
        "custom_vjp", "solve", "inverse and determinant", "cholesky and eigh", "solve with a constant matrix", "svd",
        "fft", "convolve", "random numbers",
    )
}  # fmt: skip


@cache
def mapped(group):
    """Return {name: results of `jax.vmap`, of lanes and of lanes in a loop} for the functions of a group.

    One compiled program computes all of them.
    """
    rows = {name: row for name, row in CASES.items() if name.startswith(f"{group}: ")}

    @jax.jit
    def both(args):
        found = {}
        for name, (function, *_) in rows.items():
            has_rules = name not in WITHOUT_RULE
            with pytest.warns(lanes.LanesWarning, match="no rule") if not has_rules else nullcontext():
                mapped = jax.vmap(function), lanes.vmap(function), lanes.vmap(in_loop(function))
                found[name] = [one(*args[name]) for one in mapped]
        return found

    return both({name: tuple(args) for name, (_, *args) in rows.items()})


@pytest.mark.parametrize("name", CASES)
def test_lanes_vmap_equals_jax_vmap(name):
    """The results agree outside and inside a loop.

    Only functions with a primitive without a rule cause a warning, which pytest would raise as an error otherwise.
    """
    expected, outside_loops, inside_loop = mapped(name.split(":")[0])[name]
    agree(outside_loops, expected)
    agree(inside_loop, expected)


def is_floating(tree):
    """Return whether all leaves of a pytree are floating-point numbers."""
    return all(jnp.issubdtype(jnp.result_type(leaf), jnp.floating) for leaf in jax.tree.leaves(tree))


# The directions of all arguments differ by trial. In a second case the first argument and its directions are shared by
# all trials, so that some tangents differ by direction only.
DIFFERENTIABLE = [
    name
    for name, (_, *args) in CASES.items()
    if any(map(is_floating, args)) and not any(none in name for none in ("vjp", "nextafter"))
]
SHARED = [name for name in DIFFERENTIABLE if len(CASES[name]) > 2 and is_floating(CASES[name][1])]
JVP_CASES = [(name, shared) for shared, names in ((False, DIFFERENTIABLE), (True, SHARED)) for name in names]
# Derivatives use the same rules as values, so that the short tests have one row for each kind of rule.
SHORT_ROWS = {
    "elementwise": (
        "arithmetic with constants", "matrix and scalar", "powers", "where", "select_n by the trial", "clip",
        "NaN and infinity", "single precision", "stop_gradient and copy",
    ),
    "contractions": ("with constants", "tensordot over nothing", "einsum with batches", "axes in another order"),
    "others": (
        "vmap inside", "grad of a scan inside", "custom_jvp", "gather", "dynamic_slice", "scatter",
        "scatter to a constant place", "sort", "searchsorted and interp", "solve", "large array", "large carry",
        "large table made small", "random numbers",
    ),
}  # fmt: skip
# long tests if shared
SHARED_LONG = (
    "scan backwards",
    "scan unrolled",
    "scan of length 0",
    "argument used in two loops",
)


def is_short(name, shared):
    """Return whether a row of `CASES` is in the short tests of derivatives.

    shared: whether all trials share its first argument.
    """
    group, _, row = name.partition(": ")
    is_included = not shared or (group in ("loops", "branches", "contractions") and row not in SHARED_LONG)
    return is_included and row in SHORT_ROWS.get(group, (row,))


def jvp_by_lanes_and_jax(name, shared):
    """Return a function and its arguments; it returns the tangents along two directions by lanes and by JAX.

    name: of a row of `CASES`. shared: whether all trials share its first argument.
    """
    function, *args = CASES[name]
    args = [jax.tree.map(lambda v: v[0], args[0]), *args[1:]] if shared else args
    axes = (None, *(0 for _ in args[1:])) if shared else tuple(0 for _ in args)

    def numbers(*args):
        return [leaf for leaf in jax.tree.leaves(function(*args)) if is_floating(leaf)]

    def direction(leaf):
        rng = np.random.default_rng([3, *leaf.shape])
        return jnp.asarray(rng.uniform(-1, 1, (2, *leaf.shape)), leaf.dtype)

    directions = tuple(jax.tree.map(direction, arg) if is_floating(arg) else None for arg in args)
    moving = [k for k, along in enumerate(directions) if along is not None]

    def one(along, *one):
        def of_moving(*some):
            return numbers(*(dict(enumerate(one)) | dict(zip(moving, some, strict=True))).values())

        return jax.jvp(of_moving, tuple(one[k] for k in moving), along)

    some = tuple(directions[k] for k in moving)
    in_axes = (tuple(None if shared and k == 0 else 0 for k in moving), *axes)

    def both(args, directions, some):
        expected = jax.vmap(lambda along: jax.vmap(one, in_axes)(along, *args), out_axes=(None, 0))(some)
        return lanes.jvp(in_loop(numbers), axes)(args, directions), expected

    return both, (tuple(args), directions, some)


@cache
def tangents(group, shared, short_rows):
    """Return {name: (tangents by lanes, tangents by JAX)} for functions of a group, from one program.

    shared: whether all trials share the first argument. short_rows: whether they are the functions of the short tests
    or the others.
    """
    names = [name for name in CASES if name.startswith(f"{group}: ") and is_short(name, shared) == short_rows]
    names = [name for name in names if (name, shared) in JVP_CASES]
    cases = {name: jvp_by_lanes_and_jax(name, shared) for name in names}
    return jax.jit(lambda args: {name: both(*args[name]) for name, (both, _) in cases.items()})(
        {name: args for name, (_, args) in cases.items()}
    )


@pytest.mark.parametrize(("name", "shared"), short(JVP_CASES, [case for case in JVP_CASES if is_short(*case)]))
@pytest.mark.filterwarnings("ignore::ptsmc_jax.batching.lanes.LanesWarning")
def test_lanes_jvp_equals_jax_jvp(name, shared):
    """The tolerance is 1e-12 of the largest number, since the order of sums differs."""
    got, expected = tangents(name.split(":")[0], shared, is_short(name, shared))[name]
    for a, b in zip(jax.tree.leaves(got), jax.tree.leaves(expected), strict=True):
        assert (a.shape, a.dtype) == (b.shape, b.dtype)
        tolerance = 1e-12 if b.dtype == np.float64 else 1e-5
        np.testing.assert_allclose(
            a, b, rtol=0, atol=tolerance * np.abs(np.nan_to_num(np.asarray(b), posinf=0, neginf=0)).max(initial=0)
        )


@pytest.mark.parametrize("name", sorted(WITHOUT_RULE))
def test_lanes_warn_of_primitives_without_a_rule(name):
    function, *args = CASES[name]
    with pytest.warns(lanes.LanesWarning, match="lanes have no rule for the primitive `"):
        jax.eval_shape(lanes.vmap(in_loop(function)), *args)
