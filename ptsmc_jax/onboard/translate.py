"""Translation of a jaxpr (trace) into scalar expressions.

As in `batching.lanes`, arrays are split into components: reshapes and slices move components, and small matrix products
are sums. Branches and loops become regions; short loops of fixed length are unrolled. A primitive without a rule is an
error.
"""

import functools
import itertools
import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn

from ptsmc_jax.batching import components
from ptsmc_jax.batching.components import object_array
from ptsmc_jax.batching.dependence import called_jaxpr, interpret, open_jaxpr
from ptsmc_jax.batching.lapack import NEVER_BATCHED, SIZE_LIMITED
from ptsmc_jax.numerics import draws, elementary
from ptsmc_jax.onboard import origins
from ptsmc_jax.onboard.control import CONTROL
from ptsmc_jax.onboard.expressions import BOOL, KINDS, Node, NoRuleError, Pool, kind_of, name_nodes
from ptsmc_jax.onboard.rules import ELEMENTWISE

MAX_CONSTANTS = 4096  # largest number of components of a constant array
LINEAR_ALGEBRA = SIZE_LIMITED | NEVER_BATCHED
ALLOWED_OPERATIONS = (
    "made of sums, products, quotients, powers, roots, elementary functions, comparisons, branches and loops of numbers"
)
ALLOWED_LINEAR_ALGEBRA = "plain arithmetic, or solve, determinant or smallest_eigenvalue of ptsmc_jax.numerics.matrices"
# functions, by file and name, that XLA computes by arithmetic, and that C has: in math.h, or as a helper
C_FUNCTIONS = {(elementary.__file__, "log"): "log", (elementary.__file__, "arctan2"): "atan2",
               (draws.__file__, "threefry"): "threefry"}  # fmt: skip

_REDUCTIONS = {"reduce_sum": "add", "reduce_max": "max", "reduce_min": "min", "reduce_prod": "mul", "reduce_and": "and",
          "reduce_or": "or"}  # fmt: skip
_CUMULATIVE = {"cumsum": "add", "cumprod": "mul", "cummax": "max", "cummin": "min"}
_MOVES = (
    "broadcast_in_dim concatenate expand_dims pad reshape rev slice split squeeze stack tile transpose unstack".split()
)
_INDEXED_MOVES = "dynamic_slice dynamic_update_slice gather scatter".split()
_INDEXED_ADDITIONS = {"scatter-add": "add", "scatter-sub": "sub"}


