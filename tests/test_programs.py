"""Stored programs: which of them are read, which are traced again, and that results are right in doubtful cases."""

import importlib
import os
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ptsmc_jax import configure, programs, provenance
from ptsmc_jax.campaigns import montecarlo
from ptsmc_jax.numerics import pytrees
from tests.helpers import gpus
from tests.tree import ROOT, modules

X = np.linspace(0.0, 1.0, 5)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Return the path of the folder for stored programs, which the first stored program creates."""
    monkeypatch.setattr(configure, "programs", tmp_path / "programs")
    return tmp_path / "programs"


def ours(function, name="ours"):
    """Make a function look like a function at the top of a module of the project; return it."""
    function.__module__, function.__qualname__, function.__name__ = "ptsmc_jax.numerics.attitude", name, name
    return function


def spied(name="spied", factor=2.0):
    """Return a program, as a new process would make it of the same function, and a list.

    The list receives the thread of each trace of the program. Programs with the same `name` and `factor` are equal.
    """
    traced = []

    def function(x, y=1.0, kind="plain", points=2):
        traced.append(threading.current_thread())
        return {"both": jnp.sin(factor * x) + y * len(kind), "grid": jnp.linspace(0.0, 1.0, points)}

    return programs.jit(ours(function, name), static_argnames="kind"), traced


def count(folder):
    """Return the number of files in a folder."""
    return len(list(folder.iterdir()))


def test_a_stored_program_is_traced_once_and_read_by_the_next_process(folder):
    """Only the user can read the folder."""
    program, traced = spied()
    first = [program(X), program(2 * X)]
    assert len(traced) == 1
    assert folder.stat().st_mode & 0o777 == 0o700
    again, traced = spied()
    for stored, wanted in zip([again(X), again(2 * X)], first, strict=True):
        np.testing.assert_array_equal(stored["both"], wanted["both"])
    assert not traced
    np.testing.assert_allclose(first[1]["both"], np.sin(4 * X) + 5.0, rtol=1e-15)


@pytest.mark.parametrize("stored", [False, True])
def test_all_programs_but_batches_run_on_the_cpu_if_jax_has_a_gpu(tmp_path, monkeypatch, stored):
    """A second CPU device represents the GPU.

    A program that is a part of a program of the caller runs on the device of the caller.
    """
    if stored:
        monkeypatch.setattr(configure, "programs", tmp_path)
    cpu, gpu = jax.local_devices()[:2]
    monkeypatch.setattr(configure, "devices", gpus)
    seen = []

    def function(x):
        seen.append(configure.default_device())
        return 2.0 * x

    x = jax.device_put(jnp.asarray(X), gpu)
    single, batch = programs.jit(ours(function)), programs.jit(function, batch=True)
    for result in (single(x), single(X), single(x=x), single(jnp.stack([x, x]))[1]):
        assert result.devices() == {cpu}
        np.testing.assert_array_equal(result, 2.0 * X)
    assert set(seen) == {cpu}
    with monkeypatch.context() as patch:
        patch.setattr(configure, "programs", None)  # the CPU device cannot run stored GPU programs
        assert batch(x).devices() == {gpu}
        assert seen[-1] is None
        assert jax.jit(lambda x: single(x))(x).devices() == {gpu}  # part of a program of the caller
        assert seen[-1] is None


def test_a_ctrl_c_does_not_interrupt_a_compilation(folder):
    """The main thread only waits, and an exit waits for the thread that compiles."""
    program, traced = spied()
    program(X)
    program(X[:3])
    assert len(traced) == 2
    assert threading.main_thread() not in traced
    assert not any(thread.daemon for thread in traced)


@pytest.mark.parametrize("for_command", [True, False])
def test_a_ctrl_c_does_not_interrupt_a_compilation_in_a_command_with_custom_code(monkeypatch, for_command):
    """Custom code ends the storing of programs. A script calls in its own thread, whose settings of JAX apply."""
    monkeypatch.setattr(configure, "programs", None)
    monkeypatch.setattr(configure, "for_command", for_command)
    program, traced = spied()
    program(X)
    assert [thread is threading.main_thread() for thread in traced] == [not for_command]


def test_a_thread_with_another_precision_has_other_programs(folder):
    program, _ = spied()
    double = program(X)["both"]
    with jax.enable_x64(False):
        program.prepare(X[:3])
        single = program(X)["both"]
        assert program(X[:3])["both"].dtype == single.dtype == np.float32
    np.testing.assert_allclose(single, double, rtol=1e-6)
    assert program(X)["both"].dtype == np.float64
    assert count(folder) == 3


def test_a_prepared_program_is_read_and_compiled_once(folder):
    """A program is prepared in the background before its first call."""
    spied()[0](X)
    again, traced = spied()
    again.prepare(X)
    np.testing.assert_allclose(again(X)["both"], np.sin(2 * X) + 5.0, rtol=1e-15)
    other, traced_other = spied("other", factor=3.0)
    other.prepare(X)
    np.testing.assert_allclose(other(X)["both"], np.sin(3 * X) + 5.0, rtol=1e-15)
    assert (len(traced), len(traced_other)) == (0, 1)


def test_a_program_is_named_while_a_caller_waits_for_its_compilation(folder, monkeypatch):
    """A prepared program counts from its preparation on, but is named only if a caller waits for it."""
    monkeypatch.setattr(programs, "_compiled", {})
    monkeypatch.setattr(programs, "_awaited", {})
    held, seen = threading.Event(), []

    def slow(x):
        held.wait(20.0)
        return 2.0 * x

    def quick(x):
        seen.append(programs.compiling())
        return 3.0 * x

    first = programs.jit(ours(slow, "slow"), title="slow numbers")
    second = programs.jit(ours(quick, "quick"), title="quick numbers")
    first.prepare(X)
    assert programs.compiling() == ""
    second(X)
    assert seen[0] == "compiling quick numbers, 1 of 2"
    with ThreadPoolExecutor(1) as pool:
        waiting = pool.submit(first, X)
        while not programs.compiling():
            time.sleep(0.001)
        assert programs.compiling() == "compiling slow numbers, 2 of 2"
        held.set()
        np.testing.assert_array_equal(waiting.result(), 2.0 * X)
    assert programs.compiling() == ""


def test_a_prepared_program_can_call_another_prepared_program(folder, monkeypatch):
    """Waiting for the own thread would be a deadlock."""
    monkeypatch.setattr(configure, "processors", lambda: [None])  # one thread
    threads = programs.functools.cache(programs._background_threads.__wrapped__)
    monkeypatch.setattr(programs, "_background_threads", threads)
    begin, (inner, _) = threading.Event(), spied("inner")

    def function(x):
        assert begin.wait(60.0)
        return x + inner(X)["both"]

    outer = programs.jit(ours(function, "outer"))
    outer.prepare(X)
    inner.prepare(X)
    begin.set()
    np.testing.assert_allclose(outer(X), X + np.sin(2 * X) + 5.0, rtol=1e-15)


def test_an_error_of_the_function_is_raised_by_the_call(folder):
    """It is raised by the call, not by `prepare`, and by a second call again."""

    def function(x):
        raise OverflowError("too large")

    program = programs.jit(ours(function))
    program.prepare(X)
    for _ in range(2):
        with pytest.raises(OverflowError, match="too large"):
            program(X)


def test_every_dependence_of_a_program_changes_its_file(folder, monkeypatch):
    """Shapes, types, static arguments, versions, source code and settings of JAX each lead to another stored file."""

    def files(*args, **kwargs):
        program, _ = spied()
        program(*args, **kwargs)
        return count(folder)

    calls = [((X,), {}), ((X[:3],), {}), ((X.astype(np.float32),), {}), ((1.0,), {}), ((X, 1), {}),
             ((X,), {"kind": "other"})]  # fmt: skip
    assert [files(*args, **kwargs) for args, kwargs in calls] == [1, 2, 3, 4, 5, 6]
    assert files(jnp.asarray(X)) == 6  # the same for JAX
    with monkeypatch.context() as changed:
        changed.setattr(programs, "VERSIONS", ("0.0.1",))
        assert files(X) == 7
    with monkeypatch.context() as changed:
        changed.setattr(provenance, "code_checksum", lambda *packages: "edited")
        assert files(X) == 8
    for k, change in enumerate((jax.debug_nans(True), jax.default_matmul_precision("float32"))):
        with change:
            assert files(X) == 9 + k


def test_a_change_of_a_jax_setting_after_the_first_call_takes_effect(folder):
    """As with `jax.jit`: the program of the first call must not serve the second."""

    def function(x):
        return x * (3.0 if jax.config.jax_default_matmul_precision == "float32" else 2.0)  # pyright: ignore

    program = programs.jit(ours(function))
    assert float(program(1.0)) == 2.0
    with jax.default_matmul_precision("float32"):
        assert float(program(1.0)) == 3.0
    assert float(program(1.0)) == 2.0


@pytrees.pytree
@dataclass(frozen=True)
class _Law:
    """A law with a static field and a gain."""

    order: int = field(default=2, metadata={"static": True}, kw_only=True)
    gain: Any = 1.0


class _Other(_Law):
    """Another class with the same fields as `_Law`."""


class _Pair(NamedTuple):
    """A result with two parts."""

    law: Any
    rest: Any


for _kind in (_Law, _Other, _Pair):
    _kind.__module__ = "tuning.search.evaluate"
    setattr(importlib.import_module(_kind.__module__), _kind.__qualname__, _kind)
pytrees.pytree(_Other)


def test_two_classes_of_laws_with_the_same_numbers_have_different_programs(folder):
    def function(law):
        return law.gain * (3.0 if type(law) is _Other else 1.0)

    for _ in range(2):  # traced, then read
        program = programs.jit(ours(function))
        assert [float(program(law(gain=2.0))) for law in (_Law, _Other)] == [2.0, 6.0]
        assert float(program(_Law(gain=2.0, order=3))) == 2.0
        assert count(folder) == 3


def test_results_of_stored_programs_keep_their_structure(folder):
    def function(x):
        return _Pair(_Law(order=5, gain=x), {"b": [x, None], "a": (2.0 * x, _Other(gain=3.0 * x))})

    wanted, found = function(X), []
    for _ in range(2):  # traced, then read
        found.append(programs.jit(ours(function))(X))
        assert jax.tree.structure(found[-1]) == jax.tree.structure(wanted)
        for one, other in zip(jax.tree.leaves(found[-1]), jax.tree.leaves(wanted), strict=True):
            np.testing.assert_array_equal(one, other)
    assert count(folder) == 1


def test_a_result_can_be_an_argument_of_a_program_for_several_devices(folder):
    def function(x, devices):
        return montecarlo.map_over_devices(lambda part: 2.0 * part + x, jnp.arange(4.0), devices)

    one, two = spied()[0](1.0)["both"], programs.jit(ours(function, "several"), static_argnames="devices", batch=True)
    for results in (two(one, 2), two(two(one, 2)[0], 2)):
        assert len(results.devices()) == 2
    np.testing.assert_allclose(two(one, 2), 2.0 * np.arange(4.0) + np.sin(2.0) + 5.0, rtol=1e-15)
    assert count(folder) == 2


@pytest.mark.parametrize("damage", ["cut short", "empty", "of another program", "a bit"])
def test_a_stored_program_with_a_damaged_file_is_traced_again(folder, damage):
    program, _ = spied()
    program(X)
    (stored,) = folder.iterdir()
    content = stored.read_bytes()
    if damage == "cut short":
        stored.write_bytes(content[: len(content) // 2])
    elif damage == "empty":
        stored.write_bytes(b"")
    elif damage == "of another program":
        other, _ = spied("other", factor=3.0)
        other(X)
        (theirs,) = set(folder.iterdir()) - {stored}
        stored.write_bytes(theirs.read_bytes())
    else:
        stored.write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
    again, traced = spied()
    np.testing.assert_allclose(again(X)["both"], np.sin(2 * X) + 5.0, rtol=1e-15)
    assert len(traced) == 1
    assert stored.read_bytes() == content


def test_stored_programs_in_a_read_only_folder_are_used(folder, monkeypatch):
    """As in an image of a container that is mounted read-only."""

    def refusing(call):
        def refused(path, *args, **kwargs):
            if folder in path.parents:
                raise OSError(30, "Read-only file system")
            return call(path, *args, **kwargs)

        return refused

    spied()[0](X)
    for place, name in ((programs.os, "utime"), (programs.Path, "unlink"), (programs.Path, "write_bytes")):
        monkeypatch.setattr(place, name, refusing(getattr(place, name)))
    for name, traces in (("spied", 0), ("other", 1)):
        again, traced = spied(name)
        np.testing.assert_allclose(again(X)["both"], np.sin(2 * X) + 5.0, rtol=1e-15)
        assert len(traced) == traces
    assert count(folder) == 1


def test_a_program_that_cannot_be_identified_is_traced_and_not_stored(folder):
    """It has a function or class of the user, a tracer, keys of random numbers, or an array of another device."""

    def custom(x):
        return 2.0 * x

    np.testing.assert_array_equal(programs.jit(custom)(X), 2 * X)

    class Custom(NamedTuple):
        x: Any

    def of_custom(custom):
        return 2.0 * custom.x, custom

    np.testing.assert_array_equal(programs.jit(ours(of_custom, "of_custom"))(Custom(X))[0], 2 * X)
    np.testing.assert_array_equal(programs.jit(ours(lambda x: Custom(2.0 * x)))(X).x, 2 * X)
    drawn = programs.jit(ours(lambda key: jax.random.uniform(key)))(jax.random.key(3))
    assert drawn == jax.random.uniform(jax.random.key(3))
    program, _ = spied()
    np.testing.assert_allclose(jax.vmap(lambda x: program(x)["both"])(X), np.sin(2 * X) + 5.0, rtol=1e-15)
    np.testing.assert_allclose(jax.grad(lambda x: program(x)["both"])(0.3), 2 * np.cos(0.6), rtol=1e-14)
    assert not folder.exists()
    elsewhere = jax.device_put(X, jax.local_devices()[-1])
    assert program(elsewhere)["both"].devices() == {jax.local_devices()[-1]}


def test_the_least_recently_used_stored_programs_are_deleted(folder, monkeypatch):
    monkeypatch.setattr(programs, "MOST_STORED", 3)
    made = []
    for k in range(4):
        before = set(folder.iterdir()) if folder.exists() else set()
        spied(f"number_{k}")[0](X)
        (new,) = set(folder.iterdir()) - before
        made.append(new)
        os.utime(new, (1e9 + 10 * k, 1e9 + 10 * k))
        os.utime(made[0], (1e9 + 10 * k + 1, 1e9 + 10 * k + 1))  # used again and again
    assert set(folder.iterdir()) == {made[0], made[2], made[3]}


_SCRIPT = """
import os, sys
from ptsmc_jax.configure import configure
configure(devices=2, cache=sys.argv[1], keep_programs=True)
import jax, jax.numpy as jnp, numpy as np
from ptsmc_jax import programs
from ptsmc_jax.campaigns import montecarlo

