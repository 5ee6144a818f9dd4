"""Exact solutions of Theorems 1 to 3: where a run without sampling or noise is, and by what torque."""

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from ptsmc_jax import programs
from ptsmc_jax.laws.base import SecondOrder
from ptsmc_jax.laws.prescribed_time import expansion
from ptsmc_jax.numerics import guards
from ptsmc_jax.plants.integrator_chain import Chain
from ptsmc_jax.simulation.assembly import Setup

Scalar = Float[Array, ""]


Vector = Float[Array, " n"]


class ErrorMotion(NamedTuple):
    """Attitude error vector, its derivatives and s before the hand-over."""

    error: Array  # [-]
    error_rate: Array  # [1/s]
    s: Array  # [-]
    acceleration: Array  # [1/s^2]


class ChainMotion(NamedTuple):
    """States of a chain, s, and x_n'."""

    x: Array  # (n,)
    s: Array
    acceleration: Array  # x_n', the input where f = 0, g = 1 and d = 0


def exact_error(t: Scalar, t_f: Scalar, eta: Scalar, error: Vector, error_rate: Vector) -> ErrorMotion:
    """Closed form of the second-order law before the hand-over, for each component of the attitude error vector.

    x(t) = r^eta (x(0) + s(0) L), s(t) = s(0) r^eta, s(0) = t_f x'(0) + eta x(0). t, t_f [s], t < t_f; error and
    error_rate are those at t = 0.
    """
    tau = t_f - t
    r = tau / t_f
    s0 = t_f * error_rate + eta * error
    decay = r**eta
    x, s = decay * (error - s0 * jnp.log(r)), s0 * decay
    x_dot = (s - eta * x) / tau
    return ErrorMotion(x, x_dot, s, -(eta - 1.0) * x_dot / tau - eta * s / tau**2)


def exact_chain(t: Scalar, t_f: Scalar, eta: Scalar, x0: Vector) -> ChainMotion:
    """Closed form of law (52) on a chain of any order n before the hand-over, d = 0 and K = 0; x0: (n,) at t = 0.

    In the states' own units; s(t) = s(0) r^(eta+n-2), and y = x_1 / tau^eta obeys y^(n-1) = s(0) t_f^-(eta+n-2) / tau,
    integrated n-1 times.
    """
    n = x0.shape[0]
    s0 = _surface(t_f, eta, x0)
    y = [free + s0 * forced for free, forced in zip(*_modes(t, t_f, eta, x0), strict=True)]
    x = _from_modes(t, t_f, eta, y)
    return ChainMotion(jnp.stack(x[:n]), s0 * ((t_f - t) / t_f) ** (eta + n - 2), x[n])


def state_envelope(t: Scalar, t_f: Scalar, eta: Scalar, x0: Vector, s0: Scalar, floor: Scalar) -> tuple[Vector, Vector]:
    """Centre and half width, (n,) each, of the interval that holds x_1 .. x_n where |s|^2 <= s0^2 r^(..) + floor tau^n.

    In the states' own units. (20)-(22) and (47)-(50) with their constants, for any residual that `sliding_envelope`
    allows: the exact solution without s is the centre, and each of the n-1 integrations of
    |y^(n-1)| <= |s| / tau^(eta+n-1) adds to the width.
    """
    n, tau = x0.shape[0], t_f - t
    free, forced = _modes(t, t_f, eta, x0)
    scale = jnp.sqrt(floor) * tau ** (n / 2)  # what the smooth sign leaves of |s|
    widths = []
    for j in range(n):
        p = n - 2 - j
        share = 1.0 / ((eta - n / 2 + j) * math.factorial(p)) if p >= 0 else 1.0
        left = scale * share * tau**-j * (t_f / tau) ** eta
        widths.append(jnp.abs(s0 * forced[j]) + left)
    centre = _from_modes(t, t_f, eta, free)[:n]
    half = _from_modes(t, t_f, eta, [*widths, jnp.zeros_like(tau)], jnp.abs)[:n]
    return jnp.stack(centre), jnp.stack(half)


def _surface(t_f: Scalar, eta: Scalar, x: Vector) -> Scalar:
    """The surface s of (37) at t = 0."""
    c = expansion(eta, x.shape[0])
    return sum((c[i] * t_f**i * x[i] for i in range(x.shape[0])), jnp.zeros_like(t_f))


def _modes(t: Scalar, t_f: Scalar, eta: Scalar, x0: Vector) -> tuple[list[Scalar], list[Scalar]]:
    """y, y', .. y^(n) of y = x_1 / r^eta: what the initial state gives, and what s(0) = 1 gives besides."""
    n, tau = x0.shape[0], t_f - t
    rising = [jnp.ones_like(eta)]
    for k in range(n):
        rising.append(rising[-1] * (eta + k))
    start = [
        sum((math.comb(k, j) * x0[j] * rising[k - j] * t_f ** (j - k) for j in range(k + 1)), jnp.zeros_like(t))
        for k in range(n - 1)
    ]
    free, forced = [], []
    for j in range(n + 1):
        terms = (start[k] * t ** (k - j) / math.factorial(k - j) for k in range(j, n - 1))
        free.append(sum(terms, jnp.zeros_like(t)))
        gained = _integral(t, t_f, n - 2 - j) if j < n - 1 else tau ** (n - 2 - j)
        forced.append(t_f ** (2 - n) * gained)
    return free, forced


