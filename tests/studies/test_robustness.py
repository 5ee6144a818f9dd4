"""What margins cost: gains for each limit on the largest sensitivity, what they leave, figure, page and refusals."""

import csv
import json
import re
import tomllib

import numpy as np
import pytest

from ptsmc_jax import scenario
from ptsmc_jax.scenario.errors import ScenarioError
from tests.helpers import SHORT_CHAIN, small_search
from tests.output.pages import checked
from tuning.output import front_sentences
from tuning.studies import judging, robustness, stability

MARGINS = ("gain_margin", "phase_margin", "delay_margin", "modulus_margin")


def test_more_margin_costs_accuracy(command, tmp_path, monkeypatch):
    """Every row is what flying and linearising its gains gives; the limits are kept, and each costs more than none."""
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
    assert [one["limit"] for one in told["robust"]] == [None, 6.0, 4.0]
    assert told["idle"] == [60.0]
    assert rows[0]["rms_window_error"] < rows[1]["rms_window_error"] < rows[2]["rms_window_error"]
    assert rows[0]["modulus_margin"] > 6.0
    known = scenario.read(tmp_path / "c.toml")
    for row in rows:
        flown = scenario.replace(known, controller__k1=row["k1"], controller__sign_width=row["sign_width"])
        trials = judging.judge(flown, told["seed"])
        errors = trials.metrics.window_error[:60]
        np.testing.assert_allclose(row["rms_window_error"], np.sqrt(np.mean(errors**2)), rtol=1e-9)
        np.testing.assert_allclose(row["peak_torque"], np.max(trials.metrics.peak_torque[:60]), rtol=1e-9)
        by_place = stability.worst(scenario.study(judging.as_flown(flown))) or {}
        for name in MARGINS:
            worst = max if name == "modulus_margin" else min
            limited = [place[name] for place in by_place.values() if place[name] is not None]
            np.testing.assert_allclose(row[name], worst(limited), rtol=1e-9, err_msg=name)
        # the limit stands for the phase margin asked for in the search, and not in the verdict
        assert row["modulus_margin"] <= row["limit"]
        assert row["meets"] == (row["phase_margin"] >= 45.0 and row["peak_torque"] <= 3.0 and row["failures"] == 0)
        sensitivity = 10.0 ** (row["modulus_margin"] / 20.0)
        assert row["phase_margin"] >= np.rad2deg(2.0 * np.arcsin(0.5 / sensitivity)) * (1 - 1e-6)
        assert 10.0 ** (row["gain_margin"] / 20.0) >= (1.0 + 1.0 / sensitivity) * (1 - 1e-6)
    assert status == (0 if any(row["meets"] for row in rows) else 1)
    loose, usual = (row["rms_window_error"] for row in rows[:2])
    assert f"with |S| at most 6 dB the RMS window error is {usual:.3g} x1, {usual / loose:.3g} times that" in out
    assert "the gains found for a looser limit keep 60 dB too" in out
    page = checked(tmp_path / "cost")
    assert "What margins cost" in page.text
    assert "--against margins --limits 60,6,4" in page.text
    assert (tmp_path / "cost" / "figures" / "robustness.png").exists()
    again = command("pareto", "c.toml", "--against", "margins", "--limits", "6,4,60", "--out", "cost")
    assert again == (status, out.replace("done: gains", "already done: gains"), "")


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--limits", "4,6"), "--limits is 4,6, but must be absent without --against margins"),
        (("--against", "margins", "--points", "4"), "--points is 4, but must be absent with --against margins"),
        (("--against", "margins", "--times", "4,8"), "--times is 4,8, but must be absent without --against t_f"),
        *(
            (("--against", "margins", "--limits", limits), f"--limits is {limits}, but must be limits in dB")
            for limits in ("4,x", "4,4", "0,3", "-6", "3,inf", "nan", "")
        ),
        (("--against", "margins"), 'loop.mode is "continuous", but must be "sampled"'),
    ],
)
def test_what_cannot_be_asked_is_refused_in_one_sentence(command, tmp_path, options, said):
    (tmp_path / "s.toml").write_text("[controller]\neta = 3.0\n")
    status, out, err = command("pareto", "s.toml", *options)
    assert (status, out) == (2, "")
    assert said in err
    assert len(err.strip().splitlines()) == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("tune", "said"),
    [
        ({"minimise": "t_f", "free": ["t_f"]}, 'tune.minimise is "t_f"'),
        ({"worst_case": True}, "tune.worst_case is true, but must be false to ask what margins cost"),
    ],
)
def test_what_has_no_answer_is_refused(tune, said):
    known = scenario.from_tables({**tomllib.loads(SHORT_CHAIN), "tune": tune})
    with pytest.raises(ScenarioError, match=said):
        robustness.check(known)


