"""Arrays as components, and the rules that evaluate primitives on them.

A batch of small arrays is held as a structure of arrays: each component is an array over the batch. `lanes` and
`kernel` evaluate jaxprs on such arrays. The functions on object arrays at the end serve `onboard` too, whose entries
are expressions.
"""

import itertools
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial, reduce
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.extend import core

from ptsmc_jax.numerics.pytrees import pytree

MAX_COMPONENTS = 64  # larger arrays, such as tables over time, are not split into components

TRIAL, DIRECTION = 1, 2  # batch axes of a value, as flags: it may differ by trial, by direction of differentiation


def is_small(shape: tuple[int, ...], limit: int = MAX_COMPONENTS) -> bool:
    """Return whether an array of this shape is split into components."""
    return math.prod(shape) <= limit


@pytree
@dataclass(frozen=True, eq=False)
class BatchedArray:
    """An array for each element of a batch, as components, as one array with the batch axes first, or both.

    Args:
        shape: shape of the array of one element.
        parts: the components, in row-major order: arrays that broadcast to the batch's shape.
        array: the array of all elements, (*batch, *shape).
        axes: the batch axes: 0, TRIAL, DIRECTION or TRIAL | DIRECTION. The batch's shape is (), (trials,),
            (directions, 1) or (directions, trials).
    """

    shape: tuple[int, ...] = field(metadata={"static": True})
    parts: tuple | None = None
    array: Any = None
    axes: int = field(default=TRIAL, metadata={"static": True})

    @classmethod
    def unbatched(cls, value: Any) -> "BatchedArray":
        """Return an array that is equal in the whole batch."""
        return cls(np.shape(value), array=value, axes=0)

    @classmethod
    def of_components(cls, components: np.ndarray, axes: int = TRIAL) -> "BatchedArray":
        """Return the array with these components, an object array of its shape, and with these batch axes."""
        return cls(components.shape, tuple(components.flat), axes=axes)

    @property
    def components(self) -> np.ndarray:
        """The components as an object array. They are not cached: those of a loop's body must not leave its trace."""
        if self.parts is not None:
            return object_array(self.shape, self.parts)
        array = self.array if isinstance(self.array, np.ndarray) else jnp.asarray(self.array)
        return entries(array, array.ndim - len(self.shape))

    def split(self) -> "BatchedArray":
        """Return the same array with its components computed, unless it is large or an unbatched scalar."""
        if self.parts is not None or not is_small(self.shape) or (not self.axes and not self.shape):
            return self
        array = replace(self, array=jnp.asarray(self.array))
        return replace(array, parts=tuple(array.components.flat))

    def to_array(self, batch: tuple[int, ...]) -> jax.Array:
        """Return the (*batch, *shape) array."""
        if self.array is not None:
            return jnp.broadcast_to(jnp.asarray(self.array), (*batch, *self.shape))
        flat = [jnp.broadcast_to(part, batch) for part in self.components.flat]
        return jnp.stack(flat, axis=-1).reshape((*batch, *self.shape)) if self.shape else flat[0]


def object_array(shape: tuple[int, ...], items: Iterable) -> np.ndarray:
    """Return an object array of this shape with these entries."""
    flat = np.empty(math.prod(shape), dtype=object)
    for k, item in zip(range(flat.size), items, strict=True):
        flat[k] = item
    return flat.reshape(shape)


def entries(array: Any, leading: int = 0) -> np.ndarray:
    """Return the object array of an array's entries over all axes but the first `leading` ones."""
    if isinstance(array, np.ndarray) and not leading:  # constants stay NumPy numbers
        return object_array(array.shape, array.reshape(-1))
    kept, shape = array.shape[:leading], array.shape[leading:]
    if not shape:
        return object_array((), [array])
    flat = lax.reshape(array, (*kept, math.prod(shape)))
    return object_array(shape, (lax.index_in_dim(flat, k, leading, keepdims=False) for k in range(math.prod(shape))))


def bind(eqn: Any, operands: Sequence) -> Sequence:
    """Return the results of an equation's primitive on arrays."""
    out = eqn.primitive.bind(*operands, **eqn.primitive.get_bind_params(eqn.params))
    return out if eqn.primitive.multiple_results else [out]


def contract(eqn: Any, operands: Sequence[jax.Array]) -> Sequence[jax.Array]:
    """Return the result of a `dot_general` as a sum of products.

    XLA's CPU compiler aborts the process for some batches of `dot_general`, for example of derivatives.
    """
    out = eqn.outvars[0].aval
    a, b = _grouped_operands(eqn, [operand.astype(out.dtype) for operand in operands])
    return [jnp.sum(a[:, :, None] * b[:, None], axis=-1).astype(out.dtype).reshape(out.shape)]


