import csv
import json
import math
import os
import re
import sys
import tomllib

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ptsmc_jax.campaigns import store
from ptsmc_jax.scenario import from_tables, parsing, read
from tests.helpers import tree


def test_writing_into_an_existing_folder_replaces_only_what_is_written(tmp_path):
    (tmp_path / "out" / "figures").mkdir(parents=True)
    (tmp_path / "out" / "mine.txt").write_text("keep")
    (tmp_path / "out" / "figures" / "a.png").write_text("old")

    def fill(folder):
        (folder / "figures").mkdir()
        (folder / "figures" / "a.png").write_text("new")

    store.write_folder(tmp_path / "out", fill)
    assert (tmp_path / "out" / "mine.txt").read_text() == "keep"
    assert (tmp_path / "out" / "figures" / "a.png").read_text() == "new"


def test_files_of_an_earlier_result_are_removed_and_the_summary_is_written_last(tmp_path, monkeypatch):
    """A page shows all figures of a folder, so old ones must go. Without a summary, a result is not complete.

    Files of the user are kept, also if they have the name of a result file.
    """
    moved, replace = [], os.replace
    monkeypatch.setattr(os, "replace", lambda a, b: (moved.append(b.name), replace(a, b)))

    def result(summary, *names):
        def fill(folder):
            (folder / "figures").mkdir()
            for name in names:
                (folder / name).write_bytes(store.MADE_OF_RESULTS["figures/*.png"] + summary.encode())
            (folder / "summary.json").write_text(summary)

        return fill

    out, others = tmp_path / "out", ("mine.txt", "figures/mine.csv", "figures/mine.png")
    made = [name for name in store.MADE_OF_RESULTS if "*" not in name]
    store.write_folder(out, result("first", "tuned.toml", "figures/a.png", "figures/b.png"))
    for name in others:
        (out / name).write_text("kept")
    for name in made:
        (out / name).write_bytes(store.MADE_OF_RESULTS[name])
    before = tree(out)
    store.write_folder(out, result("first", "tuned.toml"))  # same result, without figures
    assert tree(out) == before
    moved.clear()
    store.write_folder(out, result("second", "versions.json", "tuned.toml", "figures/b.png"))
    assert set(tree(out)) == {
        "mine.txt", "figures/mine.csv", "figures/mine.png", "figures/b.png", "tuned.toml", "versions.json",
        "summary.json",
    }  # fmt: skip
    assert (moved[0], moved[-1]) == ("versions.json", "summary.json")
    for name in made:
        (out / name).write_text("a user's own")
    store.write_folder(out, result("third"))
    assert [(out / name).read_text() for name in made] == ["a user's own"] * 3
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "report.html").write_bytes(store.MADE_OF_RESULTS["report.html"])  # the folder has no result
    store.write_folder(tmp_path / "mine", result("third"))
    assert (tmp_path / "mine" / "report.html").exists()


@pytest.mark.parametrize("changed", ["versions.json", "scenario.toml"])
def test_result_without_a_summary_replaces_an_earlier_result(tmp_path, changed):
    """A map has no summary. Its page would show the figures of the earlier result."""

    def a_map(folder, other=""):
        made = {"command": "map", "command_line": str(folder), **({"seed": 1} if other == "versions.json" else {})}
        store.write_json(folder / "versions.json", made)
        (folder / "scenario.toml").write_text("# other" if other == "scenario.toml" else "")

    out = tmp_path / "out"
    (out / "figures").mkdir(parents=True)
    (out / "figures" / "map.png").write_bytes(store.MADE_OF_RESULTS["figures/*.png"])
    a_map(out)
    store.write_folder(out, a_map)  # same result from another command line, without figures
    assert (out / "figures" / "map.png").exists()
    (out / "summary.json").write_text("{}")
    store.write_folder(out, lambda folder: a_map(folder, changed))
    assert not (out / "figures" / "map.png").exists()
    assert not (out / "summary.json").exists()


TOLD = {"command": "tune", "seed": 5}


