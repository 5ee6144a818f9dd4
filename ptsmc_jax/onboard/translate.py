"""Translation of a jaxpr (trace) into scalar expressions.

As in `batching.lanes`, arrays are split into components: reshapes and slices move components, and small matrix products
are sums. Branches and loops become regions; short loops of fixed length are unrolled. A primitive without a rule is an
error.
"""

import math
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend import core

from ptsmc_jax.batching import components
from ptsmc_jax.batching.components import object_array
from ptsmc_jax.batching.dependence import called_jaxpr, open_jaxpr
from ptsmc_jax.batching.lapack import NEVER_BATCHED, SIZE_LIMITED
from ptsmc_jax.numerics import draws, elementary
from ptsmc_jax.onboard import origins
from ptsmc_jax.onboard.control import CONTROL
from ptsmc_jax.onboard.expressions import BOOL, TYPES, Node, NoRuleError, Pool, Title, kind_of
from ptsmc_jax.onboard.rules import ELEMENTWISE, KNOWN_FUNCTIONS

MAX_CONSTANTS = 4096  # largest number of components of a constant array
LINEAR_ALGEBRA = SIZE_LIMITED | NEVER_BATCHED
ALLOWED_OPERATIONS = (
    "made of sums, products, quotients, powers, roots, elementary functions, comparisons, branches and loops of numbers"
)
ALLOWED_LINEAR_ALGEBRA = "plain arithmetic, or solve, determinant or smallest_eigenvalue of ptsmc_jax.numerics.matrices"


