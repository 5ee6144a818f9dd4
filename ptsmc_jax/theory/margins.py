"""Stability margins of a sampled loop at the plant's input, one axis opened at a time, the other axes closed.

The margins follow from L(e^(i w h)) of `linear.at_input` between 0 and the Nyquist frequency. Crossings are located on
a grid that is dense around every pole, refined, and completed by a differentiable Newton step. The margins are exact
for the sampled loop: at the gain or delay margin the simulated loop, with held commands, reaches its stability limit.
There is no continuous approximation. Read `Margins` and `compute` first.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ptsmc_jax import programs
from ptsmc_jax.numerics.pytrees import Scalar
from ptsmc_jax.theory import crossings, linear
from ptsmc_jax.theory.crossings import MOST, SPLIT, Brackets, SchurOpening
from ptsmc_jax.theory.linear import Loop, Opening

NEUTRAL = 1e-6  # Tolerance of the unit circle, because rounding moves the poles at 1 of stored momentum.
NEAREST = 3  # Number of crossings |L| = 1, by smallest estimated delay, from which the delay margin is searched.
LOOKED, PARTS = 8, 16  # Range of the grid search for the delay margin in periods, and its steps per period.
NEAR = 6  # Number of results of the grid search from which the delay margin is searched.
PAIR = 2  # Loops in one call of the compiled program: each point of a margin map has two.
STARTS, FARTHER = 8, 0.15  # Largest number of Newton starts for a delay, and the distance between them in periods.


class Margins(NamedTuple):
    """Margins of each axis, (m,).

    The margins of an unstable loop are negative. Their size is the distance to the nearest gain or phase that moves a
    pole across the unit circle; other poles may still be outside. The delay margin of an unstable loop is 0.
    """

    gain_up: Array  # [dB] Allowed gain increase; infinite if no gain makes the loop unstable.
    gain_down: Array  # [dB] Allowed gain reduction.
    phase: Array  # [deg]
    delay: Array  # [s]
    peak_sensitivity: Array  # [dB] Peak sensitivity M_s.
    stable: Array  # bool, whether the loop is stable.
    crossover: Array  # [rad/s] Frequency at which the phase margin is attained.

    def worst(self) -> dict[str, Any]:
        """Return the worst of each of `catalogues.MARGINS` over all axes and loops."""
        return {name: (v.max if name == "peak_sensitivity" else v.min)() for name, v in self.each().items()}

    def each(self) -> dict[str, Any]:
        """Return each of `catalogues.MARGINS` by axis.

        The gain margin is the smaller of increase and reduction. The peak sensitivity of an unstable loop is `MOST`.
        """
        xp: Any = np if isinstance(self.phase, np.ndarray) else jnp
        return {
            "gain_margin": xp.minimum(self.gain_up, self.gain_down),
            "phase_margin": self.phase,
            "delay_margin": self.delay,
            "peak_sensitivity": xp.where(self.stable, self.peak_sensitivity, MOST),
        }


FIELDS = Margins._fields[:5]  # fields of `Margins` that are margins


@programs.jit(static_argnames=("sensors", "with_delay"), title="the exact margins")
def compute_each(loops: Loop, sensors: bool = False, with_delay: bool = True) -> Margins:
    """Return the margins of several loops; the first axis is the loop.

    Args:
        loops: the loops.
        sensors: see `compute`.
        with_delay: see `compute`.
    """
    return jax.lax.map(partial(compute, sensors=sensors, with_delay=with_delay), loops)


def in_turn(loops: Loop) -> Margins:
    """Return the margins of several loops as NumPy arrays; the first axis is the loop.

    The function calls the same compiled program for `PAIR` loops at a time, so that it is not compiled for each number
    of loops.
    """
    count = np.shape(loops.period)[0]

    def call(k: int) -> Margins:
        some = np.resize(np.arange(k, min(k + PAIR, count)), PAIR)
        return jax.tree.map(np.asarray, compute_each(jax.tree.map(lambda v: np.asarray(v)[some], loops)))

    calls = [call(k) for k in range(0, count, PAIR)]
    return jax.tree.map(lambda *many: np.concatenate(many)[:count], *calls)


class _Spectrum(NamedTuple):
    """L of an opened loop from 0 to the Nyquist frequency."""

    finite: Array  # bool; if False, all numbers are meaningless.
    loop: Loop
    opening: Opening
    quick: SchurOpening  # The opening in Schur coordinates.
    stable: Array  # bool
    w: Array  # (points,) [rad/s]
    each: Array  # (m, points) L of each axis, with stopped gradients.

    def at(self, w: Array, *, by_loop: bool) -> tuple[Array, Array]:
        """Return L of each axis and its derivative by w, at frequencies w (m, places) [rad/s] of each axis.

        by_loop: whether L has gradients by the loop.
        """
        m, places = w.shape
        z = jnp.exp(1j * w.reshape(-1) * jax.lax.stop_gradient(self.loop.period))
        by_w = 1j * jax.lax.stop_gradient(self.loop.period) * z
        L, by_z = crossings.response(self.opening, self.quick, z) if by_loop else self.quick.response(z)

        def own(axis: Array, L: Array, by: Array) -> tuple[Array, Array]:
            return jax.jvp(lambda L: crossings.one_axis(L, axis), (L,), (by,))

        own_L, slope = jax.vmap(own)(jnp.repeat(jnp.arange(m), places), L, by_w[:, None, None] * by_z)
        return own_L.reshape(m, places), slope.reshape(m, places)


def _spectrum(loop: Loop, opened: Callable[[Loop], Opening] = linear.at_input) -> _Spectrum:
    finite = jnp.all(jnp.stack([jnp.all(jnp.isfinite(v)) for v in jax.tree.leaves(loop)]))
    loop = jax.tree.map(lambda v: jnp.where(finite, v, jnp.ones_like(v)), loop)
    opening = opened(loop)
    fixed, h = jax.lax.stop_gradient((opening, loop.period))
    poles = crossings.poles_of(fixed)
    quick, w = crossings.in_schur_coordinates(opening), crossings.grid(poles, h)
    each = crossings.each_axis(quick.values(jnp.exp(1j * w * h)))
    stable = finite & (jnp.max(jnp.abs(poles[0])) < 1.0 + NEUTRAL)
    return _Spectrum(finite, loop, opening, quick, stable, w, each.T)


def compute(loop: Loop, sensors: bool = False, with_delay: bool = True) -> Margins:
    """Return the margins of each axis of a loop, or NaN if the loop contains numbers that are not finite.

    Args:
        loop: the loop.
        sensors: whether to open the loop at the sensors instead of the plant's input. The margins are then those of
            each coordinate that sensors see, and the delay margin is NaN.
        with_delay: whether to compute the delay margin; otherwise it is NaN.
    """
    if not sensors:
        return _of(_spectrum(loop), with_delay)

    # one coordinate at a time: at low frequencies L of all is so large that rounding would hide L of one coordinate
    def at_one(axis: Array) -> Margins:
        def opened(loop: Loop) -> Opening:
            opening, only = linear.at_sensors(loop), jax.nn.one_hot(axis, loop.seen.shape[1])
            a = opening.closed(jnp.diag(1.0 - only))
            return Opening(a, opening.b @ only[:, None], only[None] @ opening.c)

        return _of(_spectrum(loop, opened), False)

    return jax.tree.map(lambda v: v[:, 0], jax.lax.map(at_one, jnp.arange(loop.seen.shape[1])))


def _of(spectrum: _Spectrum, with_delay: bool) -> Margins:
    """Return the margins of each axis of an opened loop, see `compute`."""
    brackets = jax.vmap(partial(crossings.brackets, spectrum.w))(spectrum.each)
    root = jax.lax.stop_gradient(_refined_crossings(spectrum, brackets))
    L, slope = spectrum.at(jnp.append(root, brackets.elsewhere, axis=1), by_loop=True)
    in_axes = (0, 0, 0, 0, None, None)
    values = jax.vmap(_axis, in_axes=in_axes)(root, L, slope, brackets.there, spectrum.stable, spectrum.w[0])
    axes = jnp.arange(root.shape[0])
    delay = jnp.full(axes.size, jnp.nan)
    if with_delay:
        delay = jax.vmap(partial(_delay, spectrum.loop, spectrum.w))(spectrum.each, axes)
    values = values._replace(delay=jnp.where(spectrum.stable, delay, 0.0))
    return jax.tree.map(lambda v: v if v.dtype == bool else jnp.where(spectrum.finite, v, jnp.nan), values)


def _crossed(L: Array) -> Array:
    """Return the functions that are zero at the crossings: Im L for the real axis, ln |L| for |L| = 1."""
    return jnp.append(L[..., : SPLIT[0]].imag, jnp.log(jnp.abs(L[..., SPLIT[0] : SPLIT[1]])), axis=-1)


def _refined_crossings(spectrum: _Spectrum, brackets: Brackets) -> Array:
    """Return the frequencies (m, places) [rad/s] of the zeros in all `Brackets` of all axes.

    The function uses the Illinois variant of regula falsi (Dowell and Jarratt, BIT 11, 1971). It stops when the
    remaining error is small enough for the final Newton step in `_axis`.
    """

    def false_position(state: tuple[Array, tuple, Array]) -> tuple[Array, tuple, Array]:
        k, (a, b, f_a, f_b), _ = state
        c = b - f_b * (b - a) / jnp.where(f_b == f_a, 1.0, f_b - f_a)
        c = jnp.clip(c, jnp.minimum(a, b), jnp.maximum(a, b))
        L, slope = spectrum.at(c, by_loop=False)
        crossed = crossings.sine(L[:, : SPLIT[0]]), _crossed(L)[:, SPLIT[0] :]
        f_c = jnp.concatenate([*crossed, (jnp.conj(1.0 + L) * slope).real[:, SPLIT[1] :]], axis=1)
        between = f_c * f_b < 0.0
        moves = jnp.any(brackets.there & (jnp.abs(c - b) > 1e-9 * b))
        return k + 1, (jnp.where(between, b, a), c, jnp.where(between, f_b, f_a / 2), f_c), moves

    def is_unfinished(state: tuple[Array, tuple, Array]) -> Array:
        return (state[0] < 10) & state[2]

    first = (jnp.zeros((), int), tuple(brackets[:4]), jnp.ones((), bool))
    root = jax.lax.while_loop(is_unfinished, false_position, jax.lax.stop_gradient(first))[1][1]
    return jnp.where(jnp.isfinite(root), root, brackets.high)


def roughly(loop: Loop) -> dict[str, Array]:
    """Return approximate margins of each axis (m,) by interpolation between grid points, with stopped gradients.

    The keys are those of `catalogues.MARGINS`. The function takes a sixth of the time of `compute`, and
    half of it without the delay margin (42 states).
    """
    spectrum = _spectrum(loop)
    gain, phase, peak_sensitivity = jax.vmap(crossings.margins_on_grid)(spectrum.each)
    delay = jnp.min(jax.vmap(partial(crossings.delay_at, spectrum.w))(spectrum.each)[0], axis=1)
    sign = jnp.where(spectrum.stable, 1.0, -1.0)
    each = {
        "gain_margin": jnp.where(spectrum.stable & (gain >= MOST), jnp.inf, sign * jnp.minimum(gain, MOST)),
        "phase_margin": sign * phase,
        "delay_margin": jnp.where(spectrum.stable, delay, 0.0),
        "peak_sensitivity": jnp.where(spectrum.stable, peak_sensitivity, MOST),
    }
    return {name: jnp.where(spectrum.finite, v, jnp.nan) for name, v in each.items()}


def _axis(root: Array, L: Array, slope: Array, there: Array, stable: Array, lowest: Scalar) -> Margins:
    """Return the margins of one axis.

    Args:
        root: frequencies of the crossings (crossings,) [rad/s], in the order of `SPLIT`.
        L: open-loop response at the crossings, then at the three frequencies `Brackets.elsewhere`.
        slope: derivative of L by w at the same frequencies.
        there: which crossings exist, bool (crossings,); numbers of the others are meaningless.
        stable: whether the loop is stable.
        lowest: lowest frequency of the grid [rad/s].
    """
    crosses = SPLIT[1]
    ends = L[-2:]  # L at w = 0 and at the Nyquist frequency, where a gain can move a pole to 1 or to -1
    on_ends = crossings.ends_at(ends.at[0].add(-lowest * slope[-2]))  # extrapolated to w = 0, which slow loops need
    slope = slope[:crosses]
    fall = jnp.append(slope[: SPLIT[0]].imag, (slope / L[:crosses]).real[SPLIT[0] :])
    # one Newton step with constant derivatives makes the crossing differentiable by the loop
    rate = jax.lax.stop_gradient(slope / jnp.where(fall == 0.0, 1.0, fall))
    real, even = jnp.split(L[:crosses] - rate * _crossed(L), SPLIT[:1])
    on = jnp.append(there[: real.size], on_ends)
    real = jnp.append(real.real, ends.real)
    factor = -20.0 * jnp.log10(jnp.where(on & (real < 0.0), -real, 1.0))
    up, down = (jnp.min(jnp.where(side * factor > 0.0, side * factor, MOST)) for side in (1.0, -1.0))
    evens = slice(SPLIT[0], crosses)  # crossings with |L| = 1
    angles = jnp.where(there[evens], jnp.rad2deg(jnp.abs(jnp.angle(-even))), 180.0)
    nearest, worst = jnp.minimum(up, down), jnp.argmin(angles)
    return Margins(
        gain_up=jnp.where(stable, jnp.where(up < MOST, up, jnp.inf), -nearest),
        gain_down=jnp.where(stable, jnp.where(down < MOST, down, jnp.inf), -nearest),
        phase=jnp.where(stable, 1.0, -1.0) * jnp.min(angles),
        delay=jnp.zeros_like(up),
        peak_sensitivity=-20.0 * jnp.log10(jnp.min(jnp.abs(1.0 + L[crosses:]))),  # derivative by w is 0: no Newton step
        stable=stable,
        crossover=jnp.where(there[evens][worst], root[evens][worst], jnp.nan),
    )


def _delay(loop: Loop, w: Array, seen: Array, axis: Array) -> Scalar:
    """Return the smallest additional delay [s] of one axis's command that brings the loop to its stability limit."""
    # no LAPACK solver: jaxlib's wait for threads of XLA, and two of them at the same time deadlock
    of_a = crossings.schur_form(loop.closed_at_sensors()[0])
    still, fixed = jax.lax.stop_gradient((loop, of_a))
    near = _delay_grid_search(still, fixed, w, axis)
    estimates, crossed = crossings.delay_at(w, seen)
    sizes, crossed = jax.lax.stop_gradient((estimates, crossed))
    # the estimates ignore that commands are held, so that the smallest estimate need not give the smallest delay
    values, places = crossings.smallest_values(sizes, NEAREST)
    starts = jnp.append(near, jnp.stack([jnp.log(crossed[places]), values / still.period], axis=1), axis=0)
    tries = jnp.append(jnp.ones(len(near), int), jnp.full(NEAREST, STARTS))

    def limit(of: tuple) -> tuple[Array, Array]:  # ln w and delay in periods at a stability limit; whether found
        start, tries = of
        known = jnp.isfinite(start[1])

        def newton(state: tuple[Array, Array, Array, Array]) -> tuple[Array, Array, Array, Array]:
            steps, starts, x, _ = state
            by = _delay_step(still, fixed, axis, x)
            x = x - by
            settled = jnp.all(jnp.abs(by) <= 1e-9 * jnp.maximum(jnp.abs(x), 1.0))  # convergence is quadratic
            found = settled & (x[1] > 0.0)
            failed = ~found & (settled | (steps == 11) | ~jnp.all(jnp.isfinite(x)))  # delay not positive, or diverged
            starts = starts + failed
            x = jnp.where(failed, start.at[1].add(FARTHER * starts), x)
            return jnp.where(failed, 0, steps + 1), starts, x, found

        zero = jnp.zeros((), int)
        begun = (zero, zero, jnp.where(known, start, 1.0), ~known)
        *_, root, found = jax.lax.while_loop(lambda at: ~at[3] & (at[1] < tries), newton, begun)
        return root, known & found

    roots, found = jax.lax.map(limit, (starts, tries))
    # a start in the range of the grid search without a limit is ignored, unless no start leads to a limit
    counts = jnp.where((starts[:, 1] < LOOKED) & jnp.any(found), jnp.inf, starts[:, 1])
    first = jnp.argmin(jnp.where(found, roots[:, 1], counts))  # smallest delay
    root = jax.lax.stop_gradient(jnp.where(found[first], roots[first], 1.0))
    exact = (root - _delay_step(loop, of_a, axis, root))[1] * loop.period
    return jnp.where(found[first], exact, jnp.append(near[:, 1] * still.period, estimates[places])[first])