def test_earlier_result_is_found_only_for_the_same_scenario_seed_and_command(tmp_path):
    """Otherwise `read_previous_summary` returns None."""
    tables, folder = {"controller": {"eta": 3.0, "gain": [1.0, 2.0]}}, tmp_path / "out"
    finished(folder, tables)
    assert store.read_previous_summary(folder, tables, TOLD) == {"status": "met"}
    assert store.read_previous_summary(folder, tables, {**TOLD, "seed": 6}) is None
    assert store.read_previous_summary(folder, tables, {**TOLD, "command": "simulate"}) is None
    for other in (
        {},
        {"controller": {"eta": 3.0000000000000004, "gain": [1.0, 2.0]}},
        {"controller": {**tables["controller"], "delta": 0.05}},
        {**tables, "loop": {"t_end": 40.0}},
    ):
        assert store.read_previous_summary(folder, other, TOLD) is None
    assert store.read_previous_summary(tmp_path / "none", tables, TOLD) is None


def test_an_unfinished_run_with_other_sensors_is_refused(tmp_path):
    """The message names the first key with another value."""
    sensors = [{"kind": "star_tracker", "period": 0.25}, {"kind": "gyro"}]
    tables, folder = {"loop": {"period": 0.125}, "sensors": sensors}, tmp_path / "out"
    store.begin_run(folder, tables, TOLD, fresh=True)
    assert store.has_unfinished_run(folder, tables, TOLD)
    slower = {**tables, "sensors": [{**sensors[0], "period": 0.5}, sensors[1]]}
    with pytest.raises(store.RefusedError, match=re.escape("sensors[0].period is 0.25 there, and 0.5 here")):
        store.has_unfinished_run(folder, slower, TOLD)
    for other in (sensors[:1], [], {"kind": "custom"}):
        with pytest.raises(store.RefusedError, match="another scenario: sensors"):
            store.has_unfinished_run(folder, {**tables, "sensors": other}, TOLD)


def fill(folder):
    """Write figures/a.png and summary.json, both with the text "new", into a folder."""
    (folder / "figures").mkdir()
    (folder / "figures" / "a.png").write_text("new")
    (folder / "summary.json").write_text("new")


@pytest.mark.parametrize("before", ["nothing", "an empty folder", "a folder below new ones"])
@pytest.mark.parametrize(("mask", "mode"), [(0o022, 0o755), (0o002, 0o775), (0o077, 0o700)])
def test_write_creates_only_the_folder_with_the_mode_of_the_umask(tmp_path, before, mask, mode):
    """The mode of a temporary folder would lock others out."""
    folder, earlier = tmp_path / ("a/b/out" if before == "a folder below new ones" else "out"), os.umask(mask)
    try:
        if before == "an empty folder":
            folder.mkdir()
        store.write_folder(folder, fill)
    finally:
        os.umask(earlier)
    assert tree(folder) == {"figures/a.png": b"new", "summary.json": b"new"}
    assert [p.name for p in folder.parent.iterdir()] == ["out"]
    assert folder.stat().st_mode & 0o777 == mode


def test_links_and_mount_points_are_written_on_their_own_disk(tmp_path, monkeypatch):
    """Files are written beside their destination, because a file can only be moved within one disk."""
    made, mounted = [], tmp_path / "mounted"

    def note(folder):
        made.append(folder.parent)
        fill(folder)

    for name in ("links", "elsewhere", "mounted"):
        (tmp_path / name).mkdir()
    (tmp_path / "links" / "out").symlink_to(tmp_path / "elsewhere" / "out")
    for _ in range(2):  # the target of the link exists only the second time
        store.write_folder(tmp_path / "links" / "out", note)
    monkeypatch.setattr(type(tmp_path), "is_mount", lambda path: path == mounted)
    store.write_folder(mounted, note)
    assert made == [tmp_path / "elsewhere", tmp_path / "elsewhere", mounted]
    written = {"figures/a.png": b"new", "summary.json": b"new"}
    assert tree(tmp_path / "elsewhere" / "out") == tree(mounted) == written
    assert len(list(mounted.iterdir())) == 2


