"""Linearised sampled loop, opened at the plant's input or at the sensors.

`jax.jacfwd` linearises the simulation code of a control period about the nominal run, without noise and disturbance.
The state z has local coordinates of the complete loop (`carries`): plant, actuators and flight computer, including the
flight computer's model of the actuators. One period is

    z' = A z + B x_seen + N u_new + O u_old + E d,    u = C z + D x_seen.

- x_seen is the part of the plant state that sensors see.
- u_new is the command of `delay` periods ago. It begins to act after a fraction of the period.
- u_old is the command before u_new. It acts until u_new begins to act.
- d is a torque on the plant.

The flight computer predicts the applied torque from u with its model of the actuators. It does not see a gain or a
delay that the analysis inserts at the plant's input. If a star tracker is slower than the loop, the matrices are means
over its interval; see also `Sensors.at_control_samples`. Read `simulate_nominal`, `linearise_period` and
`open_at_input` first.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from ptsmc_jax import programs
from ptsmc_jax.batching import lapack
from ptsmc_jax.devices.actuators import ActuatorState
from ptsmc_jax.devices.ticks import Ticks
from ptsmc_jax.numerics import stacking
from ptsmc_jax.numerics.pytrees import Leaf, Scalar, pytree
from ptsmc_jax.signals import disturbances
from ptsmc_jax.simulation import clock
from ptsmc_jax.simulation.assembly import Parts
from ptsmc_jax.simulation.computer import Computer, Decision, Period, decide
from ptsmc_jax.simulation.control_period import State, Tick, control_period, schedule, start, state_after
from ptsmc_jax.theory.carries import Carry, LocalCoordinates

NODES = 0.5 - 0.5 * np.cos(np.pi * np.arange(13) / 12)  # Chebyshev nodes for delays within a period, in periods.
_WEIGHTS = np.where(np.isin(np.arange(13), (0, 12)), 0.5, 1.0) * (-1.0) ** np.arange(13)  # Barycentric weights.


@pytree
@dataclass(frozen=True)
class Loop:
    """One period of the opened loop, with the equations of the module: z (n,), u (m,). The first k of z are x_seen."""

    a: Leaf  # (n, n) A, derivative of z' by z
    seen: Leaf  # (n, k) B, derivative of z' by x_seen
    new: Leaf  # (nodes, n, m) N, derivative of z' by u_new; entry k: u_new begins to act after the fraction `NODES[k]`
    old: Leaf  # (nodes, n, m) O, derivative of z' by u_old; entry k: u_old acts until the fraction `NODES[k]`
    command: Leaf  # (m, n) C, derivative of u by z
    direct: Leaf  # (m, k) D, derivative of u by x_seen
    disturbed: Leaf  # (n, m) E, derivative of z' by d
    period: Leaf  # h [s]
    delay: int = field(metadata={"static": True})  # delay of the actuators in whole periods

    def closed_at_sensors(
        self, xp: Any = jnp
    ) -> tuple[Float[Array | np.ndarray, "n n"], Float[Array | np.ndarray, "m n"]]:
        """Return A (n, n) and C (m, n) for x_seen equal to the first k states, so that only the input is open.

        The units are rad, rad/s and N m.
        """
        others = ((0, 0), (0, self.a.shape[0] - self.seen.shape[1]))
        return self.a + xp.pad(self.seen, others), self.command + xp.pad(self.direct, others)


class NominalRun(NamedTuple):
    """Nominal run without noise and disturbance; the first axis of all arrays is the control period."""

    period: Period
    carry: Carry  # state of the loop at the start of the period
    after: Carry  # state of the loop at the end of the period
    command: Array  # u that acts in the period, after the delay


def quiet(parts: Parts) -> Parts:
    """Return the parts without noise, disturbance and timing jitter."""
    return replace(
        parts,
        sensors=parts.sensors.at_control_samples().without_noise(),
        disturbance=disturbances.Constant(jnp.zeros(parts.plant.inputs)),
        walk_rate=None,
        jitter=None,
    )


def simulate_nominal(parts: Parts) -> NominalRun:
    """Simulate the nominal run of sampled parts."""
    assert parts.clock.sampled
    parts = quiet(parts)
    ticks = parts.clock.ticks(parts.controller.t_f, parts.controller.delta)
    x0 = parts.aligned_initial
    vehicle, initial = start(parts, ticks, x0, np.uint32(0), np.uint32(0))

    def step(state: State, tick: Tick) -> tuple[State, NominalRun]:
        after, record = control_period(vehicle, state, tick)
        acting_command = record.decision.u if state.actuators.queue is None else state.actuators.queue[0]
        return after, NominalRun(vehicle.period(tick), Carry.from_state(state), Carry.from_state(after), acting_command)

    return stacking.scan(step, initial, schedule(ticks))[1]


simulate_nominal_jit = programs.jit(simulate_nominal, compiler_options=programs.FAST_COMPILE)


def _run_computer(
    parts: Parts, k2: Any, period: Period, carry: Carry, seen: Any
) -> tuple[Decision, Computer, ActuatorState]:
    """Return the decision of the flight software, its memory, and the state of its actuator model.

    Args:
        parts: the scenario.
        k2: bound on the estimation error, see `Observer.error_bound`.
        period: the control period.
        carry: the loop at the sample.
        seen: the part of the true state that sensors see.
    """
    actuators, dt = parts.actuators, period.length
    decision, computer = decide(parts, k2, period, carry.computer, seen)
    model = carry.actuator_model._replace(h=carry.actuators.h)
    drive, queue = actuators.command(
        model, decision.u, decision.w, period.now.t, period.assumed_length, period.now.noise_weight
    )
    computer = computer._replace(applied=actuators.assumed_torque(drive, dt))
    return decision, computer, actuators.end(model, drive, queue, dt)._replace(h=None)


def _apply_commands(
    parts: Parts,
    carry: Carry,
    w: Array,
    commands: Sequence[tuple[Array, Scalar, Scalar]],
    extra_torque: Array | None = None,
) -> tuple[Any, ActuatorState]:
    """Return the states of plant and actuators after commands have acted one after the other.

    Delayed commands are already limited and compensated. Commands without a delay are limited and compensated here.

    Args:
        parts: the scenario.
        carry: the loop at the sample.
        w: body rate that the flight computer knows, (m,) [rad/s].
        commands: each command (m,) [N m], the time when it begins to act [s], and how long it acts [s].
        extra_torque: additional torque on the plant, (m,) [N m].
    """
    actuators = parts.actuators

    def apply_command(state: tuple[Any, ActuatorState], entry: tuple) -> tuple[tuple[Any, ActuatorState], None]:
        (x, actuator_state), (command, t, length) = state, entry
        sent = command if actuators.delay else actuators.send(actuator_state, command, w)[0]
        drive = actuators.drive(actuator_state, sent, t, length)
        x = state_after(parts, t, x, drive, extra_torque, length)
        return (x, actuators.end(actuator_state, drive, None, length)), None

    if len(commands) == 1:
        return apply_command((carry.x, carry.actuators), commands[0])[0]
    # a scan, so that JAX traces and compiles the motion once
    stacked = jax.tree.map(lambda *v: jnp.stack(v), *commands)
    return jax.lax.scan(apply_command, (carry.x, carry.actuators), stacked)[0]


class LinearisedPeriod(NamedTuple):
    """Linearised and opened loop of one control period, and derivatives of the error and of s at its start."""

    loop: Loop
    error: Array  # (m, x) Derivative of the error by the plant's local coordinates.
    error_rate: Array  # (m, x) Derivative of the error's rate by the same coordinates.
    s_by_z: Array  # (components, n) Derivative of s by z, the state of the complete loop.
    s_by_seen: Array  # (components, k) Derivative of s by x_seen, the plant state that sensors see.


def linearise_period(parts: Parts, nominal_period: NominalRun, *, fractional_delays: bool = True) -> LinearisedPeriod:
    """Linearise and open the loop in one control period of the nominal run, see `Loop`; the period h is in [s].

    The function does not use the clock of the scenario.

    Args:
        parts: the scenario.
        nominal_period: the period of the nominal run.
        fractional_delays: whether to compute N and O at all `NODES`, which is most of the work. `open_at_input` and
            `delay_one_axis` need them for delays that are not a whole number of periods. If False, N and O have one
            node, the fraction 0.
    """
    parts = quiet(parts)
    period, before, after, acting_command = nominal_period
    period = _with_exact_length(period)
    k2, plant, kinematics = parts.observer.error_bound(), parts.plant, parts.controller.kinematics
    at_start, at_end = LocalCoordinates(parts, before), LocalCoordinates(parts, after)
    now, dt = period.now, period.length
    z0, x0, seen0, u0 = (jnp.zeros(n) for n in (sum(at_start.sizes), *at_start.sizes[:2], plant.inputs))
    target = parts.reference(now.t)

    def simulate_period(z: Array, seen: Array, new: Array, d: Array) -> tuple[Array, Array, Array]:
        carry = at_start.retract(z)
        seen = parts.observer.model.retract(plant.visible(before.x), seen)
        decision, computer, model = _run_computer(parts, k2, period, carry, seen)
        x, actuator_state = _apply_commands(parts, carry, decision.w, [(acting_command + new, now.t, dt)], d)
        sent = decision.u
        if parts.actuators.delay:
            sent, _ = parts.actuators.send(carry.actuators, decision.u, decision.w)
        return at_end.local_coordinates(Carry(x, actuator_state, computer, model)), sent, decision.s

    def command_jacobians(fraction: Scalar) -> tuple[Array, Array]:
        def simulate_end(old: Array, new: Array) -> Array:
            new_entry = (acting_command + new, now.t + fraction * dt, (1.0 - fraction) * dt)
            commands = [(acting_command + old, now.t, fraction * dt), new_entry]
            x, actuator_state = _apply_commands(parts, before, plant.velocity(after.computer.seen), commands)
            return at_end.local_coordinates(after._replace(x=x, actuators=actuator_state))

        return jax.jacfwd(simulate_end, argnums=(0, 1))(u0, u0)

    jacobians = jax.jacfwd(simulate_period, argnums=(0, 1, 2, 3))(z0, seen0, u0, u0)
    (a, seen, new, disturbed), (command, direct, *_), (s_by_z, s_by_seen, *_) = jacobians
    if fractional_delays:
        old, new = lapack.vmap(command_jacobians)(jnp.asarray(NODES))
    else:
        old, new = jnp.zeros_like(new)[None], new[None]
    loop = Loop(a, seen, new, old, command, direct, disturbed, dt, delay=parts.actuators.delay)
    error, error_rate = jax.jacfwd(lambda offset: kinematics.errors(plant.retract(before.x, offset), target))(x0)
    return LinearisedPeriod(loop, error, error_rate, s_by_z, s_by_seen)


def _with_exact_length(period: Period) -> Period:
    """Return the period; a full period gets exactly the length of the clock's period [s], with its derivatives.

    The last period ends at t_end. Its start depends on delta, but t_end does not. If the last period happens to be
    full, its length would therefore have a derivative by delta, although all full periods have the same length.
    """
    now, length = period.now, period.full_length
    end = jnp.where(is_full(now, length), now.t + length, now.t_next)
    return period._replace(now=now._replace(t_next=end))


PERIODS_PER_CALL = 64  # periods that one call of the compiled program linearises


def linearise_periods(
    parts: Parts,
    run: NominalRun,
    indices: np.ndarray,
    widths: np.ndarray | None = None,
    *,
    fractional_delays: bool = True,
) -> LinearisedPeriod:
    """Linearise and open the loop in several control periods, stacked along the first axis; the period h is in [s].

    The same compiled program is used for any number of periods.

    Args:
        parts: the scenario.
        run: the nominal run.
        indices: numbers of the periods (periods,).
        widths: thickness of the law's boundary layer in each period (periods,), or None for the law's `sign_width`.
        fractional_delays: whether to compute N and O at all `NODES`, see `linearise_period`.
    """
    parts = replace(parts, clock=clock.flight_clock(1.0, 1.0))
    selected = jax.tree.map(lambda v: np.asarray(v)[indices], run), widths

    def linearise_batch(batch: tuple[NominalRun, Any]) -> LinearisedPeriod:
        return _linearise_batch(parts, *batch, fractional_delays=fractional_delays)

    return map_in_batches(linearise_batch, selected, PERIODS_PER_CALL)


def map_in_batches(function: Callable[[Any], Any], items: Any, size: int) -> Any:
    """Apply a compiled function to batches of items.

    All batches have the same number of items, so that JAX does not compile a program for each number of items.

    Args:
        function: the compiled function of a pytree of arrays (size, ..).
        items: pytree of arrays (items, ..).
        size: number of items in a batch. The last batch repeats items to reach it.

    Returns:
        The results of all items, a pytree of NumPy arrays (items, ..).
    """
    count = np.shape(jax.tree.leaves(items)[0])[0]

    def apply(first: int) -> Any:
        batch = np.resize(np.arange(first, min(first + size, count)), size)
        return jax.tree.map(np.asarray, function(jax.tree.map(lambda v: np.asarray(v)[batch], items)))

    batches = [apply(first) for first in range(0, count, size)]
    return jax.tree.map(lambda *blocks: np.concatenate(blocks)[:count], *batches)


@programs.jit(static_argnames=("fractional_delays",), compiler_options=programs.FAST_COMPILE)
def _linearise_batch(
    parts: Parts, nominal_periods: NominalRun, widths: Array | None, fractional_delays: bool
) -> LinearisedPeriod:
    """Linearise several control periods, which are the first axis of the arguments and the result.

    Args:
        parts: the scenario.
        nominal_periods: the nominal run in these periods.
        widths: thickness of the boundary layer in each period; None: that of the law.
        fractional_delays: see `linearise_period`.
    """

    def linearise(nominal_period: NominalRun, width: Any) -> LinearisedPeriod:
        changed = parts
        if width is not None:
            changed = replace(parts, controller=replace(parts.controller, sign_width=width))
        return linearise_period(changed, nominal_period, fractional_delays=fractional_delays)

    return lapack.vmap(linearise)(nominal_periods, widths)


def open_loops(parts: Parts, run: NominalRun, indices: np.ndarray | Array, *, fractional_delays: bool = True) -> Loop:
    """Return the opened loops of several control periods, stacked along the first axis; the period h is in [s].

    If a star tracker is slower than the loop, each loop is the mean over the star tracker's interval.

    Args:
        parts: the scenario.
        run: the nominal run.
        indices: numbers of the periods (periods,). For a NumPy array, a compiled program linearises the periods in
            batches. A JAX array may be traced.
        fractional_delays: whether to compute N and O at all `NODES`, see `linearise_period`.
    """
    periods = (indices[:, None] - np.arange(averaging_periods(parts))[None]).clip(0)
    if isinstance(periods, np.ndarray):
        loops = linearise_periods(parts, run, periods.reshape(-1), fractional_delays=fractional_delays).loop
    else:

        def open_one(index: Array) -> Loop:
            nominal_period = jax.tree.map(lambda v: v[index], run)
            return linearise_period(parts, nominal_period, fractional_delays=fractional_delays).loop

        loops = lapack.vmap(open_one)(periods.reshape(-1))
    return jax.tree.map(lambda v: v.reshape(*periods.shape, *v.shape[1:]).mean(axis=1), loops)


def averaging_periods(parts: Parts) -> int:
    """Return the number of control periods between star tracker samples, over which a loop is averaged."""
    return getattr(parts.sensors, "every", 1)


def is_full(ticks: Ticks, period: Any) -> Any:
    """Return whether each period of a run has the full length, (periods,) bool; times in [s], in NumPy or JAX."""
    return ticks.t_next - ticks.t > (1.0 - 1e-6) * period


def full_periods(parts: Parts, run: NominalRun, *, hold: bool) -> np.ndarray:
    """Return the numbers (periods,) of the full control periods before or after the hand-over.

    Args:
        parts: the sampled scenario.
        run: its nominal run, with times in [s].
        hold: whether to return periods after the hand-over; otherwise those before it.
    """
    ticks = run.period.now
    in_hold = ticks.hold if hold else parts.controller.in_hold(ticks.t, ticks.t_next, ticks.hold)
    long_enough = is_full(jax.tree.map(np.asarray, ticks), np.asarray(parts.period))
    return np.flatnonzero(long_enough & (np.asarray(in_hold) == hold))


def command_effect(loop: Loop, fraction: ArrayLike, xp: Any = jnp) -> tuple[Any, Any]:
    """Return N and O, (n, m) each, for a command [N m] that begins to act within the period.

    The function interpolates by polynomials through `NODES`.

    Args:
        loop: the opened loop.
        fraction: fraction of the period after which the command acts, 0 to 1.
        xp: `jax.numpy` or `numpy`.
    """
    offset = fraction - xp.asarray(NODES)
    at_node = xp.abs(offset) < 1e-14
    weights = xp.asarray(_WEIGHTS) / xp.where(at_node, 1.0, offset)
    weights = xp.where(xp.any(at_node), at_node.astype(float), weights / xp.sum(weights))
    return xp.tensordot(weights, loop.new, 1), xp.tensordot(weights, loop.old, 1)


class Opening(NamedTuple):
    """State space of an opened loop, L(z) = -C (z - A)^-1 B with negative feedback.

    The states are z and the delayed commands. A pole of the closed loop is on the unit circle if det(I + L) = 0 there.
    """

    a: Any  # (n, n)
    b: Any  # (n, m)
    c: Any  # (m, n)

    def closed(self, gain: Any = 1.0) -> Any:
        """Return the transition matrix (n, n) of the closed loop with a gain [-], a number or a matrix (m, m)."""
        return self.a + self.b @ (gain * self.c if np.ndim(gain) == 0 else gain @ self.c)


def open_at_input(loop: Loop, extra_delay: float = 0.0, xp: Any = jnp) -> Opening:
    """Return the loop opened at the plant's input, with an additional delay in periods.

    The input of the result is the command (m,) [N m].

    Args:
        loop: the linearised loop.
        extra_delay: additional delay of all axes in periods, whole or fractional.
        xp: `jax.numpy` or `numpy`.
    """
    a, command = loop.closed_at_sensors(xp)
    (m, n), delay = command.shape, loop.delay + extra_delay
    whole = int(np.floor(delay + 1e-12))
    fraction = max(delay - whole, 0.0)
    effects = [xp.zeros((n, m))] * whole + [loop.new[0]]  # entry k: effect of the command of k periods ago
    if fraction > 0.0:
        effects[whole:] = command_effect(loop, fraction, xp)
    queue_size = (len(effects) - 1) * m  # number of states for delayed commands, newest first
    state_rows = xp.concatenate([a, *effects[1:]], axis=1)
    queue_rows = xp.concatenate([xp.zeros((queue_size, n)), xp.eye(queue_size, k=-m)], axis=1)
    b = xp.concatenate([effects[0], xp.eye(queue_size, m)])
    return Opening(xp.concatenate([state_rows, queue_rows]), b, xp.pad(command, ((0, 0), (0, queue_size))))


def open_at_sensors(loop: Loop) -> Opening:
    """Return the loop opened at the sensors, B (n, k), with x_seen in rad and rad/s as input."""
    (n, k), (m, _) = loop.seen.shape, loop.command.shape
    effect, queue_size = loop.new[0], loop.delay * m
    if not queue_size:
        return Opening(loop.a + effect @ loop.command, loop.seen + effect @ loop.direct, jnp.eye(k, n))
    a = jnp.zeros((n + queue_size,) * 2).at[:n, :n].set(loop.a).at[:n, -m:].set(effect)
    a = a.at[n : n + m, :n].set(loop.command).at[n + m :, n : n + queue_size - m].set(jnp.eye(queue_size - m))
    b = jnp.zeros((n + queue_size, k)).at[:n].set(loop.seen).at[n : n + m].set(loop.direct)
    return Opening(a, b, jnp.eye(k, n + queue_size))


def delay_one_axis(loop: Loop, z: Array, extra_delay: Scalar, axis: Any) -> Opening:
    """Return the loop opened at the plant's input, with an additional delay of one axis, for one point z [-].

    Delays are factors z^-k instead of states. B (n, m) contains the factor of the additional delay, so that it is valid
    at this z only. It does not contain the factor z^-`loop.delay`: the loop transfer matrix is this factor times L(z).

    Args:
        loop: the linearised loop.
        z: the point e^(i w h).
        extra_delay: additional delay in periods, whole or fractional.
        axis: number of the delayed axis.
    """
    a, command = loop.closed_at_sensors()
    whole = jnp.floor(extra_delay)
    new, old = command_effect(loop, extra_delay - whole)
    delayed = (new + old / z) * z**-whole
    return Opening(a, jnp.where(jnp.arange(command.shape[0]) == axis, delayed, loop.new[0]), command)


def spectral_radius(loop: Loop, gain: Any = 1.0, extra_delay: float = 0.0) -> float:
    """Return the spectral radius of the closed loop [-].

    The loop is stable below 1. Poles of stored wheel momentum are at 1. See `closed_poles` for the arguments.
    """
    return float(np.abs(closed_poles(loop, gain, extra_delay)).max())


def closed_poles(loop: Loop, gain: Any = 1.0, extra_delay: float = 0.0) -> np.ndarray:
    """Return the poles (n,) of the closed loop [-], NaN if the nominal run is not finite.

    The function uses NumPy, because the size of the matrix depends on the delay and JAX would compile a program for
    each size.

    Args:
        loop: the linearised loop.
        gain: gain at the plant's input [-], a number or a matrix (m, m).
        extra_delay: additional delay of all axes in periods.
    """
    closed = open_at_input(jax.tree.map(np.asarray, loop), extra_delay, np).closed(gain)
    return np.linalg.eigvals(closed) if np.all(np.isfinite(closed)) else np.full(len(closed), np.nan)
