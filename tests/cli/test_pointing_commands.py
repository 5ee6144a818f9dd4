"""Pointing requirements of a scenario: rows, verdicts, compliance table, pointing budget and page."""

import json

import jax
import numpy as np
import polars as pl
import pytest

from ptsmc_jax.campaigns import campaign, montecarlo, store
from ptsmc_jax.numerics import statistics
from ptsmc_jax.simulation import rollout
from ptsmc_jax.simulation.catalogues import percent
from ptsmc_jax.simulation.requirements import Requirement
from tests.helpers import rows_of, short
from tests.output.pages import checked
from tuning.output import campaign_report, formats, summaries
from tuning.output.report import Table
from tuning.studies import campaign_summary

ASKED = """
[pointing]
boresight = [1.0, 0.0, 0.0]
window = 0.5
after = 0.5
[requirements]
peak_torque = 30.0
rpe_boresight = { limit = 0.02, probability = 0.9, confidence = 0.9 }
ape_boresight = { limit = 0.01, probability = 0.5, confidence = 0.9, interpretation = "mixed" }
ake_x = { limit = 1e-4, probability = 0.9973, interpretation = "temporal" }
"""
FOLDER = "out/montecarlo-s"


drawn, values = jax.jit(lambda parts, dispersion, *at: dispersion.apply(parts, *at)), jax.jit(montecarlo.values)


@pytest.fixture(scope="module")
def one_by_one():
    """Return a replacement of `montecarlo.run` with the compiled program of single trials.

    The lower bound uses this program too. The replacement simulates each trial once and then remembers it.
    """
    known = {}

    def one(parts, dispersion, seed, trial):
        at = np.uint32(seed), np.uint32(trial)
        run = rollout.simulate_parts(drawn(parts, dispersion, *at), *at, record=True, software=rollout.PYTHON_SOFTWARE)
        simulated = values(parts, dispersion, *at)
        return jax.tree.map(np.asarray, (run.metrics, run.status, run.bad_time, simulated, {}, run.samples))

    def run(parts, dispersion, seed, trials, **_):
        for trial in trials:
            if (seed, trial) not in known:
                known[seed, trial] = one(parts, dispersion, seed, trial)
        found = [known[seed, trial] for trial in trials]
        return montecarlo.Trials(np.asarray(trials), *jax.tree.map(lambda *many: np.stack(many), *found))

    return run


# `test_montecarlo.py` and `test_lanes.py` test batches
@pytest.fixture(params=short(["alone", "in a batch"], ["alone"]))
def simulated(request, command, tmp_path, monkeypatch, one_by_one):
    """Return exit status, stdout, rows (a data frame) and summary (a dict) of a campaign with pointing requirements."""
    if request.param == "alone":
        monkeypatch.setattr(montecarlo, "run", one_by_one)
        monkeypatch.setattr(montecarlo, "prepare", lambda *_: None)
    monkeypatch.setattr(campaign, "PART", 100)
    text = (tmp_path / "s.toml").read_text().replace("[requirements]\npeak_torque = 30.0\n", ASKED)
    (tmp_path / "s.toml").write_text(text)
    code, said, _ = command("montecarlo", "s.toml", "--trials", 150, "--seed", 0, "--no-figures")
    rows = rows_of(tmp_path / FOLDER)
    return code, said, rows, json.loads((tmp_path / FOLDER / "summary.json").read_text())


def test_pointing_requirements_have_verdicts_budget_and_table(simulated, tmp_path):
    """Each interpretation (mixed, temporal, ensemble) is judged by its own statistics of the rows.

    The budget has the probability and the confidence of the requirement on runs.
    """
    code, said, rows, found = simulated
    verdicts = {told["metric"]: told for told in found["verdicts"]}
    assert code == (0 if all(told["met"] for told in verdicts.values()) else 1)
    assert {"within_ape_boresight", "within_ake_x"} <= set(rows.columns)
    assert "within_ake_y" not in rows.columns

    mixed, within = verdicts["ape_boresight"], rows["within_ape_boresight"].to_numpy()
    assert 0.1 < within.mean() < 1.0
    assert mixed["fraction"] == pytest.approx(within.mean())
    assert mixed["fraction_bound"] == pytest.approx(1.0 - statistics.mean_bound(1.0 - within, 0.9))
    assert mixed["met"] == (mixed["fraction_bound"] >= 0.5)
    assert mixed["fewest_trials"] == 4  # 0.5^4 <= 0.1
    low, high = mixed["fraction_interval"]
    assert low < mixed["fraction"] < high
    temporal = verdicts["ake_x"]
    assert temporal["fraction_of_time"] == pytest.approx(rows["within_ake_x"].min())
    assert temporal["met"]
    ensemble = verdicts["rpe_boresight"]
    assert ensemble["failures"] == int((rows["rpe_boresight"] > 0.02).sum())

    budget = found["pointing"]["budget"]
    assert set(budget) == {"ape", "mpe", "rpe", "pde", "ake", "mke", "rke"}
    # the budget has the probability and the confidence of the requirement on runs
    assert budget["rpe"]["boresight"] == pytest.approx(ensemble["margin"] * 0.02)
    for place in (said, checked(tmp_path / FOLDER).text):
        assert "90 % of the runs stay within the angles of this budget from 0.5 s after t_f to t_end" in place
        assert "to t_end, with 90 % confidence; boresight 1, 0, 0" in place
        assert "ape_boresight at most 2062.65 arcsec in 50 % of the time of all runs" in place
    (section,) = campaign_report.pointing_sections(summaries.read(summaries.Campaign, found))
    table = section.blocks[-1]
    assert isinstance(table, Table)
    assert [row[:7] for row in table.rows] == [
        ("RPE", "half-cone", "1.15 deg", "90 %", "ensemble", "90 %",
         formats.format_angle(ensemble["margin"] * 0.02)),
        ("APE", "half-cone", "2063 arcsec", "50 %", "mixed", "90 %", f"{percent(mixed['shown'])} % of the time"),
        ("AKE", "x", "20.6 arcsec", "99.73 %", "temporal", "not required",
         f"{percent(temporal['shown'])} % of the time"),
    ]  # fmt: skip
    assert [row[9] for row in table.rows] == ["22", "4", "every run"]  # 0.9^22 <= 0.1


