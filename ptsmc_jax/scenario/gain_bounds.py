"""The bounds of gains that several laws have; each law and observer names its own beside its keys."""

import math
from typing import Any

from ptsmc_jax.scenario import mission, scales
from ptsmc_jax.scenario.gain_record import Allowed, Choice, GainBounds, Interval
from ptsmc_jax.scenario.values import MOST_STEPS

SLOWEST_DECAY = 3.5  # t_f times the least K1


def hand_over(scenario: Any) -> float:
    """How long before t_f the law hands over [s]; a period for a law that does not."""
    return getattr(scenario.controller, "delta", None) or scenario.loop.period


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
    """A period to a quarter of t_f, or to twice the design's delta if that is longer."""
    t_f = choice.smallest("t_f")  # below every one
    lower = choice.shortest_delta or t_f / 600.0
    upper = max(t_f / 4.0, 4.0 * lower)
    if choice.sampled:
        upper = max(upper, 2.0 * mission.design(choice.scenario).delta)
    return lower, min(upper, (lower + t_f) / 2.0)


def _usual_width(choice: Choice) -> Interval:
    return scales.widths(choice.scenario) if choice.sampled else scales.quiet(choice.scenario)


def _usual_k1(choice: Choice) -> Interval:
    """From a decay that takes t_f to the stability limit; if c is free, to the limit for the smallest c."""
    least = SLOWEST_DECAY / choice.t_f
    surface = choice.smallest("surface_rate") if "surface_rate" in choice.free else choice.law.surface_rate
    limit = scales.largest_k1(choice.scenario, surface) if choice.sampled else 0.0
    return least, limit if limit > least else 100.0 * least


def _usual_rate(choice: Choice) -> Interval:
    """From a decay that takes t_f to half of the stability limit of the sampled loop."""
    least = SLOWEST_DECAY / (2.0 * choice.t_f)
    high = scales.largest_rate(choice.scenario) if choice.sampled else 0.0
    return least, high if high > least else 200.0 * least


def _usual_eta(choice: Choice) -> Interval:
    return choice.scenario.least_eta + 0.05, choice.scenario.least_eta + 6.0


ETA = GainBounds(_usual_eta, lambda choice: Allowed(choice.scenario.least_eta, math.inf))
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
SURFACE_RATE = GainBounds(_usual_rate, above="half of the stability limit of the sampled hold phase")


def dead_beat(choice: Choice) -> Interval:
    """An observer's gain: from l / J = 1.5 / t_f up to that of a deadbeat one."""
    least = mission.SLOWEST_OBSERVER / choice.t_f * choice.scenario.mean_inertia
    high = scales.dead_beat_gain(choice.scenario) if choice.sampled else 0.0
    return least, high if high > least else 600.0 * least
