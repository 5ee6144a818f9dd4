"""The flight computer of the sampled loop: in a control period it measures, estimates the disturbance and commands.

One period of it is `decide`, which the rollout flies and `linear` differentiates.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from ptsmc_jax.devices.actuators import Actuators, ActuatorState, Drive
from ptsmc_jax.devices.ticks import Ticks
from ptsmc_jax.laws.base import Sample
from ptsmc_jax.numerics.draws import WholeNumber
from ptsmc_jax.numerics.pytrees import Scalar
from ptsmc_jax.simulation.assembly import Parts


class Computer(NamedTuple):
    """What a flight computer carries from sample to sample."""

    sensing: Any  # memory of the sensors
    seen: Any  # state as the law saw it at the last sample
    memory: Any  # of the observer
    law: Any  # memory of the law; None where it has none
    # what its actuators did in the last period: mean torque [N m], and momentum of the wheels in it [N m s]
    applied: tuple[Array, Array | None] | None  # None: kept elsewhere
    filtered: Any = None  # memory of the command's filter; None without one


class Decision(NamedTuple):
    """What a flight computer makes of a sample."""

    target: Any  # what the reference is then
    d_hat: Array  # (m,) [N m]
    u: Array  # (m,) commanded torque, behind its filter [N m]
    s: Array  # sliding variable
    w: Array  # (m,) velocity as it is seen [rad/s]
    channels: Array | None = None  # (channels,) torque that software with limits and wheels of its own allots [N m]


class Software(NamedTuple):
    """A flight computer, as the rollout flies it: `boot` and `decide`, or what stands for them."""

    boot: Callable[..., Computer]  # (parts, seed, trial, x0, first)
    decide: Callable[..., tuple[Decision, Computer]]  # (parts, k2, period, computer, x, what the actuators carry)


class Period(NamedTuple):
    """A control period, and what the observer needs of the one before."""

    now: Ticks
    dt_before: Scalar  # length of the one before [s]
    matrix: Array  # `Observer.update_matrix` of that length
    within: Any = None  # see `seen_within`, of the one before

    @property
    def length(self) -> Scalar:
        """Length of the control period [s]."""
        return self.now.t_next - self.now.t


def schedule(parts: Parts, ticks: Ticks) -> tuple[tuple, Callable[[tuple], Period], Ticks]:
    """Control periods as a scan takes them, what makes a `Period` of one, and the first that has a length."""
    lengths = ticks.t_next - ticks.t
    length_before = jnp.concatenate([jnp.zeros(1), lengths[:-1]])
    partial_before = jnp.concatenate([jnp.zeros(1), ticks.noise_weight[:-1]]) < 1.0
    # the observer's matrix for a whole period and for the partial first one, outside the loop
    matrix = parts.observer.update_matrix(parts.period)
    first_length = jnp.sum(jnp.where(ticks.noise_weight < 1.0, lengths, 0.0))
    first_matrix = parts.observer.update_matrix(first_length)

    def about(tick: tuple) -> Period:
        now, dt_before, partial = tick
        return Period(now, dt_before, jnp.where(partial, first_matrix, matrix))

    started = jax.tree.map(lambda v: v[jnp.argmax(lengths > 0.0)], ticks)
    return (ticks, length_before, partial_before), about, started


def boot(parts: Parts, seed: WholeNumber, trial: WholeNumber, x0: Any, first: Ticks) -> Computer:
    """A flight computer before its first sample; x0: what sensors without noise see of the true state."""
    sensing = None if parts.sensors is None else parts.sensors.begin(seed, trial, x0, first)
    none = jnp.zeros(parts.plant.inputs)
    wheels = parts.actuators is not None and parts.actuators.wheels is not None
    applied = none, none if wheels else None
    filtered = None if parts.command_filter is None else parts.command_filter.begin(parts.plant.inputs)
    return Computer(sensing, x0, parts.observer.begin(), parts.controller.begin(), applied, filtered)


def measure(parts: Parts, period: Period, computer: Computer, x: Any) -> tuple[Any, Any]:
    """The state as the sensors see it at the start of a period, and their memory; x: as in `decide`."""
    if parts.sensors is None:
        return x, None
    more = () if period.within is None else (period.within,)
    return parts.sensors.measure(computer.sensing, x, period.now, period.dt_before, *more)


def seen_within(parts: Parts, now: Ticks, until: Callable[[Scalar], Any]) -> Any:
    """What sensors without noise see at a time of their own in a period, and say at the next sample; None: nothing.

    until: time [s] in the period -> the plant's state then.
    """
    if getattr(parts.sensors, "own_times", None) is None:
        return None
    return parts.plant.visible(until(now.t_next - parts.sensors.star_age(now.sample + 1, now.t_next - now.t)))


def estimate(parts: Parts, period: Period, computer: Computer, seen: Any) -> tuple[Array, Any]:
    """The disturbance (m,) [N m] by what the last period did to the state, and the observer's memory."""
    observer, model, dt = parts.observer, parts.observer.model, period.dt_before
    assert computer.applied is not None
    torque, stored = computer.applied
    if stored is not None:  # w x h of the wheels, by the mean rate
        torque = torque - jnp.cross((model.velocity(computer.seen) + model.velocity(seen)) / 2, stored)
    impulse = model.unexplained_impulse(period.now.t, computer.seen, seen, torque, dt)
    memory = observer.update(period.matrix, computer.memory, impulse, period.now.t, dt)
    memory = _kept(dt > 0.0, memory, computer.memory)
    return observer.estimate(memory), memory


