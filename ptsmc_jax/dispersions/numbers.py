"""Random numbers of one quantity, x = low + spread u, and how they are combined with the nominal numbers.

u has a standard distribution and is a smooth function of a coordinate, which is uniform on (0, 1) or standard normal.
The coordinates of a trial are random; a search for the worst trial moves them.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ptsmc_jax.numerics import attitude, draws
from ptsmc_jax.numerics.pytrees import Leaf, pytree, vector

Numbers = Float[Array, " n"]  # of a quantity
Random = Float[Array, " count"]  # its random numbers
FARTHEST = 3.0  # standard deviations at which a truncated normal distribution ends
_ENDS = math.erf(FARTHEST / math.sqrt(2.0))


class _Standard(NamedTuple):
    """A standard distribution: u = scale times a function of coordinates."""

    coordinates: draws.Distribution
    of: Callable[[Array], Array]
    scale: float = 1.0


_STANDARD = {
    "normal": _Standard("normal", lambda c: c),
    "truncated_normal": _Standard("uniform", lambda c: jax.lax.erf_inv((2.0 * c - 1.0) * _ENDS), math.sqrt(2.0)),
    "uniform": _Standard("uniform", lambda c: 2.0 * c - 1.0),  # on (-1, 1)
    "interval": _Standard("uniform", lambda c: c),  # on (0, 1)
    "axis_angle": _Standard("uniform", lambda c: c),  # height and azimuth of the axis, and angle
    "any_attitude": _Standard("normal", attitude.normalise),  # uniform on SO(3) (Muller, 1959)
}


@pytree
@dataclass(frozen=True)
class RandomNumbers:
    """Independent random numbers (n,).

    Attributes:
        distribution: name of the standard distribution.
        spread: factor on each standard number, (n,), such as a standard deviation or half a width.
        low: numbers that are added, (n,); None: zeros.
        common: whether all numbers have the same coordinate.
    """

    distribution: str = field(metadata={"static": True})
    spread: Leaf
    low: Leaf | None = None
    common: bool = field(default=False, metadata={"static": True})

    @property
    def count(self) -> int:
        """Number of coordinates."""
        return 1 if self.common else self.spread.shape[-1]

    @property
    def drawn(self) -> draws.Distribution:
        """Distribution of the coordinates: "uniform" on (0, 1), or standard "normal"."""
        return _STANDARD[self.distribution].coordinates

    def at(self, c: Float[Array, " count"]) -> Numbers:
        """Return the numbers (n,), in the unit of the spread, from coordinates c (count,) [-]."""
        standard = _STANDARD[self.distribution]
        numbers = self.spread * standard.scale * standard.of(c)
        return numbers if self.low is None else self.low + numbers


def interval(low: object, high: object) -> RandomNumbers:
    """Return numbers that are uniform between low and high, (n,) each, in any unit."""
    return RandomNumbers("interval", vector(high) - vector(low), vector(low))


def axis_angle(smallest: float, largest: float) -> RandomNumbers:
    """Return rotations by an angle that is uniform between two [rad], about an axis that is uniform on the sphere."""
    return RandomNumbers("axis_angle", vector([2.0, 2.0 * np.pi, largest - smallest]), vector([-1.0, 0.0, smallest]))


def any_attitude() -> RandomNumbers:
    """Return attitudes that are uniform on SO(3)."""
    return RandomNumbers("any_attitude", vector(np.ones(4)))


# the numbers of a trial: (random numbers (count,), nominal numbers (n,), nominal parts) -> numbers (n,)
Combine = Callable[[Random, Numbers, Any], Numbers]


def replaced(random: Random, nominal: Numbers, parts: Any) -> Random:
    """Return the random numbers alone (n,) [SI units]."""
    return random


def added(random: Random, nominal: Numbers, parts: Any) -> Numbers:
    """Return the sums (n,) [SI units]."""
    return nominal + random


def scaled(random: Random, nominal: Numbers, parts: Any) -> Numbers:
    """Return nominal numbers (n,) [SI units] times 1 + a random number [-] of each group of n / count numbers."""
    groups = nominal.reshape(random.size, nominal.size // max(random.size, 1))
    return jnp.ravel(groups * (1.0 + random)[:, None])


def turned(random: Random, nominal: Numbers, parts: Any) -> Numbers:
    """Return the nominal attitude (4,) turned by a rotation vector (3,) [rad]."""
    return attitude.multiply(nominal, attitude.from_rotation_vector(random))


def turned_about_axis(random: Random, nominal: Numbers, parts: Any) -> Numbers:
    """Return the nominal attitude (4,) turned about an axis: its height and azimuth, and the angle [-, rad, rad]."""
    height, azimuth, angle = random[0], random[1], random[2]
    radius = jnp.sqrt(1.0 - height * height)
    axis = jnp.stack([radius * jnp.cos(azimuth), radius * jnp.sin(azimuth), height])
    return turned(angle * axis, nominal, parts)


def turned_from_reference(random: Random, nominal: Numbers, parts: Any) -> Numbers:
    """Return the attitude [-] of the reference at t = 0 (4,) turned about an axis, see `turned_about_axis`."""
    return turned_about_axis(random, parts.reference(jnp.zeros_like(parts.t_end)).q, parts)
