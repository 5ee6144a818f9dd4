"""The parts of a checked scenario: plant, law, observer, disturbance, sensors, actuators, dispersion."""

from typing import Any

import jax.numpy as jnp
import numpy as np

from ptsmc_jax import formulas
from ptsmc_jax.devices import attitude_filter, reaction_wheels
from ptsmc_jax.devices.actuators import Actuators
from ptsmc_jax.devices.sensors import Sensors, StateSensor
from ptsmc_jax.dispersions import numbers, variation
from ptsmc_jax.numerics.pytrees import vector
from ptsmc_jax.plants import integrator_chain, rigid_body
from ptsmc_jax.plants.base import Plant
from ptsmc_jax.scenario import (
    attitude_keys,
    checks,
    device_tables,
    dispersion_tables,
    free_gains,
    plant_tables,
    scales,
)
from ptsmc_jax.scenario.tables import Scenario
from ptsmc_jax.signals import disturbances, references
from ptsmc_jax.simulation.rollout import Parts


def plant(scenario: Scenario) -> tuple[Plant, Any, Any, Any]:
    """Nominal plant, law, initial state and reference."""
    table, reference = scenario.plant, scenario.reference
    initial: Any
    made: Any
    if isinstance(table, plant_tables.SpacecraftPlant):
        assert scenario.spacecraft is not None
        assert scenario.initial is not None
        assert reference is not None
        model: Any = rigid_body.spacecraft(scenario.spacecraft.inertia)
        q = jnp.asarray(attitude_keys.quaternion(scenario.initial, "initial"))
        initial, made = rigid_body.AttitudeState(q, vector(scenario.initial.rate)), reference.build()
    elif isinstance(table, plant_tables.ChainPlant):
        model, initial, made = integrator_chain.chain(table.order), vector(table.x0), references.Origin()
    else:
        model, initial, made = checks.system(table), vector(table.x0), references.Now()
    return model, scenario.controller.build(scenario, model), initial, made


def disturbance(scenario: Scenario, plant: Plant) -> tuple[Any, Any]:
    """The disturbance of the plant that flies, by time and state, and the rate of its random walk (None: none)."""
    signal, walk = [], None
    inertia = getattr(plant, "inertia", None)
    for table in checks.terms(scenario):
        acting, step = table.build(inertia), table.walk(scenario.loop.period)
        signal += [] if acting is None else [acting]
        if step is not None:
            walk = step if walk is None else jnp.sqrt(walk**2 + step**2)  # independent walks add up to one
    if len(signal) > 1:
        return disturbances.Sum(tuple(signal)), walk
    return (signal[0] if signal else disturbances.Constant(jnp.zeros(plant.inputs))), walk


def true_body(scenario: Scenario) -> rigid_body.Spacecraft:
    """The spacecraft as it is: its true inertia where the scenario gives one."""
    assert scenario.spacecraft is not None
    table = scenario.spacecraft
    return rigid_body.spacecraft(table.inertia if table.true_inertia is None else table.true_inertia)


def sensors(scenario: Scenario) -> Sensors | StateSensor | None:
    """Star tracker, gyro and filter, or a chain's sensor; None where the law sees the true state."""
    table, period = scenario.hardware, scenario.loop.period
    if isinstance(table, device_tables.StateHardware):
        return None if table.state_noise is None else StateSensor(vector(table.state_noise))
    filtered = isinstance(scenario.filter, device_tables.SteadyStateFilter)
    table = table or device_tables.Hardware()
    noises = (table.attitude_noise, table.rate_noise, table.rate_noise_density, table.rate_bias, table.rate_bias_walk)
    if not filtered and all(noise is None for noise in noises):
        return None
    star, every = table.attitude_noise or 0.0, table.star_tracker_every or 1
    gyro = scales.gyro_noise(table, period)
    walk = table.rate_bias_walk
    estimator = None
    if isinstance(scenario.filter, device_tables.SteadyStateFilter):
        bandwidth = vector(free_gains.filter_bandwidth(scenario))
        estimator = attitude_filter.attitude_filter(
            bandwidth, *(vector(v) for v in (star, gyro, walk or 0.0, period)), every
        )
    return Sensors(
        vector(star),
        vector(gyro),
        None if table.rate_bias is None else vector(table.rate_bias),
        None if walk is None else vector(formulas.per_sample(walk, period)),
        estimator,
        every,
    )


def actuators(scenario: Scenario) -> Actuators | None:
    """Limits, lag, delay and wheels; None where the torque is the commanded one."""
    table, device = scenario.hardware, scenario.wheels
    values = [getattr(table, key, None) for key in ("torque_limit", "torque_rate_limit", "torque_lag", "torque_step")]
    delay = getattr(table, "delay", None) or 0
    if device is None and delay == 0 and all(value is None for value in values):
        return None
    wheels = None
    if device is not None:
        raised = isinstance(device, device_tables.PyramidWheels)
        axes = formulas.pyramid(np.deg2rad(device.cant_deg)) if raised else device.axes
        wheels = reaction_wheels.wheels(axes, device.momentum, device.torque_limit, device.momentum_limit)
    limit, rate_limit, lag, step = (None if v is None else vector(v) for v in values)
    return Actuators(limit, rate_limit, lag, step, wheels, delay)


def dispersion(scenario: Scenario, parts: Parts) -> variation.Dispersion:
    """What is drawn for each trial, about these parts."""
    table = scenario.dispersion
    if table is None:
        return variation.Dispersion()
    phases, amplitudes = (disturbances.values(parts.disturbance, what).size for what in ("phase", "amplitude"))

    def drawn(key: str, *how: Any) -> Any:
        asked = getattr(table, key, None)
        return None if asked is None else asked.build(*how)

    levels = {key: drawn(key) for key in variation.LEVELS}
    common = {
        "phase": None if table.disturbance_phase is None else numbers.UniformPhase(phases),
        "amplitude": drawn("disturbance_amplitude", amplitudes),
        "bias": drawn("disturbance_bias", parts.plant.inputs),
        "levels": {key: level for key, level in levels.items() if level is not None},
    }
    if isinstance(table, dispersion_tables.StateDispersion):
        return variation.Dispersion(state=drawn("x0", len(checks.initial_state(scenario))), **common)
    return variation.Dispersion(
        attitude=drawn("attitude"),
        rate=drawn("rate", 3),
        inertia=drawn("inertia", parts.plant.inertia),
        reference=drawn("reference"),
        **common,
    )
