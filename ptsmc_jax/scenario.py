"""Scenarios: read, checked as a whole, changed, and turned into the parts that the rollout flies."""

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ptsmc_jax import attitude_keys, build, checks, clock, controllers, dispersions, metrics, observers, schema, theory
from ptsmc_jax import tables as t
from ptsmc_jax.checks import MOST_STEPS
from ptsmc_jax.requirements import Requirement
from ptsmc_jax.rollout import SINGULAR_CLEARANCE, Parts
from ptsmc_jax.schema import ScenarioError, wrong
from ptsmc_jax.tables import Scenario

MOST_SUBSTEPS = 50
MOVING = 4  # steps a period at least where the torque changes within it


@dataclass(frozen=True)
class Study:
    """A scenario ready to run."""

    scenario: Scenario
    parts: Parts
    dispersion: dispersions.Dispersion
    requirements: tuple[Requirement, ...]

    @property
    def drawn(self) -> bool:
        """Whether anything differs from trial to trial."""
        return self.dispersion.varies or self.parts.sensors is not None or self.parts.walk_rate is not None

    @property
    def catalogue(self) -> dict[str, tuple[str, str]]:
        """The metrics that this plant has: name -> (unit, what it is)."""
        names = metrics.CATALOGUES[self.scenario.plant.kind]
        return names if self.scenario.wheels is not None else {k: v for k, v in names.items() if "wheel" not in k}


@dataclass(frozen=True)
class Reach:
    """How far gains may move without another compilation: the clock's sizes are chosen for it."""

    t_f: float  # largest [s]
    delta: float  # largest [s]
    smallest_delta: float  # [s]
    gain: float  # smallest observer gain [N m s]; of no meaning without an observer
    largest_gain: float
    k1: float  # largest [1/s]
    sign_width: float  # smallest


def read(path: str | Path) -> Scenario:
    """The scenario of a TOML file, checked; raises ScenarioError with one sentence."""
    return from_tables(schema.load(path))


def from_tables(raw: Mapping[str, Any]) -> Scenario:
    """The scenario of raw tables (a parsed file), checked; raises ScenarioError with one sentence."""
    scenario = checks.resolve(schema.parse(raw, metrics.CATALOGUES))
    checks.check(scenario)
    return scenario


def replace(scenario: Scenario, **changes: Any) -> Scenario:
    """The scenario with other values, keys written table__key, checked again: replace(s, controller__eta=4.0).

    None returns a key, or a whole table, to its default. Another kind of a table drops the keys of the old one.
    """
    tables = schema.dump(scenario)
    for name, value in changes.items():
        table, _, key = name.partition("__")
        if value is None:
            removed = tables if not key else tables.get(table, {})
            removed.pop(key or table, None)
        elif not key:
            tables[table] = value
        elif key == "kind" and tables.get(table, {}).get("kind") != value:
            tables[table] = {"kind": value}
        else:
            tables[table] = {**tables.get(table, {}), key: value}
    return from_tables(tables)


def study(scenario: Scenario, saves: object = (), reach: Reach | None = None, *, drawn: bool = True) -> Study:
    """The parts of a checked scenario; `saves`: times [s] at which a continuous run must have nodes.

    drawn: the initial attitude is drawn where a dispersion says so; False: the nominal one is flown, and looked at.
    Raises ScenarioError where the law meets its singularity on the way from the initial state to the reference.
    """
    parts = _parts(scenario, saves, reach)
    dispersion = build.dispersion(scenario)
    if isinstance(parts.controller, controllers.PrescribedTime):
        _check_reference(scenario, parts)
    # a drawn trial that meets the singularity is marked and counted
    if scenario.initial is not None and (not drawn or dispersion.attitude is None):
        _check_start(scenario, parts)
    units = metrics.CATALOGUES[scenario.plant.kind]
    requirements = tuple(
        Requirement(name, value.limit if isinstance(value, t.Limit) else float(value), units[name][0])
        for name, value in scenario.requirements.items()
    )
    return Study(scenario, parts, dispersion, requirements)


def reach_of(scenario: Scenario) -> Reach:
    """The reach of a scenario's own gains: none beyond them."""
    table = scenario.controller
    gains = getattr(scenario.observer, "gain", (0.0,))
    return Reach(table.t_f, table.delta, table.delta, min(gains), max(gains), table.k1, table.sign_width)


_SINGULAR = "q4 = 0 (180 degrees from the inertial frame's identity), which the additive law cannot cross"
_OPPOSITE = "q_e4 = 0 (180 degrees from the reference), at which the law is singular"


