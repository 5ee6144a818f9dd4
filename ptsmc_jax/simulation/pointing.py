"""Pointing error indices (ECSS-E-ST-60-10C), accumulated interval by interval.

Of an error e(t), over an observation of consecutive windows of length D: the absolute error |e(t)|, its mean over a
window, the relative error |e(t) - mean of the window that t lies in|, and the drift, the difference between the means
of two windows. Each is reported by its largest value in the observation: about each axis, and as the half-cone of the
boresight. The error is that of the attitude (APE, MPE, RPE, PDE), or of its measurement (AKE, MKE, RKE). No history is
kept but that of the present window, and that only where a limit asks for the time in which the relative error keeps it.
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

# Directions across the boresight, over half a turn, into which an error is projected. The largest projection gives a
# half-cone to within 1/cos(pi/32) - 1 = 0.5 %, and is enlarged by as much.
DIRECTIONS = 16
ALONG = np.pi * np.arange(DIRECTIONS) / DIRECTIONS


@pytree
@dataclass(frozen=True)
class Pointing:
    """Which pointing errors are observed, and when."""

    frame: Leaf  # (3, 3) rows: the boresight, and two directions across it, in body axes
    after: Leaf  # of t_f, when the observation begins [s]
    window: Leaf  # D [s]
    limits: dict[str, Leaf] = field(default_factory=dict)  # [rad] by metric, whose share of time within them is asked
    samples: int = field(default=0, metadata={"static": True})  # most in a window; 0: as many as the run has

    def of_run(self, steps: int) -> "Pointing":
        """The same for a run of so many steps."""
        return self if self.samples else replace(self, samples=steps)

    def segments(self, index: str) -> int:
        """How many segments of a window are kept for shares of time of a relative index; 0: no limit asks for them.

        Samples divide a window into one more than there are of them; one more has no length where the window before
        ended with a sample.
        """
        return self.samples + 2 if any(name.startswith(index) for name in self.limits) else 0


def across(boresight: Any) -> np.ndarray:
    """The frame of a boresight (3,) of any length but 0: rows are it and two directions across it."""
    b = np.asarray(boresight, dtype=float)
    b = b / np.linalg.norm(b)
    first = np.cross(b, np.eye(3)[np.argmin(np.abs(b))])
    first /= np.linalg.norm(first)
    return np.stack([b, first, np.cross(b, first)])


def attitude_error(q: Float[Array, "4"], target: Float[Array, "4"], frame: Float[Array, "3 3"]) -> Float[Array, "5"]:
    """An attitude's error from a target's: rotation vector in body axes (3,), then across the boresight (2,) [rad].

    The latter is the angle by which the boresight points off, in its direction; frame: see `Pointing`.
    """
    error = attitude.multiply(attitude.conjugate(target), q)
    error = jnp.where(error[3] < 0.0, -error, error)
    return jnp.concatenate([attitude.rotation_vector(error[:3]), _cone(attitude.rotate(error, frame[0]), frame)])


def _cone(pointed: Vector, frame: Float[Array, "3 3"]) -> Float[Array, "2"]:
    """The angle from the boresight to a unit vector, and its direction: an arc on the sphere, laid flat [rad]."""
    side, ahead = frame[1:] @ pointed, jnp.dot(frame[0], pointed)
    square = jnp.sum(side * side)
    small = square < 1e-12  # the angle is then its sine to a part in 1e12
    size = jnp.sqrt(jnp.where(small, 1.0, square))
    turned = elementary.arctan2(size, jnp.abs(ahead))
    arc = side * jnp.where(small, 1.0 + square / 6.0, jnp.where(ahead < 0.0, np.pi - turned, turned) / size)
    return jnp.where(small & (ahead < 0.0), np.pi * jnp.eye(2)[0], arc)  # straight back: by any direction


class ErrorPath(NamedTuple):
    """An `attitude_error` (5,) over an interval: start + x rise + x (1 - x) ((1 - x) a + x b) at a share x of it."""

    start: Array  # [rad]
    end: Array
    rise: Array
    a: Array
    b: Array
    length: Scalar  # of the interval [s]

    def at(self, x: Scalar) -> Array:
        """The error where a share x of the interval has passed."""
        return self.start + x * self.rise + x * (1.0 - x) * ((1.0 - x) * self.a + x * self.b)

    def integral(self, x: Scalar) -> Array:
        """Its integral from the start until then [rad s]."""
        square = x * x
        first = square * (0.5 - x * (2.0 / 3.0 - x / 4.0))
        second = square * x * (1.0 / 3.0 - x / 4.0)
        return self.length * (x * self.start + square / 2.0 * self.rise + first * self.a + second * self.b)


class ConstantPath(NamedTuple):
    """An `attitude_error` (5,) that stays as it is over an interval."""

    end: Array  # [rad]
    length: Scalar  # of the interval [s]

    def at(self, x: Scalar) -> Array:
        """The error."""
        return self.end

    def integral(self, x: Scalar) -> Array:
        """Its integral until a share x of the interval has passed [rad s]."""
        return self.length * (x * self.end)


def hermite(start: Array, start_rate: Array, end: Array, end_rate: Array, length: Scalar) -> ErrorPath:
    """The cubic through both ends (5,) [rad] with these slopes [rad/s], over an interval [s]."""
    rise = end - start
    return ErrorPath(start, end, rise, length * start_rate - rise, rise - length * end_rate, length)


def error_path(start: tuple, end: tuple, frame: Float[Array, "3 3"], length: Scalar) -> ErrorPath:
    """The error of an attitude between two (state, target)."""

    def with_rate(x: Any, target: Any) -> tuple[Array, Array]:
        rates = attitude.derivative(x.q, x.w), attitude.derivative(target.q, target.w)
        return jax.jvp(lambda q, target: attitude_error(q, target, frame), (x.q, target.q), rates)

    return hermite(*with_rate(*start), *with_rate(*end), length)


def constant_path(
    q: Float[Array, "4"], true: Float[Array, "4"], frame: Float[Array, "3 3"], length: Scalar
) -> ConstantPath:
    """The error of a measured attitude from the true one at its sample, which is known until the next one."""
    return ConstantPath(attitude_error(q, true, frame), length)


class Segments(NamedTuple):
    """The error in the present window, segment by segment: its mean is known at its end only."""

    ends: Array  # (segments, 2, 5) at the start and the end of each [rad]
    lengths: Array  # (segments,) [s], 0 of those to come
    filled: Array  # how many there are

    def added(self, start: Array, end: Array, length: Scalar) -> "Segments":
        """With one segment more; beyond the last there is no room, which `filled` shows."""
        return Segments(
            self.ends.at[self.filled].set(jnp.stack([start, end])),
            self.lengths.at[self.filled].set(length),
            self.filled + 1,
        )

    def emptied(self) -> "Segments":
        """Without segments."""
        return Segments(self.ends, jnp.zeros_like(self.lengths), jnp.zeros_like(self.filled))

    def time_beyond(self, mean: Array, limits: Float[Array, "4"]) -> Float[Array, "4"]:
        """How long the error less its mean is beyond limits [s]; NaN where there was no room for all of it."""

        def of_segment(ends: Array, length: Scalar) -> Array:
            return length * _share_beyond(_sizes(ends[0] - mean), _sizes(ends[1] - mean), limits)

        total = jnp.sum(jax.vmap(of_segment)(self.ends, self.lengths), axis=0)
        return jnp.where(self.filled > self.lengths.size, jnp.nan, total)


class Window(NamedTuple):
    """The present window so far."""

    integral: Array  # (5,) of the error [rad s]
    high: Array  # (3 + DIRECTIONS,) largest of the error's projections [rad]
    low: Array  # (3 + DIRECTIONS,) smallest of them [rad]
    segments: Segments | None  # None: no limit is on the relative error

    def including(self, error: Array) -> "Window":
        """With one more value (5,) of the error among the largest and smallest."""
        projections = _projections(error)
        return self._replace(high=jnp.maximum(self.high, projections), low=jnp.minimum(self.low, projections))


class Tally(NamedTuple):
    """The indices of one error so far: about each axis, and of the half-cone, (4,) each [rad]."""

    largest: Array  # of the error
    mean: Array  # largest mean of a window
    relative: Array  # largest relative error
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
    kept = Segments(jnp.zeros((segments, 2, 5)) + zero, jnp.zeros(segments) + zero, jnp.int32(0)) if segments else None
    window = Window(jnp.zeros(5) + zero, many - jnp.inf, many + jnp.inf, kept)
    return Tally(four, four, four, window, many - jnp.inf, many + jnp.inf, zero, four, four, four)


def update(
    tally: Tally,
    error: ErrorPath | ConstantPath,
    t: Scalar,
    t_next: Scalar,
    begins: Scalar,
    window: Scalar,
    limits: Float[Array, "3 4"],
) -> Tally:
    """The tally after an interval.

    Args:
        tally: before it.
        error: over the interval.
        t: start of the interval [s].
        t_next: its end [s]; it is no longer than a window.
        begins: when the observation does [s].
        window: length D of a window [s].
        limits: on the error, on its means and on the relative error, about each axis and of the half-cone [rad].
    """
    length = error.length
    share = jnp.clip((begins - t) / length, 0.0, 1.0)  # of the interval that lies before the observation
    window_end = begins + (tally.windows + 1.0) * window
    until = jnp.clip((window_end - t) / length, share, 1.0)  # where the window ends in the interval
    by_rounding = guards.rounding(window, t_next)
    observed = t_next > begins + by_rounding
    closes = observed & (window_end <= t_next + by_rounding)
    first, last = error.at(share), error.at(until)
    # the observation's first moment counts; later intervals begin where the ones before have ended
    opens = t <= begins + guards.rounding(window, t)
    opened = guards.select(opens, tally.window.including(first), tally.window)
    largest = jnp.where(opens, jnp.maximum(tally.largest, _sizes(first)), tally.largest)
    integral = opened.integral + error.integral(until) - error.integral(share)
    segments = opened.segments
    if segments is not None:
        segments = segments.added(first, last, length * (until - share))
    present = opened._replace(integral=integral, segments=segments).including(last)
    first_sizes, end_sizes = _sizes(first), _sizes(error.end)
    still_open = tally._replace(
        largest=jnp.maximum(largest, end_sizes),
        window=present,
        beyond=tally.beyond + length * (1.0 - share) * _share_beyond(first_sizes, end_sizes, limits[0]),
    )

    def closed() -> Tally:
        mean = present.integral / window
        means = _projections(mean)
        deviations = jnp.maximum(present.high - means, means - present.low)
        rest = error.integral(jnp.ones_like(until)) - error.integral(until)
        segments, beyond = present.segments, jnp.zeros(4)
        if segments is not None:
            beyond = segments.time_beyond(mean, limits[2])
            segments = segments.emptied().added(last, error.end, length * (1.0 - until))
        projections = _projections(last)
        new = Window(rest, projections, projections, segments).including(error.end)
        if isinstance(error, ConstantPath):  # which leaps from here: what ends with a window is none of the next one's
            lasts = t_next > window_end + by_rounding
            high, low = jnp.where(lasts, new.high, -jnp.inf), jnp.where(lasts, new.low, jnp.inf)
            new = new._replace(high=high, low=low)
        return still_open._replace(
            mean=jnp.maximum(still_open.mean, _sizes(mean)),
            relative=jnp.maximum(still_open.relative, _sizes_of(deviations)),
            window=new,
            means_high=jnp.maximum(still_open.means_high, means),
            means_low=jnp.minimum(still_open.means_low, means),
            windows=still_open.windows + 1.0,
            means_beyond=still_open.means_beyond + jnp.where(_sizes(mean) <= limits[1], 0.0, window),
            relative_beyond=still_open.relative_beyond + beyond,
        )

    after = jax.lax.cond(closes, closed, lambda: still_open)
    return guards.select(observed, after, tally)


def drift(tally: Tally) -> Float[Array, "4"]:
    """Largest difference between the means of two windows [rad]."""
    return _sizes_of(tally.means_high - tally.means_low)


def _projections(error: Array) -> Array:
    """The error about each axis, and across the boresight in each of the directions, (3 + DIRECTIONS,) [rad]."""
    return jnp.concatenate([error[:3], np.cos(ALONG) * error[3] + np.sin(ALONG) * error[4]])


def _sizes(error: Array) -> Array:
    """Sizes of an error (5,): about each axis and of the half-cone, (4,) [rad]."""
    return jnp.append(jnp.abs(error[:3]), guards.norm(error[3:]))


def _sizes_of(projections: Array) -> Array:
    """Sizes about each axis and of the half-cone, (4,), from the largest projections, see `DIRECTIONS`."""
    return jnp.append(projections[:3], jnp.max(projections[3:]) / np.cos(0.5 * np.pi / DIRECTIONS))


def _share_beyond(start: Array, end: Array, limits: Array) -> Array:
    """Share of an interval in which sizes are beyond limits, as if they went straight from start to end."""
    within, within_next = start <= limits, end <= limits
    uncrossed = jnp.where(within & within_next, 0.0, 1.0)
    crosses = within != within_next
    change = jnp.where(crosses, jnp.abs(start - end), 1.0)
    return jnp.where(crosses, (jnp.maximum(start, end) - limits) / change, uncrossed)
