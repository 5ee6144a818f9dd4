"""Parse and write scenario files. Start with `parse` and `dump`.

This module validates single tables and keys. `checks` validates constraints between keys.
"""

import difflib
import math
import os
import re
import tomllib
import typing
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

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
from ptsmc_jax.scenario.errors import MOST_BITS, ScenarioError, brief, show, wrong
from ptsmc_jax.scenario.layouts import SCENARIOS, TABLES
from ptsmc_jax.scenario.tables import Limit, Scenario
from ptsmc_jax.scenario.values import Kinds, NotNegative, Positive, Table
from ptsmc_jax.simulation import catalogues

DEEPEST = 8  # nesting of tables and arrays; a rotation matrix of a disturbance in a sum has depth 6
LONGEST_KEY = 100  # largest number of characters of a key
_TOO_DEEP = f"but at most {DEEPEST} levels are allowed"
# a very long dotted key: the memory that the parser needs for it grows with the square of its length
_LONG_DOTTED_KEY = re.compile(r"""(?<![\w-])(?:(?:[\w-]+|"[^"\n]*"|'[^'\n]*')[ \t]*\.[ \t]*){20}""")


class Context(NamedTuple):
    """Properties of the whole scenario that the parser of a table needs."""

    scenario_class: type[Scenario]  # one of `layouts.SCENARIOS`
    run_code: bool = False  # whether code that the scenario names may run


def parse_toml(text: str, name: str) -> dict[str, Any]:
    """Return the raw tables of a TOML text; raise ScenarioError if it is not valid. `name` is used in errors."""
    try:
        if _LONG_DOTTED_KEY.search(text):
            raise RecursionError
        return tomllib.loads(text)
    except ValueError as error:  # TOMLDecodeError, or a number with too many digits for Python
        raise ScenarioError(f"{name} is no valid TOML: {error}") from None
    except RecursionError:
        raise ScenarioError(f"{name} has tables or arrays in each other, {_TOO_DEEP}") from None


def load(path: str | Path) -> dict[str, Any]:
    """Return the raw tables of a TOML file; raise ScenarioError if it is missing or not valid.

    Relative paths of Python files in it become absolute, relative to the folder of the TOML file. No code is run.
    """
    try:
        text = Path(path).read_text(encoding="utf-8-sig")  # some editors begin a file with a byte order mark
    except FileNotFoundError:
        raise ScenarioError(f"the scenario file {path} does not exist") from None
    except IsADirectoryError:
        raise ScenarioError(f"the scenario file {path} is a folder, but must be a TOML file") from None
    except UnicodeDecodeError:
        raise ScenarioError(f"the scenario file {path} is no text in UTF-8, but must be a TOML file") from None
    except OSError as error:
        raise ScenarioError(f"the scenario file {path} cannot be read: {error.strerror}") from None
    raw = parse_toml(text, f"the scenario file {path}")
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
    _check_shape(raw)
    suite = raw.get("sensors")
    if isinstance(suite, list | tuple):
        raw = {name: table for name, table in raw.items() if name != "sensors"}
    known_names = {"requirements", *(key for layout in TABLES.values() for key in layout)}
    for name, table in raw.items():
        if name in known_names and not isinstance(table, Mapping):
            raise wrong(name, table, "a table")
    kind = _plant_kind(raw.get("plant", {}))
    scenario_class, layout = SCENARIOS[kind], TABLES[kind]
    for name, table in raw.items():
        if name not in layout and name != "requirements":
            raise _unknown_table_error(name, table, kind)
    context = Context(scenario_class, run_code)
    plant = typing.cast(Any, _parse_table("plant", raw.get("plant", {}), layout["plant"], context))
    law_kind = raw.get("controller", {}).get("kind", next(iter(typing.cast(Kinds, layout["controller"]))))
    defaults = scenario_class.plant_defaults(plant, raw.get("plant", {}).keys(), law_kind)
    tables: dict[str, Any] = {
        name: _parse_table(name, _fill_absent_keys(raw.get(name, {}), defaults.get(name, {}), kinds), kinds, context)
        for name, kinds in layout.items()
        if name in raw or name not in layouts.OPTIONAL
    }
    for name in ("initial", "reference"):
        if isinstance(tables.get(name), Attitude):
            attitude_keys.check_single_attitude(name, tables[name])
    if isinstance(suite, list | tuple):
        tables["sensors"] = _parse_sensor_suite(suite, context)
    # plain limits first, as TOML writes them, so that the order of verdicts is the same for a scenario that was saved
    requirements = sorted(raw.get("requirements", {}).items(), key=lambda one: isinstance(one[1], Mapping))
    tables["requirements"] = {key: _parse_requirement(key, value, context) for key, value in requirements}
    return scenario_class(**tables)


