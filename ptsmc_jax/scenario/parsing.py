"""Parse and write scenario files. Start with `parse` and `dump`.

This module validates single tables and keys. `checks` validates constraints between keys.
"""

import copyreg
import difflib
import functools
import math
import os
import re
import tomllib
import typing
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from ptsmc_jax import units
from ptsmc_jax.scenario import (
    attitude_keys,
    custom,
    device_tables,
    disturbance_tables,
    keys,
    layouts,
    sensor_tables,
    systems,
)
from ptsmc_jax.scenario.attitude_keys import ATTITUDE_KEYS, Attitude
from ptsmc_jax.scenario.errors import MOST_BITS, ScenarioError, brief, show, show_key, wrong
from ptsmc_jax.scenario.layouts import SCENARIOS, TABLES
from ptsmc_jax.scenario.tables import Limit, Scenario
from ptsmc_jax.scenario.values import Kinds, NotNegative, Positive, Table
from ptsmc_jax.simulation import catalogues

DEEPEST = 8  # nesting of tables and arrays; a rotation matrix of a disturbance in a sum has depth 6
LONGEST_KEY = 100  # largest number of characters of a key
MOST_LISTED = 20  # largest number of known names that an error lists
INVERTIBLE = ("period", "frequency", "orbit_rate")  # endings of keys that may be given as 1 / their quantity
TABLES_OF_NAMES = ("telemetry", "dispersion")  # tables whose keys have the names of other things
SUITE_TEXT = "tables with a kind, [[sensors]] for each sensor"
_TOO_DEEP = f"but at most {DEEPEST} levels are allowed"
# a very long dotted key: the memory that the parser needs for it grows with the square of its length
_LONG_DOTTED_KEY = re.compile(r"""(?<![\w-])(?:(?:[\w-]+|"[^"\n]*"|'[^'\n]*')[ \t]*\.[ \t]*){20}""")


class Context(NamedTuple):
    """Properties of the whole scenario that the parser of a table needs."""

    scenario_class: type[Scenario]  # one of `layouts.SCENARIOS`
    run_code: bool = False  # whether code that the scenario names may run


def read_toml(path: str | Path) -> dict[str, Any]:
    """Return the raw tables of a TOML file; raise ScenarioError if it is missing or not valid."""
    name, text = f"the scenario file {path}", ""
    try:
        text = Path(path).read_text(encoding="utf-8-sig")  # some editors begin a file with a byte order mark
        if _LONG_DOTTED_KEY.search(text):
            raise RecursionError
        return tomllib.loads(text)
    except FileNotFoundError:
        raise ScenarioError(f"{name} does not exist") from None
    except OSError as error:
        raise ScenarioError(f"{name} cannot be read: {error.strerror}") from None
    except UnicodeDecodeError:
        raise ScenarioError(f"{name} is not encoded in UTF-8") from None
    except ValueError as error:  # TOMLDecodeError, or a number with too many digits for Python
        raise ScenarioError(f"{name} is no valid TOML: {error}{_faulty_line(text, str(error))}") from None
    except RecursionError:
        raise ScenarioError(f"{name} has tables or arrays in each other, {_TOO_DEEP}") from None


def _faulty_line(text: str, message: str) -> str:
    """Return the line that an error message of the TOML parser is about, and a hint if its value lacks quotes."""
    place = re.search(r"\(at line (\d+)", message)
    if place is None:
        return ""
    line = " ".join(text.split("\n")[int(place[1]) - 1].split())
    value = re.search(r"=([^\"'#=]*)(#.*)?$", line)
    without_quotes = value is not None and re.search(r"(^|[\s\d\]])[A-Za-zµ°]", value[1])
    hint = "; a text needs quotes, also a number with a unit" if without_quotes else ""
    return f": {line[:LONGEST_KEY]}{hint}" if line.isprintable() else ""


