"""Whole rollouts as one kernel of an accelerator: a trace of one trial, evaluated by components over a block of trials.

`kernel.vmap` computes what `lanes.vmap` does, for functions of numbers that return numbers. Under `lax.scan` an
accelerator is handed a few launches a step, which below a million trials cost more than the step; here the loop over
time lies inside one Pallas kernel, each block of trials keeps its state in registers, and only metrics leave it.

What does not depend on the trial is computed before, outside: constants become one table of numbers for each type, what
a loop goes through (times, hand-over, numbers of samples) a table with a row a step. Inside there are only numbers and
vectors over the block, which is all that a kernel's compiler takes.
"""

import math
from collections.abc import Callable, Sequence
from functools import partial, reduce
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton
from jax.extend import core
from jaxtyping import Array

from ptsmc_jax.batching import components, lanes
from ptsmc_jax.batching.components import Lane, object_array
from ptsmc_jax.batching.dependence import called, dependence, of_scan, opened, settle

BLOCK = 128  # trials in a kernel's block: a power of two
UNROLLED = 8  # steps: loops no longer than that are written out
MAPPED = 256  # the same of loops that carry nothing from step to step, whose results are stacked
LARGEST = 1024  # entries of an array: there are none but those taken apart

_CUSTOM = ("custom_jvp_call", "custom_vjp_call")  # calls here: derivatives are taken before


