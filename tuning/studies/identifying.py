"""The result folder of `ptsmc identify`. Read `write` first."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import polars as pl

from ptsmc_jax.campaigns import store
from ptsmc_jax.identification import results
from ptsmc_jax.identification.design import Design
from ptsmc_jax.identification.estimation import Identification
from ptsmc_jax.scenario import custom, parsing
from ptsmc_jax.scenario.tables import Scenario
from ptsmc_jax.simulation.catalogues import CATALOGUES
from tuning.search import custom_parts


def write(folder: Path, identification: Identification, figures: bool, made_by: Mapping[str, object]) -> None:
    """Write a result folder: `identified.toml`, `summary.json`, `innovations.csv` and figures.

    Args:
        folder: an empty folder.
        identification: the estimates.
        figures: write figures too.
        made_by: entries of `versions.json`.
    """
    versions = {"command": "identify", "seed": None, **made_by, **custom.checksums(identification.scenario)}
    store.write_run_files(folder, parsing.dump(identification.scenario), versions, results.summary(identification))
    identified = results.identified_scenario(identification)
    store.write_toml(folder / "identified.toml", custom_parts.copy_custom_files(parsing.dump(identified), folder))
    for k, fit in enumerate([*identification.fits, *identification.validation]):
        name = "innovations" if k == 0 else f"innovations_{k + 1}"
        names = results.component_names(fit)
        values, sigma = results.innovations(fit)
        header = ["t", *names, *(f"{component}_sigma" for component in names)]
        store.write_csv(folder / f"{name}.csv", header, np.column_stack([fit.log.t[1:], values, sigma]).tolist())
    if figures:
        from ptsmc_jax.figures import identification_plots, style

        style.save(identification_plots.identification_figures(identification), folder / "figures")


def design_summary(design: Design) -> dict[str, object]:
    """Return the content of `summary.json` of a design."""
    limits = {"duration": design.duration, "rate": design.rate, "torque": design.torque}
    rows = list(design.table().iter_rows(named=True))
    return {"status": "designed", **limits, "parameters": rows, "undetermined": design.undetermined}


def write_design(folder: Path, scenario: Scenario, design: Design, figures: bool) -> None:
    """Write a result folder: `profile.csv`, `summary.json` and a figure of the profile.

    Args:
        folder: an empty folder.
        scenario: the scenario.
        design: the proposed manoeuvre.
        figures: write figures too.
    """
    versions = {"command": "identify", "seed": None, "design": True, **custom.checksums(scenario)}
    store.write_run_files(folder, parsing.dump(scenario), versions, design_summary(design))
    frame = design.frame
    store.write_csv(folder / "profile.csv", frame.columns, frame.rows())
    if figures:
        from ptsmc_jax.figures import identification_plots, style

        unit = CATALOGUES[scenario.plant.kind]["peak_torque"].unit
        blocks = {"sent": f"command [{unit}]", "measured_w": "rate [rad/s]", "measured_x": "state"}
        panels = [
            (label, frame.select(pl.col(f"^{name}\\d+$")).to_numpy()) for name, label in blocks.items()
            if f"{name}1" in frame.columns
        ]  # fmt: skip
        style.save({"profile": identification_plots.profile(frame["t"].to_numpy(), panels)}, folder / "figures")
