"""Pointing error indices (ECSS-E-ST-60-10C), accumulated interval by interval.

No history is kept, but that of the window that time is in, where a limit asks for the time in which the relative error
is within it. Of an error e(t), seen over an observation of consecutive windows of length D: the absolute error |e(t)|,
its mean over a window, the relative error |e(t) - mean of the window that t lies in|, and the drift, the difference
between the means of two windows. Each is reported by its largest value in the observation: about each axis, and as the
half-cone of the boresight. The error is that of the attitude (APE, MPE, RPE, PDE), or of what the law is told of it
(AKE, MKE, RKE).
"""

from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ptsmc_jax.numerics import attitude, elementary, guards
from ptsmc_jax.numerics.pytrees import Leaf, Scalar, pytree

Vector = Float[Array, "3"]

AXES = ("x", "y", "z", "boresight")  # of the indices: body axes, and the half-cone

# across the boresight, over half a turn: what is largest in any of them is, as a half-cone, known to 1/cos(pi/32) - 1,
# 0.5 %, and said so much larger
DIRECTIONS = 16
ALONG = np.pi * np.arange(DIRECTIONS) / DIRECTIONS
ENOUGH = 1e-9  # of a window: one that ends so shortly after an interval ends with it


@pytree
@dataclass(frozen=True)
class Pointing:
    """What is observed from when on."""

    frame: Leaf  # (3, 3) rows: the boresight, and two directions across it, in body axes
    after: Leaf  # of t_f, when the observation begins [s]
    window: Leaf  # D [s]
    limits: dict[str, Leaf] = field(default_factory=dict)  # [rad] by metric: the time within is told of these
    samples: int = field(default=0, metadata={"static": True})  # most in a window; 0: as many as the run has

    def of_run(self, steps: int) -> "Pointing":
        """The same for a run of so many steps."""
        return self if self.samples else replace(self, samples=steps)

    def segments(self, index: str) -> int:
        """How many segments of a window are kept for shares of time of a relative index; 0: no limit asks for them.

        One more than the samples that part it, and one of no length where the window before ended with a sample.
        """
        return self.samples + 2 if any(name.startswith(index) for name in self.limits) else 0


def across(boresight: Any) -> np.ndarray:
    """The frame of a boresight (3,) of any length but 0: rows are it and two directions across it."""
    b = np.asarray(boresight, dtype=float)
    b = b / np.linalg.norm(b)
    first = np.cross(b, np.eye(3)[np.argmin(np.abs(b))])
    first /= np.linalg.norm(first)
    return np.stack([b, first, np.cross(b, first)])


class Seen(NamedTuple):
    """An error at one time."""

    axes: Array  # (3,) rotation vector in body axes [rad]
    cross: Array  # (2,) across the boresight: where it points, as an angle and its direction [rad]

    @property
    def flat(self) -> Array:
        """(5,)."""
        return jnp.concatenate([self.axes, self.cross])


def seen(q: Float[Array, "4"], target: Float[Array, "4"], frame: Float[Array, "3 3"]) -> Seen:
    """The error of an attitude from a target's [-]."""
    off = attitude.multiply(attitude.conjugate(target), q)
    off = jnp.where(off[3] < 0.0, -off, off)
    return Seen(attitude.rotation_vector(off[:3]), _cone(attitude.rotate(off, frame[0]), frame))


def _cone(pointed: Vector, frame: Float[Array, "3 3"]) -> Float[Array, "2"]:
    """The angle from the boresight to a unit vector, and its direction: an arc on the sphere, laid flat [rad]."""
    side = frame[1:] @ pointed
    square = jnp.sum(side * side)
    small = square < 1e-12  # the angle is then its sine to a part in 1e12
    size = jnp.sqrt(jnp.where(small, 1.0, square))
    angle = elementary.arctan2(size, jnp.where(small, 1.0, jnp.dot(frame[0], pointed)))
    return side * jnp.where(small, 1.0 + square / 6.0, angle / size)


