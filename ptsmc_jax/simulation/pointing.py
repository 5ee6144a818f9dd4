"""Pointing error indices (ECSS-E-ST-60-10C), accumulated interval by interval.

An observation consists of consecutive windows of length D. The indices of an error e(t) are:

- the absolute error |e(t)| (APE; AKE for the error of the measured attitude),
- its mean over a window (MPE, MKE),
- the relative error |e(t) - mean of the window that contains t| (RPE, RKE),
- the drift, which is the difference between the means of two windows (PDE).

Each metric is the largest value in the observation, about each axis and as the half-cone of the boresight. Only the
history of the present window is stored, and only if a requirement limits the relative error for a fraction of the time.
Start with `update`; `update_errors` accumulates the errors of the true and of the measured attitude.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ptsmc_jax.numerics import attitude, elementary, guards
from ptsmc_jax.numerics.pytrees import Leaf, Scalar, pytree
from ptsmc_jax.plants.rigid_body import AttitudeState
from ptsmc_jax.signals.references import Target

Vector = Float[Array, "3"]

# The half-cone error is computed from projections of the error onto this number of directions across the boresight,
# which cover half a turn. The half-cone error is at most 1/cos(pi/32) - 1 = 0.5 % larger than the largest projection,
# which is enlarged by this factor.
DIRECTIONS = 16
DIRECTION_ANGLES = np.pi * np.arange(DIRECTIONS) / DIRECTIONS

# pointing error indices (ECSS-E-ST-60-10C), see `pointing`; each metric is the largest value in the observation
INDICES = {
    "ape": "APE, the error",
    "mpe": "MPE, the error's mean over a window",
    "rpe": "RPE, the error less its window's mean",
    "pde": "PDE, the difference of the means of two windows",
    "ake": "AKE, the error of the attitude that the law is given",
    "mke": "MKE, the mean over a window of the error of the attitude that the law is given",
    "rke": "RKE, the error of the attitude that the law is given less its window's mean",
}
AXES = {"x": "about x", "y": "about y", "z": "about z", "boresight": "half-cone of the boresight"}
# indices that a requirement may limit in a fraction of the time
TIME_FRACTION_INDICES = ("ape", "mpe", "rpe", "ake", "mke", "rke")
RELATIVE_INDICES = ("rpe", "rke")  # errors relative to the mean of their window, whose samples must be stored
TIME_FRACTION_METRICS = tuple(f"{index}_{axis}" for index in TIME_FRACTION_INDICES for axis in AXES)
WITHIN = "within_"  # within_NAME is the fraction of the time in which the metric NAME is within its limit
# name: (unit, meaning)
METRICS = {
    **{
        f"{index}_{axis}": ("rad", f"{meaning}, {axis_meaning}: largest in the observation")
        for index, meaning in INDICES.items()
        for axis, axis_meaning in AXES.items()
    },
    **{
        f"{WITHIN}{name}": ("-", f"fraction of the observation in which {name} is within its limit")
        for name in TIME_FRACTION_METRICS
    },
}
# absolute, mean and relative error of the true attitude, and of the measured attitude
ATTITUDE, KNOWLEDGE = ("ape", "mpe", "rpe"), ("ake", "mke", "rke")


@pytree
@dataclass(frozen=True)
class Pointing:
    """The observation of pointing errors."""

    frame: Leaf  # (3, 3) rows: the boresight, and two directions across it, in body axes
    after: Leaf  # time from t_f to the start of the observation [s]
    window: Leaf  # length D of a window [s]
    # limits [rad] by metric, for requirements on the fraction of the time within a limit
    limits: dict[str, Leaf] = field(default_factory=dict)
    # largest number of control samples in a window; 0: all samples of the run
    samples: int = field(default=0, metadata={"static": True})

    def for_run(self, steps: int) -> "Pointing":
        """Return the observation for a run with this number of steps."""
        return self if self.samples else replace(self, samples=steps)

    def segment_count(self, index: str) -> int:
        """Return the number of segments of a window that are stored for a relative index, or 0 without such limits.

        n samples divide a window into n + 1 segments. A further segment, without length, is needed if the previous
        window ended at a sample.
        """
        return self.samples + 2 if any(name.startswith(index) for name in self.limits) else 0


def boresight_frame(boresight: Sequence[float] | np.ndarray) -> np.ndarray:
    """Return the frame (3, 3) of a boresight (3,) of any length: rows are its unit vector and two directions across."""
    b = np.asarray(boresight, dtype=float)
    b = b / np.linalg.norm(b)
    first = np.cross(b, np.eye(3)[np.argmin(np.abs(b))])
    first /= np.linalg.norm(first)
    return np.stack([b, first, np.cross(b, first)])


def attitude_error(q: Float[Array, "4"], target: Float[Array, "4"], frame: Float[Array, "3 3"]) -> Float[Array, "5"]:
    """Return the error of an attitude [rad]: the rotation vector in body axes (3,), then the boresight error (2,).

    Args:
        q: quaternion of the attitude.
        target: quaternion of the reference.
        frame: boresight and two directions across it, (3, 3), see `boresight_frame`.

    Returns:
        (5,) The last two entries are the angle of the boresight error times its direction across the boresight.
    """
    error = attitude.multiply(attitude.conjugate(target), q)
    error = jnp.where(error[3] < 0.0, -error, error)
    return jnp.concatenate(
        [attitude.rotation_vector(error[:3]), _boresight_error(attitude.rotate(error, frame[0]), frame)]
    )


def _boresight_error(direction: Vector, frame: Float[Array, "3 3"]) -> Float[Array, "2"]:
    """Return the angle from the boresight to a unit vector times the direction of the error across it [rad]."""
    across, along = frame[1:] @ direction, jnp.dot(frame[0], direction)
    square = jnp.sum(across * across)
    small = square < 1e-12  # then the angle is equal to its sine to 1e-12 relative
    size = jnp.sqrt(jnp.where(small, 1.0, square))
    angle = elementary.arctan2(size, jnp.abs(along))
    arc = across * jnp.where(small, 1.0 + square / 6.0, jnp.where(along < 0.0, np.pi - angle, angle) / size)
    return jnp.where(small & (along < 0.0), np.pi * jnp.eye(2)[0], arc)  # exactly backwards: any direction


class ErrorPath(NamedTuple):
    """An `attitude_error` (5,) over an interval: start + x rise + x (1 - x) ((1 - x) a + x b), x from 0 to 1."""

    start: Array  # [rad]
    end: Array
    rise: Array
    a: Array
    b: Array
    length: Scalar  # length of the interval of time that the path covers [s]

    def error_at(self, x: Scalar) -> Array:
        """Return the error at the fraction x of the interval."""
        return self.start + x * self.rise + x * (1.0 - x) * ((1.0 - x) * self.a + x * self.b)

    def integral(self, x: Scalar) -> Array:
        """Return the time integral of the error from the start to the fraction x of the interval [rad s]."""
        square = x * x
        first = square * (0.5 - x * (2.0 / 3.0 - x / 4.0))
        second = square * x * (1.0 / 3.0 - x / 4.0)
        return self.length * (x * self.start + square / 2.0 * self.rise + first * self.a + second * self.b)


class ConstantPath(NamedTuple):
    """An `attitude_error` (5,) that is constant over an interval."""

    end: Array  # [rad]
    length: Scalar  # length of the interval of time that the path covers [s]

    def error_at(self, x: Scalar) -> Array:
        """Return the error."""
        return self.end

    def integral(self, x: Scalar) -> Array:
        """Return the time integral of the error from the start to the fraction x of the interval [rad s]."""
        return self.length * (x * self.end)


def hermite_path(start: Array, start_rate: Array, end: Array, end_rate: Array, length: Scalar) -> ErrorPath:
    """Return the cubic Hermite path between two errors with these rates.

    Args:
        start: error at the start (5,) [rad].
        start_rate: rate of the error at the start (5,) [rad/s].
        end: error at the end (5,) [rad].
        end_rate: rate of the error at the end (5,) [rad/s].
        length: length of the interval [s].
    """
    rise = end - start
    return ErrorPath(start, end, rise, length * start_rate - rise, rise - length * end_rate, length)


def error_path(start: tuple, end: tuple, frame: Float[Array, "3 3"], length: Scalar) -> ErrorPath:
    """Return the path of the attitude error over an interval.

    Args:
        start: state of the body and target of the reference at the start of the interval.
        end: state and target at the end of the interval.
        frame: boresight and two directions across it in body axes, (3, 3), see `boresight_frame`.
        length: length of the interval [s].
    """

    def error_and_rate(x: AttitudeState, target: Target) -> tuple[Array, Array]:
        rates = attitude.derivative(x.q, x.w), attitude.derivative(target.q, target.w)
        return jax.jvp(lambda q, target: attitude_error(q, target, frame), (x.q, target.q), rates)

    return hermite_path(*error_and_rate(*start), *error_and_rate(*end), length)


def constant_path(
    q: Float[Array, "4"], true: Float[Array, "4"], frame: Float[Array, "3 3"], length: Scalar
) -> ConstantPath:
    """Return the error of a measured quaternion from the true one. It is constant until the next sample.

    Args:
        q: measured unit quaternion.
        true: true unit quaternion.
        frame: boresight and two directions across it in body axes, (3, 3), see `boresight_frame`.
        length: length of the interval [s].
    """
    return ConstantPath(attitude_error(q, true, frame), length)


class Segments(NamedTuple):
    """Buffer of the error's segments in the present window, because its mean is known only at its end."""

    ends: Array  # (segments, 2, 5) error at the start and at the end of each segment [rad]
    lengths: Array  # (segments,) length of each segment [s]; 0: not filled yet
    filled: Array  # number of filled segments

    def with_segment(self, start: Array, end: Array, length: Scalar) -> "Segments":
        """Append a segment. If no space is left, it is dropped and `filled` exceeds the number of places.

        Args:
            start: error at the start of the segment (5,) [rad].
            end: error at the end of the segment (5,) [rad].
            length: length of the segment [s].
        """
        return Segments(
            self.ends.at[self.filled].set(jnp.stack([start, end])),
            self.lengths.at[self.filled].set(length),
            self.filled + 1,
        )

    def time_beyond(self, mean: Array, limits: Float[Array, "4"]) -> Float[Array, "4"]:
        """Return the time in which the error minus its mean is beyond limits [s]; NaN if a segment was dropped."""

        def time_in_segment(ends: Array, length: Scalar) -> Array:
            return length * _fraction_beyond(_sizes(ends[0] - mean), _sizes(ends[1] - mean), limits)

        total = jnp.sum(jax.vmap(time_in_segment)(self.ends, self.lengths), axis=0)
        return jnp.where(self.filled > self.lengths.size, jnp.nan, total)


