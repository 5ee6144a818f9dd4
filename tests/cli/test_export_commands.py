"""`ptsmc export` and the option `--controller`: files, messages and errors."""

import json
import shutil

import numpy as np
import polars as pl
import pytest

from ptsmc_jax.onboard import folder
from tests.helpers import SHORT, SHORT_CHAIN, refused, tree
from tests.onboard.compiled import needs_compiler

SCENARIO, CONTINUOUS = SHORT_CHAIN, SHORT.replace('"sampled"', '"continuous"').split("[hardware]")[0]


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """Return the path of the folder with the exported controller of s.toml."""
    place = tmp_path_factory.mktemp("exported")
    (place / "s.toml").write_text(SHORT_CHAIN)
    return folder.export(place / "s.toml", place / "c", trials=1)


def test_export_writes_a_folder_and_prints_the_cost_of_a_step(command, tmp_path, exported):
    """The files are those of `folder.export`."""
    status, out, err = command("export", "s.toml", "--trials", 1, "--out", "the c")
    assert (status, err) == (0, "")
    assert "a step takes at most" in out
    assert "controller in the c; make -C 'the c' check" in out  # quoted for a shell
    made = json.loads((tmp_path / "the c" / "versions.json").read_text())
    assert (made["command"], made["command_line"]) == ("export", "ptsmc export s.toml --trials 1 --out 'the c'")
    # versions.json is not compared, because the command lines differ
    files = [tree(folder) | {"versions.json": b""} for folder in (tmp_path / "the c", exported)]
    assert files[0] == files[1]


def test_export_reports_default_gains(command, tmp_path):
    for gain, count in (("eta = 3.0", 0), ("", 1)):
        (tmp_path / "s.toml").write_text(SHORT_CHAIN.replace("delta = 0.5", gain))
        _, out, _ = command("export", "s.toml", "--trials", 1, "--out", "c", "--force")
        assert out.count("these are default gains") == count
        assert (tmp_path / "c" / "README.md").read_text().count("these are default gains") == count


def test_export_names_the_fmus_that_it_writes(command, tmp_path):
    status, out, _ = command("export", "s.toml", "--trials", 1, "--out", "c", "--fmu", "--fmi", 3, "--no-binary")
    assert status == 0
    assert "controller, controller_fmi3.fmu in c;" in out
    assert [path.name for path in (tmp_path / "c").glob("*.fmu")] == ["controller_fmi3.fmu"]


@needs_compiler
def test_simulate_runs_the_exported_controller(command, tmp_path, exported):
    status, _, err = command("simulate", "s.toml", "--controller", exported, "--no-figures", "--out", "r")
    assert (status, err) == (0, "")
    told = json.loads((tmp_path / "r" / "summary.json").read_text())
    layout = json.loads((exported / "controller.json").read_text())
    assert told["controller"] == layout["checksum"]
    assert told["controller_statuses"] == {"ok": 65}
    assert told["status"] == "ok"


@needs_compiler
def test_parameters_of_an_exported_controller_that_differ_from_the_scenario_are_reported(command, tmp_path, exported):
    """`simulate --controller` runs (status 0) and warns on stderr and in summary.json."""
    (tmp_path / "s.toml").write_text(SHORT_CHAIN.replace("[controller]", "[controller]\neta = 2.9\nk1 = 0.8"))
    status, _, err = command("simulate", "s.toml", "--controller", exported, "--no-figures", "--quiet")
    said = (
        "the controller has other parameters than the scenario: law_eta = 3 instead of 2.9, law_k1 = 1 instead of 0.8"
    )
    assert (status, err) == (0, f"ptsmc: {said}\n")
    (place,) = (tmp_path / "out").iterdir()
    assert json.loads((place / "summary.json").read_text())["warnings"] == [said]


