"""Telemetry of a real or simulated run as arrays: time, sensor readings, commands. Start with `measurements`.

A log is a table with a row for each time. `[telemetry]` of a scenario names its columns and their units. Cells may be
blank: a sensor has no reading in that row, or a command holds its last value.
"""

from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple, get_args

import numpy as np
import polars as pl
from scipy.ndimage import median_filter
from scipy.spatial.transform import Rotation

from ptsmc_jax import formulas
from ptsmc_jax.campaigns import run_tables
from ptsmc_jax.campaigns.store import RefusedError
from ptsmc_jax.scenario.disturbance_tables import largest_disturbance
from ptsmc_jax.scenario.identify_tables import Identify, RateUnit, SpeedUnit, StateTelemetry, Telemetry, TorqueUnit
from ptsmc_jax.scenario.parsing import nearest_name_hint
from ptsmc_jax.scenario.spacecraft_scenario import SpacecraftScenario
from ptsmc_jax.scenario.tables import Scenario
from ptsmc_jax.signals import references
from ptsmc_jax.units import in_si

MIN_ROWS = 10  # smallest number of rows of a log
NORM_TOLERANCE = 1e-3  # largest error of the norm of a quaternion: telemetry often has few digits
MAX_GYRO_DIFFERENCE = 0.5  # largest median difference between attitude and gyro, relative to the rotation
OUTLIER_RATIO = 10.0  # third difference of an outlier, relative to the median
MIN_TURN = 0.005  # smallest rotation of a part of a log in which attitude and gyro are compared [rad]
MIN_TURN_TO_NOISE = 10.0  # smallest ratio of this rotation to the noise of an attitude
COMPARED_PARTS = (400, 100, 25)  # numbers of parts of a log in which signals are compared; the first that suits
MAX_BIAS = 0.06  # largest gyro bias that may explain a difference between attitude and gyro [rad/s]
MAX_UNIT_DIFFERENCE = 0.2  # largest median difference between attitude and gyro in the unit that an error suggests
MIN_CORRELATION = 0.9  # smallest correlation of torque and motion with which their sizes are compared
MIN_TORQUE_TO_DISTURBANCE = 2.0  # smallest ratio of RMS torque to the largest disturbance in this comparison
UNIT_RATIO_ERROR = 2.0  # largest factor between a ratio of torque and motion and the ratio of two units
MAX_TORQUE_RATIO = 30.0  # largest ratio of torque and motion, or of motion and torque, without a unit that explains it
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
    return run_tables.read(path, "the log", "a .csv or .parquet file with a row for each time")


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
    if frame.height < MIN_ROWS:
        raise RefusedError(f"{name} has {frame.height} rows, but must have at least {MIN_ROWS}")
    read_log = _read_spacecraft_log if scenario.plant.kind == "spacecraft" else _read_state_log
    return read_log(scenario, table)


