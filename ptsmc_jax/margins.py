"""Stability margins of a sampled loop at the plant's input, one axis opened at a time, the others closed.

From L(e^(i w h)) of `linear.at_input` between 0 and the Nyquist frequency: crossings are found on a graded grid, closed
in on, and end in a Newton step, through which they have their derivative. Gains and delays are those at which the loop
that flies comes to its border of stability, the delayed command held in between: no continuous stand-in.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from ptsmc_jax import linear
from ptsmc_jax.linear import Loop
from ptsmc_jax.rollout import Parts

Scalar = Float[Array, ""]

# name: (unit, what it is)
CATALOGUE = {
    "gain_margin": ("dB", "factor on the gain, up or down, to the border of stability"),
    "phase_margin": ("deg", "phase, either way, to the border of stability"),
    "delay_margin": ("s", "further delay to the border of stability"),
    "modulus_margin": ("dB", "largest sensitivity, 1 / the distance of L from -1"),
}
MOST = 120.0  # dB: no limit of the gain
LOWEST, POINTS = 1e-6, 400  # of the grid: share of the Nyquist frequency that it begins at, and its size
NEUTRAL = 1e-6  # by which a pole may lie outside the unit circle: rounding of those of stored momentum


class Margins(NamedTuple):
    """Of each axis, (m,) arrays; those of an unstable loop are negative, the distance to the border from beyond it."""

    gain_up: Array  # [dB]; infinite: stable with any gain
    gain_down: Array  # [dB]
    phase: Array  # [deg]
    delay: Array  # [s]
    modulus: Array  # [dB] peak of the sensitivity
    stable: Array  # bool, of the loop
    crossover: Array  # [rad/s] where the phase margin is

    @property
    def gain(self) -> Array:
        """The nearer of both [dB]."""
        return jnp.minimum(self.gain_up, self.gain_down)

    def worst(self) -> dict[str, Array]:
        """Each of `CATALOGUE`, the worst over all axes."""
        least = {"gain_margin": self.gain, "phase_margin": self.phase, "delay_margin": self.delay}
        return {**{k: jnp.min(v) for k, v in least.items()}, "modulus_margin": jnp.max(self.modulus)}


def grid(period: Scalar) -> Float[Array, " points"]:
    """Frequencies [rad/s], graded toward 0 and toward the Nyquist frequency."""
    low = np.geomspace(LOWEST, 0.5, POINTS // 2, endpoint=False)
    high = 1.0 - np.append(0.5 * np.geomspace(1.0, 1e-4, POINTS // 4), 0.0)
    middle = np.linspace(0.05, 0.95, POINTS // 4)
    return jnp.asarray(np.unique(np.concatenate([low, middle, high]))) * jnp.pi / period


def one_axis(response: Complex[Array, "m m"], axis: Any) -> Complex[Array, ""]:
    """L of one axis with the others closed: 1 + L is det(I + L) over that of the others, a Schur complement."""
    m = response.shape[0]
    others = jnp.arange(m) != axis
    back = jnp.where(others[:, None] & others[None, :], response, 0.0) + jnp.eye(m)
    column, row = jnp.where(others, response[:, axis], 0.0), jnp.where(others, response[axis], 0.0)
    return response[axis, axis] - row @ jnp.linalg.solve(back, column)


@partial(jax.jit, static_argnames="sensors")
def of_each(loops: Loop, sensors: bool = False) -> Margins:
    """Margins of several loops, arrays over them first; sensors: opened there, and not at the plant's input."""
    return jax.lax.map(partial(of, sensors=sensors), loops)


def of(loop: Loop, sensors: bool = False) -> Margins:
    """Margins of each axis of an opened loop; at the sensors of each coordinate that they see, not of delay."""
    respond = linear.at_sensors if sensors else linear.at_input
    w, channels = grid(loop.period), loop.seen.shape[1] if sensors else loop.command.shape[0]
    responses = jax.vmap(partial(respond, loop))(w)
    stable = jnp.max(jnp.abs(jax.lax.stop_gradient(_poles(loop)))) < 1.0 + NEUTRAL

    def one(axis: Array) -> Margins:
        return _axis(loop, respond, w, jax.vmap(lambda L: one_axis(L, axis))(responses), stable, axis)

    return jax.lax.map(one, jnp.arange(channels))


