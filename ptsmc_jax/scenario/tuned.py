"""Set gains in a scenario, see `in_scenario`. `simulation.gains` sets gains in the parts of a run."""

from collections.abc import Mapping
from typing import Any

from ptsmc_jax.scenario import reading
from ptsmc_jax.scenario.errors import ScenarioError
from ptsmc_jax.scenario.parsing import to_dict
from ptsmc_jax.scenario.tables import Scenario
from ptsmc_jax.simulation.gains import AXIS, base, gain_of_each_axis


def in_scenario(scenario: Scenario, gains: Mapping[str, Any]) -> Scenario:
    """Return a validated scenario with other gains.

    A new t_f moves the end of the run by the same time. All other values stay, defaults included.

    Args:
        scenario: a scenario or the path of its file.
        gains: values by the names that `gains_of` returns.

    Raises:
        ScenarioError: a name is not a gain of the scenario, or a value is not allowed.
        TypeError: `gains` is not a mapping.
    """
    scenario = reading.to_scenario(scenario)
    if not isinstance(gains, Mapping):
        raise TypeError(f"gains are needed by name, such as {{'eta': 3.0}}, but this is a {type(gains).__name__}")
    axes = list(getattr(scenario.observer, "gain", ()))
    known_names = [*scenario.gains, *(f"{AXIS}{k + 1}" for k in range(len(axes)))]
    for name in gains:
        if name not in known_names:
            raise ScenarioError(f"{name} is no gain of this scenario; allowed is some of {', '.join(known_names)}")
        if gains[name] is None or (name == "t_f" and not hasattr(gains[name], "__float__")):
            raise ScenarioError(f"{name} is {gains[name]!r}, but must be a number")
    axis_gains = gain_of_each_axis(gains, axes)
    gains = {base(name): value for name, value in gains.items()}
    gains |= {} if axis_gains is None else {"observer_gain": axis_gains}
    changes: dict[str, Any] = {}
    for place, table in scenario.tuned_tables.items():
        values = {name.removeprefix(table.prefix): value for name, value in gains.items() if name in table.gains}
        outer, _, inner = place.partition(".")
        if inner and values:
            changes[f"{outer}__{inner}"] = {**to_dict(table), **values}
        else:
            changes |= {f"{outer}__{key}": value for key, value in values.items()}
    if "t_f" in gains:
        changes["loop__t_end"] = gains["t_f"] + (scenario.end - scenario.controller.t_f)
    try:
        return reading.replace(reading.freeze_defaults(scenario), **changes)
    except ScenarioError as error:
        changed_keys = {key.replace("__", ".") for key in changes if key != "loop__t_end"}
        of_gain = error.key in changed_keys or error.key.startswith(("observer.", "hardware.command_filter."))
        if "t_f" not in gains or of_gain:
            raise
        raise ScenarioError(
            f"t_f is {gains['t_f']}, but must go with the rest of the scenario, whose defaults stay (by replace they "
            f"follow it): {error}"
        ) from None