def test_folder_is_written_if_its_parent_is_not_writable(tmp_path, monkeypatch):
    (tmp_path / "out").mkdir()
    monkeypatch.setattr(store.os, "access", lambda path, _: path == tmp_path / "out")
    store.check_folder(tmp_path / "out", force=False)
    store.write_folder(tmp_path / "out", lambda folder: fill(folder) if folder.parent == tmp_path / "out" else None)
    assert tree(tmp_path / "out") == {"figures/a.png": b"new", "summary.json": b"new"}
    refused = pytest.raises(
        store.RefusedError, match=f"--out is .*new, but nothing may be written into {tmp_path}; allowed"
    )
    with refused:
        store.check_folder(tmp_path / "new", force=False)


def test_failed_write_of_a_file_keeps_the_existing_file(tmp_path):
    def rows():
        yield [1.0]
        raise OSError(28, "No space left on device")

    (tmp_path / "a.csv").write_text("before")
    with pytest.raises(OSError, match="No space left"):
        store.write_csv(tmp_path / "a.csv", ["x"], rows())
    with pytest.raises(FileNotFoundError, match=r"'.*/none/b.json'"):
        store.write_json(tmp_path / "none" / "b.json", {})
    store.write_text(tmp_path / ("a" * 250), "as long a name as there is")
    with pytest.raises(OSError, match=r"File name too long: '.*/b{300}'"):
        store.write_text(tmp_path / ("b" * 300), "")
    assert tree(tmp_path) == {"a.csv": b"before", "a" * 250: b"as long a name as there is"}


def test_file_names_in_a_text_that_are_not_unicode_are_written_with_escapes(tmp_path):
    store.write_text(tmp_path / "a.txt", os.fsdecode(b"gr\xf6\xdfe \xce\xb1"))
    assert (tmp_path / "a.txt").read_text(encoding="utf-8") == "gr\\udcf6\\udcdfe \u03b1"


def test_run_that_cannot_begin_on_a_full_disk_keeps_earlier_results_and_leaves_no_new_files(tmp_path, monkeypatch):
    """The run was started with `fresh`, which would replace the earlier results."""
    tables = {"controller": {"eta": 3.0}}
    finished(tmp_path / "old", tables)
    before = tree(tmp_path)

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(store, "write_json", full)  # after scenario.toml
    for name in ("old", "new"):
        with pytest.raises(OSError, match="No space left"):
            store.begin_run(tmp_path / name, tables, TOLD, fresh=True)
    assert tree(tmp_path) == before
    assert [path.name for path in tmp_path.iterdir()] == ["old"]


@pytest.mark.parametrize("stop", [RuntimeError, KeyboardInterrupt, OSError])
def test_interrupted_write_of_a_result_folder_changes_nothing(tmp_path, stop):
    def stopped(folder):
        fill(folder)
        raise stop

    (tmp_path / "old").mkdir()
    (tmp_path / "old" / "summary.json").write_text("before")
    for name in ("new", "old"):
        with pytest.raises(stop):
            store.write_folder(tmp_path / name, stopped)
    assert tree(tmp_path) == {"old/summary.json": b"before"}
    assert [p.name for p in tmp_path.iterdir()] == ["old"]


def test_results_are_allowed_in_new_and_empty_folders_and_with_force_in_others(tmp_path):
    """The command tests check the sentences of refused folders."""
    (tmp_path / "empty").mkdir()
    for name in ("new", "empty"):
        store.check_folder(tmp_path / name, force=False)
    store.check_folder(tmp_path, force=True)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("kind", [float, np.float64, np.float32, np.array, jnp.asarray, lambda x: np.array([[x]])])
def test_json_has_null_for_every_kind_of_nan(tmp_path, bad, kind):
    store.write_json(tmp_path / "a.json", {"nested": [{"value": kind(bad)}, (kind(bad), kind(1.5))]})
    text = (tmp_path / "a.json").read_text()
    assert "NaN" not in text
    assert "Infinity" not in text
    plain = json.loads(text)
    flat = np.array([plain["nested"][0]["value"], *plain["nested"][1]], dtype=object).ravel().tolist()
    assert [np.ravel(value).tolist() for value in flat] == [[None], [None], [1.5]]


