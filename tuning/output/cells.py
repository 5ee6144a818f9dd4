"""What is said of a result: its summary as it is read, and tables of text."""

from dataclasses import dataclass
from typing import Any

Summary = dict[str, Any]


@dataclass(frozen=True)
class Table:
    """Cells as text; the first column names the row."""

    head: tuple[str, ...]
    rows: list[tuple[str, ...]]