def _check_shape(raw: Mapping[str, Any]) -> None:
    """Raise ScenarioError for too deep nesting and for keys that cannot be printed, before other code visits them."""
    level: list[tuple[str, Any]] = [("", raw)]
    for _ in range(DEEPEST):
        next_level: list[tuple[str, Any]] = []
        for table, value in level:
            if isinstance(value, Mapping):
                for key, inner in value.items():
                    if not (isinstance(key, str) and key.isprintable() and 0 < len(key) <= LONGEST_KEY):
                        key_text = brief(key) if isinstance(key, str) else repr(key)
                        holder = table or "the scenario"
                        raise ScenarioError(f"{holder} has the key {key_text}, which is not a known one")
                    next_level.append((table or key, inner))
            elif isinstance(value, list | tuple):
                next_level += [(table, inner) for inner in value]
        level = [(table, value) for table, value in next_level if isinstance(value, Mapping | list | tuple)]
    if level:
        raise ScenarioError(f"{level[0][0]} has tables or arrays in each other, {_TOO_DEEP}")


def _plant_kind(plant: Mapping[str, Any]) -> str:
    kind = plant.get("kind", "spacecraft")
    if not isinstance(kind, str) or kind not in TABLES:
        raise wrong("plant.kind", kind, " or ".join(map(show, TABLES)))
    return kind


def _unknown_table_error(name: str, value: Any, kind: str) -> ScenarioError:
    """Return the error for an unknown table, or for a key outside a table; kind: kind of the plant."""
    layout = TABLES[kind]
    other_plants = [other for other, other_layout in TABLES.items() if name in other_layout]
    if other_plants:
        return ScenarioError(f"[{name}] needs plant.kind = {show(other_plants[0])}, but it is {show(kind)}")
    if isinstance(value, Mapping):
        plant_hint = f"such a plant is [plant] with kind = {show(name)}"
        hint = plant_hint if name in TABLES else nearest_name_hint(name, (*layout, "requirements"), "[{}]")
        return ScenarioError(f"[{name}] is not a known table; {hint}")
    tables_of_key = keys.table_names_by_key(layout)
    closest = difflib.get_close_matches(name, tables_of_key, n=1, cutoff=0.0)[0]
    place = f"{tables_of_key[closest][-1]}.{closest}"
    return ScenarioError(f"{name} = {brief(value)} is outside of any table; the nearest known key is {place}")


def _fill_absent_keys(
    raw: Mapping[str, Any], defaults: Mapping[str, Any], struct_or_kinds: type[Table] | Kinds
) -> Mapping[str, Any]:
    """Return a table with absent keys filled in. An attitude that is given replaces the default attitude."""
    if isinstance(struct_or_kinds, Mapping):
        kind = raw.get("kind", next(iter(struct_or_kinds)))
        struct = struct_or_kinds.get(kind) if isinstance(kind, str) else None  # `_parse_table` refuses other types
    else:
        struct = struct_or_kinds
    has_attitude = struct is not None and issubclass(struct, Attitude)
    if any(key in raw for key in ATTITUDE_KEYS) or not has_attitude:
        defaults = {key: value for key, value in defaults.items() if key not in ATTITUDE_KEYS}
    return {**defaults, **raw}


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


def unstated_values(raw: Mapping[str, Any], tables: Mapping[str, Any]) -> dict[tuple[str, ...], Any]:
    """Return the values of keys in `tables` that `raw` does not have, by the path of the key."""
    missing: dict[tuple[str, ...], Any] = {}
    for key, value in tables.items():
        if isinstance(value, Mapping):
            raw_inner = raw.get(key, {})
            inner_values = unstated_values(raw_inner if isinstance(raw_inner, Mapping) else {}, value)
            missing |= {(key, *path): one for path, one in inner_values.items()}
        elif key not in raw:
            missing[(key,)] = value
    return missing


