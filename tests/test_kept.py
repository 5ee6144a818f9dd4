"""Programs that runs of the tests leave each other: what is patched has a folder of its own, or none."""

import functools
import importlib
import re

import jax
import jaxtyping
import numpy as np
import pytest

from ptsmc_jax import configure, programs
from ptsmc_jax.batching import kernel
from ptsmc_jax.numerics import attitude
from ptsmc_jax.numerics.pytrees import vector
from ptsmc_jax.signals import disturbances
from ptsmc_jax.theory import linear
from tests import kept
from tests.tree import modules


def doubled():
    """A function as if it stood in one of our files, and what its traces are noted in."""
    traced = []

    def function(x):
        traced.append("traced")
        return 2.0 * x

    function.__module__, function.__qualname__, function.__name__ = "ptsmc_jax.numerics.attitude", "looked", "looked"
    return traced, function


def where():
    kept.keep()
    return configure.programs


def test_what_is_patched_is_kept_by_itself():
    usual = where()
    assert usual is not None
    assert usual.parents[2].samefile(jax.config.values["jax_compilation_cache_dir"])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(linear, "TOGETHER", 4)
        four = where()
        patch.setattr(linear, "TOGETHER", 5)
        assert len({usual, four, where()}) == 3
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("ptsmc_jax.theory.linear.TOGETHER", 4)  # by its name
        assert where() == four
    assert where() == usual


@pytest.mark.parametrize(("target", "name"), [(kernel, "scan"), (kernel._Rows, "__init__"), (jax.lax, "scan")])
def test_nothing_is_kept_where_code_is_patched(target, name):
    with pytest.MonkeyPatch.context() as outer:
        outer.setattr(target, name, lambda *_: None)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(linear, "TOGETHER", 4)
            assert where() == kept.NOWHERE
        assert where() == kept.NOWHERE  # the outer one still is
    assert where() != kept.NOWHERE


def test_what_no_program_hangs_on_is_not_looked_at(monkeypatch):
    usual = where()
    monkeypatch.setattr("tuning.search.worst.SCREENED", 3)
    monkeypatch.setattr("sys.argv", ["ptsmc"])
    assert where() == usual


def test_programs_without_checks_of_shapes_lie_apart():
    checked = where()
    jaxtyping.config.update("jaxtyping_disable", True)
    try:
        unchecked = where()
        assert unchecked is not None
        assert unchecked != checked
    finally:
        jaxtyping.config.update("jaxtyping_disable", False)


def test_a_program_made_without_looking_is_traced_before_a_test_that_looks_takes_it(tmp_path, monkeypatch):
    """Traced anew, not compiled; the other way round it is taken as it is."""
    compiled, (traced, function) = programs.Program._compiled, doubled()
    monkeypatch.setattr(programs.Program, "_compiled", lambda *how: traced.append("compiled") or compiled(*how))
    for name, wanted in (
        ("unchecked", ["compiled", "traced"]),
        ("checked", ["traced"]),
        ("checked", []),
        ("unchecked", []),
    ):
        monkeypatch.setattr(configure, "programs", tmp_path / name)
        np.testing.assert_array_equal(programs.jit(function)(np.arange(3.0)), [0.0, 2.0, 4.0])
        assert traced == wanted, name
        traced.clear()


def test_nothing_is_kept_once_a_file_was_edited(tmp_path, monkeypatch):
    """Code that was imported before goes with no digest that is taken after."""
    source = tmp_path / "source.py"
    source.touch()
    monkeypatch.setattr(kept, "SOURCES", [source])
    at = source.stat().st_mtime
    assert [kept._edited(at - 1.0), kept._edited(at + 1.0)] == [True, False]
    source.unlink()
    assert kept._edited(at + 1.0)
    np.testing.assert_array_equal(programs.jit(doubled()[1])(np.arange(3.0)), [0.0, 2.0, 4.0])
    assert configure.programs == kept.NOWHERE


def test_a_function_of_a_test_hangs_on_the_tests_and_on_our_code():
    *said, code = programs.jit(where)._origin()
    assert said[:2] == ["tests.test_kept", "where"]
    assert code == kept._code()
    for package in ("ptsmc_jax", "tuning", "tests"):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(kept, "modules", lambda *asked, out=package: modules(*(one for one in asked if one != out)))
            assert kept._code.__wrapped__() != code


def scaled(by):
    return lambda x, power=1: by * x**power


def test_functions_of_tests_are_told_apart_by_where_they_stand_and_by_what_they_remember():
    two, *others = map(programs._plain, (scaled(2.0), scaled(3.0), scaled(np.ones(2)), scaled(np.ones((2, 1)))))
    assert programs._plain(scaled(2.0)) == two
    others += map(programs._plain, (lambda x, power=1: 2.0 * x**power, lambda x, power=2: 2.0 * x**power))
    others += map(programs._plain, (scaled(scaled(2.0)), scaled(jax.numpy.sin), scaled(jax.numpy.cos), scaled(where)))
    acting = [disturbances.Constant(vector([size])) for size in (1.0, 2.0)]
    others += map(programs._plain, (scaled(attitude.rotate), *map(scaled, acting), scaled(acting[0].__call__)))
    for k, one in enumerate(others):
        assert one not in (two, *others[:k])


def test_what_remembers_something_that_cannot_be_told_is_not_kept():
    class Local:
        pass

    @functools.wraps(attitude.rotate)
    def turned(q, y):
        return attitude.rotate(q, 2.0 * y)

    made = jax.grad(scaled(2.0)), jax.jit(scaled(2.0)), turned, eval("lambda x: x", {})
    for one in (object(), Local(), Local, np.random.default_rng(0), *made):
        with pytest.raises(programs._UnknownError):
            programs._plain(scaled(one))
    with pytest.raises(programs._UnknownError):
        programs.jit(disturbances.Constant(vector([1.0])).__call__)._origin()  # hangs on its number


def test_what_is_said_to_be_seen_by_no_program_is_there():
    """A name that is gone would be let through for whatever is called so next."""
    found = {name.rpartition(".")[2]: importlib.import_module(name) for name in modules()}
    for named in kept.OUTSIDE:
        module, _, attribute = named.partition(".")
        owners = [found[module], *(v for v in vars(found[module]).values() if isinstance(v, type))]
        assert any(hasattr(owner, attribute) for owner in owners), named
    for name, path in modules().items():
        if name.startswith(kept.HOST):
            assert not re.search(r"\b(programs|jax)\.jit\b", path.read_text()), name
