"""Simulate one run: from its parts to metrics, status and history.

`simulate` is a pure function. It composes with jit, vmap, grad and jvp. Every number in `Parts` is a leaf of a pytree,
so other gains, inertias or noises reuse the compiled program. `simulate_parts` is the compiled function.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, PyTree

from ptsmc_jax import programs
from ptsmc_jax.devices.ticks import Ticks
from ptsmc_jax.laws.base import Sample
from ptsmc_jax.numerics import guards, integrators, matrices, stacking
from ptsmc_jax.numerics.draws import WholeNumber, check_fits
from ptsmc_jax.numerics.pytrees import Scalar
from ptsmc_jax.simulation import run_state
from ptsmc_jax.simulation.assembly import Parts, check_parts
from ptsmc_jax.simulation.clock import Graded
from ptsmc_jax.simulation.computer import PYTHON_SOFTWARE, Computer, Decision, Software
from ptsmc_jax.simulation.control_period import Record, State, control_period, schedule, start
from ptsmc_jax.simulation.metrics import Criteria, Torques
from ptsmc_jax.simulation.run_state import DIVERGED as DIVERGED
from ptsmc_jax.simulation.run_state import FINISHED as FINISHED
from ptsmc_jax.simulation.run_state import INCOMPLETE as INCOMPLETE
from ptsmc_jax.simulation.run_state import NOT_CONVERGED as NOT_CONVERGED
from ptsmc_jax.simulation.run_state import OK as OK
from ptsmc_jax.simulation.run_state import SINGULAR as SINGULAR
from ptsmc_jax.simulation.run_state import SINGULAR_DISTANCE as SINGULAR_DISTANCE
from ptsmc_jax.simulation.run_state import STATUS as STATUS
from ptsmc_jax.simulation.run_state import TOO_FAST as TOO_FAST
from ptsmc_jax.simulation.run_state import UNBOUNDED as UNBOUNDED
from ptsmc_jax.simulation.run_state import Log, Result, Run, Score


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
        seed: whole number below 2^32 that selects the random numbers, together with `trial`.
        trial: whole number below 2^32.
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
        row = run_state.history_row(run, state, after, record) if run.record else None
        return (after, run_state.advance(run, score, state, after, record)), row

    first = run_state.begin(run)
    (state, score), rows = stacking.scan(step, (loop.start, first), loop.intervals)
    log = None
    if rows is not None:
        log = run_state.history(jax.tree.map(lambda v: v[: run.ticks.t.size], rows), loop.last_row(state, rows))
    samples = None if software.count_statuses is None else software.count_statuses(state.computer)
    return run_state.finish(run, first, score, log, samples)


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
        row = run_state.history_row_at(
            run, t_end, state.x, decision, state.torque, jnp.asarray(True), state.walk, wheels
        )
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
        return run_state.history_row_at(run, t, x, Decision(target, d_hat, u, s), u, jnp.asarray(True))

    computer = Computer(None, None, observer.begin(), None, None)
    return Loop(step, State(run.x0, jnp.zeros(parts.plant.inputs), computer), (ticks, decays), last_row)


def _check_fit(parts: Parts) -> None:
    """Raise TypeError if the parts do not fit together."""
    check_parts(parts)
    for name, shape in parts.plant.state_shapes.items():
        value = getattr(parts.initial, name, None) if name else parts.initial
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
