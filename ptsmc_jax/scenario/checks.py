"""Validate constraints that involve more than one key of a scenario. Start with `check`.

`parsing` validates single keys. `custom_checks` and `start_checks` validate the parts that are built from a scenario.
"""

import math
from collections.abc import Mapping
from typing import Any

from ptsmc_jax.scenario import custom, epochs, errors, identify_tables, tables
from ptsmc_jax.scenario.errors import ScenarioError, wrong
from ptsmc_jax.scenario.sensor_tables import SensorSuite
from ptsmc_jax.scenario.tables import Scenario
from ptsmc_jax.scenario.values import MOST_STEPS
from ptsmc_jax.simulation import catalogues

# dispersions of the built-in sensors
SENSOR_DISPERSIONS = ("star_tracker_misalignment", "gyro_scale", "star_tracker_outage")
SENSOR_ERROR_KEYS = ("gyro_scale", "star_tracker_misalignment_deg")  # keys of [hardware]
SHORTEST_WINDOW = 1e-5  # fraction of t_f, continuous loop: 80 times the resolution of a 32-bit float at t_f


def check_keys(scenario: Scenario) -> None:
    """Raise ScenarioError if keys contradict each other or if their combination is not supported."""
    _check_loop(scenario)
    scenario.check_plant()
    _check_requirements(scenario)
    scenario.observer.check(scenario)
    _check_dispersion(scenario)
    identify_tables.check(scenario.identify, scenario.telemetry)


def _check_requirements(scenario: Scenario) -> None:
    """Raise ScenarioError if a required metric needs a table or noise that the scenario does not have."""
    for key, value in scenario.requirements.items():
        table = scenario.metrics[key].table if key in scenario.metrics else None
        if table is not None and getattr(scenario, table, None) is None:
            raise ScenarioError(f"requirements.{key} needs [{table}], but there is no [{table}] table")
        if key.startswith(catalogues.WITHIN):
            example = '{ limit = .., probability = .., interpretation = "mixed" }'
            name = f"requirements.{key.removeprefix(catalogues.WITHIN)}"
            raise ScenarioError(
                f"requirements.{key} is not a limit but a fraction of the time; allowed is {name} = {example}"
            )
        if key.startswith(catalogues.KNOWLEDGE) and not scenario.uses_measurements:
            raise ScenarioError(
                f"requirements.{key} needs sensor noise in [hardware], but there is none: the law has the true state"
            )
        if isinstance(value, tables.Limit):
            _check_limit(key, value)
        if key in catalogues.MARGINS:
            scenario.require_sampled_loop(f"requirements.{key}")
            if scenario.has_discontinuous_sign:
                raise ScenarioError(
                    f"requirements.{key} needs a boundary layer, but controller.sign_width is 0, a discontinuous sign; "
                    "allowed is a number greater than 0"
                )


def _check_limit(metric: str, limit: tables.Limit) -> None:
    """Raise ScenarioError if the keys of a requirement table contradict each other."""
    key = f"requirements.{metric}"
    if limit.quantile is not None and limit.probability is not None:
        raise ScenarioError(
            f"{key} has both quantile and probability, but must have only one of them: they mean the same"
        )
    if limit.confidence is not None and limit.fraction is None:
        raise ScenarioError(
            f"{key}.confidence is {limit.confidence}, but is allowed only together with quantile or probability"
        )
    if limit.interpretation in (None, "ensemble"):
        return
    beginning = f"{key}.interpretation is {errors.show(limit.interpretation)}"
    if metric not in catalogues.TIME_FRACTION_METRICS:
        metrics = ", ".join(catalogues.TIME_FRACTION_METRICS)
        raise ScenarioError(
            f'{beginning}, but must be "ensemble": only {metrics} can be judged by a fraction of the time'
        )
    if limit.probability is None:
        raise ScenarioError(f"{beginning}, which needs the key probability, the fraction of the time")
    if limit.interpretation == "temporal" and limit.confidence is not None:
        raise ScenarioError(
            f"{beginning}, which every simulated run must keep, but confidence is {limit.confidence}; "
            'allowed is no confidence, or the interpretation "ensemble" or "mixed"'
        )