def zero_tangent(eqn: Any) -> np.ndarray | None:
    """Return constant zeros if the equation fills an array with zeros, as `jax.jvp` does. Return None otherwise."""
    if eqn.primitive.name != "broadcast_in_dim" or not isinstance(eqn.invars[0], core.Literal):
        return None
    out = eqn.outvars[0].aval
    integral = out.dtype == jax.dtypes.float0  # tangents of integers and booleans, which NumPy cannot compare
    return np.zeros(out.shape, out.dtype) if integral or (eqn.invars[0].val == 0 and is_small(out.shape)) else None


def has_rule(name: str) -> bool:
    """Return whether the evaluation of a primitive is defined: by a rule for components, or always by `jax.vmap`."""
    return name in _RULES or name in _ON_ARRAYS


class ComponentRules:
    """Rules that evaluate a primitive of a jaxpr on arrays that are split into components.

    Args:
        limit: entries of the largest array that is evaluated by components.
        replacements: functions of components that replace elementwise primitives, by the primitive's name.
    """

    def __init__(self, limit: int = MAX_COMPONENTS, replacements: dict[str, Callable] | None = None):
        self.limit, self.replacements = limit, replacements or {}
        # (component, broadcast component) by shape and `_identity` of the component; the component is stored, because
        # Python may reuse the identity of an object that is deleted
        self._broadcasts: dict[Any, tuple[Any, Any]] = {}

    def apply(self, eqn: Any, values: Sequence[BatchedArray]) -> list[np.ndarray] | None:
        """Return the components of the results of an equation, or None if it must be evaluated on arrays."""
        rule, avals = _RULES.get(eqn.primitive.name), [v.aval for v in (*eqn.invars, *eqn.outvars)]
        if rule is None or not all(is_small(aval.shape, self.limit) for aval in avals):
            return None
        return rule(self, eqn, values)

    def broadcast(self, parts: Sequence) -> Sequence:
        """Return components broadcast to a common batch shape, each of them only once, which shortens traces by 1/8."""
        shapes = [np.shape(part) for part in parts]
        if len(set(shapes)) == 1:
            return parts
        shape = np.broadcast_shapes(*shapes)
        return [
            part if old == shape else self._broadcast_once(part, shape) for part, old in zip(parts, shapes, strict=True)
        ]

    def _broadcast_once(self, part: Any, shape: tuple[int, ...]) -> Any:
        """Return a component broadcast to a batch shape, from the stored results if it was broadcast before."""
        key = shape, _identity(part)
        if key not in self._broadcasts:
            trailing = range(len(shape) - np.ndim(part), len(shape))
            self._broadcasts[key] = part, lax.broadcast_in_dim(part, shape, trailing)
        return self._broadcasts[key][1]

    def _elementwise(self, eqn: Any, values: Sequence[BatchedArray]) -> list[np.ndarray]:
        """Apply a primitive to the same component of each operand. Operands get the shape of the result first."""
        name, shape = eqn.primitive.name, eqn.outvars[0].aval.shape
        operation = partial(eqn.primitive.bind, **eqn.primitive.get_bind_params(eqn.params))
        simplify = _ZERO_RULES.get(name) if _has_tangent(values) else None

        def apply_to_component(*operands: Any) -> Any:
            """Return a scalar component of the result of the primitive, from the same component of each operand."""
            result = None if simplify is None else simplify(*operands)
            return operation(*self.broadcast(operands)) if result is None else result

        operands = [np.broadcast_to(value.components, shape).flat for value in values]
        return [object_array(shape, map(self.replacements.get(name, apply_to_component), *operands))]

    def _bitcast(self, eqn: Any, values: Sequence[BatchedArray]) -> list[np.ndarray] | None:
        """Return the components with another type of the same size, or None if the sizes differ."""
        same_size = eqn.invars[0].aval.dtype.itemsize == eqn.outvars[0].aval.dtype.itemsize
        return self._elementwise(eqn, values) if same_size else None

    def _fold(self, name: str, *items: Any) -> Any:
        """Return the sum, product or extreme of components, by the function of `jax.lax` with this name."""
        if name in self.replacements:
            return reduce(self.replacements[name], items)
        return reduce(lambda a, b: getattr(lax, name)(*self.broadcast([a, b])), items)

    def _reduction(self, eqn: Any, values: Sequence[BatchedArray]) -> list[np.ndarray]:
        """Return the components of a sum, product or extreme along axes."""
        operation = _REDUCTIONS[eqn.primitive.name]
        return [reduce_entries(eqn, values[0].components, lambda row: self._fold(operation, *row))]

    def _cumulative(self, eqn: Any, values: Sequence[BatchedArray]) -> list[np.ndarray]:
        """Return the components of a cumulative sum, product or extreme along an axis."""
        return [accumulate_entries(eqn, values[0].components, partial(self._fold, _CUMULATIVE[eqn.primitive.name]))]

    def _contraction(self, eqn: Any, values: Sequence[BatchedArray]) -> list[np.ndarray] | None:
        """Return the components of a `dot_general`, or None if the result is bool."""
        dtype, skip_zeros = eqn.outvars[0].aval.dtype, _has_tangent(values)
        if jnp.issubdtype(dtype, bool):
            return None

        def convert(value: BatchedArray, variable: Any) -> np.ndarray:
            parts = value.components
            if variable.aval.dtype == dtype:
                return parts
            return object_array(parts.shape, (lax.convert_element_type(part, dtype) for part in parts.flat))

        def scalar_product(row: np.ndarray, column: np.ndarray) -> Any:
            pairs = [p for p in zip(row, column, strict=True) if not (skip_zeros and any(map(_is_zero, p)))]
            products = [lax.mul(*self.broadcast(pair)) for pair in pairs]
            return self._fold("add", *products) if products else dtype.type(0)

        left, right = map(convert, values, eqn.invars)
        return [contract_entries(eqn, left, right, scalar_product)]


