"""A scan over time as one Pallas kernel for a GPU, over all trials of a batch. `lanes.vmap` uses it.

Under `lax.scan` an accelerator needs several launches in each step. Below a million trials they take longer than the
step itself. Here one Pallas kernel runs the whole loop: each block of trials keeps its carries in registers, and only
the last carries are written. Triton compiles scalars and vectors over a block only. So the body is evaluated on
components: unbatched values are read from tables of numbers, batched values from tables with a row for each component.
"""

import itertools
import math
from collections.abc import Sequence
from functools import reduce
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton
from jaxtyping import Array

from ptsmc_jax.batching import components, dependence
from ptsmc_jax.batching.components import TRIAL, BatchedArray
from ptsmc_jax.batching.dependence import split_scan_operands

BLOCK = 128  # trials in a block, a power of two
UNROLL_LIMIT = 8  # length of the longest loop that is unrolled
STACK_LIMIT = 256  # length of the longest loop without carries that is unrolled, to stack its results
MAX_COMPONENTS = 1024  # entries of the largest array; all arrays are split into components

_CUSTOM_CALLS = ("custom_jvp_call", "custom_vjp_call")  # inlined: derivatives are taken before the kernel is built
# primitives that a compiled kernel refuses: Triton has no lowering for them, although `components` has a rule
_NOT_LOWERED = set(
    """complex conj copy copy_p digamma eq_to erf erf_inv erfc imag le_to lgamma lt_to real reduce_precision
    round""".split()
)
_DTYPES = set("bool int8 int16 int32 int64 uint8 uint16 uint32 uint64 float32 float64".split())


