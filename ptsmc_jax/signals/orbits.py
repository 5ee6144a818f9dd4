"""Keplerian orbits, directions from a spacecraft on an orbit, and reference attitudes that follow these directions.

The inertial frame has its x axis at the vernal equinox and its z axis along the Earth's rotation axis. Precession,
nutation, polar motion and orbit perturbations are neglected. Start with `Orbit`, then `MissionReference`.

Orbits and directions also run in NumPy. Reading a scenario needs the first attitude for its defaults, and must not
start JAX.
"""

from dataclasses import dataclass, field
from types import ModuleType
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from ptsmc_jax.declare import number
from ptsmc_jax.numerics import attitude, elementary
from ptsmc_jax.numerics.pytrees import Leaf, Scalar, pytree
from ptsmc_jax.signals.references import Reference, Target, target_of, with_continuous_signs

EARTH_RATE = 7.292115e-5  # rotation rate of the Earth, WGS-84 [rad/s]
EQUATORIAL_RADIUS, FLATTENING = 6_378_137.0, 1.0 / 298.257223563  # WGS-84 ellipsoid [m, -]
EARTH_GRAVITY = 3.986004418e14  # gravitational parameter of the Earth [m^3/s^2]
DAY = 86_400.0  # length of a day [s]
OBLIQUITY = np.deg2rad(23.4392911)  # angle between ecliptic and equator at J2000 [rad]
HALLEY_ITERATIONS = 4  # these solve Kepler's equation up to rounding, for eccentricities of at most 0.9
NEWTON_ITERATIONS = 2  # further iterations; only these are differentiated
TURN = 2.0 * np.pi  # [rad]
# declaration of an angle: most numbers of degrees without their unit are refused
ANGLE: dict[str, Any] = {"at_least": -TURN, "at_most": TURN, "allowed": "an angle from -2 pi to 2 pi", "unit": "rad"}


class Place(NamedTuple):
    """Position of the spacecraft on its orbit, at one time or at several times."""

    radial: Any  # (.., 3) unit vector from the Earth's centre, inertial axes
    along: Any  # (.., 3) unit vector of the horizontal velocity
    radius: Any  # (..,) distance from the Earth's centre [m]
    anomaly: Any  # (..,) true anomaly, increasing over many orbits [rad]

    @property
    def normal(self) -> Any:
        """Unit vector (.., 3) of the orbit's angular momentum."""
        return cross(self.radial, self.along)


