"""Parts of one's own: `kind = "own"` and `code = "FILE.py:NAME"`, a class whose fields are further keys of its table.

Reading a scenario runs nothing that it names: until `reading.complete` does, such a table keeps these keys as they are.
"""

import dataclasses
import functools
import inspect
import math
import re
import typing
from collections.abc import Callable, Iterator, Mapping
from typing import Annotated, Any, ClassVar

import msgspec
from msgspec import Meta

from ptsmc_jax.scenario import systems
from ptsmc_jax.scenario.errors import ScenarioError, brief, show
from ptsmc_jax.scenario.gain_record import Allowed, Choice, GainBounds
from ptsmc_jax.scenario.values import Table

KEYS = ("system", "truth", "code")  # that name code, in any table
CONTROLLER = "--controller"  # an option that names code: C that export left, not `controller.code`
DECLARED = "delta"  # what a law's class may declare anew, as a gain
Code = Annotated[Any, Meta(description=systems.WHERE)]


class Own:
    """What the tables of parts of one's own share; each declares the keys `kind` and `code`, as structs have to.

    Attributes:
        code: the class, "FILE.py:NAME" or "package.module:NAME"
    """

    __slots__ = ()
    needs: ClassVar[tuple[str, ...]] = ()  # methods of which the class must have one
    tuned: ClassVar[bool] = False  # whether it may have gains
    prefix: ClassVar[str] = ""  # of the names of its gains
    gains: ClassVar[Mapping[str, GainBounds]] = {}
    free_by_default: ClassVar[tuple[str, ...]] = ()
    waits: ClassVar[bool] = False  # until its code is run: it holds the keys that are not known yet in `rest`
    made: ClassVar[Any] = None  # the class that the code names

    @classmethod
    def base(cls) -> type:
        """What such a class is derived from; loads JAX."""
        raise NotImplementedError


def named(raw: Mapping[str, Any]) -> Iterator[tuple[dict, str]]:
    """The tables of a parsed file that name code, and the key that does, in tables within tables too."""
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
    """What flying a scenario runs: where it stands, by the key that names it."""
    found = {}
    for place, table in _places(scenario):
        for key in KEYS:
            if isinstance(getattr(table, key, None), str):
                found[f"{place}.{key}"] = getattr(table, key)
    return found


def _places(scenario: Table) -> Iterator[tuple[str, Any]]:
    """The tables that may name code, by where they stand: also those of a sum, and of what is drawn."""
    for name in scenario.__struct_fields__:
        table = getattr(scenario, name)
        if name == "disturbance":
            yield from table.placed(name).items()
        elif name == "dispersion" and table is not None:
            yield "dispersion.own", table.own
        else:
            yield name, table


def digest_name(key: str) -> str:
    """The name in `versions.json` for the digest of what a key names.

    >>> digest_name("plant.system"), digest_name("controller.code"), digest_name("disturbance.terms[0].code")
    ('system_sha256', 'controller_sha256', 'disturbance_terms_0_sha256')
    >>> digest_name("--metrics"), digest_name("--controller")  # not the name of `controller.code`
    ('metrics_sha256', 'flight_code_sha256')
    """
    if key == CONTROLLER:
        return "flight_code_sha256"
    place = key.removeprefix("plant.").removesuffix(".code").lstrip("-")
    return re.sub(r"\W+", "_", place).strip("_") + "_sha256"


def digests(scenario: Table) -> dict[str, str]:
    """What a result depends on besides its scenario: the digests of the files that it names, as they are now."""
    found = {digest_name(key): systems.digest(where) for key, where in programs(scenario).items()}
    return {name: digest for name, digest in found.items() if digest is not None}


def waits(scenario: Table) -> bool:
    """Whether a scenario has a table of one's own whose code was not run yet."""
    return any(getattr(table, "waits", False) for _, table in _places(scenario))


@functools.cache
def waiting(table: Any) -> Any:
    """The table as it is before its code is run."""
    rest = ("rest", dict[str, Any], msgspec.field(default_factory=dict))
    space = {"__doc__": table.__doc__, "__module__": table.__module__, "waits": True, "__reduce__": _reduced}
    return msgspec.defstruct(table.__name__, [rest], bases=(table,), frozen=True, kw_only=True, namespace=space)


