"""Loops that record many things in each step."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax


def scan(step: Callable[[Any, Any], tuple[Any, Any]], init: Any, xs: Any, **options: Any) -> tuple[Any, Any]:
    """`jax.lax.scan` of these arguments, with what a step records written as one row for each type of number.

    Arrays that a loop writes into are updated in place, but for those that XLA writes by one fusion of several outputs
    (`programs.BATCHED`): they are copied whole in every step, so that the time of a run would grow with the square of
    its length. Under `jax.disable_jit` it is that of JAX: nothing is compiled, and steps may differ in types.
    """
    if jax.config.jax_disable_jit:  # pyright: ignore[reportAttributeAccessIssue]
        return lax.scan(step, init, xs, **options)
    recorded: list[Any] = []  # the structure of what one step records, and the types of its arrays

    def packed(carry: Any, x: Any) -> tuple[Any, dict[str, Any]]:
        carry, y = step(carry, x)
        leaves, structure = jax.tree.flatten(jax.tree.map(jnp.asarray, y))
        recorded[:] = structure, [jax.typeof(leaf) for leaf in leaves]  # tracers must not get out
        return carry, {
            kind: lax.concatenate([jnp.ravel(leaves[k]) for k in of], 0) for kind, of in _kinds(leaves).items()
        }

    last, rows = lax.scan(packed, init, xs, **options)
    structure, leaves = recorded
    stacked: list[Any] = [None] * len(leaves)
    for kind, of in _kinds(leaves).items():
        ends = np.cumsum([leaves[k].size for k in of])[:-1]
        for k, part in zip(of, jnp.split(rows[kind], ends, axis=1), strict=True):
            stacked[k] = jnp.reshape(part, (part.shape[0], *leaves[k].shape))
    return last, jax.tree.unflatten(structure, stacked)


def _kinds(leaves: list[Any]) -> dict[str, list[int]]:
    """The types of the numbers in these arrays, and the places of those of each."""
    kinds: dict[str, list[int]] = {}
    for k, leaf in enumerate(leaves):
        kinds.setdefault(f"{leaf.dtype} {leaf.weak_type}", []).append(k)
    return kinds