def _poles(loop: Loop) -> Array:
    a, command = loop.closed_at_sensors()
    (m, n), late = command.shape, loop.delay
    if not late:
        return jnp.linalg.eigvals(a + loop.new[0] @ command)
    shift = jnp.eye(late * m, k=-m)
    pushed = jnp.zeros((n, late * m)).at[:, -m:].set(loop.new[0])
    sent = jnp.zeros((late * m, n)).at[:m].set(command)
    return jnp.linalg.eigvals(jnp.block([[a, pushed], [sent, shift]]))


def _axis(loop: Loop, respond: Callable, w: Array, seen: Array, stable: Array, axis: Array) -> Margins:
    """Margins of one axis, whose L at frequencies w is `seen`."""

    def at(w: Scalar) -> tuple[Array, Array]:
        """L and its derivative by w."""
        return jax.jvp(lambda w: one_axis(respond(loop, w), axis), (w,), (jnp.ones_like(w),))

    begin, which, signs = jax.lax.stop_gradient(_brackets(w, seen))
    at_each = jax.vmap(at)

    def off(L: Array, slope: Array) -> tuple[Array, Array]:
        """What is zero at each crossing, and its slope by w: Im L twice, ln |L|."""
        return jnp.stack([L.imag[0], L.imag[1], jnp.log(jnp.abs(L[2]))]), jnp.stack(
            [slope.imag[0], slope.imag[1], (slope[2] / L[2]).real]
        )

    def closer(_: Any, ends: tuple[Array, Array, Array, Array]) -> tuple[Array, Array, Array, Array]:
        """Illinois' regula falsi (Dowell and Jarratt, BIT 11, 1971), for all at once."""
        a, b, f_a, f_b = ends
        c = b - f_b * (b - a) / jnp.where(f_b == f_a, 1.0, f_b - f_a)
        L, slope = at_each(c)
        f_c = jnp.append(off(L, slope)[0], (jnp.conj(1.0 + L[3]) * slope[3]).real)
        crossed = f_c * f_b < 0.0
        return jnp.where(crossed, b, a), c, jnp.where(crossed, f_b, f_a / 2), f_c

    _, root, _, _ = jax.lax.stop_gradient(jax.lax.fori_loop(0, 14, closer, begin))
    root = jnp.where(jnp.isfinite(root), root, begin[1])
    L, slope = at_each(jax.lax.stop_gradient(jnp.where(which, root, signs)))
    left, fall = off(L, slope)
    # one step of Newton's, with slopes that stay: through it the crossing has its derivative
    step = left / jax.lax.stop_gradient(jnp.where(fall == 0.0, 1.0, fall))
    crossing = L[:3] - jax.lax.stop_gradient(slope[:3]) * step
    factors = [_factor(crossing[k].real, which[k], seen, side) for k, side in ((0, 1.0), (1, -1.0))]
    up, down = factors
    nearest, sign = jnp.minimum(up, down), jnp.where(stable, 1.0, -1.0)
    phase = jnp.where(which[2], jnp.rad2deg(jnp.abs(jnp.angle(-crossing[2]))), 180.0)
    delay = _delay(loop, w, seen, axis) if respond is linear.at_input else jnp.nan
    return Margins(
        gain_up=jnp.where(stable, up, -nearest),
        gain_down=jnp.where(stable, down, -nearest),
        phase=sign * phase,
        delay=jnp.where(stable, delay, 0.0),
        modulus=-20.0 / jnp.log(10.0) * jnp.log(jnp.abs(1.0 + L[3])),  # its slope by w is none: no step to take
        stable=stable,
        crossover=jnp.where(which[2], root[2], jnp.nan),
    )


def _brackets(w: Array, seen: Array) -> tuple[tuple[Array, Array, Array, Array], Array, Array]:
    """Between which points L is real at the nearest gain up and down, has the size 1, and is nearest to -1.

    (low, high) and what is zero there at both; which of the four are there, and where to look if they are not.
    """
    real, imag, size = seen.real, seen.imag, jnp.log(jnp.abs(seen))
    share = imag[:-1] / jnp.where(imag[:-1] == imag[1:], 1.0, imag[:-1] - imag[1:])
    crossing = real[:-1] + share * (real[1:] - real[:-1])
    there = (imag[:-1] * imag[1:] < 0.0) & (crossing < 0.0)
    factor = -jnp.log(jnp.where(there, -crossing, 1.0))
    far = [jnp.where(there & (side * factor > 0.0), side * factor, jnp.inf) for side in (1.0, -1.0)]
    even, left = _crossings(seen)
    far.append(jnp.where(even, jnp.abs(left), jnp.inf))
    j = jnp.stack([jnp.argmin(v) for v in far])
    near = jnp.abs(1.0 + seen) ** 2
    k = jnp.argmin(near)
    inside = (k > 0) & (k < near.size - 1)
    m = jnp.clip(k, 1, near.size - 2)
    low, high = jnp.append(w[j], w[m - 1]), jnp.append(w[j + 1], w[m + 1])
    values = [jnp.stack([imag[j[0] + e], imag[j[1] + e], size[j[2] + e]]) for e in (0, 1)]
    slopes = [(near[m] - near[m - 1]) / (w[m] - w[m - 1]), (near[m + 1] - near[m]) / (w[m + 1] - w[m])]
    f_low, f_high = (jnp.append(v, s / 2) for v, s in zip(values, slopes, strict=True))
    found = jnp.append(jnp.stack([jnp.isfinite(v[at]) for v, at in zip(far, j, strict=True)]), inside)
    return (low, high, f_low, f_high), found, jnp.append(w[j], w[k])