def to_dict(table: Table) -> dict[str, Any]:
    """Return a table as a scenario file would write it; keys that are None are omitted."""
    return typing.cast(dict, _without_none(table))


def _without_none(value: Any) -> Any:
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
    """Return a hint for an unknown name: the most similar known name, or all known names.

    Args:
        name: the unknown name.
        known: the known names.
        template: format of a known name in the hint.
    """
    known = list(known)
    matches = difflib.get_close_matches(name, known, n=1)
    if matches:
        return f"the nearest known one is {template.format(matches[0])}"
    return f"known are {', '.join(template.format(one) for one in known)}"


def similar_names_hint(name: str, known: Iterable[str], where_listed: str) -> str:
    """Return a hint for an unknown name if there are too many known names to list.

    Args:
        name: the unknown name.
        known: the known names.
        where_listed: where to find all names, in words.

    Returns:
        The three most similar names, followed by `where_listed`.
    """
    known = list(known)
    matches = difflib.get_close_matches(name, known, n=3, cutoff=0.0)
    return f"the nearest of {len(known)} known ones are {', '.join(matches)}; {where_listed}"


def _parse_table(name: str, raw: Mapping[str, Any], kinds: type[Table] | Kinds, context: Context) -> Table:
    if name == "dispersion":
        return _parse_dispersion(raw, typing.cast(type[Table], kinds), context)
    if not isinstance(kinds, Mapping):
        return _parse_fields(name, raw, kinds, context)
    kind = raw.get("kind", next(iter(kinds)))
    if not isinstance(kind, str) or kind not in kinds:
        known = list(map(show, kinds))
        raise wrong(f"{name}.kind", kind, " or ".join(known) if len(known) < 8 else f"one of {', '.join(known)}")
    struct = kinds[kind]
    if struct is disturbance_tables.SumDisturbance:
        return _parse_sum(name, raw, kinds, context)
    if issubclass(struct, custom.Custom):
        return _parse_custom_part(name, raw, struct, context)
    return _parse_fields(name, raw, struct, context, kinds)


def _parse_custom_part(name: str, raw: Mapping[str, Any], struct: Any, context: Context) -> Table:
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


def _parse_sum(name: str, raw: Mapping[str, Any], kinds: Kinds, context: Context) -> Table:
    """Return the table of a sum of disturbances, whose `terms` are tables of the other kinds."""
    others = {key: value for key, value in raw.items() if key != "terms"}
    _parse_fields(name, others, disturbance_tables.SumDisturbance, context)
    terms = raw.get("terms", ())
    if not isinstance(terms, list | tuple) or not terms or not all(isinstance(term, Mapping) for term in terms):
        raise wrong(f"{name}.terms", terms, disturbance_tables.TERMS_TEXT)
    single_kinds = disturbance_tables.without_sums(kinds)
    parsed_terms = tuple(
        _parse_table(f"{name}.terms[{k}]", term, single_kinds, context) for k, term in enumerate(terms)
    )
    return disturbance_tables.SumDisturbance(terms=parsed_terms)


def _parse_sensor_suite(raw_sensors: Any, context: Context) -> Table:
    """Return the table of [[sensors]]."""
    if context.scenario_class.motion != "spacecraft":
        raise ScenarioError('[[sensors]] needs plant.kind = "spacecraft"; allowed is [sensors] with kind = "custom"')
    if not raw_sensors or not all(isinstance(one, Mapping) for one in raw_sensors):
        raise wrong("sensors", raw_sensors, "tables with a kind, [[sensors]] for each sensor")
    return sensor_tables.SensorSuite(
        each=tuple(
            _parse_table(f"sensors[{k}]", one, sensor_tables.SENSORS, context) for k, one in enumerate(raw_sensors)
        )
    )


def _parse_dispersion(raw: Mapping[str, Any], struct: type[Table], context: Context) -> Table:
    """Return the table [dispersion], whose keys are inline tables with a kind."""
    tables = {}
    for key, table in raw.items():
        _check_key("dispersion", key, struct, context)
        if not isinstance(table, Mapping):
            raise wrong(f"dispersion.{key}", table, 'an inline table such as { kind = "uniform" }')
        tables[key] = _parse_table(f"dispersion.{key}", table, layouts.DISPERSIONS[key], context)
    return struct(**tables)


