"""Progress reports of a search, and the time of each step."""

import time
from collections.abc import Callable

# arguments: current step, work done and total work of the step, best objective, and relative violation
Report = Callable[[str, int, int, float, float], None]


def headed(report: Report, heading: str) -> Report:
    """Return a report that puts a heading before the current step, for one of several searches."""
    return lambda what, *numbers: report(f"{heading}: {what}", *numbers)


def timed(report: Report, seconds: dict[str, float]) -> Report:
    """Return a report that also adds the duration of each step [s] to `seconds`."""
    step, since = "", 0.0

    def measured(what: str, done: int, total: int, value: float, over: float) -> None:
        nonlocal step, since
        now = time.monotonic()
        if step:
            seconds[step] = seconds.get(step, 0.0) + now - since
        step, since = what, now
        report(what, done, total, value, over)

    return measured
