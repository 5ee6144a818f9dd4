"""Programs that runs of the tests leave each other: what is patched has a folder of its own, or none."""

import jax
import jaxtyping
import pytest

from ptsmc_jax import configure
from ptsmc_jax.batching import kernel
from ptsmc_jax.theory import linear
from tests import kept


def where():
    kept.keep()
    return configure.programs


def test_what_is_patched_is_kept_by_itself():
    usual = where()
    assert usual is not None
    assert usual.parent.parent.samefile(jax.config.values["jax_compilation_cache_dir"])
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
            assert where() is None
        assert where() is None  # the outer one still is
    assert where() is not None


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
