"""The command `ptsmc identify`: the round trip from a simulated run, its files, and its refusals."""

import json

import numpy as np
import polars as pl
import pytest

from ptsmc_jax import scenario
from tests.helpers import refused, tree

SCENARIO = """
[plant]
kind = "chain"
order = 2
x0 = [1.0, 0.0]
[controller]
t_f = 5.0
[disturbance]
kind = "none"
[loop]
mode = "sampled"
period = 0.1
[hardware]
state_noise = [1e-3, 1e-3]
torque_limit = 2.0
[identify]
free = ["actuator_scale", "disturbance_bias"]
prior = "none"
"""


@pytest.fixture
def logged(command, tmp_path):
    """Return a folder with the scenario s.toml, and a log in run/ of a plant with 1.25 times its actuator torque."""
    (tmp_path / "true.toml").write_text(SCENARIO.replace("[hardware]", "[hardware]\nactuator_scale = [1.25]"))
    assert command("simulate", "true.toml", "--out", "run", "--no-figures", "--quiet")[0] == 0
    return tmp_path


def test_identify_finds_the_parameters_of_a_simulated_run_and_writes_its_files(command, logged):
    """identified.toml has the estimate and a dispersion of its standard deviation, and can be simulated."""
    log = "run/trajectory.csv"
    status, out, err = command("identify", "s.toml", log, "--validate", log, "--out", "found")
    assert status == 0, err
    assert out.startswith("The model explains the telemetry")
    folder = logged / "found"
    names = ["estimates"] + [
        f"{name}{k}" for name in ("autocorrelation", "innovations", "prediction") for k in ("", "_2")
    ]
    files = {
        "scenario.toml",
        "versions.json",
        "summary.json",
        "identified.toml",
        "innovations.csv",
        "innovations_2.csv",
    }
    assert set(tree(folder)) == files | {f"figures/{name}.png" for name in names}
    summary = json.loads((folder / "summary.json").read_text())
    scale = summary["parameters"][0]
    assert abs(scale["estimate"] - 1.25) < 3.5 * scale["std"] < 0.02
    assert summary["validation"][0]["white"]
    assert summary["logs"][0]["outliers"] == 0
    identified = scenario.read(folder / "identified.toml")
    assert identified.hardware.actuator_scale == (scale["estimate"],)
    assert identified.dispersion.actuator_scale.std == pytest.approx(scale["std"] / scale["estimate"])
    assert command("simulate", "found/identified.toml", "--out", "again", "--trial", 1, "--no-figures")[0] == 0
    assert command("report", "found")[0] == 0
    assert "actuator_scale" in (folder / "report.html").read_text()


@pytest.mark.long
def test_identify_finds_the_parameters_of_a_replayed_trial(command, logged):
    text = (logged / "true.toml").read_text() + "[dispersion]\nx0 = { kind = 'uniform', half_width = [0.2, 0.1] }\n"
    (logged / "true.toml").write_text(text)
    assert command("montecarlo", "true.toml", "--trials", 2, "--out", "campaign", "--no-figures", "--quiet")[0] == 0
    assert command("replay", "campaign", "--trial", 1, "--out", "trial", "--no-figures", "--quiet")[0] == 0
    assert command("identify", "s.toml", "trial/trajectory.csv", "--out", "found", "--no-figures")[0] == 0
    scale = json.loads((logged / "found" / "summary.json").read_text())["parameters"][0]
    assert abs(scale["estimate"] - 1.25) < 3.5 * scale["std"] < 0.02


def test_identify_names_dispersed_parameters_that_are_not_free_if_the_model_does_not_fit(command, logged):
    """The log has 1.25 times the torque of the scenario, and no free parameter explains it."""
    text = SCENARIO.replace('["actuator_scale", "disturbance_bias"]', '["disturbance_bias"]')
    (logged / "few.toml").write_text(text + '[dispersion]\nactuator_scale = { kind = "relative_normal", std = 0.2 }\n')
    status, out, _ = command("identify", "few.toml", "run/trajectory.csv", "--out", "few", "--no-figures")
    assert status == 1
    assert "free actuator_scale, which [dispersion] varies" in out


