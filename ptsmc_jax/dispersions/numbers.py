"""Random numbers of one quantity, x = low + spread u, their combination with nominal numbers, and random inertias.

u has a standard distribution. It is a smooth function of a coordinate that is uniform on (0, 1) or standard normal.
In a trial the coordinates are random. A search for the worst case optimises them instead. Read `RandomNumbers` first.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ptsmc_jax.numerics import attitude, draws, guards, matrices
from ptsmc_jax.numerics.pytrees import Leaf, pytree, vector

Numbers = Float[Array, " n"]  # numbers of a quantity
Random = Float[Array, " count"]  # random numbers of a quantity
TRUNCATION_SIGMAS = 3.0  # standard deviations at which a truncated normal distribution ends
CANDIDATES = 16  # samples of an inertia; the first physical one is used
SLENDER_CANDIDATES = 4  # samples of `_sample_slender` if no candidate is physical
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
    """The distribution of independent random numbers (n,).

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
    """Return the distribution of numbers that are uniform between low and high, (n,) each, in any unit."""
    return RandomNumbers("interval", vector(high) - vector(low), vector(low))


def axis_angle(smallest: float, largest: float) -> RandomNumbers:
    """Return the distribution of rotations by a uniform angle [rad] about an axis that is uniform on the sphere.

    The numbers are the z component [-] and azimuth [rad] of the axis, and the angle.
    """
    return RandomNumbers("axis_angle", vector([2.0, 2.0 * np.pi, largest - smallest]), vector([-1.0, 0.0, smallest]))


def any_attitude() -> RandomNumbers:
    """Return the distribution of attitudes that are uniform on SO(3)."""
    return RandomNumbers("any_attitude", vector(np.ones(4)))


# (random numbers (count,), nominal numbers (n,), nominal parts) -> numbers of the trial (n,), see the functions below
Combine = Callable[[Random, Numbers, Any], Numbers]


def replace_nominal(random: Random, nominal: Numbers, parts: object) -> Random:
    """Return the random numbers without the nominal numbers.

    Args:
        random: random numbers (n,), in the unit of the quantity.
        nominal: nominal numbers (n,), which are not used.
        parts: the nominal parts, which are not used.
    """
    return random


def add_to_nominal(random: Random, nominal: Numbers, parts: object) -> Numbers:
    """Return the sum of nominal numbers and random numbers, (n,).

    Args:
        random: random numbers (n,), in the unit of the quantity.
        nominal: nominal numbers (n,), in the same unit.
        parts: the nominal parts, which are not used.
    """
    return nominal + random


