"""Tests of custom code in results, which runs only with `--trust`, and of its checksums."""

from typing import Any

import pytest

from ptsmc_jax.campaigns.store import RefusedError
from ptsmc_jax.scenario import custom, systems
from tuning.search import custom_parts


@pytest.mark.parametrize(("place", "inside"), [
    ("tuned.toml", True), ("scenarios/pd.toml", True), ("a/b/c/pd.toml", True), ("../mine.toml", False),
])  # fmt: skip
def test_folder_of_results_is_found_at_any_depth(tmp_path, place, inside):
    results = tmp_path / "out" / "compare-x"
    results.mkdir(parents=True)
    (results / "versions.json").write_text("{}")
    path = results / place
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("")
    assert custom_parts.find_results_folder(path) == (results if inside else None)
    link = tmp_path / "link.toml"
    link.symlink_to(path)
    assert custom_parts.find_results_folder(link) == (results if inside else None)  # the link is resolved


def test_a_symbolic_link_in_results_to_an_outside_file_belongs_to_the_results(tmp_path):
    results, mine = tmp_path / "results", tmp_path / "mine" / "deep" / "mine.toml"
    for place in (results, mine.parent):
        place.mkdir(parents=True)
    (results / "versions.json").write_text("{}")
    mine.write_text("")
    (results / "tuned.toml").symlink_to(mine)
    assert custom_parts.find_results_folder(results / "tuned.toml") == results
    assert custom_parts.find_results_folder(mine) is None


def test_a_file_named_by_several_keys_is_reported_once(tmp_path, capsys):
    law = tmp_path / "mine.py"
    law.write_text("")
    programs: Any = dict.fromkeys(("controller.code", "observer.code", "reference.code"), f"{law}:Mine")
    with pytest.raises(
        RefusedError, match=rf"custom code, {law} \(controller.code, observer.code, reference.code\), which"
    ):
        custom_parts.allow_results(programs, tmp_path, {}, trusted=False)
    checksums = {custom.checksum_name(key): systems.checksum(where) for key, where in programs.items()}
    custom_parts.allow_results(programs, tmp_path, checksums, trusted=True)
    keys = "controller.code, observer.code and reference.code"
    assert capsys.readouterr().err == f"ptsmc: runs {law}, which {keys} of {tmp_path} name\n"


def test_a_program_without_a_checksum_in_the_results_is_reported(tmp_path, capsys):
    law, other = tmp_path / "mine.py", tmp_path / "other.py"
    law.write_text("")
    other.write_text("")
    programs = {"controller.code": f"{law}:Mine", "observer.code": f"{other}:Mine"}
    made = {"controller_sha256": systems.checksum(f"{law}:Mine")}
    assert custom_parts.check_unchanged(programs, tmp_path, made) == ["observer.code"]
    custom_parts.allow_results(programs, tmp_path, made, trusted=True)
    (said,) = [line for line in capsys.readouterr().err.splitlines() if "no checksum" in line]
    assert str(other) in said
    assert str(law) not in said


def test_checksum_covers_imported_files_in_the_same_folder(tmp_path):
    """A campaign could otherwise resume after a change of an imported file, and mix rows of both versions."""
    (tmp_path / "package").mkdir()
    files = {"mine.py": "import helper\n", "helper.py": "from package.inner import f\n", "package/inner.py": "f = 1\n"}
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    (tmp_path / "other.py").write_text("")
    where = f"{tmp_path}/mine.py:Mine"
    known = [systems.checksum(where)]
    for name, text in files.items():
        (tmp_path / name).write_text(f"{text}# changed\n")
        known.append(systems.checksum(where))
    assert len(set(known)) == 4
    (tmp_path / "other.py").write_text("x = 1\n")
    assert systems.checksum(where) == known[-1]
    with pytest.raises(RefusedError, match=r"was made with another controller\.code"):
        custom_parts.check_unchanged({"controller.code": where}, tmp_path, {"controller_sha256": known[0]})
