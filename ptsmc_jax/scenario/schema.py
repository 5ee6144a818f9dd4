"""Build the tables of scenario files from the declarations in the classes of parts. Start with `make_table`.

A law, an observer, a disturbance or a reference declares each of its numbers once, see `declare`. The table of its kind
has these numbers as keys.
"""

import dataclasses
import functools
import inspect
from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Self

import msgspec

from ptsmc_jax import declare
from ptsmc_jax.declare import Declaration, Scaled
from ptsmc_jax.numerics.pytrees import pytree, vector
from ptsmc_jax.scenario.values import UNIT_OF_D, Meaning, Table

if TYPE_CHECKING:
    from ptsmc_jax.scenario.tables import Scenario


class PartTable(Table, frozen=True):
    """A table with two groups of keys: its own fields, and the numbers that the class of a part declares."""

    part_class: ClassVar[Any] = None  # the class of the part
    declared: ClassVar[Mapping[str, Declaration]] = {}  # declarations of its numbers, by key
    body: ClassVar[bool] = True  # whether the plant is a spacecraft
    prefix: ClassVar[str] = ""  # prefix of a key in the name of its gain, such as observer_ for observer_gain
    gains: ClassVar[tuple[str, ...]] = ()  # names of all gains that tuning can change
    usual: ClassVar[Mapping[str, str]] = {}  # by key: entry of `gain_bounds.BOUNDS`, for gains of the table itself
    free_by_default: ClassVar[tuple[str, ...]] = ()  # names of gains that tuning changes by default
    # Further such gains, in a sampled loop only. In a continuous loop, tuning would make K1 as large and the boundary
    # layer as thin as allowed, because both cost only integration steps.
    free_if_sampled: ClassVar[tuple[str, ...]] = ()

    def part(self, **known_values: object) -> Any:
        """Return the part. Fields that are not in `known_values` get the numbers of the keys with their names."""
        names = [one.name for one in dataclasses.fields(self.part_class) if not one.metadata.get("static")]
        numbers = {name: vector(getattr(self, name)) for name in names if name not in known_values}
        return register_pytree(self.part_class)(**known_values, **numbers)

    def fill_defaults(self, scenario: "Scenario") -> Self:
        """Return the table with its defaults that depend on other keys, except those in `scaled`."""
        return self

    def complete_for_file(self, scenario: "Scenario") -> Self:
        """Return the table for a file, with the keys that depend on others of a validated scenario."""
        return self

    @property
    def keys_per_input(self) -> tuple[str, ...]:
        """Keys with one number for each input of the plant."""
        return tuple(name for name, one in self.declared.items() if one.each)


@functools.cache
def register_pytree(part_class: type) -> type:
    """Return a class registered as a JAX pytree, if it is not registered yet."""
    try:
        return pytree(part_class)
    except ValueError:  # the class is already registered
        return part_class


@functools.cache  # plants share a table, which the reference pages then show once
def make_table(
    base: type[PartTable], part_class: type, kind: str, body: bool = True, changes: tuple[tuple[str, object], ...] = ()
) -> Any:
    """Return the table of a class of parts.

    Args:
        base: the table with the keys that all these parts share.
        part_class: the class of the part; the first paragraph of its docstring describes the kind.
        kind: name of the kind.
        body: whether the plant is a spacecraft.
        changes: keys and defaults that replace the declared defaults for this plant.
    """
    declared = declare.declared(part_class)
    declared |= {name: declared[name]._replace(default=default) for name, default in changes}
    return extend_table(base, part_class, kind, declared, body)


def extend_table(
    base: type[PartTable], part_class: type, kind: str, declared: Mapping[str, Declaration], body: bool
) -> Any:
    """Return a subclass of a table with declared keys.

    Args:
        base: the table with the keys that all these parts share.
        part_class: the class of the part; the first paragraph of its docstring describes the kind.
        kind: name of the kind.
        declared: declarations of the added keys by name, see `declare`.
        body: whether the plant is a spacecraft.
    """
    fields: list[tuple[str, Any, Any]] = [("kind", Literal[kind], kind)]
    for name, declaration in declared.items():
        scaled = declaration.default is None or isinstance(declaration.default, Scaled)
        type_ = declaration.type(body) | None if scaled else declaration.type(body)
        unit = declaration.unit if isinstance(declaration.unit, str) else declaration.unit[not body]
        unit = unit.replace(UNIT_OF_D, "N m") if body else unit
        annotated = Annotated[type_, Meaning(declaration.meaning, unit)]
        fields.append((name, annotated, None if scaled else declaration.default))
    gains_by_name = {base.prefix + name: declaration for name, declaration in declared.items() if declaration.gain}
    class_variables = {
        "__doc__": inspect.cleandoc(part_class.__doc__ or "").split("\n\n")[0],
        "__module__": part_class.__module__,
        "part_class": part_class,
        "declared": declared,
        "body": body,
        "scaled": {name: value.default for name, value in declared.items() if isinstance(value.default, Scaled)},
        "gains": tuple(dict.fromkeys((*gains_by_name, *base.gains))),
        "free_by_default": tuple(name for name, declaration in gains_by_name.items() if declaration.free is True),
        "free_if_sampled": tuple(name for name, declaration in gains_by_name.items() if declaration.free == "sampled"),
    }
    return msgspec.defstruct(
        part_class.__name__, fields, bases=(base,), frozen=True, kw_only=True, namespace=class_variables
    )
