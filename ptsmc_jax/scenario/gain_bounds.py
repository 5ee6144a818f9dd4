"""Usual and allowed bounds of each gain of a search. Start with `rules_of`.

The bounds are in `BOUNDS`, by the names that declarations of gains use, or in the declaration itself.
"""

import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from ptsmc_jax.declare import Declaration
from ptsmc_jax.scenario import mission, scales
from ptsmc_jax.scenario.errors import ScenarioError
from ptsmc_jax.scenario.tables import Scenario
from ptsmc_jax.scenario.values import MOST_STEPS

Interval = tuple[float, float]
SLOWEST_DECAY = 3.5  # smallest K1 / `BoundsContext.slowest_rate`
LARGEST_CORRECTION = 0.99  # largest correction of the filter / error that the star tracker measures


def is_log_scaled(low: Any, high: Any) -> Any:
    """Whether an interval is searched on a log scale: it is above zero and its ends differ by more than a factor of 10.

    The arguments are numbers, or arrays of one shape for many intervals.

    >>> is_log_scaled(0.1, 2.0), is_log_scaled(0.5, 2.0), is_log_scaled(-1.0, 2.0)
    (True, False, False)
    """
    return (low > 0.0) & (high > 10.0 * low)


class BoundsContext(NamedTuple):
    """The inputs of the bounds of a gain: the scenario, the free gains, and the bounds that are already known."""

    scenario: Scenario
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
    def slowest_rate(self) -> float:
        """1 / t_f [1/s], or down to a tenth of it if modes, dead time or noise allow only slower poles."""
        rate = 1.0 / self.t_f
        if not self.sampled:
            return rate
        return min(rate, max(mission.fastest_pole(self.scenario) / SLOWEST_DECAY, 0.1 * rate))

    def smallest_value(self, name: str) -> float:
        """Return the smallest value of a gain of the law: its lower bound, or its value if it is not free."""
        return self.bounds[name][0] if name in self.bounds else getattr(self.law, name)


class Allowed(NamedTuple):
    """The open range of allowed bounds of a gain; `lower_included`: whether `lower` itself is allowed."""

    lower: float
    upper: float
    lower_included: bool = False


class GainBounds(NamedTuple):
    """The bounds of a gain, as functions of a `BoundsContext`."""

    usual: Callable[[BoundsContext], Interval]  # the bounds if a scenario gives none
    # No range contains sign_width = 0, since the discontinuous sign has no gradient
    allowed: Callable[[BoundsContext], Allowed] = lambda _: Allowed(0.0, math.inf)
    reason_below: str | None = None  # why values below the usual lower bound are useless in the sampled loop
    reason_above: str | None = None  # why values above the usual upper bound are useless


def rules_of(scenario: Scenario, name: str) -> GainBounds:
    """Return the rules for the usual and the allowed bounds of a gain. They do not contain its bounds in [tune].

    Args:
        scenario: the scenario.
        name: name of the gain, such as "observer_gain".
    """
    table = next(table for table in scenario.tuned_tables.values() if name in table.gains)
    key = name.removeprefix(table.prefix)
    declared = table.declared.get(key)
    if declared is None or isinstance(declared.usual, str):
        return BOUNDS[table.usual[key] if declared is None else declared.usual]
    return _declared_bounds(declared, f"gain {key} of the class {table.part_class.__name__}")


def _declared_bounds(declared: Declaration, gain_name: str) -> GainBounds:
    """Return the bounds that a declaration gives as numbers, or as a function."""
    limits = declared.limits
    usual: Any = declared.usual
    lower, upper = max(limits.above, limits.at_least), min(limits.below, limits.at_most)
    allowed = Allowed(lower, upper, limits.at_least > limits.above)

    def interval(context: BoundsContext) -> Interval:
        try:
            stated: Any = usual(context.t_f, context.scenario.loop.period) if callable(usual) else usual
            bounds = tuple(map(float, stated))
        except (Exception, SystemExit) as error:
            reason = f"{type(error).__name__}: {error}"
            raise ScenarioError(f"the usual bounds of the {gain_name} fail: {reason}") from None
        low, high = bounds if len(bounds) == 2 else (math.nan, math.nan)
        if not (limits.above < low < high < limits.below and limits.at_least <= low and high <= limits.at_most):
            raise ScenarioError(
                f"the usual bounds of the {gain_name} are [{', '.join(f'{end:g}' for end in bounds)}], but must be two "
                f"numbers{limits.words()}, the lower one first"
            )
        return low, high

    near_limit = "so large that the sampled loop comes near its stability limit"
    return GainBounds(
        interval, lambda _: allowed, reason_above=near_limit if getattr(usual, "sampled", False) else None
    )