def test_worst_trials_by_a_fraction_of_time_have_the_smallest_fractions(command, simulated, tmp_path):
    """The quantiles are those that 99.73 %, 90 % and 50 % of the runs reach."""
    _, said, rows, found = simulated
    within = rows["within_ape_boresight"].to_numpy()
    ordered = np.sort(within)
    told = found["quantiles"]["within_ape_boresight"]
    assert (told["min"], told["0.0027"]["value"]) == (ordered[0], ordered[0])  # 99.73 % of 150 runs: all runs
    assert told["0.1"]["value"] == ordered[15]  # 135 runs of 150 reach it
    assert told["0.5"]["value"] == ordered[75]
    assert "0.9973" not in told
    assert "within_ape_boresight" not in said.split("99.73 % reach")[0]  # it is in the table after this heading
    assert f"{ordered[0]:.3g}" in said.split("99.73 % reach")[1]
    assert "Fractions of the time within a limit, larger is better" in checked(tmp_path / FOLDER).text

    assert command("worst", FOLDER, "--by", "within_ape_boresight", "-n", 3, "--why")[0] == 0
    assert pl.read_csv(tmp_path / FOLDER / "worst.csv")["within_ape_boresight"].to_list() == list(ordered[:3])
    for name in ("worst.csv", "why.csv"):
        assert (tmp_path / FOLDER / name).read_bytes().startswith(store.MADE_OF_RESULTS[name])
    why = pl.read_csv(tmp_path / FOLDER / "why.csv").filter(pl.col("metric") == "within_ape_boresight")
    assert set(why["trial"]) == set(np.argsort(within, kind="stable")[:3])


def test_pointing_budget_is_an_order_statistic(simulated):
    rows, found = simulated[2:]
    bound = found["pointing"]["budget"]["mpe"]["y"]
    ordered = np.sort(rows["mpe_y"].to_numpy())
    least = next(k for k in range(1, 151) if statistics.fraction_bound(k, 150, 0.9) >= 0.9)
    assert bound == ordered[least - 1]
    read = summaries.read(summaries.Campaign, found)
    assert formats.format_angle(bound) in str(campaign_report.pointing_sections(read))


@pytest.mark.parametrize(
    ("required", "expected"),
    [
        ([], (0.9973, 0.95)),
        ([("ape_x", 0.9, 0.8, "ensemble"), ("rpe_x", 0.9, 0.8, "ensemble")], (0.9, 0.8)),
        ([("ape_x", 0.9, 0.8, "ensemble"), ("rpe_x", 0.9, 0.9, "ensemble")], (0.9973, 0.95)),
        ([("ape_x", 0.9, None, "ensemble"), ("ape_y", None, None, "ensemble")], (0.9, 0.95)),
        ([("ape_x", 0.9, 0.8, "mixed"), ("peak_torque", 0.5, 0.5, "ensemble")], (0.9973, 0.95)),
    ],
)
def test_pointing_budget_has_the_probability_of_the_requirements(required, expected):
    asked = [Requirement(metric, 1e-3, None, *numbers[:2], interpretation=numbers[2]) for metric, *numbers in required]
    assert campaign_summary.budget_statistics(asked) == expected


def test_single_run_has_the_pointing_indices(command, simulated, tmp_path):
    code, said, _ = command("simulate", "s.toml", "--trial", 3, "--no-figures", "--out", "one")
    made = json.loads((tmp_path / "one" / "summary.json").read_text())
    row = simulated[2].row(3, named=True)
    for name in ("ape_x", "rpe_boresight", "mke_z", "within_ape_boresight"):
        assert made[name] == pytest.approx(row[name], rel=1e-9), name
    assert code == (0 if all(told["met"] for told in made["verdicts"]) else 1)
    assert "ake_x at most 20.6265 arcsec in 99.73 % of the time, in every run" in said
