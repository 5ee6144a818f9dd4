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


class Bar:
    """A progress bar with the time left within `with`. If the error stream is no terminal, it prints lines instead.

    A thread prints the latest step every ten seconds, also during long compilations.

    Args:
        quiet: print nothing.
        counted: show the numbers of steps too.
    """

    def __init__(self, quiet: bool, *, counted: bool = False):
        from rich import progress
        from rich.console import Console

        console = Console(stderr=True)
        self._prints_lines = not quiet and not console.is_terminal
        self._start_time, self._ended = time.monotonic(), threading.Event()
        self._step, self._count = "compiling", ""  # the step in words; numbers of steps, only for lines
        self._bar = progress.Progress(
            progress.RenderableColumn(self),
            progress.BarColumn(20),
            *([progress.MofNCompleteColumn()] if counted else []),
            progress.TimeElapsedColumn(),
            progress.TextColumn("left"),
            progress.TimeRemainingColumn(),
            console=console,
            disable=quiet or not console.is_terminal,
        )
        self._task = self._bar.add_task("", total=None)

    def __enter__(self) -> Self:
        if self._prints_lines:
            threading.Thread(target=self._print_periodically, daemon=True).start()
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()
        self._ended.set()

    def __rich__(self) -> str:
        """Return the current step, or the program that it waits for, for a column of `rich`."""
        return _compilation_progress() or self._step

    def _print_periodically(self) -> None:
        while not self._ended.wait(INTERVAL):
            text = _compilation_progress() or f"{self._step}{self._count}"
            with contextlib.suppress(OSError):  # a closed pipe or a full disk is no reason to stop
                print(f"ptsmc: {text}, {time.monotonic() - self._start_time:.0f} s", file=sys.stderr, flush=True)


def _compilation_progress() -> str:
    """Return which program is being compiled, see `programs.compiling`, without importing JAX."""
    programs = sys.modules.get("ptsmc_jax.programs")
    return "" if programs is None else programs.compiling()


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
        self._objective, self._plant = objective, plant

    def __call__(self, step: str, done: int, total: int, value: float = float("nan"), violation: float = 0.0) -> None:
        """Report the current step, the number of steps done and in all, the best objective, and its violation."""
        if (total or None) != self._bar.tasks[0].total:
            self._bar.reset(self._task, total=total or None)
        limits = "limits met in training" if violation == 0.0 else f"{format_ratio(100.0 * violation)} % beyond a limit"
        best = f": {format_objective(self._objective, value, self._plant)}, {limits}" if value == value else ""
        self._bar.update(self._task, completed=done)
        self._step, self._count = step + best, f", {done} of {total}" if total else ""


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
        self._step = text