def read(table: Any, name: str, code: object) -> Any:
    """The table with the keys of the class that is named, which is run for it, or is there.

    name: of the table in the scenario. Raises ScenarioError where there is no such class.
    """
    try:
        item = systems.item(code, f"{systems.WHERE} of a class") if isinstance(code, str) else code
        base = table.base()
        if not (isinstance(item, type) and issubclass(item, base)):
            what = f"a class {item.__name__}" if isinstance(item, type) else f"a {type(item).__name__}"
            raise ValueError(f"it names {what}, which is not derived from ptsmc_jax.{base.__name__}")
        return _with_keys(table, item)
    except ValueError as error:
        shown = brief(code) if isinstance(code, str) else getattr(code, "__name__", type(code).__name__)
        raise ScenarioError(f"{name}.code is {shown}: {error}") from None


@functools.lru_cache(maxsize=256)
def _with_keys(table: Any, found: Any) -> Any:
    from ptsmc_jax.simulation.gains import base as base_of_gain

    base = table.base()
    if all(getattr(found, method, None) is getattr(base, method, None) for method in table.needs):
        raise ValueError(f"the class {found.__name__} has no method {' or '.join(table.needs)}")
    common = {field.name: field for field in dataclasses.fields(base)}
    for name in _annotated(found, base):
        known = getattr(base, name, None)
        if name in common.keys() - {DECLARED} or callable(known) or isinstance(known, property):
            raise _taken(found, name, "another name")
        if hasattr(base, name):
            raise _taken(found, name, f"{name} = .. without a type")
    for cls in reversed(found.__mro__):  # classes of one's own that it is derived from have fields too
        if issubclass(cls, base) and "__dataclass_fields__" not in cls.__dict__:
            try:
                dataclasses.dataclass(frozen=True)(cls)
            except TypeError as error:  # such as a field without a default
                raise ValueError(f"the class {cls.__name__} cannot have such fields: {error}") from None
    key_types, gains, meanings = [], {}, []
    for field in dataclasses.fields(found):
        if common.get(field.name) is not None and common[field.name].default is field.default:
            continue
        if (hasattr(table, field.name) or field.name == "rest") and field.name not in common:  # tables have it
            raise _taken(found, field.name, "another name")
        if base_of_gain(table.prefix + field.name) == "observer_gain":
            raise ValueError(
                f"the name of its field must be another than {field.name}: gain has a number for each axis, gain_1 .."
            )
        gain = field.metadata.get("gain")
        key_types.append((field.name, *_key(field, gain)))
        meaning = "" if gain is None else " ".join(gain.meaning.split())
        unit = f" [{gain.unit}]" if gain is not None and gain.unit else ""
        meanings.append(f"    {field.name}: {meaning or 'of one of its own'}{unit}")
        if gain is not None:
            gains[table.prefix + field.name] = _gain(table, found, field, gain)
    summary = inspect.cleandoc(found.__doc__ or "").split("\n\n")[0]
    return msgspec.defstruct(
        found.__name__, key_types, bases=(table,), frozen=True, kw_only=True,
        namespace={
            "__doc__": summary + "\n\nAttributes:\n" + "\n".join(meanings),
            "__module__": found.__module__,
            "gains": {**table.gains, **gains},
            "free_by_default": tuple(gains),
            "made": found,
            "__reduce__": _reduced,
        },
    )  # fmt: skip


def _reduced(self: Any) -> tuple:
    """How a table made here is pickled: by the table that it derives from, since its module has no such name."""
    return _restored, (type(self).__base__, self.waits, {name: getattr(self, name) for name in self.__struct_fields__})


def _restored(table: Any, waits: bool, values: dict[str, Any]) -> Any:
    return (waiting(table) if waits else read(table, table.__name__, values["code"]))(**values)


def _annotated(found: type, base: type) -> Iterator[str]:
    """The names that the classes of one's own under a base give a type, which makes fields of them."""
    for cls in found.__mro__:
        if issubclass(cls, base) and cls is not base:
            yield from (name for name, kind in inspect.get_annotations(cls).items() if "ClassVar" not in str(kind))


def _taken(found: type, name: str, allowed: str) -> ValueError:
    taken = f"a field of the class {found.__name__} is called {name}, which has its meaning already"
    return ValueError(f"{taken}; allowed is {allowed}")


def build(table: Any, **common: Any) -> Any:
    """The part that the code of a table names, with its keys; common: what the fields of its base are."""
    from ptsmc_jax.numerics.pytrees import vector

    fields = [field.name for field in dataclasses.fields(table.made) if field.name not in common]
    return registered(table.made)(**common, **{name: vector(getattr(table, name)) for name in fields})


