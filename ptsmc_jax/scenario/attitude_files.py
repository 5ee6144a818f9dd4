"""Read samples of an attitude from CSV, Parquet and CCSDS attitude ephemeris messages. Start with `read`.

The functions raise ValueError. Its message continues the name of the file, such as "row 3, column q1: ...".
"""

import functools
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ptsmc_jax.scenario import aem, epochs
from ptsmc_jax.scenario.epochs import Epoch
from ptsmc_jax.signals import references

if TYPE_CHECKING:
    from polars import DataFrame

TIME_NAMES = ("t", "time", "time_s", "seconds", "epoch", "utc", "time_utc", "datetime")
# names that label the scalar part, with its order
LABELLED = {
    ("qx", "qy", "qz", "qw"): "xyzw",
    ("q0", "q1", "q2", "q3"): "wxyz",
}
UNLABELLED = ("q1", "q2", "q3", "q4")  # names that do not label the scalar part: a key states the order
RATE_NAMES = (("w1", "w2", "w3"), ("wx", "wy", "wz"))
LARGEST_NORM_ERROR = 1e-3  # allows quaternions with four digits
LARGEST_RATE_ERROR = 0.1  # largest allowed difference of rates / largest rate
MOST_SAMPLES = 100_000


@dataclass(frozen=True)
class Samples:
    """Samples of an attitude."""

    times: np.ndarray  # (n,) increasing [s], 0 at the start of the run
    quaternions: np.ndarray  # (n, 4) unit quaternions from body to inertial axes, scalar last
    end_rates: np.ndarray | None  # (2, 3) rates of the first and the last sample in body axes [rad/s], if known
    usable_until: float  # end of the usable time [s]
    fastest: float  # largest rate, plus the root of the largest acceleration [rad/s]


def read(file: str, order: str | None, direction: str | None, interpolation: str, epoch: str | None) -> Samples:
    """Return the samples of a file.

    Args:
        file: path of a .csv or .parquet file; any other file is an attitude ephemeris message.
        order: "xyzw", "wxyz" or None, see `FileReference`.
        direction: "body_to_inertial", "inertial_to_body" or None.
        interpolation: "file" or "spline".
        epoch: `loop.epoch`, the calendar time of t = 0; None: the first usable time of a file with calendar times.

    Raises:
        ValueError: the file cannot be read, or its content is damaged, ambiguous or not supported.
    """
    path = Path(file)
    try:
        file_status = path.stat()
    except OSError as error:
        raise ValueError(f"which cannot be read: {error.strerror}") from None
    return _read_version(path, order, direction, interpolation, epoch, (file_status.st_size, file_status.st_mtime_ns))


@functools.lru_cache(maxsize=8)
def _read_version(
    path: Path, order: str | None, direction: str | None, interpolation: str, epoch: str | None, version: tuple
) -> Samples:
    """Return the samples of a file, see `read`; version: its size and time of change, the key of the cache."""
    start_epoch = None if epoch is None else epochs.parse_key(epoch)
    if path.suffix.lower() in (".csv", ".parquet"):
        times, quaternions, rates = _read_table(path, order, direction, start_epoch)
        usable_until = np.inf
    else:
        for key, value in (("quaternion_order", order), ("direction", direction)):
            if value is not None:
                raise ValueError(f"an attitude ephemeris message, which states its own {key}; allowed is none")
        try:
            text = path.read_text(encoding="utf-8-sig")
        except (OSError, UnicodeDecodeError):
            raise ValueError("which is no text in UTF-8; allowed are .csv, .parquet and AEM files (KVN)") from None
        segment = aem.read_segment(text, start_epoch, any_interpolation=interpolation == "spline")
        times, quaternions, rates, usable_until = segment
    return _check_samples(times, quaternions, rates, usable_until)


