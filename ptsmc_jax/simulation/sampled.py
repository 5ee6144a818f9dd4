"""The sampled loop: measured, computed and held over each control period; the plant by RK4 under what acts on it."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from ptsmc_jax.devices.actuators import Actuators, ActuatorState, Drive
from ptsmc_jax.devices.ticks import Ticks
from ptsmc_jax.numerics import draws, integrators, stacking
from ptsmc_jax.numerics.draws import WholeNumber
from ptsmc_jax.numerics.pytrees import Scalar
from ptsmc_jax.observers.base import Bound
from ptsmc_jax.simulation import run_state
from ptsmc_jax.simulation.assembly import Parts
from ptsmc_jax.simulation.computer import Computer, Period, Software, assumed_torque, schedule, star_state
from ptsmc_jax.simulation.interval import Torques
from ptsmc_jax.simulation.run_state import Flown, Log, Result, Run, RunState

DISTURBANCE_WALK = "disturbance_walk"
SAMPLE_TIMES = "timing_jitter_samples"


def walk_stream(seed: WholeNumber, trial: WholeNumber) -> draws.Key:
    """Key of the stream that a trial's random walk of the disturbance is drawn from."""
    return draws.stream(seed, trial, DISTURBANCE_WALK)


def jitter_stream(seed: WholeNumber, trial: WholeNumber) -> draws.Key:
    """Key of the stream that the deviations of a trial's samples from their times are drawn from."""
    return draws.stream(seed, trial, SAMPLE_TIMES)


class PeriodMotion(NamedTuple):
    """The true plant in a control period, from a state on, under the period's drive and the disturbance."""

    parts: Parts
    t: Scalar  # start of the period [s]
    x: Any  # true state then
    drive: Drive
    walk: Array | None  # disturbance besides, constant over the period, (m,) [N m]; None: no random walk
    rolled: bool = False  # integrate by a loop over the stages: slower, but less to compile

    def at(self, time: Scalar) -> Any:
        """The state at a time [s] in the period."""
        return self.after(time - self.t)

    def after(self, dt: Scalar) -> Any:
        """The state dt [s] into the period."""
        parts, drive, walk = self.parts, self.drive, self.walk
        actuators = parts.effective_actuators
        step = dt / parts.substeps

        def substep(k: Scalar, x: Any) -> Any:
            start, applied = self.t + k * step, actuators.over(drive, k * step, step)

            def rate(time: Scalar, y: Any) -> Any:
                d = parts.disturbance(time, y)
                torque = applied.at(time - start, parts.plant.velocity(y))
                return parts.plant.rate(time, y, torque, d if walk is None else d + walk)

            return integrators.rk4(rate, start, x, step, rolled=self.rolled or parts.plant.of_own_functions)

        if parts.substeps == 1:
            return parts.plant.normalise(substep(jnp.zeros_like(dt), self.x))
        starts = jnp.arange(parts.substeps, dtype=dt.dtype)
        return parts.plant.normalise(jax.lax.scan(lambda x, k: (substep(k, x), None), self.x, starts)[0])


def period_torques(actuators: Actuators, drive: Drive, u: Array, dt: Scalar) -> Torques:
    """Commanded and delivered torques of a control period, and the momentum of the wheels in it."""
    ends = actuators.at(drive, jnp.zeros_like(dt)), actuators.at(drive, dt)
    nodes, weights, momentum, torque = ends[:1], (1.0,), None, None
    if actuators.moves or actuators.wheels is not None:
        # a lag may change the sign of the torque within the period, where the momentum may then peak
        middle = actuators.at(drive, dt / 2)
        if actuators.moves:
            nodes, weights = (ends[0], middle, ends[1]), (1 / 6, 4 / 6, 1 / 6)
        stored = [momentum for _, momentum in (middle, ends[1]) if momentum is not None]
        if stored:
            momentum = jnp.stack(stored)
            torque = jnp.stack([ends[0][0], ends[1][0]])  # it is monotonic in between, so its ends bound it
    delivered = tuple(actuators.on_body(v) for v, _ in nodes)
    return Torques((u,) * len(nodes), delivered, weights, drive.limited, momentum, torque)


class _Equipment(NamedTuple):
    """The state of computer, devices and noise between two control periods."""

    computer: Computer
    actuators: ActuatorState
    walk: Array | None  # random walk of the disturbance, (m,) [N m]
    star_x: Any  # `star_state` of the period before
    offset: Array | None  # by how much the sample comes after its time [s]; None: never


