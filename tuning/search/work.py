"""How far a search is: all of its steps on one scale, by the rollouts that are left, and where the time went."""

import time
from collections.abc import Mapping

from tuning.search.evaluate import Evaluator
from tuning.search.progress import Report

PERCENT = 100  # progress is reported in percent
SLOPED = 5.0  # what a rollout with slopes takes beside one without (benchmarks/gradients.py)
ROUND = "harder trials"  # how the name of a further round begins


class Work:
    """A `Report` that tells another one the share of all the work that is done.

    planned: what each step of the search flies at most, by its name, in order, in rollouts, one with slopes as
    `SLOPED`; again: the same of a further round, which is planned when it begins. A step that ends early is done.
    """

    def __init__(self, report: Report, evaluate: Evaluator, planned: Mapping[str, float], again: Mapping[str, float]):
        self._report, self._evaluate, self._again = report, evaluate, list(again.items())
        self._left, self._what, self._base, self._since = list(planned.items()), "", 0.0, time.monotonic()
        self.seconds = dict[str, float]()  # that each step took

    def __call__(self, what: str, done: int, total: int, value: float, over: float) -> None:
        """What is being done, steps done and in all; the best goal so far, how far it is beyond a limit."""
        del done, total
        flown, now = self._evaluate.rollouts + SLOPED * self._evaluate.gradients, time.monotonic()
        if self._what:
            self.seconds[self._what] = self.seconds.get(self._what, 0.0) + now - self._since
        if what != self._what:
            self._turn(what.partition(",")[0])
            self._what, self._base = what, flown
        self._since = now
        left = sum(cost for _, cost in self._left)
        if self._left and self._left[0][0] == what.partition(",")[0]:
            left -= min(self._left[0][1], flown - self._base)
        if flown:
            self._report(what, round(PERCENT * flown / (flown + left)), PERCENT, value, over)
        else:  # which takes minutes where margins with slopes are among it
            self._report("compiling", 0, 0, value, over)

    def _turn(self, name: str) -> None:
        """What is left from this step on."""
        self._left = list(self._again) if name == ROUND else self._left
        names = [known for known, _ in self._left]
        self._left = self._left[names.index(name) :] if name in names else self._left
