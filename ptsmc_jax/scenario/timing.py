"""Choose the clock and the integration steps of a run from the fastest rates of the scenario.

Start with `choose_timing`.
"""

import dataclasses
import functools
import math
import typing
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ptsmc_jax import programs
from ptsmc_jax.batching import lapack
from ptsmc_jax.laws.prescribed_time import PrescribedTime, PrescribedTimeLaw
from ptsmc_jax.numerics.pytrees import vector
from ptsmc_jax.observers.base import Observer
from ptsmc_jax.plants.base import State
from ptsmc_jax.plants.second_order import System
from ptsmc_jax.scenario.errors import ScenarioError, show, wrong
from ptsmc_jax.scenario.tables import Scenario, check_scenario
from ptsmc_jax.scenario.values import MOST_STEPS
from ptsmc_jax.simulation import clock
from ptsmc_jax.simulation.assembly import Parts
from ptsmc_jax.theory import envelopes, solutions

MOST_SUBSTEPS = 200  # largest number of integration steps in a control period
# keys of smooth motions: steps of 0.1 rad are accurate enough, see `_count_substeps`
_SMOOTH_MOTIONS = ("disturbance.frequency", "plant.system", "flexible.frequency")
_REMEDIES = {  # how the value of a key must change so that a run needs fewer steps; all other values must be lower
    "reference.duration": "longer",
    "controller.t_f": "longer",
    "controller.sign_width": "larger, or 0 for the discontinuous sign",
    "loop.t_end": "earlier",
}


@dataclass(frozen=True)
class Reach:
    """Ranges of gains and control period that one compiled program covers. The clock is sized for them."""

    smallest_t_f: float  # smallest t_f [s]
    t_f: float  # largest t_f [s]
    smallest_delta: float  # smallest delta [s]; not used in the sampled loop
    gain: float  # smallest observer gain [N m s]; not used without an observer
    largest_gain: float  # largest observer gain [N m s]
    k1: float  # largest K1 [1/s]
    sign_width: float  # smallest thickness of the boundary layer
    surface_rate: float  # largest surface rate c [1/s]
    smallest_period: float  # smallest control period [s]; not used in the continuous loop
    period: float  # largest control period [s]


_INTERVALS = (  # fields of `Reach`: smallest and largest value
    ("smallest_t_f", "t_f"), ("gain", "largest_gain"), ("smallest_period", "period")
)  # fmt: skip
_POSITIVE_FIELDS = ("smallest_t_f", "t_f", "smallest_period", "period")  # divisors of clocks and steps


def reach_of(scenario: Scenario, **changes: float) -> Reach:
    """Return the reach that contains only the scenario's gains and control period, with some fields changed.

    Args:
        scenario: a validated scenario.
        changes: fields of `Reach` with other values.

    Raises:
        ValueError: there is no such field. Or a value is negative, not finite, or 0 for a time. Or the smallest value
            of a range exceeds its largest value.
        TypeError: `scenario` is not a scenario.

    >>> from ptsmc_jax.scenario import from_tables
    >>> reach = reach_of(from_tables({}), t_f=40.0)
    >>> reach.smallest_t_f, reach.t_f, reach.smallest_delta
    (30.0, 40.0, 0.05)
    """
    check_scenario(scenario)
    names = [field.name for field in dataclasses.fields(Reach)]
    for name, value in changes.items():
        if name not in names:
            raise ValueError(f"there is no {name} in a reach; allowed are {', '.join(names)}")
        is_number = np.ndim(value) == 0 and np.asarray(value).dtype.kind in "iuf" and 0.0 <= value < math.inf
        if not is_number or (name in _POSITIVE_FIELDS and value == 0.0):
            smallest = "greater than 0" if name in _POSITIVE_FIELDS else "of at least 0"
            raise ValueError(f"{name} is {value!r}, but must be a finite number {smallest}")
    law = scenario.controller
    gains, delta = getattr(scenario.observer, "gain", (0.0,)), scenario.hand_over
    k1, width, rate = getattr(law, "k1", 1.0), getattr(law, "sign_width", 0.0), getattr(law, "surface_rate", 1.0)
    period = scenario.loop.period
    present = Reach(law.t_f, law.t_f, delta, min(gains), max(gains), k1, width, rate, period, period)
    reach = dataclasses.replace(present, **changes)
    for low, high in _INTERVALS:
        if getattr(reach, low) > getattr(reach, high):
            raise ValueError(f"{low} is {getattr(reach, low):g}, but must be at most {high}, {getattr(reach, high):g}")
    return reach


