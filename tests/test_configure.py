"""Compiler options are tried out before they are used; what is refused is left out with a warning."""

import json

import pytest

from ptsmc_jax import configure as setup

GOOD = setup._OPTIONS


@pytest.fixture
def tried(monkeypatch):
    """Which sets of options were tried; those with "bad" in a name are refused."""
    seen = []

    def try_out(options):
        seen.append(options)
        return not any("bad" in option for option in options)

    monkeypatch.setattr(setup, "_tried", try_out)
    return seen


def test_options_are_written_as_xla_reads_them():
    assert setup._flags(("a=1", "--b=2", "-c=3")) == "--xla_backend_extra_options=a=1,-c=3 --b=2"
    assert setup._flags(()) == ""


def test_the_verdict_is_kept_and_not_asked_for_again(tried, tmp_path):
    assert setup._accepted(tmp_path) == GOOD
    assert setup._accepted(tmp_path) == GOOD
    assert len(tried) == 1
    (kept,) = tmp_path.glob("options-*.json")
    for text in ("", "[]", json.dumps({"tried": ["other"], "accepted": []})):  # cut short, foreign, of another version
        kept.write_text(text)
        assert setup._accepted(tmp_path) == GOOD
    assert len(tried) == 4


def test_refused_options_are_left_out_with_a_warning(tried, tmp_path, monkeypatch):
    monkeypatch.setattr(setup, "_OPTIONS", (*GOOD[:2], "bad=1", GOOD[3]))
    with pytest.warns(RuntimeWarning, match="refuses bad=1: runs will be slower"):
        assert setup._accepted(tmp_path) == (*GOOD[:2], GOOD[3])


def test_options_that_only_fail_together_are_all_left_out(monkeypatch):
    monkeypatch.setattr(setup, "_tried", lambda options: len(options) == 1)
    with pytest.warns(RuntimeWarning, match=f"refuses {GOOD[0]}, {GOOD[1]}"):
        assert setup._accepted(None) == ()


def test_a_cache_that_cannot_be_written_is_none(tried, tmp_path):
    (tmp_path / "file").write_text("")
    assert setup._accepted(tmp_path / "file") == GOOD


def test_the_trial_run_accepts_these_options_and_refuses_unknown_ones():
    """In processes of their own, as a user's first call: an unknown flag ends the process, wrong numbers too."""
    assert setup._tried(GOOD)
    assert not setup._tried((*GOOD, "--xla_no_such_flag=true"))


def test_the_trial_run_refuses_other_numbers(monkeypatch):
    monkeypatch.setattr(setup, "_TRIAL", setup._TRIAL.replace("x, 100))(jnp", "1.000001 * x, 100))(jnp"))
    assert not setup._tried(())
