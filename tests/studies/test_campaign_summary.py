"""Requirements on fractions of time, lower bound and margins in the summary and the figures of a campaign."""

import json
from types import SimpleNamespace
from typing import Any

import numpy as np
import polars as pl
import pytest

from ptsmc_jax import scenario
from ptsmc_jax.campaigns import margin_verdicts, runs
from ptsmc_jax.figures.campaign_plots import AT_TIMES, BEYOND, KEPT
from ptsmc_jax.simulation import catalogues
from ptsmc_jax.simulation.requirements import Requirement
from tuning.studies import campaign_figures, campaign_summary, campaign_theory

# one run keeps the limit, two violate it for 10 % and 50 % of the time, and one diverges
FRAME = pl.DataFrame({
    "status": ["ok", "ok", "ok", "diverged"], "ape_z": [0.5, 2.0, 2.0, None], "within_ape_z": [1.0, 0.9, 0.5, None],
    "peak_torque": [3.0, 1.0, 1.0, None],
})  # fmt: skip


@pytest.mark.parametrize(("interpretation", "outcomes", "said"), [
    ("ensemble", [KEPT, BEYOND, BEYOND, "diverged"], ""),
    ("mixed", [KEPT, AT_TIMES, AT_TIMES, "diverged"], "required: 80 % of the time of all runs; seen: 60 %"),
    ("temporal", [KEPT, AT_TIMES, BEYOND, "diverged"],
     "required: 80 % of the time, in every run; seen: at least 0 %"),
])  # fmt: skip
def test_figures_mark_trials_beyond_a_limit_that_allows_this_for_some_time(interpretation, outcomes, said):
    """A broken limit on trials has priority."""
    asked = Requirement("ape_z", 1.0, "rad", quantile=0.8, interpretation=interpretation)
    assert campaign_figures._classify_trials(FRAME, [asked])[0].tolist() == outcomes
    torque = Requirement("peak_torque", 2.0, "N m")
    for both in ([asked, torque], [torque, asked]):  # a broken limit on trials has priority in either order
        outcome, missed = campaign_figures._classify_trials(FRAME, both)
        assert outcome.tolist() == [BEYOND, *outcomes[1:]]
        assert "peak_torque" in missed[BEYOND]
        assert ("ape_z" in missed[BEYOND]) == (BEYOND in outcomes)
        assert missed.get(AT_TIMES, []) == ["ape_z"] * (AT_TIMES in outcomes)
    values, within = FRAME["ape_z"].to_numpy(), FRAME["within_ape_z"].to_numpy()
    verdict = asked.verdict(values, np.array([True, True, True, False]), within)
    assert campaign_figures._describe_time_fraction(verdict) == said


def test_mixed_requirement_averages_time_fractions_and_counts_a_missing_one_as_zero():
    frame = pl.concat([FRAME, FRAME.head(1).with_columns(within_ape_z=pl.lit(None, pl.Float64))])
    ended = np.array([True, True, True, False, True])
    asked = Requirement("ape_z", 1.0, "rad", quantile=0.8, interpretation="mixed")
    beyond = campaign_summary._fraction_of_time_beyond(frame, asked, ended)
    np.testing.assert_allclose(beyond, [0.0, 0.1, 0.5, 1.0, 1.0], rtol=1e-12)
    verdict = asked.verdict(frame["ape_z"].to_numpy(), ended, frame["within_ape_z"].fill_null(np.nan).to_numpy())
    told = campaign_summary._verdict_entry(verdict, asked, beyond)
    assert told["fraction"] == pytest.approx(told["fraction_of_time"], rel=1e-12)
    assert told["fraction"] == pytest.approx((1.0 + 0.9 + 0.5) / 5.0, rel=1e-12)
    low, high = told["fraction_interval"]
    assert low < told["fraction_bound"] < told["fraction"] < high  # two-sided 95 % interval, one-sided 95 % bound
    of_trials = Requirement("ape_z", 1.0, "rad", quantile=0.8)
    assert campaign_summary._fraction_of_time_beyond(frame, of_trials, ended).size == 0


