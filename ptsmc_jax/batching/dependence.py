"""Evaluation of jaxprs and their control flow, and the inputs that each output of a jaxpr depends on.

`interpret` evaluates a jaxpr on values of any type. `dependence` propagates flags through a jaxpr: an integer for each
value, with one bit for each input or batch axis. `lanes` and `kernel` use the flags for the batch axes of a value,
`onboard` for the parameters of an expression.
"""

import operator
from collections.abc import Callable, Mapping, Sequence
from functools import reduce
from typing import Any, TypeVar

import jax
from jax import lax
from jax.extend import core
from jax.interpreters import partial_eval

T = TypeVar("T")
_CALLS = set("jit pjit closed_call core_call remat remat2 checkpoint".split())


def called_jaxpr(eqn: Any) -> Any:
    """Return the jaxpr that an equation calls, or None if its primitive is no call."""
    params = eqn.params
    return params.get("jaxpr", params.get("call_jaxpr")) if eqn.primitive.name in _CALLS else None


def open_jaxpr(closed: Any) -> tuple[core.Jaxpr, Sequence]:
    """Return a jaxpr and its constants. A call may hold a jaxpr without constants."""
    return (closed.jaxpr, closed.consts) if isinstance(closed, core.ClosedJaxpr) else (closed, ())


def source_location(eqn: Any) -> str:
    """Return " (file:line)" of the user's code that an equation was traced from, or "" if JAX does not know it."""
    trace = eqn.source_info.traceback
    frames = [] if trace is None else [f for f in trace.frames if "/jax/" not in f.file_name]
    return f" ({frames[0].file_name}:{frames[0].line_num})" if frames else ""


def eliminate_dead_code(closed: core.ClosedJaxpr) -> core.ClosedJaxpr:
    """Return the jaxpr without the equations that no output depends on."""
    jaxpr, _ = partial_eval.dce_jaxpr(closed.jaxpr, [True] * len(closed.jaxpr.outvars), instantiate=True)
    return core.ClosedJaxpr(jaxpr, closed.consts)


def interpret(
    jaxpr: core.Jaxpr, consts: Sequence, arguments: Sequence[T], constant: Callable[[Any], T], apply: Callable[..., Any]
) -> list[T]:
    """Evaluate a jaxpr on values of any type.

    Args:
        jaxpr: the jaxpr.
        consts: its constants.
        arguments: values of its inputs.
        constant: (constant or literal) -> value.
        apply: (equation, values of its operands) -> values of its results.

    Returns:
        The values of its outputs.
    """
    values = dict(zip(jaxpr.constvars, map(constant, consts), strict=True))
    values |= zip(jaxpr.invars, arguments, strict=True)

    def read(atom: Any) -> T:
        return constant(atom.val) if isinstance(atom, core.Literal) else values[atom]

    for eqn in jaxpr.eqns:
        values |= zip(eqn.outvars, apply(eqn, [read(atom) for atom in eqn.invars]), strict=True)
    return [read(atom) for atom in jaxpr.outvars]


def split_scan_operands(
    params: Mapping[str, Any], operands: Sequence[T]
) -> tuple[Sequence[T], Sequence[T], Sequence[T]]:
    """Split the operands of a `lax.scan`, or the inputs of its body, into constants, carries and xs."""
    if "num_consts" in params:
        consts, carries = params["num_consts"], params["num_carry"]
    else:  # jax 0.11 and later store the three counts as branches of a tree
        consts, carries, _ = (len(branch) for branch in params["ft_in"].unpack())
    return operands[:consts], operands[consts : consts + carries], operands[consts + carries :]


def split_while_operands(
    params: Mapping[str, Any], operands: Sequence[T]
) -> tuple[Sequence[T], Sequence[T], Sequence[T]]:
    """Split the operands of a `lax.while_loop` into constants of its test, constants of its body, and carries."""
    first, second = params["cond_nconsts"], params["cond_nconsts"] + params["body_nconsts"]
    return operands[:first], operands[first:second], operands[second:]


