"""Figures of a Monte Carlo campaign, made from its rows. Read `build` first."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import polars as pl
from matplotlib.figure import Figure

from ptsmc_jax import scenario
from ptsmc_jax.campaigns import campaign as running
from ptsmc_jax.campaigns import rows
from ptsmc_jax.figures import campaign_plots as plots
from ptsmc_jax.figures.style import torque_metric
from ptsmc_jax.numerics import statistics
from ptsmc_jax.simulation.catalogues import as_angle, explained_metrics, percent, without_norms
from ptsmc_jax.simulation.requirements import INTERPRETATIONS, Requirement, Verdict
from tuning.studies.campaign_folder import Folder

FAN_TRIALS = 1000  # largest number of trials whose histories are plotted
SCATTER_TRIALS = 5000  # largest number of trials in a scatter plot


def build(folder: Folder, summary: dict[str, Any]) -> dict[str, Figure]:
    """Return the figures of a campaign by name; summary: the content of its `summary.json`."""
    parts = folder.intact_parts()
    required = scenario.requirements(folder.scenario)
    limits = {r.metric: r.limit for r in required}
    torque_name = torque_metric(limits)
    metrics = dict.fromkeys((*limits, "window_error", torque_name))
    names = without_norms(metrics)
    time_metrics = [r.timed for r in required if r.timed is not None]
    frame = rows.read(parts, ["trial", "status", "initial_angle", *metrics, *time_metrics]).head(folder.trials)
    finished = running.has_finished(frame)
    time_fractions = {v["metric"]: _describe_time_fraction(Verdict.read(v)) for v in summary["verdicts"]}
    units = folder.units

    def plotted_column(name: str, values: np.ndarray) -> plots.Column:
        stated_unit, limit = units.get(name, ""), limits.get(name)
        unit, values = as_angle(name, stated_unit, values)
        limit = None if limit is None else float(as_angle(name, stated_unit, limit)[1])
        return plots.Column(unit, values, limit, time_fractions.get(name, ""))

    figures: dict[str, Figure] = {}
    if finished.any():
        if folder.can_simulate:  # campaigns store no histories, so the figure simulates its trials again
            figures |= _plot_fan(folder, frame, finished, limits)
        figures["distributions"] = plots.distributions(
            {name: plotted_column(name, np.where(finished, frame[name].to_numpy(), np.nan)) for name in names}
        )
    outcome, missed = _classify_trials(frame, required)
    labels = {}
    for name in plots.MARKS:
        metrics_beyond = f" ({', '.join(missed[name])})" if name in missed else ""
        labels[name] = f"{name.replace('_', ' ')}{metrics_beyond}: {np.count_nonzero(outcome == name)}"
    is_good = np.isin(outcome, (plots.KEPT, plots.AT_TIMES))
    bad_trials, good_trials = np.flatnonzero(~is_good)[: SCATTER_TRIALS // 2], np.flatnonzero(is_good)
    # failed trials and trials beyond a limit come last, so that their marks are on top
    plotted = np.concatenate([good_trials[: SCATTER_TRIALS - bad_trials.size], bad_trials])
    angle, torque = (frame[name].to_numpy().astype(float)[plotted] for name in ("initial_angle", torque_name))
    if np.isfinite(torque).any():
        angles, torques = plotted_column("initial_angle", angle), plotted_column(torque_name, torque)
        figures["torque_by_angle"] = plots.torque_by_angle(angles, torques, outcome[plotted], labels, torque_name)
    explained = explained_metrics(verdict["metric"] for verdict in summary["verdicts"])
    shown = [name for name in names if name in explained][:4]
    strongest_inputs = _strongest_inputs(summary, shown)
    if strongest_inputs:
        inputs = rows.read(parts, strongest_inputs)[plotted]
        figures["inputs"] = plots.inputs(
            {name: plotted_column(name, inputs[name].to_numpy()) for name in strongest_inputs},
            {name: plotted_column(name, frame[name].to_numpy()[plotted].astype(float)) for name in shown},
            outcome[plotted],
            labels,
        )
    return figures


def _strongest_inputs(summary: dict[str, Any], metrics: Sequence[str]) -> list[str]:
    """Return the names of at most four inputs that explain one of the metrics best, the best first."""
    explained = dict[str, float]()
    for metric in (name for name in metrics if name in summary["drivers"]):
        strongest = statistics.strongest_drivers(summary["drivers"][metric], summary["driver_trials"][metric])
        explained |= {name: max(fraction, explained.get(name, 0.0)) for name, fraction in strongest.items()}
    return sorted(explained, key=lambda name: -explained[name])[:4]


def _classify_trials(frame: pl.DataFrame, required: Sequence[Requirement]) -> tuple[np.ndarray, dict[str, list[str]]]:
    """Return the outcome of each trial, a key of `plots.MARKS`, (trials,), and the metrics beyond a limit by outcome.

    Some requirements ask for a fraction of the time within the limit. A single trial can break such a requirement if
    its interpretation is "temporal", but not if it is "mixed": then the fraction is a mean over all runs.
    """
    outcome = frame["status"].to_numpy().astype(object)
    ok = outcome == "ok"
    outcome[ok] = plots.KEPT
    missed: dict[str, list[str]] = {}
    for requirement in required:
        is_beyond = ok & ~(frame[requirement.metric].to_numpy() <= requirement.limit)
        is_broken = is_beyond if requirement.timed is None else np.zeros_like(ok)
        if requirement.timed is not None and requirement.interpretation == "temporal":
            is_broken = ok & ~(frame[requirement.timed].to_numpy() >= requirement.quantile)
        outcome[is_beyond & (outcome == plots.KEPT)] = plots.AT_TIMES
        outcome[is_broken] = plots.BEYOND
        for name, trials in ((plots.AT_TIMES, is_beyond & ~is_broken), (plots.BEYOND, is_broken)):
            if trials.any():
                missed.setdefault(name, []).append(requirement.metric)
    return outcome, missed


def _describe_time_fraction(verdict: Verdict) -> str:
    """Return the required and the observed fraction of time in words, or "" if the requirement counts trials."""
    if verdict.fraction_of_time is None or verdict.quantile is None:
        return ""
    required = f"required: {100 * verdict.quantile:g} % of {INTERPRETATIONS[verdict.interpretation].split(':')[0]}"
    qualifier = "at least " if verdict.interpretation == "temporal" else ""
    return f"{required}; seen: {qualifier}{percent(verdict.fraction_of_time)} %"


def _plot_fan(
    folder: Folder, frame: pl.DataFrame, finished: np.ndarray, limits: Mapping[str, float]
) -> dict[str, Figure]:
    """Simulate the first trials and the trial with the largest window error again, and plot their errors over time.

    The result is the figure by its name. It is empty if none of the first trials reaches its end, or if all errors are
    zero: its axis is logarithmic.
    """
    trials, window = frame["trial"].to_numpy(), frame["window_error"].to_numpy()  # a shard has only some of the trials
    first_trials = trials[:FAN_TRIALS]
    worst_row = int(np.argmax(np.where(finished & np.isfinite(window), window, -np.inf)))
    simulated = np.append(first_trials, trials[worst_row]).astype(np.uint32)
    t, error = running.error_history(folder.campaign_without_metrics, simulated)
    worst, finished_errors = (int(trials[worst_row]), error[-1]), error[:-1][finished[: first_trials.size]]
    if not finished_errors.any():
        return {}
    described = f"{trials.size} trial{'s' if trials.size != 1 else ''}"
    if first_trials.size < trials.size:
        described = f"the first {first_trials.size} of {described}"
    failed = first_trials.size - len(finished_errors)
    described += f", {failed} failed" if failed else ""
    parts = folder.campaign_without_metrics.ready.parts
    return {"fan": plots.fan(t, finished_errors, worst, parts, limits, described)}
