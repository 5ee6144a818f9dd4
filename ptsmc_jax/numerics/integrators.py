"""Integrators: Runge and Kutta's of order 4, plain and exponential, and the phi functions of the latter."""

from collections.abc import Callable
from functools import partial
from math import factorial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ptsmc_jax.numerics.matrices import row_norm
from ptsmc_jax.numerics.pytrees import Scalar


def rk4(rate: Callable[[Scalar, Any], Any], t: Scalar, y: Any, dt: Scalar, *, rolled: bool = False) -> Any:
    """State at t + dt by one step of the classical Runge-Kutta method of order 4.

    rate(t, y) returns dy/dt as a pytree like y; t, dt [s]. rolled: by a loop over the stages, in which a large rate is
    compiled once instead of four times.
    """
    if rolled:
        return _rolled_rk4(rate, t, y, dt)
    k1 = rate(t, y)
    k2 = rate(t + dt / 2, _ahead(y, k1, dt / 2))
    k3 = rate(t + dt / 2, _ahead(y, k2, dt / 2))
    k4 = rate(t + dt, _ahead(y, k3, dt))
    return _simpson(y, dt, k1, k2, k3, k4)


def _rolled_rk4(rate: Callable[[Scalar, Any], Any], t: Scalar, y: Any, dt: Scalar) -> Any:
    def stage(k: Array | int, slopes: tuple[Any, Any]) -> tuple[Any, Any]:
        before, total = slopes
        ahead = dt * jnp.where(k == 0, 0.0, jnp.where(k == 3, 1.0, 0.5))
        weight = jnp.where((k == 0) | (k == 3), 1.0, 2.0)
        slope = rate(t + ahead, _ahead(y, before, ahead))
        return slope, _ahead(total, slope, weight)

    nothing = jax.tree.map(jnp.zeros_like, y)
    _, total = jax.lax.fori_loop(0, 4, stage, (nothing, nothing))
    return _ahead(y, total, dt / 6)


def _ahead(y: Any, slope: Any, step: Scalar) -> Any:
    """The pytree y + step slope."""
    return jax.tree.map(lambda y, k: y + step * k, y, slope)


def _simpson(y: Any, dt: Scalar, k1: Any, k2: Any, k3: Any, k4: Any) -> Any:
    """The pytree y + dt (k1 + 2 k2 + 2 k3 + k4) / 6."""
    return jax.tree.map(lambda y, a, b, c, d: y + dt / 6 * (a + 2 * (b + c) + d), y, k1, k2, k3, k4)


def hermite_middle(start: Array, start_rate: Array, end: Array, end_rate: Array, dt: Scalar) -> Array:
    """Value in the middle of dt [s] of the cubic through both ends with these slopes [per s]."""
    return (start + end) / 2 + dt / 8 * (start_rate - end_rate)


_TERMS = 15  # of the Taylor series at a norm of at most 1/2: the rest is below 2^-16 / 15!
_DOUBLINGS = 40  # at most: enough for norms up to 2^39
_USUAL_DOUBLINGS = 4  # enough for norms up to 8, which few matrices exceed


