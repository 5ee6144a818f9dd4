"""Resolve the table [tune]: the free gains, their default bounds, and the allowed range of bounds.

Start with `resolve`. The bounds of single gains are in `gain_bounds`.
"""

import math
from collections.abc import Container, Mapping

import msgspec

from ptsmc_jax.scenario import errors, gain_bounds, parsing, tables
from ptsmc_jax.scenario.errors import ScenarioError, wrong
from ptsmc_jax.scenario.gain_bounds import BoundsContext, is_log_scaled
from ptsmc_jax.scenario.tables import Scenario
from ptsmc_jax.scenario.values import rounded
from ptsmc_jax.simulation import catalogues

RESOLVED_FIRST = ("t_f", "p", "surface_rate")  # gains whose bounds determine the bounds of other gains


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
        before_observer, after_observer = law.free(sampled=scenario.sampled)
        other_gains = [name for name in scenario.gains if name not in (*law.gains, *scenario.observer.gains)]
        free = (*before_observer, *scenario.observer.gains, *after_observer, *other_gains)
    level = 0.9 if tune.statistic in tables.LEVELS and tune.level is None else tune.level
    tune = msgspec.structs.replace(tune, free=free, level=level)
    _check_table(scenario, tune)
    bounds = dict(tune.bounds)
    for key in sorted(free, key=lambda name: name not in RESOLVED_FIRST):
        if key not in bounds:
            bounds[key] = _default_bounds(BoundsContext(scenario, free, bounds), key)
    tune = msgspec.structs.replace(tune, bounds={key: bounds[key] for key in free})
    for name in free:
        _check_bounds(BoundsContext(scenario, free, bounds), name)
    return tune


def require_free_gains(scenario: Scenario) -> None:
    """Raise ScenarioError if a scenario with [tune] has no free gain, which is possible with a custom law."""
    if not scenario.search.gains:
        raise ScenarioError(
            f"tune.free is absent, and controller.kind = {errors.show(scenario.controller.kind)} with observer.kind = "
            f"{errors.show(scenario.observer.kind)} has no gain that is free then; allowed is some of "
            f"{', '.join(scenario.gains)}, or a law with a ptsmc_jax.gain"
        )


def is_observer_time_default(scenario: Scenario) -> bool:
    """Whether the observer's t_o is absent, so that it is a fraction of t_f."""
    return getattr(scenario.observer, "t_o", 0.0) is None


def _check_table(scenario: Scenario, tune: tables.Tune) -> None:
    """Raise ScenarioError if gains, objective or stated bounds of [tune] are invalid. Runs before default bounds."""
    free, scenario_gains = tune.gains, scenario.gains
    if len(set(free)) < len(free):
        raise wrong("tune.free", free, "a list that names each gain once")
    if not set(free) <= {*tables.TUNABLE_GAINS, *scenario_gains}:
        raise wrong("tune.free", free, f"a list of some of {', '.join(scenario_gains)}")
    beginning = f"tune.free is {errors.brief(free)}, but"
    for name in free:
        if name not in scenario_gains:
            raise ScenarioError(f"{beginning} {_absence_reason(scenario, name)}")
    if "t_f" in free and is_observer_time_default(scenario):
        raise ScenarioError(f"{beginning} observer.t_o then follows t_f; allowed is t_f with observer.t_o given")
    if tune.per_axis and "observer_gain" not in free:
        raise ScenarioError(f"tune.per_axis is true, but tune.free is {errors.brief(free)}, without observer_gain")
    _check_objective(scenario, tune, beginning)
    for name in tune.bounds:
        _check_bounds(BoundsContext(scenario, free, tune.bounds), name)


