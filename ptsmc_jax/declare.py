"""How the class of a part declares its numbers: default, unit, meaning, allowed values, and usual bounds of a gain.

The keys of scenario files, their checks, `ptsmc new`, the reference pages, the tuner's bounds, the comments of exported
C and the JSON Schema are all made from these declarations. Built-in and custom parts use the same ones.
"""

import dataclasses
import math
from collections.abc import Callable
from typing import Annotated, Any, ClassVar, NamedTuple

import numpy as np
from msgspec import Meta

Usual = tuple[float, float] | str | Callable[[float, float], tuple[float, float]] | None


class Scaled(NamedTuple):
    """A default in the published case, with the powers of inertia and time in its unit.

    The unit of a disturbance on a chain of order n has the power -n of time, which is `order` = -1. A power of time may
    follow from other keys: then it is a function of the table.
    """

    value: Any
    inertia: float = 0.0
    time: float | Callable[[Any], float] = 0.0
    order: float = 0.0
    each: bool = False  # one number for each input


class Limits(NamedTuple):
    """Range of allowed values of a number."""

    above: float = -math.inf
    at_least: float = -math.inf
    below: float = math.inf
    at_most: float = math.inf

    def meta(self, description: str) -> Meta:
        """Return the limits for `msgspec`."""
        named = zip(("gt", "ge", "lt", "le"), self, strict=True)
        limits: dict[str, Any] = {name: limit for name, limit in named if math.isfinite(limit)}
        return Meta(description=description, **limits)

    def words(self) -> str:
        """Return the limits in words that follow "a number" or "three numbers", empty if there are none."""
        named = zip(("greater than", "of at least", "below", "at most"), self, strict=True)
        limits = [f"{name} {limit:g}" for name, limit in named if math.isfinite(limit)]
        return f" {' and '.join(limits)}" if limits else ""


class Declaration(NamedTuple):
    """A number of a part as a key of scenario files; see `number` and `gain`."""

    default: Any  # a number, numbers, a `Scaled`, or None if it follows from other keys
    meaning: str
    unit: str | tuple[str, str]  # two: of a spacecraft, and of a plant without a body
    limits: Limits
    each: bool = False
    any_length: bool = False
    allowed: str = ""  # if not empty, it replaces the limits in words
    gain: bool = False
    usual: Usual = None
    free: bool | str = False  # whether tuning moves it by default; "sampled": in the sampled loop only

    @property
    def words(self) -> str:
        """The allowed values of a single number, in words."""
        return self.allowed or f"a number{self.limits.words()}"

    def type(self, body: bool) -> Any:
        """Return the type that `msgspec` checks; body: the plant is a spacecraft, with three inputs."""
        number_type = Annotated[float, self.limits.meta(self.words)]
        value = self.default.value if isinstance(self.default, Scaled) else self.default
        if not self.each and not isinstance(value, tuple):
            return number_type
        words = self.limits.words()
        if self.any_length:
            return Annotated[tuple[number_type, ...], Meta(description=self.allowed, min_length=1)]
        if not self.each:
            size = len(value)
            description = f"{'three' if size == 3 else f'a list of {size}'} numbers{words}"
            return Annotated[tuple[number_type, ...], Meta(description=description, min_length=size, max_length=size)]
        if body:
            return Annotated[tuple[number_type, number_type, number_type], Meta(description=f"three numbers{words}")]
        return Annotated[tuple[number_type, ...], Meta(description=f"a list of numbers{words}, one for each input")]


