"""The counterpart of each elementwise primitive in C."""

import math
from collections.abc import Callable, Mapping
from typing import Any

import jax.numpy as jnp
from jax import lax

from ptsmc_jax.onboard.expressions import BOOL, REAL, Node, Pool


def power(pool: Pool, x: Node, exponent: int) -> Node:
    """Return x^exponent by squaring, as XLA does.

    Args:
        pool: creates the nodes.
        x: the base.
        exponent: an integer, which may be negative for a real base.
    """
    remaining, result, square = abs(exponent), None, x
    while remaining:
        if remaining & 1:
            result = square if result is None else pool.make("mul", result, square, kind=x.kind)
        remaining >>= 1
        if remaining:
            square = pool.make("mul", square, square, kind=x.kind)
    one = pool.constant(1, x.kind)
    result = one if result is None else result
    return pool.make("div", one, result) if exponent < 0 else result


def convert(pool: Pool, kind: str, x: Node) -> Node:
    """Return a number converted to another kind.

    Args:
        pool: creates the nodes.
        kind: kind of the result.
        x: the number.
    """
    if x.kind == kind:
        return x
    if x.op == "constant" and (kind == REAL or 0 <= x.value < 2**31):  # C itself converts constants that may overflow
        return pool.constant(x.value, kind)
    if kind == BOOL:
        return pool.make("ne", x, pool.constant(0, x.kind), kind=BOOL)
    if x.kind == BOOL and kind == REAL:
        return pool.make("select", x, pool.constant(1, kind), pool.constant(0, kind), kind=kind)
    return pool.make("convert", x, kind=kind)


def _convert_element_type(pool: Pool, params: Mapping[str, Any], kind: str, x: Node) -> Node:
    """Rule of a conversion. Raise KeyError for a real type with fewer digits."""
    if kind == REAL and jnp.finfo(params["new_dtype"]).bits < jnp.finfo(jnp.result_type(float)).bits:
        raise KeyError("convert_element_type")  # C does not round to fewer digits
    return convert(pool, kind, x)


def _reduce_precision(pool: Pool, params: Mapping[str, Any], kind: str, x: Node) -> Node:
    """Rule that returns x itself. Raise KeyError if the result would have fewer digits."""
    real = jnp.finfo(jnp.result_type(float))
    if params["exponent_bits"] < real.nexp or params["mantissa_bits"] < real.nmant:
        raise KeyError("reduce_precision")
    return x


def _same_operation(op: str) -> Callable:
    """Return the rule of a primitive that is the operation `op` in C."""
    return lambda pool, params, kind, *x: pool.make(op, *x, kind=kind)


def _bool_operation(op: str) -> Callable:
    """Return the rule of a logical operation. The rule raises KeyError for the bits of integers."""

    def rule(pool: Pool, params: object, kind: str, *x: Node) -> Node:
        if kind != BOOL:
            raise KeyError(op)  # operations on the bits of integers have no rule
        return pool.make(op, *x, kind=BOOL)

    return rule


def _select(pool: Pool, params: object, kind: str, selector: Node, *cases: Node) -> Node:
    """Rule of select_n: return the case that the selector numbers.

    A bool selects between no and yes, in this order. A whole number beyond the ends selects the nearest case.
    """
    if selector.kind == BOOL:
        no, yes = cases
        return pool.make("select", selector, yes, no, kind=kind)
    result = cases[-1]
    for k in range(len(cases) - 2, -1, -1):
        test = pool.make("le", selector, pool.constant(k, selector.kind), kind=BOOL)
        result = pool.make("select", test, cases[k], result, kind=kind)
    return result


def _division_rule(op: str) -> Callable:
    """Return the rule of a quotient or remainder. As in XLA, k / 0 is -1 and k % 0 is k for integers."""

    def rule(pool: Pool, params: object, kind: str, a: Node, b: Node) -> Node:
        if kind == REAL:
            return pool.make("fmod" if op == "rem" else op, a, b)
        is_zero = pool.make("eq", b, pool.constant(0, kind), kind=BOOL)
        divisor = pool.make("select", is_zero, pool.constant(1, kind), b, kind=kind)
        result_for_zero = pool.make("convert", pool.constant(-1, "int32_t"), kind=kind) if op == "div" else a
        return pool.make("select", is_zero, result_for_zero, pool.make(op, a, divisor, kind=kind), kind=kind)

    return rule


def _reciprocal(pool: Pool, x: Node) -> Node:
    """Return the node of 1 / x."""
    return pool.make("div", pool.constant(1.0, REAL), x)


ELEMENTWISE: dict[str, Callable] = {
    **{op: _same_operation(op) for op in "add sub mul neg max min abs sign lt le gt ge eq ne sqrt cbrt exp exp2 "
       "expm1 log log1p lgamma sin cos tan asin acos atan atan2 sinh cosh tanh asinh acosh atanh erf erfc erf_inv "
       "nextafter floor ceil".split()},
    **{f"{op}_to": _same_operation(op) for op in ("lt", "le", "eq")},
    "is_finite": lambda pool, params, kind, x: pool.make("isfinite", x, kind=BOOL),
    **{op: _bool_operation(op) for op in ("and", "or", "not")}, "xor": _bool_operation("ne"),
    "add_any": _same_operation("add"), "select_n": _select,
    "integer_pow": lambda pool, params, kind, x: power(pool, x, params["y"]),
    "round": lambda pool, params, kind, x: pool.make(
        "rint" if params["rounding_method"] == lax.RoundingMethod.TO_NEAREST_EVEN else "round", x
    ),
    "pow": lambda pool, params, kind, x, y: pool.make("pow", x, convert(pool, REAL, y)),
    "square": lambda pool, params, kind, x: pool.make("mul", x, x, kind=kind),
    "log2": lambda pool, params, kind, x: pool.make(  # XLA scales the natural logarithm, too
        "mul", pool.make("log", x), pool.constant(1.0 / math.log(2.0), REAL)
    ),
    "one_minus_square": lambda pool, params, kind, x: pool.make(
        "mul", *(pool.make(op, pool.constant(1, kind), x, kind=kind) for op in ("add", "sub")), kind=kind
    ),
    "rsqrt": lambda pool, params, kind, x: _reciprocal(pool, pool.make("sqrt", x)),
    "clamp": lambda pool, params, kind, low, x, high: pool.make(
        "min", pool.make("max", x, low, kind=kind), high, kind=kind
    ),
    "div": _division_rule("div"), "rem": _division_rule("rem"),
    "logistic": lambda pool, params, kind, x: _reciprocal(
        pool, pool.make("add", pool.constant(1.0, REAL), pool.make("exp", pool.make("neg", x)))
    ),
    "convert_element_type": _convert_element_type,
    **dict.fromkeys("stop_gradient copy copy_p optimization_barrier pvary".split(), lambda pool, params, kind, x: x),
    "reduce_precision": _reduce_precision,
}  # fmt: skip
