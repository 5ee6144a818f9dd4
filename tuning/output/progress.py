"""Progress on the error stream: a bar on a terminal, else a line every ten seconds."""

import contextlib
import math
import sys
import threading
import time
from typing import TYPE_CHECKING, Self

from tuning.output.formats import format_objective, format_ratio

if TYPE_CHECKING:
    from ptsmc_jax.campaigns.campaign import Tally

INTERVAL = 10.0  # time between two printed lines [s]
SHORTEST = 1.0  # shortest time that a rate is measured in [s]


class Bar:
    """A progress bar within `with`. If the error stream is no terminal, it prints lines instead.

    A thread prints the latest step every ten seconds, also during long compilations.

    Args:
        quiet: print nothing.
    """

    left = "left"  # ending of the text about the time left

    def __init__(self, quiet: bool):
        from rich import progress
        from rich.console import Console

        console = Console(stderr=True)
        self._prints_lines = not quiet and not console.is_terminal
        self._start_time, self._ended = time.monotonic(), threading.Event()
        self._step = "compiling"  # the step in words
        self._heading = ""  # what the step belongs to, such as the law in a comparison, see `headed`
        self._total, self._done = 0, 0  # work in all, and work done
        self._first_time, self._first_done = self._start_time, 0  # of the report that the rate is measured from
        self._end_time = -math.inf  # estimated time of the monotonic clock at the end of the work
        self._bar = progress.Progress(
            progress.RenderableColumn(self),
            progress.BarColumn(20),
            progress.TimeElapsedColumn(),
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
        """Return the current step with the time left, or the program that it waits for, for a column of `rich`."""
        seconds = self._end_time - time.monotonic()
        left = f", about {f'{seconds:.0f} s' if seconds < 120.0 else f'{seconds / 60.0:.0f} min'} {self.left}"
        if compilation := _compilation_progress():
            return self._heading + compilation
        return self._step + (left if seconds >= 1.0 else "")

    def _measure_rate(self, done: int, total: int, *, again: bool = False) -> float:
        """Return how much work is done per second, 0 before it is known, and store when the work will probably end.

        Args:
            done: work done so far. The measurement begins again if it decreases, in a new step.
            total: work in all. The measurement begins again if it changes.
            again: begin the measurement again.
        """
        now = time.monotonic()
        if again or total != self._total or done < self._done:
            self._first_time, self._first_done = now, done
        self._total, self._done = total, done
        seconds, measured = now - self._first_time, done - self._first_done
        rate = measured / seconds if seconds >= SHORTEST and measured > 1 else 0.0
        self._end_time = now + (total - done) / rate if rate else -math.inf
        return rate

    def _print_periodically(self) -> None:
        """Print the progress to stderr every `INTERVAL` seconds until the command ends."""
        while not self._ended.wait(INTERVAL):
            text = self.__rich__()
            with contextlib.suppress(OSError):  # a closed pipe or a full disk is no reason to stop
                print(f"ptsmc: {text}, {time.monotonic() - self._start_time:.0f} s so far", file=sys.stderr, flush=True)


def _compilation_progress() -> str:
    """Return which program is being compiled, see `programs.compiling`, without importing JAX."""
    programs = sys.modules.get("ptsmc_jax.programs")
    return "" if programs is None else programs.compiling()


class Progress(Bar):
    """The progress of a search or a study with the best objective so far."""

    left = "left in this step"

    def __init__(self, quiet: bool, objective: str = "", plant: str = "spacecraft"):
        """Begin before the first step.

        Args:
            quiet: print nothing.
            objective: name of the objective.
            plant: kind of the plant, which decides the unit of a window error.
        """
        super().__init__(quiet)
        self._objective, self._plant = objective, plant

    def __call__(self, step: str, done: int, total: int, value: float = float("nan"), violation: float = 0.0) -> None:
        """Show the current step, its progress, and the best objective so far.

        Args:
            step: current step in words.
            done: number of steps done.
            total: number of steps in all; 0: unknown.
            value: best objective so far; NaN: there is none.
            violation: how far the best gains exceed a limit in training, relative to the limit [-].
        """
        if (total or None) != self._bar.tasks[0].total:
            self._bar.reset(self._task, total=total or None)
        limits = "limits met in training" if violation == 0.0 else f"{format_ratio(100.0 * violation)} % beyond a limit"
        best = f": {format_objective(self._objective, value, self._plant)}, {limits}" if value == value else ""
        self._bar.update(self._task, completed=done)
        self._measure_rate(done, total)
        heading, colon, _ = step.rpartition(": ")
        self._heading = heading + colon
        self._step = f"{step}{f', {done} of {total}' if total else ''}{best}"


class CampaignProgress(Bar):
    """The progress of a campaign: trials, trials a second, and failures so far."""

    def __init__(self, quiet: bool):
        super().__init__(quiet)
        self._reports = 0

    def __call__(self, tally: "Tally") -> None:
        """Report the numbers of simulated and of failed trials so far."""
        self._reports += 1
        # the first part took longer, because its program was compiled
        rate = self._measure_rate(tally.done, tally.total, again=self._reports == 2)
        text = f"{tally.done} of {tally.total} trials"
        if rate:
            text += f", {rate:,.0f} a second" if rate >= 1.0 else f", {rate:.1g} a second"
        text += f", {tally.failed} failed or not converged" if tally.failed else ""
        self._bar.update(self._task, completed=tally.done, total=tally.total)
        self._step = text
