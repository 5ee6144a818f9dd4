"""Campaigns in real processes that are killed, interrupted, on a full disk, or on a cluster that loses a worker."""

import contextlib
import os
import re
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from tests.helpers import QUICKLY, ROOT, SHORT_CHAIN, rows_of, same

PTSMC = [sys.executable, "-c", "from tuning.cli.main import main; main()"]
RESULTS = "out/montecarlo-s"
COMMAND = ["montecarlo", "s.toml", "--seed", "3", "--no-figures", "--quiet"]
PARTS, TRIALS = 4, 4 * 4096 - 1000
# long enough for a kill during the simulation
SLOW = SHORT_CHAIN.replace("t_f = 5.0", "t_f = 15.0").replace("t_end = 6.5", "t_end = 20.0")


def environment():
    """Return the environment variables of a process that imports this source tree and compiles quickly."""
    return dict(os.environ, PYTHONPATH=str(ROOT), XLA_FLAGS=f"{os.environ.get('XLA_FLAGS', '')} {QUICKLY}")


def started(folder, *options, **others):
    """Start `COMMAND` (montecarlo of s.toml in the folder) with further options; return the `Popen`.

    others: arguments of `Popen`.
    """
    return subprocess.Popen([*PTSMC, *COMMAND, *options], cwd=folder, env=environment(), text=True,
                            stdout=subprocess.PIPE, stderr=subprocess.PIPE, **others)  # fmt: skip


def ended(run, seconds=300):
    """Wait at most `seconds` for the end of a process; return its exit status and the text on stderr."""
    _, error = run.communicate(timeout=seconds)
    return run.returncode, error


def parts(folder):
    """Return the sorted names of the campaign's files of rows."""
    return sorted(path.name for path in (folder / RESULTS / "trials").glob("*.parquet"))


# A limit on the file size imitates a full disk: no part and no compile cache fits. The second call has no limit.
FULL_AT_FIRST = """
import os, resource
from tuning.cli.main import main
_, most = resource.getrlimit(resource.RLIMIT_FSIZE)
resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, most))
try:
    main()
except SystemExit as stopped:
    print(stopped.code, os.listdir("out/montecarlo-s/trials"))
resource.setrlimit(resource.RLIMIT_FSIZE, (most, most))
main()
"""


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Return the rows (a data frame) of an uninterrupted run.

    Its first attempt found a full disk, reported it, and left no parts.
    """
    folder = tmp_path_factory.mktemp("whole")
    (folder / "s.toml").write_text(SLOW)
    call = [sys.executable, "-c", FULL_AT_FIRST, *COMMAND, "--trials", str(TRIALS)]
    run = subprocess.run(call, cwd=folder, env=environment(), text=True, capture_output=True, check=False, timeout=300)
    assert (run.returncode, run.stdout) == (0, "2 []\n"), run.stderr
    last = run.stderr.strip().splitlines()[-1]
    assert re.fullmatch(r"ptsmc: File too large.*", last)
    assert "Traceback" not in run.stderr
    rows = rows_of(folder / RESULTS)
    assert rows["trial"].to_list() == list(range(TRIALS))
    return rows


@pytest.fixture
def folder(tmp_path):
    """Return a new folder with the scenario s.toml, whose simulation is slow enough for a kill."""
    (tmp_path / "s.toml").write_text(SLOW)
    return tmp_path


def await_parts(folder, count, run, patience=120.0):
    """Wait until the campaign has `count` parts (True) or the process has ended (False).

    patience: time [s] after which the test fails. run: the process.
    """
    since = time.monotonic()
    while run.poll() is None:
        if len(parts(folder)) >= count:
            return True
        assert time.monotonic() - since < patience
        time.sleep(0.002)
    return False


@pytest.mark.long  # shorter tests of the same functions: `test_rows.py` and `test_campaign_commands.py`
@pytest.mark.parametrize("times", [1, 20])
def test_campaign_killed_at_random_times_ends_with_the_same_rows(folder, request, times):
    """A run is killed at a random time after its first new part, and repeated. `times` is the number of kills."""
    rng, killed = np.random.default_rng(0), 0
    for _ in range(200):
        before = len(parts(folder))
        run = started(folder, "--trials", str(TRIALS), start_new_session=True)
        if await_parts(folder, before + 1, run):
            time.sleep(rng.uniform(0.0, 0.06))
        with contextlib.suppress(ProcessLookupError):
            os.killpg(run.pid, signal.SIGKILL)
        killed += ended(run)[0] == -signal.SIGKILL
        if killed == times:
            break
        if len(parts(folder)) > PARTS - 3:  # too few missing parts for another kill, so delete some
            for name in parts(folder)[: PARTS // 2]:
                (folder / RESULTS / "trials" / name).unlink()
    assert killed == times
    run = started(folder, "--trials", str(TRIALS))
    assert ended(run) == (0, "")
    assert list((folder / RESULTS / "trials").glob(".making*")) == []
    rows = rows_of(folder / RESULTS)
    assert rows["trial"].to_list() == list(range(TRIALS))  # no trial is missing or repeated
    same(rows, request.getfixturevalue("whole"))  # evaluated last, so that it can use the compile cache


@pytest.fixture
def cluster(folder):
    """Start a Dask scheduler and two workers on the loopback device; yield the list of the workers' `Popen`.

    The scheduler file is cluster.json in the folder.
    """

    def dask(*options):
        call = [sys.executable, "-m", "dask", *options, "--scheduler-file", "cluster.json"]
        none = subprocess.DEVNULL
        return subprocess.Popen(call, cwd=folder, env=environment(), stdout=none, stderr=none)

    scheduler = dask("scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard")
    since = time.monotonic()
    while not (folder / "cluster.json").exists():
        assert time.monotonic() - since < 60.0
        time.sleep(0.05)
    workers = [dask("worker", "--no-nanny", "--nthreads", "1", "--no-dashboard") for _ in range(2)]
    yield workers
    for process in (*workers, scheduler):
        process.kill()
        process.wait()


@pytest.mark.long
def test_cluster_that_loses_a_worker_gives_the_same_rows(folder, whole, cluster):
    run = started(folder, "--trials", str(TRIALS), "--cluster", "cluster.json")
    assert await_parts(folder, 2, run)
    cluster[0].kill()
    assert ended(run) == (0, "")
    rows = rows_of(folder / RESULTS)
    assert rows["trial"].to_list() == list(range(TRIALS))
    same(rows, whole)
    assert [worker.poll() is None for worker in cluster] == [False, True]


@pytest.mark.long
def test_unreachable_cluster_is_refused(folder):
    run = started(folder, "--trials", "100", "--cluster", "tcp://127.0.0.1:1")
    code, error = ended(run)
    assert code == 2
    assert re.search(r"^ptsmc: --cluster is tcp://127.0.0.1:1, which does not answer", error, re.M)
    assert "Traceback" not in error
    assert not (folder / "out").exists()
