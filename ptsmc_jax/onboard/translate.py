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
from ptsmc_jax.batching.lapack import COUNTED, SHARED
from ptsmc_jax.numerics import draws, elementary
from ptsmc_jax.onboard import origins
from ptsmc_jax.onboard.control import CONTROL
from ptsmc_jax.onboard.expressions import BOOL, TYPES, Node, NoRuleError, Pool, Title, kind_of
from ptsmc_jax.onboard.rules import ELEMENTWISE, KNOWN_FUNCTIONS

MOST_NUMBERS = 4096  # largest number of components of a constant array
LINEAR_ALGEBRA = COUNTED | SHARED
PLAIN = (
    "made of sums, products, quotients, powers, roots, elementary functions, comparisons, branches and loops of numbers"
)
SMALL_MATRICES = "plain arithmetic, or solve, determinant or smallest_eigenvalue of ptsmc_jax.numerics.matrices"


class Translator:
    """Evaluates jaxprs on arrays of expression nodes."""

    def __init__(self, pool: Pool):
        self.pool = pool
        self.held: list[origins.Frame] | None = None  # stack frames of the call that is being translated

    def constant(self, array: Any) -> np.ndarray:
        """Return the components of a constant array."""
        array = array if jnp.issubdtype(jnp.result_type(array), jax.dtypes.extended) else np.asarray(array)
        if not _has_kind(array.dtype):
            raise NoRuleError(f"a constant has the type {array.dtype}, but must have the type {TYPES}")
        if array.size > MOST_NUMBERS:
            raise NoRuleError(f"a constant array has {array.size} numbers, but must have at most {MOST_NUMBERS} in C")
        kind = kind_of(array.dtype)
        return object_array(array.shape, (self.pool.constant(v, kind) for v in array.reshape(-1)))

    def evaluate(self, closed: Any, args: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Return the components of a jaxpr's outputs, given the components of its inputs."""
        jaxpr, consts = open_jaxpr(closed)
        known: dict[Any, np.ndarray] = dict(zip(jaxpr.constvars, map(self.constant, consts), strict=True))
        known |= dict(zip(jaxpr.invars, args, strict=True))
        spans = [() if self.held else tuple(origins.frames(eqn)[:1]) for eqn in jaxpr.eqns]
        for k, eqn in enumerate(jaxpr.eqns):
            values = [self.constant(v.val) if isinstance(v, core.Literal) else known[v] for v in eqn.invars]
            where = self.held or origins.frames(eqn)
            outer, self.pool.section = self.pool.section, origins.section(where) or self.pool.section
            results = self.apply(eqn, values, where)
            self.pool.section = outer
            if self.held is None and (k + 1 == len(spans) or spans[k + 1] != spans[k]):
                self._name(results, origins.title(where))
            for variable, result in zip(eqn.outvars, results, strict=True):
                known[variable] = result
        return [self.constant(v.val) if isinstance(v, core.Literal) else known[v] for v in jaxpr.outvars]

    def _name(self, results: Sequence[np.ndarray], title: str) -> None:
        if not title or title == "_" or len(results) != 1:
            return
        group = Title(title)
        for index in np.ndindex(results[0].shape):
            node: Any = results[0][index]
            if node.title is None and node.op not in ("constant", "place"):
                node.title, node.part = group, "".join(str(i + 1) for i in index)

    def apply(self, eqn: Any, values: list[np.ndarray], where: list[origins.Frame]) -> list[np.ndarray]:
        """Return the components of one equation's outputs.

        Args:
            eqn: the equation of the trace.
            values: components of its inputs.
            where: frames of its call stack, for sections and errors.

        Raises:
            NoRuleError: if an operation has no counterpart in C.
        """
        name, inner = eqn.primitive.name, called_jaxpr(eqn)
        if name == "custom_jvp_call" or name == "custom_vjp_call":
            inner = eqn.params.get("call_jaxpr", eqn.params.get("fun_jaxpr"))
            debug_info = getattr(getattr(inner, "jaxpr", inner), "debug_info", None)
            known = KNOWN_FUNCTIONS.get(getattr(debug_info, "func_name", ""))
            # a user's function may have the same name, so compare the file, too
            ours = getattr(debug_info, "func_filename", None) == elementary.__file__
            if known is not None and ours and len(eqn.outvars) == 1:
                return [self._each(lambda *entry: self.pool.make(known, *entry), values, eqn.outvars[0].aval.shape)]
        if _is_threefry(eqn):
            word = [self.pool.constant(k, "int32_t") for k in (0, 1)]
            return [self._each(lambda *entry, k=k: self.pool.make("threefry", *entry, k, kind="uint32_t"),
                               values, eqn.outvars[0].aval.shape) for k in word]  # fmt: skip
        if inner is not None:
            outer, self.held = self.held, where
            results = self.evaluate(inner, values)
            self.held = outer
            return results
        if not all(_has_kind(v.aval.dtype) for v in eqn.outvars):  # such as random keys and complex numbers
            raise self.refused(eqn, where)
        if name in CONTROL:
            return CONTROL[name](self, eqn, values)
        if all(node.op == "constant" for value in values for node in value.flat):
            with jax.ensure_compile_time_eval():
                known = [
                    jnp.asarray(_numbers(value), v.aval.dtype) for value, v in zip(values, eqn.invars, strict=True)
                ]
                return [self.constant(found) for found in components.bind(eqn, known)]
        if _wraps(eqn):
            raise self.refused(eqn, where)
        if name in ELEMENTWISE:
            found = self._elementwise(eqn, values)
            if found is not None:
                return [found]
        if name in _FOLDS and (kind_of(eqn.outvars[0].aval.dtype) == BOOL or name not in _LOGICAL):
            return [self._reduction(eqn, values[0])]
        if name == "dot_general":
            return [self._contraction(eqn, *values)]
        if name in _SCANS:
            return [self._cumulative(eqn, values[0])]
        if name in ("argmax", "argmin"):
            return [self._place_of_extreme(eqn, values[0])]
        if name in _MOVES or name in _ADDS:
            found = self._moved(eqn, values)
            if found is not None:
                return found
        raise self.refused(eqn, where)

    def refused(self, eqn: Any, where: list[origins.Frame]) -> NoRuleError:
        """Return the error for a primitive without a rule: function and line in the source, and allowed functions."""
        at, primitive = origins.line(where), eqn.primitive.name
        allowed = SMALL_MATRICES if primitive in LINEAR_ALGEBRA else PLAIN
        name = origins.function(where) or primitive
        return NoRuleError(f"`{name}`{f' ({at})' if at else ''} cannot be written in C, but must be {allowed}")

    def _each(self, rule: Any, values: Sequence[np.ndarray], shape: tuple[int, ...]) -> np.ndarray:
        flat = [np.broadcast_to(v, shape).reshape(-1) for v in values]
        return object_array(shape, (rule(*entry) for entry in zip(*flat, strict=True)))

    def _elementwise(self, eqn: Any, values: Sequence[np.ndarray]) -> np.ndarray | None:
        aval = eqn.outvars[0].aval
        try:
            kind = kind_of(aval.dtype)
            rule = ELEMENTWISE[eqn.primitive.name]
            return self._each(lambda *entry: rule(self.pool, eqn.params, kind, *entry), values, aval.shape)
        except KeyError:  # a type, or a variant of the primitive, that has no counterpart
            return None

    def _reduction(self, eqn: Any, value: np.ndarray) -> np.ndarray:
        op, kind = _FOLDS[eqn.primitive.name], kind_of(eqn.outvars[0].aval.dtype)
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

        def inner(row: np.ndarray, column: np.ndarray) -> Node:
            return self._fold(
                total, kind, (self.pool.make(product, *p, kind=kind) for p in zip(row, column, strict=True))
            )

        return components.contract_entries(eqn, left, right, inner)

    def _cumulative(self, eqn: Any, value: np.ndarray) -> np.ndarray:
        op, kind = _SCANS[eqn.primitive.name], kind_of(eqn.outvars[0].aval.dtype)
        return components.accumulate_entries(eqn, value, lambda *pair: self.pool.make(op, *pair, kind=kind))

    def _place_of_extreme(self, eqn: Any, value: np.ndarray) -> np.ndarray:
        (axis,), kind = eqn.params["axes"], kind_of(eqn.outvars[0].aval.dtype)
        test = "gt" if eqn.primitive.name == "argmax" else "lt"
        parts = np.moveaxis(value, axis, -1)

        def one(entries: np.ndarray) -> Node:
            best, at = entries[0], self.pool.constant(0, kind)
            for k, entry in enumerate(entries[1:], 1):
                beyond = self.pool.make(test, entry, best, kind=BOOL)
                at = self.pool.make("select", beyond, self.pool.constant(k, kind), at, kind=kind)
                best = self.pool.make("select", beyond, entry, best, kind=entry.kind)
            return at

        return object_array(parts.shape[:-1], (one(parts[i]) for i in np.ndindex(*parts.shape[:-1])))

    def _moved(self, eqn: Any, values: Sequence[np.ndarray]) -> list[np.ndarray] | None:
        """Translate a primitive that only moves or adds array entries, such as slice, gather and scatter.

        The indices may be constants or computed. The result is None if the primitive has no rule.
        """
        match eqn.primitive.name:
            case "dynamic_slice":
                arrays, places = values[:1], values[1:]
            case "dynamic_update_slice":
                arrays, places = values[:2], values[2:]
            case "gather" | "scatter" | "scatter-add" | "scatter-sub":
                arrays, places = values[::2], values[1:2]
            case _:
                return components.pick_entries(eqn, values)
        return self._indexed(eqn, values, arrays, places)

    def _indexed(
        self, eqn: Any, values: Sequence[np.ndarray], arrays: Sequence[np.ndarray], places: Sequence[np.ndarray]
    ) -> list[np.ndarray] | None:
        """Translate a primitive with indices: at a computed index, C selects among the results for all indices."""
        flat = [node for place in places for node in place.flat]
        open_places = [node for node in flat if node.op != "constant"]
        if len({id(node) for node in open_places}) > 1:
            return None
        if not open_places:
            return [self._at(eqn, values, arrays, None, 0)]
        chosen, bound = open_places[0], max(values[0].shape)
        row = self._row(eqn, values, arrays, chosen)
        if row is not None:
            return [row]
        least = 0 if chosen.kind.startswith("u") else -1
        index = self._at(eqn, values, arrays, chosen, bound)  # index beyond the end, where all results are equal
        for k in range(bound - 1, least - 1, -1):
            case = self._at(eqn, values, arrays, chosen, k)
            beyond = self.pool.make("le", chosen, self.pool.constant(k, chosen.kind), kind=BOOL)
            index = self._each(
                lambda yes, no, beyond=beyond: self.pool.make("select", beyond, yes, no, kind=yes.kind),
                [case, index],
                case.shape,
            )
        return [index]

    def _row(
        self, eqn: Any, values: Sequence[np.ndarray], arrays: Sequence[np.ndarray], chosen: Node
    ) -> np.ndarray | None:
        """Translate a row of a parameter array at a computed index to table[index] in C; None for other operations.

        A selection among all indices would need an operation for each entry of the array.
        """
        table, count = values[0], len(values[0])
        if eqn.primitive.name != "dynamic_slice" or count < 2 or table.flat[0].op != "place":
            return None
        cases = [self._at(eqn, values, arrays, chosen, k) for k in (0, 1, count - 1)]
        for first, *others in zip(*(case.flat for case in cases), strict=True):
            expected = (first.value.replace("[0]", f"[{k}]", 1) for k in (1, count - 1)) if first.op == "place" else ()
            if [node.value for node in others] != [*expected]:
                return None
        low, high = (self.pool.constant(k, chosen.kind) for k in (0, count - 1))
        index = self.pool.make("min", self.pool.make("max", chosen, low, kind=chosen.kind), high, kind=chosen.kind)
        return self._each(lambda node: self.pool.make("row", node, index, kind=node.kind), cases[:1], cases[0].shape)

    def _at(
        self, eqn: Any, values: Sequence[np.ndarray], arrays: Sequence[np.ndarray], chosen: Node | None, k: int
    ) -> np.ndarray:
        """Return the results of a primitive with indices for the case that the computed index `chosen` is k."""
        if eqn.primitive.name in _ADDS:
            array, at, more = values
            return self._added(eqn, array, at, more, chosen, k)
        pool: list[Node] = []
        numbered: dict[int, np.ndarray] = {}
        for array in arrays:
            numbered[id(array)] = np.arange(len(pool), len(pool) + array.size, dtype=np.int32).reshape(array.shape)
            pool += list(array.flat)
        pool.append(_filling(self.pool, eqn))
        operands = []
        for variable, value in zip(eqn.invars, values, strict=True):
            if id(value) in numbered:
                operands.append(jnp.asarray(numbered[id(value)]))
            else:
                operands.append(jnp.asarray(_numbers(value, chosen, k), dtype=variable.aval.dtype))
        with jax.ensure_compile_time_eval():
            out = np.asarray(components.bind(_numbering(eqn), operands)[0])
        inside = (out >= 0) & (out < len(pool) - 1)
        return object_array(out.shape, (pool[i if ok else -1] for i, ok in zip(out.flat, inside.flat, strict=True)))

    def _added(
        self, eqn: Any, array: np.ndarray, places: np.ndarray, more: np.ndarray, chosen: Node | None, k: int
    ) -> np.ndarray:
        """Return an array with additions or subtractions at indices, if the computed index `chosen` is k."""
        known, types = _numbers(places, chosen, k), [variable.aval.dtype for variable in eqn.invars]
        total = array.copy()
        for index in np.ndindex(*more.shape):  # find the entries that each number is added to
            one = np.zeros(more.shape)
            one[index] = 1.0
            with jax.ensure_compile_time_eval():
                arrays = [
                    jnp.asarray(v, dtype) for v, dtype in zip((np.zeros(array.shape), known, one), types, strict=True)
                ]
                hit = np.asarray(components.bind(eqn, arrays)[0])
            for at in map(tuple, np.argwhere(hit)):
                both: Any = total[at], more[index]
                total[at] = self.pool.make(_ADDS[eqn.primitive.name], *both, kind=kind_of(types[0]))
        return total


def _is_threefry(eqn: Any) -> bool:
    """Return whether an equation is a call of `draws.threefry`. C has its own function with 32-bit integers."""
    jaxpr = getattr(eqn.params.get("jaxpr"), "jaxpr", None)
    info = getattr(jaxpr, "debug_info", None)
    return getattr(info, "func_filename", None) == draws.__file__ and eqn.params.get("name") == "threefry"


def _numbering(eqn: Any) -> Any:
    """Return the same gather for an array of indices instead of values; entries outside of the array become -1."""
    return eqn.replace(params={**eqn.params, "fill_value": -1}) if "fill_value" in eqn.params else eqn


def _filling(pool: Pool, eqn: Any) -> Node:
    """Return the fill value of a gather outside of the array; by default NaN, or an extreme of the integer type."""
    dtype, value = eqn.outvars[0].aval.dtype, eqn.params.get("fill_value")
    if value is None and jnp.issubdtype(dtype, jnp.integer):
        limits = jnp.iinfo(dtype)
        value = limits.min or limits.max
    elif value is None:
        value = math.nan  # becomes true if the type is bool
    return pool.constant(value, kind_of(dtype))


def _wraps(eqn: Any) -> bool:
    """Return whether the equation computes integers of 8 or 16 bits, which wrap around unlike C's of 32 bits."""
    narrow = any(jnp.issubdtype(v.aval.dtype, jnp.integer) and v.aval.dtype.itemsize < 4 for v in eqn.outvars)
    return narrow and eqn.primitive.name not in _KEPT and any(v.aval.dtype != bool for v in eqn.invars)


def _has_kind(dtype: Any) -> bool:
    """Return whether a dtype has a C type."""
    try:
        return bool(kind_of(dtype))
    except KeyError:
        return False


def _numbers(value: np.ndarray, chosen: Node | None = None, k: int = 0) -> np.ndarray:
    """Return the numbers of an array of constant nodes. The node `chosen` counts as the constant k."""
    return np.asarray([k if node is chosen else node.value for node in value.flat]).reshape(value.shape)


_FOLDS = {"reduce_sum": "add", "reduce_max": "max", "reduce_min": "min", "reduce_prod": "mul", "reduce_and": "and",
          "reduce_or": "or"}  # fmt: skip
_LOGICAL = ("reduce_and", "reduce_or")  # reductions with a rule for bool only, not for the bits of integers
_SCANS = {"cumsum": "add", "cumprod": "mul", "cummax": "max", "cummin": "min"}
_MOVES = set(
    "broadcast_in_dim concatenate expand_dims pad reshape rev slice split squeeze stack tile transpose unstack "
    "dynamic_slice dynamic_update_slice gather scatter".split()
)
_ADDS = {"scatter-add": "add", "scatter-sub": "sub"}
# primitives that return some of their inputs, so that narrow integers cannot overflow
_KEPT = {
    *_MOVES,
    *"clamp copy copy_p max min optimization_barrier reduce_max reduce_min select_n stop_gradient".split(),
}
