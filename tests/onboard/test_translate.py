"""Functions of arrays in C equal those in JAX; operations without a counterpart in C raise an error with their line."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.special

from ptsmc_jax.numerics import attitude, draws, elementary, guards, matrices
from ptsmc_jax.onboard.fields import struct_fields
from ptsmc_jax.onboard.translate import NoRuleError
from tests.onboard.compiled import body, both, needs_compiler

X = np.array([0.3, -1.2, 0.7])
POSITIVE = np.array([0.3, 1.2, 2.7])
MATRIX = np.array([[2.0, 0.3, -0.1], [0.3, 1.5, 0.2], [0.0, 0.2, 1.1]])


def counted(x):
    """Return the result of a loop with 30 passes, an array like x."""
    return jax.lax.fori_loop(0, 30, lambda k, y: 0.9 * y + jnp.sin(x) / (k + 1.0), x)


def scanned(x):
    """Return the last carry (3,) and the outputs (20, 3) of a scan over the rows of two tables; x: (3,)."""

    def step(total, row):
        return total + row[0] * x, total * row[1]

    return jax.lax.scan(step, jnp.zeros(3), (jnp.linspace(0.0, 1.0, 20), jnp.linspace(1.0, 2.0, 20)))


def backwards(x):
    """Return the last carry and all outputs of a scan from the last row of a table of 20 numbers to the first."""
    return jax.lax.scan(lambda c, row: (c * 0.5 + row, c), x, jnp.linspace(0.0, 1.0, 20), reverse=True)


def until(x):
    """Return x scaled by a while loop until |x|^2 is at most 1e-3."""
    return jax.lax.while_loop(lambda y: jnp.sum(y * y) > 1e-3, lambda y: 0.7 * y, x)


def branched(x):
    """Return an array like x and a number from one of two branches, chosen by the sign of x[0]."""
    return jax.lax.cond(x[0] > 0.0, lambda: (jnp.cos(x), x[1]), lambda: (jnp.sin(x), x[2]))


def switched(x):
    """Return an array like x from one of four branches, chosen by an index from x[0]."""
    return jax.lax.switch(jnp.int32(3.0 * x[0] + 1.5), [lambda: x, lambda: 2.0 * x, lambda: x**2, lambda: x[::-1]])


def tabled(x):
    """Return a number, interpolated in a table at x[0]."""
    return jnp.interp(x[0], jnp.linspace(-1.0, 1.0, 5), jnp.asarray([1.0, 3.0, 2.0, -1.0, 0.5]))


@jax.custom_jvp
def log(x):
    """Return log(x + 1) by a custom function that has the same name as a function of C."""
    return jnp.log(x + 1.0)


log.defjvps(lambda t, _, x: t / (x + 1.0))

FUNCTIONS = {
    "elementary": (lambda x: (jnp.sin(x) * jnp.cos(x) + jnp.tan(x), jnp.exp(x), jnp.tanh(x), jnp.arctan(x)), X),
    "slopes of tanh": (lambda x: jax.jvp(jnp.tanh, (x,), (jnp.ones_like(x),)), POSITIVE),
    "roots": (lambda x: (jnp.sqrt(x), jnp.cbrt(x), jnp.log(x), jnp.log1p(x), jnp.log2(x), jnp.expm1(-x), x**0.3),
        POSITIVE),
    "signs": (lambda x: (jnp.sign(x), jnp.abs(x), jnp.floor(x), jnp.ceil(x), jnp.round(2.0 * x), -x), X),
    "negative zeros": (lambda x: (1.0 / jnp.where(x > 0.0, -0.0, 0.0), x + -0.0), X),
    "zero times infinity": (lambda x: (0.0 * jnp.exp(x), 0.0 * x, 0.0 / (x - 1.0), x * 0.0), np.array([1.0, 800.0])),
    "powers": (lambda x: (x**2, x**3, x**5, x**-1, x**-2, 1.0 / x, x**7), X),
    "limits": (lambda x: (jnp.clip(x, -0.5, 0.5), jnp.maximum(x, 0.1), jnp.minimum(x, x[::-1])), X),
    "comparisons": (lambda x: jnp.where((x > 0.0) & ~(x == 0.7) | (x < -1.0), x, 2.0 * x), X),
    "products": (lambda x, m: (m @ x, x @ m @ x, m @ m, jnp.outer(x, x), jnp.cross(x, m[0]), m.T @ x), X, MATRIX),
    "reductions": (lambda m: (m.sum(), m.max(axis=0), m.min(axis=1), m.prod(), jnp.cumsum(m, axis=1)), MATRIX),
    "moved": (lambda m: (m[1], m[:, ::-1], jnp.roll(m, 1), jnp.concatenate([m[0], m[2]]), m.reshape(-1)[3:7]), MATRIX),
    "read by columns": (lambda m: (m.ravel(order="F"), m[:2].reshape(2, 3, order="F")), MATRIX),
    "places": (lambda x, m: (jnp.argmax(x), x.at[1].set(4.0), m[:, 2], jnp.pad(x, 1)), X, MATRIX),
    "whole numbers": (lambda k, x: (x * k, k // 2 + 1, jnp.where(k % 3 == 1, x, -x)), np.int32(7), X),
    "unsigned ones by 0": (lambda k, x: jax.lax.div(k.astype(jnp.uint32), jnp.uint32(k - 7)) * x, np.int32(7), X),
    "whole numbers by 0": (lambda k, x: (jax.lax.div(k, k - 7) * x, jax.lax.rem(k, k - 7) * x), np.int32(7), X),
    "set beyond the end": (
        lambda k, x: (x.at[k].set(5.0), x.at[k - 10].set(5.0), x.at[k - 6].set(5.0), x[k], x[k - 20]), np.int32(7),
        X),
    "added at places": (lambda k, x, m: (x.at[1].add(4.0), x.at[k].add(x[0]), x.at[k + 1].add(x[0]),
        x.at[k - 9].add(1.0), x.at[jnp.asarray([0, 2, 0])].add(x * 1e-9), x.at[1:].add(x[:2]), x.at[::-1].add(x),
        m.at[k].add(x), m.at[:, k].add(1.0), m.at[k, 1].add(x[2]), m.at[0].add(jnp.ones((2, 3)).sum(0)),
        x.at[1].subtract(x[2]), (jnp.zeros(3, int).at[k].add(k)) * 1.0,
        jax.grad(lambda y: jnp.sum(jnp.sin(y[1:]) * y[:2]))(x)), np.int32(2), X, MATRIX),
    "powers of whole numbers": (lambda k, x: (k**2 * x, k**3 * x, (k * 10) ** 5 * x, (-k) ** 7 * x, k**0 * x),
        np.int64(7), X),
    "taken beyond the end": (lambda k, x: ([jnp.take(x, place) for place in (k, k - 5, k - 8, k - 11)],
        [x.at[place].get(mode="fill", fill_value=1.0) for place in (k, k - 6, k - 9, k - 11)],
        jnp.arange(3).at[k].get(mode="fill") * x, (x > 0.0).at[k].get(mode="fill") * x,
        jnp.take(jnp.outer(x, x), k, axis=0, fill_value=2), jnp.take(jnp.asarray([True, False]), k),
        x.at[k].get(mode="clip")), np.int32(7), X),
    "a logarithm of one's own": (lambda x: (log(x), elementary.log(x)), POSITIVE),
    "truths multiplied": (lambda x: jnp.where((x > 0.0) @ (x < 1.0) == (x > 0.0), x, 2.0 * x), X),
    "either and both": (lambda x: jnp.where((x > 0.5) | (x < 0.5) & (x > -1.0), x, 2.0 * x), X),
    "whole numbers of 64 bits": (lambda k, x: (jnp.maximum(k * 4_000_000_000, 5) * x,
        jnp.minimum(-k * 4_000_000_000, 5) * x, jnp.abs(-k * 4_000_000_000) * x,
        (jnp.where(k > 3, 100_000, 70_000) * jnp.where(k > 4, 80_000, -90_000)) * x,
        (jnp.where(k < 3, 100_000, 70_000) * jnp.where(k < 4, 80_000, -90_000)) * x, (k // 3) * x,
        jnp.mod(-k, 3) * x, jnp.take(jnp.asarray([5, 6]), k) * 1e-15 * x), np.int64(7), X),
    "whole numbers without a sign": (lambda k, x: (jnp.maximum(k * jnp.uint32(500_000_000), jnp.uint32(5)) * x,
        ((k * jnp.uint32(2_654_435_761)) % jnp.uint32(1000)) * x,
        (k * jnp.uint32(2_654_435_761) >= jnp.uint32(5)) * x,
        (jnp.where(k > 3, jnp.uint32(5), jnp.uint32(7)) - jnp.where(k > 4, jnp.uint32(8), jnp.uint32(9))) * x,
        (k - jnp.uint32(9)) * x), np.uint32(7), X),
    "whole parts beyond their type": (lambda x: ((1e10 * x).astype(jnp.int32), (1e20 * x).astype(jnp.int64) * 1.0,
        (1e4 * x).astype(jnp.uint32), (1e10 * x).astype(jnp.uint32), jnp.sqrt(x).astype(jnp.int32),
        (x / (x - x)).astype(jnp.int32), (9.0 * x).astype(int) * 1.0), X),
    "what is no number": (lambda x: (jnp.clip(jnp.sqrt(x), -0.5, 0.5), jnp.maximum(jnp.sqrt(x), 0.1),
        jnp.minimum(0.1, jnp.sqrt(x)), jnp.max(jnp.sqrt(x)), jnp.min(jnp.sqrt(x)), jnp.sign(jnp.sqrt(x))), X),
    "random words": (
        lambda k: tuple(draws.threefry(draws.Key(k, k + jnp.uint32(9)), (jnp.uint32(4_000_000_000), k))),
        np.uint32(7)),
    "random numbers": (lambda k: (draws.uniforms(draws.stream(k, 3, "a"), 3, k),
        draws.normals(draws.stream(5, k, "b"), 5, k - 8), draws.streams(k, 2, ["c", "d"])[1].b), np.uint32(7)),
    "inverse of erf": (lambda x: jax.lax.erf_inv(x), np.array([-0.9, -0.3, -1e-9, 0.0, 1e-5, 0.49, 0.51, 0.99])),
    "counted loop": (counted, X),
    "loop over a table": (scanned, X),
    "loop backwards": (backwards, X),
    "loop without steps": (
        lambda x: jnp.concatenate([jax.lax.scan(lambda c, r: (c * r, c), x, jnp.zeros(0))[1], x[None]]), X),
    "short loop over numbers": (lambda x: jnp.polyval(jnp.asarray([1.0, 2.0, 3.0]), x), X),
    "loop until": (until, X),
    "loops until, row by row": (jax.vmap(until), MATRIX),
    "branch": (branched, X),
    "branches": (switched, X),
    "table": (tabled, X),
    "solve": (lambda m, x: (matrices.solve(m, x), matrices.determinant(m)), MATRIX, X),
    "attitudes": (lambda x: attitude.from_rotation_vector(x), X),
    "small attitudes": (lambda x: attitude.from_rotation_vector(1e-5 * x), X),
    "logarithm written out": (lambda x: (elementary.log(x), elementary.arctan2(x[0], x[1])), POSITIVE),
    "guarded": (lambda x, b: (guards.norm(x), guards.signed_power(x, b), guards.smooth_sign(x, b)), X, np.float64(0.4)),
    "derivatives": (lambda x: jax.jacfwd(lambda y: jnp.sin(y) * jnp.cross(y, x) / (1.0 + y @ y))(2.0 * x), X),
}  # fmt: skip


@needs_compiler
@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_function_in_c_equals_the_function_in_jax(name, tmp_path):
    function, *args = FUNCTIONS[name]
    found, expected = both(tmp_path, function, *args)
    # a few rounding errors of numbers of order one
    np.testing.assert_allclose(found, expected, rtol=2e-15, atol=2e-15)


@needs_compiler
def test_inverse_of_erf_is_accurate_next_to_its_poles(tmp_path):
    """At 0.999999 the function of XLA is off by 1.5e-12."""
    x = np.array([-0.999999, 1.0 - 1e-9, 1.0 - 1e-15, 1.0, -1.0, 2.0])
    np.testing.assert_allclose(both(tmp_path, jax.lax.erf_inv, x)[0], scipy.special.erfinv(x), rtol=1e-14)


def text(function, *args):
    """Return the C statements of a function of arrays as one text; args: as for `body`."""
    return "\n".join(body(function, *map(jnp.asarray, args))[0])


def test_c_code_shares_equal_expressions_and_has_folded_constants():
    code = text(lambda x: (x[0] * x[1] + jnp.sin(x[1] * x[0]), 0.0 * x[2] + 1.0 * x[0], jnp.sqrt(4.0) * x[0]), X)
    assert code.count(" * ") == 2  # x0 x1 once, and 2 x0
    assert "R(2) * in[0]" in code
    assert "in[2]" not in code


def test_variables_in_c_have_the_names_of_the_python_source():
    def law(x):
        wanted = -2.0 * x
        speed = jnp.sum(wanted * wanted)
        return wanted / (1.0 + speed)

    code = text(law, X)
    assert "const real wanted_2 = R(-2) * in[1];" in code
    assert "const real speed = wanted_1 * wanted_1" in code


@needs_compiler
def test_names_of_the_python_source_do_not_hide_c_functions(tmp_path):
    """A law may contain an assignment such as `tanh = jnp.tanh(s)`."""

    def law(x):
        tanh, NAN = jnp.tanh(x[0]), jnp.sin(x[1])
        fabs, floor = jnp.abs(tanh + NAN), jnp.floor(tanh * 9.0)
        rint, expm1, atan2 = jnp.round(9.0 * fabs), jnp.expm1(floor), jnp.arctan2(NAN, tanh)
        turned = jnp.sin(tanh * fabs) + jnp.tanh(rint * expm1) + jnp.floor(rint * NAN)
        return turned * jnp.abs(atan2 - fabs) + jnp.expm1(atan2 * tanh) + jnp.arctan2(turned, rint)

    found, expected = both(tmp_path, law, X)
    np.testing.assert_allclose(found, expected, rtol=4e-15)


def test_branches_and_loops_in_jax_are_branches_and_loops_in_c():
    assert "if (in[0] > R(0)) {" in text(branched, X)
    assert "for (int k" in text(counted, X)
    assert "for (" not in text(lambda x: jax.lax.fori_loop(0, 3, lambda k, y: 0.5 * y + x, x), X)
    assert "break;" in text(until, X)


@pytest.mark.parametrize(
    ("law", "name"),
    [
        (lambda x: jnp.linalg.eigvalsh(jnp.outer(x, x)), "jnp.linalg.eigvalsh"),
        (lambda x: x.astype(jnp.float32) + 1.0, "x.astype"),  # C went on with 64 bits, and was 3e-8 off
        # integers of 8 bits wrap around: C gave 300 for 44
        (lambda x: (x[0] > 0.0).astype(jnp.uint8) * jnp.uint8(200) + jnp.uint8(100), "(x[0] > 0.0).astype"),
        (lambda x: jnp.int32(x[0]).astype(jnp.int8) * x, "jnp.int32(x[0]).astype"),
        (lambda x: x + jax.random.normal(jax.random.key(jnp.int32(x[0]))), "jax.random.key"),
        (lambda x: x + jax.random.normal(jax.random.PRNGKey(0)), "jax.random.PRNGKey"),
        (lambda x: jax.lax.reduce_precision(x, 8, 23), "jax.lax.reduce_precision"),  # C had all digits
        (lambda x: jnp.bitwise_or.reduce(x.astype(jnp.int32)) * x, "jnp.bitwise_or.reduce"),  # C had 1, or 0
        (
            lambda x: jax.lax.while_loop(lambda c: c.real < 9.0, lambda c: c + 1.0, jax.lax.complex(x, x)[0]),
            "jax.lax.complex",
        ),
    ],
)
def test_the_error_for_an_unsupported_operation_has_its_name_and_line(law, name):
    line = law.__code__.co_firstlineno
    said = rf"^`{re.escape(name)}` \(.*test_translate\.py:{line}\) cannot be written in C, but must"
    with pytest.raises(NoRuleError, match=said):
        body(law, X)


@pytest.mark.parametrize("name", ["solve", "inv", "cholesky", "pinv", "qr"])
def test_the_error_for_linear_algebra_names_supported_functions(name):
    """The error names the function in the source, such as `jnp.linalg.solve`, and not its primitive `lu`."""
    calls = {
        "solve": lambda x: jnp.linalg.solve(jnp.outer(x, x), x),
        "inv": lambda x: jnp.linalg.inv(jnp.outer(x, x)),
        "cholesky": lambda x: jnp.linalg.cholesky(jnp.outer(x, x)),
        "pinv": lambda x: jnp.linalg.pinv(jnp.outer(x, x)),
        "qr": lambda x: jnp.linalg.qr(jnp.outer(x, x))[0],
    }
    with pytest.raises(NoRuleError, match=rf"^`jnp\.linalg\.{name}` \(") as refused:
        body(calls[name], X)
    _, _, instead = str(refused.value).partition("but must be ")
    named = [one for one in ("solve", "determinant", "smallest_eigenvalue") if re.search(rf"\b{one}\b", instead)]
    assert "solve" in named
    for one in named:
        function = getattr(matrices, one)
        body(lambda x, f=function: f(jnp.outer(x, x), x) if f is matrices.solve else f(jnp.outer(x, x)), X)


def test_random_keys_raise_an_error_as_constants_and_in_memories():
    """The error is one sentence instead of a traceback."""
    key = jax.random.key(0)
    with pytest.raises(NoRuleError, match=r"^a constant has the type key<fry>, but must have"):
        body(lambda x: x + jax.random.normal(key), X)
    with pytest.raises(NoRuleError, match=r"^law has the type key<fry>, but must have"):
        struct_fields({"law": jax.ShapeDtypeStruct((), key.dtype)}, {})


@pytest.mark.parametrize("constant", [jnp.asarray([1.0 + 2.0j, 2.0, 3.0]), jnp.asarray([1, 2, 3], jnp.uint64)])
def test_constants_of_unsupported_types_raise_an_error(constant):
    """The error is one sentence instead of a traceback."""
    with pytest.raises(NoRuleError, match=rf"^a constant has the type {constant.dtype}, but must have"):
        body(lambda x: (x * constant).real, X)


@needs_compiler
@pytest.mark.parametrize("index", [-3, 0, 4, 6, 11])
def test_an_entry_at_a_computed_index_is_read_from_the_table_itself(tmp_path, index):
    """The C code indexes the array; it does not choose among all entries. The index is clipped as in JAX."""
    table, at = np.linspace(1.0, 4.0, 7), np.array(float(index))

    def entry(table, at):
        return jax.lax.dynamic_index_in_dim(table, at.astype(jnp.int32), keepdims=False, allow_negative_indices=False)

    found, expected = both(tmp_path, entry, table, at)
    np.testing.assert_array_equal(found, expected)
    lines, _ = body(entry, table, at)
    assert "?" not in "".join(lines)  # no choice among the entries
