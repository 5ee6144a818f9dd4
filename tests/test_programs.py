"""Compiled programs that are kept: what is loaded, what is not, and that in any doubt the right numbers come out."""

import importlib
import os
import shutil
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ptsmc_jax import configure, programs, provenance
from ptsmc_jax.batching import lapack
from ptsmc_jax.numerics import pytrees
from tests.helpers import gpus
from tests.tree import ROOT, modules


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setattr(configure, "programs", tmp_path / "programs")
    return tmp_path / "programs"


def spied(name="spied", factor=2.0):
    """A program that counts how often it is traced, as if it stood at the top of one of our files."""
    traced = []

    def function(x, y=1.0, kind="plain", points=2):
        traced.append(kind)
        return {"both": jnp.sin(factor * x) + y * len(kind), "grid": jnp.linspace(0.0, 1.0, points)}

    function.__module__, function.__qualname__, function.__name__ = "ptsmc_jax.numerics.attitude", name, name
    return programs.jit(function, static_argnames="kind"), traced


X = np.linspace(0.0, 1.0, 5)


def test_a_program_is_compiled_once_and_loaded_by_the_next_process(folder):
    """The next process is a second `Program` of the same function here."""
    program, traced = spied()
    first = [program(X), program(2 * X)]
    assert len(traced) == 1
    (kept,) = folder.iterdir()
    assert kept.stat().st_mode & 0o777 == 0o600
    assert folder.stat().st_mode & 0o777 == 0o700
    again, traced = spied()
    for ours, theirs in zip(first, [again(X), again(2 * X)], strict=True):
        np.testing.assert_array_equal(ours["both"], theirs["both"])
    assert not traced
    np.testing.assert_allclose(first[1]["both"], np.sin(4 * X) + 5.0, rtol=1e-15)


def test_what_only_tells_of_our_own_lapack_calls_none(folder, monkeypatch):
    """LAPACK takes 0.1 s to import, and what went through `batching.lapack` names that file."""

    def function(x):
        return lapack.in_turn(jnp.sin, [0])(x)

    function.__module__, function.__qualname__, function.__name__ = "ptsmc_jax.numerics.attitude", "turns", "turns"
    wanted = programs.jit(function)(X)
    (kept,) = folder.iterdir()
    assert b"batching/lapack.py" in kept.read_bytes()
    monkeypatch.setattr(programs, "_lapack", None)
    monkeypatch.setattr(programs.Program, "_compiled", None)
    np.testing.assert_array_equal(programs.jit(function)(X), wanted)


@pytest.mark.parametrize("kept", [False, True])
def test_where_jax_has_a_gpu_all_but_batches_run_on_the_processor(tmp_path, monkeypatch, kept):
    """A second device of the processor's stands for the GPU; whose Schur decomposition JAX does not have."""
    if kept:
        monkeypatch.setattr(configure, "programs", tmp_path)
    processor, gpu = jax.local_devices()[:2]
    monkeypatch.setattr(configure, "devices", gpus)
    seen = []

    def function(x):
        seen.append(configure.default_device())
        return 2.0 * x

    function.__module__, function.__qualname__, function.__name__ = "ptsmc_jax.numerics.attitude", "where", "where"
    x = jax.device_put(jnp.asarray(X), gpu)
    single, batch = programs.jit(function), programs.jit(function, batch=True)
    single.prepare(x)
    for result in (single(x), single(X), single(x=x), single(jnp.stack([x, x]))[1]):
        assert result.devices() == {processor}
        np.testing.assert_array_equal(result, 2.0 * X)
    assert set(seen) == {processor}
    assert batch(x).devices() == {gpu}
    assert seen[-1] is None
    assert jax.jit(lambda x: single(x))(x).devices() == {gpu}  # part of a program of the caller's own
    assert seen[-1] is None


def test_compiling_is_out_of_reach_of_a_ctrl_c(folder, monkeypatch):
    """XLA goes on with it, for a client that an exit takes away: a segmentation fault in place of the status."""
    compiled, threads = programs.Program._compiled, []
    monkeypatch.setattr(
        programs.Program, "_compiled", lambda *known: (threads.append(threading.current_thread()), compiled(*known))[1]
    )
    program, _ = spied()
    program(X)
    program(X[:3])
    assert len(threads) == 2
    assert threading.main_thread() not in threads
    assert not [thread for thread in threads if thread.daemon]  # an exit waits for it


