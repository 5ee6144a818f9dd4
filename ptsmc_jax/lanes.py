"""One trajectory, traced, evaluated component by component over many trials.

`lanes.vmap` computes what `jax.vmap` does. It traces the function for one trial and evaluates the trace with every
small array replaced by its components, each a vector over the trials: XLA's CPU backend vectorises arrays (trial,)
but not arrays (trial, 3). Reshapes and slices become permutations, small contractions become sums, and whatever does
not depend on the trial stays as it is. A primitive without a rule here goes through `jax.vmap` on its own.
"""

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
_LARGEST = 64

_ELEMENTWISE = set(
    """abs acos acosh add and asin asinh atan atan2 atanh cbrt ceil clamp convert_element_type
    copy copy_p cos cosh div eq erf erf_inv erfc exp exp2 expm1 floor ge gt integer_pow is_finite le log log1p
    logistic lt max min mul ne neg nextafter not or population_count pow real reduce_precision rem round rsqrt
    select_n shift_left shift_right_arithmetic shift_right_logical sign sin sinh sqrt square stop_gradient sub tan
    tanh xor""".split()
)
_STRUCTURAL = set("broadcast_in_dim concatenate expand_dims pad reshape rev slice squeeze transpose".split())
_REDUCTIONS = {
    "reduce_sum": lax.add,
    "reduce_max": lax.max,
    "reduce_min": lax.min,
    "reduce_prod": lax.mul,
    "reduce_and": lax.bitwise_and,
    "reduce_or": lax.bitwise_or,
}
_CALLS = set("jit pjit closed_call core_call remat remat2 checkpoint".split())


class _Lane:
    """A value that differs from trial to trial: as components, or dense as (trial, *shape), or both."""

    def __init__(self, shape: tuple[int, ...], parts: np.ndarray | None = None, dense: Array | None = None):
        self.shape, self._parts, self._dense = shape, parts, dense

    # What is computed here is not kept: inside a loop's body it belongs to that body alone.

    @property
    def parts(self) -> np.ndarray:
        """Object array of the value's shape, each entry (trial,) or, where equal in all trials, ()."""
        if self._parts is not None:
            return self._parts
        dense = self._dense
        assert dense is not None
        return _object_array(self.shape, (dense[(slice(None), *i)] for i in np.ndindex(*self.shape)))

    def apart(self) -> "_Lane":
        """The same value taken apart now, unless it is too large for that."""
        small = self._parts is None and np.prod(self.shape, dtype=int) <= _LARGEST
        return _Lane(self.shape, self.parts, self._dense) if small else self

    def dense(self, trials: int) -> Array:
        """(trial, *shape) array."""
        if self._dense is not None:
            return self._dense
        flat = [jnp.broadcast_to(part, (trials,)) for part in self.parts.flat]
        return jnp.stack(flat, axis=-1).reshape((trials, *self.shape)) if self.shape else flat[0]


def vmap(function: Callable, in_axes: Any = 0) -> Callable:
    """`jax.vmap(function, in_axes)` for axes 0 and None, evaluated by components; the outputs' trial axis is 0.

    Composes with jit, vmap, jvp and grad from outside. Raises ValueError where nothing is mapped.
    """

    def mapped(*args: Any) -> Any:
        axes = (in_axes,) * len(args) if in_axes is None or isinstance(in_axes, int) else tuple(in_axes)
        mapped_over = jax.tree.leaves(
            jax.tree.map(_spread, axes, args, is_leaf=lambda axis: axis is None or isinstance(axis, int))
        )
        leaves, tree = jax.tree.flatten(args)
        leaves = [jnp.asarray(leaf) for leaf in leaves]
        if any(on and not leaf.shape for leaf, on in zip(leaves, mapped_over, strict=True)):
            raise ValueError("a number has no axis to map over")
        sizes = {leaf.shape[0] for leaf, on in zip(leaves, mapped_over, strict=True) if on}
        if len(sizes) != 1:
            raise ValueError(f"the mapped arguments must share one number of trials, found {sorted(sizes)}")
        one = [
            jax.ShapeDtypeStruct(leaf.shape[1:] if on else leaf.shape, leaf.dtype, weak_type=leaf.weak_type)
            for leaf, on in zip(leaves, mapped_over, strict=True)
        ]
        closed, out = jax.make_jaxpr(function, return_shape=True)(*jax.tree.unflatten(tree, one))
        trials = sizes.pop()
        values = [
            _Lane(leaf.shape[1:], dense=leaf).apart() if on else leaf
            for leaf, on in zip(leaves, mapped_over, strict=True)
        ]
        results = _evaluate(closed.jaxpr, closed.consts, values, trials)
        return jax.tree.unflatten(jax.tree.structure(out), [_dense(value, trials) for value in results])

    return mapped


