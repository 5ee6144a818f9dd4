"""Random numbers of one quantity, x = low + spread u, and functions that combine them with the nominal numbers.

u has a standard distribution. It is a smooth function of a coordinate that is uniform on (0, 1) or standard normal.
In a trial the coordinates are random. A search for the worst case optimises them instead. Read `RandomNumbers` first.
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

Numbers = Float[Array, " n"]  # numbers of a quantity
Random = Float[Array, " count"]  # random numbers of a quantity
TRUNCATION_SIGMAS = 3.0  # standard deviations at which a truncated normal distribution ends
_INSIDE = math.erf(TRUNCATION_SIGMAS / math.sqrt(2.0))  # of a normal number inside the truncation


class _Standard(NamedTuple):
    """A standard distribution u = scale * transform(coordinates)."""

    coordinates: draws.Distribution
    transform: Callable[[Array], Array]
    scale: float = 1.0


_STANDARD = {
    "normal": _Standard("normal", lambda c: c),
    "truncated_normal": _Standard("uniform", lambda c: jax.lax.erf_inv((2.0 * c - 1.0) * _INSIDE), math.sqrt(2.0)),
    "uniform": _Standard("uniform", lambda c: 2.0 * c - 1.0),  # on (-1, 1)
    "interval": _Standard("uniform", lambda c: c),  # on (0, 1)
    "axis_angle": _Standard("uniform", lambda c: c),  # z component and azimuth of the axis, and angle, each on (0, 1)
    "any_attitude": _Standard("normal", attitude.normalise),  # uniform on SO(3) (Muller, 1959)
}


@pytree
@dataclass(frozen=True)
class RandomNumbers:
    """Independent random numbers (n,).

    Attributes:
        distribution: name of the standard distribution.
        spread: factor of each standard number, (n,), such as a standard deviation or a half-width.
        low: offsets, (n,). None: zeros.
        common: whether all numbers have one common coordinate.
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
        """Return the numbers (n,), in the unit of `spread`, for coordinates c (count,) [-]."""
        standard = _STANDARD[self.distribution]
        numbers = self.spread * standard.scale * standard.transform(c)
        return numbers if self.low is None else self.low + numbers


def interval(low: object, high: object) -> RandomNumbers:
    """Return random numbers that are uniform between low and high, (n,) each, in any unit."""
    return RandomNumbers("interval", vector(high) - vector(low), vector(low))


def axis_angle(smallest: float, largest: float) -> RandomNumbers:
    """Return random rotations by a uniform angle [rad] about an axis that is uniform on the sphere.

    The numbers are the z component [-] and azimuth [rad] of the axis, and the angle.
    """
    return RandomNumbers("axis_angle", vector([2.0, 2.0 * np.pi, largest - smallest]), vector([-1.0, 0.0, smallest]))


def any_attitude() -> RandomNumbers:
    """Return random attitudes that are uniform on SO(3)."""
    return RandomNumbers("any_attitude", vector(np.ones(4)))


# (random numbers (count,), nominal numbers (n,), nominal parts) -> numbers of the trial (n,), see the functions below
Combine = Callable[[Random, Numbers, Any], Numbers]


def replace_nominal(random: Random, nominal: Numbers, parts: Any) -> Random:
    """Return the random numbers (n,) [SI units], without the nominal ones."""
    return random


def add_to_nominal(random: Random, nominal: Numbers, parts: Any) -> Numbers:
    """Return nominal numbers plus random numbers (n,) [SI units]."""
    return nominal + random


def scale_nominal(random: Random, nominal: Numbers, parts: Any) -> Numbers:
    """Return nominal numbers (n,) [SI units] times 1 + random number [-].

    Each random number scales a group of n / count successive numbers.
    """
    groups = nominal.reshape(random.size, nominal.size // max(random.size, 1))
    return jnp.ravel(groups * (1.0 + random)[:, None])


def rotate_nominal(random: Random, nominal: Numbers, parts: Any) -> Numbers:
    """Return the nominal attitude (4,) rotated by a random rotation vector (3,) [rad]."""
    return attitude.multiply(nominal, attitude.from_rotation_vector(random))


def rotate_about_axis(random: Random, nominal: Numbers, parts: Any) -> Numbers:
    """Return the nominal attitude (4,) rotated about a random axis; see `axis_angle` for the numbers [-, rad, rad]."""
    z, azimuth, angle = random[0], random[1], random[2]
    radius = jnp.sqrt(1.0 - z * z)
    axis = jnp.stack([radius * jnp.cos(azimuth), radius * jnp.sin(azimuth), z])
    return rotate_nominal(angle * axis, nominal, parts)


def rotate_from_reference(random: Random, nominal: Numbers, parts: Any) -> Numbers:
    """Return the attitude (4,) [-] of the reference at t = 0, rotated as by `rotate_about_axis`."""
    return rotate_about_axis(random, parts.reference(jnp.zeros_like(parts.t_end)).q, parts)
