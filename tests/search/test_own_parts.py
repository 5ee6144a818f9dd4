"""Which results a scenario file lies in, whose programs are run with trust only."""

from typing import Any

import pytest

from ptsmc_jax.campaigns.store import RefusedError
from tuning.search import own_parts


@pytest.mark.parametrize(("place", "inside"), [
    ("tuned.toml", True), ("scenarios/pd.toml", True), ("figures/old/pd.toml", False), ("../mine.toml", False),
])  # fmt: skip
def test_a_scenario_lies_in_results_or_in_a_folder_of_theirs(tmp_path, place, inside):
    results = tmp_path / "out" / "compare-x"
    results.mkdir(parents=True)
    (results / "versions.json").write_text("{}")
    path = results / place
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("")
    assert own_parts.results_of(path) == (results if inside else None)
    link = tmp_path / "link.toml"
    link.symlink_to(path)
    assert own_parts.results_of(link) == (results if inside else None)  # to where it leads


def test_a_link_among_results_to_a_file_elsewhere_counts_as_one_of_theirs(tmp_path):
    results, mine = tmp_path / "results", tmp_path / "mine" / "deep" / "mine.toml"
    for place in (results, mine.parent):
        place.mkdir(parents=True)
    (results / "versions.json").write_text("{}")
    mine.write_text("")
    (results / "tuned.toml").symlink_to(mine)
    assert own_parts.results_of(results / "tuned.toml") == results
    assert own_parts.results_of(mine) is None


def test_a_file_that_several_keys_name_is_told_of_once(tmp_path, capsys):
    law = tmp_path / "mine.py"
    law.write_text("")
    programs: Any = dict.fromkeys(("controller.code", "observer.code", "reference.code"), f"{law}:Mine")
    with pytest.raises(RefusedError, match=rf"own, {law} \(controller.code, observer.code, reference.code\), which"):
        own_parts.allow(programs, tmp_path, {}, trusted=False)
    own_parts.allow(programs, tmp_path, {}, trusted=True)
    keys = "controller.code, observer.code and reference.code"
    assert capsys.readouterr().err == f"ptsmc: runs {law}, which {keys} of {tmp_path} name\n"
