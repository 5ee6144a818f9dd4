"""The gains that the tuner can change: names, units, published values and starting points from the mission.

`with_gains` sets gains in parts, and `in_scenario` sets them in a scenario. A gain with one value for each axis has
names for single axes too, such as `observer_gain_1`.
"""

from collections.abc import Iterable
from typing import Any

from ptsmc_jax import scenario as scenarios
from ptsmc_jax.scenario import disturbance_tables, keys, mission
from ptsmc_jax.scenario.device_tables import COMMAND_FILTERS, FILTERS
from ptsmc_jax.scenario.law_tables import LAWS, common_keys
from ptsmc_jax.scenario.layouts import SCENARIOS
from ptsmc_jax.scenario.reading import in_scenario as in_scenario
from ptsmc_jax.scenario.tables import Scenario
from ptsmc_jax.simulation.gains import AXIS
from ptsmc_jax.simulation.gains import base as base
from ptsmc_jax.simulation.gains import gains_of as gains_of
from ptsmc_jax.simulation.gains import present_values as present_values
from ptsmc_jax.simulation.gains import with_gains as with_gains
from ptsmc_jax.simulation.rollout import Parts

PUBLISHED_DELTA = 0.05  # published delta of a spacecraft [s]


def units(plant: str) -> dict[str, str]:
    """Return the unit of each gain that a plant of this kind can have, by name; "-" for a gain without unit."""
    tables: Any = SCENARIOS[plant].TABLES
    return _collect_units(
        (*tables["controller"].values(), *tables["observer"].values(), *FILTERS.values(), *COMMAND_FILTERS.values())
    )


def units_of(scenario: Scenario, names: Iterable[str]) -> dict[str, str]:
    """Return the units of gains by name. All axes of a gain, such as `gain[1]`, share the name of the gain.

    Args:
        scenario: scenario, which may have custom laws and observers.
        names: names of gains of its law and observer, or of other laws for its plant.
    """
    known = units(scenario.plant.kind) | _collect_units(type(table) for table in scenario.tuned_tables.values())
    return {name: known[name] for name in map(base, names) if name in known}


def _collect_units(tables: Iterable[Any]) -> dict[str, str]:
    """Return the unit of each gain of these tables, by name. The first table with the gain defines its unit."""
    gain_keys = [
        (table, key, table.prefix + key.name) for table in tables if table.gains for key in keys.list_keys(table)
    ]
    return {name: key.unit or "-" for table, key, name in reversed(gain_keys) if name in table.gains}


def free_gain_names(scenario: Scenario) -> tuple[str, ...]:
    """Return the names of the free gains, with one name for each axis if the scenario tunes per axis."""
    names: list[str] = []
    for name in scenario.search.gains:
        if scenario.search.per_axis and name == "observer_gain":
            names += [f"{AXIS}{k + 1}" for k in range(len(getattr(scenario.observer, "gain", ())))]
        else:
            names.append(name)
    return tuple(names)


def published_gains(scenario: Scenario) -> dict[str, float]:
    """Return the published gains by name, scaled to the mission.

    A spacecraft has the gains of Case I. A chain of order n has eta = n + 1, as in Figs. 1 and 2. delta is at least one
    period.
    """
    units, table = mission.scales(scenario), LAWS[scenario.plant.kind]["prescribed_time"]
    gains = {name: float(units.scaled_value(scaled)) for name, scaled in table.scaled.items() if name in table.gains}
    if scenario.sampled:
        gains["delta"] = max(gains["delta"], scenario.loop.period)
    if scenario.motion == "chain":
        gains["eta"] = scenario.order + 1.0
    observer_gain = disturbance_tables.observer_gain(scenario)
    return gains | ({"observer_gain": observer_gain} if scenario.observer.kind == "nonlinear" else {})


def design_gains(scenario: Scenario, parts: Parts, names: tuple[str, ...]) -> list[list[float]]:
    """Return starting points that follow from the mission, see `mission.starting_designs`.

    A gain that the designs do not contain, such as a gain of a custom law, keeps the value of the scenario.

    Args:
        scenario: the scenario.
        parts: parts of the scenario.
        names: names of the free gains.

    Returns:
        Gains, (designs, gains), in their units. A scenario in continuous time has no designs.
    """
    if not scenario.sampled:
        return []
    designs, current = [], dict(zip(names, present_values(parts, names), strict=True))
    for design in mission.starting_designs(scenario):
        gains = scenario.controller.gains_of(design, scenario)
        if getattr(parts.observer, "linear", False):
            gains["observer_gain"] = design.observer
        designs.append([gains.get(base(name), value) for name, value in current.items()])
    return designs


def published_scenario(scenario: Scenario) -> Scenario:
    """Return the scenario with the published law and the published gains for its plant."""
    table, published = scenario.controller, published_gains(scenario)
    if not table.law.prescribed:
        error = {"error": "multiplicative"} if scenario.motion == "spacecraft" else {}
        law = {"kind": "prescribed_time", **error, **common_keys(table), "delta": published["delta"]}
        scenario = scenarios.replace(scenario, tune=None, controller=law)
    return in_scenario(scenario, published)


def published_label(scenario: Scenario) -> str:
    """Return the label of the published gains in tables.

    The label says whether the gains are unchanged, scaled to another body or period, or belong to another law.
    """
    if not scenario.controller.law.prescribed:
        return "published gains, prescribed-time law"
    unchanged = mission.is_published_case(scenario) and published_gains(scenario)["delta"] == PUBLISHED_DELTA
    return "published gains" if unchanged else "published gains, scaled"


def controls_differ(one: Scenario, other: Scenario) -> bool:
    """Return whether two scenarios differ in controller, observer, estimator or sensors, with defaults filled in."""
    one, other = one.complete_for_file(), other.complete_for_file()
    return any(
        getattr(one, name) != getattr(other, name) for name in ("controller", "observer", "estimator", "sensors")
    )