@pytree
@dataclass(frozen=True)
class Orbit:
    """A Keplerian orbit, and the rotation angle of the Earth, both at t = 0."""

    mean_anomaly: Leaf  # mean anomaly at t = 0 [rad]
    earth_angle: Leaf = number(
        None, **ANGLE, meaning="Earth rotation angle at t = 0; default: from loop.epoch, or 0 without it"
    )
    semi_major_axis: Leaf = number(6_878_137.0, above=0.0, unit="m", meaning="half of the ellipse's longest diameter")
    eccentricity: Leaf = number(0.0, at_least=0.0, at_most=0.9, meaning="0 is a circle")
    inclination: Leaf = number(
        1.7, at_least=0.0, at_most=np.pi, allowed="an angle from 0 to pi", unit="rad",
        meaning="angle between orbit plane and equator",
    )  # fmt: skip
    ascending_node: Leaf = number(0.0, **ANGLE, meaning="right ascension of the ascending node")
    perigee: Leaf = number(0.0, **ANGLE, meaning="argument of perigee, from the ascending node")
    gravitational_parameter: Leaf = number(EARTH_GRAVITY, above=0.0, unit="m^3/s^2", meaning="of the Earth")

    def rate(self) -> Any:
        """Return the mean motion [rad/s]."""
        return (self.gravitational_parameter / self.semi_major_axis**3) ** 0.5

    def fastest(self) -> Any:
        """Return the largest angular rate of the radius vector, at perigee [rad/s]."""
        return self.rate() * (1.0 + self.eccentricity) ** 0.5 / (1.0 - self.eccentricity) ** 1.5

    def anomalies(self, t: Any, xp: ModuleType = jnp) -> tuple[Any, Any]:
        """Return the true and the eccentric anomaly (..,) [rad] at times (..,) [s].

        The eccentric anomaly E solves Kepler's equation M = E - e sin E. With b = e / (1 + sqrt(1 - e^2)) the true
        anomaly is f = E + 2 atan(b sin E / (1 - b cos E)). It has no jumps after a revolution.

        Args:
            t: the times.
            xp: JAX's or NumPy's functions.
        """
        e, mean = self.eccentricity, self.mean_anomaly + self.rate() * t
        eccentric = mean + _eccentric_less_mean(mean, e, xp)
        b = e / (1.0 + (1.0 - e * e) ** 0.5)
        arctan2 = elementary.arctan2 if xp is jnp else np.arctan2
        return eccentric + 2.0 * arctan2(b * xp.sin(eccentric), 1.0 - b * xp.cos(eccentric)), eccentric

    def __call__(self, t: Any, xp: ModuleType = jnp) -> Place:
        """Return the place on the orbit at times (..,) [s]; see `anomalies`."""
        anomaly, eccentric = self.anomalies(t, xp)
        node, tilt, angle = self.ascending_node, self.inclination, self.perigee + anomaly
        cosine, sine = xp.cos(angle), xp.sin(angle)
        zero = 0.0 * angle
        x = xp.stack([xp.cos(node) + zero, xp.sin(node) + zero, zero], axis=-1)  # unit vector to the ascending node
        up = xp.sin(tilt) + zero
        y = xp.stack([-xp.cos(tilt) * xp.sin(node) + zero, xp.cos(tilt) * xp.cos(node) + zero, up], axis=-1)
        cosine, sine = cosine[..., None], sine[..., None]
        radius = self.semi_major_axis * (1.0 - self.eccentricity * xp.cos(eccentric))
        return Place(cosine * x + sine * y, cosine * y - sine * x, radius, anomaly)

    def quaternion(self, t: Scalar) -> Float[Array, "4"]:
        """Return the quaternion (4,) [-] from orbit axes (radial, along-track, normal) to inertial axes at t [s].

        It has no jumps after a revolution.
        """
        node, tilt, half = (
            0.5 * self.ascending_node,
            0.5 * self.inclination,
            0.5 * (self.perigee + self.anomalies(t)[0]),
        )
        orbit_plane = jnp.stack([jnp.sin(tilt) * jnp.cos(node), jnp.sin(tilt) * jnp.sin(node),
                           jnp.cos(tilt) * jnp.sin(node), jnp.cos(tilt) * jnp.cos(node)])  # fmt: skip
        zero = jnp.zeros_like(half)
        return attitude.multiply(orbit_plane, jnp.stack([zero, zero, jnp.sin(half), jnp.cos(half)]))


def cross(a: Any, b: Any) -> Any:
    """Return the cross product of vectors (.., 3), in JAX or NumPy."""
    (a_x, a_y, a_z), (b_x, b_y, b_z) = ((v[..., 0], v[..., 1], v[..., 2]) for v in (a, b))
    xp = np if isinstance(a_x, np.ndarray | np.generic) and isinstance(b_x, np.ndarray | np.generic) else jnp
    return xp.stack([a_y * b_z - a_z * b_y, a_z * b_x - a_x * b_z, a_x * b_y - a_y * b_x], axis=-1)


def unit(v: Any) -> Any:
    """Return vectors (.., 3) with the length 1, in JAX or NumPy."""
    return v / ((v * v).sum(-1) ** 0.5)[..., None]


