"""An observer that has converged by a prescribed time."""

from dataclasses import dataclass
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array

from ptsmc_jax.numerics.pytrees import Leaf, Scalar, Vector, pytree
from ptsmc_jax.observers.base import ErrorBound, Linear, Matrix, Memory


class PrescribedTimeBound(NamedTuple):
    """K2(t) of `PrescribedTimeObserver`: K2' = -(l_m + mu/(T_o - t)) K2 + sqrt(m) c until T_o - delta_o, then (55).

    With rho = (T_o - t)/T_o its solution is at most rho^mu e^(-l_m t) K2(0) + c' min(a, b), c' the sqrt(m) c of (55):
    a = (T_o - t)(1 - rho^(mu-1))/(mu-1), exact for l_m = 0, and b = (1 - e^(-l_m t))/l_m, exact for mu = 0.
    """

    base: ErrorBound
    mu: Array
    t_o: Array  # [s]
    delta_o: Array  # [s]

    @property
    def largest(self) -> Scalar:
        """The largest value of K2 at any time [N m]."""
        return self.base.largest

    def __call__(self, t: Scalar) -> Scalar:
        """K2 at t [s], in N m."""
        rate, start, floor = self.base
        end = self.t_o - self.delta_o
        early = jnp.minimum(t, end)
        left = self.t_o - early
        rho = left / self.t_o
        slow = (1.0 - jnp.exp(-rate * early)) / rate
        quick = left * (1.0 - rho ** (self.mu - 1.0)) / (self.mu - 1.0)
        reached = rho**self.mu * jnp.exp(-rate * early) * start + floor * rate * jnp.minimum(slow, quick)
        remaining = jnp.exp(-rate * jnp.maximum(t - end, 0.0))
        return floor + remaining * (reached - floor)


@pytree
@dataclass(frozen=True)
class PrescribedTimeObserver(Linear):
    """The nonlinear observer with l = diag(gain) + mu M/(T_o - t) until T_o - delta_o: its error is gone by T_o.

    e' = -(l M^-1 + mu/(T_o - t)) e - d', so |e| falls like (T_o - t)^mu; from T_o - delta_o on it is the nonlinear one,
    with d_hat continuous (the paper's z reset).
    """

    mu: Leaf  # power with which the error falls, > 1 [-]
    t_o: Leaf  # T_o, by when the error is gone [s]
    delta_o: Leaf  # so long before T_o it becomes the nonlinear observer [s]

    def _left(self, t: Scalar) -> Scalar:
        """The time to T_o, and from T_o - delta_o on delta_o [s]."""
        return jnp.maximum(self.t_o - t, self.delta_o)

    def _mean(self, t: Scalar, t_next: Scalar) -> Scalar:
        """Mean of mu/(T_o - t) over an interval, 0 from T_o - delta_o on [1/s]."""
        dt = t_next - t
        mean = jnp.log(self._left(t) / self._left(t_next)) / jnp.where(dt > 0.0, dt, 1.0)
        return self.mu * jnp.where(dt > 0.0, mean, 0.0)

    def error_bound(self) -> PrescribedTimeBound:
        """K2(t)."""
        return PrescribedTimeBound(self._bound(), self.mu, self.t_o, self.delta_o)

    def decay_matrix(self, t: Scalar, t_next: Scalar) -> Matrix:
        """A = l J^-1 + mu/(T_o - t), its mean over the step [1/s]."""
        return super().decay_matrix(t, t_next) + self._mean(t, t_next) * jnp.eye(self.model.inputs)

    def forcing(self, t: Scalar, span: tuple[Scalar, Scalar], memory: Memory, d_eff: Vector) -> Memory:
        """A(t) d_eff - (A(t) - A) d_hat [N m/s]; a step lies on one side of T_o - delta_o."""
        early = 0.5 * (span[0] + span[1]) < self.t_o - self.delta_o
        rate = jnp.where(early, self.mu / self._left(t), 0.0)
        deviation = rate - self._mean(*span)
        return self.gain * (self.model.inertia_inverse @ d_eff) + rate * d_eff - deviation * memory

    def update(self, matrix: Matrix, memory: Memory, impulse: Vector, t: Scalar, dt: Scalar) -> Memory:
        """As the nonlinear one's, with E = e^(-l J^-1 dt) ((T_o - t)/(T_o - t + dt))^mu."""
        factor = jnp.exp(-self._mean(t - dt, t) * dt)
        rate = (1.0 - factor) / jnp.where(dt > 0.0, dt, 1.0)
        return memory + factor * (matrix @ (impulse - dt * memory)) + rate * (impulse - dt * memory)

    def nodes(self) -> tuple[float, ...]:
        """T_o - delta_o, and times [s] that close in on T_o, each a tenth nearer."""
        t_o, delta_o = float(self.t_o), float(self.delta_o)
        left, times = t_o, [t_o - delta_o]
        while left > max(delta_o, 1e-9 * t_o):
            times.append(t_o - left)
            left *= 0.9
        return tuple(sorted(times))
