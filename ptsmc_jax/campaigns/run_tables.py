"""Run tables: a table with a row for each trial, which sets quantities instead of dispersing them.

The columns are those of a campaign's rows and of `--dry-run`, see `quantities`; the numbers of a vector come together.
`trial` and `seed` name the random numbers of a row; by default the row's number and the campaign's seed. A quantity
that is neither set nor dispersed is nominal. Columns with results (status, metrics) are ignored.
"""

import hashlib
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path

import jax
import numpy as np
import polars as pl

from ptsmc_jax.campaigns.store import RefusedError
from ptsmc_jax.dispersions.quantities import QUANTITIES, UnfitError
from ptsmc_jax.dispersions.variation import RESULT_COLUMNS, SEED, TRIAL, Row
from ptsmc_jax.numerics import csv_tables
from ptsmc_jax.scenario import parsing
from ptsmc_jax.simulation import computer
from ptsmc_jax.simulation.catalogues import CATALOGUE
from ptsmc_jax.simulation.rollout import Parts

ALLOWED = "a .csv or .parquet file with a row for each trial, or a folder of such .parquet files"
ANGLE = "initial_angle"  # column of the initial angle, which follows from other columns
STATUS_COLUMNS = ("status", "reason", "bad_time")  # first columns of the results of a trial
RESULTS = {*STATUS_COLUMNS, *CATALOGUE}
COUNT_PREFIX = "controller_"  # beginning of the columns with numbers of samples by the status that exported C returned
SAMPLES = tuple(f"{COUNT_PREFIX}{ended}" for ended in computer.SAMPLE_STATUSES)
MOST_TRIALS = 2**32  # largest number of trials, and of seeds


@dataclass(frozen=True)
class RunTable:
    """A run table that `check_table` has checked."""

    given: dict[str, np.ndarray]  # numbers (rows, n) by the names of `QUANTITIES`
    count: int  # number of rows
    streams: dict[str, np.ndarray] = field(default_factory=dict)  # (rows,) by TRIAL and SEED, if the table states them
    dependent: dict[str, np.ndarray] = field(default_factory=dict)  # (rows,) by column, see `check_dependent`

    @property
    def checksum(self) -> str:
        """SHA-256 of its trials: tables with the same trials have the same checksum."""
        checksum = hashlib.sha256(str(self.count).encode())
        for name, values in [*sorted(self.given.items()), *self.streams.items()]:
            plain = np.ascontiguousarray(values, dtype=values.dtype.newbyteorder("<"))
            checksum.update(name.encode() + plain.tobytes())
        return checksum.hexdigest()

    def rows(self, numbers: np.ndarray, seed: int) -> np.ndarray | Row:
        """Return these rows, or numbers of trials if the table sets nothing; numbers: (rows,) from 0; seed: default."""
        numbers = np.asarray(numbers, dtype=np.uint32)
        trial = self.streams[TRIAL][numbers] if TRIAL in self.streams else numbers
        if not self.given and SEED not in self.streams:
            return trial
        seeds = self.streams[SEED][numbers] if SEED in self.streams else np.full_like(numbers, seed)
        return Row(seeds, trial, {name: values[numbers] for name, values in self.given.items()})

    def row(self, number: int, seed: int) -> int | Row:
        """Return one row: a `Row`, or only a trial number if the table sets nothing; arguments as for `rows`."""
        many = self.rows(np.asarray([number]), seed)
        return jax.tree.map(lambda v: v[0], many) if isinstance(many, Row) else int(many[0])

    def without(self, quantities: Iterable[str]) -> "RunTable":
        """Return the table without the columns of these quantities, which it then does not set."""
        return replace(self, given={name: values for name, values in self.given.items() if name not in quantities})

    def frame(self, parts: Parts) -> pl.DataFrame:
        """Return the table as a data frame, in one form for equal run tables."""
        columns = dict(self.streams)
        for name, values in self.given.items():
            columns |= dict(zip(QUANTITIES[name].columns(parts), values.T, strict=True))
        return pl.DataFrame(columns or {TRIAL: np.arange(self.count, dtype=np.uint32)})


