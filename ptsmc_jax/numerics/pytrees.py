"""Parts as pytrees: the decorator of a part's class, the types of its numbers, and gains among them."""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, fields
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
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
    where they are more than a factor of 10 apart it is searched on a log scale. above, below: what it must lie between.
    """
    return field(default=default, metadata={"gain": Gain(usual, above, below, unit, meaning)})


def vector(values: Any) -> Array:
    """Numbers, of any shape, as a leaf of the parts; with its type said, no program is compiled to copy it."""
    return jnp.asarray(np.asarray(values, dtype=float), dtype=float)