def _spread(axis: int | None, tree: Any) -> Any:
    """Whether each leaf under one entry of in_axes is mapped over."""
    if axis not in (None, 0):
        raise ValueError(f"in_axes may hold 0 and None only, found {axis}")
    return jax.tree.map(lambda _: axis == 0, tree)


def _object_array(shape: tuple[int, ...], items: Iterable) -> np.ndarray:
    array = np.empty(shape, dtype=object)
    for index, item in zip(np.ndindex(*shape), items, strict=True):
        array[index] = item
    return array


def _dense(value: Any, trials: int) -> Array:
    if isinstance(value, _Lane):
        return value.dense(trials)
    value = jnp.asarray(value)
    return jnp.broadcast_to(value, (trials, *value.shape))


def _parts(value: Any) -> np.ndarray:
    """Components of a value, lane or not."""
    if isinstance(value, _Lane):
        return value.parts
    value = jnp.asarray(value)
    return _object_array(value.shape, (value[i] for i in np.ndindex(*value.shape)))


def _evaluate(jaxpr: core.Jaxpr, consts: Sequence, args: Sequence, trials: int) -> list:
    """Values of the outputs of a trace, for arguments that are lanes or plain arrays."""
    known: dict = {}

    def write(variables: Sequence, values: Sequence) -> None:
        for variable, value in zip(variables, values, strict=True):
            empty = isinstance(value, _Lane) and 0 in value.shape  # nothing in it that could differ
            known[variable] = jnp.zeros(value.shape, variable.aval.dtype) if empty else value

    def read(atom: Any) -> Any:
        return atom.val if isinstance(atom, core.Literal) else known[atom]

    write([*jaxpr.constvars, *jaxpr.invars], [*consts, *args])
    for eqn in jaxpr.eqns:
        values = [read(atom) for atom in eqn.invars]
        if not any(isinstance(value, _Lane) for value in values):
            results = _bind(eqn, values)
        else:
            results = _apply(eqn, values, trials)
        write(eqn.outvars, results)
    return [read(atom) for atom in jaxpr.outvars]


def _bind(eqn: Any, values: Sequence) -> Sequence:
    out = eqn.primitive.bind(*values, **eqn.primitive.get_bind_params(eqn.params))
    return out if eqn.primitive.multiple_results else [out]


