"""Disturbance observers, each in a continuous and a digital form and with the bound K2 on its error.

All estimate d in M w' = known(x, u) + d (`plants.Plant`). Continuous: d_hat' = -A d_hat + A d_eff, with
d_eff = M w' - known(x, u) the disturbance that the nominal model sees; the rollout steps A exactly. Digital: one
update a period from measured states and the input applied.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ptsmc_jax import numerics
from ptsmc_jax.numerics import Leaf
from ptsmc_jax.plants import Plant

Scalar = Float[Array, ""]
Vector = Float[Array, " m"]
Matrix = Float[Array, "m m"]


class ErrorBound(NamedTuple):
    """K2(t) >= |d_hat - d|_2, the right-hand side of (55) corrected: factor (e^(-rate t) start + (1 - e^..) floor)."""

    rate: Array  # l_m [1/s]
    start: Array  # bound at t = 0 [N m]
    floor: Array  # bound as t grows [N m]

    def __call__(self, t: Scalar) -> Scalar:
        """K2 at t [s], in N m."""
        remaining = jnp.exp(-self.rate * t)
        return self.floor + remaining * (self.start - self.floor)


class Observer(Protocol):
    """What the rollout asks of an observer."""

    def decay_matrix(self) -> Matrix:
        """A [1/s]."""
        ...

    def error_bound(self) -> ErrorBound:
        """K2(t), the bound on the 2-norm of the estimation error."""
        ...

    def forcing(self, x: Any, x_dot: Any, u: Vector) -> Vector:
        """A d_eff, from the state, its true derivative and the input."""
        ...

    def update_matrix(self, dt: Scalar) -> Matrix:
        """What `update` needs of a period dt [s], computed outside the loop."""
        ...

    def update(self, matrix: Matrix, d_hat: Vector, x: Any, x_next: Any, u: Vector, dt: Scalar) -> Vector:
        """Estimate at the end of a period, from the states measured at its ends and the input applied in it."""
        ...


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class NoObserver:
    """No estimate: d_hat = 0, and the switching gain must cover the disturbance itself, as in (10), (29) and (40).

    K of Assumption 1 bounds each component of d; the law scales the 2-norm of what it does not know, so K2 = sqrt(m) K.
    """

    model: Plant
    disturbance_bound: Leaf  # K of Assumption 1 [N m]

    def decay_matrix(self) -> Matrix:
        """Zero."""
        return jnp.zeros_like(self.model.inertia)

    def error_bound(self) -> ErrorBound:
        """sqrt(m) K at all times."""
        bound = jnp.sqrt(float(self.model.inputs)) * self.disturbance_bound
        return ErrorBound(jnp.zeros_like(bound), bound, bound)

    def forcing(self, x: Any, x_dot: Any, u: Vector) -> Vector:
        """Zero."""
        return jnp.zeros_like(u)

    def update_matrix(self, dt: Scalar) -> Matrix:
        """Zero."""
        return self.decay_matrix()

    def update(self, matrix: Matrix, d_hat: Vector, x: Any, x_next: Any, u: Vector, dt: Scalar) -> Vector:
        """The estimate stays what it is."""
        return d_hat


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class NonlinearObserver:
    """Nonlinear disturbance observer (53) with constant l(w) = diag(gain), so lambda(w) = gain w.

    The paper's z is d_hat - l w. Its error obeys (54): e' = -l M^-1 e - d', with M the inertia J of a spacecraft.
    """

    model: Plant  # the nominal plant
    gain: Leaf  # (m,) diagonal of l [N m s, so that l J^-1 is in 1/s]
    disturbance_rate_bound: Leaf  # c of Assumption 1, bound on each component of d' [N m/s]
    initial_error: Leaf  # bound on |d_hat(0) - d(0)| [N m]; the paper's (57) needs it and gives none

    def decay_matrix(self) -> Matrix:
        """A = l J^-1 [1/s]."""
        return self.gain[:, None] * self.model.inertia_inverse

    def error_bound(self) -> ErrorBound:
        """(55) as it must read: sqrt(m) c, since c bounds each component of d' but K2 the 2-norm of the error.

        l_m is the smallest eigenvalue of l^1/2 J^-1 l^1/2 and the bound carries sqrt(cond(l)); for a diagonal J and
        equal gains that is the paper's smallest diagonal element of l J^-1.
        """
        root = jnp.sqrt(self.gain)
        scaled = root[:, None] * self.model.inertia_inverse * root[None, :]
        slowest = scaled[0, 0] if self.model.inputs == 1 else jnp.linalg.eigvalsh(scaled)[0]
        factor = jnp.sqrt(jnp.max(self.gain) / jnp.min(self.gain))
        floor = factor * jnp.sqrt(float(self.model.inputs)) * self.disturbance_rate_bound / slowest
        return ErrorBound(slowest, factor * self.initial_error, floor)

    def forcing(self, x: Any, x_dot: Any, u: Vector) -> Vector:
        """A d_eff [N m/s], what drives d_hat in continuous time; x_dot is the true derivative of the state."""
        seen = self.model.inertia @ self.model.velocity(x_dot) - self.model.known(x, u)
        return self.gain * (self.model.inertia_inverse @ seen)

    def update_matrix(self, dt: Scalar) -> Matrix:
        """(I - e^(-A dt)) / dt = A phi_1(-A dt) [1/s]: smooth in dt down to 0, where it is A."""
        a = self.decay_matrix()
        _, phi = numerics.phi_functions(-a * dt, 1)
        return a @ phi

    def update(self, matrix: Matrix, d_hat: Vector, x: Any, x_next: Any, u: Vector, dt: Scalar) -> Vector:
        """Estimate at the end of a period dt [s], from the states measured at its ends and the input u applied in it.

        d_hat+ = E d_hat + (I - E) (M (w+ - w)/dt - f), f = (known(x, u) + known(x+, u))/2, E = e^(-A dt): unbiased,
        and a contraction for any gain and period. `matrix` is `update_matrix(dt)`.
        """
        known = 0.5 * (self.model.known(x, u) + self.model.known(x_next, u))
        gained = self.model.velocity(x_next) - self.model.velocity(x)
        return d_hat + matrix @ (self.model.inertia @ gained - dt * (known + d_hat))
