"""The sampled loop: control periods one after the other, with their metrics and their history."""

import jax
import jax.numpy as jnp

from ptsmc_jax.devices.ticks import Ticks
from ptsmc_jax.numerics import stacking
from ptsmc_jax.numerics.draws import WholeNumber
from ptsmc_jax.numerics.pytrees import Scalar
from ptsmc_jax.simulation import run_state
from ptsmc_jax.simulation.computer import Software
from ptsmc_jax.simulation.control_period import State, Tick, control_period, schedule, start
from ptsmc_jax.simulation.run_state import Log, Result, Run, Score


def simulate(run: Run, seed: WholeNumber, trial: WholeNumber, software: Software) -> Result:
    """Return the result of a sampled run; see `rollout.simulate`."""
    ticks = _with_end(run.ticks, run.criteria.t_end) if run.record else run.ticks
    vehicle, state = start(run.parts, ticks, run.x0, seed, trial, software)

    def step(carry: tuple[State, Score], tick: Tick) -> tuple[tuple[State, Score], Log | None]:
        state, record = control_period(vehicle, carry[0], tick)
        row = run_state.row(run, record) if run.record else None
        return (state, run_state.advance(run, carry[1], record)), row

    score = run_state.begin(run, state.actuators.h)
    first = score.snapshot
    (state, score), rows = stacking.scan(step, (state, score), schedule(ticks))
    log = None
    if rows is not None:
        log = run_state.history(jax.tree.map(lambda v: v[:-1], rows), _last_row(run, state, rows))
    return run_state.finish(run, first, score, log, software.statuses(state.computer))


def _last_row(run: Run, state: State, rows: Log) -> Log:
    """Return the row at t_end: the estimate and s of a sample there, and the torque held until then."""
    t = run.criteria.t_end
    d_hat, s = (signal[jnp.argmax(rows.t >= t)] for signal in (rows.d_hat, rows.s))
    h, v = state.actuators.h, state.actuators.v
    signals, wheels = (d_hat, state.torque, state.torque, s), None if h is None else (h, v)
    return run_state.row_at(run, t, state.x, run.parts.reference(t), signals, jnp.asarray(True), state.walk, wheels)


def _with_end(ticks: Ticks, t_end: Scalar) -> Ticks:
    """Append a sample at t_end, whose period has no length and changes no metric."""
    end = Ticks(t_end, t_end, jnp.asarray(True), ticks.sample[-1] + 1, jnp.ones_like(t_end), jnp.asarray(False))
    return jax.tree.map(lambda many, one: jnp.append(many, one.astype(many.dtype)), ticks, end)
