"""The C functions and structs of a flight computer."""

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ptsmc_jax.laws.base import AccelerationLaw, Law
from ptsmc_jax.laws.kinematics import AttitudeKinematics, Kinematics
from ptsmc_jax.observers.base import Observer
from ptsmc_jax.onboard import origins, parameters, printing
from ptsmc_jax.onboard.board import SCALARS, Board, Stage
from ptsmc_jax.onboard.expressions import REAL, Node, Pool, Title
from ptsmc_jax.onboard.fields import Field, Struct
from ptsmc_jax.onboard.translate import Translator

POINTERS = {"p": "const ptsmc_params *p", "d": "const ptsmc_derived *d", "in": "const ptsmc_in *in",
            "before": "const ptsmc_state *before", "now": "ptsmc_state *now", "out": "ptsmc_out *out"}  # fmt: skip
PASSED = {"d": "&state->derived", "before": "state", "now": "&now", "out": "&found"}  # what a step has of these names
ARGUMENTS = {"t": "real t", "dt": "real dt", "regular": "int regular", "tracking": "int tracking"}
COMMON = (object, Law, AccelerationLaw, Kinematics, AttitudeKinematics, Observer)  # not described in the C


@dataclass
class Code:
    """The C of a flight computer."""

    parameters: list[Field]
    values: dict[str, np.ndarray]  # of the parameters
    inputs: list[Field]
    state: list[Field]
    outputs: list[Field]
    functions: list[str] = field(default_factory=list)  # their text
    calls: dict[str, str] = field(default_factory=dict)  # by stage
    about: dict[str, str] = field(default_factory=dict)  # what each stage does, of those of a sample
    counts: Counter[str] = field(default_factory=Counter)  # operations of a step at most
    open: bool = False  # whether the passes of a loop are not known, of which one is counted
    derived: list[Field] = field(default_factory=list)  # what follows from parameters
    basis: list[Field] = field(default_factory=list)  # the parameters that it follows from
    derivation: str = ""  # the text of the function that does
    follows: dict[str, list[str]] = field(default_factory=dict)  # of each the names of those
    fixed: dict[str, str] = field(default_factory=dict)  # parameters that follow from others, but not in C: why
    deriving: dict[str, int] = field(default_factory=dict)  # operations of that
    variables: int = 0  # at most, of all functions together


def generate(board: Board) -> Code:
    """The C of a flight computer; raises NoRuleError where something in it has no rule."""
    known = parameters.parameters(board)
    structs, trees = _structs(board)
    known.used.add("period")
    code = Code([], {}, structs["in"].listed(), structs["before"].listed(), structs["out"].listed())
    for stage in board.stages:
        _function(code, board, stage, structs, trees, known)
    _derivation(code, known)
    code.parameters = known.listed("p")
    code.values = {made.name: known.values[made.name] for made in code.parameters}
    return code


def _derivation(code: Code, known: parameters.Parameters) -> None:
    """The function that computes what follows from parameters, of what is used."""
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
    about = printing.comment("What follows from the parameters, and the parameters that it follows from.")
    head = [*about, "static void derive(const ptsmc_params *p, ptsmc_derived *d)", "{"]
    code.derivation = "\n".join([*head, *_shortened(body, {}), "", *copies, "}"])
    code.deriving = dict(printer.counts)
    code.variables = max(code.variables, printer.variables)


def _structs(board: Board) -> tuple[dict[str, Struct], dict[str, Any]]:
    """The structs, and for each named tree its leaves' fields."""
    structs = {"in": Struct("in"), "before": Struct("before"), "out": Struct("out")}
    trees: dict[str, Any] = {}
    for prefix, shapes in (("in", board.inputs), ("before", board.state), ("out", board.outputs)):
        for name, shape in shapes.items():
            plain = isinstance(shape, jax.ShapeDtypeStruct)
            trees[f"{prefix}.{name}"] = structs[prefix].add(name, shape, board.about.get(name, "") if plain else "")
    return structs, trees


def columns(inputs: Sequence[Field], state: Sequence[Field], outputs: Sequence[Field]) -> dict[str, list[str]]:
    """The columns of vectors.csv that are inputs, outputs and state, as C has them, in order."""

    def all_of(members: Sequence[Field], owner: str = "") -> list[str]:
        return [owner + element for made in members for element in made.elements()]

    return {
        "in": ["t", *all_of(inputs)],
        "out": all_of(outputs),
        "state": ["t", "started", "tracking", *all_of(state), *all_of(outputs, "last.")],
    }


def names_of(board: Board) -> dict[str, list[str]]:
    """The columns of a flight computer, without its C."""
    structs, _ = _structs(board)
    return columns(*(structs[name].listed() for name in ("in", "before", "out")))


# of what a stage reads and writes, by the first part of its name: its struct, and what C has before the field's name
STRUCTS = {"in": "in", "before": "before", "now": "before", "last": "out", "out": "out"}
PLACES = {"in": "in->", "before": "before->", "now": "now->", "last": "before->last.", "out": "out->"}