def scan(
    params: Any, values: Sequence[BatchedArray], varies: Sequence[int], batch: tuple[int, ...], interpreted: bool
) -> list[np.ndarray] | None:
    """Run a `lax.scan` as one kernel.

    Args:
        params: parameters of the scan.
        values: its operands.
        varies: whether each carry differs by trial at any step.
        batch: (trials,), or (directions, trials) with tangents: each direction is computed on its own.
        interpreted: let JAX interpret the kernel on any device, slowly, for tests.

    Returns:
        The last carries as components, whose entries have the batch's shape. None if the scan does not suit a kernel:
        it is short or runs backward, stacks results, iterates over batched rows, or no carry differs by trial.

    Raises:
        NotImplementedError: A kernel cannot compute the body. It uses primitives that Triton lacks, arrays of more than
            `MAX_COMPONENTS` entries, loops of unknown length, or long loops that stack results or run backward.
    """
    body, length, inputs = params["jaxpr"], params["length"], params["jaxpr"].jaxpr.invars
    carries, xs = split_scan_operands(params, inputs)[1], split_scan_operands(params, values)[2]
    unsuitable = (
        length <= UNROLL_LIMIT or params["reverse"] or len(body.jaxpr.outvars) > len(carries) or not any(varies)
    )
    if unsuitable or 0 in batch or any(x.axes & TRIAL for x in xs):
        return None
    *directions, trials = batch
    blocks, count = -(-trials // BLOCK), math.prod(directions)
    numbers, rows, ends = _Tables(), _Tables(), _Tables()
    operand_slots = [
        rows.add_rows(v, variable.aval.dtype) if v.axes & TRIAL else numbers.add_numbers(v, variable.aval.dtype, count)
        for v, variable in zip(values, inputs, strict=True)
    ]
    end_slots = [ends.add([], v.aval.size, v.aval.shape, v.aval.dtype) for v in carries]

    def run_block(*refs: Any) -> None:
        """Run the scan for one block of trials and one direction: load the operands, iterate, store the carries."""
        remaining = iter(refs)
        number_refs, row_refs, end_refs = ({kind: next(remaining) for kind in t.parts} for t in (numbers, rows, ends))
        vectors = {kind: _load_rows(ref, rows.sizes[kind]) for kind, ref in row_refs.items()}

        def load_if_varying(value: BatchedArray, stored: _StoredArray) -> Any:
            """Return an operand of the body: loaded if it differs by trial, otherwise its place in the tables."""
            return stored.in_tables(vectors).load() if value.axes & TRIAL else stored.in_tables(number_refs)

        operands = list(map(load_if_varying, values, operand_slots))
        last = _Interpreter(interpreted).loop(body, length, split_scan_operands(params, operands), varies)
        written: dict[str, list] = {}
        for value, stored in zip(last, end_slots, strict=True):
            parts = (jnp.broadcast_to(jnp.asarray(part, stored.kind), (BLOCK,)) for part in value.components.flat)
            written.setdefault(stored.kind, []).extend(parts)
        for kind, ref in end_refs.items():
            _store_rows(ref, written[kind])

    def block_specs(tables: _Tables) -> list:
        heights = map(_next_power_of_two, tables.sizes.values())
        return [pl.BlockSpec((height, BLOCK), lambda block, direction: (direction, block)) for height in heights]

    flat, width = numbers.number_arrays(), blocks * BLOCK
    end_tables = pl.pallas_call(
        run_block,
        out_shape=[
            jax.ShapeDtypeStruct((count * _next_power_of_two(size), width), kind) for kind, size in ends.sizes.items()
        ],
        grid=(blocks, count),
        in_specs=[*(pl.BlockSpec(v.shape, lambda block, direction: (0,)) for v in flat), *block_specs(rows)],
        out_specs=block_specs(ends),
        interpret=interpreted,
        compiler_params=triton.CompilerParams(num_warps=BLOCK // 32),
    )(*flat, *rows.row_arrays(batch, width))
    by_row = {
        kind: jnp.moveaxis(table.reshape(*directions, -1, width)[..., :trials], -2, 0)
        for kind, table in zip(ends.parts, end_tables, strict=True)
    }
    return [stored.in_tables(by_row).load().components for stored in end_slots]


def _next_power_of_two(length: int) -> int:
    """Return the smallest power of two that is at least `length`. Triton requires powers of two in shapes."""
    return 1 << (length - 1).bit_length()


def _table_dtype(dtype: Any) -> str:
    """Return the dtype of the table for values of this dtype: int32 for booleans, otherwise the dtype itself.

    Raises:
        NotImplementedError: A kernel has no values of this dtype.
    """
    if str(dtype) not in _DTYPES:
        raise NotImplementedError(f"a kernel cannot hold values of the type {dtype}")
    return "int32" if dtype == np.dtype(bool) else str(dtype)


def _check_size(shape: tuple[int, ...]) -> None:
    """Raise NotImplementedError if an array of this shape has too many entries for a kernel."""
    if not components.is_small(shape, MAX_COMPONENTS):
        raise NotImplementedError(f"a kernel splits arrays of at most {MAX_COMPONENTS} entries")


class _StoredArray(NamedTuple):
    """An array in the table of one dtype. It is loaded where it is used.

    Args:
        kind: dtype of the table.
        start: index of the first entry.
        stride: entries from one direction of differentiation to the next, 0 if all directions have the same array.
        shape: shape of the array.
        dtype: dtype of the array.
        table: the table, in the kernel.
    """

    kind: str
    start: Any
    stride: int
    shape: tuple[int, ...]
    dtype: Any
    table: Any = None

    def in_tables(self, tables: dict[str, Any]) -> "_StoredArray":
        """Return the array with the table that `load` reads, at the direction of this kernel instance.

        tables: the table of each dtype.
        """
        start = np.int32(self.start)
        if self.stride:
            start = start + pl.program_id(1) * np.int32(self.stride)
        return self._replace(start=start, table=tables.get(self.kind))

    def load(self) -> BatchedArray:
        """Load the whole array."""
        _check_size(self.shape)
        parts = [self.table[self.start + np.int32(k)] for k in range(math.prod(self.shape))]
        return BatchedArray(self.shape, tuple(part != 0 for part in parts) if self.dtype == bool else tuple(parts))

    def row(self, k: Any) -> BatchedArray:
        """Load the k-th row."""
        shape = self.shape[1:]
        return self._replace(start=self.start + k * np.int32(math.prod(shape)), shape=shape).load()


class _Tables:
    """Tables by dtype, of numbers or of rows over the trials."""

    def __init__(self) -> None:
        self.parts: dict[str, list] = {}
        self.sizes: dict[str, int] = {}

    def add(self, parts: Sequence, size: int, shape: tuple[int, ...], dtype: Any, stride: int = 0) -> _StoredArray:
        """Append an array to the table of its dtype, and return its place there. An empty array creates no table.

        Args:
            parts: in a table of numbers, one flat array (size,). In a table of rows, a row over the trials for each
                component. If it is empty, the place is only reserved.
            size: number of table entries of the array: numbers for all directions, or rows for one direction.
            shape: shape of the array in one direction.
            dtype: dtype of the array.
            stride: see `_StoredArray`.
        """
        kind = _table_dtype(dtype)
        start = self.sizes.get(kind, 0)
        if size:
            self.parts.setdefault(kind, []).extend(parts)
            self.sizes[kind] = start + size
        return _StoredArray(kind, start, stride, shape, dtype)

    def add_rows(self, value: BatchedArray, dtype: Any) -> _StoredArray:
        """Append a row over the trials for each component of a value that differs by trial; return its place."""
        _check_size(value.shape)
        parts = value.components
        return self.add(list(parts.flat), parts.size, value.shape, dtype)

    def add_numbers(self, value: BatchedArray, dtype: Any, directions: int) -> _StoredArray:
        """Append a value that is equal in all trials, once for each direction if these differ; return its place."""
        array = jnp.ravel(value.to_array((directions, 1) if value.axes else ())).astype(_table_dtype(dtype))
        return self.add([array], array.size, value.shape, dtype, math.prod(value.shape) if value.axes else 0)

    def number_arrays(self) -> list[Array]:
        """Return the table of numbers of each dtype, padded to a power of two that is at least 16."""
        whole = [jnp.concatenate(parts) for parts in self.parts.values()]
        return [jnp.pad(v, (0, max(16, _next_power_of_two(v.size)) - v.size)) for v in whole]

    def row_arrays(self, batch: tuple[int, ...], width: int) -> list[Array]:
        """Return the table of rows of each dtype, (directions * height, width).

        The rows of a direction are padded to a power of two, the height.

        Args:
            batch: (trials,) or (directions, trials).
            width: length of a row. A row over fewer trials is padded.
        """
        arrays = []
        for kind, parts in self.parts.items():
            stacked = jnp.stack([jnp.broadcast_to(part, batch).astype(kind) for part in parts], axis=-2)
            padding = [(0, 0)] * len(batch[:-1]) + [
                (0, _next_power_of_two(len(parts)) - len(parts)),
                (0, width - batch[-1]),
            ]
            arrays.append(jnp.pad(stacked, padding, mode="edge").reshape(-1, width))
        return arrays


# Rows are loaded and stored in a loop. Triton analyses everything that depends on each load and store: a hundred of
# them, unrolled, take a hundred times as long to compile.


def _load_rows(ref: Any, count: int) -> Sequence:
    """Return the first rows of a table."""

    def load_row(k: Any, loaded: tuple) -> tuple:
        row = ref[k, :]
        return tuple(jnp.where(k == np.int32(i), row, value) for i, value in enumerate(loaded))

    empty = jnp.zeros((ref.shape[1],), ref.dtype)
    return lax.fori_loop(np.int32(0), np.int32(count), load_row, (empty,) * count)


def _store_rows(ref: Any, rows: Sequence) -> None:
    """Store the first rows of a table."""

    def store_row(k: Any, _: None) -> None:
        ref[k, :] = _select(k, *rows)

    lax.fori_loop(np.int32(0), np.int32(len(rows)), store_row, None)


def _select(k: Any, *values: Any) -> Any:
    """Return the k-th value, for an index that is known in the kernel only."""
    return reduce(lambda value, i: jnp.where(k == np.int32(i), values[i], value), range(1, len(values)), values[0])


# The functions below return NaN if an operand is NaN. Triton's maximum returns the other operand, so that a torque
# limit would hide a diverged trial.


def _maximum(a: Any, b: Any) -> Any:
    """Return the larger of two numbers, NaN if one of them is NaN."""
    return jnp.where((a >= b) | (a != a), a, b)


def _minimum(a: Any, b: Any) -> Any:
    """Return the smaller of two numbers, NaN if one of them is NaN."""
    return jnp.where((a <= b) | (a != a), a, b)


_REPLACEMENTS = {
    "max": _maximum,
    "min": _minimum,
    "clamp": lambda low, value, high: _minimum(_maximum(low, value), high),
    "select_n": _select,
}


class _Interpreter:
    """Evaluates jaxprs inside the kernel. A component is a constant, a scalar or a vector over the block.

    Args:
        interpreted: whether JAX interprets the kernel, for tests.
    """

    def __init__(self, interpreted: bool):
        self.interpreted = interpreted

    def evaluate(self, closed: Any, arguments: Sequence) -> list:
        """Return the outputs of a jaxpr."""
        return dependence.interpret(*dependence.open_jaxpr(closed), arguments, _to_constant, self.apply)

    def apply(self, eqn: Any, values: list) -> Sequence:
        """Return the results of one equation."""
        name, params = eqn.primitive.name, eqn.params
        if name == "scan":
            return self.scan(params, values)
        values = _load_all(values)
        for variable in eqn.outvars:
            _table_dtype(variable.aval.dtype)
        if name in _NOT_LOWERED and not self.interpreted:
            raise NotImplementedError(
                f"a kernel's compiler lacks the primitive `{name}`{dependence.source_location(eqn)}"
            )
        inner = params["call_jaxpr"] if name in _CUSTOM_CALLS else dependence.called_jaxpr(eqn)
        if inner is not None:
            return self.evaluate(inner, values)
        if name == "cond":
            return self.cond(params["branches"], values)
        if (name == "iota" or components.has_rule(name)) and all(map(_is_constant, values)):
            arrays = [
                np.array(list(v.components.flat), variable.aval.dtype).reshape(v.shape)
                for v, variable in zip(values, eqn.invars, strict=True)
            ]
            with jax.ensure_compile_time_eval():
                return [_to_constant(out) for out in components.bind(eqn, arrays)]
        # each equation gets new rules, because they store broadcast arrays, which must not leave a branch or loop
        has_two_cases = name == "select_n" and len(values) == 3
        rules = components.ComponentRules(MAX_COMPONENTS, {} if has_two_cases else _REPLACEMENTS)
        results = rules.apply(eqn, values)
        if results is None:
            raise NotImplementedError(
                f"a kernel has no rule for the primitive `{name}`{dependence.source_location(eqn)}"
            )
        return list(map(BatchedArray.of_components, results))

    def scan(self, params: Any, values: list) -> list[BatchedArray]:
        """Return the results of a loop, unrolled if it is short."""
        body, length = params["jaxpr"], params["length"]
        consts, init, xs = split_scan_operands(params, values)
        consts, state, count = _load_all(consts), _load_all(init), len(init)
        if params["reverse"]:
            raise NotImplementedError("a kernel cannot run a loop backward")
        if length <= UNROLL_LIMIT or (count == 0 and length <= STACK_LIMIT):
            steps: list[list] = []
            for k in range(length):
                steps.append(self.evaluate(body, [*consts, *state, *(_take_row(x, k) for x in xs)]))
                state = steps[k][:count]
            outputs = enumerate(body.jaxpr.outvars[count:], count)
            rows = (((length, *v.aval.shape), [step[j].parts for step in steps]) for j, v in outputs)
            return [*state, *(BatchedArray(shape, tuple(itertools.chain(*parts))) for shape, parts in rows)]
        if len(body.jaxpr.outvars) > count:
            raise NotImplementedError(f"a kernel cannot stack the results of {length} steps")
        operands = consts, state, xs
        return self.loop(body, length, operands, dependence.scan_dependence(body.jaxpr, *map(_vary_by_trial, operands)))

    def loop(self, body: Any, length: int, operands: Sequence[Sequence], varies: Sequence[int]) -> list[BatchedArray]:
        """Return the last carries of a loop. operands: constants, carries and xs."""
        (consts, init), xs = map(_load_all, operands[:2]), operands[2]

        def step(k: Any, state: list) -> list:
            return self.align(self.evaluate(body, [*consts, *state, *(_take_row(x, k) for x in xs)]), varies)

        return lax.fori_loop(np.int32(0), np.int32(length), step, self.align(init, varies))

    def cond(self, branches: Sequence, values: list[BatchedArray]) -> list[BatchedArray]:
        """Return the results of the branch that the first value selects; the other values are its operands.

        If trials differ in the index, all branches are evaluated.
        """
        (index,), operands = values[0].components.reshape(1), values[1:]
        varies = dependence.branch_dependence(branches, np.ndim(index) > 0, _vary_by_trial(operands))
        cases = [lambda branch=branch: self.align(self.evaluate(branch, operands), varies) for branch in branches]
        if np.ndim(index) == 0:
            return lax.cond(index, cases[1], cases[0]) if index.dtype == bool else lax.switch(index, cases)
        which = index if index.dtype == bool else jnp.clip(index, 0, len(branches) - 1)
        return jax.tree.map(lambda *each: _select(which, *each), *(case() for case in cases))

    def align(self, values: Sequence[BatchedArray], varies: Sequence[int]) -> list[BatchedArray]:
        """Return values as loops and branches carry them: vectors if they differ by trial, otherwise scalars."""

        def align_one(value: BatchedArray, varies_by_trial: int) -> BatchedArray:
            def to_component(part: Any) -> Any:  # Triton cannot return constants; select makes a scalar of them
                return jnp.broadcast_to(part, (BLOCK,)) if varies_by_trial else lax.select(True, part, part)

            return BatchedArray(value.shape, tuple(map(to_component, value.components.flat)))

        return [align_one(*item) for item in zip(values, varies, strict=False)]


def _to_constant(value: Any) -> BatchedArray:
    """Return an array of constants, split into components."""
    return BatchedArray.of_components(components.entries(np.asarray(value)))


def _is_constant(value: BatchedArray) -> bool:
    """Return whether all components are constants. Pallas cannot lower a primitive whose operands are all constants."""
    return all(isinstance(part, np.ndarray | np.generic) for part in value.components.flat)


def _load_all(values: Sequence) -> list[BatchedArray]:
    """Return the values in their order; arrays in memory are loaded."""
    return [value.load() if isinstance(value, _StoredArray) else value for value in values]


def _take_row(value: Any, k: Any) -> BatchedArray:
    """Return the row of xs that step k of a loop takes."""
    if isinstance(value, _StoredArray):
        return value.row(k)
    shape, rows = value.shape[1:], value.components.reshape(value.shape[0], -1)
    parts = rows[k] if isinstance(k, int) else (_select(k, *each) for each in rows.T)
    return BatchedArray(shape, tuple(parts))


def _vary_by_trial(values: Sequence) -> list[bool]:
    """Return whether each value differs by trial."""
    return [isinstance(v, BatchedArray) and any(np.ndim(part) for part in v.components.flat) for v in values]
