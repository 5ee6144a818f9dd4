"""The gains of parts by name: read, and set in parts, under any transformation.

A gain that has a number for each axis may be named axis by axis, `observer_gain_1` and so on.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import core
from jaxtyping import Array

from ptsmc_jax.simulation.assembly import Parts, check_parts

AXIS = "observer_gain_"
MADE_ANEW = "make the parts for them, with ptsmc_jax.replace or with the reach of scenario.study"
SENSORS = "sensors_"  # prefix of the gains that sensors of one's own have


class _Device(NamedTuple):
    """The gain of a device between the law and the plant."""

    there: Callable[[Parts], bool]
    read: Callable[[Parts], Any]
    write: Callable[[Parts, Any], Parts]


_DEVICES = {
    "filter_bandwidth": _Device(
        lambda parts: getattr(parts.sensors, "filter", None) is not None,
        lambda parts: parts.sensors.bandwidth(parts.period),
        lambda parts, value: replace(parts, sensors=parts.sensors.with_bandwidth(value, parts.period)),
    ),
    "command_corner": _Device(
        lambda parts: parts.command_filter is not None,
        lambda parts: parts.command_filter.corner,
        lambda parts, value: replace(parts, command_filter=replace(parts.command_filter, corner=value)),
    ),
}


def base(name: str) -> str:
    """The gain that a name stands for: `observer_gain` for `observer_gain_2`."""
    of_axis = name.startswith(AXIS) and name.removeprefix(AXIS).isdecimal()  # not one that a part of one's own has
    return "observer_gain" if of_axis else name


def of_observer(gains: Mapping[str, Any]) -> dict[str, Any]:
    """Gains of an observer of one's own, by its fields."""
    return {
        name.removeprefix("observer_"): value
        for name, value in gains.items()
        if name.startswith("observer_") and base(name) != "observer_gain"
    }


def of_sensors(gains: Mapping[str, Any]) -> dict[str, Any]:
    """Gains of sensors of one's own, by their fields."""
    return {name.removeprefix(SENSORS): v for name, v in gains.items() if name.startswith(SENSORS)}


def of_law(gains: Mapping[str, Any]) -> dict[str, Any]:
    """Gains of the law."""
    return {k: v for k, v in gains.items() if not k.startswith(("observer_", SENSORS)) and k not in _DEVICES}


def with_gains(parts: Parts, gains: Mapping[str, Array | float]) -> Parts:
    """The parts with other gains, by name; `observer_gain` is set on all axes, and with t_f the time after it kept.

    Which numbers a law has theorems for is not asked here, as eta > 2; scenarios ask it, see `in_scenario`.

    Raises ValueError where there is no such gain, where one is no finite number, and where the parts' anchored clock
    has too few samples for them, or a continuous loop too few steps before the hand-over, as far as they are known:
    under a transformation such a run comes back as `unfinished`; TypeError where there are no parts.
    """
    check_parts(parts)
    _check_names(parts, gains)
    gains = {name: _number(name, value) for name, value in gains.items()}
    for name, value in gains.items():
        if value.ndim and name == "observer_gain":
            raise ValueError(f"the observer's gain must be a number; {AXIS}1 and so on name those of its axes")
        if value.ndim:
            raise ValueError(f"{name} must be a number, but has shape {value.shape}; jax.vmap takes one at a time")
    if "t_f" in gains:
        parts = parts.with_t_f(gains["t_f"])
    law = {name: value for name, value in of_law(gains).items() if name != "t_f"}
    parts = replace(parts, controller=replace(parts.controller, **law))
    if of_observer(gains):
        parts = replace(parts, observer=replace(parts.observer, **of_observer(gains)))
    axes = on_every_axis(gains, list(getattr(parts.observer, "gain", ())))
    if axes is not None:
        parts = replace(parts, observer=replace(parts.observer, gain=jnp.stack(axes)))
    if of_sensors(gains):
        own_sensors = replace(parts.sensors.own, **of_sensors(gains))
        parts = replace(parts, sensors=replace(parts.sensors, own=own_sensors))
    for name, device in _DEVICES.items():
        if name in gains:
            parts = device.write(parts, gains[name])
    _check_clock(parts)
    return parts


