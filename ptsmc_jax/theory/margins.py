"""Stability margins of a sampled loop at the plant's input, one axis opened at a time, the others closed.

From L(e^(i w h)) of `linear.at_input` between 0 and the Nyquist frequency: crossings are found on a grid that is fine
around every pole, closed in on, and end in a Newton step, through which they have their derivative. Gains and delays
are those at which the loop that flies comes to its border of stability, the delayed command held in between: no
continuous stand-in.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from ptsmc_jax import programs
from ptsmc_jax.simulation.assembly import Parts
from ptsmc_jax.theory import linear
from ptsmc_jax.theory.linear import Loop, Opening

Scalar = Float[Array, ""]

MOST = 100.0  # dB: no limit of the gain; of the sensitivity, that of an unstable loop
LOWEST, POINTS = 1e-6, 240  # of the grid: share of the Nyquist frequency that it begins at, and its size without poles
AROUND = np.array([-3.0, -1.0, -0.3, 0.3, 1.0, 3.0])  # of a pole, in times its damping
NEAREST = 3  # crossings of a kind that are closed in on
NEUTRAL = 1e-6  # by which a pole may lie outside the unit circle: rounding of those of stored momentum
SLOWEST = 10  # periods to go: from one to the next the gains before the hand-over change by a tenth
TIMES, SHARE = 4, 0.25  # to go at which margins are judged, and the longest as a share of t_f


class Margins(NamedTuple):
    """Of each axis, (m,) arrays; those of an unstable loop are negative, the distance to the border from beyond it."""

    gain_up: Array  # [dB]; infinite: stable with any gain
    gain_down: Array  # [dB]
    phase: Array  # [deg]
    delay: Array  # [s]
    modulus: Array  # [dB] peak of the sensitivity
    stable: Array  # bool, of the loop
    crossover: Array  # [rad/s] where the phase margin is

    def worst(self) -> dict[str, Array]:
        """Each of `catalogues.MARGINS`, the worst over all axes and loops."""
        return {name: (jnp.max if name == "modulus_margin" else jnp.min)(v) for name, v in self.each().items()}

    def each(self) -> dict[str, Array]:
        """Each of `catalogues.MARGINS` by axis: the nearer of both gains, of an unstable loop's sensitivity `MOST`."""
        return {
            "gain_margin": jnp.minimum(self.gain_up, self.gain_down),
            "phase_margin": self.phase,
            "delay_margin": self.delay,
            "modulus_margin": jnp.where(self.stable, self.modulus, MOST),
        }


FIELDS = Margins._fields[:5]  # that are margins