def _check_objective(scenario: Scenario, tune: tables.Tune, beginning: str) -> None:
    """Raise ScenarioError if the objective is not possible; `beginning` starts messages about tune.free."""
    if tune.level is not None and tune.statistic not in tables.LEVELS:
        raise ScenarioError(
            f'tune.level is {tune.level}, but is allowed only with tune.statistic = "quantile" or "cvar"'
        )
    minimised = f"tune.minimise is {errors.show(tune.minimise)}"
    if tune.minimise in (tables.T_F, tables.LIMITS):
        if tune.minimise == tables.T_F and "t_f" not in tune.gains:
            raise ScenarioError(f'{beginning} tune.minimise = "t_f" needs t_f to be free')
        if not scenario.requirements:
            raise ScenarioError(
                f"{minimised}, but there is no requirement; allowed is a metric, or [requirements] with one"
            )
        if tune.torque_weight:
            raise wrong(
                "tune.torque_weight", tune.torque_weight, f"absent with tune.minimise = {errors.show(tune.minimise)}"
            )
        if tune.statistic != "rms":
            raise ScenarioError(
                f"{minimised}, which has no statistic, but tune.statistic is {errors.show(tune.statistic)}"
            )
        return
    metrics = [name for name in scenario.metrics if name not in catalogues.LARGER_IS_BETTER]
    if tune.minimise not in metrics:
        nearest = parsing.nearest_name_hint(tune.minimise, metrics)
        raise ScenarioError(f'{minimised}, but must be a metric, "t_f" or "limits"; {nearest}')
    table_name = scenario.metrics[tune.minimise].table
    if table_name is not None and getattr(scenario, table_name, None) is None:
        raise ScenarioError(f"{minimised}, which needs [{table_name}], but there is no [{table_name}] table")
    if tune.minimise.startswith(catalogues.KNOWLEDGE) and not scenario.uses_measurements:
        raise ScenarioError(f"{minimised}, which needs noise in [hardware]: without it the law sees the true state")


def _absence_reason(scenario: Scenario, name: str) -> str:
    """Return the reason why a scenario lacks a gain, and the change that provides it."""
    law, observer = (errors.show(table.kind) for table in (scenario.controller, scenario.observer))
    others = {
        "observer_gain": f"observer.kind = {observer} has no gain of that name; allowed is an observer of another kind",
        "filter_bandwidth": 'there is no filter; allowed is filter_bandwidth with [filter] of kind "steady_state"',
        "command_corner": "the command is not filtered; allowed is command_corner with hardware.command_filter",
    }
    law_reason = f"the law of controller.kind = {law} has no {name}; allowed is some of {', '.join(scenario.gains)}"
    return others.get(name, law_reason)


def _check_bounds(context: BoundsContext, name: str) -> None:
    """Raise ScenarioError if the bounds of a gain are not allowed, or if the gain is not free."""
    key, (lower, upper) = f"tune.bounds.{name}", context.bounds[name]
    known_gains = dict.fromkeys((*context.scenario.gains, *tables.TUNABLE_GAINS))
    if name not in known_gains:
        raise ScenarioError(f"{key} is not a known gain; {parsing.nearest_name_hint(name, known_gains)}")
    if name not in context.free:
        raise ScenarioError(f"{key} bounds a gain that is not free; tune.free is {errors.brief(context.free)}")
    smallest, largest, is_closed = gain_bounds.rules_of(context.scenario, name).allowed(context)
    if not (smallest <= lower if is_closed else smallest < lower) or not upper < largest:
        allowed = f"two numbers {'of at least' if is_closed else 'above'} {smallest}"
        raise wrong(key, [lower, upper], allowed + (f" and below {largest}" if math.isfinite(largest) else ""))
    if lower >= upper:
        raise wrong(key, [lower, upper], "two numbers, the lower bound first and below the upper one")


def _default_bounds(context: BoundsContext, name: str) -> tuple[float, float]:
    """Return the usual bounds, widened if the scenario's gain is outside of them and allowed.

    The lower bound moves to the middle between the gain and the smallest allowed value. The upper bound moves to twice
    the gain's distance from the smallest allowed value, at most to the middle between the gain and the largest one.
    """
    gain_rules = gain_bounds.rules_of(context.scenario, name)
    (low, high), values = gain_rules.usual(context), _present_values(context.scenario, name)
    if values:
        smallest, largest, is_closed = gain_rules.allowed(context)
        if math.isinf(smallest):  # a custom gain that may be negative: extend the interval by its width
            smallest = min(low, *values) - (high - low)
        if min(values) < low and (smallest <= min(values) if is_closed else smallest < min(values)):
            low = (smallest + min(values)) / 2
        if high < max(values) < largest:
            high = min(2 * max(values) - smallest, (max(values) + largest) / 2)
    return rounded(low), rounded(high)


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
    gain_rules = gain_bounds.rules_of(scenario, name)
    reason = gain_rules.reason_below if side == "lower" else gain_rules.reason_above
    if not scenario.sampled or reason is None:
        return None
    low, high = usual_bounds(scenario, name)
    is_reached = bound <= low * (1 + 1e-9) if side == "lower" else bound >= high * (1 - 1e-9)
    return reason if is_reached else None