def load(path: str | Path) -> dict[str, Any]:
    """Return the raw tables of a scenario file; raise ScenarioError if it is missing or not valid.

    Relative paths of Python files in it become absolute, relative to the folder of the TOML file. No code is run.
    """
    raw = read_toml(path)
    for table in custom.find_data_tables(raw):
        table["file"] = os.path.realpath(Path(path).parent / table["file"])
    for table, key in custom.find_code_keys(raw):
        file, _, name = table[key].rpartition(":")
        if file.endswith(".py") and not os.path.isabs(file) and file.isprintable():
            table[key] = f"{os.path.realpath(Path(path).parent / file)}:{name}"
    return raw


def parse(raw: Mapping[str, Any], *, run_code: bool = False) -> Scenario:
    """Return the scenario of raw tables. Keys whose default depends on other keys are still None.

    Args:
        raw: tables by name, as TOML returns them.
        run_code: whether custom code that the tables name may run; its classes then provide further keys.

    Raises:
        ScenarioError: a table or key is unknown, or a value is not allowed.
    """
    _check_shape("", raw, DEEPEST)
    kind = _kind_of("plant", raw.get("plant") or {}, TABLES)
    scenario_class, layout = SCENARIOS[kind], TABLES[kind]
    for name, table in raw.items():
        if name not in (*layout, "requirements"):
            raise _unknown_table_error(name, table, kind)
        is_suite = name == "sensors" and isinstance(table, list | tuple)
        if not isinstance(table, Mapping | None) and not is_suite:
            raise _no_table_error(name, table, layout.get(name))
    present = {name: table for name, table in raw.items() if table is not None}
    plant = present.get("plant", {})
    context = Context(scenario_class, run_code)
    law_kind = _kind_of("controller", present.get("controller", {}), typing.cast(Kinds, layout["controller"]))
    plants = {name: typing.cast(type[Table], tables["plant"]) for name, tables in TABLES.items()}
    plant_table = _parse_table("plant", plant, plants, context)
    defaults = scenario_class.plant_defaults(plant_table, plant.keys(), law_kind)
    tables: dict[str, Any] = {}
    for name, kinds in layout.items():
        table = present.get(name, {})
        if isinstance(table, list | tuple):
            tables[name] = _parse_sensor_suite(table, context)
        elif name in present or name not in layouts.OPTIONAL:
            if name == "sensors" and kind == "spacecraft" and "code" not in table and table.get("kind") != "custom":
                raise wrong(name, table, f'{SUITE_TEXT}, or [sensors] with kind = "custom"')
            tables[name] = _parse_table(name, table, kinds, context, defaults.get(name))
    # plain limits first, as TOML writes them, so that the order of verdicts is the same for a scenario that was saved
    limits = {key: value for key, value in present.get("requirements", {}).items() if value is not None}
    plain_first = sorted(limits, key=lambda key: isinstance(limits[key], Mapping))
    tables["requirements"] = {key: _parse_requirement(key, limits[key], context) for key in plain_first}
    return scenario_class(**tables)


def _check_shape(name: str, value: object, levels: int) -> None:
    """Raise ScenarioError for too deep nesting and for keys that cannot be printed, before other code visits them."""
    if isinstance(value, Mapping):
        for key in value:
            if not (isinstance(key, str) and key.isprintable() and 0 < len(key) <= LONGEST_KEY):
                raise ScenarioError(f"{name or 'the scenario'} has the key {brief(key)}, which is not a known one")
        children = [(name or key, inner) for key, inner in value.items()]
    else:
        children = [(name, inner) for inner in value] if isinstance(value, list | tuple) else []
    if children and not levels:
        raise ScenarioError(f"{name} has tables or arrays in each other, {_TOO_DEEP}")
    for table, inner in children:
        _check_shape(table, inner, levels - 1)