def command(
    parts: Parts, k2: Any, period: Period, computer: Computer, seen: Any, target: Any, d_hat: Array
) -> tuple[Array, Array, Any]:
    """The law's torque (m,) [N m], its sliding variable and its memory; k2: its K2(t) [s]."""
    now, flown = period.now, period.length > 0.0
    # a length that one may divide by, also in a period that is none
    sample = Sample(now.t, now.hold, jnp.where(flown, period.length, parts.period))
    u, s, memory = parts.controller.command(computer.law, sample, seen, target, d_hat, k2(now.t))
    return u, s, _kept(flown, memory, computer.law)


def filtered(parts: Parts, period: Period, computer: Computer, u: Array) -> tuple[Array, Any]:
    """What the command's filter lets through of the law's torque (m,) [N m], and its memory."""
    if parts.command_filter is None:
        return u, computer.filtered
    u, memory = parts.command_filter.step(computer.filtered, u, period.dt_before, period.length)
    return u, _kept(period.length > 0.0, memory, computer.filtered)


def decide(parts: Parts, k2: Any, period: Period, computer: Computer, x: Any) -> tuple[Decision, Computer]:
    """The flight software in a control period: sensors, observer, law, filter of its command; k2: its K2(t) [s].

    x: what sensors without noise see of the true state, `Plant.visible`.
    `applied` of the computer that comes back is the old one: what the period's command brings about is not known yet.
    """
    target = parts.reference(period.now.t)
    seen, sensing = measure(parts, period, computer, x)
    d_hat, memory = estimate(parts, period, computer, seen)
    u, s, law = command(parts, k2, period, computer, seen, target, d_hat)
    u, kept = filtered(parts, period, computer, u)
    decision = Decision(target, d_hat, u, s, parts.observer.model.velocity(seen))
    return decision, Computer(sensing, seen, memory, law, computer.applied, kept)


def _decide(parts: Parts, k2: Any, period: Period, computer: Computer, x: Any, acting: ActuatorState) -> tuple:
    del acting  # it is told what they did
    return decide(parts, k2, period, computer, x)


OURS = Software(boot, _decide)


def _kept(flown: Array, new: Any, old: Any) -> Any:
    """A memory after a period; one without length changes none."""
    return jax.tree.map(lambda one, other: jnp.where(flown, one, other), new, old)


def brought_about(actuators: Actuators, drive: Drive, dt: Scalar) -> tuple[Array, Array | None]:
    """What the flight software knows of what its actuators did in a period."""
    push = actuators.assumed(drive, dt)
    return push.mean, push.middle
