"""Read Parquet files, and CSV tables that spreadsheets, pandas or R have written. Start with `read_table`."""

import codecs
import csv
import io
import re
from collections.abc import Sequence
from pathlib import Path

import polars as pl

SEPARATORS = ",;\t"
STATED_SEPARATOR = re.compile(r'"?sep=([,;|\t])"?\n?')  # first line, for Excel
UNNAMED = re.compile(r"(Unnamed: \d+)?")  # pandas names such a column when it reads it
NUMBER = re.compile(r"[-+]?[\d.,]+([eE][-+]?\d+)?")
WITH_COMMA = re.compile(r"[-+]?\d*,\d+([eE][-+]?\d+)?")
WITH_POINT = re.compile(WITH_COMMA.pattern.replace(",", r"\."))


def read_table(path: Path) -> pl.DataFrame:
    """Return the columns of a CSV or Parquet file; raise ValueError with one line of text if it is not readable."""
    try:
        return read(path) if path.suffix.lower() == ".csv" else pl.read_parquet(path, glob=False)
    except (OSError, ValueError, pl.exceptions.PolarsError) as error:
        raise ValueError((str(error).splitlines() or [type(error).__name__])[0]) from None


def read(path: Path) -> pl.DataFrame:
    """Return the columns of a CSV file as text, with null for an empty cell.

    Raises:
        OSError: The file cannot be opened.
        ValueError: The table is damaged or ambiguous. The text names the cause.
    """
    lines = list(io.StringIO(_decode_text(path.read_bytes()), newline=None))
    try:
        names, rows = _split_cells(lines)
    except csv.Error as error:
        raise ValueError(f"it is not valid CSV, {error}") from None
    columns = [list(column) for column in zip(*rows, strict=True)] or [[] for _ in names]
    kept_columns = [
        (name, column) for name, column in zip(names, columns, strict=True) if not _is_index_column(name, column)
    ]
    repeated = next(
        (name for k, (name, _) in enumerate(kept_columns) if name in [other for other, _ in kept_columns[:k]]), None
    )
    if repeated is not None:
        raise ValueError(f"it has two columns with the name {repeated}")
    table = {name: [cell or None for cell in column] for name, column in kept_columns}
    return pl.DataFrame(table, dict.fromkeys(table, pl.String))


def _decode_text(raw: bytes) -> str:
    """Return the text of a file in UTF-8, or in UTF-16 with a byte order mark."""
    is_utf16 = raw.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    try:
        text = raw.decode("utf-16" if is_utf16 else "utf-8-sig")
    except UnicodeDecodeError:
        raise ValueError("it is not text in UTF-8, or in UTF-16 with a byte order mark") from None
    if "\0" in text:
        raise ValueError("it contains null characters, like UTF-16 text without a byte order mark")
    return text


def _split_cells(lines: Sequence[str]) -> tuple[list[str], list[list[str]]]:
    """Return the column names and the cells of each row, with decimal points."""
    separator_line = STATED_SEPARATOR.fullmatch(lines[0]) if lines else None
    header_line = 0 if separator_line is None else 1
    while header_line < len(lines) and (not lines[header_line].strip() or lines[header_line].lstrip().startswith("#")):
        header_line += 1
    if header_line == len(lines):
        raise ValueError("it has no line with column names")
    separator = _find_separator(lines[header_line]) if separator_line is None else separator_line[1]
    reader = csv.reader(lines[header_line:], delimiter=separator, skipinitialspace=True, strict=True)
    names = [name.strip() for name in next(reader)]
    if all(map(NUMBER.fullmatch, names)):
        raise ValueError("its first line has numbers, but must have the column names, without a # before them")
    rows = []
    for row in reader:
        cells = [cell.strip() for cell in row]
        if len(cells) < 2 and not any(cells):
            continue
        if len(cells) != len(names):
            raise ValueError(
                f"line {header_line + reader.line_num} must have {len(names)} cells, one for each column name"
            )
        rows.append(cells)
    return names, _replace_decimal_commas(rows) if separator == ";" else rows


def _find_separator(header: str) -> str:
    """Return the character that separates the column names; a comma if there is one column."""
    candidates = [character for character in SEPARATORS if len(next(csv.reader([header], delimiter=character))) > 1]
    if len(candidates) > 1:
        raise ValueError(f"its column names are separated by {' and '.join(map(repr, candidates))}, but must be by one")
    return candidates[0] if candidates else ","


def _replace_decimal_commas(rows: list[list[str]]) -> list[list[str]]:
    """Return the cells with decimal points; raise ValueError if some numbers have decimal commas and some points."""
    numbers = [cell for row in rows for cell in row if WITH_COMMA.fullmatch(cell)]
    if not numbers:
        return rows
    point = next((cell for row in rows for cell in row if WITH_POINT.fullmatch(cell)), None)
    if point is not None:
        raise ValueError(f"it has both decimal commas and decimal points, {numbers[0]} and {point}")
    return [[cell.replace(",", ".") if WITH_COMMA.fullmatch(cell) else cell for cell in row] for row in rows]


def _is_index_column(name: str, column: Sequence[str]) -> bool:
    """Return whether a column has no name and is empty or counts the rows; raise ValueError for other cells."""
    if not UNNAMED.fullmatch(name):
        return False
    counts = [[str(first + k) for k in range(len(column))] for first in (0, 1)]
    if any(column) and list(column) not in counts:
        raise ValueError(
            'a column without a name does not count the rows: name it "trial" if it has trial numbers, or remove it'
        )
    return True