def _check_reference(scenario: Scenario, parts: Parts) -> None:
    """Refuse a reference on which the additive law meets its singularity."""
    assert scenario.reference is not None
    grid = jnp.linspace(0.0, float(parts.t_end), 4001)
    held = np.asarray(jax.vmap(lambda time: parts.reference(time).q[3])(grid))
    worst = int(np.argmin(np.abs(held)))
    crosses = np.any(np.sign(held) != np.sign(held[0]))
    if crosses or abs(held[worst]) < SINGULAR_CLEARANCE:
        when = float(grid[int(np.argmax(np.sign(held) != np.sign(held[0])))]) if crosses else float(grid[worst])
        raise ScenarioError(
            f"reference.kind is {schema.show(scenario.reference.kind)}, but its attitude reaches {_SINGULAR}, "
            f"at t = {when:.4g} s; allowed is a reference that stays away from it until t_end"
        )


def _check_start(scenario: Scenario, parts: Parts) -> None:
    """Refuse an initial attitude from which the law meets its singularity on the way."""
    assert scenario.initial is not None
    additive = isinstance(parts.controller, controllers.PrescribedTime)
    singular, name = (_SINGULAR, "|q4|") if additive else (_OPPOSITE, "|q_e4|")
    key, value = attitude_keys.attitude_key(scenario.initial)
    said = f"initial.{key} is {schema.show(value)}"
    times, _, square = (np.asarray(v) for v in _path(parts))
    if square[0] < SINGULAR_CLEARANCE**2:
        raise ScenarioError(f"{said}, but lies at {singular}; allowed is {name} of at least {SINGULAR_CLEARANCE}")
    if square.min() < SINGULAR_CLEARANCE**2:
        when = float(times[int(np.argmin(square))])
        raise ScenarioError(
            f"{said} with initial.rate = {schema.show(scenario.initial.rate)}, but from there the path to the "
            f"reference meets {singular}, at t = {when:.4g} s; allowed is a start whose path keeps {name} above "
            f"{SINGULAR_CLEARANCE}"
        )


_path = jax.jit(theory.exact_path)


def _parts(scenario: Scenario, saves: object, reach: Reach | None) -> Parts:
    reach = reach or reach_of(scenario)
    model, controller, initial, reference = build.plant(scenario)
    observer = build.observer(scenario, model)
    loop = scenario.loop
    assert loop.t_end is not None
    substeps = 1
    if loop.mode == "continuous":
        saves = (*np.ravel(np.asarray(saves, dtype=float)), *observer.nodes())
        timing: Any = _grid(scenario, reach, controller, observer, saves)
    else:
        late = loop.t_end - scenario.controller.t_f + reach.delta
        anchored = loop.clock == "anchored"
        timing = (
            clock.anchored(loop.period, loop.t_end, reach.t_f, late)
            if anchored
            else clock.flight(loop.period, loop.t_end)
        )
        substeps = _substeps(scenario)
    disturbance, walk = build.disturbance(scenario, model.inputs)
    return Parts(
        plant=model if scenario.spacecraft is None else build.true_body(scenario),
        disturbance=disturbance,
        reference=reference,
        controller=controller,
        observer=observer,
        sensors=build.sensors(scenario),
        clock=timing,
        initial=initial,
        t_end=build.vector(loop.t_end),
        window=build.vector(loop.window),
        settling_angle=build.vector(loop.settling_angle),
        actuators=build.actuators(scenario),
        walk_rate=walk,
        substeps=substeps,
    )


def _frequencies(scenario: Scenario) -> dict[str, float]:
    """How fast things happen [rad/s], by the key that says so."""
    waves = [np.max(np.abs(getattr(term, "frequency", 0.0))) for term in checks.terms(scenario)]
    found = {"disturbance.frequency": float(max(waves))}
    if scenario.initial is not None:
        found["initial.rate"] = float(np.linalg.norm(scenario.initial.rate))
        found |= _reference_frequencies(scenario.reference)
        found["controller.eta"] = 2.0 * scenario.controller.eta / scenario.controller.t_f  # of the slew
    return found


def _reference_frequencies(table: Any) -> dict[str, float]:
    """How fast the reference turns and changes [rad/s], by the key that says so."""
    if isinstance(table, t.SpinReference):
        return {"reference.rate": float(np.linalg.norm(table.rate))}
    if isinstance(table, t.SinusoidReference):
        turning = float(np.linalg.norm(np.multiply(table.amplitude, table.frequency)))
        return {"reference.frequency": turning + float(np.max(np.abs(table.frequency)))}
    if isinstance(table, t.SlewReference):  # largest rate of the quintic, and the motion's own time
        turning = 1.875 * float(np.linalg.norm(attitude_keys.turn(table)))
        return {"reference.duration": (turning + 2.0 * np.pi) / table.duration}
    return {}


