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
from ptsmc_jax.numerics import attitude, guards
from ptsmc_jax.numerics.draws import WholeNumber
from ptsmc_jax.numerics.pytrees import Scalar
from ptsmc_jax.observers.base import Bound
from ptsmc_jax.simulation.assembly import Parts


class Computer(NamedTuple):
    """The memory of a flight computer between two samples."""

    sensors: Any  # memory of the sensors
    seen: Any  # state as it was measured at the last sample
    observer: Any  # memory of the observer
    law: Any  # memory of the law; None where it has none
    # what its actuators did in the last period: mean torque [N m], and momentum of the wheels in it [N m s]
    applied: tuple[Array, Array | None] | None  # None: the loop has it
    command_filter: Any = None  # memory of the command's filter; None without one


class Decision(NamedTuple):
    """The output of a flight computer at a sample."""

    target: Any  # of the reference at the sample
    d_hat: Array  # (m,) [N m]
    u: Array  # (m,) commanded torque, behind its filter [N m]
    s: Array  # sliding variable
    w: Array  # (m,) velocity as it is measured [rad/s]
    channels: Array | None = None  # (channels,) torque that software with limits and wheels of its own allots [N m]


class Period(NamedTuple):
    """A control period, and what the flight computer needs of the one before."""

    now: Ticks
    dt_before: Scalar  # length of the one before [s]
    matrix: Array  # `Observer.update_matrix` of that length
    full_length: Scalar  # of a whole one [s]
    star_x: Any = None  # `star_state` of the one before

    @property
    def length(self) -> Scalar:
        """Length of the control period [s]."""
        return self.now.t_next - self.now.t

    @property
    def assumed_length(self) -> Scalar:
        """The length that flight software assumes [s]: it does not know that the run ends within its last period."""
        starts = jnp.where(self.now.partial, self.length, self.full_length)
        return jnp.where(self.length > 0.0, starts, 0.0)


# how samples by exported C end, the gravest of its statuses last; other: with one that an export has not
SAMPLES = ("ok", "saturated", "missed", "singular", "input", "overflow", "other")


class Software(NamedTuple):
    """A flight computer, as the rollout flies it: `boot` and `decide`, or other software in their place."""

    boot: Callable[[Parts, WholeNumber, WholeNumber, Any, Ticks], Computer]
    decide: Callable[[Parts, Bound, Period, Computer, Any, ActuatorState], tuple[Decision, Computer]]
    statuses: Callable[[Computer], dict[str, Array]]  # of a run: how many samples ended with each; ours has none
    on_processor: bool = False  # it runs nowhere else


def schedule(parts: Parts, ticks: Ticks) -> tuple[tuple, Callable[[tuple], Period], Ticks]:
    """Control periods as a scan takes them, the function that makes a `Period` of one, and the first with a length."""
    lengths = ticks.t_next - ticks.t
    length_before = jnp.concatenate([jnp.zeros(1), lengths[:-1]])
    partial_before = jnp.concatenate([jnp.ones(1, bool), ticks.partial[:-1]])
    # the observer's matrix for a whole period and for the partial first one, outside the loop, by one piece of code
    first_length = jnp.sum(jnp.where(ticks.partial, lengths, 0.0))
    matrix, first_matrix = jax.lax.map(parts.observer.update_matrix, jnp.stack([parts.period, first_length]))

    def period_of(tick: tuple) -> Period:
        now, dt_before, partial = tick
        return Period(now, dt_before, jnp.where(partial, first_matrix, matrix), parts.period)

    first = jax.tree.map(lambda v: v[jnp.argmax(lengths > 0.0)], ticks)
    return (ticks, length_before, partial_before), period_of, first


def boot(parts: Parts, seed: WholeNumber, trial: WholeNumber, x0: Any, first: Ticks) -> Computer:
    """A flight computer before its first sample; x0: what sensors without noise see of the true state."""
    sensors = None if parts.sensors is None else parts.sensors.begin(seed, trial, x0, first)
    zero = jnp.zeros(parts.plant.inputs)
    wheels = parts.actuators is not None and parts.actuators.wheels is not None
    applied = zero, zero if wheels else None
    command_filter = None if parts.command_filter is None else parts.command_filter.begin(parts.plant.inputs)
    return Computer(sensors, x0, parts.observer.begin(), parts.controller.begin(), applied, command_filter)


