"""What every kind of draw has: a map from coordinates to a value.

value = at(coordinates), numbers uniform on (0, 1) or standard normal: a trial's are drawn, and a search for the worst
trial moves them.
"""

from dataclasses import dataclass
from typing import Any, ClassVar, Literal

from jaxtyping import Array, Float

INITIAL_ATTITUDE, INITIAL_STATE, INITIAL_RATE = "initial_attitude", "initial_state", "initial_rate"


INERTIA, REFERENCE = "inertia", "reference"


DISTURBANCE_PHASE, DISTURBANCE_AMPLITUDE = "disturbance_phase", "disturbance_amplitude"


DISTURBANCE_BIAS = "disturbance_bias"


FARTHEST = 3.0  # standard deviations of what is truncated, at most


Drawn = Literal["uniform", "normal"]


OWN = "own"


Coordinates = dict[str, Array]  # of a trial, by the name of what is drawn


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
