"""What a faster slew costs: gains for each prescribed time, their costs, figure, page and refusals."""

import csv
import json
import tomllib

import numpy as np
import pytest

from ptsmc_jax import scenario
from ptsmc_jax.scenario.errors import ScenarioError
from ptsmc_jax.simulation import catalogues
from tests.helpers import SHORT_CHAIN, small_search
from tests.output.pages import checked
from tuning.output import front_sentences
from tuning.search import gains
from tuning.studies import judging, posing, slew_times


def test_a_faster_slew_costs_torque_and_accuracy(command, tmp_path, monkeypatch):
    """Two times, few steps: the peak torque of a slew goes with 1 / t_f^2, the rate with 1 / t_f."""
    small_search(monkeypatch, 60)
    # no longer than the scenario's own time: on the clock of other searches, whose programs fly this one too
    (tmp_path / "c.toml").write_text(SHORT_CHAIN.replace("[2e-5, 1e-5]", "[2e-3, 1e-3]"))
    status, out, err = command("pareto", "c.toml", "--against", "t_f", "--times", "2.5,5", "--out", "cost")
    assert status == 0, err
    assert "gains tuned for 2 prescribed times, each judged on 60 fresh trials" in out
    with (tmp_path / "cost" / "slew_times.csv").open() as file:
        rows = list(csv.DictReader(file))
    fast, slow = ({key: float(value) for key, value in row.items()} for row in rows)
    assert (fast["t_f"], slow["t_f"]) == (2.5, 5.0)
    assert fast["peak_rate"] / slow["peak_rate"] == pytest.approx(2.0, rel=0.3)
    assert 2.5 < fast["peak_torque"] / slow["peak_torque"] < 6.5
    # each time's gains are at least as good at it as the other time's, on the very trials
    for own, other in ((fast, slow), (slow, fast)):
        untuned = scenario.replace(scenario.read(tmp_path / "c.toml"), tune=None)
        errors = []
        for found in (own, other):  # all other gains stay those of t_f = 5 s
            known = gains.in_scenario(untuned, {"t_f": own["t_f"], "eta": found["eta"], "delta": found["delta"]})
            trials = judging.judge(known, judging.seed_of_judge(0))
            errors.append(np.sqrt(np.mean(trials.metrics.window_error[:60] ** 2)))
        np.testing.assert_allclose(own["rms_window_error"], errors[0], rtol=1e-9)
        assert errors[0] < errors[1]
    told = json.loads((tmp_path / "cost" / "summary.json").read_text())
    assert [slew["t_f"] for slew in told["slews"]] == [2.5, 5.0]
    assert told["slews"][0]["rms"] == fast["rms_window_error"]
    assert "times that at 5 s" in out
    page = checked(tmp_path / "cost")
    assert "What a faster slew costs" in page.text
    met = sum(slew["meets"] for slew in told["slews"])
    assert f"At {met} of 2 prescribed times gains meet every requirement" in page.text
    assert "--against t_f --times 2.5,5" in page.text
    assert (tmp_path / "cost" / "figures" / "slew_times.png").exists()
    assert "already done" in command("pareto", "c.toml", "--against", "t_f", "--times", "5,2.5", "--out", "cost")[1]


def test_each_time_is_searched_for_itself(monkeypatch):
    """Not from the gains of others alone, which may lie in another valley; hard trials of the first two join all."""
    small_search(monkeypatch, 8)
    searched, flown, joined, search = [], [], [], posing.Posed.search

    def note(posed, problem, own, starts, *asked, **told):
        searched.append((float(problem.parts.controller.t_f), starts > 1))
        flown.append(np.asarray(problem.trials).tolist())
        outcome = search(posed, problem, own, starts, *asked, **told)
        joined.append(np.asarray(outcome.problem.trials).tolist())
        return outcome

    monkeypatch.setattr(posing.Posed, "search", note)
    usual = SHORT_CHAIN.replace(", delta = [0.1, 2.0]", "")  # to 2.55 s, where t_f is 5
    slew_times.trace(scenario.from_tables(tomllib.loads(usual)), 0, (3.9, 4.5, 5.0))
    assert searched == [(5.0, True), (3.9, True), (4.5, True)]
    assert set(joined[0]) > set(flown[0])
    assert flown[1:] == joined[:2]


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--against", "speed"), "--against is speed, but must be torque, margins or t_f"),
        (("--times", "4,8"), "--times is 4,8, but must be absent without --against t_f"),
        (("--against", "t_f", "--points", "4"), "--points is 4, but must be absent with --against t_f"),
        *(
            (("--against", "t_f", "--times", times), f"--times is {times}, but must be two times or more in s")
            for times in ("4", "4,x", "4,4", "0,3", "3,inf", "")
        ),
        (
            ("--against", "t_f", "--times", "0.2,5"),
            "controller.delta is 0.5, but must be less than controller.t_f, 0.2",
        ),
    ],
)
def test_what_cannot_be_asked_is_refused_in_one_sentence(command, tmp_path, options, said):
    status, out, err = command("pareto", "s.toml", *options)
    assert (status, out) == (2, "")
    assert said in err
    assert len(err.strip().splitlines()) == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        (
            {"controller": {"kind": "pd", "t_f": 5.0}, "tune": {}},
            'controller.kind is "pd", but must be prescribed_time',
        ),
        ({"tune": {"free": ["eta", "t_f"]}}, "but must be without t_f to ask what a faster slew costs"),
        (
            {"tune": {"minimise": "t_f", "free": ["t_f"]}, "requirements": {"window_error": 1e-3}},
            'tune.minimise is "t_f"',
        ),
        ({"tune": {"worst_case": True}}, "tune.worst_case is true, but must be false"),
        ({"requirements": {"gain_margin": 6.0}, "tune": {}}, "requirements.gain_margin is asked of one loop"),
        (  # every time was flown with a third of the scenario's own t_f, which another t_f would not have had
            {"observer": {"kind": "prescribed_time"}, "tune": {}},
            "observer.t_o is absent and would follow t_f; allowed is one that is given",
        ),
    ],
)
def test_what_has_no_answer_is_refused(changes, said):
    known = scenario.from_tables({"loop": {"mode": "sampled"}, "controller": {"t_f": 20.0}, **changes})
    with pytest.raises(ScenarioError, match=said.replace("(", r"\(")):
        slew_times.check(known, (20.0, 30.0))


