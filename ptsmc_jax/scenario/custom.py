"""Custom parts of scenarios: `kind = "custom"` and `code = "FILE.py:NAME"`, a class whose fields are further keys.

Reading a scenario does not run the code that it names. Until `reading.complete` runs it, these keys are in `rest` and
are not validated. Start with `custom_kind` and `load_table`.
"""

import dataclasses
import functools
import math
import re
import typing
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import msgspec
from msgspec import Meta

from ptsmc_jax.declare import Declaration, Limits
from ptsmc_jax.devices import custom_sensors
from ptsmc_jax.dispersions.base import Draw
from ptsmc_jax.numerics.draws import DISTRIBUTIONS
from ptsmc_jax.numerics.pytrees import vector
from ptsmc_jax.scenario import schema, systems
from ptsmc_jax.scenario.errors import ScenarioError, brief, show
from ptsmc_jax.scenario.values import Kinds, Meaning, Table
from ptsmc_jax.simulation.gains import is_reserved

if TYPE_CHECKING:
    from ptsmc_jax.plants.base import Plant

CODE_KEYS = ("system", "truth", "code")  # keys that name code, in any table
DATA_FILE_KEY = "reference.file"  # key that names a data file
CONTROLLER_OPTION = "--controller"  # option that names the exported C code, unlike the key `controller.code`
REDECLARABLE_FIELD = "delta"  # field of the base class that a custom law may declare again, as a gain
# entries of `gain_bounds.BOUNDS` that do not need other fields of a built-in part
SHARED_BOUNDS = ("delta", "eta", "k1", "sign_width", "surface_rate", "dead_beat")
Code = Annotated[Any, Meta(description=systems.NAME_FORMS), Meaning("the class")]


class Custom:
    """Base class of the tables of custom parts. `custom_kind` adds the keys `kind`, `code` and `rest`."""

    __slots__ = ()
    base: ClassVar[Any] = None  # required base class of the custom class
    required_methods: ClassVar[tuple[str, ...]] = ()  # methods: the custom class must define at least one of them
    has_gains: ClassVar[bool] = False  # whether the custom class may have gains
    part_class: ClassVar[Any] = None  # the custom class, None until its code has run

    @property
    def is_unloaded(self) -> bool:
        """Whether the code has not run yet."""
        return self.part_class is None


@functools.cache  # as for `schema.make_table`
def custom_kind(
    table: type[Table], base: type, required_methods: tuple[str, ...], summary: str, has_gains: bool = False
) -> Any:
    """Return the table of custom parts.

    Args:
        table: the table class that custom and built-in parts share.
        base: the required base class of custom classes.
        required_methods: methods; a custom class must define at least one of them.
        summary: description of the kind.
        has_gains: whether a custom class may have gains.
    """
    namespace = {"__doc__": summary, "base": base, "required_methods": required_methods, "has_gains": has_gains}
    namespace["__module__"] = __name__
    rest_field = ("rest", dict[str, Any], msgspec.field(default_factory=dict))
    fields = [("kind", Literal["custom"], "custom"), ("code", Code), rest_field]
    return msgspec.defstruct("Custom", fields, bases=(Custom, table), frozen=True, kw_only=True, namespace=namespace)


def find_code_keys(value: object) -> Iterator[tuple[dict, str]]:
    """Yield each table in the tables of a file that names custom code, and the key that names it."""
    if isinstance(value, dict):
        yield from ((value, key) for key in CODE_KEYS if isinstance(value.get(key), str))
    for child in value.values() if isinstance(value, dict) else value if isinstance(value, list) else ():
        yield from find_code_keys(child)


def code_by_key(scenario: Table) -> dict[str, str]:
    """Return the custom code that a scenario runs, "FILE.py:NAME", by the key that names it."""
    code = {}
    for name, table in _named_tables(scenario):
        for key in CODE_KEYS:
            if isinstance(getattr(table, key, None), str):
                code[f"{name}.{key}"] = getattr(table, key)
    return code


def _named_tables(scenario: Table) -> Iterator[tuple[str, Any]]:
    """Yield the name and the table of each table that can name code, also in a sum of disturbances or [dispersion]."""
    for name in scenario.__struct_fields__:
        table = getattr(scenario, name)
        if hasattr(table, "tables_by_name"):
            yield from table.tables_by_name(name).items()
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
    if key == CONTROLLER_OPTION:
        return "flight_code_sha256"
    place = key.removeprefix("plant.").removesuffix(".code").lstrip("-")
    return re.sub(r"\W+", "_", place).strip("_") + "_sha256"


def checksums(scenario: Table) -> dict[str, str]:
    """Return the current SHA-256 checksums of the files that a scenario names, by their names in `versions.json`."""
    by_name = {checksum_name(key): systems.checksum(where) for key, where in code_by_key(scenario).items()}
    by_name |= {checksum_name(key): systems.sha256(file) for key, file in data_files_by_key(scenario).items()}
    return {name: checksum for name, checksum in by_name.items() if checksum is not None}


