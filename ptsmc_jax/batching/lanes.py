"""One trajectory, traced, evaluated component by component over many trials.

`lanes.vmap` computes what `jax.vmap` does. It traces the function for one trial and evaluates the trace with every
small array replaced by its components, each a vector over the trials: XLA's CPU backend vectorises arrays (trial,)
but not arrays (trial, 3). Reshapes and slices become permutations, small contractions become sums, and whatever does
not depend on the trial stays as it is: its loops keep a scalar, its branches stay branches.
"""

import warnings
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.extend import core
from jaxtyping import Array

from ptsmc_jax import configure
from ptsmc_jax.batching import components, lapack
from ptsmc_jax.batching.components import DIRECTION, TRIAL, Lane, Shared, dense_of, object_array, plain
from ptsmc_jax.batching.dependence import called, dependence, either, loop_of, of_scan, opened, place, settle, used
from ptsmc_jax.batching.packed import Packed
from ptsmc_jax.numerics import stacking


class LanesWarning(UserWarning):
    """A primitive without a rule went through `jax.vmap`, or a loop was flown step by step: right, but slower."""


def vmap(function: Callable, in_axes: Any = 0, *, strict: bool = False, whole: bool = False) -> Callable:
    """`jax.vmap(function, in_axes)` for axes 0 and None, evaluated by components; the outputs' trial axis is 0.

    Composes with jit, vmap, jvp and grad from outside. A primitive without a rule here goes through `jax.vmap` on its
    own, with one warning. whole: a long loop is one kernel of an accelerator where it can be, see `kernel`, and has no
    derivative from outside then. Raises ValueError where nothing is mapped, with strict=True NotImplementedError at
    such a primitive.

    >>> crosses = vmap(lambda a: jnp.cross(a, jnp.array([0.0, 0.0, 1.0])))
    >>> crosses(jnp.array([[1.0, 0.0, 0.0], [0.0, 2.0, 0.0]])).tolist()
    [[0.0, -1.0, 0.0], [2.0, 0.0, 0.0]]
    """

    def mapped(*args: Any) -> Any:
        trials, one, values = _mapped(args, in_axes)
        closed, out = jax.make_jaxpr(function, return_shape=True)(*one)
        results = _Lanes(trials, strict, whole=whole).evaluate(used(closed), values)
        return jax.tree.unflatten(jax.tree.structure(out), [dense_of(value, (trials,)) for value in results])

    return mapped


def jvp(function: Callable, in_axes: Any = 0, *, strict: bool = False, whole: bool = False) -> Callable:
    """(arguments, directions) -> (values, slopes): `vmap(function)`, and its derivatives along several directions.

    directions: a tree like each argument, or None for one that stays, its leaves with an axis over the directions
    before all others. The slopes have that axis first, then that of the trials. The derivative is taken of the trace
    of one trial, which is many times shorter than that of its components, and what no output hangs on is left out.

    >>> square, slope = jvp(lambda x: x**2)((jnp.array([3.0, 4.0]),), (jnp.ones((1, 2)),))
    >>> square.tolist(), slope.tolist()
    ([9.0, 16.0], [[6.0, 8.0]])
    """

    def mapped(args: tuple, directions: tuple) -> tuple[Any, Any]:
        trials, one, values = _mapped(args, in_axes)
        moves = [k for k, along in enumerate(directions) if along is not None]
        if not moves or len(directions) > len(args):
            raise ValueError(f"directions must be of some of the {len(args)} arguments, found {len(moves)}")

        def both(one: tuple, slopes: tuple) -> tuple[Any, Any]:
            def of(*some: Any) -> Any:
                every = dict(enumerate(one)) | dict(zip(moves, some, strict=True))
                return function(*every.values())

            return jax.jvp(of, tuple(one[k] for k in moves), slopes)

        along = [jnp.asarray(leaf) for leaf in jax.tree.leaves(tuple(directions[k] for k in moves))]
        closed, out = jax.make_jaxpr(both, return_shape=True)(one, tuple(one[k] for k in moves))
        # an argument that stays has a place among the values, but none here
        inner = [v.aval.shape for v in closed.jaxpr.invars[len(values) :]]
        count = along[0].shape[0] if along[0].ndim else 0
        slopes = [_slope(leaf, shape, count, trials) for leaf, shape in zip(along, inner, strict=True)]
        lanes = _Lanes(trials, strict, count, whole)
        results = lanes.evaluate(used(closed), [*values, *slopes])
        half = len(results) // 2
        leads = [(trials,)] * half + [(lanes.directions, trials)] * half
        return jax.tree.unflatten(jax.tree.structure(out), [*map(dense_of, results, leads)])

    return mapped


