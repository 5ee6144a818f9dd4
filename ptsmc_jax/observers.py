"""Disturbance observers, each in a continuous and a digital form and with the bound K2 on its error (Remark 2).

All estimate d in M w' = known(t, x, u) + d (`plants.Plant`). Continuous: m' = -A m + forcing, with the memory m, which
begins with d_hat, and d_eff = M w' - known the disturbance that the nominal model sees; the rollout steps A exactly.
Digital: one update a period from the impulse that the model leaves unexplained, the integral of d_eff over it.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from ptsmc_jax import numerics
from ptsmc_jax.numerics import Leaf, pytree
from ptsmc_jax.plants import Plant

Scalar = Float[Array, ""]
Vector = Float[Array, " m"]
Memory = Float[Array, " memory"]
Matrix = Float[Array, "k k"]


class ErrorBound(NamedTuple):
    """K2(t) >= |d_hat - d|_2, the right-hand side of (55) corrected: factor (e^(-rate t) start + (1 - e^..) floor)."""

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


@dataclass(frozen=True)
class Observer(ABC):
    """What the rollout asks of an observer."""

    model: Plant  # the nominal plant

    def begin(self) -> Memory:
        """Memory at t = 0: d_hat = 0 [N m]."""
        return jnp.zeros(self.model.inputs)

    def estimate(self, memory: Memory) -> Vector:
        """d_hat [N m]."""
        return memory[: self.model.inputs]

    @abstractmethod
    def error_bound(self) -> "ErrorBound | PrescribedTimeBound | FiniteTimeBound":
        """K2(t), the bound on the 2-norm of the estimation error."""

    @abstractmethod
    def decay_matrix(self, t: Scalar, t_next: Scalar) -> Matrix:
        """A [1/s] for the memory, its mean over a step from t to t_next [s]."""

    @abstractmethod
    def forcing(self, t: Scalar, span: tuple[Scalar, Scalar], memory: Memory, seen: Vector) -> Memory:
        """The forcing m' + A m at t in the step `span`, with A the `decay_matrix` of that step; seen: d_eff [N m]."""

    @abstractmethod
    def update_matrix(self, dt: Scalar) -> Matrix:
        """What `update` needs of a period dt [s], computed outside the loop."""

    @abstractmethod
    def update(self, matrix: Matrix, memory: Memory, impulse: Vector, t: Scalar, dt: Scalar) -> Memory:
        """Memory at the end t of a period dt [s]; impulse: what `Plant.unexplained_impulse` measures of it [N m s]."""

    def fastest(self) -> float:
        """Rate that explicit steps of the continuous loop must resolve [1/s]: that of a smooth sign of its own."""
        return 0.0

    def nodes(self) -> tuple[float, ...]:
        """Times that the continuous loop must step on [s]."""
        return ()


@pytree
@dataclass(frozen=True)
class NoObserver(Observer):
    """No estimate: d_hat = 0, and the switching gain must cover the disturbance itself, as in (10), (29) and (40).

    K of Assumption 1 bounds each component of d; the law scales the 2-norm of what it does not know, so K2 = sqrt(m) K.
    """

    disturbance_bound: Leaf  # K of Assumption 1 [N m]

    def error_bound(self) -> ErrorBound:
        """sqrt(m) K at all times."""
        bound = jnp.sqrt(float(self.model.inputs)) * self.disturbance_bound
        return ErrorBound(jnp.zeros_like(bound), bound, bound)

    def decay_matrix(self, t: Scalar, t_next: Scalar) -> Matrix:
        """Zero."""
        return jnp.zeros((self.model.inputs, self.model.inputs))

    def forcing(self, t: Scalar, span: tuple[Scalar, Scalar], memory: Memory, seen: Vector) -> Memory:
        """Zero."""
        return jnp.zeros_like(memory)

    def update_matrix(self, dt: Scalar) -> Matrix:
        """Zero."""
        return jnp.zeros((self.model.inputs, self.model.inputs))

    def update(self, matrix: Matrix, memory: Memory, impulse: Vector, t: Scalar, dt: Scalar) -> Memory:
        """The estimate stays what it is."""
        return memory


