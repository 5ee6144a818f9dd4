"""Lower bound and status of single runs."""

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ptsmc_jax.campaigns import runs
from ptsmc_jax.theory import lower_bound


@pytest.mark.parametrize(("varies", "rows", "simulated"), [
    (True, (), [0, 1, 2, 3]), (False, (), [None]), (True, (7, 9), [7, 9]), (False, (7,), [7]),
])  # fmt: skip
def test_lower_bound_is_pooled_over_the_first_trials_or_rows(monkeypatch, varies, rows, simulated):
    """Trial k has the lower bound k + 1. The second simulated trial fails and has no bound."""
    seen: list[Any] = []

    def fly(ready, seed, trial):
        seen.append((seed, trial))
        return SimpleNamespace(has_lower_bound=len(seen) != 2, parts=1.0 + (trial or 0), log=None)

    def along_each(simulated):
        return [lower_bound.LowerBound(bound, np.zeros(1), np.zeros(1)) for bound, _ in simulated]

    monkeypatch.setattr(runs, "_simulate_without_margins", fly)
    monkeypatch.setattr(lower_bound, "bounds_along_runs", along_each)
    ready: Any = SimpleNamespace(dispersion=SimpleNamespace(varies=varies))
    squares = [(1.0 + (k or 0)) ** 2 for j, k in enumerate(simulated) if j != 1]
    assert runs.rms_lower_bound(ready, 5, rows) == pytest.approx(math.sqrt(sum(squares) / len(squares)))
    assert seen == [(5, k) for k in simulated]


@pytest.mark.parametrize("status", ["not_converged", "singular", "diverged"])
def test_failed_run_is_not_met_even_without_requirements(status):
    """`ptsmc simulate` then has exit status 1."""
    none: Any = None
    run = runs.Run(none, none, {}, {}, "ok", "", math.nan, [], {})
    assert run.met
    assert not replace(run, status=status).met
