"""A plan: trials from a table, one in each row, what it gives flown in place of what is drawn.

A column is one that rows and `--dry-run` have, see `quantities`; numbers of one vector come together. `trial` and
`seed` say whose draws and noise a row has: those of its own number and of the campaign's seed where they are absent.
What is neither given nor drawn is nominal. Results (status, metrics) may stand beside, and count for nothing.
"""

import hashlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

import jax
import numpy as np
import polars as pl

from ptsmc_jax.campaigns import csv_tables
from ptsmc_jax.campaigns.store import RefusedError
from ptsmc_jax.dispersions.planned import OF_ROWS, SEED, TRIAL, Row
from ptsmc_jax.dispersions.quantities import QUANTITIES, UnfitError
from ptsmc_jax.scenario import parsing
from ptsmc_jax.simulation import computer
from ptsmc_jax.simulation.catalogues import CATALOGUE
from ptsmc_jax.simulation.rollout import Parts

ALLOWED = "a .csv or .parquet file with a row for each trial, or a folder of such .parquet files"
ANGLE = "initial_angle"  # follows from others
HEADING = ("status", "reason", "bad_time")  # of a row
RESULTS = {*HEADING, *CATALOGUE}
COUNTED = "controller_"  # and how samples of exported C end: how many of them
SAMPLES = tuple(f"{COUNTED}{ended}" for ended in computer.SAMPLES)
MOST = 2**32  # of trials and seeds


@dataclass(frozen=True)
class Plan:
    """A plan that was looked at, see `checked`."""

    given: dict[str, np.ndarray]  # numbers (rows, n) by the names of `QUANTITIES`
    trial: np.ndarray | None  # (rows,) as the table says them
    seed: np.ndarray | None
    angle: np.ndarray | None  # (rows,) initial angle that the table says
    count: int  # rows
    own: dict[str, np.ndarray] = field(default_factory=dict)  # (rows,) numbers of draws of one's own that it says

    @property
    def digest(self) -> str:
        """SHA-256 of what it says: two tables that fly the same trials have the same one."""
        digest = hashlib.sha256(str(self.count).encode())
        for name, values in [*sorted(self.given.items()), *self._whose_draws.items()]:
            plain = np.ascontiguousarray(values, dtype=values.dtype.newbyteorder("<"))
            digest.update(name.encode() + plain.tobytes())
        return digest.hexdigest()

    @property
    def _whose_draws(self) -> dict[str, np.ndarray]:
        """The columns that say whose draws and noise a row has, as far as there are such."""
        return {name: values for name, values in ((TRIAL, self.trial), (SEED, self.seed)) if values is not None}

    def rows(self, numbers: np.ndarray, seed: int) -> np.ndarray | Row:
        """These rows, (rows,) numbers from 0 on; trials' numbers where nothing else is said. seed: the campaign's."""
        numbers = np.asarray(numbers, dtype=np.uint32)
        trial = numbers if self.trial is None else self.trial[numbers]
        if not self.given and self.seed is None:
            return trial
        seeds = np.full_like(numbers, seed) if self.seed is None else self.seed[numbers]
        return Row(seeds, trial, {name: values[numbers] for name, values in self.given.items()})

    def row(self, number: int, seed: int) -> int | Row:
        """One row, as `rows` gives many."""
        many = self.rows(np.asarray([number]), seed)
        return jax.tree.map(lambda v: v[0], many) if isinstance(many, Row) else int(many[0])

    def without(self, same: Iterable[str]) -> "Plan":
        """The plan without these quantities, which it gives as they would be drawn anyway."""
        return replace(self, given={name: values for name, values in self.given.items() if name not in same})

    def origin(self, numbers: np.ndarray) -> dict[str, np.ndarray]:
        """Whose draws these rows have, as rows tell it."""
        return {OF_ROWS[name]: values[numbers] for name, values in self._whose_draws.items()}

    def frame(self, parts: Parts) -> pl.DataFrame:
        """The plan as a table, in one form for all that say the same."""
        columns = self._whose_draws
        for name, values in self.given.items():
            columns |= dict(zip(QUANTITIES[name].columns(parts), values.T, strict=True))
        return pl.DataFrame(columns or {TRIAL: np.arange(self.count, dtype=np.uint32)})


