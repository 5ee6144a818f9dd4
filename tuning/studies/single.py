"""The result folder of `ptsmc simulate`: history of one run as CSV, metrics, verdicts and figures.

Read `write` first.
"""

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np

from ptsmc_jax.campaigns import store
from ptsmc_jax.campaigns.runs import Run
from ptsmc_jax.dispersions import quantities
from ptsmc_jax.onboard import sources
from ptsmc_jax.scenario import aem as attitude_messages
from ptsmc_jax.scenario import custom, parsing, plausibility
from ptsmc_jax.scenario.tables import Scenario

if TYPE_CHECKING:  # runs without C code do not need this import
    from ptsmc_jax.onboard.library import InTheLoop


def summary(run: Run, scenario: Scenario, computer: "InTheLoop | None" = None) -> dict[str, object]:
    """Return the content of `summary.json`.

    Args:
        run: the simulated run.
        scenario: scenario of the run.
        computer: the C code that controlled the run; None: the simulated law did.
    """
    verdicts = [verdict.in_summary() for verdict in run.verdicts]
    heading = {"status": run.status, "reason": run.reason, "bad_time": run.bad_time}
    lower_bound = None if run.lower_bound is None else run.lower_bound.window_error
    warnings, controller_entries = plausibility.warnings(scenario), {}
    if computer is not None:
        warnings += [computer.parameter_differences] if computer.parameter_differences else []
        statuses = {name: count for name, count in run.samples.items() if count}
        controller_entries = {"controller_statuses": statuses, "controller": computer.library.checksum}
    unit_of = quantities.units(run.parts)
    names = [name for name in {**unit_of, **run.drawn} if name in run.drawn]  # in the order of the dispersions
    drawn = {name: {"value": run.drawn[name], "unit": unit_of.get(name, "")} for name in names}
    assessment = {"lower_bound": lower_bound, "verdicts": verdicts, "warnings": warnings, "drawn": drawn}
    return {**heading, **run.metrics, **assessment, **controller_entries}


def write(
    folder: Path,
    scenario: Scenario,
    run: Run,
    seed: int,
    trial: int | None,
    figures: bool,
    computer: "InTheLoop | None" = None,
    replayed: Mapping[str, object] = MappingProxyType({}),
    aem: bool = False,
) -> None:
    """Write a result folder: `summary.json`, `trajectory.csv` and figures.

    Args:
        folder: an empty folder.
        scenario: the scenario.
        run: the simulated run.
        seed: seed of dispersions and noise.
        trial: number of the trial; None: the nominal run.
        figures: write figures too.
        computer: the C code that controlled the run; None: the simulated law did.
        replayed: further entries of `versions.json` if the run repeats a trial of a campaign.
        aem: write `attitude.aem` too, an attitude ephemeris message.
    """
    made_by = {"command": "simulate", "seed": seed, "trial": trial, **replayed, **custom.checksums(scenario)}
    if computer is not None:
        c_folder = computer.library.folder
        made_by |= {
            "controller": str(c_folder.absolute()),
            custom.checksum_name(custom.CONTROLLER_OPTION): sources.checksum(c_folder),
        }
    store.write_run_files(folder, parsing.dump(scenario), made_by, summary(run, scenario, computer))
    columns = run.columns()
    store.write_csv(folder / "trajectory.csv", list(columns), np.column_stack(list(columns.values())).tolist())
    if aem:
        x, t = run.log.x, np.asarray(run.log.t)
        text = attitude_messages.format_message("SPACECRAFT", t, np.asarray(x.q), np.asarray(x.w), scenario.loop.epoch)
        store.write_text(folder / "attitude.aem", text)
    if figures:
        from ptsmc_jax.figures import run_plots, style  # the import takes 0.3 s, which only figures need

        style.save(run_plots.run_figures(run.parts, run.log, run.limits, run.lower_bound), folder / "figures")
