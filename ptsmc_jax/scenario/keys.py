"""Meanings, units, allowed values and defaults of the keys of scenario files. Start with `list_keys`.

They come from the declarations, types and defaults of the table classes. Error messages, the JSON Schema and the
reference page of scenarios are made from them.
"""

import functools
import types
import typing
from collections.abc import Mapping
from typing import Any, Literal, NamedTuple

import msgspec

from ptsmc_jax.scenario.values import UNIT_OF_D as UNIT_OF_D
from ptsmc_jax.scenario.values import Kinds, Meaning, Table


class Key(NamedTuple):
    """One key of a table."""

    name: str
    meaning: str
    unit: str  # empty if it has none
    allowed: str  # allowed values, in words
    default: Any  # None: off, or described in `meaning`; NODEFAULT: required
    type: Any  # the type that `msgspec` checks

    @property
    def text(self) -> str:
        """The meaning with the unit in brackets."""
        return self.meaning + (f" [{self.unit}]" if self.unit else "")


@functools.lru_cache(maxsize=512)  # every parsed table needs it; custom classes have tables of their own
def list_keys(struct: type[Table], unit_of_d: str = UNIT_OF_D) -> tuple[Key, ...]:
    """Return the keys of a table, without `kind`, in the order of the struct.

    For a custom kind, only the keys that all custom parts share are known here. The keys of its class are in `rest`.

    Args:
        struct: the table.
        unit_of_d: the unit of the plant's disturbance, for units that contain it.
    """
    hints, keys = typing.get_type_hints(struct, include_extras=True), []
    for field in msgspec.structs.fields(struct):
        if field.name in ("kind", "rest"):
            continue
        default = field.default if field.default_factory is msgspec.NODEFAULT else field.default_factory()
        type_ = hints[field.name]
        meaning, unit = next(one for one in type_.__metadata__ if isinstance(one, Meaning))
        unit = unit.replace(UNIT_OF_D, unit_of_d)
        unit = unit.replace("unit of u", "N m") if unit_of_d == "N m" else unit
        keys.append(Key(field.name, meaning, unit, allowed_values(type_), default, type_))
    return tuple(keys)


def description(struct: type[Table]) -> str:
    """Return the description of a table or of one of its kinds: its docstring, which python -OO removes."""
    return " ".join((struct.__doc__ or "").split())


def table_names_by_key(layout: Mapping[str, type[Table] | Kinds]) -> dict[str, list[str]]:
    """Return the names of the tables that have a key, for each key except "kind"."""
    names: dict[str, list[str]] = {}
    for name, table in layout.items():
        for struct in table.values() if isinstance(table, Mapping) else [table]:
            for key in struct.__struct_fields__:
                if key != "kind" and name not in names.setdefault(key, []):
                    names[key].append(name)
    return names


def allowed_values(kind: Any) -> str:
    """Return the values that a type allows, in words."""
    meta = next((one for one in getattr(kind, "__metadata__", ()) if isinstance(one, msgspec.Meta)), None)
    if meta is not None and meta.description is not None:
        return meta.description
    kind = kind.__origin__ if hasattr(kind, "__metadata__") else kind
    if typing.get_origin(kind) in (types.UnionType, typing.Union):
        return " or ".join(dict.fromkeys(allowed_values(k) for k in typing.get_args(kind) if k is not type(None)))
    if isinstance(kind, type) and issubclass(kind, Table):
        return "an inline table"
    if typing.get_origin(kind) is Literal:
        return " or ".join(f'"{v}"' for v in typing.get_args(kind))
    return "of another type"
