"""The nonlinear disturbance observer (53) of the paper."""

from dataclasses import dataclass

from ptsmc_jax.numerics.pytrees import Scalar, Vector, pytree
from ptsmc_jax.observers.base import ErrorBound, LinearObserver, Matrix, Memory


@pytree
@dataclass(frozen=True)
class NonlinearObserver(LinearObserver):
    """The paper's nonlinear disturbance observer (53), its estimate zero at t = 0.

    Nonlinear disturbance observer (53) with constant l(w) = diag(gain), so lambda(w) = gain w.

    The memory is d_hat instead of z = d_hat - l w of the paper. The estimation error e = d_hat - d obeys (54),
    e' = -l M^-1 e - d', where M is the inertia J for a spacecraft.
    """

    def error_bound(self) -> ErrorBound:
        """Return the corrected form of (55)."""
        return self._linear_bound()

    def forcing(self, t: Scalar, span: tuple[Scalar, Scalar], memory: Memory, d_eff: Vector) -> Memory:
        return self.gain * (self.model.inertia_inverse @ d_eff)

    def update(self, matrix: Matrix, memory: Memory, impulse: Vector, t: Scalar, dt: Scalar) -> Memory:
        """Return d_hat+ = E d_hat + (I - E) impulse / dt with E = e^(-A dt); see `Observer.update`.

        The update is unbiased for a constant disturbance and stable for any gain and period.
        """
        return memory + matrix @ (impulse - dt * memory)
