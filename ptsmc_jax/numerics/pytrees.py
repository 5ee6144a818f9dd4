"""Parts as pytrees: the decorator of a part's class, the types of its numbers, and gains among them."""

import math
import textwrap
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, fields, is_dataclass
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import core
from jaxtyping import Array, Float

# Type of a part's numbers: an array, alone or with batch axes; at run time anything, since JAX rebuilds pytrees
# around placeholders and a check of the type would refuse them.
if TYPE_CHECKING:
    Leaf = Array
else:
    Leaf = Any

Scalar = Float[Array, ""]
Vector = Float[Array, " m"]  # a number for each input of the plant

_Class = TypeVar("_Class", bound=type)


FEW = 9  # numbers of an array that are shown


def listing(self: Any, indent: str = "") -> str:
    """A part in lines, its fields by name, absent ones left out; of arrays with many numbers their type and shape."""
    if is_dataclass(self):
        items = {f.name: getattr(self, f.name) for f in fields(self)}
    elif type(self).__base__ is tuple and hasattr(self, "_asdict"):  # a named one, shown in no way of its own
        items = self._asdict()
    elif type(self) is dict:
        items = self
    else:
        return _shown(self, indent)
    inside = f"{indent}  "
    lines = [f"\n{inside}{name}: {listing(item, inside)}" for name, item in items.items() if item is not None]
    return type(self).__name__ + "".join(lines).replace(": \n", ":\n")


def _shown(value: Any, indent: str) -> str:
    if isinstance(value, jax.Array | np.ndarray) and not isinstance(value, core.Tracer):
        gone = isinstance(value, jax.Array) and value.is_deleted()  # as one that was donated
        if gone or value.size > FEW or not jnp.issubdtype(value.dtype, np.number):
            return f"{value.dtype} {value.shape}"
        return " ".join(np.array2string(np.asarray(value), separator=", ").split())
    text = repr(value)
    return "\n" + textwrap.indent(text, f"{indent}  ") if "\n" in text else text


def pytree(cls: _Class) -> _Class:
    """Registers a dataclass with JAX: its fields are children, those with the metadata `static` part of the structure.

    As `jax.tree_util.register_dataclass` does, which must not be used: up to jaxlib 0.10.2 two such classes whose
    fields have the same structure compare equal, so that where their hashes fall together, about once in thirty
    processes, `jit` runs the program compiled for the one on the numbers of the other. It is shown as a `listing`.
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
    setattr(cls, "__repr__", listing)  # noqa: B010, by its name pyright asks for a bound one
    return cls


@pytree
@dataclass(frozen=True)
class Function:
    """A plain function among parts, which are pytrees: it has no numbers that could be traced."""

    function: Callable = field(metadata={"static": True})

    def __call__(self, *args: Any) -> Any:
        """The value of the function."""
        return self.function(*args)


class Gain(NamedTuple):
    """A gain of one's own, as its class declares it; see `gain`."""

    usual: tuple[float, float] | Callable | None
    above: float
    below: float
    unit: str
    meaning: str


def gain(
    default: float,
    usual: tuple[float, float] | Callable[[float, float], tuple[float, float]] | None = None,
    *,
    above: float = 0.0,
    below: float = math.inf,
    unit: str = "",
    meaning: str = "",
) -> Any:
    """A field of a part of one's own that tuning may move: `k1: float = gain(1.0, (0.1, 10.0), unit="1/s")`.

    usual: the bounds of a search where a scenario gives none, two numbers or a function of t_f and the period [s];
    where they are positive and more than a factor of 10 apart it is searched on a log scale. above, below: what it must
    lie between.
    """
    return field(default=default, metadata={"gain": Gain(usual, above, below, unit, meaning)})


def vector(values: Any) -> Array:
    """Numbers, of any shape, as a leaf of the parts; with its type said, no program is compiled to copy it."""
    return jnp.asarray(np.asarray(values, dtype=float), dtype=float)
