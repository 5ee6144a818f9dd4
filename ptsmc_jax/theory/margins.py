"""Stability margins of a sampled loop at the plant's input, one axis opened at a time, the other axes closed.

The margins follow from L(e^(i w h)) of `linear.open_at_input` between 0 and the Nyquist frequency. A grid that is dense
around every pole brackets the crossings. Regula falsi refines them, and a Newton step makes them differentiable. The
margins are exact for the sampled loop with held commands, without a continuous approximation: at the gain or delay
margin the simulated loop reaches its stability limit. Read `Margins` and `compute` first.
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
from ptsmc_jax.theory.crossings import KIND_ENDS, LARGEST_MARGIN, Brackets, SchurOpening
from ptsmc_jax.theory.linear import Loop, Opening

CIRCLE_TOLERANCE = (
    1e-6  # Poles up to this distance outside the unit circle count as stable; wheel momentum has poles at 1.
)
NEAREST = 3  # Number of estimated delay margins, from crossings |L| = 1, at which Newton's method starts.
SEARCHED_PERIODS = 8  # Largest delay of the grid search for the delay margin, in periods.
STEPS_PER_PERIOD = 16  # Steps per period of the grid search for the delay margin.
GRID_ZEROS = 6  # Number of delays found by the grid search at which Newton's method starts.
LOOPS_PER_CALL = 2  # Loops in one call of the compiled program: each point of a margin map has two.
MOST_STARTS = 8  # Largest number of attempts of Newton's method for each estimated delay margin.
HALVINGS = 12  # Largest number of halvings of a grid interval for figures.
LARGEST_STEP = 0.1  # Largest step of ln L from one point of a figure to the next; 0.1 is 0.9 dB or 6 deg.
START_DISTANCE = 0.15  # Increase of the starting delay from one attempt of Newton's method to the next, in periods.


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
        return {name: (v.max if name == "peak_sensitivity" else v.min)() for name, v in self.by_name().items()}

    def by_name(self) -> dict[str, Any]:
        """Return each of `catalogues.MARGINS` by axis.

        The gain margin is the smaller of increase and reduction. The peak sensitivity of an unstable loop is
        `LARGEST_MARGIN`.
        """
        xp: Any = np if isinstance(self.phase, np.ndarray) else jnp
        return {
            "gain_margin": xp.minimum(self.gain_up, self.gain_down),
            "phase_margin": self.phase,
            "delay_margin": self.delay,
            "peak_sensitivity": xp.where(self.stable, self.peak_sensitivity, LARGEST_MARGIN),
        }

    @property
    def is_open(self) -> Any:
        """Whether the loop transfer L is zero at each input, bool.

        For example, a torque limit saturates the command of the nominal run, or the law does not react to the state at
        this sample.
        """
        # infinite margins, or the largest reported distance from a stability limit if other axes make the loop unstable
        gain_up, gain_down, peak_sensitivity = map(abs, (self.gain_up, self.gain_down, self.peak_sensitivity))
        unlimited = (gain_up >= LARGEST_MARGIN) & (gain_down >= LARGEST_MARGIN)
        return unlimited & (peak_sensitivity < 1e-9) & (self.crossover != self.crossover)  # NaN: no crossover


FIELDS = Margins._fields[:5]  # fields of `Margins` that are margins


@programs.jit(static_argnames=("sensors", "with_delay"), title="the exact margins")
def compute_each(loops: Loop, sensors: bool = False, with_delay: bool = True) -> Margins:
    """Return the margins of several loops; the first axis is the loop.

    Args:
        loops: the loops.
        sensors: whether to open the loops at the sensors instead of the plant's input, see `compute`.
        with_delay: whether to compute the delay margin; otherwise it is NaN.
    """
    return jax.lax.map(partial(compute, sensors=sensors, with_delay=with_delay), loops)


class _Spectrum(NamedTuple):
    """L of an opened loop from 0 to the Nyquist frequency."""

    finite: Array  # bool; if False, all numbers are meaningless.
    loop: Loop
    opening: Opening
    schur: SchurOpening  # The opening in Schur coordinates.
    stable: Array  # bool
    w: Array  # (points,) [rad/s]
    axis_responses: Array  # (m, points) L of each axis, with stopped gradients.

    def evaluate(self, w: Array, *, with_gradients: bool) -> tuple[Array, Array]:
        """Return L of each axis and its derivative by w, at frequencies w (m, places) [rad/s] of each axis.

        with_gradients: whether L can be differentiated by the numbers of the loop.
        """
        m, places = w.shape
        z = jnp.exp(1j * w.reshape(-1) * jax.lax.stop_gradient(self.loop.period))
        by_w = 1j * jax.lax.stop_gradient(self.loop.period) * z
        L, by_z = crossings.response(self.opening, self.schur, z) if with_gradients else self.schur.response(z)

        def differentiate_axis(axis: Array, L: Array, derivative: Array) -> tuple[Array, Array]:
            return jax.jvp(lambda L: crossings.axis_response(L, axis), (L,), (derivative,))

        axis_L, L_derivative = jax.vmap(differentiate_axis)(
            jnp.repeat(jnp.arange(m), places), L, by_w[:, None, None] * by_z
        )
        return axis_L.reshape(m, places), L_derivative.reshape(m, places)


def _open_loop_spectrum(loop: Loop, open_loop: Callable[[Loop], Opening] = linear.open_at_input) -> _Spectrum:
    """Open a loop with `open_loop`, and return its responses on a frequency grid.

    The numbers are meaningless if `finite` of the result is False.
    """
    finite = jnp.all(jnp.stack([jnp.all(jnp.isfinite(v)) for v in jax.tree.leaves(loop)]))
    loop = jax.tree.map(lambda v: jnp.where(finite, v, jnp.ones_like(v)), loop)
    opening = open_loop(loop)
    fixed, h = jax.lax.stop_gradient((opening, loop.period))
    poles = crossings.poles_of(fixed)
    schur, w = crossings.in_schur_coordinates(opening), crossings.frequency_grid(poles, h)
    axis_responses = crossings.axis_responses(schur.response_in_chunks(jnp.exp(1j * w * h)))
    stable = finite & (jnp.max(jnp.abs(poles[0])) < 1.0 + CIRCLE_TOLERANCE)
    return _Spectrum(finite, loop, opening, schur, stable, w, axis_responses.T)


def compute(loop: Loop, sensors: bool = False, with_delay: bool = True) -> Margins:
    """Return the margins of a loop opened at the plant's input or at the sensors; NaN if the loop is not finite.

    Args:
        loop: the loop.
        sensors: whether to open the loop at the sensors instead of the plant's input. The margins are then those of
            each coordinate that sensors see, and the delay margin is NaN.
        with_delay: whether to compute the delay margin; otherwise it is NaN.
    """
    if not sensors:
        return _spectrum_margins(_open_loop_spectrum(loop), with_delay)

    # Open one coordinate at a time. L of all coordinates is so large at low frequencies that rounding errors would hide
    # L of one coordinate.
    def open_coordinate(axis: Array) -> Margins:
        def open_one(loop: Loop) -> Opening:
            opening, selected = linear.open_at_sensors(loop), jax.nn.one_hot(axis, loop.seen.shape[1])
            a = opening.closed(jnp.diag(1.0 - selected))
            return Opening(a, opening.b @ selected[:, None], selected[None] @ opening.c)

        return _spectrum_margins(_open_loop_spectrum(loop, open_one), False)

    return jax.tree.map(lambda v: v[:, 0], jax.lax.map(open_coordinate, jnp.arange(loop.seen.shape[1])))


def _spectrum_margins(spectrum: _Spectrum, with_delay: bool) -> Margins:
    """Return the margins of each axis of an opened loop, see `compute`."""
    brackets = jax.vmap(partial(crossings.find_brackets, spectrum.w))(spectrum.axis_responses)
    roots = jax.lax.stop_gradient(_refine_crossings(spectrum, brackets))
    L, L_derivative = spectrum.evaluate(jnp.append(roots, brackets.further, axis=1), with_gradients=True)
    in_axes = (0, 0, 0, 0, None, None)
    values = jax.vmap(_axis_margins, in_axes=in_axes)(
        roots, L, L_derivative, brackets.exists, spectrum.stable, spectrum.w[0]
    )
    axes = jnp.arange(roots.shape[0])
    delay = jnp.full(axes.size, jnp.nan)
    if with_delay:
        delay = jax.vmap(partial(_delay_margin, spectrum.loop, spectrum.w))(spectrum.axis_responses, axes)
    values = values._replace(delay=jnp.where(spectrum.stable, delay, 0.0))
    return jax.tree.map(lambda v: v if v.dtype == bool else jnp.where(spectrum.finite, v, jnp.nan), values)


def _crossing_functions(L: Array) -> Array:
    """Return the functions that are zero at the crossings: Im L for the real axis, ln |L| for |L| = 1."""
    return jnp.append(L[..., : KIND_ENDS[0]].imag, jnp.log(jnp.abs(L[..., KIND_ENDS[0] : KIND_ENDS[1]])), axis=-1)


def _refine_crossings(spectrum: _Spectrum, brackets: Brackets) -> Array:
    """Return the frequencies (m, places) [rad/s] of the zeros in all `Brackets` of all axes.

    The function uses the Illinois variant of regula falsi (Dowell and Jarratt, BIT 11, 1971). It stops when the
    remaining error is small enough for the final Newton step in `_axis_margins`.
    """

    def false_position(state: tuple[Array, tuple, Array]) -> tuple[Array, tuple, Array]:
        k, (a, b, f_a, f_b), _ = state
        c = b - f_b * (b - a) / jnp.where(f_b == f_a, 1.0, f_b - f_a)
        c = jnp.clip(c, jnp.minimum(a, b), jnp.maximum(a, b))
        L, L_derivative = spectrum.evaluate(c, with_gradients=False)
        crossed = crossings.sine(L[:, : KIND_ENDS[0]]), _crossing_functions(L)[:, KIND_ENDS[0] :]
        f_c = jnp.concatenate([*crossed, (jnp.conj(1.0 + L) * L_derivative).real[:, KIND_ENDS[1] :]], axis=1)
        changes_sign = f_c * f_b < 0.0
        unfinished = jnp.any(brackets.exists & (jnp.abs(c - b) > 1e-9 * b))
        return k + 1, (jnp.where(changes_sign, b, a), c, jnp.where(changes_sign, f_b, f_a / 2), f_c), unfinished

    def is_unfinished(state: tuple[Array, tuple, Array]) -> Array:
        return (state[0] < 10) & state[2]

    initial = (jnp.zeros((), int), tuple(brackets[:4]), jnp.ones((), bool))
    roots = jax.lax.while_loop(is_unfinished, false_position, jax.lax.stop_gradient(initial))[1][1]
    return jnp.where(jnp.isfinite(roots), roots, brackets.high)


def estimate(loop: Loop) -> dict[str, Array]:
    """Return approximate margins of each axis (m,) by interpolation between grid points, with stopped gradients.

    The keys are those of `catalogues.MARGINS`. For 42 states the function takes a sixth of the time of `compute`, or
    half of it if neither computes the delay margin.
    """
    spectrum = _open_loop_spectrum(loop)
    gain, phase, peak_sensitivity = jax.vmap(crossings.margins_on_grid)(spectrum.axis_responses)
    delay = jnp.min(jax.vmap(partial(crossings.crossing_delays, spectrum.w))(spectrum.axis_responses)[0], axis=1)
    sign = jnp.where(spectrum.stable, 1.0, -1.0)
    values = {
        "gain_margin": jnp.where(
            spectrum.stable & (gain >= LARGEST_MARGIN), jnp.inf, sign * jnp.minimum(gain, LARGEST_MARGIN)
        ),
        "phase_margin": sign * phase,
        "delay_margin": jnp.where(spectrum.stable, delay, 0.0),
        "peak_sensitivity": jnp.where(spectrum.stable, peak_sensitivity, LARGEST_MARGIN),
    }
    return {name: jnp.where(spectrum.finite, v, jnp.nan) for name, v in values.items()}


def _axis_margins(root: Array, L: Array, L_derivative: Array, exists: Array, stable: Array, lowest: Scalar) -> Margins:
    """Return the margins of one axis.

    Args:
        root: frequencies of the crossings (crossings,) [rad/s], in the order of `KIND_ENDS`.
        L: open-loop response at the crossings, then at the three frequencies `Brackets.further`.
        L_derivative: derivative of L by w at the same frequencies.
        exists: which crossings exist, bool (crossings,); numbers of the others are meaningless.
        stable: whether the loop is stable.
        lowest: lowest frequency of the grid [rad/s].
    """
    count = KIND_ENDS[1]
    ends = L[-2:]  # L at w = 0 and at the Nyquist frequency, where a gain can move a pole to 1 or to -1
    # the first value is extrapolated to w = 0, because slow loops are not real at the lowest frequency of the grid
    real_at_ends = crossings.is_real_at_ends(ends.at[0].add(-lowest * L_derivative[-2]))
    L_derivative = L_derivative[:count]
    function_derivative = jnp.append(L_derivative[: KIND_ENDS[0]].imag, (L_derivative / L[:count]).real[KIND_ENDS[0] :])
    # one Newton step with constant derivatives makes the crossing differentiable by the loop
    rate = jax.lax.stop_gradient(L_derivative / jnp.where(function_derivative == 0.0, 1.0, function_derivative))
    real, unit_gain = jnp.split(L[:count] - rate * _crossing_functions(L), KIND_ENDS[:1])
    is_real = jnp.append(exists[: real.size], real_at_ends)
    real = jnp.append(real.real, ends.real)
    factor = -20.0 * jnp.log10(jnp.where(is_real & (real < 0.0), -real, 1.0))
    up, down = (jnp.min(jnp.where(side * factor > 0.0, side * factor, LARGEST_MARGIN)) for side in (1.0, -1.0))
    unit_gains = slice(KIND_ENDS[0], count)  # crossings with |L| = 1
    angles = jnp.where(exists[unit_gains], jnp.rad2deg(jnp.abs(jnp.angle(-unit_gain))), 180.0)
    nearest, worst = jnp.minimum(up, down), jnp.argmin(angles)
    return Margins(
        gain_up=jnp.where(stable, jnp.where(up < LARGEST_MARGIN, up, jnp.inf), -nearest),
        gain_down=jnp.where(stable, jnp.where(down < LARGEST_MARGIN, down, jnp.inf), -nearest),
        phase=jnp.where(stable, 1.0, -1.0) * jnp.min(angles),
        delay=jnp.zeros_like(up),
        peak_sensitivity=-20.0 * jnp.log10(jnp.min(jnp.abs(1.0 + L[count:]))),  # `further` needs no Newton step
        stable=stable,
        crossover=jnp.where(exists[unit_gains][worst], root[unit_gains][worst], jnp.nan),
    )


def _delay_margin(loop: Loop, w: Array, response: Array, axis: Array) -> Scalar:
    """Return the smallest additional delay [s] of one axis's command that brings the loop to its stability limit."""
    # no linear solves by LAPACK: in jaxlib they wait for threads of XLA, and two at the same time deadlock
    schur_a = crossings.schur_form(loop.closed_at_sensors()[0])
    fixed_loop, fixed_schur = jax.lax.stop_gradient((loop, schur_a))
    grid_limits = _delay_grid_search(fixed_loop, fixed_schur, w, axis)
    estimates, frequencies = crossings.crossing_delays(w, response)
    fixed_estimates, frequencies = jax.lax.stop_gradient((estimates, frequencies))
    # the estimates ignore that commands are held, so that the smallest estimate need not give the smallest delay
    values, places = crossings.smallest_values(fixed_estimates, NEAREST)
    estimated = jnp.stack([jnp.log(frequencies[places]), values / fixed_loop.period], axis=1)
    starts = jnp.append(grid_limits, estimated, axis=0)
    attempts = jnp.append(jnp.ones(len(grid_limits), int), jnp.full(NEAREST, MOST_STARTS))

    def find_limit(task: tuple) -> tuple[Array, Array]:
        """Return ln w and the delay in periods at a stability limit, and whether a positive delay was found."""
        start, attempts = task
        is_finite = jnp.isfinite(start[1])

        def newton_step(state: tuple[Array, Array, Array, Array]) -> tuple[Array, Array, Array, Array]:
            steps, starts, x, _ = state
            step = _delay_step(fixed_loop, fixed_schur, axis, x)
            x = x - step
            converged = jnp.all(jnp.abs(step) <= 1e-9 * jnp.maximum(jnp.abs(x), 1.0))  # convergence is quadratic
            has_limit = converged & (x[1] > 0.0)
            # an attempt fails if it converges to a delay that is not positive, takes 12 steps, or diverges
            failed = ~has_limit & (converged | (steps == 11) | ~jnp.all(jnp.isfinite(x)))
            starts = starts + failed
            x = jnp.where(failed, start.at[1].add(START_DISTANCE * starts), x)
            return jnp.where(failed, 0, steps + 1), starts, x, has_limit

        zero = jnp.zeros((), int)
        initial = (zero, zero, jnp.where(is_finite, start, 1.0), ~is_finite)
        *_, root, has_limit = jax.lax.while_loop(lambda state: ~state[3] & (state[1] < attempts), newton_step, initial)
        return root, is_finite & has_limit

    roots, has_limit = jax.lax.map(find_limit, (starts, attempts))
    # ignore a start without a limit in the range of the grid search, unless no start leads to a limit
    without_limit = jnp.where((starts[:, 1] < SEARCHED_PERIODS) & jnp.any(has_limit), jnp.inf, starts[:, 1])
    best = jnp.argmin(jnp.where(has_limit, roots[:, 1], without_limit))  # smallest delay
    root = jax.lax.stop_gradient(jnp.where(has_limit[best], roots[best], 1.0))
    exact = (root - _delay_step(loop, schur_a, axis, root))[1] * loop.period
    return jnp.where(has_limit[best], exact, jnp.append(grid_limits[:, 1] * fixed_loop.period, estimates[places])[best])


