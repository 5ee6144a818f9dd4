"""What a scenario's tables and keys mean, read from the docstrings, types and defaults of their structs."""

import ast
import contextlib
import inspect
import re
import sys
import textwrap
import types
import typing
from collections.abc import Mapping
from typing import Any, Literal, NamedTuple

import msgspec

from ptsmc_jax.scenario.values import Kinds, Table

UNIT_OF_D = "unit of d"  # in docstrings: the unit of the plant's disturbance


class Key(NamedTuple):
    """One key of a table."""

    name: str
    meaning: str
    unit: str  # empty where it has none
    allowed: str  # in words
    default: Any  # None: off, or said in `meaning`; NODEFAULT: needed

    @property
    def text(self) -> str:
        """Its meaning with its unit."""
        return self.meaning + (f" [{self.unit}]" if self.unit else "")


def of(struct: type[Table], unit_of_d: str = UNIT_OF_D) -> list[Key]:
    """Return the keys of a table, without `kind`, in the order of the struct; a base's docstring counts too.

    The keys of a custom kind are those that every such table has. The keys of its class, in `rest`, are not known here.

    Args:
        struct: the table.
        unit_of_d: the unit of the plant's disturbance, for the keys whose docstring has [unit of d].
    """
    meanings: dict[str, str] = {}
    for base in reversed(struct.__mro__):
        meanings |= _attributes(_docstring(base))
    hints = typing.get_type_hints(struct, include_extras=True)
    keys = []
    declared = getattr(struct, "declared", {})
    for field in msgspec.structs.fields(struct):
        if field.name in declared:
            one, body = declared[field.name], struct.body  # pyright: ignore[reportAttributeAccessIssue]
            unit = one.unit if isinstance(one.unit, str) else one.unit[not body]
            unit = unit.replace(UNIT_OF_D, "N m" if body else unit_of_d)
            keys.append(Key(field.name, one.meaning, unit, allowed(hints[field.name]), field.default))
        elif field.name not in ("kind", "rest"):
            parts = re.fullmatch(r"(.*?)(?: \[([^][]*)\])?", meanings[field.name])
            assert parts is not None
            meaning, unit = parts.groups()
            factory = field.default_factory
            default = field.default if factory is msgspec.NODEFAULT else factory()
            unit = (unit or "").replace(UNIT_OF_D, unit_of_d)
            keys.append(Key(field.name, meaning, unit, allowed(hints[field.name]), default))
    return keys


def about(struct: type[Table]) -> str:
    """What a table, or a kind of it, is: its docstring without the keys."""
    return " ".join(inspect.cleandoc(_docstring(struct)).split("\n\nAttributes:")[0].split())


def kinds_with(name: str, key: str, struct: type[Table], kinds: Kinds) -> str:
    """Which kind a table is of, and of which others a key is that it has not; empty where it is of none."""
    others = [f'"{kind}"' for kind, other in kinds.items() if key in other.__struct_fields__]
    own = next((kind for kind, other in kinds.items() if other is struct), None)
    return f' of {name}.kind = "{own}", but of {", ".join(others)}' if others else ""


def homes(layout: Mapping[str, type[Table] | Kinds]) -> dict[str, list[str]]:
    """The tables of a scenario in which each key stands, in order, but for "kind"."""
    found: dict[str, list[str]] = {}
    for name, table in layout.items():
        for struct in table.values() if isinstance(table, Mapping) else [table]:
            for key in struct.__struct_fields__:
                if key != "kind" and name not in found.setdefault(key, []):
                    found[key].append(name)
    return found


def elsewhere(name: str, key: str, layout: Mapping[str, type[Table] | Kinds]) -> str:
    """Where a key stands that the table of this name has not, as in "loop.period is"; empty: nowhere, or there too."""
    known = homes(layout).get(key, [])
    if name in known or not known:
        return ""
    return f"{', '.join(f'{home}.{key}' for home in known)} {'are' if known[1:] else 'is'}"


def allowed(kind: Any) -> str:
    """What a type allows, in words."""
    if typing.get_origin(kind) in (types.UnionType, typing.Union):
        return " or ".join(dict.fromkeys(allowed(k) for k in typing.get_args(kind) if k is not type(None)))
    if isinstance(kind, type) and issubclass(kind, Table):
        return "an inline table"
    if typing.get_origin(kind) is Literal:
        return " or ".join(f'"{v}"' for v in typing.get_args(kind))
    return next((m.description for m in getattr(kind, "__metadata__", ()) if m.description), "of another type")


def _docstring(struct: type) -> str:
    """The docstring of a class itself; python -OO leaves it out of what is run, not out of its source."""
    text = struct.__dict__.get("__doc__")
    if text is None and sys.flags.optimize > 1:
        with contextlib.suppress(OSError, TypeError):  # without a source
            (node,) = ast.parse(textwrap.dedent(inspect.getsource(struct))).body
            text = ast.get_docstring(typing.cast(ast.ClassDef, node))
    return text or ""


def _attributes(docstring: str) -> dict[str, str]:
    """Name -> text of the section `Attributes` of a docstring in Google's style."""
    _, _, section = inspect.cleandoc(docstring).partition("\nAttributes:\n")
    return {name: " ".join(text.split()) for name, text in re.findall(r"^    (\w+): (.*(?:\n {8}.*)*)", section, re.M)}
