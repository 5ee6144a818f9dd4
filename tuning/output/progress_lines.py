"""Progress on the error stream: a bar where that is a terminal, else a line every ten seconds."""

import contextlib
import sys
import threading
import time
from typing import Self

EVERY = 10.0  # seconds


def line(what: str, done: int, total: int, seconds: float) -> str:
    """Return a line of progress. A total of 100 is a percentage; 0: unknown.

    >>> line("searching", 7, 100, 99.0), line("compiling", 0, 0, 10.2)
    ('ptsmc: searching, 7 %, 99 s', 'ptsmc: compiling, 10 s')
    """
    fraction = "" if not total else f", {done} %" if total == 100 else f", {done} of {total}"
    return f"ptsmc: {what}{fraction}, {seconds:.0f} s"


class Lines:
    """Prints the latest progress every ten seconds within `with`, also during long compilations.

    Args:
        silent: print nothing.
    """

    def __init__(self, *, silent: bool):
        self._silent, self._begun = silent, time.monotonic()
        self._doing, self._ended = ("compiling", 0, 0), threading.Event()

    def __enter__(self) -> "Lines":
        if not self._silent:
            threading.Thread(target=self._watch, daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()

    def __call__(self, what: str, done: int, total: int) -> None:
        """Report the current step, and the number of steps done and in all."""
        self._doing = (what, done, total)

    def _watch(self) -> None:
        while not self._ended.wait(EVERY):
            with contextlib.suppress(OSError):  # a closed pipe or a full disk is no reason to stop
                print(line(*self._doing, time.monotonic() - self._begun), file=sys.stderr, flush=True)


class Bar:
    """A progress bar with the time left, within `with`; `Lines` where nobody looks at a terminal; silent if told to be.

    counted: with how many are done of all.
    """

    def __init__(self, quiet: bool, *, counted: bool = False):
        from rich import progress
        from rich.console import Console

        console = Console(stderr=True)
        self._lines = Lines(silent=quiet or console.is_terminal)
        self._bar = progress.Progress(
            progress.TextColumn("{task.description}"),
            progress.BarColumn(20),
            *([progress.MofNCompleteColumn()] if counted else []),
            progress.TimeElapsedColumn(),
            progress.TextColumn("left"),
            progress.TimeRemainingColumn(),
            console=console,
            disable=quiet or not console.is_terminal,
        )
        self._task = self._bar.add_task("compiling", total=None)

    def __enter__(self) -> Self:
        self._lines.__enter__()
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()
        self._lines.__exit__()