class _Loop(NamedTuple):
    """The constants of a sampled run, and what happens in a control period."""

    run: Run
    software: Software
    actuators: Actuators
    k2: Bound
    period_of: Callable[[tuple], Period]
    walk_key: draws.Key | None  # None: no walk
    jitter_key: draws.Key | None  # None: samples come at their times

    def offset(self, t: Scalar, sample: Array) -> Array | None:
        """How much later than t a sample comes [s]; the first one and the end of the run are not moved."""
        parts = self.run.parts
        if self.jitter_key is None:
            return None
        largest = jnp.minimum(parts.jitter * parts.period, jnp.minimum(t, parts.t_end - t) / 2.0)
        return largest * (2.0 * draws.uniforms(self.jitter_key, 1, sample)[0] - 1.0)

    def fly(self, carry: tuple[RunState, _Equipment], tick: tuple) -> tuple[tuple[RunState, _Equipment], Log | None]:
        """A control period, and its row of the history where that is asked for."""
        (now, *_), (state, hardware) = tick, carry
        parts, actuators = self.run.parts, self.actuators
        nominal_dt = now.t_next - now.t  # flight software takes samples to come at their times
        next_offset = self.offset(now.t_next, now.sample + 1)
        if next_offset is not None:
            now = now._replace(t=now.t + hardware.offset, t_next=now.t_next + next_offset)
        dt = now.t_next - now.t
        computer = hardware.computer._replace(applied=(state.u, None)) if actuators.holds else hardware.computer
        period = self.period_of(tick)._replace(star_x=hardware.star_x)
        decision, computer = self.software.decide(
            parts, self.k2, period, computer, parts.plant.visible(state.x), hardware.actuators
        )
        # the error is judged by where the reference is, not by where flight software takes it to be
        target = decision.target if next_offset is None else parts.reference(now.t)
        drive, queue = actuators.command(
            hardware.actuators, decision.u, decision.w, now.t, period.assumed_length, now.noise_weight
        )
        if decision.channels is not None:
            drive = drive._replace(c=decision.channels)
        walk = hardware.walk
        if walk is not None:
            assert self.walk_key is not None
            walk = walk + parts.walk_rate * dt * draws.normals(self.walk_key, parts.plant.inputs, now.sample)
        torques = period_torques(actuators, drive, decision.u, dt)
        row = None
        if self.run.record:
            wheels = None if actuators.wheels is None else (drive.h, actuators.at(drive, jnp.zeros_like(dt))[0])
            signals = decision.d_hat, torques.delivered[0], decision.u, decision.s
            row = run_state.row(self.run, now.t, state.x, target, signals, dt > 0.0, walk, wheels)
        motion = PeriodMotion(parts, now.t, state.x, drive, walk)
        seen = None if parts.sensors is None else computer.seen
        at_t_f = motion._replace(rolled=True).at  # once in a run
        flown = Flown(motion.at(now.t_next), at_t_f, torques, dt / parts.substeps, seen, computer.law)
        state = run_state.advance(self.run, state, now, target, flown)
        applied = None if actuators.holds else assumed_torque(actuators, drive, nominal_dt)
        computer = computer._replace(applied=applied)
        actuator_state = actuators.end(hardware.actuators, drive, queue, dt)
        star_x = star_state(parts, now, motion.at)
        return (state, _Equipment(computer, actuator_state, walk, star_x, next_offset)), row

    def last_row(self, state: RunState, hardware: _Equipment, rows: Log) -> Log:
        """Return the row at t_end: the estimate and s of a sample there, and the torque held until then."""
        run, t = self.run, self.run.criteria.t_end
        d_hat, s = (signal[jnp.argmax(rows.t >= t)] for signal in (rows.d_hat, rows.s))
        h, v = hardware.actuators.h, hardware.actuators.v
        signals, wheels = (d_hat, state.u, state.u, s), None if h is None else (h, v)
        target, has_length = run.parts.reference(t), jnp.asarray(True)
        return run_state.row(run, t, state.x, target, signals, has_length, hardware.walk, wheels)


def _with_end(ticks: Ticks, t_end: Scalar) -> Ticks:
    """Append a sample at t_end, whose period has no length and changes no metric."""
    end = Ticks(t_end, t_end, jnp.asarray(True), ticks.sample[-1] + 1, jnp.ones_like(t_end), jnp.asarray(False))
    return jax.tree.map(lambda many, one: jnp.append(many, one.astype(many.dtype)), ticks, end)


def fly(run: Run, seed: WholeNumber, trial: WholeNumber, software: Software) -> Result:
    """A sampled run; see `rollout.simulate`."""
    parts, actuators = run.parts, run.parts.effective_actuators
    k2 = parts.observer.error_bound()
    ticks = _with_end(run.ticks, run.criteria.t_end) if run.record else run.ticks
    periods, period_of, first_period = schedule(parts, ticks)
    walk_key = None if parts.walk_rate is None else walk_stream(seed, trial)
    jitter_key = None if parts.jitter is None else jitter_stream(seed, trial)
    loop = _Loop(run, software, actuators, k2, period_of, walk_key, jitter_key)
    actuator_state = actuators.begin(parts.plant.inputs)
    state = run_state.begin(run, actuator_state.h)
    first = state.snapshot
    walk = None if parts.walk_rate is None else jnp.zeros(parts.plant.inputs)
    computer = software.boot(parts, seed, trial, parts.plant.visible(run.x0), first_period)
    if actuators.holds:  # `RunState.u` is what they did
        computer = computer._replace(applied=None)
    offset = loop.offset(run.ticks.t[0], run.ticks.sample[0])
    hardware = _Equipment(computer, actuator_state, walk, star_state(parts, first_period, lambda t: run.x0), offset)
    (state, hardware), rows = stacking.scan(loop.fly, (state, hardware), periods)
    log = None
    if rows is not None:
        log = run_state.history(jax.tree.map(lambda v: v[:-1], rows), loop.last_row(state, hardware, rows))
    return run_state.finish(run, first, state, log, software.statuses(hardware.computer))
