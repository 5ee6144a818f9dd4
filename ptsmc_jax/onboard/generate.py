"""The C functions and structs of a flight computer, generated from its stages. Read `generate` first."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import jax
import numpy as np

from ptsmc_jax.batching.components import object_array
from ptsmc_jax.laws.base import AccelerationLaw, Law
from ptsmc_jax.laws.kinematics import AttitudeKinematics, Kinematics
from ptsmc_jax.observers.base import Observer
from ptsmc_jax.onboard import origins, parameters, printing
from ptsmc_jax.onboard.board import SCALARS, Board, Stage
from ptsmc_jax.onboard.expressions import Node, Pool, Title, kind_of
from ptsmc_jax.onboard.fields import Field, struct
from ptsmc_jax.onboard.translate import Translator

Struct = dict[str, list[Field]]  # the fields of each named tree
POINTERS = {"p": "const ptsmc_params *p", "d": "const ptsmc_derived *d", "in": "const ptsmc_in *in",
            "before": "const ptsmc_state *before", "now": "ptsmc_state *now", "out": "ptsmc_out *out"}  # fmt: skip
PASSED = {"d": "&state->derived", "before": "state", "now": "&now", "out": "&found"}  # arguments in ptsmc_step
ARGUMENTS = {"t": "real t", "dt": "real dt", "regular": "int regular", "tracking": "int tracking"}
COMMON = (object, Law, AccelerationLaw, Kinematics, AttitudeKinematics, Observer)  # docstrings that C comments omit


@dataclass
class Code:
    """The generated C of a flight computer."""

    parameters: list[Field]
    values: dict[str, np.ndarray]  # values of the parameters, by name
    inputs: list[Field]
    state: list[Field]
    outputs: list[Field]
    functions: list[str] = field(default_factory=list)  # text of the functions
    calls: dict[str, str] = field(default_factory=dict)  # text of the function calls, by stage
    about: dict[str, str] = field(default_factory=dict)  # description of each stage of a sample
    counts: Counter[str] = field(default_factory=Counter)  # largest number of operations of a step, by operation
    open: bool = False  # whether a loop has an unknown number of passes; `counts` includes one pass of it
    derived: list[Field] = field(default_factory=list)  # numbers that C derives from parameters
    basis: list[Field] = field(default_factory=list)  # parameters that determine the derived numbers
    derivation: str = ""  # text of the function that computes the derived numbers
    follows: dict[str, list[str]] = field(default_factory=dict)  # parameters that each derived number depends on
    fixed: dict[str, str] = field(default_factory=dict)  # reason why C cannot derive a parameter, by name
    deriving: dict[str, int] = field(default_factory=dict)  # number of operations of the derivation
    variables: int = 0  # largest number of variables in a function

    @property
    def columns(self) -> dict[str, list[str]]:
        """The names of the elements, by struct, see the function `columns`."""
        params = [element for made in self.parameters for element in made.elements()]
        return {**columns(self.inputs, self.state, self.outputs), "params": params}


def generate(board: Board) -> Code:
    """Return the C of a flight computer. Raises NoRuleError if an operation has no counterpart in C."""
    known, structs = parameters.parameters(board), _structs(board)
    known.used.update(board.always)
    inputs, state, outputs = map(_listed, structs.values())
    code = Code([], {}, inputs, state, outputs)
    for stage in board.stages:
        _function(code, board, stage, structs, known)
    _derivation(code, known)
    code.parameters = known.listed("p")
    code.values = {made.name: known.values[made.name] for made in code.parameters}
    return code


def _derivation(code: Code, known: parameters.Parameters) -> None:
    """Add the function that derives numbers from parameters."""
    code.derived = known.listed("d")
    follows = {made.name: known.origins[made.name] for made in code.derived}
    code.fixed = {name: why for name, why in known.fixed.items() if name in known.used}
    code.follows = follows | {name: known.origins[name] for name in code.fixed}
    if not code.derived:
        return
    printer = printing.Printer()
    block, results = known.derivation()
    ends = [(f"d->{element}", node) for made in code.derived
            for element, node in zip(made.elements(), results[made.name].flat, strict=True)]  # fmt: skip
    body = printer.body(block, ends)
    known.use(printer)
    code.basis = [made for made in known.listed("p") if any(made.name in names for names in follows.values())]
    copies = [f"    d->of_{element} = p->{element};" for made in code.basis for element in made.elements()]
    about = printing.comment("Compute the derived numbers from the parameters, and copy these parameters.")
    head = [*about, "static void derive(const ptsmc_params *p, ptsmc_derived *d)", "{"]
    code.derivation = "\n".join([*head, *body, "", *copies, "}"])
    code.deriving = dict(printer.counts)
    code.variables = max(code.variables, printer.variables)


def _shapes(board: Board) -> dict[str, dict[str, Any]]:
    return {"in": board.inputs, "before": board.state, "out": board.outputs}


def _structs(board: Board) -> dict[str, Struct]:
    return {name: struct(trees, board.about) for name, trees in _shapes(board).items()}


def _listed(made: Struct) -> list[Field]:
    """Return the fields that C declares. Arrays without elements are left out, because C has none."""
    return [one for group in made.values() for one in group if one.size]


def columns(inputs: Sequence[Field], state: Sequence[Field], outputs: Sequence[Field]) -> dict[str, list[str]]:
    """Return the columns of inputs, outputs and state in vectors.csv, named as in C.

    Args:
        inputs: fields of the inputs.
        state: fields of the state.
        outputs: fields of the outputs.

    Returns:
        The columns by struct: "in", "out" and "state".
    """

    def all_of(members: Sequence[Field], owner: str = "") -> list[str]:
        return [owner + element for made in members for element in made.elements()]

    return {
        "in": ["t", *all_of(inputs)],
        "out": all_of(outputs),
        "state": ["t", "started", "tracking", *all_of(state), *all_of(outputs, "last.")],
    }


def names_of(board: Board) -> dict[str, list[str]]:
    """Return the columns of vectors.csv for a flight computer, without generating its C."""
    return columns(*map(_listed, _structs(board).values()))


# struct, and text before the field in C, by the prefix of a name that a stage reads or writes
STRUCT_OF_PREFIX = {"in": "in", "before": "before", "now": "before", "last": "out", "out": "out"}
C_PREFIX = {"in": "in->", "before": "before->", "now": "now->", "last": "before->last.", "out": "out->"}


def _function(code: Code, board: Board, stage: Stage, structs: dict[str, Struct], known: parameters.Parameters) -> None:
    """Add the function of a stage to the code."""

    def fields_of(name: str) -> list[Field]:
        prefix, _, key = name.partition(".")
        return structs[STRUCT_OF_PREFIX[prefix]][key]

    def run(leaves: list[Any], read: list[Any]) -> dict[str, Any]:
        return stage.run(known.tree(leaves), dict(zip(stage.reads, read, strict=True)))

    pool, args = Pool(), list[np.ndarray]()
    shapes = [_shape_of(board, name) for name in stage.reads]
    closed, written = jax.make_jaxpr(run, return_shape=True)(known.leaves, shapes)
    for name, shape in zip(stage.reads, shapes, strict=True):
        if name in SCALARS:
            args.append(object_array((), [pool.place(name, kind_of(shape.dtype))]))
        else:
            args += [made.nodes(pool, C_PREFIX[name.partition(".")[0]]) for made in fields_of(name)]
    results = iter(Translator(pool).evaluate(closed, [*known.nodes(pool), *args]))
    ends, returned, needed = list[tuple[str, Node]](), None, set[str]()
    for name in sorted(written):  # JAX flattens a dict in this order
        if name == "limited":
            returned = next(results).item()
            continue
        prefix = name.partition(".")[0]
        needed.add(prefix)
        for made in fields_of(name):
            result = next(results)
            _titled(result, made.name)
            places = (C_PREFIX[prefix] + element for element in made.elements())
            ends += zip(places, result.flat, strict=True)
    printer = printing.Printer(ARGUMENTS)
    body = printer.body(pool.block, ends, returned=returned)
    needed |= {node.value.partition("->")[0] for node in printer.nodes.values() if node.op == "place"}
    known.use(printer)
    arguments = {name: text for name, text in (POINTERS | ARGUMENTS).items() if name in needed}
    kind = "void" if returned is None else "int"
    head = printing.wrapped(f"static {kind} {stage.name}({', '.join(arguments.values())})", "")
    code.functions.append("\n".join([*_documents(stage), *head, "{", *body, "}"]))
    if stage.name != "begin":
        code.about[stage.name] = stage.about
    code.calls[stage.name] = f"{stage.name}({', '.join(PASSED.get(name, name) for name in arguments)})"
    code.counts.update(printer.counts)
    code.open |= printer.open
    code.variables = max(code.variables, printer.variables)


def _shape_of(board: Board, name: str) -> Any:
    prefix, _, key = name.partition(".")
    return SCALARS[name]() if name in SCALARS else _shapes(board)[STRUCT_OF_PREFIX[prefix]][key]


def _titled(result: np.ndarray, name: str) -> None:
    """Name variables of branches and loops after the field that they are written to, if they have no name."""
    title = Title(name)
    for index, node in np.ndenumerate(result):
        if node.op == "variable" and node.title is None:
            node.title, node.part = title, "".join(str(i + 1) for i in index)


def _documents(stage: Stage) -> list[str]:
    paragraphs = [stage.about]
    for part in stage.parts:
        for name, text in origins.documents(part, COMMON):
            paragraphs += [" ".join(one.split()) for one in f"{name}: {text}".split("\n\n")]
    return printing.comment("\n".join(paragraphs))
