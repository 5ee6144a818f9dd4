"""Settings of all tests: 64 bit, two host devices, no silent rank promotion, shapes checked at run time."""

import gc
import os
import re
import sys
from pathlib import Path

import jaxtyping
import pytest

from ptsmc_jax.configure import configure
from tests.tree import QUICKLY, ROOT, modules

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # workers inherit it; waiting BLAS threads would occupy a core
# most programs of tests run once, so optimising them takes longer than it saves; separate processes are optimised
os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {QUICKLY}"
configure(devices=2)

import jax  # noqa: E402
import matplotlib  # noqa: E402

jax.devices()  # reads the flags
os.environ["XLA_FLAGS"] = os.environ["XLA_FLAGS"].replace(QUICKLY, "").strip()

jax.config.update("jax_numpy_rank_promotion", "raise")
# modules whose annotated shapes are checked. Nested functions are decorated again at every call of the outer function.
# Folders are not listed, because a folder would mean all of its modules.
SHAPES = re.compile(r"\b(Float|Int|Bool|Complex)\[")
checked = [name for name, path in modules().items() if path.name != "__init__.py" and SHAPES.search(path.read_text())]
hook = jaxtyping.install_import_hook(checked, "beartype.beartype")

from ptsmc_jax.simulation import rollout  # noqa: E402

rollout.simulate_once = rollout.simulate_parts  # tests do not need a second, optimised program
# folders of tests of commands and campaigns: other folders test the called functions with their shapes
CALLERS = ("campaigns", "cli", "onboard", "output", "paper", "scenario", "studies")

matplotlib.rcParams["savefig.dpi"] = 30  # tests examine figures in memory, so the files can be small

# tracing creates millions of objects with few reference cycles: garbage collection took a fifth of the time
gc.set_threshold(200_000, 10, 10)

MANY = 25_000  # memory mappings of a worker, about 3 GB; Linux allows 65 530


# files with the longest tests, which workers run first, so that no worker runs them alone at the end
LONGEST = """
    cli/test_cli studies/test_pareto campaigns/test_margin_requirements search/test_tuning
    search/test_worst theory/test_margins plants/test_systems devices/test_hardware simulation/test_rollout
    cli/test_campaign_commands dispersions/test_hardware_errors test_conformity onboard/test_library batching/test_lanes
    campaigns/test_montecarlo campaigns/test_run_tables studies/test_mapping theory/test_spillover
    theory/test_covariance
    laws/test_family batching/test_kernel campaigns/test_campaign_processes search/test_gains laws/test_chain
    studies/test_tuner observers/test_observers_others campaigns/test_campaign paper/test_paper
    studies/test_stability studies/test_compare theory/test_theory dispersions/test_dispersions
""".split()
assert all((ROOT / "tests" / f"{name}.py").exists() for name in LONGEST)


def pytest_collection_modifyitems(items):
    """Run the files in `LONGEST` first, in this order."""
    names = {item: item.path.relative_to(ROOT / "tests").with_suffix("").as_posix() for item in items}
    items.sort(key=lambda item: LONGEST.index(names[item]) if names[item] in LONGEST else len(LONGEST))


@pytest.fixture(autouse=True, scope="module")
def _check_shapes_outside_callers(request):
    """Check the annotated array shapes at run time, except in the folders of `CALLERS`."""
    jaxtyping.config.update("jaxtyping_disable", request.path.parent.name in CALLERS)


@pytest.fixture(autouse=True, scope="module")
def _room_for_compiled_programs():
    """Delete compiled programs in time: the kernel ends a process that keeps more than about 500 programs."""
    yield
    maps = Path("/proc/self/maps")
    if maps.exists() and maps.read_bytes().count(b"\n") > MANY:
        jax.clear_caches()
        gc.unfreeze()
        gc.collect()
    gc.freeze()  # programs stay alive, so garbage collection need not visit them


@pytest.fixture
def small_parts(monkeypatch):
    """Store the rows of a campaign in files of 100 trials, so that short campaigns have several files."""
    monkeypatch.setattr("ptsmc_jax.campaigns.campaign.PART", 100)


@pytest.fixture
def command(request, tmp_path, monkeypatch, capsys):
    """Return a function that runs `ptsmc` with its arguments and returns exit status, stdout and stderr.

    The current folder is `tmp_path`, with s.toml only. This scenario is `SCENARIO` of the test module, or `SHORT`.
    """
    from tests.helpers import SHORT
    from tuning.cli import main

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("ptsmc_jax.configure.configure", lambda **_: None)  # done above
    monkeypatch.setattr("tuning.output.progress.INTERVAL", 3600.0)  # no progress lines, also on a slow machine
    (tmp_path / "s.toml").write_text(getattr(request.module, "SCENARIO", SHORT))

    def run(*args):
        monkeypatch.setattr(sys, "argv", ["ptsmc", *map(str, args)])
        with pytest.raises(SystemExit) as done:
            main.main()
        told = capsys.readouterr()
        return done.value.code, told.out, told.err

    return run
