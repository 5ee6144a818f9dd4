"""Progress where nobody looks at a terminal: a line every ten seconds, on the error stream."""

import sys
import time
from collections.abc import Callable

EVERY = 10.0  # seconds


class Lines:
    """Prints what is being done, at most every ten seconds; nothing where it is silent: quiet, or with a bar."""

    def __init__(self, *, silent: bool, clock: Callable[[], float] = time.monotonic):
        self._silent, self._clock = silent, clock
        self._begun = self._last = clock()

    def __call__(self, what: str, done: int, total: int) -> None:
        """What is being done, so many of all."""
        now = self._clock()
        if self._silent or now - self._last < EVERY:
            return
        self._last = now
        share = f", {done} of {total}" if total else ""
        print(f"ptsmc: {what}{share}, {now - self._begun:.0f} s", file=sys.stderr, flush=True)