def _factor(real: Array, found: Array, seen: Array, side: float) -> Array:
    """Factor on the gain [dB], up or down, at which 1 + k L = 0: where L is real, or a pole lies at 1 or -1."""
    known = found & (real < 0.0)
    best = jnp.where(known, -side * 20.0 * jnp.log10(jnp.where(known, -real, 1.0)), MOST)
    for end in (seen[0], seen[-1]):
        there = (end.real < 0.0) & (jnp.abs(end.imag) < 1e-2 * jnp.abs(end.real))
        size = -side * 20.0 * jnp.log10(jnp.where(there, -end.real, 1.0))
        best = jnp.where(there & (size > 0.0), jnp.minimum(best, size), best)
    return jnp.where(best >= MOST, jnp.inf, best)


def _crossings(seen: Array) -> tuple[Array, Array]:
    """Between which points |L| is 1, bool, and the phase to -1 there (-pi, pi]."""
    size = jnp.log(jnp.abs(seen))
    share = size[:-1] / jnp.where(size[:-1] == size[1:], 1.0, size[:-1] - size[1:])
    turned = jnp.angle(seen[1:] / seen[:-1])
    return size[:-1] * size[1:] < 0.0, jnp.angle(-seen[:-1] * jnp.exp(1j * share * turned))


def _delay(loop: Loop, w: Array, seen: Array, axis: Array) -> Scalar:
    """Further delay [s] at which the loop comes to its border, the axis's command late by it."""
    there, left = _crossings(seen)
    positive = jnp.where(left < 0.0, left + 2.0 * jnp.pi, left)
    sizes = jnp.where(there, positive / w[1:], jnp.inf)
    j = jnp.argmin(sizes)
    known = jnp.isfinite(sizes[j])
    start = jnp.stack([jnp.log(w[j + 1]), sizes[j] / loop.period])

    def off(at: Array) -> Array:  # ln(-L), w and the delay in periods
        value = -one_axis(linear.at_input(loop, jnp.exp(at[0]), jnp.maximum(at[1], 0.0), axis), axis)
        return jnp.stack([jnp.log(jnp.abs(value)), jnp.angle(value)])

    def newton(_: Any, x: Array) -> Array:
        step = jnp.linalg.solve(jax.lax.stop_gradient(jax.jacfwd(off)(x)), off(x))
        return x - jnp.clip(step, -0.5 - 0.1 * jnp.abs(x), 0.5 + 0.1 * jnp.abs(x))

    start = jax.lax.stop_gradient(jnp.where(known, start, 1.0))
    root = jax.lax.stop_gradient(jax.lax.fori_loop(0, 12, newton, start))
    return jnp.where(known, newton(0, root)[1] * loop.period, jnp.inf)


class Course(NamedTuple):
    """Margins along a nominal run."""

    t: np.ndarray  # (times,) [s], the last in hold, those before it before the hand-over
    loops: Loop  # arrays over the times first
    at_input: Margins  # (times, m)
    at_sensors: Margins  # (k,) in hold
    together: dict[str, float]  # the same of all axes of the input at once, in hold

    @property
    def hold(self) -> Loop:
        """The loop in hold."""
        return jax.tree.map(lambda v: v[-1], self.loops)


def along(parts: Parts, times: int = 24) -> Course:
    """Margins of sampled parts along their nominal run: in hold, and at so many times before the hand-over."""
    run = linear.nominal_jit(parts)
    t = np.asarray(run.listed[0].t)
    before, last = linear.whole_periods(parts, run, hold=False), _in_hold(parts, run)
    left = float(parts.controller.t_f) - t[before]
    wanted = np.geomspace(left[-1], left[0], times)
    chosen = np.unique([before[np.argmin(np.abs(left - tau))] for tau in wanted])
    indices = np.append(chosen, last)
    loops = _several(parts, run, indices)
    found = jax.tree.map(np.asarray, of_each(loops))
    last = jax.tree.map(lambda v: v[-1:], loops)
    seen = jax.tree.map(lambda v: np.asarray(v)[0], of_each(last, sensors=True))
    return Course(t[indices], loops, found, seen, together(jax.tree.map(lambda v: v[0], last)))


