"""Read and set the gains of parts by name, with a table of the path of each gain. Start with `with_gains`.

The observer gain has a value for each axis: `observer_gain_1` is its first one, and `observer_gain` sets all of them.
"""

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import core
from jaxtyping import Array

from ptsmc_jax import declare
from ptsmc_jax.numerics import paths
from ptsmc_jax.simulation.assembly import Parts, check_parts

OBSERVER_GAIN, AXIS = "observer_gain", "observer_gain_"
BANDWIDTH, T_F = "sensors.filter.bandwidth", "controller.t_f"  # each of these gains changes several fields of the parts
# reports list these gains of the law after the gains of the observer, its other gains before them
LISTED_LAST = ("k1", "sign_width", "surface_rate", "t_f")
REBUILD_ADVICE = "build the parts for them, with ptsmc_jax.replace or with the argument reach of scenario.study"


def base(name: str) -> str:
    """Return the gain that a name belongs to: `observer_gain` for `observer_gain_2`."""
    return OBSERVER_GAIN if name.startswith(AXIS) and name.removeprefix(AXIS).isdecimal() else name


def is_reserved(name: str) -> bool:
    """Return whether a name is reserved for gains of the observer, the sensors or a filter. No law may use it."""
    return name.startswith(("observer_", "sensors_")) or name in ("filter_bandwidth", "command_corner")


def paths_of(parts: Parts) -> dict[str, str]:
    """Return the path of every gain by its name, such as `{"eta": "controller.eta"}`, in the order of reports.

    Raises:
        ValueError: the law and another part have a gain of the same name.
    """
    law = {name: f"controller.{name}" for name in parts.controller.tunable}
    axes = {f"{AXIS}{k + 1}": f"observer.gain[{k}]" for k in range(len(getattr(parts.observer, "gain", ())))}
    observer = {OBSERVER_GAIN: "observer.gain"} if axes else {}
    observer |= {f"observer_{name}": f"observer.{name}" for name in parts.observer.tunable}
    custom = getattr(parts.sensors, "custom", None)
    devices = {f"sensors_{name}": f"sensors.custom.{name}" for name in getattr(custom, "tunable", ())}
    if hasattr(parts.sensors, "with_bandwidth") and parts.sensors.filter is not None:  # a Kalman filter has no gains
        devices["filter_bandwidth"] = BANDWIDTH
    if parts.command_filter is not None:
        devices["command_corner"] = "command_filter.corner"
    for name in law.keys() & (observer | devices | axes).keys():
        raise ValueError(f"{name} is a gain of the law and of another part; rename the gain of the law")
    last = {name: law.pop(name) for name in parts.controller.tunable if name in LISTED_LAST}
    return {**law, **observer, **last, **devices, **axes}


def _gain_at(parts: Parts, path: str) -> Any:
    """Return the gain at a path of the parts."""
    return parts.sensors.bandwidth(parts.period) if path == BANDWIDTH else paths.get(parts, path)


def _with_gain_at(parts: Parts, path: str, value: Any) -> Parts:
    """Return the parts with another gain at a path; one observer gain is used for all axes."""
    if path == BANDWIDTH:
        return replace(parts, sensors=parts.sensors.with_bandwidth(value, parts.period))
    if path == T_F:
        return parts.with_t_f(value)
    if path == "observer.gain":
        value = jnp.stack([value] * len(parts.observer.gain))
    return paths.put(parts, path, value)


def check_mapping(gains: object) -> None:
    """Raise TypeError if gains are not a mapping from names to values."""
    if not isinstance(gains, Mapping):
        raise TypeError(f"gains are needed by name, such as {{'eta': 3.0}}, but this is a {type(gains).__name__}")


