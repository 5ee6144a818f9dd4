"""The result folder of `ptsmc identify`. Read `write` first."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from scipy.spatial.transform import Rotation

from ptsmc_jax.campaigns import store
from ptsmc_jax.identification import results
from ptsmc_jax.identification.design import Design
from ptsmc_jax.identification.estimation import Fit, Identification
from ptsmc_jax.scenario import custom, parsing
from ptsmc_jax.scenario.tables import Scenario
from tuning.search import custom_parts

UNITS = {"attitude": "rad", "rate": "rad/s"}  # of innovations


def write(folder: Path, found: Identification, figures: bool, made_by: Mapping[str, Any]) -> None:
    """Write a result folder: `identified.toml`, `summary.json`, `innovations.csv` and figures.

    Args:
        folder: an empty folder.
        found: the estimates.
        figures: write figures too.
        made_by: entries of `versions.json`.
    """
    made = {"command": "identify", "seed": None, **made_by, **custom.checksums(found.scenario)}
    store.record(folder, parsing.dump(found.scenario), made, results.summary(found))
    identified = results.identified(found)
    store.write_toml(folder / "identified.toml", custom_parts.carry(parsing.dump(identified), folder))
    for k, fit in enumerate([*found.fits, *found.validation]):
        name = "innovations" if k == 0 else f"innovations_{k + 1}"
        names = results.components(fit)
        values, sigma = innovations(fit)
        header = ["t", *names, *(f"{one}_sigma" for one in names)]
        store.write_csv(folder / f"{name}.csv", header, np.column_stack([fit.log.t[1:], values, sigma]).tolist())
    if figures:
        from ptsmc_jax.figures import style

        style.save(figures_of(found), folder / "figures")


def design_summary(design: Design, given: Mapping[str, Any]) -> dict[str, Any]:
    """Return the content of `summary.json` of a design; given: its duration [s] and limits."""
    rows = list(design.table().iter_rows(named=True))
    return {"status": "designed", **given, "parameters": rows, "undetermined": design.undetermined}


def write_design(folder: Path, scenario: Scenario, design: Design, figures: bool, given: Mapping[str, Any]) -> None:
    """Write a result folder: `profile.csv`, `summary.json` and a figure of the profile.

    Args:
        folder: an empty folder.
        scenario: the scenario.
        design: the proposed manoeuvre.
        figures: write figures too.
        given: its duration [s] and limits.
    """
    made = {"command": "identify", "seed": None, "design": True, **custom.checksums(scenario)}
    store.record(folder, parsing.dump(scenario), made, design_summary(design, given))
    frame = design.frame
    store.write_csv(folder / "profile.csv", frame.columns, frame.rows())
    if figures:
        from ptsmc_jax.figures import identification_plots, style

        blocks = {"sent": "command", "measured_w": "rate [rad/s]", "measured_x": "state"}
        panels = [
            (label, frame.select(pl.col(f"^{name}\\d+$")).to_numpy()) for name, label in blocks.items()
            if f"{name}1" in frame.columns
        ]  # fmt: skip
        style.save({"profile": identification_plots.profile(frame["t"].to_numpy(), panels)}, folder / "figures")


def innovations(fit: Fit) -> tuple[np.ndarray, np.ndarray]:
    """Return innovations and their 1 sigma at the rows of the log but the first, NaN without a reading."""
    sampled = fit.rows.source[1:] >= 0
    value, variance, accepted = (part[sampled] for part in fit.innovations)
    return np.where(accepted, value, np.nan), np.where(accepted, np.sqrt(variance), np.nan)


def figures_of(found: Identification) -> dict[str, Any]:
    """Return the figures by name; those of the second log and of later ones have its number."""
    from ptsmc_jax.figures import identification_plots as plots
    from ptsmc_jax.figures import style

    figures: dict[str, Any] = {"estimates": plots.estimates(found.table())}
    for k, fit in enumerate([*found.fits, *found.validation]):
        end = "" if k == 0 else f"_{k + 1}"
        names, t = results.components(fit), fit.log.t[1:]
        values, sigma = innovations(fit)
        labels = [style.with_unit(name, UNITS.get(name.split("_")[0], "")) for name in names]
        figures[f"innovations{end}"] = plots.innovations(t, labels, values, sigma)
        counts = np.sum(np.isfinite(values), axis=0)
        figures[f"autocorrelation{end}"] = plots.autocorrelation(names, fit.autocorrelation(), counts)
        figures[f"prediction{end}"] = plots.signals(t, _panels(fit, values))
    return figures


def _panels(fit: Fit, values: np.ndarray) -> list[tuple[str, np.ndarray, np.ndarray]]:
    """Return label, measured and predicted values of each signal; the attitude is the rotation from the first row."""
    panels, at = [], 0
    for name, readings in fit.log.readings.items():
        measured = readings[1:]
        size = 3 if name == "attitude" else readings.shape[1]
        errors = values[:, at : at + size]
        at += size
        if name == "attitude":
            there = ~np.isnan(measured[:, 0]) & ~np.isnan(errors[:, 0])
            angles, predicted = np.full((len(measured), 3), np.nan), np.full((len(measured), 3), np.nan)
            first, now = Rotation.from_quat(readings[0]), Rotation.from_quat(measured[there])
            angles[there] = np.rad2deg((first.inv() * now).as_rotvec())
            back = now * Rotation.from_rotvec(-errors[there])
            predicted[there] = np.rad2deg((first.inv() * back).as_rotvec())
            panels.append(("rotation [deg]", angles, predicted))
        else:
            label = "rate [rad/s]" if name == "rate" else "state"
            panels.append((label, measured, measured - errors))
    return panels