ANY_FLOAT = st.floats(allow_nan=False)


@settings(max_examples=100, deadline=None, derandomize=True, database=None)
@given(st.lists(st.tuples(ANY_FLOAT, ANY_FLOAT), max_size=5))
def test_csv_and_json_numbers_read_back_to_the_last_bit(tmp_path_factory, rows):
    folder = tmp_path_factory.getbasetemp()
    for body in (rows, [(np.float64(a), np.asarray(b)) for a, b in rows]):
        store.write_csv(folder / "a.csv", ["t", "x"], body)
        with (folder / "a.csv").open(newline="") as file:
            header, *read = csv.reader(file)
        assert header == ["t", "x"]
        assert [tuple(map(float, row)) for row in read] == rows
    finite = [value for row in rows for value in row if math.isfinite(value)]
    store.write_json(folder / "a.json", finite)
    assert json.loads((folder / "a.json").read_text()) == finite


TEXT = st.text(st.characters(exclude_categories=["Cs"]), max_size=9)
SCALAR = st.one_of(st.booleans(), st.integers(-(2**63), 2**63 - 1), st.floats(allow_nan=False), TEXT)
ARRAY = st.recursive(st.lists(SCALAR, max_size=4), lambda inner: st.lists(inner, max_size=3), max_leaves=6)
TABLES = st.dictionaries(TEXT, st.one_of(SCALAR, ARRAY, st.dictionaries(TEXT, st.one_of(SCALAR, ARRAY), max_size=3)))


@settings(max_examples=200, deadline=None, derandomize=True, database=None)
@given(TABLES)
def test_toml_tables_are_read_back_exactly(tmp_path_factory, tables):
    path = tmp_path_factory.getbasetemp() / "a.toml"
    store.write_toml(path, tables)
    read = tomllib.loads(path.read_text(encoding="utf-8"))
    # compared as text, which distinguishes 1, 1.0 and true
    assert json.dumps(read, sort_keys=True) == json.dumps(tables, sort_keys=True)


def test_a_written_scenario_file_has_the_units_of_its_numbers_in_comments(tmp_path):
    """Numbers without a unit have no comment, and the file is read back as the same scenario."""
    tracker = {"kind": "star_tracker", "noise_across": "8 arcsec", "noise_about": "40 arcsec"}
    raw = {
        "disturbance": {"kind": "sum", "terms": [{"kind": "constant"}, {"kind": "random_walk"}]},
        "observer": {"kind": "finite_time"},
        "loop": {"mode": "sampled"},
        "sensors": [tracker, {"kind": "gyro", "rate_noise_density": "0.1 deg/sqrt(h)"}],
        "dispersion": {"rate": {"kind": "normal", "std": "1 deg/s"}},
        "requirements": {"hold_angle": "0.5 deg", "peak_torque": {"limit": "0.5 N m", "quantile": 0.9}},
        "tune": {},
    }
    made = from_tables(raw)
    store.write_toml(tmp_path / "s.toml", parsing.dump(made))
    lines = (tmp_path / "s.toml").read_text().splitlines()
    shown = [line for line in lines if line.startswith(("gain ", "density", "rate_noise", "std", "limit", "inertia"))]
    assert [line.partition("  # ")[2] for line in shown] == [
        "kg m^2", "N m/sqrt(s)", "N m/s", "rad/s/sqrt(Hz)", "rad/s", "N m",
    ]  # fmt: skip
    assert "eta = 3.0" in lines
    assert next(line for line in lines if line.startswith("hold_angle")).endswith("  # rad")
    assert read(tmp_path / "s.toml") == made


def finished(folder, tables):
    """Create the result folder of a finished search with the status "met" and these tables of a scenario."""
    folder.mkdir()
    store.write_toml(folder / "scenario.toml", tables)
    store.write_json(folder / "versions.json", store.versions("tune", 5))
    store.write_json(folder / "summary.json", {"status": "met"})


