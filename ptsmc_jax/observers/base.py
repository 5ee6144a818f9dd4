"""Disturbance observers, each in a continuous and a digital form and with the bound K2 on its error (Remark 2).

All estimate d in M w' = f(t, x, u) + d (`base.Plant`). Continuous: m' = -A m + forcing, with the memory m, which
begins with d_hat, and d_eff = M w' - known the disturbance that the nominal model sees; the rollout steps A exactly.
Digital: one update a period from the impulse that the model leaves unexplained, the integral of d_eff over it.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple, Protocol, runtime_checkable

import jax.numpy as jnp
from jaxtyping import Array, Float

from ptsmc_jax.numerics import integrators, matrices
from ptsmc_jax.numerics.pytrees import Leaf, Scalar, Vector
from ptsmc_jax.plants.base import Plant

Memory = Float[Array, " memory"]
Matrix = Float[Array, "k k"]


@runtime_checkable
class Bound(Protocol):
    """K2(t), a bound on the 2-norm of an observer's error [N m]."""

    @property
    def largest(self) -> Scalar:
        """The largest value of K2 at any time [N m]."""
        ...

    def __call__(self, t: Scalar) -> Scalar:
        """K2 at t [s], in N m."""
        ...


class ErrorBound(NamedTuple):
    """K2(t) >= |d_hat - d|_2, the right-hand side of (55) corrected: e^(-rate t) start + (1 - e^(-rate t)) floor."""

    rate: Array  # l_m [1/s]
    start: Array  # bound at t = 0 [N m]
    floor: Array  # bound as t grows [N m]

    @property
    def largest(self) -> Scalar:
        """Its largest value [N m]."""
        return jnp.maximum(self.start, self.floor)

    def __call__(self, t: Scalar) -> Scalar:
        """K2 at t [s], in N m."""
        remaining = jnp.exp(-self.rate * t)
        return self.floor + remaining * (self.start - self.floor)


def constant_bound(component_bound: Scalar, components: int) -> ErrorBound:
    """K2 at all times where each component of the error is bounded [N m]: the 2-norm by sqrt(m) times as much."""
    bound = jnp.sqrt(float(components)) * component_bound
    return ErrorBound(jnp.zeros_like(bound), bound, bound)


@dataclass(frozen=True)
class Observer(ABC):
    """A disturbance observer, as the rollout asks for it."""

    model: Plant  # the nominal plant
    tunable: ClassVar[tuple[str, ...]] = ()  # fields that tuning may move, besides `gain`
    estimates: ClassVar[bool] = True  # False: d_hat is always 0
    linear: ClassVar[bool] = False  # the estimate is linear in what is measured, and its bound inverse to the gain

    def begin(self) -> Memory:
        """Memory at t = 0: d_hat = 0 [N m]."""
        return jnp.zeros(self.model.inputs)

    def estimate(self, memory: Memory) -> Vector:
        """d_hat [N m]."""
        return memory[: self.model.inputs]

    @abstractmethod
    def error_bound(self) -> Bound:
        """K2(t), the bound on the 2-norm of the estimation error."""

    def decay_matrix(self, t: Scalar, t_next: Scalar) -> Matrix:
        """The mean of A [1/s] over a step from t to t_next [s] of the continuous loop."""
        raise NotImplementedError

    def forcing(self, t: Scalar, span: tuple[Scalar, Scalar], memory: Memory, d_eff: Vector) -> Memory:
        """The forcing m' + A m at t in the step `span` [s], with A the `decay_matrix` of that step; d_eff [N m]."""
        raise NotImplementedError

    def update_matrix(self, dt: Scalar) -> Matrix:
        """The matrix that `update` takes for a period dt [s], computed once, outside the loop; empty: it needs none."""
        return jnp.zeros((0, 0))

    @abstractmethod
    def update(self, matrix: Matrix, memory: Memory, impulse: Vector, t: Scalar, dt: Scalar) -> Memory:
        """Memory at the end of a period.

        Args:
            matrix: `update_matrix(dt)`.
            memory: at its start.
            impulse: `Plant.unexplained_impulse` of the period, (m,) [N m s].
            t: end of the period [s].
            dt: its length [s], which may be 0.
        """

    def fastest(self) -> float:
        """Rate that explicit steps of the continuous loop must resolve [1/s]: that of a smooth sign of its own."""
        return 0.0

    def nodes(self) -> tuple[float, ...]:
        """Times that the continuous loop must step on [s]."""
        return ()


@dataclass(frozen=True)
class SampledObserver(Observer):
    """The base of an observer of one's own; it flies in the sampled loop.

    Its memory is any pytree of arrays; `begin`'s default is an estimate of zero.
    """

    disturbance_bound: Leaf  # K of Assumption 1, bound on each component of d [N m]

    def step(self, memory: Any, seen: Vector, t: Scalar, dt: Scalar) -> Any:
        """The memory at t [s] from that a period dt [s] earlier; seen: the mean disturbance in it, (m,) [N m].

        It is what the nominal model leaves unexplained of the motion between two samples, with their noise.
        """
        raise NotImplementedError

    def error_bound(self) -> ErrorBound:
        """K2, which the law switches against; by default sqrt(m) K, as without an observer."""
        return constant_bound(self.disturbance_bound, self.model.inputs)

    def update(self, matrix: Matrix, memory: Any, impulse: Vector, t: Scalar, dt: Scalar) -> Any:
        """`step` over periods that have a length, of the mean impulse / dt [N m]."""
        length = jnp.where(dt > 0.0, dt, 1.0)
        return self.step(memory, impulse / length, t, length)


@dataclass(frozen=True)
class Linear(Observer):
    """Base of observers whose gain has a constant part l = diag(gain)."""

    gain: Leaf  # (m,) diagonal of l [N m s, so that l J^-1 is in 1/s]
    disturbance_rate_bound: Leaf  # c of Assumption 1, bound on each component of d' [N m/s]
    initial_error: Leaf  # bound on |d_hat(0) - d(0)| [N m]; the paper's (57) needs it and gives none
    linear: ClassVar[bool] = True

    def decay_matrix(self, t: Scalar, t_next: Scalar) -> Matrix:
        """The constant part of A, l J^-1 [1/s]."""
        return self.gain[:, None] * self.model.inertia_inverse

    def _bound(self) -> ErrorBound:
        """(55) as it must read: sqrt(m) c, since c bounds each component of d' but K2 the 2-norm of the error.

        l_m is the smallest eigenvalue of l^1/2 J^-1 l^1/2 and the bound carries sqrt(cond(l)); for a diagonal J and
        equal gains that is the paper's smallest diagonal element of l J^-1.
        """
        root = jnp.sqrt(self.gain)
        scaled = root[:, None] * self.model.inertia_inverse * root[None, :]
        slowest = matrices.smallest_eigenvalue(scaled)
        factor = jnp.sqrt(jnp.max(self.gain) / jnp.min(self.gain))
        floor = factor * jnp.sqrt(float(self.model.inputs)) * self.disturbance_rate_bound / slowest
        return ErrorBound(slowest, factor * self.initial_error, floor)

    def update_matrix(self, dt: Scalar) -> Matrix:
        """(I - e^(-A dt)) / dt = A phi_1(-A dt) [1/s]: smooth in dt down to 0, where it is A."""
        a = Linear.decay_matrix(self, dt, dt)
        _, phi = integrators.phi_functions(-a * dt, 1)
        return a @ phi
