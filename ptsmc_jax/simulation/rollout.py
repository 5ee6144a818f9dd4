"""The one time loop: parts in, metrics, status and (if asked for) the history out. It knows no law and no plant.

`simulate` is pure and composes with jit, vmap, grad and jvp; every number in `Parts` is a leaf, so another gain,
inertia or noise is the same compiled program.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from ptsmc_jax import programs
from ptsmc_jax.devices.actuators import Actuators, Drive
from ptsmc_jax.devices.ticks import Ticks
from ptsmc_jax.laws.base import Sample
from ptsmc_jax.numerics import draws, guards, integrators, matrices
from ptsmc_jax.numerics.draws import WholeNumber
from ptsmc_jax.numerics.pytrees import Scalar
from ptsmc_jax.observers.base import Observer
from ptsmc_jax.simulation import metrics, pointing
from ptsmc_jax.simulation.assembly import Parts
from ptsmc_jax.simulation.computer import OURS, Computer, Software, brought_about, schedule, seen_within
from ptsmc_jax.simulation.interval import Arrival, Criteria, Errors, Interval, Snapshot, Start
from ptsmc_jax.simulation.metric_rows import Running

OK, DIVERGED, TOO_FAST, SINGULAR, MISSED, UNBOUNDED, UNFINISHED = range(7)
# code: (status, reason)
STATUS = {
    OK: ("ok", ""),
    DIVERGED: ("diverged", "the state is not finite"),
    TOO_FAST: ("diverged", "the body turns more than 1 rad in an integration step"),
    SINGULAR: ("singular", "the law's singularity came nearer than 1e-3"),
    MISSED: ("missed", "at t_f more than 5 % of the initial error is left"),
    UNBOUNDED: ("diverged", "a metric is not finite"),
    UNFINISHED: ("unfinished", "the clock was made for other gains, and has too few samples for these"),
}
FINISHED = (OK, MISSED)  # flown to t_end: the metrics are those of the run
SINGULAR_CLEARANCE = 1e-3  # there the law's gain, which grows like 1 / clearance, is a thousand times as large
LEFT = 0.05  # share of the initial angle, and SETTLED settling angles, beyond which a run has missed t_f
SETTLED = 10.0
DISTURBANCE_WALK = "disturbance_walk"
SAMPLE_TIMES = "timing_jitter_samples"


class Log(NamedTuple):
    """History at the start of each interval and at t_end; arrays (time, component), time (time,)."""

    t: Array  # [s]
    x: Any  # true state
    d_hat: Array  # estimated disturbance [N m]
    u: Array  # delivered torque, from this time on [N m]
    commanded: Array  # [N m]
    s: Array  # sliding variable that the law used
    disturbance: Array  # true disturbance [N m]
    reference: Any  # what the reference is then
    error: Array  # what the law drives to zero: the attitude error vector [-], for a chain x_1
    wheels: tuple[Array, Array] | None  # momentum of each reaction wheel [N m s], and its torque [N m]
    has_length: Array  # bool: the row starts an interval of positive length, or is the last


class Result(NamedTuple):
    """What a run returns: its metrics, its status code (see `STATUS`) with the first bad time, NaN if none [s]."""

    metrics: metrics.Metrics
    status: Array
    bad_time: Array
    log: Log | None


class _State(NamedTuple):
    x: Any
    u: Array  # delivered at the end of the last interval
    snapshot: Snapshot
    running: Running
    status: Array
    bad_time: Array


class _Course(NamedTuple):
    """What a run begins with and is judged by."""

    criteria: Criteria
    x0: Any
    first: Any  # the reference at t = 0
    arrival: Any  # and at t_f
    clearance_unit: Array  # what the run's clearances from the law's singularity are divided by
    gap: Array  # first time that the clock has no samples for [s]; NaN: it has them from t = 0 to t_end


class _World(NamedTuple):
    """What the sampled loop carries besides."""

    computer: Computer
    acting: Any  # state of the actuators
    pushed: Array | None  # random walk of the disturbance [N m]
    within: Any  # what sensors saw in the period before, see `computer.seen_within`
    late: Array | None  # by how much the sample comes after its time; None: never [s]


def simulate(
    parts: Parts, seed: WholeNumber = 0, trial: WholeNumber = 0, record: bool = False, software: Software = OURS
) -> Result:
    """One closed-loop run. seed, trial: whole numbers below 2^32 that name its noise; record: return the history too.

    software: the flight computer of a sampled loop, where it is not the parts' own code.
    A run that goes wrong never raises: it returns a status and the first bad time, and its metrics as they came out.
    """
    ticks = parts.clock.ticks(parts.controller.t_f, parts.controller.delta)
    observed = None if parts.pointing is None else parts.pointing.of_run(ticks.t.size)
    criteria = Criteria(parts.controller.t_f, parts.t_end, parts.window, parts.settling_angle, observed)
    target = parts.reference(jnp.zeros_like(parts.t_end))
    x0 = parts.controller.align(parts.initial, target)
    unit = parts.controller.clearance_unit(parts.controller.clearance(x0, target))
    arrival = parts.reference(criteria.t_f)
    course = _Course(criteria, x0, target, arrival, jax.lax.stop_gradient(unit), _gap(ticks, parts.t_end))
    if parts.clock.sampled:
        return _sampled(parts, ticks, course, seed, trial, record, software)
    return _continuous(parts, ticks, course, record)


def _gap(ticks: Ticks, t_end: Scalar) -> Scalar:
    """First time without samples [s], where the clock was made for shorter t_f or delta than it got; NaN: none."""
    first, last = ticks.t[0], ticks.t_next[-1]
    ends = jnp.where(last < t_end * (1.0 - 1e-9), last, jnp.nan)  # not by rounding
    return jax.lax.stop_gradient(jnp.where(first > 0.0, 0.0, ends))


def walk_stream(seed: WholeNumber, trial: WholeNumber) -> draws.Key:
    """The stream that a trial's random walk of the disturbance is drawn from."""
    return draws.stream(seed, trial, DISTURBANCE_WALK)


