"""Batches of functions that call LAPACK, without the deadlock of jaxlib 0.10.

jaxlib 0.10 shares the matrices of a large batched LAPACK call among XLA's threads. Calls that wait for each other on
all of these threads never return. So `vmap` runs such a call matrix by matrix. With jaxlib 0.11 or later, on other
devices, and for functions without LAPACK everything here is `jax.vmap`.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jaxlib.version
import numpy as np
from jax import lax
from jax.extend import core

from ptsmc_jax import configure

CAN_DEADLOCK = jaxlib.version.__version_info__ < (0, 11)
# jaxlib 0.10.2 splits a call among threads from about 2e5 operations (matrices times order^3) on
MAX_BATCHED_OPERATIONS = 1 << 16
SIZE_LIMITED = frozenset(("lu", "cholesky", "triangular_solve"))  # primitives that may be batched up to this limit
# primitives that are never batched: jaxlib shares even two matrices among threads, as in eigh, or the limit is unknown
NEVER_BATCHED = frozenset(
    """cholesky_update eig eigh geqp3 geqrf hessenberg householder_product ormqr qr schur svd tridiagonal
    tridiagonal_solve""".split()
)


def vmap(function: Callable) -> Callable:
    """Return `jax.vmap(function)` over the first axis of all arguments, without deadlocks of its LAPACK calls."""

    def batched_function(*args: Any) -> Any:
        leaves = jax.tree.leaves(args)
        element = jax.tree.map(lambda v: jax.ShapeDtypeStruct(v.shape[1:], v.dtype), args)
        closed, out = jax.make_jaxpr(function, return_shape=True)(*element)
        transform = choose_vmap(closed.jaxpr.eqns, leaves[0].shape[0])
        results = transform(core.jaxpr_as_fun(closed), [0] * len(leaves))(*leaves)
        return jax.tree.unflatten(jax.tree.structure(out), results)

    return batched_function


def choose_vmap(equations: Sequence, size: int) -> Callable:
    """Return `jax.vmap`, or a sequential map if a batch of this size could deadlock in one of these equations."""
    if CAN_DEADLOCK and configure.backend() == "cpu" and size * _operations(equations) > MAX_BATCHED_OPERATIONS:
        return sequential_map
    return jax.vmap


def sequential_map(function: Callable, in_axes: Sequence[int | None]) -> Callable:
    """Return `jax.vmap(function, in_axes)` as a loop over the elements of the batch. Axes are 0 or None."""

    def batched_function(*args: Any) -> Any:
        def evaluate_element(mapped_values: list) -> Any:
            remaining = iter(mapped_values)
            return function(*(v if axis is None else next(remaining) for v, axis in zip(args, in_axes, strict=True)))

        return lax.map(evaluate_element, [v for v, axis in zip(args, in_axes, strict=True) if axis is not None])

    return batched_function


def _operations(equations: Sequence) -> float:
    """Return the number of operations of the largest LAPACK call; infinity if a call must never be batched."""

    def count_operations(eqn: Any) -> float:
        name, shapes = eqn.primitive.name, [v.aval.shape for v in eqn.invars]
        if name in NEVER_BATCHED:
            return np.inf
        if name in SIZE_LIMITED:
            return float(np.prod(shapes[-1]) * max(shapes[0][-2:]))
        return max((_operations(inner.eqns) for inner in core.jaxprs_in_params(eqn.params)), default=0.0)

    return max(map(count_operations, equations), default=0.0)
