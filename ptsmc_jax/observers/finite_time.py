"""The super-twisting disturbance observer, whose estimate is exact after a finite time."""

from dataclasses import dataclass
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array

from ptsmc_jax import declare
from ptsmc_jax.declare import Scaled
from ptsmc_jax.numerics import guards
from ptsmc_jax.numerics.pytrees import Leaf, Scalar, Vector, pytree
from ptsmc_jax.observers.base import Matrix, Memory, Observer

# Largest ratio of |e| at successive zeros of e0, for |d'| <= k c with k = 0, 0.1 .. 1. The worst d' decelerates e while
# |e0| grows and accelerates it while |e0| decreases. The numbers come from numerical integration.
_OVERSHOOT = (0.159, 0.185, 0.212, 0.240, 0.270, 0.301, 0.336, 0.374, 0.417, 0.470, 0.538)


class FiniteTimeBound(NamedTuple):
    """The bound K2(t) of `FiniteTimeObserver`: |e(0)| until the settling time, then the error of the boundary layer."""

    start: Array  # bound on the 2-norm of the initial error e(0) [N m]
    settled: Array  # time after which the error is within `floor` [s]
    floor: Array  # bound after the time `settled`, without sensor noise [N m]

    @property
    def largest(self) -> Scalar:
        """Largest value of K2 at any time [N m]."""
        return jnp.maximum(self.start, self.floor)

    def __call__(self, t: Scalar) -> Scalar:
        """Return K2 at the time t [s], in N m."""
        return jnp.where(t < self.settled, self.largest, self.floor)


@pytree
@dataclass(frozen=True)
class FiniteTimeObserver(Observer):
    """A super-twisting observer, exact after a finite time (Levant 1998).

    The observer differentiates H = M w by super-twisting, component by component (Levant, Automatica 34, 1998). With
    e0 = z0 - H, where z0 is the estimate of H and e0(0) = 0, the equations are

        e0' = d_hat - d - 1.5 sqrt(c) |e0|^1/2 sign(e0)
        d_hat' = -1.1 c sign(e0).

    If |d'| <= c for each component, the estimation error e = d_hat - d is zero after a finite time. Seeber and Horn
    (Automatica 84, 2017) proved it for 1.5 and 1.1. The gain c may be larger than the bound on d'. M may be a full
    matrix.
    """

    gain: Leaf = declare.gain(  # (m,)
        None, "finite_time", each=True, unit="unit of d/s",
        meaning="c, at least controller.disturbance_rate_bound; default: 20 times this bound",
    )  # fmt: skip
    disturbance_rate_bound: Leaf  # pyright: ignore[reportGeneralTypeIssues]  # bound on each component of d' [N m/s], at most `gain`
    initial_error: Leaf  # pyright: ignore[reportGeneralTypeIssues]  # bound on |d_hat(0) - d(0)| [N m]
    sign_width: Leaf = declare.number(
        Scaled(1e-5, inertia=1, time=1, order=-1), at_least=0.0, unit=("N m s", ""),
        meaning="thickness of the boundary layer in the continuous loop; the sampled loop needs none",
    )  # fmt: skip

    def begin(self) -> Memory:
        """Return d_hat = 0 [N m] and e0 = 0 [N m s], (2 m,)."""
        return jnp.zeros(2 * self.model.inputs)

    def error_bound(self) -> FiniteTimeBound:
        """Return |e(0)| until the settling time, and then the error of the boundary layer.

        The settling time is (1 + q)/((1 - q)(1.1 - k)) |e(0)|/c with k = |d'|/c and the ratio q of `_OVERSHOOT`. While
        e0 grows and decreases once, e moves from e(0) to -q e(0) at a rate of at least (1.1 - k) c. The next durations
        are a geometric series in q. For a constant d, the settling time is 1.25 |d|/c. Afterwards the boundary layer of
        thickness w balances d' at e0 = w artanh(k/1.1). The residual error e then follows from e0' = 0.
        """
        c = jnp.min(self.gain)
        k = jnp.clip(self.disturbance_rate_bound / c, 0.0, 1.0)
        # linear interpolation is an upper bound, because q(k) is convex
        q = jnp.interp(k, jnp.linspace(0.0, 1.0, len(_OVERSHOOT)), jnp.asarray(_OVERSHOOT))
        settling_time = (1.0 + q) / ((1.0 - q) * (1.1 - k)) * self.initial_error / c
        ratios = jnp.clip(self.disturbance_rate_bound / self.gain, 0.0, 1.0)
        e0 = self.sign_width * jnp.arctanh(ratios / 1.1)
        e = 1.5 * jnp.sqrt(self.gain) * guards.signed_root(e0, self.sign_width)
        return FiniteTimeBound(self.initial_error, settling_time, guards.norm(e))

    def decay_matrix(self, t: Scalar, t_next: Scalar) -> Matrix:
        size = 2 * self.model.inputs
        return jnp.zeros((size, size))

    def forcing(self, t: Scalar, span: tuple[Scalar, Scalar], memory: Memory, d_eff: Vector) -> Memory:
        """Return the derivatives of d_hat and of the second state, (2 m,), by the equations of the class."""
        d_hat, e0 = jnp.split(memory, 2)
        root = 1.5 * jnp.sqrt(self.gain) * guards.signed_root(e0, self.sign_width)
        return jnp.concatenate([-1.1 * self.gain * guards.smooth_sign(e0, self.sign_width), d_hat - d_eff - root])

    def update(self, matrix: Matrix, memory: Memory, impulse: Vector, t: Scalar, dt: Scalar) -> Memory:
        """Return the memory after one implicit Euler step with the discontinuous sign; see `Observer.update`.

        The step is stable for any dt and has no chattering at e0 = 0. It solves

            e0+ + dt 1.5 sqrt(c) |e0+|^1/2 sign(e0+) + dt^2 1.1 c xi = b,  b = e0 + dt d_hat - impulse,

        with xi in the set-valued sign(e0+), which is a quadratic equation for |e0+|^1/2.
        """
        d_hat, e0 = jnp.split(memory, 2)
        b = e0 + dt * d_hat - impulse
        switching, half = 1.1 * self.gain * dt * dt, 0.75 * jnp.sqrt(self.gain) * dt
        xi = jnp.clip(b / jnp.where(switching > 0.0, switching, 1.0), -1.0, 1.0)
        one_if_empty = jnp.where(dt > 0.0, 0.0, 1.0)  # makes the derivative of the square root finite at dt = 0
        root = jnp.sqrt(half * half + jnp.maximum(jnp.abs(b) - switching, 0.0) + one_if_empty) - half
        e0 = jnp.where(jnp.abs(xi) < 1.0, 0.0, root * root * xi)
        return jnp.concatenate([d_hat - 1.1 * self.gain * dt * xi, e0])

    def fastest(self) -> float:
        """Return 1.5 sqrt(c / sign_width) [1/s], the rate inside the boundary layer."""
        width = float(self.sign_width)
        return 0.0 if width <= 0.0 else 1.5 * float(jnp.max(jnp.sqrt(self.gain))) / width**0.5
