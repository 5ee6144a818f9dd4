"""Prints reports, tables and lines on the terminal."""

import contextlib
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tuning.output.report import Report, Table

if TYPE_CHECKING:
    from ptsmc_jax.scenario.tables import Scenario

WIDE = 1000  # assumed number of columns of a file or a pipe
UNBROKEN_WIDTH = 24  # largest number of columns of a cell that is never broken


def print_result(command: str, summary: Mapping[str, object], plant: str, folder: Path) -> None:
    """Print the report of a result without its charts and pictures.

    Args:
        command: name of the command.
        summary: the content of `summary.json`.
        plant: kind of the plant.
        folder: folder of the result.
    """
    from tuning.output import reports

    print_report(reports.build(command, summary, plant), folder)


def print_report(report: Report, folder: Path, *, earlier: bool = False) -> None:
    """Print a report without its charts and pictures.

    Args:
        report: the report.
        folder: folder of the result.
        earlier: whether an earlier run wrote the result.
    """
    print_lines(report.headline, *report.lines)
    for title, content in report.printed():
        if title:
            print_lines("", title)
        if isinstance(content, Table):
            print_table(content)
        else:
            print_lines(*content)
    print_lines("", f"results in {folder}" + (" (from an earlier run)" if earlier else ""))


def print_gains_hint(scenario: "Scenario") -> None:
    """Print that a scenario has default gains, and how to find better gains. Print nothing if it states its gains."""
    from ptsmc_jax.scenario import mission

    gains = mission.describe_default_gains(scenario)
    if gains is not None:
        print_lines(f"{gains}; ptsmc tune searches for better gains")


def print_lines(*lines: str) -> None:
    """Print lines; the terminal breaks them."""
    for line in lines:
        _print(line, soft_wrap=True, markup=False)


def print_table(content: Table) -> None:
    """Print a table."""
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table as RichTable
    from rich.text import Text as RichText

    rich_table = RichTable(pad_edge=False, box=None)
    widths = [
        max(1, *map(len, name.split()), *(_smallest_width(row[k]) for row in content.rows))
        for k, name in enumerate(content.head)
    ]
    for name, width in zip(content.head, widths, strict=True):
        rich_table.add_column(escape(name), min_width=width)
    for row in content.rows:
        rich_table.add_row(*map(RichText, row))
    console = Console()
    # A file or a pipe has no width. A terminal that is too narrow for the numbers wraps the lines itself.
    width = max(console.width, sum(widths) + 2 * len(widths)) if console.is_terminal else WIDE
    _print(rich_table, width, crop=False)


def _smallest_width(cell: str) -> int:
    """Return the smallest width of a cell. Sentences may be broken between words; numbers, names and units may not."""
    return len(cell) if len(cell) <= UNBROKEN_WIDTH else max(map(len, cell.split()))


def _print(content: object, width: int | None = None, **options: Any) -> None:
    """Print; a reader that closes the pipe, such as `head`, changes neither the work nor the exit status."""
    from rich.console import Console

    with contextlib.suppress(SystemExit):  # raised by rich for a closed pipe; it prints into nothing afterwards
        Console(highlight=False, emoji=False, width=width).print(content, **options)
