"""One step of an ordinary differential equation: the classical and the exponential Runge-Kutta method of order 4.

`rk4` integrates the plant. `etdrk4` integrates a plant together with a stiff linear observer, exactly in the linear
part. `phi_functions` are the matrix functions that `etdrk4` needs.
"""

from collections.abc import Callable
from functools import partial
from math import factorial
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ptsmc_jax.numerics.matrices import row_norm
from ptsmc_jax.numerics.pytrees import Scalar

State = TypeVar("State")  # a pytree of arrays


def rk4(rate: Callable[[Scalar, State], State], t: Scalar, y: State, dt: Scalar, *, rolled: bool = False) -> State:
    """Return the state at t + dt by one step of the classical Runge-Kutta method of order 4.

    Args:
        rate: (t, y) -> dy/dt, a pytree like y.
        t: time at the start [s].
        y: state at the start, a pytree.
        dt: length of the step [s].
        rolled: use a loop over the stages, so that a large `rate` is compiled once instead of four times.
    """
    if not rolled:
        k1 = rate(t, y)
        k2 = rate(t + dt / 2, _add_scaled(y, k1, dt / 2))
        k3 = rate(t + dt / 2, _add_scaled(y, k2, dt / 2))
        k4 = rate(t + dt, _add_scaled(y, k3, dt))
        return _simpson(y, dt, k1, k2, k3, k4)

    def stage(k: Array | int, previous_and_total: tuple[State, State]) -> tuple[State, State]:
        """Return the rate of stage k, and the weighted sum of the rates of the stages 0 to k."""
        previous, total = previous_and_total
        offset = dt * jnp.where(k == 0, 0.0, jnp.where(k == 3, 1.0, 0.5))
        weight = jnp.where((k == 0) | (k == 3), 1.0, 2.0)
        current = rate(t + offset, _add_scaled(y, previous, offset))
        return current, _add_scaled(total, current, weight)

    zeros = jax.tree.map(jnp.zeros_like, y)
    _, total = jax.lax.fori_loop(0, 4, stage, (zeros, zeros))
    return _add_scaled(y, total, dt / 6)


def _add_scaled(y: State, rate: State, step: Scalar) -> State:
    """Return the pytree y + step rate."""
    return jax.tree.map(lambda y, k: y + step * k, y, rate)


def _simpson(y: State, dt: Scalar, k1: State, k2: State, k3: State, k4: State) -> State:
    """Return the pytree y + dt (k1 + 2 k2 + 2 k3 + k4) / 6."""
    return jax.tree.map(lambda y, a, b, c, d: y + dt / 6 * (a + 2 * (b + c) + d), y, k1, k2, k3, k4)


def hermite_middle(start: Array, start_rate: Array, end: Array, end_rate: Array, dt: Scalar) -> Array:
    """Return the value of the cubic Hermite polynomial in the middle of a step.

    Args:
        start: value at the start.
        start_rate: its time derivative at the start [1/s].
        end: value at the end.
        end_rate: its time derivative at the end [1/s].
        dt: length of the step [s].

    Returns:
        The value, in the shape and unit of `start`.
    """
    return (start + end) / 2 + dt / 8 * (start_rate - end_rate)


_TERMS = 15  # terms of the Taylor series, whose remainder is below 2^-16 / 15! at a norm of at most 1/2
_DOUBLINGS = 40  # largest number of doublings, for norms up to 2^39
_USUAL_DOUBLINGS = 4  # doublings for norms up to 8; few matrices have a larger norm


