"""Custom parts of scenarios: `kind = "custom"` and `code = "FILE.py:NAME"`, a class whose fields are further keys.

Reading a scenario does not run the code that it names. Until `reading.complete` runs it, these keys are in `rest` and
are not validated. Start with `custom_kind` and `read`.
"""

import dataclasses
import functools
import inspect
import math
import re
import typing
from collections.abc import Iterator, Mapping
from typing import Annotated, Any, ClassVar, Literal

import msgspec
from msgspec import Meta

from ptsmc_jax.declare import Declaration, Limits
from ptsmc_jax.scenario import schema, systems
from ptsmc_jax.scenario.errors import ScenarioError, brief, show
from ptsmc_jax.scenario.values import Meaning, Table
from ptsmc_jax.simulation.gains import is_reserved

KEYS = ("system", "truth", "code")  # keys that name code, in any table
DATA = "reference.file"  # key that names a data file
CONTROLLER = "--controller"  # option that names the exported C code, unlike the key `controller.code`
DECLARED = "delta"  # field of the base class that a custom law may declare again, as a gain
Code = Annotated[Any, Meta(description=systems.WHERE), Meaning('the class, "FILE.py:NAME" or "package.module:NAME"')]


class Custom:
    """The tables of custom parts; their keys `kind`, `code` and `rest` are in `custom_kind`."""

    __slots__ = ()
    base: ClassVar[Any] = None  # required base class of the custom class
    needs: ClassVar[tuple[str, ...]] = ()  # methods: the custom class must define at least one of them
    tuned: ClassVar[bool] = False  # whether the custom class may have gains
    made: ClassVar[Any] = None  # the custom class, None until its code has run

    @property
    def waits(self) -> bool:
        """Whether the code has not run yet."""
        return self.made is None


def custom_kind(table: Any, base: type, needs: tuple[str, ...], summary: str, tuned: bool = False) -> Any:
    """Return the table of custom parts.

    Args:
        table: the table class that custom and built-in parts share.
        base: the required base class of custom classes.
        needs: methods; a custom class must define at least one of them.
        summary: description of the kind.
        tuned: whether a custom class may have gains.
    """
    return _custom_kind(table, base, needs, summary, tuned)


@functools.cache
def _custom_kind(table: Any, base: type, needs: tuple[str, ...], summary: str, tuned: bool) -> Any:
    space = {"__doc__": summary, "base": base, "needs": needs, "tuned": tuned, "__module__": __name__}
    space["remake"] = (_custom_kind, table, base, needs, summary, tuned)
    rest = ("rest", dict[str, Any], msgspec.field(default_factory=dict))
    fields = [("kind", Literal["custom"], "custom"), ("code", Code), rest]
    return msgspec.defstruct("Custom", fields, bases=(Custom, table), frozen=True, kw_only=True, namespace=space)


def named(raw: Mapping[str, Any]) -> Iterator[tuple[dict, str]]:
    """Yield each table of a parsed file that names code, nested tables included, with the key that names it."""
    for table in _tables(raw):
        for key in KEYS:
            if isinstance(table.get(key), str):
                yield table, key


def _tables(value: Any) -> Iterator[dict]:
    inside = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    if isinstance(value, dict):
        yield value
    for one in inside:
        yield from _tables(one)


def programs(scenario: Table) -> dict[str, str]:
    """Return the custom code that a scenario runs, "FILE.py:NAME", by the key that names it."""
    found = {}
    for place, table in _places(scenario):
        for key in KEYS:
            if isinstance(getattr(table, key, None), str):
                found[f"{place}.{key}"] = getattr(table, key)
    return found


def _places(scenario: Table) -> Iterator[tuple[str, Any]]:
    """Yield the tables that can name code with their place, those in a sum and in [dispersion] included."""
    for name in scenario.__struct_fields__:
        table = getattr(scenario, name)
        if hasattr(table, "placed"):
            yield from table.placed(name).items()
        elif name == "dispersion" and table is not None:
            yield "dispersion.custom", table.custom
        else:
            yield name, table


