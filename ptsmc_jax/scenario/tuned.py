"""A scenario with other gains; parts with other gains: `simulation.gains`."""

from collections.abc import Mapping
from typing import Any

from ptsmc_jax.scenario import reading
from ptsmc_jax.scenario.errors import ScenarioError
from ptsmc_jax.scenario.parsing import plain
from ptsmc_jax.scenario.tables import Scenario
from ptsmc_jax.simulation.gains import of_law, of_observer, of_sensors, on_every_axis


def in_scenario(scenario: Scenario, gains: Mapping[str, Any]) -> Scenario:
    """The scenario with other gains, by the names that `gains_of` has, checked; with t_f goes the time after it.

    All else stays, defaults too. Raises ScenarioError where the scenario must not have them.
    """
    if "filter_bandwidth" in gains and "filter_bandwidth" not in scenario.estimator.gains:
        raise ScenarioError(
            'filter_bandwidth is no gain of this scenario, which has no [filter] of kind "steady_state"'
        )
    if "command_corner" in gains and scenario.devices.command_filter is None:
        raise ScenarioError("command_corner is no gain of this scenario, which has no hardware.command_filter")
    changes: dict[str, Any] = {f"controller__{name}": value for name, value in of_law(gains).items()}
    changes |= {f"observer__{name}": value for name, value in of_observer(gains).items()}
    changes |= {f"sensors__{name}": value for name, value in of_sensors(gains).items()}
    each = on_every_axis(gains, list(getattr(scenario.observer, "gain", ())))
    if each is not None:
        changes["observer__gain"] = each
    if "filter_bandwidth" in gains:
        changes["filter__bandwidth"] = gains["filter_bandwidth"]
    if "command_corner" in gains:
        table = plain(scenario.devices.command_filter)
        changes["hardware__command_filter"] = {**table, "corner": gains["command_corner"]}
    if "t_f" in gains:
        changes["loop__t_end"] = gains["t_f"] + (scenario.end - scenario.controller.t_f)
    return reading.replace(reading.settled(scenario), **changes)
