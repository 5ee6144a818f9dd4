"""The gains that tuning can move: their units, and how they are read from and set in parts and scenarios.

A gain that has a number for each axis may be named axis by axis, `observer_gain_1` and so on.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import core
from jaxtyping import Array

from ptsmc_jax import scenario as scenarios
from ptsmc_jax.scenario import disturbance_bounds, keys, reading
from ptsmc_jax.scenario.baseline_record import BaselineTable
from ptsmc_jax.scenario.command_filter_tables import CommandFilter
from ptsmc_jax.scenario.device_tables import FILTERS
from ptsmc_jax.scenario.layouts import SCENARIOS
from ptsmc_jax.scenario.parsing import plain
from ptsmc_jax.scenario.tables import Scenario
from ptsmc_jax.scenario.values import Table
from ptsmc_jax.simulation.rollout import Parts

_AXIS = "observer_gain_"
_OF_FILTERS = ("filter_bandwidth", "command_corner")


def units(plant: str) -> dict[str, str]:
    """The unit of each gain that a plant of this kind may have, from what its keys mean; "-" for none."""
    tables: Any = SCENARIOS[plant].TABLES
    named: list[tuple[type[Table], dict[str, str]]] = [
        *((law, {name: name for name in law.gains}) for law in tables["controller"].values()),
        *((observer, {"gain": "observer_gain"}) for observer in tables["observer"].values()),
        *((one, {"bandwidth": "filter_bandwidth"}) for one in FILTERS.values()),
        (CommandFilter, {"corner": "command_corner"}),
    ]
    found: dict[str, str] = {}
    for table, gains in named:
        for key in keys.of(table):
            if key.name in gains:
                found.setdefault(gains[key.name], key.unit or "-")
    return found


def units_of(scenario: Scenario) -> dict[str, str]:
    """The unit of each gain of a scenario, those of a law or an observer of one's own among them."""
    found = units(scenario.plant.kind)
    for table, prefix in ((scenario.controller, ""), (scenario.observer, "observer_")):
        named = {prefix + key.name: key.unit or "-" for key in keys.of(type(table))}
        found |= {name: unit for name, unit in named.items() if name in table.gains}
    return found


def base(name: str) -> str:
    """The gain that a name stands for: `observer_gain` for `observer_gain_2`."""
    return "observer_gain" if name.startswith(_AXIS) else name


def of_observer(gains: Mapping[str, Any]) -> dict[str, Any]:
    """Gains of an observer of one's own, by its fields."""
    found = {name.removeprefix("observer_"): v for name, v in gains.items() if name.startswith("observer_")}
    return {name: v for name, v in found.items() if base(f"observer_{name}") != "observer_gain"}


def of_law(gains: Mapping[str, Any]) -> dict[str, Any]:
    """Gains of the law."""
    return {k: v for k, v in gains.items() if not k.startswith("observer_") and k not in _OF_FILTERS}


def named(scenario: Scenario) -> tuple[str, ...]:
    """Names of the free gains, axis by axis where the scenario says so."""
    tune = scenario.tune
    assert tune is not None
    assert tune.free is not None  # a checked scenario names them
    names: list[str] = []
    for name in tune.free:
        each = tune.per_axis and name == "observer_gain"
        names += [f"{_AXIS}{k + 1}" for k in range(len(getattr(scenario.observer, "gain", ())))] if each else [name]
    return tuple(names)


def with_gains(parts: Parts, gains: Mapping[str, Array | float]) -> Parts:
    """The parts with other gains, by name; `observer_gain` is set on all axes, and with t_f the time after it kept.

    Raises ValueError where the parts' anchored clock has too few samples for them, as far as they are known: under a
    transformation such a run ends before t_end.
    """
    gains = {name: jnp.asarray(value, float) for name, value in gains.items()}
    if "t_f" in gains:
        parts = parts.with_t_f(gains["t_f"])
    law = {name: value for name, value in of_law(gains).items() if name != "t_f"}
    parts = replace(parts, controller=replace(parts.controller, **law))
    if of_observer(gains):
        parts = replace(parts, observer=replace(parts.observer, **of_observer(gains)))
    each = _each(gains, list(getattr(parts.observer, "gain", ())))
    if each is not None:
        parts = replace(parts, observer=replace(parts.observer, gain=jnp.stack(each)))
    if "filter_bandwidth" in gains:
        known: Any = parts
        sensors = known.sensors.with_bandwidth(gains["filter_bandwidth"], known.clock.period)
        parts = replace(parts, sensors=sensors)
    if "command_corner" in gains:
        assert parts.command_filter is not None
        parts = replace(parts, command_filter=replace(parts.command_filter, corner=gains["command_corner"]))
    _check_clock(parts)
    return parts


