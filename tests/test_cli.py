"""The command: files, exit statuses, sentences."""

import json
import subprocess
import sys

import numpy as np
import pytest

from ptsmc_jax import metrics, scenario
from tests.helpers import FIRST_FLIGHT, ROOT
from tuning import cli

SHORT = """
[controller]
t_f = 5.0
delta = 0.5
[loop]
mode = "sampled"
period = 0.1
t_end = 6.5
[hardware]
attitude_noise = 2e-5
rate_noise = 1e-6
[dispersion]
attitude = { kind = "axis_angle", min_deg = 20.0, max_deg = 90.0 }
[requirements]
peak_torque = 30.0
[tune]
free = ["eta", "delta"]
bounds = { eta = [2.1, 6.0], delta = [0.1, 2.0] }
trials = 8
starts = 2
steps = 4
"""


@pytest.fixture
def command(tmp_path, monkeypatch, capsys):
    """Runs `ptsmc ...` in an empty folder with the scenario above as s.toml: exit status, output, errors."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("ptsmc_jax.configure.configure", lambda: None)  # conftest did
    (tmp_path / "s.toml").write_text(SHORT)

    def run(*args):
        monkeypatch.setattr(sys, "argv", ["ptsmc", *map(str, args)])
        with pytest.raises(SystemExit) as done:
            cli.main()
        told = capsys.readouterr()
        return done.value.code, told.out, told.err

    return run


def tree(folder):
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def test_simulate_leaves_what_the_contract_says(command, tmp_path):
    status, out, err = command("simulate", "s.toml", "--trial", 3, "--seed", 7)
    assert (status, err) == (0, "")
    assert "window_error" in out
    folder = tmp_path / "out" / "simulate-s"
    figures = {f"figures/{name}.png" for name in ("attitude", "error", "rate", "torque", "sliding", "disturbance")}
    assert set(tree(folder)) == {"trajectory.csv", "summary.json", "scenario.toml", "versions.json", *figures}
    header, *rows = (folder / "trajectory.csv").read_text().splitlines()
    assert header == "t,q1,q2,q3,q4,w1,w2,w3,d_hat1,d_hat2,d_hat3,u1,u2,u3,s1,s2,s3"
    values = np.array([[float(v) for v in row.split(",")] for row in rows])
    assert values[0, 0] == 0.0
    assert values[-1, 0] == 6.5
    assert np.all(np.diff(values[:, 0]) > 0)
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["status"] == "ok"
    assert set(metrics.CATALOGUE) <= set(summary)
    assert summary["peak_torque"] == pytest.approx(np.abs(values[:, 11:14]).max(), rel=1e-12)
    assert scenario.read(folder / "scenario.toml") == scenario.read(tmp_path / "s.toml")
    made = json.loads((folder / "versions.json").read_text())
    assert (made["command"], made["seed"], made["trial"]) == ("simulate", 7, 3)

    before = tree(folder)
    status, _, err = command("simulate", "s.toml")
    assert status == 2
    assert "simulate-s" in err
    assert "--force" in err
    assert tree(folder) == before
    status, _, _ = command("simulate", "s.toml", "--force", "--quiet", "--no-figures")
    assert status == 0
    assert tree(folder)["trajectory.csv"] != before["trajectory.csv"]  # nominal now


def test_a_requirement_that_is_not_met_is_exit_status_one(command, tmp_path):
    (tmp_path / "s.toml").write_text(SHORT.replace("peak_torque = 30.0", "peak_torque = 0.01"))
    status, out, _ = command("simulate", "s.toml", "--no-figures")
    assert status == 1
    assert "NOT met" in out


BAD = [
    (("simulate", "nothere.toml"), "nothere.toml is not there"),
    (("simulate", "folder"), "folder cannot be read"),
    (("simulate", "broken.toml"), "broken.toml is no valid TOML"),
    (("simulate", "eta.toml"), "controller.eta is 1.0, but must be a number greater than 2"),
    (("tune", "eta.toml"), "controller.eta is 1.0, but must be a number greater than 2"),
    (("tune", "far.toml"), "initial.rotvec_deg is"),
    (("simulate", "s.toml", "--seed", "-1"), "--seed is -1"),
    (("simulate", "s.toml", "--trial", "4294967296"), "--trial is 4294967296"),
    (("simulate", "s.toml", "--seed", "many"), "many"),
    (("simulate", "s.toml", "--sed", "1"), "--sed"),
    (("simulate", "s.toml", "--out", "full"), "full, which holds something already"),
    (("tune", "s.toml", "--out", "s.toml"), "s.toml, which is a file"),
    (("fly",), "fly"),
]


@pytest.mark.parametrize(("args", "said"), BAD, ids=[" ".join(row[0]) for row in BAD])
def test_bad_input_is_one_sentence_and_exit_status_two(command, tmp_path, args, said):
    (tmp_path / "folder").mkdir()
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine").write_text("keep")
    (tmp_path / "broken.toml").write_text("x = ")
    (tmp_path / "eta.toml").write_text("[controller]\neta = 1.0")
    (tmp_path / "far.toml").write_text("[initial]\nrotvec_deg = [180.0, 0.0, 0.0]")
    before = tree(tmp_path)
    status, out, err = command(*args)
    assert (status, out) == (2, "")
    assert err.startswith("ptsmc: ")
    assert said in err
    assert err.count("\n") == 1
    assert "Traceback" not in err
    assert tree(tmp_path) == before
    assert not (tmp_path / "out").exists()


def test_tune_from_start_to_end(command, tmp_path, monkeypatch):
    from tuning import optimise, report

    for module, name, value in ((optimise, "SCREENED", 32), (optimise, "CANDIDATES", 8), (report, "FRESH", 40)):
        monkeypatch.setattr(module, name, value)
    status, out, _ = command("tune", "s.toml", "--out", "t")
    summary = json.loads((tmp_path / "t" / "summary.json").read_text())
    assert status == (0 if summary["status"] == "met" else 1)
    assert {"gains", "training", "fresh", "paper", "verdicts"} <= set(summary)
    assert summary["fresh"]["trials"] == 40
    assert summary["fresh"]["seed"] != summary["training"]["seed"]
    files = {"tuned.toml", "history.csv", "summary.json", "scenario.toml", "versions.json"}
    assert set(tree(tmp_path / "t")) == files | {"figures/history.png", "figures/tradeoff.png"}
    tuned = scenario.read(tmp_path / "t" / "tuned.toml")
    assert tuned.controller.eta == summary["gains"]["eta"]
    assert tuned.controller.delta == summary["gains"]["delta"]
    header, *rows = (tmp_path / "t" / "history.csv").read_text().splitlines()
    assert header == "step,start,rms_window_error,eta,delta,peak_torque_over_limit"
    assert len(rows) >= 2 * 5
    # the gains beat the paper's on the same trials, in this noise too
    assert summary["fresh"]["window_error"]["rms"] < summary["paper"]["window_error"]["rms"]

    before = tree(tmp_path / "t")
    again, told, _ = command("tune", "s.toml", "--out", "t")
    assert again == status
    assert "already done" in told
    assert tree(tmp_path / "t") == before
    other, _, err = command("tune", "s.toml", "--out", "t", "--seed", 1)
    assert other == 2
    assert "--force" in err


def test_help_and_version_do_not_load_jax():
    for option in ("--help", "--version"):
        code = f"import sys; sys.argv = ['ptsmc', '{option}']\nimport tuning.cli\ntry: tuning.cli.main()\nexcept SystemExit: pass\nassert 'jax' not in sys.modules"
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=False)
        assert done.returncode == 0, done.stderr
        assert done.stdout


def test_the_readme_scenario_is_read(tmp_path):
    text = (ROOT / "README.md").read_text()
    block = next(part for part in text.split("```toml\n")[1:] if "[spacecraft]" in part).split("```")[0]
    (tmp_path / "readme.toml").write_text(block)
    scenario.read(tmp_path / "readme.toml")
    scenario.read(FIRST_FLIGHT)