def _kind_of(name: str, raw: Mapping[str, Any], kinds: Mapping[str, object]) -> str:
    """Return the kind of a table, by default the first one; raise ScenarioError if there is no such kind."""
    if not isinstance(raw, Mapping):
        raise _no_table_error(name, raw, kinds)
    kind = next(iter(kinds)) if raw.get("kind") is None else raw["kind"]
    if not isinstance(kind, str) or kind not in kinds:
        known = list(map(show, kinds))
        raise wrong(f"{name}.kind", kind, " or ".join(known) if len(known) < 8 else f"one of {', '.join(known)}")
    return kind


def _no_table_error(name: str, value: object, kinds: object) -> ScenarioError:
    """Return the error for a value that must be a table; kinds: its class, or its classes by kind."""
    example = f" such as {{ kind = {show(next(iter(kinds)))} }}" if isinstance(kinds, Mapping) else ""
    if name == "disturbance" and isinstance(value, list | tuple) and all(isinstance(one, Mapping) for one in value):
        example = ' such as { kind = "sum", terms = [{ kind = "constant" }, { kind = "sinusoid" }] }'
    return wrong(name, value, f"a table{example}")


def _unknown_table_error(name: str, value: object, kind: str) -> ScenarioError:
    """Return the error for an unknown table, or for a key outside a table; kind: kind of the plant."""
    layout = TABLES[kind]
    other_plants = [other for other, other_layout in TABLES.items() if name in other_layout]
    if other_plants:
        return ScenarioError(f"[{name}] needs plant.kind = {show(other_plants[0])}, but it is {show(kind)}")
    if isinstance(value, Mapping):
        hint = nearest_name_hint(name, (*layout, "requirements"), "[{}]")
        return ScenarioError(f"[{name}] is not a known table; {hint}")
    return ScenarioError(f"{show_key(name)} = {brief(value)} is outside of any table; {nearest_keys_hint(name, kind)}")


def nearest_keys_hint(name: str, kind: str) -> str:
    """Return a hint for a key without its table: the nearest known keys with their tables; kind: of the plant."""
    tables_of_key = keys.table_names_by_key(TABLES[kind])
    closest = difflib.get_close_matches(name.lower(), tables_of_key, n=1)
    tables = [table for table in tables_of_key[closest[0]] if table not in TABLES_OF_NAMES] if closest else []
    places = [f"{table}.{closest[0]}" for table in tables]
    hint = f"the nearest known {'keys are' if places[1:] else 'key is'} {', '.join(places)}"
    return hint if places else "no table has such a key"


def dump(scenario: Scenario) -> dict[str, Any]:
    """Return tables for a file, with all defaults filled in. `parse` returns an equivalent scenario from them."""
    return to_raw_tables(scenario.complete_for_file())


def to_raw_tables(scenario: Scenario) -> dict[str, Any]:
    """Return tables that `parse` converts back to the same scenario; keys that are None are omitted."""
    raw = to_dict(scenario)
    if "each" in raw.get("sensors", {}):
        raw["sensors"] = raw["sensors"]["each"]
    names = [name for name in TABLES[scenario.plant.kind] if name != "tune"]
    return {name: raw[name] for name in (*names, "requirements", "tune") if name in raw}


def _reduce(scenario: Scenario) -> tuple:
    """Pickle a scenario as its tables, since no module contains the classes that are made from declarations."""
    return _restore, (to_raw_tables(scenario), not custom.has_unloaded_code(scenario), scenario.defaulted)


def _restore(raw: Mapping[str, Any], run_code: bool, defaulted: dict[tuple[str, ...], object]) -> Scenario:
    """Return a pickled scenario. Arguments: its tables, whether to run custom code, and `Scenario.defaulted`."""
    return msgspec.structs.replace(parse(raw, run_code=run_code), defaulted=defaulted)


for _scenario_class in SCENARIOS.values():
    copyreg.pickle(_scenario_class, _reduce)


def stated_tables(scenario: Scenario) -> dict[str, Any]:
    """Return tables for a file without the keys that have their defaults and that the scenario's file omits."""
    tables = dump(scenario)
    for (*outer, key), value in scenario.defaulted.items():
        inner: Any = tables
        for name in outer:
            inner = inner.get(name, {})
        if key in inner and inner[key] == value:
            del inner[key]
    return tables