class _Table:
    """Columns of a log as arrays, with errors that name column and row."""

    def __init__(self, frame: pl.DataFrame, name: str):
        self.frame, self.name = frame, name

    def check_rows(self, is_bad: Values, column: str, allowed: str | Callable[[int], str]) -> None:
        """Raise RefusedError for the first row that `is_bad` (rows,) marks, if there is one."""
        run_tables.check_rows(is_bad, self.name, column, self.frame[column], allowed)

    def column(self, column: str) -> pl.Series:
        """Return a column. Raises RefusedError if the log does not have it."""
        if column not in self.frame.columns:
            raise RefusedError(f"{self.name} has no column {column}; {nearest_name_hint(column, self.frame.columns)}")
        return self.frame[column]

    def read_numbers(self, columns: Sequence[str], unit: float = 1.0) -> Values:
        """Return columns (rows, columns) in SI units, NaN for a blank cell; unit: unit of the columns in SI units."""
        converted = []
        for name in columns:
            series = self.column(name)
            values = series.cast(pl.Float64, strict=False).to_numpy().astype(float)
            is_blank = series.is_null().to_numpy() | np.isnan(values)
            if series.dtype == pl.String:
                is_blank = series.is_null().to_numpy() | series.str.to_lowercase().eq("nan").fill_null(True).to_numpy()
            self.check_rows(~is_blank & ~np.isfinite(values), name, "a finite number or an empty cell")
            converted.append(values * unit)
        return np.stack(converted, axis=1)

    def read_vectors(self, columns: Sequence[str], unit: float = 1.0) -> Values:
        """Return columns of vectors, which are complete or blank in each row; see `read_numbers`."""
        values = self.read_numbers(columns, unit)
        is_blank = np.isnan(values)
        for k, name in enumerate(columns):
            is_incomplete = is_blank[:, k] & ~is_blank.all(axis=1)
            self.check_rows(
                is_incomplete,
                name,
                lambda row: f"a number there, since {columns[int(np.argmin(is_blank[row]))]} has one",
            )
        return values

    def read_times(self, column: str) -> Values:
        """Return the times since the first row (rows,) [s]."""
        series = self.column(column)
        if series.dtype.is_temporal():
            counts = series.cast(pl.Datetime("ns")).dt.timestamp("ns")
            t = (counts - counts.min()).cast(pl.Float64).to_numpy() * 1e-9
        else:
            t = series.cast(pl.Float64, strict=False).to_numpy().astype(float)
            if series.dtype == pl.String and np.isnan(t).all():
                t = np.array([_iso_to_seconds(cell) for cell in series])
                t = t - t[0] if np.isfinite(t[0]) else t
        self.check_rows(~np.isfinite(t), column, "a number of seconds, or a date and time in ISO 8601")
        is_not_later = np.append(False, np.diff(t) <= 0.0)
        self.check_rows(is_not_later, column, lambda row: f"a time after that of row {row - 1}, {series[row - 1]}")
        return t - t[0]

    def read_commands(self, columns: Sequence[str], unit: float) -> Values:
        """Return the commands (rows, columns) in SI units; a blank cell repeats the last value of its column.

        Raises RefusedError for a blank cell in the first row.
        """
        values = self.read_numbers(columns, unit)
        for k, column in enumerate(columns):
            self.check_rows(np.isnan(values[:1, k]), column, "a number in the first row")
            last_filled_row = np.maximum.accumulate(np.where(np.isnan(values[:, k]), 0, np.arange(len(values))))
            values[:, k] = values[last_filled_row, k]
        return values


def _iso_to_seconds(cell: str | None) -> float:
    """Return a date and time in ISO 8601 as seconds since 1970. A time without a zone is UTC; another text is NaN."""
    try:
        moment = datetime.fromisoformat(cell or "")
    except ValueError:
        return np.nan
    moment = moment.replace(tzinfo=UTC) if moment.tzinfo is None else moment
    return (moment - datetime(1970, 1, 1, tzinfo=UTC)).total_seconds()


def _numbered_columns(prefix: str, count: int) -> list[str]:
    """Return names such as "q1", "q2" for a prefix and a number of columns."""
    return [f"{prefix}{k + 1}" for k in range(count)]


def _read_state_log(scenario: Scenario, table: _Table) -> Measurements:
    """Return the log of a chain or a custom system."""
    states, inputs, config = len(scenario.plant.x0), scenario.inputs, scenario.telemetry or StateTelemetry()
    t = table.read_times(config.time)
    for key, count in (("state", states), ("input", inputs)):
        columns = getattr(config, key)
        if columns is not None and len(columns) != count:
            raise RefusedError(f"telemetry.{key} has {len(columns)} columns, but must have {count} for this plant")
    x = table.read_numbers(config.state or _numbered_columns("measured_x", states))
    command = table.read_commands(config.input or _numbered_columns("sent", inputs), 1.0)
    is_complete = np.all(~np.isnan(x), axis=1)
    if not is_complete.any():
        raise RefusedError(f"{table.name} has no row with every component of the state, but must have one")
    start = _find_start_row(t, {"x": x}, np.asarray(is_complete))
    return Measurements(table.name, t[start:] - t[start], {"x": x[start:]}, command[start:])


