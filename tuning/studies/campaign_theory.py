"""The lower bound of the error and the verdicts on stability margins of a campaign.

`write_missing` computes both and writes them to `theory.json` in the campaign's folder. The other functions read
this file.
"""

from collections.abc import Mapping
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from ptsmc_jax.campaigns import campaign as running
from ptsmc_jax.campaigns import margin_verdicts, rows, runs, store
from ptsmc_jax.dispersions.variation import Row
from ptsmc_jax.simulation import catalogues
from ptsmc_jax.simulation.requirements import Verdict

if TYPE_CHECKING:
    from tuning.studies.campaign_folder import Folder

FILE = "theory.json"


class _Theory(msgspec.Struct):
    """The content of `theory.json`."""

    lower_bound: float | None
    margins: list[dict[str, Any]]


def write_missing(folder: "Folder") -> None:
    """Write `theory.json` if it is missing, incomplete or damaged.

    It has the lower bound of the RMS window error, and the verdicts on the required stability margins. If margins are
    required, nothing is written before the trials that they are judged on are simulated.
    """
    if not _lacks_theory(folder):
        return
    ready, table = folder.campaign.ready, folder.campaign.run_table
    finished = _judged_trials_finished(folder) if ready.margins else np.zeros(0, bool)
    if finished is None:
        return
    bound_trials = 0 if table is None else min(runs.BOUND_TRIALS, table.count)
    first_rows = [] if table is None else [table.row(k, folder.seed) for k in range(bound_trials)]
    verdicts = margin_verdicts.judge_trials(ready, folder.seed, _rows_with_margins(folder), finished)
    lower_bound = runs.rms_lower_bound(ready, folder.seed, first_rows)
    theory = {"lower_bound": lower_bound, "margins": [verdict.in_summary() for verdict in verdicts]}
    store.write_json(folder.path / FILE, theory)


def prepare(folder: "Folder") -> None:
    """Start to compile the programs of `write_missing` in the background, while the trials are simulated."""
    if _lacks_theory(folder):
        margin_verdicts.prepare(folder.campaign.ready, _rows_with_margins(folder))
        runs.prepare(folder.campaign.ready)


def _lacks_theory(folder: "Folder") -> bool:
    """Return whether lower bound or margins of a campaign are still to be computed."""
    theory = read(folder)
    return "lower_bound" not in theory or bool(margins_without_verdict(folder, theory))


def _judged_trials_finished(folder: "Folder") -> np.ndarray | None:
    """Return which of the trials with margins reached their end; None: another shard has not simulated them yet."""
    parts, _ = folder.rows.parts()
    judged = min(margin_verdicts.TRIALS, folder.trials)
    if running.missing_parts(parts, judged):
        return None
    return running.has_finished(rows.read(parts, ["status"]).head(judged))


def _rows_with_margins(folder: "Folder") -> np.ndarray | Row | None:
    """Return the rows of the run table whose margins are computed, or None without a run table."""
    table = folder.campaign.run_table
    return None if table is None else table.rows(np.arange(min(margin_verdicts.TRIALS, table.count)), folder.seed)


def margins_without_verdict(folder: "Folder", theory: Mapping[str, Any]) -> list[str]:
    """Return the required margins without a verdict: the campaign was interrupted, or `theory.json` is damaged."""
    judged = {verdict["metric"] for verdict in theory.get("margins", [])}
    return [name for name in catalogues.MARGINS if name in folder.scenario.requirements and name not in judged]


def read(folder: "Folder") -> dict[str, Any]:
    """Return "lower_bound" and "margins" of `theory.json`, or nothing if the file is missing or damaged."""
    try:
        theory = msgspec.json.decode((folder.path / FILE).read_bytes(), type=_Theory)
        margins = [msgspec.convert(asdict(Verdict.read(entry)), Verdict) for entry in theory.margins]
    except (OSError, ValueError, TypeError):
        return {}
    return {"lower_bound": theory.lower_bound, "margins": [verdict.in_summary() for verdict in margins]}
