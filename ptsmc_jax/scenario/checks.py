"""What single keys of a scenario cannot tell: defaults that depend on other keys, keys against each other."""

import math
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from ptsmc_jax import formulas
from ptsmc_jax.scenario import (
    attitude_keys,
    device_tables,
    dispersion_tables,
    errors,
    plant_tables,
    systems,
    tables,
)
from ptsmc_jax.scenario.disturbance_tables import SumDisturbance
from ptsmc_jax.scenario.errors import ScenarioError, wrong
from ptsmc_jax.scenario.gain_bounds import hand_over
from ptsmc_jax.scenario.tables import Scenario
from ptsmc_jax.scenario.values import MOST_STEPS, Kind
from ptsmc_jax.simulation import catalogues

if TYPE_CHECKING:
    from ptsmc_jax.plants.second_order import System

SHORTEST_WINDOW = 1e-5  # of t_f, continuous loop: 80 times what 32 bits tell apart at t_f, whose steps may be finer


def resolve(scenario: Scenario) -> Scenario:
    """The scenario with the defaults that depend on other keys: t_end, lists as long as there are inputs."""
    loop, t_f = scenario.loop, scenario.controller.t_f
    m = inputs(scenario)
    observer, disturbance = scenario.observer.filled(scenario, m), scenario.disturbance
    if isinstance(disturbance, SumDisturbance):
        each = tuple(term.filled(scenario, m) for term in disturbance.terms)
        disturbance = msgspec.structs.replace(disturbance, terms=each)
    else:
        disturbance = disturbance.filled(scenario, m)
    scenario = msgspec.structs.replace(scenario, observer=observer, disturbance=disturbance)
    if loop.t_end is None:
        loop = msgspec.structs.replace(loop, t_end=t_f + max(10.0, loop.window))
    dispersion = scenario.dispersion
    if isinstance(dispersion, dispersion_tables.StateDispersion) and dispersion.x0 is not None:
        key = dispersion.x0.width
        width = getattr(dispersion.x0, key) or (1.0,) * len(initial_state(scenario))
        dispersion = msgspec.structs.replace(dispersion, x0=msgspec.structs.replace(dispersion.x0, **{key: width}))
    return msgspec.structs.replace(scenario, loop=loop, dispersion=dispersion)


def inputs(scenario: Scenario) -> int:
    """How many inputs the plant has."""
    plant = scenario.plant
    if isinstance(plant, plant_tables.SystemPlant):
        return len(plant.x0) // 2
    return 3 if isinstance(plant, plant_tables.SpacecraftPlant) else 1


def initial_state(scenario: Scenario) -> tuple[float, ...]:
    """x0 of a chain or a system."""
    assert not isinstance(scenario.plant, plant_tables.SpacecraftPlant)
    return scenario.plant.x0


def check(scenario: Scenario) -> None:
    """Raise ScenarioError where keys contradict each other or ask for what the project cannot do yet."""
    _check_plant(scenario)
    _check_requirements(scenario)
    scenario.observer.check(scenario)
    _check_loop(scenario)
    _check_dispersion(scenario)


def _check_requirements(scenario: Scenario) -> None:
    entries = catalogues.CATALOGUES[scenario.plant.kind]
    for key, value in scenario.requirements.items():
        table = entries[key].table if key in entries else None
        if table is not None and getattr(scenario, table) is None:
            raise ScenarioError(f"requirements.{key} needs [{table}], but there is no [{table}] table")
        if isinstance(value, tables.Limit) and value.confidence is not None and value.quantile is None:
            raise ScenarioError(f"requirements.{key}.confidence is {value.confidence}, but goes with a quantile only")
        if key in catalogues.MARGINS and scenario.loop.mode != "sampled":
            raise ScenarioError(f'requirements.{key} needs the sampled loop, but loop.mode is "{scenario.loop.mode}"')
        if key in catalogues.MARGINS and getattr(scenario.controller, "sign_width", None) == 0.0:
            raise ScenarioError(
                f"requirements.{key} needs a sign with a slope, but controller.sign_width is 0, the exact sign; "
                "allowed is a width greater than 0"
            )