def vmap(function: Callable, *, block: int = BLOCK, interpret: bool = False) -> Callable:
    """`jax.vmap(function)` for arguments (trials,) and results that are trees of numbers, as one kernel.

    function: of numbers, to a tree of numbers; what it closes over is equal in all trials. interpret: evaluated by
    JAX on any device, slowly, for tests. Take derivatives inside, of `function`. Raises NotImplementedError at what a
    kernel cannot do: results with axes, loops of unknown length, long loops that stack results.
    """

    def mapped(*arguments: Any) -> Any:
        one = [jax.ShapeDtypeStruct((), jnp.asarray(a).dtype) for a in arguments]
        closed, shapes = jax.make_jaxpr(function, return_shape=True)(*one)
        outputs, tree = jax.tree.flatten(shapes)
        if any(out.shape for out in outputs):
            raise NotImplementedError("a kernel returns numbers for each trial, no arrays")
        trials = arguments[0].shape[0]
        program = _Program(closed)
        blocks = -(-trials // block)
        padded = [jnp.resize(jnp.asarray(a), (blocks * block,)) for a in arguments]
        across = pl.BlockSpec((block,), lambda k: (k,))
        tables = program.tables()
        results = pl.pallas_call(
            partial(_body, program, len(arguments), len(tables), block),
            out_shape=[jax.ShapeDtypeStruct((blocks * block,), out.dtype) for out in outputs],
            grid=(blocks,),
            in_specs=[across] * len(arguments) + [pl.BlockSpec(table.shape, lambda k: (0,)) for table in tables],
            out_specs=[across] * len(outputs),
            interpret=interpret,
            compiler_params=triton.CompilerParams(num_warps=max(1, block // 32)),
        )(*padded, *tables)
        return jax.tree.unflatten(tree, [v[:trials] for v in results])

    return mapped


class _Outside:
    """A value computed before the kernel."""

    def __init__(self, value: Array):
        self.value, self.shape, self.dtype = value, jnp.shape(value), jnp.asarray(value).dtype
        self.where: tuple[str, int] = ("", 0)  # table, and where it begins there


class _Program:
    """A trace split in two: what depends on the trial, to be evaluated in the kernel, and the values that it needs."""

    def __init__(self, closed: core.ClosedJaxpr):
        self.equations: list[tuple[Any, list, list]] = []
        self.outside: list[_Outside] = []
        variables = closed.jaxpr.invars
        known: dict[Any, Any] = dict(zip(closed.jaxpr.constvars, map(_Outside, closed.consts), strict=True))
        known |= {variable: variable for variable in variables}
        self.arguments = list(variables)
        self._walk(closed.jaxpr, known)
        self.results = [self._use(known, atom) for atom in closed.jaxpr.outvars]
        self.layout = self._lay_out()

    def _walk(self, jaxpr: core.Jaxpr, known: dict[Any, Any]) -> None:
        """Compute what does not depend on the trial, keep the rest; calls are opened."""
        for eqn in jaxpr.eqns:
            read = [atom if isinstance(atom, core.Literal) else known[atom] for atom in eqn.invars]
            if all(isinstance(value, core.Literal | _Outside) for value in read):
                plain = [value.val if isinstance(value, core.Literal) else value.value for value in read]
                known |= zip(eqn.outvars, map(_Outside, components.bind(eqn, plain)), strict=True)
            elif (inner := _called(eqn)) is not None:
                inside: dict[Any, Any] = dict(zip(inner.jaxpr.constvars, map(_Outside, inner.consts), strict=True))
                inside |= zip(inner.jaxpr.invars, read, strict=True)
                self._walk(inner.jaxpr, inside)
                known |= {
                    out: inside.get(atom, atom) for out, atom in zip(eqn.outvars, inner.jaxpr.outvars, strict=True)
                }
            else:
                outputs = [object() for _ in eqn.outvars]
                self.equations.append((eqn, [self._use(known, atom) for atom in eqn.invars], outputs))
                known |= zip(eqn.outvars, outputs, strict=True)

    def _use(self, known: dict, atom: Any) -> Any:
        value = atom if isinstance(atom, core.Literal) else known[atom]
        if isinstance(value, _Outside) and value not in self.outside:
            self.outside.append(value)
        return value

    def _lay_out(self) -> dict[str, int]:
        """Give each value from outside its place in the table of its type; returns the tables' lengths."""
        lengths: dict[str, int] = {}
        for value in self.outside:
            name = "int32" if value.dtype == bool else value.dtype.name
            value.where = (name, lengths.get(name, 0))
            lengths[name] = value.where[1] + math.prod(value.shape)
        return lengths

    def tables(self) -> list[Array]:
        """A table (length,) for each type, as long as a power of two."""
        made = []
        for name, length in self.layout.items():
            parts = [jnp.ravel(value.value).astype(name) for value in self.outside if value.where[0] == name]
            filled = max(16, 1 << (length - 1).bit_length())
            made.append(jnp.pad(jnp.concatenate(parts), (0, filled - length)))
        return made


def _body(program: _Program, arguments: int, tables: int, block: int, *refs: Any) -> None:
    """The kernel: refs of the arguments, of the tables, and of the results."""
    takes, held, gives = refs[:arguments], refs[arguments : arguments + tables], refs[arguments + tables :]
    inside = _Inside(block, dict(zip(program.layout, held, strict=True)))
    known: dict[Any, Any] = {
        variable: Lane((), object_array((), [ref[...]])) for variable, ref in zip(program.arguments, takes, strict=True)
    }

    def read(value: Any) -> Any:
        return value if isinstance(value, core.Literal | _Outside) else known[value]

    for eqn, values, outputs in program.equations:
        known |= zip(outputs, inside.apply(eqn, [inside.value(read(value)) for value in values]), strict=True)
    for ref, result in zip(gives, program.results, strict=True):
        ref[...] = jnp.broadcast_to(_lane(inside.value(read(result))).parts[()], (block,)).astype(ref.dtype)


class _Held:
    """A value from outside: in a table, from a place on."""

    def __init__(self, ref: Any, first: int, value: _Outside):
        self.ref, self.first, self.shape, self.dtype = ref, first, value.shape, value.dtype

    def lane(self) -> Lane:
        """The whole value as components."""
        return self._load(self.shape, self.first)

    def row(self, k: Any) -> Lane:
        """The k-th row as components."""
        shape = self.shape[1:]
        return self._load(shape, np.int32(self.first) + k * np.int32(math.prod(shape)))

    def _load(self, shape: tuple[int, ...], start: Any) -> Lane:
        numbers = [self.ref[start + k] for k in range(math.prod(shape))]
        return Lane(shape, object_array(shape, [n != 0 for n in numbers] if self.dtype == bool else numbers))


class _Inside:
    """Evaluation inside the kernel: every value an object array of numbers, or of vectors over the block."""

    def __init__(self, block: int, refs: dict[str, Any]):
        self.block, self.refs = block, refs

    def value(self, value: Any) -> Any:
        """A literal as components, a value from outside where it is held."""
        if isinstance(value, core.Literal):
            return _constant(value.val)
        if isinstance(value, _Outside):
            return _Held(self.refs[value.where[0]], value.where[1], value)
        return value

    def evaluate(self, closed: Any, arguments: Sequence) -> list:
        """Values of the outputs of a trace."""
        jaxpr, consts = opened(closed)
        known = dict(zip(jaxpr.constvars, map(_constant, consts), strict=True))
        known |= zip(jaxpr.invars, arguments, strict=True)

        def read(atom: Any) -> Any:
            return _constant(atom.val) if isinstance(atom, core.Literal) else known[atom]

        for eqn in jaxpr.eqns:
            known |= zip(eqn.outvars, self.apply(eqn, [read(atom) for atom in eqn.invars]), strict=True)
        return [read(atom) for atom in jaxpr.outvars]

    def apply(self, eqn: Any, values: list) -> Sequence:
        """The outputs of one primitive."""
        name, params = eqn.primitive.name, eqn.params
        if name == "scan":
            return self.scan(params, values)
        values = [_lane(value) for value in values]
        if (inner := _called(eqn)) is not None:
            return self.evaluate(inner, values)
        if name == "cond":
            return self.branch(params["branches"], values)
        if name == "iota":
            with jax.ensure_compile_time_eval():
                return [_constant(components.bind(eqn, [])[0])]
        # spread anew for each equation, as its speed on a GPU was measured
        made = components.apply(eqn, values, components.Alike(), LARGEST) if components.covers(name) else None
        if made is not None:
            return made
        raise NotImplementedError(f"a kernel has no rule for the primitive `{name}`{lanes.place(eqn)}")

    def scan(self, params: Any, values: list) -> list:
        """A loop, its steps written out if they are few."""
        body, length = params["jaxpr"], params["length"]
        *inside, xs = of_scan(params, values)
        consts, state = ([_lane(v) for v in part] for part in inside)
        carried = len(state)
        if params["reverse"]:
            raise NotImplementedError("a kernel's loops run forward")
        if length <= UNROLLED or (carried == 0 and length <= MAPPED):
            rows = []
            for k in range(length):
                results = self.evaluate(body, [*consts, *state, *(_row(x, k) for x in xs)])
                state, row = results[:carried], results[carried:]
                rows.append(row)
            return [*state, *(_stacked(part) for part in zip(*rows, strict=True))]
        if len(body.jaxpr.outvars) > carried:
            raise NotImplementedError(f"a kernel stacks no results of {length} steps")
        differs = settle(body.jaxpr, _varies(consts), _varies(state), _varies(xs))
        shapes = [v.aval.shape for v in of_scan(params, body.jaxpr.invars)[1]]

        def step(k: Any, packed: tuple) -> tuple:
            rows = (_row(x, k) for x in xs)
            return self.pack(self.evaluate(body, [*consts, *_unpacked(packed, shapes), *rows]), differs)

        return _unpacked(lax.fori_loop(np.int32(0), np.int32(length), step, self.pack(state, differs)), shapes)

    def branch(self, branches: Sequence, values: list) -> list:
        """A branch where all trials agree, else all of them and a choice for each trial."""
        (index,), operands = values[0].parts.reshape(1), values[1:]
        shapes = [v.shape for v in branches[0].out_avals]
        depends = [dependence(branch.jaxpr, _varies(operands)) for branch in branches]
        differs = [np.ndim(index) > 0 or any(each) for each in zip(*depends, strict=True)]
        cases = [lambda branch=branch: self.pack(self.evaluate(branch, operands), differs) for branch in branches]
        if np.ndim(index) == 0:
            chosen = lax.cond(index, cases[1], cases[0]) if index.dtype == bool else lax.switch(index, cases)
        else:
            which = index if index.dtype == bool else jnp.clip(index, 0, len(branches) - 1)
            chosen = jax.tree.map(lambda *each: lax.select_n(which, *each), *(case() for case in cases))
        return _unpacked(chosen, shapes)

    def pack(self, values: Sequence, differs: Sequence[int]) -> tuple:
        """Components as loops and branches carry them: numbers where all trials agree, vectors elsewhere."""
        return tuple(
            tuple(jnp.broadcast_to(part, (self.block,) if each else ()) for part in value.parts.flat)
            for value, each in zip(values, differs, strict=False)
        )


def _unpacked(packed: Sequence, shapes: Sequence) -> list[Lane]:
    """The components that `_Inside.pack` packed."""
    return [Lane(shape, object_array(shape, parts)) for parts, shape in zip(packed, shapes, strict=True)]


def _called(eqn: Any) -> Any:
    return eqn.params["call_jaxpr"] if eqn.primitive.name in _CUSTOM else called(eqn)


def _constant(value: Any) -> Lane:
    array = np.asarray(value)
    return Lane(array.shape, object_array(array.shape, (array[i] for i in np.ndindex(*array.shape))))


def _lane(value: Any) -> Lane:
    return value.lane() if isinstance(value, _Held) else value


def _row(value: Any, k: Any) -> Lane:
    """What step k is given of what a loop goes through."""
    if isinstance(value, _Held):
        return value.row(k)
    shape, rows = value.shape[1:], value.parts.reshape(value.shape[0], -1)
    if isinstance(k, int):
        return Lane(shape, object_array(shape, rows[k]))

    def chosen(numbers: Any) -> Any:  # there is no table of what was made inside
        return reduce(lambda found, i: jnp.where(k == i, numbers[i], found), range(1, len(numbers)), numbers[0])

    return Lane(shape, object_array(shape, map(chosen, rows.T)))


def _stacked(rows: Sequence[Lane]) -> Lane:
    shape = (len(rows), *rows[0].shape)
    return Lane(shape, object_array(shape, (part for row in rows for part in row.parts.flat)))


def _varies(values: Sequence) -> list[bool]:
    """Which values differ from trial to trial."""
    return [isinstance(value, Lane) and any(np.ndim(part) for part in value.parts.flat) for value in values]
