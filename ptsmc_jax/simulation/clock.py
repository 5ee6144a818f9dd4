"""The times at which things happen: graded grid (continuous loop), anchored and flight clock (sampled loop).

Each clock turns t_f and delta into `Ticks`, intervals in order of time. Their number is fixed when the clock is built;
intervals that lie before t = 0 or after t_end have length zero and count for nothing.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ptsmc_jax.devices.ticks import Ticks
from ptsmc_jax.numerics import guards
from ptsmc_jax.numerics.pytrees import Leaf, Scalar, pytree, vector

COARSEST = 0.25  # of the time to go that a step before the hand-over may be: the window error is then 5e-4 off


def _not_above(t: Array, limit: Scalar, rounding: Scalar | float = 0.0) -> Array:
    """min(t, limit), with the derivative of `limit` where they are equal; rounding: what counts as equal."""
    return jnp.where(t < limit - rounding, t, limit)


def _whole(t: Array, t_next: Array, hold: Array) -> Ticks:
    """Intervals counted from the first, none of them a partial one."""
    return Ticks(t, t_next, hold, jnp.arange(t.size, dtype=jnp.int32), jnp.ones_like(t), jnp.zeros_like(hold))


@pytree
@dataclass(frozen=True)
class Anchored:
    """Control clock with a sample at the hand-over t_s: t_k = t_s + (k - before) period.

    Everything, the noise too, moves with t_s, so a run depends smoothly on delta and t_f. The first period, from t = 0,
    is a partial one; its noise is blended with the next sample's so that no state jumps where it vanishes. There slopes
    by delta and t_f are one-sided, and what is summed over samples, the chattering, jumps by one sample's share.
    """

    period: Leaf  # h [s]
    t_end: Leaf  # [s]
    before: int = field(metadata={"static": True})  # samples before the hand-over, at least t_s / period
    after: int = field(metadata={"static": True})  # samples from the hand-over on
    sampled: ClassVar[bool] = True
    anchored: ClassVar[bool] = True

    @property
    def count(self) -> int:
        """How many samples there are."""
        return self.before + self.after

    def long_enough_for(self, others: Sequence[Any]) -> "Anchored":
        """The clock with as many samples on either side of the hand-over as the longest of these clocks."""
        return replace(self, before=max(one.before for one in others), after=max(one.after for one in others))

    def ticks(self, t_f: Scalar, delta: Scalar) -> Ticks:
        """Control periods for this prescribed time and delta [s]."""
        sample = jnp.arange(-self.before, self.after, dtype=jnp.int32)
        # one array of nodes, so that one interval ends where, to the last bit, the next begins
        nominal = (t_f - delta) + jnp.arange(-self.before, self.after + 1).astype(float) * self.period
        # a sample that rounding alone puts after t = 0 is the one there: else two of them, and slopes between their two
        begun = nominal > guards.rounding(self.period, t_f)
        nodes = _not_above(jnp.where(begun, nominal, 0.0), self.t_end, guards.rounding(self.period, self.t_end))
        t, t_next = nodes[:-1], nodes[1:]
        # told by where it starts: its share of a whole one may be 1 or more by rounding, and has slopes there, too
        partial = ~begun[:-1]
        share = jnp.where(partial, (t_next - t) / self.period, 1.0)
        return Ticks(t, t_next, sample >= 0, sample, share, partial)


@pytree
@dataclass(frozen=True)
class Flight:
    """Control clock as flown: samples at k period from t = 0, the hand-over at the first one not before t_s."""

    period: Leaf  # h [s]
    t_end: Leaf  # [s]
    count: int = field(metadata={"static": True})  # samples, at least t_end / period
    sampled: ClassVar[bool] = True
    anchored: ClassVar[bool] = False

    def long_enough_for(self, others: Sequence[Any]) -> "Flight":
        """The clock with as many samples as the longest of these clocks."""
        return replace(self, count=max(one.count for one in others))

    def ticks(self, t_f: Scalar, delta: Scalar) -> Ticks:
        """Control periods for this prescribed time and delta [s]."""
        nominal = jnp.arange(self.count + 1).astype(float) * self.period
        nodes = _not_above(nominal, self.t_end, guards.rounding(self.period, self.t_end))
        t, t_next = nodes[:-1], nodes[1:]
        hold = t >= t_f - delta - guards.rounding(self.period, t_f)  # which must not cost a period
        return _whole(t, t_next, hold)


@pytree
@dataclass(frozen=True)
class Graded:
    """Integration grid of the continuous loop, graded toward t_f; nodes at t_s, t_f, t_f + window and `saves`.

    Before the hand-over nodes are uniform in a ln(tau) + tau / max_step, tau = t_f - t, and uniform after it.
    """

    t_end: Leaf  # [s]
    window: Leaf  # [s]
    max_step: Leaf  # largest step [s]
    saves: Leaf  # (m,) further nodes [s]
    before: int = field(metadata={"static": True})  # steps before the hand-over, more than t_s / max_step
    after: int = field(metadata={"static": True})  # steps after it
    sampled: ClassVar[bool] = False
    anchored: ClassVar[bool] = False

    @property
    def count(self) -> int:
        """How many steps there are."""
        return self.before + self.after

    def long_enough_for(self, others: Sequence[Any]) -> "Graded":
        """The clock itself: its number of steps follows from its own accuracy."""
        return self

    def ticks(self, t_f: Scalar, delta: Scalar) -> Ticks:
        """Integration steps for this prescribed time and delta [s]."""
        t_s = t_f - delta
        early = self._graded(t_f, delta)
        early = jnp.sort(jnp.concatenate([early, jnp.clip(self.saves, 0.0, t_s)]))
        extra = jnp.stack([t_f, _not_above(t_f + self.window, self.t_end)])
        late = t_s + (self.t_end - t_s) * jnp.arange(self.after + 1).astype(float) / self.after
        late = late.at[-1].set(self.t_end)
        late = jnp.sort(jnp.concatenate([late, extra, jnp.clip(self.saves, t_s, self.t_end)]))
        t, t_next = jnp.concatenate([early[:-1], late[:-1]]), jnp.concatenate([early[1:], late[1:]])
        hold = jnp.arange(t.size) >= early.size - 1
        return _whole(t, t_next, hold)

    def too_coarse(self, t_f: Any, delta: Any, xp: Any = jnp) -> Any:
        """Whether steps are beyond `COARSEST`, as where t_f is twice that which the grid was made for; times in [s]."""
        return self._grading(t_f, delta, xp) < 1.0 / COARSEST

    def _grading(self, t_f: Any, delta: Any, xp: Any = jnp) -> Any:
        """The weight a of ln(tau): how many steps there are while the time to go falls to 1/e, but for `max_step`."""
        return (self.before - (t_f - delta) / self.max_step) / xp.log(t_f / delta)

    def _graded(self, t_f: Scalar, delta: Scalar) -> Float[Array, " nodes"]:
        """Nodes from 0 to the hand-over [s]."""
        a = self._grading(t_f, delta)
        start, end = a * jnp.log(t_f) + t_f / self.max_step, a * jnp.log(delta) + delta / self.max_step
        level = start + (end - start) * jnp.arange(self.before + 1).astype(float) / self.before

        def newton(u: Array) -> Array:  # on a u + e^u / max_step = level, u = ln tau: convex, so from above it is safe
            slope = a + jnp.exp(u) / self.max_step
            return u - (a * u + jnp.exp(u) / self.max_step - level) / slope

        u = jax.lax.fori_loop(0, 40, lambda _, u: newton(u), jnp.full_like(level, jnp.log(t_f)))
        u = newton(jax.lax.stop_gradient(u))  # one step from the root has the root's exact derivative
        return (t_f - jnp.exp(u)).at[0].set(0.0).at[-1].set(t_f - delta)


def anchored(period: float, t_end: float, t_f_max: float, longest_after: float) -> Anchored:
    """Anchored clock for any t_f up to t_f_max and any hand-over at most longest_after before t_end; all in s."""
    before, after = math.ceil(t_f_max / period), math.ceil(longest_after / period) + 1
    return Anchored(vector(period), vector(t_end), before, after)


def flight(period: float, t_end: float) -> Flight:
    """Flight clock; period and t_end in s."""
    return Flight(vector(period), vector(t_end), math.ceil(t_end / period))


def graded(
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
    """Grid of the continuous loop.

    200 graded steps and at most t_f/200 each leave 1e-8 in the states of the paper's cases, and the error falls with
    the fourth power. Chains take 3 n - 4 times as many, which leaves 1e-9 of the largest state up to order 5 before the
    hand-over. Explicit steps must resolve the smooth sign: where s enters a layer of width 0.02 after the hand-over,
    under a disturbance that no observer takes off, 3e-5 are left in the last state and 3e-6 in x_1 (of 1).

    Args:
        t_f: prescribed time [s].
        delta: the hand-over is so long before it [s].
        t_end: end of the run [s].
        window: after t_f, a node at its end [s].
        hold_rate: fastest decay after the hand-over [1/s].
        frequency: fastest angular frequency [rad/s].
        layer: fastest rates of the smooth sign's boundary layer before and after the hand-over [1/s].
        saves: further nodes [s].
        order: of a chain, 1 otherwise.
    """
    before, after = (math.ceil(steps) for steps in graded_steps(t_f, delta, t_end, hold_rate, frequency, layer, order))
    times = np.asarray(saves, dtype=float).reshape(-1)
    step, _ = _largest_steps(t_f, hold_rate, frequency, layer, order)
    end, width, largest = (vector(v) for v in (t_end, window, step))
    return Graded(end, width, largest, vector(times), before, after)


def graded_steps(
    t_f: float,
    delta: float,
    t_end: float,
    hold_rate: float,
    frequency: float,
    layer: tuple[float, float],
    order: int,
) -> tuple[float, float]:
    """How many steps `graded` takes before and after the hand-over, before rounding up; may be infinite."""
    before, after = _largest_steps(t_f, hold_rate, frequency, layer, order)
    with np.errstate(divide="ignore"):
        uniform = float(np.divide(t_f - delta, before))
        return 200.0 * _refinement(order) + uniform, float(np.divide(t_end - t_f + delta, after))


def _refinement(order: int) -> int:
    """How many times as many steps a chain takes as a second-order motion."""
    return max(1, 3 * order - 4)


def _largest_steps(
    t_f: float, hold_rate: float, frequency: float, layer: tuple[float, float], order: int
) -> tuple[float, float]:
    """Largest steps before and after the hand-over [s]."""
    rapid = 0.3 / max(frequency, 1e-12)
    before = min(t_f / 200.0 / _refinement(order), rapid, 1.5 / max(layer[0], 1e-12))
    return before, min(t_f / 50.0, 0.1 / max(hold_rate, 1e-300), rapid, 1.5 / max(layer[1], 1e-12))