def _delay_grid_search(loop: Loop, schur_a: tuple[Array, Array], w: Array, axis: Array) -> Array:
    """Return approximate stability limits (`GRID_ZEROS`, 2), ln w and delay in periods, by a search on a grid of both.

    A grid cell contains a zero of 1 + L if 1 + L winds around 0 along the edges of the cell. The function returns the
    zeros with the smallest delays. The delay is infinite if there are fewer than `GRID_ZEROS` zeros.

    Args:
        loop: the loop.
        schur_a: `crossings.schur_form` of A of the loop closed at its sensors.
        w: grid frequencies [rad/s].
        axis: number of the delayed axis.
    """
    a, command = loop.closed_at_sensors()
    z = jnp.exp(1j * w * loop.period)
    opening = Opening(a, loop.new[0], command)
    schur = crossings.in_schur_coordinates(opening, schur_a)
    y = schur.resolvent_products(z)[1] * (z**-loop.delay)[None, None]
    to_schur = jnp.conj(schur.axes.T)
    response = -jnp.einsum("nkp,nm->pkm", y, to_schur @ loop.new[0])

    def axis_response_with(response: Array, column: Array) -> Array:
        """Return L of the delayed axis, others closed, with `column` as its column of L. L is linear in `column`."""
        return crossings.axis_response(response.at[:, axis].set(column), axis)

    unit_vectors = jnp.eye(command.shape[0]) + 0j
    by_column = jax.vmap(jax.vmap(axis_response_with, (None, 0)), (0, None))(response, unit_vectors)
    y = jnp.einsum("nkp,pk->np", y, by_column)
    new, old = (-jnp.einsum("np,nq->qp", y, to_schur @ delayed[:, :, axis].T) for delayed in (loop.new, loop.old))
    schur_loop = replace(loop, new=new, old=old / z[None])
    fractions = jnp.arange(STEPS_PER_PERIOD) / STEPS_PER_PERIOD
    within = jax.vmap(lambda fraction: jnp.add(*linear.command_effect(schur_loop, fraction)))(fractions)
    whole_periods = jnp.arange(SEARCHED_PERIODS)[:, None, None]
    delayed = (within[None] * z[None, None] ** -whole_periods).reshape(-1, w.size)  # a whole period only rotates L
    step, point = crossings.find_zeros(1.0 + delayed, GRID_ZEROS)
    return jnp.stack([jnp.log(jnp.interp(point, jnp.arange(w.size), w)), step / STEPS_PER_PERIOD], axis=1)


