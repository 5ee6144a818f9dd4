"""Checked scenarios turned into what flies: parts, dispersion, requirements."""

import dataclasses
import typing
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ptsmc_jax import programs
from ptsmc_jax.dispersions import variation
from ptsmc_jax.laws.base import Prescribed
from ptsmc_jax.laws.error_motions import ErrorVector
from ptsmc_jax.numerics.pytrees import vector
from ptsmc_jax.observers import none
from ptsmc_jax.plants.second_order import System
from ptsmc_jax.scenario import attitude_keys, build, errors, own_checks, reading, timing
from ptsmc_jax.scenario import tables as t
from ptsmc_jax.scenario.errors import ScenarioError
from ptsmc_jax.scenario.tables import Scenario
from ptsmc_jax.simulation import catalogues, clock
from ptsmc_jax.simulation.requirements import Requirement
from ptsmc_jax.simulation.rollout import SINGULAR_CLEARANCE, Parts
from ptsmc_jax.theory import solutions

SINGULAR_CONDITION = 1e14  # of a matrix in double precision


@dataclass(frozen=True)
class Study:
    """A scenario ready to run."""

    scenario: Scenario
    parts: Parts
    dispersion: variation.Dispersion
    requirements: tuple[Requirement, ...]  # of its runs
    margins: tuple[Requirement, ...]  # of its loop

    @property
    def drawn(self) -> bool:
        """Whether anything differs from trial to trial."""
        return self.dispersion.varies or self.parts.sensors is not None or self.parts.walk_rate is not None

    @property
    def catalogue(self) -> dict[str, catalogues.Entry]:
        """The metrics that this scenario's runs have, by name."""
        return catalogue(self.scenario)


def catalogue(scenario: Scenario) -> dict[str, catalogues.Entry]:
    """The metrics that a scenario's runs have, by name."""
    entries = catalogues.CATALOGUES[scenario.plant.kind]
    return {name: e for name, e in entries.items() if e.table is None or getattr(scenario, e.table) is not None}


def requirements(scenario: Scenario) -> tuple[Requirement, ...]:
    """What a scenario asks of its runs."""
    units = catalogues.CATALOGUES[scenario.plant.kind]
    return tuple(
        Requirement(name, value.limit, units[name].unit, value.quantile, value.confidence)
        if isinstance(value, t.Limit)
        else Requirement(name, float(value), units[name].unit)
        for name, value in scenario.requirements.items()
        if name in units
    )


def margin_requirements(scenario: Scenario) -> tuple[Requirement, ...]:
    """What a scenario asks of its loop."""
    asked = {name: value for name, value in scenario.requirements.items() if name in catalogues.MARGINS}
    return tuple(
        Requirement(
            name, float(typing.cast(float, value)), catalogues.MARGINS[name][0], at_least=catalogues.MARGINS[name][2]
        )
        for name, value in asked.items()
    )


def study(scenario: Scenario, saves: object = (), reach: timing.Reach | None = None, *, drawn: bool = True) -> Study:
    """The parts of a checked scenario; `saves`: times [s] at which a continuous run must have nodes.

    drawn: the initial attitude is drawn where a dispersion says so; False: the nominal one is flown, and looked at.
    Runs the file of a system that the scenario names, which is then a program: read it before. Raises ScenarioError
    where the law meets its singularity on the way from the initial state to the reference.
    """
    scenario = reading.complete(scenario)
    parts = _parts(scenario, saves, reach)
    own_checks.check(parts, scenario)
    dispersion = build.dispersion(scenario, parts)
    if isinstance(parts.controller, ErrorVector):
        _check_reference(scenario, parts)
    if isinstance(parts.plant, System):
        _check_system(scenario, parts.plant, parts)
    # a drawn trial that meets the singularity is marked and counted
    if scenario.initial is not None and (not drawn or (dispersion.attitude is None and dispersion.reference is None)):
        _check_start(scenario, parts)
    return Study(scenario, parts, dispersion, requirements(scenario), margin_requirements(scenario))