def _number(name: str, value: Any) -> Array:
    """A gain as an array. Raises ValueError where it is known to be none: JAX reads words as numbers, too."""
    try:
        if isinstance(value, str | bytes | bool) or value is None:
            raise TypeError
        number = jnp.asarray(value, float)
    except TypeError:
        raise ValueError(f"{name} is {value!r}, but must be a number") from None
    if not (isinstance(number, core.Tracer) or np.isfinite(number).all()):
        raise ValueError(f"{name} is {value!r}, but must be a finite number")
    return number


def _check_names(parts: Parts, names: Iterable[str]) -> None:
    """Raises ValueError where one of these is no gain of the parts."""
    axes = len(getattr(parts.observer, "gain", ()))
    allowed = {"t_f", *parts.controller.tunable, *(f"observer_{name}" for name in parts.observer.tunable)}
    if axes:
        allowed |= {"observer_gain", *(f"{AXIS}{k + 1}" for k in range(axes))}
    allowed |= {SENSORS + name for name in _tunable_of_sensors(parts)}
    allowed |= {name for name, device in _DEVICES.items() if device.there(parts)}
    for name in names:
        if name not in allowed:
            raise ValueError(f"{name} is no gain of these parts; allowed are {', '.join(sorted(allowed))}")


def _tunable_of_sensors(parts: Parts) -> tuple[str, ...]:
    """Gains of sensors of one's own, by their fields."""
    return getattr(getattr(parts.sensors, "own", None), "tunable", ())


def _check_clock(parts: Parts) -> None:
    """Raises ValueError where a clock has too few samples or steps for t_f and delta, as far as these are known."""
    clock: Any = parts.clock
    law = parts.controller
    longest = clock.period if clock.sampled else clock.max_step  # step
    times = [law.t_f, law.delta, parts.t_end, longest]
    if any(isinstance(v, core.Tracer) or np.ndim(v) > 0 for v in times):
        return
    t_f, delta, t_end, longest = map(float, times)
    # by plain numbers: where another gain is traced, JAX's would be too
    if not clock.sampled and replace(clock, max_step=longest).too_coarse(t_f, delta, np):
        raise ValueError(
            f"t_f = {t_f:g} s with delta = {delta:g} s needs more than the {clock.before} steps that the parts' "
            f"continuous loop has before the hand-over; {MADE_ANEW}"
        )
    if not clock.anchored:
        return
    hand_over = t_f - delta
    for where, needed, samples in (("before", hand_over, clock.before), ("after", t_end - hand_over, clock.after)):
        if needed > samples * longest * (1.0 + 1e-9):
            raise ValueError(
                f"t_f = {t_f:g} s with delta = {delta:g} s needs {needed:g} s of samples {where} the hand-over, but "
                f"the parts' clock has {samples * longest:g}; {MADE_ANEW}"
            )


def gains_of(parts: Parts) -> dict[str, float]:
    """Every gain of the parts by name; the observer's also axis by axis, `observer_gain` then being their mean."""
    check_parts(parts)
    controller = parts.controller
    law = [name for name in controller.tunable if name not in ("k1", "sign_width", "surface_rate", "t_f")]
    gains = {name: float(getattr(controller, name)) for name in law}
    axes = [float(v) for v in getattr(parts.observer, "gain", ())]
    if axes:
        gains["observer_gain"] = sum(axes) / len(axes)
    gains |= {f"observer_{name}": float(getattr(parts.observer, name)) for name in parts.observer.tunable}
    gains |= {name: float(getattr(controller, name)) for name in controller.tunable if name not in law}
    for name in _tunable_of_sensors(parts):
        gains[SENSORS + name] = float(getattr(parts.sensors.own, name))
    gains |= {name: float(device.read(parts)) for name, device in _DEVICES.items() if device.there(parts)}
    return {**gains, **{f"{AXIS}{k + 1}": v for k, v in enumerate(axes) if len(set(axes)) > 1}}


def own(parts: Parts, names: tuple[str, ...]) -> list[float]:
    """The parts' own values of these gains."""
    gains = gains_of(parts)
    axes = {f"{AXIS}{k + 1}": float(value) for k, value in enumerate(getattr(parts.observer, "gain", ()))}
    return [(axes if base(name) != name else gains)[name] for name in names]


def on_every_axis(gains: Mapping[str, Any], own: list[Any]) -> list[Any] | None:
    """The observer's gain on every axis, where these gains name one; own: its values without them."""
    if not any(base(name) == "observer_gain" for name in gains):
        return None
    return [gains.get(f"{AXIS}{k + 1}", gains.get("observer_gain", value)) for k, value in enumerate(own)]
