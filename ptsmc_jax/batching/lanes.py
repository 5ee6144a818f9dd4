"""`jax.vmap` and `jax.jvp` in structure-of-arrays form: a jaxpr is evaluated component by component over a batch.

XLA's CPU backend vectorises arrays (trials,), but not arrays (trials, 3). So `lanes.vmap` traces a function for one
trial and interprets its jaxpr with every small array of its loops replaced by components, each an array (trials,):

- Elementwise primitives are applied to each component. Reshapes and slices permute components. Small contractions
  become sums of products. `components` has these rules.
- Values that do not depend on the trial stay unbatched: their loops carry scalars, their branches stay branches.
- Equations outside of loops go through `jax.vmap`. They run once, so components would only prolong the compilation.
- Loops, branches and functions with custom derivative rules are traced again, with components as operands.
- Large arrays, and primitives without a rule, go through `jax.vmap`.

`lanes.jvp` differentiates the jaxpr of one trial. So tangents have a second batch axis, the direction, and a value is
batched over trials, over directions, over both or not at all (`BatchedArray.axes`).
"""

import warnings
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from ptsmc_jax import configure
from ptsmc_jax.batching import components, dependence, lapack
from ptsmc_jax.batching.components import DIRECTION, TRIAL, BatchedArray
from ptsmc_jax.batching.dependence import union
from ptsmc_jax.numerics import stacking


class LanesWarning(UserWarning):
    """A primitive without a rule was evaluated by `jax.vmap`, or a kernel became a scan: correct, but slower."""


def vmap(function: Callable, in_axes: Any = 0, *, kernel: bool = False) -> Callable:
    """Vectorise a function over trials, like `jax.vmap(function, in_axes)`, in structure-of-arrays form.

    The result composes with jit, vmap, jvp and grad from outside.

    Args:
        function: a function of arrays in pytrees.
        in_axes: 0, None or a tuple of pytree prefixes of these, one for each argument.
        kernel: run long loops as one kernel of an accelerator where possible, see `kernel`. Such a loop has no
            derivative from outside.

    Returns:
        The function of batched arguments. Its outputs have the trials as first axis.

    Raises:
        ValueError: No argument is mapped, or the numbers of trials differ.

    >>> crosses = vmap(lambda a: jnp.cross(a, jnp.array([0.0, 0.0, 1.0])))
    >>> crosses(jnp.array([[1.0, 0.0, 0.0], [0.0, 2.0, 0.0]])).tolist()
    [[0.0, -1.0, 0.0], [2.0, 0.0, 0.0]]
    """

    def batched_function(*args: Any) -> Any:
        """Return the outputs of `function` for all trials."""
        trials, one_trial, values = _batched_arguments(args, in_axes)
        closed, out = jax.make_jaxpr(function, return_shape=True)(*one_trial)
        results = _Interpreter(trials, use_kernel=kernel).evaluate(dependence.eliminate_dead_code(closed), values)
        return jax.tree.unflatten(jax.tree.structure(out), [value.to_array((trials,)) for value in results])

    return batched_function