def value_beyond_bound(scenario: Scenario, name: str, side: str) -> float | None:
    """Return a value of a gain beyond a bound, to test whether the bound limits the objective.

    The value is a tenth of the interval beyond the bound, on a log scale if the interval is searched on one. It stays
    closer to the bound than to the end of the allowed range.

    Args:
        scenario: a scenario with [tune].
        name: name of the gain.
        side: "lower" or "upper".

    Returns:
        The value. None: `reason_of_bound` gives a reason, or no value beyond the bound is allowed.
    """
    low, high = scenario.search.bounds[name]
    if reason_of_bound(scenario, name, side, low if side == "lower" else high) is not None:
        return None
    smallest, largest, _ = gain_bounds.rules_of(scenario, name).allowed(_search_context(scenario))
    if is_log_scaled(low, high):
        step = (high / low) ** 0.1
        value = low / step if side == "lower" else high * step
    else:
        value = low - 0.1 * (high - low) if side == "lower" else high + 0.1 * (high - low)
    value = max(value, 0.5 * (smallest + low)) if side == "lower" else min(value, 0.5 * (largest + high))
    # the value equals the bound if the allowed range ends there
    return None if value in (low, high) else float(f"{value:.4g}")


def widen_bounds(
    scenario: Scenario, sides: Mapping[str, str], defaulted: Container[tuple[str, ...]]
) -> dict[str, tuple[float, float]]:
    """Return wider bounds for gains that ended on a default bound, by name.

    A bound on a log scale moves by a factor of ten, and a bound on a linear scale by half of the interval. Neither
    moves more than half way to the end of the allowed range. A bound does not move if the loop is unstable beyond
    it, or if the gain has no influence there.

    Args:
        scenario: scenario whose bounds were searched.
        sides: "lower" or "upper" for each gain on a bound, by its name.
        defaulted: paths of the keys that the user's scenario leaves out.

    Returns:
        Lower and upper bound of each gain whose bounds move, in the unit of the gain.
    """
    bounds, wider = scenario.search.bounds, dict[str, tuple[float, float]]()
    for name, side in sides.items():
        low, high = bounds[name]
        is_default = ("tune", "bounds", name) in defaulted
        if not is_default or reason_of_bound(scenario, name, side, low if side == "lower" else high) is not None:
            continue
        smallest, largest, _ = gain_bounds.rules_of(scenario, name).allowed(_search_context(scenario))
        if name == "delta":  # the upper bound stays: the clock has samples for it only
            largest = high
        if side == "lower" and is_log_scaled(low, high) and math.isfinite(smallest):
            low = smallest + 0.1 * (low - smallest)
        elif side == "lower":
            low = max(low - 0.5 * (high - low), 0.5 * (smallest + low))
        else:
            high = min(10.0 * high if is_log_scaled(low, high) else high + 0.5 * (high - low), 0.5 * (largest + high))
        if (low, high) != bounds[name]:
            wider[name] = low, high
    return wider


def usual_bounds(scenario: Scenario, name: str) -> tuple[float, float]:
    """Return the usual bounds of a free gain, before they are widened to include the scenario's gain."""
    low, high = gain_bounds.rules_of(scenario, name).usual(_search_context(scenario))
    return rounded(low), rounded(high)


def default_bounds(scenario: Scenario, name: str) -> tuple[float, float]:
    """Return the default bounds of a free gain: the usual ones, widened to include the scenario's gain."""
    return _default_bounds(_search_context(scenario), name)


def _search_context(scenario: Scenario) -> BoundsContext:
    """Return the inputs of the bounds of gains, with the free gains and the bounds in [tune]."""
    return BoundsContext(scenario, scenario.search.gains, scenario.search.bounds)
