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
from ptsmc_jax.simulation.interval import Torques
from ptsmc_jax.simulation.run_state import Flown, Log, Result, Run, RunState


def fly(run: Run) -> Result:
    """A continuous run; see `rollout.simulate`."""
    parts, ticks, controller = run.parts, run.ticks, run.parts.controller
    observer: Observer = parts.observer
    model = observer.model
    k2 = observer.error_bound()
    lengths = ticks.t_next - ticks.t
    slopes = jax.vmap(observer.decay_matrix)(ticks.t, ticks.t_next)
    largest = jnp.max(jax.vmap(lambda a, dt: matrices.row_norm(a) * dt)(slopes, lengths))
    decays = jax.vmap(lambda a, dt: integrators.decay(a, dt, largest))(slopes, lengths)

    def step(carry: tuple[RunState, Array], tick: tuple) -> tuple[tuple[RunState, Array], Log | None]:
        (now, linear), (state, memory) = tick, carry
        dt, target = now.t_next - now.t, parts.reference(now.t)

        def rate(t: Scalar, x: Any, memory: Array) -> tuple[Any, Array, tuple[Array, Array]]:
            sample = Sample(t, now.hold, dt)
            u, s, _ = controller(sample, x, parts.reference(t), observer.estimate(memory), k2(t))
            x_dot = parts.plant.rate(t, x, u, parts.disturbance(t, x))
            d_eff = model.unexplained(t, x, x_dot, u)
            return x_dot, observer.forcing(t, (now.t, now.t_next), memory, d_eff), (u, s)

        x, memory_next, (u, s) = integrators.etdrk4(rate, linear, now.t, state.x, memory, dt)
        d_hat = observer.estimate(memory)
        signals, has_length = (d_hat, u, u, s), dt > 0.0
        row = run_state.row(run, now.t, state.x, target, signals, has_length) if run.record else None
        x = parts.plant.normalise(x)
        _, _, (u_end, _) = rate(now.t_next, x, memory_next)
        u_nodes = u, u_end  # not that of a stage in the middle, which a narrow sign makes zigzag from step to step
        torques = Torques(u_nodes, u_nodes, (1 / 2, 1 / 2), jnp.asarray(False), None)
        state = run_state.advance(run, state, now, target, Flown(x, lambda t: x, torques, dt))
        return (state, memory_next), row

    state = run_state.begin(run)
    first = state.snapshot
    (state, memory), rows = stacking.scan(step, (state, observer.begin()), (ticks, decays))
    log = None
    if rows is not None:
        t = run.criteria.t_end
        target, hold, d_hat = parts.reference(t), t >= controller.hand_over, observer.estimate(memory)
        u, s, _ = controller(Sample(t, hold, jnp.zeros_like(t)), state.x, target, d_hat, k2(t))
        last = run_state.row(run, t, state.x, target, (d_hat, u, u, s), jnp.asarray(True))
        log = run_state.history(rows, last)
    return run_state.finish(run, first, state, log)
