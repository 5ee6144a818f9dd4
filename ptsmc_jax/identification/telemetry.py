"""Telemetry of a real or simulated run as arrays: time, sensor readings, commands. Start with `measurements`.

A log is a table with a row for each time. `[telemetry]` of a scenario names its columns and their units. Cells may be
blank: a sensor has no reading in that row, or a command holds its last value.
"""

from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import polars as pl
from scipy.spatial.transform import Rotation

from ptsmc_jax.campaigns.store import RefusedError
from ptsmc_jax.numerics import csv_tables
from ptsmc_jax.scenario.identify_tables import StateTelemetry, Telemetry
from ptsmc_jax.scenario.parsing import nearest_name_hint
from ptsmc_jax.scenario.tables import Scenario
from ptsmc_jax.signals import attitude_tables
from ptsmc_jax.simulation.catalogues import UNITS

FEWEST = 10  # smallest number of rows of a log
UNIT_NORM = 1e-3  # largest error of the norm of a quaternion: telemetry often has few digits
RPM = 2.0 * np.pi / 60.0  # one revolution per minute [rad/s]
GYRO_DISAGREES = 0.5  # largest median difference of the rotations by attitude and by gyro, relative to the rotation
OUTLIER = 10.0  # third difference of an outlier, relative to the median
PARTS = 400  # number of parts of a log in which attitude and gyro are compared
Values = np.ndarray


class Measurements(NamedTuple):
    """A log in SI units. Missing readings are NaN."""

    name: str  # name of the file or table, for errors and reports
    t: Values  # (rows,) time since the first row [s]
    readings: dict[str, Values]  # "attitude" (rows, 4) [-] and "rate" (rows, 3) [rad/s], or "x" (rows, n)
    command: Values  # (rows, channels) held until the next row [N m]; with `wheel_inertia` wheel speeds [rad/s]
    by_channel: bool = False  # whether the columns of `command` are actuator channels; otherwise they are body axes
    wheel_inertia: float | None = None  # inertia of a wheel [kg m^2]; None: the command is a torque


def read(path: Path) -> pl.DataFrame:
    """Return the table of a .csv or .parquet file.

    Raises:
        RefusedError: the file is missing, has another type or is damaged.
    """
    allowed = "a .csv or .parquet file with a row for each time"
    if not path.is_file():
        raise RefusedError(f"there is no file {path}; a log is {allowed}")
    try:
        if path.suffix.lower() == ".csv":
            return csv_tables.read(path)
        if path.suffix.lower() == ".parquet":
            return pl.read_parquet(path, glob=False)
    except (OSError, ValueError, pl.exceptions.PolarsError) as error:
        first_line = (str(error).splitlines() or [type(error).__name__])[0]
        raise RefusedError(f"the log {path} cannot be read: {first_line}") from None
    raise RefusedError(f"the log is {path}, but must be {allowed}")


def measurements(scenario: Scenario, frame: pl.DataFrame, name: str = "the log") -> Measurements:
    """Return a log in SI units.

    Args:
        scenario: its table [telemetry] names the columns.
        frame: a row for each time.
        name: name of the log, for errors.

    Returns:
        The log from its first row on.

    Raises:
        RefusedError: a column is missing, or a value is not allowed. The message names the column and the row,
            counted from 0.
    """
    table = _Table(frame, name)
    spacecraft = scenario.plant.kind == "spacecraft"
    given: Any = scenario.telemetry or (Telemetry() if spacecraft else StateTelemetry())
    if frame.height < FEWEST:
        raise RefusedError(f"{name} has {frame.height} rows, but must have at least {FEWEST}")
    t = table.times(given.time)
    return _of_spacecraft(scenario, given, table, t) if spacecraft else _of_state(scenario, given, table, t)