def find_data_tables(file: Mapping[str, Any]) -> list[dict]:
    """Return the tables of a parsed file that name a data file."""
    table = file.get("reference")
    return [table] if isinstance(table, dict) and isinstance(table.get("file"), str) else []


def data_files_by_key(scenario: Table) -> dict[str, str]:
    """Return the paths of the data files that a scenario names, by the key that names the file."""
    file = getattr(getattr(scenario, "reference", None), "file", None)
    return {} if file is None else {DATA_FILE_KEY: file}


def has_unloaded_code(scenario: Table) -> bool:
    """Whether a scenario has a custom part whose code has not run yet."""
    return any(getattr(table, "is_unloaded", False) for _, table in _named_tables(scenario))


def load_table(table: Any, name: str, code: object) -> Any:
    """Return the table of a custom part with the keys of its class.

    Args:
        table: the table class from `custom_kind`.
        name: name of the table in the scenario, for errors.
        code: "FILE.py:NAME" or "package.module:NAME", which is run, or the class itself.

    Raises:
        ScenarioError: there is no such class, or its fields cannot be keys.
    """
    try:
        item = systems.load_object(code, f"{systems.NAME_FORMS} of a class") if isinstance(code, str) else code
        base = table.base
        if not (isinstance(item, type) and issubclass(item, base)):
            shown_type = f"a class {item.__name__}" if isinstance(item, type) else f"of type {type(item).__name__}"
            raise ValueError(f"it is {shown_type}, but must be a class derived from ptsmc_jax.{base.__name__}")
        return _add_class_keys(table, item)
    except ValueError as error:
        shown = brief(code) if isinstance(code, str) else getattr(code, "__name__", type(code).__name__)
        raise ScenarioError(f"{name}.code is {shown}: {error}") from None


@functools.lru_cache(maxsize=256)
def _add_class_keys(table: Any, custom_class: type) -> Any:
    """Return a table with a key for each field of a custom class; raise ValueError for fields that it cannot have."""
    base = table.base
    if all(getattr(custom_class, method, None) is getattr(base, method, None) for method in table.required_methods):
        raise ValueError(f"the class {custom_class.__name__} has no method {' or '.join(table.required_methods)}")
    for cls in reversed(custom_class.__mro__):  # custom base classes have fields too
        if issubclass(cls, base) and "__dataclass_fields__" not in cls.__dict__:
            try:
                dataclasses.dataclass(frozen=True)(cls)
            except TypeError as error:  # for example a field without a default
                allowed = "fields with a type annotation and a default, whose names the base class does not use"
                raise ValueError(
                    f"the class {cls.__name__} cannot have such fields: {error}; allowed are {allowed}"
                ) from None
    base_fields = {field.name: field for field in dataclasses.fields(base)}
    declarations = {}
    for field in dataclasses.fields(custom_class):
        name = field.name
        if field is base_fields.get(name):
            continue
        in_use = name in base_fields or name == "rest" or hasattr(base, name) or hasattr(table, name)
        if in_use and name != REDECLARABLE_FIELD:
            raise ValueError(
                f"the class {custom_class.__name__} has a field {name}, a name that the base class already uses; "
                f"allowed is another name, or {name} = .. without a type"
            )
        if re.fullmatch(r"observer_gain(_\d+)?", table.prefix + name):
            raise ValueError(
                f"its field {name} needs another name: gain_1, gain_2 .. are the numbers of gain for each axis"
            )
        declarations[name] = _declaration(table, custom_class, field)
    return schema.extend_table(table, custom_class, "custom", declarations, table.body)


def fastest_rate(table: Any, name: str, part: Any) -> float:
    """Return the largest angular frequency that the method `fastest` of a table's class reports [rad/s].

    Args:
        table: the table.
        name: name of the table, for errors.
        part: the part, or the table itself, which has the same fields.

    Raises:
        ScenarioError: the method does not return a number of at least 0.
    """
    returned = table.part_class.fastest(part)
    try:
        rate = float(returned)
    except (TypeError, ValueError):
        rate = math.nan
    if not rate >= 0.0:
        shown = "nothing" if returned is None else brief(returned)
        raise ScenarioError(
            f"{name}.code is the class {table.part_class.__name__}, whose method fastest returns {shown}, but must "
            "return an angular frequency of at least 0 rad/s"
        )
    return rate