def jitter_stream(seed: WholeNumber, trial: WholeNumber) -> draws.Key:
    """The stream that the deviations of a trial's samples from their times are drawn from."""
    return draws.stream(seed, trial, SAMPLE_TIMES)


# One compiled program for all parts of the same structure.
simulate_jit = programs.jit(simulate, static_argnames=("record", "software"))


def _sampled(parts: Parts, ticks: Ticks, course: _Course, seed, trial, record, software: Software) -> Result:
    """Measured, computed and held over each control period; digital observer; plant by RK4 under what acts on it."""
    actuators = Actuators() if parts.actuators is None else parts.actuators
    k2 = parts.observer.error_bound()
    listed, period_of, started = schedule(parts, ticks)
    walk, jitter = walk_stream(seed, trial), jitter_stream(seed, trial)

    def late(t: Scalar, sample: Array) -> Scalar:
        """How much later than t a sample comes [s]; the first one and the end of the run are not moved."""
        assert parts.jitter is not None
        most = jnp.minimum(parts.jitter * parts.period, jnp.minimum(t, parts.t_end - t) / 2.0)
        return most * (2.0 * draws.uniforms(jitter, 1, sample)[0] - 1.0)

    def period(carry: tuple[_State, _World], tick: tuple) -> tuple[tuple[_State, _World], Any]:
        (now, *_), (state, world) = tick, carry
        nominal, pushed, next_late = now.t_next - now.t, world.pushed, None
        if parts.jitter is not None:  # flight software takes samples to come at their times
            next_late = late(now.t_next, now.sample + 1)
            now = now._replace(t=now.t + world.late, t_next=now.t_next + next_late)
        dt = now.t_next - now.t
        computer = world.computer._replace(applied=(state.u, None)) if actuators.holds else world.computer
        (target, d_hat, u, s, w, channels), computer = software.decide(
            parts,
            k2,
            period_of(tick)._replace(within=world.within),
            computer,
            parts.plant.visible(state.x),
            world.acting,
        )
        drive, queue = actuators.command(world.acting, u, w, now.t, dt, now.noise_weight)
        drive = drive if channels is None else drive._replace(c=channels)
        if parts.walk_rate is not None:
            pushed = pushed + parts.walk_rate * dt * draws.normals(walk, parts.plant.inputs, now.sample)
        torques = _torques(actuators, drive, u, dt)
        row = None
        if record:
            wheels = None if actuators.wheels is None else actuators.wheels_at(drive, jnp.zeros_like(dt))
            delivered = torques.delivered[0]
            row = _row(parts, now.t, state.x, target, d_hat, delivered, u, s, dt > 0.0, pushed, wheels)
        start = state.x

        def until(t: Scalar) -> Any:
            return over_period(parts, now.t, start, drive, pushed, t - now.t)

        sight, flown = None if parts.sensors is None else computer.seen, until(now.t_next)
        state = _advance(parts, course, state, now, target, flown, torques, until, dt / parts.substeps, sight)
        computer = computer._replace(applied=None if actuators.holds else brought_about(actuators, drive, nominal))
        acting, within = actuators.end(world.acting, drive, queue, dt), seen_within(parts, now, until)
        return (state, _World(computer, acting, pushed, within, next_late)), row

    acting = actuators.begin(parts.plant.inputs)
    state = _begin(parts, course, acting.h)
    first = state.snapshot
    pushed = None if parts.walk_rate is None else jnp.zeros(parts.plant.inputs)
    computer = software.boot(parts, seed, trial, parts.plant.visible(course.x0), started)
    if actuators.holds:  # the state has it
        computer = computer._replace(applied=None)
    first_late = None if parts.jitter is None else late(ticks.t[0], ticks.sample[0])
    world = _World(computer, acting, pushed, seen_within(parts, started, lambda t: course.x0), first_late)
    (state, world), rows = jax.lax.scan(period, (state, world), listed)
    return _finish(parts, course, first, state, world.computer.memory, k2, rows, world)