def test_a_thread_with_bits_of_its_own_has_programs_of_its_own(folder):
    """They are compiled in other threads, in which numbers would have 64 all the same."""
    program, _ = spied()
    double = program(X)["both"]
    with jax.enable_x64(False):
        program.prepare(X[:3])
        single = program(X)["both"]
        assert program(X[:3])["both"].dtype == single.dtype == np.float32
    np.testing.assert_allclose(single, double, rtol=1e-6)
    assert program(X)["both"].dtype == np.float64
    assert len(list(folder.iterdir())) == 3


def test_another_command_in_the_same_process_prepares_programs_too(folder):
    program, _ = spied()
    for count in range(1, 5):  # the last ones wait, and are not begun any more
        program.prepare(X[:count])
    programs.stop()
    program.prepare(X)
    for count in range(1, 6):
        assert program(X[:count])["both"].shape == (count,)


def test_what_is_not_to_be_compiled_is_not(folder):
    program, _ = spied()
    with jax.disable_jit():
        np.testing.assert_allclose(program(X)["both"], np.sin(2 * X) + 5.0, rtol=1e-15)
    assert not folder.exists()


@pytrees.pytree
@dataclass(frozen=True)
class _Law:
    gain: Any
    order: int = field(default=2, metadata={"static": True})


class _Other(_Law):
    pass


for _kind in (_Law, _Other):
    _kind.__module__ = "ptsmc_jax.laws.error_motions"
pytrees.pytree(_Other)


def test_another_structure_shape_type_static_argument_version_or_code_is_another_program(folder, monkeypatch):
    def count(*args, **kwargs):
        program, _ = spied()
        program(*args, **kwargs)
        return len(list(folder.iterdir()))

    calls = [((X,), {}), ((X[:3],), {}), ((X.astype(np.float32),), {}), ((1.0,), {}), ((X, 1), {}),
             ((X,), {"kind": "other"})]  # fmt: skip
    assert [count(*args, **kwargs) for args, kwargs in calls] == [1, 2, 3, 4, 5, 6]
    assert count(jnp.asarray(X)) == 6  # the same for JAX
    with monkeypatch.context() as changed:
        changed.setattr(programs.jax, "__version__", "0.0.1")
        assert count(X) == 7
    with monkeypatch.context() as changed:
        changed.setattr(programs, "_code", lambda package: "edited")
        assert count(X) == 8
    with jax.debug_nans(True):
        assert count(X) == 9


def test_two_laws_with_the_same_numbers_are_two_programs(folder):
    def function(law):
        return law.gain * (3.0 if type(law) is _Other else 1.0)

    function.__module__, function.__qualname__ = "ptsmc_jax.numerics.attitude", "function"
    for _ in range(2):  # compiled, then loaded
        program = programs.jit(function)
        assert [float(program(law(2.0))) for law in (_Law, _Other)] == [2.0, 6.0]
        assert float(program(_Law(2.0, order=3))) == 2.0
        assert len(list(folder.iterdir())) == 3


