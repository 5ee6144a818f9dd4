"""The JSON Schema of scenario files, for completion and validation in editors. Start with `json_schema`."""

import typing
from collections.abc import Mapping
from typing import Any

import msgspec

from ptsmc_jax.scenario import disturbance_tables, keys, layouts, sensor_tables
from ptsmc_jax.scenario.custom import Custom
from ptsmc_jax.scenario.tables import Limit, Scenario
from ptsmc_jax.scenario.values import Kinds, NotNegative, Table
from ptsmc_jax.simulation import catalogues

Schema = dict[str, Any]


def json_schema() -> Schema:
    """Return the JSON Schema (draft 2020-12) of scenario files for a spacecraft, a chain or a system."""
    plants = [_plant(kind, made) for kind, made in layouts.SCENARIOS.items()]
    dialect = "https://json-schema.org/draft/2020-12/schema"
    return {"$schema": dialect, "title": "Scenario of ptsmc", "anyOf": plants}


def _plant(kind: str, made: type[Scenario]) -> Schema:
    tables = {name: _kinds(name, kinds, made.unit_of_d) for name, kinds in made.TABLES.items()}
    if kind == "spacecraft":
        each = {"type": "array", "items": _kinds("sensors", sensor_tables.SENSORS, made.unit_of_d)}
        tables["sensors"] = {"anyOf": [tables["sensors"], each]}
    tables["plant"]["required"] = ["kind"]
    tables["plant"]["properties"]["kind"] = {"const": kind}
    limit = _with_unit(_leaf(NotNegative), {})
    full = _struct(Limit, made.unit_of_d)
    full["properties"]["limit"] = limit
    limits = {"anyOf": [limit, full | {"required": ["limit"]}]}
    metrics = {**made.metrics, **catalogues.MARGINS}
    named = {name: limits | {"description": f"{one.meaning} [{one.unit}]"} for name, one in metrics.items()}
    tables["requirements"] = _object("Largest values that are allowed.", named)
    required = [] if kind == next(iter(layouts.SCENARIOS)) else ["plant"]
    return _object(f"Scenario of a {kind}.", tables) | {"required": required}


def _kinds(name: str, kinds: type[Table] | Kinds, unit_of_d: str) -> Schema:
    """Return the schema of a table: one object for each kind. The key `kind` is optional for the default kind."""
    if not isinstance(kinds, Mapping):
        return _struct(kinds, unit_of_d, name)
    first, found = next(iter(kinds)), []
    for kind, struct in kinds.items():
        one = _struct(struct, unit_of_d, name)
        required = [] if kind == first else ["kind"]
        one["properties"] = {"kind": {"const": kind}, **one["properties"]}
        if struct is disturbance_tables.SumDisturbance:
            one["properties"]["terms"] |= {
                "items": _kinds(name, disturbance_tables.single(kinds), unit_of_d),
                "minItems": 1,
            }
            required.append("terms")
        found.append(one | {"required": required} if required else one)
    return {"anyOf": found}


def _struct(struct: type[Table], unit_of_d: str, name: str = "") -> Schema:
    """Return the schema of a table of one kind; name: of the table, for its inline tables."""
    hints, properties = typing.get_type_hints(struct, include_extras=True), {}
    for key in keys.list_keys(struct, unit_of_d):
        inline = layouts.DISPERSIONS.get(key.name) if name == "dispersion" else layouts.KINDS.get(f"{name}.{key.name}")
        one = _leaf(hints[key.name]) if inline is None else _kinds("", inline, unit_of_d)
        if key.unit in catalogues.UNITS:
            one = _with_unit(one, one.pop("items", {}))
        if isinstance(key.default, bool | int | float | str):
            one["default"] = key.default
        properties[key.name] = one | {"description": key.text if inline else f"{key.text}: {key.allowed}"}
    return _object(keys.about(struct), properties, more=issubclass(struct, Custom))


def _object(description: str, properties: Schema, *, more: bool = False) -> Schema:
    head = {"type": "object", "description": description}
    return {**head, "properties": properties, "additionalProperties": more}


def _leaf(hint: Any) -> Schema:
    """Return the schema of a value, without null for a default of None."""
    found: Schema = msgspec.json.schema(hint)
    some = [one for one in found.get("anyOf", []) if one.get("type") != "null"]
    one = {**(some[0] if len(some) == 1 else found)}
    if "prefixItems" in one and all(other == one["prefixItems"][0] for other in one["prefixItems"]):
        one["items"] = one.pop("prefixItems")[0]
    return one


def _with_unit(number: Schema, items: Schema) -> Schema:
    """Return the schema of a number, or of a list of numbers, and allow texts with a unit as numbers."""
    if items:
        return {**number, "items": {"anyOf": [items, {"type": "string"}]}}
    return {"anyOf": [number, {"type": "string"}]}
