"""The C functions and structs of a flight computer, generated from its stages. Read `generate` first."""

from collections import Counter
from dataclasses import dataclass, field

import jax
import numpy as np

from ptsmc_jax.batching.components import object_array
from ptsmc_jax.laws.base import AccelerationLaw, Law
from ptsmc_jax.laws.kinematics import AttitudeKinematics, Kinematics
from ptsmc_jax.observers.base import Observer
from ptsmc_jax.onboard import origins, printing
from ptsmc_jax.onboard.board import SCALARS, Board, Stage, Values
from ptsmc_jax.onboard.expressions import Node, Pool, kind_of, name_nodes
from ptsmc_jax.onboard.fields import Field, Parameters, collect_parameters, struct_fields
from ptsmc_jax.onboard.translate import Translator

Struct = dict[str, list[Field]]  # the fields of each named tree
# attribute of `Board` and `Code` with a struct, by the prefix of a name that a stage reads or writes
STRUCTS = {"in": "inputs", "before": "state", "now": "state", "last": "outputs", "out": "outputs"}
# text before the field in C
C_PREFIX = {"in": "in->", "before": "before->", "now": "now->", "last": "before->last.", "out": "out->"}
POINTERS = {"p": "const ptsmc_params *p", "d": "const ptsmc_derived *d", "in": "const ptsmc_in *in",
            "before": "const ptsmc_state *before", "now": "ptsmc_state *now", "out": "ptsmc_out *out"}  # fmt: skip
# arguments that ptsmc_step passes to the functions of the stages
CALL_ARGUMENTS = {"d": "&state->derived", "before": "state", "now": "&now", "out": "&found"}
SCALAR_PARAMETERS = {"t": "real t", "dt": "real dt", "regular": "int regular", "tracking": "int tracking"}
# classes whose docstrings are omitted from the comments in C
COMMON_BASES = (object, Law, AccelerationLaw, Kinematics, AttitudeKinematics, Observer)


@dataclass
class Code:
    """The generated C of a flight computer."""

    values: dict[str, np.ndarray]  # values of the parameters, by name
    inputs: list[Field]
    state: list[Field]
    outputs: list[Field]
    columns: dict[str, list[str]]  # names of the elements, by struct: "in", "out", "state", "params"
    parameters: list[Field] = field(default_factory=list)
    functions: list[str] = field(default_factory=list)  # text of the functions
    calls: dict[str, str] = field(default_factory=dict)  # text of the function calls, by stage
    stage_descriptions: dict[str, str] = field(default_factory=dict)  # description of each stage of a sample
    counts: Counter[str] = field(default_factory=Counter)  # largest number of operations of a step, by operation
    has_open_loop: bool = False  # whether a loop has an unknown number of passes; `counts` includes one pass of it
    derived: list[Field] = field(default_factory=list)  # numbers that C derives from parameters
    derivation_inputs: list[Field] = field(default_factory=list)  # parameters that determine the derived numbers
    derivation: str = ""  # text of the function that computes the derived numbers
    sources_of: dict[str, list[str]] = field(default_factory=dict)  # parameters that each derived number depends on
    underivable: dict[str, str] = field(default_factory=dict)  # reason why C cannot derive a parameter, by name
    derivation_counts: dict[str, int] = field(default_factory=dict)  # number of operations of the derivation
    variables: int = 0  # largest number of variables in a function


def generate(board: Board) -> Code:
    """Return the C of a flight computer. Raises NoRuleError if an operation has no counterpart in C."""
    params, structs = collect_parameters(board), _fields_by_struct(board)
    params.used.update(board.always_exported)
    inputs, state, outputs = map(_declared_fields, structs.values())
    code = Code(params.values, inputs, state, outputs, column_names(board))
    code.stage_descriptions = {stage.name: stage.description for stage in board.stages if stage.name != "begin"}
    for stage in board.stages:
        _add_stage_function(code, board, stage, structs, params)
    _add_derivation(code, params)
    code.parameters = params.used_fields("p")
    code.columns["params"] = [element for member in code.parameters for element in member.elements()]
    return code


def _add_derivation(code: Code, params: Parameters) -> None:
    """Add the function that derives numbers from parameters."""
    code.derived, code.sources_of = params.used_fields("d"), params.sources_of
    code.underivable = {name: reason for name, reason in params.underivable.items() if name in params.used}
    if not code.derived:
        return
    pool, printer = Pool(), printing.Printer()
    results = Translator(pool).evaluate(params.trace(params.rules), params.nodes(pool))
    # several leaves may share a field: the first one has its value
    nodes_by_name = {member.name: result for member, result in [*zip(params.fields, results, strict=True)][::-1]}
    outputs = [(f"d->{element}", node) for member in code.derived
            for element, node in zip(member.elements(), nodes_by_name[member.name].flat, strict=True)]  # fmt: skip
    body = printer.body(pool.block, outputs)
    params.mark_used(printer)
    inputs = {name for member in code.derived for name in params.sources_of[member.name]}
    code.derivation_inputs = [member for member in params.used_fields("p") if member.name in inputs]
    elements = [element for member in code.derivation_inputs for element in member.elements()]
    copy_lines = [f"    d->of_{element} = p->{element};" for element in elements]
    comment = printing.format_comment("Compute the derived numbers from the parameters, and copy these parameters.")
    head = [*comment, "static void derive(const ptsmc_params *p, ptsmc_derived *d)", "{"]
    code.derivation = "\n".join([*head, *body, "", *copy_lines, "}"])
    code.derivation_counts = dict(printer.counts)
    code.variables = max(code.variables, printer.variables)


