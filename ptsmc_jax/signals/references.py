"""Reference attitudes with their rates, and the references of plants that are no spacecraft.

A reference is a function from the time to a `Target`. `Reference` is the base of custom reference attitudes.
`interpolate_attitude` returns a reference through samples, with continuous rate and acceleration.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from ptsmc_jax.declare import Scaled, number
from ptsmc_jax.numerics import attitude
from ptsmc_jax.numerics.pytrees import Function, Leaf, Scalar, pytree, vector

MOST_INTERVALS = 1_000_000  # largest size of the search table, which then needs 4 MB
END_SAMPLES = 5  # samples that determine the rate at an end, with an error proportional to h^4 as at other samples
CONJUGATE = np.array([-1.0, -1.0, -1.0, 1.0])  # factors that invert the rotation of a unit quaternion
LARGEST_TURN = np.pi / 2  # largest rotation between two samples [rad], because a rotation by pi has no unique axis


class Target(NamedTuple):
    """Reference attitude, rate and acceleration at one time."""

    q: Array  # (4,) q_f, rotation from reference axes to inertial axes [-]
    w: Array  # (3,) w_f, rate of the reference in reference axes [rad/s]
    w_dot: Array  # (3,) time derivative of w [rad/s^2]


def target_of(path: Callable[[Scalar], Float[Array, "4"]], t: Scalar) -> Target:
    """Return the target at t [s] of an attitude path, which is a unit quaternion as a function of time.

    Rates are exact, by automatic differentiation: w = 2 vec(q* q') and w' = 2 vec(q* q''), because the product
    q*' q' = |q'|^2 has no vector part.
    """
    t = jnp.asarray(t, jnp.result_type(float))
    one = jnp.ones_like(t)
    # one nested jvp traces the path once, with its tangents
    (q, q_dot), (_, q_ddot) = jax.jvp(lambda t: jax.jvp(path, (t,), (one,)), (t,), (one,))
    inverse = attitude.conjugate(q)
    return Target(q, 2.0 * attitude.multiply(inverse, q_dot)[:3], 2.0 * attitude.multiply(inverse, q_ddot)[:3])


@pytree
@dataclass(frozen=True)
class TurningFunction(Function):
    """A custom function of time [s] as a reference. It returns a `Target`, or a quaternion (4,) of any norm [-]."""

    function: Callable  # a pytree such as `jax.tree_util.Partial`, whose numbers are leaves

    def __call__(self, t: Scalar) -> Target:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Return the target at the time t [s]. The rates of a quaternion are its derivatives.

        Raises:
            TypeError: The function returns neither a `Target` nor a quaternion.
        """
        value = self.function(t)
        if isinstance(value, Target):
            return value
        value = jnp.asarray(value) if isinstance(value, list | tuple) else value
        if jnp.shape(value) != (4,):
            raise TypeError(
                f"the reference function returns {value!r}, but must return a quaternion (4,), scalar last, or a Target"
            )
        return target_of(lambda t: attitude.normalise(jnp.asarray(self.function(t))), t)


@dataclass(frozen=True)
class Reference:
    """Base of references that define an attitude as a function of time, also of custom ones: q_f(t) = q attitude(t)."""

    q: Leaf  # (4,) attitude from which the reference rotates
    paced_by: ClassVar[str] = "code"  # scenario key that determines how fast the reference rotates

    def attitude(self, t: Scalar) -> Float[Array, "4"]:
        """Return the unit quaternion (4,) [-] at the time t [s]. It must be twice differentiable for the rates."""
        raise NotImplementedError

    def fastest(self) -> float:
        """Return the largest rate or angular frequency [rad/s], for the choice of the integration step. 0: no limit."""
        return 0.0

    def __call__(self, t: Scalar) -> Target:
        """Return the target at the time t [s]."""
        return target_of(lambda t: attitude.multiply(self.q, self.attitude(t)), t)


@pytree
@dataclass(frozen=True)
class Fixed(Reference):
    """A constant attitude."""

    def __call__(self, t: Scalar) -> Target:
        """Return the target at t [s]."""
        return Target(self.q, jnp.zeros(3), jnp.zeros(3))


@pytree
@dataclass(frozen=True)
class Spin(Reference):
    """A rotation at a constant body rate from the attitude at t = 0: q_f(t) = q(0) exp(w t)."""

    rate: Leaf = number((0.0, 0.0, 0.0), unit="rad/s", meaning="rate of the reference, in its own axes")
    paced_by: ClassVar[str] = "rate"

    def __call__(self, t: Scalar) -> Target:
        """Return the target at t [s]."""
        turned = attitude.multiply(self.q, attitude.from_rotation_vector(self.rate * t))
        return Target(turned, self.rate, jnp.zeros(3))

    def fastest(self) -> float:
        """Return its rate [rad/s]."""
        return float(np.linalg.norm(self.rate))


@pytree
@dataclass(frozen=True)
class Swing(Reference):
    """An oscillation about the attitude, with the rotation vector r = amplitude sin(frequency t + phase) per axis.

    q_f(t) = q exp(r(t)).
    """

    amplitude: Leaf = number((0.1, 0.1, 0.1), unit="rad", meaning="amplitude of the rotation vector on each axis")
    frequency: Leaf = number(
        Scaled((0.1, 0.1, 0.1), time=-1), unit="rad/s", meaning="per axis; default: 0.1 each, scaled to the mission"
    )
    phase: Leaf = number((0.0, 0.0, 0.0), unit="rad", meaning="per axis")
    paced_by: ClassVar[str] = "frequency"

    def fastest(self) -> float:
        """Return its largest rate plus its largest angular frequency [rad/s]."""
        turning = float(np.linalg.norm(np.multiply(self.amplitude, self.frequency)))
        return turning + float(np.max(np.abs(self.frequency)))

    def attitude(self, t: Scalar) -> Float[Array, "4"]:
        """Return the quaternion (4,) of the rotation vector amplitude sin(frequency t + phase)."""
        return attitude.from_rotation_vector(self.amplitude * jnp.sin(self.frequency * t + self.phase))


@pytree
@dataclass(frozen=True)
class Slew(Reference):
    """A slew about one axis, from rest to rest: q_f(t) = q exp(f(t / duration) turn).

    The fraction f(x) = 10 x^3 - 15 x^4 + 6 x^5 rises from 0 to 1, with zero first and second derivatives at both ends.
    """

    turn: Leaf  # (3,) rotation vector from the attitude at t = 0 to the attitude at t = duration and later [rad]
    duration: Leaf = number(
        Scaled(30.0, time=1), above=0.0, unit="s", meaning="duration of the slew; default: 30, scaled to the mission"
    )
    paced_by: ClassVar[str] = "duration"

    def fastest(self) -> float:
        """Return the largest rate of the quintic plus 2 pi / duration [rad/s]."""
        turning = 1.875 * float(np.linalg.norm(self.turn))
        return (turning + 2.0 * np.pi) / float(self.duration)

    def attitude(self, t: Scalar) -> Float[Array, "4"]:
        """Return the quaternion (4,) of a fraction of the turn. The fraction is 1 from `duration` on."""
        x = jnp.clip(t / self.duration, 0.0, 1.0)
        fraction = x * x * x * (10.0 + x * (6.0 * x - 15.0))
        return attitude.from_rotation_vector(fraction * self.turn)


@pytree
@dataclass(frozen=True)
class Origin:
    """The reference of an integrator chain: the origin. Its target is None, not zeros."""

    def __call__(self, t: Scalar) -> None:
        """Return None, because the origin needs no numbers."""


@pytree
@dataclass(frozen=True)
class CurrentTime:
    """The reference of a custom second-order system: the time itself, because F(t, x) defines the error."""

    def __call__(self, t: Scalar) -> Scalar:
        """Return t [s]."""
        return t


@pytree
@dataclass(frozen=True)
class TableReference(Reference):
    """An attitude from a file, exact at its samples, with continuous rate and acceleration in between.

    q_f(t) = s(t) / |s(t)| q, where s is a cubic spline through unit quaternions. It has two continuous derivatives. The
    attitude q is the identity, unless dispersions turn it. Outside of the samples, the attitude is the first or the
    last one, at rest. With the sample interval h, the errors between samples are proportional to h^4 (attitude), h^3
    (rate) and h^2 (acceleration).
    """

    times: Leaf  # (n,) increasing [s]
    samples: Leaf  # (n, 4) unit quaternions without jumps of their signs [-]
    slopes: Leaf  # (n, 4) time derivative of s at the samples [1/s]
    first: Leaf  # (m,) number of the last sample before each of m equal intervals of time, int32
    intervals: Leaf  # number of these intervals per second [1/s]

    def __call__(self, t: Scalar) -> Target:
        """Return the target at the time t [s]."""
        begin, end = self.times[0], self.times[-1]
        inside = (t >= begin - 1e-9 * (end - begin)) & (t <= end + 1e-9 * (end - begin))
        t = jnp.where(inside, t, jnp.clip(t, begin, end))
        interval = jnp.clip(jnp.floor((t - begin) * self.intervals), 0, self.first.shape[0] - 1).astype(jnp.int32)
        k = _entry(self.first, interval)
        k = jnp.where((t >= _entry(self.times, k + 1)) & (k < self.times.shape[0] - 2), k + 1, k)
        t_0, s_0, d_0 = (_entry(table, k) for table in (self.times, self.samples, self.slopes))
        t_1, s_1, d_1 = (_entry(table, k + 1) for table in (self.times, self.samples, self.slopes))
        h = t_1 - t_0
        x, chord = (t - t_0) / h, (s_1 - s_0) / h
        # cubic Hermite polynomial s_0 + h x (d_0 + x (a + x b)), its first and second time derivative
        a, b = 3.0 * chord - 2.0 * d_0 - d_1, d_0 + d_1 - 2.0 * chord
        s = s_0 + h * x * (d_0 + x * (a + x * b))
        s_dot = d_0 + x * (2.0 * a + 3.0 * x * b)
        s_ddot = (2.0 * a + 6.0 * x * b) / h
        square, inverse = jnp.dot(s, s), attitude.conjugate(s)
        # for q = s / |s|, the quaternion q* q' is s* s' / |s|^2 plus a scalar, so their vector parts are equal
        w = 2.0 * attitude.multiply(inverse, s_dot)[:3] / square
        w_dot = 2.0 * attitude.multiply(inverse, s_ddot)[:3] / square - 2.0 * jnp.dot(s, s_dot) / square * w
        to_body = attitude.conjugate(self.q)
        rates = (jnp.where(inside, attitude.rotate(to_body, rate), 0.0) for rate in (w, w_dot))
        return Target(attitude.multiply(attitude.normalise(s), self.q), *rates)


def _entry(table: Array, k: Array) -> Array:
    """Return row k of an array; k: between 0 and the number of rows less 1."""
    return lax.dynamic_index_in_dim(table, k, keepdims=False, allow_negative_indices=False)


def interpolate_attitude(times: np.ndarray, quaternions: np.ndarray, ends: np.ndarray | None = None) -> TableReference:
    """Return the reference through samples of an attitude.

    Args:
        times: (n,) increasing [s], n >= 2.
        quaternions: (n, 4) unit quaternions; their signs are made continuous.
        ends: (2, 3) rates at the first and the last sample in reference axes [rad/s]; None: the rates of polynomials
            through the first and the last `END_SAMPLES` samples.
    """
    samples = with_continuous_signs(quaternions)
    count = count_intervals(times)
    starts = times[0] + (times[-1] - times[0]) / count * np.arange(count)
    last_sample_before = np.clip(np.searchsorted(times, starts, side="right") - 1, 0, len(times) - 2)
    return TableReference(
        vector([0.0, 0.0, 0.0, 1.0]), vector(times), vector(samples),
        vector(_spline_rates(times, samples, ends)),
        jnp.asarray(last_sample_before.astype(np.int32)), vector(count / (times[-1] - times[0])),
    )  # fmt: skip


def _spline_rates(times: np.ndarray, samples: np.ndarray, ends: np.ndarray | None) -> np.ndarray:
    """Return the time derivatives (n, 4) [1/s] of the spline at its samples.

    ends: (2, 3) body rates [rad/s] at the first and the last sample, see `interpolate_attitude`.
    """
    from scipy.interpolate import CubicSpline, KroghInterpolator

    if ends is None:
        sides = (
            (times[:END_SAMPLES], samples[:END_SAMPLES]),
            (times[-END_SAMPLES:][::-1], samples[-END_SAMPLES:][::-1]),
        )
        slopes = [KroghInterpolator(*side).derivative(side[0][0]) for side in sides]
    else:
        slopes = quaternion_rates(samples[[0, -1]], ends)
    return CubicSpline(times, samples, bc_type=[(1, slope) for slope in slopes])(times, 1)


def sample_rates(times: np.ndarray, samples: np.ndarray, ends: np.ndarray | None = None) -> np.ndarray:
    """Return the rates (n, 3) [rad/s] at the samples in reference axes.

    Args:
        times: (n,) [s].
        samples: (n, 4) unit quaternions without jumps of their signs.
        ends: rates at the first and the last sample, as in `interpolate_attitude`.
    """
    return body_rates(samples, _spline_rates(times, samples, ends))


def body_rates(q: np.ndarray, q_dot: np.ndarray) -> np.ndarray:
    """Return the rates 2 vec(q* q') (n, 3) [rad/s] of quaternions (n, 4) with derivatives (n, 4) [1/s]."""
    v, s, v_dot, s_dot = q[:, :3], q[:, 3:], q_dot[:, :3], q_dot[:, 3:]
    return 2.0 * (s * v_dot - s_dot * v - np.cross(v, v_dot))


def quaternion_rates(q: np.ndarray, w: np.ndarray) -> np.ndarray:
    """Return the time derivatives (n, 4) [1/s] of quaternions (n, 4) for the rates w (n, 3) [rad/s] in body axes."""
    v, s = q[:, :3], q[:, 3:]
    return 0.5 * np.hstack([s * w + np.cross(v, w), -np.sum(v * w, axis=1, keepdims=True)])


def with_continuous_signs(quaternions: np.ndarray) -> np.ndarray:
    """Return quaternions (n, 4) with signs that do not jump from one to the next."""
    signs = np.where(np.einsum("ij,ij->i", quaternions[1:], quaternions[:-1]) < 0.0, -1.0, 1.0)
    return quaternions * np.cumprod(np.append(1.0, signs))[:, None]


def count_intervals(times: np.ndarray) -> int:
    """Return the number of equal intervals of time that have at most one sample each."""
    return int(np.ceil((times[-1] - times[0]) / np.min(np.diff(times)) * (1.0 + 1e-9)))