def choose_timing(
    scenario: Scenario, setup: Parts, reach: Reach, saves: object
) -> tuple[clock.Sampled | clock.Graded, int]:
    """Return the clock of a run, and the number of integration steps in a control period.

    Args:
        scenario: the scenario.
        setup: its parts without a clock.
        reach: ranges of gains and control period that the clock must suit.
        saves: times [s] at which the grid of the continuous loop must have nodes.

    Raises:
        ScenarioError: the run would need too many steps; the message names the key that causes them.
    """
    loop, visited = scenario.loop, None
    disturbed = {"disturbance.frequency": max(term.largest_frequency() for term in scenario.terms)}
    with np.errstate(over="ignore"):  # `_check_steps` refuses huge frequencies
        frequencies = disturbed | scenario.frequencies(setup, reach.smallest_t_f)  # [rad/s], by key that causes them
    if reach.t_f > scenario.controller.t_f:
        scenario.check_reference_until(scenario.end + reach.t_f - scenario.controller.t_f)
    if setup.plant.custom_functions:
        fastest_setup = _with_prescribed_time_law(setup.with_t_f(vector(reach.smallest_t_f)))
        visited = solutions.visited_states(fastest_setup)
        frequencies["plant.system"] = _fastest_system_rate(fastest_setup, visited)
    if not scenario.sampled:
        for key in {"plant.system", "flexible.frequency"} & set(frequencies):
            frequencies[key] *= 2.0  # 0.15 rad per step, since a system is unknown and modes ring for a long time
        return _continuous_grid(scenario, reach, setup, saves, frequencies, visited), 1
    substeps = _count_substeps(scenario, reach.period, frequencies)
    last_time = scenario.end + reach.t_f - scenario.controller.t_f
    _check_steps(scenario, last_time, reach.smallest_period, substeps)
    build_clock = clock.flight_clock if loop.clock == "flight" else clock.anchored_clock
    run_clock = build_clock(reach.smallest_period, last_time)
    return dataclasses.replace(run_clock, period=vector(loop.period), t_end=vector(scenario.end)), substeps


def count_steps(parts: Parts) -> int:
    """Return the number of integration steps of a run."""
    return parts.clock.count * parts.substeps


def _check_steps(scenario: Scenario, last_time: float, period: float, substeps: int) -> None:
    """Raise ScenarioError if a sampled run until `last_time` [s] needs more than `MOST_STEPS` integration steps."""
    needed = last_time / period * substeps
    if needed > MOST_STEPS:
        reason = (
            f"the sampled loop would take {needed:.6g} steps, {substeps} a period, and at most {MOST_STEPS} are allowed"
        )
        if last_time > scenario.end:
            raise ScenarioError(f"tune.bounds.t_f asks for runs of {last_time:.6g} s, but must be lower: {reason}")
        raise _too_fast_error(scenario, "loop.t_end", reason)


def _fastest_frequency(frequencies: Mapping[str, float]) -> float:
    """Return the highest angular frequency of the motion [rad/s].

    It is the frequency of the disturbance or the sum of all other frequencies, whichever is larger.
    """
    others = sum(value for key, value in frequencies.items() if key != "disturbance.frequency")
    return max(frequencies["disturbance.frequency"], others)


