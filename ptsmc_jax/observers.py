"""Disturbance observers, each in a continuous and a digital form and with the bound K2 on its error.

Continuous: d_hat' = -A d_hat + A d_eff, with d_eff = J w' + w x J w - u the disturbance that the nominal model sees;
the rollout steps A exactly. Digital: one update a period from measured rates and the torque applied.
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ptsmc_jax import numerics
from ptsmc_jax.numerics import Leaf
from ptsmc_jax.plants import Spacecraft

Scalar = Float[Array, ""]
Vector = Float[Array, "3"]
Matrix = Float[Array, "3 3"]


class ErrorBound(NamedTuple):
    """K2(t) >= |d_hat - d|_2, the right-hand side of (55) corrected: factor (e^(-rate t) start + (1 - e^..) floor)."""

    rate: Array  # l_m [1/s]
    start: Array  # bound at t = 0 [N m]
    floor: Array  # bound as t grows [N m]

    def __call__(self, t: Scalar) -> Scalar:
        """K2 at t [s], in N m."""
        remaining = jnp.exp(-self.rate * t)
        return self.floor + remaining * (self.start - self.floor)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class NonlinearObserver:
    """Nonlinear disturbance observer (53) with constant l(w) = diag(gain), so lambda(w) = gain w.

    The paper's z is d_hat - l w. Its error obeys (54): e' = -l J^-1 e - d'.
    """

    model: Spacecraft  # the nominal plant
    gain: Leaf  # (3,) diagonal of l [N m s, so that l J^-1 is in 1/s]
    disturbance_rate_bound: Leaf  # c of Assumption 1, bound on each component of d' [N m/s]
    initial_error: Leaf  # bound on |d_hat(0) - d(0)| [N m]; the paper's (57) needs it and gives none

    def decay_matrix(self) -> Matrix:
        """A = l J^-1 [1/s]."""
        return self.gain[:, None] * self.model.inertia_inverse

    def error_bound(self) -> ErrorBound:
        """(55) as it must read: sqrt(3) c, since c bounds each component of d' but K2 the 2-norm of the error.

        l_m is the smallest eigenvalue of l^1/2 J^-1 l^1/2 and the bound carries sqrt(cond(l)); for a diagonal J and
        equal gains that is the paper's smallest diagonal element of l J^-1.
        """
        root = jnp.sqrt(self.gain)
        slowest = jnp.linalg.eigvalsh(root[:, None] * self.model.inertia_inverse * root[None, :])[0]
        factor = jnp.sqrt(jnp.max(self.gain) / jnp.min(self.gain))
        floor = factor * jnp.sqrt(3.0) * self.disturbance_rate_bound / slowest
        return ErrorBound(slowest, factor * self.initial_error, floor)

    def forcing(self, w: Vector, w_dot: Vector, u: Vector) -> Vector:
        """A d_eff [N m/s], what drives d_hat in continuous time; w_dot [rad/s^2] is the true acceleration."""
        seen = self.model.inertia @ w_dot + self.model.gyroscopic(w) - u
        return self.gain * (self.model.inertia_inverse @ seen)

    def update_matrix(self, dt: Scalar) -> Matrix:
        """(I - e^(-A dt)) / dt = A phi_1(-A dt) [1/s]: smooth in dt down to 0, where it is A."""
        a = self.decay_matrix()
        _, phi = numerics.phi_functions(-a * dt, 1)
        return a @ phi

    def update(self, matrix: Matrix, d_hat: Vector, w: Vector, w_next: Vector, u: Vector, dt: Scalar) -> Vector:
        """Estimate at the end of a period dt [s], from the rates measured at its ends and the torque u applied in it.

        d_hat+ = E d_hat + (I - E) (J (w+ - w)/dt - f), f = u - (w x J w + w+ x J w+)/2, E = e^(-A dt): unbiased, and
        a contraction for any gain and period. `matrix` is `update_matrix(dt)`.
        """
        gyroscopic = 0.5 * (self.model.gyroscopic(w) + self.model.gyroscopic(w_next))
        return d_hat + matrix @ (self.model.inertia @ (w_next - w) - dt * (u - gyroscopic + d_hat))
