"""One trajectory, traced, evaluated component by component over many trials.

`lanes.vmap` computes what `jax.vmap` does. It traces the function for one trial and evaluates the trace with every
small array replaced by its components, each a vector over the trials: XLA's CPU backend vectorises arrays (trial,)
but not arrays (trial, 3). Reshapes and slices become permutations, small contractions become sums, and whatever does
not depend on the trial stays as it is: its loops keep a scalar, its branches stay branches.
"""

import warnings
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.extend import core
from jaxtyping import Array

from ptsmc_jax.batching import components
from ptsmc_jax.batching.components import Lane, Shared, dense_of, object_array, parts_of, plain

_CALLS = set("jit pjit closed_call core_call remat remat2 checkpoint".split())


class LanesWarning(UserWarning):
    """A primitive without a rule went through `jax.vmap`: right, but slower."""


def vmap(function: Callable, in_axes: Any = 0, *, strict: bool = False) -> Callable:
    """`jax.vmap(function, in_axes)` for axes 0 and None, evaluated by components; the outputs' trial axis is 0.

    Composes with jit, vmap, jvp and grad from outside. A primitive without a rule here goes through `jax.vmap` on its
    own, with one warning. Raises ValueError where nothing is mapped, with strict=True NotImplementedError at such a
    primitive.

    >>> crosses = vmap(lambda a: jnp.cross(a, jnp.array([0.0, 0.0, 1.0])))
    >>> crosses(jnp.array([[1.0, 0.0, 0.0], [0.0, 2.0, 0.0]])).tolist()
    [[0.0, -1.0, 0.0], [2.0, 0.0, 0.0]]
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
        values = [
            Lane(leaf.shape[1:], dense=leaf).apart() if on else leaf
            for leaf, on in zip(leaves, mapped_over, strict=True)
        ]
        lanes = _Lanes(sizes.pop(), strict)
        results = lanes.evaluate(closed, values)
        return jax.tree.unflatten(jax.tree.structure(out), [dense_of(value, lanes.trials) for value in results])

    return mapped


def _spread(axis: int | None, tree: Any) -> Any:
    """Whether each leaf under one entry of in_axes is mapped over."""
    if axis not in (None, 0):
        raise ValueError(f"in_axes may hold 0 and None only, found {axis}")
    return jax.tree.map(lambda _: axis == 0, tree)


class _Packed:
    """How values are handed through JAX's loops and branches: lanes as tuples of components, large ones dense."""

    def __init__(self, variables: Sequence, differs: Sequence[bool], trials: int):
        self.shapes, self.differs, self.trials = [v.aval.shape for v in variables], differs, trials

    def pack(self, values: Sequence) -> tuple:
        return tuple(self._pack(*item) for item in zip(values, self.shapes, self.differs, strict=True))

    def _pack(self, value: Any, shape: tuple[int, ...], differs: bool) -> Any:
        if not differs:
            return plain(value)
        if not components.small(shape):
            return dense_of(value, self.trials)
        return tuple(jnp.broadcast_to(part, (self.trials,)) for part in parts_of(value).flat)

    def unpack(self, packed: Sequence) -> list:
        return [self._unpack(*item) for item in zip(packed, self.shapes, self.differs, strict=True)]

    def _unpack(self, value: Any, shape: tuple[int, ...], differs: bool) -> Any:
        if not differs:
            return value
        return Lane(shape, object_array(shape, value)) if components.small(shape) else Lane(shape, dense=value)


