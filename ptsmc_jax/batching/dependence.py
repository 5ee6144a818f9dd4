"""What the values of a trace differ over, and which of them count, without evaluating it: for `lanes` and `kernel`."""

import operator
from collections.abc import Mapping, Sequence
from functools import reduce
from typing import Any, NamedTuple, TypeVar

import jax
from jax import lax
from jax.extend import core
from jax.interpreters import partial_eval

T = TypeVar("T")
_CALLS = set("jit pjit closed_call core_call remat remat2 checkpoint".split())


def called(eqn: Any) -> Any:
    """The trace that a call stands for; None where an equation is no call."""
    params = eqn.params
    return params.get("jaxpr", params.get("call_jaxpr")) if eqn.primitive.name in _CALLS else None


def opened(closed: Any) -> tuple[core.Jaxpr, Sequence]:
    """A trace and its constants; a call's may stand without any."""
    return (closed.jaxpr, closed.consts) if isinstance(closed, core.ClosedJaxpr) else (closed, ())


def place(eqn: Any) -> str:
    """Where in the user's files an equation stands, as far as JAX knows."""
    trace = eqn.source_info.traceback
    frames = [] if trace is None else [f for f in trace.frames if "/jax/" not in f.file_name]
    return f" ({frames[0].file_name}:{frames[0].line_num})" if frames else ""


def of_scan(params: Mapping[str, Any], operands: Sequence[T]) -> tuple[Sequence[T], Sequence[T], Sequence[T]]:
    """The operands of a `lax.scan`, or its body's inputs: constants, carries, and what it goes through."""
    if "num_consts" in params:
        fixed, carried = params["num_consts"], params["num_carry"]
    else:  # from jax 0.11 on: three branches of a tree
        fixed, carried, _ = (len(branch) for branch in params["ft_in"].unpack())
    return operands[:fixed], operands[fixed : fixed + carried], operands[fixed + carried :]


def of_while(params: Mapping[str, Any], operands: Sequence[T]) -> tuple[Sequence[T], Sequence[T], Sequence[T]]:
    """The operands of a `lax.while_loop`: constants of its test, constants of its body, and carries."""
    first, second = params["cond_nconsts"], params["cond_nconsts"] + params["body_nconsts"]
    return operands[:first], operands[first:second], operands[second:]


class Loop(NamedTuple):
    """A `lax.while_loop`: the traces of its test, which is one truth, and of its body, and their operands."""

    test: core.ClosedJaxpr
    body: core.ClosedJaxpr
    test_consts: Sequence
    body_consts: Sequence
    init: Sequence


def loop_of(eqn: Any, operands: Sequence) -> Loop:
    """The loop that an equation stands for.

    `jax.vmap` in what a user wrote makes loops whose test has a truth for each row of the carries: they go on while it
    holds for one of these, and rows for which it does not stay as they are.
    """
    test, body = eqn.params["cond_jaxpr"], eqn.params["body_jaxpr"]
    test_consts, body_consts, init = of_while(eqn.params, operands)
    (truth,) = test.out_avals
    if not truth.shape:
        return Loop(test, body, test_consts, body_consts, init)

    def going(*inside: Any) -> Any:
        (on,) = core.jaxpr_as_fun(test)(*inside)
        return on

    def one_going(*inside: Any) -> Any:
        return lax.reduce_or(going(*inside), range(len(truth.shape)))

    def step(*inside: Any) -> list:
        tested, fixed, carried = of_while(eqn.params, inside)
        on = going(*tested, *carried)
        after = core.jaxpr_as_fun(body)(*fixed, *carried)
        rows = (lax.broadcast_in_dim(on, new.shape, range(on.ndim)) for new in after)
        return [lax.select(row, new, old) for row, new, old in zip(rows, after, carried, strict=True)]

    tested, _, carried = of_while(eqn.params, [v.aval for v in eqn.invars])
    kept = jax.make_jaxpr(step)(*(v.aval for v in eqn.invars))
    return Loop(jax.make_jaxpr(one_going)(*tested, *carried), kept, test_consts, [*test_consts, *body_consts], init)


def either(differs: Sequence[int]) -> int:
    """What at least one of them differs over."""
    return reduce(operator.or_, differs, 0)


def settle(jaxpr: core.Jaxpr, before: Sequence[int], carried: Sequence[int], after: Sequence[int]) -> list[int]:
    """What the carries of a loop differ over: what they do at its start, and what its body makes them differ over.

    before, after: the same for what stands before and after the carries among the body's inputs.
    """
    carried = list(carried)
    while True:
        outputs = dependence(jaxpr, [*before, *carried, *after])
        wider = [a | b for a, b in zip(carried, outputs, strict=False)]
        if wider == carried:
            return carried
        carried = wider


def dependence(jaxpr: core.Jaxpr, inputs: Sequence[int]) -> list[int]:
    """What the outputs of a trace differ over, given what its inputs do: all that any operand differs over."""
    known = dict(zip(jaxpr.invars, inputs, strict=True))

    def read(atom: Any) -> int:
        return 0 if isinstance(atom, core.Literal) else known.get(atom, 0)

    for eqn in jaxpr.eqns:
        depends = [read(atom) for atom in eqn.invars]
        known.update(zip(eqn.outvars, _dependence_through(eqn, depends), strict=True))
    return [read(atom) for atom in jaxpr.outvars]


def _dependence_through(eqn: Any, depends: list[int]) -> list[int]:
    """What the results of one equation differ over; of calls, branches and loops result by result."""
    inner, name, params, every = called(eqn), eqn.primitive.name, eqn.params, either(depends)
    if every and inner is not None:
        return dependence(getattr(inner, "jaxpr", inner), depends)
    if every and name == "cond":
        found = [dependence(branch.jaxpr, depends[1:]) for branch in params["branches"]]
        return [either(some) | depends[0] for some in zip(*found, strict=True)]
    if every and name == "scan":
        body, (fixed, begun, rowed) = params["jaxpr"].jaxpr, of_scan(params, depends)
        settled = settle(body, fixed, begun, rowed)
        return [*settled, *dependence(body, [*fixed, *settled, *rowed])[len(begun) :]]
    if every and name == "while":
        tested, fixed, begun = of_while(params, depends)
        settled = settle(params["body_jaxpr"].jaxpr, fixed, begun, [])
        (each,) = dependence(params["cond_jaxpr"].jaxpr, [*tested, *settled])
        return [own | each for own in settled]
    return [every] * len(eqn.outvars)


def used(closed: core.ClosedJaxpr) -> core.ClosedJaxpr:
    """The trace without what no output hangs on."""
    used, _ = partial_eval.dce_jaxpr(closed.jaxpr, [True] * len(closed.jaxpr.outvars), instantiate=True)
    return core.ClosedJaxpr(used, closed.consts)
