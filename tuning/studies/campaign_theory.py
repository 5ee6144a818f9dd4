"""What theory says of a campaign, kept in its folder: the floor of its errors, and verdicts on margins."""

import json
from typing import Any

import numpy as np

from ptsmc_jax.campaigns import margin_verdicts, runs, store
from ptsmc_jax.dispersions.planned import Row
from ptsmc_jax.simulation import catalogues
from tuning.studies.campaign_folder import FLOOR, Folder


def find(folder: Folder) -> None:
    """Write what theory says into the folder, where it is not there yet, or cannot be read.

    The RMS window error that no controller can beat, and verdicts on the margins that are asked for.
    """
    if _lacks_theory(folder):
        ready, plan = folder.campaign.ready, folder.campaign.plan
        first = [] if plan is None else [plan.row(k, folder.seed) for k in range(min(runs.FLOORS, plan.count))]
        verdicts = margin_verdicts.over_trials(ready, folder.seed, _looked_at(folder))
        floor = runs.floor(ready, folder.seed, first)
        theory = {"window_error": floor, "margins": [verdict.in_summary() for verdict in verdicts]}
        store.write_json(folder.path / FLOOR, theory)


def prepare(folder: Folder) -> None:
    """Begin to compile what `find` needs, beside flying."""
    if _lacks_theory(folder):
        margin_verdicts.prepare(folder.campaign.ready, _looked_at(folder))
        runs.prepare(folder.campaign.ready)


def _lacks_theory(folder: Folder) -> bool:
    return "window_error" not in _theory(folder) or bool(unjudged(folder))


def _looked_at(folder: Folder) -> np.ndarray | Row | None:
    """The rows of a plan whose loops are looked at; None: there is none."""
    plan = folder.campaign.plan
    return None if plan is None else plan.rows(np.arange(min(margin_verdicts.TRIALS, plan.count)), folder.seed)


def floor_of(folder: Folder) -> float | None:
    """The floor that `find` wrote; None: none, as in campaigns of earlier versions."""
    return _theory(folder).get("window_error")


def margins_of(folder: Folder) -> list[dict[str, Any]]:
    """The verdicts on margins that `find` wrote, as `summary.json` says them."""
    return _theory(folder).get("margins", [])


def unjudged(folder: Folder) -> list[str]:
    """Margins that are asked for and that no verdict is there of: flying ended before, or what it wrote is damaged."""
    judged = {verdict["metric"] for verdict in margins_of(folder)}
    return [name for name in catalogues.MARGINS if name in folder.scenario.requirements and name not in judged]


def _theory(folder: Folder) -> dict[str, Any]:
    try:
        return dict(json.loads((folder.path / FLOOR).read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError):
        return {}
