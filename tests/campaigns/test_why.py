"""Reasons of the worst trials: percentiles of their inputs among all trials, medians, and sensitivities."""

import inspect
from types import SimpleNamespace
from typing import Any

import numpy as np
import polars as pl
import pytest

from ptsmc_jax import scenario as scenarios
from ptsmc_jax.campaigns import campaign, run_tables
from ptsmc_jax.dispersions.quantities import CATEGORIES
from ptsmc_jax.numerics import statistics
from tests.output import examples
from tuning.output import campaign_report
from tuning.studies import campaign_folder, campaign_summary


class Rows:
    """A fake campaign folder of 401 trials with a random initial attitude.

    The test replaces the reading of its rows.
    """

    custom_metric_names = ()
    scenario = scenarios.from_tables({"dispersion": {"attitude": {"kind": "uniform"}}})
    ready = scenarios.study(scenario)
    trials = 401
    path = "rows"
    units = campaign_folder.Folder.units

    def intact_parts(self):
        """Return a list with the only file of rows, which is this object."""
        return [self]


def test_inputs_of_the_worst_trial_have_percentile_median_and_sensitivity(monkeypatch):
    """Inputs without an effect are not named, and an input that duplicates another input counts once.

    Categories have the fraction of trials with the same category instead of a percentile. Failed trials can be
    explained, but do not count in the sensitivities.
    """
    angle = np.linspace(0.0, 2.0, 401)
    rate = np.random.default_rng(0).permutation(401) / 400.0
    table = pl.DataFrame({
        "trial": np.arange(401), "status": ["ok"] * 401, "peak_torque": angle**2, "initial_angle": angle,
        "initial_q4": np.cos(angle / 2), "initial_w1": rate, "always": np.ones(401),
    })  # fmt: skip
    monkeypatch.setattr(campaign_summary.rows, "column_names", lambda part: list(table.schema))
    monkeypatch.setattr(campaign_summary.rows, "read", lambda parts, names: table.select(names))
    # without the type check, which would refuse `Rows`
    why: Any = inspect.unwrap(campaign_summary.explain_worst_trials)
    told = why(Rows(), ["peak_torque"], 1)
    assert [one["input"] for one in told] == ["initial_angle", "initial_w1"]  # q4 duplicates the angle
    assert told[0] == {"metric": "peak_torque", "trial": 400, "value": 4.0, "input": "initial_angle", "drawn": 2.0,
                       "unit": "rad", "percentile": 100.0, "median": 1.0, "fraction": None,
                       "rank_correlation": pytest.approx(1.0, rel=1e-12),
                       "first_order": pytest.approx(1.0, abs=0.05), "trials": 401}  # fmt: skip
    assert told[1]["percentile"] == 100.0 * np.mean(rate <= rate[400])
    (said,) = campaign_report.explanation_lines(told, Rows().units)
    # the rate has no effect on the torque
    assert said == "peak_torque 4 N m in trial 400: initial_angle 114.6 deg at 100.0 % (median 57.3 deg)"
    table = table.with_columns(peak_torque=np.random.default_rng(5).permutation(401) / 50.0)
    (said,) = campaign_report.explanation_lines(why(Rows(), ["peak_torque"], 1), Rows().units)
    assert said.endswith("no sampled input explains it; sensor noise remains")
    # the number of a failed wheel is a category without an order; here wheel 2 causes the largest torques
    wheel = np.arange(401) % 4 + 1.0
    table = table.with_columns(peak_torque=(wheel == 2.0) + 1e-3 * rate, wheel_failure_wheel=wheel)
    told = why(Rows(), ["peak_torque"], 1)
    (one,) = [row for row in told if row["input"] == "wheel_failure_wheel"]
    assert (one["percentile"], one["median"], one["fraction"]) == (None, None, pytest.approx(100 / 401))
    assert one["rank_correlation"] is None
    assert one["first_order"] > 0.5
    assert "wheel_failure_wheel 2 as in 24.9 % of the trials" in "".join(
        campaign_report.explanation_lines(told, Rows().units)
    )
    drivers = {"peak_torque": statistics.drivers({"wheel_failure_wheel": wheel, "initial_w1": rate},
                                                 table["peak_torque"].to_numpy(), categories=CATEGORIES)}  # fmt: skip
    found = examples.campaign(verdicts=[examples.torque(0.9)], drivers=drivers, driver_trials={"peak_torque": 401})
    (said,) = campaign_report.driver_lines(found)
    assert "wheel_failure_wheel (56 % of the variance of the ranks)" in said
    table = table.with_columns(status=pl.Series(["diverged"] + ["ok"] * 400))
    told = why(Rows(), ["peak_torque"], 1)
    # unusual inputs of a failed trial
    assert "wheel_failure_wheel 1 as in 25.2 % of the trials" in "".join(
        campaign_report.explanation_lines(told, Rows().units)
    )
    # metrics of a failed run are those until its failure; sensitivities must not use them
    cut = np.where(np.arange(401) % 3 == 0, 1e3 * (1.0 - rate), table["peak_torque"].to_numpy())
    table = table.with_columns(
        peak_torque=cut, status=pl.Series(["diverged", "ok", "not_converged"] * 133 + ["diverged", "ok"])
    )
    ended = table.filter(pl.col("status") != "diverged")
    driven = statistics.drivers({"initial_w1": ended["initial_w1"].to_numpy()}, ended["peak_torque"].to_numpy())
    (one,) = [row for row in why(Rows(), ["peak_torque"], 1) if row["input"] == "initial_w1"]
    assert one["rank_correlation"] == pytest.approx(driven["initial_w1"]["rank_correlation"], rel=1e-12)
    assert one["trials"] == ended.height
    table = table.with_columns(peak_torque=pl.Series([*cut[:-1], None]))  # a metric that one trial does not have
    assert {row["value"] for row in why(Rows(), ["peak_torque"], 401) if row["trial"] == 400} == {None}
    assert statistics.distinct_inputs({"a": angle, "b": -angle, "c": rate}) == ["a", "c"]


