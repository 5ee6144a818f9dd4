"""Parts as pytrees: what a part's class is decorated with, and the type of its numbers."""

from collections.abc import Iterable
from dataclasses import fields
from typing import TYPE_CHECKING, Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

# Type of a part's numbers: an array, alone or with batch axes; at run time anything, since JAX rebuilds pytrees
# around placeholders and a check of the type would refuse them.
if TYPE_CHECKING:
    Leaf = Array
else:
    Leaf = Any


_Class = TypeVar("_Class", bound=type)


def pytree(cls: _Class) -> _Class:
    """Registers a dataclass with JAX: its fields are children, those with the metadata `static` part of the structure.

    As `jax.tree_util.register_dataclass` does, which must not be used: up to jaxlib 0.10.2 two such classes whose
    fields have the same structure compare equal, so that where their hashes fall together, about once in thirty
    processes, `jit` runs the program compiled for the one on the numbers of the other.
    """
    static = tuple(f.name for f in fields(cls) if f.metadata.get("static"))
    names = tuple(f.name for f in fields(cls) if f.name not in static)
    keys = tuple(jax.tree_util.GetAttrKey(name) for name in names)

    def flatten(x: Any) -> tuple[tuple, tuple]:
        return tuple([getattr(x, name) for name in names]), tuple([getattr(x, name) for name in static])

    def with_keys(x: Any) -> tuple[tuple, tuple]:
        children, fixed = flatten(x)
        return tuple(zip(keys, children, strict=True)), fixed

    def unflatten(fixed: tuple, children: Iterable) -> Any:
        return cls(**dict(zip(names, children, strict=True)), **dict(zip(static, fixed, strict=True)))

    jax.tree_util.register_pytree_with_keys(cls, with_keys, unflatten, flatten)
    return cls


def vector(values: Any) -> Array:
    """Numbers, of any shape, as a leaf of the parts."""
    return jnp.asarray(np.asarray(values, dtype=float))