def units_of_keys(tables: Mapping[str, Any], name: str, index: int = 0) -> dict[str, str]:
    """Return the units of the keys of a table, by key.

    Args:
        tables: tables of a file, see `dump`.
        name: name of the table, such as dispersion.rate.
        index: number of the table in a list of tables.
    """
    scenario_class = SCENARIOS[tables["plant"]["kind"]]
    table: Any = tables
    for part in name.split("."):
        table = table[part]
    outer, _, inner = name.partition(".")
    if outer == "requirements":
        metrics = {**scenario_class.metrics, **catalogues.MARGINS}
        return {"limit": metrics[inner].unit} if inner else {key: entry.unit for key, entry in metrics.items()}
    struct: Any = layouts.KINDS.get(name, scenario_class.TABLES[outer])
    if isinstance(table, list):
        struct, table = sensor_tables.SENSORS if outer == "sensors" else struct, table[index]
    if isinstance(struct, Mapping):
        struct = struct[table.get("kind", next(iter(struct)))]
    return {key.name: key.unit for key in keys.list_keys(struct, scenario_class.unit_of_d)}


def unstated_values(raw: Mapping[str, object], tables: Mapping[str, object]) -> dict[tuple[str, ...], object]:
    """Return the values of keys in `tables` that `raw` does not have, by the path of the key."""
    missing: dict[tuple[str, ...], object] = {}
    for key, value in tables.items():
        if isinstance(value, Mapping):
            raw_inner = raw.get(key, {})
            inner_values = unstated_values(raw_inner if isinstance(raw_inner, Mapping) else {}, value)
            missing |= {(key, *path): one for path, one in inner_values.items()}
        elif raw.get(key) is None:
            missing[(key,)] = value
    return missing


def to_dict(table: Table) -> dict[str, Any]:
    """Return a table as a scenario file would write it; keys that are None are omitted."""
    return typing.cast(dict, _without_none(table))


def _without_none(value: object) -> object:
    """Convert structs to mappings and tuples to lists. Python objects such as systems and classes stay unchanged."""
    if isinstance(value, msgspec.Struct):
        value = {key: getattr(value, key) for key in value.__struct_fields__}
        value |= value.pop("rest", {})
    if isinstance(value, Mapping):
        entries = {k: _without_none(v) for k, v in value.items() if v is not None}
        return {k: v for k, v in entries.items() if v != {} or k not in ("requirements", "bounds")}
    if isinstance(value, list | tuple):
        return [_without_none(v) for v in value]
    return value


def nearest_name_hint(name: str, known: Iterable[str], template: str = "{}") -> str:
    """Return a hint for an unknown name: one or two similar known names, or else the first `MOST_LISTED` known ones.

    Args:
        name: the unknown name.
        known: the known names.
        template: format of a known name in the hint.
    """
    known = {one.lower(): one for one in known}
    similar = functools.partial(difflib.get_close_matches, name.lower(), known)
    # a misspelt name has one very similar name; of less similar names the second one may be meant
    matches = similar(n=1, cutoff=0.85) or similar(n=2)
    listed = [known[one] for one in matches] or list(known.values())[:MOST_LISTED]
    shown = ", ".join(map(template.format, listed)) + (", .." if len(listed) == MOST_LISTED < len(known) else "")
    return f"the nearest known {'ones are' if matches[1:] else 'one is'} {shown}" if matches else f"known are {shown}"