@needs_compiler
def test_campaign_runs_the_exported_controller_and_copies_it(command, tmp_path):
    """Rows equal those of the simulated law with the gains of the C code, to rounding, and count sample statuses.

    A different gain of the scenario causes a warning. A replay runs the copied C code only with --trust and only if it
    has not changed. C code of the user is not overwritten.
    """
    text = SHORT_CHAIN.replace('mode = "sampled"', 'mode = "sampled"\nclock = "flight"')
    (tmp_path / "of_c.toml").write_text(text)
    (tmp_path / "s.toml").write_text(text.replace("[controller]", "[controller]\neta = 2.9"))
    folder.export(tmp_path / "of_c.toml", tmp_path / "c", trials=1)
    options = "--trials", 40, "--no-figures", "--quiet"
    flight = "montecarlo", "s.toml", *options
    code, out, err = command(*flight, "--controller", "c", "--out", "r")
    assert (code, out, "law_eta = 3 instead of 2.9" in err) == (0, "", True)
    (tmp_path / "mine" / "controller").mkdir(parents=True)
    (tmp_path / "mine" / "controller" / "mine.c").write_text("")
    code, _, err = command(*flight, "--controller", "c", "--out", "mine", "--force")
    assert (code, "whose controller contains C code of the user" in err) == (2, True)
    assert command("montecarlo", "of_c.toml", *options, "--out", "o")[0] == 0
    by_c, by_us = (pl.read_parquet(tmp_path / name / "trials") for name in ("r", "o"))
    for name in ("window_error", "peak_torque", "effort"):
        np.testing.assert_allclose(by_c[name], by_us[name], rtol=1e-9, err_msg=name)
    counted = [name for name in by_c.columns if name.startswith("controller_")]
    assert set(by_c.columns) - set(by_us.columns) == set(counted)
    assert by_c["controller_ok"].to_list() == 40 * [65]
    assert by_c.select(counted).sum_horizontal().to_list() == 40 * [65]
    kept = {path.name.replace("ptsmc_of_c", "") for path in (tmp_path / "r" / "controller").iterdir()}
    assert kept == {"controller.json", ".c", ".h", "_flat.h", "_parameters.c"}
    told = json.loads((tmp_path / "r" / "summary.json").read_text())
    assert "law_eta = 3 instead of 2.9" in told["warnings"][0]
    samples = told["controller_samples"]
    assert samples["ok"] == {"samples": 40 * 65, "trials": 40}
    assert samples["singular"] == {"samples": 0, "trials": 0}

    said = refused(command, tmp_path, *flight, "--out", "r")  # without the controller, it is another campaign
    assert "holds a run with flight_code_sha256" in said
    assert "which is not used here" in said
    replay = "replay", "r", "--trial", 7, "--no-figures"
    assert "r/controller (--controller), which this command would run; read the code, then" in refused(
        command, tmp_path, *replay
    )
    code, out, err = command(*replay, "--trust")
    assert (code, "equals its row to the last digit" in out, "equals the replayed trial" in out) == (0, True, True)
    assert err == f"ptsmc: runs {tmp_path / 'r' / 'controller'}, which --controller of r names\n"
    assert command("summarize", "r", "--no-figures", "--quiet")[0] == 0  # it does not execute the C code
    assert json.loads((tmp_path / "r" / "summary.json").read_text()) == told
    replayed = tmp_path / "r" / "replay" / "7"
    assert json.loads((replayed / "summary.json").read_text())["warnings"] == told["warnings"][:1]
    kept = tmp_path / "r" / "controller"
    before = tree(kept)
    with (kept / "ptsmc_of_c.c").open("a") as file:
        file.write("/* changed */\n")
    assert "was made with another --controller" in refused(command, tmp_path, *replay, "--trust")
    assert command(*flight, "--controller", "c", "--out", "r")[:2] == (0, "")  # it restores the copy of the C code
    assert tree(kept) == before


@pytest.mark.parametrize(
    ("text", "args", "said"),
    [
        (CONTINUOUS, (), "loop.mode is \"continuous\", but must be"),
        (SHORT + "[wheels]\n[dispersion.wheel_failure]\nkind = 'uniform'\nlatest = 3.0\nknown = true\n", (),
         "dispersion.wheel_failure.known is true, but must be false to be exported"),
        (SHORT, ("--trials", "0"), 'Invalid value "0" for --trials. Must be >= 1.'),
        (SHORT, ("--trials", "101"), 'Invalid value "101" for --trials. Must be <= 100.'),
        (SHORT, ("--seed", "-1"), 'Invalid value "-1" for --seed. Must be >= 0.'),
        (SHORT, ("--fmu", "--fmi", "4"), 'Invalid value "4" for --fmi. Choose from: 2, 3.'),
        (SHORT, ("--name", ""), '--name is "", but must have a letter from A to Z or a digit'),
        (SHORT, ("--fmi", "2"), "--fmi is 2, but must be absent without --fmu or --fmu-plant"),
        (SHORT, ("--no-binary",), "--no-binary is given, but must be absent without --fmu or --fmu-plant"),
    ],
)  # fmt: skip
def test_export_refuses_invalid_scenarios_and_options(command, tmp_path, text, args, said):
    (tmp_path / "s.toml").write_text(text)
    assert said in refused(command, tmp_path, "export", "s.toml", *args)


def test_export_refuses_a_folder_with_files(command, tmp_path, exported):
    shutil.copytree(exported, tmp_path / "c")
    assert "holds something already" in refused(command, tmp_path, "export", "s.toml", "--out", "c")


@needs_compiler
def test_simulate_refuses_a_controller_that_is_no_export_or_of_another_plant(command, tmp_path, exported, monkeypatch):
    """A continuous loop and a missing C compiler are refused too."""

    def said(controller):
        return refused(command, tmp_path, "simulate", "s.toml", "--controller", controller)

    assert "the controller is s.toml, but must be a folder that ptsmc export" in said("s.toml")
    (tmp_path / "s.toml").write_text(SHORT)
    assert "has other inputs than the scenario, but must be an export of one with the same plant" in said(exported)
    (tmp_path / "s.toml").write_text(CONTINUOUS)
    assert 'loop.mode is "continuous", but must be "sampled"' in said(exported)
    (tmp_path / "s.toml").write_text(SHORT_CHAIN)
    monkeypatch.setenv("CC", "no-such-compiler")
    assert "there is no C compiler no-such-compiler; install cc, gcc or clang, or set CC to one" in said(exported)