def _delay_grid_search(loop: Loop, of_a: tuple[Array, Array], w: Array, axis: Array) -> Array:
    """Return approximate stability limits (NEAR, 2), ln w and delay in periods, by a search on a grid of both.

    A grid cell contains a zero of 1 + L if 1 + L winds around 0 along the edges of the cell. The function returns the
    zeros with the smallest delays. The delay is infinite if there are fewer than `NEAR` zeros.

    Args:
        loop: the loop.
        of_a: see `_delay_step`.
        w: frequencies [rad/s].
        axis: number of the delayed axis.
    """
    a, command = loop.closed_at_sensors()
    z = jnp.exp(1j * w * loop.period)
    opening = Opening(a, loop.new[0], command)
    quick = crossings.in_schur_coordinates(opening, of_a)
    y = quick.halves(z)[1] * (z**-loop.delay)[None, None]
    into = jnp.conj(quick.axes.T)
    response = -jnp.einsum("nkp,nm->pkm", y, into @ loop.new[0])

    def back(response: Array, column: Array) -> Array:  # L of the axis, linear in its column of the response
        return crossings.one_axis(response.at[:, axis].set(column), axis)

    each = jnp.eye(command.shape[0]) + 0j
    by_column = jax.vmap(jax.vmap(back, (None, 0)), (0, None))(response, each)
    y = jnp.einsum("nkp,pk->np", y, by_column)
    new, old = (-jnp.einsum("np,nq->qp", y, into @ late[:, :, axis].T) for late in (loop.new, loop.old))
    nodes = replace(loop, new=new, old=old / z[None])
    parts = jnp.arange(PARTS) / PARTS
    within = jax.vmap(lambda part: jnp.add(*linear.acting(nodes, part)))(parts)
    wholes = jnp.arange(LOOKED)[:, None, None]
    late = (within[None] * z[None, None] ** -wholes).reshape(-1, w.size)  # a whole period only rotates L
    step, point = crossings.zeros_of(1.0 + late, NEAR)
    return jnp.stack([jnp.log(jnp.interp(point, jnp.arange(w.size), w)), step / PARTS], axis=1)


