"""Clocks: the sample times of the sampled loop (`Sampled`) and the steps of the continuous loop (`Graded`).

Each clock turns t_f and delta into `Ticks`, which are intervals in order of time. Their number is fixed when the clock
is built. Intervals before t = 0 or after t_end have length zero and change nothing.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from types import ModuleType
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ptsmc_jax.devices.ticks import Ticks
from ptsmc_jax.numerics import guards
from ptsmc_jax.numerics.pytrees import Leaf, Scalar, pytree, vector

# longest step before the hand-over, divided by the time to t_f; such steps change window_error by 0.05 % of its value
LARGEST_STEP_FRACTION = 0.25


def _limit_time(t: Array, limit: Scalar, rounding: Scalar | float = 0.0) -> Array:
    """Return min(t, limit), with the derivative of `limit` if they are equal within `time_tolerance`."""
    return jnp.where(t < limit - rounding, t, limit)


def _full_intervals(t: Array, t_next: Array, hold: Array) -> Ticks:
    """Return the `Ticks` of complete intervals, with sample numbers from 0."""
    return Ticks(t, t_next, hold, jnp.arange(t.size, dtype=jnp.int32), jnp.ones_like(t), jnp.zeros_like(hold))


@pytree
@dataclass(frozen=True)
class Sampled:
    """Control clock of a sampled loop: an anchored clock, or the clock of a flight computer.

    Anchored clock: samples are whole periods before and after the hand-over, so all samples and their noise move with
    it. A run depends smoothly on delta and t_f. The first period, from t = 0, is partial. For some delta and t_f its
    length is zero. Its noise is blended with the noise of the next sample, so that the states are continuous there.
    Derivatives by delta and t_f are one-sided there, and the chattering jumps by the contribution of one sample.

    Flight clock: sample k is at k periods from t = 0. The hand-over is the first sample at or after t_f - delta.

    Clocks of both kinds with the same number of samples share compiled programs.
    """

    period: Leaf  # h [s]
    t_end: Leaf  # [s]
    anchored: Leaf  # 1: anchored clock; 0: flight clock
    count: int = field(metadata={"static": True})  # number of samples; an anchored clock needs t_end / period + 1
    sampled: ClassVar[bool] = True

    def long_enough_for(self, clocks: Sequence["Sampled"]) -> "Sampled":
        """Return this clock with as many samples as the longest of several clocks."""
        return replace(self, count=max(clock.count for clock in clocks))

    def ticks(self, t_f: Scalar, delta: Scalar) -> Ticks:
        """Control periods for this prescribed time and delta [s]."""
        is_anchored, tolerance = jnp.asarray(self.anchored) > 0.5, guards.time_tolerance(self.period, t_f)
        numbers = jnp.arange(self.count + 1, dtype=jnp.int32)
        before = jnp.ceil(jax.lax.stop_gradient((t_f - delta) / self.period)).astype(jnp.int32)
        # one array of nodes, so that each interval ends exactly where the next begins
        anchored_nodes = (t_f - delta) + (numbers - before).astype(float) * self.period
        nominal = jnp.where(is_anchored, anchored_nodes, numbers.astype(float) * self.period)
        # rounding may put the sample at t = 0 slightly after it; then there would be two samples
        has_started = ~is_anchored | (nominal > tolerance)
        nodes = _limit_time(
            jnp.where(has_started, nominal, 0.0), self.t_end, guards.time_tolerance(self.period, self.t_end)
        )
        t, t_next = nodes[:-1], nodes[1:]
        sample = numbers[:-1] - jnp.where(is_anchored, before, 0)
        # a period that starts at t = 0 is partial, even if rounding makes it as long as a full period or longer
        partial = ~has_started[:-1]
        fraction = jnp.where(partial, (t_next - t) / self.period, 1.0)
        # rounding must not delay the hand-over of a flight computer
        hold = jnp.where(is_anchored, sample >= 0, t >= t_f - delta - tolerance)
        return Ticks(t, t_next, hold, sample, fraction, partial)


@pytree
@dataclass(frozen=True)
class Graded:
    """Integration grid of the continuous loop, with shorter steps near t_f.

    The hand-over t_s = t_f - delta, t_f, t_f + window and `saves` are nodes. Before the hand-over, the nodes have equal
    distances in the variable a ln(tau) + tau / max_step, with tau = t_f - t. After it, they have equal distances in t.
    """

    t_end: Leaf  # [s]
    window: Leaf  # length of the window after t_f [s]
    max_step: Leaf  # largest step [s]
    saves: Leaf  # (m,) times at which the grid needs a node [s]
    before: int = field(metadata={"static": True})  # number of steps before the hand-over; more than t_s / max_step
    after: int = field(metadata={"static": True})  # number of steps after the hand-over
    sampled: ClassVar[bool] = False
    anchored: ClassVar[float] = 0.0

    @property
    def count(self) -> int:
        """The number of steps."""
        return self.before + self.after

    def long_enough_for(self, clocks: Sequence["Graded"]) -> "Graded":
        """Return this clock unchanged: its accuracy determines its number of steps, not the longest of the clocks."""
        return self

    def ticks(self, t_f: Scalar, delta: Scalar) -> Ticks:
        """Integration steps for this prescribed time and delta [s]."""
        t_s = t_f - delta
        nodes_before = self._nodes_before_hand_over(t_f, delta)
        nodes_before = jnp.sort(jnp.concatenate([nodes_before, jnp.clip(self.saves, 0.0, t_s)]))
        further_nodes = jnp.stack([t_f, _limit_time(t_f + self.window, self.t_end)])
        nodes_after = t_s + (self.t_end - t_s) * jnp.arange(self.after + 1).astype(float) / self.after
        nodes_after = nodes_after.at[-1].set(self.t_end)
        nodes_after = jnp.sort(jnp.concatenate([nodes_after, further_nodes, jnp.clip(self.saves, t_s, self.t_end)]))
        t, t_next = (
            jnp.concatenate([nodes_before[:-1], nodes_after[:-1]]),
            jnp.concatenate([nodes_before[1:], nodes_after[1:]]),
        )
        hold = jnp.arange(t.size) >= nodes_before.size - 1
        return _full_intervals(t, t_next, hold)

    def is_too_coarse(self, t_f: Any, delta: Any, xp: ModuleType = jnp) -> Any:
        """Return whether steps are longer than `LARGEST_STEP_FRACTION` allows.

        This happens, for example, if t_f is twice the t_f that the grid was built for.

        Args:
            t_f: prescribed time [s].
            delta: time from the hand-over to t_f [s].
            xp: JAX's or NumPy's functions.
        """
        return self._grading_weight(t_f, delta, xp) < 1.0 / LARGEST_STEP_FRACTION

    def _grading_weight(self, t_f: Any, delta: Any, xp: ModuleType = jnp) -> Any:
        """Return the weight a in a ln(tau) + tau / max_step, by which nodes are spaced before the hand-over.

        If `max_step` is infinite, tau = t_f - t falls to 1/e in a steps.
        """
        return (self.before - (t_f - delta) / self.max_step) / xp.log(t_f / delta)

    def _nodes_before_hand_over(self, t_f: Scalar, delta: Scalar) -> Float[Array, " nodes"]:
        """Return the nodes from 0 to the hand-over [s]."""
        a = self._grading_weight(t_f, delta)
        start, end = a * jnp.log(t_f) + t_f / self.max_step, a * jnp.log(delta) + delta / self.max_step
        level = start + (end - start) * jnp.arange(self.before + 1).astype(float) / self.before

        # solves a u + e^u / max_step = level for u = ln tau; the function is convex, so Newton converges from above
        def newton(u: Array) -> Array:
            derivative = a + jnp.exp(u) / self.max_step
            return u - (a * u + jnp.exp(u) / self.max_step - level) / derivative

        u = jax.lax.fori_loop(0, 40, lambda _, u: newton(u), jnp.full_like(level, jnp.log(t_f)))
        u = newton(jax.lax.stop_gradient(u))  # one step from the root gives its exact derivative
        return (t_f - jnp.exp(u)).at[0].set(0.0).at[-1].set(t_f - delta)


def anchored_clock(period: float, t_end: float) -> Sampled:
    """Return the anchored clock; period and t_end in s."""
    return Sampled(vector(period), vector(t_end), vector(1.0), math.ceil(t_end / period) + 1)


def flight_clock(period: float, t_end: float) -> Sampled:
    """Return the flight clock; period and t_end in s. It has as many samples as the anchored clock."""
    return replace(anchored_clock(period, t_end), anchored=vector(0.0))


def graded_clock(
    t_f: float,
    delta: float,
    t_end: float,
    window: float,
    hold_rate: float,
    frequency: float,
    layer: tuple[float, float],
    saves: object = (),
    order: int = 1,
) -> Graded:
    """Return the integration grid of the continuous loop.

    It has 200 graded steps, each at most t_f/200. The error in the states is then about 1e-8 in the cases of the paper,
    and falls with the fourth power of the step. Chains of order n have 3 n - 4 times as many steps, for an error of
    1e-9 of the largest state. The explicit steps must also resolve the boundary layer. The largest error was 3e-5 in
    the last state, for a boundary layer of thickness 0.02 and a disturbance without observer.

    Args:
        t_f: prescribed time [s].
        delta: time from the hand-over to t_f [s].
        t_end: end of the run [s].
        window: length of the window after t_f, which ends at a node [s].
        hold_rate: fastest decay after the hand-over [1/s].
        frequency: fastest angular frequency [rad/s].
        layer: fastest rates in the boundary layer before and after the hand-over [1/s].
        saves: further nodes [s].
        order: order of a chain, otherwise 1.
    """
    before, after, step_before = graded_steps(t_f, delta, t_end, hold_rate, frequency, layer, order)
    save_times = np.asarray(saves, dtype=float).reshape(-1)
    steps = math.ceil(before), math.ceil(after)
    return Graded(vector(t_end), vector(window), vector(step_before), vector(save_times), *steps)


def graded_steps(
    t_f: float,
    delta: float,
    t_end: float,
    hold_rate: float,
    frequency: float,
    layer: tuple[float, float],
    order: int,
) -> tuple[float, float, float]:
    """Return the steps of `graded_clock`.

    Args:
        t_f: prescribed time [s].
        delta: time from the hand-over to t_f [s].
        t_end: end of the run [s].
        hold_rate: fastest decay after the hand-over [1/s].
        frequency: fastest angular frequency [rad/s].
        layer: fastest rates in the boundary layer before and after the hand-over [1/s].
        order: order of a chain, otherwise 1.

    Returns:
        The number of steps before and after the hand-over, not rounded up and perhaps infinite, and the largest step
        before the hand-over [s].
    """
    refinement = max(1, 3 * order - 4)  # ratio of the number of steps for a chain to the number for a motion of order 2
    oscillation_step = 0.3 / max(frequency, 1e-12)
    before = min(t_f / 200.0 / refinement, oscillation_step, 1.5 / max(layer[0], 1e-12))
    after = min(t_f / 50.0, 0.1 / max(hold_rate, 1e-300), oscillation_step, 1.5 / max(layer[1], 1e-12))
    with np.errstate(divide="ignore"):
        uniform = float(np.divide(t_f - delta, before))
        return 200.0 * refinement + uniform, float(np.divide(t_end - t_f + delta, after)), before