def _check_plant(scenario: Scenario) -> None:
    plant = scenario.plant
    if isinstance(plant, plant_tables.SpacecraftPlant):
        assert scenario.spacecraft is not None
        assert scenario.initial is not None
        assert scenario.reference is not None
        try:
            formulas.check_inertia(scenario.spacecraft.inertia)
        except ValueError as error:
            raise ScenarioError(f"spacecraft.inertia is {errors.brief(scenario.spacecraft.inertia)}: {error}") from None
        if scenario.spacecraft.true_inertia is not None:
            try:
                formulas.check_inertia(scenario.spacecraft.true_inertia)
            except ValueError as error:
                value = errors.brief(scenario.spacecraft.true_inertia)
                raise ScenarioError(f"spacecraft.true_inertia is {value}: {error}") from None
        attitude_keys.quaternion(scenario.initial, "initial")
        scenario.reference.check()
        _check_devices(scenario)
        return
    if isinstance(plant, plant_tables.SystemPlant):
        _check_system(plant)
    else:
        _check_chain(plant)
    m, n = inputs(scenario), len(plant.x0)
    for k, term in enumerate(terms(scenario)):
        name = f"disturbance.terms[{k}]" if len(terms(scenario)) > 1 else "disturbance"
        _check_each(name, term, m)
    _check_each("observer", scenario.observer, m)
    noise = getattr(scenario.hardware, "state_noise", None)
    if noise is not None and len(noise) != n:
        raise wrong("hardware.state_noise", noise, f"a list of {n} numbers, one for each state")


def _check_each(name: str, table: Kind, m: int) -> None:
    for key in table.each:
        value = getattr(table, key)
        if len(value) != m:
            raise wrong(f"{name}.{key}", value, f"a list of {m} number{'s' * (m > 1)}, one for each input")


def _check_system(plant: plant_tables.SystemPlant) -> None:
    """What can be said of it without running the file that it names: whoever reads a scenario may not want that."""
    if plant.system is None:
        raise ScenarioError(f"plant.system is absent, but must be given: {systems.ALLOWED}")
    if len(plant.x0) % 2:
        raise wrong("plant.x0", plant.x0, "a list of x_1 followed by x_2, as many numbers each")
    if not isinstance(plant.system, str):
        system(plant)
        return
    try:
        systems.named(plant.system, systems.ALLOWED)
    except ValueError as error:
        raise ScenarioError(f"plant.system is {errors.brief(plant.system)}: {error}") from None


def system(plant: plant_tables.SystemPlant) -> "System":
    """The system that a scenario holds, or names: that file is run. Raises ScenarioError where there is none."""
    try:
        found = systems.load(plant.system)
    except ValueError as error:
        raise ScenarioError(f"plant.system is {errors.brief(plant.system)}: {error}") from None
    if found.inputs * 2 != len(plant.x0):
        n = found.inputs
        raise wrong("plant.x0", plant.x0, f"a list of {2 * n} numbers, since plant.system has n = {n}")
    return found


def _check_chain(plant: plant_tables.ChainPlant) -> None:
    n = plant.order
    if len(plant.x0) != n:
        raise wrong("plant.x0", plant.x0, f"a list of plant.order = {n} numbers")


def terms(scenario: Scenario) -> tuple[Any, ...]:
    """The disturbances that act together."""
    table = scenario.disturbance
    return table.terms if isinstance(table, SumDisturbance) else (table,)


def _check_devices(scenario: Scenario) -> None:
    """Disturbances, sensors, filter and wheels of a spacecraft."""
    table, device, estimator = scenario.hardware, scenario.wheels, scenario.filter
    assert table is None or isinstance(table, device_tables.Hardware)
    for k, term in enumerate(terms(scenario)):
        several = isinstance(scenario.disturbance, SumDisturbance)
        term.check(f"disturbance.terms[{k}]" if several else "disturbance")
    if table is not None:
        if table.rate_noise is not None and table.rate_noise_density is not None:
            raise wrong("hardware.rate_noise_density", table.rate_noise_density, "absent where rate_noise is given")
        every = table.star_tracker_every
        if every not in (None, 1) and not isinstance(estimator, device_tables.SteadyStateFilter):
            raise ScenarioError(
                f"hardware.star_tracker_every is {every}, but without a filter the law needs a sample every period; "
                'allowed is 1, or [filter] with kind = "steady_state"'
            )
    noisy = table is not None and table.attitude_noise and (table.rate_noise or table.rate_noise_density)
    if isinstance(estimator, device_tables.SteadyStateFilter) and estimator.bandwidth is None and not noisy:
        raise ScenarioError(
            "filter.bandwidth is absent, but must be given where attitude_noise or rate_noise of [hardware] is 0"
        )
    if device is not None:
        flat = isinstance(device, device_tables.PyramidWheels)
        axes = formulas.pyramid(np.deg2rad(device.cant_deg)) if flat else np.asarray(device.axes)
        try:
            formulas.wheel_axes(axes)
        except ValueError as error:
            if flat:
                enough = "far enough from 0 and 90 degrees for the wheels to span all directions"
                raise wrong("wheels.cant_deg", device.cant_deg, enough) from None
            raise ScenarioError(f"wheels.axes is {errors.brief(axes.tolist())}: {error}") from None
        if device.momentum is not None and len(device.momentum) != len(axes):
            raise wrong("wheels.momentum", device.momentum, f"a list of {len(axes)} numbers, one for each wheel")
        limit = device.momentum_limit
        if limit is not None and any(abs(h) > limit for h in device.momentum or ()):
            raise wrong("wheels.momentum", device.momentum, f"within wheels.momentum_limit, {limit}")


