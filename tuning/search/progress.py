"""How a search says where it stands, to whoever shows it."""

from collections.abc import Callable

# what is being done, steps done, in all, best goal, how far beyond a limit
Report = Callable[[str, int, int, float, float], None]
