"""Small arrays as components, each a vector over the trials, and what the plain primitives do to them: for `lanes`."""

import itertools
import math
from collections.abc import Callable, Iterable, Sequence
from functools import reduce
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.extend import core
from jaxtyping import Array

# Larger arrays (tables over time, say) are not taken apart.
LARGEST = 64

# What a lane differs over, added up: from trial to trial, from direction to direction.
TRIAL, DIRECTION = 1, 2


def small(shape: tuple[int, ...], largest: int = LARGEST) -> bool:
    """Whether an array of this shape is taken apart."""
    return math.prod(shape) <= largest


class Lane:
    """A value that differs from trial to trial: as components, or dense as (*lead, *shape), or both.

    Its lead is (trials,); of a slope (directions, trials), or (directions, 1) where it is equal in all trials.
    """

    def __init__(
        self, shape: tuple[int, ...], parts: np.ndarray | None = None, dense: Array | None = None, differs: int = TRIAL
    ):
        self.shape, self.differs, self._parts, self._dense = shape, differs, parts, dense

    # What is computed here is not kept: inside a loop's body it belongs to that body alone.

    @property
    def parts(self) -> np.ndarray:
        """Object array of the value's shape, each entry of the lead's shape, or of one that is spread to it."""
        if self._parts is not None:
            return self._parts
        assert self._dense is not None
        return entries(self._dense, self._dense.ndim - len(self.shape))

    def apart(self) -> "Lane":
        """The value taken apart now, unless it is too large for that."""
        whole = self._parts is not None or not small(self.shape)
        return self if whole else Lane(self.shape, self.parts, self._dense, self.differs)

    def dense(self, lead: tuple[int, ...]) -> Array:
        """(*lead, *shape) array."""
        if self._dense is not None:
            return jnp.broadcast_to(self._dense, (*lead, *self.shape))
        flat = [jnp.broadcast_to(part, lead) for part in self.parts.flat]
        return jnp.stack(flat, axis=-1).reshape((*lead, *self.shape)) if self.shape else flat[0]


class Shared:
    """A small array equal in all trials, taken apart once, outside the loop that uses it."""

    def __init__(self, array: Array):
        self.array, self.parts = array, parts_of(array)


def object_array(shape: tuple[int, ...], items: Iterable) -> np.ndarray:
    """An array of this shape whose entries may be anything."""
    flat = np.empty(math.prod(shape), dtype=object)
    for k, item in zip(range(flat.size), items, strict=True):
        flat[k] = item
    return flat.reshape(shape)


def zero(part: Any) -> bool:
    """Whether a component is known to be zero while the trace is evaluated."""
    return isinstance(part, np.ndarray | np.generic) and part.ndim == 0 and part == 0


def entries(array: Any, leading: int = 0) -> np.ndarray:
    """The entries of an array over all axes but the first `leading` ones, as an object array of arrays."""
    if isinstance(array, np.ndarray) and not leading:  # known
        return object_array(array.shape, array.reshape(-1))
    kept, shape = array.shape[:leading], array.shape[leading:]
    if not shape:
        return object_array((), [array])
    flat = lax.reshape(array, (*kept, math.prod(shape)))
    return object_array(shape, (lax.index_in_dim(flat, k, leading, keepdims=False) for k in range(math.prod(shape))))


def parts_of(value: Any) -> np.ndarray:
    """Components of a value, lane or not."""
    if isinstance(value, Lane | Shared):
        return value.parts
    return entries(value if isinstance(value, np.ndarray) else jnp.asarray(value))


def plain(value: Any) -> Any:
    """A value that is equal in all trials, as JAX takes it."""
    return value.array if isinstance(value, Shared) else value


def dense_of(value: Any, lead: tuple[int, ...]) -> Array:
    """(*lead, *shape) array of a value, lane or not."""
    if isinstance(value, Lane):
        return value.dense(lead)
    value = jnp.asarray(plain(value))
    return jnp.broadcast_to(value, (*lead, *value.shape))


def joined(shapes: Iterable[tuple[int, ...]]) -> tuple[int, ...]:
    """The shape that all of these are spread to."""
    some = set(shapes)
    longest = max(some, key=len, default=())
    return longest if some <= {(), longest} else np.broadcast_shapes(*some)