def test_identify_names_a_constant_torque_that_the_log_does_not_tell_from_a_slow_sinusoid(command, logged):
    """Regression: the identified scenario had the disturbance twice, as a sinusoid and as a constant."""
    slow = 'kind = "sinusoid"\namplitude = [0.01]\nfrequency = [1e-4]\nphase = [1.5]'
    (logged / "slow.toml").write_text(SCENARIO.replace('kind = "none"', slow))
    status, out, _ = command("identify", "slow.toml", "run/trajectory.csv", "--out", "slow", "--no-figures")
    assert status == 0
    assert "the data do not tell disturbance_bias from the sinusoid of [disturbance]" in out


def test_a_designed_manoeuvre_has_a_profile_within_the_limits(command, logged):
    """The manoeuvre has a smaller expected standard deviation than plain slews."""
    options = "--design", "--duration", "0.1 min", "--rate", "500 mrad/s"
    status, out, err = command("identify", "s.toml", *options, "--out", "plan")
    assert status == 0, err
    assert out.startswith("Proposed a manoeuvre of 6 s")
    profile = pl.read_csv(logged / "plan" / "profile.csv").to_dict(as_series=False)
    assert np.abs(profile["sent1"]).max() <= 2.0
    assert np.abs(profile["measured_x2"]).max() <= 0.5 + 1e-9
    rows = json.loads((logged / "plan" / "summary.json").read_text())["parameters"]
    assert 0.0 < rows[0]["expected_std"] < rows[0]["plain_std"]
    assert command("report", "plan")[0] == 0


def test_a_design_names_parameters_that_are_known_better_than_the_manoeuvre_can_determine_them(command, logged):
    """The prior counts as knowledge before the manoeuvre. An earlier version counted it as information of the data."""
    known = SCENARIO.replace('prior = "none"', 'prior = "dispersion"')
    known += '[dispersion]\nactuator_scale = { kind = "relative_normal", std = 1e-6 }\n'
    (logged / "known.toml").write_text(known)
    status, _, err = command("identify", "known.toml", "--design", "--out", "plan")
    assert (status, err) == (0, "")
    summary = json.loads((logged / "plan" / "summary.json").read_text())
    (sentence,) = summary["undetermined"]
    assert "actuator_scale" in sentence
    assert [summary[name] for name in ("duration", "rate", "torque")] == [25.0, 0.6, 2.0]  # t_f is 5 s


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ([], "give at least one log file after the scenario, or --design"),
        (["run/trajectory.csv", "--design"], "--design needs no log: leave the log files out"),
        (["run/trajectory.csv", "--rate", "0.1"], "--rate is 0.1, but must be absent without --design"),
        (["--design", "--duration", "inf"], 'Invalid value "inf" for --duration. Must be < inf.'),
        (["--design", "--duration", "1"], "the duration is 1 s, but must be at least 20 control periods, 2 s"),
        (["--design", "--rate", "2 m/s"], "for --rate: 2 m/s is no number in rad/s or with a unit such as"),
        (["absent.csv"], "the log is absent.csv, which does not exist; allowed is a .csv or .parquet file"),
        (["s.toml"], "the log is s.toml, but must be a .csv or .parquet file"),
        (["twice.csv"], "twice.csv has t 0.5 in row 6, but must have a time after that of row 5, 0.5"),
    ],
)
def test_identify_refuses_wrong_options_and_files_and_writes_nothing(command, tmp_path, options, words):
    rows = [f"{0.1 * min(k, 5 + k // 7):.1f},1,0,0" for k in range(20)]
    (tmp_path / "twice.csv").write_text("\n".join(["t,measured_x1,measured_x2,sent1", *rows]))
    assert words in refused(command, tmp_path, "identify", "s.toml", *options)