@jax.jit
def _delay_step(loop: Loop, schur_a: tuple[Array, Array], axis: Array, x: Array) -> Array:
    """Return the Newton step of ln w and the delay toward L = -1 of one axis; the new estimate is x minus the step.

    Args:
        loop: the loop.
        schur_a: `crossings.schur_form` of A of the loop closed at its sensors.
        axis: number of the delayed axis.
        x: ln w and the delay in periods.
    """

    def log_of_negated(point: Array) -> tuple[Array, Array]:  # ln(-L) twice, the second one as auxiliary value
        z = jnp.exp(1j * jnp.exp(point[0]) * loop.period)
        delayed = linear.delay_one_axis(loop, z, point[1], axis)
        L = crossings.response(delayed, crossings.in_schur_coordinates(delayed, schur_a), z[None])[0][0]
        value = -crossings.axis_response(z**-loop.delay * L, axis)
        residual = jnp.stack([jnp.log(jnp.abs(value)), jnp.angle(value)])
        return residual, residual

    jacobian, residual = jax.jacfwd(log_of_negated, has_aux=True)(x)
    (a, b), (c, d) = jax.lax.stop_gradient(jacobian)
    # Cramer's rule
    step = jnp.stack([d * residual[0] - b * residual[1], a * residual[1] - c * residual[0]]) / (a * d - b * c)
    largest = jnp.stack([0.2 * jnp.ones_like(a), 0.5 + 0.1 * jnp.abs(x[1])])
    return jnp.clip(step, -largest, largest)


