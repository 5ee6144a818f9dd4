"""The quantities that the window error is traded against: margins and prescribed times."""

import csv
import json
import re
import tomllib

import numpy as np
import pytest

from ptsmc_jax import scenario
from ptsmc_jax.campaigns.montecarlo import Trials
from ptsmc_jax.scenario.errors import ScenarioError
from ptsmc_jax.simulation import catalogues, rollout
from ptsmc_jax.simulation.metrics import METRICS, Metrics
from tests.helpers import SHORT_CHAIN, refused, refuses, small_search
from tests.output.pages import checked
from tuning.search import gains
from tuning.studies import judging, pareto, posing, stability, trades

MARGINS = ("gain_margin", "phase_margin", "delay_margin", "peak_sensitivity")


def test_larger_margins_reduce_the_accuracy(command, tmp_path, monkeypatch):
    """Every row agrees with simulation and linearisation of its gains. Tighter limits increase the error."""
    small_search(monkeypatch, 60)
    (tmp_path / "c.toml").write_text(
        re.sub(r"\[dispersion\]\n.*\n", "", SHORT_CHAIN)  # one loop
        .replace("peak_torque = 3.0", "peak_torque = 3.0\nphase_margin = 45.0")
        .replace('free = ["eta", "delta"]', 'free = ["k1", "sign_width"]')
        .replace("eta = [2.6, 3.05], delta = [0.1, 2.0]", "k1 = [0.5, 12.0], sign_width = [1e-3, 0.1]")
        .replace("starts = 2\nsteps = 4", "starts = 1\nsteps = 8")
    )
    status, out, _ = command("pareto", "c.toml", "--against", "margins", "--limits", "4,60,6", "--out", "cost")
    told = json.loads((tmp_path / "cost" / "summary.json").read_text())
    with (tmp_path / "cost" / "robustness.csv").open() as file:
        rows = [{key: float(value) for key, value in row.items()} for row in csv.DictReader(file)]
    assert [row["limit"] for row in rows] == [np.inf, 6.0, 4.0]
    assert [one["value"] for one in told["points"]] == [None, 6.0, 4.0]
    assert told["idle"] == [60.0]
    assert rows[0]["rms_window_error"] < rows[1]["rms_window_error"] < rows[2]["rms_window_error"]
    assert rows[0]["peak_sensitivity"] > 6.0
    known = scenario.read(tmp_path / "c.toml")
    for row in rows:
        simulated = scenario.replace(known, controller__k1=row["k1"], controller__sign_width=row["sign_width"])
        trials = judging.judge(simulated, told["seed"])
        errors = trials.metrics.window_error[:60]
        np.testing.assert_allclose(row["rms_window_error"], np.sqrt(np.mean(errors**2)), rtol=1e-9)
        np.testing.assert_allclose(row["peak_torque"], np.max(trials.metrics.peak_torque[:60]), rtol=1e-9)
        by_place = stability.worst_margins(scenario.study(judging.on_flight_clock(simulated))) or {}
        for name in MARGINS:
            worst = max if name == "peak_sensitivity" else min
            limited = [place[name] for place in by_place.values() if place[name] is not None]
            np.testing.assert_allclose(row[name], worst(limited), rtol=1e-9, err_msg=name)
        # the limit replaces the required phase margin in the search, not in the verdict
        assert row["peak_sensitivity"] <= row["limit"]
        assert row["meets"] == (row["phase_margin"] >= 45.0 and row["peak_torque"] <= 3.0 and row["failures"] == 0)
        sensitivity = 10.0 ** (row["peak_sensitivity"] / 20.0)
        assert row["phase_margin"] >= np.rad2deg(2.0 * np.arcsin(0.5 / sensitivity)) * (1 - 1e-6)
        assert 10.0 ** (row["gain_margin"] / 20.0) >= (1.0 + 1.0 / sensitivity) * (1 - 1e-6)
    assert status == (0 if any(row["meets"] for row in rows) else 1)
    loose, usual = (row["rms_window_error"] for row in rows[:2])
    assert f"RMS error {usual:.3g} x1 with |S| at most 6 dB, {usual / loose:.3g} times the error" in out
    assert "no separate point for limit on |S|: 60 dB" in out
    page = checked(tmp_path / "cost")
    assert "Cost of stability margins" in page.text
    assert "--against margins --limits 4,60,6" in page.text
    assert (tmp_path / "cost" / "figures" / "robustness.png").exists()
    again = command("pareto", "c.toml", "--against", "margins", "--limits", "6,4,60", "--out", "cost")
    assert again == (status, out.rstrip() + " (from an earlier run)\n", "")


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--against", "speed"), 'Invalid value "speed" for --against. Choose from: "torque", "margins", "t_f".'),
        (("--limits", "4,6"), "--limits is 4,6, but must be absent without --against margins"),
        (("--times", "4,8"), "--times is 4,8, but must be absent without --against t_f"),
        (("--against", "margins", "--times", "4,8"), "--times is 4,8, but must be absent without --against t_f"),
        *(
            (("--against", other, "--points", "4"), "--points is 4, but must be absent without --against torque")
            for other in ("margins", "t_f")
        ),
        *((("--points", points), "--points") for points in ("2", "101", "many", "-3")),
        *(
            (("--against", "margins", "--limits", limits), f"--limits is {limits}, but must be limits in dB")
            for limits in ("4,x", "4,4", "0,3", "-6", "3,inf", "nan", "")
        ),
        *(
            (("--against", "t_f", "--times", times), f"--times is {times}, but must be two times or more in s")
            for times in ("4", "4,x", "4,4", "60,1min", "4m,8m", "0,3", "3,inf", "")
        ),
        (
            ("--against", "t_f", "--times", "0.2,5"),
            "controller.delta is 0.5, but must be less than controller.t_f, 0.2",
        ),
    ],
)
def test_invalid_options_of_pareto_are_refused(command, tmp_path, options, said):
    assert said in refused(command, tmp_path, "pareto", "s.toml", *options)