def _read_spacecraft_log(scenario: Any, table: _Table) -> Measurements:
    """Return the log of a spacecraft, starting at the first row with an attitude."""
    config: Telemetry = scenario.telemetry or Telemetry()
    t, readings = table.read_times(config.time), {}
    logged = set(table.frame.columns)
    columns = config.attitude or _numbered_columns("measured_q", 4)
    if config.attitude is not None or logged.intersection(columns):
        readings["attitude"] = _read_attitudes(config, table, columns)
    rate_columns = config.rate or _numbered_columns("measured_w", 3)
    if config.rate is not None or logged.intersection(rate_columns):
        readings["rate"] = table.read_vectors(rate_columns, in_si(config.rate_unit))
    if not readings or all(np.isnan(values).all() for values in readings.values()):
        raise RefusedError(
            f"{table.name} has no attitude and no rate, but must have one of them; name the columns in [telemetry], "
            "such as attitude = [..] or rate = [..]"
        )
    command_columns = config.wheel_torque or config.wheel_speed or config.torque or _numbered_columns("sent", 3)
    command, by_channel = _read_torques_or_speeds(scenario, config, table, t)
    age_column = config.attitude_age or ("measured_age" if "measured_age" in logged else None)
    if age_column is not None and "attitude" in readings:
        ages = np.nan_to_num(table.read_numbers([age_column])[:, 0])
        table.check_rows(ages < 0.0, age_column, "an age of at least 0 s")
        t, readings, command = _move_to_measurement_times(t, ages, readings, command)
    _check_rates_match_attitudes(table, rate_columns, config.rate_unit, t, readings)
    inertia = config.wheel_inertia if config.wheel_speed is not None else None
    log = Measurements(table.name, t, readings, command, by_channel, inertia)
    _check_torques_match_motion(scenario, config, command_columns, log)
    main_readings = readings.get("attitude", readings.get("rate"))
    assert main_readings is not None
    start = _find_start_row(t, readings, ~np.isnan(main_readings[:, 0]))
    kept_readings = {name: values[start:] for name, values in readings.items()}
    return log._replace(t=t[start:] - t[start], readings=kept_readings, command=command[start:])


def _find_start_row(t: Values, readings: dict[str, Values], is_complete: Values) -> int:
    """Return the index of the first complete row without an outlier; the filter starts from its readings.

    A reading is an outlier if the third divided difference of this reading and the next three is far above the median.

    Args:
        t: times (rows,) [s].
        readings: readings by name.
        is_complete: whether a row has the readings that the filter needs, (rows,) bool.
    """
    is_usable = is_complete.copy()
    for values in readings.values():
        reading_rows = np.flatnonzero(~np.isnan(values).any(axis=1))
        if reading_rows.size > MIN_ROWS:
            difference = values[reading_rows]
            for k in (1, 2, 3):
                difference = np.diff(difference, axis=0) / (t[reading_rows[k:]] - t[reading_rows[:-k]])[:, None]
            magnitudes = np.max(np.abs(difference), axis=1)
            is_usable[reading_rows[:-3][magnitudes > OUTLIER_RATIO * np.median(magnitudes)]] = False
    return int(np.argmax(is_usable)) if is_usable.any() else int(np.argmax(is_complete))


def _read_attitudes(config: Telemetry, table: _Table, columns: Sequence[str]) -> Values:
    """Return unit quaternions (rows, 4), scalar last, from body to inertial axes, with a continuous sign."""
    q = table.read_vectors(columns)
    norm = np.linalg.norm(q, axis=1)
    is_off = np.abs(norm - 1.0) > NORM_TOLERANCE
    table.check_rows(
        is_off, columns[0], lambda row: f"a unit quaternion in its four columns (the norm is {norm[row]:.6g})"
    )
    q = q / norm[:, None]
    q = np.roll(q, -1, axis=1) if config.quaternion_order == "wxyz" else q
    if config.rotation == "inertial_to_body":
        q[:, :3] *= -1.0
    has_attitude = ~np.isnan(q[:, 0])
    q[has_attitude] = references.with_continuous_signs(q[has_attitude])
    return q


