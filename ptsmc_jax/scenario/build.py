"""Build the simulation parts of a validated scenario: law, observer, disturbance, sensors, actuators, dispersions.

Start with `setup`. `timing` adds the clock, and `assembly.study` combines both.
"""

import dataclasses
from typing import Any

import jax.numpy as jnp

from ptsmc_jax.devices import reaction_wheels
from ptsmc_jax.dispersions.base import INITIAL_ATTITUDE, INITIAL_RATE, INITIAL_STATE
from ptsmc_jax.dispersions.quantities import QUANTITIES, level_name
from ptsmc_jax.dispersions.variation import Dispersion
from ptsmc_jax.numerics.pytrees import vector
from ptsmc_jax.plants.base import Plant
from ptsmc_jax.scenario.tables import Scenario
from ptsmc_jax.signals import disturbances
from ptsmc_jax.simulation.assembly import Parts, Setup


def setup(scenario: Scenario) -> Setup:
    """Return all parts except the clock, which `timing.choose_timing` derives from the fastest rates of these parts."""
    model = scenario.design_model()
    plant = scenario.true_plant(model)
    signal, walk_rate = disturbance(scenario, plant)
    wheels = scenario.reaction_wheels
    actuators = scenario.devices.actuators(None if wheels is None else wheels.build())
    if getattr(getattr(scenario.dispersion, "wheel_failure", None), "known", False):
        actuators = dataclasses.replace(
            actuators, spare_allocations=reaction_wheels.spare_allocations(actuators.wheels)
        )
    command_filter = scenario.devices.command_filter
    return Setup(
        plant=plant,
        disturbance=signal,
        reference=scenario.build_reference(),
        controller=scenario.controller.build(scenario, model),
        observer=scenario.observer.build(scenario, model),
        sensors=_sensors(scenario, model),
        initial=plant.with_hidden_at_rest(scenario.initial_state()),
        t_end=vector(scenario.end),
        window=vector(scenario.window),
        settling_angle=vector(scenario.loop.settling_angle),
        actuators=actuators,
        walk_rate=walk_rate,
        command_filter=None if command_filter is None else command_filter.part(),
        pointing=scenario.observation(),
    )


def _sensors(scenario: Scenario, model: Any) -> Any:
    """Return the sensors of [sensors] or [[sensors]] if given, otherwise the sensors of [hardware]."""
    if scenario.sensors is None:
        return scenario.devices.sensors(scenario)
    return scenario.sensors.build(model, scenario.loop.period)


def disturbance(scenario: Scenario, plant: Plant) -> tuple[Any, Any]:
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


def dispersion(scenario: Scenario, parts: Parts) -> Dispersion:
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
