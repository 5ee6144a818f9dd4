"""Base classes of the disturbance observers (Remark 2), and the bound K2 on their estimation error.

Read `Observer` first. Custom observers derive from `SampledObserver`, and `NoObserver` is the law without an observer.
An observer estimates d in M w' = f(t, x, u) + d (see `plants.base.Plant`). The measured disturbance d_eff = M w' - f of
the design model includes model errors. Every observer has two forms with a memory m that begins with d_hat. The
continuous form is m' = -A m + forcing, where the simulation integrates A exactly. The digital form updates m once in
each control period from the integral of d_eff.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar, NamedTuple, Protocol, runtime_checkable

import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from ptsmc_jax import declare
from ptsmc_jax.numerics.pytrees import Leaf, Scalar, Vector, pytree
from ptsmc_jax.plants.base import Plant

Memory = Float[Array, " memory"]
Matrix = Float[Array, "k k"]


@runtime_checkable
class Bound(Protocol):
    """K2(t), a bound on the 2-norm of the estimation error of an observer [N m]."""

    @property
    def largest(self) -> Scalar:
        """Largest value of K2 at any time [N m]."""
        ...

    def __call__(self, t: Scalar) -> Scalar:
        """Return K2 at the time t [s], in N m."""
        ...


class ErrorBound(NamedTuple):
    """The bound K2(t) = e^(-rate t) start + (1 - e^(-rate t)) floor, the corrected form of (55)."""

    rate: Array  # l_m, decay rate of the initial bound [1/s]
    start: Array  # bound at t = 0 [N m]
    floor: Array  # limit of the bound for large t [N m]

    @property
    def largest(self) -> Scalar:
        """Largest value of K2 at any time [N m]."""
        return jnp.maximum(self.start, self.floor)

    def __call__(self, t: Scalar) -> Scalar:
        """Return K2 at the time t [s], in N m."""
        remaining = jnp.exp(-self.rate * t)
        return self.floor + remaining * (self.start - self.floor)


def constant_bound(component_bound: Scalar, components: int) -> ErrorBound:
    """Return the constant bound K2 = sqrt(m) times a bound on each of m components of the error [N m]."""
    bound = jnp.sqrt(float(components)) * component_bound
    return ErrorBound(jnp.zeros_like(bound), bound, bound)


@dataclass(frozen=True)
class Observer(declare.Tunable, ABC):
    """Base class of the disturbance observers. The memory is a separate value, see `begin` and `update`."""

    model: Plant  # design model of the plant
    estimates: ClassVar[bool] = True  # whether the observer estimates anything: d_hat can differ from 0
    # whether the estimate is linear in the measurements, and K2 is inversely proportional to the gain
    linear: ClassVar[bool] = False

    def begin(self) -> Memory:
        """Return the memory at t = 0, with d_hat = 0 [N m]."""
        return jnp.zeros(self.model.inputs)

    def estimate(self, memory: Memory) -> Vector:
        """Return the estimate d_hat (m,) [N m] from the memory."""
        return memory[: self.model.inputs]

    @abstractmethod
    def error_bound(self) -> Bound:
        """Return K2(t), the bound on the 2-norm of the estimation error."""

    def decay_matrix(self, t: Scalar, t_next: Scalar) -> Matrix:
        """Return the mean of A [1/s] over a step of the continuous loop from t to t_next [s]."""
        raise NotImplementedError

    def forcing(self, t: Scalar, span: tuple[Scalar, Scalar], memory: Memory, d_eff: Vector) -> Memory:
        """Return the forcing m' + A m of the continuous form, where A is the `decay_matrix` of the step.

        Args:
            t: time [s].
            span: begin and end of the step [s].
            memory: memory m of the observer.
            d_eff: disturbance of the design model, (m,) [N m].

        Returns:
            A pytree like `memory`, in its unit per second.
        """
        raise NotImplementedError

    def update_matrix(self, dt: Scalar) -> Matrix:
        """Return the matrix that `update` needs for a period dt [s]. It is computed once before the loop."""
        return jnp.zeros((0, 0))

    @abstractmethod
    def update(self, matrix: Matrix, memory: Memory, impulse: Vector, t: Scalar, dt: Scalar) -> Memory:
        """Return the memory at the end of a control period.

        Args:
            matrix: `update_matrix(dt)`.
            memory: memory at the start of the period.
            impulse: integral of d_eff over the period, from `Plant.implied_disturbance_impulse`, (m,) [N m s].
            t: end of the period [s].
            dt: length of the period [s], which may be 0.

        Returns:
            The memory, a pytree like `memory`.
        """

    def fastest(self) -> float:
        """Return the fastest rate that the steps of the continuous loop must resolve [1/s]; 0 if there is none."""
        return 0.0

    def nodes(self) -> tuple[float, ...]:
        """Return times that must be nodes of the time grid of the continuous loop [s]."""
        return ()


@dataclass(frozen=True)
class SampledObserver(Observer):
    """Base of custom observers, for the sampled loop. They define `step`.

    The memory may be any pytree of arrays. By default `begin` returns an estimate of zero.
    """

    disturbance_bound: Leaf  # K of Assumption 1, bound on each component of d [N m]

    def step(self, memory: PyTree, d_mean: Vector, t: Scalar, dt: Scalar) -> PyTree:
        """Return the memory at the end of a control period.

        Args:
            memory: memory at the start of the period.
            d_mean: mean measured disturbance in the period, (m,) [N m]. It includes model errors and sensor noise.
            t: end of the period [s].
            dt: length of the period [s].

        Returns:
            The memory, a pytree like `memory` with the same shapes and dtypes.
        """
        raise NotImplementedError

    def error_bound(self) -> ErrorBound:
        """Return K2; by default sqrt(m) K, the bound without an observer."""
        return constant_bound(self.disturbance_bound, self.model.inputs)

    def update(self, matrix: Matrix, memory: PyTree, impulse: Vector, t: Scalar, dt: Scalar) -> PyTree:
        """Call `step` with the mean disturbance impulse / dt [N m]."""
        length = jnp.where(dt > 0.0, dt, 1.0)
        return self.step(memory, impulse / length, t, length)


@pytree
@dataclass(frozen=True)
class NoObserver(Observer):
    """No observer: d_hat = 0, and the switching gain K must exceed the whole disturbance.

    Laws (10), (29) and (40) of the paper have no observer. K of Assumption 1 bounds each component of d. The law uses a
    bound on the 2-norm, so K2 = sqrt(m) K.
    """

    disturbance_bound: Leaf  # K of Assumption 1, bound on each component of d [N m]
    estimates: ClassVar[bool] = False
    linear: ClassVar[bool] = True

    def error_bound(self) -> ErrorBound:
        """Return sqrt(m) K at all times."""
        return constant_bound(self.disturbance_bound, self.model.inputs)

    def decay_matrix(self, t: Scalar, t_next: Scalar) -> Matrix:
        return jnp.zeros((self.model.inputs, self.model.inputs))

    def forcing(self, t: Scalar, span: tuple[Scalar, Scalar], memory: Memory, d_eff: Vector) -> Memory:
        return jnp.zeros_like(memory)

    def update(self, matrix: Matrix, memory: Memory, impulse: Vector, t: Scalar, dt: Scalar) -> Memory:
        return memory
