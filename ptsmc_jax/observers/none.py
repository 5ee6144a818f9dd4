"""The law without an observer: the estimate is zero, and the switching gain covers the whole disturbance."""

from dataclasses import dataclass
from typing import ClassVar

import jax.numpy as jnp

from ptsmc_jax.numerics.pytrees import Leaf, Scalar, Vector, pytree
from ptsmc_jax.observers.base import ErrorBound, Matrix, Memory, Observer, constant_bound


@pytree
@dataclass(frozen=True)
class NoObserver(Observer):
    """No observer: d_hat = 0, and the switching gain K must exceed the whole disturbance.

    Laws (10), (29) and (40) of the paper have no observer. K of Assumption 1 bounds each component of d. The law uses a
    bound on the 2-norm, so K2 = sqrt(m) K.
    """

    disturbance_bound: Leaf  # K of Assumption 1, bound on each component of d [N m]
    estimates: ClassVar[bool] = False
    linear: ClassVar[bool] = True

    def error_bound(self) -> ErrorBound:
        """Return sqrt(m) K at all times."""
        return constant_bound(self.disturbance_bound, self.model.inputs)

    def decay_matrix(self, t: Scalar, t_next: Scalar) -> Matrix:
        return jnp.zeros((self.model.inputs, self.model.inputs))

    def forcing(self, t: Scalar, span: tuple[Scalar, Scalar], memory: Memory, d_eff: Vector) -> Memory:
        return jnp.zeros_like(memory)

    def update_matrix(self, dt: Scalar) -> Matrix:
        """Return zeros (m, m), which `update` does not use."""
        return jnp.zeros((self.model.inputs, self.model.inputs))

    def update(self, matrix: Matrix, memory: Memory, impulse: Vector, t: Scalar, dt: Scalar) -> Memory:
        return memory