def test_failed_trial_counts_as_zero_in_quantiles_of_a_time_fraction():
    """The quantiles mirror those of a metric whose smaller values are better."""
    told = campaign_summary._metric_statistics(
        np.array([0.9, np.nan, 0.5, 0.8]), np.array([True, False, True, True]), True
    )
    assert (told["min"], told["max"], told["without_value"]) == (0.0, 0.9, 1)
    assert (told["0.0027"]["value"], told["0.1"]["value"], told["0.5"]["value"]) == (0.0, 0.0, 0.8)
    fractions, ended = np.linspace(0.0, 1.0, 200), np.arange(200) % 50 > 0
    told, mirrored = (
        campaign_summary._metric_statistics(fractions, ended, True),
        campaign_summary._metric_statistics(1.0 - fractions, ended, False),
    )
    assert told["0.1"]["value"] == pytest.approx(1.0 - mirrored["0.9"]["value"])
    assert told["0.1"]["low"] == pytest.approx(1.0 - mirrored["0.9"]["high"])
    assert told["0.1"]["high"] == pytest.approx(1.0 - mirrored["0.9"]["low"])
    assert told["0.1"]["low"] < told["0.1"]["value"] < told["0.1"]["high"]
    none = campaign_summary._metric_statistics(np.array([np.nan]), np.array([False]), True)
    assert none["0.5"]["value"] == 0.0


def test_worst_trials_by_the_number_of_successful_samples_have_the_fewest():
    counts, none = np.array([65, 31, 40]), np.zeros(3, bool)
    assert campaign_summary.most_extreme("controller_ok", counts, none, 2).tolist() == [1, 2]
    assert campaign_summary.most_extreme("controller_other", counts, none, 2).tolist() == [0, 2]


@pytest.mark.parametrize(("count", "rows", "looked"), [(None, [], None), (3, [0, 1, 2], 3), (900, [0, 1, 2, 3], 256)])
def test_bound_and_margins_of_a_campaign_use_its_first_trials_once(tmp_path, monkeypatch, count, rows, looked):
    """A run table has the lower bound of at most its first 4 rows, and the margins of at most its first 256 rows."""
    asked: list[Any] = []

    def lower_bound(ready, seed, first):
        asked.append((ready, seed, first))
        return 1e-6

    def of_trials(ready, seed, some, finished):
        assert finished.tolist() == [True, False]
        asked.append((ready, seed, None if some is None else len(some)))
        return []

    monkeypatch.setattr(runs, "rms_lower_bound", lower_bound)
    monkeypatch.setattr(margin_verdicts, "judge_trials", of_trials)
    monkeypatch.setattr(campaign_theory, "_judged_trials_finished", lambda _: np.array([True, False]))
    table = SimpleNamespace(count=count, row=lambda k, seed: (k, seed), rows=lambda numbers, seed: np.asarray(numbers))
    ready = SimpleNamespace(margins=("gain_margin",))
    simulated = SimpleNamespace(ready=ready, run_table=None if count is None else table)
    folder: Any = SimpleNamespace(path=tmp_path, seed=7, campaign=simulated, scenario=SimpleNamespace(requirements={}))
    campaign_theory.write_missing(folder)
    assert asked == [(ready, 7, looked), (ready, 7, [(k, 7) for k in rows])]
    assert json.loads((tmp_path / "theory.json").read_text()) == {"lower_bound": 1e-6, "margins": []}
    campaign_theory.write_missing(folder)
    assert len(asked) == 2
    assert campaign_theory.read(folder)["lower_bound"] == 1e-6


def folder_of_figures(monkeypatch, required):
    """Return a fake campaign folder of 20 trials, whose rows all have the same numbers in all metrics.

    required: the metric that has a requirement.
    """
    error = np.linspace(1e-6, 1e-5, 20)
    frame = pl.DataFrame({
        "trial": np.arange(20), "status": ["ok"] * 20, "initial_angle": error, "window_error": error,
        "window_angle": 2.0 * np.arcsin(error), "peak_torque": error, "peak_torque_delivered": error, "effort": error,
    })  # fmt: skip
    monkeypatch.setattr(campaign_figures.rows, "read", lambda parts, names: frame.select(names))
    folder: Any = SimpleNamespace(
        scenario=scenario.from_tables({"requirements": {required: 5e-5}}), units=catalogues.units("spacecraft"),
        intact_parts=list, trials=20, can_simulate=False,
    )  # fmt: skip
    return folder


