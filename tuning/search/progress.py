"""How a search says where it stands, to whoever shows it."""

from collections.abc import Callable

# what is being done, steps done, in all, best goal, how far beyond a limit
Report = Callable[[str, int, int, float, float], None]


def headed(report: Report, heading: str) -> Report:
    """A report of one of several searches, what is being done headed by which one it is."""
    return lambda what, *numbers: report(f"{heading}: {what}", *numbers)
