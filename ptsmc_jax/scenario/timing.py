"""Choose the clock and the integration steps of a run from the fastest rates of the scenario. Start with `timing`."""

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
from ptsmc_jax.laws.prescribed_time import PrescribedTime
from ptsmc_jax.numerics.pytrees import vector
from ptsmc_jax.plants.second_order import System
from ptsmc_jax.scenario.errors import ScenarioError, show, wrong
from ptsmc_jax.scenario.tables import Scenario, check_scenario
from ptsmc_jax.scenario.values import MOST_STEPS
from ptsmc_jax.simulation import clock
from ptsmc_jax.simulation.assembly import Parts, Setup
from ptsmc_jax.theory import rates, solutions
from ptsmc_jax.theory.exact_motion import plant_motion

MOST_SUBSTEPS = 200  # largest number of integration steps in a control period
# keys of smooth motions: steps of 0.1 rad are accurate enough, see `_substeps`
_SMOOTHED = ("disturbance.frequency", "plant.system", "flexible.frequency")


@dataclass(frozen=True)
class Reach:
    """Ranges of gains and control period that one compiled program covers. The clock is sized for them."""

    smallest_t_f: float  # smallest t_f [s]
    t_f: float  # largest t_f [s]
    delta: float  # largest delta [s]
    smallest_delta: float  # smallest delta [s]
    gain: float  # smallest observer gain [N m s]; not used without an observer
    largest_gain: float  # largest observer gain [N m s]
    k1: float  # largest K1 [1/s]
    sign_width: float  # smallest thickness of the boundary layer
    surface_rate: float  # largest surface rate c [1/s]
    smallest_period: float  # smallest control period [s]; not used in the continuous loop
    period: float  # largest control period [s]


_INTERVALS = (  # smallest and largest value in `Reach`
    ("smallest_t_f", "t_f"), ("smallest_delta", "delta"), ("gain", "largest_gain"), ("smallest_period", "period")
)  # fmt: skip
_ABOVE_ZERO = ("smallest_t_f", "t_f", "smallest_period", "period")  # divisors of clocks and steps


def reach_of(scenario: Scenario, **farther: float) -> Reach:
    """Return the reach that contains only the scenario's gains and control period, with some fields changed.

    Args:
        scenario: a validated scenario.
        farther: fields of `Reach` with other values.

    Raises:
        ValueError: there is no such field, a value is not finite, is negative or is a time of 0, or a smallest value
            exceeds its largest value.
        TypeError: `scenario` is not a scenario.

    >>> from ptsmc_jax.scenario import from_tables
    >>> reach = reach_of(from_tables({}), delta=2.0)
    >>> reach.t_f, reach.smallest_delta, reach.delta
    (30.0, 0.05, 2.0)
    """
    check_scenario(scenario)
    names = [field.name for field in dataclasses.fields(Reach)]
    for name, value in farther.items():
        if name not in names:
            raise ValueError(f"there is no {name} in a reach; allowed are {', '.join(names)}")
        if np.ndim(value) or np.asarray(value).dtype.kind not in "iuf" or not 0.0 <= value < math.inf:
            raise ValueError(f"{name} is {value!r}, but must be a finite number of at least 0")
        if name in _ABOVE_ZERO and value == 0.0:
            raise ValueError(f"{name} is {value!r}, but must be greater than 0")
    table = scenario.controller
    gains, delta = getattr(scenario.observer, "gain", (0.0,)), scenario.hand_over
    k1, width, rate = getattr(table, "k1", 1.0), getattr(table, "sign_width", 0.0), getattr(table, "surface_rate", 1.0)
    period = scenario.loop.period
    present = Reach(table.t_f, table.t_f, delta, delta, min(gains), max(gains), k1, width, rate, period, period)
    made = dataclasses.replace(present, **farther)
    for low, high in _INTERVALS:
        if getattr(made, low) > getattr(made, high):
            raise ValueError(f"{low} is {getattr(made, low):g}, but must be at most {high}, {getattr(made, high):g}")
    return made


def timing(scenario: Scenario, setup: Setup, reach: Reach, saves: object) -> tuple[Any, int]:
    """Return the clock of a run, and the number of integration steps in a control period.

    Args:
        scenario: the scenario.
        setup: its parts without a clock.
        reach: ranges of gains and control period that the clock must suit.
        saves: times [s] at which the grid of the continuous loop must have nodes.

    Raises:
        ScenarioError: the run would need too many steps; the message names the key that causes them.
    """
    loop, frequencies, visited = scenario.loop, _frequencies(scenario, setup, reach), None
    if reach.t_f > scenario.controller.t_f:
        scenario.check_reference_until(scenario.end + reach.t_f - scenario.controller.t_f)
    if setup.plant.custom_functions:
        hurried = _with_papers_law(setup.with_t_f(vector(reach.smallest_t_f)))
        visited = solutions.visited(hurried)
        frequencies["plant.system"] = _fastest_of_system(hurried, visited)
    if not scenario.sampled:
        for key in {"plant.system", "flexible.frequency"} & set(frequencies):
            frequencies[key] *= 2.0  # 0.15 rad per step, since a system is unknown and modes ring for a long time
        return _grid(scenario, reach, setup, saves, frequencies, visited), 1
    substeps = _substeps(scenario, reach.period, frequencies)
    last = scenario.end + reach.t_f - scenario.controller.t_f
    _check_steps(scenario, last, reach.smallest_period, substeps)
    if loop.clock == "flight":
        made = clock.flight(reach.smallest_period, last)
    else:
        late = scenario.end - scenario.controller.t_f + reach.delta
        made = clock.anchored(reach.smallest_period, scenario.end, reach.t_f, late)
    return dataclasses.replace(made, period=vector(loop.period), t_end=vector(scenario.end)), substeps


