"""Part files with the trials of a campaign: order, overlaps, damage and keys."""

import os
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from ptsmc_jax.campaigns import campaign, rows

KEY = rows.campaign_key({"loop": {"period": 0.1}}, {"seed": 1})


def frame(first, count):
    """Return a data frame of `count` successive trials with the columns trial and x."""
    return pl.DataFrame({"trial": np.arange(first, first + count, dtype=np.uint32), "x": np.arange(count) / 7.0})


@pytest.fixture
def kept(tmp_path):
    """Return a `rows.Rows`, the empty store of a campaign's rows, in a new folder."""
    return rows.Rows(tmp_path / "trials", KEY)


def test_part_files_of_a_campaign_are_read_in_the_order_of_their_trials(kept):
    for first in (100, 0, 50):
        kept.write(first, frame(first, 50))
    parts, broken = kept.parts()
    assert broken == []
    assert [(part.first, part.count, part.end) for part in parts] == [(0, 50, 50), (50, 50, 100), (100, 50, 150)]
    assert rows.read(parts)["trial"].to_list() == list(range(150))
    assert rows.read(parts, ["x"]).columns == ["x"]
    assert rows.read(parts)["x"].to_list() == [k / 7.0 for k in range(50)] * 3  # to the last digit


@pytest.mark.parametrize("harm", ["flip", "cut", "empty", "renamed", "foreign", "longer"])
def test_damaged_part_file_of_a_campaign_is_listed_as_broken(kept, harm):
    """A file with the name of other trials or the key of another campaign is broken, too."""
    whole, harmed = kept.write(0, frame(0, 50)), kept.write(50, frame(50, 50))
    content = bytearray(harmed.path.read_bytes())
    if harm == "flip":
        content[len(content) // 2] ^= 1
    changed = {"cut": content[:-1], "empty": b"", "longer": content + b"\0"}.get(harm, content)
    harmed.path.write_bytes(bytes(changed))
    if harm == "renamed":  # the name is that of other trials
        harmed.path.rename(harmed.path.with_name("0000000060-0000000109" + harmed.path.name[21:]))
    if harm == "foreign":
        harmed.path.unlink()
        other = rows.Rows(kept.folder, rows.campaign_key({"loop": {"period": 0.1}}, {"seed": 2}))
        other.write(50, frame(50, 50))
    parts, broken = kept.parts()
    assert parts == [whole]
    assert len(broken) == 1


def test_a_part_file_of_a_campaign_is_read_once_until_it_changes(kept, monkeypatch):
    """A change of the content is detected also if the size stays the same."""
    part = kept.write(0, frame(0, 50))
    os.utime(part.path, (1e9, 1e9))
    content, read, reads = part.path.read_bytes(), Path.read_bytes, []
    monkeypatch.setattr(Path, "read_bytes", lambda path: (reads.append(path), read(path))[1])
    assert kept.parts() == kept.parts() == ([part], [])
    assert reads == [part.path]
    part.path.write_bytes(content[:-1] + bytes([content[-1] ^ 1]))  # same size
    assert kept.parts() == kept.parts() == ([], [part.path])
    os.utime(part.path, (1e9 + 1, 1e9 + 1))
    assert kept.parts() == kept.parts() == ([], [part.path])


def test_longer_part_file_replaces_a_shorter_one_with_the_same_first_trial(kept):
    short, long = kept.write(0, frame(0, 20)), kept.write(0, frame(0, 50))
    after = kept.write(50, frame(50, 10))
    assert kept.parts()[0] == [long, after]
    kept.tidy(kept.parts()[0])
    assert not short.path.exists()
    assert kept.parts()[0] == [long, after]


def test_temporary_files_among_the_part_files_are_ignored_and_removed(kept):
    kept.write(0, frame(0, 20))
    (kept.folder / ".making-xyz").write_bytes(b"half")
    assert len(kept.parts()[0]) == 1
    kept.tidy(kept.parts()[0])
    assert [path.name[0] for path in kept.folder.iterdir()] == ["0"]


def test_file_of_the_user_among_the_part_files_is_not_deleted(kept):
    kept.write(0, frame(0, 20))
    mine = kept.folder / "mine.parquet"
    frame(0, 5).write_parquet(mine)
    kept.tidy(kept.parts()[0])
    assert mine.exists()


def test_part_file_that_does_not_fit_on_the_disk_is_removed(kept, monkeypatch):
    """The OSError is raised."""

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(rows.os, "fsync", full)
    with pytest.raises(OSError, match="No space left"):
        kept.write(0, frame(0, 20))
    assert list(kept.folder.iterdir()) == []


def test_different_campaigns_have_different_keys():
    assert rows.campaign_key({"a": {"b": 1}}, {"seed": 1}) == rows.campaign_key({"a": {"b": 1}}, {"seed": 1})
    others = [({"a": {"b": 2}}, {"seed": 1}), ({"a": {"b": 1}}, {"seed": 2}), ({"a": {"b": 1}}, {"seed": 1, "m": "x"})]
    assert len({rows.campaign_key(*o) for o in others} | {rows.campaign_key({"a": {"b": 1}}, {"seed": 1})}) == 4


def test_the_key_of_a_campaign_is_the_same_in_every_process():
    """A process can read the parts of another process."""
    assert KEY.hex() == "79ec63fbf7446be36358bada73ee7bbd0088b974470097e1ab1365364697ff48"


def test_trials_of_overlapping_part_files_are_read_once(kept):
    long, _, after = kept.write(0, frame(0, 50)), kept.write(20, frame(20, 20)), kept.write(50, frame(50, 10))
    assert kept.parts() == ([long, after], [])
    assert rows.read(kept.parts()[0])["trial"].to_list() == list(range(60))


@pytest.mark.parametrize("name", ["runs[1]", "runs*", "runs?"])
def test_folder_with_wildcards_in_its_name_is_read_alone(tmp_path, name):
    """Rows of the folder `runs1` are not read with those of `runs*`."""
    for folder in (name, "runs1"):
        kept = rows.Rows(tmp_path / folder, KEY)
        kept.write(0, frame(0, 50).with_columns(status=pl.lit("ok" if folder == name else "diverged")))
    parts, _ = rows.Rows(tmp_path / name, KEY).parts()
    assert rows.read(parts)["trial"].to_list() == list(range(50))
    assert rows.column_names(parts[0]) == ["trial", "x", "status"]
    assert campaign.count_progress(parts, 50) == campaign.Tally(done=50, total=50, failed=0)
