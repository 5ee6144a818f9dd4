"""Build the tables of scenario files from the declarations in the classes of parts. Start with `table`.

A law, an observer, a disturbance or a reference declares each of its numbers once, see `declare`. The table of its kind
has these numbers as keys.
"""

import dataclasses
import functools
import inspect
from collections.abc import Mapping
from typing import Any, ClassVar, Literal

import msgspec

from ptsmc_jax import declare
from ptsmc_jax.declare import Declaration, Scaled
from ptsmc_jax.numerics.pytrees import pytree, vector
from ptsmc_jax.scenario.values import Table


class PartTable(Table, frozen=True):
    """A table with two groups of keys: its own fields, and the numbers that the class of a part declares."""

    made: ClassVar[Any] = None  # the class of the part
    declared: ClassVar[Mapping[str, Declaration]] = {}  # declarations of its numbers, by key
    body: ClassVar[bool] = True  # whether the plant is a spacecraft
    prefix: ClassVar[str] = ""  # prefix of a key in the name of its gain, such as observer_ for observer_gain
    gains: ClassVar[tuple[str, ...]] = ()  # names of all gains that tuning can change
    usual: ClassVar[Mapping[str, str]] = {}  # by key: entry of `gain_bounds.BOUNDS`, for gains of the table itself
    # Gains that are free by default. The second tuple is free in the sampled loop only: in the continuous loop a larger
    # K1 and a thinner boundary layer cost only integration steps.
    free_by_default: ClassVar[tuple[str, ...]] = ()
    free_if_sampled: ClassVar[tuple[str, ...]] = ()
    remake: ClassVar[tuple] = ()  # how unpickling makes this type again: a function and its arguments

    def __reduce__(self) -> tuple:
        """Pickle with the arguments that make this type, since no module contains it."""
        return _restored, (self.remake or type(self), {name: getattr(self, name) for name in self.__struct_fields__})

    def part(self, **known: Any) -> Any:
        """Return the part. Fields that are not in `known` get the numbers of the keys with their names."""
        fields = [one.name for one in dataclasses.fields(self.made) if not one.metadata.get("static")]
        numbers = {name: vector(getattr(self, name)) for name in fields if name not in known}
        return registered(self.made)(**known, **numbers)

    def filled(self, scenario: Any) -> Any:
        """Return the table with its defaults that depend on other keys, except those in `scaled`."""
        return self

    def written(self, scenario: Any) -> Any:
        """Return the table for a file, with the keys that depend on others of a validated scenario."""
        return self

    @property
    def each(self) -> tuple[str, ...]:
        """Keys with one number for each input of the plant."""
        return tuple(name for name, one in self.declared.items() if one.each)


def _restored(remake: Any, values: dict[str, Any]) -> Any:
    return (remake[0](*remake[1:]) if isinstance(remake, tuple) else remake)(**values)


@functools.cache
def registered(made: type) -> type:
    """Return a class registered as a JAX pytree, if it is not registered yet."""
    try:
        return pytree(made)
    except ValueError:  # the class is already registered
        return made


def table(base: Any, made: Any, kind: str, body: bool = True, changes: tuple[tuple[str, Any], ...] = ()) -> Any:
    """Return the table of a class of parts.

    Args:
        base: the table with the keys that all these parts share.
        made: the class of the part; the first paragraph of its docstring describes the kind.
        kind: name of the kind.
        body: whether the plant is a spacecraft.
        changes: keys and defaults that replace the declared defaults for this plant.
    """
    return _table(base, made, kind, body, changes)


@functools.cache
def _table(base: Any, made: Any, kind: str, body: bool, changes: tuple) -> Any:
    declared = declare.declared(made)
    declared |= {name: declared[name]._replace(default=default) for name, default in changes}
    return extended(base, made, kind, declared, body=body, remake=(_table, base, made, kind, body, changes))


def extended(base: Any, made: Any, kind: str, declared: Mapping[str, Declaration], **space: Any) -> Any:
    """Return a subclass of a table with declared keys.

    Args:
        base: the table.
        made: the class of the part.
        kind: name of the kind.
        declared: declarations by key.
        space: further class variables.
    """
    body, fields = space.get("body", base.body), []
    for name, one in declared.items():
        scaled = one.default is None or isinstance(one.default, Scaled)
        type_ = one.type(body)
        fields.append((name, type_ | None if scaled else type_, None if scaled else one.default))
    named = {base.prefix + name: one for name, one in declared.items() if one.gain}
    space = {
        "__doc__": inspect.cleandoc(made.__doc__ or "").split("\n\n")[0],
        "__module__": made.__module__,
        "made": made,
        "declared": declared,
        "scaled": {name: one.default for name, one in declared.items() if isinstance(one.default, Scaled)},
        "gains": tuple(dict.fromkeys((*named, *base.gains))),
        "free_by_default": tuple(name for name, one in named.items() if one.free is True),
        "free_if_sampled": tuple(name for name, one in named.items() if one.free == "sampled"),
        **space,
    }
    kinds = [("kind", Literal[kind], kind)]
    return msgspec.defstruct(made.__name__, kinds + fields, bases=(base,), frozen=True, kw_only=True, namespace=space)