@dataclass(frozen=True)
class Linear(Observer):
    """What observers with a constant part l = diag(gain) of their gain share."""

    gain: Leaf  # (m,) diagonal of l [N m s, so that l J^-1 is in 1/s]
    disturbance_rate_bound: Leaf  # c of Assumption 1, bound on each component of d' [N m/s]
    initial_error: Leaf  # bound on |d_hat(0) - d(0)| [N m]; the paper's (57) needs it and gives none

    def _slope(self) -> Matrix:
        """The matrix l J^-1 [1/s]."""
        return self.gain[:, None] * self.model.inertia_inverse

    def _bound(self) -> ErrorBound:
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

    def update_matrix(self, dt: Scalar) -> Matrix:
        """(I - e^(-A dt)) / dt = A phi_1(-A dt) [1/s]: smooth in dt down to 0, where it is A."""
        a = self._slope()
        _, phi = numerics.phi_functions(-a * dt, 1)
        return a @ phi


@pytree
@dataclass(frozen=True)
class NonlinearObserver(Linear):
    """Nonlinear disturbance observer (53) with constant l(w) = diag(gain), so lambda(w) = gain w.

    The paper's z is d_hat - l w. Its error obeys (54): e' = -l M^-1 e - d', with M the inertia J of a spacecraft.
    """

    def decay_matrix(self, t: Scalar, t_next: Scalar) -> Matrix:
        """A = l J^-1 [1/s], constant."""
        return self._slope()

    def error_bound(self) -> ErrorBound:
        """(55) corrected."""
        return self._bound()

    def forcing(self, t: Scalar, span: tuple[Scalar, Scalar], memory: Memory, seen: Vector) -> Memory:
        """A d_eff [N m/s]."""
        return self.gain * (self.model.inertia_inverse @ seen)

    def update(self, matrix: Matrix, memory: Memory, impulse: Vector, t: Scalar, dt: Scalar) -> Memory:
        """d_hat+ = E d_hat + (I - E) impulse / dt, E = e^(-A dt): unbiased, a contraction for any gain and period.

        `matrix` is `update_matrix(dt)`.
        """
        return memory + matrix @ (impulse - dt * memory)


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
        """What it never exceeds [N m]."""
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

    mu: Leaf  # > 1 [-]
    t_o: Leaf  # T_o [s]
    delta_o: Leaf  # [s]

    def _left(self, t: Scalar) -> Scalar:
        return jnp.maximum(self.t_o - t, self.delta_o)

    def _mean(self, t: Scalar, t_next: Scalar) -> Scalar:
        """Mean of mu/(T_o - t) over an interval, 0 from T_o - delta_o on [1/s]."""
        dt = t_next - t
        fallen = jnp.log(self._left(t) / self._left(t_next)) / jnp.where(dt > 0.0, dt, 1.0)
        return self.mu * jnp.where(dt > 0.0, fallen, 0.0)

    def error_bound(self) -> PrescribedTimeBound:
        """K2(t)."""
        return PrescribedTimeBound(self._bound(), self.mu, self.t_o, self.delta_o)

    def decay_matrix(self, t: Scalar, t_next: Scalar) -> Matrix:
        """A = l J^-1 + mu/(T_o - t), its mean over the step [1/s]."""
        return self._slope() + self._mean(t, t_next) * jnp.eye(self.model.inputs)

    def forcing(self, t: Scalar, span: tuple[Scalar, Scalar], memory: Memory, seen: Vector) -> Memory:
        """A(t) d_eff - (A(t) - A) d_hat [N m/s]; a step lies on one side of T_o - delta_o."""
        early = 0.5 * (span[0] + span[1]) < self.t_o - self.delta_o
        extra = jnp.where(early, self.mu / self._left(t), 0.0)
        off = extra - self._mean(*span)
        return self.gain * (self.model.inertia_inverse @ seen) + extra * seen - off * memory

    def update(self, matrix: Matrix, memory: Memory, impulse: Vector, t: Scalar, dt: Scalar) -> Memory:
        """As the nonlinear one's, with E = e^(-l J^-1 dt) ((T_o - t)/(T_o - t + dt))^mu."""
        kept = jnp.exp(-self._mean(t - dt, t) * dt)
        gone = (1.0 - kept) / jnp.where(dt > 0.0, dt, 1.0)
        return memory + kept * (matrix @ (impulse - dt * memory)) + gone * (impulse - dt * memory)

    def nodes(self) -> tuple[float, ...]:
        """Nodes that close in on T_o, each a tenth nearer, and T_o - delta_o."""
        t_o, delta_o = float(self.t_o), float(self.delta_o)
        left, times = t_o, [t_o - delta_o]
        while left > max(delta_o, 1e-9 * t_o):
            times.append(t_o - left)
            left *= 0.9
        return tuple(sorted(times))


