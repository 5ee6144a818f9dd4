"""The parameters of a flight computer as fields of C: what is set, and what C derives from that."""

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
    """Leaves of the parameters, for each its field, and by which pointer C has it: "p" as it is set, "d" derived."""

    structure: Any
    leaves: list[Any]
    fields: list[Field]  # of each leaf; what is shared is one
    values: dict[str, np.ndarray]  # by name
    derived: set[str] = field(default_factory=set)  # names
    origins: dict[str, list[str]] = field(default_factory=dict)  # of what follows from others: the names of those
    fixed: dict[str, str] = field(default_factory=dict)  # what does, but not in C: why
    rules: list[Rule] = field(default_factory=list)  # that C has
    used: set[str] = field(default_factory=set)  # names

    def tree(self, leaves: Any) -> Any:
        """The parameters of leaves."""
        return jax.tree.unflatten(self.structure, leaves)

    def pointer(self, made: Field) -> str:
        """The name of the pointer by which C has a field."""
        return "d" if made.name in self.derived else "p"

    def listed(self, pointer: str) -> list[Field]:
        """The fields that are used and that C has by this pointer."""
        once = {made.name: made for made in self.fields if self.pointer(made) == pointer and made.name in self.used}
        return list(once.values())

    def nodes(self, pool: Pool, places: dict[str, str]) -> list[np.ndarray]:
        """What C reads for each leaf."""
        return [nodes_of(pool, f"{self.pointer(made)}->", made, places, self.pointer(made)) for made in self.fields]

    def use(self, printer: printing.Printer) -> None:
        """Marks what a function reads."""
        read = {node.value.partition("[")[0] for node in printer.nodes.values() if node.op == "place"}
        self.used |= {made.name for made in self.fields if f"{self.pointer(made)}->{made.name}" in read}

    def derivation(self) -> tuple[Block, dict[str, np.ndarray]]:
        """What the rules compute: a block, and by name what it gives."""
        pool = Pool()
        results = Translator(pool).evaluate(_traced(self, self.rules), self.nodes(pool, {}))
        derived: dict[str, np.ndarray] = {}
        for made, result in zip(self.fields, results, strict=True):
            if made.name in self.derived:
                derived.setdefault(made.name, result)
        return pool.block, derived


def nodes_of(pool: Pool, text: str, made: Field, places: dict[str, str], pointer: str) -> np.ndarray:
    """What C reads of a field; places: is told by which pointer."""
    array = np.empty(made.shape, dtype=object)
    for index in np.ndindex(*made.shape):
        place = f"{text}{made.element(index)}"
        places[place] = pointer
        array[index] = pool.place(place, made.kind)
    return array


def parameters(board: Board) -> Parameters:
    """The parameters of a flight computer, and which of them C derives."""
    made = named(board)
    for rule in board.rules:
        _follow(made, rule)
    return made


COMPUTED = ("bound", "observer_matrix")  # what is shared with these has the other's name


def named(board: Board) -> Parameters:
    """The parameters of a flight computer by their names, of which none is derived yet."""
    found: dict[int, Field] = {}
    listed = jax.tree_util.tree_flatten_with_path(board.parameters)[0]
    leaves = [leaf for _, leaf in listed]
    made = Parameters(jax.tree.structure(board.parameters), leaves, [], {})
    for path, leaf in sorted(listed, key=lambda item: item[0][0].key in COMPUTED):
        if id(leaf) in found:
            continue
        parts, meaning = fields.spoken(path, board.parameters)
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


def _follow(made: Parameters, rule: Rule) -> None:
    """Marks what a rule gives as derived, or as fixed where C cannot say it."""
    closed = _traced(made, [*made.rules, rule])
    jaxpr, gives = closed.jaxpr, {}
    places = {variable: k for k, variable in enumerate(jaxpr.invars)}
    of = dependence(jaxpr, [1 << k for k in range(len(jaxpr.invars))])
    for k, variable in enumerate(jaxpr.outvars):
        name = made.fields[k].name
        if not isinstance(variable, core.Literal) and variable in places:
            made.fields[k] = made.fields[places[variable]]  # another one as it is
        elif name not in made.derived:
            gives[name] = [other.name for j, other in enumerate(made.fields) if of[k] >> j & 1]
    try:
        pool = Pool()
        Translator(pool).evaluate(closed, made.nodes(pool, {}))
    except NoRuleError as error:
        made.fixed |= {name: str(error) for name in gives}
    else:
        made.rules.append(rule)
        made.derived |= set(gives)
    made.origins |= {name: list(dict.fromkeys(others)) for name, others in gives.items()}
