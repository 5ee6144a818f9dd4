"""Tables of scenario files, made from what the classes of parts declare of their numbers."""

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
    """A table whose keys are the numbers of the class of a part, besides those that the table itself has."""

    made: ClassVar[Any] = None  # the class of the part
    declared: ClassVar[Mapping[str, Declaration]] = {}  # its numbers
    body: ClassVar[bool] = True  # the plant is a spacecraft
    prefix: ClassVar[str] = ""  # with the key it makes the name of a gain
    gains: ClassVar[tuple[str, ...]] = ()  # names of all that tuning may move
    usual: ClassVar[Mapping[str, str]] = {}  # names of the usual bounds of gains that the table itself declares
    # gains that are free if a scenario does not say; the second ones in the sampled loop only, since without samples a
    # larger K1 and a thinner boundary layer cost nothing but steps
    free_by_default: ClassVar[tuple[str, ...]] = ()
    free_if_sampled: ClassVar[tuple[str, ...]] = ()
    remake: ClassVar[tuple] = ()  # how a process makes this type again: a function and its arguments

    def __reduce__(self) -> tuple:
        """Pickle by the arguments that this type is made from, since no module has its name."""
        return _restored, (self.remake or type(self), {name: getattr(self, name) for name in self.__struct_fields__})

    def part(self, **known: Any) -> Any:
        """Return the part: its fields are those known, and else the numbers of the keys with their names."""
        fields = [one.name for one in dataclasses.fields(self.made) if not one.metadata.get("static")]
        numbers = {name: vector(getattr(self, name)) for name in fields if name not in known}
        return registered(self.made)(**known, **numbers)

    def filled(self, scenario: Any) -> Any:
        """Return the table with the defaults that follow from other keys, besides those in `scaled`."""
        return self

    def written(self, scenario: Any) -> Any:
        """Return the table with its keys that follow from others of a checked scenario."""
        return self

    @property
    def each(self) -> tuple[str, ...]:
        """Keys with one number for each input of the plant."""
        return tuple(name for name, one in self.declared.items() if one.each)


def _restored(remake: Any, values: dict[str, Any]) -> Any:
    return (remake[0](*remake[1:]) if isinstance(remake, tuple) else remake)(**values)


@functools.cache
def registered(made: type) -> type:
    """Return a class registered as a pytree, as the built-in ones are."""
    try:
        return pytree(made)
    except ValueError:  # it is one already
        return made


def table(base: Any, made: Any, kind: str, body: bool = True, changes: tuple[tuple[str, Any], ...] = ()) -> Any:
    """Return the table of a class of parts.

    Args:
        base: the table with the keys that all these parts have.
        made: the class; its docstring begins with what the kind is.
        kind: name of the kind.
        body: the plant is a spacecraft.
        changes: defaults that are others for these plants, by key.
    """
    return _table(base, made, kind, body, changes)


@functools.cache
def _table(base: Any, made: Any, kind: str, body: bool, changes: tuple) -> Any:
    declared = declare.declared(made)
    declared |= {name: declared[name]._replace(default=default) for name, default in changes}
    return extended(base, made, kind, declared, body=body, remake=(_table, base, made, kind, body, changes))


def extended(base: Any, made: Any, kind: str, declared: Mapping[str, Declaration], **space: Any) -> Any:
    """Return `base` with the keys that are declared; space: further class variables."""
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
