"""Branches and loops of a jaxpr as regions of C; short loops of fixed length are unrolled."""

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from jax.extend.core import JaxprEqn

from ptsmc_jax.batching.components import object_array
from ptsmc_jax.batching.dependence import split_scan_operands, unpack_while
from ptsmc_jax.onboard.expressions import BOOL, Block, Node, Region, kind_of

if TYPE_CHECKING:
    from ptsmc_jax.onboard.translate import Translator

MAX_UNROLLED_PASSES = 8  # largest number of passes of an unrolled loop
MAX_UNROLLED_OPERATIONS = 200  # largest number of operations of an unrolled loop


def _add_block(translator: "Translator", region: Region, translate_block: Callable[[], list[np.ndarray]]) -> None:
    """Add a block to a region. `translate_block` returns the components of the block's outputs."""
    outer = translator.pool.block
    translator.pool.block = Block(outer)
    region.outputs.append(_flatten(translate_block()))
    region.blocks.append(translator.pool.block)
    translator.pool.block = outer


def _flatten(arrays: Sequence[np.ndarray]) -> list[Node]:
    """Return the nodes of several arrays in one list, row by row."""
    return [node for array in arrays for node in array.flat]


def _new_variables(translator: "Translator", variables: Sequence[Any]) -> list[np.ndarray]:
    """Return an array for each variable of the jaxpr, in its shape, with a new C variable for each component."""
    return [object_array(aval.shape, (translator.pool.new_variable(kind_of(aval.dtype)) for _ in range(aval.size)))
            for aval in (variable.aval for variable in variables)]  # fmt: skip


def _begin_loop(
    translator: "Translator", region: Region, init: Sequence[np.ndarray], variables: Any
) -> list[np.ndarray]:
    """Return the C variables of a loop's state, as `_new_variables` does, with these components as initial values."""
    region.initial, state = _flatten(init), _new_variables(translator, variables)
    region.carried = _flatten(state)
    return state


def _end_region(translator: "Translator", region: Region, variables: Sequence[Any]) -> list[np.ndarray]:
    """Append a finished region to the current block.

    Return the C variables of its results, as `_new_variables` does.
    """
    results = _new_variables(translator, variables)
    region.results += _flatten(results)
    statement = Node("region", (), "", region, translator.pool.block)
    statement.section = translator.pool.section
    for node in region.results:
        node.args = (statement,)
    translator.pool.block.nodes.append(statement)
    return results


def translate_cond(translator: "Translator", eqn: JaxprEqn, values: list[np.ndarray]) -> list[np.ndarray]:
    """Translate lax.cond and lax.switch: C runs one of the branches.

    Args:
        translator: translator of the whole jaxpr, which also translates the branches.
        eqn: equation of the jaxpr.
        values: the nodes of each input, an object array in the shape of the input.

    Returns:
        The nodes of each output, an object array in the shape of the output.
    """
    index, *operands = values
    branches, test = eqn.params["branches"], index.item()
    if test.op == "constant":
        return translator.evaluate(branches[int(np.clip(int(test.value), 0, len(branches) - 1))], operands)

    def translate_first(count: int) -> list[np.ndarray]:
        """Translate the first branches: the last of them, or else the branches before it."""
        if count == 1:
            return translator.evaluate(branches[0], operands)
        if test.kind == BOOL:
            is_last = test
        elif test.op == "convert" and test.args[0].kind == BOOL and count == 2:
            is_last = test.args[0]
        else:
            is_last = translator.pool.make("ge", test, translator.pool.constant(count - 1, test.kind), kind=BOOL)
        region = Region("branch", is_last)
        _add_block(translator, region, lambda: translator.evaluate(branches[count - 1], operands))
        _add_block(translator, region, lambda: translate_first(count - 1))
        return _end_region(translator, region, eqn.outvars)

    return translate_first(len(branches))


