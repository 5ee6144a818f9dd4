"""What tuning may move in a scenario: the default bounds of each gain, and how far they may be set."""

import math

import msgspec
import numpy as np

from ptsmc_jax import formulas
from ptsmc_jax.scenario import device_tables, errors, law_tables, plant_tables, scales, schema, tables
from ptsmc_jax.scenario.errors import ScenarioError, wrong
from ptsmc_jax.scenario.tables import Scenario

FINITE_TIME = law_tables.FiniteTimeObserver | law_tables.EachFiniteTimeObserver
# what is free of a law if a scenario does not say: before the observer's gain, and after it in the sampled loop, since
# without samples a larger K1 and a narrower sign cost nothing but steps
_FREE: dict[str, tuple[tuple[tables.Free, ...], tuple[tables.Free, ...]]] = {
    "prescribed_time": (("eta", "delta"), ("k1", "sign_width")),
    "pd": (("k_p", "k_d"), ()),
    "terminal": (("p", "b", "k"), ("sign_width",)),
    "fixed_time": (("a1", "b1", "a2", "b2", "p", "gamma", "m", "n"), ("sign_width",)),
}
_POWERS = {"p": (1.0, 2.0), "m": (1.0, math.inf), "n": (0.0, 1.0)}  # between which they must lie
MOST_STEPS = 200_000  # of a run


def least_eta(scenario: Scenario) -> float:
    """What eta must exceed: 2 by Theorems 1 and 2, the order of a chain by Theorem 3."""
    return float(scenario.plant.order) if isinstance(scenario.plant, plant_tables.ChainPlant) else 2.0


def hand_over(scenario: Scenario) -> float:
    """How long before t_f the law hands over [s]; a period for a law that does not."""
    return getattr(scenario.controller, "delta", scenario.loop.period)


def filter_bandwidth(scenario: Scenario) -> float:
    """Bandwidth of the scenario's filter [rad/s]: where star tracker and gyro weigh the same, if it gives none."""
    assert isinstance(scenario.filter, device_tables.SteadyStateFilter)
    if scenario.filter.bandwidth is not None:
        return scenario.filter.bandwidth
    table, period = scenario.hardware, scenario.loop.period
    assert isinstance(table, device_tables.Hardware)
    return formulas.best_bandwidth(
        table.attitude_noise or 0.0, scales.gyro_noise(table, period), period, _interval(scenario)
    )


def resolve(scenario: Scenario, tune: tables.Tune) -> tables.Tune:
    """The table with its defaults: gains, bounds, level; of a scenario that is checked but for it.

    Raises ScenarioError where it asks for what cannot be tuned.
    """
    free = tune.free
    if free is None:
        law, rest = _FREE[scenario.controller.kind]
        observer: tuple[tables.Free, ...] = ("observer_gain",) if _has_gain(scenario) else ()
        filtered: tuple[tables.Free, ...] = ("filter_bandwidth",) if _has_bandwidth(scenario) else ()
        free = (*law, *observer, *(rest if scenario.loop.mode == "sampled" else ()), *filtered)
    level = 0.9 if tune.objective == "cvar" and tune.level is None else tune.level
    tune = msgspec.structs.replace(tune, free=free, level=level)
    _check(scenario, tune)
    bounds = dict(tune.bounds)
    for key in sorted(free, key=lambda name: name not in ("t_f", "p")):  # those first that bounds of others go by
        if key not in bounds:
            bounds[key] = _default(scenario, msgspec.structs.replace(tune, bounds=bounds), key)
    tune = msgspec.structs.replace(tune, bounds={key: bounds[key] for key in free})
    for name in free:
        _check_bounds(scenario, tune, name, bounds[name])
    return tune


def _check(scenario: Scenario, tune: tables.Tune) -> None:
    """Raise ScenarioError where the table asks for what cannot be tuned, before defaults are computed from it."""
    free = tune.free
    assert free is not None  # `resolve` filled it in
    if len(set(free)) < len(free):
        raise wrong("tune.free", free, "a list that names each gain once")
    said = f"tune.free is {errors.brief(free)}, but"
    for name in free:
        if name not in ("observer_gain", "filter_bandwidth") and not hasattr(scenario.controller, name):
            known = [key for key in tables.FREE if hasattr(scenario.controller, key)]
            raise ScenarioError(
                f"{said} the law of controller.kind = {errors.show(scenario.controller.kind)} has no {name}; "
                f"allowed is some of {', '.join(known)}, observer_gain, filter_bandwidth"
            )
    if "observer_gain" in free and not _has_gain(scenario):
        raise ScenarioError(
            f'{said} observer.kind = "none" has no gain; allowed is observer_gain with an observer of another kind'
        )
    if "filter_bandwidth" in free and not _has_bandwidth(scenario):
        raise ScenarioError(
            f'{said} there is no filter; allowed is filter_bandwidth with [filter] of kind "steady_state"'
        )
    if "t_f" in free and isinstance(scenario.observer, law_tables.Prescribed) and scenario.observer.t_o is None:
        raise ScenarioError(f"{said} observer.t_o then follows t_f; allowed is t_f with observer.t_o given")
    if tune.per_axis and "observer_gain" not in free:
        raise ScenarioError(f"tune.per_axis is true, but tune.free is {errors.brief(free)}, without observer_gain")
    if tune.level is not None and tune.objective != "cvar":
        raise ScenarioError(f'tune.level is {tune.level}, but goes with tune.objective = "cvar" only')
    if tune.objective == "t_f":
        if "t_f" not in free:
            raise ScenarioError(f'{said} tune.objective = "t_f" needs t_f to be free')
        if not scenario.requirements:
            raise ScenarioError('tune.objective is "t_f", but there is no requirement that a short t_f could break')
        if tune.torque_weight:
            raise wrong("tune.torque_weight", tune.torque_weight, 'absent where tune.objective is "t_f"')
    for name, bounds in tune.bounds.items():
        _check_bounds(scenario, tune, name, bounds)