def _parse_requirement(metric: str, value: Any, context: Context) -> float | Limit:
    key, metrics = f"requirements.{metric}", context.scenario_class.metrics
    if metric not in metrics and metric not in catalogues.MARGINS:
        raise ScenarioError(
            f"{key} is not a known metric; {nearest_name_hint(metric, (*metrics, *catalogues.MARGINS))}"
        )
    if isinstance(value, Mapping):
        if metric in catalogues.MARGINS:
            raise wrong(key, value, "a number greater than 0, which every loop must keep")
        if "limit" not in value:
            raise wrong(key, value, "a number greater than 0 or a table with `limit`")
        value = {**value, "limit": _parse_limit(f"{key}.limit", value["limit"], metric, metrics)}
        return typing.cast(Limit, _parse_fields(key, value, Limit, context))
    return _parse_limit(key, value, metric, metrics)


def _parse_limit(key: str, value: Any, metric: str, metrics: Mapping[str, Any]) -> float:
    """Return a limit in the metric's unit; the value is a number or a text such as "0.05 deg"."""
    allowed = NotNegative if metric in catalogues.MAY_BE_ZERO else Positive
    if isinstance(value, str):
        value = _convert_text(key, value, {**metrics, **catalogues.MARGINS}[metric].unit, keys.allowed_values(allowed))
    return _parse_value(key, value, allowed)


def _convert_text(key: str, text: str, unit: str, allowed: str) -> float:
    """Convert a text such as "0.05 deg" to a number in a unit; raise ScenarioError if it is not possible."""
    units = catalogues.UNITS.get(unit, {})
    size, name = _split_unit(text)
    if name not in units or not math.isfinite(size):
        example = f', or with a unit such as "0.05 {[*units][:2][-1]}", in {", ".join(units)}' if units else ""
        raise wrong(key, text, allowed + (f" [{unit}]" if unit != "-" else "") + example)
    return size * units[name]


def _split_unit(text: str) -> tuple[float, str]:
    """Return the number of a text such as "0.05 deg", NaN if there is none, and the name of its unit."""
    match = re.fullmatch(r"([-+]?[\d.]+(?:[eE][-+]?\d+)?) ?(.*)", " ".join(text.split()))
    number, name = match.groups() if match else ("", "")
    try:
        return float(number), name
    except ValueError:
        return math.nan, name


def quote_as_written(error: ScenarioError, raw: Mapping[str, Any]) -> ScenarioError:
    """Return an error that quotes its value as the raw tables write it, such as "8 arcsec", and in SI units."""
    written = _raw_value(raw, error.key)
    is_list = isinstance(written, list | tuple)
    if not any(map(_si_unit, written if is_list else [written])):
        return error
    number = list(map(_convert_to_si, written)) if is_list else _convert_to_si(written)
    if number != (list(error.value) if isinstance(error.value, tuple) else error.value):
        return error
    unit = _si_unit(written)
    si_text = f" ({number:.6g} {unit})" if unit and number != _split_unit(written)[0] else ""
    return error.with_shown_value(f"{brief(written)}{si_text}")


def _raw_value(raw: Any, key: str) -> Any:
    """Return the value of a key such as disturbance.terms[0].amplitude in raw tables; None if they do not have it."""
    for part in re.findall(r"[^][.]+", key):
        if isinstance(raw, list | tuple):
            raw = raw[int(part)] if part.isdecimal() and int(part) < len(raw) else None
        else:
            raw = raw.get(part) if isinstance(raw, Mapping) else None
    return raw


def _convert_to_si(value: Any) -> Any:
    """Return a text such as "8 arcsec" as a number in SI units, and any other value unchanged."""
    unit = _si_unit(value)
    if not unit:
        return value
    size, name = _split_unit(value)
    return size * catalogues.UNITS[unit][name]


def _si_unit(value: Any) -> str:
    """Return the SI unit of a text such as "8 arcsec", here rad; empty if the value is not such a text."""
    name = _split_unit(value)[1] if isinstance(value, str) else ""
    return next((unit for unit, names in catalogues.UNITS.items() if name in names), "")


