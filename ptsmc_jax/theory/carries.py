"""What the sampled loop carries from sample to sample, and local coordinates of it, in which `linear` has the loop."""

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
    """What the loop carries from sample to sample."""

    x: Any  # true state of the plant
    acting: ActuatorState  # true state of the actuators, without commands on their way
    computer: Computer
    model: ActuatorState  # the flight computer's own of its actuators, with them; momentum it measures

    @classmethod
    def of(cls, state: State) -> "Carry":
        """Return the carry of a state of the sampled loop, whose actuators are as the flight computer knows them."""
        actuators, computer = state.actuators, state.computer._replace(applied=state.applied)
        return cls(state.x, actuators._replace(queue=None), computer, actuators._replace(h=None))


class _Stored:
    """Coordinates (wheels,) of the momenta that wheels store, the total angular momentum among them.

    No command changes that: in inertial axes it stays as it is. In body axes it turns, and a period of its turning
    alone, taken to go on for ever, would look as if commands changed it a little.
    """

    def __init__(self, parts: Parts, x: Any, h: Array):
        self._h, self._on_body = h, parts.actuators.on_body
        self._plant: Any = parts.plant  # a spacecraft, which has a momentum
        self._total_there = self._total(x, h)

    def _inverse(self, momentum: Array) -> Array:
        """The smallest momenta (wheels,) that make this one (3,) [N m s]."""
        axes = jax.vmap(self._on_body, out_axes=1)(jnp.eye(self._h.size))
        return axes.T @ matrices.solve(axes @ axes.T, momentum)

    def _total(self, x: Any, h: Array) -> Array:
        """The angular momentum (3,) of the body and the wheels [N m s], in the axes that its attitude turns from."""
        return attitude.rotate(x.q, self._plant.momentum(x) + self._on_body(h))

    def retract(self, x: Any, z: Array) -> Array:
        """The momenta (wheels,) [N m s] that have these coordinates where the true state is x."""
        near, total = self._h + z, self._total_there + self._on_body(z)
        wanted = attitude.rotate(attitude.conjugate(x.q), total) - self._plant.momentum(x)
        return near + self._inverse(wanted - self._on_body(near))

    def local_coordinates(self, x: Any, h: Array) -> Array:
        """The coordinates of momenta (wheels,) [N m s] and a true state."""
        apart = h - self._h
        return apart + self._inverse(self._total(x, h) - self._total_there - self._on_body(apart))


class Local:
    """Local coordinates z of carries about one: x, the state last seen, sensors' memory, wheels' momenta, the rest."""

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
        """The carry that has these coordinates (n,)."""
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
        """The coordinates (n,) of a carry."""
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
    """The numbers of a memory, of sensors or a law, that can change by a little."""
    return [v for v in jax.tree.leaves(memory) if jnp.issubdtype(jnp.result_type(v), jnp.floating)]


def _with_numbers(memory: Any, numbers: list[Array]) -> Any:
    leaves, structure = jax.tree.flatten(memory)
    new = iter(numbers)
    leaves = [next(new) if jnp.issubdtype(jnp.result_type(v), jnp.floating) else v for v in leaves]
    return jax.tree.unflatten(structure, leaves)
