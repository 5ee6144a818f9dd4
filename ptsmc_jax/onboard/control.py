"""Branches and loops of a jaxpr as regions of C; short loops of fixed length are unrolled."""

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ptsmc_jax.batching.components import object_array
from ptsmc_jax.batching.dependence import split_scan_operands, unpack_while
from ptsmc_jax.onboard.expressions import BOOL, Block, Node, Region, kind_of

MAX_UNROLLED_PASSES = 8  # largest number of passes of an unrolled loop
MAX_UNROLLED_OPERATIONS = 200  # largest number of operations of an unrolled loop


def _add_block(translator: Any, region: Region, translate_block: Callable[[], list[np.ndarray]]) -> None:
    """Add a block to a region. `translate_block` returns the components of the block's outputs."""
    outer = translator.pool.block
    translator.pool.block = Block(outer)
    region.outputs.append(_flatten(translate_block()))
    region.blocks.append(translator.pool.block)
    translator.pool.block = outer


def _flatten(arrays: Sequence[np.ndarray]) -> list[Node]:
    return [node for array in arrays for node in array.flat]


def _new_variables(translator: Any, variables: Sequence[Any]) -> list[np.ndarray]:
    """Return new C variables for the components of these variables of the jaxpr."""
    shapes, kinds = [v.aval.shape for v in variables], [kind_of(v.aval.dtype) for v in variables]
    return [object_array(shape, [translator.pool.new_variable(kind) for _ in range(math.prod(shape))])
            for shape, kind in zip(shapes, kinds, strict=True)]  # fmt: skip


def _end_region(translator: Any, region: Region, variables: Sequence[Any]) -> list[np.ndarray]:
    """Append a finished region to the current block. Return the C variables of its results."""
    results = _new_variables(translator, variables)
    region.results += _flatten(results)
    statement = Node("region", (), "", region, translator.pool.block)
    statement.section = translator.pool.section
    for node in region.results:
        node.args = (statement,)
    translator.pool.block.nodes.append(statement)
    return results


def translate_cond(translator: Any, eqn: Any, values: list[np.ndarray]) -> list[np.ndarray]:
    """Translate lax.cond and lax.switch: C runs one of the branches.

    Args:
        translator: the translator.
        eqn: the equation of the jaxpr.
        values: components of its inputs.

    Returns:
        The components of its outputs.
    """
    index, *operands = values
    branches, test = eqn.params["branches"], index.item()
    if test.op == "constant":
        return translator.evaluate(branches[int(np.clip(int(test.value), 0, len(branches) - 1))], operands)
    return _translate_switch(translator, eqn, test, branches, operands)


def _translate_switch(
    translator: Any, eqn: Any, test: Node, branches: Sequence[Any], operands: list[np.ndarray]
) -> list[np.ndarray]:
    """Translate lax.switch as an if statement: the last branch, or else a switch of the branches before it."""
    last = len(branches) - 1
    if test.kind == BOOL:
        is_last = test
    elif test.op == "convert" and test.args[0].kind == BOOL and last == 1:
        is_last = test.args[0]
    else:
        is_last = translator.pool.make("ge", test, translator.pool.constant(last, test.kind), kind=BOOL)
    region = Region("branch", is_last)
    _add_block(translator, region, lambda: translator.evaluate(branches[-1], operands))
    if last == 1:
        _add_block(translator, region, lambda: translator.evaluate(branches[0], operands))
    else:
        _add_block(translator, region, lambda: _translate_switch(translator, eqn, test, branches[:-1], operands))
    return _end_region(translator, region, eqn.outvars)


def translate_while(translator: Any, eqn: Any, values: list[np.ndarray]) -> list[np.ndarray]:
    """Translate lax.while_loop; see `translate_cond` for arguments and result."""
    test, body, test_consts, body_consts, init = unpack_while(eqn, values)
    region = Region("while")
    carry = _start_loop_state(translator, region, init, eqn.outvars)
    _add_block(translator, region, lambda: translator.evaluate(test, [*test_consts, *carry]))
    _add_block(translator, region, lambda: translator.evaluate(body, [*body_consts, *carry]))
    return _end_region(translator, region, eqn.outvars)