def _read_torques_or_speeds(
    scenario: SpacecraftScenario, config: Telemetry, table: _Table, t: Values
) -> tuple[Values, bool]:
    """Return the commands (rows, channels), and `by_channel` of `Measurements`."""
    key = "wheel_torque" if config.wheel_torque is not None else "wheel_speed"
    columns, torque_unit = getattr(config, key), in_si(config.torque_unit)
    if columns is None:
        return table.read_commands(config.torque or _numbered_columns("sent", 3), torque_unit), False
    if scenario.wheels is None:
        raise RefusedError(f"telemetry.{key} needs [wheels] in the scenario")
    count = len(scenario.wheels.spin_axes())
    if len(columns) != count:
        raise RefusedError(f"telemetry.{key} has {len(columns)} columns, but must have {count}, one for each wheel")
    if key == "wheel_torque":
        return table.read_commands(columns, torque_unit), True
    speeds = table.read_numbers(columns, in_si(config.speed_unit))
    for k, column in enumerate(columns):
        has_speed = ~np.isnan(speeds[:, k])
        if not has_speed.any():
            raise RefusedError(f"{table.name} has no number in the column {column}, but must have one")
        speeds[:, k] = np.interp(t, t[has_speed], speeds[has_speed, k])
    return speeds, True


def _move_to_measurement_times(
    t: Values, ages: Values, readings: dict[str, Values], command: Values
) -> tuple[Values, dict[str, Values], Values]:
    """Move each attitude to the time at which it was measured, in an additional row if necessary.

    Args:
        t: times of the rows [s].
        ages: ages of the attitudes [s].
        readings: readings by name.
        command: command of each row, which is held until the next row.

    Returns:
        Times, readings and commands of the new rows.
    """
    attitude = readings["attitude"]
    has_attitude = ~np.isnan(attitude[:, 0])
    measured_at = t - np.where(has_attitude, ages, 0.0)
    next_row = np.searchsorted(t, measured_at)
    for candidate in (np.clip(next_row - 1, 0, len(t) - 1), np.clip(next_row, 0, len(t) - 1)):
        measured_at = np.where(np.abs(t[candidate] - measured_at) < 1e-6, t[candidate], measured_at)
    times = np.unique(np.concatenate([t, measured_at[has_attitude & (measured_at >= t[0])]]))
    source_row = np.clip(np.searchsorted(t, times, side="right") - 1, 0, len(t) - 1)
    is_original = t[source_row] == times
    moved = np.full((len(times), 4), np.nan)
    is_usable = has_attitude & (measured_at >= t[0])
    moved[np.searchsorted(times, measured_at[is_usable])] = attitude[is_usable]
    new = {name: np.where(is_original[:, None], values[source_row], np.nan) for name, values in readings.items()}
    return times, {**new, "attitude": moved}, command[source_row]


def estimate_noise(values: np.ndarray, axis: int | None = None) -> Any:
    """Return the noise of values (rows, n), 1 sigma, robustly from third differences with 20 times its variance.

    Args:
        values: values of a smooth signal with normal noise.
        axis: 0: return the noise of each column, (n,); None: return the noise of all of them.
    """
    return 1.4826 * np.median(np.abs(np.diff(values, 3, axis=0)), axis=axis) / np.sqrt(20.0)