def with_gains(parts: Parts, gains: Mapping[str, Array | float]) -> Parts:
    """Return the parts with other gains. `observer_gain` sets all axes; `t_f` moves the end of the run with it.

    The conditions of a law's theorems, such as eta > 2, are not checked here. Scenarios check them, see `in_scenario`.

    Args:
        parts: the parts that have these gains.
        gains: scalars by name [units as in the scenario].

    Raises:
        ValueError: a name is unknown, a value is no finite number, or the clock of the parts has too few samples or
            steps for the new times. Under a JAX transformation the run has the status `incomplete` instead.
        TypeError: the first argument is not the parts of a run, or `gains` is not a mapping.
    """
    check_parts(parts)
    check_mapping(gains)
    gain_paths = {"t_f": T_F, **paths_of(parts)}
    for name in gains:
        if name not in gain_paths:
            is_number = name in declare.declared(type(parts.controller))
            reason = ", because it is declared by ptsmc_jax.number" if is_number else ""
            raise ValueError(f"{name} is no gain of these parts{reason}; allowed are {', '.join(sorted(gain_paths))}")
    numbers = {name: _convert_gain(name, value) for name, value in gains.items()}
    for name, path in gain_paths.items():  # gains of single axes are last, so that they override the gain of all axes
        if name in numbers:
            parts = _with_gain_at(parts, path, numbers[name])
    _check_clock(parts)
    return parts


def _convert_gain(name: str, value: Any) -> Array:
    """Return a gain as an array. Raises ValueError if it is not a finite scalar. JAX would accept strings, too."""
    try:
        if isinstance(value, str | bytes | bool) or value is None:
            raise TypeError
        number = jnp.asarray(value, float)
    except TypeError:
        raise ValueError(f"{name} is {value!r}, but must be a number") from None
    if not (isinstance(number, core.Tracer) or np.isfinite(number).all()):
        raise ValueError(f"{name} is {value!r}, but must be a finite number")
    if number.ndim:
        advice = f"{AXIS}1, {AXIS}2, .. set single axes" if name == OBSERVER_GAIN else "jax.vmap takes one at a time"
        raise ValueError(f"{name} must be a number, but has shape {number.shape}; {advice}")
    return number


def _check_clock(parts: Parts) -> None:
    """Raise ValueError if a clock has too few samples or steps for t_f and delta. Traced values are not checked."""
    clock, law = parts.clock, parts.controller
    longest_step = clock.period if clock.sampled else clock.max_step  # [s]
    times = [law.t_f, law.delta, parts.t_end, longest_step]
    if any(isinstance(v, core.Tracer) or np.ndim(v) > 0 for v in times):
        return
    t_f, delta, t_end, longest_step = map(float, times)
    # plain numbers, because JAX arrays would become tracers if another gain is traced
    if not clock.sampled and replace(clock, max_step=longest_step).is_too_coarse(t_f, delta, np):
        raise ValueError(
            f"t_f = {t_f:g} s with delta = {delta:g} s needs more than the {clock.before} steps that the parts' "
            f"continuous loop has before the hand-over; {REBUILD_ADVICE}"
        )
    if clock.sampled and t_end > (clock.count - 1) * longest_step * (1.0 + 1e-9):
        covered = (clock.count - 1) * longest_step
        raise ValueError(
            f"t_f = {t_f:g} s needs {t_end:g} s of samples, but the parts' clock has {covered:g}; {REBUILD_ADVICE}"
        )


def present_values(parts: Parts, names: Iterable[str]) -> list[float]:
    """Return the present values of these gains. For `observer_gain` it is the mean of the axes."""
    gain_paths, values = paths_of(parts), list[float]()
    for name in names:
        value = np.ravel(_gain_at(parts, gain_paths[name])).tolist()
        values.append(sum(value) / len(value))
    return values


def gains_of(parts: Parts) -> dict[str, float]:
    """Return every gain of the parts by name. Gains of single axes are listed if they differ."""
    check_parts(parts)
    names = [*paths_of(parts)]
    gains = dict(zip(names, present_values(parts, names), strict=True))
    axes = [name for name in names if base(name) != name]
    axes_are_equal = len({gains[name] for name in axes}) <= 1
    return {name: value for name, value in gains.items() if not (axes_are_equal and name in axes)}


def gain_of_each_axis(gains: Mapping[str, Any], current_gains: list[Any]) -> list[Any] | None:
    """Return the new or else the current observer gain of every axis, or None if `gains` has no observer gain.

    Args:
        gains: new values by name.
        current_gains: current observer gain of each axis, used for an axis without a new value.
    """
    if not any(base(name) == OBSERVER_GAIN for name in gains):
        return None
    return [gains.get(f"{AXIS}{k + 1}", gains.get(OBSERVER_GAIN, value)) for k, value in enumerate(current_gains)]