def _check_bounds(scenario: Scenario, tune: tables.Tune, name: str, bounds: tuple[float, float]) -> None:
    key, (lower, upper), free = f"tune.bounds.{name}", bounds, tune.free or ()
    if name not in tables.FREE:
        raise ScenarioError(f"{key} is not a known gain; {schema.nearest(name, tables.FREE)}")
    if name not in free:
        raise ScenarioError(f"{key} bounds a gain that is not free; tune.free is {errors.brief(free)}")
    least, most, closed = _range(scenario, tune, name)
    if not (least <= lower if closed else least < lower) or not upper < most:
        allowed = f"two numbers {'from' if closed else 'above'} {least}"
        raise wrong(key, [lower, upper], allowed + (f" and below {most}" if math.isfinite(most) else ""))
    if lower >= upper:
        raise wrong(key, [lower, upper], "two numbers, the lower bound first and below the upper one")


def _range(scenario: Scenario, tune: tables.Tune, name: str) -> tuple[float, float, bool]:
    """Lowest and highest that a bound may be, and whether the lowest itself may be."""
    loop, shortest = scenario.loop, _shortest_delta(scenario)
    if name == "eta":
        return least_eta(scenario), math.inf, False
    if name == "delta":  # below every t_f
        return shortest, tune.bounds.get("t_f", (scenario.controller.t_f,))[0], shortest > 0.0
    if name == "t_f":
        least = max(hand_over(scenario) if "delta" not in (tune.free or ()) else shortest, _t_o(scenario))
        assert loop.t_end is not None
        hold = loop.t_end - scenario.controller.t_f
        return least, MOST_STEPS * loop.period - hold if loop.mode == "sampled" else math.inf, False
    if name == "gamma":  # gamma - 1/p > 1, for every p
        return 1.0 + 1.0 / tune.bounds.get("p", (scenario.controller.p,))[0], math.inf, False
    if name == "p" and "gamma" not in (tune.free or ()) and hasattr(scenario.controller, "gamma"):
        return _least_p(scenario), 2.0, False
    if name in _POWERS:
        return *_POWERS[name], False
    if name == "observer_gain" and isinstance(scenario.observer, FINITE_TIME):
        least = scenario.controller.disturbance_rate_bound
        return least, math.inf, least > 0.0
    return 0.0, math.inf, False


def _default(scenario: Scenario, tune: tables.Tune, name: str) -> tuple[float, float]:
    """The usual bounds, moved where the law allows the scenario's own gain outside them.

    Then to half the distance, or twice the distance, that it keeps from the least that is allowed.
    """
    (low, high), own = _usual(scenario, tune, name), _own(scenario, name)
    if own:
        least, most, closed = _range(scenario, tune, name)
        if min(own) < low and (least <= min(own) if closed else least < min(own)):
            low = (least + min(own)) / 2
        if high < max(own) < most:
            high = min(2 * max(own) - least, (max(own) + most) / 2)
    return low, high


def _own(scenario: Scenario, name: str) -> tuple[float, ...]:
    """The scenario's gain of this name, on each axis where it has several; none if it has none."""
    if name == "observer_gain":
        return getattr(scenario.observer, "gain", None) or ()
    value = getattr(scenario.controller, name, None)
    return () if value is None or (name == "sign_width" and value == 0.0) else (float(value),)


