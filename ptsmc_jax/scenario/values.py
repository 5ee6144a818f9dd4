"""Base class `Table` of all tables of scenario files, and types of values with their ranges and descriptions."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, NamedTuple

import msgspec
from msgspec import Meta

from ptsmc_jax.declare import Scaled

Number = Annotated[float, Meta(description="a number")]
Positive = Annotated[float, Meta(gt=0, description="a number greater than 0")]
NotNegative = Annotated[float, Meta(ge=0, description="a number, at least 0")]
Truth = Annotated[bool, Meta(description="true or false")]
Count = Annotated[int, Meta(ge=1, description="a whole number, at least 1")]
Three = Annotated[tuple[float, float, float], Meta(description="three numbers")]
Numbers = Annotated[tuple[float, ...], Meta(min_length=1, description="a list of numbers, one for each state")]
NotNegatives = Annotated[
    tuple[NotNegative, ...], Meta(min_length=1, description="a list of numbers of at least 0, one for each state")
]
Four = Annotated[tuple[float, float, float, float], Meta(description="four numbers")]
Matrix = Annotated[tuple[Three, Three, Three], Meta(description="three rows of three numbers")]
Interval = Annotated[tuple[float, float], Meta(description="two numbers, the lower bound first")]
Inertia = Annotated[
    tuple[int | float | tuple[int | float, ...], ...],
    Meta(description="three principal moments or a symmetric 3x3 tensor"),
]
Quantile = Annotated[float, Meta(gt=0, lt=1, description="a number between 0 and 1")]

# Types of keys whose default depends on other keys. Their value is None until `reading.resolve` fills it in.
ABSENT: Any = None
if TYPE_CHECKING:
    ResolvedPositive = float
else:
    ResolvedPositive = Positive | None

UNIT_OF_D = "unit of d"  # placeholder in declared units: replaced by the unit of the plant's disturbance d, if known
MOST_STEPS = 200_000  # largest number of integration steps in a run


class Meaning(NamedTuple):
    """Meaning and unit of a key."""

    text: str
    unit: str = ""


class Table(msgspec.Struct, kw_only=True, frozen=True, omit_defaults=False):
    """A table of a scenario file."""

    scaled: ClassVar[Mapping[str, Scaled]] = {}  # defaults that follow the mission

    def __repr__(self) -> str:
        keys = {key: getattr(self, key) for key in self.__struct_fields__}
        return f"{type(self).__name__}({', '.join(f'{key}={v!r}' for key, v in keys.items() if v is not None)})"


Kinds = Mapping[str, type[Table]]  # classes of a table by kind, the default first


def rounded(value: float) -> float:
    """Return a number rounded to 15 digits, which removes the rounding error of a product.

    >>> 3 * 0.1, rounded(3 * 0.1)
    (0.30000000000000004, 0.3)
    """
    return float(f"{value:.15g}")