def _parse_table(
    name: str, raw: Any, kinds: type[Table] | Kinds, context: Context, defaults: Mapping[str, object] | None = None
) -> Table:
    """Return a table.

    Args:
        name: name of the table, such as disturbance.terms[0].
        raw: the table as read; a list of tables has been refused.
        kinds: class of the table, or classes by kind.
        context: properties of the scenario.
        defaults: defaults that depend on the plant. An attitude that is given replaces the default attitude.
    """
    if isinstance(kinds, Mapping):
        struct = kinds[_kind_of(name, raw, kinds)]
    else:
        struct, kinds = kinds, {}
    defaults = defaults or {}
    if any(key in raw for key in ATTITUDE_KEYS) or not issubclass(struct, Attitude):
        defaults = {key: value for key, value in defaults.items() if key not in ATTITUDE_KEYS}
    raw = {**defaults, **raw}
    if issubclass(struct, custom.Custom):
        return _parse_custom_part(name, raw, struct, context)
    if struct is not disturbance_tables.SumDisturbance:
        return _parse_fields(name, raw, struct, context, kinds)
    _parse_fields(name, {key: value for key, value in raw.items() if key != "terms"}, struct, context, kinds)
    single_kinds = disturbance_tables.without_sums(kinds)
    terms = _parse_list(f"{name}.terms", raw.get("terms", ()), single_kinds, disturbance_tables.TERMS_TEXT, context)
    return disturbance_tables.SumDisturbance(terms=terms)


def _parse_list(name: str, raw: object, kinds: Kinds, allowed: str, context: Context) -> tuple[Table, ...]:
    """Return a list of tables with a kind; `allowed`: description of it."""
    if not isinstance(raw, list | tuple) or not raw or not all(isinstance(one, Mapping) for one in raw):
        raise wrong(name, raw, allowed)
    return tuple(_parse_table(f"{name}[{k}]", one, kinds, context) for k, one in enumerate(raw))


def _parse_sensor_suite(raw: object, context: Context) -> Table:
    """Return the table of [[sensors]]."""
    if context.scenario_class.motion != "spacecraft":
        raise ScenarioError('[[sensors]] needs plant.kind = "spacecraft"; allowed is [sensors] with kind = "custom"')
    return sensor_tables.SensorSuite(each=_parse_list("sensors", raw, sensor_tables.SENSORS, SUITE_TEXT, context))


def _parse_custom_part(name: str, raw: Mapping[str, object], struct: type[Table], context: Context) -> Table:
    """Return the table of a custom part.

    It has the keys of its class only if the class is given as an object or if its file may be executed.
    """
    code = raw.get("code")
    if code is None:
        raise ScenarioError(f"{name}.code is absent, but must be given: {systems.NAME_FORMS}")
    if isinstance(code, str):
        try:
            systems.split_name(code, systems.NAME_FORMS)
        except ValueError as error:
            raise ScenarioError(f"{name}.code is {brief(code)}: {error}") from None
    if context.run_code or not isinstance(code, str):
        return _parse_fields(name, raw, custom.load_table(struct, name, code), context)
    shared_keys = {key: value for key, value in raw.items() if key in struct.__struct_fields__ and key != "rest"}
    rest = {key: value for key, value in raw.items() if key not in shared_keys}
    for key in (key for key, value in rest.items() if _find_non_finite(value) is not None):
        raise wrong(f"{name}.{key}", rest[key], "made of finite numbers")
    return msgspec.structs.replace(_parse_fields(name, shared_keys, struct, context), rest=rest)


def _parse_requirement(metric: str, value: object, context: Context) -> float | Limit:
    """Return a limit, or a table with a limit, of a metric; raise ScenarioError if it is not allowed."""
    key, metrics = f"requirements.{metric}", context.scenario_class.metrics
    if metric not in metrics and metric not in catalogues.MARGINS:
        raise ScenarioError(
            f"{key} is not a known metric; {nearest_name_hint(metric, (*metrics, *catalogues.MARGINS))}"
        )
    allowed = NotNegative if metric in catalogues.MAY_BE_ZERO else Positive
    unit = {**metrics, **catalogues.MARGINS}[metric].unit
    if not isinstance(value, Mapping):
        return _parse_value(key, value, allowed, unit)
    if metric in catalogues.MARGINS:
        raise wrong(key, value, "a number greater than 0, which every loop must keep")
    if "limit" not in value:
        raise wrong(key, value, "a number greater than 0 or a table with `limit`")
    limit = _parse_value(f"{key}.limit", value["limit"], allowed, unit)
    return typing.cast(Limit, _parse_fields(key, {**value, "limit": limit}, Limit, context))