def check_sensors(scenario: Scenario) -> None:
    """Raise ScenarioError if [sensors] or [[sensors]] contradict other keys.

    They replace the noise keys of [hardware] and the table [filter], and they need the sampled loop.
    """
    if scenario.sensors is None:
        return
    scenario.require_sampled_loop("[sensors]")
    if isinstance(scenario.sensors, SensorSuite):
        scenario.sensors.check(scenario)
    for key in (*scenario.devices.noise_keys, *SENSOR_ERROR_KEYS, "star_tracker_every", "star_tracker_period"):
        value = getattr(scenario.hardware, key, None)
        if value is not None:
            raise wrong(f"hardware.{key}", value, "absent, because [sensors] defines the measurements")
    if getattr(getattr(scenario, "filter", None), "on", False):
        raise ScenarioError(
            'filter.kind is "steady_state", but must be absent, because [sensors] defines the measurements'
        )
    noise_dispersions = (
        key for key, set_by in scenario.devices.nominal_keys.items() if set(set_by) <= {*scenario.devices.noise_keys}
    )
    for key in (*noise_dispersions, *SENSOR_DISPERSIONS):
        if getattr(scenario.dispersion, key, None) is not None:
            raise ScenarioError(
                f"dispersion.{key} changes the sensors of [hardware], but [sensors] replaces them; allowed is "
                "dispersion.custom, which can change these sensors"
            )


def _check_loop(scenario: Scenario) -> None:
    """Raise ScenarioError if t_f, delta, the window, the end or the periods of the loop contradict each other."""
    controller, loop = scenario.controller, scenario.loop
    t_f, delta, window = controller.t_f, scenario.hand_over, scenario.window
    if loop.epoch is not None:
        epochs.parse_key(loop.epoch)
    if not controller.law.prescribed:
        scenario.require_sampled_loop(f"controller.kind = {errors.show(controller.kind)}")
    controller.check(scenario)
    if scenario.sampled and t_f <= loop.period:  # checked before delta, which must be at least one period
        raise wrong("controller.t_f", t_f, f"greater than one control period, loop.period = {loop.period} s")
    if delta >= t_f:
        raise wrong("controller.delta", delta, f"less than controller.t_f, {t_f} s")
    if scenario.end < (t_f + window) * (1 - 1e-9):  # the default t_end is later, so the file has a t_end
        needed = f"at least controller.t_f + loop.window, {t_f:g} + {window:g} = {t_f + window:g} s"
        raise wrong("loop.t_end", loop.t_end, needed)
    if scenario.sampled:
        _check_periods(scenario)
    elif window < SHORTEST_WINDOW * t_f:
        raise wrong(
            "loop.window", window, f"at least {SHORTEST_WINDOW * t_f:.6g} s, controller.t_f times {SHORTEST_WINDOW}"
        )
    for key in scenario.hardware.__struct_fields__ if scenario.hardware is not None else ():
        if getattr(scenario.hardware, key) is not None:
            scenario.require_sampled_loop(f"hardware.{key}")
    for name, present in (("wheels", scenario.reaction_wheels is not None), ("filter", scenario.estimator.on)):
        if present:
            scenario.require_sampled_loop(f"[{name}]")
    for key, term in scenario.terms_by_place.items():
        if term.sampled_only:
            scenario.require_sampled_loop(f"{key}.kind = {errors.show(term.kind)}")


def _check_periods(scenario: Scenario) -> None:
    """Raise ScenarioError if a time or a number of control periods does not fit the period or the run."""
    loop, window, command_filter = scenario.loop, scenario.window, scenario.devices.command_filter
    delta = scenario.hand_over
    if delta < loop.period * (1 - 1e-9):
        raise wrong("controller.delta", delta, f"at least one control period, loop.period = {loop.period} s")
    if scenario.end / loop.period > MOST_STEPS:
        raise wrong("loop.period", loop.period, f"at least loop.t_end / {MOST_STEPS}, {scenario.end / MOST_STEPS} s")
    if command_filter is not None and command_filter.corner >= math.pi / loop.period:
        highest = f"below pi / loop.period = {math.pi / loop.period:.6g} rad/s, the Nyquist frequency"
        raise wrong("hardware.command_filter.corner", command_filter.corner, highest)
    if window < loop.period * (1 - 1e-9):
        raise wrong("loop.window", window, f"at least one control period, loop.period = {loop.period} s")
    delay, t_f = scenario.devices.delay_periods, scenario.controller.t_f
    if delay * loop.period >= t_f:
        allowed = f"a number of control periods ({loop.period:g} s each) that is shorter than controller.t_f, {t_f:g} s"
        raise wrong("hardware.delay", delay, allowed)
    samples = math.ceil(scenario.end / loop.period * (1 - 1e-9))
    every = getattr(scenario.hardware, "star_tracker_every", None) or 0
    if every > samples:
        raise wrong("hardware.star_tracker_every", every, f"at most the {samples} control periods until loop.t_end")
    tracker_period = getattr(scenario.hardware, "star_tracker_period", None) or 0.0
    if tracker_period > scenario.end:
        raise wrong("hardware.star_tracker_period", tracker_period, f"at most loop.t_end, {scenario.end} s")


