"""Branches and loops of a jaxpr as regions of C; short loops of fixed length are unrolled."""

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ptsmc_jax.batching.components import object_array
from ptsmc_jax.batching.dependence import split_scan_operands, unpack_while
from ptsmc_jax.onboard.expressions import BOOL, Block, Node, Region, kind_of

MOST_PASSES = 8  # largest number of passes of an unrolled loop
MOST_OPERATIONS = 200  # largest number of operations of an unrolled loop


def _inside(to: Any, region: Region, made: Callable[[], list[np.ndarray]]) -> None:
    """Add a block to a region. `made` returns the components of the block's outputs."""
    outer = to.pool.block
    to.pool.block = Block(outer)
    region.outputs.append(_flat(made()))
    region.blocks.append(to.pool.block)
    to.pool.block = outer


def _flat(arrays: Sequence[np.ndarray]) -> list[Node]:
    return [node for array in arrays for node in array.flat]


def _variables(to: Any, like: Sequence[Any]) -> list[np.ndarray]:
    """Return new C variables for the components of these variables of the jaxpr."""
    shapes, kinds = [v.aval.shape for v in like], [kind_of(v.aval.dtype) for v in like]
    return [object_array(shape, [to.pool.fresh(kind) for _ in range(math.prod(shape))])
            for shape, kind in zip(shapes, kinds, strict=True)]  # fmt: skip


def _region(to: Any, region: Region, like: Sequence[Any]) -> list[np.ndarray]:
    """End a region; return the variables of its results."""
    found = _variables(to, like)
    region.results += _flat(found)
    statement = Node("region", (), "", region, to.pool.block)
    statement.section = to.pool.section
    for node in region.results:
        node.args = (statement,)
    to.pool.block.nodes.append(statement)
    return found


def branch(to: Any, eqn: Any, values: list[np.ndarray]) -> list[np.ndarray]:
    """Translate lax.cond and lax.switch: C runs one of the branches.

    Args:
        to: the translator.
        eqn: the equation of the jaxpr.
        values: components of its inputs.

    Returns:
        The components of its outputs.
    """
    index, *operands = values
    branches, test = eqn.params["branches"], index.item()
    if test.op == "constant":
        return to.evaluate(branches[int(np.clip(int(test.value), 0, len(branches) - 1))], operands)
    return _switch(to, eqn, test, branches, operands)


def _switch(to: Any, eqn: Any, test: Node, branches: Sequence[Any], operands: list[np.ndarray]) -> list[np.ndarray]:
    """Translate lax.switch as an if statement: the last branch, or else the branches before it."""
    last = len(branches) - 1
    if test.kind == BOOL:
        on = test
    elif test.op == "convert" and test.args[0].kind == BOOL and last == 1:
        on = test.args[0]
    else:
        on = to.pool.make("ge", test, to.pool.constant(last, test.kind), kind=BOOL)
    region = Region("branch", on)
    _inside(to, region, lambda: to.evaluate(branches[-1], operands))
    if last == 1:
        _inside(to, region, lambda: to.evaluate(branches[0], operands))
    else:
        _inside(to, region, lambda: _switch(to, eqn, test, branches[:-1], operands))
    return _region(to, region, eqn.outvars)


def loop(to: Any, eqn: Any, values: list[np.ndarray]) -> list[np.ndarray]:
    """Translate lax.while_loop; see `branch` for arguments and result."""
    test, body, test_consts, body_consts, init = unpack_while(eqn, values)
    region = Region("while")
    carry = _carry(to, region, init, eqn.outvars)
    _inside(to, region, lambda: to.evaluate(test, [*test_consts, *carry]))
    _inside(to, region, lambda: to.evaluate(body, [*body_consts, *carry]))
    return _region(to, region, eqn.outvars)


def _carry(to: Any, region: Region, init: Sequence[np.ndarray], like: Sequence[Any]) -> list[np.ndarray]:
    """Return the variables of a loop's state, with these initial components."""
    region.initial, found = _flat(init), _variables(to, like)
    region.carried = _flat(found)
    return found


def scan(to: Any, eqn: Any, values: list[np.ndarray]) -> list[np.ndarray]:
    """Translate lax.scan and fori_loop of fixed length: unrolled if short, otherwise a loop in C.

    See `branch` for arguments and result.
    """
    params = eqn.params
    body, length = params["jaxpr"], params["length"]
    consts, init, xs = split_scan_operands(params, values)
    carried = len(init)
    order = range(length)[:: -1 if params["reverse"] else 1]
    if length <= 1 or (length <= MOST_PASSES and length * len(body.jaxpr.eqns) <= MOST_OPERATIONS):
        carry, rows = list(init), [[] for _ in body.jaxpr.outvars[carried:]]
        for k in order:
            results = to.evaluate(body, [*consts, *carry, *(x[k, ...] for x in xs)])
            carry = results[:carried]
            for row, result in zip(rows, results[carried:], strict=True):
                row.append(result)
        rows = [row[:: -1 if params["reverse"] else 1] for row in rows]
        stacked = [np.stack(row) if row else np.empty(v.aval.shape, object)
                   for row, v in zip(rows, eqn.outvars[carried:], strict=True)]  # fmt: skip
        return [*carry, *stacked]
    region = Region("count")
    region.length, region.index = length, to.pool.fresh("int32_t", "index")
    state, stacked = body.jaxpr.outvars[:carried], body.jaxpr.outvars[carried:]
    carry = _carry(to, region, init, state)

    def passed() -> list[np.ndarray]:
        entries = [_entries(to, region, x[list(order)]) for x in xs]
        return to.evaluate(body, [*consts, *carry, *entries])

    _inside(to, region, passed)
    out = _region(to, region, state)
    return [*out, *(_stacked_output(to, region, v.aval, order) for v in stacked)]


def _entries(to: Any, region: Region, x: np.ndarray) -> np.ndarray:
    """Return the entries of an input x (passes, ..) in one pass of a counted loop.

    Each component of x becomes a C array, which the loop reads at its index.
    """
    nodes = []
    for column in x.reshape(len(x), -1).T:
        table = to.pool.fresh(column[0].kind, "table")
        region.tables.append((table, list(column)))
        nodes.append(to.pool.make("entry", table, region.index, kind=table.kind))
    return object_array(x.shape[1:], nodes)


def _stacked_output(to: Any, region: Region, aval: Any, order: range) -> np.ndarray:
    """Return a stacked output (passes, ..) of a counted loop, from C arrays that the loop fills.

    Args:
        to: the translator.
        region: the loop. The arrays are added to it.
        aval: shape and dtype of the output in one pass.
        order: the passes in the order of the output's first axis.
    """
    kind, columns = kind_of(aval.dtype), []
    for _ in range(math.prod(aval.shape)):
        table = to.pool.fresh(kind, "table")
        table.args = (to.pool.block.nodes[-1],)
        region.rows.append((table, len(region.results) + len(region.rows)))
        columns.append([to.pool.make("entry", table, to.pool.constant(k, "int32_t"), kind=kind) for k in order])
    return object_array((len(order), *aval.shape), (column[k] for k in range(len(order)) for column in columns))


CONTROL = {"scan": scan, "while": loop, "cond": branch}  # rules by primitive; `to` is the translator
