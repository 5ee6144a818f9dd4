"""Metrics, status and history of a run, in either loop."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, PyTree

from ptsmc_jax.devices.ticks import Ticks
from ptsmc_jax.numerics import guards
from ptsmc_jax.numerics.pytrees import Scalar, listing
from ptsmc_jax.simulation import metrics, pointing
from ptsmc_jax.simulation.assembly import Parts
from ptsmc_jax.simulation.computer import Decision
from ptsmc_jax.simulation.control_period import Record, State
from ptsmc_jax.simulation.metrics import Arrival, Criteria, Errors, Interval, Snapshot, Start

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


class Log(NamedTuple):
    """History at the start of each interval and at t_end: arrays (time, component), and `t` (time,).

    In the sampled loop the row at t_end has d_hat and s of a further sample, and the torques held until t_end.
    """

    t: Array  # [s]
    x: PyTree  # true state
    d_hat: Array  # estimated disturbance [N m]
    u: Array  # torque delivered from this time on [N m]
    commanded: Array  # [N m]
    s: Array  # sliding variable that the law used
    disturbance: Array  # true disturbance [N m]
    reference: PyTree  # target of the reference
    error: Array  # error that the law drives to zero: the attitude error vector [-]; for a chain x_1
    wheels: tuple[Array, Array] | None  # momentum of each reaction wheel [N m s], and its torque [N m]
    has_length: Array  # bool: the interval of this row has a positive length, or the row is the last
    readings: dict[str, Array] | None = None  # sensor readings, see `Sensor.inputs`; None in the continuous loop
    sent: Array | None = None  # torque that the computer sends to the actuators [N m]

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
    uncovered_from: Array  # first time for which the clock has no samples [s]; NaN: it covers t = 0 to t_end
    record: bool  # whether the history is recorded


class Score(NamedTuple):
    """Metrics and status of a run so far."""

    snapshot: Snapshot  # true state at the present time
    running: metrics.Running  # accumulators of the metrics
    status: Array  # code of the first failure, see `STATUS`
    bad_time: Array  # time of the first failure [s]; NaN: none


def begin(run: Run) -> Score:
    """Return the accumulated metrics and the status at t = 0."""
    parts, zero, no_torque = run.parts, jnp.zeros_like(run.criteria.t_f), jnp.zeros(run.parts.plant.inputs)
    snapshot = _snapshot(parts, run.target_0, run.x0)
    momentum = None if parts.actuators.wheels is None else parts.actuators.wheels.initial
    start = Start(snapshot, parts.plant.inputs, momentum, measured=not parts.sensors.perfect)
    running = metrics.begin(start, run.criteria)
    score = Score(snapshot, running, jnp.int32(OK), jnp.full_like(zero, jnp.nan))
    return _check_state(run, score, run.x0, run.target_0, zero, zero, no_torque)


def advance(run: Run, score: Score, before: State, after: State, record: Record) -> Score:
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


def history_row(run: Run, before: State, after: State, record: Record) -> Log:
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
    row = history_row_at(run, now.t, before.x, decision, u, has_length, after.walk, wheels)
    if tick is None:
        return row
    # the flight software measured the same; the compiler merges both computations
    parts, memory, seen = run.parts, before.computer.sensors, run.parts.plant.visible(before.x)
    readings, _ = parts.sensors.inputs(memory, seen, tick.now, tick.dt_before, before.star_x)
    return row._replace(readings=readings, sent=parts.actuators.send(before.actuators, decision.u, decision.w)[0])


def history_row_at(
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


def history(rows: Log, last: Log) -> Log:
    """Append the last row to the rows of the history, arrays (time, ...)."""
    return jax.tree.map(lambda column, value: jnp.concatenate([column, jnp.asarray(value)[None]]), rows, last)


def finish(run: Run, initial: Score, score: Score, log: Log | None, samples: dict[str, Array] | None = None) -> Result:
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
