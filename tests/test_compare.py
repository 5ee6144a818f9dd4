"""`ptsmc compare`: every law tuned alike and judged on the same trials."""

import csv
import json
import tomllib

import numpy as np
import pytest

from ptsmc_jax import scenario
from ptsmc_jax.schema import ScenarioError
from tests.helpers import FIRST_FLIGHT, SHORT, small_search
from tests.pages import checked
from tuning import compare, gains

TABLES = tomllib.loads(SHORT)


def tuned(scenario):
    assert scenario.tune is not None
    return scenario.tune


def test_every_law_is_asked_for_the_same(monkeypatch):
    base = scenario.from_tables(TABLES)
    posed = compare.contenders(base)
    assert list(posed) == ["prescribed_time", "pd", "terminal", "fixed_time"]
    assert posed["prescribed_time"] is base
    for kind, other in posed.items():
        assert other.controller.kind == kind
        assert other.controller.t_f == base.controller.t_f
        for table in ("loop", "hardware", "dispersion", "observer", "disturbance", "spacecraft", "requirements"):
            assert getattr(other, table) == getattr(base, table)
        for key in compare.KEPT:
            assert getattr(other.tune, key) == getattr(base.tune, key)
    free = {kind: tuned(other).free for kind, other in posed.items()}
    assert free["pd"] == ("k_p", "k_d", "observer_gain")
    assert free["terminal"] == ("p", "b", "k", "observer_gain")
    assert free["fixed_time"] == ("a1", "b1", "a2", "b2", "observer_gain")


def test_a_baselines_own_scenario_keeps_its_own_bounds():
    own = scenario.replace(scenario.from_tables(TABLES), tune=None, controller={"kind": "pd", "t_f": 5.0, "k_p": 2.0})
    own = scenario.replace(own, tune={"free": ["k_d"], "bounds": {"k_d": [0.5, 3.0]}, "trials": 8})
    posed = compare.contenders(own)
    assert posed["pd"] is own
    assert posed["prescribed_time"].controller.kind == "prescribed_time"
    assert tuned(posed["prescribed_time"]).free == ("eta", "delta", "observer_gain")
    assert gains.papers(own).controller.eta == 3.0
    assert gains.papers(own).controller.t_f == 5.0


@pytest.mark.parametrize(
    ("tables", "said"),
    [
        ({"loop": {"mode": "continuous"}}, 'loop.mode is "continuous", but must be "sampled"'),
        ({"plant": {"kind": "chain"}}, 'plant.kind is "chain", but must be "spacecraft"'),
    ],
)
def test_what_cannot_be_compared_is_refused(tables, said):
    with pytest.raises(ScenarioError, match=said):
        compare.check(scenario.from_tables(tables))


def test_the_command(command, tmp_path, monkeypatch):
    small_search(monkeypatch)
    monkeypatch.setattr(compare, "BASELINES", ("pd",))  # the others compile as long again
    code, said, _ = command("compare", "s.toml")
    folder = tmp_path / "out/compare-s"
    found = json.loads((folder / "summary.json").read_text())
    laws = ["paper", "prescribed_time", "pd"]
    assert list(found["laws"]) == laws
    assert code == (0 if found["laws"]["prescribed_time"]["met"] else 1)
    assert {path.name for path in (folder / "figures").iterdir()} == {"settling.png", "tradeoff.png"}
    rows = list(csv.DictReader((folder / "compare.csv").read_text().splitlines()))
    assert [row["law"] for row in rows] == laws
    for row, law in zip(rows, laws, strict=True):
        assert float(row["window_error"]) == found["laws"][law]["window_error"]
        assert law.split("_")[0] in said
        again = scenario.read(folder / "scenarios" / f"{law}.toml")  # what was judged can be flown again
        assert found["laws"][law]["gains"].keys() >= {"pd": {"k_p", "k_d"}}.get(law, {"eta", "delta"})
        for name, value in found["laws"][law]["gains"].items():
            if name != "observer_gain":
                assert getattr(again.controller, name) == pytest.approx(value, rel=1e-9)
    read = checked(folder)
    assert read.text.startswith("ptsmc compare: compare-s")
    assert f"{found['laws']['pd']['window_error']:.2e}" in read.text
    code, again, _ = command("compare", "s.toml")
    assert "already done" in again
    assert command("compare", "s.toml", "--seed", "x")[0] == 2


def test_settling_is_summed_up_by_where_trials_start():
    angle, settling = np.linspace(0.3, 2.4, 100), np.concatenate([np.full(50, 30.0), np.full(50, 33.0)])
    assert compare._near_far(angle, settling) == (30.0, 33.0)
    assert compare._rank_correlation(angle, angle**3) == pytest.approx(1.0)
    assert compare._rank_correlation(angle, -angle) == pytest.approx(-1.0)


def test_other_commands_take_a_baseline(command, tmp_path):
    text = SHORT.replace("[controller]\nt_f = 5.0\ndelta = 0.5\n", '[controller]\nkind = "pd"\nt_f = 5.0\n')
    (tmp_path / "pd.toml").write_text(text[: text.index("[tune]")])
    code, _, _ = command("simulate", "pd.toml")
    assert code in (0, 1)
    assert {path.stem for path in (tmp_path / "out/simulate-pd/figures").iterdir()} >= {"error", "torque", "sliding"}
    axes = ["--x", "controller.k_p=0.1:1:2", "--y", "controller.k_d=0.5:2:2", "--trials", 2]
    assert command("map", "pd.toml", *axes)[0] == 0
    assert command("montecarlo", "pd.toml", "--trials", 70, "--no-figures")[0] in (0, 1)


def test_the_first_flight_can_be_compared():
    posed = compare.contenders(scenario.replace(scenario.read(FIRST_FLIGHT), tune__trials=32))
    for other in posed.values():
        assert tuned(other).trials == 32
        scenario.study(other)
