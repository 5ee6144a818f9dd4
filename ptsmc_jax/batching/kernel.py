"""A loop over time as one kernel of an accelerator, all trials side by side: what `lanes` flies with on a GPU.

Under `lax.scan` an accelerator is handed a few launches a step, which below a million trials cost more than the step.
Here the loop lies inside one Pallas kernel: each block of trials keeps its state in registers, and only the last state
leaves it. Inside there are only numbers and vectors over the block, which is all that a kernel's compiler takes: what
is equal in all trials comes from tables of numbers, what differs from tables with a row for each component.
"""

import math
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton
from jax.extend import core
from jaxtyping import Array

from ptsmc_jax.batching import components
from ptsmc_jax.batching.choices import chosen, otherwise
from ptsmc_jax.batching.components import TRIAL, Lane, object_array, plain
from ptsmc_jax.batching.dependence import called, dependence, of_scan, opened, place, settle

BLOCK = 128  # trials in a kernel's block: a power of two
UNROLLED = 8  # steps: loops no longer than that are written out
MAPPED = 256  # the same of loops that carry nothing from step to step, whose results are stacked
LARGEST = 1024  # entries of an array: there are none but those taken apart

_CUSTOM = ("custom_jvp_call", "custom_vjp_call")  # calls here: derivatives are taken before
# what `components` has a rule for, and the kernel's compiler has none
_UNKNOWN = set(
    """complex conj copy copy_p digamma eq_to erf erf_inv erfc imag le_to lgamma lt_to real reduce_precision
    round""".split()
)
_TYPES = set("bool int8 int16 int32 int64 uint8 uint16 uint32 uint64 float32 float64".split())


