"""Figures of a Monte Carlo campaign, made from its rows. Read `build` first."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import polars as pl
from matplotlib.figure import Figure

from ptsmc_jax import scenario
from ptsmc_jax.campaigns import campaign as running
from ptsmc_jax.campaigns import rows
from ptsmc_jax.figures import campaign_plots as plots
from ptsmc_jax.formulas import pointing_angle
from ptsmc_jax.simulation.catalogues import percent
from ptsmc_jax.simulation.requirements import INTERPRETATIONS, Requirement, Verdict
from tuning.studies.campaign_folder import Folder

ERRORS = ("terminal_error", "window_error", "hold_error")  # norms of error vectors
DRAWN = 1000  # largest number of trials whose histories are plotted
POINTS = 5000  # largest number of trials in a scatter plot


def build(folder: Folder, summary: dict[str, Any]) -> dict[str, Figure]:
    """Return the figures of a campaign by name; summary: the content of its `summary.json`."""
    parts = folder.whole_parts()
    required = scenario.requirements(folder.scenario)
    limits = {r.metric: r.limit for r in required}
    names = list(dict.fromkeys((*limits, "window_error", "peak_torque")))
    timed = [r.timed for r in required if r.timed is not None]
    frame = rows.read(parts, ["trial", "status", "initial_angle", *names, *timed]).head(folder.trials)
    finished = running.finished(frame)
    of_time = {v["metric"]: _of_time(Verdict.read(v)) for v in summary["verdicts"]}
    units, spacecraft = folder.units, folder.scenario.plant.kind == "spacecraft"

    def column(name: str, values: np.ndarray) -> plots.Column:
        unit, limit = units.get(name, ""), limits.get(name)
        if spacecraft and name in ERRORS:  # as an angle
            unit, values, limit = "rad", pointing_angle(values), None if limit is None else float(pointing_angle(limit))
        return plots.Column(unit, values, limit, of_time.get(name, "")).in_readable_unit()

    figures: dict[str, Figure] = {}
    if finished.any():
        if folder.can_simulate:  # campaigns store no histories, so the figure simulates its trials again
            figures |= _fan(folder, frame, finished)
        figures["distributions"] = plots.distributions(
            {name: column(name, np.where(finished, frame[name].to_numpy(), np.nan)) for name in names}
        )
    outcome = _outcomes(frame, required)
    totals = {name: int((outcome == name).sum()) for name in plots.MARKS}
    fine = np.isin(outcome, ("ok", plots.AT_TIMES))
    bad, good = np.flatnonzero(~fine)[: POINTS // 2], np.flatnonzero(fine)
    some = np.concatenate([good[: POINTS - bad.size], bad])  # trials with problems last, so that their marks are on top
    angle, torque = (frame[name].to_numpy().astype(float)[some] for name in ("initial_angle", "peak_torque"))
    if np.isfinite(torque).any():
        starts, torques = column("initial_angle", angle), column("peak_torque", torque)
        figures["torque_by_angle"] = plots.torque_by_angle(starts, torques, outcome[some], totals)
    drivers = summary["drivers"].get("window_error", {})
    strongest = sorted(drivers, key=lambda name: -drivers[name]["first_order"])[:4]
    if strongest:
        inputs = rows.read(parts, strongest)[some]
        figures["inputs"] = plots.inputs(
            {name: column(name, inputs[name].to_numpy()) for name in strongest},
            {name: column(name, frame[name].to_numpy()[some].astype(float)) for name in names[:4]},
            outcome[some],
            totals,
        )
    return figures


def _outcomes(frame: pl.DataFrame, required: Sequence[Requirement]) -> np.ndarray:
    """Return the outcome of each trial, a key of `plots.MARKS`, (trials,).

    Some requirements ask for a fraction of the time within the limit. A single trial can break such a requirement if
    its interpretation is "temporal", but not if it is "mixed": then the fraction is a mean over all runs.
    """
    outcome = frame["status"].to_numpy().astype(object)
    ok = outcome == "ok"
    for one in required:
        beyond = ok & ~(frame[one.metric].to_numpy() <= one.limit)
        breaks = beyond if one.timed is None else np.zeros_like(ok)
        if one.timed is not None and one.interpretation == "temporal":
            breaks = ok & ~(frame[one.timed].to_numpy() >= one.quantile)
        outcome[beyond & (outcome == "ok")] = plots.AT_TIMES
        outcome[breaks] = plots.BEYOND
    return outcome


def _of_time(verdict: Verdict) -> str:
    """Return the required and the observed fraction of time in words, or "" if the requirement counts trials."""
    if verdict.fraction_of_time is None or verdict.quantile is None:
        return ""
    asked = f"required: {100 * verdict.quantile:g} % of {INTERPRETATIONS[verdict.interpretation].split(':')[0]}"
    least = "at least " if verdict.interpretation == "temporal" else ""
    return f"{asked}; seen: {least}{percent(verdict.fraction_of_time)} %"


def _fan(folder: Folder, frame: pl.DataFrame, finished: np.ndarray) -> dict[str, Figure]:
    """Simulate the first trials and the trial with the largest window error again, and plot their errors over time.

    The result is empty if none of the first trials reaches its end, or if all errors are zero: the axis is logarithmic.
    """
    trials, window = frame["trial"].to_numpy(), frame["window_error"].to_numpy()  # a shard has only some of the trials
    shown = trials[:DRAWN]
    hardest = int(np.argmax(np.where(finished & np.isfinite(window), window, -np.inf)))
    t, error = running.history(folder.without_metrics, np.append(shown, trials[hardest]).astype(np.uint32))
    simulated, worst, ended = folder.scenario, (int(trials[hardest]), error[-1]), error[:-1][finished[: shown.size]]
    return {"fan": plots.fan(t, ended, worst, simulated.controller.t_f, simulated.plant.kind)} if ended.any() else {}
