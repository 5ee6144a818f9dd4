"""Usual and allowed bounds of each gain of a search. Start with `bounds_of`.

The bounds are in `BOUNDS`, by the names that declarations of gains use, or in the declaration itself.
"""

import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from ptsmc_jax.declare import Declaration
from ptsmc_jax.scenario import mission, scales
from ptsmc_jax.scenario.errors import ScenarioError
from ptsmc_jax.scenario.values import MOST_STEPS

Interval = tuple[float, float]
SLOWEST_DECAY = 3.5  # smallest K1 / `Choice.slowest`


def wide(low: Any, high: Any) -> Any:
    """Whether an interval is searched on a log scale: it is above zero and its ends differ by more than a factor of 10.

    The arguments are numbers, or arrays of one shape for many intervals.

    >>> wide(0.1, 2.0), wide(0.5, 2.0), wide(-1.0, 2.0)
    (True, False, False)
    """
    return (low > 0.0) & (high > 10.0 * low)


class Choice(NamedTuple):
    """The inputs of the bounds of a gain: the scenario, the free gains, and the bounds that are known already."""

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
        """The shortest delta [s]: a control period in the sampled loop, otherwise 0."""
        return self.scenario.loop.period if self.sampled else 0.0

    @property
    def slowest(self) -> float:
        """1 / t_f [1/s], or down to a tenth of it if modes, dead time or noise allow only slower poles."""
        rate = 1.0 / self.t_f
        if not self.sampled:
            return rate
        return min(rate, max(mission.fastest_pole(self.scenario) / SLOWEST_DECAY, 0.1 * rate))

    def smallest(self, name: str) -> float:
        """Return the smallest value of a gain of the law: its lower bound, or its value if it is not free."""
        return self.bounds[name][0] if name in self.bounds else getattr(self.law, name)


class Allowed(NamedTuple):
    """The open range of allowed bounds of a gain; `lower_included`: whether `lower` itself is allowed."""

    lower: float
    upper: float
    lower_included: bool = False


class GainBounds(NamedTuple):
    """The bounds of a gain, as functions of a `Choice`."""

    usual: Callable[[Choice], Interval]  # the bounds if a scenario gives none
    # No range contains sign_width = 0, since the discontinuous sign has no gradient
    allowed: Callable[[Choice], Allowed] = lambda _: Allowed(0.0, math.inf)
    below: str | None = None  # why values below the usual lower bound are useless in the sampled loop, in words
    above: str | None = None  # why values above the usual upper bound are useless


def bounds_of(scenario: Any, name: str) -> GainBounds:
    """Return the bounds of a scenario's gain; name: of the gain, such as "observer_gain"."""
    table = next(table for table in scenario.tuned_tables.values() if name in table.gains)
    key = name.removeprefix(table.prefix)
    declared = table.declared.get(key)
    if declared is None or isinstance(declared.usual, str):
        return BOUNDS[table.usual[key] if declared is None else declared.usual]
    return _declared(declared, f"gain {key} of the class {table.made.__name__}")


def _declared(declared: Declaration, called: str) -> GainBounds:
    """Return the bounds that a declaration gives as numbers, or as a function; called: its name in errors."""
    limits = declared.limits
    usual: Any = declared.usual
    lower, upper = max(limits.above, limits.at_least), min(limits.below, limits.at_most)
    allowed = Allowed(lower, upper, limits.at_least > limits.above)

    def interval(choice: Choice) -> Interval:
        try:
            ends: Any = usual(choice.t_f, choice.scenario.loop.period) if callable(usual) else usual
            low, high = (float(end) for end in ends)
        except (Exception, SystemExit) as error:
            reason = f"{type(error).__name__}: {error}"
            raise ScenarioError(f"the usual bounds of the {called} fail: {reason}") from None
        if not (limits.above < low < high < limits.below and limits.at_least <= low and high <= limits.at_most):
            raise ScenarioError(
                f"the usual bounds of the {called} are [{low:g}, {high:g}], but must be two "
                f"numbers{limits.words(several=True)}, the lower one first"
            )
        return low, high

    near_limit = "so large that the sampled loop comes near its stability limit"
    return GainBounds(interval, lambda _: allowed, above=near_limit if getattr(usual, "sampled", False) else None)


def _converged(scenario: Any) -> float:
    """Return the prescribed time of the observer [s], the smallest t_f; 0 if it has none."""
    return getattr(scenario.observer, "t_o", None) or 0.0


def _usual_t_f(choice: Choice) -> Interval:
    shortest = 4.0 * choice.shortest_delta if "delta" in choice.free else choice.scenario.hand_over
    return max(0.5 * choice.t_f, 1.05 * shortest, 1.05 * _converged(choice.scenario)), 2.0 * choice.t_f


def _allowed_t_f(choice: Choice) -> Allowed:
    loop, shortest = choice.scenario.loop, choice.shortest_delta
    least = max(shortest if "delta" in choice.free else choice.scenario.hand_over, _converged(choice.scenario))
    hold = loop.t_end - choice.t_f
    return Allowed(least, MOST_STEPS * loop.period - hold if choice.sampled else math.inf)


def _usual_delta(choice: Choice) -> Interval:
    """Return delta from one period to a quarter of t_f, or to twice the design's delta if that is longer."""
    t_f = choice.smallest("t_f")  # delta must be below every t_f of the search
    lower = choice.shortest_delta or t_f / 600.0
    upper = max(t_f / 4.0, 4.0 * lower)
    if choice.sampled:
        upper = max(upper, 2.0 * mission.design(choice.scenario).delta)
    return lower, min(upper, (lower + t_f) / 2.0)


