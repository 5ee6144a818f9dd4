"""Reject runs that the law cannot perform, before they start: singular paths and singular input matrices.

Start with `check`.
"""

import typing
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ptsmc_jax import programs
from ptsmc_jax.batching import lapack
from ptsmc_jax.dispersions.base import INITIAL_ATTITUDE, REFERENCE
from ptsmc_jax.dispersions.variation import Dispersion
from ptsmc_jax.plants.second_order import System
from ptsmc_jax.scenario import attitude_keys, errors
from ptsmc_jax.scenario.errors import ScenarioError
from ptsmc_jax.scenario.tables import Scenario
from ptsmc_jax.signals.references import Target
from ptsmc_jax.simulation.rollout import SINGULAR_DISTANCE, Parts
from ptsmc_jax.theory import solutions

SINGULAR_CONDITION = 1e14  # condition number of a matrix that counts as singular in double precision


def check(scenario: Scenario, parts: Parts, dispersion: Dispersion, *, dispersed: bool) -> None:
    """Raise ScenarioError if the law meets its singularity on the nominal path, or if it must invert a singular matrix.

    Trials with random attitudes are not checked here: a trial that meets the singularity is marked in the results.

    Args:
        scenario: the scenario.
        parts: its parts.
        dispersion: its dispersions.
        dispersed: whether dispersed attitudes are simulated. If so, and if attitude or reference is dispersed, the
            nominal initial attitude is not checked.
    """
    if scenario.motion == "system":
        check_system(scenario, parts)
    if scenario.motion == "spacecraft":
        check_reference_path(scenario, parts)
        if not dispersed or dispersion.kinds.keys().isdisjoint((INITIAL_ATTITUDE, REFERENCE)):
            check_attitude_path(scenario, parts)


def check_system(scenario: Scenario, parts: Parts) -> None:
    """Raise ScenarioError if a system is not finite at t = 0, or if law or observer cannot invert it there."""
    start, plant = (jnp.zeros(()), parts.initial), typing.cast(System, parts.controller.model)
    _check_finite("system", plant, *start)
    if scenario.plant.truth is not None:
        _check_finite("truth", typing.cast(System, parts.plant), *start)
    matrices = {"dF/dx2 G": plant.rate_jacobian(*start) @ plant.input_gain(*start)}
    if parts.observer.estimates:
        matrices["D"] = plant.disturbance_gain(*start)
    for name, matrix in matrices.items():
        if not np.linalg.cond(np.asarray(matrix)) < SINGULAR_CONDITION:
            user = "the law" if name != "D" else f"observer.kind = {errors.show(scenario.observer.kind)}"
            raise ScenarioError(
                f"plant.system has a singular {name} at t = 0 in plant.x0, which {user} must invert; allowed is an "
                "invertible one" + ("" if name != "D" else ', or observer.kind = "none"')
            )


def _check_finite(key: str, plant: System, t: Array, x: Array) -> None:
    """Raise ScenarioError if a function of a system is not finite in this state; key: "system" or "truth"."""
    functions = {"F": plant.position_rate, "H": plant.drift, "G": plant.input_gain, "D": plant.disturbance_gain}
    values = [(name, function(t, x)) for name, function in (*functions.items(), ("dF/dx2", plant.rate_jacobian))]
    values += [("Z", z) for z in plant.hidden_rates(t, x, jnp.zeros(plant.inputs))]
    for name, value in values:
        if not np.all(np.isfinite(np.asarray(value))):
            raise ScenarioError(
                f"plant.{key} has {name} = {errors.brief(np.asarray(value).tolist())} at t = 0 in plant.x0; allowed "
                "are finite numbers"
            )


_Q4_ZERO = "q4 = 0 (180 degrees from the inertial frame's identity), which the additive law cannot cross"
_QE4_ZERO = "q_e4 = 0 (180 degrees from the reference), at which the law is singular"


def check_reference_path(scenario: Any, parts: Parts) -> None:
    """Raise ScenarioError if the additive law meets its singularity q4 = 0 on the reference."""
    if not parts.controller.kinematics.additive:
        return
    times = np.linspace(0.0, float(parts.t_end), 4001)
    scalar_parts = np.asarray(_scalar_part(parts.reference, times))
    beginning = f"reference.kind is {errors.show(scenario.reference.kind)}, but its attitude"
    if not np.all(np.isfinite(scalar_parts)):
        time = float(times[int(np.argmin(np.isfinite(scalar_parts)))])
        raise ScenarioError(f"{beginning} is not finite at t = {time:.4g} s; allowed are finite numbers until t_end")
    crossed = np.sign(scalar_parts) != np.sign(scalar_parts[0])
    nearest = int(np.argmax(crossed) if np.any(crossed) else np.argmin(np.abs(scalar_parts)))
    if np.any(crossed) or abs(scalar_parts[nearest]) < SINGULAR_DISTANCE:
        raise ScenarioError(
            f"{beginning} reaches {_Q4_ZERO}, at t = {float(times[nearest]):.4g} s; allowed is a reference that stays "
            'away from it until t_end, or controller.error = "multiplicative"'
        )


@programs.jit
def _scalar_part(reference: Callable[[Array], Target], times: Array) -> Array:
    """Return q_f4 of a reference at the times (n,) [s]."""
    return lapack.vmap(lambda time: reference(time).q[3])(times)


def check_attitude_path(scenario: Any, parts: Parts) -> None:
    """Raise ScenarioError if the nominal path from the initial attitude to the reference meets the singularity."""
    law = parts.controller
    singularity, name = (_Q4_ZERO, "|q4|") if law.kinematics.additive else (_QE4_ZERO, "|q_e4|")
    key, value = attitude_keys.attitude_key(scenario.initial)
    if law.prescribed:
        times, _, square_distance = (np.asarray(v) for v in solutions.exact_path(parts))
    else:  # the path of other laws is not known, so only the start is checked
        target = parts.reference(jnp.zeros_like(parts.t_end))
        first = law.singularity_distance(law.kinematics.align(parts.initial, target), target)
        times, square_distance = np.zeros(1), np.square([float(first)])
    if square_distance[0] < SINGULAR_DISTANCE**2:
        allowed = f"{name} of at least {SINGULAR_DISTANCE}"
        raise errors.value_error(f"initial.{key}", value, f", but lies at {singularity}; allowed is {allowed}", allowed)
    if square_distance.min() < SINGULAR_DISTANCE**2:
        time = float(times[int(np.argmin(square_distance))])
        allowed = f"a start whose path keeps {name} above {SINGULAR_DISTANCE}"
        reason = (
            f" with initial.rate = {errors.brief(scenario.initial.rate)}, but from there the path to the reference "
            f"meets {singularity}, at t = {time:.4g} s; allowed is {allowed}"
        )
        raise errors.value_error(f"initial.{key}", value, reason, allowed)