class Course(NamedTuple):
    """An error over an interval: the cubic through both ends and slopes (Hermite), (5,) each, see `Seen.flat`."""

    start: Array  # [rad]
    start_rate: Array  # [rad/s]
    end: Array
    end_rate: Array
    length: Scalar  # of the interval [s]

    def at(self, x: Scalar) -> Array:
        """The error where a share x of the interval has passed."""
        rise = self.end - self.start
        bend = self.length * self.start_rate - rise, rise - self.length * self.end_rate
        return self.start + x * rise + x * (1.0 - x) * ((1.0 - x) * bend[0] + x * bend[1])

    def integral(self, x: Scalar) -> Array:
        """Its integral from the start until then [rad s]."""
        rise = self.end - self.start
        bend = self.length * self.start_rate - rise, rise - self.length * self.end_rate
        square = x * x
        first = square * (0.5 - x * (2.0 / 3.0 - x / 4.0))
        second = square * x * (1.0 / 3.0 - x / 4.0)
        return self.length * (x * self.start + square / 2.0 * rise + first * bend[0] + second * bend[1])


def course(start: tuple, end: tuple, frame: Float[Array, "3 3"], length: Scalar) -> Course:
    """The error of an attitude between two (state, target)."""

    def moving(x: Any, target: Any) -> tuple[Array, Array]:
        rates = attitude.derivative(x.q, x.w), attitude.derivative(target.q, target.w)
        return jax.jvp(lambda q, of: seen(q, of, frame).flat, (x.q, target.q), rates)

    return Course(*moving(*start), *moving(*end), length)


def held(q: Float[Array, "4"], true: Float[Array, "4"], frame: Float[Array, "3 3"], length: Scalar) -> Course:
    """The error of a sample, which is what is known until the next one."""
    error = seen(q, true, frame).flat
    return Course(error, jnp.zeros_like(error), error, jnp.zeros_like(error), length)


class Path(NamedTuple):
    """The error in the window that time is in, segment by segment: its mean is known at its end only."""

    ends: Array  # (segments, 2, 5) at the start and the end of each [rad]
    lengths: Array  # (segments,) [s], 0 of those to come
    filled: Array  # how many there are

    def added(self, start: Array, end: Array, length: Scalar) -> "Path":
        """With one segment more; beyond the last there is no room, which `filled` tells."""
        return Path(
            self.ends.at[self.filled].set(jnp.stack([start, end])),
            self.lengths.at[self.filled].set(length),
            self.filled + 1,
        )

    def emptied(self) -> "Path":
        """Without segments."""
        return Path(self.ends, jnp.zeros_like(self.lengths), jnp.zeros_like(self.filled))

    def time_beyond(self, mean: Array, limits: Float[Array, "4"]) -> Float[Array, "4"]:
        """How long the error less its mean is beyond limits [s]; NaN where there was no room for all of it."""

        def of_segment(ends: Array, length: Scalar) -> Array:
            return length * _share_beyond(_sizes(ends[0] - mean), _sizes(ends[1] - mean), limits)

        total = jnp.sum(jax.vmap(of_segment)(self.ends, self.lengths), axis=0)
        return jnp.where(self.filled > self.lengths.size, jnp.nan, total)


class Window(NamedTuple):
    """What is remembered of the window that time is in."""

    integral: Array  # (5,) of the error [rad s]
    high: Array  # (3 + DIRECTIONS,) the largest of its projections [rad]
    low: Array
    path: Path | None  # None: no limit is on the relative error


class Tally(NamedTuple):
    """Where the indices of one error stand: about each axis, and the half-cone, (4,) each [rad]."""

    largest: Array
    mean: Array  # largest of a window
    relative: Array
    window: Window
    means_high: Array  # (3 + DIRECTIONS,) of the windows so far
    means_low: Array
    windows: Scalar  # how many are closed
    beyond: Array  # time beyond the limits [s]: exactly 0 of a run that keeps them, which a sum of times within is not
    means_beyond: Array  # time in windows whose means are beyond theirs [s]
    relative_beyond: Array  # time in closed windows in which the relative error is beyond its limits [s]


def begin(zero: Scalar, segments: int = 0) -> Tally:
    """Before the observation; zero: of the run's numbers; segments: of a window that are kept, see `Pointing`."""
    four, many = jnp.zeros(4) + zero, jnp.zeros(3 + DIRECTIONS) + zero
    path = Path(jnp.zeros((segments, 2, 5)) + zero, jnp.zeros(segments) + zero, jnp.int32(0)) if segments else None
    window = Window(jnp.zeros(5) + zero, many - jnp.inf, many + jnp.inf, path)
    return Tally(four, four, four, window, many - jnp.inf, many + jnp.inf, zero, four, four, four)


