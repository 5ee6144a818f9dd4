"""Ctrl-C: the first one ends a command without loss of results, the second one kills it. Resuming of searches."""

import math
import signal
import subprocess
import sys
import tomllib
from types import SimpleNamespace

import numpy as np
import pytest

from ptsmc_jax import scenario
from ptsmc_jax.campaigns import store
from ptsmc_jax.scenario import parsing
from tests.helpers import ROOT, SHORT_CHAIN, tree
from tuning.cli import searches
from tuning.output import reports
from tuning.output.report import Report
from tuning.studies import compare, pareto, tuner

EMPTY = Report("", "calm", [])
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
WORKING = """
import os, signal
from tuning.cli import command, main

def working(*_, **__):
    try:
        os.kill(os.getpid(), signal.SIGINT)
    finally:
        print("saved", flush=True)
        if TWICE:
            os.kill(os.getpid(), signal.SIGINT)
        print("done", flush=True)

main.app = working
command()
"""


def test_ctrl_c_during_imports_prints_one_line():
    done = subprocess.run([sys.executable, "-c", IMPORTING], capture_output=True, text=True, cwd=ROOT, check=False)
    assert (done.returncode, done.stderr) == (130, "ptsmc: interrupted\n")


@pytest.mark.parametrize(("twice", "status", "out", "error"), [
    (False, 130, "saved\ndone\n", "ptsmc: interrupted; nothing was written\n"),
    (True, -signal.SIGINT, "saved\n", ""),
])  # fmt: skip
def test_first_ctrl_c_ends_the_command_and_a_second_kills_it(twice, status, out, error):
    program = WORKING.replace("TWICE", str(twice))
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, cwd=ROOT, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (status, out, error)


LOADED = scenario.from_tables(tomllib.loads(SHORT_CHAIN))


@pytest.fixture(autouse=True)
def shown(monkeypatch):
    """Replace the printed reports by empty ones; return the list of summaries whose reports are requested."""
    summaries = []
    monkeypatch.setattr(reports, "build", lambda command, summary, plant: summaries.append(summary) or EMPTY)
    return summaries


def search_of(status, write, command="tune"):
    """Return a fake `LongSearch` that ends with this status.

    write: function of the folder and the outcome that fills the folder. command: the command that starts the search.
    """
    made_by = {"command": command, "seed": 0}
    return searches.LongSearch(made_by, "window error", lambda *_: SimpleNamespace(status=status), write)


def recorded(summary, command="tune"):
    """Return a function of a folder and an outcome that writes a result folder with this summary; it is a `write`."""
    made_by = {"command": command, "seed": 0}
    return lambda making, _: store.write_run_files(making, parsing.dump(LOADED), made_by, summary)


@pytest.mark.parametrize(("force", "same"), [(False, "the same command"), (True, "the same command without --force")])
def test_search_interrupted_while_writing_reports_how_to_resume_and_leaves_no_results(tmp_path, shown, force, same):
    """Only journal, scenario and versions are left: no summary, and no report is printed."""

    def write_then_interrupt(folder, outcome):
        (folder / "summary.json").write_text(outcome.status)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt, match=f"^{same} resumes it$"):
        searches.run(search_of("met", write_then_interrupt), LOADED, tmp_path / "out", force=force, quiet=False)
    assert shown == []
    assert set(tree(tmp_path / "out")) == {"journal.bin", "scenario.toml", "versions.json"}


@pytest.mark.parametrize(("force", "same"), [(False, "the same command"), (True, "the same command without --force")])
def test_interrupted_search_that_wrote_its_best_gains_resumes_without_force(tmp_path, capsys, shown, force, same):
    """With --force, the same command would start again."""
    search = search_of("interrupted", recorded({"status": "interrupted"}))
    assert searches.run(search, LOADED, tmp_path / "out", force=force, quiet=False) == 130
    assert [summary["status"] for summary in shown] == ["interrupted"]
    assert capsys.readouterr().err == f"ptsmc: interrupted; {same} resumes it\n"
    assert {"journal.bin", "summary.json"} <= set(tree(tmp_path / "out"))


def test_new_and_stored_results_of_a_search_have_the_same_report(tmp_path, shown):
    """Earlier, the report of a new front without gains printed "|S| at most inf dB", but the stored one did not."""
    said = {"status": "not met", "without": [math.inf, 6.0], "slews": ({"rms": np.float64(math.nan)},)}
    search = search_of("not met", recorded(said, "pareto"), command="pareto")
    for _ in range(2):
        assert searches.run(search, LOADED, tmp_path / "out", force=False, quiet=False) == 1
    assert shown == 2 * [{"status": "not met", "without": [None, 6.0], "slews": [{"rms": None}]}]


def test_search_of_another_code_version_is_shown_with_a_note_and_repeated_with_force(tmp_path, capsys):
    """`campaigns/test_store.py` tests that an unfinished search of another code version is refused."""
    folder, search = tmp_path / "out", search_of("met", recorded({"status": "met"}))
    assert searches.run(search, LOADED, folder, force=False, quiet=True) == 0
    store.write_json(folder / "versions.json", store.read_versions(folder) | {"code_checksum": "before"})
    before = tree(folder)
    assert searches.run(search, LOADED, folder, force=False, quiet=True) == 0
    assert "another version of the source code" in capsys.readouterr().err
    assert tree(folder) == before
    searches.run(search, LOADED, folder, force=True, quiet=True)
    assert store.read_versions(folder)["code_checksum"] != "before"


@pytest.mark.parametrize("study", ["tune", "pareto", "compare"])
def test_an_interrupted_search_is_refused_on_another_device(command, tmp_path, monkeypatch, study):
    """Its journal would contain numbers of a GPU and of a processor."""

    def stopped(*_, **__):
        raise KeyboardInterrupt

    modules = {"tune": (tuner, "tune"), "pareto": (pareto, "trace"), "compare": (compare, "compare")}
    monkeypatch.setattr(*modules[study], stopped)
    assert command(study, "s.toml", "--out", "t")[0] == 130
    versions = store.read_versions(tmp_path / "t")
    assert versions["device"] == "cpu"
    store.write_json(tmp_path / "t" / "versions.json", versions | {"device": "gpu"})
    status, _, error = command(study, "s.toml", "--out", "t")
    assert (status, "a run with device gpu, not cpu" in error) == (2, True)
