"""One process at a time writes into a result folder."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from ptsmc_jax.campaigns import campaign, store
from tests.helpers import ROOT, SHORT_CHAIN, tree


def refused(folder, **options):
    """Return whether another writer uses the folder, so that it cannot be locked; options: of `lock_folder`."""
    try:
        with store.lock_folder(folder, **options):
            return False
    except store.InUseError:
        return True


@pytest.mark.parametrize("first", [False, True])
@pytest.mark.parametrize("second", [False, True])
def test_a_second_writer_of_a_result_folder_is_refused_unless_both_share_the_lock(tmp_path, first, second):
    """The same holds for a link to the folder. Afterwards no lock file and no empty folder is left."""
    folder = tmp_path / "new" / "out"
    with store.lock_folder(folder, shared=first):
        assert refused(folder, shared=second) is not (first and second)
        assert refused(tmp_path / "new" / "other") is False
        (tmp_path / "link").symlink_to(folder)
        assert refused(tmp_path / "link", shared=second) is not (first and second)
        (tmp_path / "link").unlink()
    assert refused(folder) is False
    assert list(tmp_path.iterdir()) == []  # no lock file, no folder


def test_the_last_of_several_writers_removes_the_lock_file(tmp_path):
    with store.lock_folder(tmp_path / "out", shared=True):
        with store.lock_folder(tmp_path / "out", shared=True):
            pass
        assert refused(tmp_path / "out")
    assert list(tmp_path.iterdir()) == []


HOLDING = """
import time
from pathlib import Path
from ptsmc_jax.campaigns import store

def fill(making):
    print("writing", flush=True)
    time.sleep(60.0)

folder = Path("a[b]")
with store.lock_folder(folder):
    store.write_folder(folder, fill)
"""


def test_a_folder_is_refused_until_the_process_with_its_lock_is_killed(tmp_path):
    """The next writer removes the lock file of the killed process. The temporary folder of results remains."""
    environment = dict(os.environ, PYTHONPATH=str(ROOT))
    call = [sys.executable, "-c", HOLDING]
    with subprocess.Popen(call, cwd=tmp_path, env=environment, text=True, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "writing\n"
        assert refused(tmp_path / "a[b]")
        process.send_signal(signal.SIGKILL)
        process.wait()
    assert len(list(tmp_path.iterdir())) == 2  # the temporary folder and the lock file
    assert not refused(tmp_path / "a[b]")
    assert len(list(tmp_path.iterdir())) == 1


def test_a_temporary_folder_stays_while_another_process_shares_the_lock(tmp_path):
    folder = tmp_path / "out"

    def fill(making):
        assert not refused(folder, shared=True)
        (making / "a").write_text("kept")

    with store.lock_folder(folder, shared=True):
        store.write_folder(folder, fill)
    assert tree(folder) == {"a": b"kept"}


def test_results_are_written_to_a_file_system_without_locks(tmp_path, monkeypatch):
    def unsupported(*_):
        raise OSError(95, "Operation not supported")

    monkeypatch.setattr(store.fcntl, "flock", unsupported)
    assert not refused(tmp_path / "out")
    monkeypatch.setattr(store, "fcntl", None)  # Windows
    assert not refused(tmp_path / "out")


def test_a_lock_file_inside_the_folder_does_not_count_as_its_content(tmp_path, monkeypatch):
    """If the folder is a mount point, its parent is on another disk, so that the lock file is inside."""
    folder = tmp_path / "out"
    folder.mkdir()
    monkeypatch.setattr(type(tmp_path), "is_mount", lambda path: path == folder)
    with store.lock_folder(folder, force=False):
        assert len(list(folder.iterdir())) == 1
        assert refused(folder)
        store.check_folder(folder, force=False)
        assert store.is_empty(folder)
        (folder / "a").touch()
        assert not store.is_empty(folder)
    assert [path.name for path in folder.iterdir()] == ["a"]
    with pytest.raises(store.RefusedError, match="holds something already"), store.lock_folder(folder, force=False):
        pass


SCENARIO, ASKED = SHORT_CHAIN, ("s.toml", "--quiet", "--no-figures")


@pytest.mark.parametrize(
    "asked",
    [
        ("simulate", *ASKED),
        ("map", *ASKED),
        ("margins", *ASKED),
        ("tune", *ASKED),
        ("pareto", *ASKED),
        ("montecarlo", *ASKED, "--trials", "10"),
        ("montecarlo", *ASKED, "--trials", "10", "--shard", "1/2"),
        ("montecarlo", *ASKED, "--trials", "10", "--dry-run"),
        ("export", "s.toml", "--quiet"),
        ("reproduce", "--quiet"),
    ],
    ids=" ".join,
)
def test_commands_refuse_a_result_folder_in_use(command, tmp_path, asked):
    """They exit with status 2 and write nothing."""
    before = tree(tmp_path)
    with store.lock_folder(tmp_path / "out"):
        code, said, error = command(*asked, "--out", "out")
        assert (code, said, error.count("\n")) == (2, "", 1)
        assert error.startswith("ptsmc: out is in use by another ptsmc process")
    assert tree(tmp_path) == before


@pytest.mark.skipif(not Path("/proc/self").is_dir(), reason="the system has no /proc")
def test_a_folder_that_cannot_be_written_is_refused_but_not_as_in_use():
    """No file can be created in /proc, although its permissions allow it."""
    with (
        pytest.raises(store.RefusedError, match="nothing may be written into /proc;"),
        store.lock_folder(Path("/proc/x")),
    ):
        pass


def test_shards_of_one_folder_run_at_the_same_time(command, tmp_path, monkeypatch):
    monkeypatch.setattr(campaign, "PART", 100)
    asked = ("montecarlo", *ASKED, "--trials", 110, "--out", "out")
    with store.lock_folder(tmp_path / "out", shared=True):
        assert command(*asked, "--shard", "1/2") == command(*asked, "--shard", "2/2") == (0, "", "")
        assert command("summarize", "out", "--quiet", "--no-figures") == (0, "", "")
        assert command(*asked)[0] == 2


def test_a_campaign_in_use_is_summarised_without_writing(command, tmp_path):
    """The output is that of an unused campaign, with a warning."""
    asked = ("montecarlo", *ASKED, "--trials", "10", "--out", "out")
    assert command(*asked) == (0, "", "")
    _, printed, _ = command("summarize", "out", "--no-figures")
    (tmp_path / "out" / "summary.json").unlink()
    before = tree(tmp_path / "out")
    with store.lock_folder(tmp_path / "out"):
        code, said, error = command("summarize", "out", "--no-figures")
    assert (code, said) == (0, printed)
    assert "is in use" in error
    assert tree(tmp_path / "out") == before