def _mapped(args: tuple, in_axes: Any) -> tuple[int, tuple, list]:
    """How many trials there are; the arguments of one, as shapes; and their leaves as values."""
    axes = (in_axes,) * len(args) if in_axes is None or isinstance(in_axes, int) else tuple(in_axes)
    over = jax.tree.leaves(
        jax.tree.map(_spread, axes, args, is_leaf=lambda axis: axis is None or isinstance(axis, int))
    )
    leaves, tree = jax.tree.flatten(args)
    leaves = [jnp.asarray(leaf) for leaf in leaves]
    if any(on and not leaf.shape for leaf, on in zip(leaves, over, strict=True)):
        raise ValueError("a number has no axis to map over")
    sizes = {leaf.shape[0] for leaf, on in zip(leaves, over, strict=True) if on}
    if len(sizes) != 1:
        raise ValueError(f"the mapped arguments must share one number of trials, found {sorted(sizes)}")
    one = [
        jax.ShapeDtypeStruct(leaf.shape[1:] if on else leaf.shape, leaf.dtype, weak_type=leaf.weak_type)
        for leaf, on in zip(leaves, over, strict=True)
    ]
    values = [Lane(v.shape[1:], dense=v).apart() if on else v for v, on in zip(leaves, over, strict=True)]
    return sizes.pop(), jax.tree.unflatten(tree, one), values


def _slope(along: Array, shape: tuple[int, ...], count: int, trials: int) -> Lane:
    """Directions of a value of this shape, (directions, [trials,] *shape)."""
    equal = along.shape == (count, *shape)  # in all trials
    if not equal and along.shape != (count, trials, *shape):
        raise ValueError(f"{count} directions of {shape} in {trials} trials cannot be of shape {along.shape}")
    dense, differs = (along[:, None], DIRECTION) if equal else (along, TRIAL | DIRECTION)
    return Lane(shape, dense=dense, differs=differs).apart()


def _spread(axis: int | None, tree: Any) -> Any:
    """Whether each leaf under one entry of in_axes is mapped over."""
    if axis not in (None, 0):
        raise ValueError(f"in_axes may hold 0 and None only, found {axis}")
    return jax.tree.map(lambda _: axis == 0, tree)