def test_an_observer_with_a_time_of_its_own_is_asked():
    known = {"observer": {"kind": "prescribed_time", "t_o": 4.0}, "tune": {}, "loop": {"mode": "sampled"}}
    slew_times.check(scenario.from_tables({"controller": {"t_f": 20.0}, **known}), (20.0, 30.0))


def test_usual_times_go_from_half_to_twice_the_scenarios():
    assert slew_times.usual_times(scenario.from_tables({})) == (15.0, 21.0, 30.0, 42.0, 60.0)


def test_a_study_is_known_by_all_digits_of_its_times():
    """Of six digits, others' results were shown as already done."""
    known = scenario.from_tables({})
    listed = [slew_times.identity(known, 0, times)["times"] for times in ((100.0001, 20), (20.0, 100.0002), (20, 30))]
    assert listed == ["20,100.0001", "20,100.0002", "20,30"]


def test_costs_are_those_that_the_scenario_has():
    def costs(**tables):
        return slew_times._costs(scenario.from_tables(tables))

    assert costs() == ["peak_torque", "peak_momentum", "peak_rate", "effort"]
    assert set(slew_times.COSTS) == set(costs(loop={"mode": "sampled"}, wheels={}))
    assert costs(plant={"kind": "chain"}) == ["peak_torque", "peak_rate", "effort"]
    assert set(slew_times.COSTS) <= set(catalogues.CATALOGUES["spacecraft"])


def test_times_without_gains_are_told():
    slew = {"t_f": 8.0, "gains": {"eta": 3.0}, "rms": 1e-5, "interval": [0.9e-5, 1.1e-5], "costs": {"peak_torque": 0.2},
            "failures": 2, "meets": False}  # fmt: skip
    told = {"plant": "spacecraft", "slews": [slew], "without": [4.0], "requirements": ["peak_torque"], "trials": 1000}
    assert list(front_sentences.slew_times_lines(told)) == [
        "no gains keep the limits on the training trials at t_f = 4 s",
        "at none of these times do gains meet every requirement on the fresh trials",
    ]
    assert front_sentences.slew_times(told).rows == [
        ("8", "1.000e-05", "10.0 %", "0.2", "3", "2 failed or missed"),
    ]
    assert front_sentences.slew_times_heading(told) == "gains tuned for 1 prescribed time, judged on 1000 fresh trials"
    slow = {**slew, "t_f": 16.0, "rms": 4e-6, "costs": {"peak_torque": 0.05}, "meets": True}
    assert list(front_sentences.slew_times_lines({**told, "slews": [slew, slow], "without": []})) == [
        "peak torque: 0.2 N m at t_f = 8 s, 4 times that at 16 s",
        "RMS window error: 1e-05 at t_f = 8 s, 2.5 times that at 16 s",
    ]
    nothing = {**told, "slews": [], "requirements": []}
    assert front_sentences.slew_times(nothing).rows == []
    assert np.isfinite(len(list(front_sentences.slew_times_lines(nothing))))


def test_default_bounds_of_delta_follow_the_shortest_time():
    """The default bounds of t_f = 8 s reach to 2 s, which a prescribed time of 1.9 s does not allow."""
    tables = {
        "plant": {"kind": "chain", "x0": [1.0, 0.0]},
        "controller": {"t_f": 8.0, "delta": 0.5},
        "loop": {"mode": "sampled", "period": 0.05},
    }
    known = scenario.from_tables({**tables, "tune": {}})
    assert known.search.bounds["delta"] == (0.05, 2.0)
    slew_times.check(known, (1.9, 8.0))
    given = scenario.from_tables({**tables, "tune": {"bounds": {"delta": [0.05, 1.95]}}})
    with pytest.raises(ScenarioError, match=r"tune\.bounds\.delta is \[0\.05, 1\.95\]"):
        slew_times.check(given, (1.9, 8.0))
    # so do the default bounds that include a longer delta of the scenario
    reaching = scenario.from_tables({**tables, "controller": {"t_f": 8.0, "delta": 6.0}, "tune": {}})
    assert reaching.search.bounds["delta"] == (0.05, 7.0)
    slew_times.check(reaching, (6.5, 8.0))
