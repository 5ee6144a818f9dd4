"""Every metric, a row each: what it remembers at t = 0, after each interval, and the value at the end of the run."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array

from ptsmc_jax.numerics import guards, integrators
from ptsmc_jax.simulation import pointing
from ptsmc_jax.simulation.catalogues import AXES, WITHIN
from ptsmc_jax.simulation.interval import Arrival, Criteria, Errors, Interval, Snapshot, Start, integral_in_window


class Running(NamedTuple):
    """The metrics of a run so far: the state at t_f, and what each metric remembers, by its name."""

    arrival: Arrival
    memories: dict[str, Any]


@dataclass(frozen=True)
class Metric:
    """How a metric is computed; its unit and meaning stand in `catalogues`, for the plants that have it.

    Its memory from `begin` changes after every interval of positive length by `update`, or by `update_after_t_f`, which
    is called for intervals that reach beyond t_f only, with the errors at their ends. Its value is the memory at t_end,
    or what `value` makes of it. A metric that a run lacks is NaN from t = 0 on.
    """

    begin: Callable[[Start, Criteria], Any] = lambda start, criteria: jnp.zeros_like(criteria.t_f)
    update: Callable[[Any, Interval, Criteria], Any] | None = None
    update_after_t_f: Callable[[Any, Interval, Errors, Criteria], Any] | None = None
    value: Callable[[Any, Running, Criteria], Array] = lambda memory, running, criteria: memory
    may_lack: bool = False  # a run that is finite may end with NaN


def _peak(
    during: Callable[[Interval], Array | None], at_start: Callable[[Start], Array | None] | None = None
) -> Metric:
    """The largest value at t = 0, by default 0, and in every interval; None: the run lacks it."""

    def begin(start: Start, criteria: Criteria) -> Array:
        first = jnp.zeros_like(criteria.t_f) if at_start is None else at_start(start)
        return jnp.full_like(criteria.t_f, jnp.nan) if first is None else first

    def update(largest: Array, interval: Interval, criteria: Criteria) -> Array:
        value = during(interval)
        return largest if value is None else jnp.maximum(largest, value)

    return Metric(begin, update)


def _largest_of(torques: tuple[Array, ...]) -> Array:
    return jnp.max(jnp.stack([jnp.max(jnp.abs(u)) for u in torques]))


def _size(of_wheels: Array | None) -> Array | None:
    return None if of_wheels is None else jnp.max(jnp.abs(of_wheels))


def _effort(effort: Array, interval: Interval, criteria: Criteria) -> Array:
    torques = interval.torques
    norms = (w * jnp.sum(jnp.abs(u)) for w, u in zip(torques.weights, torques.delivered, strict=True))
    return effort + interval.length * sum(norms)


def _unsettled(snapshot: Snapshot, criteria: Criteria) -> Array:
    return ~(snapshot.angle < criteria.settling_angle)  # an angle that is no number is not settled


def _settled_at(settled_at: Array, interval: Interval, criteria: Criteria) -> Array:
    """End of the last time spent above the settling angle [s], by linear interpolation; infinite while above it."""
    start, end = interval.start, interval.end
    above, above_next = _unsettled(start, criteria), _unsettled(end, criteria)
    drop = jnp.where(above & ~above_next, start.angle - end.angle, 1.0)
    crossing = interval.t + interval.length * (start.angle - criteria.settling_angle) / drop
    return jnp.where(above_next, jnp.inf, jnp.where(above, crossing, settled_at))


def _square_error(square: Array, interval: Interval, errors: Errors, criteria: Criteria) -> Array:
    """Integral of |error|^2 over the window so far; fourth order, once differentiable in t_f.

    The error in between is the cubic through both ends and slopes (Hermite), its square the parabola through the ends
    and the middle, integrated exactly.
    """
    middle = integrators.hermite_middle(*errors, interval.length)
    g0, g1, g2 = (jnp.sum(e * e) for e in (errors.start, middle, errors.end))
    return square + integral_in_window(interval.t, interval.t_next, (g0, g1, g2), criteria)


def _largest_in_hold(at_end: Callable[[Interval, Errors], Array], at_t_f: Callable[[Arrival], Array]) -> Metric:
    """The largest value at t_f and at the ends of intervals after it."""

    def update(largest: Array, interval: Interval, errors: Errors, criteria: Criteria) -> Array:
        return jnp.where(interval.t_next > criteria.t_f, jnp.maximum(largest, at_end(interval, errors)), largest)

    return Metric(
        update_after_t_f=update, value=lambda largest, run, criteria: jnp.maximum(largest, at_t_f(run.arrival))
    )


def _rms_in_window(update: Callable[[Array, Interval, Errors, Criteria], Array]) -> Metric:
    """Root of the mean over the window of the square that `update` integrates."""
    return Metric(update_after_t_f=update, value=lambda square, run, criteria: guards.sqrt(square / criteria.window))


def _variation(variation: Array, interval: Interval, errors: Errors, criteria: Criteria) -> Array:
    """Total variation of the torque delivered from t_f on, (m,) [N m]: the jump at its start, then inside."""
    delivered = interval.torques.delivered
    by_rounding = guards.rounding(interval.length, criteria.t_f)  # which must not count the jump of a sample at t_f
    jump = jnp.where(interval.t > criteria.t_f + by_rounding, jnp.abs(delivered[0] - interval.last_torque), 0.0)
    inside = sum((jnp.abs(v - u) for u, v in pairwise(delivered)), start=jnp.zeros_like(jump))
    return variation + jump + jnp.where(interval.t >= criteria.t_f - by_rounding, inside, 0.0)


def _chattering(variation: Array, running: Running, criteria: Criteria) -> Array:
    length = criteria.t_end - criteria.t_f
    return jnp.max(variation) / jnp.where(length > 0.0, length, 1.0)


def _square_angle(square: Array, interval: Interval, errors: Errors, criteria: Criteria) -> Array:
    """Integral of angle^2 over the window so far, as that of |error|^2: an angle has a kink where it is zero."""
    start, middle, end = interval.start.angle, interval.middle_angle(), interval.end.angle
    squares = (start * start, middle * middle, end * end)
    return square + integral_in_window(interval.t, interval.t_next, squares, criteria)


def _residual_modal(largest: Array, interval: Interval, criteria: Criteria) -> Array:
    """The largest at ends of intervals from t_f on; before, what it was."""
    amplitude = interval.end.modal_amplitude
    if amplitude is None:
        return largest
    early = interval.t < criteria.t_f  # an interval that t_f lies in begins anew
    reached = interval.t_next >= criteria.t_f
    return jnp.where(reached, jnp.where(early, amplitude, jnp.maximum(largest, amplitude)), largest)


def _pointing_rows(
    absolute: str,
    mean: str,
    relative: str,
    error_of: Callable[[Interval], Callable[[], pointing.ErrorPath | pointing.ConstantPath] | None],
    *,
    measured: bool,
    drift: str | None = None,
) -> dict[str, Metric]:
    """A row for each index of an error and each axis; they share the tally that the first of them keeps.

    absolute, mean, relative, drift: names of the indices; measured: the error is that of a measurement.
    """
    keeper = f"{absolute}_{next(iter(AXES))}"

    def begin(start: Start, criteria: Criteria) -> pointing.Tally | None:
        if criteria.pointing is None or (measured and not start.measured):
            return None
        return pointing.begin(jnp.zeros_like(criteria.t_f), criteria.pointing.segments(relative))

    def update(tally: Any, interval: Interval, errors: Errors, criteria: Criteria) -> pointing.Tally | None:
        observed, error = criteria.pointing, error_of(interval)
        if tally is None or observed is None or error is None:
            return tally
        path = error()
        limits = [
            [jnp.asarray(observed.limits.get(f"{index}_{axis}", jnp.inf)) for axis in AXES]
            for index in (absolute, mean, relative)
        ]
        limits = jnp.stack([jnp.stack(of_axes) for of_axes in limits])
        begins = criteria.t_f + observed.after
        return pointing.update(tally, path, interval.t, interval.t_next, begins, observed.window, limits)

    def row(index: Callable[[pointing.Tally, Criteria], Array], axis: int) -> Metric:
        def value(memory: Any, running: Running, criteria: Criteria) -> Array:
            tally = running.memories[keeper]
            return jnp.full_like(criteria.t_f, jnp.nan) if tally is None else index(tally, criteria)[axis]

        return Metric(begin=lambda start, criteria: None, value=value, may_lack=True)

    # index -> its values so far (4,)
    indices: dict[str, Callable[[pointing.Tally, Criteria], Array]] = {
        absolute: lambda tally, criteria: tally.largest,
        mean: lambda tally, criteria: tally.mean,
        relative: lambda tally, criteria: tally.relative,
        **({drift: lambda tally, criteria: pointing.drift(tally)} if drift is not None else {}),
        f"{WITHIN}{absolute}": _time_within,
        f"{WITHIN}{mean}": lambda tally, criteria: _share_of_windows(tally.means_beyond, tally, criteria),
        f"{WITHIN}{relative}": lambda tally, criteria: _share_of_windows(tally.relative_beyond, tally, criteria),
    }
    rows = {f"{name}_{axis}": row(index, k) for name, index in indices.items() for k, axis in enumerate(AXES)}
    return {**rows, keeper: replace(rows[keeper], begin=begin, update_after_t_f=update)}


def _time_within(tally: pointing.Tally, criteria: Criteria) -> Array:
    assert criteria.pointing is not None
    return _share_left(tally.beyond, criteria.t_end - criteria.t_f - criteria.pointing.after)


def _share_of_windows(beyond: Array, tally: pointing.Tally, criteria: Criteria) -> Array:
    """Share of the time in whole windows that a time beyond limits leaves; NaN where no window has ended."""
    assert criteria.pointing is not None
    observed = tally.windows * criteria.pointing.window
    return jnp.where(observed > 0.0, _share_left(beyond, jnp.where(observed > 0.0, observed, 1.0)), jnp.nan)


def _share_left(beyond: Array, total: Array) -> Array:
    """Share of a time [s] that times beyond limits [s] leave; by rounding their sum may be off all of it."""
    left = total - beyond
    return jnp.where(left <= guards.rounding(total, total), 0.0, left / total)


_PEAK_MODAL = _peak(lambda interval: interval.end.modal_amplitude, lambda start: start.snapshot.modal_amplitude)
METRICS = {
    "terminal_error": Metric(value=lambda memory, run, criteria: guards.norm(run.arrival.error)),
    "terminal_angle": Metric(value=lambda memory, run, criteria: run.arrival.angle),
    "window_error": _rms_in_window(_square_error),
    "hold_error": _largest_in_hold(
        lambda interval, errors: guards.norm(errors.end), lambda arrival: guards.norm(arrival.error)
    ),
    "window_angle": _rms_in_window(_square_angle),
    "hold_angle": _largest_in_hold(lambda interval, errors: interval.end.angle, lambda arrival: arrival.angle),
    "peak_torque": _peak(lambda interval: _largest_of(interval.torques.commanded)),
    "peak_torque_delivered": _peak(lambda interval: _largest_of(interval.torques.delivered)),
    "saturated": Metric(
        update=lambda limited_for, interval, criteria: (
            limited_for + jnp.where(interval.torques.limited, interval.length, 0.0)
        ),
        value=lambda limited_for, run, criteria: jnp.where(
            jnp.isnan(run.memories["effort"]), jnp.nan, limited_for / criteria.t_end
        ),
    ),
    "effort": Metric(update=_effort),
    "settling_time": Metric(
        begin=lambda start, criteria: jnp.where(_unsettled(start.snapshot, criteria), jnp.inf, 0.0),
        update=_settled_at,
        value=lambda settled_at, run, criteria: jnp.where(jnp.isfinite(settled_at), settled_at, jnp.nan),
        may_lack=True,
    ),
    "chattering": Metric(
        begin=lambda start, criteria: jnp.zeros(start.inputs), update_after_t_f=_variation, value=_chattering
    ),
    "peak_rate": _peak(lambda interval: interval.end.rate, lambda start: start.snapshot.rate),
    "peak_momentum": _peak(lambda interval: interval.end.momentum, lambda start: start.snapshot.momentum),
    "peak_wheel_momentum": _peak(
        lambda interval: _size(interval.torques.wheel_momentum), lambda start: _size(start.wheel_momentum)
    ),
    "peak_wheel_torque": _peak(
        lambda interval: _size(interval.torques.wheel_torque),
        lambda start: None if start.wheel_momentum is None else jnp.zeros_like(start.snapshot.angle),
    ),
    "peak_modal": _PEAK_MODAL,
    "residual_modal": replace(_PEAK_MODAL, update=_residual_modal),
    **_pointing_rows("ape", "mpe", "rpe", lambda interval: interval.attitude_error, measured=False, drift="pde"),
    **_pointing_rows("ake", "mke", "rke", lambda interval: interval.knowledge_error, measured=True),
}