class _Table:
    """Columns of a log as arrays, with errors that name column and row."""

    def __init__(self, frame: pl.DataFrame, name: str):
        self.frame, self.name = frame, name

    def refusal(self, column: str, row: int, allowed: str) -> RefusedError:
        """Return the error for a value of a column."""
        value = self.frame[column][row]
        shown = "empty" if value is None else value
        return RefusedError(f"{self.name} has {column} {shown} in row {row}, but must have {allowed}")

    def refuse(self, bad: Values, column: str, allowed: str | Callable[[int], str]) -> None:
        """Raise RefusedError for the first bad row (rows,), if there is one."""
        if bad.any():
            row = int(np.argmax(bad))
            raise self.refusal(column, row, allowed if isinstance(allowed, str) else allowed(row))

    def has_any(self, columns: Sequence[str]) -> bool:
        """Return whether the log has at least one of the columns."""
        return any(column in self.frame.columns for column in columns)

    def column(self, column: str) -> pl.Series:
        """Return a column. Raises RefusedError if the log does not have it."""
        if column not in self.frame.columns:
            raise RefusedError(f"{self.name} has no column {column}; {nearest_name_hint(column, self.frame.columns)}")
        return self.frame[column]

    def numbers(self, columns: Sequence[str], unit: float = 1.0) -> Values:
        """Return columns (rows, columns) in SI units, NaN for a blank cell; unit: unit of the columns in SI units."""
        found = []
        for name in columns:
            series = self.column(name)
            values = series.cast(pl.Float64, strict=False).to_numpy().astype(float)
            blank = series.is_null().to_numpy() | np.isnan(values)
            if series.dtype == pl.String:
                blank = series.is_null().to_numpy() | series.str.to_lowercase().eq("nan").fill_null(True).to_numpy()
            self.refuse(~blank & ~np.isfinite(values), name, "a finite number or an empty cell")
            found.append(values * unit)
        return np.stack(found, axis=1)

    def vectors(self, columns: Sequence[str], unit: float = 1.0) -> Values:
        """Return columns of vectors, which are complete or blank in each row; see `numbers`."""
        values = self.numbers(columns, unit)
        blank = np.isnan(values)
        partly = blank.any(axis=1) & ~blank.all(axis=1)
        if partly.any():
            row = int(np.argmax(partly))
            column = columns[int(np.argmax(blank[row]))]
            raise self.refusal(column, row, f"a number there, since {columns[int(np.argmin(blank[row]))]} has one")
        return values

    def times(self, column: str) -> Values:
        """Return the times (rows,) [s] from the first row on."""
        series = self.column(column)
        if series.dtype.is_temporal():
            counts = series.cast(pl.Datetime("ns")).dt.timestamp("ns")
            t = (counts - counts.min()).cast(pl.Float64).to_numpy() * 1e-9
        else:
            t = series.cast(pl.Float64, strict=False).to_numpy().astype(float)
            if series.dtype == pl.String and np.isnan(t).all():
                t = np.array([_seconds(cell) for cell in series])
                t = t - t[0] if np.isfinite(t[0]) else t
        self.refuse(~np.isfinite(t), column, "a number of seconds, or a date and time in ISO 8601")
        late = np.append(False, np.diff(t) <= 0.0)
        self.refuse(late, column, lambda row: f"a time after that of row {row - 1}, {series[row - 1]}")
        return t - t[0]

    def held(self, columns: Sequence[str], unit: float) -> Values:
        """Return commands; a blank cell holds the last value."""
        values = self.numbers(columns, unit)
        for k, column in enumerate(columns):
            self.refuse(np.isnan(values[:1, k]), column, "a number in the first row")
            there = np.maximum.accumulate(np.where(np.isnan(values[:, k]), 0, np.arange(len(values))))
            values[:, k] = values[there, k]
        return values


def _seconds(cell: str | None) -> float:
    """Return a date and time in ISO 8601 as seconds since 1970, NaN if it is none. Without a zone it is UTC."""
    try:
        moment = datetime.fromisoformat(cell or "")
    except ValueError:
        return np.nan
    moment = moment.replace(tzinfo=UTC) if moment.tzinfo is None else moment
    return (moment - datetime(1970, 1, 1, tzinfo=UTC)).total_seconds()


def _names(prefix: str, count: int) -> list[str]:
    return [f"{prefix}{k + 1}" for k in range(count)]


