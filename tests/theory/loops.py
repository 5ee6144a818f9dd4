"""Linear loops built from matrices, without a scenario, and helpers that evaluate their margins and poles."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from scipy import linalg

from ptsmc_jax import programs
from ptsmc_jax.theory import linear, margins

# a spacecraft with slow star tracker, attitude filter, delay, lag and wheels
ALL_AT_ONCE = {
    "controller": {"t_f": 10.0, "delta": 0.5},
    "loop": {"mode": "sampled", "period": 0.1, "t_end": 14.0},
    "hardware": {
        "attitude_noise": 2e-5, "rate_noise": 1e-6, "rate_bias": 1e-5, "rate_bias_walk": 1e-6,
        "star_tracker_every": 4, "delay": 1, "torque_lag": 0.1,
    },
    "filter": {"kind": "steady_state", "bandwidth": 1.0},
    "wheels": {"momentum": [1.0, -2.0, 0.5, 3.0]},
    "reference": {"kind": "spin", "rate": [0.0, 0.0, 0.0]},
}  # fmt: skip


# numbers of states, seen states and inputs of a chain's loop; smaller loops are padded to share its compiled programs
ROOM, LATE_ROOM = (8, 2, 2), (9, 2, 1)


def of(loop, **how):
    """Return the `Margins` of a loop, with one entry for each input or sensor.

    how: arguments of `margins.compute_each`. Small loops are padded so that one compiled program serves all of them.
    """
    sizes, room = (*loop.seen.shape, len(loop.command)), {0: ROOM, 1: LATE_ROOM}.get(loop.delay)
    if not how and room is not None and np.all(np.array(sizes) <= room):
        loop = larger(loop, *room)
        if loop.delay == 1:
            return jax.tree.map(np.asarray, with_gradients(loop, jax.tree.map(np.zeros_like, loop))[2])
    each = margins.compute_each(jax.tree.map(lambda v: np.asarray(v)[None], loop), **how)
    return jax.tree.map(lambda v: np.asarray(v)[0] if how else np.asarray(v)[0, : sizes[2]], each)


@programs.jit
def with_gradients(loop, way):
    """Return margins of the first input, their derivatives along a direction, and the `Margins` of all inputs.

    way: a loop, the direction. The margins of the first input are in the order of `margins.FIELDS`.
    """

    def margins_of(loop):
        found = margins.compute(loop)
        return jnp.stack([getattr(found, name)[0] for name in margins.FIELDS]), found

    return jax.jvp(margins_of, (loop,), (way,), has_aux=True)


def larger(loop, n, k, m):
    """Return the loop padded with zeros to n states, k sensors and m inputs, which have no effect."""
    sizes = {"a": (n, n), "seen": (n, k), "new": (n, m), "old": (n, m), "command": (m, n), "direct": (m, k),
             "disturbed": (n, m)}  # fmt: skip

    def pad_with_zeros(v, sizes):
        more = [(0, to - size) for to, size in zip(sizes, np.shape(v)[-2:], strict=True)]
        return np.pad(np.asarray(v), [(0, 0)] * (np.ndim(v) - 2) + more)

    all_of = replace(loop, **{name: pad_with_zeros(getattr(loop, name), to) for name, to in sizes.items()})
    return jax.tree.map(np.asarray, all_of)  # NumPy arrays, because weak types would compile another program


def a_loop(a, b, c):
    """Return the discrete loop x' = a x + b u, u = c x with one input, no sensor and a period of 1 s."""
    n, zero = len(a), jnp.zeros
    push = jnp.tile(jnp.reshape(jnp.asarray(b, float), (n, 1)), (linear.NODES.size, 1, 1))
    c = jnp.reshape(jnp.asarray(c, float), (1, n))
    period = jnp.ones(())
    return linear.Loop(a, zero((n, 1)), push, 0.0 * push, c, zero((1, 1)), zero((n, 1)), period, delay=0)


def held(a, b, c, h=1.0, sensors=False):
    """Return the sampled loop of dx/dt = a x + b u with u = c x held for h [s]; sensors: whether they see all of x."""
    n, m = b.shape
    both = np.vstack([np.hstack([a, b]), np.zeros((m, n + m))])
    spans = [[linalg.expm(both * share * h) for share in (part, 1.0 - part)] for part in linear.NODES]
    new = jnp.asarray([later[:n, n:] for _, later in spans])
    old = jnp.asarray([later[:n, :n] @ first[:n, n:] for first, later in spans])
    command, direct = (0.0 * c, c) if sensors else (c, np.zeros((m, 1)))
    values = (linalg.expm(a * h), np.zeros((n, direct.shape[1])), new, old, command, direct, np.zeros((n, m)), h)
    return linear.Loop(*map(jnp.asarray, values), delay=0)


INTEGRATORS = np.eye(3, k=1), np.eye(3)[:, 2:], -np.array([[0.027, 0.27, 0.9]])  # closed-loop poles at -0.3 1/s


def drawn_loop(seed):
    """Return a random loop: two damped oscillators or integrators, two inputs, perturbed linear-quadratic feedback."""
    rng = np.random.default_rng(seed)
    turns, damping, a = rng.uniform(0.3, 2.8, 2), 10 ** rng.uniform(-3.0, -0.5, 2), np.zeros((4, 4))
    for k, (w, share) in enumerate(zip(turns, damping, strict=True)):
        swings = rng.integers(3) > 0
        row = [-(w**2), -2.0 * share * w] if swings else [0.0, -0.2 * rng.random()]
        a[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = [[0.0, 1.0], row]
    b = rng.normal(size=(4, 2))
    moved = linalg.expm(np.vstack([np.hstack([a, b]), np.zeros((2, 6))]))
    a_1, b_1 = moved[:4, :4], moved[:4, 4:]
    dear = np.eye(2) * 10 ** rng.uniform(-0.5, 2.0)
    costs = linalg.solve_discrete_are(a_1, b_1, np.diag(10 ** rng.uniform(-2.0, 1.0, 4)), dear)
    gains = np.linalg.solve(dear + b_1.T @ costs @ b_1, b_1.T @ costs @ a_1)
    return held(2.0 * a, 2.0 * b, -gains * rng.uniform(0.6, 1.3), 0.5)


def radius_late(loop, axis, late):
    """Return the spectral radius of a loop without delay if input `axis` is delayed by `late` periods."""
    (a, command), whole = loop.closed_at_sensors(np), int(late)
    (m, n), pushes = command.shape, np.zeros((whole + 2, *command.T.shape))
    pushes[0] = loop.new[0] * (np.arange(m) != axis)
    for push, acts in zip(pushes[whole:], linear.command_effect(loop, late - whole, np), strict=True):
        push[:, axis] += acts[:, axis]
    closed = np.eye(n + (whole + 1) * m, k=-m)
    closed[:n], closed[n : n + m] = np.hstack([a + pushes[0] @ command, *pushes[1:]]), 0.0
    closed[n : n + m, :n] = command
    return np.abs(np.linalg.eigvals(closed)).max()
