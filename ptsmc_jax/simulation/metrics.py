"""Accumulate the metrics of a run interval by interval inside the simulation: `begin`, `update`, `finish`.

The functions of each metric are in `metric_table`, and in `pointing_report` for the pointing errors.
"""

from collections.abc import Iterable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import core
from jaxtyping import Array

from ptsmc_jax.numerics import guards
from ptsmc_jax.simulation import pointing_report
from ptsmc_jax.simulation.catalogues import CATALOGUE
from ptsmc_jax.simulation.interval import Arrival, Criteria, Interval, Start
from ptsmc_jax.simulation.metric_table import METRICS
from ptsmc_jax.simulation.pointing_report import PointingErrors


@jax.tree_util.register_pytree_with_keys_class
class Metrics(dict[str, Any]):
    """The metrics of a run, scalars by name; units and meanings are in `catalogues`.

    Each metric is also an attribute. The attribute is NaN if the run does not have the metric.
    """

    def __getattr__(self, name: str) -> Any:
        if name not in CATALOGUE:
            raise AttributeError(f"there is no metric {name!r}")
        return self[name] if name in self else np.nan * next(iter(self.values()))

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
    if not isinstance(value, jax.Array | np.ndarray | np.number | float):
        return repr(value)  # under transformations a leaf may be a shape or an axis
    is_array = isinstance(value, core.Tracer) or np.ndim(value) > 0
    return f"{type(value).__name__} {np.shape(value)}" if is_array else f"{float(value):.6g}"


class Running(NamedTuple):
    """Accumulators of the metrics of a run up to the present time."""

    arrival: Arrival
    memories: dict[str, Any]  # accumulators of the metrics that the run has, by name
    pointing: PointingErrors | None  # accumulators of the pointing errors; None: pointing errors are not observed


def begin(start: Start, criteria: Criteria) -> Running:
    """Return the accumulators at t = 0 (accumulator pattern: `begin`, `update`, `finish`)."""
    arrival = Arrival(jnp.zeros(start.inputs), jnp.zeros_like(criteria.t_f))
    memories = {name: metric.init(start, criteria) for name, metric in METRICS.items()}
    present = {name: memory for name, memory in memories.items() if memory is not None}
    return Running(arrival, present, pointing_report.begin(criteria, measured=start.measured))


def update(running: Running, interval: Interval, criteria: Criteria) -> Running:
    """Return the accumulators after one more interval. An interval of length zero changes nothing."""
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
    return Running(arrival, memories, pointing_report.update(running.pointing, interval, criteria))


def finish(running: Running, criteria: Criteria) -> Metrics:
    """Return the metrics of the complete run from the accumulators at t_end."""
    memories = running.memories
    values = {
        name: metric.value(memories[name], running, criteria) for name, metric in METRICS.items() if name in memories
    }
    return Metrics(values | pointing_report.metric_values(running.pointing, criteria))


def is_unbounded(values: Metrics) -> Array:
    """Return whether a metric is infinite or NaN, for example because a square overflows."""
    finite_metrics = [values[name] for name in METRICS if name in values and not METRICS[name].may_be_nan]
    return ~jnp.all(jnp.isfinite(jnp.stack(finite_metrics)))