@pytest.mark.parametrize(
    "damage",
    ["cut short", "empty", "another's", "a bit", "open to the group", "a link", "an open folder"],
)
def test_a_file_that_is_not_as_we_left_it_is_not_loaded(folder, damage, tmp_path):
    program, _ = spied()
    program(X)
    (kept,) = folder.iterdir()
    content = kept.read_bytes()
    if damage == "cut short":
        kept.write_bytes(content[: len(content) // 2])
    elif damage == "empty":
        kept.write_bytes(b"")
    elif damage == "another's":
        other, _ = spied("other", factor=3.0)
        other(X)
        (theirs,) = set(folder.iterdir()) - {kept}
        kept.write_bytes(theirs.read_bytes())
    elif damage == "a bit":
        kept.write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
    elif damage == "open to the group":
        kept.chmod(0o620)
    elif damage == "a link":
        kept.rename(tmp_path / "elsewhere")
        kept.symlink_to(tmp_path / "elsewhere")
    else:
        folder.chmod(0o777)
    again, traced = spied()
    np.testing.assert_allclose(again(X)["both"], np.sin(2 * X) + 5.0, rtol=1e-15)
    assert len(traced) == 1


def test_what_several_write_at_once_is_whole_at_any_time(folder):
    """Writers that get in each other's way, and readers: each finds nothing yet, or all of it."""
    program, _ = spied()
    program(X)
    (kept,) = folder.iterdir()
    (ready,) = program._ready.values()
    known = program._known((X,), {})
    assert known is not None
    said, inside = program._said(known[0]), jax.tree.structure(((known[2],), {}))
    assert programs._path(said) == kept
    kept.unlink()
    with ThreadPoolExecutor(6) as pool:
        writing = [pool.submit(programs._write, kept, said, ready) for _ in range(40)]
        found = [pool.submit(lambda: kept.exists() and programs._read(kept, said, inside)) for _ in range(40)]
        assert all(one.result() is not None for one in found)
        for one in writing:
            one.result()
    assert list(folder.iterdir()) == [kept]
    loaded = programs._read(kept, said, inside)
    assert loaded is not None
    np.testing.assert_array_equal(loaded(known[2])["both"], program(X)["both"])


def test_what_is_prepared_is_loaded_too(folder):
    spied()[0](X)
    again, traced = spied()
    again.prepare(X)
    np.testing.assert_allclose(again(X)["both"], np.sin(2 * X) + 5.0, rtol=1e-15)
    other, traced_other = spied("other", factor=3.0)
    other.prepare(X)
    np.testing.assert_allclose(other(X)["both"], np.sin(3 * X) + 5.0, rtol=1e-15)
    assert (len(traced), len(traced_other)) == (0, 1)


def test_a_program_that_does_not_run_is_compiled_again(folder, monkeypatch):
    program, _ = spied()
    program(X)

    def fails(given):
        raise RuntimeError("Function fusion not found")

    monkeypatch.setattr(programs, "_read", lambda *told: fails)
    again, traced = spied()
    np.testing.assert_allclose(again(X)["both"], np.sin(2 * X) + 5.0, rtol=1e-15)
    assert len(traced) == 1


@pytest.mark.parametrize("runs", [True, False])
def test_programs_in_a_folder_that_cannot_be_written_are_loaded_all_the_same(folder, monkeypatch, runs):
    """As in an image of a container, mounted to be read only: there was no noting that one was used, or removing it."""
    program, _ = spied()
    program(X)

    def refused(*args, **kwargs):
        raise OSError(30, "Read-only file system")

    def fails(given):
        raise RuntimeError("Function fusion not found")

    for place, name in ((programs.os, "utime"), (programs.Path, "unlink"), (programs.tempfile, "mkstemp")):
        monkeypatch.setattr(place, name, refused)
    if not runs:
        monkeypatch.setattr(programs, "_read", lambda *told: fails)
    again, traced = spied()
    np.testing.assert_allclose(again(X)["both"], np.sin(2 * X) + 5.0, rtol=1e-15)
    assert len(traced) == (0 if runs else 1)


def test_what_cannot_be_told_from_files_is_compiled_as_ever(folder):
    """A user's own function or class, a tracer, arrays spread over devices."""

    def own(x):
        return 2.0 * x

    np.testing.assert_array_equal(programs.jit(own)(X), 2 * X)
    program, _ = spied()
    np.testing.assert_allclose(jax.vmap(lambda x: program(x)["both"])(X), np.sin(2 * X) + 5.0, rtol=1e-15)
    np.testing.assert_allclose(jax.grad(lambda x: program(x)["both"])(0.3), 2 * np.cos(0.6), rtol=1e-14)
    elsewhere = jax.device_put(X, jax.local_devices()[-1])
    assert program(elsewhere)["both"].devices() == {jax.local_devices()[-1]}
    assert not folder.exists()


def test_only_so_many_are_kept(folder, monkeypatch):
    monkeypatch.setattr(programs, "KEPT", 2)
    for k in range(4):
        program, _ = spied(f"number_{k}")
        program(X)
    assert len(list(folder.iterdir())) == 2


def test_those_not_used_for_longest_make_room(folder, monkeypatch):
    monkeypatch.setattr(programs, "KEPT", 3)
    made: list[Path] = []
    for k in range(4):
        before = set(folder.iterdir()) if folder.exists() else set()
        program, _ = spied(f"number_{k}")
        program(X)
        (new,) = set(folder.iterdir()) - before
        made.append(new)
        used = (new, made[0])  # the first one is used again and again
        for j, path in enumerate(used):
            at = 1e9 + 10 * k + j
            os.utime(path, (at, at))
    assert set(folder.iterdir()) == {made[0], made[2], made[3]}


_SCRIPT = """
import os, sys
from ptsmc_jax.configure import configure
configure(devices=2, cache=sys.argv[1], keep_programs=True)
import jax, jax.numpy as jnp, numpy as np
from ptsmc_jax import programs
from ptsmc_jax.campaigns import montecarlo

traced = []

def poles(a):
    traced.append(1)
    values = jnp.linalg.eigvals(a)
    spread = montecarlo.spread(lambda x: jnp.sin(3.0 * x) * x + 1.0, jnp.arange(4.0), 2)
    return jnp.sort(jnp.abs(values)), spread

poles.__module__, poles.__qualname__ = "ptsmc_jax.theory.linear", "poles"

def same(given):
    return poles(**given)

same.__name__ = "poles"
a = np.array([[0.5, 1.0], [-1.0, 0.5]])

begun = sys.argv[2] == "two" and os.fork()  # with what was imported, and nothing of JAX's that has started
if sys.argv[2] == "two":
    jax.block_until_ready(jax.jit(same)({"a": a}))  # the compile cache has it then
before = len(traced)
found, spread = programs.jit(poles)(a)
np.testing.assert_allclose(found, np.sqrt([1.25, 1.25]), rtol=1e-12)
np.testing.assert_allclose(spread, np.sin(3.0 * np.arange(4)) * np.arange(4) + 1.0, rtol=1e-12)
if begun:
    assert os.waitpid(begun, 0)[1] == 0
print(len(traced) - before)
"""


def test_processes_share_programs_with_lapack_and_several_devices_in_them(tmp_path):
    """Two at once compile and write; the third loads, though LAPACK was never asked for before in it.

    What the compile cache gives back could not be written again: it must be compiled anew for that.
    """
    cache, ours = tmp_path / "cache", configure._cache_folder()
    cache.mkdir()
    for verdict in ours.glob("options-*.json") if ours else ():
        shutil.copy(verdict, cache)

    def run(which):
        call = [sys.executable, "-c", _SCRIPT, str(cache), which]
        environment = dict(os.environ, PYTHONPATH=str(ROOT))
        done = subprocess.run(call, env=environment, capture_output=True, text=True, timeout=300, check=False)
        assert done.returncode == 0, done.stderr
        return done.stdout.split()

    assert "1" in run("two")
    assert run("last") == ["0"]
    assert len(list((cache / "programs").iterdir())) == 1


def test_every_program_is_a_function_of_its_module():
    """Called by keywords where it is kept, and known by its name: no function that another one wraps, as vmap does."""
    found = 0
    for module in map(importlib.import_module, modules()):
        for program in [v for v in vars(module).values() if isinstance(v, programs.Program)]:
            home = sys.modules[program._function.__module__]
            named = getattr(home, program._function.__name__)
            assert named is program or named is program._function, program._function
            found += 1
    assert found > 20


def test_a_program_of_the_search_hangs_on_the_files_of_the_library_too(tmp_path, monkeypatch):
    for name in programs.OURS:
        (tmp_path / name).mkdir()
    monkeypatch.setattr(provenance, "FOLDER", tmp_path)
    monkeypatch.setattr(provenance, "code_checksum", provenance.code_checksum.__wrapped__)
    library, search = (tmp_path / name / "part.py" for name in ("ptsmc_jax", "tuning"))

    def digests():
        return [programs._code(name) for name in ("ptsmc_jax", "tuning")]

    first = digests()
    library.write_text("a = 1")
    second = digests()
    search.write_text("a = 1")
    third = digests()
    assert [a != b for a, b in zip(first, second, strict=True)] == [True, True]
    assert [a != b for a, b in zip(second, third, strict=True)] == [False, True]
