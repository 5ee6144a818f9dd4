"""A super-twisting observer, exact after a finite time."""

from dataclasses import dataclass
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array

from ptsmc_jax.numerics import guards
from ptsmc_jax.numerics.pytrees import Leaf, Scalar, Vector, pytree
from ptsmc_jax.observers.base import Matrix, Memory, Observer

# Largest |e| at a zero of e0 over that at the zero before, for |d'| <= 0, 0.1 .. 1 times c and the worst d': it slows e
# down while |e0| grows and speeds it up while |e0| falls (by integration, checked in tests/observers).
_OVERSHOOT = (0.159, 0.185, 0.212, 0.240, 0.270, 0.301, 0.336, 0.374, 0.417, 0.470, 0.538)


class FiniteTimeBound(NamedTuple):
    """K2(t) of `FiniteTimeObserver`: |e(0)| until it has settled, then what its smooth sign leaves (without noise)."""

    start: Array  # bound on |e(0)|_2 [N m]
    settled: Array  # [s]
    floor: Array  # [N m]

    @property
    def largest(self) -> Scalar:
        """Its largest value [N m]."""
        return jnp.maximum(self.start, self.floor)

    def __call__(self, t: Scalar) -> Scalar:
        """K2 at t [s], in N m."""
        return jnp.where(t < self.settled, self.largest, self.floor)


@pytree
@dataclass(frozen=True)
class FiniteTimeObserver(Observer):
    """Super-twisting observer on H = M w, per component (Levant, Automatica 34, 1998; order 1, full M allowed).

    e0' = d_hat - d - 1.5 sqrt(c) |e0|^1/2 sign(e0), d_hat' = -1.1 c sign(e0), e0 = z0 - M w, e0(0) = 0: exact after a
    finite time where |d'| <= c per component (1.5 and 1.1 proven by Seeber and Horn, Automatica 84, 2017). c is the
    gain, free to be larger than the bound on d'.
    """

    gain: Leaf  # (m,) c [N m/s]
    disturbance_rate_bound: Leaf  # bound on each component of d' [N m/s], at most `gain`
    initial_error: Leaf  # bound on |d_hat(0) - d(0)| [N m]
    sign_width: Leaf  # of the smooth sign in the continuous loop [N m s]; the digital form needs none

    def begin(self) -> Memory:
        """Estimate d_hat [N m] and e0 [N m s], zero."""
        return jnp.zeros(2 * self.model.inputs)

    def error_bound(self) -> FiniteTimeBound:
        """No component of the error grows, and each is gone after (1 + q)/((1 - q)(1.1 - k)) |e(0)|/c, k = |d'|/c.

        e0 grows and falls while e goes from e(0) to -q e(0) at a rate of at least (1.1 - k) c, and so on with q^2 e(0):
        a geometric series. For a constant d: 1.25 |d|/c. Afterwards the smooth sign holds e0 = w artanh(k/1.1) against
        d', where the root in e0' = 0 is what is left of e.
        """
        c = jnp.min(self.gain)
        k = jnp.clip(self.disturbance_rate_bound / c, 0.0, 1.0)
        q = jnp.interp(k, jnp.linspace(0.0, 1.0, len(_OVERSHOOT)), jnp.asarray(_OVERSHOOT))  # convex: from above
        settled = (1.0 + q) / ((1.0 - q) * (1.1 - k)) * self.initial_error / c
        shares = jnp.clip(self.disturbance_rate_bound / self.gain, 0.0, 1.0)
        e0 = self.sign_width * jnp.arctanh(shares / 1.1)
        e = 1.5 * jnp.sqrt(self.gain) * guards.signed_root(e0, self.sign_width)
        return FiniteTimeBound(self.initial_error, settled, guards.norm(e))

    def decay_matrix(self, t: Scalar, t_next: Scalar) -> Matrix:
        """Zero: nothing is linear."""
        size = 2 * self.model.inputs
        return jnp.zeros((size, size))

    def forcing(self, t: Scalar, span: tuple[Scalar, Scalar], memory: Memory, d_eff: Vector) -> Memory:
        """The equations above."""
        d_hat, e0 = jnp.split(memory, 2)
        root = 1.5 * jnp.sqrt(self.gain) * guards.signed_root(e0, self.sign_width)
        return jnp.concatenate([-1.1 * self.gain * guards.smooth_sign(e0, self.sign_width), d_hat - d_eff - root])

    def update(self, matrix: Matrix, memory: Memory, impulse: Vector, t: Scalar, dt: Scalar) -> Memory:
        """Implicit Euler with the exact sign, in closed form: it cannot blow up, and it rests where e0 = 0.

        e0+ + dt 1.5 sqrt(c) |e0+|^1/2 sign(e0+) + dt^2 1.1 c xi = b, b = e0 + dt d_hat - impulse, xi in sign(e0+): a
        quadratic equation for |e0+|^1/2.
        """
        d_hat, e0 = jnp.split(memory, 2)
        b = e0 + dt * d_hat - impulse
        switching, half = 1.1 * self.gain * dt * dt, 0.75 * jnp.sqrt(self.gain) * dt
        xi = jnp.clip(b / jnp.where(switching > 0.0, switching, 1.0), -1.0, 1.0)
        no_length = jnp.where(dt > 0.0, 0.0, 1.0)  # keeps the square root's slope finite where dt is 0
        root = jnp.sqrt(half * half + jnp.maximum(jnp.abs(b) - switching, 0.0) + no_length) - half
        e0 = jnp.where(jnp.abs(xi) < 1.0, 0.0, root * root * xi)
        return jnp.concatenate([d_hat - 1.1 * self.gain * dt * xi, e0])

    def fastest(self) -> float:
        """1.5 sqrt(c / width) at e0 = 0 [1/s], with 1.1 c / width the square of the frequency."""
        width = float(self.sign_width)
        return 0.0 if width <= 0.0 else 1.5 * float(jnp.max(jnp.sqrt(self.gain))) / width**0.5
