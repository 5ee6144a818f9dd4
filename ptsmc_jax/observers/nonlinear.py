"""The nonlinear disturbance observer (53) of the paper."""

from dataclasses import dataclass
from typing import Any, ClassVar

import jax.numpy as jnp

from ptsmc_jax import declare
from ptsmc_jax.numerics import integrators, matrices
from ptsmc_jax.numerics.pytrees import Leaf, Scalar, Vector, pytree
from ptsmc_jax.observers.base import ErrorBound, Matrix, Memory, Observer


@pytree
@dataclass(frozen=True)
class NonlinearObserver(Observer):
    """The paper's nonlinear disturbance observer (53), its estimate zero at t = 0.

    Nonlinear disturbance observer (53) with constant l(w) = diag(gain), so lambda(w) = gain w.

    The memory is d_hat instead of z = d_hat - l w of the paper. The estimation error e = d_hat - d obeys (54),
    e' = -l M^-1 e - d', where M is the inertia J for a spacecraft.
    """

    gain: Leaf = declare.gain(  # (m,), so that l J^-1 is in 1/s
        None, "dead_beat", each=True, unit=("N m s", "1/s"),
        meaning="diagonal of l(w), or of its constant part; 10 N m s in the paper; default in the sampled loop: "
                "l / J of at most half of the rate p of the hold phase",
    )  # fmt: skip
    disturbance_rate_bound: Leaf  # pyright: ignore[reportGeneralTypeIssues]  # c of Assumption 1, bound on each component of d' [N m/s]
    initial_error: Leaf  # pyright: ignore[reportGeneralTypeIssues]  # bound on |d_hat(0) - d(0)| [N m]; (57) needs it, but the paper has no value
    linear: ClassVar[bool] = True

    def error_bound(self) -> Any:
        """Return the bound K2(t) by the corrected form of (55).

        (55) needs sqrt(m) c instead of c, because c bounds each component of d' and K2 bounds the 2-norm of the error.
        l_m is the smallest eigenvalue of l^1/2 J^-1 l^1/2, and the bound has the factor sqrt(cond(l)). For a diagonal J
        and equal gains, l_m is the smallest diagonal element of l J^-1, as in the paper, and the factor is 1.
        """
        root = jnp.sqrt(self.gain)
        scaled = root[:, None] * self.model.inertia_inverse * root[None, :]
        slowest = matrices.smallest_eigenvalue(scaled)
        factor = jnp.sqrt(jnp.max(self.gain) / jnp.min(self.gain))
        floor = factor * jnp.sqrt(float(self.model.inputs)) * self.disturbance_rate_bound / slowest
        return ErrorBound(slowest, factor * self.initial_error, floor)

    def decay_matrix(self, t: Scalar, t_next: Scalar) -> Matrix:
        """Return A = l J^-1 [1/s], which is constant over the step."""
        return self.gain[:, None] * self.model.inertia_inverse

    def forcing(self, t: Scalar, span: tuple[Scalar, Scalar], memory: Memory, d_eff: Vector) -> Memory:
        """Return l J^-1 d_eff, (m,)."""
        return self.gain * (self.model.inertia_inverse @ d_eff)

    def update_matrix(self, dt: Scalar) -> Matrix:
        """Return (I - e^(-A dt)) / dt = A phi_1(-A dt) [1/s], with A = l J^-1. It is smooth in dt, also at dt = 0."""
        a = self.gain[:, None] * self.model.inertia_inverse
        _, phi = integrators.phi_functions(-a * dt, 1)
        return a @ phi

    def update(self, matrix: Matrix, memory: Memory, impulse: Vector, t: Scalar, dt: Scalar) -> Memory:
        """Return d_hat+ = E d_hat + (I - E) impulse / dt with E = e^(-A dt); see `Observer.update`.

        The update is unbiased for a constant disturbance and stable for any gain and period.
        """
        return memory + matrix @ (impulse - dt * memory)
