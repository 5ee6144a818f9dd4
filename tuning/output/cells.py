"""What is said of a result: its summary as it is read, and tables of text."""

from dataclasses import dataclass
from typing import Any

Summary = dict[str, Any]


@dataclass(frozen=True)
class Table:
    """Cells as text; the first column names the row."""

    head: tuple[str, ...]
    rows: list[tuple[str, ...]]


def number(cell: str) -> Any:
    """The number of a cell of a CSV file, NaN of an empty one; its text where it is none."""
    try:
        return float(cell or "nan")
    except ValueError:
        return cell


def short(cell: str) -> str:
    """A cell of a CSV file, its number in four digits."""
    value = number(cell)
    return cell if isinstance(value, str) or not cell else f"{value:.4g}"