def jvp(function: Callable, in_axes: Any = 0, *, kernel: bool = False) -> Callable:
    """Vectorise a function over trials, together with its derivatives along several directions.

    The derivative is taken of the jaxpr of one trial, which is many times shorter than the jaxpr of its components.

    Args:
        function: a function of arrays in pytrees.
        in_axes: mapped axes of the arguments, as in `vmap`.
        kernel: run long loops as one kernel, as in `vmap`.

    Returns:
        (arguments, directions) -> (values, tangents). Both parameters are tuples. A direction is a pytree like its
        argument, with leaves (directions, ...) or (directions, trials, ...), or None for a constant argument. The
        values are (trials, ...), the tangents (directions, trials, ...).

    >>> square, tangent = jvp(lambda x: x**2)((jnp.array([3.0, 4.0]),), (jnp.ones((1, 2)),))
    >>> square.tolist(), tangent.tolist()
    ([9.0, 16.0], [[6.0, 8.0]])
    """

    def values_and_tangents(args: tuple, directions: tuple) -> tuple[Any, Any]:
        """Return the values of the function for all trials, and its derivatives along all directions."""
        trials, one_trial, values = _batched_arguments(args, in_axes)
        active = [k for k, along in enumerate(directions) if along is not None]  # arguments with a direction
        if not active or len(directions) > len(args):
            raise ValueError(f"directions must be of some of the {len(args)} arguments, found {len(active)}")

        def value_and_tangent(one_trial: tuple, tangents: tuple) -> tuple[Any, Any]:
            def call_with_active_arguments(*replacements: Any) -> Any:
                return function(*(dict(enumerate(one_trial)) | dict(zip(active, replacements, strict=True))).values())

            return jax.jvp(call_with_active_arguments, tuple(one_trial[k] for k in active), tangents)

        along = [jnp.asarray(leaf) for leaf in jax.tree.leaves(directions)]
        closed, out = jax.make_jaxpr(value_and_tangent, return_shape=True)(
            one_trial, tuple(one_trial[k] for k in active)
        )
        shapes = [v.aval.shape for v in closed.jaxpr.invars[len(values) :]]
        count = along[0].shape[0] if along[0].ndim else 0
        values += [_batch_directions(leaf, shape, count, trials) for leaf, shape in zip(along, shapes, strict=True)]
        results = _Interpreter(trials, count, kernel).evaluate(dependence.eliminate_dead_code(closed), values)
        half = len(results) // 2
        batches = [(trials,)] * half + [(count, trials)] * half
        return jax.tree.unflatten(jax.tree.structure(out), list(map(BatchedArray.to_array, results, batches)))

    return values_and_tangents


def _batched_arguments(args: tuple, in_axes: Any) -> tuple[int, tuple, list[BatchedArray]]:
    """Return the number of trials, the arguments of one trial as shapes, and the batched leaves."""
    axes = (in_axes,) * len(args) if in_axes is None or isinstance(in_axes, int) else tuple(in_axes)
    mapped = jax.tree.map(_is_mapped, axes, is_leaf=lambda axis: axis is None)
    leaves, tree = jax.tree.flatten(args)
    is_mapped = jax.tree.leaves(jax.tree.broadcast(mapped, args))
    leaves = [(jnp.asarray(leaf), on) for leaf, on in zip(leaves, is_mapped, strict=True)]
    if any(on and not leaf.shape for leaf, on in leaves):
        raise ValueError("a number has no axis to map over")
    sizes = {leaf.shape[0] for leaf, on in leaves if on}
    if len(sizes) != 1:
        raise ValueError(f"the mapped arguments must share one number of trials, found {sorted(sizes)}")
    one_trial = [jax.ShapeDtypeStruct(v.shape[on:], v.dtype, weak_type=jax.typeof(v).weak_type) for v, on in leaves]
    values = [BatchedArray(v.shape[1:], array=v) if on else BatchedArray.unbatched(v) for v, on in leaves]
    return sizes.pop(), jax.tree.unflatten(tree, one_trial), values


def _is_mapped(axis: int | None) -> bool:
    """Return whether an entry of in_axes maps axis 0. Raise ValueError for entries other than 0 and None."""
    if axis not in (None, 0):
        raise ValueError(f"in_axes may hold 0 and None only, found {axis}")
    return axis == 0


def _batch_directions(along: Array, shape: tuple[int, ...], count: int, trials: int) -> BatchedArray:
    """Return the directions of differentiation of an argument as a batched array.

    Args:
        along: directions (count, *shape), equal for all trials, or (count, trials, *shape).
        shape: shape of the argument in one trial.
        count: number of directions.
        trials: number of trials.
    """
    if along.shape == (count, *shape):
        return BatchedArray(shape, array=along[:, None], axes=DIRECTION)
    if along.shape == (count, trials, *shape):
        return BatchedArray(shape, array=along, axes=TRIAL | DIRECTION)
    raise ValueError(f"{count} directions of {shape} in {trials} trials cannot be of shape {along.shape}")