def _torques(actuators: Actuators, drive: Drive, u: Array, dt: Scalar) -> "_Torques":
    """Commanded and delivered torques of a control period, and the momentum of the wheels in it."""
    weights, delivered, stored, turned = (1.0,), (actuators.torque(drive, jnp.zeros_like(dt)),), None, None
    if actuators.moves:
        weights = (1 / 6, 4 / 6, 1 / 6)
        delivered = (*delivered, actuators.torque(drive, dt / 2), actuators.torque(drive, dt))
    if actuators.wheels is not None:  # in the middle too: a lag may turn the torque around within the period
        stored = jnp.stack([actuators.wheels_at(drive, time)[0] for time in (dt / 2, dt)])
        # which goes one way in between
        turned = jnp.stack([actuators.wheels_at(drive, time)[1] for time in (jnp.zeros_like(dt), dt)])
    return _Torques((u,) * len(delivered), delivered, weights, drive.limited, stored, turned)


def over_period(parts: Parts, t: Scalar, x: Any, drive: Drive, pushed: Array | None, dt: Scalar) -> Any:
    """The true plant's state dt [s] into a control period from t [s], under the period's drive and a torque besides.

    pushed: that torque, constant over the period, (m,) [N m]; None: no random walk.
    """
    actuators = Actuators() if parts.actuators is None else parts.actuators
    step = dt / parts.substeps

    def substep(k: Scalar, x: Any) -> Any:
        start, push = t + k * step, actuators.over(drive, k * step, step)

        def rate(time: Scalar, y: Any) -> Any:
            d = parts.disturbance(time, y)
            acting = push.at(time - start, parts.plant.velocity(y))
            return parts.plant.rate(time, y, acting, d if pushed is None else d + pushed)

        return integrators.rk4(rate, start, x, step)

    if parts.substeps == 1:
        return parts.plant.normalise(substep(jnp.zeros_like(dt), x))
    starts = jnp.arange(parts.substeps, dtype=dt.dtype)
    return parts.plant.normalise(jax.lax.scan(lambda x, k: (substep(k, x), None), x, starts)[0])


