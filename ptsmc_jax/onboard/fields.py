"""Fields of C structs: the leaves of pytrees, each with its name, shape and meaning."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

from ptsmc_jax.batching.components import object_array
from ptsmc_jax.onboard.expressions import TYPES, NoRuleError, Pool, kind_of
from ptsmc_jax.onboard.origins import field_comments


@dataclass(frozen=True)
class Field:
    """A number or an array in a struct."""

    name: str
    shape: tuple[int, ...]
    kind: str
    meaning: str = ""

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


def struct_fields(trees: Mapping[str, Any], meanings: Mapping[str, str]) -> dict[str, list[Field]]:
    """Return the fields of a struct, in order.

    Args:
        trees: pytrees of shapes and dtypes, by name.
        meanings: the meaning of trees that are a single leaf, by name.

    Returns:
        A field for each leaf, by the name of the tree.

    Raises:
        NoRuleError: the dtype of a leaf has no C type.
    """
    fields: dict[str, list[Field]] = {}
    used_names: set[str] = set()
    for name, tree in trees.items():
        fields[name] = []
        for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
            parts, meaning = path_names_and_meaning(path, tree)
            full_name = re.sub(r"\W+", "_", "_".join([name, *parts])).strip("_").lower() or "x"
            while full_name in used_names:  # keys of a memory may differ only in capitals or punctuation
                full_name += "_"
            used_names.add(full_name)
            try:
                kind = kind_of(leaf.dtype)
            except KeyError:
                raise NoRuleError(f"{full_name} has the type {leaf.dtype}, but must have the type {TYPES}") from None
            meaning = meaning or ("" if path else meanings.get(name, ""))
            fields[name].append(Field(full_name, tuple(leaf.shape), kind, meaning))
    return fields


def path_names_and_meaning(path: Any, tree: Any) -> tuple[list[str], str]:
    """Return the names of the attributes that lead to a leaf, and its meaning from the source."""
    names, meaning, owner = [], "", tree
    for key in path:
        attribute = getattr(key, "name", None)
        if attribute is not None and not isinstance(owner, dict):
            meaning = declared_meaning(owner, attribute) or field_comments(type(owner)).get(attribute, "")
            names.append(attribute)
            owner = getattr(owner, attribute)
        else:
            entry = getattr(key, "key", getattr(key, "idx", key))
            names.append(str(entry))
            owner = _child(owner, entry)
    return names, meaning


def declared_meaning(part: Any, name: str) -> str:
    """Return meaning, unit and allowed values of a field of a part, empty if its class does not declare them."""
    field = getattr(type(part), "__dataclass_fields__", {}).get(name)
    declared = None if field is None else field.metadata.get("declared")
    if declared is None:
        return ""
    unit = declared.unit if isinstance(declared.unit, str) else declared.unit[0]
    meaning = f"{declared.meaning or name.replace('_', ' ')} [{unit.replace('unit of d', 'N m') or '-'}]"
    return f"{meaning}: {declared.words}"


def _child(tree: Any, entry: Any) -> Any:
    """Return the part of a pytree at a key or index, or None if there is none."""
    try:
        return tree[entry]
    except (TypeError, KeyError, IndexError):
        leaves = jax.tree.leaves(tree, is_leaf=lambda node: node is not tree)
        return leaves[entry] if isinstance(entry, int) and entry < len(leaves) else None
