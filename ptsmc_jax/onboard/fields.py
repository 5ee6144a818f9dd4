"""The fields of the C structs: pytrees taken apart, with names, shapes and what the source says of them."""

import re
from dataclasses import dataclass, field
from typing import Any

import jax
import numpy as np

from ptsmc_jax.batching.components import object_array
from ptsmc_jax.onboard.expressions import NoRuleError, Pool, kind_of
from ptsmc_jax.onboard.origins import comments


@dataclass(frozen=True)
class Field:
    """A number or an array in a struct."""

    name: str
    shape: tuple[int, ...]
    kind: str
    about: str = ""

    @property
    def size(self) -> int:
        """How many numbers it is."""
        return int(np.prod(self.shape, dtype=int))

    def element(self, index: tuple[int, ...]) -> str:
        """One of its numbers, as C has it."""
        return self.name + "".join(f"[{i}]" for i in index)

    def elements(self) -> list[str]:
        """All its numbers, as C has them, row by row."""
        return [self.element(index) for index in np.ndindex(*self.shape)]


@dataclass
class Struct:
    """A struct that is being filled: its fields in order, and for each leaf that C reads its place."""

    pointer: str  # by what name C's functions have it
    fields: dict[str, Field] = field(default_factory=dict)

    def add(self, name: str, tree: Any, about: str = "") -> Any:
        """Fields for the leaves of a tree of arrays, or of shapes; returns the tree with names in place of leaves."""

        def one(path: Any, leaf: Any) -> str:
            parts, meaning = spoken(path, tree)
            full = "_".join([name, *parts]) if name else "_".join(parts)
            full = re.sub(r"\W+", "_", full).strip("_").lower() or "x"
            while full in self.fields:  # keys of a memory may differ in capitals, or in what no name has
                full += "_"
            try:
                kind = kind_of(leaf.dtype)
            except KeyError:
                raise NoRuleError(f"{full} holds {leaf.dtype}, which C has no number for here") from None
            self.fields[full] = Field(full, tuple(np.shape(leaf)), kind, meaning or about)
            return full

        return jax.tree_util.tree_map_with_path(one, tree)

    def listed(self) -> list[Field]:
        """Its fields as C declares them, which knows no array of no numbers."""
        return [made for made in self.fields.values() if made.size]

    def nodes(self, pool: Pool, tree: Any) -> Any:
        """The tree of names with arrays of what C reads there."""

        def one(name: str) -> np.ndarray:
            made = self.fields[name]
            places = (pool.place(f"{self.pointer}->{element}", made.kind) for element in made.elements())
            return object_array(made.shape, places)

        return jax.tree.map(one, tree)


def spoken(path: Any, tree: Any) -> tuple[list[str], str]:
    """How a leaf is called, by the attributes that lead to it, and the comment beside its field in the source."""
    names, meaning, at = [], "", tree
    for key in path:
        attribute = getattr(key, "name", None)
        if attribute is not None and not isinstance(at, dict):
            meaning = declared_of(at, attribute) or comments(type(at)).get(attribute, "")
            names.append(attribute)
            at = getattr(at, attribute)
        else:
            what = getattr(key, "key", getattr(key, "idx", key))
            names.append(str(what))
            at = _within(at, what)
    return names, meaning


def declared_of(part: Any, name: str) -> str:
    """Return meaning, unit and allowed values of a field of a part, empty if its class does not declare them."""
    field = getattr(type(part), "__dataclass_fields__", {}).get(name)
    declared = None if field is None else field.metadata.get("declared")
    if declared is None:
        return ""
    unit = declared.unit if isinstance(declared.unit, str) else declared.unit[0]
    meaning = f"{declared.meaning or name.replace('_', ' ')} [{unit.replace('unit of d', 'N m') or '-'}]"
    return f"{meaning}: {declared.words}"


def _within(at: Any, what: Any) -> Any:
    try:
        return at[what]
    except (TypeError, KeyError, IndexError):
        leaves = jax.tree.leaves(at, is_leaf=lambda node: node is not at)
        return leaves[what] if isinstance(what, int) and what < len(leaves) else None
