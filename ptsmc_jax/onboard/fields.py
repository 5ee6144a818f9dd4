"""Fields of C structs: the leaves of pytrees, each with its name, shape and meaning.

`struct_fields` names the inputs, the state and the outputs. `collect_parameters` names the parameters, and the numbers
that are derived from them.
"""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import jax
import numpy as np
from jax.extend import core

from ptsmc_jax.batching.components import object_array
from ptsmc_jax.batching.dependence import dependence
from ptsmc_jax.onboard.board import Board
from ptsmc_jax.onboard.derived import Rule
from ptsmc_jax.onboard.expressions import KINDS, NoRuleError, Pool, kind_of
from ptsmc_jax.onboard.origins import field_comments
from ptsmc_jax.onboard.printing import Printer
from ptsmc_jax.onboard.translate import Translator

# computed parameters; an array that they share with another parameter is named after the other parameter
COMPUTED = ("bound", "observer_matrix")


@dataclass(frozen=True)
class Field:
    """A number or an array in a struct."""

    name: str
    shape: tuple[int, ...]
    kind: str
    meaning: str = ""

    @classmethod
    def of_leaf(cls, name: str, leaf: Any, meaning: str) -> "Field":
        """Return the field of a leaf of a pytree.

        Args:
            name: name of the field in C.
            leaf: array, or its shape and dtype.
            meaning: comment on the field in C.

        Raises:
            NoRuleError: the dtype has no type in C.
        """
        kind = kind_of(leaf.dtype)
        if not kind:
            raise NoRuleError(f"{name} has the type {leaf.dtype}, but must have one of the types {', '.join(KINDS)}")
        return cls(name, tuple(leaf.shape), kind, meaning)

    @property
    def size(self) -> int:
        """The number of elements."""
        return int(np.prod(self.shape, dtype=int))

    def elements(self) -> list[str]:
        """Return the names of its elements in C, row by row."""
        return [self.name + "".join(f"[{i}]" for i in index) for index in np.ndindex(*self.shape)]

    def nodes(self, pool: Pool, prefix: str) -> np.ndarray:
        """Return the elements as an array of nodes.

        Args:
            pool: makes the nodes.
            prefix: the text before the name in C, such as "in->".
        """
        return object_array(self.shape, (pool.place(prefix + element, self.kind) for element in self.elements()))


def struct_fields(trees: Mapping[str, object], meanings: Mapping[str, str]) -> dict[str, list[Field]]:
    """Return the fields of a struct, in order.

    Args:
        trees: pytrees of shapes and dtypes, by name.
        meanings: the meaning of trees that are a single leaf, by name.

    Returns:
        For each tree, by its name, the list of its fields, one for each leaf.

    Raises:
        NoRuleError: the dtype of a leaf has no C type.
    """
    fields: dict[str, list[Field]] = {}
    used_names: set[str] = set()
    for name, tree in trees.items():
        fields[name] = []
        for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
            path_names, meaning = _names_and_meaning(path, tree)
            full_name = re.sub(r"\W+", "_", "_".join([name, *path_names])).strip("_").lower() or "x"
            while full_name in used_names:  # keys of a memory may differ only in capitals or punctuation
                full_name += "_"
            used_names.add(full_name)
            fields[name].append(Field.of_leaf(full_name, leaf, meaning or ("" if path else meanings.get(name, ""))))
    return fields


def _names_and_meaning(path: tuple, tree: object) -> tuple[list[str], str]:
    """Return the names of the attributes and entries that lead to a leaf, the outermost first.

    The second result is the meaning of the leaf in the source, empty if there is none.
    """
    names, meaning, owner = [], "", tree
    for key in path:
        name = getattr(key, "name", getattr(key, "key", getattr(key, "idx", key)))
        names.append(str(name))
        if isinstance(key, jax.tree_util.GetAttrKey):
            meaning = _declared_meaning(owner, str(name)) or field_comments(type(owner)).get(str(name), "")
        children = jax.tree_util.tree_leaves_with_path(owner, is_leaf=lambda node, owner=owner: node is not owner)
        owner = dict(children)[(key,)]
    return names, meaning


def _declared_meaning(part: object, name: str) -> str:
    """Return meaning, unit and allowed values of a field of a part, empty if its class does not declare them."""
    known = getattr(type(part), "__dataclass_fields__", {})
    declared = known[name].metadata.get("declared") if name in known else None
    if declared is None:
        return ""
    unit = declared.unit if isinstance(declared.unit, str) else declared.unit[0]
    meaning = f"{declared.meaning or name.replace('_', ' ')} [{unit.replace('unit of d', 'N m') or '-'}]"
    return f"{meaning}: {declared.words}"


