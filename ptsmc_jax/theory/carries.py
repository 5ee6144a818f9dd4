"""State of the sampled loop between two samples, and its local coordinates, which `linear` uses to linearise the loop.

Read `Carry` first, then `Local`.
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
    acting: ActuatorState  # true state of the actuators, without delayed commands
    computer: Computer
    model: ActuatorState  # actuator state in the flight computer's model, with delayed commands, without momentum

    @classmethod
    def of(cls, state: State) -> "Carry":
        """Return the carry of a simulated state, assuming that the actuator model of the flight computer is exact."""
        actuators, computer = state.actuators, state.computer._replace(applied=state.applied)
        return cls(state.x, actuators._replace(queue=None), computer, actuators._replace(h=None))


class _Stored:
    """Local coordinates (wheels,) of the wheels' momenta, which represent the total angular momentum in inertial axes.

    Commands do not change the total angular momentum, which is constant in inertial axes. In body axes it rotates with
    the attitude. A linearisation of one period would then wrongly show that commands change it.
    """

    def __init__(self, parts: Parts, x: Any, h: Array):
        self._h, self._on_body = h, parts.actuators.on_body
        self._plant: Any = parts.plant  # a spacecraft, because only spacecraft have wheels and a method `momentum`
        self._total_there = self._total(x, h)

    def _inverse(self, momentum: Array) -> Array:
        """Return the wheel momenta (wheels,) of least norm with this total (3,) [N m s]."""
        axes = jax.vmap(self._on_body, out_axes=1)(jnp.eye(self._h.size))
        return axes.T @ matrices.solve(axes @ axes.T, momentum)

    def _total(self, x: Any, h: Array) -> Array:
        """Return the angular momentum (3,) of body and wheels in inertial axes [N m s]."""
        return attitude.rotate(x.q, self._plant.momentum(x) + self._on_body(h))

    def retract(self, x: Any, z: Array) -> Array:
        """Return the wheel momenta (wheels,) [N m s] with coordinates z (wheels,) at the true state x."""
        near, total = self._h + z, self._total_there + self._on_body(z)
        wheel_momentum = attitude.rotate(attitude.conjugate(x.q), total) - self._plant.momentum(x)
        return near + self._inverse(wheel_momentum - self._on_body(near))

    def local_coordinates(self, x: Any, h: Array) -> Array:
        """Return the coordinates (wheels,) of wheel momenta h (wheels,) [N m s] at the true state x."""
        apart = h - self._h
        return apart + self._inverse(self._total(x, h) - self._total_there - self._on_body(apart))


class Local:
    """Local coordinates z (n,) of carries near a base carry.

    The blocks of lengths `sizes` are: plant state, last seen state, sensor memory, wheel momenta, all other floats.
    """

    def __init__(self, parts: Parts, base: Carry):
        self._plant, self._model, self._sensors = parts.plant, parts.observer.model, parts.sensors
        self._base = base
        self._turned = hasattr(parts.sensors, "retract")
        start = parts.plant.local_coordinates(base.x, base.x)
        known = self._model.local_coordinates(base.computer.seen, base.computer.seen)
        sensing = base.computer.sensors
        inside = parts.sensors.local_coordinates(sensing, sensing) if self._turned else jnp.zeros(0)
        self._stored = None if base.acting.h is None else _Stored(parts, base.x, base.acting.h)
        rest, self._unravel = ravel_pytree(self._rest(base))
        stored = 0 if base.acting.h is None else base.acting.h.size
        self.sizes = [start.size, known.size, inside.size, stored, rest.size]

    def _rest(self, carry: Carry) -> Any:
        computer = carry.computer
        sensing = None if self._turned else _numbers(computer.sensors)
        own = _numbers(computer.law), computer.command_filter
        return carry.acting.v, computer.observer, computer.applied, carry.model, sensing, *own

    def retract(self, z: Array) -> Carry:
        """Return the carry with coordinates z (n,)."""
        x, seen, sensing, stored, rest = jnp.split(z, np.cumsum(self.sizes)[:-1])
        base, plant = self._base, self._plant
        near = jax.tree.map(jnp.add, self._rest(base), self._unravel(rest))
        v, memory, applied, model, numbers, law, filtered = near
        x = plant.retract(base.x, x)
        acting = base.acting._replace(v=v, h=None if self._stored is None else self._stored.retract(x, stored))
        inside = base.computer.sensors
        inside = self._sensors.retract(inside, sensing) if self._turned else _with_numbers(inside, numbers)
        law = _with_numbers(base.computer.law, law)
        computer = Computer(inside, self._model.retract(base.computer.seen, seen), memory, law, applied, filtered)
        return Carry(x, acting, computer, model)

    def local_coordinates(self, other: Carry) -> Array:
        """Return the coordinates (n,) of a carry."""
        base, plant = self._base, self._plant
        seen = self._model.local_coordinates(base.computer.seen, other.computer.seen)
        inside = stored = jnp.zeros(0)
        if self._turned:
            inside = self._sensors.local_coordinates(base.computer.sensors, other.computer.sensors)
        if self._stored is not None:
            assert other.acting.h is not None
            stored = self._stored.local_coordinates(other.x, other.acting.h)
        rest, _ = ravel_pytree(jax.tree.map(jnp.subtract, self._rest(other), self._rest(base)))
        return jnp.concatenate([plant.local_coordinates(base.x, other.x), seen, inside, stored, rest])


def _numbers(memory: Any) -> list[Array]:
    """Return the floating-point leaves of the memory of sensors or of a law."""
    return [v for v in jax.tree.leaves(memory) if jnp.issubdtype(jnp.result_type(v), jnp.floating)]


def _with_numbers(memory: Any, numbers: list[Array]) -> Any:
    """Return the memory with its floating-point leaves replaced by `numbers`."""
    leaves, structure = jax.tree.flatten(memory)
    new = iter(numbers)
    leaves = [next(new) if jnp.issubdtype(jnp.result_type(v), jnp.floating) else v for v in leaves]
    return jax.tree.unflatten(structure, leaves)
