"""LAPACK in what a user wrote, batched so that it never waits for XLA's threads in one of these.

jaxlib 0.10 does just that where it shares many matrices among the threads: calls that meet on all of them stand still
for ever. From 0.11 on, on other devices and for functions without LAPACK all of this is `jax.vmap`.
"""

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import jaxlib.version
import numpy as np
from jax import lax
from jax.extend import core

from ptsmc_jax import configure

WAITS = jaxlib.version.__version_info__ < (0, 11)
# operations, matrices times order^3, up to which jaxlib 0.10.2 does not share: it did from 1.8 to 2.2e5 of these on
ALONE = 1 << 16
COUNTED = frozenset(("lu", "cholesky", "triangular_solve"))  # primitives for which that is known
SHARED = frozenset(
    """cholesky_update eig eigh geqp3 geqrf hessenberg householder_product ormqr qr schur svd tridiagonal
    tridiagonal_solve""".split()
)  # primitives of which it shares two already, as eigenvalues, or which are rare


def vmap(function: Callable) -> Callable:
    """`jax.vmap(function)`, see `over`."""

    def mapped(*args: Any) -> Any:
        leaves = jax.tree.leaves(args)
        one = jax.tree.map(lambda v: jax.ShapeDtypeStruct(v.shape[1:], v.dtype), args)
        closed, out = jax.make_jaxpr(function, return_shape=True)(*one)
        by = over(closed, leaves[0].shape[0])
        return jax.tree.unflatten(jax.tree.structure(out), by(core.jaxpr_as_fun(closed), [0] * len(leaves))(*leaves))

    return mapped


def over(trace: Any, count: int) -> Callable:
    """What takes a trace, or an equation, over so many: `jax.vmap`, or `in_turn` where LAPACK would wait."""
    waits = WAITS and configure.backend() == "cpu" and count * _work(trace) > ALONE
    return in_turn if waits else jax.vmap


def in_turn(function: Callable, in_axes: Sequence[int | None]) -> Callable:
    """`jax.vmap(function, in_axes)` for arrays and axes 0 and None, one after the other."""

    def mapped(*args: Any) -> Any:
        def one(own: list) -> Any:
            rest = iter(own)
            return function(*(v if axis is None else next(rest) for v, axis in zip(args, in_axes, strict=True)))

        return lax.map(one, [v for v, axis in zip(args, in_axes, strict=True) if axis is not None])

    return mapped


def _work(trace: Any) -> float:
    """Operations of the largest call of LAPACK in a trace, or an equation; infinite where it is shared in any case."""
    if not hasattr(trace, "primitive"):
        return max(map(_work, getattr(trace, "jaxpr", trace).eqns), default=0.0)
    name = trace.primitive.name
    if name in SHARED:
        return np.inf
    if name in COUNTED:
        shapes = [v.aval.shape for v in trace.invars]
        return float(np.prod(shapes[-1]) * max(shapes[0][-2:]))
    return max(map(_work, _traces(trace)), default=0.0)


def _traces(eqn: Any) -> Iterator[Any]:
    """The traces among an equation's parameters; those of `custom_linear_solve` JAX's own walk does not see."""
    for value in eqn.params.values():
        for inner in value if isinstance(value, tuple | list) else (value,):
            if hasattr(getattr(inner, "jaxpr", inner), "eqns"):
                yield inner
