"""Resolve the table [tune]: the free gains, their default bounds, and the allowed range of bounds.

Start with `resolve`. The bounds of single gains are in `gain_bounds`.
"""

import math
from collections.abc import Container, Mapping

import msgspec

from ptsmc_jax.scenario import errors, gain_bounds, parsing, tables
from ptsmc_jax.scenario.errors import ScenarioError, wrong
from ptsmc_jax.scenario.gain_bounds import Choice, wide
from ptsmc_jax.scenario.tables import Scenario
from ptsmc_jax.simulation import catalogues

FIRST = ("t_f", "p", "surface_rate")  # gains whose bounds determine the bounds of other gains


def resolve(scenario: Scenario, tune: tables.Tune) -> tables.Tune:
    """Return the table [tune] with its default gains, bounds and level.

    Args:
        scenario: a scenario that is validated except for this table.
        tune: the table as read.

    Raises:
        ScenarioError: a gain, a bound or the objective is not possible in this scenario.
    """
    free = tune.free
    if free is None:
        law = scenario.controller
        first, rest = law.free(sampled=scenario.sampled)
        others = [name for name in scenario.gains if name not in (*law.gains, *scenario.observer.gains)]
        free = (*first, *scenario.observer.gains, *rest, *others)
    level = 0.9 if tune.statistic in tables.LEVELS and tune.level is None else tune.level
    tune = msgspec.structs.replace(tune, free=free, level=level)
    _check(scenario, tune)
    bounds = dict(tune.bounds)
    for key in sorted(free, key=lambda name: name not in FIRST):
        if key not in bounds:
            bounds[key] = _default(Choice(scenario, free, bounds), key)
    tune = msgspec.structs.replace(tune, bounds={key: bounds[key] for key in free})
    for name in free:
        _check_bounds(Choice(scenario, free, bounds), name)
    return tune


def need_some(scenario: Scenario) -> None:
    """Raise ScenarioError if a scenario with [tune] has no free gain, which is possible with a custom law."""
    if not scenario.search.gains:
        raise ScenarioError(
            f"tune.free is absent, and controller.kind = {errors.show(scenario.controller.kind)} with observer.kind = "
            f"{errors.show(scenario.observer.kind)} has no gain that is free then; allowed is some of "
            f"{', '.join(scenario.gains)}, or a law with a ptsmc_jax.gain"
        )


def observer_follows(scenario: Scenario) -> bool:
    """Whether the observer's t_o is absent, so that it is a fraction of t_f."""
    return getattr(scenario.observer, "t_o", 0.0) is None


def _check(scenario: Scenario, tune: tables.Tune) -> None:
    """Raise ScenarioError for invalid gains, objective or bounds, before default bounds are computed."""
    free, present = tune.gains, scenario.gains
    if len(set(free)) < len(free):
        raise wrong("tune.free", free, "a list that names each gain once")
    if not set(free) <= {*tables.FREE, *present}:
        raise wrong("tune.free", free, tables.FREE_ALLOWED)
    beginning = f"tune.free is {errors.brief(free)}, but"
    for name in free:
        if name not in present:
            raise ScenarioError(f"{beginning} {_absent(scenario, name)}")
    if "t_f" in free and observer_follows(scenario):
        raise ScenarioError(f"{beginning} observer.t_o then follows t_f; allowed is t_f with observer.t_o given")
    if tune.per_axis and "observer_gain" not in free:
        raise ScenarioError(f"tune.per_axis is true, but tune.free is {errors.brief(free)}, without observer_gain")
    _check_objective(scenario, tune, beginning)
    for name in tune.bounds:
        _check_bounds(Choice(scenario, free, tune.bounds), name)