class Window(NamedTuple):
    """Accumulator of the present window."""

    integral: Array  # (5,) time integral of the error [rad s]
    high: Array  # (3 + DIRECTIONS,) largest projections of the error [rad]
    low: Array  # (3 + DIRECTIONS,) smallest projections of the error [rad]
    segments: Segments | None  # None: no limit on the relative error needs them

    def with_error(self, error: Array) -> "Window":
        """Return the window with `high` and `low` updated by one more value of the error, (5,) [rad]."""
        projections = _projections(error)
        return self._replace(high=jnp.maximum(self.high, projections), low=jnp.minimum(self.low, projections))


class Tally(NamedTuple):
    """Accumulator of the indices of one pointing error. Arrays (4,) are about each axis and of the half-cone."""

    largest: Array  # (4,) largest absolute error up to now [rad]
    mean: Array  # (4,) largest mean of a complete window [rad]
    relative: Array  # (4,) largest relative error in a complete window [rad]
    window: Window
    means_high: Array  # (3 + DIRECTIONS,) largest projections of the means of complete windows [rad]
    means_low: Array  # (3 + DIRECTIONS,) smallest projections of these means [rad]
    windows: Scalar  # number of complete windows
    # times beyond limits are exactly 0 in a run that keeps them; times within would have rounding errors
    beyond: Array  # (4,) time with the error beyond its limits [s]
    means_beyond: Array  # (4,) total length of the complete windows with a mean beyond its limits [s]
    relative_beyond: Array  # (4,) time with the relative error beyond its limits, in complete windows [s]


