"""The table of metrics of a run: name, unit, meaning and functions that compute it. `METRICS` is the table.

Reading a scenario needs only names, units and meanings, so JAX is imported when a metric is first computed. Pointing
errors share one accumulator, see `pointing_report`.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import jax.numpy as jnp
    from jaxtyping import Array

    from ptsmc_jax.numerics import guards, integrators
    from ptsmc_jax.simulation import interval as intervals
    from ptsmc_jax.simulation.interval import Arrival, Criteria, Errors, Interval, Snapshot, Start
    from ptsmc_jax.simulation.metrics import Running
else:

    class _Deferred:
        """A module that is imported at its first use."""

        def __init__(self, name: str):
            self._name = name

        def __getattr__(self, name: str) -> Any:
            return getattr(importlib.import_module(self._name), name)

    jnp, guards = _Deferred("jax.numpy"), _Deferred("ptsmc_jax.numerics.guards")
    integrators, intervals = _Deferred("ptsmc_jax.numerics.integrators"), _Deferred("ptsmc_jax.simulation.interval")


def _zero(start: Start, criteria: Criteria) -> Array:
    return jnp.zeros_like(criteria.t_f)


@dataclass(frozen=True)
class Metric:
    """A metric of a run.

    `init` returns the initial accumulator, called memory. `update` changes it after every interval of positive length.
    `update_after_t_f` instead changes it only after intervals that end at t_f or later; it also gets the errors at the
    ends of the interval. `value` returns the metric at t_end.
    """

    unit: str
    meaning: str
    of_states: tuple[str, str] | None = None  # unit and meaning for chains and systems; None: only for spacecraft
    table: str | None = None  # only runs with this table in the scenario have the metric; None: all runs
    init: Callable[[Start, Criteria], Any] = _zero  # returns None if the run lacks the metric
    update: Callable[[Any, Interval, Criteria], Any] | None = None
    update_after_t_f: Callable[[Any, Interval, Errors, Criteria], Any] | None = None
    value: Callable[[Any, Running, Criteria], Array] = lambda memory, running, criteria: memory
    may_be_nan: bool = False  # whether the metric may be NaN in a run that did not diverge


def _peak(largest_in: Callable[[Interval], Any], init: Callable[[Start, Criteria], Any] = _zero) -> dict[str, Any]:
    """Return `init` and `update` of the metric that is the largest value over all intervals.

    Args:
        largest_in: function from an interval to its largest value.
        init: value at t = 0, by default 0.
    """
    return {"init": init, "update": lambda memory, interval, criteria: jnp.maximum(memory, largest_in(interval))}


def _hold_peak(at_end: Callable[[Interval, Errors], Array], at_t_f: Callable[[Arrival], Array]) -> dict[str, Any]:
    """Return the functions of the metric that is the largest value at t_f and at the ends of intervals after t_f."""

    def update(memory: Array, interval: Interval, errors: Errors, criteria: Criteria) -> Array:
        return jnp.where(interval.t_next > criteria.t_f, jnp.maximum(memory, at_end(interval, errors)), memory)

    def value(memory: Array, running: Running, criteria: Criteria) -> Array:
        return jnp.maximum(memory, at_t_f(running.arrival))

    return {"update_after_t_f": update, "value": value}


def _window_rms(squares: Callable[[Interval, Errors], tuple[Array, Array, Array]]) -> dict[str, Any]:
    """Return the functions of the metric that is the RMS over the window after t_f.

    The memory is the integral of the parabola through the squares at the start, the middle and the end of each
    interval. It is of fourth order and once differentiable in t_f.
    """

    def update(memory: Array, interval: Interval, errors: Errors, criteria: Criteria) -> Array:
        values = squares(interval, errors)
        return memory + intervals.integral_in_window(interval.t, interval.t_next, values, criteria)

    def value(memory: Array, running: Running, criteria: Criteria) -> Array:
        return guards.sqrt(memory / criteria.window)

    return {"update_after_t_f": update, "value": value}


def _squared_errors(interval: Interval, errors: Errors) -> tuple[Array, Array, Array]:
    """Return |error|^2 at start, middle and end. The middle error is from cubic Hermite interpolation."""
    middle = integrators.hermite_middle(*errors, interval.length)
    g0, g1, g2 = (jnp.sum(e * e) for e in (errors.start, middle, errors.end))
    return g0, g1, g2


def _squared_angles(interval: Interval, errors: Errors) -> tuple[Array, Array, Array]:
    """Return angle^2 at start, middle and end. The angle has a kink at zero, so the error vector is interpolated."""
    start, middle, end = interval.start.angle, interval.middle_angle(), interval.end.angle
    return start * start, middle * middle, end * end


def _largest_component(torques: tuple[Array, ...]) -> Array:
    return jnp.max(jnp.stack([jnp.max(jnp.abs(u)) for u in torques]))


def _largest_value(wheel_values: Any) -> Array:
    return jnp.max(jnp.abs(wheel_values))


def _limited_fraction(memory: Array, running: Running, criteria: Criteria) -> Array:
    """Return the fraction of the time in which a limit cuts the command, or NaN if a delivered torque was NaN."""
    return jnp.where(jnp.isnan(running.memories["effort"]), jnp.nan, memory / criteria.t_end)


def _add_effort(memory: Array, interval: Interval, criteria: Criteria) -> Array:
    torques = interval.torques
    norms = (w * jnp.sum(jnp.abs(u)) for w, u in zip(torques.weights, torques.delivered, strict=True))
    return memory + interval.length * sum(norms)


def _is_unsettled(snapshot: Snapshot, criteria: Criteria) -> Array:
    return ~(snapshot.angle < criteria.settling_angle)  # true if the angle is NaN


def _update_settling_time(memory: Array, interval: Interval, criteria: Criteria) -> Array:
    """Return the last time at which the angle falls below the settling angle [s]; infinite while it is above."""
    start, end = interval.start, interval.end
    is_above, is_above_next = _is_unsettled(start, criteria), _is_unsettled(end, criteria)
    decrease = jnp.where(is_above & ~is_above_next, start.angle - end.angle, 1.0)
    crossing = interval.t + interval.length * (start.angle - criteria.settling_angle) / decrease
    return jnp.where(is_above_next, jnp.inf, jnp.where(is_above, crossing, memory))


def _add_torque_variation(memory: Array, interval: Interval, errors: Errors, criteria: Criteria) -> Array:
    """Return the total variation of the torque delivered from t_f on, (m,) [N m]."""
    delivered = interval.torques.delivered
    tolerance = guards.time_tolerance(interval.length, criteria.t_f)  # the jump of a sample at t_f must not count
    jump = jnp.where(interval.t > criteria.t_f + tolerance, jnp.abs(delivered[0] - interval.last_torque), 0.0)
    change_inside = sum((jnp.abs(v - u) for u, v in pairwise(delivered)), start=jnp.zeros_like(jump))
    return memory + jump + jnp.where(interval.t >= criteria.t_f - tolerance, change_inside, 0.0)


def _variation_per_second(memory: Array, running: Running, criteria: Criteria) -> Array:
    length = criteria.t_end - criteria.t_f
    return jnp.max(memory) / jnp.where(length > 0.0, length, 1.0)


def _update_residual_amplitude(memory: Array, interval: Interval, criteria: Criteria) -> Array:
    """Return the largest amplitude of the flexible modes at the ends of intervals from t_f on.

    Before t_f the memory is the initial amplitude. It does not count and is replaced at t_f.
    """
    amplitude = interval.end.modal_amplitude
    assert amplitude is not None
    starts_before_t_f, reaches_t_f = interval.t < criteria.t_f, interval.t_next >= criteria.t_f
    return jnp.where(reaches_t_f, jnp.where(starts_before_t_f, amplitude, jnp.maximum(memory, amplitude)), memory)


METRICS = {
    "terminal_error": Metric(
        "-", "2-norm of the attitude error vector at t_f", ("x1", "|x_1| at t_f"),
        value=lambda memory, running, criteria: guards.norm(running.arrival.error)),
    "terminal_angle": Metric(
        "rad", "angle to the reference attitude at t_f", value=lambda memory, running, criteria: running.arrival.angle),
    "window_error": Metric(
        "-", "RMS of the attitude error vector's 2-norm over the window after t_f",
        ("x1", "RMS of |x_1| over the window after t_f"), **_window_rms(_squared_errors)),
    "hold_error": Metric(
        "-", "largest 2-norm of the attitude error vector from t_f to t_end, at ends of periods",
        ("x1", "largest |x_1| from t_f to t_end, at ends of periods"),
        **_hold_peak(lambda interval, errors: guards.norm(errors.end), lambda arrival: guards.norm(arrival.error))),
    "window_angle": Metric(
        "rad", "RMS of the angle to the reference attitude over the window after t_f", **_window_rms(_squared_angles)),
    "hold_angle": Metric(
        "rad", "largest angle to the reference attitude from t_f to t_end, at ends of periods",
        **_hold_peak(lambda interval, errors: interval.end.angle, lambda arrival: arrival.angle)),
    "peak_torque": Metric(
        "N m", "largest commanded torque about one axis, before the actuator",
        ("u", "largest commanded component of the input, before the actuator"),
        **_peak(lambda interval: _largest_component(interval.torques.commanded))),
    "peak_torque_delivered": Metric(
        "N m", "largest delivered torque about one axis", ("u", "largest delivered component of the input"),
        **_peak(lambda interval: _largest_component(interval.torques.delivered))),
    "saturated": Metric(
        "-", "fraction of the time in which a limit of the actuators cuts the command",
        ("-", "fraction of the time in which a limit of the actuators cuts the command"),
        update=lambda memory, interval, criteria: memory + jnp.where(interval.torques.limited, interval.length, 0.0),
        value=_limited_fraction),
    "effort": Metric(
        "N m s", "integral of the 1-norm of the delivered torque",
        ("u s", "integral of the 1-norm of the delivered input"), update=_add_effort),
    "settling_time": Metric(
        "s", "time from which the angle stays below settling_angle, interpolated between ends of periods",
        ("s", "time from which |x_1| stays below settling_angle, interpolated between ends of periods"),
        init=lambda start, criteria: jnp.where(_is_unsettled(start.snapshot, criteria), jnp.inf, 0.0),
        update=_update_settling_time,
        value=lambda memory, running, criteria: jnp.where(jnp.isfinite(memory), memory, jnp.nan), may_be_nan=True),
    "chattering": Metric(
        "N m/s", "total variation of the delivered torque per second after t_f, largest axis",
        ("u/s", "total variation of the delivered input per second after t_f, largest component"),
        init=lambda start, criteria: jnp.zeros(start.inputs), update_after_t_f=_add_torque_variation,
        value=_variation_per_second),
    "peak_rate": Metric(
        "rad/s", "largest 2-norm of the body rate", ("x2", "largest |x_2|"),
        **_peak(lambda interval: interval.end.rate, lambda start, criteria: start.snapshot.rate)),
    "peak_momentum": Metric(
        "N m s", "largest 2-norm of the body's angular momentum",
        **_peak(lambda interval: interval.end.momentum, lambda start, criteria: start.snapshot.momentum)),
    "peak_wheel_momentum": Metric(
        "N m s", "largest momentum stored in one reaction wheel", table="wheels",
        **_peak(lambda interval: _largest_value(interval.torques.wheel_momentum),
                lambda start, criteria: (
                    None if start.wheel_momentum is None else _largest_value(start.wheel_momentum)))),
    "peak_wheel_torque": Metric(
        "N m", "largest torque of one reaction wheel", table="wheels",
        **_peak(lambda interval: _largest_value(interval.torques.wheel_torque),
                lambda start, criteria: None if start.wheel_momentum is None else _zero(start, criteria))),
    "peak_modal": Metric(
        "sqrt(kg) m", "largest size of the flexible modes' motion, (sum of e^2 + (e'/W)^2)^1/2", table="flexible",
        **_peak(lambda interval: interval.end.modal_amplitude, lambda start, criteria: start.snapshot.modal_amplitude)),
    "residual_modal": Metric(
        "sqrt(kg) m", "largest size of the flexible modes' motion from t_f to t_end", table="flexible",
        init=lambda start, criteria: start.snapshot.modal_amplitude, update=_update_residual_amplitude),
}  # fmt: skip