def _function(
    code: Code, board: Board, stage: Stage, structs: dict[str, Struct], trees: dict[str, Any],
    known: parameters.Parameters,
) -> None:  # fmt: skip
    """Adds the function of a stage to the code."""

    def fields_of(name: str) -> list[Field]:
        prefix, _, key = name.partition(".")
        made = structs[STRUCTS[prefix]].fields
        return [made[leaf] for leaf in jax.tree.leaves(trees[f"{STRUCTS[prefix]}.{key}"])]

    def run(leaves: list[Any], read: list[Any]) -> dict[str, Any]:
        return stage.run(known.tree(leaves), *read)

    pool, places = Pool(), dict[str, str]()  # places: of what C reads, the pointer or argument
    closed, shape = jax.make_jaxpr(run, return_shape=True)(known.leaves, [_shape_of(board, n) for n in stage.reads])
    args = known.nodes(pool, places)
    for name in stage.reads:
        if name in SCALARS:
            node = pool.place(name, "int32_t" if name in ("regular", "tracking") else "real")
            places[name] = name
            args.append(np.array(node, dtype=object).reshape(()))
            continue
        prefix = name.partition(".")[0]
        pointer = "before" if prefix == "last" else prefix
        args += [parameters.nodes_of(pool, PLACES[prefix], made, places, pointer) for made in fields_of(name)]
    results = iter(Translator(pool).evaluate(closed, args))
    ends, returned, writes = list[tuple[str, Node]](), list[tuple[str, Node]](), set[str]()
    for name in sorted(shape):  # JAX's order of a dict
        if name == "limited":
            returned.append(("return", next(results).item()))
            continue
        prefix = name.partition(".")[0]
        writes.add(prefix)
        for made, result in zip(fields_of(name), results, strict=False):  # as many as it has
            _titled(result, made.name)
            ends += [
                (PLACES[prefix] + element, node) for element, node in zip(made.elements(), result.flat, strict=True)
            ]
    kinds = {place + made.name: made.kind for prefix, place in PLACES.items()
             for made in structs[STRUCTS[prefix]].fields.values()}  # fmt: skip
    printer = printing.Printer(ARGUMENTS)
    body = [line.replace("return = ", "return ") for line in printer.body(pool.block, [*ends, *returned])]
    needed = {places[node.value] for node in printer.nodes.values() if node.op == "place"} | writes
    known.use(printer)
    arguments = {name: text for name, text in (POINTERS | ARGUMENTS).items() if name in needed}
    kind = "int" if returned else "void"
    head = printing.wrapped(f"static {kind} {stage.name}({', '.join(arguments.values())})", "")
    code.functions.append("\n".join([*_documents(stage), *head, "{", *_shortened(body, kinds), "}"]))
    if stage.name != "begin":
        code.about[stage.name] = stage.about
    code.calls[stage.name] = f"{stage.name}({', '.join(PASSED.get(name, name) for name in arguments)})"
    code.counts.update(printer.counts)
    code.open |= printer.open
    code.variables = max(code.variables, printer.variables)


def _shortened(body: list[str], kinds: dict[str, str]) -> list[str]:
    """Lines in which an array of a struct that is read often has a name of its own; kinds: of arrays, by place."""
    text = "\n".join(body)
    reads = Counter(re.findall(r"(?<![\w>])((?:in|before|now|out)->(?:last\.)?\w+)\[(?!\d+\](?: =(?!=)|\[))", text))
    short_names, taken = {}, set(re.findall(r"(?<![\w>.])[A-Za-z_]\w*", text))
    for place, count in sorted(reads.items(), key=lambda item: (item[0].startswith("before"), item[0])):
        name = re.split(r"->|\.", place)[-1]
        name = f"{name}_before" if place.startswith("before") else name
        name = f"{name}_now" if name in taken else name
        if count >= 4 and name not in taken:
            taken.add(name)
            short_names[place] = name
    for place, name in short_names.items():
        body = [re.sub(rf"(?<![\w>]){re.escape(place)}\[(?!\d+\] =(?!=))", f"{name}[", line) for line in body]
    heads = [
        f"    const {printing.declared(kinds.get(place, REAL))} *const {name} = {place};"
        for place, name in sorted(short_names.items())
    ]
    return [*heads, *body]


def _shape_of(board: Board, name: str) -> Any:
    prefix, _, key = name.partition(".")
    if name in SCALARS:
        return jax.ShapeDtypeStruct((), jnp.int32 if name in ("regular", "tracking") else jnp.result_type(float))
    return {"in": board.inputs, "before": board.state, "now": board.state, "last": board.outputs,
            "out": board.outputs}[prefix][key]  # fmt: skip


def _titled(result: np.ndarray, name: str) -> None:
    """Gives variables of branches and loops that have no name of their own that of the field which they are for."""
    title = Title(name)
    for index, node in np.ndenumerate(result):
        if node.op == "variable" and node.title is None:
            node.title, node.part = title, "".join(str(i + 1) for i in index)


def _documents(stage: Stage) -> list[str]:
    said = [stage.about]
    for part in stage.parts:
        for name, text in origins.documents(part, COMMON):
            said += [" ".join(one.split()) for one in f"{name}: {text}".split("\n\n")]
    return printing.comment("\n".join(said))