def slew_time(known):
    """Return the trade of accuracy against a t_f of 20 and of 30 s; known: the scenario."""
    return trades.SlewTime(known, (20.0, 30.0))


FASTEST = {"tune": {"minimise": "t_f", "free": ["t_f"]}, "requirements": {"window_error": 1e-3}}
WORST_CASE = {"tune": {"worst_case": True}}


@pytest.mark.parametrize(
    ("trade", "changes", "said"),
    [
        (trades.Torque, FASTEST, 'tune.minimise is "t_f", but must be "window_error" for a front of the window error'),
        (trades.Torque, {"tune": {"minimise": "effort"}}, 'tune.minimise is "effort"'),
        (trades.Torque, {"tune": {"torque_weight": 0.5}}, "tune.torque_weight is 0.5"),
        (trades.Torque, WORST_CASE, "tune.worst_case is true, but must be false for a front of the window error"),
        (trades.Margins, {"loop": {"mode": "continuous"}}, 'loop.mode is "continuous", but must be "sampled"'),
        (trades.Margins, FASTEST, 'tune.minimise is "t_f"'),
        (trades.Margins, WORST_CASE, "tune.worst_case is true, but must be false for a front against margins"),
        (
            slew_time,
            {"controller": {"kind": "pd", "t_f": 5.0}, "tune": {}},
            'controller.kind is "pd", but must be prescribed_time',
        ),
        (slew_time, {"tune": {"free": ["eta", "t_f"]}}, "but must be without t_f for a front against t_f"),
        (slew_time, FASTEST, 'tune.minimise is "t_f"'),
        (slew_time, WORST_CASE, "tune.worst_case is true, but must be false"),
        (  # t_o would stay a third of the scenario's t_f at every time
            slew_time,
            {"observer": {"kind": "prescribed_time"}, "tune": {}},
            "observer.t_o is absent, but must be set for a front against t_f",
        ),
    ],
)
def test_scenarios_that_do_not_allow_a_front_are_refused(trade, changes, said):
    known = scenario.from_tables({"loop": {"mode": "sampled"}, "controller": {"t_f": 20.0}, **changes})
    with refuses(ScenarioError, said):
        trade(known).check()


def test_default_limits_of_a_front_against_margins_include_the_limit_of_the_scenario():
    tables = tomllib.loads(SHORT_CHAIN)
    usual = [np.inf, 12.0, 8.0, 6.0, 5.0, 4.0, 3.0]
    assert trades.Margins(scenario.from_tables(tables)).values == usual
    asked = scenario.from_tables({**tables, "requirements": {"peak_sensitivity": 5.5}})
    assert trades.Margins(asked).values == sorted([*usual, 5.5], reverse=True)


def test_sensitivity_limit_of_a_front_replaces_required_gain_and_phase_margins():
    asked = {
        "peak_torque": 3.0,
        "gain_margin": 8.0,
        "phase_margin": 45.0,
        "delay_margin": 0.02,
        "peak_sensitivity": 5.0,
    }
    known = scenario.from_tables({**tomllib.loads(SHORT_CHAIN), "requirements": asked})
    limited = trades.Margins(known, (6.0, 4.0)).base
    assert limited.requirements == {"peak_torque": 3.0, "delay_margin": 0.02, "peak_sensitivity": 4.0}