def _eccentric_less_mean(mean: Any, e: Any, xp: ModuleType) -> Any:
    """Return E - M [rad] of Kepler's equation.

    Halley's iterations start at Danby's value (Celestial Mechanics 40, 1987). They are not differentiated.
    Newton's iterations follow. `NEWTON_ITERATIONS` = 2 of them give three correct derivatives.
    """
    d = 0.85 * e * xp.sign(xp.sin(mean))
    for _ in range(HALLEY_ITERATIONS):
        sine, slope = e * xp.sin(mean + d), 1.0 - e * xp.cos(mean + d)
        step = (d - sine) / slope
        d = d - step / (1.0 - 0.5 * step * sine / slope)
    d = lax.stop_gradient(d) if xp is jnp else d
    for _ in range(NEWTON_ITERATIONS):
        d = d - (d - e * xp.sin(mean + d)) / (1.0 - e * xp.cos(mean + d))
    return d


def mean_anomaly(true_anomaly: float, eccentricity: float) -> float:
    """Return the mean anomaly [rad] of a true anomaly [rad]."""
    e, f = eccentricity, true_anomaly
    b = e / (1.0 + np.sqrt(1.0 - e * e))
    eccentric = f - 2.0 * np.arctan2(b * np.sin(f), 1.0 + b * np.cos(f))
    return float(eccentric - e * np.sin(eccentric))


def ground_point(latitude: float, longitude: float, height: float) -> np.ndarray:
    """Return the Earth-fixed coordinates (3,) [m] of a point near the ground.

    Args:
        latitude: geodetic latitude on WGS-84 [rad].
        longitude: longitude, positive to the east [rad].
        height: height above the ellipsoid [m].
    """
    eccentricity_squared = FLATTENING * (2.0 - FLATTENING)  # square of the first eccentricity
    normal = EQUATORIAL_RADIUS / np.sqrt(1.0 - eccentricity_squared * np.sin(latitude) ** 2)
    equatorial = (normal + height) * np.cos(latitude)
    polar = (normal * (1.0 - eccentricity_squared) + height) * np.sin(latitude)
    return np.array([equatorial * np.cos(longitude), equatorial * np.sin(longitude), polar])


def earth_angle(days: float) -> float:
    """Return the Earth rotation angle [rad] for UT1 days since J2000 (IERS Conventions 2010, eq. 5.15)."""
    return float(2.0 * np.pi * ((0.7790572732640 + 0.00273781191135448 * days + days % 1.0) % 1.0))


@pytree
@dataclass(frozen=True)
class Fixed:
    """A constant direction. All directions are functions with the same arguments."""

    vector: Any  # (3,) vector in this direction, in inertial axes

    def __call__(self, t: Any, place: Place | None, orbit: Orbit | None, xp: ModuleType) -> Any:
        """Return vectors (.., 3) of any length in inertial axes.

        Args:
            t: times (..,) [s].
            place: the place on the orbit, None without an orbit.
            orbit: the orbit, or None.
            xp: JAX's or NumPy's functions.
        """
        return self.vector + 0.0 * xp.asarray(t)[..., None]


@pytree
@dataclass(frozen=True)
class OrbitDirection:
    """The direction to the Earth's centre, of the velocity, or of the orbit's angular momentum."""

    name: str = field(metadata={"static": True})  # "nadir", "velocity" or "orbit_normal"

    def __call__(self, t: Any, place: Place, orbit: Orbit, xp: ModuleType) -> Any:
        """Return vectors (.., 3) of any length in inertial axes at these places (..,); see `Fixed.__call__`."""
        if self.name == "nadir":
            return -place.radial
        if self.name == "orbit_normal":
            return place.normal
        outward, along = orbit.eccentricity * xp.sin(place.anomaly), 1.0 + orbit.eccentricity * xp.cos(place.anomaly)
        return outward[..., None] * place.radial + along[..., None] * place.along


@pytree
@dataclass(frozen=True)
class GroundPoint:
    """The direction from the spacecraft to a point on the rotating Earth."""

    point: Any  # (3,) Earth-fixed coordinates of the point [m]

    def __call__(self, t: Any, place: Place, orbit: Orbit, xp: ModuleType) -> Any:
        """Return vectors (.., 3) from the spacecraft to the point in inertial axes, divided by the orbit radius.

        The arguments are those of `Fixed.__call__`.
        """
        angle = orbit.earth_angle + EARTH_RATE * t
        sine, cosine = xp.sin(angle), xp.cos(angle)
        x, y, z = (self.point[k] for k in range(3))
        target = xp.stack([cosine * x - sine * y, sine * x + cosine * y, z + 0.0 * angle], axis=-1)
        return target / place.radius[..., None] - place.radial