def _usual_k1(choice: Choice) -> Interval:
    """Return K1 from the slowest decay to the stability limit, for the smallest c if c is free."""
    least = SLOWEST_DECAY * choice.slowest
    surface = choice.smallest("surface_rate") if "surface_rate" in choice.free else choice.law.surface_rate
    limit = scales.largest_k1(choice.scenario, surface) if choice.sampled else 0.0
    return least, limit if limit > least else 100.0 * least


def _usual_rate(choice: Choice) -> Interval:
    """Return c from the slowest decay to half of the stability limit of the sampled loop."""
    least = 0.5 * SLOWEST_DECAY * choice.slowest
    high = scales.largest_rate(choice.scenario) if choice.sampled else 0.0
    return least, high if high > least else 200.0 * least


def _in_mission(low: float, high: float, power: Callable[[Any], float]) -> Callable[[Choice], Interval]:
    """Return bounds that scale with the mission time to a power; power: a function of the law's table."""

    def interval(choice: Choice) -> Interval:
        unit = mission.scales(choice.scenario).time ** power(choice.law)
        return low * unit, high * unit

    return interval


def _usual_p(choice: Choice) -> Interval:
    least = _allowed_p(choice)[0]
    return least + 0.05 * (2.0 - least), 2.0 - 0.05 * (2.0 - least)


def _allowed_p(choice: Choice) -> Allowed:
    """Return the p with gamma - 1/p > 1. If gamma is free too, its bounds follow p instead."""
    return Allowed(1.0 if "gamma" in choice.free else max(1.0, 1.0 / (choice.law.gamma - 1.0)), 2.0)


def _usual_gamma(choice: Choice) -> Interval:
    least = _allowed_gamma(choice)[0]
    return least + 0.05, least + 2.0


def _allowed_gamma(choice: Choice) -> Allowed:
    """Return the allowed values of gamma: gamma - 1/p > 1 must hold for every p within its bounds."""
    return Allowed(1.0 + 1.0 / choice.smallest("p"), math.inf)


def _dead_beat(choice: Choice) -> Interval:
    """Return observer gains [N m s] from the slowest decay to the gain of a deadbeat observer."""
    least = mission.SLOWEST_OBSERVER * choice.slowest * choice.scenario.mean_inertia
    high = scales.dead_beat_gain(choice.scenario) if choice.sampled else 0.0
    return least, high if high > least else 600.0 * least


def _usual_bound(choice: Choice) -> Interval:
    """Return gains of a finite-time observer, which bound the disturbance's rate."""
    present = choice.scenario.observer.gain
    return max(choice.law.disturbance_rate_bound, 0.05 * min(present)), 50.0 * max(present)


def _allowed_bound(choice: Choice) -> Allowed:
    least = choice.law.disturbance_rate_bound
    return Allowed(least, math.inf, least > 0.0)


def _usual_corner(choice: Choice) -> Interval:
    """Return a tenth to ten times the corner, at most half of the Nyquist frequency or the corner."""
    corner = choice.scenario.devices.command_filter.corner
    return 0.1 * corner, min(10.0 * corner, max(0.5 * math.pi / choice.scenario.loop.period, 0.5 * corner))


def _usual_bandwidth(choice: Choice) -> Interval:
    scenario = choice.scenario
    width = scenario.estimator.width(scenario)
    return 0.1 * width, min(10.0 * width, max(2.0 * width, 1.0 / scenario.devices.interval(scenario.loop.period)))


BOUNDS = {
    "eta": GainBounds(
        lambda choice: (choice.scenario.least_eta + 0.05, choice.scenario.least_eta + 6.0),
        lambda choice: Allowed(choice.scenario.least_eta, math.inf),
    ),
    "t_f": GainBounds(_usual_t_f, _allowed_t_f),
    "delta": GainBounds(
        _usual_delta,
        lambda choice: Allowed(choice.shortest_delta, choice.smallest("t_f"), choice.shortest_delta > 0.0),
        below="one period, the shortest hand-over that there is",
    ),
    "sign_width": GainBounds(
        lambda choice: (scales.widths if choice.sampled else scales.quiet)(choice.scenario),
        below="a narrower one is lost in the noise, or hops from side to side",
        above="so wide that hardly a switching term is left",
    ),
    "k1": GainBounds(_usual_k1, above="the stability limit of the sampled loop"),
    "surface_rate": GainBounds(_usual_rate, above="half of the stability limit of the sampled hold phase"),
    "dead_beat": GainBounds(_dead_beat, above="a dead-beat observer: nothing of its error is left after a period"),
    "finite_time": GainBounds(_usual_bound, _allowed_bound),
    "terminal_surface": GainBounds(_in_mission(3e-4, 3.0, lambda law: -law.p)),
    "fixed_time_reaching": GainBounds(_in_mission(1e-4, 10.0, lambda law: law.p - 2.0)),
    "fixed_time_p": GainBounds(_usual_p, _allowed_p),
    "fixed_time_gamma": GainBounds(_usual_gamma, _allowed_gamma),
    "corner": GainBounds(_usual_corner, lambda choice: Allowed(0.0, math.pi / choice.scenario.loop.period)),
    "bandwidth": GainBounds(_usual_bandwidth),
}
