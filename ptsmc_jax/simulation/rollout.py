"""Simulate one run: from its parts to metrics, status and history.

`simulate` is a pure function. It composes with jit, vmap, grad and jvp. Every number in `Parts` is a leaf of a pytree,
so other gains, inertias or noises reuse the compiled program. `simulate_parts` is the compiled function.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, PyTree

from ptsmc_jax import programs
from ptsmc_jax.devices.ticks import Ticks
from ptsmc_jax.laws.base import Sample
from ptsmc_jax.numerics import guards, integrators, matrices, stacking
from ptsmc_jax.numerics.draws import WholeNumber, check_fits
from ptsmc_jax.numerics.pytrees import Scalar, listing
from ptsmc_jax.simulation import metrics, pointing
from ptsmc_jax.simulation.assembly import Parts, check_parts
from ptsmc_jax.simulation.clock import Graded
from ptsmc_jax.simulation.computer import PYTHON_SOFTWARE, Computer, Decision, Software
from ptsmc_jax.simulation.control_period import Record, State, control_period, schedule, start
from ptsmc_jax.simulation.metrics import Arrival, Criteria, Errors, Interval, Snapshot, Start, Torques

OK, DIVERGED, TOO_FAST, SINGULAR, NOT_CONVERGED, UNBOUNDED, INCOMPLETE = range(7)
# code: (status, reason)
STATUS = {
    OK: ("ok", ""),
    DIVERGED: ("diverged", "the state, the torque or the law's memory is not finite"),
    TOO_FAST: ("diverged", "the body turns more than 1 rad in an integration step"),
    SINGULAR: ("singular", "the law's singularity came nearer than 1e-3"),
    NOT_CONVERGED: ("not_converged", "at t_f more than 5 % of the initial error is left"),
    UNBOUNDED: ("diverged", "a metric is not finite"),
    INCOMPLETE: ("incomplete", "the clock was made for other gains, and has too few samples or steps for these"),
}
FINISHED = (OK, NOT_CONVERGED)  # statuses of runs that were simulated to t_end
# distance to the singularity of the law at which a run counts as singular; the law's gain grows like 1 / distance
SINGULAR_DISTANCE = 1e-3
# a run has not converged if its angle at t_f is larger than both of these
NOT_CONVERGED_FRACTION = 0.05  # fraction of the initial angle
NOT_CONVERGED_SETTLING_ANGLES = 10.0


def has_finished(status: ArrayLike) -> Array:
    """Return whether runs were simulated to t_end, so that their metrics count, even if they did not converge at t_f.

    Args:
        status: codes of `STATUS`, of any shape; they may be traced.

    Returns:
        An array of the same shape, bool.

    Raises:
        TypeError: the status is a name, such as "ok".

    >>> has_finished(jnp.array([0, 1, 4])).tolist()
    [True, False, True]
    """
    return jnp.isin(status, jnp.array(FINISHED))


class Log(NamedTuple):
    """History at the start of each interval and at t_end: arrays (time, component), and `t` (time,).

    In the sampled loop the row at t_end has d_hat and s of a further sample, and the torques held until t_end.
    """

    t: Array  # time [s]
    x: PyTree  # true state; of a spacecraft `x.q`, quaternion with the scalar last [-], and `x.w`, body rate [rad/s]
    d_hat: Array  # estimated disturbance [N m]
    u: Array  # torque that the actuators deliver from this time on [N m]
    commanded: Array  # torque that the law commands, after a command filter, before limits and delay [N m]
    s: Array  # sliding variable that the law used
    disturbance: Array  # true disturbance [N m]
    reference: PyTree  # target of the reference, for a spacecraft with `q` [-], `w` [rad/s] and `w_dot` [rad/s^2]
    error: Array  # error that the law drives to zero: the attitude error vector [-]; for a chain x_1
    wheels: tuple[Array, Array] | None  # momentum [N m s] and torque [N m] of each reaction wheel
    has_length: Array  # bool: the interval of this row has a positive length, or the row is the last
    readings: dict[str, Array] | None = None  # sensor readings, see `Sensor.inputs`; None in the continuous loop
    sent: Array | None = None  # torque that the computer sends to the actuators [N m]; None in the continuous loop

    __repr__ = listing


class Result(NamedTuple):
    """The result of a run."""

    metrics: metrics.Metrics
    status: Array  # code, see `STATUS`
    bad_time: Array  # time of the first failure, at which the status changed [s]; NaN: the status is ok
    log: Log | None  # history; None: not recorded
    samples: dict[str, Array]  # number of samples by the status that exported C reports; empty for simulated software

    __repr__ = listing


class Run(NamedTuple):
    """The constants of a run."""

    parts: Parts
    ticks: Ticks
    criteria: Criteria
    x0: PyTree
    target_0: PyTree  # reference at t = 0
    target_t_f: PyTree  # reference at t_f
    singularity_distance_unit: Array  # divisor of the distance to the law's singularity, see `Kinematics`
    uncovered_from: Array  # first time without samples of the clock [s]; NaN: it covers t = 0 to t_end
    record: bool  # whether the history is recorded


class Score(NamedTuple):
    """Metrics and status of a run so far."""

    snapshot: Snapshot  # true state at the present time
    running: metrics.Running  # accumulators of the metrics
    status: Array  # code of the first failure, see `STATUS`
    bad_time: Array  # time of the first failure [s]; NaN: none


def simulate(
    parts: Parts,
    seed: WholeNumber = 0,
    trial: WholeNumber = 0,
    record: bool = False,
    software: Software = PYTHON_SOFTWARE,
) -> Result:
    """Simulate one closed-loop run. A run that diverges raises nothing: its status reports it.

    Args:
        parts: parts of the run.
        seed: whole number from 0 to 2^32 - 1 that selects the random numbers, together with `trial`.
        trial: whole number from 0 to 2^32 - 1.
        record: whether to return the history.
        software: flight software of a sampled loop; by default the law and observer of `parts`.

    Returns:
        Metrics, status, first bad time and history. The metrics of a diverged run are returned as computed.

    Raises:
        TypeError: the parts do not fit together.
    """
    _check_fit(parts)
    ticks = parts.clock.ticks(parts.controller.t_f, parts.controller.delta)
    pointing = None if parts.pointing is None else parts.pointing.for_run(ticks.t.size)
    criteria = Criteria(parts.controller.t_f, parts.t_end, parts.window, parts.settling_angle, pointing)
    target = parts.reference(jnp.zeros_like(parts.t_end))
    # the initial state may have integers or single precision; the run uses the precision of JAX
    x0 = jax.tree.map(lambda v: jnp.asarray(v, float), parts.aligned_initial)
    unit = parts.controller.kinematics.singularity_distance_unit(parts.controller.singularity_distance(x0, target))
    target_t_f = parts.reference(criteria.t_f)
    unit, uncovered_from = jax.lax.stop_gradient(unit), _first_time_without_samples(ticks, parts.t_end)
    if isinstance(parts.clock, Graded):
        is_too_coarse = parts.clock.is_too_coarse(parts.controller.t_f, parts.controller.delta)
        uncovered_from = jnp.where(is_too_coarse, 0.0, uncovered_from)
    run = Run(parts, ticks, criteria, x0, target, target_t_f, unit, uncovered_from, record)
    loop = _sampled_loop(run, seed, trial, software) if parts.clock.sampled else _continuous_loop(run)

    def step(carry: tuple[State, Score], interval: PyTree) -> tuple[tuple[State, Score], Log | None]:
        state, score = carry
        after, record = loop.step(state, interval)
        row = _history_row(run, state, after, record) if run.record else None
        return (after, _advance_score(run, score, state, after, record)), row

    first = _begin_score(run)
    (state, score), rows = stacking.scan(step, (loop.start, first), loop.intervals)
    log = None
    if rows is not None:
        last, n = loop.last_row(state, rows), ticks.t.size
        log = jax.tree.map(lambda column, value: jnp.concatenate([column[:n], jnp.asarray(value)[None]]), rows, last)
    samples = None if software.count_statuses is None else software.count_statuses(state.computer)
    return _finish(run, first, score, log, samples)


class Loop(NamedTuple):
    """The sampled or the continuous loop of a run."""

    step: Callable[[State, PyTree], tuple[State, Record]]  # simulates one control period or integration step
    start: State
    intervals: PyTree  # control periods or integration steps, arrays (intervals,)
    last_row: Callable[[State, Log], Log]  # last state and all rows -> row of the history at t_end


def _sampled_loop(run: Run, seed: WholeNumber, trial: WholeNumber, software: Software) -> Loop:
    """Return the loop of control periods."""
    ticks, t_end = run.ticks, run.criteria.t_end
    if run.record:  # the history ends with a sample at t_end, whose period has no length and changes no metric
        end = Ticks(t_end, t_end, jnp.asarray(True), ticks.sample[-1] + 1, jnp.ones_like(t_end), jnp.asarray(False))
        ticks = jax.tree.map(lambda column, value: jnp.append(column, value.astype(column.dtype)), ticks, end)
    vehicle, state = start(run.parts, ticks, run.x0, seed, trial, software)

    def last_row(state: State, rows: Log) -> Log:
        """Return the row with the estimate and s of a sample at t_end, and the torque held until then."""
        end_index = jnp.argmax(rows.t >= t_end)
        decision = Decision(run.parts.reference(t_end), rows.d_hat[end_index], state.torque, rows.s[end_index])
        h, v = state.actuators.h, state.actuators.v
        wheels = None if h is None or v is None else (h, v)
        row = _history_row_at(run, t_end, state.x, decision, state.torque, jnp.asarray(True), state.walk, wheels)
        readings, sent = jax.tree.map(lambda column: column[end_index], (rows.readings, rows.sent))
        return row._replace(readings=readings, sent=sent)

    return Loop(partial(control_period, vehicle), state, schedule(ticks), last_row)


def _continuous_loop(run: Run) -> Loop:
    """Return the loop of integration steps.

    Law and observer are integrated with the plant. The observer's linear part is exact (ETDRK4).
    """
    parts, ticks, controller = run.parts, run.ticks, run.parts.controller
    observer = parts.observer
    model = observer.model
    k2 = observer.error_bound()
    lengths = ticks.t_next - ticks.t
    decay_matrices = jax.vmap(observer.decay_matrix)(ticks.t, ticks.t_next)
    largest_decay = jnp.max(jax.vmap(lambda a, dt: matrices.row_norm(a) * dt)(decay_matrices, lengths))
    decays = jax.vmap(lambda a, dt: integrators.decay(a, dt, largest_decay))(decay_matrices, lengths)

    def step(state: State, interval: tuple[Ticks, integrators.Decay]) -> tuple[State, Record]:
        (now, decay), x, memory = interval, state.x, state.computer.observer
        dt, target = now.t_next - now.t, parts.reference(now.t)

        def rate(t: Scalar, x: PyTree, memory: Array) -> tuple[PyTree, Array, tuple[Array, Array]]:
            sample = Sample(t, now.hold, dt)
            u, s, _ = controller(sample, x, parts.reference(t), observer.estimate(memory), k2(t))
            x_dot = parts.plant.rate(t, x, u, parts.disturbance(t, x))
            d_eff = model.implied_disturbance(t, x, x_dot, u)
            return x_dot, observer.forcing(t, (now.t, now.t_next), memory, d_eff), (u, s)

        x_next, memory_next, (u, s) = integrators.etdrk4(rate, decay, now.t, x, memory, dt)
        x_next = parts.plant.normalise(x_next)
        _, _, (u_end, _) = rate(now.t_next, x_next, memory_next)
        u_nodes = u, u_end  # without the middle stage, whose torque oscillates from step to step in a thin layer
        torques = Torques(u_nodes, u_nodes, (1 / 2, 1 / 2), jnp.asarray(False), None)
        decision = Decision(target, observer.estimate(memory), u, s)
        torque = jnp.where(now.t_next > now.t, u_end, state.torque)
        after = State(x_next, torque, state.computer._replace(observer=memory_next))
        return after, Record(now, decision, torques, lambda time: x_next, dt)  # t_f is a node, so it ends a step

    def last_row(state: State, rows: Log) -> Log:
        """Return the row with the estimate, the command and s at t_end."""
        t, x, d_hat = run.criteria.t_end, state.x, observer.estimate(state.computer.observer)
        target, hold = parts.reference(t), t >= controller.hand_over
        u, s, _ = controller(Sample(t, hold, jnp.zeros_like(t)), x, target, d_hat, k2(t))
        return _history_row_at(run, t, x, Decision(target, d_hat, u, s), u, jnp.asarray(True))

    computer = Computer(None, None, observer.begin(), None, None)
    return Loop(step, State(run.x0, jnp.zeros(parts.plant.inputs), computer), (ticks, decays), last_row)


def _begin_score(run: Run) -> Score:
    """Return the accumulated metrics and the status at t = 0."""
    parts, zero, no_torque = run.parts, jnp.zeros_like(run.criteria.t_f), jnp.zeros(run.parts.plant.inputs)
    snapshot = _snapshot(parts, run.target_0, run.x0)
    momentum = None if parts.actuators.wheels is None else parts.actuators.wheels.initial
    start = Start(snapshot, parts.plant.inputs, momentum, measured=not parts.sensors.perfect)
    running = metrics.begin(start, run.criteria)
    score = Score(snapshot, running, jnp.int32(OK), jnp.full_like(zero, jnp.nan))
    return _check_state(run, score, run.x0, run.target_0, zero, zero, no_torque)


def _advance_score(run: Run, score: Score, before: State, after: State, record: Record) -> Score:
    """Return metrics and status after a control period, or after a step of the continuous loop.

    Args:
        run: constants of the run.
        score: metrics and status before the period.
        before: state at the start of the period.
        after: state at its end.
        record: record of the period.
    """
    kinematics, criteria, now = run.parts.controller.kinematics, run.criteria, record.now
    target_next = run.parts.reference(now.t_next)
    snapshot = _snapshot(run.parts, target_next, after.x)
    at_start, at_end, length = (before.x, record.decision.target), (after.x, target_next), now.t_next - now.t

    def errors() -> Errors:
        return Errors(*kinematics.errors(*at_start), *kinematics.errors(*at_end))

    def arrival() -> Arrival:
        x = record.x_after(criteria.t_f - now.t)
        return Arrival(kinematics.errors(x, run.target_t_f)[0], kinematics.angle(x, run.target_t_f))

    attitude_error = knowledge_error = None
    if criteria.pointing is not None:
        frame = criteria.pointing.frame
        attitude_error = partial(pointing.error_path, at_start, at_end, frame, length)
        if after.computer.seen is not None:
            knowledge_error = partial(pointing.constant_path, after.computer.seen.q, before.x.q, frame, length)
    interval = Interval(
        now.t, now.t_next, score.snapshot, snapshot, errors, partial(kinematics.middle_angle, at_start, at_end, length),
        arrival, before.torque, record.torques, attitude_error, knowledge_error,
    )  # fmt: skip
    score = score._replace(snapshot=snapshot, running=metrics.update(score.running, interval, criteria))
    u_end = record.torques.delivered[-1]
    return _check_state(run, score, after.x, target_next, now.t_next, record.step, u_end, after.computer.law)


def _history_row(run: Run, before: State, after: State, record: Record) -> Log:
    """Return the history row at the start of a control period or step; without `Record.tick` it has no sensor readings.

    Args:
        run: constants of the run.
        before: state at the start of the period.
        after: state at its end.
        record: record of the period.
    """
    now, tick, drive, decision, wheels = record.now, record.tick, record.drive, record.decision, None
    if drive is not None and drive.h is not None and record.torques.wheel_torque is not None:
        wheels = drive.h, record.torques.wheel_torque[0]
    u, has_length = record.torques.delivered[0], now.t_next > now.t
    row = _history_row_at(run, now.t, before.x, decision, u, has_length, after.walk, wheels)
    if tick is None:
        return row
    # the flight software measured the same; the compiler merges both computations
    parts, memory, seen = run.parts, before.computer.sensors, run.parts.plant.visible(before.x)
    readings, _ = parts.sensors.inputs(memory, seen, tick.now, tick.dt_before, before.star_x)
    return row._replace(readings=readings, sent=parts.actuators.send(before.actuators, decision.u, decision.w)[0])


def _history_row_at(
    run: Run,
    t: Scalar,
    x: PyTree,
    decision: Decision,
    u: Array,
    has_length: Array,
    walk: Array | None = None,
    wheels: tuple[Array, Array] | None = None,
) -> Log:
    """Return a row of the history.

    Args:
        run: constants of the run.
        t: time [s].
        x: true state.
        decision: decision of the flight software.
        u: delivered torque, (m,) [N m].
        has_length: whether the interval of the row has a positive length, or the row is the last.
        walk: random walk of the disturbance, (m,) [N m], or None.
        wheels: momentum [N m s] and torque [N m] of the reaction wheels, or None.
    """
    target, d_hat, commanded, s, *_ = decision
    d = run.parts.disturbance(t, x)
    error, _ = run.parts.controller.kinematics.errors(x, target)
    return Log(t, x, d_hat, u, commanded, s, d if walk is None else d + walk, target, error, wheels, has_length)


def _finish(run: Run, initial: Score, score: Score, log: Log | None, samples: dict[str, Array] | None = None) -> Result:
    """Return the result of a run.

    Args:
        run: constants of the run.
        initial: metrics and status at t = 0.
        score: metrics and status at t_end.
        log: history, or None.
        samples: number of samples by the status that exported C reports, or None.
    """
    criteria, angle_at_t_f = run.criteria, score.running.arrival.angle
    values = metrics.finish(score.running, criteria)
    unbounded = (score.status == OK) & metrics.is_unbounded(values)
    not_converged = (score.status == OK) & is_not_converged(
        angle_at_t_f, initial.snapshot.angle, criteria.settling_angle
    )
    # a run that the clock does not cover is incomplete, unless it failed while it was covered
    is_incomplete = ~jnp.isnan(run.uncovered_from) & ~(score.bad_time < run.uncovered_from)
    status = jnp.where(unbounded, UNBOUNDED, jnp.where(not_converged, NOT_CONVERGED, score.status))
    status = jnp.where(is_incomplete, INCOMPLETE, status).astype(jnp.int32)
    bad_time = jnp.where(unbounded, criteria.t_end, jnp.where(not_converged, criteria.t_f, score.bad_time))
    bad_time = jnp.where(is_incomplete, run.uncovered_from, bad_time)
    return Result(values, status, bad_time, log, samples or {})


def is_not_converged(angle_at_t_f: Scalar, initial_angle: Scalar, settling_angle: Scalar) -> Array:
    """Return whether a completed run has not converged at t_f.

    Args:
        angle_at_t_f: angle to the reference at t_f [rad].
        initial_angle: angle to the reference at t = 0 [rad].
        settling_angle: settling angle of the scenario [rad].
    """
    return angle_at_t_f > jnp.maximum(
        NOT_CONVERGED_FRACTION * initial_angle, NOT_CONVERGED_SETTLING_ANGLES * settling_angle
    )


def _snapshot(parts: Parts, target: PyTree, x: PyTree) -> Snapshot:
    """Return the quantities of a state x that metrics use; target: the reference."""
    angle, plant = parts.controller.kinematics.angle(x, target), parts.plant
    momentum = plant.momentum(x)
    momentum_norm = None if momentum is None else guards.norm(momentum)
    return Snapshot(angle, plant.speed(x), momentum_norm, plant.modal_amplitude(x))


def _check_state(
    run: Run, score: Score, x: PyTree, target: PyTree, t: Scalar, step: Scalar, u: Array, memory: PyTree = None
) -> Score:
    """Check the state at t, and return the score with status and `bad_time` of the first failure.

    Exported code rejects a memory of the law that is not finite, so the simulated run counts as diverged, too.
    """
    law, plant = run.parts.controller, run.parts.plant
    real_leaves = [
        leaf for leaf in jax.tree.leaves((x, u, memory)) if jnp.issubdtype(jnp.asarray(leaf).dtype, jnp.inexact)
    ]
    is_finite = jnp.isfinite(sum(jnp.sum(leaf) for leaf in real_leaves))
    is_too_fast = plant.is_too_fast(x, step)
    is_singular = ~(law.singularity_distance(x, target) / run.singularity_distance_unit >= SINGULAR_DISTANCE)
    code = jnp.where(
        ~is_finite, DIVERGED, jnp.where(is_singular, SINGULAR, jnp.where(is_too_fast, TOO_FAST, OK))
    ).astype(jnp.int32)
    is_first_failure = (score.status == OK) & (code != OK)
    return score._replace(
        status=jnp.where(is_first_failure, code, score.status), bad_time=jnp.where(is_first_failure, t, score.bad_time)
    )


def _check_fit(parts: Parts) -> None:
    """Raise TypeError if the parts do not fit together."""
    check_parts(parts)
    for name, shape in parts.plant.state_shapes.items():
        if name and not hasattr(parts.initial, name):
            names = ", ".join(parts.plant.state_shapes)
            raise TypeError(f"initial must be a state with {names}, such as parts.initial._replace({name}=...)")
        value = getattr(parts.initial, name) if name else parts.initial
        _check_shape(f"initial.{name}".rstrip("."), value, [shape])
    if not callable(parts.disturbance):
        raise TypeError(f"the disturbance must be a function of (t, x), but is {parts.disturbance!r}")
    value = jax.eval_shape(lambda: parts.disturbance(jnp.zeros_like(parts.t_end), parts.initial))
    _check_shape("the disturbance's value", value, [(parts.plant.inputs,), ()])
    if not parts.clock.sampled:
        _check_continuous(parts)


def _check_continuous(parts: Parts) -> None:
    """Raise TypeError if parts of a continuous loop have devices that only the sampled loop simulates."""
    only_sampled = [name for name in ("walk_rate", "command_filter", "jitter") if getattr(parts, name) is not None]
    present = {"sensors": not parts.sensors.perfect, "actuators": not parts.actuators.is_ideal}
    for name in (*(name for name, is_present in present.items() if is_present), *only_sampled):
        raise TypeError(f"the continuous loop cannot simulate {name}: remove {name}, or use a sampled clock")
    if not parts.controller.continuous:
        law = type(parts.controller).__name__
        raise TypeError(f"the law {law} needs the sampled loop: use a sampled clock")


def _check_shape(name: str, value: object, allowed: list[tuple[int, ...]]) -> None:
    """Raise TypeError if a value is not an array of an allowed shape; the message names the first one."""
    shape = getattr(value, "shape", None)
    if shape not in allowed:
        actual = f"of type {type(value).__name__}" if shape is None else f"one of shape {shape}"
        raise TypeError(f"{name} must be an array {allowed[0]}, but is {actual}")


def _first_time_without_samples(ticks: Ticks, t_end: Scalar) -> Scalar:
    """Return the first time without samples [s], or NaN. A clock made for a shorter t_f or delta lacks samples."""
    first, last = ticks.t[0], ticks.t_next[-1]
    end_of_samples = jnp.where(last < t_end - guards.time_tolerance(t_end, t_end), last, jnp.nan)
    return jax.lax.stop_gradient(jnp.where(first > 0.0, 0.0, end_of_samples))


class _SimulateProgram(programs.Program):
    """Compiled `simulate`. It checks the types of parts, seed and trial before JAX converts them to arrays."""

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """Check the arguments and call the program with the arguments of `simulate`."""
        arguments = dict(zip(("parts", "seed", "trial"), args, strict=False)) | kwargs
        check_parts(arguments.get("parts"))
        for name in ("seed", "trial"):
            check_fits(name, arguments.get(name))
        return super().__call__(*args, **kwargs)


# compiled `simulate`; one program serves all parts that differ in numbers only
simulate_parts = _SimulateProgram(simulate, ("record", "software"), title="the simulation")
# `simulate` for a single run: it compiles 2 to 10 times as fast, and runs 3 to 8 times as slowly
simulate_once = _SimulateProgram(simulate, ("record", "software"), programs.FAST_COMPILE, title="the simulation")
LONG_RUN = 20_000  # number of control periods above which the slower compilation of `simulate_parts` pays off


def single_run_program(parts: Parts) -> programs.Program:
    """Return the compiled `simulate` that is fastest for a single run, compilation included."""
    return simulate_parts if parts.clock.count > LONG_RUN else simulate_once