def test_the_scenarios_own_limit_is_one_of_the_usual_ones():
    tables = tomllib.loads(SHORT_CHAIN)
    assert robustness.usual_limits(scenario.from_tables(tables)) == robustness.LIMITS
    asked = scenario.from_tables({**tables, "requirements": {"modulus_margin": 5.5}})
    assert robustness.usual_limits(asked) == (3.0, 4.0, 5.0, 5.5, 6.0, 8.0, 12.0)


def test_a_limit_stands_for_the_margins_that_it_bounds():
    asked = {"peak_torque": 3.0, "gain_margin": 8.0, "phase_margin": 45.0, "delay_margin": 0.02, "modulus_margin": 5.0}
    known = scenario.from_tables({**tomllib.loads(SHORT_CHAIN), "requirements": asked})
    limited = robustness._limited(known, 4.0)
    assert limited.requirements == {"peak_torque": 3.0, "delay_margin": 0.02, "modulus_margin": 4.0}


def robust(limit, rms, **margins):
    kept = {"gain_margin": 6.1, "phase_margin": 40.0, "delay_margin": None, "modulus_margin": 5.8}
    return {
        "limit": limit, "gains": {"eta": 3.0, "observer_gain_2": 25.0}, "rms": rms,
        "interval": [0.95 * rms, 1.05 * rms], "peak": 0.2, "margins": {**kept, **margins}, "failures": 0, "meets": True,
    }  # fmt: skip


def test_a_limit_that_fresh_trials_break_is_told_and_not_set_beside_none():
    loose, broken = robust(None, 1e-5), robust(6.0, 2e-5, gain_margin=-100.0, modulus_margin=100.0)
    told = {"plant": "chain", "robust": [loose, broken, robust(4.0, 3e-5, modulus_margin=4.02)], "idle": [],
            "without": [], "requirements": []}  # fmt: skip
    assert list(front_sentences.robust_lines(told)) == [
        "with |S| at most 4 dB the RMS window error is 3e-05 x1, 3 times that without a limit",
        "the gains found for |S| at most 6 dB do not keep it on the fresh trials: 100 dB",
    ]


def test_limits_without_gains_and_loops_without_margins_are_told():
    loose = robust(None, 1e-5, gain_margin=-0.3, modulus_margin=100.0)
    told = {"plant": "spacecraft", "robust": [loose, robust(6.0, 2e-5)], "idle": [60.0, 20.0], "without": [3.0],
            "requirements": ["peak_torque"], "trials": 1000, "floor": 1e-6,
            "gain_units": {"eta": "-", "observer_gain": "kg m^2/s"}}  # fmt: skip
    assert list(front_sentences.robust_lines(told)) == [
        "without a limit on |S| not every loop is stable: the best error lies beyond the border of stability",
        "with |S| at most 6 dB the RMS window error is 2e-05, 2 times that without a limit",
        "the gains found for a looser limit keep 60 and 20 dB too",
        "no gains found keep |S| at most 3 dB on the training trials",
    ]
    assert front_sentences.robust(told).rows == [
        ("none", "1.000e-05", "5.0 %", "10", "-0.3", "40", "none", "100", "0.2", "meets"),
        ("6", "2.000e-05", "5.0 %", "20", "6.1", "40", "none", "5.8", "0.2", "meets"),
    ]
    gains = front_sentences.robust_gains(told)
    assert gains.head == ("|S| at most [dB]", "eta", "observer_gain_2 [kg m^2/s]")
    assert gains.rows == [("none", "3", "25"), ("6", "3", "25")]
    nothing = {**told, "robust": [], "idle": [], "without": [None, 6.0], "floor": None}
    assert list(front_sentences.robust_lines(nothing)) == [
        "no gains found keep the limits on the training trials, whatever margins they leave",
        "for none of these limits do gains meet every requirement on the fresh trials",
    ]
    assert front_sentences.robust(nothing).rows == front_sentences.robust_gains(nothing).rows == []
