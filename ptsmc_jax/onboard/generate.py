"""The C functions and structs of a flight computer."""

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ptsmc_jax.laws.base import Law
from ptsmc_jax.laws.error_motions import ErrorMotion
from ptsmc_jax.observers.base import Observer
from ptsmc_jax.onboard import origins, parameters, printing
from ptsmc_jax.onboard.board import SCALARS, Board, Stage
from ptsmc_jax.onboard.expressions import Node, Pool, Title
from ptsmc_jax.onboard.fields import Field, Struct
from ptsmc_jax.onboard.translate import Translator

POINTERS = {"p": "const ptsmc_params *p", "d": "const ptsmc_derived *d", "in": "const ptsmc_in *in",
            "before": "const ptsmc_state *before", "now": "ptsmc_state *now", "out": "ptsmc_out *out"}  # fmt: skip
PASSED = {"d": "&state->derived", "before": "state", "now": "&now", "out": "&found"}  # what a step has of these names
ARGUMENTS = {"t": "real t", "dt": "real dt", "regular": "int regular", "tracking": "int tracking"}
COMMON = (object, Law, ErrorMotion, Observer)  # what of a part's classes says nothing about it


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
    counts: dict[str, int] = field(default_factory=dict)  # operations of a step at most
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
    code = Code([], {}, list(structs["in"].fields.values()), list(structs["before"].fields.values()),
                list(structs["out"].fields.values()))  # fmt: skip
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
    code.derivation = "\n".join([*head, *_shortened(body), "", *copies, "}"])
    code.deriving = dict(printer.counts)
    code.variables = max(code.variables, len(printer.names))


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
    return columns(*(list(structs[name].fields.values()) for name in ("in", "before", "out")))


def _function(
    code: Code, board: Board, stage: Stage, structs: dict[str, Struct], trees: dict[str, Any],
    known: parameters.Parameters,
) -> None:  # fmt: skip
    pool = Pool()
    read = [_shape_of(board, name) for name in stage.reads]

    def run(leaves: list[Any], read: list[Any]) -> dict[str, Any]:
        return stage.run(known.tree(leaves), *read)

    closed, shape = jax.make_jaxpr(run, return_shape=True)(known.leaves, read)
    places: dict[str, str] = {}  # of what C reads: the pointer or argument
    args = known.nodes(pool, places)
    for name in stage.reads:
        prefix, _, key = name.partition(".")
        if name in SCALARS:
            kind = "int32_t" if name in ("regular", "tracking") else "real"
            node = pool.place(name, kind)
            places[name] = name
            args.append(np.array(node, dtype=object).reshape(()))
            continue
        text = {"in": "in->", "before": "before->", "last": "before->last.", "now": "now->", "out": "out->"}[prefix]
        struct = {"in": "in", "before": "before", "now": "before", "last": "out", "out": "out"}[prefix]
        pointer = "before" if prefix == "last" else prefix
        for leaf in jax.tree.leaves(trees[f"{struct}.{key}"]):
            args.append(parameters.nodes_of(pool, text, structs[struct].fields[leaf], places, pointer))
    results = Translator(pool).evaluate(closed, args)
    outputs: list[tuple[str, Node]] = []
    writes: set[str] = set()
    returned: Node | None = None
    for (name, part), result in zip(_named(shape), results, strict=True):
        prefix, _, key = name.partition(".")
        if name == "limited":
            returned = result.item()
            continue
        struct = "before" if prefix == "now" else "out"
        made = structs[struct].fields[jax.tree.leaves(trees[f"{struct}.{key}"])[part]]
        writes.add(prefix)
        flat, title = result.reshape(-1), Title(made.name)
        for index, node in np.ndenumerate(result):
            if node.op == "variable" and node.title is None:
                node.title, node.part = title, "".join(str(i + 1) for i in index)
        outputs += [(f"{prefix}->{element}", node) for element, node in zip(made.elements(), flat, strict=True)]
    printer = printing.Printer(ARGUMENTS)
    ends = [*outputs, *([("return", returned)] if returned is not None else [])]
    body = printer.body(pool.block, ends)
    needed = {places[node.value] for node in printer.nodes.values() if node.op == "place"} | writes
    known.use(printer)
    signature = [POINTERS[name] for name in POINTERS if name in needed]
    signature += [ARGUMENTS[name] for name in ARGUMENTS if name in needed]
    passed = [PASSED.get(name, name) for name in (*POINTERS, *ARGUMENTS) if name in needed]
    body = [line.replace("return = ", "return ") for line in body]
    kind = "int" if returned is not None else "void"
    head = printing.wrapped(f"static {kind} {stage.name}({', '.join(signature)})", "")
    code.functions.append("\n".join([*_documents(stage), *head, "{", *_shortened(body), "}"]))
    if stage.name != "begin":
        code.about[stage.name] = stage.about
    code.calls[stage.name] = f"{stage.name}({', '.join(passed)})"
    for op, count in printer.counts.items():
        code.counts[op] = code.counts.get(op, 0) + count
    code.variables = max(code.variables, len(printer.names))


def _shortened(body: list[str]) -> list[str]:
    """Lines in which an array of a struct that is read often has a name of its own."""
    text = "\n".join(body)
    reads = Counter(re.findall(r"(?<![\w>])((?:in|before|now|out)->(?:last\.)?\w+)\[(?!\d+\](?: =(?!=)|\[))", text))
    found, taken = {}, set(re.findall(r"(?<![\w>.])[A-Za-z_]\w*", text))
    for place, count in sorted(reads.items(), key=lambda item: (item[0].startswith("before"), item[0])):
        name = re.split(r"->|\.", place)[-1]
        name = f"{name}_before" if place.startswith("before") else name
        name = f"{name}_now" if name in taken else name
        if count >= 4 and name not in taken:
            taken.add(name)
            found[place] = name
    for place, name in found.items():
        body = [re.sub(rf"(?<![\w>]){re.escape(place)}\[(?!\d+\] =(?!=))", f"{name}[", line) for line in body]
    heads = [f"    const real *const {name} = {place};" for place, name in sorted(found.items())]
    return [*heads, *body]


def _shape_of(board: Board, name: str) -> Any:
    prefix, _, key = name.partition(".")
    if name in SCALARS:
        return jax.ShapeDtypeStruct((), jnp.int32 if name in ("regular", "tracking") else jnp.result_type(float))
    return {"in": board.inputs, "before": board.state, "now": board.state, "last": board.outputs,
            "out": board.outputs}[prefix][key]  # fmt: skip


def _named(shape: dict[str, Any]) -> list[tuple[str, int]]:
    """For each leaf of what a stage gives, in JAX's order: the name of its tree, and which leaf of it it is."""
    return [(name, k) for name in sorted(shape) for k in range(len(jax.tree.leaves(shape[name])))]


def _documents(stage: Stage) -> list[str]:
    said = [stage.about]
    for part in stage.parts:
        for name, text in origins.documents(part, COMMON):
            said += [" ".join(one.split()) for one in f"{name}: {text}".split("\n\n")]
    return printing.comment("\n".join(said))
