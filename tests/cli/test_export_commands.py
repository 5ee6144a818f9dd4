"""`ptsmc export` and `ptsmc simulate --controller`: what they leave and say, and what they refuse in one sentence."""

import json
import shutil

import pytest

from ptsmc_jax.onboard import folder
from tests.helpers import SHORT, tree
from tests.onboard.compiled import needs_compiler

CONTINUOUS = SHORT.replace('"sampled"', '"continuous"').split("[hardware]")[0]


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """A controller of s.toml."""
    place = tmp_path_factory.mktemp("exported")
    (place / "s.toml").write_text(SHORT)
    return folder.export(place / "s.toml", place / "c", trials=1)


def test_export_leaves_a_folder_and_says_what_a_step_takes(command, tmp_path, exported):
    status, out, err = command("export", "s.toml", "--trials", 1, "--out", "c")
    assert (status, err) == (0, "")
    assert "a step takes at most" in out
    assert "controller in c; make -C c check" in out
    assert tree(tmp_path / "c") == tree(exported)
    assert json.loads((tmp_path / "c" / "versions.json").read_text())["command"] == "export"


@needs_compiler
def test_simulate_flies_the_controller(command, tmp_path, exported):
    status, _, err = command("simulate", "s.toml", "--controller", exported, "--no-figures", "--out", "r")
    assert (status, err) == (0, "")
    told = json.loads((tmp_path / "r" / "summary.json").read_text())
    layout = json.loads((exported / "controller.json").read_text())
    assert told["controller"] == layout["digest"]
    assert told["controller_statuses"] == {"ok": 65}
    assert told["status"] == "ok"


def refused(command, tmp_path, *args):
    """The one sentence of a command that writes nothing."""
    before = tree(tmp_path)
    status, out, err = command(*args)
    assert (status, out) == (2, "")
    assert tree(tmp_path) == before
    (line,) = err.strip().splitlines()
    return line


@pytest.mark.parametrize(
    ("text", "args", "said"),
    [
        (CONTINUOUS, (), "loop.mode is \"continuous\", but must be"),
        (SHORT + "[hardware.command_filter]\nkind = 'first_order'\ncorner = 2.0\n", (),
         'hardware.command_filter is { corner = 2.0, kind = "first_order" }, but must be absent to be exported'),
        (SHORT + "[wheels]\n[dispersion.wheel_failure]\nkind = 'uniform'\nlatest = 3.0\nknown = true\n", (),
         "dispersion.wheel_failure.known is true, but must be false to be exported"),
        (SHORT, ("--trials", "0"), "--trials is 0, but must be a whole number from 1 to 100"),
        (SHORT, ("--trials", "101"), "--trials is 101, but must be a whole number from 1 to 100"),
        (SHORT, ("--seed", "-1"), "--seed is -1, but must be a whole number"),
    ],
)  # fmt: skip
def test_export_refuses_in_one_sentence(command, tmp_path, text, args, said):
    (tmp_path / "s.toml").write_text(text)
    assert said in refused(command, tmp_path, "export", "s.toml", *args)


def test_export_refuses_a_folder_that_holds_something(command, tmp_path, exported):
    shutil.copytree(exported, tmp_path / "c")
    assert "holds something already" in refused(command, tmp_path, "export", "s.toml", "--out", "c")


@needs_compiler
def test_simulate_refuses_what_is_no_controller_of_the_scenario(command, tmp_path, exported, monkeypatch):
    def said(controller):
        return refused(command, tmp_path, "simulate", "s.toml", "--controller", controller)

    assert "the controller is nothing, but must be a folder that ptsmc export has written" in said("nothing")
    assert "the controller is s.toml, but must be a folder that ptsmc export" in said("s.toml")
    (tmp_path / "s.toml").write_text(SHORT.replace("period = 0.1", "period = 0.05"))
    assert "loop.period is 0.05 s, but must be 0.1 s, that of the controller in" in said(exported)
    (tmp_path / "s.toml").write_text(SHORT + "[filter]\n")
    assert "has other inputs than the scenario, but must be an export of one with the same plant" in said(exported)
    (tmp_path / "s.toml").write_text(CONTINUOUS)
    assert 'loop.mode is "continuous", but must be "sampled"' in said(exported)
    (tmp_path / "s.toml").write_text(SHORT)
    monkeypatch.setenv("CC", "no-such-compiler")
    assert "there is no C compiler no-such-compiler; allowed is cc, gcc or clang, or what CC names" in said(exported)