def test_every_random_input_may_explain_the_worst_trials(monkeypatch):
    """Columns are in alphabetical order. Earlier, columns before the initial angle (the inertia) were left out."""
    drawn = {"attitude": {"kind": "uniform"}, "inertia": {"kind": "relative_normal", "std": 0.1},
             "disturbance_phase": {"kind": "uniform"}}  # fmt: skip
    ready = scenarios.study(scenarios.from_tables({"dispersion": drawn}))
    columns = campaign.Campaign(ready, 0).draw(range(2)).drop("trial").columns
    assert {"inertia_11", "initial_angle"} <= set(columns)
    assert any(name.startswith("disturbance") for name in columns)
    kept = [
        "trial",
        *run_tables.STATUS_COLUMNS,
        *run_tables.RESULT_COLUMNS.values(),
        *ready.catalogue,
        *run_tables.SAMPLES,
        *columns,
        "mine",
    ]
    monkeypatch.setattr(campaign_summary.rows, "column_names", lambda part: kept)
    folder: Any = SimpleNamespace(custom_metric_names=["mine"])
    assert inspect.unwrap(campaign_summary.input_columns)(folder, [None]) == columns


def test_dispersion_of_zero_width_does_not_explain_a_metric():
    """Angles with a dispersion from 100 to 100 deg differ by rounding errors of the quaternion only."""
    random = np.random.default_rng(3)
    angle = np.deg2rad(100.0) + 2.2e-16 * random.integers(-2, 3, 401)
    rate = random.normal(size=401)
    driven = statistics.drivers({"initial_angle": angle, "initial_w1": rate}, rate**3)
    assert list(driven) == ["initial_w1"]
    assert statistics.drivers({"initial_w1": rate}, angle) == {}
    assert not statistics.has_variation(angle)
    assert statistics.has_variation(1e-9 * rate)
