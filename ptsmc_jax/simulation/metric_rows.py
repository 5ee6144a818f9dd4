"""Every metric, a row each: what it remembers at t = 0, after each interval, and the value at the end of the run."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array

from ptsmc_jax.numerics import guards
from ptsmc_jax.simulation import pointing
from ptsmc_jax.simulation.interval import Arrival, Criteria, Errors, Interval, Snapshot, Start, integral_in_window


class Running(NamedTuple):
    """Where a run stands: the state at t_f, and what each metric remembers, by its name."""

    arrival: Arrival
    memories: dict[str, Any]


@dataclass(frozen=True)
class Metric:
    """How a metric comes about; its unit and meaning stand in `catalogues`, for the plants that have it.

    It changes after every interval of positive length by `update`, or by `update_after_t_f`, which sees intervals that
    reach beyond t_f only, and the errors at their ends. Its value is what it remembers at t_end, unless `value` makes
    another one of it. A metric that a run lacks is NaN from t = 0 on.
    """

    begin: Callable[[Start, Criteria], Any] = lambda start, criteria: jnp.zeros_like(criteria.t_f)
    update: Callable[[Any, Interval, Criteria], Any] | None = None
    update_after_t_f: Callable[[Any, Interval, Errors, Criteria], Any] | None = None
    value: Callable[[Any, Running, Criteria], Array] = lambda memory, running, criteria: memory
    may_lack: bool = False  # a run that is finite may end with NaN


def _peak(
    during: Callable[[Interval], Array | None], at_start: Callable[[Start], Array | None] | None = None
) -> Metric:
    """The largest of what there is at t = 0, by default 0, and in every interval; None: the run lacks it."""

    def begin(start: Start, criteria: Criteria) -> Array:
        first = jnp.zeros_like(criteria.t_f) if at_start is None else at_start(start)
        return jnp.full_like(criteria.t_f, jnp.nan) if first is None else first

    def update(largest: Array, interval: Interval, criteria: Criteria) -> Array:
        present = during(interval)
        return largest if present is None else jnp.maximum(largest, present)

    return Metric(begin, update)


def _largest_of(torques: tuple[Array, ...]) -> Array:
    return jnp.max(jnp.stack([jnp.max(jnp.abs(u)) for u in torques]))


def _size(of_wheels: Array | None) -> Array | None:
    return None if of_wheels is None else jnp.max(jnp.abs(of_wheels))


def _effort(effort: Array, interval: Interval, criteria: Criteria) -> Array:
    norms = (w * jnp.sum(jnp.abs(u)) for w, u in zip(interval.weights, interval.delivered, strict=True))
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
    middle = (errors.start + errors.end) / 2 + interval.length / 8 * (errors.start_rate - errors.end_rate)
    g0, g1, g2 = (jnp.sum(e * e) for e in (errors.start, middle, errors.end))
    return square + integral_in_window(interval.t, interval.t_next, (g0, g1, g2), criteria)


def _hold_error(largest: Array, interval: Interval, errors: Errors, criteria: Criteria) -> Array:
    return jnp.where(interval.t_next > criteria.t_f, jnp.maximum(largest, guards.norm(errors.end)), largest)


def _variation(variation: Array, interval: Interval, errors: Errors, criteria: Criteria) -> Array:
    """Total variation of the torque delivered from t_f on, (m,) [N m]: the jump at its start, then inside."""
    delivered = interval.delivered
    jump = jnp.where(interval.t > criteria.t_f, jnp.abs(delivered[0] - interval.last_torque), 0.0)
    inside = sum((jnp.abs(v - u) for u, v in pairwise(delivered)), start=jnp.zeros_like(jump))
    return variation + jump + jnp.where(interval.t >= criteria.t_f, inside, 0.0)


def _chattering(variation: Array, running: Running, criteria: Criteria) -> Array:
    still = criteria.t_end - criteria.t_f
    return jnp.max(variation) / jnp.where(still > 0.0, still, 1.0)


def _square_angle(square: Array, interval: Interval, errors: Errors, criteria: Criteria) -> Array:
    """Integral of angle^2 over the window so far; an angle has a kink where it is zero: by the mean of both ends."""
    start, end = interval.start.angle, interval.end.angle
    squares = (start * start, (0.5 * (start + end)) ** 2, end * end)
    return square + integral_in_window(interval.t, interval.t_next, squares, criteria)


def _hold_angle(largest: Array, interval: Interval, errors: Errors, criteria: Criteria) -> Array:
    return jnp.where(interval.t_next > criteria.t_f, jnp.maximum(largest, interval.end.angle), largest)


def _ringing_after_t_f(largest: Array, interval: Interval, criteria: Criteria) -> Array:
    """The largest at ends of intervals from t_f on; before, what it was."""
    amplitude = interval.end.modal_amplitude
    if amplitude is None:
        return largest
    early = interval.t < criteria.t_f  # an interval that t_f lies in begins anew
    reached = interval.t_next >= criteria.t_f
    return jnp.where(reached, jnp.where(early, amplitude, jnp.maximum(largest, amplitude)), largest)


# absolute, mean and relative index: of the attitude's error, and of what the law is told of it
OF_ATTITUDE, OF_KNOWLEDGE = ("ape", "mpe", "rpe"), ("ake", "mke", "rke")


def _tally(indices: tuple[str, str, str], criteria: Criteria) -> pointing.Tally | None:
    """Of an error whose indices, absolute, mean and relative, are these; None: no pointing is observed."""
    asked = criteria.pointing
    return None if asked is None else pointing.begin(jnp.zeros_like(criteria.t_f), asked.segments(indices[2]))


def _observed(
    tally: Any, course: pointing.Course, indices: tuple[str, str, str], interval: Interval, criteria: Criteria
) -> pointing.Tally:
    assert criteria.pointing is not None
    asked = criteria.pointing
    each = [[jnp.asarray(asked.limits.get(f"{name}_{axis}", jnp.inf)) for axis in pointing.AXES] for name in indices]
    limits = jnp.stack([jnp.stack(some) for some in each])
    begins = criteria.t_f + asked.after
    return pointing.update(tally, course, interval.t, interval.t_next, begins, asked.window, limits)


def _pointing(tally: Any, interval: Interval, errors: Errors, criteria: Criteria) -> Any:
    return tally if tally is None else _observed(tally, interval.pointing(), OF_ATTITUDE, interval, criteria)  # pyright: ignore[reportOptionalCall]


def _knowledge(tally: Any, interval: Interval, errors: Errors, criteria: Criteria) -> Any:
    return tally if tally is None else _observed(tally, interval.knowledge(), OF_KNOWLEDGE, interval, criteria)  # pyright: ignore[reportOptionalCall]


def _time_within(tally: pointing.Tally, criteria: Criteria) -> Array:
    assert criteria.pointing is not None
    return 1.0 - tally.beyond / (criteria.t_end - criteria.t_f - criteria.pointing.after)


def _means_within(tally: pointing.Tally, criteria: Criteria) -> Array:
    return _of_windows(tally.means_beyond, tally, criteria)


def _relative_within(tally: pointing.Tally, criteria: Criteria) -> Array:
    return _of_windows(tally.relative_beyond, tally, criteria)


def _of_windows(beyond: Array, tally: pointing.Tally, criteria: Criteria) -> Array:
    """What a time beyond limits leaves of that in whole windows, as a share of it; NaN where none is over."""
    assert criteria.pointing is not None
    observed = tally.windows * criteria.pointing.window
    return jnp.where(observed > 0.0, 1.0 - beyond / jnp.where(observed > 0.0, observed, 1.0), jnp.nan)


def _from(first: str, index: Callable[[pointing.Tally, Criteria], Array], axis: int) -> Callable:
    """The value of a metric that the tally kept under the name `first` knows; NaN without one."""

    def value(memory: Any, running: Running, criteria: Criteria) -> Array:
        tally = running.memories[first]
        return jnp.full_like(criteria.t_f, jnp.nan) if tally is None else index(tally, criteria)[axis]

    return value


# index -> what a tally knows of it, (4,)
POINTING = {
    "ape": lambda tally, criteria: tally.largest,
    "mpe": lambda tally, criteria: tally.mean,
    "rpe": lambda tally, criteria: tally.relative,
    "pde": lambda tally, criteria: pointing.drift(tally),
    "within_ape": _time_within,
    "within_mpe": _means_within,
    "within_rpe": _relative_within,
}
KNOWLEDGE = {
    "ake": POINTING["ape"],
    "mke": POINTING["mpe"],
    "rke": POINTING["rpe"],
    "within_ake": _time_within,
    "within_mke": _means_within,
    "within_rke": _relative_within,
}


def _pointing_rows() -> dict[str, Metric]:
    """A row for each index and axis; those of one error share the tally that the first of them keeps."""
    found = {}
    for indices in (POINTING, KNOWLEDGE):
        first = f"{next(iter(indices))}_{pointing.AXES[0]}"
        for index, of in indices.items():
            for k, axis in enumerate(pointing.AXES):
                none, value = (lambda start, criteria: None), _from(first, of, k)
                found[f"{index}_{axis}"] = Metric(begin=none, value=value, may_lack=True)
    told = lambda start, criteria: _tally(OF_ATTITUDE, criteria)  # noqa: E731
    found["ape_x"] = replace(found["ape_x"], begin=told, update_after_t_f=_pointing)
    measured = lambda start, criteria: _tally(OF_KNOWLEDGE, criteria) if start.measured else None  # noqa: E731
    found["ake_x"] = replace(found["ake_x"], begin=measured, update_after_t_f=_knowledge)
    return found


_RINGING = _peak(lambda interval: interval.end.modal_amplitude, lambda start: start.snapshot.modal_amplitude)
METRICS = {
    "terminal_error": Metric(value=lambda memory, run, criteria: guards.norm(run.arrival.error)),
    "terminal_angle": Metric(value=lambda memory, run, criteria: run.arrival.angle),
    "window_error": Metric(
        update_after_t_f=_square_error, value=lambda square, run, criteria: guards.sqrt(square / criteria.window)
    ),
    "hold_error": Metric(
        update_after_t_f=_hold_error,
        value=lambda largest, run, criteria: jnp.maximum(largest, guards.norm(run.arrival.error)),
    ),
    "window_angle": Metric(
        update_after_t_f=_square_angle, value=lambda square, run, criteria: guards.sqrt(square / criteria.window)
    ),
    "hold_angle": Metric(
        update_after_t_f=_hold_angle, value=lambda largest, run, criteria: jnp.maximum(largest, run.arrival.angle)
    ),
    "peak_torque": _peak(lambda interval: _largest_of(interval.commanded)),
    "peak_torque_delivered": _peak(lambda interval: _largest_of(interval.delivered)),
    "saturated": Metric(
        update=lambda limited_for, interval, criteria: limited_for + interval.length * interval.limited,
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
        lambda interval: _size(interval.wheel_momentum), lambda start: _size(start.wheel_momentum)
    ),
    "peak_wheel_torque": _peak(
        lambda interval: _size(interval.wheel_torque),
        lambda start: None if start.wheel_momentum is None else jnp.zeros_like(start.snapshot.angle),
    ),
    "peak_modal": _RINGING,
    "residual_modal": replace(_RINGING, update=_ringing_after_t_f),
    **_pointing_rows(),
}