def _fields_by_struct(board: Board) -> dict[str, Struct]:
    """Return the fields of "inputs", "state" and "outputs", by these names.

    The fields of a struct are lists by the name of its pytree, see `struct_fields`.
    """
    return {name: struct_fields(getattr(board, name), board.meanings) for name in ("inputs", "state", "outputs")}


def _declared_fields(struct: Struct) -> list[Field]:
    """Return the fields that C declares. Arrays without elements are left out, because C has none."""
    return [member for members in struct.values() for member in members if member.size]


def column_names(board: Board) -> dict[str, list[str]]:
    """Return the columns of vectors.csv, named as in C, by struct: "in", "out" and "state"."""
    inputs, state, outputs = (
        [element for member in _declared_fields(struct) for element in member.elements()]
        for struct in _fields_by_struct(board).values()
    )
    last_outputs = [f"last.{element}" for element in outputs]
    return {"in": ["t", *inputs], "out": outputs, "state": ["t", "started", "tracking", *state, *last_outputs]}


def _add_stage_function(code: Code, board: Board, stage: Stage, structs: dict[str, Struct], params: Parameters) -> None:
    """Add the function of a stage to the code."""
    shapes = {name: shape() for name, shape in SCALARS.items()}
    shapes |= {f"{prefix}.{key}": shape for prefix, struct in STRUCTS.items()
               for key, shape in getattr(board, struct).items()}  # fmt: skip

    def run_stage(parameter_leaves: list[jax.Array], values: list) -> Values:
        """Return the values that the stage writes, by name, given all values in the order of `shapes`."""
        parameters = jax.tree.unflatten(params.structure, parameter_leaves)
        return stage.run(parameters, dict(zip(shapes, values, strict=True)))

    pool = Pool()
    jaxpr, written = jax.make_jaxpr(run_stage, return_shape=True)(params.leaves, list(shapes.values()))
    args = [object_array((), [pool.place(name, kind_of(shapes[name].dtype))]) for name in SCALARS]
    args += [member.nodes(pool, C_PREFIX[prefix]) for prefix, struct in STRUCTS.items()
             for members in structs[struct].values() for member in members]  # fmt: skip
    results = iter(Translator(pool).evaluate(jaxpr, [*params.nodes(pool), *args]))
    assignments, return_value, needed_arguments = list[tuple[str, Node]](), None, set[str]()
    for name in sorted(written):  # JAX flattens a dict in this order
        if name == "limited":
            return_value = next(results).item()
            continue
        prefix, _, key = name.partition(".")
        needed_arguments.add(prefix)
        for member in structs[STRUCTS[prefix]][key]:
            result = next(results)
            name_nodes(result, member.name, only_variables=True)
            locations = (C_PREFIX[prefix] + element for element in member.elements())
            assignments += zip(locations, result.flat, strict=True)
    printer = printing.Printer(SCALAR_PARAMETERS)
    body = printer.body(pool.block, assignments, returned=return_value)
    needed_arguments |= {node.value.partition("->")[0] for node in printer.use_counts if node.op == "place"}
    params.mark_used(printer)
    arguments = {name: text for name, text in (POINTERS | SCALAR_PARAMETERS).items() if name in needed_arguments}
    kind = "void" if return_value is None else "int"
    head = printing.wrap_statement(f"static {kind} {stage.name}({', '.join(arguments.values())})", "")
    code.functions.append("\n".join([*_stage_comment(stage), *head, "{", *body, "}"]))
    code.calls[stage.name] = f"{stage.name}({', '.join(CALL_ARGUMENTS.get(name, name) for name in arguments)})"
    code.counts.update(printer.counts)
    code.has_open_loop |= printer.has_open_loop
    code.variables = max(code.variables, printer.variables)


def _stage_comment(stage: Stage) -> list[str]:
    """Return the lines of a stage's C comment: its description, and the docstrings of its parts' classes."""
    paragraphs = [stage.description]
    for part in stage.parts:
        for name, text in origins.class_docstrings(part, COMMON_BASES):
            paragraphs += [" ".join(paragraph.split()) for paragraph in f"{name}: {text}".split("\n\n")]
    return printing.format_comment("\n".join(paragraphs))