@jax.jit
def _delay_step(loop: Loop, of_a: tuple[Array, Array], axis: Array, x: Array) -> Array:
    """Return the Newton step of ln w and the delay toward L = -1 of one axis; the new estimate is x minus the step.

    Args:
        loop: the loop.
        of_a: `crossings.schur_form` of A of the loop closed at its sensors.
        axis: number of the delayed axis.
        x: ln w and the delay in periods.
    """

    def log_of_negated(at: Array) -> tuple[Array, Array]:  # ln(-L) twice, the second one as auxiliary value
        z = jnp.exp(1j * jnp.exp(at[0]) * loop.period)
        late = linear.late_axis(loop, z, at[1], axis)
        L = crossings.response(late, crossings.in_schur_coordinates(late, of_a), z[None])[0][0]
        value = -crossings.one_axis(z**-loop.delay * L, axis)
        far = jnp.stack([jnp.log(jnp.abs(value)), jnp.angle(value)])
        return far, far

    jacobian, far = jax.jacfwd(log_of_negated, has_aux=True)(x)
    (a, b), (c, d) = jax.lax.stop_gradient(jacobian)
    by = jnp.stack([d * far[0] - b * far[1], a * far[1] - c * far[0]]) / (a * d - b * c)  # Cramer's rule
    most = jnp.stack([0.2 * jnp.ones_like(a), 0.5 + 0.1 * jnp.abs(x[1])])
    return jnp.clip(by, -most, most)


