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
    """Return all parts except the clock. `timing.timing` derives the clock from the fastest rates of these parts."""
    model = scenario.model()
    plant = scenario.truth(model)
    acting, walk = disturbance(scenario, plant)
    wheels = scenario.reaction_wheels
    devices = scenario.devices.actuators(None if wheels is None else wheels.build())
    if getattr(getattr(scenario.dispersion, "wheel_failure", None), "known", False):
        devices = dataclasses.replace(devices, spare_allocations=reaction_wheels.spare_allocations(devices.wheels))
    filtering = scenario.devices.command_filter
    return Setup(
        plant=plant,
        disturbance=acting,
        reference=scenario.target(),
        controller=scenario.controller.build(scenario, model),
        observer=scenario.observer.build(scenario, model),
        sensors=_sensors(scenario, model),
        initial=plant.with_hidden_at_rest(scenario.start()),
        t_end=vector(scenario.end),
        window=vector(scenario.window),
        settling_angle=vector(scenario.loop.settling_angle),
        actuators=devices,
        walk_rate=walk,
        command_filter=None if filtering is None else filtering.part(),
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
    signal, walk = [], None
    inertia = getattr(plant, "inertia", None)
    for table in scenario.terms:
        acting, step = table.build(inertia, scenario), table.walk(scenario.loop.period)
        signal += [] if acting is None else [acting]
        if step is not None:
            walk = step if walk is None else jnp.sqrt(walk**2 + step**2)  # variances of independent walks add up
    if len(signal) > 1:
        return disturbances.Sum(tuple(signal)), walk
    return (signal[0] if signal else disturbances.Constant(jnp.zeros(plant.inputs))), walk


def _quantity_of(key: str) -> str:
    """Return the name of the quantity that a key of [dispersion] disperses."""
    initial = {"attitude": INITIAL_ATTITUDE, "rate": INITIAL_RATE, "x0": INITIAL_STATE}
    return initial.get(key, level_name(key) if level_name(key) in QUANTITIES else key)


def dispersion(scenario: Scenario, parts: Parts) -> Dispersion:
    """Return the dispersions of a scenario about these nominal parts."""
    table = scenario.dispersion
    if table is None:
        return Dispersion()
    keys: tuple[str, ...] = table.__struct_fields__
    tables: dict[str, Any] = {_quantity_of(key): getattr(table, key) for key in keys if key != "custom"}
    return Dispersion(
        {
            name: one.build(parts, QUANTITIES[name].count(parts))
            for name, one in tables.items()
            # hardware errors of zero size are omitted: the compiled program is then the program without them
            if one is not None and not (QUANTITIES[name].hardware and getattr(one, "nothing", False))
        },
        custom=None if table.custom is None else table.custom.build(),
    )