def star_state(parts: Parts, now: Ticks, x_at: Callable[[Scalar], Any]) -> Any:
    """The true state when a star tracker with times of its own samples in a period; None: it samples with the computer.

    x_at: time [s] in the period -> the plant's state then. The computer uses it at the next sample.
    """
    if getattr(parts.sensors, "own_times", None) is None:
        return None
    return parts.plant.visible(x_at(now.t_next - parts.sensors.star_age(now.sample + 1, now.t_next - now.t)))


def estimate(parts: Parts, period: Period, computer: Computer, seen: Any) -> tuple[Array, Any]:
    """The disturbance (m,) [N m] by what the last period did to the state, and the observer's memory."""
    observer, model, dt = parts.observer, parts.observer.model, period.dt_before
    assert computer.applied is not None
    torque, stored = computer.applied
    if stored is not None:  # w x h of the wheels, by the mean rate
        torque = torque - attitude.cross((model.velocity(computer.seen) + model.velocity(seen)) / 2, stored)
    impulse = model.unexplained_impulse(period.now.t, computer.seen, seen, torque, dt)
    memory = observer.update(period.matrix, computer.observer, impulse, period.now.t, dt)
    memory = guards.select(dt > 0.0, memory, computer.observer)
    return observer.estimate(memory), memory


def command(
    parts: Parts, k2: Bound, period: Period, computer: Computer, seen: Any, target: Any, d_hat: Array
) -> tuple[Array, Array, Any]:
    """The law's torque (m,) [N m], its sliding variable and its memory."""
    now, has_length = period.now, period.length > 0.0
    # a length that one may divide by, also in a period that has none
    length = jnp.where(has_length, period.assumed_length, period.full_length)
    u, s, memory = parts.controller(Sample(now.t, now.hold, length, computer.law), seen, target, d_hat, k2(now.t))
    return u, s, guards.select(has_length, memory, computer.law)


def decide(
    parts: Parts, k2: Bound, period: Period, computer: Computer, x: Any, actuator_state: ActuatorState | None = None
) -> tuple[Decision, Computer]:
    """The flight software in a control period: sensors, observer, law, filter of its command.

    Args:
        parts: the run's.
        k2: bound K2(t) on the error of the estimate.
        period: which begins.
        computer: the memory.
        x: what sensors without noise see of the true state, `Plant.visible`.
        actuator_state: not used here; software that is not ours may measure it.

    Returns:
        The decision, and the memory but for `applied`, which is still that of the last period.
    """
    target, seen, sensors = parts.reference(period.now.t), x, None
    if parts.sensors is not None:
        seen, sensors = parts.sensors.measure(computer.sensors, x, period.now, period.dt_before, period.star_x)
    d_hat, observer = estimate(parts, period, computer, seen)
    u, s, law = command(parts, k2, period, computer, seen, target, d_hat)
    command_filter = computer.command_filter
    if parts.command_filter is not None:
        u, command_filter = parts.command_filter.step(command_filter, u, period.dt_before, period.assumed_length)
        command_filter = guards.select(period.length > 0.0, command_filter, computer.command_filter)
    decision = Decision(target, d_hat, u, s, parts.observer.model.velocity(seen))
    return decision, Computer(sensors, seen, observer, law, computer.applied, command_filter)


def statuses(computer: Computer) -> dict[str, Array]:
    """How many samples ended with each status: ours have none."""
    return {}


OURS = Software(boot, decide, statuses)


def assumed_torque(actuators: Actuators, drive: Drive, dt: Scalar) -> tuple[Array, Array | None]:
    """`Computer.applied` of a period dt [s]: what the flight software knows of its actuators' torque in it."""
    torque = actuators.assumed(drive, dt)
    return torque.mean, torque.middle