def steps(parts: Parts) -> int:
    """Return the number of integration steps of a run."""
    return parts.clock.count * parts.substeps


def _check_steps(scenario: Scenario, last: float, period: float, substeps: int) -> None:
    """Raise ScenarioError if a sampled run until `last` [s] needs more than `MOST_STEPS` integration steps."""
    needed = last / period * substeps
    if needed > MOST_STEPS:
        asks = (
            f"the sampled loop would take {needed:.6g} steps, {substeps} a period, and at most {MOST_STEPS} are allowed"
        )
        if last > scenario.end:
            raise ScenarioError(f"tune.bounds.t_f asks for runs of {last:.6g} s, but must be lower: {asks}")
        raise wrong("loop.t_end", scenario.loop.t_end, f"earlier: {asks}")


def _frequencies(scenario: Scenario, setup: Setup, reach: Reach) -> dict[str, float]:
    """Return the angular frequencies of disturbance and plant [rad/s], by the key that causes each of them."""
    disturbed = {"disturbance.frequency": max(term.quickest() for term in scenario.terms)}
    return disturbed | scenario.frequencies(setup, reach.smallest_t_f)


def _fastest(frequencies: Mapping[str, float]) -> float:
    """Return the highest angular frequency of the motion [rad/s]: of the disturbance, or the sum of all others."""
    others = sum(value for key, value in frequencies.items() if key != "disturbance.frequency")
    return max(frequencies["disturbance.frequency"], others)


