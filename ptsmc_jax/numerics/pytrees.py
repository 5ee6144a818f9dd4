"""Parts as pytrees: the decorator of a part's class, and the types of its numbers."""

import textwrap
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, fields, is_dataclass
from typing import TYPE_CHECKING, Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import core
from jaxtyping import Array, Float

# Type of the numeric fields of a part: an array, with or without batch axes. At run time it is Any, because JAX
# rebuilds pytrees with placeholders that a type check would refuse.
if TYPE_CHECKING:
    Leaf = Array
else:
    Leaf = Any

Scalar = Float[Array, ""]
Vector = Float[Array, " m"]  # one number for each input of the plant

_Class = TypeVar("_Class", bound=type)


MAX_SHOWN = 9  # entries of the largest array that `listing` prints in full


def listing(self: Any, indent: str = "") -> str:
    """Format a part with one field on each line. None is left out, and large arrays are shown as dtype and shape."""
    if is_dataclass(self):
        items = {f.name: getattr(self, f.name) for f in fields(self)}
    elif type(self).__base__ is tuple and hasattr(self, "_asdict"):  # a named tuple without its own __repr__
        items = self._asdict()
    elif type(self) is dict:
        items = self
    else:
        return _format_value(self, indent)
    inner_indent = f"{indent}  "
    lines = [
        f"\n{inner_indent}{name}: {listing(item, inner_indent)}" for name, item in items.items() if item is not None
    ]
    return type(self).__name__ + "".join(lines).replace(": \n", ":\n")


def _format_value(value: Any, indent: str) -> str:
    """Return the text of a field: the numbers of a small array, type and shape of a large one.

    A text of several lines begins on a new line and is indented more than `indent`.
    """
    if isinstance(value, jax.Array | np.ndarray) and not isinstance(value, core.Tracer):
        is_deleted = isinstance(value, jax.Array) and value.is_deleted()  # its buffer was donated
        if is_deleted or value.size > MAX_SHOWN or not jnp.issubdtype(value.dtype, np.number):
            return f"{value.dtype} {value.shape}"
        return " ".join(np.array2string(np.asarray(value), separator=", ").split())
    text = repr(value)
    return "\n" + textwrap.indent(text, f"{indent}  ") if "\n" in text else text


def pytree(cls: _Class) -> _Class:
    """Register a dataclass as a pytree: fields are children, but fields with the metadata `static` are structure.

    `jax.tree_util.register_dataclass` must not be used instead. Up to jaxlib 0.10.2, it gives two classes equal tree
    structures if their fields have the same structure. In about one process of thirty the hashes of the two tree
    structures are equal as well, and `jit` then runs the program of one class for the other. The decorator also sets
    `__repr__` to `listing`, which prints each field on its own line.
    """
    static = tuple(f.name for f in fields(cls) if f.metadata.get("static"))
    names = tuple(f.name for f in fields(cls) if f.name not in static)
    keys = tuple(jax.tree_util.GetAttrKey(name) for name in names)

    def flatten(x: Any) -> tuple[tuple, tuple]:
        return tuple([getattr(x, name) for name in names]), tuple([getattr(x, name) for name in static])

    def flatten_with_keys(x: Any) -> tuple[tuple, tuple]:
        children, fixed = flatten(x)
        return tuple(zip(keys, children, strict=True)), fixed

    def unflatten(fixed: tuple, children: Iterable) -> Any:
        return cls(**dict(zip(names, children, strict=True)), **dict(zip(static, fixed, strict=True)))

    jax.tree_util.register_pytree_with_keys(cls, flatten_with_keys, unflatten, flatten)
    setattr(cls, "__repr__", listing)  # noqa: B010, pyright refuses an assignment of an unbound function
    return cls


@pytree
@dataclass(frozen=True)
class Function:
    """A plain function as a pytree without leaves, so that a part can hold it."""

    function: Callable = field(metadata={"static": True})

    def __call__(self, *args: Any) -> Any:
        """Call `function` with these arguments."""
        return self.function(*args)


def is_function(value: Any) -> bool:
    """Return whether a value is a callable that JAX would treat as a leaf, such as a plain or jitted function."""
    return callable(value) and jax.tree_util.all_leaves([value])


def vector(values: Any) -> Array:
    """Convert numbers of any shape to an array of floats, a leaf of the parts.

    The explicit dtype avoids that JAX compiles a program for the conversion.
    """
    return jnp.asarray(np.asarray(values, dtype=float), dtype=float)