def checksum_name(key: str) -> str:
    """Return the name in `versions.json` for the checksum of the code that a key names.

    >>> checksum_name("plant.system"), checksum_name("controller.code"), checksum_name("disturbance.terms[0].code")
    ('system_sha256', 'controller_sha256', 'disturbance_terms_0_sha256')
    >>> checksum_name("--metrics"), checksum_name("--controller")  # not the name of `controller.code`
    ('metrics_sha256', 'flight_code_sha256')
    """
    if key == CONTROLLER:
        return "flight_code_sha256"
    place = key.removeprefix("plant.").removesuffix(".code").lstrip("-")
    return re.sub(r"\W+", "_", place).strip("_") + "_sha256"


def checksums(scenario: Table) -> dict[str, str]:
    """Return the current SHA-256 checksums of the files that a scenario names, by their names in `versions.json`."""
    found = {checksum_name(key): systems.checksum(where) for key, where in programs(scenario).items()}
    found |= {checksum_name(key): systems.sha256(file) for key, file in data_files(scenario).items()}
    return {name: checksum for name, checksum in found.items() if checksum is not None}


def data_tables(raw: Mapping[str, Any]) -> list[dict]:
    """Return the tables of a parsed file that name a data file."""
    table = raw.get("reference")
    return [table] if isinstance(table, dict) and isinstance(table.get("file"), str) else []


def data_files(scenario: Table) -> dict[str, str]:
    """Return the paths of the data files that a scenario names, by key."""
    file = getattr(getattr(scenario, "reference", None), "file", None)
    return {} if file is None else {DATA: file}


def waits(scenario: Table) -> bool:
    """Whether a scenario has a custom part whose code has not run yet."""
    return any(getattr(table, "waits", False) for _, table in _places(scenario))


def read(table: Any, name: str, code: object) -> Any:
    """Return the table of a custom part with the keys of its class.

    Args:
        table: the table class from `custom_kind`.
        name: name of the table in the scenario, for errors.
        code: "FILE.py:NAME" or "package.module:NAME", which is run, or the class itself.

    Raises:
        ScenarioError: there is no such class, or its fields cannot be keys.
    """
    try:
        item = systems.item(code, f"{systems.WHERE} of a class") if isinstance(code, str) else code
        base = table.base
        if not (isinstance(item, type) and issubclass(item, base)):
            what = f"a class {item.__name__}" if isinstance(item, type) else f"of type {type(item).__name__}"
            raise ValueError(f"it is {what}, but must be a class derived from ptsmc_jax.{base.__name__}")
        return _with_keys(table, item, (_remade, table.remake, name, code))
    except ValueError as error:
        shown = brief(code) if isinstance(code, str) else getattr(code, "__name__", type(code).__name__)
        raise ScenarioError(f"{name}.code is {shown}: {error}") from None


def _remade(remake: tuple, name: str, code: object) -> Any:
    make, *arguments = remake
    return read(make(*arguments), name, code)


@functools.lru_cache(maxsize=256)
def _with_keys(table: Any, found: Any, remake: tuple) -> Any:
    base = table.base
    if all(getattr(found, method, None) is getattr(base, method, None) for method in table.needs):
        raise ValueError(f"the class {found.__name__} has no method {' or '.join(table.needs)}")
    common = {field.name: field for field in dataclasses.fields(base)}
    for name in _annotated(found, base):
        known = getattr(base, name, None)
        if name in common.keys() - {DECLARED} or callable(known) or isinstance(known, property):
            raise _name_in_use(found, name, "another name")
        if hasattr(base, name):
            raise _name_in_use(found, name, f"{name} = .. without a type")
    for cls in reversed(found.__mro__):  # custom base classes have fields too
        if issubclass(cls, base) and "__dataclass_fields__" not in cls.__dict__:
            try:
                dataclasses.dataclass(frozen=True)(cls)
            except TypeError as error:  # such as a field without a default
                raise ValueError(f"the class {cls.__name__} cannot have such fields: {error}") from None
    declared = {}
    for field in dataclasses.fields(found):
        if common.get(field.name) is not None and common[field.name].default is field.default:
            continue
        if (hasattr(table, field.name) or field.name == "rest") and field.name not in common:  # the name is in use
            raise _name_in_use(found, field.name, "another name")
        if table.prefix + field.name == "observer_gain" or re.fullmatch(
            r"observer_gain_\d+", table.prefix + field.name
        ):
            raise ValueError(
                f"its field {field.name} needs another name: gain_1, gain_2 .. are the numbers of gain for each axis"
            )
        declared[field.name] = _declaration(table, found, field)
    return schema.extended(table, found, "custom", declared, remake=remake)


