"""The lower bound and the margins in the folder of a campaign."""

import json
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ptsmc_jax.campaigns import margin_verdicts, runs
from tuning.studies import campaign_theory


@pytest.mark.parametrize(("count", "rows", "looked"), [(None, [], None), (3, [0, 1, 2], 3), (900, [0, 1, 2, 3], 256)])
def test_bound_and_margins_use_the_first_trials_and_are_computed_once(tmp_path, monkeypatch, count, rows, looked):
    """A run table has the lower bound of at most its first 4 rows, and the margins of at most its first 256 rows."""
    asked: list[Any] = []

    def lower_bound(ready, seed, first):
        asked.append((ready, seed, first))
        return 1e-6

    def of_trials(ready, seed, some):
        asked.append((ready, seed, None if some is None else len(some)))
        return []

    monkeypatch.setattr(runs, "rms_lower_bound", lower_bound)
    monkeypatch.setattr(margin_verdicts, "judge_trials", of_trials)
    table = SimpleNamespace(count=count, row=lambda k, seed: (k, seed), rows=lambda numbers, seed: np.asarray(numbers))
    simulated = SimpleNamespace(ready="ready", run_table=None if count is None else table)
    folder: Any = SimpleNamespace(path=tmp_path, seed=7, campaign=simulated, scenario=SimpleNamespace(requirements={}))
    campaign_theory.write_missing(folder)
    assert asked == [("ready", 7, looked), ("ready", 7, [(k, 7) for k in rows])]
    assert json.loads((tmp_path / "theory.json").read_text()) == {"lower_bound": 1e-6, "margins": []}
    campaign_theory.write_missing(folder)
    assert len(asked) == 2
    assert campaign_theory.read_lower_bound(folder) == 1e-6