def _parse_fields(
    name: str, raw: Mapping[str, object], struct: type[Table], context: Context, kinds: Kinds | None = None
) -> Table:
    """Return the table of a struct with the values of its keys; arguments as in `_parse_table`."""
    known_keys = {key.name: key for key in keys.list_keys(struct, context.scenario_class.unit_of_d)}
    values = {}
    for key, value in raw.items():
        if key not in struct.__struct_fields__:
            raise _unknown_key_error(name, key, struct, context, kinds or {})
        if value is None or key == "kind":  # `_kind_of` has read the kind
            continue
        inline_kinds = layouts.KINDS.get(f"{name}.{key}")
        if inline_kinds is None:
            values[key] = _parse_value(f"{name}.{key}", value, known_keys[key].type, known_keys[key].unit)
        elif isinstance(value, Mapping):
            values[key] = _parse_table(f"{name}.{key}", value, inline_kinds, context)
        else:
            example = show(next(iter(inline_kinds)))
            raise wrong(f"{name}.{key}", value, f"an inline table such as {{ kind = {example} }}")
    table = struct(**values)
    if isinstance(table, Attitude):
        attitude_keys.check_single_attitude(name, table)
    return table


def _unknown_key_error(name: str, key: str, struct: type[Table], context: Context, kinds: Kinds) -> ScenarioError:
    """Return the error for a key that the table of this name does not have; `kinds`: kinds of the table."""
    known, layout = struct.__struct_fields__, context.scenario_class.TABLES
    others = [show(kind) for kind, other in kinds.items() if key in other.__struct_fields__]
    this_kind = next((kind for kind, other in kinds.items() if other is struct), None)
    other_kinds = f" of {name}.kind = {show(this_kind)}, but of {', '.join(others)}" if others else ""
    tables = [table for table in keys.table_names_by_key(layout).get(key, []) if table not in TABLES_OF_NAMES]
    if key in layout:
        hint = f"[{key}] is a table of its own"
    elif tables and name not in tables and not difflib.get_close_matches(key.lower(), known, cutoff=0.85):
        hint = f"{', '.join(f'{table}.{key}' for table in tables)} {'are' if tables[1:] else 'is'}"
        if len(known) <= MOST_LISTED // 2:
            hint += f", and the keys of {name} are {', '.join(known)}"
    else:
        hint = nearest_name_hint(key, known, f"{name}.{{}}")
    return ScenarioError(f"{name}.{key} is not a known key{other_kinds}; {hint}")


def _parse_value(key: str, value: object, value_type: Any, unit: str = "") -> Any:
    """Return the value of a key. Texts with a unit, such as "0.05 deg", become numbers in the unit of the key."""
    try:
        number = _to_numbers(value, unit, key)
    except TypeError:  # raised by JAX for a traced value
        raise ScenarioError(f"{key} is traced by JAX, but must be known here; with_gains takes traced gains") from None
    allowed = keys.allowed_values(value_type)
    bad = _find_non_finite(number)
    if bad is not None:
        raise wrong(key, value, f"{allowed}, and {show(bad)} is no finite number")
    try:
        return msgspec.convert(number, value_type, strict=True)
    except msgspec.ValidationError:
        raise wrong(key, value, allowed + _hint(key, value, number, unit, value_type)) from None


