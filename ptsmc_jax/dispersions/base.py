"""What every kind of draw has: a map from coordinates to a value, and what a quantity of a trial is.

Coordinates are numbers uniform on (0, 1) or standard normal: a trial's are drawn, and a search for the worst trial
moves them: value = at(coordinates).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ptsmc_jax.numerics import draws
from ptsmc_jax.simulation.rollout import Parts

Numbers = Float[Array, " n"]
Drawn = draws.Distribution
Coordinates = dict[str, Array]  # of a trial, by the name of what is drawn

# names of what is drawn, and of the streams that it is drawn from
INITIAL_ATTITUDE, INITIAL_STATE, INITIAL_RATE = "initial_attitude", "initial_state", "initial_rate"
INERTIA, REFERENCE, OWN = "inertia", "reference", "own"
DISTURBANCE_PHASE, DISTURBANCE_AMPLITUDE = "disturbance_phase", "disturbance_amplitude"
DISTURBANCE_BIAS = "disturbance_bias"
FARTHEST = 3.0  # standard deviations of what is truncated, at most
NEAR = 1e-6  # of 1, the norm of a unit vector, or quaternion, that a plan gives
PAIRS = [(i, j) for i in range(3) for j in range(i, 3)]  # the upper triangle, in the order of the inertia's columns


class UnfitError(ValueError):
    """Numbers that cannot be flown: in which row, and what is allowed there."""

    def __init__(self, row: int, allowed: str):
        super().__init__(allowed)
        self.row = row

    @staticmethod
    def check(fit: np.ndarray, allowed: Callable[[int], str]) -> None:
        """Raise it of the first row that is not fit, (rows,) bool; allowed: what that row must have, in words."""
        if not fit.all():
            row = int(np.argmin(fit))
            raise UnfitError(row, allowed(row))


Checked = Callable[[np.ndarray], np.ndarray]
Given = Mapping[str, np.ndarray]  # numbers (rows, n) that a plan gives, by the names of `QUANTITIES`


class Quantity(NamedTuple):
    """One of `QUANTITIES`. Its numbers (n,) stand in as many columns."""

    columns: Callable[[Parts], list[str]]  # their names; empty where these parts have no such quantity
    read: Callable[[Parts], Numbers]
    write: Callable[[Parts, Numbers], Parts]
    checked: Checked = lambda rows: rows  # numbers (rows, n) of a plan -> as they are flown; raises UnfitError
    check_with: Callable[[Given, Parts], None] = lambda given, parts: None  # raises it where others forbid them
    unit: str | tuple[str, ...] = "-"  # a spacecraft's, of all its numbers or of each
    categories: tuple[str, ...] = ()  # columns that say which of several things: of such numbers none is more


def of_field(
    part: str,
    key: str,
    columns: list[str],
    nominal: Sequence[float] = (),
    checked: Checked = lambda rows: rows,
    unit: str = "-",
) -> Quantity:
    """The quantity that one field of a part holds, such as `rate_scale` of `sensors`.

    Args:
        part: field of `Parts`.
        key: field of that part; where the part has none, there is no such quantity.
        columns: names of its numbers (n,) [SI units].
        nominal: the numbers where the field is None.
        checked: see `Quantity`.
        unit: likewise.
    """

    def read(parts: Parts) -> Numbers:
        value = getattr(getattr(parts, part), key)
        return jnp.asarray(nominal) if value is None else value

    def write(parts: Parts, numbers: Numbers) -> Parts:
        return replace(parts, **{part: replace(getattr(parts, part), **{key: numbers})})

    there = Quantity(lambda parts: columns if hasattr(getattr(parts, part), key) else [], read, write)
    return there._replace(checked=checked, unit=unit)


def fitting(fits: Callable[[np.ndarray], np.ndarray], allowed: str) -> Checked:
    """Checks rows (rows, n) of numbers, in any unit [-], and leaves them as they are.

    fits: (rows, n) -> (rows, ..) bool, all of them where a row is fit; allowed: what a row must have, in words.
    """

    def checked(rows: np.ndarray) -> np.ndarray:
        """The rows (rows, n) as they are, in any unit [-]; raises UnfitError where one is not fit."""
        UnfitError.check(np.asarray(fits(rows).reshape(len(rows), -1).all(axis=1)), lambda row: allowed)
        return rows

    return checked


not_negative = fitting(lambda numbers: numbers >= 0.0, "numbers of at least 0")
positive = fitting(lambda numbers: numbers > 0.0, "a number greater than 0")


def tensors(rows: np.ndarray) -> np.ndarray:
    """Symmetric tensors (rows, 3, 3) of their upper triangles (rows, 6), as `PAIRS` has them [kg m^2]."""
    full = np.zeros((len(rows), 3, 3))
    for k, (i, j) in enumerate(PAIRS):
        full[:, i, j] = full[:, j, i] = rows[:, k]
    return full


def reason(check: Callable[..., Any], *values: Any) -> str:
    """What a check says that refuses these values, in any unit [-], by a ValueError."""
    try:
        check(*values)
    except ValueError as error:
        return str(error)
    return ""


def numbered(name: str, count: int) -> list[str]:
    """Names of so many numbers, counted from 1."""
    return [f"{name}{k + 1}" for k in range(count)]


def plant_of(parts: Parts) -> Any:
    """The true plant, which has the fields of its own kind besides those of every plant [SI units]."""
    return parts.plant


@dataclass(frozen=True)
class Draw:
    """What draws of one's own are derived from: the parts of a trial from `count` numbers that are drawn for it.

    drawn: "normal", standard normal numbers, or "uniform", on (0, 1).
    """

    count: ClassVar[int] = 1
    drawn: ClassVar[Drawn] = "normal"

    def at(self, c: Float[Array, " count"], parts: Any) -> Any:
        """The parts with what these numbers (count,) [-] make of them, by `dataclasses.replace`; shapes stay."""
        raise NotImplementedError

    def values(self, c: Float[Array, " count"]) -> dict[str, Array]:
        """What a trial's row says of it, numbers by name; by default those drawn [-], own_1 and so on."""
        return {f"{OWN}_{k + 1}": c[k] for k in range(self.count)}
