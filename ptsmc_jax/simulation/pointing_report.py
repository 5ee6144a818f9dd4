"""Accumulators of all pointing error indices of a run, and their values by metric name."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array

from ptsmc_jax.numerics import guards
from ptsmc_jax.simulation import pointing
from ptsmc_jax.simulation.catalogues import AXES, WITHIN
from ptsmc_jax.simulation.interval import Criteria, Interval
from ptsmc_jax.simulation.pointing import ConstantPath, ErrorPath, Pointing, Tally

ATTITUDE, KNOWLEDGE = ("ape", "mpe", "rpe"), ("ake", "mke", "rke")  # absolute, mean, relative


class PointingErrors(NamedTuple):
    """Accumulators of the pointing error indices."""

    attitude: Tally  # error of the true attitude
    knowledge: Tally | None  # error of the attitude that the law gets; None: the law gets the true attitude


def begin(criteria: Criteria, *, measured: bool) -> PointingErrors | None:
    """Return the accumulator at t = 0, or None if no pointing is observed.

    Args:
        criteria: criteria of the run.
        measured: whether the law gets a measured attitude.
    """
    observed, zero = criteria.pointing, jnp.zeros_like(criteria.t_f)
    if observed is None:
        return None
    knowledge = pointing.begin(zero, observed.segments(KNOWLEDGE[2])) if measured else None
    return PointingErrors(pointing.begin(zero, observed.segments(ATTITUDE[2])), knowledge)


def update(errors: PointingErrors | None, interval: Interval, criteria: Criteria) -> PointingErrors | None:
    """Return the accumulator after an interval of positive length that reaches t_f."""
    observed = criteria.pointing
    if errors is None or observed is None or interval.attitude_error is None:
        return errors
    begins = criteria.t_f + observed.after

    def updated(tally: Tally, path: ErrorPath | ConstantPath, names: tuple[str, ...]) -> Tally:
        limits = _limits(observed, names)
        return pointing.update(tally, path, interval.t, interval.t_next, begins, observed.window, limits)

    attitude, knowledge = updated(errors.attitude, interval.attitude_error(), ATTITUDE), errors.knowledge
    if knowledge is not None and interval.knowledge_error is not None:
        knowledge = updated(knowledge, interval.knowledge_error(), KNOWLEDGE)
    return PointingErrors(attitude, knowledge)


def _limits(observed: Pointing, names: tuple[str, ...]) -> Array:
    """Return the limits of the indices about each axis and of the half-cone, (indices, 4) [rad]; infinite: no limit."""
    limits = [[jnp.asarray(observed.limits.get(f"{name}_{axis}", jnp.inf)) for axis in AXES] for name in names]
    return jnp.stack([jnp.stack(of_axes) for of_axes in limits])


def values(errors: PointingErrors | None, criteria: Criteria) -> dict[str, Array]:
    """Return the pointing metrics at t_end by name, empty if no pointing is observed."""
    observed = criteria.pointing
    if errors is None or observed is None:
        return {}
    length = criteria.t_end - criteria.t_f - observed.after
    indices = _indices(errors.attitude, ATTITUDE, observed, length) | {"pde": pointing.drift(errors.attitude)}
    if errors.knowledge is not None:
        indices |= _indices(errors.knowledge, KNOWLEDGE, observed, length)
    return {f"{name}_{axis}": sizes[k] for name, sizes in indices.items() for k, axis in enumerate(AXES)}


def _indices(tally: Tally, names: tuple[str, str, str], observed: Pointing, length: Array) -> dict[str, Array]:
    """Return the values of each index, (4,) [rad], and the fractions of the time within limits, (4,) [-].

    Args:
        tally: accumulator of one error.
        names: names of its absolute, mean and relative index.
        observed: the observation.
        length: length of the observation [s].
    """
    absolute, mean, relative = names
    in_windows = tally.windows * observed.window
    any_window = in_windows > 0.0

    def of_windows(beyond: Array) -> Array:
        return jnp.where(any_window, _fraction_within(beyond, jnp.where(any_window, in_windows, 1.0)), jnp.nan)

    return {
        absolute: tally.largest,
        mean: tally.mean,
        relative: tally.relative,
        f"{WITHIN}{absolute}": _fraction_within(tally.beyond, length),
        f"{WITHIN}{mean}": of_windows(tally.means_beyond),
        f"{WITHIN}{relative}": of_windows(tally.relative_beyond),
    }


def _fraction_within(beyond: Array, total: Array) -> Array:
    """Return the fraction of a total time [s] within limits. Rounding may make the time beyond them longer than it."""
    left = total - beyond
    return jnp.where(left <= guards.time_tolerance(total, total), 0.0, left / total)
