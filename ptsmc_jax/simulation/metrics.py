"""The metrics of a run, accumulated interval by interval inside the rollout: loops over the rows of `METRICS`."""

from collections import namedtuple
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import core
from jaxtyping import Array

from ptsmc_jax.numerics import guards
from ptsmc_jax.simulation.interval import Arrival, Criteria, Interval, Start
from ptsmc_jax.simulation.metric_rows import METRICS, Running


class Metrics(namedtuple("Metrics", METRICS)):
    """Metrics of a run by name, scalars; units and meaning in `catalogues`. NaN: a metric that this run lacks."""

    __slots__ = ()

    def __repr__(self) -> str:
        """The metrics that the run has, a line each; of many runs, or traced ones, their type and shape."""
        present = {name: value for name, value in self._asdict().items() if not _lacks(name, value)}
        return "\n".join(f"{name:24s} {_shown(value)}" for name, value in present.items())


def _lacks(name: str, value: Any) -> bool:
    """Whether no run has the metric; one that never settles has that one."""
    return name != "settling_time" and _are_numbers(value) and bool(np.all(np.isnan(value)))


def _are_numbers(value: Any) -> bool:
    """Whether they are known: under transformations tracers, shapes, axes stand in their places."""
    return isinstance(value, jax.Array | np.ndarray | np.number | float) and not isinstance(value, core.Tracer)


def _shown(value: Any) -> str:
    if not (_are_numbers(value) or isinstance(value, core.Tracer)):
        return repr(value)
    several = isinstance(value, core.Tracer) or np.ndim(value) > 0
    return f"{type(value).__name__} {np.shape(value)}" if several else f"{float(value):.6g}"


def begin(start: Start, criteria: Criteria) -> Running:
    """The metrics at t = 0."""
    arrival = Arrival(jnp.zeros(start.inputs), jnp.zeros_like(criteria.t_f))
    return Running(arrival, {name: metric.begin(start, criteria) for name, metric in METRICS.items()})


def update(running: Running, interval: Interval, criteria: Criteria) -> Running:
    """The metrics after one interval; one of length zero changes nothing."""
    has_length = interval.length > 0.0
    old = running.memories
    new = {
        name: old[name] if metric.update is None else metric.update(old[name], interval, criteria)
        for name, metric in METRICS.items()
        if metric.update_after_t_f is None
    }
    after_t_f = {name: old[name] for name, metric in METRICS.items() if metric.update_after_t_f is not None}
    arrival, after_t_f = jax.lax.cond(
        has_length & (interval.t_next >= criteria.t_f),
        lambda: _update_after_t_f(running.arrival, after_t_f, interval, criteria),
        lambda: (running.arrival, after_t_f),
    )
    return Running(arrival, {**guards.select(has_length, new, {name: old[name] for name in new}), **after_t_f})


def _update_after_t_f(arrival: Arrival, memories: dict, interval: Interval, criteria: Criteria) -> tuple[Arrival, dict]:
    """The memories that begin at t_f, after an interval that reaches t_f."""
    errors = interval.errors()
    arrival = jax.lax.cond(interval.t < criteria.t_f, interval.arrival, lambda: arrival)
    updates = {name: METRICS[name].update_after_t_f for name in memories}
    return arrival, {
        name: update(memories[name], interval, errors, criteria) for name, update in updates.items() if update
    }


def finish(running: Running, criteria: Criteria) -> Metrics:
    """The metrics at t_end."""
    return Metrics(*(metric.value(running.memories[name], running, criteria) for name, metric in METRICS.items()))


def unbounded(values: Metrics, begun: Running) -> Array:
    """Whether a metric ends infinite or NaN, such as the square of a number beyond the square root of the largest one.

    begun: the metrics at t = 0, which are NaN where the run lacks one.
    """

    def any_nan(memory: Any) -> Array:
        return jnp.any(jnp.isnan(jnp.concatenate([jnp.ravel(leaf) for leaf in jax.tree.leaves(memory)])))

    ends = {name: value for name, value in values._asdict().items() if not METRICS[name].may_lack}
    end, lacking = jnp.stack(list(ends.values())), jnp.stack([any_nan(begun.memories[name]) for name in ends])
    return jnp.any(jnp.isinf(end) | (jnp.isnan(end) & ~lacking))