def _check_rates_match_attitudes(
    table: _Table, columns: Sequence[str], unit: str, t: Values, readings: dict[str, Values]
) -> None:
    """Raise RefusedError if the attitudes and the rates describe different motions.

    The sum of the rotations from sample to sample over each part of the log is compared with the integral of the rate.
    Parts that turn by less than `MIN_TURN`, by little compared with the noise of the attitudes, or by more than 0.5 rad
    between two samples, are ignored. Longer parts follow if less than five parts are left. Medians of three readings
    replace the readings, so that a part with an outlier does not seem to turn.

    Args:
        table: the log.
        columns: columns of the rates.
        unit: unit of the rates in the scenario.
        t: times [s].
        readings: readings by name.
    """
    if set(readings) != {"attitude", "rate"}:
        return
    q, rate = readings["attitude"], readings["rate"]
    common_rows = np.flatnonzero(~np.isnan(q[:, 0]) & ~np.isnan(rate[:, 0]))
    if common_rows.size < MIN_ROWS:
        return
    integral = _integrate(t, _smooth_rates(t, rate))[common_rows]
    attitudes = Rotation.from_quat(q[common_rows])
    rotations = (attitudes[:-1].inv() * attitudes[1:]).as_rotvec()
    turns = np.concatenate([np.zeros((1, 3)), np.cumsum(rotations, axis=0)])
    smallest_turn = max(MIN_TURN, MIN_TURN_TO_NOISE * estimate_noise(turns))
    turns = median_filter(turns, (3, 1))
    for count in COMPARED_PARTS:
        ends = np.arange(0, common_rows.size, max(1, common_rows.size // count))
        turn, rate_turn, duration = (np.diff(v[ends], axis=0) for v in (turns, integral, t[common_rows, None]))
        largest_step = np.maximum.reduceat(np.linalg.norm(rotations, axis=1), ends[:-1])
        angle = np.linalg.norm(turn, axis=1)
        is_comparable = (angle > smallest_turn) & (largest_step < 0.5)
        if is_comparable.sum() >= 5:
            break
    else:
        return
    turn, rate_turn, duration, angle = (v[is_comparable] for v in (turn, rate_turn, duration, angle))

    def median_difference(rate_turn: Values) -> float:
        return float(np.median(np.linalg.norm(rate_turn - turn, axis=1) / angle))

    if median_difference(rate_turn) <= MAX_GYRO_DIFFERENCE:
        return
    ratio = np.median(np.linalg.norm(rate_turn, axis=1) / angle)
    message = (
        f"{table.name} has rates that do not fit its attitudes: the columns {', '.join(columns)} integrate to "
        f"{ratio:.3g} times the rotation"
    )
    ratios = {other: in_si(other) / in_si(unit) for other in get_args(RateUnit)}
    differences = {other: median_difference(ratio * rate_turn) for other, ratio in ratios.items()}
    likely_unit = min(differences, key=lambda other: differences[other])
    if differences[likely_unit] < MAX_UNIT_DIFFERENCE:
        raise RefusedError(f'{message}; set telemetry.rate_unit = "{likely_unit}", which fits')
    bias = np.clip(np.median((rate_turn - turn) / duration, axis=0), -MAX_BIAS, MAX_BIAS)
    if median_difference(rate_turn - bias * duration) > MAX_GYRO_DIFFERENCE:
        raise RefusedError(
            f"{message}, and differ from it by a median of {100.0 * differences[unit]:.3g} %; check "
            "telemetry.rate_unit, order and rotation"
        )


def _smooth_rates(t: Values, rate: Values) -> Values:
    """Return the medians of three rates (rows, 3) [rad/s], interpolated where a rate is missing."""
    has_rate = ~np.isnan(rate[:, 0])
    return np.stack([np.interp(t, t[has_rate], column) for column in median_filter(rate[has_rate], (3, 1)).T], axis=1)


def _integrate(t: Values, values: Values) -> Values:
    """Return the integral (rows, n) of values from the first time on, by the trapezoidal rule."""
    increments = 0.5 * (values[1:] + values[:-1]) * np.diff(t)[:, None]
    return np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(increments, axis=0)])


def _measured_rates(log: Measurements) -> tuple[Values, Values]:
    """Return times (rows,) [s] and body rates (rows, 3) [rad/s], from the attitudes if the log has no rates.

    There are no rows if the log has fewer than `MIN_ROWS` attitudes.
    """
    rate = log.readings.get("rate", np.full((1, 3), np.nan))
    if np.isfinite(rate).any():
        return log.t, rate
    has_attitude = ~np.isnan(log.readings["attitude"][:, 0])
    if has_attitude.sum() < MIN_ROWS:
        return np.zeros(0), np.zeros((0, 3))
    attitudes, times = Rotation.from_quat(log.readings["attitude"][has_attitude]), log.t[has_attitude]
    rotations = (attitudes[:-1].inv() * attitudes[1:]).as_rotvec()
    return 0.5 * (times[1:] + times[:-1]), rotations / np.diff(times)[:, None]