def _check_objective(scenario: Scenario, tune: tables.Tune, beginning: str) -> None:
    """Raise ScenarioError if the objective is not possible; beginning: the first words of a message about tune.free."""
    if tune.level is not None and tune.statistic not in tables.LEVELS:
        raise ScenarioError(
            f'tune.level is {tune.level}, but is allowed only with tune.statistic = "quantile" or "cvar"'
        )
    shown = f"tune.minimise is {errors.show(tune.minimise)}"
    if tune.minimise in (tables.T_F, tables.LIMITS):
        if tune.minimise == tables.T_F and "t_f" not in tune.gains:
            raise ScenarioError(f'{beginning} tune.minimise = "t_f" needs t_f to be free')
        if not scenario.requirements:
            raise ScenarioError(
                f"{shown}, but there is no requirement; allowed is a metric, or [requirements] with one"
            )
        if tune.torque_weight:
            raise wrong(
                "tune.torque_weight", tune.torque_weight, f"absent with tune.minimise = {errors.show(tune.minimise)}"
            )
        if tune.statistic != "rms":
            raise ScenarioError(f"{shown}, which has no statistic, but tune.statistic is {errors.show(tune.statistic)}")
        return
    known = [name for name in scenario.metrics if name not in catalogues.LARGER_IS_BETTER]
    if tune.minimise not in known:
        nearest = parsing.like(tune.minimise, known, "`ptsmc new` lists them")
        raise ScenarioError(f'{shown}, but must be a metric, "t_f" or "limits"; {nearest}')
    table = scenario.metrics[tune.minimise].table
    if table is not None and getattr(scenario, table, None) is None:
        raise ScenarioError(f"{shown}, which needs [{table}], but there is no [{table}] table")
    if tune.minimise.startswith(catalogues.KNOWLEDGE) and not scenario.measured:
        raise ScenarioError(f"{shown}, which needs noise in [hardware]: without it the law sees the true state")


def _absent(scenario: Scenario, name: str) -> str:
    """Return the reason why a scenario lacks a gain, and the change that provides it."""
    law, observer = (errors.show(table.kind) for table in (scenario.controller, scenario.observer))
    match name:
        case "observer_gain":
            lacks = f"observer.kind = {observer} has no gain of that name"
            return f"{lacks}; allowed is observer_gain with an observer of another kind"
        case "filter_bandwidth":
            return 'there is no filter; allowed is filter_bandwidth with [filter] of kind "steady_state"'
        case "command_corner":
            return "the command is not filtered; allowed is command_corner with hardware.command_filter"
    known = (*scenario.controller.gains, *scenario.observer.gains, *tables.OF_NO_LAW)
    lacks = f"the law of controller.kind = {law} has no {name}"
    return f"{lacks}; allowed is some of {', '.join(dict.fromkeys(known))}"


def _check_bounds(choice: Choice, name: str) -> None:
    key, (lower, upper) = f"tune.bounds.{name}", choice.bounds[name]
    known = dict.fromkeys((*choice.scenario.gains, *tables.FREE))
    if name not in known:
        raise ScenarioError(f"{key} is not a known gain; {parsing.nearest(name, known)}")
    if name not in choice.free:
        raise ScenarioError(f"{key} bounds a gain that is not free; tune.free is {errors.brief(choice.free)}")
    least, most, closed = gain_bounds.bounds_of(choice.scenario, name).allowed(choice)
    if not (least <= lower if closed else least < lower) or not upper < most:
        allowed = f"two numbers {'from' if closed else 'above'} {least}"
        raise wrong(key, [lower, upper], allowed + (f" and below {most}" if math.isfinite(most) else ""))
    if lower >= upper:
        raise wrong(key, [lower, upper], "two numbers, the lower bound first and below the upper one")


def _default(choice: Choice, name: str) -> tuple[float, float]:
    """Return the usual bounds, widened if the scenario's gain is outside of them and allowed.

    The lower bound moves to the middle between the gain and the smallest allowed value. The upper bound moves to twice
    the gain's distance from the smallest allowed value, at most to the middle between the gain and the largest one.
    """
    gain = gain_bounds.bounds_of(choice.scenario, name)
    (low, high), present = gain.usual(choice), _present_values(choice.scenario, name)
    if present:
        least, most, closed = gain.allowed(choice)
        if math.isinf(least):  # a custom gain that may be negative: extend the interval by its width
            least = min(low, *present) - (high - low)
        if min(present) < low and (least <= min(present) if closed else least < min(present)):
            low = (least + min(present)) / 2
        if high < max(present) < most:
            high = min(2 * max(present) - least, (max(present) + most) / 2)
    return low, high


def _present_values(scenario: Scenario, name: str) -> tuple[float, ...]:
    """Return the scenario's values of a gain: one for each axis, or one for all, or none if it is absent."""
    table = next(table for table in scenario.tuned_tables.values() if name in table.gains)
    value = getattr(table, name.removeprefix(table.prefix))
    if value is None or (name == "sign_width" and value == 0.0):
        return ()
    return value if isinstance(value, tuple) else (float(value),)