def begin(zero: Scalar, segments: int = 0) -> Tally:
    """Return the accumulator before the observation.

    Args:
        zero: a zero with the type of the numbers of the run.
        segments: number of segments of a window to store, see `Pointing.segment_count`; 0: none.
    """
    zeros, projections = jnp.zeros(4) + zero, jnp.zeros(3 + DIRECTIONS) + zero
    buffer = (
        Segments(jnp.zeros((segments, 2, 5)) + zero, jnp.zeros(segments) + zero, jnp.int32(0)) if segments else None
    )
    window = Window(jnp.zeros(5) + zero, projections - jnp.inf, projections + jnp.inf, buffer)
    return Tally(zeros, zeros, zeros, window, projections - jnp.inf, projections + jnp.inf, zero, zeros, zeros, zeros)


def update(
    tally: Tally,
    error: ErrorPath | ConstantPath,
    t: Scalar,
    t_next: Scalar,
    observation_start: Scalar,
    window: Scalar,
    limits: Float[Array, "3 4"],
) -> Tally:
    """Return the accumulator after an interval, which is at most as long as a window.

    Args:
        tally: accumulator before the interval.
        error: error over the interval.
        t: start of the interval [s].
        t_next: end of the interval [s].
        observation_start: start of the observation [s].
        window: length D of a window [s].
        limits: limits (3, 4) of the error, its mean and the relative error, about each axis and of the half-cone [rad].
    """
    length = error.length
    # fractions of the interval at which the observation starts and the window ends
    start_fraction = jnp.clip((observation_start - t) / length, 0.0, 1.0)
    window_end = observation_start + (tally.windows + 1.0) * window
    end_fraction = jnp.clip((window_end - t) / length, start_fraction, 1.0)
    tolerance = guards.time_tolerance(window, t_next)
    is_observed = t_next > observation_start + tolerance
    is_window_complete = is_observed & (window_end <= t_next + tolerance)
    first_error, last_error = error.error_at(start_fraction), error.error_at(end_fraction)
    # the first interval adds the error at the start of the observation; later ones start where the last one ended
    is_first = t <= observation_start + guards.time_tolerance(window, t)
    window_before = guards.select(is_first, tally.window.with_error(first_error), tally.window)
    largest = jnp.where(is_first, jnp.maximum(tally.largest, _sizes(first_error)), tally.largest)
    integral = window_before.integral + error.integral(end_fraction) - error.integral(start_fraction)
    segments = window_before.segments
    if segments is not None:
        segments = segments.with_segment(first_error, last_error, length * (end_fraction - start_fraction))
    present_window = window_before._replace(integral=integral, segments=segments).with_error(last_error)
    first_sizes, end_sizes = _sizes(first_error), _sizes(error.end)
    window_open = tally._replace(
        largest=jnp.maximum(largest, end_sizes),
        window=present_window,
        beyond=tally.beyond + length * (1.0 - start_fraction) * _fraction_beyond(first_sizes, end_sizes, limits[0]),
    )

    def close_window() -> Tally:
        """Return the accumulator with the indices of the completed window, and the rest of the interval in the next."""
        mean = present_window.integral / window
        means = _projections(mean)
        deviations = jnp.maximum(present_window.high - means, means - present_window.low)
        next_integral = error.integral(jnp.ones_like(end_fraction)) - error.integral(end_fraction)
        segments, beyond = present_window.segments, jnp.zeros(4)
        if segments is not None:
            beyond = segments.time_beyond(mean, limits[2])
            empty = Segments(segments.ends, jnp.zeros_like(segments.lengths), jnp.zeros_like(segments.filled))
            segments = empty.with_segment(last_error, error.end, length * (1.0 - end_fraction))
        projections = _projections(last_error)
        next_window = Window(next_integral, projections, projections, segments).with_error(error.end)
        if isinstance(error, ConstantPath):  # the error jumps here: its old value is not part of the next window
            continues = t_next > window_end + tolerance
            high, low = jnp.where(continues, next_window.high, -jnp.inf), jnp.where(continues, next_window.low, jnp.inf)
            next_window = next_window._replace(high=high, low=low)
        return window_open._replace(
            mean=jnp.maximum(window_open.mean, _sizes(mean)),
            relative=jnp.maximum(window_open.relative, _sizes_from_projections(deviations)),
            window=next_window,
            means_high=jnp.maximum(window_open.means_high, means),
            means_low=jnp.minimum(window_open.means_low, means),
            windows=window_open.windows + 1.0,
            means_beyond=window_open.means_beyond + jnp.where(_sizes(mean) <= limits[1], 0.0, window),
            relative_beyond=window_open.relative_beyond + beyond,
        )

    after = jax.lax.cond(is_window_complete, close_window, lambda: window_open)
    return guards.select(is_observed, after, tally)