@pytree
@dataclass(frozen=True)
class Sun:
    """The direction from the Earth to the Sun, to 0.01 deg (Astronomical Almanac, low-precision formulas)."""

    longitude: Any  # mean longitude of the Sun at t = 0 [rad]
    anomaly: Any  # mean anomaly of the Sun at t = 0 [rad]

    def __call__(self, t: Any, place: Place | None, orbit: Orbit | None, xp: ModuleType) -> Any:
        """Return unit vectors (.., 3) to the Sun in inertial axes at times t (..,) [s]; see `Fixed.__call__`."""
        g = self.anomaly + np.deg2rad(0.9856003) / DAY * t
        mean = self.longitude + np.deg2rad(0.9856474) / DAY * t
        ecliptic = mean + np.deg2rad(1.915) * xp.sin(g) + np.deg2rad(0.020) * xp.sin(2.0 * g)
        sine = xp.sin(ecliptic)
        return xp.stack([xp.cos(ecliptic), np.cos(OBLIQUITY) * sine, np.sin(OBLIQUITY) * sine], axis=-1)


Direction = Fixed | OrbitDirection | GroundPoint | Sun


def sun_direction(days: float) -> Sun:
    """Return the direction to the Sun, a function of time.

    Args:
        days: time from J2000 to t = 0 [days].
    """
    turn = 2.0 * np.pi
    return Sun(np.deg2rad(280.460 + 0.9856474 * days) % turn, np.deg2rad(357.528 + 0.9856003 * days) % turn)


@dataclass(frozen=True)
class MissionReference(Reference):
    """Base of mission references: q_f(t) = frame(t) mount q, with a moving frame and two constant rotations.

    The attitude q is the identity, unless dispersions turn it.
    """

    mount: Leaf  # (4,) rotation from body axes to the axes of the frame

    def frame(self, t: Scalar) -> Float[Array, "4"]:
        """Return the quaternion (4,) [-] from the axes of the frame to inertial axes at the time t [s]."""
        raise NotImplementedError

    def __call__(self, t: Scalar) -> Target:
        """Return the target at the time t [s]."""
        return target_of(lambda t: attitude.multiply(self.frame(t), attitude.multiply(self.mount, self.q)), t)


@pytree
@dataclass(frozen=True)
class NadirReference(MissionReference):
    """One body axis points to the Earth's centre, another one along the horizontal velocity."""

    orbit: Orbit

    def frame(self, t: Scalar) -> Float[Array, "4"]:
        """Return the quaternion (4,) from orbit axes (radial, along-track, normal) to inertial axes at t [s]."""
        return self.orbit.quaternion(t)


@pytree
@dataclass(frozen=True)
class TwoVectorReference(MissionReference):
    """One body axis points exactly in a primary direction, another one as near as possible to a secondary one."""

    primary: Direction
    secondary: Direction
    orbit: Any  # `Orbit`, or None if no direction depends on it
    anchors: Leaf  # (n, 4) quaternions of the frame, without jumps of their signs, see `anchor_quaternions`
    anchor_rate: Leaf  # number of anchors per second [1/s]

    def matrix(self, t: Any, xp: ModuleType = jnp) -> Any:
        """Return the rotation matrices (.., 3, 3) from the axes of the frame to inertial axes.

        The columns are the primary direction, the normal of both directions, and their cross product (TRIAD; Black,
        AIAA Journal 2(7), 1964).

        Args:
            t: times (..,) [s].
            xp: JAX's or NumPy's functions.
        """
        first, second = self.directions(t, xp)
        second = unit(cross(first, second))
        return xp.stack([first, second, cross(first, second)], axis=-1)

    def directions(self, t: Any, xp: ModuleType = jnp) -> tuple[Any, Any]:
        """Return the primary and the secondary direction, unit vectors (.., 3) in inertial axes; see `matrix`."""
        orbit: Any = self.orbit
        position: Any = None if self.orbit is None else self.orbit(t, xp)
        primary, secondary = (unit(direction(t, position, orbit, xp)) for direction in (self.primary, self.secondary))
        return primary, secondary

    def frame(self, t: Scalar) -> Float[Array, "4"]:
        """Return the quaternion (4,) of `matrix` at t [s], with the sign of the nearest anchor."""
        last = self.anchors.shape[0] - 1
        index = jnp.clip(jnp.floor(t * self.anchor_rate), 0, last).astype(jnp.int32)
        return quaternion_near(self.matrix(t), lax.dynamic_index_in_dim(self.anchors, index, keepdims=False))


