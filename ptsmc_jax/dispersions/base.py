"""Quantities of a trial, checks of their numbers in plans, and the base class of custom draws.

A number of a trial = combine(random number, nominal number), in the unit of its quantity.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ptsmc_jax.dispersions.numbers import Combine, Numbers, Random, added
from ptsmc_jax.numerics import draws, paths
from ptsmc_jax.simulation.rollout import Parts

Coordinates = dict[str, Array]  # of a trial, by the name of the quantity

# names of quantities, and of the streams of their random numbers
INITIAL_ATTITUDE, INITIAL_STATE, INITIAL_RATE = "initial_attitude", "initial_state", "initial_rate"
INERTIA, REFERENCE, OWN = "inertia", "reference", "own"
DISTURBANCE_PHASE, DISTURBANCE_AMPLITUDE = "disturbance_phase", "disturbance_amplitude"
DISTURBANCE_BIAS = "disturbance_bias"


class UnfitError(ValueError):
    """Numbers of a plan that cannot be simulated; `row` is the first such row, and the message the allowed values."""

    def __init__(self, row: int, allowed: str):
        super().__init__(allowed)
        self.row = row

    @staticmethod
    def check(fit: np.ndarray, allowed: Callable[[int], str]) -> None:
        """Raise it for the first row that is not fit.

        Args:
            fit: whether each row is fit, (rows,).
            allowed: returns the allowed values in words, for the index of the row.
        """
        if not fit.all():
            row = int(np.argmin(fit))
            raise UnfitError(row, allowed(row))


Checked = Callable[[np.ndarray], np.ndarray]
Given = Mapping[str, np.ndarray]  # numbers (rows, n) of a plan, by the names of quantities


class Quantity(NamedTuple):
    """Numbers (n,) of a trial that may differ from the nominal ones.

    Attributes:
        columns: returns the names of their columns in rows and plans; empty if the parts have no such quantity.
        read: returns the numbers of the parts.
        write: returns the parts with other numbers.
        combine: returns the numbers of a trial; a mapping has one such function for each distribution.
        size: returns the count of random numbers; None: there is one for each column.
        unit: a spacecraft's, of all numbers or of each.
        checked: returns the simulated numbers for those of a plan, (rows, n) each; raises UnfitError.
        check_with: raises UnfitError if other quantities of the plan, or the parts, forbid the numbers.
        categories: columns that number several things, such as wheels, so that their order means nothing.
        hardware: whether it is an error of the hardware, or of the modes, that flight software does not know.
    """

    columns: Callable[[Parts], list[str]]
    read: Callable[[Parts], Numbers]
    write: Callable[[Parts, Numbers], Parts]
    combine: Combine | Mapping[str, Combine] = added
    size: Callable[[Parts], int] | None = None
    unit: str | tuple[str, ...] = "-"
    checked: Checked = lambda rows: rows
    check_with: Callable[[Given, Parts], None] = lambda given, parts: None
    categories: tuple[str, ...] = ()
    hardware: bool = False

    def count(self, parts: Parts) -> int:
        """Return how many random numbers the quantity has in these parts."""
        return len(self.columns(parts)) if self.size is None else self.size(parts)

    def dispersed(self, parts: Parts, random: Random, distribution: str) -> Parts:
        """Return the parts with this quantity dispersed.

        Args:
            parts: nominal parts.
            random: random numbers of the quantity, (count,) [SI units or -].
            distribution: of the random numbers.
        """
        combine = self.combine if callable(self.combine) else self.combine[distribution]
        return self.write(parts, combine(random, self.read(parts), parts))


def at_path(
    path: str,
    names: str | Sequence[str],
    default: object = None,
    present: Callable[[Parts], bool] = lambda parts: True,
    **others: Any,
) -> Quantity:
    """Return the quantity at one path of the parts, such as `sensors.rate_noise`.

    Args:
        path: fields from the parts to a number or a vector. Parts without one of the fields have no such quantity.
        names: names of the columns, or the beginning of their numbered names; a single number has no number.
        default: the value if the field is None; None: there is no such quantity.
        present: returns whether parts that have the fields have the quantity.
        others: further fields of `Quantity`.
    """

    def value(parts: Parts) -> Any:
        if not paths.exists(parts, path):
            return None
        found = paths.get(parts, path)
        return default if found is None else found

    def columns(parts: Parts) -> list[str]:
        found = value(parts) if present(parts) else None
        if found is None:
            return []
        if not isinstance(names, str):
            return list(names)
        return numbered(names, np.size(found)) if np.ndim(found) else [names.rstrip("_")]

    def write(parts: Parts, new: Numbers) -> Parts:
        return paths.put(parts, path, new.reshape(np.shape(value(parts))))

    return Quantity(columns, lambda parts: jnp.ravel(jnp.asarray(value(parts))), write, **others)


def fitting(fits: Callable[[np.ndarray], np.ndarray], allowed: str) -> Checked:
    """Return a check of rows (rows, n) that raises UnfitError for the first row that is not fit.

    Args:
        fits: (rows, n) -> (rows, ..) bool, all true for a row that is fit [SI units].
        allowed: the allowed values, in words.
    """

    def checked(rows: np.ndarray) -> np.ndarray:
        """Return these rows (rows, n) [SI units] unchanged; raise UnfitError if a row is not fit."""
        UnfitError.check(np.asarray(fits(rows).reshape(len(rows), -1).all(axis=1)), lambda row: allowed)
        return rows

    return checked


not_negative = fitting(lambda numbers: numbers >= 0.0, "numbers of at least 0")
positive = fitting(lambda numbers: numbers > 0.0, "a number greater than 0")


def reason(check: Callable[..., Any], *values: Any) -> str:
    """Return the message of the ValueError that a check raises for these values; empty if it raises none."""
    try:
        check(*values)
    except ValueError as error:
        return str(error)
    return ""


def numbered(name: str, count: int) -> list[str]:
    """Return names that are numbered from 1."""
    return [f"{name}{k + 1}" for k in range(count)]


@dataclass(frozen=True)
class Draw:
    """Base class of custom draws: they make the parts of a trial from `count` random numbers.

    drawn: "normal", standard normal numbers, or "uniform", on (0, 1).
    """

    count: ClassVar[int] = 1
    drawn: ClassVar[draws.Distribution] = "normal"

    def at(self, c: Float[Array, " count"], parts: Any) -> Any:
        """Return the parts as these numbers (count,) [-] change them, by `dataclasses.replace`; shapes stay."""
        raise NotImplementedError

    def values(self, c: Float[Array, " count"]) -> dict[str, Array]:
        """Return the numbers of a trial's row by name; by default the random numbers [-], own_1 and so on."""
        return {f"{OWN}_{k + 1}": c[k] for k in range(self.count)}
