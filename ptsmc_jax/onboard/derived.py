"""Rules that derive parameters of a flight computer from other parameters, such as filter gains from a bandwidth.

The rules call the functions of the library. The export traces them, so that the C updates derived parameters when a
user changes gains or the body. Read `rules` first.
"""

from collections.abc import Callable
from dataclasses import fields, replace
from functools import partial
from typing import Any

import jax.numpy as jnp
import numpy as np

from ptsmc_jax.devices.actuators import Actuators
from ptsmc_jax.devices.attitude_filter import filter_gains
from ptsmc_jax.devices.kalman_filter import KalmanFilter
from ptsmc_jax.numerics import matrices
from ptsmc_jax.numerics.pytrees import Scalar
from ptsmc_jax.simulation.assembly import Parts

Values = dict[str, Any]  # the parameters by name, see `board.board_parameters`
Rule = Callable[[Values], Values]  # maps all parameters to all parameters, with the derived ones recomputed


def rules(parts: Parts) -> list[Rule]:
    """Return the rules for the flight computer of these parts; each uses the result of the rule before it."""
    sensors: Any = parts.sensors
    rules_in_order: list[Rule] = [_derive_inertia_inverses, _derive_observer_values]
    if isinstance(getattr(sensors, "filter", None), KalmanFilter):
        rules_in_order.append(_copy_period)
    elif getattr(sensors, "filter", None) is not None:
        rules_in_order.append(partial(_derive_filter_gains, sensors.every))
    return [*rules_in_order, _derive_wheel_allocation]


def _with_inertia_inverse(model: Any) -> Any:
    """Return a plant model with the inverse of its inertia, if it has such a field."""
    if all(field.name != "inertia_inverse" for field in fields(model)):
        return model
    return replace(model, inertia_inverse=matrices.solve(model.inertia, jnp.eye(model.inputs)))


def _derive_inertia_inverses(values: Values) -> Values:
    """Derive the inverse inertia in the models of the law and the observer."""
    law, observer = values["law"], values["observer"]
    law = replace(law, kinematics=replace(law.kinematics, model=_with_inertia_inverse(law.model)))
    return values | {"law": law, "observer": replace(observer, model=_with_inertia_inverse(observer.model))}


def _derive_observer_values(values: Values) -> Values:
    """Derive the observer's matrix for a period, and K2, the bound on the observer's error."""
    observer = values["observer"]
    return values | {"observer_matrix": observer.update_matrix(values["period"]), "bound": observer.error_bound()}


def _copy_period(values: Values) -> Values:
    """Copy the control period into the Kalman filter and its sensors."""
    estimator, period = values["filter"], values["period"]
    sensors = (replace(sensor, times=replace(sensor.times, period=period)) for sensor in estimator.sensors)
    return values | {"filter": replace(estimator, sensors=tuple(sensors), period=period)}


def _derive_filter_gains(samples_per_reading: int, values: Values) -> Values:
    """Compute the gains of `attitude_filter.filter_gains`, with `expm1` for accuracy in single precision."""
    interval = values.get("star_tracker_interval", values["period"] * samples_per_reading)
    decay = -jnp.expm1(-values["filter_bandwidth"] * interval)  # 1 - p with the pole p of the filter
    estimator = replace(values["filter"], attitude_gain=decay * (2.0 - decay), bias_gain=decay**2 / interval)
    return values | {"filter": estimator}


def _derive_wheel_allocation(values: Values) -> Values:
    """Derive the wheels' allocation from their axes."""
    return values | {"actuators": with_wheel_allocation(values["actuators"])}


def with_wheel_allocation(device: Actuators) -> Actuators:
    """Return actuators with the pseudo-inverse of the wheels' axes, A' (A A')^-1, which span all directions."""
    if device.wheels is None:
        return device
    axes = jnp.asarray(device.wheels.axes)
    allocation = axes.T @ matrices.solve(axes @ axes.T, jnp.eye(len(axes)))
    return replace(device, wheels=replace(device.wheels, allocation=allocation))


def shortest_filter_bandwidth(sensors: Any, period: Scalar) -> np.ndarray:
    """Return the bandwidth of the sensors' attitude filter [rad/s], as the shortest number that gives its gains."""
    exact_bandwidth = float(sensors.bandwidth(period))
    interval = float(period) * sensors.every if sensors.own_times is None else float(sensors.own_times.interval)
    gain = float(sensors.filter.attitude_gain)
    for digits in range(3, 17):
        rounded_bandwidth = float(f"{exact_bandwidth:.{digits}g}")
        if abs(float(filter_gains(rounded_bandwidth, interval)[0]) - gain) < 1e-15:
            return np.asarray(rounded_bandwidth)
    return np.asarray(exact_bandwidth)