def _in_hold(parts: Parts, run: linear.Nominal) -> int:
    """The last whole period in hold; of an unstable loop the last at whose start it is no farther off than at first."""
    after = linear.whole_periods(parts, run, hold=True)
    x, t = jax.tree.map(lambda v: v[after], (run.carry.x, run.listed[0].t))
    off = jax.vmap(lambda x, t: parts.controller.errors(x, parts.reference(t))[0])(x, t)
    size = np.linalg.norm(np.asarray(off), axis=1)
    near = np.flatnonzero(size <= 2.0 * size[0])
    return int(after[near[-1] if near.size else 0])


def _several(parts: Parts, run: linear.Nominal, indices: Any) -> Loop:
    """The loops of these periods, arrays over them first."""
    every = linear.opened_all(parts, run).loop
    each = [linear.mean(parts, every, index) for index in indices]
    return jax.tree.map(lambda *v: jnp.stack(v), *each)


def at_ends(parts: Parts) -> dict[str, tuple[Margins, float]]:
    """Margins at the last whole period before the "hand_over" and in "hold", and the largest modulus of the poles."""
    run = linear.nominal_jit(parts)
    indices = [linear.whole_periods(parts, run, hold=False)[-1], _in_hold(parts, run)]
    loops = _several(parts, run, indices)
    found = jax.tree.map(np.asarray, of_each(loops))
    each = [jax.tree.map(lambda v, k=k: v[k], (found, loops)) for k in range(2)]
    return {name: (one, linear.radius(loop)) for name, (one, loop) in zip(("hand_over", "hold"), each, strict=True)}


def together(loop: Loop) -> dict[str, float]:
    """Margins with the same gain, phase or delay at all axes at once, by poles; the modulus by singular values.

    [dB], [deg], [s]: infinite beyond 80 dB and 200 periods, `nan` where the loop itself is unstable.
    """
    names = ("gain_up", "gain_down", "phase", "delay", "modulus")
    if linear.radius(loop) >= 1.0 + NEUTRAL:
        return dict.fromkeys(names, float("nan"))
    h = float(loop.period)
    w = grid(loop.period)
    m = loop.command.shape[0]
    responses = np.asarray(_responses(loop, w))
    least = np.linalg.svd(np.eye(m) + responses, compute_uv=False)[:, -1].min()

    def first(unstable: Callable[[float], bool], values: np.ndarray) -> float:
        """The least of these values, closed in on, at which it is unstable."""
        low = 0.0
        for high in values:
            if unstable(high):
                for _ in range(40):
                    middle = 0.5 * (low + high)
                    low, high = (low, middle) if unstable(middle) else (middle, high)
                return float(high)
            low = high
        return float("inf")

    def unstable(gain: Any = 1.0, late: float = 0.0) -> bool:
        return linear.radius(loop, gain, late) >= 1.0 + NEUTRAL

    decibels, degrees = np.arange(1.0, 81.0), np.arange(2.0, 181.0, 2.0)
    found = (
        first(lambda dB: unstable(10.0 ** (dB / 20.0)), decibels),
        first(lambda dB: unstable(10.0 ** (-dB / 20.0)), decibels),
        first(lambda angle: unstable(np.exp(-1j * np.deg2rad(angle))), degrees),
        first(
            lambda late: unstable(late=late),
            np.unique(np.append(np.linspace(0.0, 10.0, 41)[1:], np.geomspace(10, 200, 40))),
        )
        * h,
        float(-20.0 * np.log10(least)),
    )
    return dict(zip(names, found, strict=True))


@jax.jit
def _responses(loop: Loop, w: Array) -> Array:
    return jax.vmap(partial(linear.at_input, loop))(w)


def responses(loop: Loop) -> tuple[np.ndarray, np.ndarray]:
    """Frequencies (points,) [rad/s] and L of each axis (points, m), the others closed."""
    w = grid(loop.period)
    m = loop.command.shape[0]
    seen = _responses(loop, w)
    each = [jax.vmap(lambda L, k=k: one_axis(L, k))(seen) for k in range(m)]
    return np.asarray(w), np.stack([np.asarray(v) for v in each], axis=1)