def _observer_time(scenario: Scenario) -> float:
    """Return the prescribed time of the observer [s], the smallest t_f; 0 if it has none."""
    return getattr(scenario.observer, "t_o", None) or 0.0


def _usual_t_f(context: BoundsContext) -> Interval:
    """Return t_f from half to twice its value [s]. The lower end is later than hand-over and observer need."""
    shortest_t_f = 4.0 * context.shortest_delta if "delta" in context.free else context.scenario.hand_over
    return max(0.5 * context.t_f, 1.05 * shortest_t_f, 1.05 * _observer_time(context.scenario)), 2.0 * context.t_f


def _allowed_t_f(context: BoundsContext) -> Allowed:
    """Return the t_f [s] after the hand-over and the observer, with at most `MOST_STEPS` periods until the end."""
    loop, shortest = context.scenario.loop, context.shortest_delta
    lowest = max(shortest if "delta" in context.free else context.scenario.hand_over, _observer_time(context.scenario))
    hold_time = loop.t_end - context.t_f
    return Allowed(lowest, MOST_STEPS * loop.period - hold_time if context.sampled else math.inf)


def _usual_delta(context: BoundsContext) -> Interval:
    """Return delta from one period to a quarter of t_f, or to twice the design's delta if that is longer."""
    t_f = context.smallest_value("t_f")  # delta must be below every t_f of the search
    lower = context.shortest_delta or t_f / 600.0
    upper = max(t_f / 4.0, 4.0 * lower)
    if context.sampled:
        upper = max(upper, 2.0 * mission.design(context.scenario).delta)
    return lower, min(upper, (lower + t_f) / 2.0)


def _usual_k1(context: BoundsContext) -> Interval:
    """Return K1 from the slowest decay to the stability limit, for the smallest c if c is free."""
    lowest = SLOWEST_DECAY * context.slowest_rate
    if "surface_rate" in context.free:
        rate = context.smallest_value("surface_rate")
    else:  # a custom law may have no c, see `Law.noise_of_s`
        rate = getattr(context.law, "surface_rate", 1.0 / context.t_f)
    largest = scales.largest_k1(context.scenario, rate) if context.sampled else 0.0
    return lowest, largest if largest > lowest else 100.0 * lowest


def _usual_surface_rate(context: BoundsContext) -> Interval:
    """Return c from the slowest decay to half of the stability limit of the sampled loop."""
    lowest = 0.5 * SLOWEST_DECAY * context.slowest_rate
    highest = scales.largest_surface_rate(context.scenario) if context.sampled else 0.0
    return lowest, highest if highest > lowest else 200.0 * lowest


def _scaled_bounds(low: float, high: float, power: Callable[[Any], float]) -> Callable[[BoundsContext], Interval]:
    """Return bounds that scale with the mission time to a power, a function of the law's table."""

    def interval(context: BoundsContext) -> Interval:
        scale = mission.scales(context.scenario).time ** power(context.law)
        return low * scale, high * scale

    return interval


def _usual_p(context: BoundsContext) -> Interval:
    """Return the allowed p without 5 % of the interval at each end."""
    lowest = _allowed_p(context)[0]
    return lowest + 0.05 * (2.0 - lowest), 2.0 - 0.05 * (2.0 - lowest)


def _allowed_p(context: BoundsContext) -> Allowed:
    """Return the p with gamma - 1/p > 1. If gamma is free too, its bounds follow p instead."""
    return Allowed(1.0 if "gamma" in context.free else max(1.0, 1.0 / (context.law.gamma - 1.0)), 2.0)