def test_margins_of_a_front_are_those_of_the_loops_if_a_trial_fails():
    tables = {name: table for name, table in tomllib.loads(SHORT_CHAIN).items() if name != "dispersion"}
    made, status = scenario.from_tables(tables), np.array([0, rollout.DIVERGED])
    trials = Trials(np.arange(2), Metrics(dict.fromkeys(METRICS, np.ones(2))), status, np.zeros(2), {})
    costs = trades.Margins(made).costs(made, trials, [], 0)
    assert min(costs[name] for name in MARGINS) > 0.0


def test_pareto_against_t_f_finds_gains_for_each_time_and_faster_slews_need_more_torque(command, tmp_path, monkeypatch):
    """The gains of each time are more accurate at this time than the gains of the other time.

    The peak torque of a slew is proportional to 1 / t_f^2, and the peak rate to 1 / t_f. Files and report agree with
    the search, and times that were searched before are read from the earlier run.
    """
    small_search(monkeypatch, 60)
    # times up to the scenario's t_f, so that the compiled programs of other searches can be used
    (tmp_path / "c.toml").write_text(SHORT_CHAIN.replace("[2e-5, 1e-5]", "[2e-3, 1e-3]"))
    status, out, err = command("pareto", "c.toml", "--against", "t_f", "--times", "2.5,5", "--out", "cost")
    assert status == 0, err
    assert "2 points, each judged on 60 held-out trials" in out
    with (tmp_path / "cost" / "slew_times.csv").open() as file:
        rows = list(csv.DictReader(file))
    fast, slow = ({key: float(value) for key, value in row.items()} for row in rows)
    assert (fast["t_f"], slow["t_f"]) == (2.5, 5.0)
    assert fast["peak_rate"] / slow["peak_rate"] == pytest.approx(2.0, rel=0.3)
    assert 2.5 < fast["peak_torque"] / slow["peak_torque"] < 6.5
    # at each time, its own gains are more accurate than the gains of the other time, on the same trials
    for found_here, other in ((fast, slow), (slow, fast)):
        untuned = scenario.replace(scenario.read(tmp_path / "c.toml"), tune=None)
        errors = []
        for found in (found_here, other):  # the fixed gains are those of t_f = 5 s
            known = gains.in_scenario(untuned, {"t_f": found_here["t_f"], "eta": found["eta"], "delta": found["delta"]})
            trials = judging.judge(known, judging.derive_held_out_seed(0))
            errors.append(np.sqrt(np.mean(trials.metrics.window_error[:60] ** 2)))
        np.testing.assert_allclose(found_here["rms_window_error"], errors[0], rtol=1e-9)
        assert errors[0] < errors[1]
    told = json.loads((tmp_path / "cost" / "summary.json").read_text())
    assert [slew["value"] for slew in told["points"]] == [2.5, 5.0]
    assert told["points"][0]["rms"] == fast["rms_window_error"]
    assert "times the value at 5 s" in out
    page = checked(tmp_path / "cost")
    assert "Cost of a faster slew" in page.text
    met = sum(slew["meets"] for slew in told["points"])
    assert f"{met} of 2 points meet every requirement" in page.text
    assert "--against t_f --times 2.5,5" in page.text
    assert (tmp_path / "cost" / "figures" / "slew_times.png").exists()
    again = command("pareto", "c.toml", "--against", "t_f", "--times", "5,2500ms", "--out", "cost")
    assert "from an earlier run" in again[1]


def test_front_against_t_f_keeps_the_required_margins_of_the_loop_with_each_t_f(monkeypatch):
    """All gains break the required margin at t_f = 5 s. At 3 s some gains keep it, but not the most accurate ones."""
    small_search(monkeypatch, 40)
    tables = tomllib.loads(re.sub(r"\[dispersion\]\n.*\n", "", SHORT_CHAIN))  # one loop
    known = scenario.from_tables({**tables, "requirements": {"peak_torque": 20.0, "phase_margin": 52.0}})
    trade = trades.SlewTime(known, (3.0, 5.0))
    traced = pareto.trace(trade, 0)
    assert traced.without == [5.0]
    (point,) = traced.points
    assert point.meets

    def phase_margin(t_f, found):
        tuned = judging.on_flight_clock(trade.tuned_scenario(t_f, found))
        by_place = stability.worst_margins(scenario.study(tuned)) or {}
        return min(place["phase_margin"] for place in by_place.values())

    np.testing.assert_allclose(point.costs["phase_margin"], phase_margin(3.0, point.gains), rtol=1e-6)
    assert point.costs["phase_margin"] >= 52.0 > phase_margin(5.0, point.gains)
    most_accurate = {"eta": 3.05, "delta": 0.1}
    assert phase_margin(3.0, most_accurate) < 52.0
    figure = pareto.figure_of(trade, traced)
    assert "phase margin [deg]" in [axes.get_title() for axes in figure.axes]
    assert "limit of the scenario" in [text.get_text() for text in figure.legends[0].get_texts()]