def _check_system(scenario: Scenario, system: System, parts: Parts) -> None:
    """Refuse a system that the law, or the observer, cannot invert where it starts."""
    start = jnp.zeros(()), parts.initial
    matrices = {"dF/dx2 G": system.slope(*start) @ system.input_gain(*start)}
    if not isinstance(parts.observer, none.NoObserver):
        matrices["D"] = system.disturbance_gain(*start)
    for name, matrix in matrices.items():
        if not np.linalg.cond(np.asarray(matrix)) < SINGULAR_CONDITION:
            user = "the law" if name != "D" else f"observer.kind = {errors.show(scenario.observer.kind)}"
            raise ScenarioError(
                f"plant.system has a singular {name} at t = 0 in plant.x0, which {user} must invert; allowed is an "
                "invertible one" + ("" if name != "D" else ', or observer.kind = "none"')
            )


_SINGULAR = "q4 = 0 (180 degrees from the inertial frame's identity), which the additive law cannot cross"
_OPPOSITE = "q_e4 = 0 (180 degrees from the reference), at which the law is singular"


def _check_reference(scenario: Scenario, parts: Parts) -> None:
    """Refuse a reference on which the additive law meets its singularity."""
    assert scenario.reference is not None
    grid = np.linspace(0.0, float(parts.t_end), 4001)
    held = np.asarray(_scalar_part(parts, grid))
    worst = int(np.argmin(np.abs(held)))
    crosses = np.any(np.sign(held) != np.sign(held[0]))
    if crosses or abs(held[worst]) < SINGULAR_CLEARANCE:
        when = float(grid[int(np.argmax(np.sign(held) != np.sign(held[0])))]) if crosses else float(grid[worst])
        raise ScenarioError(
            f"reference.kind is {errors.show(scenario.reference.kind)}, but its attitude reaches {_SINGULAR}, "
            f"at t = {when:.4g} s; allowed is a reference that stays away from it until t_end, "
            'or controller.error = "multiplicative"'
        )


@programs.jit
def _scalar_part(parts: Parts, times: Array) -> Array:
    """q_f4 of the reference at these times (times,) [s]."""
    return jax.vmap(lambda time: parts.reference(time).q[3])(times)


def _check_start(scenario: Scenario, parts: Parts) -> None:
    """Refuse an initial attitude from which the law meets its singularity on the way."""
    assert scenario.initial is not None
    additive, law = isinstance(parts.controller, ErrorVector), parts.controller
    singular, name = (_SINGULAR, "|q4|") if additive else (_OPPOSITE, "|q_e4|")
    key, value = attitude_keys.attitude_key(scenario.initial)
    said = f"initial.{key} is {errors.brief(value)}"
    if isinstance(law, Prescribed):
        times, _, square = (np.asarray(v) for v in solutions.exact_path(parts))
    else:  # of the others only the start is known
        target = parts.reference(jnp.zeros_like(parts.t_end))
        times, square = np.zeros(1), np.square([float(law.clearance(law.align(parts.initial, target), target))])
    if square[0] < SINGULAR_CLEARANCE**2:
        raise ScenarioError(f"{said}, but lies at {singular}; allowed is {name} of at least {SINGULAR_CLEARANCE}")
    if square.min() < SINGULAR_CLEARANCE**2:
        when = float(times[int(np.argmin(square))])
        raise ScenarioError(
            f"{said} with initial.rate = {errors.brief(scenario.initial.rate)}, but from there the path to the "
            f"reference meets {singular}, at t = {when:.4g} s; allowed is a start whose path keeps {name} above "
            f"{SINGULAR_CLEARANCE}"
        )


def _parts(scenario: Scenario, saves: object, reach: timing.Reach | None) -> Parts:
    model, controller, initial, reference = build.plant(scenario)
    plant = model if scenario.spacecraft is None else build.true_body(scenario)
    disturbance, walk = build.disturbance(scenario, plant)
    loop = scenario.loop
    parts = Parts(
        plant=plant,
        disturbance=disturbance,
        reference=reference,
        controller=controller,
        observer=scenario.observer.build(scenario, model),
        sensors=build.sensors(scenario),
        clock=clock.flight(1.0, 1.0),  # until it is known how fast things happen
        initial=initial,
        t_end=vector(loop.t_end),
        window=vector(loop.window),
        settling_angle=vector(loop.settling_angle),
        actuators=build.actuators(scenario),
        walk_rate=walk,
    )
    clock_of_it, substeps = timing.timing(scenario, parts, reach or timing.reach_of(scenario), saves)
    return dataclasses.replace(parts, clock=clock_of_it, substeps=substeps)