def _check_clock(parts: Parts) -> None:
    clock: Any = parts.clock
    law = parts.controller
    if not clock.anchored:
        return
    times = [law.t_f, law.delta, parts.t_end, clock.period]
    if any(isinstance(v, core.Tracer) or np.ndim(v) > 0 for v in times):
        return
    t_f, delta, t_end, period = map(float, times)
    hand_over = t_f - delta
    for where, needed, samples in (("before", hand_over, clock.before), ("after", t_end - hand_over, clock.after)):
        if needed > samples * period * (1.0 + 1e-9):
            raise ValueError(
                f"t_f = {t_f:g} s with delta = {delta:g} s needs {needed:g} s of samples {where} the hand-over, but "
                f"the parts' clock has {samples * period:g}; make the parts for them, with ptsmc_jax.replace or with "
                "the reach of scenario.study"
            )


def gains_of(parts: Parts) -> dict[str, float]:
    """Every gain of the parts by name; the observer's also axis by axis, `observer_gain` then being their mean."""
    controller = parts.controller
    law = [name for name in controller.tunable if name not in ("k1", "sign_width", "surface_rate", "t_f")]
    gains = {name: float(getattr(controller, name)) for name in law}
    each = [float(v) for v in getattr(parts.observer, "gain", ())]
    if each:
        gains["observer_gain"] = sum(each) / len(each)
    gains |= {f"observer_{name}": float(getattr(parts.observer, name)) for name in parts.observer.tunable}
    gains |= {name: float(getattr(controller, name)) for name in controller.tunable if name not in law}
    if getattr(parts.sensors, "filter", None) is not None:
        gains["filter_bandwidth"] = float(parts.sensors.bandwidth(parts.clock.period))  # pyright: ignore[reportAttributeAccessIssue]
    if parts.command_filter is not None:
        gains["command_corner"] = float(parts.command_filter.corner)
    return {**gains, **{f"{_AXIS}{k + 1}": v for k, v in enumerate(each) if len(set(each)) > 1}}


def own(parts: Parts, names: tuple[str, ...]) -> list[float]:
    """The parts' own values of these gains."""
    gains, each = gains_of(parts), getattr(parts.observer, "gain", ())
    return [float(each[int(name.removeprefix(_AXIS)) - 1]) if name != base(name) else gains[name] for name in names]


def in_scenario(scenario: Scenario, gains: Mapping[str, float]) -> Scenario:
    """The scenario with other gains, checked; all else stays, defaults too, and with another t_f the time after it."""
    changes: dict[str, Any] = {f"controller__{name}": value for name, value in of_law(gains).items()}
    changes |= {f"observer__{name}": value for name, value in of_observer(gains).items()}
    each = _each(gains, list(getattr(scenario.observer, "gain", ())))
    if each is not None:
        changes["observer__gain"] = each
    if "filter_bandwidth" in gains:
        changes["filter__bandwidth"] = gains["filter_bandwidth"]
    if "command_corner" in gains:
        table = scenario.devices.command_filter
        assert table is not None
        changes["hardware__command_filter"] = {**plain(table), "corner": gains["command_corner"]}
    if "t_f" in gains:
        assert scenario.loop.t_end is not None
        changes["loop__t_end"] = gains["t_f"] + (scenario.loop.t_end - scenario.controller.t_f)
    return scenarios.replace(reading.settled(scenario), **changes)


def of_paper(scenario: Scenario) -> dict[str, float]:
    """The paper's gains for this plant: its Case I, or eta = n + 1 as in Figs. 1 and 2; a smooth sign 1e-3 wide.

    delta is a period or more, and half of t_f or less where a period is; the observer's gain is that of this body.
    """
    shortest = scenario.loop.period if scenario.loop.mode == "sampled" else 0.0
    delta = max(min(0.05, 0.5 * scenario.controller.t_f), shortest)
    gains = {"eta": 3.0, "delta": delta, "k1": 1.0, "sign_width": 1e-3, "surface_rate": 1.0}
    if scenario.motion == "chain":
        gains["eta"] = scenario.order + 1.0
    gain = {"observer_gain": disturbance_bounds.observer_gain(scenario)}
    return {**gains, **gain} if scenario.observer.kind == "nonlinear" else gains


def papers(scenario: Scenario) -> Scenario:
    """The scenario under the paper's law with the paper's gains for its plant."""
    table, own = scenario.controller, of_paper(scenario)
    if not table.prescribed:
        kept = {key: getattr(table, key) for key in BaselineTable.__struct_fields__}
        law = {"kind": "prescribed_time", "error": "multiplicative", **kept, "delta": own["delta"]}
        scenario = scenarios.replace(scenario, tune=None, controller=law)
    return in_scenario(scenario, own)


def differ(one: Scenario, other: Scenario) -> bool:
    """Whether two scenarios fly another law or other gains."""
    return any(getattr(one, name) != getattr(other, name) for name in ("controller", "observer", "estimator"))


def _each(gains: Mapping[str, Any], own: list[Any]) -> list[Any] | None:
    """The observer's gain on every axis, where these gains name one."""
    if not any(base(name) == "observer_gain" for name in gains):
        return None
    common = [gains.get("observer_gain", value) for value in own]
    return [gains.get(f"{_AXIS}{k + 1}", value) for k, value in enumerate(common)]
