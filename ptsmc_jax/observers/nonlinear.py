"""The paper's nonlinear disturbance observer (53)."""

from dataclasses import dataclass

from jaxtyping import Array, Float

from ptsmc_jax.numerics.pytrees import pytree
from ptsmc_jax.observers.base import ErrorBound, Linear

Matrix = Float[Array, "k k"]
Memory = Float[Array, " memory"]
Scalar = Float[Array, ""]
Vector = Float[Array, " m"]


@pytree
@dataclass(frozen=True)
class NonlinearObserver(Linear):
    """Nonlinear disturbance observer (53) with constant l(w) = diag(gain), so lambda(w) = gain w.

    The paper's z is d_hat - l w. Its error obeys (54): e' = -l M^-1 e - d', with M the inertia J of a spacecraft.
    """

    def decay_matrix(self, t: Scalar, t_next: Scalar) -> Matrix:
        """A = l J^-1 [1/s], constant."""
        return self._slope()

    def error_bound(self) -> ErrorBound:
        """(55) corrected."""
        return self._bound()

    def forcing(self, t: Scalar, span: tuple[Scalar, Scalar], memory: Memory, seen: Vector) -> Memory:
        """A d_eff [N m/s]."""
        return self.gain * (self.model.inertia_inverse @ seen)

    def update(self, matrix: Matrix, memory: Memory, impulse: Vector, t: Scalar, dt: Scalar) -> Memory:
        """d_hat+ = E d_hat + (I - E) impulse / dt, E = e^(-A dt): unbiased, a contraction for any gain and period.

        `matrix` is `update_matrix(dt)`.
        """
        return memory + matrix @ (impulse - dt * memory)
