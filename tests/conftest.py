"""Strictness for the tests alone: 64 bit, two host devices, no silent rank promotion, shapes checked at run time."""

import gc
import os
import re
import sys
from pathlib import Path

import jaxtyping
import pytest

from ptsmc_jax.configure import configure
from tests.tree import QUICKLY, ROOT, modules

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # of workers, which inherit it: threads that wait take a core
# most programs of tests fly once: what optimising saves is less than what it takes; not so in processes of their own
os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {QUICKLY}"
configure(devices=2)

import jax  # noqa: E402
import matplotlib  # noqa: E402

jax.devices()  # reads the flags
os.environ["XLA_FLAGS"] = os.environ["XLA_FLAGS"].replace(QUICKLY, "").strip()

jax.config.update("jax_numpy_rank_promotion", "raise")
# modules that name shapes: a function inside another is decorated anew whenever that one is called. Not folders, whose
# names would stand for all modules in them
SHAPES = re.compile(r"\b(Float|Int|Bool|Complex)\[")
checked = [name for name, path in modules().items() if path.name != "__init__.py" and SHAPES.search(path.read_text())]
hook = jaxtyping.install_import_hook(checked, "beartype.beartype")

from ptsmc_jax.simulation import rollout  # noqa: E402

rollout.simulate_once = rollout.simulate_parts  # all programs are compiled quickly here: not the same one twice
# rooms of tests whose commands and campaigns call what other rooms test by itself, with its shapes
CALLERS = ("campaigns", "cli", "onboard", "output", "paper", "scenario", "studies")

matplotlib.rcParams["savefig.dpi"] = 30  # what figures show, tests ask of these themselves: not of their files

# tracing makes objects by the million, and hardly any in cycles: looking for these took a fifth of its time
gc.set_threshold(200_000, 10, 10)

MANY = 25_000  # mappings of memory; Linux allows a process 65 530: with these a worker comes to 3 GB


# files that a worker is to begin with, the longest first: the last ones would keep one of them waiting
LONGEST = """
    cli/test_cli studies/test_compare studies/test_pareto campaigns/test_margin_requirements search/test_tuning
    search/test_worst theory/test_margins plants/test_systems devices/test_hardware simulation/test_rollout
    cli/test_campaign_commands dispersions/test_hardware_errors test_conformity onboard/test_library batching/test_lanes
    campaigns/test_montecarlo campaigns/test_plans studies/test_mapping theory/test_spillover theory/test_covariance
    laws/test_family batching/test_kernel campaigns/test_campaign_processes search/test_gains laws/test_chain
    studies/test_tuner observers/test_observers_others campaigns/test_campaign paper/test_paper
    studies/test_stability theory/test_theory dispersions/test_dispersions
""".split()
assert all((ROOT / "tests" / f"{name}.py").exists() for name in LONGEST)


def pytest_collection_modifyitems(items):
    """Files in the order of `LONGEST`, then the others."""
    names = {item: item.path.relative_to(ROOT / "tests").with_suffix("").as_posix() for item in items}
    items.sort(key=lambda item: LONGEST.index(names[item]) if names[item] in LONGEST else len(LONGEST))


@pytest.fixture(autouse=True, scope="module")
def _shapes_are_checked_where_a_thing_is_tested_by_itself(request):
    jaxtyping.config.update("jaxtyping_disable", request.path.parent.name in CALLERS)


@pytest.fixture(autouse=True, scope="module")
def _room_for_compiled_programs():
    """A process that keeps every program it ever compiled is ended by the kernel after some 500 of them."""
    yield
    maps = Path("/proc/self/maps")
    if maps.exists() and maps.read_bytes().count(b"\n") > MANY:
        jax.clear_caches()
        gc.unfreeze()
        gc.collect()
    gc.freeze()  # programs live on: no collection is to walk through them again


@pytest.fixture
def command(tmp_path, monkeypatch, capsys):
    """Runs `ptsmc ...` in an empty folder with the scenario `SHORT` as s.toml: exit status, output, errors."""
    from tests.helpers import SHORT
    from tuning.cli import main

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("ptsmc_jax.configure.configure", lambda **_: None)  # conftest did
    (tmp_path / "s.toml").write_text(SHORT)

    def run(*args):
        monkeypatch.setattr(sys, "argv", ["ptsmc", *map(str, args)])
        with pytest.raises(SystemExit) as done:
            main.main()
        told = capsys.readouterr()
        return done.value.code, told.out, told.err

    return run