def _integral(t: Scalar, t_f: Scalar, p: int) -> Scalar:
    """Integral over 0 < u < t of (t - u)^p / p! / (t_f - u) [s^p]."""
    tau = t_f - t
    total = (-tau) ** p * jnp.log(t_f / tau)
    for j in range(1, p + 1):
        total += math.comb(p, j) * (-tau) ** (p - j) * (t_f**j - tau**j) / j
    return total / math.factorial(p)


def _from_modes(t: Scalar, t_f: Scalar, eta: Scalar, y: list[Scalar], size=lambda v: v) -> list[Scalar]:
    """x_1, x_1', .. of x_1 = r^eta y by Leibniz's rule; size = abs: bounds on them from bounds on y."""
    r = (t_f - t) / t_f
    falling = [jnp.ones_like(eta)]
    for k in range(len(y)):
        falling.append(-falling[-1] * (eta - k))
    slopes = [size(falling[p] * r ** (eta - p) * t_f**-p) for p in range(len(y))]
    return [
        sum((math.comb(k, j) * slopes[k - j] * y[j] for j in range(k + 1)), jnp.zeros_like(r)) for k in range(len(y))
    ]


def _start(parts: Setup) -> tuple[Array, Array]:
    """The errors and their derivatives at t = 0, (m,) each."""
    target = parts.reference(jnp.zeros_like(parts.t_end))
    return parts.controller.errors(parts.controller.align(parts.initial, target), target)


def starts(parts: Setup) -> Float[Array, "m n"]:
    """Each component of the error and its derivatives at t = 0, in the states' own units: x_1 .. x_n = x_1^(n-1)."""
    return parts.initial[None] if isinstance(parts.plant, Chain) else jnp.stack(_start(parts), axis=1)


def exact_sizes(parts: Setup, t: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """2-norms of the error and of s along the exact motion at times t (time,) [s] before the hand-over."""
    error, s = _exact_sizes(parts, jnp.asarray(t))
    return np.asarray(error), np.asarray(s)


@programs.jit
def _exact_sizes(parts: Setup, t: Array) -> tuple[Array, Array]:
    law = parts.controller

    def sizes(time: Scalar) -> tuple[Scalar, Scalar]:
        if isinstance(parts.plant, Chain):
            chain = exact_chain(time, law.t_f, law.eta, parts.initial)
            return jnp.abs(chain.x[0]), jnp.abs(chain.s)
        motion = exact_error(time, law.t_f, law.eta, *_start(parts))
        return guards.norm(motion.error), guards.norm(motion.s)

    return jax.vmap(sizes)(t)


def exact_input(parts: Setup, t: Scalar) -> tuple[Array, Scalar]:
    """Input (m,) [N m] along the exact motion at t [s] before the hand-over, and the law's clearance then [-].

    For attitudes 1 - |v|^2, the square of the scalar part, stands for the clearance; at or below 0 there is no path.
    """
    law, plant = parts.controller, parts.plant
    if isinstance(plant, Chain):
        motion = exact_chain(t, law.t_f, law.eta, parts.initial)
        w_dot = jnp.reshape(motion.acceleration, 1)
        return plant.input_for(t, motion.x, w_dot, parts.disturbance(t, motion.x)), jnp.ones_like(t)
    assert isinstance(law, SecondOrder)
    wanted = exact_error(t, law.t_f, law.eta, *_start(parts))
    motion = law.motion(parts.reference(t), parts.initial, wanted.error, wanted.error_rate, wanted.acceleration)
    d = parts.disturbance(t, motion.x)
    return plant.input_for(t, motion.x, motion.w_dot, d), motion.clearance


@programs.jit(static_argnames="points")
def visited(parts: Setup, points: int = 64) -> tuple[Array, Any]:
    """Targets and states of a second-order run, (2 points,) each: along the exact motion, then on the target.

    States in the states' own units; half of the times close in on the hand-over.
    """
    law = parts.controller
    assert isinstance(law, SecondOrder)
    share = jnp.linspace(0.0, 1.0, points)

    def at(t: Scalar, moving: bool) -> tuple[Any, Any]:
        target = parts.reference(t)
        wanted = exact_error(t, law.t_f, law.eta, *_start(parts))
        errors = (wanted.error, wanted.error_rate, wanted.acceleration)
        return target, law.motion(target, parts.initial, *(e if moving else jnp.zeros_like(e) for e in errors)).x

    early = jax.vmap(lambda t: at(t, True))(law.t_f - law.t_f * (law.delta / law.t_f) ** share)
    late = jax.vmap(lambda t: at(t, False))(parts.t_end * share)
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), early, late)


@programs.jit(static_argnames="points")
def exact_path(parts: Setup, points: int = 2000) -> tuple[Array, Array, Array]:
    """Times before the hand-over [s], (points,), inputs (points, m) and clearance (points,) along the exact motion.

    See `exact_input`.
    """
    law = parts.controller
    t = law.t_f - law.t_f * (law.delta / law.t_f) ** jnp.linspace(0.0, 1.0, points)
    u, clearance = jax.vmap(lambda time: exact_input(parts, time))(t)
    return t, u, clearance


def exact_peak(parts: Setup, points: int = 400) -> Scalar:
    """Largest input along the exact motion before the hand-over [N m]: rule 3.5 for any start, reference and order."""
    _, u, _ = exact_path(parts, points)
    return jnp.max(jnp.abs(u))
