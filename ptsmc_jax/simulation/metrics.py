"""The metrics of a run: the table `METRICS`, and the functions `begin`, `update`, `finish` that accumulate them.

A metric is computed interval by interval inside the simulation. The pointing errors have accumulators of their own, see
`pointing`. Start with `Metric` and `METRICS`.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import core
from jaxtyping import Array

from ptsmc_jax.numerics import guards, integrators
from ptsmc_jax.simulation import pointing
from ptsmc_jax.simulation.pointing import ConstantPath, ErrorPath, Pointing, PointingErrors


class Criteria(NamedTuple):
    """Times that the metrics refer to [s], the settling angle [rad], and the observation of pointing errors."""

    t_f: Array
    t_end: Array
    window: Array
    settling_angle: Array
    pointing: Pointing | None = None


class Snapshot(NamedTuple):
    """The true state at one time, as far as the metrics need it."""

    angle: Array  # angle to the reference [rad]; for other plants |x_1|
    rate: Array  # `Plant.speed`, |w| [rad/s]
    momentum: Array | None  # |J w| [N m s]; None: the plant has no momentum
    modal_amplitude: Array | None = None  # `Plant.modal_amplitude` of a flexible body [sqrt(kg) m]


class Start(NamedTuple):
    """Data at t = 0 from which the metrics are initialised."""

    snapshot: Snapshot
    inputs: int  # number of inputs of the plant
    wheel_momentum: Array | None  # (wheels,) [N m s]; None: no wheels
    measured: bool = False  # whether the law gets a measured state instead of the true state


class Arrival(NamedTuple):
    """Error and angle of the true state at t_f; zero until t_f is reached."""

    error: Array  # (m,) error that the law drives to zero [-]; for other plants x_1
    angle: Array  # angle to the reference [rad]


class Errors(NamedTuple):
    """The error that the law drives to zero at both ends of an interval, (m,) [-], and its rate [1/s]."""

    start: Array
    start_rate: Array
    end: Array
    end_rate: Array


class Torques(NamedTuple):
    """Torques of an interval at its quadrature nodes: the start, or both ends, or both ends and the middle."""

    commanded: tuple[Array, ...]  # (m,) each [N m]
    delivered: tuple[Array, ...]  # (m,) each [N m]
    weights: tuple[float, ...]  # quadrature weights of the nodes; they sum to 1
    limited: Array  # bool: a limit of the actuators cuts the command
    wheel_momentum: Array | None  # (times, wheels) in the middle and at the end [N m s]
    wheel_torque: Array | None = None  # (times, wheels) at both ends [N m]


class Interval(NamedTuple):
    """A control period, or a step of the continuous loop."""

    t: Array  # start [s]
    t_next: Array  # end [s]
    start: Snapshot  # true state at the start
    end: Snapshot  # true state at the end
    errors: Callable[[], Errors]  # called only for intervals that end at t_f or later
    # angle in the middle [rad], from the cubic Hermite polynomial of the error; called like `errors`
    middle_angle: Callable[[], Array]
    arrival: Callable[[], Arrival]  # called only for the interval that contains t_f
    last_torque: Array  # (m,) torque delivered at the end of the previous interval [N m]
    torques: Torques
    attitude_error: Callable[[], ErrorPath] | None = None  # pointing error; None: the run has no pointing metrics
    # error of the attitude that is measured at the start; None: the law gets the true attitude
    knowledge_error: Callable[[], ConstantPath] | None = None

    @property
    def length(self) -> Array:
        """The length of the interval [s]."""
        return self.t_next - self.t


def integral_in_window(t: Any, t_next: Any, squares: tuple[Any, Any, Any], criteria: Criteria) -> Any:
    """Integrate a squared error over the part of an interval that is inside the window after t_f.

    The squared error is replaced by the parabola through its values at the start, the middle and the end. The parabola
    may become negative in between, which a square cannot. The integral over a fraction L of the interval is therefore
    at least L^3 / 4 of the whole integral, as for an error that passes linearly through zero.

    Args:
        t: start of the interval [s], an array of JAX or NumPy.
        t_next: end of the interval [s].
        squares: squared error at the start, in the middle and at the end.
        criteria: criteria of the run, with t_f and the window [s].

    Returns:
        The integral [unit of the squares times s].
    """
    dt, (g0, g1, g2) = t_next - t, squares

    def fraction(time: Any) -> Any:
        return ((time - t) / dt).clip(0.0, 1.0)

    def primitive(x: Any) -> Any:
        return x * (g0 + x * ((-3 * g0 + 4 * g1 - g2) / 2 + x * (2 * g0 - 4 * g1 + 2 * g2) / 3))

    begin, end = fraction(criteria.t_f), fraction(criteria.t_f + criteria.window)
    smallest_integral = (end - begin) ** 3 / 4 * (g0 + 4 * g1 + g2) / 6
    window_integral = primitive(end) - primitive(begin)
    xp: Any = np if isinstance(window_integral, np.ndarray) else jnp
    # `maximum` would have another gradient at the ends of the window, where both integrals are zero
    return dt * xp.where(window_integral < smallest_integral, smallest_integral, window_integral)


class Running(NamedTuple):
    """Accumulators of the metrics of a run up to the present time."""

    arrival: Arrival
    memories: dict[str, Array]  # accumulators of the metrics that the run has, by name
    pointing: PointingErrors | None  # accumulators of the pointing errors; None: pointing errors are not observed


def _zero(start: Start, criteria: Criteria) -> Array:
    """Return the initial accumulator 0."""
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
    init: Callable[[Start, Criteria], Array | None] = _zero  # returns None if the run lacks the metric
    update: Callable[[Array, Interval, Criteria], Array] | None = None
    update_after_t_f: Callable[[Array, Interval, Errors, Criteria], Array] | None = None
    value: Callable[[Array, Running, Criteria], Array] = lambda memory, running, criteria: memory
    may_be_nan: bool = False  # whether the metric may be NaN in a run that did not diverge


def _peak(
    largest_in: Callable[[Interval], Any], init: Callable[[Start, Criteria], Array | None] = _zero
) -> dict[str, Any]:
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
        return memory + integral_in_window(interval.t, interval.t_next, values, criteria)

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
    """Return the largest absolute component of several torques (m,)."""
    return jnp.max(jnp.stack([jnp.max(jnp.abs(u)) for u in torques]))


def _largest_value(wheel_values: Any) -> Array:
    """Return the largest absolute value of an array."""
    return jnp.max(jnp.abs(wheel_values))


def _limited_fraction(memory: Array, running: Running, criteria: Criteria) -> Array:
    """Return the fraction of the time in which a limit cuts the command, or NaN if a delivered torque was NaN."""
    return jnp.where(jnp.isnan(running.memories["effort"]), jnp.nan, memory / criteria.t_end)


def _add_effort(memory: Array, interval: Interval, criteria: Criteria) -> Array:
    """Return the effort after an interval: the integral of the 1-norm of the delivered torque."""
    torques = interval.torques
    norms = (w * jnp.sum(jnp.abs(u)) for w, u in zip(torques.weights, torques.delivered, strict=True))
    return memory + interval.length * sum(norms)


def _is_unsettled(snapshot: Snapshot, criteria: Criteria) -> Array:
    """Return whether the angle is not below the settling angle."""
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
    """Return the total variation after t_f per second, of the component with the largest one."""
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


@jax.tree_util.register_pytree_with_keys_class
class Metrics(dict[str, Any]):
    """The metrics of a run, scalars by name; units and meanings are in `catalogues`.

    Each metric is also an attribute. The attribute is NaN if the run does not have the metric.
    """

    def __getattr__(self, name: str) -> Any:
        if name not in METRICS | pointing.METRICS:
            raise AttributeError(f"there is no metric {name!r}; this run has {', '.join(self)}")
        return self[name] if name in self else np.nan * next(iter(self.values()))

    def __missing__(self, name: str) -> Any:
        raise KeyError(f"this run has no metric {name!r}, but it has {', '.join(self)}")

    def tree_flatten_with_keys(self) -> tuple[Iterable, tuple[str, ...]]:
        """Return the values with their keys, and the names."""
        return [(jax.tree_util.DictKey(name), value) for name, value in self.items()], tuple(self)

    @classmethod
    def tree_unflatten(cls, names: tuple[str, ...], values: Iterable) -> "Metrics":
        """Return the metrics of these names and values."""
        return cls(zip(names, values, strict=True))

    def __repr__(self) -> str:
        """Return a line for each metric: its value, or type and shape for many runs or under a transformation."""
        return "\n".join(f"{name:24s} {_format_value(value)}" for name, value in self.items())


def _format_value(value: Any) -> str:
    """Return the text of a metric: a number with six digits, type and shape of an array."""
    if not isinstance(value, jax.Array | np.ndarray | np.number | float):
        return repr(value)  # under transformations a leaf may be a shape or an axis
    is_array = isinstance(value, core.Tracer) or np.ndim(value) > 0
    return f"{type(value).__name__} {np.shape(value)}" if is_array else f"{float(value):.6g}"


def begin(start: Start, criteria: Criteria) -> Running:
    """Return the accumulators at t = 0 (accumulator pattern: `begin`, `update`, `finish`)."""
    arrival = Arrival(jnp.zeros(start.inputs), jnp.zeros_like(criteria.t_f))
    memories = {name: metric.init(start, criteria) for name, metric in METRICS.items()}
    present = {name: memory for name, memory in memories.items() if memory is not None}
    observed, zero = criteria.pointing, jnp.zeros_like(criteria.t_f)
    errors = None if observed is None else pointing.begin_errors(observed, zero, measured=start.measured)
    return Running(arrival, present, errors)


def update(running: Running, interval: Interval, criteria: Criteria) -> Running:
    """Return the accumulators after one more interval. An interval of length zero changes nothing.

    Args:
        running: accumulators before the interval.
        interval: the interval, with the true states at its ends.
        criteria: times [s], settling angle [rad] and observation of pointing errors that the metrics refer to.
    """
    has_length, old = interval.length > 0.0, running.memories
    updated = {
        name: metric.update(old[name], interval, criteria)
        for name, metric in METRICS.items()
        if name in old and metric.update
    }
    memories_after_t_f = {
        name: old[name] for name, metric in METRICS.items() if name in old and metric.update_after_t_f
    }
    arrival, memories_after_t_f, pointing = jax.lax.cond(
        has_length & (interval.t_next >= criteria.t_f),
        lambda: _update_after_t_f(Running(running.arrival, memories_after_t_f, running.pointing), interval, criteria),
        lambda: Running(running.arrival, memories_after_t_f, running.pointing),
    )
    updated = guards.select(has_length, updated, {name: old[name] for name in updated})
    return Running(arrival, {**old, **updated, **memories_after_t_f}, pointing)


def _update_after_t_f(running: Running, interval: Interval, criteria: Criteria) -> Running:
    """Update the accumulators that only change in intervals that end at t_f or later; `memories` has no others."""
    errors = interval.errors()
    arrival = jax.lax.cond(interval.t < criteria.t_f, interval.arrival, lambda: running.arrival)
    updates = {name: METRICS[name].update_after_t_f for name in running.memories}
    memories = {
        name: update(running.memories[name], interval, errors, criteria) for name, update in updates.items() if update
    }
    tallies = running.pointing
    if tallies is not None and criteria.pointing is not None and interval.attitude_error is not None:
        tallies = pointing.update_errors(
            tallies, criteria.pointing, criteria.t_f, (interval.t, interval.t_next),
            interval.attitude_error, interval.knowledge_error,
        )  # fmt: skip
    return Running(arrival, memories, tallies)


def finish(running: Running, criteria: Criteria) -> Metrics:
    """Return the metrics of the complete run from the accumulators at t_end."""
    memories = running.memories
    values = {
        name: metric.value(memories[name], running, criteria) for name, metric in METRICS.items() if name in memories
    }
    if running.pointing is not None and criteria.pointing is not None:
        length = criteria.t_end - criteria.t_f - criteria.pointing.after
        values |= pointing.metric_values(running.pointing, criteria.pointing, length)
    return Metrics(values)


def is_unbounded(values: Metrics) -> Array:
    """Return whether a metric is infinite or NaN, for example because a square overflows."""
    finite_metrics = [values[name] for name in METRICS if name in values and not METRICS[name].may_be_nan]
    return ~jnp.all(jnp.isfinite(jnp.stack(finite_metrics)))