def update(
    tally: Tally, course: Course, t: Scalar, t_next: Scalar, begins: Scalar, window: Scalar, limits: Float[Array, "3 4"]
) -> Tally:
    """After an interval from t to t_next that is no longer than a window; begins: when the observation does [s].

    limits: (3, 4) [rad], on the error, on its means and on the relative error.
    """
    length = course.length
    share = jnp.clip((begins - t) / length, 0.0, 1.0)
    end = begins + (tally.windows + 1.0) * window
    until = jnp.clip((end - t) / length, share, 1.0)
    observed, closes = t_next > begins, (t_next > begins) & (end <= t_next + ENOUGH * window)
    first, last = course.at(share), course.at(until)
    # the observation's first moment counts; later intervals begin where the ones before have ended
    opened = guards.select(t <= begins, _with(tally.window, first), tally.window)
    started = jnp.where(t <= begins, jnp.maximum(tally.largest, _sizes(first)), tally.largest)
    added = opened.integral + course.integral(until) - course.integral(share)
    kept = None if opened.path is None else opened.path.added(first, last, length * (until - share))
    present = _with(opened._replace(integral=added, path=kept), last)
    sizes = _sizes(first), _sizes(course.end)
    still = tally._replace(
        largest=jnp.maximum(started, sizes[1]),
        window=present,
        beyond=tally.beyond + length * (1.0 - share) * _share_beyond(*sizes, limits[0]),
    )

    def closed() -> Tally:
        mean = present.integral / window
        means = _projected(mean)
        off = jnp.maximum(present.high - means, means - present.low)
        rest = course.integral(jnp.ones_like(until)) - course.integral(until)
        path, beyond = present.path, jnp.zeros(4)
        if path is not None:
            beyond = path.time_beyond(mean, limits[2])
            path = path.emptied().added(last, course.end, length * (1.0 - until))
        new = _with(_with(Window(rest, 0.0 * means - jnp.inf, 0.0 * means + jnp.inf, path), last), course.end)
        return still._replace(
            mean=jnp.maximum(still.mean, _sizes(mean)),
            relative=jnp.maximum(still.relative, _sizes_of(off)),
            window=new,
            means_high=jnp.maximum(still.means_high, means),
            means_low=jnp.minimum(still.means_low, means),
            windows=still.windows + 1.0,
            means_beyond=still.means_beyond + jnp.where(_sizes(mean) <= limits[1], 0.0, window),
            relative_beyond=still.relative_beyond + beyond,
        )

    found = jax.lax.cond(closes, closed, lambda: still)
    return guards.select(observed, found, tally)


def drift(tally: Tally) -> Float[Array, "4"]:
    """Largest difference between the means of two windows [rad]."""
    return _sizes_of(tally.means_high - tally.means_low)


def _projected(error: Array) -> Array:
    """About each axis, and across the boresight in each of the directions, (3 + DIRECTIONS,)."""
    return jnp.concatenate([error[:3], np.cos(ALONG) * error[3] + np.sin(ALONG) * error[4]])


def _with(window: Window, error: Array) -> Window:
    shown = _projected(error)
    return window._replace(high=jnp.maximum(window.high, shown), low=jnp.minimum(window.low, shown))


def _sizes(error: Array) -> Array:
    """About each axis and of the half-cone, (4,)."""
    return jnp.append(jnp.abs(error[:3]), guards.norm(error[3:]))


def _sizes_of(projected: Array) -> Array:
    """Sizes about each axis and of the half-cone, (4,), from the largest in each direction, see `DIRECTIONS`."""
    return jnp.append(projected[:3], jnp.max(projected[3:]) / np.cos(0.5 * np.pi / DIRECTIONS))


def _share_beyond(start: Array, end: Array, limits: Array) -> Array:
    """Share of an interval in which sizes are beyond limits, as if they went straight from start to end."""
    kept, kept_next = start <= limits, end <= limits
    both = jnp.where(kept & kept_next, 0.0, 1.0)
    crosses = kept != kept_next
    apart = jnp.where(crosses, jnp.abs(start - end), 1.0)
    return jnp.where(crosses, (jnp.maximum(start, end) - limits) / apart, both)