class _Lanes:
    """Evaluation of traces for so many trials; with slopes, along so many directions."""

    def __init__(self, trials: int, strict: bool, directions: int = 0, whole: bool = False):
        self.trials, self.directions, self.strict, self.whole = trials, directions, strict, whole
        self.leads = ((), (trials,), (directions, 1), (directions, trials))  # by what differs
        self.alike = components.Alike()

    def inside(self) -> "_Lanes":
        """The same in a function that JAX traces by itself: what is computed there belongs to it alone, also a loop."""
        return _Lanes(self.trials, self.strict, self.directions)

    def evaluate(self, closed: Any, args: Sequence) -> list:
        """Values of the outputs of a trace, for arguments that are lanes or equal in all trials."""
        jaxpr, consts = opened(closed)
        values_of: dict = {}

        def write(variables: Sequence, values: Sequence) -> None:
            for variable, value in zip(variables, values, strict=True):
                empty = isinstance(value, Lane) and 0 in value.shape  # nothing in it that could differ
                values_of[variable] = jnp.zeros(value.shape, variable.aval.dtype) if empty else value

        def read(atom: Any) -> Any:
            return atom.val if isinstance(atom, core.Literal) else values_of[atom]

        write([*jaxpr.constvars, *jaxpr.invars], [*consts, *args])
        for eqn in jaxpr.eqns:
            values = [read(atom) for atom in eqn.invars]
            laned = any(isinstance(value, Lane) for value in values)
            if laned:
                results = self.apply(eqn, values)
            else:
                results = components.known(eqn) if self.directions else None
                results = components.bind(eqn, values) if results is None else results
            write(eqn.outvars, results)
        return [read(atom) for atom in jaxpr.outvars]

    def apply(self, eqn: Any, values: list) -> Sequence:
        """One primitive with at least one lane among its operands."""
        name, inner = eqn.primitive.name, called(eqn)
        if inner is not None:
            return self.evaluate(inner, values)
        differs = _which(values)
        every = either(differs)
        if name in _CONTROL:
            return _CONTROL[name](self, eqn, values)
        if every == DIRECTION:  # equal in all trials: there is nothing to gain by components
            return self.densely(eqn, values)
        if components.covers(name):
            results = components.apply(eqn, values, self.alike)
            if results is not None:
                for lane in results:
                    lane.differs = every
                return results
        else:
            self.without_rule(eqn)
        return self.densely(eqn, values)

    def densely(self, eqn: Any, values: list) -> list[Lane]:
        """One primitive by `jax.vmap`, or one after the other, see `lapack`."""
        differs = _which(values)
        operands, every = [self._dense(*pair) for pair in zip(values, differs, strict=True)], either(differs)

        def one(*operands: Any) -> Any:
            return components.bind(eqn, operands)

        count = (self.trials if every & TRIAL else 1) * (self.directions if every & DIRECTION else 1)
        function, over = one, lapack.over(eqn, count)
        for axis in (TRIAL, DIRECTION):
            if every & axis:
                function = over(function, [0 if on & axis else None for on in differs])
        dense = [out[:, None] if every == DIRECTION else out for out in function(*operands)]
        return [Lane(out.shape[len(self.leads[every]) :], dense=out, differs=every) for out in dense]

    def _dense(self, value: Any, differs: int) -> Array:
        """An array with an axis for each of what a value differs over, first the directions."""
        if not differs:
            return plain(value)
        dense = value.dense(self.leads[differs])
        return dense[:, 0] if differs == DIRECTION else dense

    def without_rule(self, eqn: Any) -> None:
        told = f"lanes have no rule for the primitive `{eqn.primitive.name}`{place(eqn)}"
        if self.strict:
            raise NotImplementedError(f"{told}; write it with others, or leave strict mode")
        warnings.warn(f"{told}: jax.vmap evaluates it, which may be slow", LanesWarning, stacklevel=2)

    def scan(self, eqn: Any, values: list) -> list:
        params, body = eqn.params, eqn.params["jaxpr"]
        consts, init, xs = of_scan(params, values)
        _, carried_in, gone_through = of_scan(params, body.jaxpr.invars)
        consts, carried = [_apart(value) for value in consts], len(init)
        fixed, rowed = _which(consts), _which(xs)
        differs = settle(body.jaxpr, fixed, _which(init), rowed)
        state = Packed(carried_in, differs, self.leads)
        whole = self.in_one_kernel(params, [*consts, *map(_apart, init), *xs], state) if self.whole else None
        if whole is not None:
            return whole
        outputs = dependence(body.jaxpr, [*fixed, *differs, *rowed])[carried:]
        row = Packed(gone_through, rowed, self.leads)
        out = Packed(body.jaxpr.outvars[carried:], outputs, self.leads)

        def rows(value: Any, shape: tuple[int, ...], differs: int) -> Any:
            if not isinstance(value, Lane):
                return plain(value)
            lead = self.leads[differs]
            dense = jnp.moveaxis(value.dense(lead), len(lead), 0)  # (time, *lead, *shape)
            if not row.apart(shape, differs):
                return dense
            return tuple(components.entries(dense, 1 + len(lead)).flat)

        def step(carry: tuple, x: tuple) -> tuple[tuple, tuple]:
            results = self.inside().evaluate(body, [*consts, *state.unpack(carry), *row.unpack(x)])
            return state.pack(results[:carried]), out.pack(results[carried:])

        packed_xs = tuple(rows(*item) for item in zip(xs, row.shapes, rowed, strict=True))
        as_asked = {name: params[name] for name in ("length", "reverse", "unroll")}
        last, ys = stacking.scan(step, state.pack(init), packed_xs, **as_asked)
        stacked = [self._stacked(*item, params["length"]) for item in zip(ys, out.shapes, outputs, strict=True)]
        return [*state.unpack(last), *stacked]

    def in_one_kernel(self, params: Any, values: list, state: Packed) -> list | None:
        """The last carries of a scan by `kernel.scan`; None: it is no kernel, or cannot be one, which is told."""
        from ptsmc_jax.batching import kernel  # which takes a while to import, and is for accelerators

        lead = self.leads[TRIAL | DIRECTION if self.directions else TRIAL]
        varies, interpret = [own & TRIAL for own in state.differs], configure.backend() == "cpu"
        try:
            last = kernel.scan(params, values, varies, lead, interpret)
        except NotImplementedError as error:
            warnings.warn(f"a loop is flown step by step, which may be slow: {error}", LanesWarning, stacklevel=2)
            return None
        return last and state.unpack([state.of_all(k, parts) for k, parts in enumerate(last)])

    def _stacked(self, y: Any, shape: tuple[int, ...], differs: int, length: int) -> Any:
        """What a scan stacks, components of (time, *lead), or (time, *lead, *shape): a lane of (time, *shape)."""
        if not differs:
            return y
        whole, lead, apart = (length, *shape), self.leads[differs], Packed.apart(shape, differs)
        if 0 in whole:
            return Lane(whole, np.empty(whole, dtype=object), differs=differs)
        if apart and components.small(whole):
            rows = (lax.index_in_dim(part, k, 0, keepdims=False) for k in range(length) for part in y)
            return Lane(whole, object_array(whole, rows), differs=differs)
        dense = jnp.stack(y, axis=-1) if apart else y
        return Lane(whole, dense=jnp.moveaxis(dense, 0, len(lead)).reshape((*lead, *whole)), differs=differs)

    def loop(self, eqn: Any, values: list) -> list:
        """lax.while_loop; where the trials end at different times each stays as it is from its end on."""
        test, body, *consts, init = loop_of(eqn, values)
        test_consts, body_consts = ([_apart(value) for value in some] for some in consts)
        differs = settle(body.jaxpr, _which(body_consts), _which(init), [])
        (each,) = dependence(test.jaxpr, [*_which(test_consts), *differs])
        differs = [own | each for own in differs]
        state = Packed(body.jaxpr.outvars, differs, self.leads)

        def going(carry: tuple) -> Any:
            (test_value,) = self.inside().evaluate(test, [*test_consts, *state.unpack(carry)])
            return dense_of(test_value, self.leads[each]) if each else test_value

        def step(carry: tuple) -> tuple:
            after = state.pack(self.inside().evaluate(body, [*body_consts, *state.unpack(carry)]))
            if not each:
                return after
            on = going(carry)
            return tuple(
                jax.tree.map(lambda new, old, own=own: jnp.where(self._along(on, new, own), new, old), *both)
                for *both, own in zip(after, carry, differs, strict=True)
            )

        proceed = (lambda carry: jnp.any(going(carry))) if each else going
        return state.unpack(lax.while_loop(proceed, step, state.pack(init)))

    def _along(self, on: Array, value: Array, differs: int) -> Array:
        """A condition (trials,) or (directions, trials) shaped for an array whose leading axes are of `differs`."""
        return on.reshape(on.shape + (1,) * (value.ndim - len(self.leads[differs])))

    def branch(self, eqn: Any, values: list) -> list:
        """lax.cond and lax.switch: a branch where all trials agree, else all of them and a choice for each trial."""
        index, *operands = values
        agree, branches = not isinstance(index, Lane), eqn.params["branches"]
        operands = [_apart(value) for value in operands] if agree else operands
        depends = [dependence(branch.jaxpr, _which(operands)) for branch in branches]
        differs = [either([*each, *_which([index])]) for each in zip(*depends, strict=True)]
        results = Packed(eqn.outvars, differs, self.leads)

        def case(branch: Any, operands: list) -> tuple:
            return results.pack(self.inside().evaluate(branch, operands))

        if agree:
            return results.unpack(lax.switch(plain(index), [partial(case, branch, operands) for branch in branches]))
        which = index.dense(self.leads[index.differs])
        which = which if which.dtype == bool else jnp.clip(which, 0, len(branches) - 1)

        def choice(differs: int, *case: Array) -> Array:
            return lax.select_n(jnp.broadcast_to(self._along(which, case[0], differs), case[0].shape), *case)

        cases = [case(branch, self.shielded(eqn, operands, which == k)) for k, branch in enumerate(branches)]
        outputs = zip(differs, *cases, strict=True)
        return results.unpack([jax.tree.map(partial(choice, over), *output) for over, *output in outputs])

    def shielded(self, eqn: Any, operands: list, on: Array) -> list:
        """Operands of a branch, whose derivatives are zero in the trials that do not take it.

        There a derivative may be infinite, and reverse mode would multiply it by zero. `jax.vmap` does the same.
        """
        floats = [k for k, v in enumerate(eqn.invars[1:]) if jnp.issubdtype(v.aval.dtype, jnp.inexact)]
        differs = [own | TRIAL for own in _which([operands[k] for k in floats])]
        some = Packed([eqn.invars[1 + k] for k in floats], differs, self.leads)

        def masked(over: int, leaf: Array) -> Array:
            return jnp.where(self._along(on, leaf, over), leaf, lax.stop_gradient(leaf))

        packed = some.pack([operands[k] for k in floats])
        own = [jax.tree.map(partial(masked, over), leaf) for over, leaf in zip(differs, packed, strict=True)]
        by_place = dict(zip(floats, some.unpack(own), strict=True))
        return [by_place.get(k, operand) for k, operand in enumerate(operands)]

    def custom(self, eqn: Any, values: list) -> list:
        """A function with a derivative rule of its own (custom_jvp), which is kept."""
        avals = [jax.ShapeDtypeStruct(v.aval.shape, v.aval.dtype) for v in eqn.invars]
        smooth = [k for k, aval in enumerate(avals) if jnp.issubdtype(aval.dtype, jnp.inexact)]
        takes = Packed(eqn.invars, _which(values), self.leads)
        gives = Packed(eqn.outvars, [either(takes.differs)] * len(eqn.outvars), self.leads)

        @jax.custom_jvp
        def function(packed: tuple) -> tuple:
            return gives.pack(self.inside().evaluate(eqn.params["call_jaxpr"], takes.unpack(packed)))

        @function.defjvp
        def derivative(primals: tuple, tangents: tuple) -> tuple:
            def both(x: list, slopes: list) -> tuple:
                def of(varied: list) -> Sequence:
                    every = dict(enumerate(x)) | dict(zip(smooth, varied, strict=True))
                    return components.bind(eqn, list(every.values()))

                return jax.jvp(of, ([x[k] for k in smooth],), (slopes,))

            traced = jax.make_jaxpr(both)(avals, [avals[k] for k in smooth])
            slopes = takes.unpack(tangents[0])
            results = self.inside().evaluate(traced, [*takes.unpack(primals[0]), *(slopes[k] for k in smooth)])
            half = len(results) // 2
            return gives.pack(results[:half]), gives.pack(results[half:])

        return gives.unpack(function(takes.pack(values)))


_CONTROL = {"scan": _Lanes.scan, "while": _Lanes.loop, "cond": _Lanes.branch, "custom_jvp_call": _Lanes.custom}


def _which(values: Sequence) -> list[int]:
    """What each value differs over."""
    return [value.differs if isinstance(value, Lane) else 0 for value in values]


def _apart(value: Any) -> Any:
    """A value taken apart before the loop or the branch that uses it, if it is small."""
    if isinstance(value, Lane) and value.differs == DIRECTION:
        return value
    if isinstance(value, Lane):
        return value.apart()
    if isinstance(value, Shared) or np.ndim(value) == 0 or not components.small(np.shape(value)):
        return value
    return Shared(jnp.asarray(value))
