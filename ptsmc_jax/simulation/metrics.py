"""What a run is judged by, accumulated interval by interval inside the rollout."""

from collections.abc import Callable
from itertools import pairwise
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ptsmc_jax.numerics import guards

Scalar = Float[Array, ""]


class Metrics(NamedTuple):
    """Metrics of a run, scalars; units and meaning in `catalogues`. settling_time is NaN where it never settles."""

    terminal_error: Array
    terminal_angle: Array
    window_error: Array
    hold_error: Array
    peak_torque: Array
    peak_torque_delivered: Array
    saturated: Array
    effort: Array
    settling_time: Array
    chattering: Array
    peak_rate: Array
    peak_momentum: Array
    peak_wheel_momentum: Array


class Sight(NamedTuple):
    """What the metrics see of the true state at one time."""

    angle: Array  # to the reference [rad]; for other plants |x_1|
    rate: Array  # `Plant.speed`, |w| [rad/s]
    momentum: Array  # |J w| [N m s]


class Span(NamedTuple):
    """One interval: its ends and the torques at `weights`, quadrature nodes in it (one where the torque is held)."""

    t: Array  # [s]
    t_next: Array
    start: Sight
    end: Sight
    # () -> what the law drives to zero, (m,) [-], for other plants x_1, and its rate [1/s], at both ends
    errors: Callable[[], tuple[tuple[Array, Array], tuple[Array, Array]]]
    arrival: Callable[[], tuple[Array, Array]]  # () -> what the law drives to zero and the angle at t_f, if in here
    last_torque: Array  # (m,) delivered at the end of the interval before [N m]
    commanded: tuple[Array, ...]  # (m,) each [N m]
    delivered: tuple[Array, ...]
    weights: tuple[float, ...]  # sum to 1
    limited: Array  # bool: a limit of the actuators cuts the command
    wheel_momentum: Array | None  # (times, wheels) in the middle and at the end [N m s]


class Judged(NamedTuple):
    """Times that the metrics refer to [s] and the settling angle [rad]."""

    t_f: Array
    t_end: Array
    window: Array
    settling_angle: Array


class Late(NamedTuple):
    """What is judged from t_f on only."""

    error_at_t_f: Array  # (m,)
    angle_at_t_f: Array
    square_error: Array
    hold_error: Array
    variation: Array  # (m,) of the delivered torque [N m]


class Running(NamedTuple):
    """Accumulators; `settled_at` is the end of the last time spent above the settling angle."""

    late: Late
    peak_torque: Array
    peak_torque_delivered: Array
    saturated_for: Array
    effort: Array
    settled_at: Array
    peak_rate: Array
    peak_momentum: Array
    peak_wheel_momentum: Array  # NaN without wheels


def begin(first: Sight, judged: Judged, inputs: int, wheel_momentum: Array | None = None) -> Running:
    """Accumulators at t = 0 for a plant with this many inputs; wheel_momentum: (wheels,) [N m s]."""
    zero = jnp.zeros_like(judged.t_f)
    stored = jnp.full_like(zero, jnp.nan) if wheel_momentum is None else jnp.max(jnp.abs(wheel_momentum))
    return Running(
        late=Late(jnp.zeros(inputs), zero, zero, zero, jnp.zeros(inputs)),
        peak_torque=zero,
        peak_torque_delivered=zero,
        saturated_for=zero,
        effort=zero,
        settled_at=jnp.where(_unsettled(first, judged), jnp.inf, 0.0),
        peak_rate=first.rate,
        peak_momentum=first.momentum,
        peak_wheel_momentum=stored,
    )


def update(running: Running, span: Span, judged: Judged) -> Running:
    """Accumulators after one interval; one of length zero changes nothing."""
    dt = span.t_next - span.t
    lasts = dt > 0.0
    delivered = span.delivered
    largest, largest_delivered = (
        jnp.max(jnp.stack([jnp.max(jnp.abs(u)) for u in torques])) for torques in (span.commanded, delivered)
    )
    effort = sum(w * jnp.sum(jnp.abs(v)) for w, v in zip(span.weights, delivered, strict=True))

    # the angle falls below the threshold inside the interval: linear interpolation; stays above: not yet settled
    above, above_next = _unsettled(span.start, judged), _unsettled(span.end, judged)
    drop = jnp.where(above & ~above_next, span.start.angle - span.end.angle, 1.0)
    crossing = span.t + dt * (span.start.angle - judged.settling_angle) / drop
    settled_at = jnp.where(above_next, jnp.inf, jnp.where(above, crossing, running.settled_at))

    new = running._replace(
        peak_torque=jnp.maximum(running.peak_torque, largest),
        peak_torque_delivered=jnp.maximum(running.peak_torque_delivered, largest_delivered),
        saturated_for=running.saturated_for + dt * span.limited,
        effort=running.effort + dt * effort,
        settled_at=settled_at,
        peak_rate=jnp.maximum(running.peak_rate, span.end.rate),
        peak_momentum=jnp.maximum(running.peak_momentum, span.end.momentum),
        peak_wheel_momentum=running.peak_wheel_momentum
        if span.wheel_momentum is None
        else jnp.maximum(running.peak_wheel_momentum, jnp.max(jnp.abs(span.wheel_momentum))),
    )
    late = jax.lax.cond(
        lasts & (span.t_next >= judged.t_f),
        lambda: _late(running.late, span, judged),
        lambda: running.late,
    )
    return guards.select(lasts, new, running)._replace(late=late)