compiled = []
jax.monitoring.register_event_listener(lambda event, **_: event.endswith("cache_misses") and compiled.append(1))
traced = []

def poles(a, scale):
    traced.append(1)
    values = jnp.linalg.eigvals(a)
    spread = montecarlo.map_over_devices(lambda x: jnp.sin(3.0 * x) * x + scale, jnp.arange(4.0), 2)
    return jnp.sort(jnp.abs(values)), spread

poles.__module__, poles.__qualname__ = "ptsmc_jax.theory.linear", "poles"
a = np.array([[0.5, 1.0], [-1.0, 0.5]])

begun = sys.argv[2] == "two" and os.fork()  # with what was imported, and nothing of JAX's that has started
found, spread = programs.jit(poles, batch=True)(a, 1.0)
np.testing.assert_allclose(found, np.sqrt([1.25, 1.25]), rtol=1e-12)
np.testing.assert_allclose(spread, np.sin(3.0 * np.arange(4)) * np.arange(4) + 1.0, rtol=1e-12)
if begun:
    assert os.waitpid(begun, 0)[1] == 0
print(len(traced), len(compiled))
"""


def test_processes_share_programs_with_lapack_and_several_devices_in_them(tmp_path):
    """Two at once trace and store; the third neither traces nor compiles."""

    def run(which):
        call = [sys.executable, "-c", _SCRIPT, str(tmp_path / "cache"), which]
        environment = dict(os.environ, PYTHONPATH=os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")]))
        done = subprocess.run(call, env=environment, capture_output=True, text=True, timeout=300, check=False)
        assert done.returncode == 0, done.stderr
        assert done.stderr == ""
        return done.stdout.split()

    assert run("two")[0] == "1"
    assert run("last") == ["0", "0"]
    assert count(tmp_path / "cache" / "programs") == 1


def test_every_program_is_a_function_of_its_module():
    """Stored programs are called by keywords and identified by name, so the function must not be wrapped."""
    found = 0
    for module in map(importlib.import_module, modules()):
        for program in [v for v in vars(module).values() if isinstance(v, programs.Program)]:
            home = sys.modules[program._function.__module__]
            named = getattr(home, program._function.__name__)
            assert named is program or named is program._function, program._function
            found += 1
    assert found > 20


def test_a_program_of_the_search_depends_on_the_files_of_the_library_too(folder, tmp_path, monkeypatch):
    """An edited file of `ptsmc_jax` changes the stored programs of `tuning` too, but not the other way round."""
    for name in programs.OURS:
        (tmp_path / name).mkdir()
    monkeypatch.setattr(provenance, "FOLDER", tmp_path)
    monkeypatch.setattr(provenance, "code_checksum", provenance.code_checksum.__wrapped__)
    library, search = (tmp_path / name / "part.py" for name in ("ptsmc_jax", "tuning"))

    def paths():
        found = []
        for package in ("ptsmc_jax", "tuning"):
            function = ours(lambda x: x)
            function.__module__ = f"{package}.part"
            found.append(programs.jit(function).path(X))
        return found

    first = paths()
    library.write_text("a = 1")
    second = paths()
    search.write_text("a = 1")
    third = paths()
    assert [a != b for a, b in zip(first, second, strict=True)] == [True, True]
    assert [a != b for a, b in zip(second, third, strict=True)] == [False, True]