def number(
    default: Any,
    *,
    above: float = -math.inf,
    below: float = math.inf,
    at_least: float = -math.inf,
    at_most: float = math.inf,
    unit: str | tuple[str, str] = "",
    meaning: str = "",
    each: bool = False,
    any_length: bool = False,
    allowed: str = "",
    kw_only: bool = False,
) -> Any:
    """Declare a field of a part as a key of scenario files: `phase: float = number(0.0, unit="rad", meaning="..")`.

    Args:
        default: its value if the file gives none: a number, numbers, a `Scaled`, or None if it follows from other keys.
        above: the number is greater than this.
        below: it is less than this.
        at_least: it is not less than this.
        at_most: it is not greater than this.
        unit: of the number; two units: of a spacecraft, and of a plant without a body.
        meaning: meaning of the number.
        each: there is one number for each input of the plant.
        any_length: it is a list of numbers, of a length that is checked later.
        allowed: the allowed values in words; by default they are made from the limits.
        kw_only: as for `dataclasses.field`.
    """
    limits = Limits(above, at_least, below, at_most)
    return _make_field(Declaration(default, meaning, unit, limits, each, any_length, allowed), kw_only=kw_only)


def gain(
    default: Any,
    usual: Usual = None,
    *,
    above: float = 0.0,
    below: float = math.inf,
    at_least: float = -math.inf,
    at_most: float = math.inf,
    unit: str | tuple[str, str] = "",
    meaning: str = "",
    each: bool = False,
    allowed: str = "",
    free: bool | str = True,
) -> Any:
    """Declare a field that tuning may move: `k1: float = gain(1.0, (0.1, 10.0), unit="1/s", meaning="..")`.

    A gain is searched on a log scale if its bounds are positive and more than a factor of 10 apart.

    Args:
        default: its value if the file gives none: a number, numbers, a `Scaled`, or None if it follows from other keys.
        usual: bounds of a search if a scenario gives none: two numbers, a function of t_f and the control period [s],
            or the name of bounds in `scenario.gain_bounds`.
        above: the gain is greater than this.
        below: it is less than this.
        at_least: it is not less than this.
        at_most: it is not greater than this.
        unit: unit of the gain; two units: of a spacecraft, and of a plant without a body.
        meaning: meaning of the number.
        each: there is one number for each input of the plant; tuning moves them together, or each alone.
        allowed: the allowed values in words; by default they are made from the limits.
        free: whether tuning moves it by default; "sampled": in the sampled loop only.
    """
    limits = Limits(-math.inf if math.isfinite(at_least) else above, at_least, below, at_most)
    return _make_field(Declaration(default, meaning, unit, limits, each, False, allowed, True, usual, free))


def _make_field(declared: Declaration, **options: Any) -> Any:
    """Return the dataclass field. It has a default if that is a number or numbers, in the published case."""
    value = declared.default.value if isinstance(declared.default, Scaled) else declared.default
    options["metadata"] = {"declared": declared}
    if value is not None:  # a number is as strongly typed as an array
        options["default"] = np.float64(value) if isinstance(value, int | float) else value
    return dataclasses.field(**options)


def declared(cls: type) -> dict[str, Declaration]:
    """Return the declarations of the fields of a class, by field name."""
    declarations = {field.name: field.metadata.get("declared") for field in dataclasses.fields(cls)}
    return {name: declaration for name, declaration in declarations.items() if declaration is not None}


class Tunable:
    """Base class of parts that may have gains; it collects the names of the gains from the declarations."""

    tunable: ClassVar[tuple[str, ...]] = ()  # gains that tuning may move

    def __init_subclass__(cls, **options: Any) -> None:
        """Add the gains that this class declares to the gains of its bases."""
        super().__init_subclass__(**options)
        if "tunable" not in vars(cls):
            fields = {name: one for name, one in vars(cls).items() if isinstance(one, dataclasses.Field)}
            gains = [name for name, one in fields.items() if getattr(one.metadata.get("declared"), "gain", False)]
            cls.tunable = tuple(dict.fromkeys((*cls.tunable, *gains)))


class Rates(NamedTuple):
    """Usual bounds low / t_f^power and high / t_f^power, or high / h^power for a control period h."""

    low: float
    high: float
    power: int = 1
    sampled: bool = False  # the upper bound follows the control period

    def __call__(self, t_f: float, period: float) -> tuple[float, float]:
        """Return the bounds for a t_f and a control period [s]."""
        return self.low / t_f**self.power, self.high / (period if self.sampled else t_f) ** self.power
