"""The bounds of gains that several laws have; each law and observer names its own beside its keys."""

import math
from collections.abc import Callable
from typing import Any

from ptsmc_jax.scenario import scales
from ptsmc_jax.scenario.gain_record import Allowed, Choice, GainBounds, Interval
from ptsmc_jax.scenario.values import MOST_STEPS


def rounded(bound: float) -> float:
    """A bound in four digits."""
    return float(f"{bound:.4g}")


def hand_over(scenario: Any) -> float:
    """How long before t_f the law hands over [s]; a period for a law that does not."""
    return getattr(scenario.controller, "delta", None) or scenario.loop.period


def size(scenario: Any) -> float:
    """A body's mean moment of inertia, as a share of the paper's 12 kg m^2; 1 without a body."""
    mean, _ = scenario.moments
    return 1.0 if mean is None else mean / 12.0


def _converged(scenario: Any) -> float:
    """Prescribed time of the observer [s], which t_f must not fall below."""
    return getattr(scenario.observer, "t_o", None) or 0.0


def _usual_t_f(choice: Choice) -> Interval:
    shortest = 4.0 * choice.shortest_delta if "delta" in choice.free else hand_over(choice.scenario)
    return max(0.5 * choice.t_f, 1.05 * shortest, 1.05 * _converged(choice.scenario)), 2.0 * choice.t_f


def _allowed_t_f(choice: Choice) -> Allowed:
    loop, shortest = choice.scenario.loop, choice.shortest_delta
    least = max(shortest if "delta" in choice.free else hand_over(choice.scenario), _converged(choice.scenario))
    hold = loop.t_end - choice.t_f
    return Allowed(least, MOST_STEPS * loop.period - hold if choice.sampled else math.inf)


def _usual_delta(choice: Choice) -> Interval:
    t_f = choice.smallest("t_f")  # below every one
    lower = choice.shortest_delta or min(0.05, t_f / 4)
    return lower, min(max(5.0, t_f / 8, 4 * lower), (lower + t_f) / 2)


def _usual_width(choice: Choice) -> Interval:
    low, high = scales.widths(choice.scenario) if choice.sampled else scales.QUIET
    return rounded(low), rounded(high)


def _usual_k1(choice: Choice) -> Interval:
    least = 3.5 / choice.t_f
    border = scales.largest_k1(choice.scenario) if choice.sampled else 0.0
    return least, rounded(border) if border > least else 350.0 / choice.t_f


def _usual_rate(choice: Choice) -> Interval:
    """Two decades; sampled, the frozen loop is stable for (c + K1/2) h < 2: to half of that."""
    high = 700.0 / choice.t_f
    high = min(high, 1.0 / choice.scenario.loop.period) if choice.sampled else high
    return 0.01 * high, high


T_F = GainBounds(_usual_t_f, _allowed_t_f)
DELTA = GainBounds(
    _usual_delta,
    lambda choice: Allowed(choice.shortest_delta, choice.smallest("t_f"), choice.shortest_delta > 0.0),
    below="one period, the shortest hand-over that there is",
)
SIGN_WIDTH = GainBounds(
    _usual_width,
    below="a narrower one is lost in the noise, or hops from side to side",
    above="so wide that hardly a switching term is left",
)
K1 = GainBounds(_usual_k1, above="the stability border of the sampled loop")
SURFACE_RATE = GainBounds(_usual_rate)


def eta(order: Callable[[Any], float]) -> GainBounds:
    """The power of the approach, which must exceed a number that the scenario tells: 2, or the order of a chain."""

    def usual(choice: Choice) -> Interval:
        least = order(choice.scenario)
        return least + 0.05, least + 6.0

    return GainBounds(usual, lambda choice: Allowed(order(choice.scenario), math.inf))


def dead_beat(choice: Choice) -> Interval:
    """An observer's gain, up to that of a dead-beat one."""
    share = size(choice.scenario)
    high = rounded(scales.dead_beat_gain(choice.scenario)) if choice.sampled else 300.0 * share
    return 0.5 * share, high
