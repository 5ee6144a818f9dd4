"""Rules that derive parameters of a flight computer from other parameters, such as filter gains from a bandwidth.

The rules call the functions of the library. The export traces them, so that the C updates derived parameters when a
user changes gains or the body. Read `rules` first.
"""

from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any

import jax.numpy as jnp
import numpy as np

from ptsmc_jax.devices.actuators import Actuators
from ptsmc_jax.devices.attitude_filter import filter_gains
from ptsmc_jax.devices.kalman_filter import KalmanFilter
from ptsmc_jax.numerics import matrices
from ptsmc_jax.simulation.assembly import Parts

Given = dict[str, Any]  # the parameters, see `board.board`
Rule = Callable[[Given], Given]  # maps all parameters to all parameters, with the derived ones recomputed


def rules(parts: Parts) -> list[Rule]:
    """Return the rules for the flight computer of these parts; each uses the result of the rule before it."""
    found: list[Rule] = [_inertia_inverses, _estimation]
    estimator = getattr(parts.sensors, "filter", None)
    if isinstance(estimator, KalmanFilter):
        found.append(_copied_periods)
    elif estimator is not None:
        found.append(_filtering(parts.sensors))
    if parts.actuators.wheels is not None:
        found.append(_wheel_allocation)
    return found


def _inverse(model: Any) -> Any:
    """Return a plant model with the inverse of its inertia, if it has such a field."""
    if all(field.name != "inertia_inverse" for field in fields(model)):
        return model
    return replace(model, inertia_inverse=matrices.solve(model.inertia, jnp.eye(model.inputs)))


def _inertia_inverses(given: Given) -> Given:
    law, observer = given["law"], given["observer"]
    law = replace(law, kinematics=replace(law.kinematics, model=_inverse(law.model)))
    return given | {"law": law, "observer": replace(observer, model=_inverse(observer.model))}


def _estimation(given: Given) -> Given:
    """Derive the observer's matrix for a period, and K2, the bound on the observer's error."""
    observer = given["observer"]
    return given | {"observer_matrix": observer.update_matrix(given["period"]), "bound": observer.error_bound()}


def _copied_periods(given: Given) -> Given:
    """Copy the control period into the Kalman filter and its sensors."""
    estimator, period = given["filter"], given["period"]
    sensors = (replace(sensor, times=replace(sensor.times, period=period)) for sensor in estimator.sensors)
    return given | {"filter": replace(estimator, sensors=tuple(sensors), period=period)}


def _filtering(sensors: Any) -> Rule:
    every = sensors.every

    def run(given: Given) -> Given:
        """Compute the gains of `attitude_filter.filter_gains`, with `expm1` for accuracy in single precision."""
        interval = given.get("star_tracker_interval", given["period"] * every)
        gone = -jnp.expm1(-given["filter_bandwidth"] * interval)  # 1 - p with the pole p of the filter
        known = replace(given["filter"], attitude_gain=gone * (2.0 - gone), bias_gain=gone**2 / interval)
        return given | {"filter": known}

    return run


def _wheel_allocation(given: Given) -> Given:
    return given | {"actuators": allocated(given["actuators"])}


def allocated(device: Actuators) -> Actuators:
    """Return actuators with the pseudo-inverse of the wheels' axes, A' (A A')^-1, which span all directions."""
    if device.wheels is None:
        return device
    axes = jnp.asarray(device.wheels.axes)
    allocation = axes.T @ matrices.solve(axes @ axes.T, jnp.eye(len(axes)))
    return replace(device, wheels=replace(device.wheels, allocation=allocation))


def bandwidth(sensors: Any, period: Any) -> np.ndarray:
    """Return the bandwidth of the sensors' attitude filter [rad/s], as the shortest number that gives its gains."""
    exact = float(sensors.bandwidth(period))
    interval = float(period) * sensors.every if sensors.own_times is None else float(sensors.own_times.interval)
    gain = float(sensors.filter.attitude_gain)
    for digits in range(3, 17):
        short = float(f"{exact:.{digits}g}")
        if abs(float(filter_gains(short, interval)[0]) - gain) < 1e-15:
            return np.asarray(short)
    return np.asarray(exact)