def read(path: Path, name: str = "--runs", allowed: str = ALLOWED) -> pl.DataFrame:
    """Return the table of a .csv or .parquet file, or of a folder that `--dry-run` wrote.

    Args:
        path: the file or folder.
        name: name of the table in errors.
        allowed: the allowed files, for errors.

    Raises:
        RefusedError: it does not exist, has another type or cannot be read.
    """
    if not path.exists():
        raise RefusedError(f"{name} is {path}, which does not exist; allowed is {allowed}")
    files = sorted(path.glob("*.parquet")) if path.is_dir() else [path]
    if not files or files[0].suffix.lower() not in (".csv", ".parquet"):
        raise RefusedError(f"{name} is {path}, but must be {allowed}")
    table = None
    for file in files:
        try:
            part = csv_tables.read_table(file)
            table = part if table is None else pl.concat([table, part])
        except (ValueError, pl.exceptions.PolarsError) as error:
            damaged = "which" if file == path else f"whose {file.name}"
            raise RefusedError(f"{name} is {path}, {damaged} cannot be read: {str(error).splitlines()[0]}") from None
    assert table is not None
    return table


def check_table(
    table: pl.DataFrame,
    parts: Parts,
    where: str = "the run table",
    custom_metrics: Iterable[str] = (),
    drawn: Iterable[str] = (),
) -> RunTable:
    """Return the run table of a data frame.

    Args:
        table: a row for each trial.
        parts: the nominal parts; the quantities depend on them.
        where: the name of the table in errors.
        custom_metrics: names of custom metrics, which are allowed as columns.
        drawn: names of the numbers of custom dispersions, see `check_dependent`.

    Returns:
        The checked run table.

    Raises:
        RefusedError: a column is unknown or lacks the others of its vector, a cell is empty or not a finite number, or
            a value cannot be simulated. The sentence names column and row, counted from 0.
    """
    if not table.height:
        raise RefusedError(f"{where} has no rows, but must have one for each trial")
    columns_of = {name: quantity.columns(parts) for name, quantity in QUANTITIES.items()}
    quantity_of = {column: name for name, columns in columns_of.items() for column in columns}
    stream_columns = {*RESULT_COLUMNS, *RESULT_COLUMNS.values()}
    known = {*quantity_of, *stream_columns, ANGLE, *RESULTS, *SAMPLES, *custom_metrics, *drawn}
    unknown = next((column for column in table.columns if column not in known), None)
    if unknown is not None:
        hint = parsing.nearest_name_hint(unknown, (*quantity_of, *RESULT_COLUMNS))
        raise RefusedError(f"{where} has the column {unknown}, which no trial of this scenario has; {hint}")
    given: dict[str, np.ndarray] = {}
    for column in table.columns:
        name = quantity_of.get(column)
        if name is None or name in given:
            continue
        columns = columns_of[name]
        for other in columns:
            if other not in table.columns:
                raise RefusedError(
                    f"{where} has the column {column}, but not {other}: {_column_range(columns)} come together"
                )
        given[name] = np.stack([_finite_numbers(table, other, where) for other in columns], axis=1)
    name = ""
    try:
        for name, values in given.items():
            given[name] = QUANTITIES[name].validate(values)
        for name in given:
            QUANTITIES[name].check_together(given, parts)
    except UnfitError as error:
        row, columns = ", ".join(f"{v:.9g}" for v in given[name][error.row]), columns_of[name]
        heading = columns[0] if len(columns) == 1 else f"{_column_range(columns)} ="
        raise _row_error(where, heading, error.row, row, str(error)) from None
    streams = {}
    for name, other in RESULT_COLUMNS.items():  # the rows of a campaign state these numbers in `other`
        column = other if other in table.columns else name
        if column in table.columns:
            streams[name] = _whole_numbers(table, column, where)
    if TRIAL in streams and np.array_equal(streams[TRIAL], np.arange(table.height)):
        del streams[TRIAL]  # row k has the number k of a trial, as by default
    dependent = {name: _to_numbers(table[name]) for name in (ANGLE, *drawn) if name in table.columns}
    return RunTable(given, table.height, streams, dependent)