def _continuous(parts: Parts, ticks: Ticks, course: _Course, record) -> Result:
    """Law and observer inside the integrator's stages; the observer's linear part exact in every step."""
    controller = parts.controller
    observer: Observer = parts.observer
    model = observer.model
    k2 = observer.error_bound()
    lengths = ticks.t_next - ticks.t
    slopes = jax.vmap(observer.decay_matrix)(ticks.t, ticks.t_next)
    largest = jnp.max(jax.vmap(lambda a, dt: matrices.row_norm(a) * dt)(slopes, lengths))
    decays = jax.vmap(lambda a, dt: integrators.decay(a, dt, largest))(slopes, lengths)

    def step(carry: tuple[_State, Array], tick: tuple) -> tuple[tuple[_State, Array], Any]:
        (now, linear), (state, before) = tick, carry
        dt, target = now.t_next - now.t, parts.reference(now.t)

        def rate(t: Scalar, x: Any, memory: Array) -> tuple[Any, Array, tuple[Array, Array]]:
            u, s = controller.torque(t, now.hold, x, parts.reference(t), observer.estimate(memory), k2(t))
            x_dot = parts.plant.rate(t, x, u, parts.disturbance(t, x))
            seen = model.unexplained(t, x, x_dot, u)
            return x_dot, observer.forcing(t, (now.t, now.t_next), memory, seen), (u, s)

        x, memory, (u, s), (u_middle, _) = integrators.etdrk4(rate, linear, now.t, state.x, before, dt)
        d_hat = observer.estimate(before)
        row = _row(parts, now.t, state.x, target, d_hat, u, u, s, dt > 0.0) if record else None
        x = parts.plant.normalise(x)
        _, _, (u_end, _) = rate(now.t_next, x, memory)
        three = (u, u_middle, u_end)
        torques = _Torques(three, three, (1 / 6, 4 / 6, 1 / 6), jnp.asarray(False), None)
        return (_advance(parts, course, state, now, target, x, torques, lambda t: x, dt), memory), row

    state = _begin(parts, course)
    first = state.snapshot
    (state, memory), rows = jax.lax.scan(step, (state, observer.begin()), (ticks, decays))
    return _finish(parts, course, first, state, memory, k2, rows, None)


def _begin(parts: Parts, course: _Course, wheels: Array | None = None) -> _State:
    criteria, x0 = course.criteria, course.x0
    zero, none = jnp.zeros_like(criteria.t_f), jnp.zeros(parts.plant.inputs)
    snapshot = _snapshot(parts, course.first, x0)
    state = _State(
        x=x0,
        u=none,
        snapshot=snapshot,
        running=metrics.begin(_start(parts, snapshot, wheels), criteria),
        status=jnp.int32(OK),
        bad_time=jnp.full_like(zero, jnp.nan),
    )
    status, bad_time = _watch(parts, course, state, course.first, zero, zero, none)
    return state._replace(status=status, bad_time=bad_time)


class _Torques(NamedTuple):
    """Torques of an interval at the quadrature nodes of `weights`, the last one at its end."""

    commanded: tuple[Array, ...]
    delivered: tuple[Array, ...]
    weights: tuple[float, ...]
    limited: Array
    wheel_momentum: Array | None
    wheel_torque: Array | None = None


def _advance(parts, course, state: _State, now: Ticks, target, x, torques: _Torques, until, step, seen=None) -> _State:
    """The state after an interval: metrics and status. until: time in it -> the plant's state then.

    step: longest integration step taken in it [s]; seen: what the law saw of the state at its start.
    """
    law, criteria, target_next = parts.controller, course.criteria, parts.reference(now.t_next)
    snapshot = _snapshot(parts, target_next, x)

    def errors() -> Errors:
        return Errors(*law.errors(state.x, target), *law.errors(x, target_next))

    def arrival() -> Arrival:
        reached = until(criteria.t_f)
        return Arrival(law.errors(reached, course.arrival)[0], law.angle(reached, course.arrival))

    observed = ()
    if parts.pointing is not None:
        frame, length = parts.pointing.frame, now.t_next - now.t
        observed = (
            lambda: pointing.course((state.x, target), (x, target_next), frame, length),
            None if seen is None else lambda: pointing.held(seen.q, state.x.q, frame, length),
        )
    interval = Interval(now.t, now.t_next, state.snapshot, snapshot, errors, arrival, state.u, *torques, *observed)
    after = state._replace(
        x=x,
        u=jnp.where(now.t_next > now.t, torques.delivered[-1], state.u),
        snapshot=snapshot,
        running=metrics.update(state.running, interval, criteria),
    )
    status, bad_time = _watch(parts, course, after, target_next, now.t_next, step, torques.delivered[-1])
    return after._replace(status=status, bad_time=bad_time)