def unpack_while(eqn: Any, operands: Sequence[T]) -> tuple[Any, Any, Sequence[T], Sequence[T], Sequence[T]]:
    """Return the test (a scalar) and the body of a `while` equation, constants of each, and the initial carries.

    `jax.vmap` in user code makes loops whose test has a truth value for each row of the carries. Such a loop runs while
    any row is true. Rows that are false keep their carries.
    """
    test, body = eqn.params["cond_jaxpr"], eqn.params["body_jaxpr"]
    test_consts, body_consts, init = split_while_operands(eqn.params, operands)
    (rows_axes,) = (range(len(aval.shape)) for aval in test.out_avals)
    if not rows_axes:
        return test, body, test_consts, body_consts, init
    run_test, run_body = core.jaxpr_as_fun(test), core.jaxpr_as_fun(body)

    def any_row(*loop_operands: Any) -> Any:
        return lax.reduce_or(run_test(*loop_operands)[0], rows_axes)

    def step(*loop_operands: Any) -> list:
        test_inputs, body_inputs, carries = split_while_operands(eqn.params, loop_operands)
        (running,) = run_test(*test_inputs, *carries)
        after = run_body(*body_inputs, *carries)
        masks = (lax.broadcast_in_dim(running, new.shape, rows_axes) for new in after)
        return [lax.select(mask, new, old) for mask, new, old in zip(masks, after, carries, strict=True)]

    avals = [v.aval for v in eqn.invars]
    test_inputs, _, carries = split_while_operands(eqn.params, avals)
    masked = jax.make_jaxpr(step)(*avals)
    return jax.make_jaxpr(any_row)(*test_inputs, *carries), masked, test_consts, [*test_consts, *body_consts], init


def union(flags: Sequence[int]) -> int:
    """Return the flags that at least one value has."""
    return reduce(operator.or_, flags, 0)


def dependence(jaxpr: core.Jaxpr, inputs: Sequence[int]) -> list[int]:
    """Return the flags of each output of a jaxpr: the union of the flags of the inputs that it depends on."""
    return interpret(jaxpr, [0] * len(jaxpr.constvars), inputs, lambda _: 0, _propagate)


def scan_dependence(body: core.Jaxpr, consts: Sequence[int], init: Sequence[int], xs: Sequence[int]) -> list[int]:
    """Return the flags of the last carries of a scan, then the flags of its stacked outputs.

    The flags of the carries are propagated through the step until they no longer change.

    Args:
        body: jaxpr of a step.
        consts: flags of its constants.
        init: flags of the initial carries.
        xs: flags of the arrays that it iterates over.
    """
    carries = list(init)
    while True:
        outputs = dependence(body, [*consts, *carries, *xs])
        updated = [a | b for a, b in zip(carries, outputs, strict=False)]
        if updated == carries:
            return [*carries, *outputs[len(carries) :]]
        carries = updated


def while_dependence(
    test: Any, body: Any, test_consts: Sequence[int], body_consts: Sequence[int], init: Sequence[int]
) -> tuple[list[int], int]:
    """Return the inputs or batch axes that the carries and the test of a `while` loop depend on, as flags.

    Flags are explained in the docstring of the module.

    Args:
        test: closed jaxpr of the test, see `unpack_while`.
        body: closed jaxpr of the body.
        test_consts: flags of the constants of the test.
        body_consts: flags of the constants of the body.
        init: flags of the initial carries.

    Returns:
        The flags of each carry, and the flags of the test.
    """
    carries = scan_dependence(body.jaxpr, body_consts, init, [])
    (running,) = dependence(test.jaxpr, [*test_consts, *carries])
    return [carry | running for carry in carries], running


def branch_dependence(branches: Sequence, index: int, operands: Sequence[int]) -> list[int]:
    """Return the flags of the outputs of a `cond` or `switch`: integers with one bit for each input or batch axis.

    Args:
        branches: closed jaxprs of the branches.
        index: flags of the index.
        operands: flags of the operands.
    """
    outputs = (dependence(branch.jaxpr, operands) for branch in branches)
    return [union(each) | index for each in zip(*outputs, strict=True)]


def _propagate(eqn: Any, flags: list[int]) -> list[int]:
    """Return the flags of the results of one equation. Calls, branches and loops are evaluated result by result."""
    inner, combined = called_jaxpr(eqn), union(flags)
    if combined and inner is not None:
        return dependence(open_jaxpr(inner)[0], flags)
    match eqn.primitive.name if combined else "":
        case "cond":
            return branch_dependence(eqn.params["branches"], flags[0], flags[1:])
        case "scan":
            return scan_dependence(eqn.params["jaxpr"].jaxpr, *split_scan_operands(eqn.params, flags))
        case "while":
            return while_dependence(*unpack_while(eqn, flags))[0]
    return [combined] * len(eqn.outvars)