def _declaration(table: Any, custom_class: type, field: dataclasses.Field) -> Declaration:
    """Return the declaration of a field of a custom class. A plain number becomes a key without a unit.

    ValueError is raised if the default is not a number, not allowed, or not possible for a gain.
    """
    value, no_default = typing.cast(Any, field.default), dataclasses.MISSING
    declared = field.metadata.get("declared")
    numbers = value if isinstance(value, tuple) and value and not (declared and declared.gain) else (value,)
    if not all(map(_is_number, numbers)):
        shown = "none" if value is no_default else show(value)
        is_gain = declared is not None and declared.gain
        allowed = "a number, the first argument of gain" if is_gain else "one number or several numbers"
        raise ValueError(f"the default of {field.name} is {shown}, but must be {allowed}")
    value = tuple(map(float, value)) if isinstance(value, tuple) else float(value)
    declared = (declared or Declaration(value, "", "", Limits()))._replace(default=value)
    declared = declared._replace(meaning=" ".join(declared.meaning.split()) or "declared by the custom class")
    try:
        msgspec.convert(value, declared.type(table.body), strict=True)
    except msgspec.ValidationError:
        allowed = f"a number{declared.limits.words()}"
        raise ValueError(f"the default of {field.name} is {value:g}, but must be {allowed}") from None
    if declared.gain:
        if not table.has_gains:
            raise ValueError(
                f"its field {field.name} is a gain, but the tuner cannot change parts of this kind; allowed is a number"
            )
        if not table.prefix and is_reserved(field.name):
            raise ValueError(f"its gain {field.name} needs another name: a gain of a built-in part has this name")
        if declared.usual is None:
            raise ValueError(
                f"the gain {field.name} of the class {custom_class.__name__} has no bounds; allowed is "
                "ptsmc_jax.gain(.., usual=(lower, upper))"
            )
        if isinstance(declared.usual, str) and declared.usual not in SHARED_BOUNDS:
            raise ValueError(
                f"the usual bounds of the gain {field.name} of the class {custom_class.__name__} are "
                f"{show(declared.usual)}, but must be two numbers, a function of t_f and the control period, or one of "
                f"{', '.join(map(show, SHARED_BOUNDS))}"
            )
        number, usual = typing.cast(Any, value), typing.cast(Any, declared.usual)
        is_interval = isinstance(usual, tuple) and len(usual) == 2 and all(map(_is_number, usual))
        if is_interval and usual[0] < usual[1] and not usual[0] <= number <= usual[1]:
            low, high = usual
            raise ValueError(
                f"the default of {field.name} is {number:g}, but must be inside its usual bounds, {low:g} to {high:g}"
            )
    return declared


def _is_number(value: object) -> typing.TypeGuard[float]:
    """Return whether a value is a finite number and no bool."""
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


class SensorTable(schema.PartTable, frozen=True):
    """Custom sensors. They replace the noise of [hardware] and the table [filter]."""

    prefix: ClassVar[str] = "sensors_"

    def build(self, model: "Plant", period: float) -> custom_sensors.CustomSensors:
        """Return the sensors for the rollout; `model`: the design model of the plant, `period`: control period [s]."""
        part = self.part(model=model)
        _check_field("sensors", part, "draws", _is_count(part.draws, 0), "a whole number of at least 0")
        return custom_sensors.CustomSensors(part, vector(1.0))


class DrawTable(schema.PartTable, frozen=True):
    """Custom random quantities."""

    def build(self) -> Draw:
        """Return the dispersion, an instance of `ptsmc_jax.Draw`."""
        part = self.part()
        _check_field("dispersion.custom", part, "count", _is_count(part.count, 1), "a whole number of at least 1")
        _check_field("dispersion.custom", part, "drawn", part.drawn in DISTRIBUTIONS, '"normal" or "uniform"')
        return part


def _is_count(value: object, smallest: int) -> bool:
    """Return whether a value is a whole number of at least `smallest`."""
    return isinstance(value, int) and not isinstance(value, bool) and value >= smallest


def _check_field(table: str, part: object, field: str, is_allowed: bool, allowed: str) -> None:
    """Raise ScenarioError if a class has a field that is not allowed; `allowed`: the allowed values in words."""
    if not is_allowed:
        beginning = f"{table}.code is a class whose {field} is {show(getattr(part, field))}"
        raise ScenarioError(f"{beginning}, but must be {allowed}")


SENSORS: Kinds = {  # kinds of the table [sensors]; built-in sensors are set by [hardware] and [filter] instead
    "custom": custom_kind(
        SensorTable, custom_sensors.SampledSensor, ("see",), has_gains=True,
        summary="Custom sensors, a class derived from ptsmc_jax.SampledSensor; its fields are further keys. They "
        "replace the noise of [hardware] and the table [filter].",
    )
}  # fmt: skip
CUSTOM_DRAW: Any = custom_kind(
    DrawTable, Draw, ("at",), "A custom dispersion, a class derived from ptsmc_jax.Draw; its fields are further keys."
)