def read(path: Path) -> pl.DataFrame:
    """The table of a file, or of the files in a folder that `--dry-run` left; raises RefusedError where it is none."""
    if not path.exists():
        raise RefusedError(f"--plan is {path}, which is not there; allowed is {ALLOWED}")
    files = sorted(path.glob("*.parquet")) if path.is_dir() else [path]
    kinds = {file.suffix.lower() for file in files}
    if not kinds or not (kinds == {".parquet"} or kinds == {".csv"}):
        raise RefusedError(f"--plan is {path}, but must be {ALLOWED}")
    try:
        if kinds == {".csv"}:
            return csv_tables.read(path)
        return pl.concat([pl.read_parquet(file, glob=False) for file in files])
    except (OSError, ValueError, pl.exceptions.PolarsError) as error:
        first_line = (str(error).splitlines() or [type(error).__name__])[0]
        raise RefusedError(f"--plan is {path}, which cannot be read: {first_line}") from None


def checked(
    table: pl.DataFrame, parts: Parts, where: str = "the plan", own: Iterable[str] = (), drawn: Iterable[str] = ()
) -> Plan:
    """The plan that a table says.

    Args:
        table: a row for each trial.
        parts: the nominal ones, that say which quantities there are.
        where: what errors call the plan.
        own: names of metrics of one's own, which may stand beside.
        drawn: names of the numbers that draws of one's own say, see `check_drawn`.

    Raises RefusedError, in one sentence with column and row (counted from 0, as trials are), where a column is not
    known or comes without the others of its vector, a cell is empty or no finite number, or a value is none that can be
    flown.
    """
    if table.height == 0:
        raise RefusedError(f"{where} has no rows, but must have one for each trial")
    if table.height > MOST:
        raise RefusedError(f"{where} has {table.height} rows, but at most {MOST} are allowed")
    columns_of = {name: quantity.columns(parts) for name, quantity in QUANTITIES.items()}
    quantity_of = {column: name for name, columns in columns_of.items() for column in columns}
    whose = [*OF_ROWS, *OF_ROWS.values()]
    for column in table.columns:
        if column not in (*quantity_of, *whose, ANGLE, *RESULTS, *SAMPLES, *own, *drawn):
            close = parsing.nearest(column, (*quantity_of, *OF_ROWS))
            raise RefusedError(f"{where} has the column {column}, with which no trial of this scenario flies; {close}")
    given = {}
    for name in dict.fromkeys(quantity_of[column] for column in table.columns if column in quantity_of):
        absent = [column for column in columns_of[name] if column not in table.columns]
        if absent:
            present = next(column for column in table.columns if quantity_of.get(column) == name)
            raise RefusedError(
                f"{where} has the column {present}, but not {absent[0]}: {_all(columns_of[name])} come together"
            )
        values = np.stack([_numbers(table, column, where) for column in columns_of[name]], axis=1)
        with _refusing(values, columns_of[name], where):
            given[name] = QUANTITIES[name].checked(values)
    for name, values in given.items():
        with _refusing(values, columns_of[name], where):
            QUANTITIES[name].check_with(given, parts)
    whose_draws = {}
    for name, other in OF_ROWS.items():  # of rows that are flown again, `trial` is but their number
        column = other if other in table.columns else name
        whose_draws[name] = _whole_numbers(table, column, where) if column in table.columns else None
    if whose_draws[TRIAL] is not None and np.array_equal(whose_draws[TRIAL], np.arange(table.height)):
        whose_draws[TRIAL] = None  # their own numbers
    angle = _numbers(table, ANGLE, where) if ANGLE in table.columns else None
    said = {name: _cells(table[name]) for name in drawn if name in table.columns}
    return Plan(given, whose_draws[TRIAL], whose_draws[SEED], angle, table.height, said)


