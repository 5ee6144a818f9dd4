"""What the commands print: progress while they work, results when they are done."""

import contextlib
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tuning.output import front_sentences, margin_sentences, search_sentences, sentences
from tuning.output.progress_lines import Bar

if TYPE_CHECKING:
    from tuning.output.cells import Table as Content
    from tuning.studies.mapping import Cell

WIDE = 1000  # columns of what is no terminal
UNBROKEN = 24  # columns that a cell may have and stay in one piece


class Progress(Bar):
    """A progress bar with the best so far."""

    def __init__(self, quiet: bool, goal: str = ""):
        super().__init__(quiet, counted=True)
        self._goal, self._total = goal, 0

    def __call__(self, what: str, done: int, total: int, value: float = float("nan"), over: float = 0.0) -> None:
        """What is being done, steps done and in all; the best goal so far, how far it is beyond a limit."""
        if total != self._total:
            self._total = total
            self._bar.reset(self._task, total=total or None)
        limits = "limits met" if over == 0.0 else f"{sentences.ratio(100.0 * over)} % beyond a limit"
        best = f": {self._goal} {value:.4g}, {limits}" if value == value else ""
        self._bar.update(self._task, completed=done, total=total or None, description=what + best)
        self._lines(what + best, done, total)


def reproduction(summary: dict[str, Any], folder: Path) -> None:
    """Claims and slips of the paper."""
    from rich.box import SIMPLE

    box: Any = {"box": SIMPLE, "title_justify": "left"}
    table(sentences.claims(summary), title="Claims", **box)
    table(sentences.slips(summary), title="Slips", **box)
    say("claims.md says why, and gives the slips as printed", f"results in {folder}")


def grid(cells: "list[Cell]", keys: tuple[str, str], kind: str, folder: Path) -> None:
    """What was flown over two keys, across and up; kind: of the plant."""
    say(*sentences.grid([asdict(cell) for cell in cells], keys, kind), f"results in {folder}")


def margins(summary: dict[str, Any], folder: Path) -> None:
    """Margins of a loop, as their `summary.json` says."""
    table(margin_sentences.table(summary))
    say(*margin_sentences.lines(summary), f"results in {folder}")


def run(summary: dict[str, Any], kind: str, folder: Path) -> None:
    """Metrics and verdicts of one run, as its `summary.json` says; kind: of its plant."""
    say(*sentences.run_lines(summary))
    table(sentences.run(summary, kind))
    say(
        *map(sentences.verdict, sentences.run_verdicts(summary, kind)),
        *sentences.cautions(summary),
        f"results in {folder}",
    )


def tuning(summary: dict[str, Any], folder: Path, how: str) -> None:
    """What a tuning run found, as its `summary.json` says."""
    say(f"tuning {how}; {sentences.tuning_heading(summary)}:")
    table(sentences.tuning(summary))
    say(*sentences.accuracy(summary), *search_sentences.search(summary), *search_sentences.trust(summary))
    say(
        *map(sentences.verdict, summary["verdicts"]),
        *search_sentences.advice(summary),
        *search_sentences.shortest(summary),
    )
    if summary["status"] == "interrupted":
        say("interrupted: these are the best gains so far; the same command goes on from here")
    say(*sentences.cautions(summary), f"results in {folder}")


def comparison(summary: dict[str, Any], folder: Path, how: str) -> None:
    """Laws side by side, as `summary.json` says."""
    from tuning.output import law_sentences, sentences

    say(f"comparison {how}: {law_sentences.alike(summary)}")
    for answer in law_sentences.answers(summary):
        table(answer.table, title=answer.title, title_justify="left")
    say(law_sentences.winner(summary), *law_sentences.lines(summary))
    say(*sentences.cautions(summary), f"results in {folder}")


def front(summary: dict[str, Any], folder: Path, how: str) -> None:
    """Print a Pareto front from its `summary.json`."""
    from tuning.studies.front import read

    found = read(summary)
    say(f"front {how}: {front_sentences.heading(found)}", *front_sentences.answers(found))
    table(front_sentences.results(found))
    table(front_sentences.gains(found))
    say(*front_sentences.remarks(found))
    say(*sentences.cautions(summary), f"results in {folder}")


def say(*lines: str) -> None:
    """Print lines that the terminal breaks, not we."""
    for line in lines:
        _print(line, soft_wrap=True, markup=False)


def _narrowest(cell: str) -> int:
    """Into how many columns a cell fits: a number, a name or a unit is in one piece, a sentence breaks at its words."""
    return len(cell) if len(cell) <= UNBROKEN else max(map(len, cell.split()))


def table(content: "Content", **style: Any) -> None:
    """Print a table; style: of rich's `Table`."""
    from rich.console import Console
    from rich.markup import escape
    from rich.measure import Measurement
    from rich.table import Table
    from rich.text import Text

    printed = Table(pad_edge=False, **{"box": None, **style})
    for k, name in enumerate(content.head):
        printed.add_column(escape(name), min_width=max((_narrowest(row[k]) for row in content.rows), default=1))
    for row in content.rows:
        printed.add_row(*map(Text, row))
    # a file or a pipe has no width; numbers that do not fit into a terminal's would be cut, so it breaks the lines
    width, here = WIDE, Console()
    if here.is_terminal:
        wide = Console(width=WIDE)
        width = max(here.width, Measurement.get(wide, wide.options, printed).minimum)
    _print(printed, width, crop=False)


def _print(content: Any, width: int | None = None, **how: Any) -> None:
    """Print for who reads; where they have read enough, as `head` has, what a command returns is told all the same."""
    from rich.console import Console

    with contextlib.suppress(SystemExit):  # rich's way of ending then; from there on it prints into nothing
        Console(highlight=False, width=width).print(content, **how)
