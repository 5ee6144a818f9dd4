"""The lower bound of the error and the verdicts on stability margins of a campaign.

`write_missing` computes both and writes them to `theory.json` in the campaign's folder. The other functions read
this file.
"""

import json
from typing import Any

import numpy as np

from ptsmc_jax.campaigns import margin_verdicts, runs, store
from ptsmc_jax.dispersions.variation import Row
from ptsmc_jax.simulation import catalogues
from tuning.studies.campaign_folder import THEORY, Folder


def write_missing(folder: Folder) -> None:
    """Write `theory.json` if it is missing, incomplete or damaged.

    It has the lower bound of the RMS window error, and the verdicts on the required stability margins.
    """
    if _lacks_theory(folder):
        ready, table = folder.campaign.ready, folder.campaign.run_table
        bound_trials = 0 if table is None else min(runs.BOUND_TRIALS, table.count)
        first_rows = [] if table is None else [table.row(k, folder.seed) for k in range(bound_trials)]
        verdicts = margin_verdicts.judge_trials(ready, folder.seed, _rows_with_margins(folder))
        lower_bound = runs.rms_lower_bound(ready, folder.seed, first_rows)
        theory = {"lower_bound": lower_bound, "margins": [verdict.in_summary() for verdict in verdicts]}
        store.write_json(folder.path / THEORY, theory)


def prepare(folder: Folder) -> None:
    """Start to compile the programs of `write_missing` in the background, while the trials are simulated."""
    if _lacks_theory(folder):
        margin_verdicts.prepare(folder.campaign.ready, _rows_with_margins(folder))
        runs.prepare(folder.campaign.ready)


def _lacks_theory(folder: Folder) -> bool:
    return "lower_bound" not in _read_theory(folder) or bool(margins_without_verdict(folder))


def _rows_with_margins(folder: Folder) -> np.ndarray | Row | None:
    """Return the rows of the run table whose margins are computed, or None without a run table."""
    table = folder.campaign.run_table
    return None if table is None else table.rows(np.arange(min(margin_verdicts.TRIALS, table.count)), folder.seed)


def read_lower_bound(folder: Folder) -> float | None:
    """Return the lower bound of the RMS window error that `write_missing` wrote; None: there is none."""
    return _read_theory(folder).get("lower_bound")


def read_margin_verdicts(folder: Folder) -> list[dict[str, Any]]:
    """Return the verdicts on margins that `write_missing` wrote, as in `summary.json`."""
    return _read_theory(folder).get("margins", [])


def margins_without_verdict(folder: Folder) -> list[str]:
    """Return the required margins without a verdict: the campaign was interrupted, or `theory.json` is damaged."""
    judged = {verdict["metric"] for verdict in read_margin_verdicts(folder)}
    return [name for name in catalogues.MARGINS if name in folder.scenario.requirements and name not in judged]


def _read_theory(folder: Folder) -> dict[str, Any]:
    try:
        return dict(json.loads((folder.path / THEORY).read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError):
        return {}
