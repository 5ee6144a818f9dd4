"""The sampled loop: control periods one after the other, with their metrics and their history."""

import jax
import jax.numpy as jnp

from ptsmc_jax.devices.ticks import Ticks
from ptsmc_jax.numerics import stacking
from ptsmc_jax.numerics.draws import WholeNumber
from ptsmc_jax.numerics.pytrees import Scalar
from ptsmc_jax.simulation import run_state
from ptsmc_jax.simulation.computer import Decision, Software
from ptsmc_jax.simulation.control_period import State, Tick, control_period, schedule, start
from ptsmc_jax.simulation.run_state import Log, Result, Run, Score


def simulate(run: Run, seed: WholeNumber, trial: WholeNumber, software: Software) -> Result:
    """Return the result of a sampled run; see `rollout.simulate`."""
    ticks = _append_end_sample(run.ticks, run.criteria.t_end) if run.record else run.ticks
    vehicle, state = start(run.parts, ticks, run.x0, seed, trial, software)

    def step(carry: tuple[State, Score], tick: Tick) -> tuple[tuple[State, Score], Log | None]:
        state, score = carry
        after, record = control_period(vehicle, state, tick)
        measured_tick = None if software.on_processor else tick
        row = run_state.history_row(run, state, after, record, measured_tick) if run.record else None
        return (after, run_state.advance(run, score, state, after, record)), row

    first = run_state.begin(run)
    (state, score), rows = stacking.scan(step, (state, first), schedule(ticks))
    log = None
    if rows is not None:
        log = run_state.history(jax.tree.map(lambda v: v[:-1], rows), _last_row(run, state, rows))
    return run_state.finish(run, first, score, log, software.count_statuses(state.computer))


def _last_row(run: Run, state: State, rows: Log) -> Log:
    """Return the row at t_end: the estimate and s of a sample there, and the torque held until then."""
    parts, t, x, torque = run.parts, run.criteria.t_end, state.x, state.torque
    end_index = jnp.argmax(rows.t >= t)
    d_hat, s = rows.d_hat[end_index], rows.s[end_index]
    decision = Decision(parts.reference(t), d_hat, torque, s)
    wheels = None if state.actuators.h is None else (state.actuators.h, state.actuators.v)
    last = run_state.history_row_at(run, t, x, decision, torque, jnp.asarray(True), state.walk, wheels)
    readings, sent = jax.tree.map(lambda column: column[end_index], (rows.readings, rows.sent))
    return last._replace(readings=readings, sent=sent)


def _append_end_sample(ticks: Ticks, t_end: Scalar) -> Ticks:
    """Append a sample at t_end, whose period has no length and changes no metric."""
    end_sample = Ticks(t_end, t_end, jnp.asarray(True), ticks.sample[-1] + 1, jnp.ones_like(t_end), jnp.asarray(False))
    return jax.tree.map(lambda column, value: jnp.append(column, value.astype(column.dtype)), ticks, end_sample)