@pytree
@dataclass(frozen=True)
class GroundTargetReference(TwoVectorReference):
    """One body axis points to a ground target, another one as near as possible to a second direction."""


def quaternion_near(matrix: Float[Array, "3 3"], anchor: Float[Array, "4"]) -> Float[Array, "4"]:
    """Return the quaternion (4,) of a rotation matrix (3, 3) with the sign that is nearer to another quaternion (4,).

    The matrix q q' is linear in the rotation matrix, and q q' a = q (q.a). The result therefore has no branches. It is
    smooth unless the two attitudes are 180 degrees apart.
    """
    v, s = anchor[:3], anchor[3]
    trace = matrix[0, 0] + matrix[1, 1] + matrix[2, 2]
    antisymmetric = matrix - matrix.T
    axial = jnp.stack([antisymmetric[2, 1], antisymmetric[0, 2], antisymmetric[1, 0]])
    vector = (matrix + matrix.T) @ v + (1.0 - trace) * v + s * axial
    return attitude.normalise(jnp.append(vector, jnp.dot(axial, v) + (1.0 + trace) * s))


def mounting(primary: object, secondary: object) -> np.ndarray:
    """Return the quaternion (4,) from body axes to the axes of `TwoVectorReference.matrix`.

    Args:
        primary: body axis (3,) of the primary direction, of any length.
        secondary: body axis (3,) of the secondary direction.
    """
    from scipy.spatial.transform import Rotation

    first = np.asarray(primary, dtype=float) / np.linalg.norm(np.asarray(primary))
    second = np.cross(first, np.asarray(secondary, dtype=float))
    second /= np.linalg.norm(second)
    return Rotation.from_matrix(np.stack([first, second, np.cross(first, second)])).as_quat()


def nadir_mounting(primary: object, secondary: object) -> np.ndarray:
    """Return the quaternion (4,) from body axes to orbit axes. Nadir is -x and the horizontal velocity is y there.

    Args:
        primary: body axis (3,) that points to the Earth's centre, of any length.
        secondary: body axis (3,) along the velocity.
    """
    from scipy.spatial.transform import Rotation

    to_frame, orbit_to_frame = mounting(primary, secondary), mounting((-1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    return (Rotation.from_quat(orbit_to_frame).inv() * Rotation.from_quat(to_frame)).as_quat()


def anchor_quaternions(matrices: np.ndarray) -> np.ndarray:
    """Return quaternions (n, 4) of rotation matrices (m, 3, 3) at equal intervals of time, without jumps of sign.

    Each anchor is the attitude at the start of one of n equal intervals. m and n are powers of two. n is the smallest
    of them with turns of less than 90 degrees in all intervals, but at most m.
    """
    from scipy.spatial.transform import Rotation

    q = with_continuous_signs(Rotation.from_matrix(matrices).as_quat())
    count = 1
    while count < len(q):
        intervals = q.reshape(count, -1, 4)
        if np.all(np.einsum("kij,kj->ki", intervals, intervals[:, 0]) > np.cos(np.pi / 4)):
            break
        count *= 2
    return q.reshape(count, -1, 4)[:, 0]