class _Lanes:
    """Evaluation of traces for so many trials."""

    def __init__(self, trials: int, strict: bool):
        self.trials, self.strict = trials, strict

    def evaluate(self, closed: Any, args: Sequence) -> list:
        """Values of the outputs of a trace, for arguments that are lanes or equal in all trials."""
        jaxpr, consts = (closed.jaxpr, closed.consts) if isinstance(closed, core.ClosedJaxpr) else (closed, ())
        known: dict = {}

        def write(variables: Sequence, values: Sequence) -> None:
            for variable, value in zip(variables, values, strict=True):
                empty = isinstance(value, Lane) and 0 in value.shape  # nothing in it that could differ
                known[variable] = jnp.zeros(value.shape, variable.aval.dtype) if empty else value

        def read(atom: Any) -> Any:
            return atom.val if isinstance(atom, core.Literal) else known[atom]

        write([*jaxpr.constvars, *jaxpr.invars], [*consts, *args])
        for eqn in jaxpr.eqns:
            values = [read(atom) for atom in eqn.invars]
            laned = any(isinstance(value, Lane) for value in values)
            write(eqn.outvars, self.apply(eqn, values) if laned else components.bind(eqn, values))
        return [read(atom) for atom in jaxpr.outvars]

    def apply(self, eqn: Any, values: list) -> Sequence:
        """One primitive with at least one lane among its operands."""
        name, inner = eqn.primitive.name, called(eqn)
        if inner is not None:
            return self.evaluate(inner, values)
        if name in _CONTROL:
            return _CONTROL[name](self, eqn, values)
        if components.covers(name):
            results = components.apply(eqn, values)
            if results is not None:
                return results
        else:
            self.without_rule(eqn)
        mapped = [0 if isinstance(v, Lane) else None for v in values]
        operands = [v.dense(self.trials) if isinstance(v, Lane) else plain(v) for v in values]
        dense = jax.vmap(lambda *v: components.bind(eqn, v), mapped)(*operands)
        return [Lane(out.shape[1:], dense=out) for out in dense]

    def without_rule(self, eqn: Any) -> None:
        told = f"lanes have no rule for the primitive `{eqn.primitive.name}`{place(eqn)}"
        if self.strict:
            raise NotImplementedError(f"{told}; write it with others, or leave strict mode")
        warnings.warn(f"{told}: jax.vmap evaluates it, which may be slow", LanesWarning, stacklevel=2)

    def scan(self, eqn: Any, values: list) -> list:
        params = eqn.params
        body, constants, carried = params["jaxpr"], params["num_consts"], params["num_carry"]
        consts = [_apart(value) for value in values[:constants]]
        init, xs = values[constants : constants + carried], values[constants + carried :]
        fixed, rowed = _which(consts), _which(xs)
        differs = settle(body.jaxpr, fixed, _which(init), rowed)
        outputs = dependence(body.jaxpr, [*fixed, *differs, *rowed])[carried:]
        state = _Packed(body.jaxpr.invars[constants : constants + carried], differs, self.trials)
        row = _Packed(body.jaxpr.invars[constants + carried :], rowed, self.trials)
        out = _Packed(body.jaxpr.outvars[carried:], outputs, self.trials)

        def rows(value: Any, shape: tuple[int, ...]) -> Any:
            if not isinstance(value, Lane):
                return plain(value)
            dense = jnp.moveaxis(value.dense(self.trials), 0, 1)  # (time, trial, *shape)
            if not components.small(shape):
                return dense
            return tuple(components.entries(dense, 2).flat)

        def step(carry: tuple, x: tuple) -> tuple[tuple, tuple]:
            results = self.evaluate(body, [*consts, *state.unpack(carry), *row.unpack(x)])
            return state.pack(results[:carried]), out.pack(results[carried:])

        last, ys = lax.scan(
            step,
            state.pack(init),
            tuple(rows(value, shape) for value, shape in zip(xs, row.shapes, strict=True)),
            params["length"],
            params["reverse"],
            params["unroll"],
        )
        results = state.unpack(last)
        for y, shape, laned in zip(ys, out.shapes, outputs, strict=True):
            if laned:  # components of (time, trial), or (time, trial, *shape) -> (trial, time, *shape)
                whole = (params["length"], *shape)
                if 0 in whole:
                    y = Lane(whole, np.empty(whole, dtype=object))
                elif components.small(whole):
                    steps = range(params["length"])
                    rows_of = (lax.index_in_dim(part, k, 0, keepdims=False) for k in steps for part in y)
                    y = Lane(whole, object_array(whole, rows_of))
                else:
                    stacked = jnp.stack(y, axis=-1) if components.small(shape) else y
                    y = Lane(whole, dense=jnp.moveaxis(stacked, 0, 1).reshape((self.trials, *whole)))
            results.append(y)
        return results

    def loop(self, eqn: Any, values: list) -> list:
        """lax.while_loop; where the trials end at different times each stays as it is from its end on."""
        params = eqn.params
        test, body = params["cond_jaxpr"], params["body_jaxpr"]
        first, second = params["cond_nconsts"], params["cond_nconsts"] + params["body_nconsts"]
        values = [*(_apart(value) for value in values[:second]), *values[second:]]
        test_consts, body_consts, init = values[:first], values[first:second], values[second:]
        differs = settle(body.jaxpr, _which(body_consts), _which(init), [])
        (each,) = dependence(test.jaxpr, [*_which(test_consts), *differs])
        if each:
            differs = [True] * len(init)
        state = _Packed(body.jaxpr.outvars, differs, self.trials)

        def going(carry: tuple) -> Any:
            (test_value,) = self.evaluate(test, [*test_consts, *state.unpack(carry)])
            return dense_of(test_value, self.trials) if each else test_value

        def step(carry: tuple) -> tuple:
            after = state.pack(self.evaluate(body, [*body_consts, *state.unpack(carry)]))
            if not each:
                return after
            on = going(carry)
            return jax.tree.map(lambda new, old: jnp.where(_along(on, new), new, old), after, carry)

        proceed = (lambda carry: jnp.any(going(carry))) if each else going
        return state.unpack(lax.while_loop(proceed, step, state.pack(init)))

    def branch(self, eqn: Any, values: list) -> list:
        """lax.cond and lax.switch: a branch where all trials agree, else all of them and a choice for each trial."""
        index, *operands = values
        branches = eqn.params["branches"]
        if isinstance(index, Lane):
            each = _Packed(eqn.outvars, [True] * len(eqn.outvars), self.trials)
            cases = [each.pack(self.evaluate(branch, operands)) for branch in branches]
            which = index.dense(self.trials)
            which = which if which.dtype == bool else jnp.clip(which, 0, len(branches) - 1)
            return each.unpack(jax.tree.map(lambda *c: lax.select_n(_along(which, c[0], full=True), *c), *cases))
        operands = [_apart(value) for value in operands]
        depends = [dependence(branch.jaxpr, _which(operands)) for branch in branches]
        one = _Packed(eqn.outvars, [any(d) for d in zip(*depends, strict=True)], self.trials)
        choices = [lambda branch=branch: one.pack(self.evaluate(branch, operands)) for branch in branches]
        return one.unpack(lax.switch(plain(index), choices))

    def custom(self, eqn: Any, values: list) -> list:
        """A function with a derivative rule of its own (custom_jvp), which is kept."""
        avals = [jax.ShapeDtypeStruct(v.aval.shape, v.aval.dtype) for v in eqn.invars]
        smooth = [k for k, aval in enumerate(avals) if jnp.issubdtype(aval.dtype, jnp.inexact)]
        takes = _Packed(eqn.invars, _which(values), self.trials)
        gives = _Packed(eqn.outvars, [True] * len(eqn.outvars), self.trials)

        @jax.custom_jvp
        def function(packed: tuple) -> tuple:
            return gives.pack(self.evaluate(eqn.params["call_jaxpr"], takes.unpack(packed)))

        @function.defjvp
        def derivative(primals: tuple, tangents: tuple) -> tuple:
            def both(x: list, slopes: list) -> tuple:
                def of(varied: list) -> Sequence:
                    every = dict(enumerate(x)) | dict(zip(smooth, varied, strict=True))
                    return components.bind(eqn, list(every.values()))

                return jax.jvp(of, ([x[k] for k in smooth],), (slopes,))

            traced = jax.make_jaxpr(both)(avals, [avals[k] for k in smooth])
            slopes = takes.unpack(tangents[0])
            results = self.evaluate(traced, [*takes.unpack(primals[0]), *(slopes[k] for k in smooth)])
            half = len(results) // 2
            return gives.pack(results[:half]), gives.pack(results[half:])

        return gives.unpack(function(takes.pack(values)))


