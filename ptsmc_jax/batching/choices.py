"""How a kernel chooses among values, in forms that its compiler takes and that keep what is NaN: for `kernel`."""

import itertools
from collections.abc import Callable, Sequence
from functools import reduce
from typing import Any

import jax.numpy as jnp
import numpy as np

from ptsmc_jax.batching import components
from ptsmc_jax.batching.components import Lane, object_array


def chosen(k: Any, values: Sequence) -> Any:
    """The k-th of some values that lie in no table, k being known in the kernel only."""
    return reduce(lambda found, i: jnp.where(k == np.int32(i), values[i], found), range(1, len(values)), values[0])


def otherwise(eqn: Any, values: Sequence[Lane]) -> list[Lane] | None:
    """The outputs of a primitive that the compiler lacks, or takes for another; None: it has that one."""
    name, shapes = eqn.primitive.name, [of.aval.shape for of in eqn.outvars]
    if name in _OF_ENTRIES:
        found = components.reduced(eqn, values[0].parts, lambda row: reduce(_OF_ENTRIES[name], row))
    elif name in _SO_FAR:
        found = components.cumulated(eqn, values[0].parts, _SO_FAR[name])
    elif name in _FORMS and not (name == "select_n" and len(values) == 3):
        each = zip(*(np.broadcast_to(value.parts, shapes[0]).flat for value in values), strict=True)
        found = object_array(shapes[0], itertools.starmap(_FORMS[name], each))
    else:
        return None
    return [Lane(found.shape, found)]


# Triton's own give the other number where one is NaN, so that a torque's limits would hide that a flight has failed.


def _largest(a: Any, b: Any) -> Any:
    return jnp.where((a >= b) | (a != a), a, b)


def _least(a: Any, b: Any) -> Any:
    return jnp.where((a <= b) | (a != a), a, b)


_OF_ENTRIES = {"reduce_max": _largest, "reduce_min": _least}
_SO_FAR = {"cummax": _largest, "cummin": _least}
_FORMS: dict[str, Callable] = {
    "max": _largest,
    "min": _least,
    "clamp": lambda low, value, high: _least(_largest(low, value), high),
    "select_n": lambda which, *cases: chosen(which, cases),
}
