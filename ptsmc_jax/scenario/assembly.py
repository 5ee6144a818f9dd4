"""Build everything that a run needs from a validated scenario: parts, dispersions, requirements. Start with `study`."""

import typing
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import jax.numpy as jnp

from ptsmc_jax import configure
from ptsmc_jax.devices.actuators import spare_allocations
from ptsmc_jax.dispersions.base import INITIAL_ATTITUDE, INITIAL_RATE, INITIAL_STATE
from ptsmc_jax.dispersions.quantities import QUANTITIES, level_name
from ptsmc_jax.dispersions.variation import Dispersion
from ptsmc_jax.numerics.pytrees import listing, vector
from ptsmc_jax.plants.base import Plant
from ptsmc_jax.scenario import custom_checks, reading, start_checks, timing
from ptsmc_jax.scenario import tables as t
from ptsmc_jax.scenario.errors import ScenarioError
from ptsmc_jax.scenario.tables import Scenario
from ptsmc_jax.signals import disturbances
from ptsmc_jax.simulation import catalogues
from ptsmc_jax.simulation.assembly import Parts
from ptsmc_jax.simulation.requirements import Requirement


@dataclass(frozen=True)
class Study:
    """A scenario with the parts, dispersions and requirements that are built from it."""

    scenario: Scenario
    parts: Parts
    dispersion: Dispersion
    requirements: tuple[Requirement, ...]  # on metrics of runs
    margins: tuple[Requirement, ...]  # on stability margins of the loop

    __repr__ = listing

    @property
    def drawn(self) -> bool:
        """Whether trials differ from each other."""
        return self.dispersion.varies or not self.parts.sensors.perfect or self.parts.walk_rate is not None

    @property
    def catalogue(self) -> dict[str, catalogues.Entry]:
        """The metrics of this scenario's runs, by name."""
        return catalogue(self.scenario)

    @cached_property
    def missing_derivative(self) -> str | None:
        """Why the derivatives of a custom law are zero, in words; None: they are not."""
        return custom_checks.describe_missing_derivative(self.parts, self.scenario)


def catalogue(scenario: Scenario) -> dict[str, catalogues.Entry]:
    """Return the metrics of a scenario's runs, by name."""
    timed_metrics = {r.timed for r in requirements(scenario)}

    def is_available(name: str, entry: catalogues.Entry) -> bool:
        if name.startswith(catalogues.WITHIN) and name not in timed_metrics:
            return False
        if name.startswith(catalogues.KNOWLEDGE) and not scenario.uses_measurements:
            return False
        return entry.table is None or getattr(scenario, entry.table, None) is not None

    return {name: entry for name, entry in scenario.metrics.items() if is_available(name, entry)}


def requirements(scenario: Scenario) -> tuple[Requirement, ...]:
    """Return the requirements on the metrics of a scenario's runs."""
    metrics = scenario.metrics
    return tuple(
        Requirement(
            name,
            value.limit,
            metrics[name].unit,
            value.fraction,
            value.confidence,
            interpretation=value.interpretation or "ensemble",
        )
        if isinstance(value, t.Limit)
        else Requirement(name, float(value), metrics[name].unit)
        for name, value in scenario.requirements.items()
        if name in metrics
    )


def margin_requirements(scenario: Scenario) -> tuple[Requirement, ...]:
    """Return the requirements on the stability margins of a scenario's loop."""
    return tuple(
        Requirement(name, float(typing.cast(float, value)), margin.unit, at_least=margin.at_least)
        for name, value in scenario.requirements.items()
        if (margin := catalogues.MARGINS.get(name)) is not None
    )