def _check_torques_match_motion(
    scenario: SpacecraftScenario, config: Telemetry, columns: Sequence[str], log: Measurements
) -> None:
    """Raise RefusedError if the motion shows that the torques or the speeds of the wheels are in another unit.

    The mean of J w in each part of the log, less that of the part before, is compared with the same difference of the
    commanded impulse. Both must be correlated, so that noise or a fast rotation is no error of a unit. An actuator that
    compensates a disturbance hardly moves the body. Torques that are not above the disturbances of the scenario are
    therefore not compared.

    Args:
        scenario: a spacecraft.
        config: its table [telemetry].
        columns: columns of the torques or speeds.
        log: the log.
    """
    axes = scenario.wheels.spin_axes() if log.by_channel and scenario.wheels is not None else np.eye(3)
    walk, disturbance = (scenario.identify or Identify()).torque_walk, largest_disturbance(scenario)
    if walk or disturbance is None:
        return
    t, interval = log.t, np.append(np.diff(log.t), 0.0)[:, None]
    wheel_inertia = log.wheel_inertia
    if wheel_inertia is not None:
        impulse = -wheel_inertia * (log.command - log.command[0]) @ axes
    else:
        impulse = np.cumsum(log.command * interval, axis=0) @ axes
        impulse = np.concatenate([np.zeros((1, 3)), impulse[:-1]])
    rate_t, rate = _measured_rates(log)
    if not rate_t.size:
        return
    momentum = _smooth_rates(rate_t, rate) @ formulas.check_inertia(scenario.true_inertia)
    impulse = np.stack([np.interp(rate_t, t, column) for column in impulse.T], axis=1)
    for count in COMPARED_PARTS:
        starts = np.arange(0, rate_t.size, max(1, rate_t.size // count))
        sizes = np.diff(np.append(starts, rate_t.size))[:, None]
        change, commanded = (np.diff(np.add.reduceat(v, starts) / sizes, axis=0) for v in (momentum, impulse))
        product, largest = np.sum(change * commanded), np.linalg.norm(change) * np.linalg.norm(commanded)
        if starts.size >= MIN_ROWS and abs(product) > MIN_CORRELATION * largest:
            break
    else:
        return
    ratio = product / np.sum(commanded**2)
    torque = np.sqrt(np.mean(np.square(np.diff(impulse, axis=0) / np.diff(rate_t)[:, None])))
    if max(1.0, abs(ratio)) * torque < MIN_TORQUE_TO_DISTURBANCE * disturbance[0]:
        return
    key, kinds = ("speed_unit", SpeedUnit) if wheel_inertia is not None else ("torque_unit", TorqueUnit)
    unit = getattr(config, key)
    errors = {other: abs(np.log(abs(ratio) * in_si(unit) / in_si(other))) for other in get_args(kinds)}
    likely_unit = min(errors, key=lambda other: errors[other])
    fits = errors[likely_unit] < np.log(UNIT_RATIO_ERROR)
    message = (
        f"{log.name} has {'wheel speeds' if wheel_inertia is not None else 'torques'} that do not fit its motion: "
        f"the momentum changes by {ratio:.3g} times the impulse of the columns {', '.join(columns)}"
    )
    if fits and likely_unit != unit:
        inertia = "telemetry.wheel_inertia and " if wheel_inertia is not None else ""
        raise RefusedError(
            f'{message}; set telemetry.{key} = "{likely_unit}", which fits, or check {inertia}spacecraft.inertia'
        )
    if fits and ratio < 0.0:
        raise RefusedError(f"{message}; check the signs of these columns")
    if abs(np.log(abs(ratio))) > np.log(MAX_TORQUE_RATIO):
        rate_unit = ", telemetry.rate_unit" if rate_t is log.t else ""
        inertia = ", telemetry.wheel_inertia" if wheel_inertia is not None else ""
        raise RefusedError(f"{message}; check telemetry.{key}{rate_unit}{inertia} and spacecraft.inertia")
