"""The parameters of a flight computer as fields of C: independent parameters, and numbers derived from them.

Read `parameters` first.
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
    origins: dict[str, list[str]] = field(default_factory=dict)  # parameters that each derived one depends on
    fixed: dict[str, str] = field(default_factory=dict)  # reason why C cannot derive a parameter, by name
    rules: list[Rule] = field(default_factory=list)  # rules that C can evaluate
    used: set[str] = field(default_factory=set)  # names that C reads

    def tree(self, leaves: Any) -> Any:
        """Return the parameters with these leaves."""
        return jax.tree.unflatten(self.structure, leaves)

    def pointer(self, made: Field) -> str:
        """Return the name of the pointer to the struct that contains a field."""
        return "d" if made.name in self.derived else "p"

    def listed(self, pointer: str) -> list[Field]:
        """Return the fields of this struct that C reads."""
        once = {made.name: made for made in self.fields if self.pointer(made) == pointer and made.name in self.used}
        return list(once.values())

    def nodes(self, pool: Pool) -> list[np.ndarray]:
        """Return the nodes that C reads, an array for each leaf."""
        return [made.nodes(pool, f"{self.pointer(made)}->") for made in self.fields]

    def use(self, printer: printing.Printer) -> None:
        """Mark the fields that a function reads."""
        read = {node.value.partition("[")[0] for node in printer.nodes.values() if node.op == "place"}
        self.used |= {made.name for made in self.fields if f"{self.pointer(made)}->{made.name}" in read}

    def derivation(self) -> tuple[Block, dict[str, np.ndarray]]:
        """Return the block that evaluates the rules, and the derived numbers by name."""
        pool = Pool()
        results = Translator(pool).evaluate(_traced(self, self.rules), self.nodes(pool))
        derived: dict[str, np.ndarray] = {}
        for made, result in zip(self.fields, results, strict=True):
            if made.name in self.derived:
                derived.setdefault(made.name, result)
        return pool.block, derived


def parameters(board: Board) -> Parameters:
    """Return the parameters of a flight computer, with the derived ones marked."""
    made = named(board)
    for rule in board.rules:
        _mark_results(made, rule)
    return made


COMPUTED = ("bound", "observer_matrix")  # computed parameters; a leaf that they share is named after the other one


def named(board: Board) -> Parameters:
    """Return the parameters of a flight computer; none is marked as derived yet."""
    found: dict[int, Field] = {}
    listed = jax.tree_util.tree_flatten_with_path(board.parameters)[0]
    leaves = [leaf for _, leaf in listed]
    made = Parameters(jax.tree.structure(board.parameters), leaves, [], {})
    for path, leaf in sorted(listed, key=lambda item: item[0][0].key in COMPUTED):
        if id(leaf) in found:
            continue
        parts, meaning = fields.names_and_comment(path, board.parameters)
        short = parts[parts.index("model") + 1 :] if "model" in parts[:-1] else parts
        name = "_".join(short).lower()
        name = name if name not in made.values else "_".join(parts).lower()
        while name in made.values:
            name += "_"
        array = np.asarray(leaf)
        kind = fields.kind_of(array.dtype)
        found[id(leaf)] = Field(name, array.shape, kind, meaning or board.about.get(parts[0], ""))
        made.values[name] = array
    made.fields = [found[id(leaf)] for leaf in leaves]
    return made


def _traced(made: Parameters, rules: Iterable[Rule]) -> Any:
    def run(leaves: list[Any]) -> list[Any]:
        given = made.tree(leaves)
        for rule in rules:
            given = rule(given)
        return jax.tree.leaves(given)

    return jax.make_jaxpr(run)(made.leaves)


def _mark_results(made: Parameters, rule: Rule) -> None:
    """Mark the results of a rule as derived, or as fixed if C cannot compute them."""
    closed = _traced(made, [*made.rules, rule])
    jaxpr, gives = closed.jaxpr, {}
    places = {variable: k for k, variable in enumerate(jaxpr.invars)}
    of = dependence(jaxpr, [1 << k for k in range(len(jaxpr.invars))])
    for k, variable in enumerate(jaxpr.outvars):
        name = made.fields[k].name
        if not isinstance(variable, core.Literal) and variable in places:
            made.fields[k] = made.fields[places[variable]]  # the rule copies another parameter: they share a field
        elif name not in made.derived:
            gives[name] = [other.name for j, other in enumerate(made.fields) if of[k] >> j & 1]
    try:
        pool = Pool()
        Translator(pool).evaluate(closed, made.nodes(pool))
    except NoRuleError as error:
        made.fixed |= {name: str(error) for name in gives}
    else:
        made.rules.append(rule)
        made.derived |= set(gives)
    made.origins |= {name: list(dict.fromkeys(others)) for name, others in gives.items()}