def together(loop: Loop) -> dict[str, float]:
    """Return margins against the same change of gain, phase or delay in all axes at once, by the poles of the loop.

    The keys are `FIELDS`, in dB, deg and s. The peak sensitivity is the largest singular value of (I + L)^-1. Margins
    beyond 80 dB, 180 deg or 200 periods are infinite. All values are NaN if the loop is unstable.
    """

    def unstable(gain: Any = 1.0, delay: float = 0.0) -> bool:
        return not linear.radius(loop, gain, delay) < 1.0 + NEUTRAL

    def first(lost: Callable[[float], bool], values: np.ndarray) -> float:
        """Return the smallest change that makes the loop unstable, bracketed by `values` and refined by bisection."""
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
    response, _ = _responses(loop)[1:]
    least = np.linalg.svd(np.eye(response.shape[1]) + np.asarray(response), compute_uv=False)[:, -1].min()
    decibels, degrees = np.arange(1.0, 81.0), np.arange(2.0, 181.0, 2.0)
    periods = np.unique(np.append(np.linspace(0.0, 10.0, 41)[1:], np.geomspace(10, 200, 40)))
    each = (
        first(lambda dB: unstable(10.0 ** (dB / 20.0)), decibels),
        first(lambda dB: unstable(10.0 ** (-dB / 20.0)), decibels),
        first(lambda angle: unstable(np.exp(-1j * np.deg2rad(angle))), degrees),
        first(lambda delay: unstable(delay=delay), periods) * float(loop.period),
        float(-20.0 * np.log10(least)),
    )
    return dict(zip(FIELDS, each, strict=True))


@programs.jit
def _responses(loop: Loop) -> tuple[Array, Array, Array]:
    """Return frequencies, L (points, m, m), and L of each axis with the other axes closed (points, m)."""
    opening = linear.at_input(loop)
    w = crossings.grid(crossings.poles_of(opening), loop.period)
    seen, _ = crossings.in_schur_coordinates(opening).response(jnp.exp(1j * w * loop.period))
    return w, seen, crossings.each_axis(seen)


def responses(loop: Loop) -> tuple[np.ndarray, np.ndarray]:
    """Return frequencies (points,) [rad/s] and L of each axis with the other axes closed (points, m)."""
    w, _, each = _responses(loop)
    return np.asarray(w), np.asarray(each)
