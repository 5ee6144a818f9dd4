"""What `ptsmc simulate` leaves: the history of one run as CSV, its metrics and verdicts, figures."""

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

from ptsmc_jax.campaigns import store
from ptsmc_jax.campaigns.runs import Run
from ptsmc_jax.onboard import sources
from ptsmc_jax.scenario import cautions, own, parsing
from ptsmc_jax.scenario.tables import Scenario

if TYPE_CHECKING:  # what flies C is imported where C flies
    from ptsmc_jax.onboard.library import InTheLoop

# of a verdict on a share of the time
OF_TIME = ("quantile", "confidence", "interpretation", "share_of_time", "shown")


def summary(run: Run, scenario: Scenario, computer: "InTheLoop | None" = None) -> dict[str, Any]:
    """What `summary.json` says; computer: the C that decided, where that is not the parts' own code."""
    verdicts = {
        v.metric: {
            **{"limit": v.limit, "margin": v.margin, "met": v.met, "worst": v.worst, "at_least": v.at_least},
            **({} if v.share_of_time is None else {name: getattr(v, name) for name in OF_TIME}),
        }
        for v in run.verdicts
    }
    heading = {"status": run.status, "reason": run.reason, "bad_time": run.bad_time}
    floor = None if run.floor is None else run.floor.window_error
    said, decided_by = cautions.of(scenario), {}
    if computer is not None:
        said += [computer.otherwise] if computer.otherwise else []
        statuses = {name: count for name, count in run.samples.items() if count}
        decided_by = {"controller_statuses": statuses, "controller": computer.library.digest}
    return {**heading, **run.metrics, "floor": floor, "verdicts": verdicts, "cautions": said, **decided_by}


def write(
    folder: Path,
    scenario: Scenario,
    run: Run,
    seed: int,
    trial: int | None,
    figures: bool,
    computer: "InTheLoop | None" = None,
    replayed: Mapping[str, Any] = MappingProxyType({}),
) -> None:
    """Fill a result folder; computer: see `summary`; replayed: what else `versions.json` says of a campaign's trial."""
    made_by = {"command": "simulate", "seed": seed, "trial": trial, **replayed, **own.digests(scenario)}
    if computer is not None:
        place = computer.library.folder
        made_by |= {"controller": str(place.absolute()), own.digest_name(own.CONTROLLER): sources.digest(place)}
    store.record(folder, parsing.dump(scenario), made_by, summary(run, scenario, computer))
    columns = run.columns()
    store.write_csv(folder / "trajectory.csv", list(columns), np.column_stack(list(columns.values())).tolist())
    if figures:
        from ptsmc_jax.figures import run_plots, style  # takes 0.3 s, which a run without figures need not wait for

        style.save(run_plots.run_figures(run.parts, run.log, run.torque_limit, run.floor), folder / "figures")