def _check_dispersion(scenario: Scenario) -> None:
    """Raise ScenarioError if a dispersion needs an absent device, or if a lower end exceeds an upper end."""
    names = scenario.dispersion.__struct_fields__ if scenario.dispersion is not None else ()
    random = {name: getattr(scenario.dispersion, name) for name in names}
    random = {name: table for name, table in random.items() if table is not None}
    for key in {"actuator_scale", "actuator_misalignment", "timing_jitter"} & random.keys():
        scenario.require_sampled_loop(f"dispersion.{key}")
    _check_disturbance_dispersions(scenario, random)
    for key, needed in _absent_needs(scenario).items():
        if key in random:
            raise ScenarioError(f"dispersion.{key} needs {needed}")
    for low, high, unit in (("min_deg", "max_deg", " deg"), ("earliest", "latest", " s"), ("smallest", "largest", "")):
        for name, table in random.items():
            smallest, largest = getattr(table, low, None), getattr(table, high, None)
            largest = scenario.end if largest is None else largest  # the default of `latest`
            if smallest is not None and smallest > largest:
                raise wrong(f"dispersion.{name}.{low}", smallest, f"at most {high}, {largest}{unit}")
    if "x0" in random:
        key, state_count = random["x0"].width_key, len(scenario.plant.x0)
        value = getattr(random["x0"], key)
        if len(value) != state_count:
            raise wrong(f"dispersion.x0.{key}", value, errors.list_of(state_count, "state in plant.x0"))


def _absent_needs(scenario: Scenario) -> dict[str, str]:
    """Return the needed part in words for each dispersion that this scenario cannot have, by key."""
    devices = scenario.devices
    absent = {
        key: f"hardware.{key}, which is absent"
        for key, nominal_keys in devices.nominal_keys.items()
        if all(getattr(devices, one) is None for one in nominal_keys)
    }
    for key, name in (("star_tracker_misalignment", "attitude_noise"), ("gyro_scale", "rate_noise")):
        if name in absent:
            absent[key] = f"{absent[name]}; {name} = 0 is allowed"
    if scenario.reaction_wheels is None:
        absent["wheel_failure"] = "reaction wheels, but there is no [wheels] table"
    if not scenario.estimator.on:
        needed = "an attitude filter, which estimates the attitude in the outage"
        absent["star_tracker_outage"] = f'{needed}; allowed is [filter] with kind = "steady_state"'
    if getattr(scenario, "flexible", None) is None:
        modes = "flexible modes, but there is no [flexible] table"
        absent |= {"mode_frequency": modes, "mode_coupling": modes}
    return absent


def _check_disturbance_dispersions(scenario: Scenario, random: Mapping[str, object]) -> None:
    """Raise ScenarioError if no disturbance has the phase or the amplitude that is dispersed.

    A custom disturbance declares them in `drawn`. A custom key of that name alone does not suffice.
    """
    kinds: Any = scenario.TABLES["disturbance"]
    if getattr(scenario, "orbit", None) is not None:  # the gravity gradient of [orbit] has no dispersion
        kinds = {kind: one for kind, one in kinds.items() if kind != "gravity_gradient"}

    def has(term: Any, quantity: str) -> bool:
        if isinstance(term, custom.Custom):
            return term.is_unloaded or quantity in term.part_class.drawn
        return term.kind in kinds and hasattr(term, quantity)

    for article, quantity in (("a", "phase"), ("an", "amplitude")):
        if f"disturbance_{quantity}" in random and not any(has(term, quantity) for term in scenario.terms):
            allowed = " or ".join(errors.show(kind) for kind, one in kinds.items() if quantity in one.__struct_fields__)
            raise ScenarioError(
                f"dispersion.disturbance_{quantity} needs a disturbance that has {article} {quantity}, but "
                f"disturbance.kind is {errors.show(scenario.disturbance.kind)}; allowed is {allowed}"
            )