def _count_substeps(scenario: Scenario, period: float, frequencies: Mapping[str, float]) -> int:
    """Return the number of integration steps in a control period [s].

    RK4 with 0.025 rad per step has an error of about 1e-9 rad over 100 s. For disturbances, flexible modes and custom
    systems, 0.1 rad per step gives a relative error of about 1e-7. A torque that changes within the period, because of
    a lag or a rate limit, needs no further steps: its impulse and first moment are exact, see `Actuators.torque_over`.
    """
    frequencies = {key: value / (4 if key in _SMOOTH_MOTIONS else 1) for key, value in frequencies.items()}
    needed = period * _fastest_frequency(frequencies) / 0.025
    if needed > MOST_SUBSTEPS:
        reason = f"loop.period = {period} s would take more than {MOST_SUBSTEPS} integration steps a period"
        raise _too_fast_error(scenario, max(frequencies, key=lambda key: frequencies[key]), reason)
    count = max(1, math.ceil(needed))
    # round up to a power of 2 or 1.5 times one: nearly all gains then share one compiled program
    power = 2 ** (count.bit_length() - 1)
    return next(allowed for allowed in (power, power + power // 2, 2 * power) if allowed >= count)


def _too_fast_error(scenario: Scenario, key: str, reason: str) -> ScenarioError:
    """Return the error for a run that needs too many steps, mainly because of this key."""
    key = "controller.t_f" if key == "controller.eta" else key  # eta may be at its lower bound already
    table, *names = key.split(".")
    value = functools.reduce(lambda one, name: getattr(one, name, None), names, getattr(scenario, table))
    if value is None:  # the key is in the terms of a sum of disturbances, or the scenario does not have it
        value = [getattr(term, names[-1]) for term in scenario.terms if hasattr(term, names[-1])]
    if not value or names[-1] in ("system", "code", "file", "kind"):
        named = f"{key} is {show(value)}, which" if isinstance(value, str) else key if value else table
        return ScenarioError(f"{named} is too fast: {reason}")
    return wrong(key, value, f"{_REMEDIES.get(key, 'lower')}: {reason}")


@programs.jit  # compiled as one program instead of one for each operation
def _layer_rates(controller: PrescribedTimeLaw, observer: Observer, visited: tuple | None) -> tuple:
    """Return the fastest rates in the boundary layer before and after the hand-over [1/s]."""
    return envelopes.boundary_layer(controller, observer.error_bound().largest, visited)


def _with_prescribed_time_law(setup: Parts) -> Parts:
    """Return the parts with the prescribed-time law. Its exact motion represents the states of a run under any law."""
    law = setup.controller
    if law.prescribed:
        return setup
    gains = (vector(v) for v in (3.0, law.delta, 1.0, 1e-3, 1.0))  # eta, delta, K1, width of the sign, surface rate
    return dataclasses.replace(setup, controller=PrescribedTime(law.kinematics, law.t_f, *gains))


@programs.jit
def _system_rates(setup: Parts, visited: tuple) -> tuple:
    """Return Jacobians of a custom system and the derivatives of its motion with zero error.

    Args:
        setup: the parts of the run.
        visited: times (states,) and states (states, n), at which the Jacobians (states, n, n) are evaluated.

    Returns:
        The Jacobians, and a pair of w' and w'' of the motion with zero error, (times, m) each.
    """
    plant, kinematics = typing.cast(System, setup.plant), setup.controller.kinematics
    zero = jnp.zeros(plant.inputs)

    def jacobian(t: jax.Array, x: State) -> jax.Array:
        u = kinematics.invert(x, t, zero, zero)
        return plant.jacobian(t, plant.with_hidden_at_rest(x), u)

    def zero_error_acceleration(t: jax.Array) -> jax.Array:
        return solutions.plant_motion(kinematics, t, setup.initial, (zero, zero, zero)).w_dot

    times = setup.t_end * jnp.linspace(0.0, 1.0, 509)  # 509 is prime, so that the samples rarely alias with a period
    steady = lapack.vmap(lambda t: jax.jvp(zero_error_acceleration, (t,), (jnp.ones_like(t),)))(times)
    return lapack.vmap(jacobian)(*visited), steady


def _fastest_system_rate(setup: Parts, visited: tuple) -> float:
    """Return the fastest rate of a custom system along its run [rad/s], from its modes and its explicit time."""
    jacobians, (acceleration, jerk) = _system_rates(solutions.without_devices(setup), visited)
    matrices = np.asarray(jacobians)
    modes = np.abs(np.linalg.eigvals(matrices[np.all(np.isfinite(matrices), axis=(1, 2))])).max(initial=0.0)
    largest_acceleration, largest_jerk = (float(np.nanmax(np.abs(v), initial=0.0)) for v in (acceleration, jerk))
    return float(max(modes, largest_jerk / largest_acceleration if largest_acceleration > 1e-12 else 0.0))


def _with_gain(observer: Any, gain: float) -> Any:
    """Return the observer with the same gain on all axes."""
    return dataclasses.replace(observer, gain=vector(np.full(np.shape(observer.gain), gain)))


def _fastest_layer_rates(
    reach: Reach, law: PrescribedTimeLaw, observer: Observer, visited: tuple | None
) -> tuple[float, float]:
    """Return the fastest rates of boundary layer and observer before and after the hand-over, within reach [1/s]."""
    before = after = 0.0
    if hasattr(observer, "gain"):  # the smallest gain gives the largest K2, the largest gain the fastest observer
        before = after = _with_gain(observer, reach.largest_gain).fastest()
        observer = _with_gain(observer, reach.gain)
    if reach.sign_width > 0.0:
        for t_f in (reach.smallest_t_f, reach.t_f):
            layer = _layer_rates(dataclasses.replace(law, t_f=vector(t_f)), observer, visited)
            before, after = max(before, float(layer[0])), max(after, float(layer[1]))
    return before, after


def _continuous_grid(
    scenario: Scenario,
    reach: Reach,
    setup: Parts,
    saves: object,
    frequencies: Mapping[str, float],
    visited: tuple | None,
) -> clock.Graded:
    """Return the grid of the continuous loop; raise ScenarioError if it needs more than `MOST_STEPS` steps."""
    loop = scenario.loop
    t_end = scenario.end + reach.t_f - scenario.controller.t_f
    saves = (*np.ravel(np.asarray(saves, dtype=float)), *setup.observer.nodes())
    names = ("t_f", "k1", "sign_width", "surface_rate")
    fastest_law = dataclasses.replace(setup.controller, **{name: vector(getattr(reach, name)) for name in names})
    layer_rates = _fastest_layer_rates(reach, fastest_law, setup.observer, visited)
    decay_rates, frequency, order = (
        envelopes.hold_rates(fastest_law),
        _fastest_frequency(frequencies),
        scenario.grid_order,
    )

    def steps_for(frequency: float = 0.0, layer: tuple[float, float] = (0.0, 0.0), rate: float = 0.0) -> float:
        total = sum(clock.graded_steps(reach.t_f, reach.smallest_delta, t_end, rate, frequency, layer, order)[:2])
        return total if total == total else math.inf

    rate = max(decay_rates.values())
    needed = steps_for(frequency, layer_rates, rate)
    if not needed <= MOST_STEPS:
        reason = f"the continuous loop would need {needed:.6g} steps, and at most {MOST_STEPS} are allowed"
        steps_by_key = {key: steps_for(value) for key, value in frequencies.items()}
        steps_by_key |= {f"controller.{key}": steps_for(rate=value) for key, value in decay_rates.items()}
        steps_by_key["controller.sign_width"] = steps_for(layer=layer_rates)
        main_cause = max(steps_by_key, key=lambda key: steps_by_key[key])
        if not steps_by_key["disturbance.frequency"] <= MOST_STEPS:  # the switching term gets faster with it, too
            main_cause = "disturbance.frequency"
        if steps_by_key[main_cause] <= steps_for() * 1.5:
            main_cause = "loop.t_end"
        raise _too_fast_error(scenario, main_cause, reason)
    grid = clock.graded_clock(
        reach.t_f, reach.smallest_delta, t_end, scenario.window, rate, frequency, layer_rates, saves, order
    )
    return dataclasses.replace(grid, t_end=vector(loop.t_end))