def _identity(part: Any) -> Any:
    """Return a key that differs between components: the value of a constant, the identity of another object."""
    constant = isinstance(part, np.generic | np.ndarray) and not np.ndim(part)
    return (part.dtype, part.tobytes()) if constant else id(part)


def _has_tangent(values: Sequence[BatchedArray]) -> bool:
    """Return whether any value is a tangent, which differs by direction. Rules then skip constant zeros."""
    return any(value.axes & DIRECTION for value in values)


def _is_zero(part: Any) -> bool:
    """Return whether a component is a constant zero."""
    return isinstance(part, np.ndarray | np.generic) and part.ndim == 0 and part == 0


def _simplified_sum(a: Any, b: Any) -> Any:
    """Return the other operand of a sum with a constant zero, or None if no operand is a constant zero."""
    return b if _is_zero(a) else a if _is_zero(b) else None


# simplified results of operations with a constant zero; None if no operand is a constant zero
_ZERO_RULES: dict[str, Callable] = {
    "mul": lambda a, b: a if _is_zero(a) else b if _is_zero(b) else None,
    "add": _simplified_sum,
    "add_any": _simplified_sum,
    "sub": lambda a, b: a if _is_zero(b) else None,
    "neg": lambda a: a if _is_zero(a) else None,
}