class _Interpreter:
    """Evaluates jaxprs on batched arrays.

    Args:
        trials: size of the batch.
        directions: number of directions of tangents, 0 without tangents.
        use_kernel: run long scans as a kernel.
        in_loop: evaluate the equations by components, because they are in a loop.
    """

    def __init__(self, trials: int, directions: int = 0, use_kernel: bool = False, in_loop: bool = False):
        self.trials, self.directions, self.use_kernel, self.in_loop = trials, directions, use_kernel, in_loop
        self.batch_shapes = ((), (trials,), (directions, 1), (directions, trials))  # batch shape by `BatchedArray.axes`
        self.rules = components.ComponentRules()

    def evaluate(self, closed: Any, arguments: Sequence[BatchedArray]) -> list[BatchedArray]:
        """Return the outputs of a jaxpr for batched arguments."""
        jaxpr, consts = dependence.open_jaxpr(closed)
        arguments = _unbatch_empty(arguments, jaxpr.invars)
        return dependence.interpret(jaxpr, consts, arguments, BatchedArray.unbatched, self.apply)

    def evaluate_inside(
        self, closed: Any, arguments: Sequence[BatchedArray], *, in_loop: bool = False
    ) -> list[BatchedArray]:
        """Return the outputs of a jaxpr inside a function that JAX traces, by a separate interpreter.

        Arrays of the inner trace must not be stored in this interpreter.
        """
        return _Interpreter(self.trials, self.directions, in_loop=in_loop or self.in_loop).evaluate(closed, arguments)

    def apply(self, eqn: Any, values: list[BatchedArray]) -> list[BatchedArray]:
        """Return the results of one equation."""
        if union(_axes(values)):
            return _unbatch_empty(self.apply_batched(eqn, values), eqn.outvars)
        zeros = components.zero_tangent(eqn) if self.directions else None
        results = components.bind(eqn, [value.array for value in values]) if zeros is None else [zeros]
        return list(map(BatchedArray.unbatched, results))

    def apply_batched(self, eqn: Any, values: list[BatchedArray]) -> list[BatchedArray]:
        """Return the results of one equation with at least one batched operand."""
        name, inner, axes = eqn.primitive.name, dependence.called_jaxpr(eqn), union(_axes(values))
        if inner is not None:
            return self.evaluate(inner, values)
        if name in _CONTROL_FLOW:
            return _CONTROL_FLOW[name](self, eqn, values)
        if axes == DIRECTION or not self.in_loop:  # components would not be faster
            return self.apply_to_arrays(eqn, values)
        if not components.has_rule(name):
            message = f"lanes have no rule for the primitive `{name}`{dependence.source_location(eqn)}"
            warnings.warn(f"{message}: jax.vmap evaluates it, which may be slow", LanesWarning, stacklevel=2)
        results = self.rules.apply(eqn, values)
        if results is None:
            return self.apply_to_arrays(eqn, values)
        return [BatchedArray.of_components(parts, axes) for parts in results]

    def apply_to_arrays(self, eqn: Any, values: list[BatchedArray]) -> list[BatchedArray]:
        """Return the results of one equation by `jax.vmap`, or by a sequential map, see `lapack`."""
        axes = union(_axes(values))

        def mapped_array(value: BatchedArray) -> Any:
            """Return a value as one array. Its first axes are the batch axes over which `jax.vmap` maps it."""
            array = value.to_array(self.batch_shapes[value.axes]) if value.axes else value.array
            return array[:, 0] if value.axes == DIRECTION else array

        is_small = all(components.is_small(v.aval.shape) for v in (*eqn.invars, *eqn.outvars))
        bind = components.contract if eqn.primitive.name == "dot_general" and is_small else components.bind

        def function(*operands: Any) -> Any:
            return bind(eqn, operands)

        size = (self.trials if axes & TRIAL else 1) * (self.directions if axes & DIRECTION else 1)
        transform = lapack.choose_vmap([eqn], size)
        for axis in (TRIAL, DIRECTION):
            if axes & axis:
                function = transform(function, [0 if value.axes & axis else None for value in values])
        arrays = [out[:, None] if axes == DIRECTION else out for out in function(*map(mapped_array, values))]
        return [BatchedArray(out.shape[len(self.batch_shapes[axes]) :], array=out, axes=axes) for out in arrays]

    def align(self, values: Sequence[BatchedArray], axes: Sequence[int]) -> list[BatchedArray]:
        """Return values as loops and branches carry them: equal shapes and axes give equal leaves.

        Small arrays become components, each broadcast to the batch. Large ones, and those that are equal in all trials,
        become arrays.
        """
        return [self._align_one(*item) for item in zip(values, axes, strict=True)]

    def _align_one(self, value: BatchedArray, axes: int) -> BatchedArray:
        """Return a value with these batch axes (0, TRIAL, DIRECTION or their sum), broadcast if needed; see `align`."""
        if not axes and value.array is not None:
            return BatchedArray(value.shape, array=value.array, axes=0)
        batch = self.batch_shapes[axes]
        if not _carried_as_components(value.shape, axes):
            return BatchedArray(value.shape, array=value.to_array(batch), axes=axes)
        parts = tuple(jnp.broadcast_to(part, batch) for part in value.components.flat)
        return BatchedArray(value.shape, parts, axes=axes)

    def scan(self, eqn: Any, values: list[BatchedArray]) -> list[BatchedArray]:
        """Return the results of `lax.scan`."""
        params, body = eqn.params, eqn.params["jaxpr"]
        consts, init, xs = dependence.split_scan_operands(params, values)
        consts, count = _split_all(consts), len(init)
        axes = dependence.scan_dependence(body.jaxpr, *map(_axes, (consts, init, xs)))
        if self.use_kernel:
            last = self.scan_in_kernel(params, [*consts, *_split_all(init), *xs], axes[:count])
            if last is not None:
                return last

        def step(carry: list, x: list) -> tuple[list, list]:
            results = self.align(self.evaluate_inside(body, [*consts, *carry, *x], in_loop=True), axes)
            return results[:count], results[count:]

        rows = [self.rows(x) for x in xs]
        options = {name: params[name] for name in ("length", "reverse", "unroll")}
        last, outputs = stacking.scan(step, self.align(init, axes[:count]), rows, **options)
        return [*last, *(self.stack_rows(value, params["length"]) for value in outputs)]

    def rows(self, value: BatchedArray) -> BatchedArray:
        """Return the rows that a scan iterates over: arrays of value.shape[1:], whose leaves have the time first."""
        shape, batch = value.shape[1:], self.batch_shapes[value.axes]
        if not value.axes:
            return BatchedArray(shape, array=value.array, axes=0)
        array = jnp.moveaxis(value.to_array(batch), len(batch), 0)  # (time, *batch, *shape)
        if not _carried_as_components(shape, value.axes):
            return BatchedArray(shape, array=array, axes=value.axes)
        return BatchedArray.of_components(components.entries(array, 1 + len(batch)), value.axes)

    def stack_rows(self, value: BatchedArray, length: int) -> BatchedArray:
        """Return the array (length, *value.shape) of rows, whose leaves have the time first."""
        shape, batch, axes = (length, *value.shape), self.batch_shapes[value.axes], value.axes
        if not axes:
            return BatchedArray.unbatched(value.array)
        if 0 in shape:
            return BatchedArray(shape, (), axes=axes)
        split = _carried_as_components(value.shape, axes)
        if self.in_loop and split and components.is_small(shape):
            rows = (lax.index_in_dim(part, k, 0, keepdims=False) for k in range(length) for part in value.parts or ())
            return BatchedArray(shape, tuple(rows), axes=axes)
        array = jnp.stack(value.parts or (), axis=-1) if split else value.array
        return BatchedArray(shape, array=jnp.moveaxis(array, 0, len(batch)).reshape((*batch, *shape)), axes=axes)

    def scan_in_kernel(self, params: Any, values: list[BatchedArray], axes: Sequence[int]) -> list | None:
        """Return the last carries of a scan that runs as a kernel, or None if it must remain a `lax.scan`."""
        from ptsmc_jax.batching import kernel  # imported on demand: Pallas takes a while

        batch = self.batch_shapes[TRIAL | DIRECTION if self.directions else TRIAL]
        try:
            last = kernel.scan(params, values, [flags & TRIAL for flags in axes], batch, configure.backend() == "cpu")
        except NotImplementedError as error:
            warnings.warn(f"a loop runs step by step, which may be slow: {error}", LanesWarning, stacklevel=2)
            return None

        def drop_equal_axes(parts: np.ndarray, axes: int) -> BatchedArray:
            """Return a carry with the batch axes `axes` over which it differs. The kernel returns it with all axes."""

            def drop_from_component(part: Array) -> Array:
                """Return a component (trials,) or (directions, trials) without its equal axes."""
                part = part if axes & DIRECTION or part.ndim == 1 else part[0]
                return part if axes & TRIAL else part[..., :1] if axes else part[0]

            axes = axes if parts.size else TRIAL
            return self._align_one(jax.tree.map(drop_from_component, BatchedArray.of_components(parts, axes)), axes)

        return last and list(map(drop_equal_axes, last, axes))

    def while_loop(self, eqn: Any, values: list[BatchedArray]) -> list[BatchedArray]:
        """Return the results of `lax.while_loop`. A trial whose test is false keeps its carries."""
        test, body, test_consts, body_consts, init = dependence.unpack_while(eqn, values)
        test_consts, body_consts = _split_all(test_consts), _split_all(body_consts)
        axes, test_axes = dependence.while_dependence(test, body, *map(_axes, (test_consts, body_consts, init)))

        def is_running(carry: list) -> Any:
            """Return the result of the test: a scalar, or an array over the batch if it differs by trial."""
            (value,) = self.evaluate_inside(test, [*test_consts, *carry], in_loop=True)
            return value.to_array(self.batch_shapes[test_axes]) if test_axes else value.array

        def step_running_trials(carry: list) -> list:
            """Return the carries after one step. A trial whose test is false keeps its carries."""
            after = self.align(self.evaluate_inside(body, [*body_consts, *carry], in_loop=True), axes)
            if not test_axes:
                return after
            running = is_running(carry)
            return [self._map_leaves(jnp.where, running, new, old) for new, old in zip(after, carry, strict=True)]

        proceed = (lambda carry: jnp.any(is_running(carry))) if test_axes else is_running
        return lax.while_loop(proceed, step_running_trials, self.align(init, axes))

    def _map_leaves(self, function: Callable, condition: Array, *values: BatchedArray) -> BatchedArray:
        """Return function(condition, *leaves) for the leaves of values with equal axes.

        Args:
            function: (condition, *leaves) -> leaf.
            condition: array over the batch.
            *values: values with equal batch axes and shapes.
        """
        batch_axes = len(self.batch_shapes[values[0].axes])

        def call_with_condition(*leaves: Array) -> Array:
            return function(condition.reshape(condition.shape + (1,) * (leaves[0].ndim - batch_axes)), *leaves)

        return jax.tree.map(call_with_condition, *values)

    def cond(self, eqn: Any, values: list[BatchedArray]) -> list[BatchedArray]:
        """Return the results of `lax.cond` and `lax.switch`: of all branches if trials differ in the index."""
        index, *operands = values
        branches = eqn.params["branches"]
        operands = operands if index.axes else _split_all(operands)
        axes = dependence.branch_dependence(branches, index.axes, _axes(operands))

        def run_branch(branch: Any, operands: Sequence[BatchedArray]) -> list[BatchedArray]:
            return self.align(self.evaluate_inside(branch, operands), axes)

        if not index.axes:
            return lax.switch(index.array, [partial(run_branch, branch, operands) for branch in branches])
        which = index.to_array(self.batch_shapes[index.axes])
        which = which if which.dtype == bool else jnp.clip(which, 0, len(branches) - 1)
        cases = [
            run_branch(branch, self._stop_gradients(eqn, operands, which == k)) for k, branch in enumerate(branches)
        ]

        def choose(which: Array, *leaves: Array) -> Array:
            return lax.select_n(jnp.broadcast_to(which, leaves[0].shape), *leaves)

        return [self._map_leaves(choose, which, *results) for results in zip(*cases, strict=True)]

    def _stop_gradients(self, eqn: Any, operands: Sequence[BatchedArray], selected: Array) -> list[BatchedArray]:
        """Return operands of a branch without gradients in the trials that do not select it.

        A derivative may be infinite there, and reverse mode would multiply it by zero. `jax.vmap` does the same.
        """

        def keep_selected_gradients(selected: Array, leaf: Array) -> Array:
            return jnp.where(selected, leaf, lax.stop_gradient(leaf))

        def stop_gradient_if_unselected(value: BatchedArray, variable: Any) -> BatchedArray:
            """Return an operand of the branch without gradient in the trials that do not select it."""
            if not jnp.issubdtype(variable.aval.dtype, jnp.inexact):
                return value
            return self._map_leaves(keep_selected_gradients, selected, self._align_one(value, value.axes | TRIAL))

        return list(map(stop_gradient_if_unselected, operands, eqn.invars[1:]))

    def custom_jvp(self, eqn: Any, values: list[BatchedArray]) -> list[BatchedArray]:
        """Return the results of a function with a custom derivative rule (`jax.custom_jvp`), and preserve the rule."""
        avals = [jax.ShapeDtypeStruct(v.aval.shape, v.aval.dtype) for v in eqn.invars]
        inexact = [k for k, aval in enumerate(avals) if jnp.issubdtype(aval.dtype, jnp.inexact)]
        axes = [union(_axes(values))] * len(eqn.outvars)

        def value_and_tangent(primals: list, tangents: list) -> tuple:
            def apply_to_inexact(inexact_operands: list) -> Sequence:
                operands = dict(enumerate(primals)) | dict(zip(inexact, inexact_operands, strict=True))
                return components.bind(eqn, list(operands.values()))

            return jax.jvp(apply_to_inexact, ([primals[k] for k in inexact],), (tangents,))

        @jax.custom_jvp
        def function(operands: list) -> list:
            return self.align(self.evaluate_inside(eqn.params["call_jaxpr"], operands), axes)

        @function.defjvp
        def derivative(primals: tuple, tangents: tuple) -> tuple:
            """Return batched results and tangents of `function`, by the custom rule of the equation."""
            traced = jax.make_jaxpr(value_and_tangent)(avals, [avals[k] for k in inexact])
            results = self.evaluate_inside(traced, [*primals[0], *(tangents[0][k] for k in inexact)])
            return self.align(results[: len(axes)], axes), self.align(results[len(axes) :], axes)

        return function(self.align(values, _axes(values)))


_CONTROL_FLOW = {
    "scan": _Interpreter.scan, "while": _Interpreter.while_loop, "cond": _Interpreter.cond,
    "custom_jvp_call": _Interpreter.custom_jvp,
}  # fmt: skip


def _axes(values: Sequence[BatchedArray]) -> list[int]:
    """Return the batch axes of each value, sums of TRIAL and DIRECTION."""
    return [value.axes for value in values]


def _split_all(values: Sequence[BatchedArray]) -> list[BatchedArray]:
    """Split operands into components before the loop or branch that uses them, so that this is done only once."""
    return [value if value.axes == DIRECTION else value.split() for value in values]


def _carried_as_components(shape: tuple[int, ...], axes: int) -> bool:
    """Return whether loops and branches carry an array as components."""
    return bool(axes & TRIAL) and components.is_small(shape)


def _unbatch_empty(values: Sequence[BatchedArray], variables: Sequence) -> list[BatchedArray]:
    """Return values of variables, the empty ones as unbatched: they have no entry that could differ."""
    return [
        BatchedArray.unbatched(jnp.zeros(v.shape, variable.aval.dtype)) if v.axes and 0 in v.shape else v
        for v, variable in zip(values, variables, strict=True)
    ]
