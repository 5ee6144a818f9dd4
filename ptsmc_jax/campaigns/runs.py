"""One run of a scenario, with its history, metrics and verdicts as plain numbers."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import jax
import numpy as np
from numpy.typing import ArrayLike

from ptsmc_jax import programs
from ptsmc_jax.campaigns import margin_verdicts, montecarlo
from ptsmc_jax.dispersions.variation import Dispersion, Row, trial_setup
from ptsmc_jax.scenario import Study
from ptsmc_jax.simulation import requirements, rollout
from ptsmc_jax.simulation.catalogues import Entry
from ptsmc_jax.simulation.computer import PYTHON_SOFTWARE, Software
from ptsmc_jax.simulation.requirements import Verdict
from ptsmc_jax.simulation.rollout import Log, Parts
from ptsmc_jax.theory import lower_bound
from ptsmc_jax.theory.lower_bound import LowerBound

BOUND_TRIALS = 4  # number of trials whose lower bounds are pooled: the bounds differ by a few per cent


@dataclass(frozen=True)
class Run:
    """A finished run."""

    parts: Parts  # parts with the dispersions of the trial
    log: Log  # numpy arrays (time, component), intervals of length zero left out
    metrics: dict[str, float]
    catalogue: dict[str, Entry]  # units and meanings of the metrics
    status: str
    reason: str
    bad_time: float  # time of the first failure [s]; NaN if the status is ok
    verdicts: list[Verdict]
    samples: dict[str, int]  # numbers of samples by the status of exported flight software
    drawn: dict[str, float]  # initial state and dispersions of the trial by column, in SI units; empty: nominal run

    @property
    def met(self) -> bool:
        """Whether the run succeeded and met every requirement."""
        return self.status == "ok" and all(v.met for v in self.verdicts)

    @property
    def limits(self) -> dict[str, float]:
        """The required limits by metric, in the unit of the metric."""
        return {verdict.metric: verdict.limit for verdict in self.verdicts}

    @cached_property
    def lower_bound(self) -> LowerBound | None:
        """The lower bound of the error along this run, see `lower_bound`.

        None: the run did not reach the end, or its sensors are custom and have no linear model.
        """
        return lower_bound.bound_along_run(self.parts, self.log) if self.has_lower_bound else None

    @property
    def has_lower_bound(self) -> bool:
        """Whether the run has a lower bound: it reached its end, and its sensors have a linear model."""
        has_linear_model = self.parts.sensors.perfect or hasattr(self.parts.sensors, "measurement_model")
        return has_linear_model and self.status in montecarlo.FINISHED

    def columns(self) -> dict[str, np.ndarray]:
        """Return the history by column, (time,) each: t [s], state, estimate, delivered torque, s, wheels, modes.

        The readings of the sensors and the torque that the computer sends to the actuators follow, for `identify`.
        """
        log = self.log
        blocks = {**self.parts.plant.columns(log.x), "d_hat": log.d_hat, "u": log.u, "s": log.s}
        if log.wheels is not None:
            blocks["h"], blocks["v"] = log.wheels
        blocks |= self.parts.plant.hidden_columns(log.x) | self._measured_columns()
        return {"t": np.asarray(log.t), **numbered_columns(blocks)}

    def _measured_columns(self) -> dict[str, np.ndarray]:
        """Return the readings of the sensors and the torque that the computer sends, (time, ..), by name.

        The result is empty if they are not logged. A sample without a reading of the attitude has NaN.
        """
        log, sensors = self.log, self.parts.sensors
        if log.readings is None or log.sent is None:
            return {}
        readings: dict[str, ArrayLike] = dict(log.readings)
        columns: dict[str, ArrayLike] = {}
        tracker = getattr(sensors, "star_tracker", None)
        if tracker is not None:  # the sensors are a suite
            readings["attitude"] = np.asarray(jax.vmap(tracker.body)(readings[tracker.name]))
            for name in ("valid", "age"):
                readings[f"attitude_{name}"] = readings[f"{tracker.name}_{name}"]
        if "attitude" in readings:
            valid = np.asarray(readings.get("attitude_valid", np.ones(len(log.t))), bool)
            columns["measured_q"] = np.where(valid[:, None], readings["attitude"], np.nan)
        if "attitude_age" in readings:
            columns["measured_age"] = readings["attitude_age"]
        names = {"rate": "measured_w", "x": "measured_x"}
        columns |= {new: readings[name] for name, new in names.items() if name in readings}
        columns["sent"] = log.sent
        return jax.tree.map(np.asarray, columns)


def numbered_columns(blocks: Mapping[str, ArrayLike]) -> dict[str, np.ndarray]:
    """Return the columns of (time, component) arrays, named by a number from 1; of (time,) arrays, the column."""
    columns = {}
    for name, block in blocks.items():
        values = np.asarray(block)
        numbered = {name: values} if values.ndim == 1 else {f"{name}{k + 1}": v for k, v in enumerate(values.T)}
        columns |= numbered
    return columns


def simulate(
    ready: Study,
    seed: int = 0,
    trial: int | Row | None = None,
    software: Software = PYTHON_SOFTWARE,
    *,
    with_margins: bool = True,
) -> Run:
    """Simulate one run of a scenario with its history, and judge its requirements.

    Args:
        ready: the scenario, ready to simulate.
        seed: seed of dispersions and noise.
        trial: the number of a trial, or a row of a run table, with its dispersions and noise. None: the nominal run
            with the noise of trial 0.
        software: flight software: the simulated law, or exported C code.
        with_margins: whether to judge the required margins too.

    Returns:
        The run with its verdicts.
    """
    row = trial if isinstance(trial, Row) else Row(np.uint32(seed), np.uint32(trial or 0), {})
    key, number = np.uint32(row.seed), np.uint32(row.trial)
    number_or_row = trial if isinstance(trial, Row) else number
    parts, drawn = ready.parts, {}
    if trial is not None:
        parts, drawn = _dispersed_parts(ready.dispersion, ready.parts, key, number_or_row)
    result = jax.tree.map(
        np.asarray, rollout.single_run_program(parts)(parts, key, number, record=True, software=software)
    )
    assert result.log is not None
    has_length = result.log.has_length
    log = jax.tree.map(lambda rows: rows[has_length], result.log)
    status, reason = rollout.STATUS[int(result.status)]
    metrics = {name: float(getattr(result.metrics, name)) for name in ready.catalogue}
    finished = np.asarray(int(result.status) in rollout.FINISHED)
    verdicts = requirements.verdicts(ready.requirements, metrics.__getitem__, finished)
    if with_margins:
        verdicts += margin_verdicts.judge_loop(parts, ready.margins, finished=bool(finished))
    samples = {name: int(count) for name, count in result.samples.items()}
    bad_time, drawn = float(result.bad_time), {name: float(value) for name, value in drawn.items()}
    return Run(parts, log, metrics, ready.catalogue, status, reason, bad_time, verdicts, samples, drawn)


def prepare(ready: Study) -> None:
    """Start to compile the program for one run of this scenario in the background."""
    number = np.uint32(0)
    rollout.single_run_program(ready.parts).prepare(ready.parts, number, number, record=True, software=PYTHON_SOFTWARE)


@programs.jit
def _dispersed_parts(
    dispersion: Dispersion, parts: Parts, seed: jax.Array, trial: jax.Array | Row
) -> tuple[Parts, dict[str, jax.Array]]:
    """Return the parts of a trial, and its initial state and dispersions by column."""
    values = montecarlo.values(parts, dispersion, seed, trial)
    return trial_setup(parts, dispersion, seed, trial).dispersed_parts, values


def rms_lower_bound(ready: Study, seed: int = 0, rows: Sequence[int | Row] = ()) -> float | None:
    """Return the lower bound of the RMS window error, in its unit, see `lower_bound`; 0 if nothing is unknown.

    Args:
        ready: the scenario, ready to simulate.
        seed: seed of dispersions and noise.
        rows: rows of a run table. By default the nominal run, or the first `BOUND_TRIALS` trials if the
            scenario has dispersions. The bounds of several runs are pooled.

    Returns:
        The bound, or None if no run has one.
    """
    trials = rows or (range(BOUND_TRIALS) if ready.dispersion.varies else (None,))
    runs = [simulate(ready, seed, trial, with_margins=False) for trial in trials]
    bounds = lower_bound.bounds_along_runs([(run.parts, run.log) for run in runs if run.has_lower_bound])
    return float(np.sqrt(np.mean([bound.window_error**2 for bound in bounds]))) if bounds else None