def test_every_prescribed_time_has_its_own_search(monkeypatch):
    """Other times may have other local minima. All times use the difficult trials of the first two times."""
    small_search(monkeypatch, 8)
    searched, simulated, joined, search = [], [], [], posing.TuningSetup.search

    def note(posed, problem, scenario_gains, starts, *asked, **told):
        searched.append((float(problem.parts.controller.t_f), starts > 1))
        simulated.append(np.asarray(problem.trials).tolist())
        outcome = search(posed, problem, scenario_gains, starts, *asked, **told)
        joined.append(np.asarray(outcome.problem.trials).tolist())
        return outcome

    monkeypatch.setattr(posing.TuningSetup, "search", note)
    usual = SHORT_CHAIN.replace(", delta = [0.1, 2.0]", "")  # default bounds, up to 2.55 s for t_f = 5 s
    pareto.trace(trades.SlewTime(scenario.from_tables(tomllib.loads(usual)), (3.9, 4.5, 5.0)), 0)
    assert searched == [(5.0, True), (3.9, True), (4.5, True)]
    assert set(joined[0]) > set(simulated[0])
    assert simulated[1:] == joined[:2]


def test_a_front_against_t_f_accepts_an_observer_with_a_given_t_o():
    known = {"observer": {"kind": "prescribed_time", "t_o": 4.0}, "tune": {}, "loop": {"mode": "sampled"}}
    trades.SlewTime(scenario.from_tables({"controller": {"t_f": 20.0}, **known}), (20.0, 30.0)).check()


def test_default_times_of_a_front_against_t_f_are_half_to_twice_the_t_f_of_the_scenario():
    assert trades.SlewTime(scenario.from_tables({})).values == [15.0, 21.0, 30.0, 42.0, 60.0]


def test_identity_of_a_study_has_all_digits_of_its_times():
    """Earlier, with six digits, results of other times were taken for the requested ones."""
    known = scenario.from_tables({})
    listed = [
        trades.SlewTime(known, times).identity(0)["times"] for times in ((100.0001, 20), (20.0, 100.0002), (20, 30))
    ]
    assert listed == ["20,100.0001", "20,100.0002", "20,30"]


def test_costs_in_a_front_against_t_f_are_metrics_that_the_scenario_has_or_requires():
    trials = Trials(np.arange(1), Metrics(dict.fromkeys(METRICS, np.ones(1))), np.zeros(1, int), np.zeros(1), {})

    def costs(**tables):
        made = scenario.from_tables(tables)
        verdicts = judging.verdicts_of(made, trials, 0)
        return list(trades.SlewTime(made).costs(made, trials, verdicts, 0))

    assert costs() == ["peak_torque", "peak_momentum", "peak_rate", "effort"]
    assert set(trades.SLEW_COSTS) == set(costs(loop={"mode": "sampled"}, wheels={}))
    assert costs(plant={"kind": "chain"}) == ["peak_torque", "peak_rate", "effort"]
    assert set(trades.SLEW_COSTS) <= set(catalogues.CATALOGUES["spacecraft"])
    required = {"peak_rate": 1.0, "window_error": 1.0, "hold_angle": 1.0}  # the error has a column of its own
    assert costs(requirements=required) == ["peak_torque", "peak_momentum", "peak_rate", "effort", "hold_angle"]


def test_default_bounds_of_delta_follow_the_shortest_t_f_of_a_front():
    """The default bounds of t_f = 8 s reach to 2 s, which a prescribed time of 1.9 s does not allow."""
    tables = {
        "plant": {"kind": "chain", "x0": [1.0, 0.0]},
        "controller": {"t_f": 8.0, "delta": 0.5},
        "loop": {"mode": "sampled", "period": 0.05},
    }
    known = scenario.from_tables({**tables, "tune": {}})
    assert known.search.bounds["delta"] == (0.05, 2.0)
    trades.SlewTime(known, (1.9, 8.0)).check()
    given = scenario.from_tables({**tables, "tune": {"bounds": {"delta": [0.05, 1.95]}}})
    with pytest.raises(ScenarioError, match=r"tune\.bounds\.delta is \[0\.05, 1\.95\]"):
        trades.SlewTime(given, (1.9, 8.0)).check()
    # so do the default bounds that include a longer delta of the scenario
    reaching = scenario.from_tables({**tables, "controller": {"t_f": 8.0, "delta": 6.0}, "tune": {}})
    assert reaching.search.bounds["delta"] == (0.05, 7.0)
    trades.SlewTime(reaching, (6.5, 8.0)).check()