def simultaneous_margins(loop: Loop) -> dict[str, float]:
    """Return margins against the same change of gain, phase or delay in all axes at once, by the poles of the loop.

    The keys are `FIELDS`, in dB, deg and s. The peak sensitivity is the largest singular value of (I + L)^-1. Margins
    beyond 80 dB, 180 deg or 200 periods are infinite. All values are NaN if the loop is unstable.
    """

    def is_unstable(gain: Any = 1.0, delay: float = 0.0) -> bool:
        return not linear.spectral_radius(loop, gain, delay) < 1.0 + CIRCLE_TOLERANCE

    def smallest_change(is_unstable_at: Callable[[float], bool], values: np.ndarray) -> float:
        """Return the smallest change that makes the loop unstable, bracketed by `values` and refined by bisection."""
        low = 0.0
        for high in values:
            if is_unstable_at(high):
                for _ in range(40):
                    middle = 0.5 * (low + high)
                    low, high = (low, middle) if is_unstable_at(middle) else (middle, high)
                return float(high)
            low = high
        return float("inf")

    if not all(np.isfinite(v).all() for v in jax.tree.leaves(loop)) or is_unstable():
        return dict.fromkeys(FIELDS, float("nan"))
    _, response = _responses(loop)
    smallest = np.linalg.svd(np.eye(response.shape[1]) + np.asarray(response), compute_uv=False)[:, -1].min()
    decibels, degrees = np.arange(1.0, 81.0), np.arange(2.0, 181.0, 2.0)
    periods = np.unique(np.append(np.linspace(0.0, 10.0, 41)[1:], np.geomspace(10, 200, 40)))
    results = (
        smallest_change(lambda dB: is_unstable(10.0 ** (dB / 20.0)), decibels),
        smallest_change(lambda dB: is_unstable(10.0 ** (-dB / 20.0)), decibels),
        smallest_change(lambda angle: is_unstable(np.exp(-1j * np.deg2rad(angle))), degrees),
        smallest_change(lambda delay: is_unstable(delay=delay), periods) * float(loop.period),
        float(-20.0 * np.log10(smallest)),
    )
    return dict(zip(FIELDS, results, strict=True))