def check_angle(said: np.ndarray, flown: np.ndarray, where: str) -> None:
    """Raise RefusedError where the initial angles (rows,) that a plan says are not those that follow from the rest."""
    off = np.abs(flown - said) > 1e-5 * np.maximum(1.0, np.abs(said))
    _refuse_said(off, ANGLE, said, flown, where, "follows from the rest, or no such column")


def check_drawn(said: dict[str, np.ndarray], rows: pl.DataFrame, where: str) -> None:
    """Raise RefusedError where numbers of draws of one's own, (rows,) by name, are not those that are drawn.

    A plan cannot give them: only `Draw.at` knows what follows from them.
    """
    for name, values in said.items():
        flown = _cells(rows[name])
        near = 1e-5 * np.max(np.abs(flown), initial=0.0, where=np.isfinite(flown))
        same = (np.abs(flown - values) <= near) | (np.isnan(flown) & np.isnan(values))
        _refuse_said(~same, name, values, flown, where, "is drawn for its trial and seed, or no such column: what a "
                     "draw of one's own draws, no plan gives")  # fmt: skip


def _refuse_said(off: np.ndarray, column: str, said: np.ndarray, flown: np.ndarray, where: str, why: str) -> None:
    """Raise RefusedError for the first row in which a column says another number than is flown."""
    if off.any():
        k = int(np.argmax(off))
        raise RefusedError(
            f"{where} has {column} {said[k]:g} in row {k}, but must have {flown[k]:.9g} there, which {why}"
        )


def _all(columns: list[str]) -> str:
    return " to ".join((columns[0], columns[-1]))


def _refused(where: str, column: str, row: int, value: object, allowed: str) -> RefusedError:
    shown = "empty" if value is None else value.to_list() if isinstance(value, pl.Series) else value
    return RefusedError(f"{where} has {column} {shown} in row {row}, but must have {allowed}")


def _refuse(bad: np.ndarray, table: pl.DataFrame, column: str, where: str, allowed: str) -> None:
    """Raise RefusedError of the first bad row of a column, if there is one; bad: (rows,) bool."""
    if bad.any():
        row = int(np.argmax(bad))
        raise _refused(where, column, row, table[column][row], allowed)


def _numbers(table: pl.DataFrame, column: str, where: str) -> np.ndarray:
    """A column of finite numbers."""
    numbers = _cells(table[column])
    _refuse(~np.isfinite(numbers), table, column, where, "a finite number")
    return numbers


def _cells(values: pl.Series) -> np.ndarray:
    """The numbers of a column; what is none, or empty, is NaN."""
    if values.dtype.is_numeric() or values.dtype == pl.String:
        return values.cast(pl.Float64, strict=False).to_numpy().astype(float)
    return np.full(values.len(), np.nan)


def _whole_numbers(table: pl.DataFrame, column: str, where: str) -> np.ndarray:
    """A column of whole numbers below 2^32."""
    values = _numbers(table, column, where)
    bad = (values != np.floor(values)) | (values < 0) | (values >= MOST)
    _refuse(bad, table, column, where, f"a whole number from 0 to {MOST - 1}")
    return values.astype(np.uint32)


@contextmanager
def _refusing(values: np.ndarray, columns: list[str], where: str) -> Iterator[None]:
    """Raise RefusedError of the row of a quantity's numbers (rows, n) that a check in here finds unfit."""
    try:
        yield
    except UnfitError as error:
        row = ", ".join(f"{v:.9g}" for v in values[error.row])
        heading = columns[0] if len(columns) == 1 else f"{_all(columns)} ="
        raise _refused(where, heading, error.row, row, str(error)) from None
