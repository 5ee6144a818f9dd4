"""The type of a dispersed quantity, validation of its values in run tables, and the base class of custom dispersions.

Read `Quantity` first. In a trial, each number of a quantity is combine(random number, nominal number), in the unit of
the quantity. A run table gives the values of quantities for each trial instead.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ptsmc_jax.dispersions.numbers import Combine, Numbers, Random, add_to_nominal
from ptsmc_jax.numerics import draws, paths
from ptsmc_jax.simulation.assembly import Parts

Coordinates = dict[str, Array]  # standard random numbers of a trial, by the name of the quantity

# names of quantities, which are also the names of their random streams
INITIAL_ATTITUDE, INITIAL_STATE, INITIAL_RATE = "initial_attitude", "initial_state", "initial_rate"
INERTIA, REFERENCE = "inertia", "reference"
CUSTOM = "own"  # [dispersion] custom; the name of its stream must not change, because the random numbers depend on it
DISTURBANCE_PHASE, DISTURBANCE_AMPLITUDE = "disturbance_phase", "disturbance_amplitude"
DISTURBANCE_BIAS = "disturbance_bias"


class UnfitError(ValueError):
    """Raised for values of a run table that cannot be simulated.

    The message states the allowed values. `row` is the index of the first invalid row.
    """

    def __init__(self, row: int, allowed: str):
        super().__init__(allowed)
        self.row = row

    @staticmethod
    def check(is_valid: np.ndarray, allowed: Callable[[int], str]) -> None:
        """Raise UnfitError for the first invalid row.

        Args:
            is_valid: whether each row is valid, (rows,).
            allowed: (index of the row) -> allowed values in words.
        """
        if not is_valid.all():
            row = int(np.argmin(is_valid))
            raise UnfitError(row, allowed(row))


Validator = Callable[[np.ndarray], np.ndarray]
TableValues = Mapping[str, np.ndarray]  # values (rows, n) of a run table, by the name of the quantity


class Quantity(NamedTuple):
    """A quantity of n numbers that can differ from trial to trial, such as the initial attitude or the torque limits.

    Attributes:
        columns: (parts) -> names of its columns in result files and run tables. Empty if the parts have no such
            quantity.
        read: (parts) -> numbers (n,).
        write: (parts, numbers) -> parts with these numbers.
        combine: (random numbers, nominal numbers, parts) -> numbers of the trial, or one such function by distribution.
        size: (parts) -> number of random numbers. None: one for each column.
        unit: unit for a spacecraft, of all numbers or of each number.
        validate: (values of a run table (rows, n)) -> values to simulate (rows, n). It raises UnfitError for invalid
            values.
        check_together: (all values of a run table, parts) -> None. It raises UnfitError if values of several quantities
            contradict each other.
        hardware: whether it is an error of the hardware or of the flexible modes that the flight software does not
            know.
    """

    columns: Callable[[Parts], list[str]]
    read: Callable[[Parts], Numbers]
    write: Callable[[Parts, Numbers], Parts]
    combine: Combine | Mapping[str, Combine] = add_to_nominal
    size: Callable[[Parts], int] | None = None
    unit: str | tuple[str, ...] = "-"
    validate: Validator = lambda rows: rows
    check_together: Callable[[TableValues, Parts], None] = lambda table, parts: None
    hardware: bool = False

    def count(self, parts: Parts) -> int:
        """Return the number of random numbers of the quantity."""
        return len(self.columns(parts)) if self.size is None else self.size(parts)

    def disperse(self, parts: Parts, random: Random, distribution: str) -> Parts:
        """Return the parts with the quantity of a trial.

        Args:
            parts: nominal parts.
            random: random numbers of the quantity, (count,) [SI units or -].
            distribution: name of the distribution of the random numbers, which selects the function of `combine`.
        """
        combine = self.combine if callable(self.combine) else self.combine[distribution]
        return self.write(parts, combine(random, self.read(parts), parts))


def field_quantity(
    path: str,
    names: str | Sequence[str],
    default: object = None,
    present: Callable[[Parts], bool] = lambda parts: True,
    **others: Any,
) -> Quantity:
    """Return the quantity whose numbers are a field of the parts, such as `sensors.rate_noise`.

    Args:
        path: path from the parts to a number or an array. If it does not exist, the parts have no such quantity.
        names: names of the columns, or a prefix for numbered names. A scalar has the prefix as its name.
        default: value if the field is None, or (parts) -> value. None: the parts then have no such quantity.
        present: (parts) -> whether parts with this field have the quantity.
        **others: further fields of `Quantity`.
    """

    def value(parts: Parts) -> Any:
        if not paths.exists(parts, path):
            return None
        stored = paths.get(parts, path)
        if stored is not None:
            return stored
        return default(parts) if callable(default) else default

    def columns(parts: Parts) -> list[str]:
        current = value(parts) if present(parts) else None
        if current is None:
            return []
        if not isinstance(names, str):
            return list(names)
        return number_names(names, np.size(current)) if np.ndim(current) else [names.rstrip("_")]

    def write(parts: Parts, new: Numbers) -> Parts:
        return paths.put(parts, path, new.reshape(np.shape(value(parts))))

    return Quantity(columns, lambda parts: jnp.ravel(jnp.asarray(value(parts))), write, **others)


def validator(is_valid: Callable[[np.ndarray], np.ndarray], allowed: str) -> Validator:
    """Return a validator for `Quantity.validate` that raises UnfitError for the first invalid row.

    Args:
        is_valid: (rows, n) [SI units] -> (rows, ..) bool, all true for a valid row.
        allowed: the allowed values, in words.
    """

    def validate(rows: np.ndarray) -> np.ndarray:
        """Return the rows (rows, n) [SI units] unchanged. Raise UnfitError if `is_valid` is false for a row."""
        UnfitError.check(np.asarray(is_valid(rows).reshape(len(rows), -1).all(axis=1)), lambda row: allowed)
        return rows

    return validate


not_negative = validator(lambda numbers: numbers >= 0.0, "numbers of at least 0")
positive = validator(lambda numbers: numbers > 0.0, "a number greater than 0")


def error_message(check: Callable[..., object], *values: object) -> str:
    """Return the message of the ValueError that a check raises for these values, or "" if it raises none."""
    try:
        check(*values)
    except ValueError as error:
        return str(error)
    return ""


def number_names(name: str, count: int) -> list[str]:
    """Return names with numbers from 1 to count."""
    return [f"{name}{k + 1}" for k in range(count)]


@dataclass(frozen=True)
class Draw:
    """Base class of custom dispersions, which compute the parts of a trial from random numbers."""

    count: ClassVar[int] = 1  # how many random numbers
    drawn: ClassVar[draws.Distribution] = "normal"  # their distribution: standard "normal", or "uniform" on (0, 1)

    def at(self, c: Float[Array, " count"], parts: Any) -> Any:
        """Return the parts of a trial for random numbers c (count,) [-]. Shapes and dtypes must not change."""
        raise NotImplementedError

    def values(self, c: Float[Array, " count"]) -> dict[str, Array]:
        """Return numbers for the result file by column; by default the random numbers [-] as custom_1, custom_2."""
        return {f"custom_{k + 1}": c[k] for k in range(self.count)}
