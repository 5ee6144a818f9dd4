"""The continuous loop: law and observer inside the integrator's stages, the observer's linear part stepped exactly."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from ptsmc_jax.laws.base import Sample
from ptsmc_jax.numerics import integrators, matrices, stacking
from ptsmc_jax.numerics.pytrees import Scalar
from ptsmc_jax.observers.base import Observer
from ptsmc_jax.simulation import run_state
from ptsmc_jax.simulation.control_period import Record
from ptsmc_jax.simulation.interval import Torques
from ptsmc_jax.simulation.run_state import Log, Result, Run, Score

Carry = tuple[Any, Array, Array, Score]  # true state, memory of the observer, torque at the end of the last step, score


def simulate(run: Run) -> Result:
    """Return the result of a continuous run; see `rollout.simulate`."""
    parts, ticks, controller = run.parts, run.ticks, run.parts.controller
    observer: Observer = parts.observer
    model = observer.model
    k2 = observer.error_bound()
    lengths = ticks.t_next - ticks.t
    slopes = jax.vmap(observer.decay_matrix)(ticks.t, ticks.t_next)
    largest = jnp.max(jax.vmap(lambda a, dt: matrices.row_norm(a) * dt)(slopes, lengths))
    decays = jax.vmap(lambda a, dt: integrators.decay(a, dt, largest))(slopes, lengths)

    def step(carry: Carry, tick: tuple) -> tuple[Carry, Log | None]:
        (now, linear), (x, memory, last_torque, score) = tick, carry
        dt, target = now.t_next - now.t, parts.reference(now.t)

        def rate(t: Scalar, x: Any, memory: Array) -> tuple[Any, Array, tuple[Array, Array]]:
            sample = Sample(t, now.hold, dt)
            u, s, _ = controller(sample, x, parts.reference(t), observer.estimate(memory), k2(t))
            x_dot = parts.plant.rate(t, x, u, parts.disturbance(t, x))
            d_eff = model.unexplained(t, x, x_dot, u)
            return x_dot, observer.forcing(t, (now.t, now.t_next), memory, d_eff), (u, s)

        x_next, memory_next, (u, s) = integrators.etdrk4(rate, linear, now.t, x, memory, dt)
        x_next = parts.plant.normalise(x_next)
        _, _, (u_end, _) = rate(now.t_next, x_next, memory_next)
        u_nodes = u, u_end  # not that of a stage in the middle, which a narrow sign makes zigzag from step to step
        torques = Torques(u_nodes, u_nodes, (1 / 2, 1 / 2), jnp.asarray(False), None)
        d_hat = observer.estimate(memory)
        record = Record(now, x, target, d_hat, u, s, last_torque, torques, x_next, lambda t: x_next, dt)
        row = run_state.row(run, record) if run.record else None
        torque = jnp.where(now.t_next > now.t, u_end, last_torque)
        return (x_next, memory_next, torque, run_state.advance(run, score, record)), row

    score = run_state.begin(run)
    first = score.snapshot
    begun = run.x0, observer.begin(), jnp.zeros(parts.plant.inputs), score
    (x, memory, _, score), rows = stacking.scan(step, begun, (ticks, decays))
    log = None
    if rows is not None:
        t = run.criteria.t_end
        target, hold, d_hat = parts.reference(t), t >= controller.hand_over, observer.estimate(memory)
        u, s, _ = controller(Sample(t, hold, jnp.zeros_like(t)), x, target, d_hat, k2(t))
        last = run_state.row_at(run, t, x, target, (d_hat, u, u, s), jnp.asarray(True))
        log = run_state.history(rows, last)
    return run_state.finish(run, first, score, log)