def scan(params: Any, values: Sequence, varies: Sequence[int], lead: tuple[int, ...], interpret: bool) -> list | None:
    """The last carries of a `lax.scan`, each an object array of components (*lead).

    None: it is no work for a kernel, being short, or the same in all trials, or of none, or stacking results, or
    running backward, or going through what differs from trial to trial.

    Args:
        params: the scan's.
        values: its operands: lanes, or what is equal in all trials and directions.
        varies: which carries come to differ from trial to trial.
        lead: (trials,), or (directions, trials) of slopes: each direction is flown by itself.
        interpret: evaluated by JAX on any device, slowly, for tests.

    Raises NotImplementedError at what a kernel cannot do: primitives that its compiler lacks, arrays of more than
    `LARGEST` entries, and inside of it loops of unknown length, or long ones that stack results or run backward.
    """
    body, length, inputs = params["jaxpr"], params["length"], params["jaxpr"].jaxpr.invars
    carried = of_scan(params, inputs)[1]
    xs = of_scan(params, values)[2]
    other = length <= UNROLLED or params["reverse"] or len(body.jaxpr.outvars) > len(carried) or not any(varies)
    if other or 0 in lead or any(map(_by_trial, xs)):
        return None
    *directions, trials = lead
    blocks, each = -(-trials // BLOCK), math.prod(directions)
    numbers, rows, ends = _Numbers(each), _Rows(), _Rows()
    shapes = [of.aval.shape if k < len(values) - len(xs) else (length, *of.aval.shape) for k, of in enumerate(inputs)]
    given = [
        (rows if _by_trial(v) else numbers).take(v, shape, of.aval.dtype)
        for v, shape, of in zip(values, shapes, inputs, strict=True)
    ]
    results = [ends.places([None] * math.prod(of.aval.shape), of.aval.shape, of.aval.dtype) for of in carried]

    def flown(*refs: Any) -> None:
        every = iter(refs)
        tables, takes, gives = ({kind: next(every) for kind in table.parts} for table in (numbers, rows, ends))
        vectors = {kind: _loaded(ref, len(rows.parts[kind])) for kind, ref in takes.items()}
        known = [v.of(vectors if isinstance(v, _Places) else tables) for v in given]
        last = _Inside(interpret).loop(body, length, of_scan(params, known), varies)
        made: dict[str, list] = {}
        for value, of in zip(last, carried, strict=True):
            kind = _held_as(of.aval.dtype)
            parts = (jnp.broadcast_to(jnp.asarray(part, kind), (BLOCK,)) for part in value.parts.flat)
            made.setdefault(kind, []).extend(parts)
        for kind, ref in gives.items():
            _put(ref, made[kind])

    def across(table: _Rows) -> list:
        heights = (_filled(len(parts)) for parts in table.parts.values())
        return [pl.BlockSpec((height, BLOCK), lambda block, direction: (direction, block)) for height in heights]

    flat = numbers.tables()
    found = pl.pallas_call(
        flown,
        out_shape=[
            jax.ShapeDtypeStruct((each * _filled(len(parts)), blocks * BLOCK), kind)
            for kind, parts in ends.parts.items()
        ],
        grid=(blocks, each),
        in_specs=[*(pl.BlockSpec(table.shape, lambda block, direction: (0,)) for table in flat), *across(rows)],
        out_specs=across(ends),
        interpret=interpret,
        compiler_params=triton.CompilerParams(num_warps=BLOCK // 32),
    )(*flat, *rows.tables(lead, blocks * BLOCK))
    by_row = {
        kind: jnp.moveaxis(table.reshape(*directions, -1, blocks * BLOCK)[..., :trials], -2, 0)
        for kind, table in zip(ends.parts, found, strict=True)
    }
    return [places.of(by_row).parts for places in results]


def _by_trial(value: Any) -> bool:
    return isinstance(value, Lane) and bool(value.differs & TRIAL)


def _filled(length: int) -> int:
    """A length that a kernel's compiler takes: a power of two."""
    return 1 << (length - 1).bit_length()


def _held_as(kind: np.dtype) -> str:
    """The type that numbers of this one have in a table."""
    if str(kind) not in _TYPES:
        raise NotImplementedError(f"a kernel holds nothing of the type {kind}")
    return "int32" if kind == np.dtype(bool) else str(kind)


def _check_size(shape: tuple[int, ...]) -> None:
    if not components.small(shape, LARGEST):
        raise NotImplementedError(f"a kernel takes arrays of up to {LARGEST} entries apart")


class _Places(NamedTuple):
    """Where the components of a value lie among rows."""

    kind: str
    rows: np.ndarray  # object array of whole numbers
    boolean: bool

    def of(self, vectors: dict[str, Any]) -> Lane:
        """The components."""
        found = (vectors[self.kind][k] for k in self.rows.flat)
        return Lane(self.rows.shape, object_array(self.rows.shape, (v != 0 if self.boolean else v for v in found)))


class _Rows:
    """Tables of what differs from trial to trial, one for each type, with a row for each component."""

    def __init__(self) -> None:
        self.parts: dict[str, list] = {}

    def places(self, parts: Iterable, shape: tuple[int, ...], dtype: np.dtype) -> _Places:
        """Rows for these components of a value."""
        kind = _held_as(dtype)
        rows = self.parts.get(kind, [])
        first = len(rows)
        rows += parts
        if rows:  # a value may have no components, and there is no table without rows
            self.parts[kind] = rows
        return _Places(kind, object_array(shape, range(first, len(rows))), dtype == np.dtype(bool))

    def take(self, value: Lane, shape: tuple[int, ...], dtype: np.dtype) -> _Places:
        """Rows for a lane."""
        _check_size(shape)
        return self.places(value.parts.flat, shape, dtype)

    def tables(self, lead: tuple[int, ...], width: int) -> list[Array]:
        """A table (directions * height, width) for each type."""
        made = []
        for kind, parts in self.parts.items():
            stacked = jnp.stack([jnp.broadcast_to(part, lead).astype(kind) for part in parts], axis=-2)
            beyond = [(0, 0)] * len(lead[:-1]) + [(0, _filled(len(parts)) - len(parts)), (0, width - lead[-1])]
            made.append(jnp.pad(stacked, beyond, mode="edge").reshape(-1, width))
        return made


# Rows are read and written in a loop over them: a compiler that goes through all that hangs on a load or a store, and
# does so for each, takes a hundred times as long for a hundred that are written out.


def _loaded(ref: Any, count: int) -> Sequence:
    """The first rows of a table."""

    def step(k: Any, found: tuple) -> tuple:
        row = ref[k, :]
        return tuple(jnp.where(k == np.int32(i), row, value) for i, value in enumerate(found))

    empty = jnp.zeros((ref.shape[1],), ref.dtype)
    return lax.fori_loop(np.int32(0), np.int32(count), step, (empty,) * count)


def _put(ref: Any, rows: Sequence) -> None:
    """Write the first rows of a table."""

    def step(k: Any, _: None) -> None:
        ref[k, :] = chosen(k, rows)

    lax.fori_loop(np.int32(0), np.int32(len(rows)), step, None)


class _Numbers:
    """Tables of what is equal in all trials, one for each type; what differs over directions lies there for each."""

    def __init__(self, directions: int):
        self.directions, self.parts = directions, dict[str, list[Array]]()

    def take(self, value: Any, shape: tuple[int, ...], dtype: np.dtype) -> "_Stretch":
        """Places for a value."""
        by_direction = isinstance(value, Lane)
        array = value.dense((self.directions, 1)) if by_direction else jnp.asarray(plain(value))
        kind = _held_as(dtype)
        parts = self.parts.setdefault(kind, [])
        first = sum(part.size for part in parts)
        parts.append(jnp.ravel(array).astype(kind))
        return _Stretch(kind, first, math.prod(shape) if by_direction else 0, shape, dtype)

    def tables(self) -> list[Array]:
        """A table (length,) for each type."""
        whole = [jnp.concatenate(parts) for parts in self.parts.values()]
        return [jnp.pad(v, (0, max(16, _filled(v.size)) - v.size)) for v in whole]


class _Stretch(NamedTuple):
    """Where a value lies in a table of numbers: from a place on, and of each direction by so many places further."""

    kind: str
    first: int
    further: int
    shape: tuple[int, ...]
    dtype: np.dtype

    def of(self, tables: dict[str, Any]) -> "_Held":
        """The value as it is held in the kernel."""
        start: Any = np.int32(self.first)
        if self.further:
            start = start + pl.program_id(1) * np.int32(self.further)
        return _Held(tables[self.kind], start, self.shape, self.dtype)


class _Held(NamedTuple):
    """A value in a table of numbers, from a place on."""

    ref: Any
    start: Any
    shape: tuple[int, ...]
    dtype: np.dtype

    def lane(self) -> Lane:
        """The whole value as components."""
        _check_size(self.shape)
        return self._load(self.shape, self.start)

    def row(self, k: Any) -> Lane:
        """The k-th row as components."""
        shape = self.shape[1:]
        return self._load(shape, self.start + k * np.int32(math.prod(shape)))

    def _load(self, shape: tuple[int, ...], start: Any) -> Lane:
        numbers = [self.ref[start + np.int32(k)] for k in range(math.prod(shape))]
        return Lane(shape, object_array(shape, [n != 0 for n in numbers] if self.dtype == bool else numbers))


class _Inside:
    """Evaluation inside the kernel: every value an object array of numbers, or of vectors over the block."""

    def __init__(self, interpret: bool):
        self.interpret = interpret

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
        for of in eqn.outvars:
            _held_as(of.aval.dtype)
        if name in _UNKNOWN and not self.interpret:
            raise NotImplementedError(f"a kernel's compiler lacks the primitive `{name}`{place(eqn)}")
        inner = params["call_jaxpr"] if name in _CUSTOM else called(eqn)
        if inner is not None:
            return self.evaluate(inner, values)
        if name == "cond":
            return self.branch(params["branches"], values)
        if (name == "iota" or components.covers(name)) and all(map(_known, values)):
            arrays = [
                np.array(list(v.parts.flat), of.aval.dtype).reshape(v.shape)
                for v, of in zip(values, eqn.invars, strict=True)
            ]
            with jax.ensure_compile_time_eval():
                return [_constant(out) for out in components.bind(eqn, arrays)]
        # spread anew for each equation: what was spread inside a branch or a loop is not known outside
        made = otherwise(eqn, values)
        if made is None and components.covers(name):
            made = components.apply(eqn, values, components.Alike(), LARGEST)
        if made is not None:
            return made
        raise NotImplementedError(f"a kernel has no rule for the primitive `{name}`{place(eqn)}")

    def scan(self, params: Any, values: list) -> list:
        """A loop, its steps written out if they are few."""
        body, length = params["jaxpr"], params["length"]
        operands = of_scan(params, values)
        carried = len(operands[1])
        if params["reverse"]:
            raise NotImplementedError("a kernel's loops run forward")
        if length <= UNROLLED or (carried == 0 and length <= MAPPED):
            consts, state = ([_lane(v) for v in part] for part in operands[:2])
            every = []
            for k in range(length):
                every.append(self.evaluate(body, [*consts, *state, *(_row(x, k) for x in operands[2])]))
                state = every[k][:carried]
            stacked = enumerate(of.aval.shape for of in body.jaxpr.outvars[carried:])
            return [*state, *(_stacked([step[carried + k] for step in every], shape) for k, shape in stacked)]
        if len(body.jaxpr.outvars) > carried:
            raise NotImplementedError(f"a kernel stacks no results of {length} steps")
        return self.loop(body, length, operands, settle(body.jaxpr, *map(_varies, operands)))

    def loop(self, body: Any, length: int, operands: Sequence[Sequence], varies: Sequence[int]) -> list:
        """The last carries of a loop; operands: constants, carries, and what it goes through."""
        *inside, xs = operands
        consts, state = ([_lane(v) for v in part] for part in inside)
        shapes = [v.shape for v in state]

        def step(k: Any, packed: tuple) -> tuple:
            rows = (_row(x, k) for x in xs)
            return self.pack(self.evaluate(body, [*consts, *_unpacked(packed, shapes), *rows]), varies)

        return _unpacked(lax.fori_loop(np.int32(0), np.int32(length), step, self.pack(state, varies)), shapes)

    def branch(self, branches: Sequence, values: list) -> list:
        """A branch where all trials agree, else all of them and a choice for each trial."""
        (index,), operands = values[0].parts.reshape(1), values[1:]
        shapes = [v.shape for v in branches[0].out_avals]
        depends = [dependence(branch.jaxpr, _varies(operands)) for branch in branches]
        differs = [np.ndim(index) > 0 or any(each) for each in zip(*depends, strict=True)]
        cases = [lambda branch=branch: self.pack(self.evaluate(branch, operands), differs) for branch in branches]
        if np.ndim(index) == 0:
            found = lax.cond(index, cases[1], cases[0]) if index.dtype == bool else lax.switch(index, cases)
        else:
            which = index if index.dtype == bool else jnp.clip(index, 0, len(branches) - 1)
            found = jax.tree.map(lambda *each: chosen(which, each), *(case() for case in cases))
        return _unpacked(found, shapes)

    def pack(self, values: Sequence, differs: Sequence[int]) -> tuple:
        """Components as loops and branches carry them: numbers where all trials agree, vectors elsewhere."""

        def one(part: Any, each: int) -> Any:  # a number by an equation: its compiler hands back no known one
            return jnp.broadcast_to(part, (BLOCK,)) if each else lax.select(True, part, part)

        every = zip(values, differs, strict=False)
        return tuple(tuple(one(part, each) for part in value.parts.flat) for value, each in every)


def _unpacked(packed: Sequence, shapes: Sequence) -> list[Lane]:
    """The components that `_Inside.pack` packed."""
    return [Lane(shape, object_array(shape, parts)) for parts, shape in zip(packed, shapes, strict=True)]


def _constant(value: Any) -> Lane:
    array = np.asarray(value)
    return Lane(array.shape, object_array(array.shape, (array[i] for i in np.ndindex(*array.shape))))


def _known(value: Lane) -> bool:
    """Whether nothing is left to the kernel to compute, whose compiler takes no primitive of known numbers alone."""
    return all(isinstance(part, np.ndarray | np.generic) for part in value.parts.flat)


def _lane(value: Any) -> Lane:
    return value.lane() if isinstance(value, _Held) else value


def _row(value: Any, k: Any) -> Lane:
    """What step k is given of what a loop goes through."""
    if isinstance(value, _Held):
        return value.row(k)
    shape, rows = value.shape[1:], value.parts.reshape(value.shape[0], -1)
    return Lane(shape, object_array(shape, rows[k] if isinstance(k, int) else (chosen(k, each) for each in rows.T)))


def _stacked(rows: Sequence[Lane], each: tuple[int, ...]) -> Lane:
    shape = (len(rows), *each)
    return Lane(shape, object_array(shape, (part for row in rows for part in row.parts.flat)))


def _varies(values: Sequence) -> list[bool]:
    """Which values differ from trial to trial."""
    return [isinstance(value, Lane) and any(np.ndim(part) for part in value.parts.flat) for value in values]