def _fastest(scenario: Scenario) -> float:
    """Highest angular frequency of the motion [rad/s]."""
    frequencies = _frequencies(scenario)
    wave = frequencies.pop("disturbance.frequency")
    return max(wave, sum(frequencies.values()))


def _substeps(scenario: Scenario) -> int:
    """Integration steps a control period: RK4 at 0.025 rad a step leaves some 1e-9 rad over 100 s."""
    frequencies = _frequencies(scenario)
    frequencies["disturbance.frequency"] /= 4
    wave = frequencies["disturbance.frequency"]
    needed = scenario.loop.period * max(wave, sum(frequencies.values()) - wave) / 0.025
    if needed > MOST_SUBSTEPS:
        asks = f"loop.period = {scenario.loop.period} would take more than {MOST_SUBSTEPS} integration steps a period"
        raise _lower(scenario, max(frequencies, key=lambda key: frequencies[key]), asks)
    moving = any(getattr(scenario.hardware, key, None) is not None for key in ("torque_rate_limit", "torque_lag"))
    return max(MOVING if moving else 1, math.ceil(needed))


def _lower(scenario: Scenario, key: str, asks: str) -> ScenarioError:
    table, _, name = key.partition(".")
    if key == "controller.eta":  # over a short t_f
        asks += f" at controller.t_f = {scenario.controller.t_f}"
    value = getattr(getattr(scenario, table), name, None)
    if value is None:  # of a term in a sum
        value = [getattr(term, name) for term in checks.terms(scenario) if hasattr(term, name)]
    return wrong(key, value, f"{'longer' if key == 'reference.duration' else 'lower'}: {asks}")


@jax.jit  # one program, where each of its operations would be one
def _boundary_layer(controller: Any, observer: Any) -> tuple:
    """Fastest rates of the smooth sign's boundary layer before and after the hand-over [1/s]."""
    return controller.boundary_layer(observer.error_bound().largest)


def _with_gain(observer: Any, gain: float) -> Any:
    return dataclasses.replace(observer, gain=jnp.full_like(observer.gain, gain))


def _grid(scenario: Scenario, reach: Reach, controller: Any, observer: Any, saves: object) -> clock.Graded:
    """Grid of the continuous loop; refused where it would take more than a sensible number of steps."""
    loop = scenario.loop
    t_end = loop.t_end
    assert t_end is not None
    resolved = 0.0
    if not isinstance(observer, observers.NoObserver):  # K2 is largest with the smallest gain
        resolved = _with_gain(observer, reach.largest_gain).fastest()
        observer = _with_gain(observer, reach.gain)
    widest = dataclasses.replace(
        controller, t_f=build.vector(reach.t_f), k1=build.vector(reach.k1), sign_width=build.vector(reach.sign_width)
    )
    layer = (0.0, 0.0)
    if reach.sign_width > 0.0:
        before, after = _boundary_layer(widest, observer)
        layer = (float(before), float(after))
    layer = (max(layer[0], resolved), max(layer[1], resolved))
    rate, frequency = widest.hold_rate(), _fastest(scenario)
    order = 1 if isinstance(scenario.plant, t.SpacecraftPlant) else controller.order

    def steps(frequency: float = 0.0, layer: tuple[float, float] = (0.0, 0.0)) -> float:
        taken = sum(clock.graded_steps(reach.t_f, reach.smallest_delta, t_end, rate, frequency, layer, order))
        return taken if taken == taken else math.inf

    needed = steps(frequency, layer)
    if not needed <= MOST_STEPS:
        asks = f"the continuous loop would need {needed:.6g} steps, and at most {MOST_STEPS} are allowed"
        by_key = {key: steps(value) for key, value in _frequencies(scenario).items()}
        by_key["controller.sign_width"] = steps(layer=layer)
        worst = max(by_key, key=lambda key: by_key[key])
        if by_key[worst] <= steps() * 1.5:
            raise wrong("loop.t_end", t_end, f"earlier: {asks}")
        if worst == "controller.sign_width":
            raise wrong(worst, scenario.controller.sign_width, f"larger, or 0 for the exact sign: {asks}")
        raise _lower(scenario, worst, asks)
    return clock.graded(reach.t_f, reach.smallest_delta, t_end, loop.window, rate, frequency, layer, saves, order)