@pytest.mark.parametrize("name", ["scenario.toml", "versions.json", "summary.json"])
@pytest.mark.parametrize("content", [None, "", "{", "\x00", "[]", "{}"])
def test_folder_with_a_missing_or_broken_file_has_no_earlier_result(tmp_path, name, content):
    """`read_previous_summary` then returns None."""
    tables = {"controller": {"eta": 3.0, "bounds": {"eta": (2.5, 3.5)}}}
    finished(tmp_path / "out", tables)
    assert store.read_previous_summary(tmp_path / "out", tables, TOLD) == {"status": "met"}
    (tmp_path / "out" / name).unlink() if content is None else (tmp_path / "out" / name).write_text(content)
    assert store.read_previous_summary(tmp_path / "out", tables, TOLD) is None


def test_versions_describe_command_code_and_platform(monkeypatch):
    monkeypatch.setattr(sys, "argv", ["/usr/bin/ptsmc", "simulate", "my file.toml", "--trial", "3"])
    made = store.versions("simulate", 7, trial=3)
    assert made["command_line"] == "ptsmc simulate 'my file.toml' --trial 3"
    assert re.fullmatch("[0-9a-f]{16}", made["code_checksum"])
    assert (made["command"], made["seed"], made["trial"]) == ("simulate", 7, 3)
    assert all(
        made[name].split(".")[0].isdigit() for name in ("python", "ptsmc-jax", "jax", "jaxlib", "numpy", "scipy")
    )
    assert made["platform"]
    assert made["machine"]


def test_unfinished_run_resumes_only_with_the_same_command(tmp_path):
    """Another subcommand, seed, scenario or version is refused with the difference. Another command line is accepted.

    A fresh run replaces journal and summary. A finished run is not resumed.
    """
    tables, folder = {"controller": {"eta": 3.0}}, tmp_path / "new"
    assert not store.has_unfinished_run(folder, tables, TOLD)
    journal = store.begin_run(folder, tables, TOLD, fresh=True)
    journal.write_bytes(b"kept")
    assert store.has_unfinished_run(folder, tables, TOLD)
    for other, asked, said in (
        (tables, {**TOLD, "seed": 6}, "a run with seed 5, not 6"),
        (tables, {**TOLD, "command": "pareto"}, "a run with command tune, not pareto"),
        ({"controller": {"eta": 3.1}}, TOLD, "eta is 3.0 there, and 3.1 here"),
    ):
        with pytest.raises(store.RefusedError, match=said):
            store.has_unfinished_run(folder, other, asked)
    assert store.read_previous_summary(folder, tables, TOLD) is None
    assert store.begin_run(folder, tables, TOLD, fresh=False).read_bytes() == b"kept"
    (folder / "summary.json").write_text('{"status": "interrupted"}')
    assert store.read_previous_summary(folder, tables, TOLD) == {"status": "interrupted"}
    assert store.begin_run(folder, tables, TOLD, fresh=False)
    assert (folder / "summary.json").exists()
    assert store.begin_run(folder, tables, TOLD, fresh=True).read_bytes() == b""
    assert not (folder / "summary.json").exists()  # the summary of another run must not remain
    made = json.loads((folder / "versions.json").read_text())
    for name, said in (("jax", "a run with jax other"), ("code_checksum", "another version of the source code")):
        (folder / "versions.json").write_text(json.dumps({**made, name: "other"}))
        with pytest.raises(store.RefusedError, match=said):  # other versions may have other rounding errors
            store.has_unfinished_run(folder, tables, TOLD)
    (folder / "versions.json").write_text(json.dumps({**made, "command_line": "other"}))
    assert store.has_unfinished_run(folder, tables, TOLD)
    with pytest.raises(store.RefusedError):
        store.check_folder(folder, force=False)
    store.end_run(folder)
    assert not store.has_unfinished_run(folder, tables, TOLD)
