"""A disturbance observer that converges within a prescribed time."""

from dataclasses import dataclass
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array

from ptsmc_jax import declare
from ptsmc_jax.numerics.pytrees import Leaf, Scalar, Vector, pytree
from ptsmc_jax.observers.base import ErrorBound, Matrix, Memory
from ptsmc_jax.observers.nonlinear import NonlinearObserver


class PrescribedTimeBound(NamedTuple):
    """The bound K2(t) of `PrescribedTimeObserver`.

    Until T_o - delta_o it bounds the solution of K2' = -(l_m + mu/(T_o - t)) K2 + sqrt(m) c, and then it is (55). With
    rho = (T_o - t)/T_o and c' = sqrt(m) c the solution is at most

        rho^mu e^(-l_m t) K2(0) + c' min(a, b).

    a = (T_o - t)(1 - rho^(mu-1))/(mu-1) is the exact integral for l_m = 0, and b = (1 - e^(-l_m t))/l_m for mu = 0.
    """

    base: ErrorBound  # bound of the observer without the time-varying gain
    mu: Array  # exponent of the convergence [-]
    t_o: Array  # prescribed time of convergence T_o [s]
    delta_o: Array  # time before T_o at which the time-varying gain is switched off [s]

    @property
    def largest(self) -> Scalar:
        """Largest value of K2 at any time [N m]."""
        return self.base.largest

    def __call__(self, t: Scalar) -> Scalar:
        """Return K2 at the time t [s], in N m."""
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
class PrescribedTimeObserver(NonlinearObserver):
    """An observer that converges by t_o. Afterwards it is the nonlinear observer.

    Until T_o - delta_o it is the nonlinear observer with the gain l + mu M/(T_o - t), where l = diag(gain). The error
    obeys e' = -(l M^-1 + mu/(T_o - t)) e - d'. So for a constant disturbance |e| decays like (T_o - t)^mu. From
    T_o - delta_o on, the gain is l. d_hat is continuous at this change.
    """

    mu: Leaf = declare.number(
        2.0, above=1.0,
        meaning="exponent of the convergence: the initial error decreases like (t_o - t)^mu, the error "
                "from the disturbance's rate like c (t_o - t)/(mu - 1)",
    )  # fmt: skip
    t_o: Leaf = declare.number(
        None, above=0.0, unit="s", meaning="prescribed time of convergence; default: a third of t_f", kw_only=True
    )
    delta_o: Leaf = declare.number(
        None, above=0.0, unit="s", kw_only=True,
        meaning="time before t_o at which mu/(t_o - t) is switched off; default: t_f / 600, or a period, at most t_o/4",
    )  # fmt: skip

    def _time_left(self, t: Scalar) -> Scalar:
        """Return the time to T_o [s], at least delta_o."""
        return jnp.maximum(self.t_o - t, self.delta_o)

    def _mean_rate(self, t: Scalar, t_next: Scalar) -> Scalar:
        """Return the mean of mu/(T_o - t) over an interval [1/s]; it is 0 after T_o - delta_o."""
        dt = t_next - t
        mean = jnp.log(self._time_left(t) / self._time_left(t_next)) / jnp.where(dt > 0.0, dt, 1.0)
        return self.mu * jnp.where(dt > 0.0, mean, 0.0)

    def error_bound(self) -> PrescribedTimeBound:
        return PrescribedTimeBound(super().error_bound(), self.mu, self.t_o, self.delta_o)

    def decay_matrix(self, t: Scalar, t_next: Scalar) -> Matrix:
        """Return the mean of A = l J^-1 + mu/(T_o - t) over the step [1/s]."""
        return super().decay_matrix(t, t_next) + self._mean_rate(t, t_next) * jnp.eye(self.model.inputs)

    def forcing(self, t: Scalar, span: tuple[Scalar, Scalar], memory: Memory, d_eff: Vector) -> Memory:
        """Return the forcing A(t) d_eff - (A(t) - A) d_hat of d_hat' + A d_hat [N m/s]; A is the mean over the step.

        A step ends or begins at T_o - delta_o, where mu/(T_o - t) is switched off; no step contains that time inside.
        """
        early = 0.5 * (span[0] + span[1]) < self.t_o - self.delta_o
        rate = jnp.where(early, self.mu / self._time_left(t), 0.0)
        deviation = rate - self._mean_rate(*span)
        return super().forcing(t, span, memory, d_eff) + rate * d_eff - deviation * memory

    def update(self, matrix: Matrix, memory: Memory, impulse: Vector, t: Scalar, dt: Scalar) -> Memory:
        """Update as `NonlinearObserver` does, with E = e^(-l J^-1 dt) ((T_o - t)/(T_o - t + dt))^mu."""
        factor = jnp.exp(-self._mean_rate(t - dt, t) * dt)
        rate = (1.0 - factor) / jnp.where(dt > 0.0, dt, 1.0)
        return memory + factor * (matrix @ (impulse - dt * memory)) + rate * (impulse - dt * memory)

    def nodes(self) -> tuple[float, ...]:
        """Return T_o - delta_o, and times [s] whose distance to T_o decreases by a tenth each."""
        t_o, delta_o = float(self.t_o), float(self.delta_o)
        remaining, times = t_o, [t_o - delta_o]
        while remaining > max(delta_o, 1e-9 * t_o):
            times.append(t_o - remaining)
            remaining *= 0.9
        return tuple(sorted(times))