# Largest |e| at the next zero of e0 over that at the last one, for |d'| <= 0, 0.1 .. 1 times c and the worst d': it
# slows e down while |e0| grows and speeds it up while it falls (found by integration, checked in the tests).
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
        off = self.sign_width * jnp.arctanh(shares / 1.1)
        left = 1.5 * jnp.sqrt(self.gain) * numerics.signed_root(off, self.sign_width)
        return FiniteTimeBound(self.initial_error, settled, numerics.norm(left))

    def decay_matrix(self, t: Scalar, t_next: Scalar) -> Matrix:
        """Zero: nothing is linear."""
        size = 2 * self.model.inputs
        return jnp.zeros((size, size))

    def forcing(self, t: Scalar, span: tuple[Scalar, Scalar], memory: Memory, seen: Vector) -> Memory:
        """The equations above."""
        d_hat, off = jnp.split(memory, 2)
        drop = 1.5 * jnp.sqrt(self.gain) * numerics.signed_root(off, self.sign_width)
        return jnp.concatenate([-1.1 * self.gain * numerics.smooth_sign(off, self.sign_width), d_hat - seen - drop])

    def update_matrix(self, dt: Scalar) -> Matrix:
        """Nothing."""
        return jnp.zeros((0, 0))

    def update(self, matrix: Matrix, memory: Memory, impulse: Vector, t: Scalar, dt: Scalar) -> Memory:
        """Implicit Euler with the exact sign, in closed form: it cannot blow up, and it rests where e0 = 0.

        e0+ + dt 1.5 sqrt(c) |e0+|^1/2 sign(e0+) + dt^2 1.1 c xi = e0 + dt d_hat - impulse, xi in sign(e0+).
        """
        d_hat, off = jnp.split(memory, 2)
        pulled = off + dt * d_hat - impulse
        reach, half = 1.1 * self.gain * dt * dt, 0.75 * jnp.sqrt(self.gain) * dt
        xi = jnp.clip(pulled / jnp.where(reach > 0.0, reach, 1.0), -1.0, 1.0)
        root = jnp.sqrt(half * half + jnp.maximum(jnp.abs(pulled) - reach, 0.0) + jnp.where(dt > 0.0, 0.0, 1.0)) - half
        off = jnp.where(jnp.abs(xi) < 1.0, 0.0, root * root * xi)
        return jnp.concatenate([d_hat - 1.1 * self.gain * dt * xi, off])

    def fastest(self) -> float:
        """1.5 sqrt(c / width) at e0 = 0 [1/s], with 1.1 c / width the square of the frequency."""
        width = float(self.sign_width)
        return 0.0 if width <= 0.0 else 1.5 * float(jnp.max(jnp.sqrt(self.gain))) / width**0.5
