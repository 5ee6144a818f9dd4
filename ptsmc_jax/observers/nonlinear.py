"""The paper's nonlinear disturbance observer (53)."""

from dataclasses import dataclass

from ptsmc_jax.numerics.pytrees import Scalar, Vector, pytree
from ptsmc_jax.observers.base import ErrorBound, Linear, Matrix, Memory


@pytree
@dataclass(frozen=True)
class NonlinearObserver(Linear):
    """Nonlinear disturbance observer (53) with constant l(w) = diag(gain), so lambda(w) = gain w.

    The paper's z is d_hat - l w. Its error obeys (54): e' = -l M^-1 e - d', with M the inertia J of a spacecraft.
    """

    def error_bound(self) -> ErrorBound:
        """(55) corrected."""
        return self._bound()

    def forcing(self, t: Scalar, span: tuple[Scalar, Scalar], memory: Memory, d_eff: Vector) -> Memory:
        """A d_eff [N m/s]."""
        return self.gain * (self.model.inertia_inverse @ d_eff)

    def update(self, matrix: Matrix, memory: Memory, impulse: Vector, t: Scalar, dt: Scalar) -> Memory:
        """d_hat+ = E d_hat + (I - E) impulse / dt, E = e^(-A dt): unbiased, a contraction for any gain and period."""
        return memory + matrix @ (impulse - dt * memory)
