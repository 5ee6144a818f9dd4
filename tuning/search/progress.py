"""Progress reports of a search."""

from collections.abc import Callable

# arguments: current step, work done and total work of the step, best objective, and relative violation
Report = Callable[[str, int, int, float, float], None]


def headed(report: Report, heading: str) -> Report:
    """Return a report that puts a heading before the current step, for one of several searches."""
    return lambda what, *numbers: report(f"{heading}: {what}", *numbers)