def study(
    scenario: Scenario | str | Path, saves: object = (), reach: timing.Reach | None = None, *, drawn: bool = True
) -> Study:
    """Build the parts, dispersions and requirements of a scenario.

    The function runs Python files that the scenario names. Read such a file before you run a scenario of somebody else.

    Args:
        scenario: a validated scenario, or the path of a scenario file.
        saves: times [s] at which the grid of the continuous loop must have nodes.
        reach: ranges of gains and control period that the compiled program must cover; by default the scenario's
            values only, see `timing.reach_of`.
        drawn: whether the dispersed initial attitude is simulated. If False, the nominal path is checked for the
            singularity of the law even if the attitude is dispersed.

    Returns:
        The study, whose `parts` are the arguments of the simulation.

    Raises:
        ScenarioError: the law meets its singularity between the initial state and the reference, custom code fails, or
            the run needs too many steps.
        TypeError: `scenario` is not a scenario, or `reach` is not a `Reach`.
    """
    if not isinstance(reach, timing.Reach | None):
        raise TypeError(f"a reach is needed, as reach_of(scenario) returns it, but this is a {type(reach).__name__}")
    configure.warn_if_not_configured()
    scenario = reading.complete(reading.to_scenario(scenario))
    setup = build_setup(scenario)
    clock, substeps = timing.choose_timing(scenario, setup, reach or timing.reach_of(scenario), saves)
    parts = replace(setup, clock=clock, substeps=substeps)
    dispersion = build_dispersion(scenario, parts)
    custom_checks.check(parts, dispersion, scenario)
    start_checks.check(scenario, parts, dispersion, dispersed=drawn)
    ready = Study(scenario, parts, dispersion, requirements(scenario), margin_requirements(scenario))
    if ready.margins and ready.missing_derivative is not None:
        metric, missing = ready.margins[0].metric, ready.missing_derivative
        raise ScenarioError(f"requirements.{metric}: required margins need the derivative of the law, but {missing}")
    return ready


def build_setup(scenario: Scenario) -> Parts:
    """Return all parts except the clock, which `timing.choose_timing` derives from the fastest rates of these parts."""
    model = scenario.design_model()
    plant = scenario.true_plant(model)
    signal, walk_rate = build_disturbance(scenario, plant)
    wheels, devices, suite = scenario.reaction_wheels, scenario.devices, scenario.sensors
    actuators = devices.actuators(None if wheels is None else wheels.build())
    if getattr(getattr(scenario.dispersion, "wheel_failure", None), "known", False):
        actuators = replace(actuators, spare_allocations=spare_allocations(actuators.wheels))
    command_filter = devices.command_filter
    return Parts(
        plant=plant,
        disturbance=signal,
        reference=scenario.build_reference(),
        controller=scenario.controller.build(scenario, model),
        observer=scenario.observer.build(scenario, model),
        sensors=devices.sensors(scenario) if suite is None else suite.build(model, scenario.loop.period),
        initial=plant.with_hidden_at_rest(scenario.initial_state()),
        t_end=vector(scenario.end),
        window=vector(scenario.window),
        settling_angle=vector(scenario.loop.settling_angle),
        actuators=actuators,
        walk_rate=walk_rate,
        command_filter=None if command_filter is None else command_filter.part(),
        pointing=scenario.observation(),
    )


def build_disturbance(scenario: Scenario, plant: Plant) -> tuple[disturbances.Disturbance, jnp.ndarray | None]:
    """Return the disturbance of the true plant, a function of time and state, and the rate of its random walk or None.

    The rate of the random walk is one sigma per second for each input (m,).
    """
    signals, walk = [], None
    inertia = getattr(plant, "inertia", None)
    for table in scenario.terms:
        signal, step = table.build(inertia, scenario), table.walk(scenario.loop.period)
        signals += [] if signal is None else [signal]
        if step is not None:
            walk = step if walk is None else jnp.sqrt(walk**2 + step**2)  # variances of independent walks add up
    if len(signals) > 1:
        return disturbances.Sum(tuple(signals)), walk
    return (signals[0] if signals else disturbances.Constant(jnp.zeros(plant.inputs))), walk


def _dispersed_quantity(key: str) -> str:
    """Return the name of the quantity that a key of [dispersion] disperses."""
    initial_values = {"attitude": INITIAL_ATTITUDE, "rate": INITIAL_RATE, "x0": INITIAL_STATE}
    return initial_values.get(key, level_name(key) if level_name(key) in QUANTITIES else key)


def build_dispersion(scenario: Scenario, parts: Parts) -> Dispersion:
    """Return the dispersions of a scenario about these nominal parts."""
    table = scenario.dispersion
    if table is None:
        return Dispersion()
    keys: tuple[str, ...] = table.__struct_fields__
    tables: dict[str, Any] = {_dispersed_quantity(key): getattr(table, key) for key in keys if key != "custom"}
    return Dispersion(
        {
            name: random.build(parts, QUANTITIES[name].count(parts))
            for name, random in tables.items()
            # zero hardware errors are omitted, so that the compiled program is the one without hardware errors
            if random is not None and not (QUANTITIES[name].hardware and getattr(random, "is_zero", False))
        },
        custom=None if table.custom is None else table.custom.build(),
    )