def _of_state(scenario: Scenario, given: Any, table: _Table, t: Values) -> Measurements:
    """Return the log of a chain or a custom system."""
    states, inputs = len(scenario.plant.x0), scenario.inputs
    for key, count in (("state", states), ("input", inputs)):
        columns = getattr(given, key)
        if columns is not None and len(columns) != count:
            raise RefusedError(f"telemetry.{key} has {len(columns)} columns, but must have {count} for this plant")
    x = table.numbers(given.state or _names("measured_x", states))
    command = table.held(given.input or _names("sent", inputs), 1.0)
    complete = np.all(~np.isnan(x), axis=1)
    if not complete.any():
        raise RefusedError(f"{table.name} has no row with every component of the state, but must have one")
    first = _first_row(t, {"x": x}, np.asarray(complete))
    return Measurements(table.name, t[first:] - t[first], {"x": x[first:]}, command[first:])


def _of_spacecraft(scenario: Scenario, given: Any, table: _Table, t: Values) -> Measurements:
    """Return the log of a spacecraft, from the first row with an attitude on."""
    readings = {}
    columns = given.attitude or _names("measured_q", 4)
    if given.attitude is not None or table.has_any(columns):
        readings["attitude"] = _attitude(given, table, columns)
    columns = given.rate or _names("measured_w", 3)
    if given.rate is not None or table.has_any(columns):
        readings["rate"] = table.vectors(columns, UNITS["rad/s"][given.rate_unit])
    if not readings or all(np.isnan(values).all() for values in readings.values()):
        raise RefusedError(
            f"{table.name} has no attitude and no rate, but must have one of them; name the columns in [telemetry], "
            "such as attitude = [..] or rate = [..]"
        )
    command, by_channel = _commands(scenario, given, table, t)
    age = given.attitude_age or ("measured_age" if table.has_any(["measured_age"]) else None)
    if age is not None and "attitude" in readings:
        ages = np.nan_to_num(table.numbers([age])[:, 0])
        table.refuse(ages < 0.0, age, "an age of at least 0 s")
        t, readings, command = _taken_before(t, ages, readings, command)
    _check_motion(table, t, readings)
    lead = readings.get("attitude", readings.get("rate"))
    assert lead is not None
    first = _first_row(t, readings, ~np.isnan(lead[:, 0]))
    rest = {name: values[first:] for name, values in readings.items()}
    inertia = given.wheel_inertia if given.wheel_speed is not None else None
    return Measurements(table.name, t[first:] - t[first], rest, command[first:], by_channel, inertia)


def _first_row(t: Values, readings: dict[str, Values], complete: Values) -> int:
    """Return the first complete row without an outlier, because the filter starts from its readings.

    A reading is an outlier if the third divided difference of the readings from it on is far beyond the usual one.

    Args:
        t: times (rows,) [s].
        readings: readings by name.
        complete: whether a row has the readings that the filter needs, (rows,) bool.
    """
    good = complete.copy()
    for values in readings.values():
        there = np.flatnonzero(~np.isnan(values).any(axis=1))
        if there.size > FEWEST:
            change = values[there]
            for k in (1, 2, 3):
                change = np.diff(change, axis=0) / (t[there[k:]] - t[there[:-k]])[:, None]
            sizes = np.max(np.abs(change), axis=1)
            good[there[:-3][sizes > OUTLIER * np.median(sizes)]] = False
    return int(np.argmax(good)) if good.any() else int(np.argmax(complete))


def _attitude(given: Any, table: _Table, columns: Sequence[str]) -> Values:
    """Return unit quaternions (rows, 4), scalar last, from body to inertial axes, with a continuous sign."""
    q = table.vectors(columns)
    norm = np.linalg.norm(q, axis=1)
    off = np.abs(norm - 1.0) > UNIT_NORM
    table.refuse(off, columns[0], lambda row: f"a unit quaternion in its four columns (the norm is {norm[row]:.6g})")
    q = q / norm[:, None]
    q = np.roll(q, -1, axis=1) if given.quaternion_order == "wxyz" else q
    if given.rotation == "inertial_to_body":
        q[:, :3] *= -1.0
    there = ~np.isnan(q[:, 0])
    q[there] = attitude_tables.with_continuous_signs(q[there])
    return q