def grid(loop: Loop, opening: Opening) -> Float[Array, " points"]:
    """Frequencies [rad/s], graded toward 0 and toward the Nyquist frequency, and around every pole.

    Of the closed loop, at which the sensitivity may have a peak, and of those with one axis open, at which its L may.
    """
    low = np.geomspace(LOWEST, 0.5, POINTS // 2, endpoint=False)
    high = 1.0 - np.append(0.5 * np.geomspace(1.0, 1e-4, POINTS // 4), 0.0)
    base = np.unique(np.concatenate([low, np.linspace(0.05, 0.95, POINTS // 4), high]))
    m = opening.c.shape[0]
    closed = np.append(np.ones((1, m)), 1.0 - np.eye(m), axis=0)  # all of them, and all but one
    poles = jax.lax.map(lambda on: jnp.linalg.eigvals(opening.closed(jnp.diag(on))), jnp.asarray(closed))
    upper = jnp.argsort(-poles.imag, axis=1)[:, : (poles.shape[1] + 1) // 2]  # of pairs one; real ones need no more
    poles = jnp.take_along_axis(poles, upper, axis=1).reshape(-1)
    damping = jnp.clip(jnp.abs(jnp.log(jnp.maximum(jnp.abs(poles), 1e-12))) / jnp.pi, LOWEST, 1.0)
    near = jnp.abs(jnp.angle(poles))[None] / jnp.pi + AROUND[:, None] * damping[None]
    both = jnp.append(jnp.asarray(base), jnp.clip(jnp.nan_to_num(near), LOWEST, 1.0))
    return jnp.sort(both) * jnp.pi / loop.period


def one_axis(response: Complex[Array, "m m"], axis: Any) -> Complex[Array, ""]:
    """L of one axis with the others closed: 1 + L is det(I + L) over that of the others, a Schur complement."""
    m = response.shape[0]
    others = jnp.arange(m) != axis
    back = jnp.where(others[:, None] & others[None, :], response, 0.0) + jnp.eye(m)
    column, row = jnp.where(others, response[:, axis], 0.0), jnp.where(others, response[axis], 0.0)
    return response[axis, axis] - row @ jnp.linalg.solve(back, column)


@programs.jit(static_argnames="sensors")
def of_each(loops: Loop, sensors: bool = False) -> Margins:
    """Margins of several loops, arrays over them first; sensors: opened there, and not at the plant's input."""
    return jax.lax.map(partial(of, sensors=sensors), loops)


def of(loop: Loop, sensors: bool = False) -> Margins:
    """Margins of each axis of an opened loop; at the sensors of each coordinate that they see, not of delay.

    NaN where the loop has a number that is not finite.
    """
    finite = jnp.all(jnp.stack([jnp.all(jnp.isfinite(v)) for v in jax.tree.leaves(loop)]))
    loop = jax.tree.map(lambda v: jnp.where(finite, v, jnp.ones_like(v)), loop)
    opening = linear.at_sensors(loop) if sensors else linear.at_input(loop)
    fixed, h = jax.lax.stop_gradient((opening, loop.period))
    w, quick = jax.lax.stop_gradient((grid(loop, fixed), fixed.in_triangles()))
    responses = jax.vmap(lambda w: quick.response(jnp.exp(1j * w * h), triangular=True))(w)
    stable = finite & (jnp.max(jnp.abs(jnp.linalg.eigvals(fixed.closed()))) < 1.0 + NEUTRAL)

    def one(axis: Array) -> Margins:
        seen = jax.vmap(lambda L: one_axis(L, axis))(responses)

        def at(opening: Opening, w: Scalar, *, triangular: bool = False) -> tuple[Array, Array]:
            """L and its derivative by w."""
            z = jnp.exp(1j * w * h)
            by = 1j * h * z
            return jax.jvp(lambda z: one_axis(opening.response(z, triangular=triangular), axis), (z,), (by,))

        found = _axis(jax.vmap(partial(at, opening)), jax.vmap(partial(at, quick, triangular=True)), w, seen, stable)
        delay = jnp.nan if sensors else _delay(loop, w, seen, axis)
        found = found._replace(delay=jnp.where(stable, delay, 0.0))
        return jax.tree.map(lambda v: v if v.dtype == bool else jnp.where(finite, v, jnp.nan), found)

    return jax.lax.map(one, jnp.arange(opening.c.shape[0]))


def _axis(at: Callable, quick: Callable, w: Array, seen: Array, stable: Array) -> Margins:
    """Margins of one axis, whose L at frequencies w is `seen`; at, quick: L and its slope, with its gradient or not."""
    begin, there, elsewhere = jax.lax.stop_gradient(_brackets(w, seen))

    def crossed(L: Array) -> Array:
        """What is zero at crossings: of the real axis, of the size 1."""
        return jnp.append(L[: _SPLIT[0]].imag, jnp.log(jnp.abs(L[_SPLIT[0] : _SPLIT[1]])))

    def closer(_: Any, ends: tuple[Array, Array, Array, Array]) -> tuple[Array, Array, Array, Array]:
        """Illinois' regula falsi (Dowell and Jarratt, BIT 11, 1971), for all at once."""
        a, b, f_a, f_b = ends
        c = b - f_b * (b - a) / jnp.where(f_b == f_a, 1.0, f_b - f_a)
        c = jnp.clip(c, jnp.minimum(a, b), jnp.maximum(a, b))
        L, slope = quick(c)
        f_c = jnp.append(crossed(L), (jnp.conj(1.0 + L) * slope).real[_SPLIT[1] :])
        between = f_c * f_b < 0.0
        return jnp.where(between, b, a), c, jnp.where(between, f_b, f_a / 2), f_c

    _, root, _, _ = jax.lax.stop_gradient(jax.lax.fori_loop(0, 10, closer, begin))
    root = jnp.where(jnp.isfinite(root), root, begin[1])
    L, slope = at(jnp.append(root, elsewhere))
    crosses = _SPLIT[1]
    slope = slope[:crosses]
    fall = jnp.append(slope[: _SPLIT[0]].imag, (slope / L[:crosses]).real[_SPLIT[0] :])
    # one step of Newton's, with slopes that stay: through it the crossing has its derivative
    rate = jax.lax.stop_gradient(slope / jnp.where(fall == 0.0, 1.0, fall))
    real, even = jnp.split(L[:crosses] - rate * crossed(L), _SPLIT[:1])
    ends = L[-2:]  # where a pole comes to 1, and to -1
    on = jnp.append(there[: real.size], jnp.abs(ends.imag) < 1e-2 * jnp.abs(ends.real))
    real = jnp.append(real.real, ends.real)
    factor = -20.0 * jnp.log10(jnp.where(on & (real < 0.0), -real, 1.0))
    up, down = (jnp.min(jnp.where(side * factor > 0.0, side * factor, MOST)) for side in (1.0, -1.0))
    angles = jnp.where(there[real.size - 2 : crosses], jnp.rad2deg(jnp.abs(jnp.angle(-even))), 180.0)
    nearest, worst = jnp.minimum(up, down), jnp.argmin(angles)
    return Margins(
        gain_up=jnp.where(stable, jnp.where(up < MOST, up, jnp.inf), -nearest),
        gain_down=jnp.where(stable, jnp.where(down < MOST, down, jnp.inf), -nearest),
        phase=jnp.where(stable, 1.0, -1.0) * jnp.min(angles),
        delay=jnp.zeros_like(up),
        modulus=-20.0 * jnp.log10(jnp.min(jnp.abs(1.0 + L[crosses:]))),  # its slope by w is none: no step to take
        stable=stable,
        crossover=jnp.where(there[real.size - 2 + worst], root[real.size - 2 + worst], jnp.nan),
    )


_SPLIT = (2 * NEAREST, 3 * NEAREST)  # of the places looked for: L real, |L| = 1, L nearest to -1


def _brackets(w: Array, seen: Array) -> tuple[tuple[Array, Array, Array, Array], Array, Array]:
    """Between which points L is real and may be -1 with more gain, or with less, has the size 1, is nearest to -1.

    `NEAREST` each: (low, high) and what is zero there at both; which of them are there; frequencies to look at besides.
    """
    real, imag, size = seen.real, seen.imag, jnp.log(jnp.abs(seen))
    share = imag[:-1] / jnp.where(imag[:-1] == imag[1:], 1.0, imag[:-1] - imag[1:])
    crossing = real[:-1] + share * (real[1:] - real[:-1])
    there = (imag[:-1] * imag[1:] < 0.0) & (crossing < 0.0)
    factor = -jnp.log(jnp.where(there, -crossing, 1.0))
    # one that lies a little to the other side may turn out to lie on this one
    far = [jnp.where(there & (side * factor > -0.1), side * factor, jnp.inf) for side in (1.0, -1.0)]
    even, left = _crossings(seen)
    far.append(jnp.where(even, jnp.abs(left), jnp.inf))
    near = jnp.abs(1.0 + seen) ** 2
    least = jnp.append(jnp.inf, jnp.where((near[1:-1] <= near[:-2]) & (near[1:-1] <= near[2:]), near[1:-1], jnp.inf))
    values, places = zip(*(jax.lax.top_k(-v, NEAREST) for v in (*far, least)), strict=True)
    j, k = jnp.concatenate(places[:3]), jnp.maximum(places[3], 1)
    slope = (near[1:] - near[:-1]) / jnp.where(w[1:] == w[:-1], 1.0, w[1:] - w[:-1]) / 2
    zero = [jnp.append(imag[j + e][: _SPLIT[0]], size[j + e][_SPLIT[0] :]) for e in (0, 1)]
    begin = jnp.append(w[j], w[k - 1]), jnp.append(w[j + 1], w[k + 1])
    off = jnp.append(zero[0], slope[k - 1]), jnp.append(zero[1], slope[k])
    return (*begin, *off), jnp.isfinite(jnp.concatenate(values)), w[jnp.stack([jnp.argmin(near), 0, -1])]


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
        z = jnp.exp(1j * jnp.exp(at[0]) * loop.period)
        value = -one_axis(linear.one_late(loop, z, jnp.maximum(at[1], 0.0), axis), axis)
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
    judged: np.ndarray  # (times,) bool: where the frozen loop means something, see `judged_times`
    loops: Loop  # arrays over the times first
    at_input: Margins  # (times, m)
    at_sensors: Margins  # (k,) in hold
    together: dict[str, float]  # the same of all axes of the input at once, in hold

    @property
    def hold(self) -> tuple[Loop, Margins]:
        """The loop in hold, and its margins (m,)."""
        return jax.tree.map(lambda v: v[-1], (self.loops, self.at_input))

    @property
    def before(self) -> Margins:
        """(times, m) before the hand-over."""
        return jax.tree.map(lambda v: v[:-1], self.at_input)

    def worst(self) -> dict[str, float]:
        """`catalogues.MARGINS`, the worst over the axes, in hold and where it is judged before the hand-over."""
        kept = jax.tree.map(lambda v: v[self.judged], self.at_input)
        return {name: float(v) for name, v in kept.worst().items()}


def judged_times(parts: Parts) -> Float[Array, " times"]:
    """Times to go [s] at which frozen gains mean something, the shortest first, evenly spaced by their logarithms.

    From the hand-over, where gains are largest, but no nearer than where they change by a tenth from one sample to the
    next; to where the loop takes as long to settle as it has left. They move with t_f and delta, and with them slopes.
    """
    law = parts.controller
    shortest = jnp.maximum(law.delta, SLOWEST * parts.clock.period)  # pyright: ignore[reportAttributeAccessIssue]
    longest = jnp.maximum(SHARE * law.t_f, shortest)
    return shortest * (longest / shortest) ** (jnp.arange(TIMES) / (TIMES - 1))


def moments(parts: Parts, run: linear.Nominal, times: Array) -> Array:
    """Numbers of the whole control periods nearest to so long before t_f [s], and then of one in hold.

    Before the hand-over, or in hold where there is none. In hold: the last; of an unstable loop the last at whose start
    it is no farther off than at the hand-over.
    """
    ticks, law = run.period.now, parts.controller
    whole = ticks.t_next - ticks.t > (1.0 - 1e-6) * parts.clock.period  # pyright: ignore[reportAttributeAccessIssue]
    off = jax.vmap(lambda x, t: law.errors(x, parts.reference(t))[0])(run.carry.x, ticks.t)
    size, hold = jnp.linalg.norm(off, axis=1), whole & ticks.hold
    first = jnp.argmax(hold)
    near = hold & (size <= 2.0 * size[first])
    last = jnp.maximum(jnp.max(jnp.where(near, jnp.arange(hold.size), -1)), first)
    before = whole & ~ticks.hold
    left = jnp.where(before, law.t_f - ticks.t, jnp.inf)
    nearest = jnp.argmin(jnp.abs(left[None] - times[:, None]), axis=1)
    return jnp.append(jnp.where(jnp.any(before), nearest, last), last)


_moments = programs.jit(moments)


class Found(NamedTuple):
    """Margins at times of a nominal run, the last of them in hold."""

    t: np.ndarray  # (times,) [s]
    hold: np.ndarray  # (times,) bool: in hold
    loops: Loop  # arrays over the times first
    margins: Margins  # (times, m)


def at(parts: Parts, left: Float[Array, " times"], known: linear.Nominal | None = None) -> Found:
    """Margins of sampled parts at these times to go [s], (times,), and in hold."""
    run: linear.Nominal = linear.nominal_jit(parts) if known is None else known
    indices = np.asarray(_moments(parts, run, left))
    loops = linear.loops_in(parts, run, indices)
    ticks = jax.tree.map(lambda v: np.asarray(v)[indices], run.period.now)
    return Found(ticks.t, ticks.hold, loops, jax.tree.map(np.asarray, of_each(loops)))


def judged(parts: Parts) -> tuple[Margins, Array]:
    """Margins where they are judged and in hold, (times + 1, m), and which are in hold; for any transformation."""
    run = linear.nominal(parts)
    indices = moments(parts, run, judged_times(parts))
    return of_each(linear.loops_at(parts, run, indices)), run.period.now.hold[indices]


judged_jit = programs.jit(judged, compiler_options=programs.QUICKLY)


def along(parts: Parts, times: int = 24) -> Course:
    """Margins of sampled parts along their nominal run: in hold, where judged, and at about so many times besides."""
    kept, law = judged_times(parts), parts.controller
    period = float(parts.clock.period)  # pyright: ignore[reportAttributeAccessIssue]
    found = at(parts, jnp.append(kept, jnp.geomspace(period, float(law.t_f), times)))
    known = {t: k for k, t in reversed(list(enumerate(found.t.tolist()))) if not found.hold[k]}
    order = np.asarray([k for _, k in sorted(known.items())] + [len(found.t) - 1])
    t, _, loops, margins = jax.tree.map(lambda v: v[order], found)
    count = (order < kept.size) | (order == order[-1])
    last = jax.tree.map(lambda v: v[-1:], loops)
    seen = jax.tree.map(lambda v: np.asarray(v)[0], of_each(last, sensors=True))
    return Course(t, count, loops, margins, seen, together(jax.tree.map(lambda v: v[0], last)))


def at_ends(parts: Parts) -> dict[str, tuple[Margins, float]]:
    """Margins at the last whole period before the "hand_over" and in "hold", and the largest modulus of the poles.

    Without a whole period before the hand-over those in hold are both.
    """
    run = linear.nominal_jit(parts)
    before = linear.whole_periods(parts, run, hold=False)[-1:]
    left = float(parts.controller.t_f) - np.asarray(run.period.now.t)[before]
    found = at(parts, jnp.asarray(left), run)
    ends = {"hand_over": 0, "hold": -1}
    each = {name: jax.tree.map(lambda v, k=k: v[k], (found.margins, found.loops)) for name, k in ends.items()}
    return {name: (margins, linear.radius(loop)) for name, (margins, loop) in each.items()}


def together(loop: Loop) -> dict[str, float]:
    """`FIELDS` with the same gain, phase or delay at all axes at once, by poles; the modulus by singular values.

    [dB], [deg], [s]: infinite beyond 80 dB and 200 periods, `nan` where the loop itself is unstable.
    """

    def unstable(gain: Any = 1.0, late: float = 0.0) -> bool:
        return not linear.radius(loop, gain, late) < 1.0 + NEUTRAL

    def first(lost: Callable[[float], bool], values: np.ndarray) -> float:
        """The least of these values, closed in on, at which it is unstable."""
        low = 0.0
        for high in values:
            if lost(high):
                for _ in range(40):
                    middle = 0.5 * (low + high)
                    low, high = (low, middle) if lost(middle) else (middle, high)
                return float(high)
            low = high
        return float("inf")

    if not all(np.isfinite(v).all() for v in jax.tree.leaves(loop)) or unstable():
        return dict.fromkeys(FIELDS, float("nan"))
    seen, _ = _responses(loop)[1:]
    least = np.linalg.svd(np.eye(seen.shape[1]) + np.asarray(seen), compute_uv=False)[:, -1].min()
    decibels, degrees = np.arange(1.0, 81.0), np.arange(2.0, 181.0, 2.0)
    periods = np.unique(np.append(np.linspace(0.0, 10.0, 41)[1:], np.geomspace(10, 200, 40)))
    found = (
        first(lambda dB: unstable(10.0 ** (dB / 20.0)), decibels),
        first(lambda dB: unstable(10.0 ** (-dB / 20.0)), decibels),
        first(lambda angle: unstable(np.exp(-1j * np.deg2rad(angle))), degrees),
        first(lambda late: unstable(late=late), periods) * float(loop.period),
        float(-20.0 * np.log10(least)),
    )
    return dict(zip(FIELDS, found, strict=True))


@programs.jit
def _responses(loop: Loop) -> tuple[Array, Array, Array]:
    """Frequencies, L (points, m, m) and that of each axis with the others closed (points, m)."""
    opening = linear.at_input(loop)
    w, quick = grid(loop, opening), opening.in_triangles()
    seen = jax.vmap(lambda w: quick.response(jnp.exp(1j * w * loop.period), triangular=True))(w)
    axes = jnp.arange(seen.shape[1])
    return w, seen, jax.vmap(lambda L: jnp.stack([one_axis(L, k) for k in range(axes.size)]))(seen)


def responses(loop: Loop) -> tuple[np.ndarray, np.ndarray]:
    """Frequencies (points,) [rad/s] and L of each axis (points, m), the others closed."""
    w, _, each = _responses(loop)
    return np.asarray(w), np.asarray(each)