def drift(tally: Tally) -> Float[Array, "4"]:
    """Return the largest difference between the means of two windows, (4,) [rad]."""
    return _sizes_from_projections(tally.means_high - tally.means_low)


def _projections(error: Array) -> Array:
    """Return the error about each axis and along each direction across the boresight, (3 + DIRECTIONS,) [rad]."""
    return jnp.concatenate([error[:3], np.cos(DIRECTION_ANGLES) * error[3] + np.sin(DIRECTION_ANGLES) * error[4]])


def _sizes(error: Array) -> Array:
    """Return the sizes of an error (5,) about each axis and of the half-cone, (4,) [rad]."""
    return jnp.append(jnp.abs(error[:3]), guards.norm(error[3:]))


def _sizes_from_projections(projections: Array) -> Array:
    """Return the sizes about each axis and of the half-cone, (4,) [rad], from projections, see `DIRECTIONS`."""
    return jnp.append(projections[:3], jnp.max(projections[3:]) / np.cos(0.5 * np.pi / DIRECTIONS))


def _fraction_beyond(start: Array, end: Array, limits: Array) -> Array:
    """Return the fraction of an interval with sizes beyond the limits, if the sizes are linear in the interval."""
    is_within, is_within_next = start <= limits, end <= limits
    without_crossing = jnp.where(is_within & is_within_next, 0.0, 1.0)
    is_crossing = is_within != is_within_next
    change = jnp.where(is_crossing, jnp.abs(start - end), 1.0)
    return jnp.where(is_crossing, (jnp.maximum(start, end) - limits) / change, without_crossing)


