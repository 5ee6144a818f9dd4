"""The flight computer of the sampled loop: in a control period it measures, estimates the disturbance and commands.

One period of it is `decide`, which the rollout flies and `linear` differentiates.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ptsmc_jax.devices.actuators import Actuators, Drive
from ptsmc_jax.devices.ticks import Ticks
from ptsmc_jax.laws.base import Sample
from ptsmc_jax.numerics.draws import Whole
from ptsmc_jax.simulation.assembly import Parts

Scalar = Float[Array, ""]


class Computer(NamedTuple):
    """What a flight computer carries from sample to sample."""

    sensing: Any  # memory of the sensors
    seen: Any  # state as the law saw it at the last sample
    memory: Any  # of the observer
    law: Any  # memory of the law; None where it has none
    # what the observer is told of the last period: mean torque [N m], and momentum of the wheels in it [N m s]
    told: tuple[Array, Array | None] | None  # None: kept elsewhere


class Decision(NamedTuple):
    """What a flight computer makes of a sample."""

    target: Any  # what the reference is then
    d_hat: Array  # (m,) [N m]
    u: Array  # (m,) commanded torque [N m]
    s: Array  # sliding variable
    w: Array  # (m,) velocity as it is seen [rad/s]


class Period(NamedTuple):
    """A control period, and what the observer needs of the one before."""

    now: Ticks
    dt_before: Scalar  # length of the one before [s]
    matrix: Array  # `Observer.update_matrix` of that length

    @property
    def length(self) -> Scalar:
        """Of the control period [s]."""
        return self.now.t_next - self.now.t


def schedule(parts: Parts, ticks: Ticks) -> tuple[tuple, Callable[[tuple], Period], Ticks]:
    """Control periods as a scan takes them, what makes a `Period` of one, and the first that has a length."""
    lengths = ticks.t_next - ticks.t
    length_before = jnp.concatenate([jnp.zeros(1), lengths[:-1]])
    partial_before = jnp.concatenate([jnp.zeros(1), ticks.noise_weight[:-1]]) < 1.0
    # the observer's matrix for a whole period and for the partial first one, outside the loop
    matrix = parts.observer.update_matrix(parts.clock.period)  # pyright: ignore[reportAttributeAccessIssue]
    first_length = jnp.sum(jnp.where(ticks.noise_weight < 1.0, lengths, 0.0))
    first_matrix = parts.observer.update_matrix(first_length)

    def about(tick: tuple) -> Period:
        now, dt_before, partial = tick
        return Period(now, dt_before, jnp.where(partial, first_matrix, matrix))

    started = jax.tree.map(lambda v: v[jnp.argmax(lengths > 0.0)], ticks)
    return (ticks, length_before, partial_before), about, started


def boot(parts: Parts, seed: Whole, trial: Whole, x0: Any, first: Ticks) -> Computer:
    """A flight computer before its first sample; x0: the true state."""
    sensing = None if parts.sensors is None else parts.sensors.begin(seed, trial, x0, first)
    none = jnp.zeros(parts.plant.inputs)
    wheels = parts.actuators is not None and parts.actuators.wheels is not None
    told = none, none if wheels else None
    return Computer(sensing, x0, parts.observer.begin(), parts.controller.begin(), told)


def decide(parts: Parts, k2: Any, period: Period, computer: Computer, x: Any) -> tuple[Decision, Computer]:
    """The flight software in a control period: sensors, observer, law; k2: its K2(t) [s]; x: the true state.

    `told` of the computer that comes back is the old one: what the period's command brings about is not known yet.
    """
    now, dt_before, matrix = period
    law, observer, sensors = parts.controller, parts.observer, parts.sensors
    model, target = observer.model, parts.reference(now.t)
    seen, sensing = (x, None) if sensors is None else sensors.measure(computer.sensing, x, now, dt_before)
    w = parts.plant.velocity(seen)
    assert computer.told is not None
    applied, stored = computer.told
    if stored is not None:
        applied = applied - jnp.cross((parts.plant.velocity(computer.seen) + w) / 2, stored)
    impulse = model.unexplained_impulse(now.t, computer.seen, seen, applied, dt_before)
    memory = observer.update(matrix, computer.memory, impulse, now.t, dt_before)
    memory = _kept(dt_before > 0.0, memory, computer.memory)
    d_hat = observer.estimate(memory)
    flown = period.length > 0.0
    # a length that one may divide by, also in a period that is none
    sample = Sample(now.t, now.hold, jnp.where(flown, period.length, parts.clock.period))  # pyright: ignore[reportAttributeAccessIssue]
    u, s, kept = law.command(computer.law, sample, seen, target, d_hat, k2(now.t))
    kept = _kept(flown, kept, computer.law)
    return Decision(target, d_hat, u, s, w), Computer(sensing, seen, memory, kept, computer.told)


def _kept(flown: Array, new: Any, old: Any) -> Any:
    """A memory after a period; one without length changes none."""
    return jax.tree.map(lambda one, other: jnp.where(flown, one, other), new, old)


def told(actuators: Actuators, drive: Drive, dt: Scalar) -> tuple[Array, Array | None]:
    """What the flight software knows of what its actuators did in a period."""
    push = actuators.over(drive, jnp.zeros_like(dt), dt)
    return push.mean, push.middle
