"""Branches and loops of a trace as regions of C; short loops with a fixed length are written out."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from ptsmc_jax.batching.components import object_array
from ptsmc_jax.onboard.expressions import BOOL, Block, Node, Region, kind_of

UNROLLED = 8  # passes of a loop that are written out, and
WRITTEN = 200  # operations that they may have together


def _inside(to: Any, closed: Any, args: Sequence[np.ndarray]) -> tuple[Block, list[np.ndarray]]:
    """A block of its own, and what its trace gives."""
    outer = to.pool.block
    to.pool.block = Block(outer)
    results = to.evaluate(closed, args)
    block, to.pool.block = to.pool.block, outer
    return block, results


def _region(to: Any, region: Region, shapes: Sequence[tuple[int, ...]], kinds: Sequence[str]) -> list[np.ndarray]:
    """Ends a region: variables that hold its results."""
    found = []
    for shape, kind in zip(shapes, kinds, strict=True):
        nodes = [to.pool.fresh(kind) for _ in range(int(np.prod(shape, dtype=int)))]
        region.results += nodes
        found.append(object_array(shape, nodes))
    statement = Node("region", (), "", region, to.pool.block)
    statement.section = to.pool.section
    for node in region.results:
        node.args = (statement,)
    to.pool.block.nodes.append(statement)
    return found


def _avals(variables: Sequence[Any]) -> tuple[list[tuple[int, ...]], list[str]]:
    return [v.aval.shape for v in variables], [kind_of(v.aval.dtype) for v in variables]


def branch(to: Any, eqn: Any, values: list[np.ndarray]) -> list[np.ndarray]:
    """lax.cond and lax.switch: as many branches, of which C runs one."""
    index, *operands = values
    branches, test = eqn.params["branches"], index.item()
    if test.op == "constant":
        return to.evaluate(branches[int(np.clip(int(test.value), 0, len(branches) - 1))], operands)
    return _switch(to, eqn, test, branches, operands)


def _switch(to: Any, eqn: Any, test: Node, branches: Sequence[Any], operands: list[np.ndarray]) -> list[np.ndarray]:
    """The last branch where `test` says so, else one of those before."""
    last = len(branches) - 1
    if test.kind == BOOL:
        on = test
    elif test.op == "convert" and test.args[0].kind == BOOL and last == 1:
        on = test.args[0]
    else:
        on = to.pool.make("ge", test, to.pool.constant(last, test.kind), kind=BOOL)
    region = Region("branch", on)
    for rest in ([branches[-1]], branches[:-1]):
        if len(rest) == 1:
            block, results = _inside(to, rest[0], operands)
        else:
            outer = to.pool.block
            to.pool.block = Block(outer)
            results = _switch(to, eqn, test, rest, operands)
            block, to.pool.block = to.pool.block, outer
        region.blocks.append(block)
        region.outputs.append([node for result in results for node in result.flat])
    return _region(to, region, *_avals(eqn.outvars))


def loop(to: Any, eqn: Any, values: list[np.ndarray]) -> list[np.ndarray]:
    """lax.while_loop."""
    params = eqn.params
    test, body = params["cond_jaxpr"], params["body_jaxpr"]
    first, second = params["cond_nconsts"], params["cond_nconsts"] + params["body_nconsts"]
    test_consts, body_consts, init = values[:first], values[first:second], values[second:]
    region = Region("while")
    shapes, kinds = _avals(eqn.outvars)
    region.initial = [node for value in init for node in value.flat]
    carry = _carry(to, region, shapes, kinds)
    block, going = _inside(to, test, [*test_consts, *carry])
    region.blocks.append(block)
    region.outputs.append([going[0].item()])
    block, after = _inside(to, body, [*body_consts, *carry])
    region.blocks.append(block)
    region.outputs.append([node for value in after for node in value.flat])
    return _region(to, region, shapes, kinds)


def _carry(to: Any, region: Region, shapes: Sequence[tuple[int, ...]], kinds: Sequence[str]) -> list[np.ndarray]:
    found = []
    for shape, kind in zip(shapes, kinds, strict=True):
        nodes = [to.pool.fresh(kind) for _ in range(int(np.prod(shape, dtype=int)))]
        region.carried += nodes
        found.append(object_array(shape, nodes))
    return found


def scan(to: Any, eqn: Any, values: list[np.ndarray]) -> list[np.ndarray]:
    """lax.scan and fori_loop of a fixed length: written out where it is short, else a loop in C."""
    params = eqn.params
    body, constants, carried, length = (params[k] for k in ("jaxpr", "num_consts", "num_carry", "length"))
    consts, init, xs = values[:constants], values[constants : constants + carried], values[constants + carried :]
    order = range(length)[:: -1 if params["reverse"] else 1]
    if length <= 1 or (length <= UNROLLED and length * len(body.jaxpr.eqns) <= WRITTEN):
        carry, rows = list(init), [[] for _ in body.jaxpr.outvars[carried:]]
        for k in order:
            results = to.evaluate(body, [*consts, *carry, *(x[k] if x.ndim else x for x in map(np.asarray, xs))])
            carry = results[:carried]
            for row, result in zip(rows, results[carried:], strict=True):
                row.append(result)
        stacked = [np.stack(row[:: -1 if params["reverse"] else 1]) if row else np.empty((0,), object)
                   for row in rows]  # fmt: skip
        return [*carry, *stacked]
    region = Region("count")
    region.length, region.index = length, to.pool.fresh("int32_t", "index")
    shapes, kinds = _avals(body.jaxpr.outvars[:carried])
    region.initial = [node for value in init for node in value.flat]
    carry = _carry(to, region, shapes, kinds)
    outer = to.pool.block
    to.pool.block = Block(outer)
    entries = []
    for x in xs:  # each component is a table over the passes
        nodes = []
        for column in x[list(order)].reshape(length, -1).T:
            table = to.pool.fresh(column[0].kind, "table")
            region.tables.append((table, list(column)))
            nodes.append(to.pool.make("entry", table, region.index, kind=table.kind))
        entries.append(object_array(x.shape[1:], nodes))
    after = to.evaluate(body, [*consts, *carry, *entries])
    block, to.pool.block = to.pool.block, outer
    region.blocks.append(block)
    region.outputs.append([node for value in after for node in value.flat])
    out = _region(to, region, shapes, kinds)
    at, filled = len(region.results), []
    shapes, kinds = _avals(body.jaxpr.outvars[carried:])
    for shape, kind in zip(shapes, kinds, strict=True):
        columns = []
        for _ in range(int(np.prod(shape, dtype=int))):
            table = to.pool.fresh(kind, "table")
            table.args = (to.pool.block.nodes[-1],)
            region.rows.append((table, at + len(region.rows)))
            columns.append([to.pool.make("entry", table, to.pool.constant(k, "int32_t"), kind=kind)
                            for k in order])  # fmt: skip
        filled.append(object_array((length, *shape), (column[k] for k in range(length) for column in columns)))
    return [*out, *filled]


CONTROL = {"scan": scan, "while": loop, "cond": branch}  # by primitive; `to` is the translator
