"""A gain that tuning may move: its usual bounds, how far they may be set, and what lies beyond them, in words."""

import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

Interval = tuple[float, float]


def wide(low: Any, high: Any) -> Any:
    """Whether an interval, or each of many, is searched on a log scale: above zero, its ends more than tenfold apart.

    >>> wide(0.1, 2.0), wide(0.5, 2.0), wide(-1.0, 2.0)
    (True, False, False)
    """
    return (low > 0.0) & (high > 10.0 * low)


class Choice(NamedTuple):
    """What bounds of a gain follow from: the scenario, the gains that are free, and bounds that are known already."""

    scenario: Any
    free: tuple[str, ...]
    bounds: Mapping[str, Interval]

    @property
    def law(self) -> Any:
        """The table of the scenario's law."""
        return self.scenario.controller

    @property
    def t_f(self) -> float:
        """The prescribed time of the scenario [s]."""
        return self.law.t_f

    @property
    def sampled(self) -> bool:
        """Whether the loop is sampled."""
        return self.scenario.sampled

    @property
    def shortest_delta(self) -> float:
        """The shortest delta [s]: a period, if there is one."""
        return self.scenario.loop.period if self.sampled else 0.0

    def smallest(self, name: str) -> float:
        """What one of the law's gains is at least: its lower bound, or its own value where it is not free."""
        return self.bounds[name][0] if name in self.bounds else getattr(self.law, name)


class Allowed(NamedTuple):
    """Between which numbers bounds of a gain may be set, the upper one excluded."""

    lower: float
    upper: float
    lower_included: bool = False


def _positive(_: Choice) -> Allowed:
    return Allowed(0.0, math.inf)


class GainBounds(NamedTuple):
    """The bounds of a gain, as functions of a `Choice`."""

    usual: Callable[[Choice], Interval]  # where a scenario gives none
    # None of them contains zero, since the discontinuous sign has no gradient
    allowed: Callable[[Choice], Allowed] = _positive
    below: str | None = None  # what lies below the usual lower bound in the sampled loop, in words
    above: str | None = None  # and above the upper one
