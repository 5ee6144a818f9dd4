"""The parameters of a flight computer as fields of C: independent parameters, and numbers derived from them.

Read `collect_parameters` first.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import jax
import numpy as np
from jax.extend import core

from ptsmc_jax.batching.dependence import dependence
from ptsmc_jax.onboard import fields, printing
from ptsmc_jax.onboard.board import Board
from ptsmc_jax.onboard.derived import Rule
from ptsmc_jax.onboard.expressions import Block, Pool
from ptsmc_jax.onboard.fields import Field
from ptsmc_jax.onboard.translate import NoRuleError, Translator


@dataclass
class Parameters:
    """The leaves of the parameters and their fields in C, in the struct "p" (set) or "d" (derived)."""

    structure: Any
    leaves: list[Any]
    fields: list[Field]  # field of each leaf; leaves that are the same array share a field
    values: dict[str, np.ndarray]  # values by name
    derived: set[str] = field(default_factory=set)  # names of derived parameters
    sources_of: dict[str, list[str]] = field(default_factory=dict)  # parameters that each derived one depends on
    underivable: dict[str, str] = field(default_factory=dict)  # reason why C cannot derive a parameter, by name
    rules: list[Rule] = field(default_factory=list)  # rules that C can evaluate
    used: set[str] = field(default_factory=set)  # names that C reads

    def unflatten(self, leaves: Any) -> Any:
        """Return the parameters with these leaves."""
        return jax.tree.unflatten(self.structure, leaves)

    def struct_pointer(self, member: Field) -> str:
        """Return the name of the pointer to the struct that contains a field."""
        return "d" if member.name in self.derived else "p"

    def used_fields(self, pointer: str) -> list[Field]:
        """Return the fields of this struct that C reads."""
        members = (member for member in self.fields if self.struct_pointer(member) == pointer)
        return list({member.name: member for member in members if member.name in self.used}.values())

    def nodes(self, pool: Pool) -> list[np.ndarray]:
        """Return the nodes that C reads, an array for each leaf."""
        return [member.nodes(pool, f"{self.struct_pointer(member)}->") for member in self.fields]

    def mark_used(self, printer: printing.Printer) -> None:
        """Mark the fields that a function reads."""
        read_names = {node.value.partition("[")[0] for node in printer.nodes.values() if node.op == "place"}
        pointers = ((self.struct_pointer(member), member.name) for member in self.fields)
        self.used |= {name for pointer, name in pointers if f"{pointer}->{name}" in read_names}

    def translate_rules(self) -> tuple[Block, dict[str, np.ndarray]]:
        """Return the block that evaluates the rules, and the derived numbers by name."""
        pool = Pool()
        results = Translator(pool).evaluate(_trace_rules(self, self.rules), self.nodes(pool))
        derived: dict[str, np.ndarray] = {}
        for member, result in zip(self.fields, results, strict=True):
            if member.name in self.derived:
                derived.setdefault(member.name, result)
        return pool.block, derived


def collect_parameters(board: Board) -> Parameters:
    """Return the parameters of a flight computer with their names in C, and mark the derived parameters."""
    parameters = name_parameters(board)
    for rule in board.rules:
        _mark_results(parameters, rule)
    return parameters


# computed parameters; an array that they share with another parameter is named after the other parameter
COMPUTED = ("bound", "observer_matrix")


def name_parameters(board: Board) -> Parameters:
    """Return the parameters of a flight computer with their names in C, without marks of derived parameters."""
    field_by_leaf: dict[int, Field] = {}
    leaves_with_path = jax.tree_util.tree_flatten_with_path(board.parameters)[0]
    leaves = [leaf for _, leaf in leaves_with_path]
    parameters = Parameters(jax.tree.structure(board.parameters), leaves, [], {})
    for path, leaf in sorted(leaves_with_path, key=lambda item: item[0][0].key in COMPUTED):
        if id(leaf) in field_by_leaf:
            continue
        path_names, meaning = fields.path_names_and_meaning(path, board.parameters)
        short_names = path_names[path_names.index("model") + 1 :] if "model" in path_names[:-1] else path_names
        name = "_".join(short_names).lower()
        name = name if name not in parameters.values else "_".join(path_names).lower()
        while name in parameters.values:
            name += "_"
        array = np.asarray(leaf)
        kind = fields.kind_of(array.dtype)
        field_by_leaf[id(leaf)] = Field(name, array.shape, kind, meaning or board.meanings.get(path_names[0], ""))
        parameters.values[name] = array
    parameters.fields = [field_by_leaf[id(leaf)] for leaf in leaves]
    return parameters


def _trace_rules(parameters: Parameters, rules: Iterable[Rule]) -> Any:
    def apply_rules(leaves: list[Any]) -> list[Any]:
        values = parameters.unflatten(leaves)
        for rule in rules:
            values = rule(values)
        return jax.tree.leaves(values)

    return jax.make_jaxpr(apply_rules)(parameters.leaves)


def _mark_results(parameters: Parameters, rule: Rule) -> None:
    """Mark the results of a rule as derived, or as underivable if C cannot compute them."""
    closed = _trace_rules(parameters, [*parameters.rules, rule])
    jaxpr, inputs_of_result = closed.jaxpr, {}
    input_index = {variable: k for k, variable in enumerate(jaxpr.invars)}
    masks = dependence(jaxpr, [1 << k for k in range(len(jaxpr.invars))])
    for k, variable in enumerate(jaxpr.outvars):
        name = parameters.fields[k].name
        if not isinstance(variable, core.Literal) and variable in input_index:
            # the rule copies another parameter: they share a field
            parameters.fields[k] = parameters.fields[input_index[variable]]
        elif name not in parameters.derived:
            inputs_of_result[name] = [other.name for j, other in enumerate(parameters.fields) if masks[k] >> j & 1]
    try:
        pool = Pool()
        Translator(pool).evaluate(closed, parameters.nodes(pool))
    except NoRuleError as error:
        parameters.underivable |= {name: str(error) for name in inputs_of_result}
    else:
        parameters.rules.append(rule)
        parameters.derived |= set(inputs_of_result)
    parameters.sources_of |= {name: list(dict.fromkeys(input_names)) for name, input_names in inputs_of_result.items()}
