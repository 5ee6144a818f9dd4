"""Progress on the error stream: a bar on a terminal, else a line every ten seconds."""

import contextlib
import sys
import threading
import time
from typing import TYPE_CHECKING, Self

from tuning.output.formats import format_objective, format_ratio

if TYPE_CHECKING:
    from ptsmc_jax.campaigns.campaign import Tally

INTERVAL = 10.0  # time between two printed lines [s]


def format_progress(step: str, done: int, total: int, seconds: float) -> str:
    """Return a line of progress. A total of 0 means that the number of steps is unknown.

    >>> format_progress("searching", 1, 7, 10.4), format_progress("compiling", 0, 0, 10.2)
    ('ptsmc: searching, 1 of 7, 10 s', 'ptsmc: compiling, 10 s')
    """
    fraction = "" if not total else f", {done} of {total}"
    return f"ptsmc: {step}{fraction}, {seconds:.0f} s"


class ProgressLines:
    """Prints the latest progress every ten seconds within `with`, also during long compilations.

    Args:
        silent: print nothing.
    """

    def __init__(self, *, silent: bool):
        self._silent, self._start_time = silent, time.monotonic()
        self._step, self._ended = ("compiling", 0, 0), threading.Event()

    def __enter__(self) -> Self:
        if not self._silent:
            threading.Thread(target=self._print_periodically, daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()

    def __call__(self, step: str, done: int, total: int) -> None:
        """Report the current step, and the number of steps done and in all."""
        self._step = (step, done, total)

    def __rich__(self) -> str:
        """Return the current step, or the program that it waits for, for a column of `rich`."""
        return _compilation_progress() or self._step[0]

    def _print_periodically(self) -> None:
        while not self._ended.wait(INTERVAL):
            compiling, seconds = _compilation_progress(), time.monotonic() - self._start_time
            text = format_progress(compiling, 0, 0, seconds) if compiling else format_progress(*self._step, seconds)
            with contextlib.suppress(OSError):  # a closed pipe or a full disk is no reason to stop
                print(text, file=sys.stderr, flush=True)


def _compilation_progress() -> str:
    """Return which program is being compiled, see `programs.compiling`, without importing JAX."""
    programs = sys.modules.get("ptsmc_jax.programs")
    return "" if programs is None else programs.compiling()


class Bar:
    """A progress bar with the time left, within `with`; `ProgressLines` if the error stream is no terminal.

    Args:
        quiet: print nothing.
        counted: show the numbers of steps too.
    """

    def __init__(self, quiet: bool, *, counted: bool = False):
        from rich import progress
        from rich.console import Console

        console = Console(stderr=True)
        self._lines = ProgressLines(silent=quiet or console.is_terminal)
        self._bar = progress.Progress(
            progress.RenderableColumn(self._lines),
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


class Progress(Bar):
    """The progress of a search or a study with the best objective so far."""

    def __init__(self, quiet: bool, objective: str = "", plant: str = "spacecraft"):
        """Begin before the first step.

        Args:
            quiet: print nothing.
            objective: name of the objective.
            plant: kind of the plant, which decides the unit of a window error.
        """
        super().__init__(quiet, counted=True)
        self._objective, self._plant, self._total = objective, plant, 0

    def __call__(self, step: str, done: int, total: int, value: float = float("nan"), violation: float = 0.0) -> None:
        """Report the current step, the number of steps done and in all, the best objective, and its violation."""
        if total != self._total:
            self._total = total
            self._bar.reset(self._task, total=total or None)
        limits = "limits met" if violation == 0.0 else f"{format_ratio(100.0 * violation)} % beyond a limit"
        best = f": {format_objective(self._objective, value, self._plant)}, {limits}" if value == value else ""
        self._bar.update(self._task, completed=done, total=total or None)
        self._lines(step + best, done, total)


class CampaignProgress(Bar):
    """The progress of a campaign: trials, trials a second, and failures so far."""

    def __init__(self, quiet: bool):
        super().__init__(quiet)
        self._started: tuple[float, int] | None = None

    def __call__(self, tally: "Tally") -> None:
        """Report the numbers of simulated and of failed trials so far."""
        now = time.monotonic()
        if self._started is None:
            self._started = now, tally.done
        start, done_at_start = self._started
        rate = (tally.done - done_at_start) / (now - start) if tally.done > done_at_start else 0.0
        text = f"{tally.done} of {tally.total} trials"
        if rate:
            text += f", {rate:,.0f} a second" if rate >= 1.0 else f", {rate:.1g} a second"
        elif tally.done < tally.total:
            text += ", compiling"
        text += f", {tally.failed} failed or not converged" if tally.failed else ""
        self._bar.update(self._task, completed=tally.done, total=tally.total)
        self._lines(text, 0, 0)