def _finish(parts: Parts, course, first, state: _State, memory: Any, k2, rows, world: _World | None) -> Result:
    criteria = course.criteria
    log, angle_at_t_f = None, state.running.arrival.angle
    acting = None if world is None else world.acting
    if rows is not None:  # the last row: the state at t_end, with the torque held until then or as it is there
        target = parts.reference(criteria.t_end)
        hold = criteria.t_end >= parts.controller.hand_over
        d_hat = parts.observer.estimate(memory)
        at_end = state.x, target, d_hat, k2(criteria.t_end)
        if world is None:
            u, s = parts.controller.torque(criteria.t_end, hold, *at_end)
        else:  # the input is held
            sample = Sample(criteria.t_end, hold, parts.period)
            _, s, _ = parts.controller.command(world.computer.law, sample, *at_end)
            u = state.u
        pushed = None if world is None else world.pushed
        wheels = None if acting is None or acting.h is None else (acting.h, acting.v)
        last = _row(parts, criteria.t_end, state.x, target, d_hat, u, u, s, jnp.asarray(True), pushed, wheels)
        log = jax.tree.map(lambda many, one: jnp.concatenate([many, jnp.asarray(one)[None]]), rows, last)
    values = metrics.finish(state.running, criteria)
    start = _start(parts, first, None if acting is None else acting.h)
    unbounded = (state.status == OK) & metrics.unbounded(values, metrics.begin(start, criteria))
    missed = (state.status == OK) & (angle_at_t_f > jnp.maximum(LEFT * first.angle, SETTLED * criteria.settling_angle))
    cut = (state.status == OK) & ~jnp.isnan(course.gap)
    status = jnp.where(unbounded, UNBOUNDED, jnp.where(missed, MISSED, state.status))
    status = jnp.where(cut, UNFINISHED, status).astype(jnp.int32)
    bad_time = jnp.where(unbounded, criteria.t_end, jnp.where(missed, criteria.t_f, state.bad_time))
    bad_time = jnp.where(cut, course.gap, bad_time)
    return Result(values, status, bad_time, log)


def _start(parts: Parts, snapshot: Snapshot, wheels: Array | None) -> Start:
    return Start(snapshot, parts.plant.inputs, wheels, measured=parts.sensors is not None)


def _snapshot(parts: Parts, target: Any, x: Any) -> Snapshot:
    angle = parts.controller.angle(x, target)
    plant = parts.plant
    return Snapshot(angle, plant.speed(x), guards.norm(plant.momentum(x)), plant.modal_amplitude(x))


def _watch(
    parts: Parts, course: _Course, state: _State, target: Any, t: Scalar, dt: Scalar, u: Array
) -> tuple[Array, Array]:
    """Status and first bad time of the state at t; the first thing that goes wrong stays."""
    finite = jnp.isfinite(sum(jnp.sum(leaf) for leaf in jax.tree.leaves((state.x, u))))
    fast = parts.plant.too_fast(state.x, dt)
    near = ~(parts.controller.clearance(state.x, target) / course.clearance_unit >= SINGULAR_CLEARANCE)
    code = jnp.where(~finite, DIVERGED, jnp.where(near, SINGULAR, jnp.where(fast, TOO_FAST, OK))).astype(jnp.int32)
    first = (state.status == OK) & (code != OK)
    return jnp.where(first, code, state.status), jnp.where(first, t, state.bad_time)


def _row(parts: Parts, t, x, target, d_hat, u, commanded, s, has_length, pushed=None, wheels=None) -> Log:
    d = parts.disturbance(t, x)
    error, _ = parts.controller.errors(x, target)
    return Log(t, x, d_hat, u, commanded, s, d if pushed is None else d + pushed, target, error, wheels, has_length)