def check_dependent(stated: dict[str, np.ndarray], rows: pl.DataFrame, where: str) -> None:
    """Raise RefusedError if columns that a table cannot set have other values than its trials.

    These columns are the initial angle, which follows from other columns, and the numbers of custom dispersions, since
    only `Draw.at` knows the parts that follow from them.

    Args:
        stated: values in the table (rows,), by column.
        rows: the rows of the trials.
        where: the name of the table in errors.
    """
    rule = "is the value of this trial, or no such column: a run table cannot set it"
    for name, values in stated.items():
        numbers = _to_numbers(rows[name])
        largest = np.max(np.abs(numbers), initial=1.0 if name == ANGLE else 0.0, where=np.isfinite(numbers))
        is_same = (np.abs(numbers - values) <= 1e-5 * largest) | (np.isnan(numbers) & np.isnan(values))
        check_rows(
            ~is_same, where, name, values, lambda row, numbers=numbers: f"{numbers[row]:.9g} there, which {rule}"
        )


def _column_range(columns: list[str]) -> str:
    """Return the first and the last of these columns in words, such as "q1 to q4"."""
    return " to ".join((columns[0], columns[-1]))


def _row_error(where: str, column: str, row: int, value: object, allowed: str) -> RefusedError:
    """Return the error for a cell of a run table.

    Args:
        where: the name of the table.
        column: name of the column.
        row: number of the row, from 0.
        value: content of the cell, or None if it is empty.
        allowed: the allowed values, in words.
    """
    value = value.to_list() if isinstance(value, pl.Series) else f"{value:.10g}" if isinstance(value, float) else value
    shown = "empty" if value is None else value
    return RefusedError(f"{where} has {column} {shown} in row {row}, but must have {allowed}")


def check_rows(
    is_bad: np.ndarray, where: str, column: str, values: pl.Series | np.ndarray, allowed: str | Callable[[int], str]
) -> None:
    """Raise RefusedError for the first row of a column that `is_bad` (rows,) marks, if there is one.

    Args:
        is_bad: which rows are bad.
        where: the name of the table in errors.
        column: name of the column.
        values: its values (rows,).
        allowed: the allowed values in words, or a function of the row that returns them.
    """
    if is_bad.any():
        row = int(np.argmax(is_bad))
        raise _row_error(where, column, row, values[row], allowed if isinstance(allowed, str) else allowed(row))


def _finite_numbers(table: pl.DataFrame, column: str, where: str) -> np.ndarray:
    """Return a column of finite numbers, (rows,). Raises RefusedError if a cell is not a finite number."""
    numbers = _to_numbers(table[column])
    check_rows(~np.isfinite(numbers), where, column, table[column], "a finite number")
    return numbers


def _to_numbers(values: pl.Series) -> np.ndarray:
    """Return the numbers of a column, (rows,); an empty cell or text is NaN."""
    if values.dtype.is_numeric() or values.dtype == pl.String:
        return values.cast(pl.Float64, strict=False).to_numpy().astype(float)
    return np.full(values.len(), np.nan)


def _whole_numbers(table: pl.DataFrame, column: str, where: str) -> np.ndarray:
    """Return a column of whole numbers below 2^32, (rows,). Raises RefusedError if a cell is not such a number."""
    values = _finite_numbers(table, column, where)
    is_bad = (values != np.floor(values)) | (values < 0) | (values >= MOST_TRIALS)
    check_rows(is_bad, where, column, table[column], f"a whole number from 0 to {MOST_TRIALS - 1}")
    return values.astype(np.uint32)
