"""The JSON Schema of scenario files, for completion and validation in editors. Start with `json_schema`."""

from collections.abc import Mapping
from typing import Any

import msgspec

from ptsmc_jax import units
from ptsmc_jax.scenario import disturbance_tables, keys, layouts, sensor_tables
from ptsmc_jax.scenario.custom import Custom
from ptsmc_jax.scenario.tables import Limit, Scenario
from ptsmc_jax.scenario.values import Kinds, NotNegative, Table
from ptsmc_jax.simulation import catalogues

Schema = dict[str, Any]


def json_schema() -> Schema:
    """Return the JSON Schema (draft 2020-12) of scenario files for a spacecraft, a chain or a system."""
    schemas = [_plant_schema(kind, scenario) for kind, scenario in layouts.SCENARIOS.items()]
    dialect = "https://json-schema.org/draft/2020-12/schema"
    return {"$schema": dialect, "title": "Scenario of ptsmc", "anyOf": schemas}


def _plant_schema(kind: str, scenario: type[Scenario]) -> Schema:
    """Return the schema of scenarios of this kind of plant; scenario: the class of its scenarios."""
    tables = {name: _kinds_schema(name, kinds, scenario.unit_of_d) for name, kinds in scenario.TABLES.items()}
    if kind == "spacecraft":
        sensor_list = {"type": "array", "items": _kinds_schema("sensors", sensor_tables.SENSORS, scenario.unit_of_d)}
        tables["sensors"] = {"anyOf": [tables["sensors"], sensor_list]}
    tables["plant"]["required"] = ["kind"]
    tables["plant"]["properties"]["kind"] = {"const": kind}
    limit = _allow_unit_text(_value_schema(NotNegative))
    limit_table = _table_schema(Limit, scenario.unit_of_d)
    limit_table["properties"]["limit"] = limit
    limit_or_table = {"anyOf": [limit, limit_table | {"required": ["limit"]}]}
    metrics = {**scenario.metrics, **catalogues.MARGINS}
    limits = {name: limit_or_table | {"description": f"{one.meaning} [{one.unit}]"} for name, one in metrics.items()}
    tables["requirements"] = _object_schema("Largest values that are allowed.", limits)
    required = [] if kind == next(iter(layouts.SCENARIOS)) else ["plant"]
    return _object_schema(f"Scenario of a {kind}.", tables) | {"required": required}


def _kinds_schema(name: str, kinds: type[Table] | Kinds, unit_of_d: str) -> Schema:
    """Return the schema of a table: one object for each kind. The key `kind` is optional for the default kind."""
    if not isinstance(kinds, Mapping):
        return _table_schema(kinds, unit_of_d, name)
    default_kind, schemas = next(iter(kinds)), []
    for kind, struct in kinds.items():
        schema = _table_schema(struct, unit_of_d, name)
        required = [] if kind == default_kind else ["kind"]
        schema["properties"] = {"kind": {"const": kind}, **schema["properties"]}
        if struct is disturbance_tables.SumDisturbance:
            schema["properties"]["terms"] |= {
                "items": _kinds_schema(name, disturbance_tables.without_sums(kinds), unit_of_d),
                "minItems": 1,
            }
            required.append("terms")
        schemas.append(schema | {"required": required} if required else schema)
    return {"anyOf": schemas}


def _table_schema(struct: type[Table], unit_of_d: str, name: str = "") -> Schema:
    """Return the schema of a table of one kind; `name`: the table's name, for inline tables."""
    properties = {}
    for key in keys.list_keys(struct, unit_of_d):
        inline = layouts.KINDS.get(f"{name}.{key.name}")
        schema = _value_schema(key.type) if inline is None else _kinds_schema("", inline, unit_of_d)
        if units.parse(key.unit) is not None:
            schema = _allow_unit_text(schema)
        if isinstance(key.default, bool | int | float | str):
            schema["default"] = key.default
        properties[key.name] = schema | {"description": key.text if inline else f"{key.text}: {key.allowed}"}
    return _object_schema(keys.description(struct), properties, allow_more=issubclass(struct, Custom))


def _object_schema(description: str, properties: Schema, *, allow_more: bool = False) -> Schema:
    """Return the schema of an object; allow_more: it may have other properties."""
    beginning = {"type": "object", "description": description}
    return {**beginning, "properties": properties, "additionalProperties": allow_more}


def _value_schema(hint: Any) -> Schema:
    """Return the schema of a value, without null for a default of None."""
    schema: Schema = msgspec.json.schema(hint)
    not_null = [value for value in schema.get("anyOf", []) if value.get("type") != "null"]
    value = {**(not_null[0] if len(not_null) == 1 else schema)}
    if "prefixItems" in value and all(item == value["prefixItems"][0] for item in value["prefixItems"]):
        value["items"] = value.pop("prefixItems")[0]
    return value


def _allow_unit_text(schema: Schema) -> Schema:
    """Return the schema of a number, or of a list or a matrix of numbers, and allow texts with a unit as numbers."""
    if "prefixItems" in schema:  # a row of a matrix
        return {**schema, "prefixItems": [*map(_allow_unit_text, schema["prefixItems"])]}
    if "items" in schema:
        return {**schema, "items": _allow_unit_text(schema["items"])}
    alternatives = [_allow_unit_text(one) if "items" in one else one for one in schema.get("anyOf", [schema])]
    return {"anyOf": [*alternatives, {"type": "string"}]}
