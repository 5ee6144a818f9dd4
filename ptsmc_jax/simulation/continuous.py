"""The continuous loop. Law and observer are integrated with the plant; the observer's linear part is exact (ETDRK4)."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from ptsmc_jax.laws.base import Sample
from ptsmc_jax.numerics import integrators, matrices, stacking
from ptsmc_jax.numerics.pytrees import Scalar
from ptsmc_jax.observers.base import Observer
from ptsmc_jax.simulation import run_state
from ptsmc_jax.simulation.computer import Computer, Decision
from ptsmc_jax.simulation.control_period import Record, State
from ptsmc_jax.simulation.interval import Torques
from ptsmc_jax.simulation.run_state import Log, Result, Run, Score


def simulate(run: Run) -> Result:
    """Return the result of a continuous run; see `rollout.simulate`."""
    parts, ticks, controller = run.parts, run.ticks, run.parts.controller
    observer: Observer = parts.observer
    model = observer.model
    k2 = observer.error_bound()
    lengths = ticks.t_next - ticks.t
    decay_matrices = jax.vmap(observer.decay_matrix)(ticks.t, ticks.t_next)
    largest_decay = jnp.max(jax.vmap(lambda a, dt: matrices.row_norm(a) * dt)(decay_matrices, lengths))
    decays = jax.vmap(lambda a, dt: integrators.decay(a, dt, largest_decay))(decay_matrices, lengths)

    def step(carry: tuple[State, Score], tick: tuple) -> tuple[tuple[State, Score], Log | None]:
        (now, decay), (state, score) = tick, carry
        x, memory = state.x, state.computer.observer
        dt, target = now.t_next - now.t, parts.reference(now.t)

        def rate(t: Scalar, x: Any, memory: Array) -> tuple[Any, Array, tuple[Array, Array]]:
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
        record = Record(now, decision, torques, lambda t: x_next, dt)
        torque = jnp.where(now.t_next > now.t, u_end, state.torque)
        after = State(x_next, torque, state.computer._replace(observer=memory_next))
        row = run_state.history_row(run, state, after, record) if run.record else None
        return (after, run_state.advance(run, score, state, after, record)), row

    first = run_state.begin(run)
    start_state = State(run.x0, jnp.zeros(parts.plant.inputs), Computer(None, None, observer.begin(), None, None))
    (state, score), rows = stacking.scan(step, (start_state, first), (ticks, decays))
    log = None
    if rows is not None:
        t = run.criteria.t_end
        x, d_hat = state.x, observer.estimate(state.computer.observer)
        target, hold = parts.reference(t), t >= controller.hand_over
        u, s, _ = controller(Sample(t, hold, jnp.zeros_like(t)), x, target, d_hat, k2(t))
        decision = Decision(target, d_hat, u, s)
        last = run_state.history_row_at(run, t, x, decision, u, jnp.asarray(True))
        log = run_state.history(rows, last)
    return run_state.finish(run, first, score, log)
