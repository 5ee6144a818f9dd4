"""One run: a scenario flown once, with its history, metrics and verdicts as plain numbers."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import jax
import numpy as np
from numpy.typing import ArrayLike

from ptsmc_jax import programs
from ptsmc_jax.campaigns import margin_verdicts, montecarlo
from ptsmc_jax.dispersions import planned
from ptsmc_jax.dispersions.planned import Row
from ptsmc_jax.dispersions.variation import Dispersion
from ptsmc_jax.scenario import Study
from ptsmc_jax.simulation import requirements, rollout
from ptsmc_jax.simulation.catalogues import Entry
from ptsmc_jax.simulation.computer import OURS, Software
from ptsmc_jax.simulation.requirements import Verdict
from ptsmc_jax.simulation.rollout import Log, Parts
from ptsmc_jax.theory import error_floor
from ptsmc_jax.theory.error_floor import Floor

FLOORS = 4  # trials whose floors are pooled: they differ by a few per cent


@dataclass(frozen=True)
class Run:
    """A finished run."""

    parts: Parts  # as flown
    log: Log  # numpy arrays (time, component), intervals of length zero left out
    metrics: dict[str, float]
    catalogue: dict[str, Entry]  # what those are
    status: str
    reason: str
    bad_time: float  # [s], NaN if none
    verdicts: list[Verdict]
    samples: dict[str, int]  # by the status that flight software of another make ended them with

    @property
    def met(self) -> bool:
        """The run ended well and met every requirement."""
        return self.status == "ok" and all(v.met for v in self.verdicts)

    @property
    def torque_limit(self) -> float | None:
        """What the scenario allows of the torque; None: it does not say."""
        return next((v.limit for v in self.verdicts if v.metric.startswith("peak_torque")), None)

    @cached_property
    def floor(self) -> Floor | None:
        """What no controller can beat along this run, see `error_floor`.

        None: it was not flown to the end, or with sensors of one's own, of which it is not known what they say.
        """
        return error_floor.along(self.parts, self.log) if self.has_floor else None

    @property
    def has_floor(self) -> bool:
        """Whether there is a `floor`."""
        known = self.parts.sensors.perfect or hasattr(self.parts.sensors, "reading")
        return known and self.status in montecarlo.FINISHED

    def columns(self) -> dict[str, np.ndarray]:
        """The history by column, (time,) each: t [s], state, estimate, delivered torque, s, wheels, flexible modes."""
        log = self.log
        blocks = {**self.parts.plant.columns(log.x), "d_hat": log.d_hat, "u": log.u, "s": log.s}
        if log.wheels is not None:
            blocks["h"], blocks["v"] = log.wheels
        blocks |= self.parts.plant.hidden_columns(log.x)
        columns = {"t": np.asarray(log.t)}
        for name, block in blocks.items():
            columns |= numbered(name, block)
        return columns


def numbered(name: str, block: ArrayLike) -> dict[str, np.ndarray]:
    """The columns of a (time, component) array, by its name and a number from 1 on."""
    return {f"{name}{k + 1}": column for k, column in enumerate(np.asarray(block).T)}


def fly(ready: Study, seed: int = 0, trial: int | Row | None = None, software: Software = OURS) -> Run:
    """Fly one run: nominal with the noise of trial 0, or a trial, or a plan's row, with its dispersions and noise.

    software: the flight computer, where it is not the parts' own code.
    """
    run = _fly(ready, seed, trial, software)
    return replace(run, verdicts=[*run.verdicts, *margin_verdicts.of_loop(run.parts, ready.margins)])


def _fly(ready: Study, seed: int, trial: int | Row | None, software: Software = OURS) -> Run:
    row = trial if isinstance(trial, Row) else Row(np.uint32(seed), np.uint32(trial or 0), {})
    key, number = np.uint32(row.seed), np.uint32(row.trial)
    about = trial if isinstance(trial, Row) else number
    parts = ready.parts if trial is None else _drawn(ready.dispersion, ready.parts, key, about)
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
    samples = {name: int(count) for name, count in result.samples.items()}
    return Run(parts, log, metrics, ready.catalogue, status, reason, float(result.bad_time), verdicts, samples)


def prepare(ready: Study) -> None:
    """Begin to compile what flies one run of such a study, beside what is being done."""
    number = np.uint32(0)
    rollout.single_run_program(ready.parts).prepare(ready.parts, number, number, record=True, software=OURS)


@programs.jit
def _drawn(dispersion: Dispersion, parts: Parts, seed: jax.Array, trial: jax.Array | Row) -> Parts:
    return planned.about(parts, dispersion, seed, trial).drawn


def floor(ready: Study, seed: int = 0, rows: Sequence[int | Row] = ()) -> float | None:
    """RMS window error that no controller can beat, in its unit, see `error_floor`; 0: nothing is unknown.

    Along the nominal run, or, where something is drawn, pooled over the first `FLOORS` trials, of a plan over these
    rows. None: none of these has a `Run.floor`.
    """
    trials = rows or (range(FLOORS) if ready.dispersion.varies else (None,))
    runs = [_fly(ready, seed, trial) for trial in trials]
    return error_floor.pooled(error_floor.along_each([(run.parts, run.log) for run in runs if run.has_floor]))