def pick_entries(eqn: Any, arrays: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Return the results of a primitive that only moves entries, such as `slice`, on object arrays of any entries."""
    shape, params, first = eqn.outvars[0].aval.shape, eqn.params, arrays[0]
    match eqn.primitive.name:
        case "reshape" if params.get("dimensions") is None:
            return [first.reshape(shape)]
        case "squeeze" | "expand_dims":
            return [first.reshape(shape)]
        case "broadcast_in_dim":
            expanded = [1] * len(shape)
            for axis, size in zip(params["broadcast_dimensions"], first.shape, strict=True):
                expanded[axis] = size
            return [np.broadcast_to(first.reshape(expanded), shape)]
        case "slice":
            steps = params["strides"] or (1,) * len(shape)
            return [first[tuple(map(slice, params["start_indices"], params["limit_indices"], steps))]]
        case "concatenate":
            return [np.concatenate(arrays, params["dimension"])]
        case "stack":
            return [np.stack(arrays, params["axis"])]
        case "transpose":
            return [first.transpose(params["permutation"])]
    return _pick_by_index(eqn, arrays)


def _pick_by_index(eqn: Any, arrays: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Return the results of a primitive that only moves entries: it is applied to the entries' indices."""
    pool = [entry for array in arrays for entry in array.flat]
    ends = itertools.accumulate(array.size for array in arrays)
    with jax.ensure_compile_time_eval():
        indices = [np.arange(end - array.size, end, dtype=np.int32).reshape(array.shape)
                   for end, array in zip(ends, arrays, strict=True)]  # fmt: skip
        moved = [np.asarray(out) for out in bind(eqn, indices)]
    return [object_array(out.shape, (pool[k] for k in out.flat)) for out in moved]


def reduce_entries(eqn: Any, array: np.ndarray, fold: Callable[[np.ndarray], Any]) -> np.ndarray:
    """Return the result of a reduction on an object array.

    Args:
        eqn: the equation.
        array: its operand.
        fold: function from entries (n,) to their sum, product or extreme.

    Returns:
        An object array in the shape of `array` without the reduced axes.
    """
    axes = eqn.params["axes"]
    kept = [a for a in range(array.ndim) if a not in axes]
    shape = tuple(array.shape[a] for a in kept)
    rows = array.transpose([*kept, *axes]).reshape((*shape, -1))
    return object_array(shape, (fold(rows[i]) for i in np.ndindex(*shape)))


def _grouped_operands(eqn: Any, operands: Sequence[Any]) -> list[Any]:
    """Return both operands of a `dot_general`, arrays of JAX or of objects, as (batch, kept, contracted)."""

    def group_axes(array: Any, axes: Sequence[int], batch: Sequence[int]) -> Any:
        kept = [a for a in range(array.ndim) if a not in (*axes, *batch)]
        sizes = [math.prod(array.shape[a] for a in group) for group in (batch, kept, axes)]
        return array.transpose([*batch, *kept, *axes]).reshape(sizes)

    return [group_axes(*each) for each in zip(operands, *eqn.params["dimension_numbers"], strict=True)]


def contract_entries(eqn: Any, left: np.ndarray, right: np.ndarray, inner: Callable[..., Any]) -> np.ndarray:
    """Return the result of a `dot_general` on object arrays.

    Args:
        eqn: the equation.
        left: its first operand.
        right: its second operand.
        inner: function from a row (n,) and a column (n,) to their scalar product.

    Returns:
        An object array in the shape of the equation's output.
    """
    a, b = _grouped_operands(eqn, (left, right))
    indices = itertools.product(range(len(a)), range(a.shape[1]), range(b.shape[1]))
    return object_array(eqn.outvars[0].aval.shape, (inner(a[k, i], b[k, j]) for k, i, j in indices))


def accumulate_entries(eqn: Any, array: np.ndarray, operation: Callable[[Any, Any], Any]) -> np.ndarray:
    """Return a cumulative sum, product or extreme of an object array.

    Args:
        eqn: the equation.
        array: its operand.
        operation: (previous result, entry) -> result.

    Returns:
        An object array in the shape of `array`.
    """
    results = np.moveaxis(array.copy(), eqn.params["axis"], 0)
    for previous, k in itertools.pairwise(range(len(results))[:: -1 if eqn.params["reverse"] else 1]):
        for i in np.ndindex(*results.shape[1:]):
            results[(k, *i)] = operation(results[(previous, *i)], results[(k, *i)])
    return np.moveaxis(results, 0, eqn.params["axis"])


# primitive -> function of jax.lax on two components
_REDUCTIONS = {
    "reduce_sum": "add", "reduce_max": "max", "reduce_min": "min", "reduce_prod": "mul",
    "reduce_and": "bitwise_and", "reduce_or": "bitwise_or", "reduce_xor": "bitwise_xor",
}  # fmt: skip
_CUMULATIVE = {"cumsum": "add", "cumprod": "mul", "cummax": "max", "cummin": "min"}
_ELEMENTWISE = """abs acos acosh add add_any and asin asinh atan atan2 atanh cbrt ceil clamp clz complex conj
    convert_element_type copy copy_p cos cosh digamma div eq eq_to erf erf_inv erfc exp exp2 expm1
    floor ge gt imag integer_pow is_finite le le_to lgamma log log1p log2 logistic lt lt_to max min mul ne
    neg nextafter not one_minus_square or population_count pow real reduce_precision rem round rsqrt select_n
    shift_left shift_right_arithmetic shift_right_logical sign sin sinh sqrt square stop_gradient sub
    tan tanh xor""".split()  # jax has log2 and one_minus_square since version 0.11
_STRUCTURAL = """broadcast_in_dim concatenate expand_dims pad reshape rev slice split squeeze stack tile
    transpose unstack""".split()
# An index that differs by trial needs whole arrays, and so does foreign code (ffi_call).
_ON_ARRAYS = set(
    """argmax argmin dynamic_slice dynamic_update_slice ffi_call gather optimization_barrier scatter scatter-add
    scatter-mul scatter-min scatter-max sort top_k""".split()
)
_RULES: dict[str, Callable[[ComponentRules, Any, Sequence[BatchedArray]], list[np.ndarray] | None]] = {
    **dict.fromkeys(_ELEMENTWISE, ComponentRules._elementwise),
    **dict.fromkeys(_STRUCTURAL, lambda _, eqn, values: pick_entries(eqn, [value.components for value in values])),
    **dict.fromkeys(_REDUCTIONS, ComponentRules._reduction),
    **dict.fromkeys(_CUMULATIVE, ComponentRules._cumulative),
    "reshard": lambda rules, eqn, values: [values[0].components],  # resharding on one device is the identity
    "bitcast_convert_type": ComponentRules._bitcast,
    "dot_general": ComponentRules._contraction,
}