_CONTROL = {"scan": _Lanes.scan, "while": _Lanes.loop, "cond": _Lanes.branch, "custom_jvp_call": _Lanes.custom}


def _which(values: Sequence) -> list[bool]:
    return [isinstance(value, Lane) for value in values]


def _apart(value: Any) -> Any:
    """A value taken apart before the loop or the branch that uses it, if it is small."""
    if isinstance(value, Lane):
        return value.apart()
    if isinstance(value, Shared) or np.ndim(value) == 0 or not components.small(np.shape(value)):
        return value
    return Shared(jnp.asarray(value))


def _along(on: Array, value: Array, full: bool = False) -> Array:
    """(trial,) condition shaped for an array (trial, ...)."""
    shaped = on.reshape(on.shape + (1,) * (value.ndim - 1))
    return jnp.broadcast_to(shaped, value.shape) if full else shaped


def called(eqn: Any) -> Any:
    """The trace that a call stands for; None where an equation is no call."""
    params = eqn.params
    return params.get("jaxpr", params.get("call_jaxpr")) if eqn.primitive.name in _CALLS else None


def place(eqn: Any) -> str:
    """Where in the user's files an equation stands, as far as JAX knows."""
    trace = eqn.source_info.traceback
    frames = [] if trace is None else [f for f in trace.frames if "/jax/" not in f.file_name]
    return f" ({frames[0].file_name}:{frames[0].line_num})" if frames else ""


def settle(jaxpr: core.Jaxpr, before: list[bool], carried: list[bool], after: list[bool]) -> list[bool]:
    """Which carries of a loop depend on the trial: those that start so, and those that its body makes so.

    before, after: the same for what stands before and after the carries among the body's inputs.
    """
    while True:
        outputs = dependence(jaxpr, [*before, *carried, *after])
        wider = [a or b for a, b in zip(carried, outputs, strict=False)]
        if wider == carried:
            return carried
        carried = wider


def dependence(jaxpr: core.Jaxpr, inputs: Sequence[bool]) -> list[bool]:
    """Which outputs of a trace depend on the trial, given which inputs do: on any operand that does."""
    known = dict(zip(jaxpr.invars, inputs, strict=True))

    def read(atom: Any) -> bool:
        return not isinstance(atom, core.Literal) and known.get(atom, False)

    for eqn in jaxpr.eqns:
        depends = [read(atom) for atom in eqn.invars]
        inner = called(eqn)
        if inner is not None and any(depends):
            results = dependence(getattr(inner, "jaxpr", inner), depends)
        else:
            results = [any(depends)] * len(eqn.outvars)
        known.update(zip(eqn.outvars, results, strict=True))
    return [read(atom) for atom in jaxpr.outvars]