def _check_samples(
    times: np.ndarray, quaternions: np.ndarray, rates: np.ndarray | None, usable_until: float
) -> Samples:
    """Return the samples; raise ValueError for times, quaternions and rates that cannot be interpolated."""
    if not 2 <= len(times) <= MOST_SAMPLES:
        raise ValueError(f"which has {len(times)} samples, but must have 2 to {MOST_SAMPLES}")
    steps = np.diff(times)
    if not np.all(steps > 0.0):
        k = int(np.argmin(steps > 0.0)) + 1
        raise ValueError(f"sample {k + 1}: its time, {times[k]:.12g} s, is not after the time before it, "
                         f"{times[k - 1]:.12g} s")  # fmt: skip
    if references.count_intervals(times) > references.MOST_INTERVALS:
        raise ValueError(f"whose times have steps from {steps.min():.3g} to {steps.max():.3g} s; the whole span may be "
                         f"at most {references.MOST_INTERVALS} of the smallest step")  # fmt: skip
    norms = np.linalg.norm(quaternions, axis=1)
    if np.abs(norms - 1.0).max() > LARGEST_NORM_ERROR:
        k = int(np.argmax(np.abs(norms - 1.0)))
        raise ValueError(f"sample {k + 1}: the norm of its quaternion is {norms[k]:.6g}, but must be 1 within "
                         f"{LARGEST_NORM_ERROR:g}")  # fmt: skip
    q = references.with_continuous_signs(quaternions / norms[:, None])
    turns = 4.0 * np.arctan2(np.linalg.norm(np.diff(q, axis=0), axis=1), np.linalg.norm(q[1:] + q[:-1], axis=1))
    if turns.max() > references.LARGEST_TURN:
        k = int(np.argmax(turns))
        raise ValueError(f"sample {k + 2}: it is {np.rad2deg(turns[k]):.4g} deg from the sample before it, and at most "
                         f"{np.rad2deg(references.LARGEST_TURN):g} deg are allowed")  # fmt: skip
    end_rates = None if rates is None else rates[[0, -1]]
    all_rates = references.sample_rates(times, q, end_rates)
    largest = np.linalg.norm(all_rates, axis=1).max()
    if rates is not None:
        errors = np.linalg.norm(references.sample_rates(times, q) - rates, axis=1)
        if errors.max() > LARGEST_RATE_ERROR * largest + 1e-9:
            k = int(np.argmax(errors))
            raise ValueError(f"sample {k + 1}: its rate differs from the derivative of its quaternions by "
                             f"{errors[k]:.3g} rad/s; rates are body rates in rad/s, in an AEM in deg/s")  # fmt: skip
    acceleration = (np.linalg.norm(np.diff(all_rates, axis=0), axis=1) / steps).max()
    return Samples(times, q, end_rates, min(usable_until, float(times[-1])), float(largest + np.sqrt(acceleration)))


def _read_table(
    path: Path, order: str | None, direction: str | None, start_epoch: Epoch | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Return times (n,) [s], quaternions (n, 4) and rates (n, 3) [rad/s] or None of a CSV or Parquet file."""
    from ptsmc_jax.numerics import csv_tables  # imports polars, which most scenarios do not need

    frame = csv_tables.read_table(path)
    names = {name.strip().lower(): name for name in frame.columns}
    time_name = next((name for name in TIME_NAMES if name in names), None)
    if time_name is None:
        raise ValueError(f"which has no column of times; allowed is one of {', '.join(TIME_NAMES)}")
    columns, scalar_last = _quaternion_columns(names, order)
    quaternions = np.stack([_read_numbers(frame, names[name]) for name in columns], axis=1)
    quaternions = quaternions if scalar_last else np.roll(quaternions, -1, axis=1)
    if direction == "inertial_to_body":
        quaternions = quaternions * references.CONJUGATE
    rate_names = next((rate_names for rate_names in RATE_NAMES if any(name in names for name in rate_names)), None)
    missing = next((name for name in rate_names or () if name not in names), None)
    if missing is not None:
        raise ValueError(f"which has no column {missing}: {', '.join(rate_names or ())} come together")
    rates = None if rate_names is None else np.stack([_read_numbers(frame, names[name]) for name in rate_names], axis=1)
    return _read_times(frame, names[time_name], start_epoch), quaternions, rates


def _quaternion_columns(names: dict[str, str], order: str | None) -> tuple[tuple[str, ...], bool]:
    """Return the columns of the quaternion, and whether the scalar part is the last one."""
    for group, labelled_order in LABELLED.items():
        if names.keys() >= set(group):
            if order not in (None, labelled_order):
                raise ValueError(
                    f'whose columns {", ".join(group)} label the scalar part; quaternion_order is "{order}"'
                )
            return group, labelled_order == "xyzw"
    if names.keys() >= set(UNLABELLED):
        return UNLABELLED, order != "wxyz"
    raise ValueError("which has no quaternion; allowed are the columns q1, q2, q3, q4 or qx, qy, qz, qw or q0 to q3 "
                     "with the scalar q0")  # fmt: skip


def _read_numbers(frame: "DataFrame", name: str) -> np.ndarray:
    """Return a column as finite numbers (n,)."""
    values = frame[name].cast(float, strict=False).to_numpy()
    if not np.all(np.isfinite(values)):
        k = int(np.argmin(np.isfinite(values)))
        cell = frame[name][k]
        shown = "empty" if cell is None else f'"{cell}"' if isinstance(cell, str) else cell
        raise ValueError(f"row {k + 1}, column {name}: it is {shown}, but must be a finite number")
    return values


def _read_times(frame: "DataFrame", name: str, start_epoch: Epoch | None) -> np.ndarray:
    """Return the times (n,) [s], from numbers of seconds or calendar times."""
    cells = frame[name].to_list()
    if not cells or not (hasattr(cells[0], "isoformat") or (isinstance(cells[0], str) and "T" in cells[0])):
        return _read_numbers(frame, name)
    times = []
    for k, cell in enumerate(cells):
        try:
            times.append(epochs.parse(cell.isoformat() if hasattr(cell, "isoformat") else str(cell)))
        except ValueError as error:
            raise ValueError(f'row {k + 1}, column {name}: it is "{cell}", {error}') from None
    return np.array([time.since(start_epoch or times[0]) for time in times])