class PointingErrors(NamedTuple):
    """Accumulators of the pointing error indices."""

    attitude: Tally  # error of the true attitude
    knowledge: Tally | None  # error of the attitude that the law gets; None: the law gets the true attitude


def begin_errors(observation: Pointing, zero: Scalar, *, measured: bool) -> PointingErrors:
    """Return the accumulators at t = 0.

    Args:
        observation: the observation.
        zero: a zero with the type of the numbers of the run.
        measured: whether the law gets a measured attitude.
    """
    knowledge = begin(zero, observation.segment_count(KNOWLEDGE[2])) if measured else None
    return PointingErrors(begin(zero, observation.segment_count(ATTITUDE[2])), knowledge)


def update_errors(
    errors: PointingErrors,
    observation: Pointing,
    t_f: Scalar,
    span: tuple[Scalar, Scalar],
    attitude_error: Callable[[], ErrorPath],
    knowledge_error: Callable[[], ConstantPath] | None,
) -> PointingErrors:
    """Return the accumulators after an interval that ends at t_f or later.

    Args:
        errors: accumulators before the interval.
        observation: the observation.
        t_f: prescribed time [s].
        span: start and end of the interval [s].
        attitude_error: function that returns the error of the true attitude over the interval.
        knowledge_error: function that returns the error of the measured attitude; None without sensors.
    """
    observation_start = t_f + observation.after

    def update_tally(tally: Tally, path: ErrorPath | ConstantPath, names: tuple[str, ...]) -> Tally:
        # the limit of each index about each axis and of the half-cone, (indices, 4) [rad]; infinite: no limit
        limits = [[jnp.asarray(observation.limits.get(f"{name}_{axis}", jnp.inf)) for axis in AXES] for name in names]
        table = jnp.stack([jnp.stack(axis_limits) for axis_limits in limits])
        return update(tally, path, *span, observation_start, observation.window, table)

    attitude, knowledge = update_tally(errors.attitude, attitude_error(), ATTITUDE), errors.knowledge
    if knowledge is not None and knowledge_error is not None:
        knowledge = update_tally(knowledge, knowledge_error(), KNOWLEDGE)
    return PointingErrors(attitude, knowledge)


def metric_values(errors: PointingErrors, observation: Pointing, length: Array) -> dict[str, Array]:
    """Return the pointing metrics by name.

    Args:
        errors: accumulators at the end of the run.
        observation: the observation.
        length: length of the observation [s].

    Returns:
        Scalars: the largest value of each index [rad], and the fractions of the time within each limit [-].
    """
    indices = _index_values(errors.attitude, ATTITUDE, observation, length) | {"pde": drift(errors.attitude)}
    if errors.knowledge is not None:
        indices |= _index_values(errors.knowledge, KNOWLEDGE, observation, length)
    return {f"{name}_{axis}": sizes[k] for name, sizes in indices.items() for k, axis in enumerate(AXES)}


def _index_values(tally: Tally, names: tuple[str, str, str], observation: Pointing, length: Array) -> dict[str, Array]:
    """Return the values of each index, (4,) [rad], and the fractions of the time within limits, (4,) [-].

    Args:
        tally: accumulator of one error.
        names: names of its absolute, mean and relative index.
        observation: the observation.
        length: length of the observation [s].
    """
    absolute, mean, relative = names
    time_in_windows = tally.windows * observation.window
    has_window = time_in_windows > 0.0

    def fraction_in_windows(beyond: Array) -> Array:
        return jnp.where(has_window, _fraction_within(beyond, jnp.where(has_window, time_in_windows, 1.0)), jnp.nan)

    return {
        absolute: tally.largest,
        mean: tally.mean,
        relative: tally.relative,
        f"{WITHIN}{absolute}": _fraction_within(tally.beyond, length),
        f"{WITHIN}{mean}": fraction_in_windows(tally.means_beyond),
        f"{WITHIN}{relative}": fraction_in_windows(tally.relative_beyond),
    }


def _fraction_within(beyond: Array, total: Array) -> Array:
    """Return the fraction of a total time [s] that is within limits. Rounding may make `beyond` exceed the total."""
    within = total - beyond
    return jnp.where(within <= guards.time_tolerance(total, total), 0.0, within / total)