@partial(jax.jit, static_argnames="order")
def phi_functions(x: Float[Array, "n n"], order: int, largest: Scalar | None = None) -> list[Float[Array, "n n"]]:
    """[phi_0(x), .., phi_order(x)] of a matrix [-]: phi_0(x) = e^x, phi_k(x) = (phi_(k-1)(x) - I/(k-1)!) / x.

    Scaling and doubling, phi_k(2x) = 2^-k (phi_0 phi_k + sum_(j=1..k) phi_j / (k-j)!) (Skaflestad and Wright, Applied
    Numerical Mathematics 59, 2009): nothing cancels for small x, eigenvalues may repeat, and no LAPACK is called, whose
    batched solves were seen to lock up when two of them shared a small thread pool. largest: `row_norm` of the largest
    of many matrices, which then take as many doublings as that one and no more.
    """
    one = jnp.eye(x.shape[-1], dtype=x.dtype)
    size = jax.lax.stop_gradient(row_norm(x) if largest is None else largest)
    doublings = jnp.clip(jnp.ceil(jnp.log2(jnp.maximum(size, 0.5))) + 1.0, 0.0, _DOUBLINGS)
    small = x * 2.0**-doublings
    top = one / float(factorial(order + _TERMS))
    # a loop, which is compiled once, not once for each term
    terms = jnp.asarray([1.0 / factorial(order + k) for k in range(_TERMS - 1, -1, -1)], x.dtype)
    top, _ = jax.lax.scan(lambda top, term: (term * one + small @ top, None), top, terms)
    phi = [top]
    for k in range(order - 1, -1, -1):
        phi.insert(0, one / factorial(k) + small @ phi[0])

    def step(k: Any, phi: list[Array]) -> list[Array]:
        return jax.lax.cond(k < doublings, _double, lambda phi: phi, phi)

    # loops of fixed length, since those can be differentiated backwards
    phi = jax.lax.fori_loop(0, _USUAL_DOUBLINGS, step, phi)
    return jax.lax.cond(
        doublings > _USUAL_DOUBLINGS,
        lambda phi: jax.lax.fori_loop(_USUAL_DOUBLINGS, _DOUBLINGS, step, phi),
        lambda phi: phi,
        phi,
    )


def _double(phi: list[Array]) -> list[Array]:
    """phi_k(2x) from phi_k(x)."""
    return [
        (phi[0] @ phi[k] + sum((phi[j] / factorial(k - j) for j in range(1, k + 1)), 0.0 * phi[0])) / 2**k
        for k in range(len(phi))
    ]


class Decay(NamedTuple):
    """Coefficients of `etdrk4` for the linear part -A and a step dt: matrices (n, n) [- or s]."""

    half: Array  # e^(-A dt/2)
    full: Array  # e^(-A dt)
    stage: Array  # dt/2 phi_1(-A dt/2) [s]
    ends: tuple[Array, Array, Array]  # weights of the forcing at the start, the middle (twice) and the end [s]


def decay(a: Float[Array, "n n"], dt: Scalar, largest: Scalar | None = None) -> Decay:
    """Coefficients of Cox and Matthews, J. Comput. Phys. 176 (2002), eqs. (26)-(29), for m' = -A m + forcing.

    largest: `row_norm` of a dt for the largest of many steps that this one is among; see `phi_functions`.
    """
    halves = phi_functions(-a * dt / 2, 3, None if largest is None else largest / 2)
    half, phi_half, *_ = halves
    full, p1, p2, p3 = _double(halves)
    ends = (dt * (p1 - 3 * p2 + 4 * p3), dt * 2 * (p2 - 2 * p3), dt * (4 * p3 - p2))
    return Decay(half, full, dt / 2 * phi_half, ends)


def etdrk4(rate: Callable, linear: Decay, t: Scalar, y: Any, m: Float[Array, " n"], dt: Scalar) -> tuple:
    """One step of order 4 of y' = f(t, y, m), m' = -A m + g(t, y, m), exact in A: (y, m) at t + dt, and aux at t.

    rate(t, y, m) returns (f, g, aux). With A = 0 it is `rk4`; however stiff A is, the step stays stable and exact
    for a constant g.
    """
    f1, g1, aux = rate(t, y, m)
    m2 = linear.half @ m + linear.stage @ g1
    f2, g2, _ = rate(t + dt / 2, _ahead(y, f1, dt / 2), m2)
    m3 = linear.half @ m + linear.stage @ g2
    f3, g3, _ = rate(t + dt / 2, _ahead(y, f2, dt / 2), m3)
    m4 = linear.half @ m2 + linear.stage @ (2 * g3 - g1)
    f4, g4, _ = rate(t + dt, _ahead(y, f3, dt), m4)
    w1, w2, w4 = linear.ends
    m_next = linear.full @ m + w1 @ g1 + w2 @ (g2 + g3) + w4 @ g4
    return _simpson(y, dt, f1, f2, f3, f4), m_next, aux