def _start_loop_state(
    translator: Any, region: Region, init: Sequence[np.ndarray], variables: Sequence[Any]
) -> list[np.ndarray]:
    """Create the C variables of a loop's state, with these components as initial values."""
    region.initial, state = _flatten(init), _new_variables(translator, variables)
    region.carried = _flatten(state)
    return state


def translate_scan(translator: Any, eqn: Any, values: list[np.ndarray]) -> list[np.ndarray]:
    """Translate lax.scan and fori_loop of fixed length: unrolled if short, otherwise a loop in C.

    See `translate_cond` for arguments and result.
    """
    params = eqn.params
    body, length = params["jaxpr"], params["length"]
    consts, init, xs = split_scan_operands(params, values)
    carry_size = len(init)
    order = range(length)[:: -1 if params["reverse"] else 1]
    if length <= 1 or (length <= MAX_UNROLLED_PASSES and length * len(body.jaxpr.eqns) <= MAX_UNROLLED_OPERATIONS):
        carry, rows = list(init), [[] for _ in body.jaxpr.outvars[carry_size:]]
        for k in order:
            results = translator.evaluate(body, [*consts, *carry, *(x[k, ...] for x in xs)])
            carry = results[:carry_size]
            for row, result in zip(rows, results[carry_size:], strict=True):
                row.append(result)
        rows = [row[:: -1 if params["reverse"] else 1] for row in rows]
        stacked = [np.stack(row) if row else np.empty(v.aval.shape, object)
                   for row, v in zip(rows, eqn.outvars[carry_size:], strict=True)]  # fmt: skip
        return [*carry, *stacked]
    region = Region("count")
    region.length, region.index = length, translator.pool.new_variable("int32_t", "index")
    state, stacked = body.jaxpr.outvars[:carry_size], body.jaxpr.outvars[carry_size:]
    carry = _start_loop_state(translator, region, init, state)

    def translate_pass() -> list[np.ndarray]:
        entries = [_read_entries(translator, region, x[list(order)]) for x in xs]
        return translator.evaluate(body, [*consts, *carry, *entries])

    _add_block(translator, region, translate_pass)
    out = _end_region(translator, region, state)
    return [*out, *(_stacked_output(translator, region, v.aval, order) for v in stacked)]


def _read_entries(translator: Any, region: Region, x: np.ndarray) -> np.ndarray:
    """Return the entries of an input x (passes, ..) in one pass of a counted loop.

    Each component of x becomes a C array, which the loop reads at its index.
    """
    nodes = []
    for column in x.reshape(len(x), -1).T:
        table = translator.pool.new_variable(column[0].kind, "table")
        region.tables.append((table, list(column)))
        nodes.append(translator.pool.make("entry", table, region.index, kind=table.kind))
    return object_array(x.shape[1:], nodes)


def _stacked_output(translator: Any, region: Region, aval: Any, order: range) -> np.ndarray:
    """Return a stacked output (passes, ..) of a counted loop, from C arrays that the loop fills.

    Args:
        translator: the translator.
        region: the loop. The arrays are added to it.
        aval: shape and dtype of the output in one pass.
        order: the passes in the order of the output's first axis.
    """
    kind, columns = kind_of(aval.dtype), []
    for _ in range(math.prod(aval.shape)):
        table = translator.pool.new_variable(kind, "table")
        table.args = (translator.pool.block.nodes[-1],)
        region.rows.append((table, len(region.results) + len(region.rows)))
        indices = [translator.pool.constant(k, "int32_t") for k in order]
        columns.append([translator.pool.make("entry", table, k, kind=kind) for k in indices])
    return object_array((len(order), *aval.shape), (column[k] for k in range(len(order)) for column in columns))


# functions that translate a primitive, by its name
CONTROL = {"scan": translate_scan, "while": translate_while, "cond": translate_cond}