def _apply(eqn: Any, values: list, trials: int) -> Sequence:
    """One primitive with at least one lane among its operands."""
    name, params = eqn.primitive.name, eqn.params
    if name in _CALLS:
        inner = params["jaxpr"] if "jaxpr" in params else params["call_jaxpr"]
        if isinstance(inner, core.ClosedJaxpr):
            return _evaluate(inner.jaxpr, inner.consts, values, trials)
        return _evaluate(inner, (), values, trials)
    if name == "scan":
        return _scan(eqn, values, trials)
    sizes = [np.prod(v.aval.shape, dtype=int) for v in (*eqn.invars, *eqn.outvars)]
    if max(sizes) <= _LARGEST:
        if name in _ELEMENTWISE:
            return [_elementwise(eqn, values)]
        if name in _STRUCTURAL:
            return [_structural(eqn, values)]
        if name in _REDUCTIONS:
            return [_reduction(eqn, values[0])]
        numeric = eqn.outvars[0].aval.dtype != bool
        if name == "dot_general" and numeric and not any(params["dimension_numbers"][1]):
            return [_contraction(eqn, values)]
    dense = jax.vmap(lambda *v: _bind(eqn, v), [0 if isinstance(v, _Lane) else None for v in values])(
        *(v.dense(trials) if isinstance(v, _Lane) else v for v in values)
    )
    return [_Lane(out.shape[1:], dense=out) for out in dense]


def _call(eqn: Any, operands: Sequence) -> Array:
    """An elementwise primitive on components: those equal in all trials are spread over them if any is not."""
    shape = jnp.broadcast_shapes(*(np.shape(v) for v in operands))
    return _bind(eqn, [jnp.broadcast_to(v, shape) for v in operands])[0]


def _elementwise(eqn: Any, values: list) -> _Lane:
    shape = eqn.outvars[0].aval.shape
    parts = [np.broadcast_to(_parts(value), shape) for value in values]
    return _Lane(shape, _object_array(shape, (_call(eqn, [p[i] for p in parts]) for i in np.ndindex(*shape))))


def _structural(eqn: Any, values: list) -> _Lane:
    """Apply the primitive to the numbers of the components instead, and pick the components by the result."""
    pool, numbered = [], []
    for value in values:
        parts = _parts(value)
        numbered.append(np.arange(len(pool), len(pool) + parts.size, dtype=np.int32).reshape(parts.shape))
        pool += list(parts.flat)
    with jax.ensure_compile_time_eval():
        chosen = np.asarray(_bind(eqn, [jnp.asarray(n) for n in numbered])[0])
    return _Lane(chosen.shape, _object_array(chosen.shape, [pool[k] for k in chosen.flat]))


def _reduction(eqn: Any, value: _Lane) -> _Lane:
    kept = [a for a in range(len(value.shape)) if a not in eqn.params["axes"]]
    shape = tuple(value.shape[a] for a in kept)
    rows = value.parts.transpose([*kept, *eqn.params["axes"]]).reshape((*shape, -1))
    return _Lane(
        shape, _object_array(shape, (_fold(_REDUCTIONS[eqn.primitive.name], rows[i]) for i in np.ndindex(*shape)))
    )


def _fold(operation: Callable, items: Iterable) -> Array:
    return reduce(lambda a, b: operation(*jnp.broadcast_arrays(a, b)), items)


def _contraction(eqn: Any, values: list) -> _Lane:
    (left_axes, right_axes), _ = eqn.params["dimension_numbers"]
    kind = eqn.outvars[0].aval.dtype
    left, right = (np.vectorize(lambda part: lax.convert_element_type(part, kind), [object])(_parts(v)) for v in values)
    left = np.moveaxis(left, left_axes, range(-len(left_axes), 0))
    right = np.moveaxis(right, right_axes, range(-len(right_axes), 0))
    kept_left, kept_right = (array.shape[: array.ndim - len(left_axes)] for array in (left, right))
    left, right = left.reshape((*kept_left, -1)), right.reshape((*kept_right, -1))
    shape = (*kept_left, *kept_right)
    items = (
        _fold(lax.add, [a * b for a, b in zip(left[i], right[j], strict=True)])
        for i in np.ndindex(*kept_left)
        for j in np.ndindex(*kept_right)
    )
    return _Lane(shape, _object_array(shape, items))