def _commands(scenario: Any, given: Any, table: _Table, t: Values) -> tuple[Values, bool]:
    """Return the commands (rows, channels), and `by_channel` of `Measurements`."""
    count = 3 if scenario.wheels is None else len(scenario.wheels.spin_axes())
    for key in ("wheel_torque", "wheel_speed"):
        columns = getattr(given, key)
        if columns is None:
            continue
        if scenario.wheels is None:
            raise RefusedError(f"telemetry.{key} needs [wheels] in the scenario")
        if len(columns) != count:
            raise RefusedError(f"telemetry.{key} has {len(columns)} columns, but must have {count}, one for each wheel")
        if key == "wheel_torque":
            return table.held(columns, UNITS["N m"][given.torque_unit]), True
        speeds = table.numbers(columns, RPM if given.speed_unit == "rpm" else 1.0)
        for k, column in enumerate(columns):
            there = ~np.isnan(speeds[:, k])
            if not there.any():
                raise RefusedError(f"{table.name} has no number in the column {column}, but must have one")
            speeds[:, k] = np.interp(t, t[there], speeds[there, k])
        return speeds, True
    columns = given.torque or _names("sent", 3)
    return table.held(columns, UNITS["N m"][given.torque_unit]), False


def _taken_before(
    t: Values, ages: Values, readings: dict[str, Values], command: Values
) -> tuple[Values, dict[str, Values], Values]:
    """Move each attitude to the time at which it was taken, which may need rows of its own.

    Args:
        t: times of the rows [s].
        ages: ages of the attitudes [s].
        readings: readings by name.
        command: command of each row, which is held until the next row.

    Returns:
        Times, readings and commands of the new rows.
    """
    attitude = readings["attitude"]
    there = ~np.isnan(attitude[:, 0])
    taken = t - np.where(there, ages, 0.0)
    near = np.searchsorted(t, taken)
    for candidate in (np.clip(near - 1, 0, len(t) - 1), np.clip(near, 0, len(t) - 1)):
        taken = np.where(np.abs(t[candidate] - taken) < 1e-6, t[candidate], taken)
    times = np.unique(np.concatenate([t, taken[there & (taken >= t[0])]]))
    old = np.clip(np.searchsorted(t, times, side="right") - 1, 0, len(t) - 1)
    exact = t[old] == times
    moved = np.full((len(times), 4), np.nan)
    usable = there & (taken >= t[0])
    moved[np.searchsorted(times, taken[usable])] = attitude[usable]
    new = {name: np.where(exact[:, None], values[old], np.nan) for name, values in readings.items()}
    return times, {**new, "attitude": moved}, command[old]


def _check_motion(table: _Table, t: Values, readings: dict[str, Values]) -> None:
    """Raise RefusedError if the attitudes and the rates describe different motions.

    The rotation of the attitude over a part of the log is compared with the integral of the rate, if the part is
    between 0.02 and 0.5 rad.
    """
    if set(readings) != {"attitude", "rate"}:
        return
    q, rate = readings["attitude"], readings["rate"]
    both = np.flatnonzero(~np.isnan(q[:, 0]) & ~np.isnan(rate[:, 0]))
    ends = both[:: max(1, both.size // PARTS)]
    if ends.size < FEWEST:
        return
    known = ~np.isnan(rate[:, 0])
    filled = np.stack([np.interp(t, t[known], column[known]) for column in rate.T], axis=1)
    means = 0.5 * (filled[1:] + filled[:-1]) * np.diff(t)[:, None]
    integral = np.concatenate([np.zeros((1, 3)), np.cumsum(means, axis=0)])[ends]
    turns = (Rotation.from_quat(q[ends[:-1]]).inv() * Rotation.from_quat(q[ends[1:]])).as_rotvec()
    size, off = np.linalg.norm(turns, axis=1), np.linalg.norm(turns - np.diff(integral, axis=0), axis=1)
    clear = (size > 0.02) & (size < 0.5)
    if clear.sum() >= 5 and np.median(off[clear] / size[clear]) > GYRO_DISAGREES:
        raise RefusedError(
            f"{table.name} has rates that do not fit its attitudes: their integral differs from the rotation by a "
            f"median of {100.0 * np.median(off[clear] / size[clear]):.3g} %; check telemetry.rate_unit, order and "
            "rotation"
        )