class Translator:
    """Evaluates jaxprs on arrays of expression nodes."""

    def __init__(self, pool: Pool):
        self.pool = pool
        self.outer_frames: list[origins.Frame] | None = None  # stack frames of the call that is being translated

    def constant(self, array: jax.typing.ArrayLike) -> np.ndarray:
        """Return the components of a constant array."""
        dtype = jnp.result_type(array)
        kind = kind_of(dtype)
        if not kind:
            raise NoRuleError(f"a constant has the type {dtype}, but must have one of the types {', '.join(KINDS)}")
        array = np.asarray(array)
        if array.size > MAX_CONSTANTS:
            raise NoRuleError(f"a constant array has {array.size} numbers, but must have at most {MAX_CONSTANTS} in C")
        return object_array(array.shape, (self.pool.constant(v, kind) for v in array.reshape(-1)))

    def evaluate(self, closed: ClosedJaxpr | Jaxpr, args: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Return the components of a jaxpr's outputs, given the components of its inputs."""
        jaxpr, consts = open_jaxpr(closed)
        all_frames = [self.outer_frames or origins.stack_frames(eqn) for eqn in jaxpr.eqns]
        # the last equation of an expression of the source has the value of the expression
        is_last = [frames[:1] != following[:1] for frames, following in itertools.pairwise([*all_frames, []])]
        frames_in_order = zip(all_frames, is_last, strict=True)

        def translate(eqn: JaxprEqn, values: list[np.ndarray]) -> list[np.ndarray]:
            frames, has_value = next(frames_in_order)
            outer, self.pool.section = self.pool.section, origins.section_heading(frames) or self.pool.section
            results = self.translate_equation(eqn, values, frames)
            self.pool.section = outer
            if self.outer_frames is None and has_value and len(results) == 1:
                name = origins.value_name(frames)
                if name not in ("", "_"):
                    name_nodes(results[0], name)
            return results

        return interpret(jaxpr, consts, args, self.constant, translate)

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
        if name in ("custom_jvp_call", "custom_vjp_call"):
            inner = eqn.params["call_jaxpr"]
        if inner is not None:
            info = open_jaxpr(inner)[0].debug_info
            function = C_FUNCTIONS.get((info.func_filename or "", info.func_name))
            if function is not None:
                return self._c_call(function, values, eqn)
            outer, self.outer_frames = self.outer_frames, frames
            results = self.evaluate(inner, values)
            self.outer_frames = outer
            return results
        if not all(kind_of(v.aval.dtype) for v in eqn.outvars):  # such as random keys and complex numbers
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
        if name in _MOVES:
            return components.pick_entries(eqn, values)
        try:
            return [self._translate_primitive(eqn, values)]
        except KeyError:  # the primitive, or this variant of it, has no counterpart
            raise self.unsupported_error(eqn, frames) from None

    def _c_call(self, function: str, values: Sequence[np.ndarray], eqn: Any) -> list[np.ndarray]:
        """Return the components of each result of a function that C has, an object array in the shape of the result."""
        shape = eqn.outvars[0].aval.shape
        if function != "threefry":
            return [_map_entries(lambda *entry: self.pool.make(function, *entry), values, shape)]
        word_indices = [self.pool.constant(k, "int32_t") for k in (0, 1)]
        return [_map_entries(lambda *entry, k=k: self.pool.make("threefry", *entry, k, kind="uint32_t"), values, shape)
                for k in word_indices]  # fmt: skip

    def _translate_primitive(self, eqn: Any, values: list[np.ndarray]) -> np.ndarray:
        """Return the components of the result of a primitive, an object array in the shape of the result.

        Raises KeyError if the primitive has no counterpart in C.
        """
        name, aval, pool = eqn.primitive.name, eqn.outvars[0].aval, self.pool
        kind = kind_of(aval.dtype)

        def fold(op: str, items: Sequence[Node]) -> Node:
            """Return the node of the sum, product, minimum or maximum of nodes, taken from the first to the last."""
            first, *others = items or [pool.constant(op in ("and", "mul"), kind)]
            return functools.reduce(partial(ELEMENTWISE[op], pool, eqn.params, kind), others, first)

        def dot_product(row: np.ndarray, column: np.ndarray) -> Node:
            total, product = ("or", "and") if kind == BOOL else ("add", "mul")
            return fold(total, [pool.make(product, *pair, kind=kind) for pair in zip(row, column, strict=True)])

        if name in _REDUCTIONS:
            return components.reduce_entries(eqn, values[0], lambda row: fold(_REDUCTIONS[name], list(row)))
        if name in _CUMULATIVE:
            return components.accumulate_entries(eqn, values[0], lambda *pair: fold(_CUMULATIVE[name], pair))
        if name == "dot_general":
            return components.contract_entries(eqn, values[0], values[1], dot_product)
        if name in ("argmax", "argmin"):
            return self._index_of_extreme(eqn, values[0], kind)
        if name in _INDEXED_MOVES or name in _INDEXED_ADDITIONS:
            return self._select_by_index(eqn, values)
        rule = partial(ELEMENTWISE[name], pool, eqn.params, kind)
        return _map_entries(rule, values, aval.shape)

    def unsupported_error(self, eqn: JaxprEqn, frames: list[origins.Frame]) -> NoRuleError:
        """Return the error for a primitive without a rule: function and line in the source, and allowed functions."""
        primitive, (function, line) = eqn.primitive.name, origins.describe_call(frames)
        allowed = ALLOWED_LINEAR_ALGEBRA if primitive in LINEAR_ALGEBRA else ALLOWED_OPERATIONS
        return NoRuleError(
            f"`{function or primitive}`{f' ({line})' if line else ''} cannot be written in C, but must be {allowed}"
        )

    def _index_of_extreme(self, eqn: JaxprEqn, value: np.ndarray, kind: str) -> np.ndarray:
        """Return the components of argmax or argmin: the first index of the extreme along the reduced axis."""
        test = "gt" if eqn.primitive.name == "argmax" else "lt"

        def index_of_extreme(entries: np.ndarray) -> Node:
            best, best_index = entries[0], self.pool.constant(0, kind)
            for k, entry in enumerate(entries[1:], 1):
                is_better = self.pool.make(test, entry, best, kind=BOOL)
                best_index = self.pool.make("select", is_better, self.pool.constant(k, kind), best_index, kind=kind)
                best = self.pool.make("select", is_better, entry, best, kind=entry.kind)
            return best_index

        return components.reduce_entries(eqn, value, index_of_extreme)

    def _select_by_index(self, eqn: JaxprEqn, values: Sequence[np.ndarray]) -> np.ndarray:
        """Translate a primitive with indices: at a computed index, C selects among the results for all indices.

        Raises:
            KeyError: if there are several computed indices.
        """
        count = {"dynamic_slice": 1, "dynamic_update_slice": 2}.get(eqn.primitive.name)  # number of arrays
        arrays, indices = (values[::2], values[1:2]) if count is None else (values[:count], values[count:])
        computed = {id(node): node for array in indices for node in array.flat if node.op != "constant"}
        if len(computed) > 1:
            raise KeyError(eqn.primitive.name)
        if not computed:
            return self._results_for_index(eqn, values, arrays, None, 0)
        (index,), bound = computed.values(), max(values[0].shape)
        row = self._read_table_row(eqn, values, arrays, index)
        if row is not None:
            return row
        lowest = 0 if index.kind.startswith("u") else -1
        # all indices beyond the end give the same result
        result = self._results_for_index(eqn, values, arrays, index, bound)
        for k in range(bound - 1, lowest - 1, -1):
            case = self._results_for_index(eqn, values, arrays, index, k)
            is_at_most = self.pool.make("le", index, self.pool.constant(k, index.kind), kind=BOOL)
            result = _map_entries(
                lambda yes, no, is_at_most=is_at_most: self.pool.make("select", is_at_most, yes, no, kind=yes.kind),
                [case, result],
                case.shape,
            )
        return result

    def _read_table_row(
        self, eqn: JaxprEqn, values: Sequence[np.ndarray], arrays: Sequence[np.ndarray], index: Node
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
        return _map_entries(
            lambda node: self.pool.make("row", node, clipped, kind=node.kind), cases[:1], cases[0].shape
        )

    def _results_for_index(
        self, eqn: Any, values: Sequence[np.ndarray], arrays: Sequence[np.ndarray], index: Node | None, k: int
    ) -> np.ndarray:
        """Return the results of a primitive that reads or writes at indices, for one value of the computed index.

        Args:
            eqn: the primitive.
            values: its operands.
            arrays: operands that it reads from.
            index: the index that C computes at run time; None: all indices are constants.
            k: the value of this index.

        Returns:
            Nodes in an object array of the shape of the result.
        """
        if eqn.primitive.name in _INDEXED_ADDITIONS:
            array, indices, addends = values
            return self._add_at_indices(eqn, array, indices, addends, index, k)
        entries: list[Node] = []
        positions: dict[int, np.ndarray] = {}
        for array in arrays:
            numbers = np.arange(len(entries), len(entries) + array.size, dtype=np.int32)
            positions[id(array)] = numbers.reshape(array.shape)
            entries += list(array.flat)
        if eqn.primitive.name == "gather":  # the position -1 marks entries outside of the array
            entries.append(self.pool.constant(_fill_value(eqn), kind_of(eqn.outvars[0].aval.dtype)))
            eqn = eqn.replace(params={**eqn.params, "fill_value": -1})
        operands = [
            jnp.asarray(positions[id(value)])
            if id(value) in positions
            else jnp.asarray(_constant_values(value, index, k), dtype=variable.aval.dtype)
            for variable, value in zip(eqn.invars, values, strict=True)
        ]
        with jax.ensure_compile_time_eval():
            out = np.asarray(components.bind(eqn, operands)[0])
        return object_array(out.shape, (entries[i] for i in out.flat))

    def _add_at_indices(
        self, eqn: Any, array: np.ndarray, indices: np.ndarray, addends: np.ndarray, index: Node | None, k: int
    ) -> np.ndarray:
        """Return an array with additions or subtractions at indices, if the computed index `index` is k."""
        units = np.eye(addends.size).reshape(-1, *addends.shape)
        values = np.zeros(array.shape), _constant_values(indices, index, k), units
        with jax.ensure_compile_time_eval():
            operands = [jnp.asarray(v, variable.aval.dtype) for v, variable in zip(values, eqn.invars, strict=True)]
            add_unit = jax.vmap(lambda unit: components.bind(eqn, [*operands[:2], unit])[0])
            is_changed = np.asarray(add_unit(operands[2]))  # by each number, (numbers, *array.shape)
        total, op, kind = array.copy(), _INDEXED_ADDITIONS[eqn.primitive.name], kind_of(eqn.outvars[0].aval.dtype)
        for number, *entry in np.argwhere(is_changed):
            pair: Any = total[tuple(entry)], addends.flat[number]
            total[tuple(entry)] = self.pool.make(op, *pair, kind=kind)
        return total


def _map_entries(rule: Callable, values: Sequence[np.ndarray], shape: tuple[int, ...]) -> np.ndarray:
    """Return the components of an elementwise function, an object array of this shape.

    The components of its arguments, `values`, are broadcast to the shape.
    """
    return object_array(shape, map(rule, *(np.broadcast_to(value, shape).flat for value in values)))


def _fill_value(eqn: Any) -> float:
    """Return the value of a gather outside of the array; by default NaN, or an extreme of the integer type."""
    dtype, value = eqn.outvars[0].aval.dtype, eqn.params["fill_value"]
    if value is None and jnp.issubdtype(dtype, jnp.integer):
        return jnp.iinfo(dtype).min or jnp.iinfo(dtype).max
    return math.nan if value is None else value  # NaN becomes true if the type is bool


def _constant_values(value: np.ndarray, index: Node | None = None, k: int = 0) -> np.ndarray:
    """Return the numbers of an array of constant nodes, in its shape. The node `index` counts as the constant k."""
    return np.asarray([k if node is index else node.value for node in value.flat]).reshape(value.shape)
