"""Accumulators of all pointing error indices of a run, and their values by metric name."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array

from ptsmc_jax.numerics import guards
from ptsmc_jax.simulation import pointing
from ptsmc_jax.simulation.catalogues import AXES, WITHIN
from ptsmc_jax.simulation.interval import Criteria, Interval
from ptsmc_jax.simulation.pointing import ConstantPath, ErrorPath, Pointing, Tally

# absolute, mean and relative error of the true attitude, and of the measured attitude
ATTITUDE, KNOWLEDGE = ("ape", "mpe", "rpe"), ("ake", "mke", "rke")


class PointingErrors(NamedTuple):
    """Accumulators of the pointing error indices."""

    attitude: Tally  # error of the true attitude
    knowledge: Tally | None  # error of the attitude that the law gets; None: the law gets the true attitude


def begin(criteria: Criteria, *, measured: bool) -> PointingErrors | None:
    """Return the accumulators at t = 0, or None if the run has no pointing observation.

    Args:
        criteria: criteria of the run.
        measured: whether the law gets a measured attitude.
    """
    observation, zero = criteria.pointing, jnp.zeros_like(criteria.t_f)
    if observation is None:
        return None
    knowledge = pointing.begin(zero, observation.segment_count(KNOWLEDGE[2])) if measured else None
    return PointingErrors(pointing.begin(zero, observation.segment_count(ATTITUDE[2])), knowledge)


def update(errors: PointingErrors | None, interval: Interval, criteria: Criteria) -> PointingErrors | None:
    """Return the accumulators after an interval of positive length that ends at t_f or later."""
    observation = criteria.pointing
    if errors is None or observation is None or interval.attitude_error is None:
        return errors
    observation_start = criteria.t_f + observation.after

    def update_tally(tally: Tally, path: ErrorPath | ConstantPath, names: tuple[str, ...]) -> Tally:
        limits = _limit_table(observation, names)
        return pointing.update(tally, path, interval.t, interval.t_next, observation_start, observation.window, limits)

    attitude, knowledge = update_tally(errors.attitude, interval.attitude_error(), ATTITUDE), errors.knowledge
    if knowledge is not None and interval.knowledge_error is not None:
        knowledge = update_tally(knowledge, interval.knowledge_error(), KNOWLEDGE)
    return PointingErrors(attitude, knowledge)


def _limit_table(observation: Pointing, names: tuple[str, ...]) -> Array:
    """Return the limit of each index about each axis and of the half-cone, (indices, 4) [rad]; infinite: no limit."""
    limits = [[jnp.asarray(observation.limits.get(f"{name}_{axis}", jnp.inf)) for axis in AXES] for name in names]
    return jnp.stack([jnp.stack(axis_limits) for axis_limits in limits])


def metric_values(errors: PointingErrors | None, criteria: Criteria) -> dict[str, Array]:
    """Return the pointing metrics at t_end by name, empty if the run has no pointing observation."""
    observation = criteria.pointing
    if errors is None or observation is None:
        return {}
    length = criteria.t_end - criteria.t_f - observation.after
    indices = _index_values(errors.attitude, ATTITUDE, observation, length) | {"pde": pointing.drift(errors.attitude)}
    if errors.knowledge is not None:
        indices |= _index_values(errors.knowledge, KNOWLEDGE, observation, length)
    return {f"{name}_{axis}": sizes[k] for name, sizes in indices.items() for k, axis in enumerate(AXES)}


def _index_values(tally: Tally, names: tuple[str, str, str], observation: Pointing, length: Array) -> dict[str, Array]:
    """Return the values of each index, (4,) [rad], and the fractions of the time within limits, (4,) [-].

    Args:
        tally: accumulator of one error.
        names: names of its absolute, mean and relative index.
        observation: the observation.
        length: length of the observation [s].
    """
    absolute, mean, relative = names
    time_in_windows = tally.windows * observation.window
    has_window = time_in_windows > 0.0

    def fraction_in_windows(beyond: Array) -> Array:
        return jnp.where(has_window, _fraction_within(beyond, jnp.where(has_window, time_in_windows, 1.0)), jnp.nan)

    return {
        absolute: tally.largest,
        mean: tally.mean,
        relative: tally.relative,
        f"{WITHIN}{absolute}": _fraction_within(tally.beyond, length),
        f"{WITHIN}{mean}": fraction_in_windows(tally.means_beyond),
        f"{WITHIN}{relative}": fraction_in_windows(tally.relative_beyond),
    }


def _fraction_within(beyond: Array, total: Array) -> Array:
    """Return the fraction of a total time [s] that is within limits. Rounding may make `beyond` exceed the total."""
    within = total - beyond
    return jnp.where(within <= guards.time_tolerance(total, total), 0.0, within / total)