def reason_of_bound(scenario: Scenario, name: str, side: str, bound: float) -> str | None:
    """Return the reason, in words, why a gain beyond a bound is useless; None if no reason is known.

    A reason is known only for a bound that is at or beyond the usual bound.

    Args:
        scenario: a scenario.
        name: name of the gain.
        side: "lower" or "upper".
        bound: the bound.
    """
    tune = scenario.tune
    if not scenario.sampled or tune is None:
        return None
    gain = gain_bounds.bounds_of(scenario, name)
    words = gain.below if side == "lower" else gain.above
    if words is None:
        return None
    low, high = usual(scenario, name)
    reached = bound <= low * (1 + 1e-9) if side == "lower" else bound >= high * (1 - 1e-9)
    return words if reached else None


def beyond(scenario: Scenario, name: str, side: str) -> float | None:
    """Return a value of a gain beyond a bound, to test whether the bound limits the objective.

    The value lies a tenth of the interval beyond the bound, on a log scale if the interval is searched on one. It stays
    closer to the bound than to the end of the allowed range.

    Args:
        scenario: a scenario with [tune].
        name: name of the gain.
        side: "lower" or "upper".

    Returns:
        The value. None: `reason_of_bound` gives a reason, or no value beyond the bound is allowed.
    """
    tune = scenario.search
    low, high = tune.bounds[name]
    if reason_of_bound(scenario, name, side, low if side == "lower" else high) is not None:
        return None
    least, most, _ = gain_bounds.bounds_of(scenario, name).allowed(Choice(scenario, tune.gains, tune.bounds))
    if wide(low, high):
        step = (high / low) ** 0.1
        value = low / step if side == "lower" else high * step
    else:
        value = low - 0.1 * (high - low) if side == "lower" else high + 0.1 * (high - low)
    value = max(value, 0.5 * (least + low)) if side == "lower" else min(value, 0.5 * (most + high))
    return None if value in (low, high) else float(f"{value:.4g}")  # None if the bound is the end of the allowed range


def widened(
    scenario: Scenario, sides: Mapping[str, str], defaulted: Container[tuple[str, ...]]
) -> dict[str, tuple[float, float]]:
    """Return wider bounds for gains that ended on a default bound, by name.

    A bound on a log scale moves by a factor of ten, and a bound on a linear scale by half of the interval. Neither
    moves more than half way to the end of the allowed range. A bound stays if the loop is unstable beyond it, or if
    the gain has no influence there.

    Args:
        scenario: with the bounds that were searched.
        sides: "lower" or "upper" for each gain on a bound, by its name.
        defaulted: paths of the keys that the user's scenario leaves out.
    """
    tune, found = scenario.search, dict[str, tuple[float, float]]()
    for name, side in sides.items():
        low, high = tune.bounds[name]
        by_default = ("tune", "bounds", name) in defaulted
        if not by_default or reason_of_bound(scenario, name, side, low if side == "lower" else high) is not None:
            continue
        least, most, _ = gain_bounds.bounds_of(scenario, name).allowed(Choice(scenario, tune.gains, tune.bounds))
        if name == "delta":  # the upper bound stays: the clock has samples for it only
            most = high
        if side == "lower" and wide(low, high) and math.isfinite(least):
            low = least + 0.1 * (low - least)
        elif side == "lower":
            low = max(low - 0.5 * (high - low), 0.5 * (least + low))
        else:
            high = min(10.0 * high if wide(low, high) else high + 0.5 * (high - low), 0.5 * (most + high))
        if (low, high) != tune.bounds[name]:
            found[name] = low, high
    return found


def usual(scenario: Scenario, name: str) -> tuple[float, float]:
    """Return the usual bounds of a free gain, before they are widened to include the scenario's gain."""
    tune = scenario.search
    return gain_bounds.bounds_of(scenario, name).usual(Choice(scenario, tune.gains, tune.bounds))


def by_default(scenario: Scenario, name: str) -> tuple[float, float]:
    """Return the default bounds of a free gain: the usual ones, widened to include the scenario's gain."""
    tune = scenario.search
    return _default(Choice(scenario, tune.gains, tune.bounds), name)