@dataclass
class Parameters:
    """The leaves of the parameters and their fields in C, in the struct "p" (set) or "d" (derived)."""

    structure: Any  # `PyTreeDef`
    leaves: list[jax.Array]
    fields: list[Field]  # field of each leaf; leaves that are the same array share a field
    values: dict[str, np.ndarray]  # values by name
    derived: set[str] = field(default_factory=set)  # names of derived parameters
    sources_of: dict[str, list[str]] = field(default_factory=dict)  # parameters that each derived one depends on
    underivable: dict[str, str] = field(default_factory=dict)  # reason why C cannot derive a parameter, by name
    rules: list[Rule] = field(default_factory=list)  # rules that C can evaluate
    used: set[str] = field(default_factory=set)  # names that C reads

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

    def mark_used(self, printer: Printer) -> None:
        """Add to `used` the names of the parameters that the function of this printer reads."""
        read_names = {node.value.partition("[")[0] for node in printer.use_counts if node.op == "place"}
        self.used |= {
            member.name for member in self.fields if f"{self.struct_pointer(member)}->{member.name}" in read_names
        }

    def trace(self, rules: Iterable[Rule]) -> core.ClosedJaxpr:
        """Return the jaxpr that applies rules to the leaves."""

        def apply_rules(leaves: list[jax.Array]) -> list[jax.Array]:
            values = jax.tree.unflatten(self.structure, leaves)
            for rule in rules:
                values = rule(values)
            return jax.tree.leaves(values)

        return jax.make_jaxpr(apply_rules)(self.leaves)

    def add_rule(self, rule: Rule) -> None:
        """Note which C parameters a rule computes from other parameters; without such C code they are underivable."""
        closed = self.trace([*self.rules, rule])
        jaxpr, inputs_of_result = closed.jaxpr, dict[str, list[str]]()
        input_index = {variable: k for k, variable in enumerate(jaxpr.invars)}
        masks = dependence(jaxpr, [1 << k for k in range(len(jaxpr.invars))])
        for k, variable in enumerate(jaxpr.outvars):
            name = self.fields[k].name
            if not isinstance(variable, core.Literal) and variable in input_index:
                # the rule copies another parameter: they share a field
                self.fields[k] = self.fields[input_index[variable]]
            elif name not in self.derived:
                inputs = (other.name for j, other in enumerate(self.fields) if masks[k] >> j & 1)
                inputs_of_result[name] = list(dict.fromkeys(inputs))
        try:
            pool = Pool()
            Translator(pool).evaluate(closed, self.nodes(pool))
        except NoRuleError as error:
            self.underivable |= dict.fromkeys(inputs_of_result, str(error))
        else:
            self.rules.append(rule)
            self.derived |= set(inputs_of_result)
        self.sources_of |= inputs_of_result


def name_parameters(board: Board) -> Parameters:
    """Return the parameters of a flight computer with their names in C, without marks of derived parameters."""
    field_by_leaf: dict[int, Field] = {}
    leaves_with_path = jax.tree_util.tree_leaves_with_path(board.parameters)
    leaves = [leaf for _, leaf in leaves_with_path]
    parameters = Parameters(jax.tree.structure(board.parameters), leaves, [], {})
    for path, leaf in sorted(leaves_with_path, key=lambda item: item[0][0].key in COMPUTED):
        if id(leaf) in field_by_leaf:
            continue
        path_names, meaning = _names_and_meaning(path, board.parameters)
        short_names = path_names[path_names.index("model") + 1 :] if "model" in path_names[:-1] else path_names
        name = "_".join(short_names).lower()
        name = name if name not in parameters.values else "_".join(path_names).lower()
        while name in parameters.values:
            name += "_"
        parameters.values[name] = np.asarray(leaf)
        meaning = meaning or board.meanings.get(path_names[0], "")
        field_by_leaf[id(leaf)] = Field.of_leaf(name, parameters.values[name], meaning)
    parameters.fields = [field_by_leaf[id(leaf)] for leaf in leaves]
    return parameters


def collect_parameters(board: Board) -> Parameters:
    """Return the parameters of a flight computer with their names in C, and mark the derived parameters."""
    parameters = name_parameters(board)
    for rule in board.rules:
        parameters.add_rule(rule)
    return parameters
