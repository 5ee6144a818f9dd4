"""Test that a search in other units of time and inertia finds the same gains, converted to these units."""

import copy
import tomllib
from typing import Any

import numpy as np
import pytest

from ptsmc_jax.scenario import from_tables
from ptsmc_jax.simulation import catalogues
from tests.tree import ROOT
from tests.units import in_units, powers
from tuning.search import gains as gain_names
from tuning.studies import tuner

SATELLITES = ROOT / "benchmarks" / "satellites"
INERTIA, TIME = 4.0, 16.0  # powers of 4, so that square roots stay exact
SMALL = {"trials": 8, "starts": 3, "steps": 8}


def tables_of(name: str, **changes: Any) -> dict[str, Any]:
    """Return the tables of a satellite scenario with a small search. Changes replace whole tables."""
    raw = tomllib.loads((SATELLITES / f"{name}.toml").read_text())
    return {**copy.deepcopy(raw), **changes, "tune": SMALL}


def without_margins(name: str) -> dict[str, Any]:
    """Return the tables of a satellite without requirements on margins, which take long to compile."""
    tables = tables_of(name)
    requirements = {key: value for key, value in tables["requirements"].items() if key not in catalogues.MARGINS}
    return {**tables, "requirements": requirements}


@pytest.mark.long  # compilation takes minutes; tests/scenario/test_units.py checks defaults and bounds
@pytest.mark.parametrize(
    "tables",
    [without_margins("cubetas"), without_margins("sixu"), tables_of("microsat")],
    ids=["cubetas", "sixu", "microsat"],
)
def test_other_units_rescale_the_tuned_gains_and_change_nothing_else(tables):
    """Gains are reported with 10 digits and agree to 1e-9. Single trials amplify this rounding."""
    here, there = (
        tuner.tune(from_tables(one), 0, with_checks=False) for one in (tables, in_units(tables, INERTIA, TIME))
    )
    units = gain_names.units_of(here.tuned)
    for name, value in here.gains.items():
        mass, second = powers(units[gain_names.base(name)])
        assert there.gains[name] == pytest.approx(value * INERTIA**mass * TIME**second, rel=1e-9), name
    assert there.rollouts == here.rollouts
    assert there.gradients == here.gradients
    assert there.search.value == pytest.approx(here.search.value, rel=1e-9)
    for metric in ("window_error", "terminal_angle", "saturated"):
        one, other = (np.asarray(getattr(run.held_out["tuned"].metrics, metric)) for run in (here, there))
        np.testing.assert_allclose(other, one, rtol=1e-7)
    torque = INERTIA * TIME**-2.0
    one, other = (np.asarray(run.held_out["tuned"].metrics.peak_torque) for run in (here, there))
    np.testing.assert_allclose(other, torque * one, rtol=1e-7)
    np.testing.assert_array_equal(here.held_out["tuned"].status, there.held_out["tuned"].status)