def _usual(scenario: Scenario, tune: tables.Tune, name: str) -> tuple[float, float]:
    t_f, free = scenario.controller.t_f, tune.free or ()
    least = least_eta(scenario)
    if name == "t_f":
        shortest = 4.0 * _shortest_delta(scenario) if "delta" in free else hand_over(scenario)
        return max(0.5 * t_f, 1.05 * shortest, 1.05 * _t_o(scenario)), 2.0 * t_f
    if name == "delta":  # below every t_f
        t_f = tune.bounds.get("t_f", (t_f,))[0]
        lower = _shortest_delta(scenario) or min(0.05, t_f / 4)
        return lower, min(max(5.0, t_f / 8, 4 * lower), (lower + t_f) / 2)
    if name == "filter_bandwidth":
        width = filter_bandwidth(scenario)
        return 0.1 * width, min(10.0 * width, max(2.0 * width, 1.0 / _interval(scenario)))
    if name == "observer_gain" and isinstance(scenario.observer, FINITE_TIME):  # a bound on the disturbance's rate
        own = _own(scenario, name)
        return max(scenario.controller.disturbance_rate_bound, 0.05 * min(own)), 50.0 * max(own)
    if name == "gamma":
        above = 1.0 + 1.0 / tune.bounds.get("p", (getattr(scenario.controller, "p", 1.05),))[0]
        return above + 0.05, above + 2.0
    if name == "p" and "gamma" not in free and hasattr(scenario.controller, "gamma"):
        above = _least_p(scenario)
        return above + 0.05 * (2.0 - above), 2.0 - 0.05 * (2.0 - above)
    sampled = scenario.loop.mode == "sampled"
    if name == "k1":
        border = scales.largest_k1(scenario) if sampled else 0.0
        return 3.5 / t_f, _shown(border) if border > 3.5 / t_f else 350.0 / t_f
    if name == "sign_width":
        low, high = scales.widths(scenario) if sampled else scales.QUIET
        return _shown(low), _shown(high)
    if name == "surface_rate":  # two decades; sampled, the frozen loop is stable for (c + K1/2) h < 2: to half of that
        high = min(700.0 / t_f, 1.0 / scenario.loop.period) if sampled else 700.0 / t_f
        return 0.01 * high, high
    size = 1.0
    if scenario.spacecraft is not None:  # beside a mean moment of 12 kg m^2
        moments = np.asarray(scenario.spacecraft.inertia)
        size = float(np.mean(moments if moments.ndim == 1 else np.diag(moments))) / 12.0
    return {
        "eta": (least + 0.05, least + 6.0),
        "observer_gain": (0.5 * size, _shown(scales.dead_beat_gain(scenario)) if sampled else 300.0 * size),
        **dict.fromkeys(("k_p", "k"), (2.0 / t_f**2, 2000.0 / t_f**2)),
        "k_d": (0.3 / t_f, 100.0 / t_f),
        **dict.fromkeys(("b", "a1", "b1"), (0.01 / t_f, 100.0 / t_f)),
        **dict.fromkeys(("a2", "b2"), (1e-4, 10.0)),
        "p": (1.05, 1.95),
        "m": (1.05, 3.0),
        "n": (0.05, 0.95),
    }[name]


def border(scenario: Scenario, name: str, side: str, bound: float) -> str | None:
    """What lies beyond a bound of a gain, "lower" or "upper", in words; None: nothing that is known.

    A bound says something where it is the usual one, or beyond it.
    """
    tune = scenario.tune
    if scenario.loop.mode != "sampled" or tune is None:
        return None
    words = {
        ("delta", "lower"): "one period, the shortest hand-over that there is",
        ("observer_gain", "upper"): "a dead-beat observer: nothing of its error is left after a period",
        ("k1", "upper"): "the stability border of the sampled loop",
        ("sign_width", "lower"): "a narrower one is lost in the noise, or hops from side to side",
        ("sign_width", "upper"): "so wide that hardly a switching term is left",
    }
    if (name, side) not in words or (name == "observer_gain" and isinstance(scenario.observer, FINITE_TIME)):
        return None
    low, high = usual(scenario, name)
    reached = bound <= low * (1 + 1e-9) if side == "lower" else bound >= high * (1 - 1e-9)
    return words[name, side] if reached else None


def usual(scenario: Scenario, name: str) -> tuple[float, float]:
    """The default bounds of a free gain, before they reach out to the scenario's own."""
    assert scenario.tune is not None
    return _usual(scenario, scenario.tune, name)


def _shown(bound: float) -> float:
    return float(f"{bound:.4g}")


def _least_p(scenario: Scenario) -> float:
    """What p must exceed for gamma - 1/p > 1."""
    return max(1.0, 1.0 / (scenario.controller.gamma - 1.0))


def _has_gain(scenario: Scenario) -> bool:
    return not isinstance(scenario.observer, law_tables.NoObserver)


def _has_bandwidth(scenario: Scenario) -> bool:
    return isinstance(scenario.filter, device_tables.SteadyStateFilter)


def _interval(scenario: Scenario) -> float:
    """Between two samples of the star tracker [s]."""
    return scenario.loop.period * (getattr(scenario.hardware, "star_tracker_every", None) or 1)


def _shortest_delta(scenario: Scenario) -> float:
    return scenario.loop.period if scenario.loop.mode == "sampled" else 0.0


def _t_o(scenario: Scenario) -> float:
    """Prescribed time of the observer [s], which t_f must not fall below."""
    return getattr(scenario.observer, "t_o", None) or 0.0
