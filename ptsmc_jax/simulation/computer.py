"""The flight software of the sampled loop: `decide` measures, estimates the disturbance and commands a torque."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, PyTree

from ptsmc_jax.devices.actuators import ActuatorState
from ptsmc_jax.devices.ticks import Ticks
from ptsmc_jax.laws.base import Sample
from ptsmc_jax.numerics import attitude, guards
from ptsmc_jax.numerics.draws import WholeNumber
from ptsmc_jax.numerics.pytrees import Scalar
from ptsmc_jax.observers.base import Bound
from ptsmc_jax.simulation.assembly import Parts


class Computer(NamedTuple):
    """The memory of the flight software between two samples."""

    sensors: PyTree  # memory of the sensors
    seen: PyTree  # state that the sensors measured at the last sample
    observer: PyTree  # memory of the observer
    law: PyTree  # memory of the law; None: the law has no memory
    # mean torque [N m] and wheel momentum [N m s] of the last period, as the flight software assumes them
    applied: tuple[Array, Array | None] | None  # None: it is `control_period.State.torque`, held exactly
    command_filter: PyTree = None  # memory of the command filter; None: there is no filter


class Decision(NamedTuple):
    """The output of a flight computer at a sample."""

    target: PyTree  # reference at the sample
    d_hat: Array  # (m,) estimated disturbance [N m]
    u: Array  # (m,) commanded torque, after the command filter [N m]
    s: Array  # sliding variable of the law at the sample
    w: Any = None  # (m,) measured velocity [rad/s]; None in the continuous loop and in the row at t_end
    channels: Array | None = None  # (channels,) torque, if the flight software itself limits and allocates it [N m]


class Period(NamedTuple):
    """A control period at its nominal times, which the flight software assumes."""

    now: Ticks
    dt_before: Scalar  # length of the period before [s]
    matrix: Array  # `Observer.update_matrix` of the length `dt_before`
    full_length: Scalar  # length of a complete period [s]

    @property
    def length(self) -> Scalar:
        """Length of the control period [s]."""
        return self.now.t_next - self.now.t

    @property
    def assumed_length(self) -> Scalar:
        """The length [s] that the flight software assumes. It does not know that t_end cuts the last period."""
        expected = jnp.where(self.now.partial, self.length, self.full_length)
        return jnp.where(self.length > 0.0, expected, 0.0)

    def sample(self, memory: PyTree) -> Sample:
        """Return the sample for the law with this memory. Its dt is never 0, so that the law can divide by it."""
        dt = jnp.where(self.length > 0.0, self.assumed_length, self.full_length)
        return Sample(self.now.t, self.now.hold, dt, memory)


# statuses that exported C reports for a sample, the most severe last; other: not known to this version
SAMPLE_STATUSES = ("ok", "saturated", "missed", "singular", "input", "overflow", "other")


class Software(NamedTuple):
    """The flight software of a run: `boot` and `decide` of this module, or exported C instead of them."""

    boot: Callable[[Parts, WholeNumber, WholeNumber, PyTree, Ticks], Computer]
    # arguments: parts, k2, period, memory, visible state, state at star tracker readings, state of the actuators
    decide: Callable[[Parts, Bound, Period, Computer, PyTree, PyTree, ActuatorState], tuple[Decision, Computer]]
    # returns the number of samples of a run by their status; None: the software reports none
    count_statuses: Callable[[Computer], dict[str, Array]] | None = None
    on_processor: bool = False  # whether it runs on the host processor only


def boot(parts: Parts, seed: WholeNumber, trial: WholeNumber, x0: PyTree, first: Ticks) -> Computer:
    """Return the memory of the flight computer before the first sample.

    Args:
        parts: parts of the run.
        seed: seed of the noise, a whole number.
        trial: number of the trial.
        x0: true initial state, as far as sensors can measure it.
        first: the first control period.
    """
    sensors = parts.sensors.begin(seed, trial, x0, first)
    zero = jnp.zeros(parts.plant.inputs)
    applied = zero, None if parts.actuators.wheels is None else zero
    command_filter = None if parts.command_filter is None else parts.command_filter.begin(parts.plant.inputs)
    return Computer(sensors, x0, parts.observer.begin(), parts.controller.begin(), applied, command_filter)


def estimate(parts: Parts, period: Period, computer: Computer, seen: PyTree) -> tuple[Array, PyTree]:
    """Estimate the disturbance from the change of the measured state in the last period.

    Args:
        parts: parts of the run.
        period: the control period that begins.
        computer: memory of the flight computer from the period before.
        seen: measured state at the sample.

    Returns:
        The disturbance (m,), for a spacecraft in N m, and the memory of the observer for the next sample.
    """
    observer, model, dt = parts.observer, parts.observer.model, period.dt_before
    assert computer.applied is not None
    torque, wheel_momentum = computer.applied
    if wheel_momentum is not None:  # w x h of the wheels, by the mean rate
        torque = torque - attitude.cross((model.velocity(computer.seen) + model.velocity(seen)) / 2, wheel_momentum)
    impulse = model.implied_disturbance_impulse(period.now.t, computer.seen, seen, torque, dt)
    memory = observer.update(period.matrix, computer.observer, impulse, period.now.t, dt)
    memory = guards.select(dt > 0.0, memory, computer.observer)
    return observer.estimate(memory), memory


def decide(
    parts: Parts,
    k2: Bound,
    period: Period,
    computer: Computer,
    x: PyTree,
    star_x: PyTree = None,
    actuator_state: ActuatorState | None = None,
) -> tuple[Decision, Computer]:
    """Run the flight software at a sample: sensors, observer, law, command filter.

    Args:
        parts: parts of the run.
        k2: bound K2(t) on the error of the estimated disturbance.
        period: the control period that begins.
        computer: memory of the flight software.
        x: true state without noise, as far as sensors can measure it, see `Plant.visible`.
        star_x: `control_period.star_state` of the period before.
        actuator_state: not used; other flight software may measure it.

    Returns:
        The decision and the new memory. Its field `applied` is still the one of the last period.
    """
    target = parts.reference(period.now.t)
    seen, sensors = parts.sensors.measure(computer.sensors, x, period.now, period.dt_before, star_x)
    d_hat, observer = estimate(parts, period, computer, seen)
    u, s, law = parts.controller(period.sample(computer.law), seen, target, d_hat, k2(period.now.t))
    law, command_filter = guards.select(period.length > 0.0, law, computer.law), computer.command_filter
    if parts.command_filter is not None:
        u, command_filter = parts.command_filter.step(command_filter, u, period.dt_before, period.assumed_length)
        command_filter = guards.select(period.length > 0.0, command_filter, computer.command_filter)
    decision = Decision(target, d_hat, u, s, parts.observer.model.velocity(seen))
    return decision, Computer(sensors, seen, observer, law, computer.applied, command_filter)


PYTHON_SOFTWARE = Software(boot, decide)
