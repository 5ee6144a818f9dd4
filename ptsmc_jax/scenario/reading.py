"""Scenarios read, checked as a whole and changed; without JAX, so that a bad one is refused at once."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec

from ptsmc_jax.declare import Scaled
from ptsmc_jax.scenario import checks, free_gains, layouts, mission, own, parsing
from ptsmc_jax.scenario.errors import ScenarioError
from ptsmc_jax.scenario.tables import Scenario, check_scenario
from ptsmc_jax.scenario.values import Table

AFTER = Scaled(10.0, time=1)  # from t_f to the end of a run [s]


def read(path: str | Path) -> Scenario:
    """The scenario of a TOML file, checked; raises ScenarioError with one sentence. Runs nothing that it names."""
    return from_tables(parsing.load(path))


def of(what: object) -> Scenario:
    """What is a scenario, or the file of one; raises TypeError, with one sentence, where it is neither."""
    if isinstance(what, str | Path):
        return read(what)
    return check_scenario(what, ", or its file")


def from_tables(raw: Mapping[str, Any], *, run: bool = False) -> Scenario:
    """The scenario of raw tables (a parsed file), checked; raises ScenarioError with one sentence.

    run: code of one's own may be run, without which its keys and gains are not known, and not checked: see `complete`.

    Raises TypeError where these are no tables.
    """
    if not isinstance(raw, Mapping):
        found = f"this is a {type(raw).__name__}"
        raise TypeError(f'tables are needed, such as {{"controller": {{"t_f": 35.0}}}}, but {found}')
    try:
        return _checked(raw, run)
    except ScenarioError as error:
        raise parsing.as_written(error, raw) from None


def _checked(raw: Mapping[str, Any], run: bool) -> Scenario:
    """Return the scenario of raw tables, with the defaults that depend on other keys."""
    scenario = resolve(parsing.parse(raw, run=run))
    checks.check(scenario)
    if scenario.tune is not None and not own.waits(scenario):
        scenario = msgspec.structs.replace(scenario, tune=free_gains.resolve(scenario, scenario.tune))
    return msgspec.structs.replace(scenario, defaulted=parsing.not_said(raw, parsing.dump(scenario)))


def resolve(scenario: Scenario) -> Scenario:
    """The scenario with the defaults that depend on other keys: t_end, lists as long as there are inputs, bounds.

    Raises ScenarioError where the body is none, from whose inertia some follow.
    """
    scenario.check_body()
    units, law = mission.scales(scenario), scenario.controller
    filled = {
        name: mission.with_defaults(getattr(scenario, name), units)
        for name in scenario.__struct_fields__
        if isinstance(getattr(scenario, name), Table) and name not in ("controller", "observer", "tune")
    }
    loop = filled["loop"]
    if scenario.loop.window is None and scenario.sampled:
        loop = msgspec.structs.replace(loop, window=max(loop.window, loop.period))
    if loop.t_end is None:
        loop = msgspec.structs.replace(loop, t_end=law.t_f + max(units.of(AFTER), loop.window))
    scenario = msgspec.structs.replace(scenario, **{**filled, "loop": loop})
    checks.check_sensors(scenario)
    scenario.check_devices()
    if loop.settling_angle is None:
        loop = msgspec.structs.replace(loop, settling_angle=scenario.usual_settling())
        scenario = msgspec.structs.replace(scenario, loop=loop)
    scenario = msgspec.structs.replace(scenario, controller=law.filled(scenario))
    observer = mission.with_defaults(scenario.observer.filled(scenario), units)
    return msgspec.structs.replace(scenario, observer=observer).resolved()


def complete(scenario: Scenario) -> Scenario:
    """The scenario with the keys and gains of parts of one's own, whose files are run; raises ScenarioError."""
    return from_tables(parsing.stated(scenario), run=True) if own.waits(scenario) else scenario


def settled(scenario: Scenario) -> Scenario:
    """The scenario with its defaults as stated values: replacing a key then moves no default that depends on it."""
    return msgspec.structs.replace(scenario, defaulted={})


def replace(scenario: Scenario | str | Path, **changes: Any) -> Scenario:
    """The scenario, or a file's, with other values, keys written table__key, checked: replace(s, controller__eta=4.0).

    None returns a key, or a whole table, to its default. Another kind of a table drops the keys of the old one. What
    the scenario does not say stays the default, which may follow what is changed.

    >>> faster = replace(from_tables({}), controller__t_f=20.0)
    >>> faster.controller.t_f, round(faster.loop.t_end, 3)
    (20.0, 26.667)
    >>> replace(faster, controller__eta=1.0)
    Traceback (most recent call last):
    ptsmc_jax.scenario.errors.ScenarioError: controller.eta is 1.0, but must be a number greater than 2 (Theorem 2)
    """
    scenario = of(scenario)
    tables = parsing.stated(scenario)
    for name in sorted(changes, key=_comes):
        value, (table, _, key) = changes[name], name.partition("__")
        within = tables.get(table, {})
        if key and not isinstance(within, Mapping):
            continue  # given beside it, and refused as in a file
        if value is None and _is_known(scenario, table, key):
            if not key:
                tables.pop(table, None)
            elif key == "kind" and _is_another_kind(scenario, table):
                tables[table] = {}
            elif key in within:  # of a copy: it may be the caller's
                tables[table] = {other: kept for other, kept in within.items() if other != key}
        elif not key:
            tables[table] = value
        elif key == "kind" and getattr(getattr(scenario, table, None), "kind", None) != value:
            tables[table] = {"kind": value}
        else:
            tables[table] = {**within, key: value}
    return from_tables(tables, run=not own.waits(scenario))


def _comes(name: str) -> int:
    """When a change is made: whole tables and kinds first, which would drop the keys that go with them."""
    _, _, key = name.partition("__")
    return 0 if not key else 1 if key == "kind" else 2


def _is_another_kind(scenario: Scenario, table: str) -> bool:
    """Whether a table is of another kind than the default one."""
    kinds = layouts.SCENARIOS if table == "plant" else scenario.TABLES.get(table)
    kind = getattr(getattr(scenario, table), "kind", None)
    return isinstance(kinds, Mapping) and kind not in (None, next(iter(kinds)))


def _is_known(scenario: Scenario, table: str, key: str) -> bool:
    """Whether there is such a table or key; one that is not known is handed on, and refused as in a file."""
    tables = set(scenario.__struct_fields__) - {"defaulted"}
    now = getattr(scenario, table) if table in tables else None
    if not key or now is None:
        return table in tables
    return key in now.__struct_fields__ if isinstance(now, msgspec.Struct) else True