def translate_while(translator: "Translator", eqn: JaxprEqn, values: list[np.ndarray]) -> list[np.ndarray]:
    """Translate lax.while_loop to a loop in C.

    Args:
        translator: translator of the whole jaxpr, which also translates the test and body.
        eqn: equation of the jaxpr.
        values: the nodes of each input, an object array in the shape of the input.

    Returns:
        The nodes of each output, an object array in the shape of the output.
    """
    test, body, test_consts, body_consts, init = unpack_while(eqn, values)
    region = Region("while")
    carry = _begin_loop(translator, region, init, eqn.outvars)
    _add_block(translator, region, lambda: translator.evaluate(test, [*test_consts, *carry]))
    _add_block(translator, region, lambda: translator.evaluate(body, [*body_consts, *carry]))
    return _end_region(translator, region, eqn.outvars)


def translate_scan(translator: Any, eqn: Any, values: list[np.ndarray]) -> list[np.ndarray]:
    """Translate lax.scan and fori_loop of fixed length: unrolled if short, otherwise a loop in C.

    Args:
        translator: translator of the whole jaxpr, which also translates the body.
        eqn: equation of the jaxpr.
        values: the nodes of each input, an object array in the shape of the input.

    Returns:
        The nodes of each output, an object array in the shape of the output.
    """
    params = eqn.params
    body, length = params["jaxpr"], params["length"]
    consts, init, xs = split_scan_operands(params, values)
    carry_size = len(init)
    direction = -1 if params["reverse"] else 1
    order = range(length)[::direction]
    if length <= 1 or (length <= MAX_UNROLLED_PASSES and length * len(body.jaxpr.eqns) <= MAX_UNROLLED_OPERATIONS):
        carry, rows = list(init), [[] for _ in body.jaxpr.outvars[carry_size:]]
        for k in order:
            results = translator.evaluate(body, [*consts, *carry, *(x[k, ...] for x in xs)])
            carry = results[:carry_size]
            for row, result in zip(rows, results[carry_size:], strict=True):
                row.append(result)
        stacked = [np.stack(row[::direction]) if row else np.empty(v.aval.shape, object)
                   for row, v in zip(rows, eqn.outvars[carry_size:], strict=True)]  # fmt: skip
        return [*carry, *stacked]
    region = Region("count")
    region.length, region.index = length, translator.pool.new_variable("int32_t", "index")
    state, stacked = body.jaxpr.outvars[:carry_size], body.jaxpr.outvars[carry_size:]
    carry = _begin_loop(translator, region, init, state)

    def read_entries(x: np.ndarray) -> np.ndarray:
        """Return the entries of an input (passes, ..) in a pass, from C arrays of its components."""
        nodes = []
        for column in x[list(order)].reshape(length, -1).T:
            table = translator.pool.new_variable(column[0].kind, "table")
            region.tables.append((table, list(column)))
            nodes.append(translator.pool.make("entry", table, region.index, kind=table.kind))
        return object_array(x.shape[1:], nodes)

    _add_block(translator, region, lambda: translator.evaluate(body, [*consts, *carry, *map(read_entries, xs)]))
    out = _end_region(translator, region, state)
    indices = [translator.pool.constant(k, "int32_t") for k in order]
    for variable in stacked:  # C arrays that the loop fills
        shape, kind, columns = variable.aval.shape, kind_of(variable.aval.dtype), []
        for _ in range(math.prod(shape)):
            table = translator.pool.new_variable(kind, "table")
            table.args = (translator.pool.block.nodes[-1],)
            region.rows.append((table, len(region.results) + len(region.rows)))
            columns.append([translator.pool.make("entry", table, k, kind=kind) for k in indices])
        out.append(object_array((length, *shape), (column[k] for k in range(length) for column in columns)))
    return out


# functions that translate a primitive, by its name
CONTROL = {"scan": translate_scan, "while": translate_while, "cond": translate_cond}
