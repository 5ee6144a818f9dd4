"""Read, validate and change scenarios. Start with `read`, `from_tables` and `replace`."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax  # noqa: F401  # first: from a deeper stack, Python 3.11 may need 0.2 s longer, for memory of its frames
import msgspec

from ptsmc_jax.declare import Scaled
from ptsmc_jax.scenario import checks, custom, free_gains, layouts, mission, parsing
from ptsmc_jax.scenario.errors import ScenarioError, wrong
from ptsmc_jax.scenario.tables import Scenario, check_scenario
from ptsmc_jax.scenario.values import Table
from ptsmc_jax.simulation.gains import AXIS, base, check_mapping, gain_of_each_axis

TIME_AFTER_T_F = Scaled(10.0, time=1)  # default time from t_f to the end of a run [s]


def read(path: str | Path) -> Scenario:
    """Return the validated scenario of a TOML file; raise ScenarioError with one sentence. Custom code is not run."""
    return from_tables(parsing.load(path))


def to_scenario(scenario_or_path: object) -> Scenario:
    """Return a scenario, or read it if `scenario_or_path` is the path of a file; raise TypeError for anything else."""
    if isinstance(scenario_or_path, str | Path):
        return read(scenario_or_path)
    return check_scenario(scenario_or_path, ", or its file")


def from_tables(raw: Mapping[str, Any], *, run: bool = False) -> Scenario:
    """Return the validated scenario of raw tables, such as a parsed TOML file.

    Args:
        raw: tables by name; tables and keys that are absent or None get their defaults.
        run: whether custom code may run. If not, the keys and gains of custom parts are not validated, see `complete`.

    Raises:
        ScenarioError: a key, a value or a combination of values is not allowed; the message is one sentence.
        TypeError: `raw` is not a mapping.
    """
    if not isinstance(raw, Mapping):
        actual = f"this is a {type(raw).__name__}"
        raise TypeError(f'tables are needed, such as {{"controller": {{"t_f": 35.0}}}}, but {actual}')
    try:
        scenario = resolve(parsing.parse(raw, run_code=run))
        checks.check_keys(scenario)
        if scenario.tune is not None and not custom.has_unloaded_code(scenario):
            scenario = msgspec.structs.replace(scenario, tune=free_gains.resolve(scenario, scenario.tune))
    except ScenarioError as error:
        raise parsing.as_written(error, raw) from None
    return msgspec.structs.replace(scenario, defaulted=parsing.unstated_values(raw, parsing.dump(scenario)))


def resolve(scenario: Scenario) -> Scenario:
    """Return a scenario with the defaults that depend on other keys: times, gains, disturbance bounds, lists.

    Raises:
        ScenarioError: the inertia, which determines defaults, is not that of a body, or devices contradict each other.
    """
    scenario.check_body()
    if scenario.loop.mode is None:
        loop = msgspec.structs.replace(scenario.loop, mode=scenario.default_mode())
        scenario = msgspec.structs.replace(scenario, loop=loop)
    ratios, law = mission.scales(scenario), scenario.controller
    tables = {
        name: mission.fill_scaled_defaults(getattr(scenario, name), ratios)
        for name in scenario.__struct_fields__
        if isinstance(getattr(scenario, name), Table) and name not in ("controller", "observer", "tune")
    }
    loop = tables["loop"]
    if scenario.loop.window is None and scenario.sampled:
        loop = msgspec.structs.replace(loop, window=max(loop.window, loop.period))
    if loop.t_end is None:
        pointing = getattr(tables.get("pointing"), "time_after_t_f", 0.0)
        after = max(ratios.scaled_value(TIME_AFTER_T_F), loop.window, pointing)
        loop = msgspec.structs.replace(loop, t_end=law.t_f + after)
    scenario = msgspec.structs.replace(scenario, **{**tables, "loop": loop})
    checks.check_sensors(scenario)
    scenario.check_devices()
    scenario = scenario.fill_plant_defaults()
    if loop.settling_angle is None:
        loop = msgspec.structs.replace(loop, settling_angle=scenario.default_settling_angle())
        scenario = msgspec.structs.replace(scenario, loop=loop)
    scenario = msgspec.structs.replace(scenario, controller=law.fill_defaults(scenario))
    observer = mission.fill_scaled_defaults(scenario.observer.fill_defaults(scenario), ratios)
    return msgspec.structs.replace(scenario, observer=observer)


def complete(scenario: Scenario) -> Scenario:
    """Return a scenario with the keys and gains of its custom parts. It executes their code.

    Raises:
        ScenarioError: the code fails, or a key is not valid.
    """
    return from_tables(parsing.stated_tables(scenario), run=True) if custom.has_unloaded_code(scenario) else scenario


def freeze_defaults(scenario: Scenario) -> Scenario:
    """Return a scenario whose defaults count as stated values, so that `replace` does not change them."""
    return msgspec.structs.replace(scenario, defaulted={})


def replace(scenario: Scenario | str | Path, **changes: object) -> Scenario:
    """Return a validated scenario with other values, such as replace(scenario, controller__eta=4.0).

    Keys that the scenario does not state keep their defaults, which may change with the new values. A new kind of a
    table discards the keys of the old kind.

    Args:
        scenario: a scenario or the path of its file.
        changes: values by key, written table__key, or whole tables by name, also those of another scenario. None
            restores the default. The path of a file is relative to the working directory.

    Raises:
        ScenarioError: a value or a combination of values is not allowed.

    >>> faster = replace(from_tables({}), controller__t_f=20.0)
    >>> faster.controller.t_f, round(faster.loop.t_end, 3)
    (20.0, 26.667)
    >>> replace(faster, controller__eta=1.0)
    Traceback (most recent call last):
    ptsmc_jax.scenario.errors.ScenarioError: controller.eta is 1.0, but must be a number greater than 2 (Theorem 2)
    """
    scenario = to_scenario(scenario)
    tables = parsing.stated_tables(scenario)
    # whole tables first, then kinds, then other keys, which these would discard
    for name in sorted(changes, key=lambda name: ("__" in name, not name.endswith("__kind"))):
        value, (table, _, key) = changes[name], name.partition("__")
        value = parsing.to_dict(value) if isinstance(value, Table) else value
        present = tables.get(table) or {}
        if not key:
            tables[table] = value
        elif not isinstance(present, Mapping):
            raise wrong(table, present, "a table")
        elif key == "kind" and getattr(getattr(scenario, table, None), "kind", None) != (
            _default_kind(scenario, table) if value is None else value
        ):
            tables[table] = {"kind": value}
        else:
            tables[table] = {**present, key: value}
    return from_tables(tables, run=not custom.has_unloaded_code(scenario))


def _default_kind(scenario: Scenario, table: str) -> str | None:
    """Return the default kind of a table, or None if it has no kinds."""
    kinds = layouts.SCENARIOS if table == "plant" else scenario.TABLES.get(table)
    return next(iter(kinds)) if isinstance(kinds, Mapping) else None


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
    scenario = to_scenario(scenario)
    check_mapping(gains)
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
    changes: dict[str, object] = {}
    for place, table in scenario.tuned_tables.items():
        values = {name.removeprefix(table.prefix): value for name, value in gains.items() if name in table.gains}
        outer, _, inner = place.partition(".")
        if inner and values:
            changes[f"{outer}__{inner}"] = {**parsing.to_dict(table), **values}
        else:
            changes |= {f"{outer}__{key}": value for key, value in values.items()}
    if "t_f" in gains:
        changes["loop__t_end"] = gains["t_f"] + (scenario.end - scenario.controller.t_f)
    return replace(freeze_defaults(scenario), **changes)