def _usual_gamma(context: BoundsContext) -> Interval:
    """Return gamma from 0.05 to 2 above its smallest allowed value."""
    lowest = _allowed_gamma(context)[0]
    return lowest + 0.05, lowest + 2.0


def _allowed_gamma(context: BoundsContext) -> Allowed:
    """Return the allowed values of gamma: gamma - 1/p > 1 must hold for every p within its bounds."""
    return Allowed(1.0 + 1.0 / context.smallest_value("p"), math.inf)


def _usual_observer_gain(context: BoundsContext) -> Interval:
    """Return observer gains [N m s] from the slowest decay to the gain of a deadbeat observer."""
    lowest = mission.MIN_OBSERVER_TIMES_T_F * context.slowest_rate * context.scenario.mean_inertia
    highest = scales.dead_beat_gain(context.scenario) if context.sampled else 0.0
    return lowest, highest if highest > lowest else 600.0 * lowest


def _usual_finite_time_gain(context: BoundsContext) -> Interval:
    """Return gains of a finite-time observer, which bound the disturbance's rate."""
    gains = context.scenario.observer.gain
    return max(context.law.disturbance_rate_bound, 0.05 * min(gains)), 50.0 * max(gains)


def _allowed_finite_time_gain(context: BoundsContext) -> Allowed:
    """Return gains above the bound on the disturbance's rate, or from 0 if it is 0."""
    lowest = context.law.disturbance_rate_bound
    return Allowed(lowest, math.inf, lowest > 0.0)


def _usual_corner(context: BoundsContext) -> Interval:
    """Return a tenth to ten times the corner, at most half of the Nyquist frequency or the corner."""
    corner = context.scenario.devices.command_filter.corner
    return 0.1 * corner, min(10.0 * corner, max(0.5 * math.pi / context.scenario.loop.period, 0.5 * corner))


def _usual_bandwidth(context: BoundsContext) -> Interval:
    """Return a tenth to ten times the bandwidth, at most that whose correction is nearly all of the measured error."""
    scenario = context.scenario
    estimator: Any = scenario.estimator
    width = estimator.bandwidth
    largest = -0.5 * math.log1p(-LARGEST_CORRECTION) / scenario.devices.interval(scenario.loop.period)
    return 0.1 * width, min(10.0 * width, max(2.0 * width, largest))


BOUNDS = {
    "eta": GainBounds(
        lambda context: (context.scenario.least_eta + 0.05, context.scenario.least_eta + 6.0),
        lambda context: Allowed(context.scenario.least_eta, math.inf),
    ),
    "t_f": GainBounds(_usual_t_f, _allowed_t_f),
    "delta": GainBounds(
        _usual_delta,
        lambda context: Allowed(context.shortest_delta, context.smallest_value("t_f"), context.shortest_delta > 0.0),
        reason_below="one period, the shortest possible hand-over",
    ),
    "sign_width": GainBounds(
        lambda context: (scales.width_range if context.sampled else scales.noiseless_width_range)(context.scenario),
        reason_below="a narrower boundary layer is smaller than the noise, or s jumps across it",
        reason_above="so wide that the switching term has almost no effect",
    ),
    "k1": GainBounds(_usual_k1, reason_above="the stability limit of the sampled loop"),
    "surface_rate": GainBounds(
        _usual_surface_rate, reason_above="half of the stability limit of the sampled hold phase"
    ),
    "dead_beat": GainBounds(
        _usual_observer_gain, reason_above="a dead-beat observer, whose error is zero after one period"
    ),
    "finite_time": GainBounds(_usual_finite_time_gain, _allowed_finite_time_gain),
    "terminal_surface": GainBounds(_scaled_bounds(3e-4, 3.0, lambda law: -law.p)),
    "fixed_time_reaching": GainBounds(_scaled_bounds(1e-4, 10.0, lambda law: law.p - 2.0)),
    "fixed_time_p": GainBounds(_usual_p, _allowed_p),
    "fixed_time_gamma": GainBounds(_usual_gamma, _allowed_gamma),
    "corner": GainBounds(_usual_corner, lambda context: Allowed(0.0, math.pi / context.scenario.loop.period)),
    "bandwidth": GainBounds(_usual_bandwidth),
}