def _annotated(found: type, base: type) -> Iterator[str]:
    """Yield the annotated names of a custom class and its custom bases; annotations make them dataclass fields."""
    for cls in found.__mro__:
        if issubclass(cls, base) and cls is not base:
            yield from (name for name, kind in inspect.get_annotations(cls).items() if "ClassVar" not in str(kind))


def _name_in_use(found: type, name: str, allowed: str) -> ValueError:
    taken = f"the class {found.__name__} has a field {name}, a name that the base class already uses"
    return ValueError(f"{taken}; allowed is {allowed}")


def fastest(table: Any, name: str, part: Any) -> float:
    """Return the largest angular frequency that the method `fastest` of a table's class reports [rad/s].

    Args:
        table: the table.
        name: name of the table, for errors.
        part: the part, or the table itself, which has the same fields.

    Raises:
        ScenarioError: the method does not return a number of at least 0.
    """
    returned = table.made.fastest(part)
    try:
        rate = float(returned)
    except (TypeError, ValueError):
        rate = math.nan
    if not rate >= 0.0:
        other = "nothing" if returned is None else f"a {type(returned).__name__}"
        shown = brief(returned) if isinstance(returned, int | float | str) else other
        raise ScenarioError(
            f"{name}.code is the class {table.made.__name__}, whose method fastest returns {shown}, but must return an "
            "angular frequency of at least 0 rad/s"
        )
    return rate


def _declaration(table: Any, found: Any, field: dataclasses.Field) -> Declaration:
    """Return the declaration of a field of a custom class. A plain number becomes a key without a unit.

    ValueError is raised if the default is not a number, not allowed, or not possible for a gain.
    """
    value, missing = typing.cast(Any, field.default), dataclasses.MISSING
    one = field.metadata.get("declared")
    numbers = value if isinstance(value, tuple) and value and not (one and one.gain) else (value,)
    if not all(map(_plain, numbers)):
        shown = "none" if value is missing else show(value)
        allowed = "a number, the first argument of gain" if one and one.gain else "one number or several numbers"
        raise ValueError(f"the default of {field.name} is {shown}, but must be {allowed}")
    value = tuple(map(float, value)) if isinstance(value, tuple) else float(value)
    one = (one or Declaration(value, "", "", Limits()))._replace(default=value)
    one = one._replace(meaning=" ".join(one.meaning.split()) or "declared by the custom class")
    try:
        msgspec.convert(value, one.type(table.body), strict=True)
    except msgspec.ValidationError:
        words = f"a number{one.limits.words()}"
        raise ValueError(f"the default of {field.name} is {value:g}, but must be {words}") from None
    if one.gain:
        _check_gain(table, found, field.name, one)
    return one


def _plain(value: object) -> typing.TypeGuard[float]:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _check_gain(table: Any, found: Any, name: str, gain: Declaration) -> None:
    """Raise ValueError if a field that is a gain cannot be one of such a table, or has no sensible bounds."""
    if not table.tuned:
        raise ValueError(
            f"its field {name} is a gain, but the tuner cannot change parts of this kind; allowed is a number"
        )
    if not table.prefix and is_reserved(name):
        raise ValueError(f"its gain {name} needs another name: a gain of a built-in part has this name")
    usual: Any = gain.usual
    if usual is None:
        raise ValueError(
            f"the gain {name} of the class {found.__name__} has no bounds; allowed is ptsmc_jax.gain(.., "
            "usual=(lower, upper))"
        )
    plain = isinstance(usual, tuple | list) and len(usual) == 2 and all(map(_plain, usual)) and usual[0] < usual[1]
    if plain and not usual[0] <= gain.default <= usual[1]:
        raise ValueError(
            f"the default of the gain {name} is {gain.default:g}, but must be a number from {usual[0]:g} to "
            f"{usual[1]:g}, its usual bounds"
        )
