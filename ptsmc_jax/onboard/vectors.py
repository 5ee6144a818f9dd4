"""Test vectors for exported C: inputs, outputs and state of the simulated flight computer at each sample.

Read `simulate` first.
"""

from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ptsmc_jax import programs
from ptsmc_jax.batching import lapack
from ptsmc_jax.dispersions.base import REFERENCE
from ptsmc_jax.dispersions.quantities import level_name
from ptsmc_jax.dispersions.variation import Dispersion
from ptsmc_jax.numerics import stacking
from ptsmc_jax.onboard.board import Board
from ptsmc_jax.simulation.assembly import Parts
from ptsmc_jax.simulation.control_period import State, Tick, control_period, schedule, start
from ptsmc_jax.simulation.run_state import SINGULAR_DISTANCE


class Samples(NamedTuple):
    """The samples of a run, arrays (samples, ..); None for values that the scenario does not have."""

    t: Array  # time [s].
    has_length: Array  # bool: whether the period has a nonzero length.
    inputs: dict[str, Array]  # inputs from the sensors, see `Sensor.inputs`.
    before: dict[str, Array]  # attitude filter before the sample, see `Sensor.filter_state`.
    after: dict[str, Array]  # attitude filter after the sample.
    applied: Array  # mean torque over the last period [N m].
    acting: Array | None  # torque of the channels [N m].
    momentum: Array | None  # momentum of the wheels [N m s].
    target: Any  # reference.
    measured: Any  # measured state.
    observer: Any  # memory of the observer.
    law: Any  # memory of the law.
    command_filter: Any  # memory of the command filter.
    queue: Array | None  # delayed commands [N m].
    d_hat: Array  # estimated disturbance [N m].
    command: Array  # command of the law [N m].
    sent_torque: Array  # torque that is sent to the actuators [N m].
    s: Array  # sliding variable.
    error: Array  # error of the measured state.
    torque: Array  # torque on the body from this sample on [N m].
    wheel_torque: Array | None  # torque of each wheel [N m].
    limited: Array  # bool: whether a limit reduces the command.
    singularity_distance: Array  # distance to the singularity, divided by `singularity_distance_unit` [-].
    singularity_distance_unit: Array  # divisor of the distance to the law's singularity, constant in a run.


def simulate(parts: Parts, dispersion: Dispersion, seed: Any, trial: Any) -> Samples:
    """Simulate a trial without timing jitter and return its samples.

    Args:
        parts: the nominal scenario.
        dispersion: the dispersions.
        seed: seed of the campaign.
        trial: number of the trial.
    """
    parts = replace(dispersion.apply(parts, seed, trial), jitter=None)
    ticks = parts.clock.ticks(parts.controller.t_f, parts.controller.delta)
    law, sensors, wheels = parts.controller, parts.sensors, parts.actuators.wheels
    vehicle, first = start(parts, ticks, parts.aligned_initial, seed, trial)

    def simulate_period(carry: tuple[State, Array], tick: Tick) -> tuple[tuple[State, Array], Samples]:
        """Simulate a control period. The carry is the loop's state and `singularity_distance_unit`, NaN at first."""
        state, scale = carry
        after, record = control_period(vehicle, state, tick)
        now, drive, computer = record.now, record.drive, after.computer
        target, d_hat, u, s, *_ = record.decision
        assert drive is not None
        visible, sensing = parts.plant.visible(state.x), state.computer.sensors
        inputs, _ = sensors.inputs(sensing, visible, now, tick.dt_before, state.star_x)
        distance = law.singularity_distance(computer.seen, target)
        scale = jnp.where(jnp.isnan(scale), law.kinematics.singularity_distance_unit(distance), scale)
        row = Samples(
            t=now.t, has_length=now.t_next > now.t, inputs=inputs,
            before=sensors.filter_state(sensing), after=sensors.filter_state(computer.sensors),
            applied=state.applied[0], acting=state.actuators.v, momentum=state.actuators.h,
            target=target, measured=computer.seen, observer=computer.observer,
            law=computer.law, command_filter=computer.command_filter, queue=after.actuators.queue,
            d_hat=d_hat, command=u, s=s,
            sent_torque=parts.actuators.send(state.actuators, u, record.decision.w)[0],
            error=law.kinematics.errors(computer.seen, target)[0],
            torque=drive.c if wheels is None else wheels.axes @ drive.c,
            wheel_torque=None if wheels is None else drive.c, limited=drive.limited,
            singularity_distance=distance / scale, singularity_distance_unit=scale,
        )  # fmt: skip
        return (after, scale), row

    return stacking.scan(simulate_period, (first, jnp.full_like(parts.t_end, jnp.nan)), schedule(ticks))[1]


