"""Test vectors for exported C: inputs, outputs and state of the simulated flight computer at each sample.

Read `simulate` first.
"""

from dataclasses import replace
from typing import NamedTuple

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
from ptsmc_jax.numerics.draws import WholeNumber
from ptsmc_jax.onboard.board import Board, Values
from ptsmc_jax.simulation.assembly import Parts
from ptsmc_jax.simulation.control_period import State, Tick, control_period, schedule, start
from ptsmc_jax.simulation.rollout import SINGULAR_DISTANCE


class Samples(NamedTuple):
    """The samples of a run, arrays (samples, ..). The dicts have the names of `Board`; None: the scenario has none."""

    t: Array  # time [s].
    has_length: Array  # bool: whether the period has a nonzero length.
    inputs: Values  # inputs of the flight computer.
    before: dict[str, Array]  # attitude filter before the sample, see `Sensor.filter_state`.
    state: Values  # state of the flight computer after the sample.
    outputs: Values  # outputs of the flight computer.
    error: Array  # error of the measured state.
    limited: Array  # bool: whether a limit reduces the command.


def simulate(parts: Parts, dispersion: Dispersion, seed: WholeNumber, trial: WholeNumber) -> Samples:
    """Simulate a trial without timing jitter and return its samples.

    Args:
        parts: the nominal scenario.
        dispersion: the dispersions. Reference and torque limit stay nominal, because the C has no other values of them.
        seed: seed of the campaign.
        trial: number of the trial.
    """
    dispersion = dispersion.without((REFERENCE, level_name("torque_limit")))
    parts = replace(dispersion.apply(parts, seed, trial), jitter=None)
    ticks = parts.clock.ticks(parts.controller.t_f, parts.controller.delta)
    law, sensors, wheels = parts.controller, parts.sensors, parts.actuators.wheels
    vehicle, first = start(parts, ticks, parts.aligned_initial, seed, trial)

    def simulate_period(carry: tuple[State, Array], tick: Tick) -> tuple[tuple[State, Array], Samples]:
        """Simulate a control period. The carry is the loop's state and `singularity_distance_unit`, NaN at first."""
        state, unit = carry
        after, record = control_period(vehicle, state, tick)
        now, drive, computer = record.now, record.drive, after.computer
        target, d_hat, u, s, *_ = record.decision
        assert drive is not None
        visible, sensing = parts.plant.visible(state.x), state.computer.sensors
        inputs, _ = sensors.inputs(sensing, visible, now, tick.dt_before, state.star_x)
        distance = law.singularity_distance(computer.seen, target)
        unit = jnp.where(jnp.isnan(unit), law.kinematics.singularity_distance_unit(distance), unit)
        telemetry = {"wheel_momentum": state.actuators.h, "acting": state.actuators.v}
        filtered = sensors.filter_state(computer.sensors) | parts.observer.model.signals_of(computer.seen)
        row = Samples(
            t=now.t, has_length=now.t_next > now.t,
            inputs=inputs | telemetry | {"applied": state.applied[0], "reference": target},
            before=sensors.filter_state(sensing),
            state={**filtered, **telemetry, "observer": computer.observer, "law": computer.law,
                   "command_filter": computer.command_filter, "queue": after.actuators.queue,
                   "reference": getattr(target, "q", None), "singularity_distance": distance / unit,
                   "singularity_distance_unit": unit},
            outputs={"d_hat": d_hat, "command": u, "s": s,
                     "sent_torque": parts.actuators.send(state.actuators, u, record.decision.w)[0],
                     "torque": drive.c if wheels is None else wheels.axes @ drive.c,
                     "wheel_torque": None if wheels is None else drive.c},
            error=law.kinematics.errors(computer.seen, target)[0], limited=drive.limited,
        )  # fmt: skip
        return (after, unit), row

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


def is_usable(samples: Samples) -> bool:
    """Return whether a trial is finite and stays away from the law's singularity."""
    finite = all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(samples))
    return finite and bool(np.min(samples.state["singularity_distance"]) >= SINGULAR_DISTANCE)


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
    ones, outputs = np.ones_like(samples.t), _flatten_columns(board.outputs, samples.outputs)
    state = np.column_stack([samples.t, ones, ones, _flatten_columns(board.state, samples.state), outputs])
    return np.column_stack([samples.t, _flatten_columns(board.inputs, samples.inputs)]), outputs, state


def first_state(board: Board, samples: Samples) -> np.ndarray:
    """Return the state before a trial's first sample, (columns,)."""
    begun = {name: board.parameters[name].begin() for name in ("law", "observer")}
    zeros = jax.tree.map(lambda leaf: np.zeros((1, *leaf.shape)), (board.state, board.outputs))
    state = zeros[0] | jax.tree.map(lambda v: np.asarray(v)[None], begun)
    state |= {name: value[:1] for name, value in samples.before.items()}
    columns = _flatten_columns(board.state, state), _flatten_columns(board.outputs, zeros[1])
    return np.column_stack([np.zeros((1, 3)), *columns])[0]


def _flatten_columns(shapes: Values, values: Values) -> np.ndarray:
    """Flatten pytrees (samples, ..) by name to a table (samples, columns); `shapes` has the order of the names."""
    leaves = [np.asarray(leaf, dtype=float) for name in shapes for leaf in jax.tree.leaves(values[name])]
    return np.column_stack([leaf.reshape(len(leaf), -1) for leaf in leaves])
