"""A `lax.scan` for loops that record many arrays in each step, such as a simulation with its history."""

from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

# pytrees of arrays
Carry = TypeVar("Carry")
X = TypeVar("X")
Y = TypeVar("Y")


def scan(step: Callable[[Carry, X], tuple[Carry, Y]], init: Carry, xs: X, **options: Any) -> tuple[Carry, Y]:
    """Run `jax.lax.scan` with all outputs of a step concatenated into one row for each dtype.

    XLA usually updates the output arrays of a loop in place. But if one fusion writes several output arrays, XLA copies
    all of them in every step (see `programs.BATCHED`). The time of a run would then grow with the square of its length.
    Under `jax.disable_jit` the function is `jax.lax.scan` itself.

    Args:
        step: (carry, x) -> (carry, outputs).
        init: initial carry.
        xs: arrays that the loop iterates over, in a pytree.
        **options: options of `jax.lax.scan`.

    Returns:
        The last carry and the stacked outputs, as `jax.lax.scan` does.
    """
    if jax.config.jax_disable_jit:  # pyright: ignore[reportAttributeAccessIssue]
        return lax.scan(step, init, xs, **options)
    recorded: list[Any] = []  # tracing a step writes the structure of its outputs and their abstract values here

    def step_with_packed_outputs(carry: Carry, x: X) -> tuple[Carry, dict[str, Array]]:
        """Return the carry and the outputs after a step. The outputs of each dtype are joined into one vector."""
        carry, y = step(carry, x)
        leaves, structure = jax.tree.flatten(jax.tree.map(jnp.asarray, y))
        recorded[:] = structure, [jax.typeof(leaf) for leaf in leaves]  # no tracers, which must not leave the trace
        return carry, {
            dtype: lax.concatenate([jnp.ravel(leaves[k]) for k in indices], 0)
            for dtype, indices in _group_by_dtype(leaves).items()
        }

    last, rows = lax.scan(step_with_packed_outputs, init, xs, **options)
    structure, leaves = recorded
    stacked: list[Any] = [None] * len(leaves)
    for dtype, indices in _group_by_dtype(leaves).items():
        ends = np.cumsum([leaves[k].size for k in indices])[:-1]
        for k, part in zip(indices, jnp.split(rows[dtype], ends, axis=1), strict=True):
            stacked[k] = jnp.reshape(part, (part.shape[0], *leaves[k].shape))
    return last, jax.tree.unflatten(structure, stacked)


def _group_by_dtype(leaves: list[Any]) -> dict[str, list[int]]:
    """Return the indices of the arrays of each dtype; weakly typed arrays form groups of their own."""
    groups: dict[str, list[int]] = {}
    for k, leaf in enumerate(leaves):
        groups.setdefault(f"{leaf.dtype} {leaf.weak_type}", []).append(k)
    return groups