def _hint(key: str, written: object, value: object, unit: str, value_type: Any) -> str:
    """Return a hint for a value that is not allowed: how its unit, a whole number or a noise per axis is written.

    Args:
        key: the key.
        written: its value as the file gives it.
        value: the same value, with numbers instead of texts with a valid unit.
        unit: unit of the key.
        value_type: type of the key.
    """
    allowed, depth = keys.allowed_values(value_type), _list_depth(value_type)
    has_unit = units.parse(unit) is not None
    entries = _flatten(value)
    if has_unit and (any(isinstance(one, str | Mapping) for one in entries) or (depth and isinstance(written, str))):
        examples = units.EXAMPLES.get(unit, f'"1 {unit}"')
        if depth:  # the text itself if its unit fits, or one example, in the brackets of a list
            example = show(written) if isinstance(value, float) else re.split(", | or ", examples)[0]
            examples = f"{'[' * depth}{example}, ..{']' * depth}"
        return f" [{unit}], or with a unit such as {examples}"
    if any(isinstance(one, str) and units.split(one)[1] for one in entries):
        return ", without a unit"
    if isinstance(value, float) and value.is_integer() and "whole number" in allowed:
        return f", written as {value:.0f}"
    if key == "hardware.attitude_noise" and isinstance(value, tuple):
        return " for all axes: the largest one, or noise_across and noise_about of a star_tracker in [[sensors]]"
    if key.removeprefix("hardware.") in device_tables.Hardware.noise_keys and isinstance(value, tuple):
        return " for all axes: the largest one, or a custom sensor in [sensors] if they differ"
    return f" [{unit}]" if has_unit else ""


def _list_depth(value_type: Any) -> int:
    """Return 0 for the type of a number, 1 for a list of numbers, and 2 for a list of rows."""
    inner = typing.get_args(value_type)
    return (typing.get_origin(value_type) is tuple) + (_list_depth(inner[0]) if inner else 0)


def _to_numbers(value: Any, unit: str = "", key: str = "") -> Any:
    """Convert lists and NumPy arrays to tuples of Python numbers, and texts with a unit to numbers in another unit."""
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, str):
        number = units.convert(*units.split(value), unit, inverse=key.endswith(INVERTIBLE))
        return value if number is None else number
    return tuple(_to_numbers(one, unit, key) for one in value) if isinstance(value, list | tuple) else value


def _flatten(value: Any) -> list[Any]:
    """Return the numbers and texts of nested tuples."""
    return [inner for one in value for inner in _flatten(one)] if isinstance(value, tuple) else [value]


def as_written(error: ScenarioError, raw: Mapping[str, Any]) -> ScenarioError:
    """Return the error of a key, with its value as the file gives it if the file gives a unit.

    >>> str(as_written(wrong("loop.period", 0.05, "at least 0.1 s"), {"loop": {"period": "50 ms"}}))
    'loop.period is "50 ms" (0.05 s), but must be at least 0.1 s'
    """
    written: Any = raw
    try:
        for name in re.findall(r"[^.\[\]]+", error.key):
            written = written[int(name) if isinstance(written, list | tuple) else name]
    except (KeyError, IndexError, TypeError, ValueError):  # the file does not have this key
        return error
    value, plain = _to_numbers(error.value), _to_numbers(written)
    for unit in units.EXAMPLES:
        if plain != value == _to_numbers(written, unit, error.key):
            shown, numbers = brief(written), _flatten(value)
            if numbers != [float(units.split(str(one))[0]) for one in _flatten(plain)]:
                shown += f" ({', '.join(f'{one:.6g}' for one in numbers)} {unit})"
            text = str(error).replace(brief(error.value), shown, 1)
            return ScenarioError(text, key=error.key, value=error.value, allowed=error.allowed)
    return error


def _find_non_finite(value: object) -> float | int | None:
    """Return the first number in nested tables and lists that is not finite, or too large for a float; else None."""
    if isinstance(value, float) and not math.isfinite(value):
        return value
    if isinstance(value, int) and value.bit_length() > MOST_BITS:
        return value
    values = value.values() if isinstance(value, Mapping) else value if isinstance(value, list | tuple) else ()
    return next((bad for bad in map(_find_non_finite, values) if bad is not None), None)
