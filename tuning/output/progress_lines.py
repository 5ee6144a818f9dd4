"""Progress where nobody looks at a terminal: a line every ten seconds, on the error stream."""

import sys
import threading
import time
from collections.abc import Callable

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
            share = f", {done} of {total}" if total else ""
            print(f"ptsmc: {what}{share}, {now - self._begun:.0f} s", file=sys.stderr, flush=True)