@programs.jit
def _responses(loop: Loop) -> tuple[Array, Array]:
    """Return the frequencies (points,) [rad/s] of the grid, and L (points, m, m)."""
    opening = linear.open_at_input(loop)
    w = crossings.frequency_grid(crossings.poles_of(opening), loop.period)
    L, _ = crossings.in_schur_coordinates(opening).response(jnp.exp(1j * w * loop.period))
    return w, L


def responses(loop: Loop) -> tuple[np.ndarray, np.ndarray]:
    """Return frequencies (points,) [rad/s] and L of each axis with the other axes closed (points, m), for figures.

    Grid intervals are halved until L is a smooth curve. L follows from the sensitivity of all axes, S_jj = 1/(1 + L_j).
    """
    a, b, c = map(np.asarray, linear.open_at_input(loop))
    w = np.unique(_responses(loop)[0])

    def evaluate(w: np.ndarray) -> np.ndarray:
        z = np.exp(1j * w * float(loop.period))[:, None, None]
        L = -c @ np.linalg.solve(z * np.eye(len(a)) - a, np.broadcast_to(b, (w.size, *b.shape)))
        return 1.0 / np.diagonal(np.linalg.inv(np.eye(len(c)) + L), axis1=1, axis2=2) - 1.0

    L = evaluate(w)
    for _ in range(HALVINGS):
        with np.errstate(divide="ignore", invalid="ignore"):  # L may be 0
            steps = np.abs(np.log(L[1:] / L[:-1]))
        middle = ((w[1:] + w[:-1]) / 2.0)[np.any(steps > LARGEST_STEP, axis=1)]
        order = np.argsort(np.append(w, middle))
        w, L = np.append(w, middle)[order], np.append(L, evaluate(middle), axis=0)[order]
    return w, L