def _scan(eqn: Any, values: list, trials: int) -> list:
    """lax.scan with carries as tuples of components; what does not depend on the trial stays as it is."""
    params = eqn.params
    body, constants, carried = params["jaxpr"], params["num_consts"], params["num_carry"]
    consts, init, xs = values[:constants], values[constants : constants + carried], values[constants + carried :]

    consts = [value.apart() if isinstance(value, _Lane) else value for value in consts]
    # which carries depend on the trial: those that start so, and those that a pass through the body makes so
    differs = [isinstance(value, _Lane) for value in init]
    while True:
        inputs = [*(isinstance(v, _Lane) for v in consts), *differs, *(isinstance(v, _Lane) for v in xs)]
        outputs = _dependence(body.jaxpr, inputs)
        wider = [a or b for a, b in zip(differs, outputs[:carried], strict=True)]
        if wider == differs:
            break
        differs = wider
    shapes = [v.aval.shape for v in body.jaxpr.invars]
    carry_shapes, x_shapes = shapes[constants : constants + carried], shapes[constants + carried :]
    out_shapes = [v.aval.shape for v in body.jaxpr.outvars]

    def spread(value: Any, laned: bool) -> Any:  # a flat tuple of (trial,) arrays, or the array itself
        if not laned:
            return value
        return tuple(jnp.broadcast_to(part, (trials,)) for part in _parts(value).flat)

    def gather(value: Any, shape: tuple[int, ...], laned: bool) -> Any:
        return _Lane(shape, _object_array(shape, value)) if laned else value

    def rows(value: Any) -> Any:
        if not isinstance(value, _Lane):
            return value
        dense = jnp.moveaxis(value.dense(trials), 0, 1)  # (time, trial, *shape)
        return tuple(dense[(slice(None), slice(None), *i)] for i in np.ndindex(*value.shape[1:]))

    def step(carry: tuple, x: tuple) -> tuple[tuple, tuple]:
        state = [gather(c, s, d) for c, s, d in zip(carry, carry_shapes, differs, strict=True)]
        row = [gather(r, s, isinstance(v, _Lane)) for r, s, v in zip(x, x_shapes, xs, strict=True)]
        out = _evaluate(body.jaxpr, body.consts, [*consts, *state, *row], trials)
        after = tuple(spread(v, d) for v, d in zip(out[:carried], differs, strict=True))
        return after, tuple(spread(v, d) for v, d in zip(out[carried:], outputs[carried:], strict=True))

    first = tuple(spread(v, d) for v, d in zip(init, differs, strict=True))
    last, ys = lax.scan(step, first, tuple(rows(v) for v in xs), params["length"], params["reverse"], params["unroll"])
    results = [gather(c, s, d) for c, s, d in zip(last, carry_shapes, differs, strict=True)]
    for y, shape, laned in zip(ys, out_shapes[carried:], outputs[carried:], strict=True):
        if laned:  # (component) of (time, trial) -> (trial, time, *shape)
            rows_of = (params["length"], *shape)
            dense = None if 0 in rows_of else jnp.moveaxis(jnp.stack(y, axis=-1), 0, 1).reshape((trials, *rows_of))
            y = _Lane(rows_of, np.empty(rows_of, dtype=object) if dense is None else None, dense)
        results.append(y)
    return results


def _dependence(jaxpr: core.Jaxpr, inputs: Sequence[bool]) -> list[bool]:
    """Which outputs of a trace depend on the trial, given which inputs do: on any operand that does."""
    known = dict(zip(jaxpr.invars, inputs, strict=True))

    def read(atom: Any) -> bool:
        return not isinstance(atom, core.Literal) and known.get(atom, False)

    for eqn in jaxpr.eqns:
        depends = [read(atom) for atom in eqn.invars]
        inner = eqn.params.get("jaxpr") if eqn.primitive.name in _CALLS else None
        if inner is not None and any(depends):
            results = _dependence(getattr(inner, "jaxpr", inner), depends)
        else:
            results = [any(depends)] * len(eqn.outvars)
        known.update(zip(eqn.outvars, results, strict=True))
    return [read(atom) for atom in jaxpr.outvars]
