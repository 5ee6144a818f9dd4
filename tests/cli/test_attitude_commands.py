"""Commands with attitude files: `ptsmc simulate --aem`, and a search with a reference from a file."""

import json
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest

from ptsmc_jax import scenario
from ptsmc_jax.scenario import aem
from tests.helpers import SHORT, SHORT_CHAIN, refused, small_search
from tests.onboard.flights import PROFILE

MULTIPLICATIVE = SHORT.replace("[controller]", '[controller]\nerror = "multiplicative"')
FOLLOWING = f'{MULTIPLICATIVE}[reference]\nkind = "table"\nfile = "profile.csv"\n'


def test_simulate_writes_an_ephemeris_that_is_a_reference_of_another_run(command, tmp_path):
    """The ephemeris has the rows of trajectory.csv, which can be a reference too."""
    (tmp_path / "s.toml").write_text(MULTIPLICATIVE.replace("[loop]", '[loop]\nepoch = "2026-03-20T12:00:00"'))
    status, _, err = command("simulate", "s.toml", "--aem", "--no-figures", "--quiet", "--out", "r")
    assert (status, err) == (0, "")
    table = pl.read_csv(tmp_path / "r" / "trajectory.csv")
    text = (tmp_path / "r" / "attitude.aem").read_text()
    assert "START_TIME = 2026-03-20T12:00:00.000000000000" in text
    found = aem.read_segment(text)
    assert found.rates is not None
    np.testing.assert_array_equal(found.quaternions, table["q1", "q2", "q3", "q4"].to_numpy())
    np.testing.assert_allclose(found.rates, table["w1", "w2", "w3"].to_numpy(), rtol=0, atol=1e-14)
    np.testing.assert_allclose(found.times, table["t"].to_numpy(), atol=1e-11)
    for file in ("attitude.aem", "trajectory.csv"):
        tables = tomllib.loads(MULTIPLICATIVE) | {"reference": {"kind": "table", "file": str(tmp_path / "r" / file)}}
        read: Any = scenario.from_tables(tables)
        np.testing.assert_allclose(read.reference.initial_reference_attitude(read), found.quaternions[0], atol=1e-12)


def test_simulate_refuses_to_write_an_ephemeris_of_a_chain(command, tmp_path):
    (tmp_path / "s.toml").write_text(SHORT_CHAIN)
    assert "--aem" in refused(command, tmp_path, "simulate", "s.toml", "--aem")


def test_a_missing_file_of_the_reference_is_a_configuration_error(command, tmp_path):
    (tmp_path / "s.toml").write_text(FOLLOWING)
    assert "reference.file" in refused(command, tmp_path, "simulate", "s.toml")


@pytest.mark.long
def test_tune_finds_gains_for_a_reference_from_a_file_and_copies_it(command, tmp_path, monkeypatch):
    """The tuned scenario refers to the copy, and versions.json has the checksum of the file."""
    small_search(monkeypatch)
    content = Path(PROFILE).read_text()
    (tmp_path / "profile.csv").write_text(content)
    (tmp_path / "s.toml").write_text(FOLLOWING)
    status, _, _ = command("tune", "s.toml", "--no-figures", "--quiet", "--out", "r")
    assert status == 0
    summary = json.loads((tmp_path / "r" / "summary.json").read_text())
    assert "reference_file_sha256" in json.loads((tmp_path / "r" / "versions.json").read_text())
    assert summary
    (tmp_path / "profile.csv").unlink()
    assert (tmp_path / "r" / "profile.csv").read_text() == content
    tuned: Any = scenario.read(tmp_path / "r" / "tuned.toml")
    assert tuned.reference.file == str(tmp_path / "r" / "profile.csv")