def test_figures_show_the_required_torque_and_the_inputs_that_drive_a_metric(monkeypatch):
    """An earlier version showed peak_torque always, and only the inputs that drive the window error most."""
    folder = folder_of_figures(monkeypatch, "peak_torque_delivered")
    weak, strong = ({"rank_correlation": 0.0, "first_order": index} for index in (0.01, 0.6))
    drivers = {"window_error": {"effort": weak}, "peak_torque_delivered": {"effort": weak, "initial_angle": strong}}
    drivers["peak_torque"] = {"effort": strong}  # not required, so that the report does not name its inputs either
    verdict = Requirement("peak_torque_delivered", 5e-5).verdict(np.zeros(20), np.full(20, True)).in_summary()
    summary = {"verdicts": [verdict], "drivers": drivers, "driver_trials": dict.fromkeys(drivers, 1000)}
    figures = campaign_figures.build(folder, summary)
    (axes,) = figures["torque_by_angle"].axes
    assert axes.get_ylabel() == "peak torque delivered [N m]"
    assert "limit 5e-05 N m" in axes.get_legend_handles_labels()[1]
    assert [axes.get_xlabel() for axes in figures["inputs"].axes if axes.get_xlabel()] == ["initial_angle [arcsec]"]


def test_figures_name_the_required_metric_of_the_marked_trials(monkeypatch):
    """The figure of the torque marks trials beyond the limit of another metric; an earlier version did not name it."""
    folder = folder_of_figures(monkeypatch, "window_angle")
    folder.scenario = scenario.replace(folder.scenario, requirements={"window_angle": 1e-5})
    (axes,) = campaign_figures.build(folder, {"verdicts": [], "drivers": {}})["torque_by_angle"].axes
    assert "beyond a limit (window_angle): 11" in axes.get_legend_handles_labels()[1]


@pytest.mark.parametrize(("first", "broken", "trials"), [
    (20, 0, "20 trials"), (5, 0, "the first 5 of 20 trials"), (5, 2, "the first 5 of 20 trials, 2 failed"),
])  # fmt: skip
def test_figure_of_the_error_over_time_states_how_many_trials_it_shows(monkeypatch, first, broken, trials):
    """An earlier version showed 1000 of 2000 trials as all trials of the campaign."""
    finished, ready = np.arange(20) >= broken, scenario.study(scenario.from_tables({}))
    frame = pl.DataFrame({"trial": np.arange(20), "window_error": np.linspace(1e-6, 1e-5, 20)})
    monkeypatch.setattr(campaign_figures, "FAN_TRIALS", first)
    history = np.arange(1.0, 4.0), np.full((first + 1, 3), 1e-6)
    monkeypatch.setattr(campaign_figures.running, "error_history", lambda campaign, simulated: history)
    folder: Any = SimpleNamespace(campaign_without_metrics=SimpleNamespace(ready=ready))
    (axes,) = campaign_figures._plot_fan(folder, frame, finished, {})["fan"].axes
    assert axes.get_title(loc="left") == f"Pointing error of {trials}, median in white"


@pytest.mark.parametrize(("required", "shown"), [
    ("window_angle", ["window_angle [arcsec]", "peak_torque [N m]"]),
    ("effort", ["effort [N m s]", "window_error [arcsec]", "peak_torque [N m]"]),
])  # fmt: skip
def test_the_figure_of_distributions_shows_an_error_once_and_as_an_angle(monkeypatch, required, shown):
    folder = folder_of_figures(monkeypatch, required)
    figures = campaign_figures.build(folder, {"verdicts": [], "drivers": {}})
    assert "inputs" not in figures
    panels = figures["distributions"].axes
    assert [axes.get_xlabel() for axes in panels] == shown
    points = np.asarray(panels[shown.index(next(name for name in shown if "arcsec" in name))].lines[0].get_xdata())
    np.testing.assert_allclose(points[[0, -1]], 2.0 * np.degrees([1e-6, 1e-5]) * 3600.0, rtol=1e-6)