def _substeps(scenario: Scenario, period: float, frequencies: Mapping[str, float]) -> int:
    """Return the number of integration steps in a control period [s].

    RK4 with 0.025 rad per step has an error of about 1e-9 rad over 100 s. For disturbances, flexible modes and custom
    systems, 0.1 rad per step gives a relative error of about 1e-7. A torque that changes within the period, because of
    a lag or a rate limit, needs no further steps: its impulse and first moment are exact, see `Actuators.over`.
    """
    frequencies = {key: value / (4 if key in _SMOOTHED else 1) for key, value in frequencies.items()}
    needed = period * _fastest(frequencies) / 0.025
    if needed > MOST_SUBSTEPS:
        asks = f"loop.period = {period} would take more than {MOST_SUBSTEPS} integration steps a period"
        raise _lower(scenario, max(frequencies, key=lambda key: frequencies[key]), asks)
    steps = max(1, math.ceil(needed))
    # round up to a power of 2 or 1.5 times one: nearly all gains then share one compiled program
    power = 2 ** (steps.bit_length() - 1)
    return next(allowed for allowed in (power, power + power // 2, 2 * power) if allowed >= steps)


def _lower(scenario: Scenario, key: str, asks: str) -> ScenarioError:
    if key == "plant.system":
        return ScenarioError(f"plant.system is too fast, in its own modes or in time: {asks}")
    table, _, name = key.partition(".")
    if name == "code":
        return ScenarioError(f"{key} says that it is too fast: {asks}")
    if key in ("reference.file", "reference.kind"):
        shown = show(getattr(getattr(scenario, table), name))
        return ScenarioError(f"{key} is {shown}, whose attitude is too fast: {asks}")
    if key == "controller.eta":  # blame t_f, because eta may be at its lower bound already
        eta = f"with controller.eta = {scenario.controller.eta}"
        shorter = ", or loop.period shorter" if scenario.sampled else ""
        return wrong("controller.t_f", scenario.controller.t_f, f"longer {eta}{shorter}: {asks}")
    *tables, name = name.split(".")
    value = getattr(functools.reduce(getattr, tables, getattr(scenario, table)), name, None)
    if value is None:  # the key belongs to terms of a sum of disturbances
        value = [getattr(term, name) for term in scenario.terms if hasattr(term, name)]
    if value == []:
        return ScenarioError(f"{table} is too fast: {asks}")
    return wrong(key, value, f"{'longer' if key in ('reference.duration', 'controller.t_f') else 'lower'}: {asks}")


@programs.jit  # compiled as one program instead of one for each operation
def _boundary_layer(controller: Any, observer: Any, visited: Any) -> tuple:
    """Return the fastest rates in the boundary layer before and after the hand-over [1/s]."""
    return rates.boundary_layer(controller, observer.error_bound().largest, visited)


def _with_papers_law(setup: Setup) -> Setup:
    """Return the parts with the prescribed-time law. Its exact motion represents the states of a run under any law."""
    law = setup.controller
    if law.prescribed:
        return setup
    gains = (vector(v) for v in (3.0, law.delta, 1.0, 1e-3, 1.0))  # eta, delta, K1, width of the sign, surface rate
    return dataclasses.replace(setup, controller=PrescribedTime(law.kinematics, law.t_f, *gains))


@programs.jit
def _rates_of_system(setup: Setup, visited: tuple) -> tuple:
    """Return Jacobians of a custom system at the visited states, and w' and w'' of the motion with zero error."""
    plant, kinematics = typing.cast(System, setup.plant), setup.controller.kinematics
    none = jnp.zeros(plant.inputs)

    def jacobian(t: Any, x: Any) -> Any:
        u = kinematics.invert(x, t, none, none)
        return plant.jacobian(t, plant.with_hidden_at_rest(x), u)

    def along(t: Any) -> Any:
        return plant_motion(kinematics, t, setup.initial, (none, none, none)).w_dot

    times = setup.t_end * jnp.linspace(0.0, 1.0, 509)  # 509 is prime, so that the samples rarely alias with a period
    steady = lapack.vmap(lambda t: jax.jvp(along, (t,), (jnp.ones_like(t),)))(times)
    return lapack.vmap(jacobian)(*visited), steady


def _fastest_of_system(setup: Setup, visited: tuple) -> float:
    """Return the fastest rate of a custom system along its run [rad/s], from its modes and its explicit time."""
    jacobians, (acceleration, change) = _rates_of_system(solutions.bare(setup), visited)
    matrices = np.asarray(jacobians)
    modes = np.abs(np.linalg.eigvals(matrices[np.all(np.isfinite(matrices), axis=(1, 2))])).max(initial=0.0)
    size, quick = (float(np.nanmax(np.abs(v), initial=0.0)) for v in (acceleration, change))
    return float(max(modes, quick / size if size > 1e-12 else 0.0))


def _with_gain(observer: Any, gain: float) -> Any:
    return dataclasses.replace(observer, gain=vector(np.full(np.shape(observer.gain), gain)))


def _fastest_layer(reach: Reach, law: Any, observer: Any, visited: Any) -> tuple[float, float]:
    """Return the fastest rates of boundary layer and observer before and after the hand-over, within reach [1/s]."""
    before = after = 0.0
    if hasattr(observer, "gain"):  # the smallest gain gives the largest K2, the largest gain the fastest observer
        before = after = _with_gain(observer, reach.largest_gain).fastest()
        observer = _with_gain(observer, reach.gain)
    if reach.sign_width > 0.0:
        for t_f in (reach.smallest_t_f, reach.t_f):
            layer = _boundary_layer(dataclasses.replace(law, t_f=vector(t_f)), observer, visited)
            before, after = max(before, float(layer[0])), max(after, float(layer[1]))
    return before, after


def _grid(
    scenario: Scenario, reach: Reach, setup: Setup, saves: object, frequencies: Mapping[str, float], visited: Any
) -> clock.Graded:
    """Return the grid of the continuous loop; raise ScenarioError if it needs more than `MOST_STEPS` steps."""
    loop = scenario.loop
    t_end = scenario.end + reach.t_f - scenario.controller.t_f
    saves = (*np.ravel(np.asarray(saves, dtype=float)), *setup.observer.nodes())
    names = ("t_f", "k1", "sign_width", "surface_rate")
    widest = dataclasses.replace(setup.controller, **{name: vector(getattr(reach, name)) for name in names})
    layer = _fastest_layer(reach, widest, setup.observer, visited)
    decays, frequency, order = rates.hold_rates(widest), _fastest(frequencies), scenario.grid_order

    def steps(frequency: float = 0.0, layer: tuple[float, float] = (0.0, 0.0), rate: float = 0.0) -> float:
        taken = sum(clock.graded_steps(reach.t_f, reach.smallest_delta, t_end, rate, frequency, layer, order))
        return taken if taken == taken else math.inf

    rate = max(decays.values())
    needed = steps(frequency, layer, rate)
    if not needed <= MOST_STEPS:
        asks = f"the continuous loop would need {needed:.6g} steps, and at most {MOST_STEPS} are allowed"
        by_key = {key: steps(value) for key, value in frequencies.items()}
        by_key |= {f"controller.{key}": steps(rate=value) for key, value in decays.items()}
        by_key["controller.sign_width"] = steps(layer=layer)
        worst = max(by_key, key=lambda key: by_key[key])
        if not by_key["disturbance.frequency"] <= MOST_STEPS:  # the switching term gets faster with it, too
            worst = "disturbance.frequency"
        if by_key[worst] <= steps() * 1.5:
            raise wrong("loop.t_end", t_end, f"earlier: {asks}")
        if worst == "controller.sign_width":
            raise wrong(worst, scenario.controller.sign_width, f"larger, or 0 for the discontinuous sign: {asks}")
        raise _lower(scenario, worst, asks)
    grid = clock.graded(reach.t_f, reach.smallest_delta, t_end, scenario.window, rate, frequency, layer, saves, order)
    return dataclasses.replace(grid, t_end=vector(loop.t_end))