def bind(eqn: Any, values: Sequence) -> Sequence:
    """A primitive on arrays: its outputs."""
    out = eqn.primitive.bind(*map(plain, values), **eqn.primitive.get_bind_params(eqn.params))
    return out if eqn.primitive.multiple_results else [out]


def known(eqn: Any) -> list | None:
    """Zeros, as jvp makes of what has no slope; None: the equation makes something else."""
    if eqn.primitive.name != "broadcast_in_dim" or not isinstance(eqn.invars[0], core.Literal):
        return None
    out = eqn.outvars[0].aval
    slopeless = out.dtype == jax.dtypes.float0  # of whole numbers and truths, which NumPy compares with nothing
    zeros = slopeless or (eqn.invars[0].val == 0 and small(out.shape))
    return [np.zeros(out.shape, out.dtype)] if zeros else None


def apply(eqn: Any, values: Sequence, alike: "Alike", largest: int = LARGEST) -> list[Lane] | None:
    """The outputs of a primitive with at least one lane among its operands; None where they must stay dense.

    largest: entries of an array that is taken apart.
    """
    rule = _RULES[eqn.primitive.name]
    if all(small(v.aval.shape, largest) for v in (*eqn.invars, *eqn.outvars)):
        return rule(eqn, values, alike)
    return None


def covers(name: str) -> bool:
    """Whether there is a rule for the primitive."""
    return name in _RULES


class Alike:
    """Components spread over the trials if any of them differs from trial to trial, over directions likewise.

    Each is spread once, for all equations of a body: a trace would be an eighth longer else.
    """

    def __init__(self) -> None:
        self._spread: dict[Any, tuple[Any, Any]] = {}  # with the component, whose identity must not be another's

    def __call__(self, parts: Sequence) -> list:
        """Components that an equation takes together, all of the same shape."""
        shapes = [np.shape(part) for part in parts]
        shape = joined(shapes)
        return [part if own == shape else self._over(part, own, shape) for part, own in zip(parts, shapes, strict=True)]

    def _over(self, part: Any, own: tuple[int, ...], shape: tuple[int, ...]) -> Any:
        key = shape, _identity(part)
        if key not in self._spread:
            self._spread[key] = part, lax.broadcast_in_dim(part, shape, range(len(shape) - len(own), len(shape)))
        return self._spread[key][1]


def _identity(part: Any) -> Any:
    """What tells components apart: a known number its value, whatever else itself."""
    known = isinstance(part, np.generic | np.ndarray) and not np.ndim(part)
    return (part.dtype, part.tobytes()) if known else id(part)


def _elementwise(eqn: Any, values: Sequence, alike: Alike) -> list[Lane]:
    shape = eqn.outvars[0].aval.shape
    parts, size = [parts_of(value) for value in values], math.prod(shape)
    flat = [p.reshape(-1) if p.size == size else np.broadcast_to(p, shape).reshape(-1) for p in parts]
    params = eqn.primitive.get_bind_params(eqn.params)
    simpler = _WITH_ZERO.get(eqn.primitive.name) if sloped(values) else None

    def item(entry: tuple) -> Any:
        found = simpler(*entry) if simpler is not None else None
        return eqn.primitive.bind(*alike(entry), **params) if found is None else found

    return [Lane(shape, object_array(shape, map(item, zip(*flat, strict=True))))]


def sloped(values: Sequence) -> bool:
    """Whether a slope is among these values. One that is known to be zero stays out of sums and products."""
    return any(isinstance(value, Lane) and value.differs & DIRECTION for value in values)


def _product(a: Any, b: Any) -> Any:
    return next((part for part in (a, b) if zero(part)), None)


def _sum(a: Any, b: Any) -> Any:
    return b if zero(a) else a if zero(b) else None


_WITH_ZERO: dict[str, Callable] = {
    "mul": _product,
    "add": _sum,
    "add_any": _sum,
    "sub": lambda a, b: a if zero(b) else None,
    "neg": lambda a: a if zero(a) else None,
}


def _bitcast(eqn: Any, values: Sequence, alike: Alike) -> list[Lane] | None:
    sizes = [v.aval.dtype.itemsize for v in (eqn.invars[0], eqn.outvars[0])]
    return _elementwise(eqn, values, alike) if sizes[0] == sizes[1] else None


