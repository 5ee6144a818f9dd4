"""One run as `ptsmc simulate` hands it over: history as CSV, metrics, verdicts, figures."""

from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from ptsmc_jax import plotting, rollout, schema, store
from ptsmc_jax.requirements import Verdict
from ptsmc_jax.rollout import Log, Parts
from ptsmc_jax.scenario import Study
from ptsmc_jax.schema import Scenario


@dataclass(frozen=True)
class Run:
    """A finished run."""

    parts: Parts  # as flown
    log: Log  # numpy arrays, intervals of length zero left out
    metrics: dict[str, float]
    status: str
    reason: str
    bad_time: float  # [s], NaN if none
    verdicts: list[Verdict]

    @property
    def met(self) -> bool:
        """The run ended well and met every requirement."""
        return self.status == "ok" and all(v.met for v in self.verdicts)


def fly(ready: Study, seed: int, trial: int | None) -> Run:
    """Fly one run: nominal with the noise of trial 0, or a trial with its dispersions and its noise."""
    key, number = jnp.uint32(seed), jnp.uint32(trial or 0)
    parts = ready.parts if trial is None else ready.dispersion.apply(ready.parts, key, number)
    result = jax.tree.map(np.asarray, rollout.simulate_jit(parts, key, number, record=True))
    assert result.log is not None
    lasts = result.log.lasts
    log = jax.tree.map(lambda rows: rows[lasts], result.log)
    status, reason = rollout.STATUS[int(result.status)]
    metrics = {name: float(value) for name, value in result.metrics._asdict().items()}
    verdicts = [r.verdict(np.asarray(metrics[r.metric]), np.asarray(status == "ok")) for r in ready.requirements]
    return Run(parts, log, metrics, status, reason, float(result.bad_time), verdicts)


def write(folder: Path, scenario: Scenario, run: Run, seed: int, trial: int | None, figures: bool) -> None:
    """Fill a result folder."""
    store.write_toml(folder / "scenario.toml", schema.dump(scenario))
    store.write_json(folder / "versions.json", store.versions("simulate", seed, trial=trial))
    verdicts = {v.metric: {"limit": v.limit, "margin": v.margin, "met": v.met} for v in run.verdicts}
    heading = {"status": run.status, "reason": run.reason, "bad_time": run.bad_time}
    store.write_json(folder / "summary.json", {**heading, **run.metrics, "verdicts": verdicts})
    log = run.log
    columns = {"q": log.x.q, "w": log.x.w, "d_hat": log.d_hat, "u": log.u, "s": log.s}
    header = ["t", *(f"{name}{k + 1}" for name, block in columns.items() for k in range(block.shape[1]))]
    store.write_csv(folder / "trajectory.csv", header, np.column_stack([log.t, *columns.values()]).tolist())
    if figures:
        limit = next((v.limit for v in run.verdicts if v.metric.startswith("peak_torque")), None)
        plotting.save(plotting.run_figures(run.parts, log, limit), folder / "figures")
