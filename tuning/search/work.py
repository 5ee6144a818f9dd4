"""Progress of a search in percent, from the planned and simulated rollouts, and the time of each step."""

import time
from collections.abc import Mapping

from tuning.search.evaluate import Evaluator
from tuning.search.progress import Report

PERCENT = 100  # progress is reported in percent
SLOPED = 5.0  # duration of a rollout with gradients relative to a rollout without (benchmarks/gradients.py)
ROUND = "harder trials"  # first words of the name of a further round


class Work:
    """A `Report` that converts the rollouts of a search to percent of all work, and forwards them to another report.

    A step that ends early counts as done. A further round is planned when it begins.
    """

    def __init__(self, report: Report, evaluate: Evaluator, planned: Mapping[str, float], again: Mapping[str, float]):
        """Begin to measure the time.

        Args:
            report: receives the progress in percent.
            evaluate: counts the rollouts.
            planned: largest number of rollouts of each step, by its name and in order. A rollout with gradients counts
                as `SLOPED` rollouts.
            again: the same for a further round.
        """
        self._report, self._evaluate, self._again = report, evaluate, list(again.items())
        self._left, self._what, self._base, self._since = list(planned.items()), "", 0.0, time.monotonic()
        self.seconds = dict[str, float]()  # duration of each step [s]

    def __call__(self, what: str, done: int, total: int, value: float, over: float) -> None:
        """Report the progress in percent.

        Args:
            what: name of the current step.
            done: not used.
            total: not used.
            value: best objective so far.
            over: relative violation of the best point.
        """
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
        else:  # compilation takes minutes if the problem has margins
            self._report("compiling", 0, 0, value, over)

    def _turn(self, name: str) -> None:
        """Remove the steps before this one from the remaining work."""
        self._left = list(self._again) if name == ROUND else self._left
        names = [known for known, _ in self._left]
        self._left = self._left[names.index(name) :] if name in names else self._left