def _structural(eqn: Any, values: Sequence, alike: Alike) -> list[Lane]:
    """Move the components as the primitive moves the entries of an array."""
    return [Lane(moved.shape, moved) for moved in picked(eqn, list(map(parts_of, values)))]


def _reduction(eqn: Any, values: Sequence, alike: Alike) -> list[Lane]:
    operation = _REDUCTIONS[eqn.primitive.name]
    found = reduced(eqn, values[0].parts, lambda row: _fold(operation, row, alike))
    return [Lane(found.shape, found)]


def _fold(operation: Callable, items: Iterable, alike: Alike) -> Any:
    return reduce(lambda a, b: operation(*alike([a, b])), items)


def _contraction(eqn: Any, values: Sequence, alike: Alike) -> list[Lane] | None:
    kind = eqn.outvars[0].aval.dtype
    if jnp.issubdtype(kind, bool):
        return None

    def operand(value: Any, own: Any) -> np.ndarray:
        """Components of an operand, converted to the result's type."""
        parts = parts_of(value)
        return parts if own == kind else object_array(
            parts.shape, (lax.convert_element_type(part, kind) for part in parts.flat)
        )  # fmt: skip

    skip = sloped(values)

    def inner(row: np.ndarray, column: np.ndarray) -> Any:
        pairs = list(zip(row, column, strict=True))
        some = [pair for pair in pairs if not (skip and any(map(zero, pair)))]
        return _fold(lax.add, [lax.mul(*alike(pair)) for pair in some], alike) if some else kind.type(0)

    left, right = (operand(value, v.aval.dtype) for value, v in zip(values, eqn.invars, strict=True))
    found = contracted(eqn, left, right, inner)
    return [Lane(found.shape, found)]


def _cumulative(eqn: Any, values: Sequence, alike: Alike) -> list[Lane]:
    operation = _CUMULATIVE[eqn.primitive.name]
    return [Lane(values[0].shape, cumulated(eqn, values[0].parts, lambda *pair: operation(*alike(pair))))]


# How primitives move the entries of object arrays, whatever these are: `onboard.translate` has expressions in them.


def picked(eqn: Any, arrays: Sequence[np.ndarray]) -> list[np.ndarray]:
    """What a primitive that only moves entries makes of these."""
    shape, params, first = eqn.outvars[0].aval.shape, eqn.params, arrays[0]
    match eqn.primitive.name:
        case "reshape":
            order = params.get("dimensions")  # of the axes, where they are read in another one
            return [(first if order is None else first.transpose(order)).reshape(shape)]
        case "squeeze" | "expand_dims":
            return [first.reshape(shape)]
        case "broadcast_in_dim":
            spread = [1] * len(shape)
            for axis, size in zip(params["broadcast_dimensions"], first.shape, strict=True):
                spread[axis] = size
            return [np.broadcast_to(first.reshape(spread), shape)]
        case "slice":
            steps = params["strides"] or (1,) * len(shape)
            return [first[tuple(map(slice, params["start_indices"], params["limit_indices"], steps))]]
        case "concatenate":
            return [np.concatenate(arrays, params["dimension"])]
        case "stack":
            return [np.stack(arrays, params["axis"])]
        case "transpose":
            return [first.transpose(params["permutation"])]
        case "rev":
            return [np.flip(first, params["dimensions"])]
        case "split":
            return np.split(first, list(itertools.accumulate(params["sizes"]))[:-1], params["axis"])
    return _by_number(eqn, arrays)


def _by_number(eqn: Any, arrays: Sequence[np.ndarray]) -> list[np.ndarray]:
    """The same of any such primitive, which is applied to the entries' numbers."""
    entries = [entry for array in arrays for entry in array.flat]
    firsts = itertools.accumulate((array.size for array in arrays), initial=0)
    with jax.ensure_compile_time_eval():
        numbers = [np.arange(first, first + array.size, dtype=np.int32).reshape(array.shape)
                   for first, array in zip(firsts, arrays, strict=False)]  # fmt: skip
        outputs = [np.asarray(chosen) for chosen in bind(eqn, numbers)]
    return [object_array(out.shape, (entries[k] for k in out.flat)) for out in outputs]


