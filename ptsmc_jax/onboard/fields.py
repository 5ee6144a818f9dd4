"""Fields of C structs: the leaves of pytrees, each with its name, shape and meaning."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

from ptsmc_jax.batching.components import object_array
from ptsmc_jax.onboard.expressions import TYPES, NoRuleError, Pool, kind_of
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
        """The number of elements."""
        return int(np.prod(self.shape, dtype=int))

    def elements(self) -> list[str]:
        """Return the names of its elements in C, row by row."""
        return [self.name + "".join(f"[{i}]" for i in index) for index in np.ndindex(*self.shape)]

    def nodes(self, pool: Pool, owner: str) -> np.ndarray:
        """Return the elements as an array of nodes.

        Args:
            pool: makes the nodes.
            owner: the text before the name in C, such as "in->".
        """
        return object_array(self.shape, (pool.place(owner + element, self.kind) for element in self.elements()))


def struct(trees: Mapping[str, Any], about: Mapping[str, str]) -> dict[str, list[Field]]:
    """Return the fields of a struct, in order.

    Args:
        trees: pytrees of shapes and dtypes, by name.
        about: the meaning of trees that are a single leaf, by name.

    Returns:
        A field for each leaf, by the name of the tree.

    Raises:
        NoRuleError: the dtype of a leaf has no C type.
    """
    found: dict[str, list[Field]] = {}
    taken: set[str] = set()
    for name, tree in trees.items():
        found[name] = []
        for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
            parts, meaning = names_and_comment(path, tree)
            full = re.sub(r"\W+", "_", "_".join([name, *parts])).strip("_").lower() or "x"
            while full in taken:  # keys of a memory may differ only in capitals or punctuation
                full += "_"
            taken.add(full)
            try:
                kind = kind_of(leaf.dtype)
            except KeyError:
                raise NoRuleError(f"{full} has the type {leaf.dtype}, but must have the type {TYPES}") from None
            found[name].append(Field(full, tuple(leaf.shape), kind, meaning or ("" if path else about.get(name, ""))))
    return found


def names_and_comment(path: Any, tree: Any) -> tuple[list[str], str]:
    """Return the attributes that lead to a leaf, and the comment beside its field in the source."""
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
