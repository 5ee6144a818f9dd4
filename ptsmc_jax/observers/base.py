"""Base classes of the disturbance observers (Remark 2), and the bound K2 on their estimation error.

Read `Observer` first; custom observers derive from `SampledObserver`. An observer estimates d in M w' = f(t, x, u) + d
(see `plants.base.Plant`). The measured disturbance d_eff = M w' - f of the design model includes model errors. Every
observer has two forms with a memory m that begins with d_hat. The continuous form is m' = -A m + forcing, where the
simulation integrates A exactly. The digital form updates m once in each control period from the integral of d_eff.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple, Protocol, runtime_checkable

import jax.numpy as jnp
from jaxtyping import Array, Float

from ptsmc_jax import declare
from ptsmc_jax.numerics import integrators, matrices
from ptsmc_jax.numerics.pytrees import Leaf, Scalar, Vector
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

    def step(self, memory: Any, d_mean: Vector, t: Scalar, dt: Scalar) -> Any:
        """Return the memory at the end of a control period.

        Args:
            memory: memory at the start of the period.
            d_mean: mean measured disturbance in the period, (m,) [N m]. It includes model errors and sensor noise.
            t: end of the period [s].
            dt: length of the period [s].
        """
        raise NotImplementedError

    def error_bound(self) -> ErrorBound:
        """Return K2; by default sqrt(m) K, the bound without an observer."""
        return constant_bound(self.disturbance_bound, self.model.inputs)

    def update(self, matrix: Matrix, memory: Any, impulse: Vector, t: Scalar, dt: Scalar) -> Any:
        """Call `step` with the mean disturbance impulse / dt [N m]."""
        length = jnp.where(dt > 0.0, dt, 1.0)
        return self.step(memory, impulse / length, t, length)


@dataclass(frozen=True)
class LinearObserver(Observer):
    """Base of the observers with a constant gain l = diag(gain)."""

    gain: Leaf = declare.gain(  # (m,), so that l J^-1 is in 1/s
        None, "dead_beat", each=True, unit=("N m s", "1/s"),
        meaning="diagonal of l(w), or of its constant part; 10 in the paper; default for the sampled "
                "loop: as fast as the hold phase",
    )  # fmt: skip
    disturbance_rate_bound: Leaf  # pyright: ignore[reportGeneralTypeIssues]  # c of Assumption 1, bound on each component of d' [N m/s]
    initial_error: Leaf  # pyright: ignore[reportGeneralTypeIssues]  # bound on |d_hat(0) - d(0)| [N m]; (57) needs it, but the paper has no value
    linear: ClassVar[bool] = True

    def decay_matrix(self, t: Scalar, t_next: Scalar) -> Matrix:
        """Return A = l J^-1 [1/s], which is constant over the step."""
        return self._constant_decay()

    def _constant_decay(self) -> Matrix:
        """Return the constant part l J^-1 of A [1/s]."""
        return self.gain[:, None] * self.model.inertia_inverse

    def _linear_bound(self) -> ErrorBound:
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

    def update_matrix(self, dt: Scalar) -> Matrix:
        """Return (I - e^(-A dt)) / dt = A phi_1(-A dt) [1/s], with A = l J^-1. It is smooth in dt, also at dt = 0."""
        a = self._constant_decay()
        _, phi = integrators.phi_functions(-a * dt, 1)
        return a @ phi