def reduced(eqn: Any, array: np.ndarray, fold: Callable[[np.ndarray], Any]) -> np.ndarray:
    """A reduction; fold: of the entries that become one."""
    axes = eqn.params["axes"]
    kept = [a for a in range(array.ndim) if a not in axes]
    shape = tuple(array.shape[a] for a in kept)
    rows = array.transpose([*kept, *axes]).reshape((*shape, -1))
    return object_array(shape, (fold(rows[i]) for i in np.ndindex(*shape)))


def contracted(eqn: Any, left: np.ndarray, right: np.ndarray, inner: Callable[..., Any]) -> np.ndarray:
    """A `dot_general`; inner: of the entries of a row and of a column."""

    def rows(array: np.ndarray, axes: Sequence[int], batch: Sequence[int]) -> np.ndarray:
        """(batch, kept, contracted)."""
        kept = [a for a in range(array.ndim) if a not in (*axes, *batch)]
        sizes = [math.prod(array.shape[a] for a in group) for group in (batch, kept, axes)]
        return array.transpose([*batch, *kept, *axes]).reshape(sizes)

    a, b = (rows(*each) for each in zip((left, right), *eqn.params["dimension_numbers"], strict=True))
    every = itertools.product(range(len(a)), range(a.shape[1]), range(b.shape[1]))
    return object_array(eqn.outvars[0].aval.shape, (inner(a[k, i], b[k, j]) for k, i, j in every))


def cumulated(eqn: Any, array: np.ndarray, operation: Callable[[Any, Any], Any]) -> np.ndarray:
    """A cumulative sum, product or extreme along an axis; operation: on what there is so far and the next entry."""
    found = np.moveaxis(array.copy(), eqn.params["axis"], 0)
    for before, k in itertools.pairwise(range(len(found))[:: -1 if eqn.params["reverse"] else 1]):
        for i in np.ndindex(*found.shape[1:]):
            found[(k, *i)] = operation(found[(before, *i)], found[(k, *i)])
    return np.moveaxis(found, 0, eqn.params["axis"])


_REDUCTIONS = {
    "reduce_sum": lax.add,
    "reduce_max": lax.max,
    "reduce_min": lax.min,
    "reduce_prod": lax.mul,
    "reduce_and": lax.bitwise_and,
    "reduce_or": lax.bitwise_or,
    "reduce_xor": lax.bitwise_xor,
}
_CUMULATIVE = {"cumsum": lax.add, "cumprod": lax.mul, "cummax": lax.max, "cummin": lax.min}
_ELEMENTWISE = """abs acos acosh add add_any and asin asinh atan atan2 atanh cbrt ceil clamp clz complex conj
    convert_element_type copy copy_p cos cosh digamma div eq eq_to erf erf_inv erfc exp exp2 expm1
    floor ge gt imag integer_pow is_finite le le_to lgamma log log1p log2 logistic lt lt_to max min mul ne
    neg nextafter not one_minus_square or population_count pow real reduce_precision rem round rsqrt select_n
    shift_left shift_right_arithmetic shift_right_logical sign sin sinh sqrt square stop_gradient sub
    tan tanh xor""".split()  # log2 and one_minus_square since jax 0.11
_STRUCTURAL = """broadcast_in_dim concatenate expand_dims pad reshape rev slice split squeeze stack tile
    transpose unstack""".split()
# An index that differs from trial to trial wants whole arrays.
_INDEXING = """argmax argmin dynamic_slice dynamic_update_slice gather scatter scatter-add scatter-mul scatter-min
    scatter-max sort top_k""".split()
_RULES: dict[str, Callable[[Any, Sequence, Alike], list[Lane] | None]] = {
    **dict.fromkeys(_ELEMENTWISE, _elementwise),
    **dict.fromkeys(_STRUCTURAL, _structural),
    **dict.fromkeys(_REDUCTIONS, _reduction),
    **dict.fromkeys(_CUMULATIVE, _cumulative),
    **dict.fromkeys(_INDEXING, lambda eqn, values, alike: None),
    "optimization_barrier": lambda eqn, values, alike: None,
    "ffi_call": lambda eqn, values, alike: None,  # code that is not JAX's, which takes rows
    # on one device: itself
    "reshard": lambda eqn, values, alike: [Lane(eqn.outvars[0].aval.shape, parts_of(values[0]))],
    "bitcast_convert_type": _bitcast,
    "dot_general": _contraction,
}
