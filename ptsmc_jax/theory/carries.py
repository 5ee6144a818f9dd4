"""State of the sampled loop between two samples, and its local coordinates, which `linear` uses to linearise the loop.

Read `Carry` first, then `LocalCoordinates`.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array

from ptsmc_jax.devices.actuators import ActuatorState
from ptsmc_jax.numerics import attitude, matrices
from ptsmc_jax.simulation.assembly import Parts
from ptsmc_jax.simulation.computer import Computer
from ptsmc_jax.simulation.control_period import State


class Carry(NamedTuple):
    """Complete state of the sampled loop at a sample."""

    x: Any  # true state of the plant
    actuators: ActuatorState  # true state of the actuators, without delayed commands
    computer: Computer
    actuator_model: ActuatorState  # state of the flight computer's actuator model: with delayed commands, no momentum

    @classmethod
    def from_state(cls, state: State) -> "Carry":
        """Return the carry of a simulated state, assuming that the actuator model of the flight computer is exact."""
        actuators, computer = state.actuators, state.computer._replace(applied=state.applied)
        return cls(state.x, actuators._replace(queue=None), computer, actuators._replace(h=None))


class _WheelCoordinates:
    """Local coordinates (wheels,) of the wheels' momenta, which represent the total angular momentum in inertial axes.

    Commands do not change the total angular momentum, which is constant in inertial axes. In body axes it rotates with
    the attitude, and the linearisation of one period would wrongly show that commands change it.
    """

    def __init__(self, parts: Parts, x: Any, h: Array):
        self._h, self._on_body = h, parts.actuators.on_body
        self._plant: Any = parts.plant  # a spacecraft, because only spacecraft have wheels and a method `momentum`
        self._base_total = self._total_momentum(x, h)

    def _least_norm_momenta(self, momentum: Array) -> Array:
        """Return the wheel momenta (wheels,) of least norm with this total (3,) [N m s]."""
        axes = jax.vmap(self._on_body, out_axes=1)(jnp.eye(self._h.size))
        return axes.T @ matrices.solve(axes @ axes.T, momentum)

    def _total_momentum(self, x: Any, h: Array) -> Array:
        """Return the angular momentum (3,) of body and wheels in inertial axes [N m s]."""
        return attitude.rotate(x.q, self._plant.momentum(x) + self._on_body(h))

    def retract(self, x: Any, z: Array) -> Array:
        """Return the wheel momenta (wheels,) [N m s] with coordinates z (wheels,) at the true state x."""
        estimate, total = self._h + z, self._base_total + self._on_body(z)
        wheel_momentum = attitude.rotate(attitude.conjugate(x.q), total) - self._plant.momentum(x)
        return estimate + self._least_norm_momenta(wheel_momentum - self._on_body(estimate))

    def local_coordinates(self, x: Any, h: Array) -> Array:
        """Return the coordinates (wheels,) of wheel momenta h (wheels,) [N m s] at the true state x."""
        difference = h - self._h
        residual = self._total_momentum(x, h) - self._base_total - self._on_body(difference)
        return difference + self._least_norm_momenta(residual)


class LocalCoordinates:
    """Local coordinates z (n,) of carries near a base carry.

    The blocks of lengths `sizes` are: plant state, last seen state, sensor memory, wheel momenta, all other floats.
    """

    def __init__(self, parts: Parts, base: Carry):
        self._plant, self._model, self._sensors = parts.plant, parts.observer.model, parts.sensors
        self._base = base
        self._has_sensor_coordinates = hasattr(parts.sensors, "retract")
        plant_part = parts.plant.local_coordinates(base.x, base.x)
        seen_part = self._model.local_coordinates(base.computer.seen, base.computer.seen)
        sensor_part, memory = jnp.zeros(0), base.computer.sensors
        if self._has_sensor_coordinates:
            sensor_part = parts.sensors.local_coordinates(memory, memory)
        self._wheels = None if base.actuators.h is None else _WheelCoordinates(parts, base.x, base.actuators.h)
        other_part, self._unravel = ravel_pytree(self._other_floats(base))
        wheels = 0 if base.actuators.h is None else base.actuators.h.size
        self.sizes = [plant_part.size, seen_part.size, sensor_part.size, wheels, other_part.size]

    def _other_floats(self, carry: Carry) -> Any:
        """Return the floats of a carry that no other block has.

        They are actuator torques, observer, applied torque, actuator model, sensors without coordinates, law and
        command filter.
        """
        computer = carry.computer
        sensor_floats = None if self._has_sensor_coordinates else _float_leaves(computer.sensors)
        law_and_filter = _float_leaves(computer.law), computer.command_filter
        device_floats = carry.actuators.v, computer.observer, computer.applied, carry.actuator_model, sensor_floats
        return *device_floats, *law_and_filter

    def retract(self, z: Array) -> Carry:
        """Return the carry with coordinates z (n,)."""
        x, seen, sensor_part, wheel_part, other_part = jnp.split(z, np.cumsum(self.sizes)[:-1])
        base, plant = self._base, self._plant
        floats = jax.tree.map(jnp.add, self._other_floats(base), self._unravel(other_part))
        v, memory, applied, model, sensor_floats, law, filtered = floats
        x = plant.retract(base.x, x)
        momenta = None if self._wheels is None else self._wheels.retract(x, wheel_part)
        actuators = base.actuators._replace(v=v, h=momenta)
        sensors = base.computer.sensors
        if self._has_sensor_coordinates:
            sensors = self._sensors.retract(sensors, sensor_part)
        else:
            sensors = _replace_float_leaves(sensors, sensor_floats)
        law = _replace_float_leaves(base.computer.law, law)
        seen = self._model.retract(base.computer.seen, seen)
        computer = Computer(sensors, seen, memory, law, applied, filtered)
        return Carry(x, actuators, computer, model)

    def local_coordinates(self, other: Carry) -> Array:
        """Return the coordinates (n,) of a carry."""
        base, plant = self._base, self._plant
        seen = self._model.local_coordinates(base.computer.seen, other.computer.seen)
        sensor_part = wheel_part = jnp.zeros(0)
        if self._has_sensor_coordinates:
            sensor_part = self._sensors.local_coordinates(base.computer.sensors, other.computer.sensors)
        if self._wheels is not None:
            assert other.actuators.h is not None
            wheel_part = self._wheels.local_coordinates(other.x, other.actuators.h)
        other_part, _ = ravel_pytree(jax.tree.map(jnp.subtract, self._other_floats(other), self._other_floats(base)))
        return jnp.concatenate([plant.local_coordinates(base.x, other.x), seen, sensor_part, wheel_part, other_part])


def _float_leaves(memory: Any) -> Any:
    """Return the memory of sensors or of a law, with None instead of leaves that are not floating-point numbers."""
    return jax.tree.map(lambda v: v if jnp.issubdtype(jnp.result_type(v), jnp.floating) else None, memory)


def _replace_float_leaves(memory: Any, floats: Any) -> Any:
    """Return the memory with other floating-point leaves, see `_float_leaves`."""
    return jax.tree.map(lambda new, old: old if new is None else new, floats, memory, is_leaf=lambda v: v is None)