def scale_nominal(random: Random, nominal: Numbers, parts: object) -> Numbers:
    """Return the nominal numbers, (n,), each multiplied by 1 + a random number.

    Each random number scales a group of n / count successive numbers.

    Args:
        random: relative changes (count,) [-], where n is a multiple of count.
        nominal: nominal numbers (n,), in the unit of the quantity.
        parts: the nominal parts, which are not used.
    """
    groups = nominal.reshape(random.size, nominal.size // max(random.size, 1))
    return jnp.ravel(groups * (1.0 + random)[:, None])


def rotate_nominal(random: Random, nominal: Numbers, parts: object) -> Numbers:
    """Return the nominal attitude rotated by a random rotation, a unit quaternion (4,).

    Args:
        random: rotation vector in body axes (3,) [rad].
        nominal: nominal attitude, a unit quaternion (4,).
        parts: the nominal parts, which are not used.
    """
    return attitude.multiply(nominal, attitude.from_rotation_vector(random))


def rotate_about_axis(random: Random, nominal: Numbers, parts: object) -> Numbers:
    """Return the nominal attitude rotated about a random axis, a unit quaternion (4,).

    Args:
        random: z component [-] and azimuth [rad] of the axis, and the angle [rad], (3,), see `axis_angle`.
        nominal: nominal attitude, a unit quaternion (4,).
        parts: the nominal parts, which are not used.
    """
    z, azimuth, angle = random[0], random[1], random[2]
    radius = jnp.sqrt(1.0 - z * z)
    axis = jnp.stack([radius * jnp.cos(azimuth), radius * jnp.sin(azimuth), z])
    return rotate_nominal(angle * axis, nominal, parts)


def rotate_from_reference(random: Random, nominal: Numbers, parts: Any) -> Numbers:
    """Return the reference attitude at t = 0 rotated about a random axis, a unit quaternion (4,).

    Args:
        random: z component [-] and azimuth [rad] of the axis, and the angle [rad], (3,), see `axis_angle`.
        nominal: nominal attitude (4,), which is not used.
        parts: the nominal parts, whose reference is used.
    """
    return rotate_about_axis(random, parts.reference(jnp.zeros_like(parts.t_end)).q, parts)


@pytree
@dataclass(frozen=True)
class RelativeInertia:
    """True inertia with random principal moments and axes.

    Each moment has a relative error from a normal distribution, truncated at `TRUNCATION_SIGMAS` standard deviations.
    A sample is physical if each moment is at most the sum of the other two. The first physical sample of `CANDIDATES`
    samples is used. For slender bodies often no sample is physical. Then the first physical sample of
    `SLENDER_CANDIDATES` samples of `_sample_slender` is used. If none of these is physical either, which happens in
    less than one of 1e10 trials, the trial is nominal.
    """

    moments: Leaf  # (3,) nominal principal moments [kg m^2]
    axes: Leaf  # (3, 3) nominal principal axes in columns [-]
    std: Leaf  # relative standard deviation of each moment, at most 0.3 [-]
    turn: Leaf  # standard deviation of each component of the rotation vector of the axes [rad]
    drawn: ClassVar[draws.Distribution] = "normal"
    count: ClassVar[int] = 3 * CANDIDATES + 3 + 4 * SLENDER_CANDIDATES

    def at(self, c: Float[Array, " count"]) -> tuple[Float[Array, "3 3"], Float[Array, "3 3"]]:
        """Return the inertia [kg m^2] and its inverse, (3, 3) each, for standard normal numbers c (count,) [-]."""
        plain, rotation, slender_c = jnp.split(c, (3 * CANDIDATES, 3 * CANDIDATES + 3))
        candidates = plain.reshape(CANDIDATES, 3), jnp.ones(CANDIDATES, dtype=bool)
        # loops over the samples have a fraction of the code to compile
        permutation = jnp.eye(3)[jnp.argsort(self.moments)]  # outside the loop, because a GPU kernel cannot sort
        slender = jax.lax.map(partial(self._sample_slender, permutation), slender_c.reshape(SLENDER_CANDIDATES, 4))
        errors, accepted = jax.tree.map(lambda *both: jnp.concatenate(both), candidates, slender)

        def find_first(found: tuple[Array, Array], candidate: tuple[Array, Array]) -> tuple[tuple[Array, Array], None]:
            """Return whether a physical sample has been found, and its principal moments; the nominal ones if not.

            Args:
                found: the result for the candidates before.
                candidate: standardised errors (3,) of the moments, and whether the candidate is accepted.
            """
            (is_found, moments), (error, is_accepted) = found, candidate
            sample = self.moments * (1.0 + self.std * error)
            is_physical = (2.0 * jnp.max(sample) <= jnp.sum(sample)) & (jnp.min(sample) > 0.0)
            is_valid = is_accepted & is_physical & (jnp.max(jnp.abs(error)) <= TRUNCATION_SIGMAS)
            return (is_found | is_valid, jnp.where(is_valid & ~is_found, sample, moments)), None

        (_, moments), _ = jax.lax.scan(find_first, (jnp.asarray(False), self.moments), (errors, accepted))
        q = attitude.from_rotation_vector(self.turn * rotation)
        axes = self.axes @ jnp.stack([attitude.rotate(q, axis) for axis in jnp.eye(3)], axis=1)
        return (axes @ jnp.diag(moments)) @ axes.T, (axes @ jnp.diag(1.0 / moments)) @ axes.T

    def _sample_slender(
        self, permutation: Float[Array, "3 3"], n: Float[Array, "4"]
    ) -> tuple[Float[Array, "3"], Array]:
        """Sample moments of a slender body whose two larger moments differ by at most the smallest one.

        Let the nominal moments be a, b >= c with the standardised errors s_a, s_b, s_c. Two other independent normal
        numbers replace s_a and s_b: u = (a s_a - b s_b) / r and v = (b s_a + a s_b) / r with r^2 = a^2 + b^2. The
        sample is physical if |a - b + std r u| <= c (1 + std s_c), an interval of u with the probability W(s_c). So s_c
        has the normal density times W, u given s_c is normal inside the interval, and v is normal.

        s_c is sampled by rejection from a normal number. s_c is accepted with the probability W(s_c) / 2 W(0), -s_c
        with the probability W(-s_c) / 2 W(0), and otherwise the sample is rejected. The sum of both probabilities is at
        most 1, with the largest value at s_c = 0, because both ends of the interval are linear in s_c.

        Args:
            permutation: matrix that sorts the moments in ascending order.
            n: standard normal numbers, (4,).

        Returns:
            The standardised errors (3,) [-] in the original order, and whether the sample is accepted.
        """
        c, a, b = permutation @ self.moments
        r, std = guards.norm(jnp.stack([a, b])), jnp.where(self.std > 0.0, self.std, 1.0)

        def interval_ends(s: Array) -> tuple[Array, Array]:
            """Return the ends of the interval of u, mapped by `_to_uniform`. Their difference is 2 W(s)."""
            limit = c * (1.0 + std * s)
            return _to_uniform((b - a - limit) / (std * r)), _to_uniform((b - a + limit) / (std * r))

        (low, high), plus, minus = (interval_ends(s) for s in (jnp.zeros_like(c), n[0], -n[0]))
        accepts_plus = plus[1] - plus[0] > (high - low) * (1.0 + _to_uniform(n[1]))
        accepts_minus = minus[1] - minus[0] > (high - low) * (1.0 - _to_uniform(n[1]))
        s, (low, high) = guards.select(accepts_plus, (n[0], plus), (-n[0], minus))
        u, v = _to_normal(low + (high - low) * (1.0 + _to_uniform(n[2])) / 2.0), n[3]
        errors = jnp.stack([s, (a * u + b * v) / r, (a * v - b * u) / r])
        return errors @ permutation, accepts_plus | accepts_minus


@pytree
@dataclass(frozen=True)
class CorrelatedInertia:
    """True inertia with six correlated random coordinates. Every value of the coordinates gives a physical body.

    S = tr(J) I / 2 - J is the pseudo-inertia, and R R' is that of the nominal inertia. A lower triangular L with
    S = R L L' R' has six coordinates: the logarithms of its diagonal, and its other entries. S is positive definite if
    and only if each moment is positive and less than the sum of the other two (Rucker and Wensing, IEEE Robotics and
    Automation Letters 7(2), 2022).
    """

    root: Leaf  # (3, 3) R [sqrt(kg) m]
    factor: Leaf  # (6, 6) a factor of the covariance of c [-]
    drawn: ClassVar[draws.Distribution] = "normal"
    count: ClassVar[int] = 6

    def at(self, c: Float[Array, "6"]) -> tuple[Float[Array, "3 3"], Float[Array, "3 3"]]:
        """Return the inertia [kg m^2] and its inverse, (3, 3) each, for standard normal numbers c (6,) [-]."""
        inertia = from_coordinates(self.root, self.factor @ c)
        return inertia, matrices.solve(inertia, jnp.eye(3))


def pseudo_root(inertia: np.ndarray) -> np.ndarray:
    """Return a factor R [sqrt(kg) m] of the pseudo-inertia R R' = tr(J) I / 2 - J of an inertia J [kg m^2], all (3, 3).

    A flat body, whose largest moment is the sum of the others, gets a thickness: its smallest pseudo-moment becomes
    1e-6 of the largest.
    """
    sizes, axes = np.linalg.eigh(0.5 * np.trace(inertia) * np.eye(3) - inertia)
    return np.linalg.cholesky((axes * np.maximum(sizes, 1e-6 * sizes[-1])) @ axes.T)


def from_coordinates(root: Float[Array, "3 3"], c: Float[Array, "6"]) -> Float[Array, "3 3"]:
    """Return the inertia (3, 3) [kg m^2] at coordinates (6,) [-], see `CorrelatedInertia`; zeros give the nominal one.

    Args:
        root: factor of the nominal pseudo-inertia (3, 3) [sqrt(kg) m].
        c: logarithms of the diagonal, then the entries 21, 31, 32.
    """
    lower = jnp.diag(jnp.exp(c[:3])).at[jnp.array([1, 2, 2]), jnp.array([0, 0, 1])].set(c[3:])
    factor = root @ lower
    pseudo = factor @ factor.T
    return jnp.trace(pseudo) * jnp.eye(3) - pseudo


def _to_uniform(normal: Float[Array, "..."]) -> Float[Array, "..."]:
    """Map standard normal numbers to uniform numbers on (-1, 1)."""
    return jax.lax.erf(normal / math.sqrt(2.0))


def _to_normal(uniform: Float[Array, "..."]) -> Float[Array, "..."]:
    """Map uniform numbers on (-1, 1) to standard normal numbers, which are finite also at -1 and 1."""
    end = 1.0 - jnp.finfo(uniform.dtype).eps
    return math.sqrt(2.0) * jax.lax.erf_inv(jnp.clip(uniform, -end, end))