@programs.jit(compiler_options=programs.FAST_COMPILE)
def simulate_many(parts: Parts, dispersion: Dispersion, seed: Array, trials: Array) -> Samples:
    """Simulate trials and return their samples, (trials, samples, ..).

    Args:
        parts: the nominal scenario.
        dispersion: the dispersions.
        seed: seed of the campaign.
        trials: numbers of the trials (trials,).
    """
    return lapack.vmap(lambda trial: simulate(parts, dispersion, seed, trial))(trials)


def with_nominal_reference(dispersion: Dispersion) -> Dispersion:
    """Return the dispersion with nominal reference and torque limit, because the C has no other values of them."""
    return dispersion.without((REFERENCE, level_name("torque_limit")))


def is_usable(samples: Samples) -> bool:
    """Return whether a trial is finite and stays away from the law's singularity."""
    finite = all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(samples))
    return finite and bool(np.min(samples.singularity_distance) >= SINGULAR_DISTANCE)


def rounding_growth(samples: Samples, rounding: float, t_f: float, last_time_to_go: float) -> float:
    """Return the rounding error of a trial's commands, relative to the largest command, in units of the resolution.

    Gains grow like 1 / (t_f - t)^2 until `last_time_to_go` [s] before t_f. A command is about the measured error
    times the gain at its time. A small slew needs small commands, so the rounding error of its attitude counts more.

    Args:
        samples: the trial.
        rounding: relative rounding error of the measured error, see `Plant.error_rounding`.
        t_f: the prescribed time [s].
        last_time_to_go: time to go of the last sample before the hand-over [s].
    """
    time_to_go = t_f - samples.t
    early = time_to_go >= last_time_to_go * (1.0 - 1e-9)
    command = np.linalg.norm(samples.error[early], axis=1) * (last_time_to_go / time_to_go[early]) ** 2
    largest = float(command.max(initial=0.0))
    return rounding / largest if largest else 0.0


def single_trial(samples: Samples, trial: int) -> Samples:
    """Return one of many trials in NumPy arrays, without samples whose period has length 0."""
    samples_of_trial = jax.tree.map(lambda v: np.asarray(v[trial]), samples)
    return jax.tree.map(lambda v: v[samples_of_trial.has_length], samples_of_trial)


def rows(board: Board, samples: Samples) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return inputs, outputs and state of one trial, (samples, columns) each; `generate.column_names` has the order."""
    inputs = samples.inputs | {"wheel_momentum": samples.momentum, "applied": samples.applied,
                               "acting": samples.acting, "reference": samples.target}  # fmt: skip
    state_by_name = {**samples.after, **board.model.signals_of(samples.measured), "observer": samples.observer,
                     "law": samples.law, "queue": samples.queue, "command_filter": samples.command_filter,
                     "wheel_momentum": samples.momentum, "acting": samples.acting,
                     "singularity_distance": samples.singularity_distance,
                     "singularity_distance_unit": samples.singularity_distance_unit,
                     "reference": getattr(samples.target, "q", None)}  # fmt: skip
    names = ("d_hat", "command", "s", "sent_torque", "torque", "wheel_torque")
    outputs_by_name = {name: getattr(samples, name) for name in names}
    ones = np.ones_like(samples.t)
    outputs = _flatten_columns(board.outputs, outputs_by_name)
    state = np.column_stack([samples.t, ones, ones, _flatten_columns(board.state, state_by_name), outputs])
    return np.column_stack([samples.t, _flatten_columns(board.inputs, inputs)]), outputs, state


def first_state(board: Board, samples: Samples) -> np.ndarray:
    """Return the state before a trial's first sample, (columns,)."""
    law, observer = (board.parameters[name].begin() for name in ("law", "observer"))
    state_by_name = {"law": jax.tree.map(lambda v: np.asarray(v)[None], law),
            "observer": jax.tree.map(lambda v: np.asarray(v)[None], observer)}  # fmt: skip
    state_by_name |= {name: value[:1] for name, value in samples.before.items()}
    no_outputs = np.zeros((1, sum(leaf.size for leaf in jax.tree.leaves(board.outputs))))
    return np.column_stack([np.zeros((1, 3)), _flatten_columns(board.state, state_by_name), no_outputs])[0]


def _flatten_columns(shapes: dict[str, Any], values: dict[str, Any]) -> np.ndarray:
    """Flatten named pytrees (samples, ..) to a table (samples, columns).

    Args:
        shapes: shapes of the trees by name, in the order of the columns.
        values: trees by name. The columns of missing trees are zero.
    """
    columns = []
    for name, shape in shapes.items():
        tree = values.get(name)
        for k, leaf in enumerate(jax.tree.leaves(shape)):
            if tree is None:
                columns.append(np.zeros((len(jax.tree.leaves(values)[0]), leaf.size)))
            else:
                column = np.asarray(jax.tree.leaves(tree)[k], dtype=float)
                columns.append(column.reshape(len(column), leaf.size))
    return np.column_stack(columns) if columns else np.zeros((0, 0))