def _late(late: Late, span: Span, judged: Judged) -> Late:
    """What is judged from t_f on, after an interval that reaches t_f."""
    delivered, errors = span.delivered, span.errors()
    crosses = span.t < judged.t_f
    error_at_t_f, angle_at_t_f = jax.lax.cond(crosses, span.arrival, lambda: (late.error_at_t_f, late.angle_at_t_f))
    # total variation after t_f: the jump at the start of the interval, then what happens inside
    jump = jnp.where(span.t > judged.t_f, jnp.abs(delivered[0] - span.last_torque), 0.0)
    inside = sum((jnp.abs(v - u) for u, v in pairwise(delivered)), start=jnp.zeros_like(jump))
    error_next, _ = errors[1]
    held = jnp.maximum(late.hold_error, guards.norm(error_next))
    return Late(
        error_at_t_f=error_at_t_f,
        angle_at_t_f=angle_at_t_f,
        square_error=late.square_error + _square_error(span, *errors, judged),
        hold_error=jnp.where(span.t_next > judged.t_f, held, late.hold_error),
        variation=late.variation + jump + jnp.where(span.t >= judged.t_f, inside, 0.0),
    )


def finish(running: Running, judged: Judged) -> Metrics:
    """Metrics of the run from its accumulators."""
    late, still = running.late, judged.t_end - judged.t_f
    terminal_error = guards.norm(late.error_at_t_f)
    chattering = jnp.max(late.variation) / jnp.where(still > 0.0, still, 1.0)
    return Metrics(
        terminal_error=terminal_error,
        terminal_angle=late.angle_at_t_f,
        window_error=guards.sqrt(late.square_error / judged.window),
        hold_error=jnp.maximum(late.hold_error, terminal_error),
        peak_torque=running.peak_torque,
        peak_torque_delivered=running.peak_torque_delivered,
        saturated=jnp.where(jnp.isnan(running.effort), jnp.nan, running.saturated_for / judged.t_end),
        effort=running.effort,
        settling_time=jnp.where(jnp.isfinite(running.settled_at), running.settled_at, jnp.nan),
        chattering=chattering,
        peak_rate=running.peak_rate,
        peak_momentum=running.peak_momentum,
        peak_wheel_momentum=running.peak_wheel_momentum,
    )


def unbounded(found: Metrics, first: Running) -> Array:
    """Whether a metric ends infinite or NaN: the square of what it is made of is beyond the largest number, say.

    first: accumulators at t = 0, where a metric that the plant lacks is NaN already. A settling time need not be there.
    """
    every = found._replace(settling_time=jnp.zeros_like(found.effort))._asdict()
    lacking = {name: jnp.isnan(getattr(first, name, 0.0)) for name in every}
    return jnp.any(jnp.stack([jnp.isinf(v) | (jnp.isnan(v) & ~lacking[name]) for name, v in every.items()]))


def _unsettled(sight: Sight, judged: Judged) -> Array:
    return ~(sight.angle < judged.settling_angle)  # an angle that is no number is not settled


def _square_error(span: Span, start: tuple, end: tuple, judged: Judged) -> Scalar:
    """Integral of |error|^2 over the part of the interval inside the window; fourth order, once differentiable in t_f.

    The error in between is the cubic through both ends and slopes (Hermite), its square the parabola through the ends
    and the middle, integrated exactly.
    """
    dt = span.t_next - span.t
    (error, rate), (error_next, rate_next) = start, end
    middle = (error + error_next) / 2 + dt / 8 * (rate - rate_next)
    g0, g1, g2 = (jnp.sum(e * e) for e in (error, middle, error_next))
    return in_window(span.t, span.t_next, (g0, g1, g2), judged)


def in_window(t: Array, t_next: Array, squares: tuple[Array, Array, Array], judged: Judged) -> Array:
    """Integral over the part of an interval inside the window of the parabola through its start, middle and end [s]."""
    dt, (g0, g1, g2) = t_next - t, squares

    def fraction(time: Array) -> Array:
        return jnp.clip((time - t) / dt, 0.0, 1.0)

    def primitive(x: Array) -> Array:
        return x * (g0 + x * ((-3 * g0 + 4 * g1 - g2) / 2 + x * (2 * g0 - 4 * g1 + 2 * g2) / 3))

    return dt * (primitive(fraction(judged.t_f + judged.window)) - primitive(fraction(judged.t_f)))