class Translator:
    """Evaluates jaxprs on arrays of expression nodes."""

    def __init__(self, pool: Pool):
        self.pool = pool
        self.outer_frames: list[origins.Frame] | None = None  # stack frames of the call that is being translated

    def constant(self, array: Any) -> np.ndarray:
        """Return the components of a constant array."""
        array = array if jnp.issubdtype(jnp.result_type(array), jax.dtypes.extended) else np.asarray(array)
        if not _has_kind(array.dtype):
            raise NoRuleError(f"a constant has the type {array.dtype}, but must have the type {TYPES}")
        if array.size > MAX_CONSTANTS:
            raise NoRuleError(f"a constant array has {array.size} numbers, but must have at most {MAX_CONSTANTS} in C")
        kind = kind_of(array.dtype)
        return object_array(array.shape, (self.pool.constant(v, kind) for v in array.reshape(-1)))

    def evaluate(self, closed: Any, args: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Return the components of a jaxpr's outputs, given the components of its inputs."""
        jaxpr, consts = open_jaxpr(closed)
        components_of: dict[Any, np.ndarray] = dict(zip(jaxpr.constvars, map(self.constant, consts), strict=True))
        components_of |= dict(zip(jaxpr.invars, args, strict=True))
        spans = [() if self.outer_frames else tuple(origins.stack_frames(eqn)[:1]) for eqn in jaxpr.eqns]
        for k, eqn in enumerate(jaxpr.eqns):
            values = [self.constant(v.val) if isinstance(v, core.Literal) else components_of[v] for v in eqn.invars]
            frames = self.outer_frames or origins.stack_frames(eqn)
            outer, self.pool.section = self.pool.section, origins.find_section(frames) or self.pool.section
            results = self.translate_equation(eqn, values, frames)
            self.pool.section = outer
            if self.outer_frames is None and (k + 1 == len(spans) or spans[k + 1] != spans[k]):
                self._name_results(results, origins.value_name(frames))
            for variable, result in zip(eqn.outvars, results, strict=True):
                components_of[variable] = result
        return [self.constant(v.val) if isinstance(v, core.Literal) else components_of[v] for v in jaxpr.outvars]

    def _name_results(self, results: Sequence[np.ndarray], title: str) -> None:
        if not title or title == "_" or len(results) != 1:
            return
        shared_title = Title(title)
        for index in np.ndindex(results[0].shape):
            node: Any = results[0][index]
            if node.title is None and node.op not in ("constant", "place"):
                node.title, node.indices = shared_title, "".join(str(i + 1) for i in index)

    def translate_equation(self, eqn: Any, values: list[np.ndarray], frames: list[origins.Frame]) -> list[np.ndarray]:
        """Return the components of one equation's outputs.

        Args:
            eqn: the equation of the trace.
            values: components of its inputs.
            frames: frames of its call stack, for sections and errors.

        Raises:
            NoRuleError: if an operation has no counterpart in C.
        """
        name, inner = eqn.primitive.name, called_jaxpr(eqn)
        if name == "custom_jvp_call" or name == "custom_vjp_call":
            inner = eqn.params.get("call_jaxpr", eqn.params.get("fun_jaxpr"))
            debug_info = getattr(getattr(inner, "jaxpr", inner), "debug_info", None)
            c_function = KNOWN_FUNCTIONS.get(getattr(debug_info, "func_name", ""))
            # a user's function may have the same name, so compare the file, too
            is_from_library = getattr(debug_info, "func_filename", None) == elementary.__file__
            if c_function is not None and is_from_library and len(eqn.outvars) == 1:
                shape = eqn.outvars[0].aval.shape
                return [self._map_entries(lambda *entry: self.pool.make(c_function, *entry), values, shape)]
        if _is_threefry(eqn):
            word_indices = [self.pool.constant(k, "int32_t") for k in (0, 1)]
            return [self._map_entries(lambda *entry, k=k: self.pool.make("threefry", *entry, k, kind="uint32_t"),
                               values, eqn.outvars[0].aval.shape) for k in word_indices]  # fmt: skip
        if inner is not None:
            outer, self.outer_frames = self.outer_frames, frames
            results = self.evaluate(inner, values)
            self.outer_frames = outer
            return results
        if not all(_has_kind(v.aval.dtype) for v in eqn.outvars):  # such as random keys and complex numbers
            raise self.unsupported_error(eqn, frames)
        if name in CONTROL:
            return CONTROL[name](self, eqn, values)
        if all(node.op == "constant" for value in values for node in value.flat):
            with jax.ensure_compile_time_eval():
                constants = [
                    jnp.asarray(_constant_values(value), v.aval.dtype)
                    for value, v in zip(values, eqn.invars, strict=True)
                ]
                return [self.constant(result) for result in components.bind(eqn, constants)]
        if _wraps_around(eqn):
            raise self.unsupported_error(eqn, frames)
        if name in ELEMENTWISE:
            result = self._elementwise(eqn, values)
            if result is not None:
                return [result]
        if name in _REDUCTIONS and (kind_of(eqn.outvars[0].aval.dtype) == BOOL or name not in _BOOL_REDUCTIONS):
            return [self._reduction(eqn, values[0])]
        if name == "dot_general":
            return [self._contraction(eqn, *values)]
        if name in _CUMULATIVE:
            return [self._cumulative(eqn, values[0])]
        if name in ("argmax", "argmin"):
            return [self._index_of_extreme(eqn, values[0])]
        if name in _MOVES or name in _INDEXED_ADDITIONS:
            result = self._move_entries(eqn, values)
            if result is not None:
                return result
        raise self.unsupported_error(eqn, frames)

    def unsupported_error(self, eqn: Any, frames: list[origins.Frame]) -> NoRuleError:
        """Return the error for a primitive without a rule: function and line in the source, and allowed functions."""
        line, primitive = origins.call_line(frames), eqn.primitive.name
        allowed = ALLOWED_LINEAR_ALGEBRA if primitive in LINEAR_ALGEBRA else ALLOWED_OPERATIONS
        name = origins.called_function(frames) or primitive
        return NoRuleError(f"`{name}`{f' ({line})' if line else ''} cannot be written in C, but must be {allowed}")

    def _map_entries(self, rule: Any, values: Sequence[np.ndarray], shape: tuple[int, ...]) -> np.ndarray:
        flat = [np.broadcast_to(v, shape).reshape(-1) for v in values]
        return object_array(shape, (rule(*entry) for entry in zip(*flat, strict=True)))

    def _elementwise(self, eqn: Any, values: Sequence[np.ndarray]) -> np.ndarray | None:
        aval = eqn.outvars[0].aval
        try:
            kind = kind_of(aval.dtype)
            rule = ELEMENTWISE[eqn.primitive.name]
            return self._map_entries(lambda *entry: rule(self.pool, eqn.params, kind, *entry), values, aval.shape)
        except KeyError:  # a type, or a variant of the primitive, that has no counterpart
            return None

    def _reduction(self, eqn: Any, value: np.ndarray) -> np.ndarray:
        op, kind = _REDUCTIONS[eqn.primitive.name], kind_of(eqn.outvars[0].aval.dtype)
        return components.reduce_entries(eqn, value, lambda row: self._fold(op, kind, row))

    def _fold(self, op: str, kind: str, items: Any) -> Node:
        items = list(items)
        total = items[0] if items else self.pool.constant(op == "and", kind)
        for item in items[1:]:
            total = self.pool.make(op, total, item, kind=kind)
        return total

    def _contraction(self, eqn: Any, left: np.ndarray, right: np.ndarray) -> np.ndarray:
        kind = kind_of(eqn.outvars[0].aval.dtype)
        total, product = ("or", "and") if kind == BOOL else ("add", "mul")

        def dot_product(row: np.ndarray, column: np.ndarray) -> Node:
            return self._fold(
                total, kind, (self.pool.make(product, *p, kind=kind) for p in zip(row, column, strict=True))
            )

        return components.contract_entries(eqn, left, right, dot_product)

    def _cumulative(self, eqn: Any, value: np.ndarray) -> np.ndarray:
        op, kind = _CUMULATIVE[eqn.primitive.name], kind_of(eqn.outvars[0].aval.dtype)
        return components.accumulate_entries(eqn, value, lambda *pair: self.pool.make(op, *pair, kind=kind))

    def _index_of_extreme(self, eqn: Any, value: np.ndarray) -> np.ndarray:
        (axis,), kind = eqn.params["axes"], kind_of(eqn.outvars[0].aval.dtype)
        test = "gt" if eqn.primitive.name == "argmax" else "lt"
        parts = np.moveaxis(value, axis, -1)

        def index_of_extreme(entries: np.ndarray) -> Node:
            best, best_index = entries[0], self.pool.constant(0, kind)
            for k, entry in enumerate(entries[1:], 1):
                is_better = self.pool.make(test, entry, best, kind=BOOL)
                best_index = self.pool.make("select", is_better, self.pool.constant(k, kind), best_index, kind=kind)
                best = self.pool.make("select", is_better, entry, best, kind=entry.kind)
            return best_index

        return object_array(parts.shape[:-1], (index_of_extreme(parts[i]) for i in np.ndindex(*parts.shape[:-1])))

    def _move_entries(self, eqn: Any, values: Sequence[np.ndarray]) -> list[np.ndarray] | None:
        """Translate a primitive that only moves or adds array entries, such as slice, gather and scatter.

        The indices may be constants or computed. The result is None if the primitive has no rule.
        """
        match eqn.primitive.name:
            case "dynamic_slice":
                arrays, indices = values[:1], values[1:]
            case "dynamic_update_slice":
                arrays, indices = values[:2], values[2:]
            case "gather" | "scatter" | "scatter-add" | "scatter-sub":
                arrays, indices = values[::2], values[1:2]
            case _:
                return components.pick_entries(eqn, values)
        return self._select_by_index(eqn, values, arrays, indices)

    def _select_by_index(
        self, eqn: Any, values: Sequence[np.ndarray], arrays: Sequence[np.ndarray], indices: Sequence[np.ndarray]
    ) -> list[np.ndarray] | None:
        """Translate a primitive with indices: at a computed index, C selects among the results for all indices."""
        flat_indices = [node for index_array in indices for node in index_array.flat]
        computed = [node for node in flat_indices if node.op != "constant"]
        if len({id(node) for node in computed}) > 1:
            return None
        if not computed:
            return [self._results_for_index(eqn, values, arrays, None, 0)]
        index, bound = computed[0], max(values[0].shape)
        row = self._read_table_row(eqn, values, arrays, index)
        if row is not None:
            return [row]
        lowest = 0 if index.kind.startswith("u") else -1
        # all indices beyond the end give the same result
        result = self._results_for_index(eqn, values, arrays, index, bound)
        for k in range(bound - 1, lowest - 1, -1):
            case = self._results_for_index(eqn, values, arrays, index, k)
            is_at_most = self.pool.make("le", index, self.pool.constant(k, index.kind), kind=BOOL)
            result = self._map_entries(
                lambda yes, no, is_at_most=is_at_most: self.pool.make("select", is_at_most, yes, no, kind=yes.kind),
                [case, result],
                case.shape,
            )
        return [result]

    def _read_table_row(
        self, eqn: Any, values: Sequence[np.ndarray], arrays: Sequence[np.ndarray], index: Node
    ) -> np.ndarray | None:
        """Translate a row of a parameter array at a computed index to table[index] in C; None for other operations.

        A selection among all indices would need an operation for each entry of the array.
        """
        table, count = values[0], len(values[0])
        if eqn.primitive.name != "dynamic_slice" or count < 2 or table.flat[0].op != "place":
            return None
        cases = [self._results_for_index(eqn, values, arrays, index, k) for k in (0, 1, count - 1)]
        for first, *others in zip(*(case.flat for case in cases), strict=True):
            expected = (first.value.replace("[0]", f"[{k}]", 1) for k in (1, count - 1)) if first.op == "place" else ()
            if [node.value for node in others] != [*expected]:
                return None
        low, high = (self.pool.constant(k, index.kind) for k in (0, count - 1))
        clipped = self.pool.make("min", self.pool.make("max", index, low, kind=index.kind), high, kind=index.kind)
        return self._map_entries(
            lambda node: self.pool.make("row", node, clipped, kind=node.kind), cases[:1], cases[0].shape
        )

    def _results_for_index(
        self, eqn: Any, values: Sequence[np.ndarray], arrays: Sequence[np.ndarray], index: Node | None, k: int
    ) -> np.ndarray:
        """Return the results of a primitive with indices for the case that the computed index `index` is k."""
        if eqn.primitive.name in _INDEXED_ADDITIONS:
            array, indices, addends = values
            return self._add_at_indices(eqn, array, indices, addends, index, k)
        entries: list[Node] = []
        positions: dict[int, np.ndarray] = {}
        for array in arrays:
            numbers = np.arange(len(entries), len(entries) + array.size, dtype=np.int32)
            positions[id(array)] = numbers.reshape(array.shape)
            entries += list(array.flat)
        entries.append(_fill_node(self.pool, eqn))
        operands = []
        for variable, value in zip(eqn.invars, values, strict=True):
            if id(value) in positions:
                operands.append(jnp.asarray(positions[id(value)]))
            else:
                operands.append(jnp.asarray(_constant_values(value, index, k), dtype=variable.aval.dtype))
        with jax.ensure_compile_time_eval():
            out = np.asarray(components.bind(_with_marked_fill(eqn), operands)[0])
        is_inside = (out >= 0) & (out < len(entries) - 1)
        chosen = (entries[i if ok else -1] for i, ok in zip(out.flat, is_inside.flat, strict=True))
        return object_array(out.shape, chosen)

    def _add_at_indices(
        self, eqn: Any, array: np.ndarray, indices: np.ndarray, addends: np.ndarray, index: Node | None, k: int
    ) -> np.ndarray:
        """Return an array with additions or subtractions at indices, if the computed index `index` is k."""
        numbers, types = _constant_values(indices, index, k), [variable.aval.dtype for variable in eqn.invars]
        total = array.copy()
        for position in np.ndindex(*addends.shape):  # find the entries that each number is added to
            unit_addend = np.zeros(addends.shape)
            unit_addend[position] = 1.0
            with jax.ensure_compile_time_eval():
                arrays = [
                    jnp.asarray(v, dtype)
                    for v, dtype in zip((np.zeros(array.shape), numbers, unit_addend), types, strict=True)
                ]
                is_changed = np.asarray(components.bind(eqn, arrays)[0])
            for entry in map(tuple, np.argwhere(is_changed)):
                operands: Any = total[entry], addends[position]
                total[entry] = self.pool.make(_INDEXED_ADDITIONS[eqn.primitive.name], *operands, kind=kind_of(types[0]))
        return total


def _is_threefry(eqn: Any) -> bool:
    """Return whether an equation is a call of `draws.threefry`. C has its own function with 32-bit integers."""
    jaxpr = getattr(eqn.params.get("jaxpr"), "jaxpr", None)
    info = getattr(jaxpr, "debug_info", None)
    return getattr(info, "func_filename", None) == draws.__file__ and eqn.params.get("name") == "threefry"


def _with_marked_fill(eqn: Any) -> Any:
    """Return the same gather for an array of indices instead of values; entries outside of the array become -1."""
    return eqn.replace(params={**eqn.params, "fill_value": -1}) if "fill_value" in eqn.params else eqn


def _fill_node(pool: Pool, eqn: Any) -> Node:
    """Return the fill value of a gather outside of the array; by default NaN, or an extreme of the integer type."""
    dtype, value = eqn.outvars[0].aval.dtype, eqn.params.get("fill_value")
    if value is None and jnp.issubdtype(dtype, jnp.integer):
        limits = jnp.iinfo(dtype)
        value = limits.min or limits.max
    elif value is None:
        value = math.nan  # becomes true if the type is bool
    return pool.constant(value, kind_of(dtype))


def _wraps_around(eqn: Any) -> bool:
    """Return whether the equation computes integers of 8 or 16 bits, which wrap around unlike C's of 32 bits."""
    is_narrow = any(jnp.issubdtype(v.aval.dtype, jnp.integer) and v.aval.dtype.itemsize < 4 for v in eqn.outvars)
    return is_narrow and eqn.primitive.name not in _PASS_THROUGH and any(v.aval.dtype != bool for v in eqn.invars)


def _has_kind(dtype: Any) -> bool:
    """Return whether a dtype has a C type."""
    try:
        return bool(kind_of(dtype))
    except KeyError:
        return False


def _constant_values(value: np.ndarray, index: Node | None = None, k: int = 0) -> np.ndarray:
    """Return the numbers of an array of constant nodes. The node `index` counts as the constant k."""
    return np.asarray([k if node is index else node.value for node in value.flat]).reshape(value.shape)


_REDUCTIONS = {"reduce_sum": "add", "reduce_max": "max", "reduce_min": "min", "reduce_prod": "mul", "reduce_and": "and",
          "reduce_or": "or"}  # fmt: skip
_BOOL_REDUCTIONS = ("reduce_and", "reduce_or")  # reductions with a rule for bool only, not for the bits of integers
_CUMULATIVE = {"cumsum": "add", "cumprod": "mul", "cummax": "max", "cummin": "min"}
_MOVES = set(
    "broadcast_in_dim concatenate expand_dims pad reshape rev slice split squeeze stack tile transpose unstack "
    "dynamic_slice dynamic_update_slice gather scatter".split()
)
_INDEXED_ADDITIONS = {"scatter-add": "add", "scatter-sub": "sub"}
# primitives that return some of their inputs, so that narrow integers cannot overflow
_PASS_THROUGH = {
    *_MOVES,
    *"clamp copy copy_p max min optimization_barrier reduce_max reduce_min select_n stop_gradient".split(),
}