def _convert_value(name: str, value: Any, struct: type[Table], value_type: Any, context: Context) -> Any:
    """Convert the value of a key from text with a unit, such as "1 mN m", to a number or a list of numbers.

    Other values are returned unchanged.
    """
    is_list = isinstance(value, list | tuple)
    has_text = isinstance(value, str) or (is_list and any(isinstance(one, str) for one in value))
    if not has_text or name in layouts.KINDS or _is_valid(value, value_type):
        return value
    key = name.rpartition(".")[2]
    unit = next((one.unit for one in keys.list_keys(struct, context.scenario_class.unit_of_d) if one.name == key), "")
    if unit not in catalogues.UNITS:
        return value

    def convert(one: Any) -> Any:
        return _convert_text(name, one, unit, keys.allowed_values(value_type)) if isinstance(one, str) else one

    return [convert(one) for one in value] if is_list else convert(value)


def _is_valid(value: Any, value_type: Any) -> bool:
    try:
        msgspec.convert(value, value_type, strict=True)
    except msgspec.ValidationError:
        return False
    return True


def _parse_fields(
    name: str, raw: Mapping[str, Any], struct: type[Table], context: Context, kinds: Kinds | None = None
) -> Table:
    hints = typing.get_type_hints(struct, include_extras=True)
    for key in raw:
        _check_key(name, key, struct, context, kinds)
    values = {key: _convert_value(f"{name}.{key}", value, struct, hints[key], context) for key, value in raw.items()}
    return struct(**{key: _parse_key(f"{name}.{key}", value, hints[key], context) for key, value in values.items()})


def _check_key(name: str, key: str, struct: type[Table], context: Context, kinds: Kinds | None = None) -> None:
    """Raise ScenarioError if the table of this name, of one of these kinds, has no such key."""
    if key not in (known_keys := struct.__struct_fields__):
        other_kinds = keys.hint_other_kinds(name, key, struct, kinds or {})
        hint = keys.hint_other_tables(name, key, context.scenario_class.TABLES)
        hint = hint or nearest_name_hint(key, known_keys, f"{name}.{{}}")
        raise ScenarioError(f"{name}.{key} is not a known key{other_kinds}; {hint}")


def _parse_key(key: str, value: Any, value_type: Any, context: Context) -> Any:
    """Return the value of a key, or its inline table with a kind."""
    kinds = layouts.KINDS.get(key)
    if kinds is None:
        return _parse_value(key, value, value_type)
    if isinstance(value, Table):
        return value
    if not isinstance(value, Mapping):
        raise wrong(key, value, f"an inline table such as {{ kind = {show(next(iter(kinds)))} }}")
    return _parse_table(key, value, kinds, context)


def _parse_value(key: str, value: Any, value_type: Any) -> Any:
    try:
        value = _to_tuples(value)
    except TypeError:  # raised by JAX for a traced value
        raise ScenarioError(f"{key} is traced by JAX, but must be known here; with_gains takes traced gains") from None
    bad = _find_non_finite(value)
    if bad is not None:
        raise wrong(key, value, f"{keys.allowed_values(value_type)}, and {show(bad)} is no finite number")
    # numpy, which reads the inertia, converts true to 1
    if _has_bool(value) and keys.without_annotations(value_type) is not bool:
        raise wrong(key, value, keys.allowed_values(value_type))
    try:
        return msgspec.convert(value, value_type, strict=True)
    except msgspec.ValidationError:
        raise wrong(key, value, keys.allowed_values(value_type) + _per_axis_hint(key, value)) from None


def _per_axis_hint(key: str, value: Any) -> str:
    """Return a hint if the value is one noise per axis. [hardware] allows one number for all axes."""
    table, _, name = key.partition(".")
    if table != "hardware" or name not in device_tables.Hardware.noise_keys or not isinstance(value, tuple):
        return ""
    return " for all axes: the largest one, or a custom sensor in [sensors] if they differ"


def _to_tuples(value: Any) -> Any:
    """Convert lists and NumPy arrays to tuples of Python numbers."""
    if hasattr(value, "tolist"):
        value = value.tolist()
    return tuple(map(_to_tuples, value)) if isinstance(value, list | tuple) else value


def _has_bool(value: Any) -> bool:
    return isinstance(value, bool) or (isinstance(value, tuple) and any(map(_has_bool, value)))


def _find_non_finite(value: Any) -> float | int | None:
    if isinstance(value, float) and not math.isfinite(value):
        return value
    if isinstance(value, int) and value.bit_length() > MOST_BITS:
        return value
    values = value.values() if isinstance(value, Mapping) else value if isinstance(value, list | tuple) else ()
    return next((bad for bad in map(_find_non_finite, values) if bad is not None), None)