@partial(jax.jit, static_argnames="order")
def phi_functions(x: Float[Array, "n n"], order: int, largest: Scalar | None = None) -> list[Float[Array, "n n"]]:
    """Return the phi functions of a matrix: phi_0(x) = e^x and phi_k(x) = (phi_(k-1)(x) - I/(k-1)!) / x.

    The method is scaling and doubling (Skaflestad and Wright, Applied Numerical Mathematics 59, 2009), with

        phi_k(2x) = 2^-k (phi_0 phi_k + sum_(j=1..k) phi_j / (k-j)!).

    It has no cancellation for small x and allows repeated eigenvalues. It does not call LAPACK, because batched LAPACK
    calls can deadlock (see `batching.lapack`).

    Args:
        x: matrix [-].
        order: the highest index k.
        largest: `row_norm` of the largest matrix of a batch. All matrices of the batch then use the same number of
            doublings. None: use the norm of x.

    Returns:
        [phi_0(x), .., phi_order(x)] [-].
    """
    identity = jnp.eye(x.shape[-1], dtype=x.dtype)
    size = jax.lax.stop_gradient(row_norm(x) if largest is None else largest)
    doublings = jnp.clip(jnp.ceil(jnp.log2(jnp.maximum(size, 0.5))) + 1.0, 0.0, _DOUBLINGS)
    small = x * 2.0**-doublings
    top = identity / float(factorial(order + _TERMS))
    # JAX compiles the body of a loop once; without the loop it would compile every term.
    terms = jnp.asarray([1.0 / factorial(order + k) for k in range(_TERMS - 1, -1, -1)], x.dtype)
    top, _ = jax.lax.scan(lambda top, term: (term * identity + small @ top, None), top, terms)
    phi = [top]
    for k in range(order - 1, -1, -1):
        phi.insert(0, identity / factorial(k) + small @ phi[0])

    def step(k: Array | int, phi: list[Array]) -> list[Array]:
        return jax.lax.cond(k < doublings, _double, lambda phi: phi, phi)

    # The loops have a fixed length, because reverse-mode differentiation requires it.
    phi = jax.lax.fori_loop(0, _USUAL_DOUBLINGS, step, phi)
    return jax.lax.cond(
        doublings > _USUAL_DOUBLINGS,
        lambda phi: jax.lax.fori_loop(_USUAL_DOUBLINGS, _DOUBLINGS, step, phi),
        lambda phi: phi,
        phi,
    )


def _double(phi: list[Array]) -> list[Array]:
    """Return all phi_k(2x) from all phi_k(x)."""
    return [
        (phi[0] @ phi[k] + sum((phi[j] / factorial(k - j) for j in range(1, k + 1)), 0.0 * phi[0])) / 2**k
        for k in range(len(phi))
    ]


class Decay(NamedTuple):
    """Coefficients of `etdrk4` for m' = -A m + g and a step dt: matrices (n, n)."""

    half: Array  # e^(-A dt/2) [-]
    full: Array  # e^(-A dt) [-]
    stage: Array  # dt/2 phi_1(-A dt/2) [s]
    ends: tuple[Array, Array, Array]  # weights of g at the start, of each of two g at the middle, and at the end [s]


def decay(a: Float[Array, "n n"], dt: Scalar, largest: Scalar | None = None) -> Decay:
    """Return the coefficients of `etdrk4` (Cox and Matthews, J. Comput. Phys. 176, 2002, eqs. (26)-(29)).

    Args:
        a: matrix A of the linear part m' = -A m + g [1/s].
        dt: length of the step [s].
        largest: largest `row_norm` of A dt in a batch of steps, which then all use the same number of doublings, see
            `phi_functions`. None: use the norm of this A dt.
    """
    halves = phi_functions(-a * dt / 2, 3, None if largest is None else largest / 2)
    half, phi_half, *_ = halves
    full, p1, p2, p3 = _double(halves)
    ends = (dt * (p1 - 3 * p2 + 4 * p3), dt * 2 * (p2 - 2 * p3), dt * (4 * p3 - p2))
    return Decay(half, full, dt / 2 * phi_half, ends)


def etdrk4(rate: Callable, linear: Decay, t: Scalar, y: Any, m: Float[Array, " n"], dt: Scalar) -> tuple:
    """Return y and m after one step of order 4 of the system y' = f(t, y, m), m' = -A m + g(t, y, m).

    The linear part is integrated exactly. The step is stable for any A, and exact in m if g is constant. If A = 0, it
    equals `rk4`.

    Args:
        rate: (t, y, m) -> (f, g, aux).
        linear: coefficients for A and dt, see `decay`.
        t: time at the start [s].
        y: first part of the state at the start, a pytree.
        m: second part of the state at the start, (n,).
        dt: length of the step [s].

    Returns:
        (y, m, aux): the state at t + dt, and aux of the first stage, at t.
    """
    f1, g1, aux = rate(t, y, m)
    m2 = linear.half @ m + linear.stage @ g1
    f2, g2, _ = rate(t + dt / 2, _add_scaled(y, f1, dt / 2), m2)
    m3 = linear.half @ m + linear.stage @ g2
    f3, g3, _ = rate(t + dt / 2, _add_scaled(y, f2, dt / 2), m3)
    m4 = linear.half @ m2 + linear.stage @ (2 * g3 - g1)
    f4, g4, _ = rate(t + dt, _add_scaled(y, f3, dt), m4)
    w1, w2, w4 = linear.ends
    m_next = linear.full @ m + w1 @ g1 + w2 @ (g2 + g3) + w4 @ g4
    return _simpson(y, dt, f1, f2, f3, f4), m_next, aux
