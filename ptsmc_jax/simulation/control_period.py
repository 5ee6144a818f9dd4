"""One control period of the sampled loop. Read `control_period` first: it has all events of a period in their order.

The sampled loop, the linearisation of `theory.linear` and the test vectors of the C export call it.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, PyTree

from ptsmc_jax.devices.actuators import Actuators, ActuatorState, Drive
from ptsmc_jax.devices.ticks import Ticks
from ptsmc_jax.numerics import draws, integrators
from ptsmc_jax.numerics.draws import WholeNumber
from ptsmc_jax.numerics.pytrees import Scalar
from ptsmc_jax.observers.base import Bound
from ptsmc_jax.simulation.assembly import Parts
from ptsmc_jax.simulation.computer import PYTHON_SOFTWARE, Computer, Decision, Period, Software
from ptsmc_jax.simulation.metrics import Torques

DISTURBANCE_WALK = "disturbance_walk"
SAMPLE_TIMES = "timing_jitter_samples"


class Tick(NamedTuple):
    """A control period at its nominal times. For a whole run the fields are arrays over the periods."""

    now: Ticks
    dt_before: Array  # length of the period before [s]
    partial_before: Array  # bool: the period before is the partial first period, see `Ticks.partial`


class State(NamedTuple):
    """The state of a loop between two control periods. The continuous loop has the first three fields only."""

    x: PyTree  # true state of the plant
    torque: Array  # (m,) delivered at the end of the last period [N m]
    computer: Computer  # memory of the flight software; its `applied` is None if the actuators hold `torque`
    actuators: ActuatorState = ActuatorState(None, None, None)
    walk: Array | None = None  # (m,) random walk of the disturbance [N m]; None: there is none
    star_x: PyTree = None  # true states at sensors' own sample times in the last period, see `star_state`
    offset: Array | None = None  # delay of the next sample after its nominal time [s]; None: no timing jitter

    @property
    def applied(self) -> tuple[Array, Array | None]:
        """Mean torque [N m] and wheel momentum [N m s] in the last period, as the flight software knows them."""
        return (self.torque, None) if self.computer.applied is None else self.computer.applied


class Record(NamedTuple):
    """Times, decision, torques and true states of a control period, or of a step of the continuous loop."""

    now: Ticks  # true times
    decision: Decision  # decision of the flight software; its target is the reference at the true time
    torques: Torques
    x_after: Callable[[Scalar], PyTree]  # time since the start [s] -> true state then
    step: Scalar  # longest integration step [s]
    drive: Drive | None = None  # input of the actuators in the period
    tick: Tick | None = None  # nominal times; None in the continuous loop, and with software on the host processor


class Vehicle(NamedTuple):
    """The constants of a sampled run."""

    parts: Parts
    software: Software
    k2: Bound  # bound K2(t) on the error of the estimated disturbance
    matrix: Array  # `Observer.update_matrix` of a full period
    first_matrix: Array  # `Observer.update_matrix` of the partial first period
    walk_key: draws.Key | None  # random key of the disturbance's random walk; None: no random walk
    jitter_key: draws.Key | None  # random key of the timing jitter; None: samples come at their nominal times

    def period(self, tick: Tick) -> Period:
        """Return the control period of a tick, at its nominal times."""
        matrix = jnp.where(tick.partial_before, self.first_matrix, self.matrix)
        return Period(tick.now, tick.dt_before, matrix, self.parts.period)

    def draw_offset(self, t: Scalar, sample: Array) -> Array:
        """Return the random delay [s] of a sample after its nominal time t [s]; zero at both ends of the run."""
        parts = self.parts
        assert parts.jitter is not None
        assert self.jitter_key is not None
        largest = jnp.minimum(parts.jitter * parts.period, jnp.minimum(t, parts.t_end - t) / 2.0)
        return largest * (2.0 * draws.uniforms(self.jitter_key, 1, sample)[0] - 1.0)


def control_period(vehicle: Vehicle, state: State, tick: Tick) -> tuple[State, Record]:
    """Simulate one control period: measure, estimate, command, limit, delay, allocate, act, integrate.

    Args:
        vehicle: the constants of the run.
        state: state of the loop at the sample that begins the period.
        tick: the period.

    Returns:
        The state at the next sample, and the record of the period, from which metrics and history are computed.
    """
    parts, actuators, plant = vehicle.parts, vehicle.parts.actuators, vehicle.parts.plant
    period = vehicle.period(tick)

    # with timing jitter, samples come early or late; flight software assumes the nominal times of `period`
    now, next_offset = period.now, None
    if state.offset is not None:
        next_offset = vehicle.draw_offset(now.t_next, now.sample + 1)
        now = now._replace(t=now.t + state.offset, t_next=now.t_next + next_offset)
    dt = now.t_next - now.t

    # flight software: measure, estimate the disturbance, command a torque, filter it
    memory = state.computer._replace(applied=state.applied)
    decision, computer = vehicle.software.decide(
        parts, vehicle.k2, period, memory, plant.visible(state.x), state.star_x, state.actuators
    )

    # actuators: limit, delay, allocate to the channels, quantise, limit the channels
    drive, queue = actuators.command(
        state.actuators, decision.u, decision.w, now.t, period.assumed_length, now.noise_weight
    )
    if decision.channels is not None:
        drive = drive._replace(c=decision.channels)
    torques = period_torques(actuators, drive, decision.u, dt)

    # true plant: integrate under the torques and the disturbance
    walk = state.walk
    if walk is not None:
        assert vehicle.walk_key is not None
        assert parts.walk_rate is not None
        walk = walk + parts.walk_rate * dt * draws.normals(vehicle.walk_key, walk.size, now.sample)
    x_after = partial(state_after, parts, now.t, state.x, drive, walk)
    applied = None if actuators.is_exact_hold else actuators.assumed_torque(drive, period.length)
    after = State(
        x=x_after(dt),
        torque=jnp.where(now.t_next > now.t, torques.delivered[-1], state.torque),
        computer=computer._replace(applied=applied),
        actuators=actuators.end(state.actuators, drive, queue, dt),
        walk=walk,
        star_x=star_state(parts, now, x_after),
        offset=next_offset,
    )
    if next_offset is not None:
        decision = decision._replace(target=parts.reference(now.t))
    x_at_t_f = partial(x_after, rolled=True)  # called only once in a run, so that speed does not matter
    nominal = None if vehicle.software.on_processor else tick
    return after, Record(now, decision, torques, x_at_t_f, dt / parts.substeps, drive, nominal)


def start(
    parts: Parts, ticks: Ticks, x0: PyTree, seed: WholeNumber, trial: WholeNumber, software: Software = PYTHON_SOFTWARE
) -> tuple[Vehicle, State]:
    """Return the constants of a sampled run, and its state before the first control period.

    Args:
        parts: parts of the run.
        ticks: control periods of the run.
        x0: true state at t = 0.
        seed: whole number that selects the random numbers, together with `trial`.
        trial: number of the trial.
        software: the flight software.
    """
    lengths, actuators, inputs = ticks.t_next - ticks.t, parts.actuators, parts.plant.inputs
    # one compiled function computes the observer matrices of a full and of the first period, outside the loop
    first_length = jnp.sum(jnp.where(ticks.partial, lengths, 0.0))
    matrices = jax.lax.map(parts.observer.update_matrix, jnp.stack([parts.period, first_length]))
    walk_key = None if parts.walk_rate is None else draws.stream(seed, trial, DISTURBANCE_WALK)
    jitter_key = None if parts.jitter is None else draws.stream(seed, trial, SAMPLE_TIMES)
    vehicle = Vehicle(parts, software, parts.observer.error_bound(), matrices[0], matrices[1], walk_key, jitter_key)

    first = first_period(ticks)
    computer = software.boot(parts, seed, trial, parts.plant.visible(x0), first)
    state = State(
        x=x0,
        torque=jnp.zeros(inputs),
        computer=computer._replace(applied=None) if actuators.is_exact_hold else computer,
        actuators=actuators.begin(inputs),
        walk=None if walk_key is None else jnp.zeros(inputs),
        star_x=star_state(parts, first, lambda dt: x0),
        offset=None if jitter_key is None else vehicle.draw_offset(ticks.t[0], ticks.sample[0]),
    )
    return vehicle, state


def schedule(ticks: Ticks) -> Tick:
    """Return the control periods of a run, for a scan over `control_period`; times in [s]."""
    lengths = ticks.t_next - ticks.t
    length_before = jnp.concatenate([jnp.zeros(1), lengths[:-1]])
    return Tick(ticks, length_before, jnp.concatenate([jnp.ones(1, bool), ticks.partial[:-1]]))


def first_period(ticks: Ticks) -> Ticks:
    """Return the first control period that has a length."""
    return jax.tree.map(lambda v: v[jnp.argmax(ticks.t_next > ticks.t)], ticks)


def state_after(
    parts: Parts, t: Scalar, x: PyTree, drive: Drive, walk: Array | None, dt: Scalar, *, rolled: bool = False
) -> PyTree:
    """Return the true state of the plant after a part of a control period.

    Args:
        parts: parts of the run.
        t: start of the period [s].
        x: true state then.
        drive: input of the actuators in the period.
        walk: additional disturbance, constant over the period, (m,) [N m]; None: there is none.
        dt: time since the start of the period [s].
        rolled: whether a loop computes the RK4 stages, which is slower but compiles faster.
    """
    plant, step = parts.plant, dt / parts.substeps

    def substep(k: Scalar, x: PyTree) -> PyTree:
        """Return the state after integration step k, which begins in the state x."""
        start, applied = t + k * step, parts.actuators.torque_over(drive, k * step, step)

        def rate(time: Scalar, x_stage: PyTree) -> PyTree:
            d = parts.disturbance(time, x_stage)
            torque = applied.torque_at(time - start, plant.velocity(x_stage))
            return plant.rate(time, x_stage, torque, d if walk is None else d + walk)

        return integrators.rk4(rate, start, x, step, rolled=rolled or plant.custom_functions)

    if parts.substeps == 1:
        return plant.normalise(substep(jnp.zeros_like(dt), x))
    starts = jnp.arange(parts.substeps, dtype=dt.dtype)
    return plant.normalise(jax.lax.scan(lambda x, k: (substep(k, x), None), x, starts)[0])


def star_state(parts: Parts, now: Ticks, x_after: Callable[[Scalar], PyTree]) -> PyTree:
    """Return the true states when sensors with their own sample times take readings in a period, or None.

    The flight software gets these readings at the next sample or later.

    Args:
        parts: parts of the run.
        now: the period.
        x_after: function from the time since the start of the period [s] to the true state.
    """
    ages = parts.sensors.newest_reading_age(now.sample + 1, now.t_next - now.t)
    return jax.tree.map(lambda age: parts.plant.visible(x_after(now.t_next - age - now.t)), ages)


def period_torques(actuators: Actuators, drive: Drive, u: Array, dt: Scalar) -> Torques:
    """Return commanded and delivered torques of a control period, and the momentum of the wheels in it.

    Args:
        actuators: the actuators.
        drive: input of the actuators in the period.
        u: command of the law (m,) [N m].
        dt: length of the control period [s].
    """
    wheels = actuators.wheels is not None
    # with a lag the torque may change its sign within the period, where the wheels' momentum may then peak
    times = (jnp.zeros_like(dt), dt / 2, dt) if actuators.has_dynamics or wheels else (jnp.zeros_like(dt),)
    channel_torques, wheel_momenta = zip(*(actuators.torque_and_momentum(drive, time) for time in times), strict=True)
    weights = (1 / 6, 4 / 6, 1 / 6) if actuators.has_dynamics else (1.0,)
    delivered = tuple(actuators.on_body(v) for v in channel_torques[: len(weights)])
    wheel_momentum = jnp.stack(wheel_momenta[1:]) if wheels else None
    wheel_torque = jnp.stack([channel_torques[0], channel_torques[-1]]) if wheels else None  # monotonic in between
    return Torques((u,) * len(weights), delivered, weights, drive.limited, wheel_momentum, wheel_torque)