def fastest(table: Any, name: str, part: Any) -> float:
    """What the method `fastest` of a part says that the code of this table names [rad/s]."""
    said = part.fastest()
    try:
        rate = float(said)
    except (TypeError, ValueError):
        rate = math.nan
    if not rate >= 0.0:
        other = "nothing" if said is None else f"a {type(said).__name__}"
        shown = brief(said) if isinstance(said, int | float | str) else other
        raise ScenarioError(
            f"{name}.code names a class {table.made.__name__} whose fastest returns {shown}, but must return a number "
            "of at least 0 [rad/s]"
        )
    return rate


@functools.cache
def registered(made: type) -> type:
    """Return a class that code names, registered as a pytree."""
    from ptsmc_jax.numerics.pytrees import pytree

    try:
        return pytree(made)
    except ValueError:  # its file says `pytree` itself
        return made


def _key(field: dataclasses.Field, about: Any) -> tuple[Any, Any]:
    """Type and default of a field as a key."""
    value, missing = typing.cast(Any, field.default), dataclasses.MISSING
    if about is None and isinstance(value, tuple) and value and all(map(_plain, value)):
        count, numbers = len(value), tuple(map(float, value))
        said = f"a list of {count} numbers"
        return Annotated[tuple[float, ...], Meta(min_length=count, max_length=count, description=said)], numbers
    if not _plain(value):
        shown = "none" if value is missing else show(value)
        allowed = "a number, or several in parentheses" if about is None else "a number, the first argument of gain"
        raise ValueError(f"the default of {field.name} is {shown}, but must be {allowed}")
    if about is None:
        return Annotated[float, Meta(description="a number")], float(value)
    said = " and ".join([f"{word} {limit:g}" for word, limit in (("above", about.above), ("below", about.below))
                         if math.isfinite(limit)])  # fmt: skip
    if not about.above < value < about.below:
        raise ValueError(f"the default of {field.name} is {value:g}, but must be a number {said}")
    above, below = (limit if math.isfinite(limit) else None for limit in (about.above, about.below))
    return Annotated[float, Meta(gt=above, lt=below, description=f"a number {said}".strip())], float(value)


def _plain(value: object) -> typing.TypeGuard[float]:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _gain(table: Any, found: Any, field: dataclasses.Field, gain: Any) -> GainBounds:
    """The bounds of a field that is a gain. Raises ValueError where it cannot be one of such a table."""
    from ptsmc_jax.simulation.gains import is_reserved

    if not table.tuned:
        raise ValueError(f"its field {field.name} is a gain, but of such a part none is tuned; allowed is a number")
    if not table.prefix and is_reserved(field.name):
        raise ValueError(f"the name of its gain {field.name} stands for one of another part")
    bounds = _bounds(gain, f"gain {field.name} of the class {found.__name__}")
    _inside(field, gain.usual)
    return bounds


def _inside(field: dataclasses.Field, usual: Any) -> None:
    """Raise ValueError where the default of a gain lies outside its usual bounds, where these are two numbers."""
    value = float(typing.cast(Any, field.default))
    plain = isinstance(usual, tuple | list) and len(usual) == 2 and all(map(_plain, usual)) and usual[0] < usual[1]
    if plain and not usual[0] <= value <= usual[1]:
        raise ValueError(
            f"the default of the gain {field.name} is {value:g}, but must be a number from {usual[0]:g} to "
            f"{usual[1]:g}, its usual bounds"
        )


def _bounds(gain: Any, called: str) -> GainBounds:
    """The bounds of a gain as its class has them; called: which gain of which class that is."""
    usual = gain.usual
    if usual is None:
        raise ValueError(f"the {called} has no bounds; allowed is ptsmc_jax.gain(.., usual=(lower, upper))")
    bounds_of: Callable = usual if callable(usual) else lambda t_f, period: usual

    def interval(choice: Choice) -> tuple[float, float]:
        try:
            low, high = (float(v) for v in bounds_of(choice.t_f, choice.scenario.loop.period))
        except (Exception, SystemExit) as error:
            said = f"{type(error).__name__}: {error}"
            raise ScenarioError(f"the usual bounds of the {called} fail: {said}") from None
        if not gain.above < low < high < gain.below:
            limits = (("above", gain.above), ("below", gain.below))
            allowed = " and".join(f" {word} {limit:g}" for word, limit in limits if math.isfinite(limit))
            raise ScenarioError(
                f"the usual bounds of the {called} are [{low:g}, {high:g}], but must be two numbers{allowed}, the "
                "lower one first"
            )
        return low, high

    return GainBounds(interval, lambda _: Allowed(gain.above, gain.below))
