"""What the values of a trace differ over, and which of them count, without evaluating it: for `lanes` and `kernel`."""

import operator
from collections.abc import Sequence
from functools import reduce
from typing import Any

from jax.extend import core
from jax.interpreters import partial_eval

_CALLS = set("jit pjit closed_call core_call remat remat2 checkpoint".split())


def called(eqn: Any) -> Any:
    """The trace that a call stands for; None where an equation is no call."""
    params = eqn.params
    return params.get("jaxpr", params.get("call_jaxpr")) if eqn.primitive.name in _CALLS else None


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
        first, carried = params["num_consts"], params["num_carry"]
        fixed, begun, rowed = depends[:first], depends[first : first + carried], depends[first + carried :]
        body = params["jaxpr"].jaxpr
        settled = settle(body, fixed, begun, rowed)
        return [*settled, *dependence(body, [*fixed, *settled, *rowed])[carried:]]
    if every and name == "while":
        first = params["cond_nconsts"]
        second = first + params["body_nconsts"]
        settled = settle(params["body_jaxpr"].jaxpr, depends[first:second], depends[second:], [])
        (each,) = dependence(params["cond_jaxpr"].jaxpr, [*depends[:first], *settled])
        return [own | each for own in settled]
    return [every] * len(eqn.outvars)


def used(closed: core.ClosedJaxpr) -> core.ClosedJaxpr:
    """The trace without what no output hangs on."""
    used, _ = partial_eval.dce_jaxpr(closed.jaxpr, [True] * len(closed.jaxpr.outvars), instantiate=True)
    return core.ClosedJaxpr(used, closed.consts)
