"""The parts of a checked scenario: plant, law, observer, disturbance, sensors, actuators, dispersion."""

from typing import Any

import jax.numpy as jnp
import numpy as np

from ptsmc_jax import formulas
from ptsmc_jax.devices import attitude_filter, reaction_wheels
from ptsmc_jax.devices.actuators import Actuators
from ptsmc_jax.devices.sensors import Sensors, StateSensor
from ptsmc_jax.dispersions import attitudes, inertias, numbers, variation
from ptsmc_jax.laws.fixed_time import FixedTime
from ptsmc_jax.laws.pd import QuaternionPD
from ptsmc_jax.laws.prescribed_time import (
    PrescribedTime,
    PrescribedTimeChain,
    PrescribedTimeMultiplicative,
    PrescribedTimeSystem,
)
from ptsmc_jax.laws.terminal import Terminal
from ptsmc_jax.observers.base import Observer
from ptsmc_jax.observers.finite_time import FiniteTimeObserver
from ptsmc_jax.observers.none import NoObserver
from ptsmc_jax.observers.nonlinear import NonlinearObserver
from ptsmc_jax.observers.prescribed_time import PrescribedTimeObserver
from ptsmc_jax.plants import integrator_chain, rigid_body
from ptsmc_jax.plants.base import Plant
from ptsmc_jax.scenario import (
    attitude_keys,
    checks,
    device_tables,
    dispersion_tables,
    free_gains,
    law_tables,
    plant_tables,
    scales,
    signal_tables,
)
from ptsmc_jax.scenario.tables import Scenario
from ptsmc_jax.signals import disturbances, references


def vector(values: Any) -> Any:
    """Numbers of a scenario as a leaf of the parts."""
    return jnp.asarray(np.asarray(values, dtype=float))


def _gains(scenario: Scenario) -> tuple[Any, Any, Any, Any, Any, Any]:
    table = scenario.controller
    return (
        vector(table.t_f),
        vector(table.eta),
        vector(table.delta),
        vector(table.k1),
        vector(table.sign_width),
        vector(table.surface_rate),
    )


def plant(scenario: Scenario) -> tuple[Plant, Any, Any, Any]:
    """Nominal plant, law, initial state and reference."""
    if isinstance(scenario.plant, plant_tables.SystemPlant):
        model = checks.system(scenario.plant)
        law = PrescribedTimeSystem(model, *_gains(scenario))
        return model, law, vector(scenario.plant.x0), references.Now()
    return _spacecraft(scenario) if isinstance(scenario.plant, plant_tables.SpacecraftPlant) else _chain(scenario)


def _spacecraft(scenario: Scenario) -> tuple[Plant, Any, Any, Any]:
    assert scenario.spacecraft is not None
    assert scenario.initial is not None
    assert scenario.reference is not None
    model = rigid_body.spacecraft(scenario.spacecraft.inertia)
    q = jnp.asarray(attitude_keys.quaternion(scenario.initial, "initial"))
    initial = rigid_body.AttitudeState(q, vector(scenario.initial.rate))
    q_f = jnp.asarray(attitude_keys.quaternion(scenario.reference, "reference"))
    reference: Any = references.Fixed(q_f)
    table = scenario.reference
    if isinstance(table, signal_tables.SpinReference):
        reference = references.Spin(q_f, vector(table.rate))
    elif isinstance(table, signal_tables.SinusoidReference):
        reference = references.Swing(q_f, vector(table.amplitude), vector(table.frequency), vector(table.phase))
    elif isinstance(table, signal_tables.SlewReference):
        reference = references.Slew(q_f, vector(attitude_keys.turn(table)), vector(table.duration))
    table = scenario.controller
    if isinstance(table, law_tables.Baseline):
        kinds = {"pd": QuaternionPD, "terminal": Terminal, "fixed_time": FixedTime}
        kind = kinds[scenario.controller.kind]
        own = {name: vector(getattr(table, name)) for name in kind.free}
        return model, kind(model=model, delta=vector(scenario.loop.period), **own), initial, reference
    assert isinstance(table, law_tables.Controller)
    multiplicative = table.error == "multiplicative"
    law = PrescribedTimeMultiplicative if multiplicative else PrescribedTime
    return model, law(model, *_gains(scenario)), initial, reference


def _chain(scenario: Scenario) -> tuple[Plant, Any, Any, Any]:
    assert isinstance(scenario.plant, plant_tables.ChainPlant)
    assert isinstance(scenario.controller, law_tables.ChainController)
    model = integrator_chain.chain(scenario.plant.order)
    controller = PrescribedTimeChain(model, *_gains(scenario), vector(scenario.controller.a))
    return model, controller, vector(scenario.plant.x0), references.Origin()


