"""What every kind of draw has: a map from coordinates to a value, and what a quantity of a trial is.

Coordinates are numbers uniform on (0, 1) or standard normal: a trial's are drawn, and a search for the worst trial
moves them: value = at(coordinates).
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

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


class UnfitError(ValueError):
    """Numbers that cannot be flown: in which row, and what is allowed there."""

    def __init__(self, row: int, allowed: str):
        super().__init__(allowed)
        self.row = row

    @staticmethod
    def check(fit: Any, allowed: Callable[[int], str]) -> None:
        """Raise it of the first row that is not fit, (rows,) bool; allowed: what that row must have, in words."""
        if not fit.all():
            row = int(np.argmin(fit))
            raise UnfitError(row, allowed(row))


class Quantity(NamedTuple):
    """One of `QUANTITIES`. Its numbers (n,) stand in as many columns."""

    columns: Callable[[Parts], list[str]]  # their names; empty where these parts have no such quantity
    read: Callable[[Parts], Numbers]
    write: Callable[[Parts, Numbers], Parts]
    # numbers (rows, n) as a plan gives them -> as they are flown; raises UnfitError
    checked: Callable[[np.ndarray], np.ndarray] = lambda given: given


def numbered(name: str, count: int) -> list[str]:
    """Names of so many numbers, counted from 1."""
    return [f"{name}{k + 1}" for k in range(count)]


def not_negative(given: np.ndarray) -> np.ndarray:
    """The numbers (rows, n), of which none is negative, as `Quantity.checked` takes them in any unit [-]."""
    UnfitError.check((given >= 0.0).all(axis=1), lambda k: "numbers of at least 0")
    return given


def positive(given: np.ndarray) -> np.ndarray:
    """The numbers (rows, n), which must all be positive, as `Quantity.checked` takes them in any unit [-]."""
    UnfitError.check((given > 0.0).all(axis=1), lambda k: "a number greater than 0")
    return given


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
