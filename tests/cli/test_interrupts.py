"""Ctrl-C where it came to nothing, or was told wrongly."""

import importlib
import math
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest

from ptsmc_jax import scenario
from ptsmc_jax.campaigns import store
from ptsmc_jax.scenario import parsing
from tests.helpers import ROOT, SHORT_CHAIN, tree
from tuning.cli import options, searches

IMPORTING = """
import sys

class Interrupted:
    def find_spec(self, name, *_):
        if name == "cyclopts":
            raise KeyboardInterrupt
sys.meta_path.insert(0, Interrupted())
from tuning.cli import command
command()
"""


def test_a_ctrl_c_while_a_command_imports_what_it_needs_ends_it_in_one_sentence():
    done = subprocess.run([sys.executable, "-c", IMPORTING], capture_output=True, text=True, cwd=ROOT, check=False)
    assert (done.returncode, done.stderr) == (130, "ptsmc: interrupted; nothing was written\n")


@pytest.mark.parametrize(("force", "same"), [(False, "the same command"), (True, "the same command without --force")])
def test_a_search_interrupted_while_its_results_are_written_goes_on(tmp_path, capsys, force, same):
    def stopped(making, outcome):
        (making / "summary.json").write_text(outcome.status)
        raise KeyboardInterrupt

    (tmp_path / "s.toml").write_text(SHORT_CHAIN)
    search = searches.LongSearch(
        {"command": "tune", "seed": 0},
        "window error",
        work=lambda report, journal: SimpleNamespace(status=journal.get(b"asked", lambda: {}) or "met"),
        write=stopped,
        summary=lambda _: {},
        show=lambda *_: pytest.fail("there is nothing to show"),
    )
    loaded = scenario.read(tmp_path / "s.toml")
    assert searches.run(search, loaded, tmp_path / "out", force=force, quiet=True) == 130
    assert capsys.readouterr().err == f"ptsmc: interrupted; {same} goes on from here\n"
    assert set(tree(tmp_path / "out")) == {"journal.bin", "scenario.toml", "versions.json"}


@pytest.mark.parametrize(
    ("force", "told"), [(False, ""), (True, "ptsmc: interrupted; the same command without --force")]
)
def test_a_search_that_leaves_its_best_where_it_is_interrupted_goes_on_without_force(tmp_path, capsys, force, told):
    """What is shown says that the same command goes on, which with --force would begin anew."""
    (tmp_path / "s.toml").write_text(SHORT_CHAIN)
    shown = []

    def write(making, outcome):
        (making / "summary.json").write_text(outcome.status)

    search = searches.LongSearch(
        {"command": "tune", "seed": 0},
        "window error",
        work=lambda report, journal: SimpleNamespace(status="interrupted"),
        write=write,
        summary=lambda outcome: {"status": outcome.status},
        show=lambda summary, folder, how: shown.append((summary["status"], how)),
    )
    assert searches.run(search, scenario.read(tmp_path / "s.toml"), tmp_path / "out", force=force, quiet=False) == 130
    assert shown == [("interrupted", "interrupted")]
    assert capsys.readouterr().err == (f"{told} goes on from here\n" if told else "")
    assert {"journal.bin", "summary.json"} <= set(tree(tmp_path / "out"))


def test_a_search_is_shown_as_it_is_when_it_is_read_again(tmp_path):
    """A front without gains told "|S| at most inf dB" when it was done, and what it meant when it was shown again."""
    (tmp_path / "s.toml").write_text(SHORT_CHAIN)
    loaded, shown = scenario.read(tmp_path / "s.toml"), []
    said = {"status": "not met", "without": [math.inf, 6.0], "slews": ({"rms": np.float64(math.nan)},)}
    search = searches.LongSearch(
        {"command": "pareto", "seed": 0},
        "window error",
        work=lambda report, journal: SimpleNamespace(status="not met"),
        write=lambda making, _: store.record(making, parsing.dump(loaded), search.known_by, said),
        summary=lambda _: said,
        show=lambda summary, folder, how: shown.append(summary),
    )
    for _ in range(2):
        assert searches.run(search, loaded, tmp_path / "out", force=False, quiet=False) == 1
    assert shown == 2 * [{"status": "not met", "without": [None, 6.0], "slews": [{"rms": None}]}]


@pytest.mark.parametrize("status", ["interrupted", "met"])
def test_a_search_by_another_version_of_the_code_does_not_resume(tmp_path, capsys, status):
    (tmp_path / "s.toml").write_text(SHORT_CHAIN)
    loaded, folder, asked = scenario.read(tmp_path / "s.toml"), tmp_path / "out", []
    search = searches.LongSearch(
        {"command": "tune", "seed": 0},
        "window error",
        work=lambda report, journal: SimpleNamespace(status=asked.append(journal.replaying) or status),
        write=lambda making, outcome: store.record(
            making, parsing.dump(loaded), search.known_by, {"status": outcome.status}
        ),
        summary=lambda outcome: {"status": outcome.status},
        show=lambda *_: None,
    )

    def run(**force):
        return searches.run(search, loaded, folder, **{"force": False, "quiet": True, **force})

    assert run() == searches.STATUS[status]
    store.write_json(folder / "versions.json", store.read_versions(folder) | {"code_checksum": "before"})
    before = tree(folder)
    capsys.readouterr()
    if status == "interrupted":
        with pytest.raises(store.RefusedError, match="another version of the source code"):
            run()
    else:  # a finished result is shown, with a note
        assert run() == 0
        assert "another version of the source code" in capsys.readouterr().err
    assert (len(asked), tree(folder)) == (1, before)
    run(force=True)
    assert len(asked) == 2
    assert store.read_versions(folder)["code_checksum"] != "before"


TWICE = """
import builtins
from tuning.cli import main

told = builtins.print

def first(*_, **__):
    builtins.print = told
    raise KeyboardInterrupt

def working(*_, **__):
    builtins.print = first  # polars raises a Ctrl-C, and Python the same one once more in what answers it
    raise KeyboardInterrupt

main.app = working
main.main()
"""
WHILE_IMPORTED = """
from tuning.cli import main

def working(*_, **__):
    raise ImportError("initialization failed") from KeyboardInterrupt()  # as pybind11 does

main.app = working
main.main()
"""


@pytest.mark.parametrize("program", [TWICE, WHILE_IMPORTED])
def test_a_ctrl_c_that_comes_twice_or_as_another_error_ends_the_command_in_one_sentence(program):
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, cwd=ROOT, check=False)
    assert (done.returncode, done.stderr) == (130, "ptsmc: interrupted; nothing was written\n")


def test_a_ctrl_c_that_comes_once_more_while_it_is_answered_is_answered():
    times = iter([KeyboardInterrupt])

    def answer():
        for error in times:
            raise error
        return 130

    def work():
        raise KeyboardInterrupt

    assert options.answered(work, answer) == 130
    with pytest.raises(ImportError, match="no such"):
        options.answered(lambda: importlib.import_module("no such"), answer)