def observer(scenario: Scenario, model: Plant) -> Observer:
    """The observer; its model is the nominal plant."""
    law, table = scenario.controller, scenario.observer
    if isinstance(table, law_tables.NoObserver):
        return NoObserver(model, vector(law.disturbance_bound))
    common = (model, vector(table.gain), vector(law.disturbance_rate_bound), vector(law.initial_estimate_error))
    if isinstance(table, checks.FINITE_TIME):
        return FiniteTimeObserver(*common, vector(table.sign_width))
    if isinstance(table, law_tables.Prescribed):
        times = (vector(v) for v in (table.mu, *checks.prescribed_times(scenario, table)))
        return PrescribedTimeObserver(*common, *times)
    return NonlinearObserver(*common)


def disturbance(scenario: Scenario, inputs: int) -> tuple[Any, Any]:
    """The disturbance as a function of time and state, and the rate of its random walk (None: none)."""
    signal, walk = [], None
    for table in checks.terms(scenario):
        if isinstance(table, signal_tables.RandomWalk | signal_tables.EachRandomWalk):
            step = vector(table.density) / np.sqrt(scenario.loop.period)
            walk = step if walk is None else jnp.sqrt(walk**2 + step**2)  # independent walks add up to one
        elif isinstance(table, signal_tables.ConstantDisturbance | signal_tables.EachConstant):
            signal.append(disturbances.Constant(vector(table.amplitude)))
        elif isinstance(table, signal_tables.SinusoidDisturbance | signal_tables.EachSinusoid):
            values = (table.amplitude, table.frequency, table.phase, table.bias)
            signal.append(disturbances.Sinusoid(*(vector(v) for v in values)))
        elif isinstance(table, signal_tables.GravityGradient):
            assert scenario.spacecraft is not None
            turned = attitude_keys.has_attitude(table)
            orbit = attitude_keys.quaternion(table, "disturbance") if turned else np.array([0.0, 0.0, 0.0, 1.0])
            values = (orbit, table.orbit_rate, table.phase)
            signal.append(disturbances.GravityGradient(true_body(scenario).inertia, *(vector(v) for v in values)))
    if len(signal) > 1:
        return disturbances.Sum(tuple(signal)), walk
    return (signal[0] if signal else disturbances.Constant(jnp.zeros(inputs))), walk


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


def dispersion(scenario: Scenario) -> variation.Dispersion:
    """What is drawn for each trial."""
    table = scenario.dispersion
    if table is None:
        return variation.Dispersion()
    m = checks.inputs(scenario)
    signal, _ = disturbance(scenario, m)
    phases, amplitudes = (disturbances.values(signal, what).size for what in ("phase", "amplitude"))
    levels = {key: _numbers(getattr(table, key, None)) for key in variation.LEVELS}
    common = {
        "phase": None if table.disturbance_phase is None else numbers.UniformPhase(phases),
        "amplitude": _numbers(table.disturbance_amplitude, amplitudes),
        "bias": _numbers(table.disturbance_bias, m),
        "levels": {key: level for key, level in levels.items() if level is not None},
    }
    if isinstance(table, dispersion_tables.StateDispersion):
        return variation.Dispersion(state=_numbers(table.x0), **common)
    inertia = None
    if table.inertia is not None:
        moments, axes = np.linalg.eigh(np.asarray(true_body(scenario).inertia))
        spread = (vector(table.inertia.std), vector(np.deg2rad(table.inertia.axes_deg)))
        inertia = inertias.RelativeInertia(vector(moments), vector(axes), *spread)
    return variation.Dispersion(
        attitude=_attitudes(table.attitude),
        rate=_numbers(table.rate, 3),
        inertia=inertia,
        reference=_attitudes(table.reference),
        **common,
    )


def _attitudes(table: Any) -> Any:
    if isinstance(table, dispersion_tables.UniformAttitude):
        return attitudes.UniformAttitude()
    if isinstance(table, dispersion_tables.NormalAttitude):
        return attitudes.NormalAttitude(vector(np.deg2rad(table.std_deg)))
    if isinstance(table, dispersion_tables.AxisAngle):
        return attitudes.AxisAngle(*(vector(np.deg2rad(a)) for a in (table.min_deg, table.max_deg)))
    return None


def _numbers(table: Any, count: int = 1) -> Any:
    """How numbers are drawn; count: how many a single one of the table stands for."""
    if isinstance(table, dispersion_tables.RelativeNormal):
        return numbers.TruncatedNormal(vector(np.ones(count) * table.std))
    if hasattr(table, "half_width"):
        return numbers.Uniform(vector(np.ones(count) * table.half_width))
    if hasattr(table, "std"):
        return numbers.Normal(vector(np.ones(count) * table.std))
    return None