def _check_loop(scenario: Scenario) -> None:
    controller, loop = scenario.controller, scenario.loop
    t_f, delta, sampled = controller.t_f, hand_over(scenario), loop.mode == "sampled"
    if not controller.prescribed and not sampled:
        kind = errors.show(scenario.controller.kind)
        raise ScenarioError(f'controller.kind = {kind} needs the sampled loop, but loop.mode is "{loop.mode}"')
    controller.check(scenario)
    if delta >= t_f:
        raise wrong("controller.delta", delta, f"less than controller.t_f, {t_f}")
    assert loop.t_end is not None  # `resolve` filled it in
    if loop.t_end < t_f:
        raise wrong("loop.t_end", loop.t_end, f"at least controller.t_f + loop.window, {t_f + loop.window}")
    if loop.t_end < t_f + loop.window - 1e-9:
        raise wrong("loop.window", loop.window, f"at most loop.t_end - controller.t_f, {loop.t_end - t_f}")
    if sampled and delta < loop.period * (1 - 1e-9):
        raise wrong("controller.delta", delta, f"at least one control period, loop.period = {loop.period}")
    if sampled and loop.t_end / loop.period > MOST_STEPS:
        raise wrong("loop.period", loop.period, f"at least loop.t_end / {MOST_STEPS}, {loop.t_end / MOST_STEPS}")
    if sampled:
        _check_periods(scenario)
    elif loop.window < SHORTEST_WINDOW * t_f:
        raise wrong(
            "loop.window", loop.window, f"at least {SHORTEST_WINDOW * t_f:.6g}, controller.t_f times {SHORTEST_WINDOW}"
        )
    if not sampled:
        for key in scenario.hardware.__struct_fields__ if scenario.hardware is not None else ():
            if getattr(scenario.hardware, key) is not None:
                raise ScenarioError(f'hardware.{key} needs the sampled loop, but loop.mode is "{loop.mode}"')
        for name in ("wheels", "filter"):
            value = getattr(scenario, name)
            if value is not None and not isinstance(value, device_tables.NoFilter):
                raise ScenarioError(f'[{name}] needs the sampled loop, but loop.mode is "{loop.mode}"')
        if any(term.sampled_only for term in terms(scenario)):
            kind = next(errors.show(term.kind) for term in terms(scenario) if term.sampled_only)
            raise ScenarioError(f'disturbance.kind = {kind} needs the sampled loop, but loop.mode is "{loop.mode}"')


def _check_periods(scenario: Scenario) -> None:
    """What is counted in periods, or holds some, against the period and the run."""
    loop = scenario.loop
    assert loop.t_end is not None
    if loop.window < loop.period * (1 - 1e-9):
        raise wrong("loop.window", loop.window, f"at least one control period, loop.period = {loop.period}")
    samples = math.ceil(loop.t_end / loop.period * (1 - 1e-9))
    for key in ("delay", "star_tracker_every"):
        periods = getattr(scenario.hardware, key, None) or 0
        if periods > samples:
            raise wrong(f"hardware.{key}", periods, f"at most the {samples} control periods until loop.t_end")


def _check_dispersion(scenario: Scenario) -> None:
    dispersion = scenario.dispersion
    for what, allowed in (("phase", "a sinusoid, or gravity_gradient"), ("amplitude", "a sinusoid, or constant")):
        asked = getattr(dispersion, f"disturbance_{what}", None) is not None
        if asked and not any(hasattr(term, what) for term in terms(scenario)):
            raise ScenarioError(
                f"dispersion.disturbance_{what} needs a disturbance that has {'a' if what == 'phase' else 'an'} {what},"
                f" but disturbance.kind is {errors.show(scenario.disturbance.kind)}; allowed is {allowed}"
            )
    for key in ("attitude_noise", "rate_noise", "state_noise", "torque_limit"):
        given = getattr(scenario.hardware, key, None)
        if key == "rate_noise":
            given = given or getattr(scenario.hardware, "rate_noise_density", None)
        if getattr(dispersion, key, None) is not None and given is None:
            raise ScenarioError(f"dispersion.{key} needs hardware.{key}, which is absent")
    for key in ("attitude", "reference"):
        angles = getattr(dispersion, key, None)
        if isinstance(angles, dispersion_tables.AxisAngle) and angles.min_deg > angles.max_deg:
            raise wrong(f"dispersion.{key}.min_deg", angles.min_deg, f"at most max_deg, {angles.max_deg}")
    if isinstance(dispersion, dispersion_tables.StateDispersion) and dispersion.x0 is not None:
        key, states = dispersion.x0.width, len(initial_state(scenario))
        value = getattr(dispersion.x0, key)
        if len(value) != states:
            raise wrong(f"dispersion.x0.{key}", value, f"a list of {states} numbers, one for each state")
