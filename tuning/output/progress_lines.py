"""Progress on the error stream: a bar where that is a terminal, else a line every ten seconds."""

import contextlib
import sys
import threading
import time
from collections.abc import Callable
from typing import Self

EVERY = 10.0  # seconds


class Lines:
    """Prints what is being done every ten seconds, within `with` also while nothing new is said, as in compiling.

    Nothing where it is silent: quiet, or with a bar.
    """

    def __init__(self, *, silent: bool, clock: Callable[[], float] = time.monotonic):
        self._silent, self._clock = silent, clock
        self._begun = self._last = clock()
        self._doing = ("compiling", 0, 0)
        self._lock, self._ended = threading.Lock(), threading.Event()

    def __enter__(self) -> "Lines":
        if not self._silent:
            threading.Thread(target=self._watch, daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()

    def __call__(self, what: str, done: int, total: int) -> None:
        """What is being done, so many of all."""
        self._doing = (what, done, total)
        self._print_if_due()

    def _watch(self) -> None:
        while not self._ended.wait(EVERY / 20.0):
            self._print_if_due()

    def _print_if_due(self) -> None:
        with self._lock:
            now = self._clock()
            if self._silent or now - self._last < EVERY:
                return
            self._last = now
            what, done, total = self._doing
            # so many of a hundred are a percentage, as searches report
            share = "" if not total else f", {done} %" if total == 100 else f", {done} of {total}"
            with contextlib.suppress(OSError):  # nobody reads them any more, or a disk is full: no reason to stop
                print(f"ptsmc: {what}{share}, {now - self._begun:.0f} s", file=sys.stderr, flush=True)


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
