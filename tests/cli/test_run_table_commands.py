"""`ptsmc montecarlo --runs`: campaigns with a run table, which can be resumed, replayed and reported."""

import json
import shlex

import polars as pl
import pytest

from tests.helpers import SHORT_CHAIN, refused, rows_of
from tests.output.pages import checked

pytestmark = pytest.mark.usefixtures("small_parts")
CORNERS = "initial_x1,initial_x2\n1.4,0.0\n1.0,0.02\n0.5,-0.02\n"
SCENARIO = SHORT_CHAIN.replace("[dispersion]", '[dispersion]\nstate_noise = { kind = "relative_normal" }')


def test_run_table_of_a_dry_run_reproduces_the_campaign(command, tmp_path):
    options = ["--seed", 3, "--no-figures", "--quiet"]
    assert command("montecarlo", "s.toml", "--trials", 150, *options)[0] == 0
    assert command("montecarlo", "s.toml", "--trials", 150, "--dry-run", *options, "--out", "dry")[0] == 0
    assert command("montecarlo", "s.toml", "--runs", "dry/runs", *options) == (0, "", "")
    made = tmp_path / "out" / "montecarlo-s-runs"
    assert rows_of(made).equals(rows_of(tmp_path / "out" / "montecarlo-s"))
    told = json.loads((made / "versions.json").read_text())
    assert (told["run_table"], told["trials"]) == ("runs", 150)


def test_run_table_is_simulated_resumed_replayed_and_reported(command, tmp_path):
    """Quantities that the table omits are random. A changed or damaged run table is refused without --force."""
    (tmp_path / "corners.csv").write_text(CORNERS)
    asked = ["montecarlo", "s.toml", "--runs", "corners.csv", "--no-figures"]
    code, said, _ = command(*asked)
    folder = tmp_path / "out" / "montecarlo-s-corners"
    assert code == 0
    assert "3 trials of the run table corners.csv and seed 1000: 3 ok" in said
    assert "assume random trials; they hold as far as the run table is random" in said
    rows = rows_of(folder)
    assert rows["trial"].to_list() == [0, 1, 2]
    assert rows["initial_x2"].to_list() == [0.0, 0.02, -0.02]
    assert rows["state_noise_1"].n_unique() == 3  # omitted quantities are random
    read = checked(folder)
    assert "ptsmc montecarlo s.toml --runs corners.csv --no-figures" in read.text

    part = next((folder / "trials").iterdir())
    part.unlink()
    assert command(*asked, "--quiet")[0] == 0  # it simulates the missing part
    assert rows_of(folder).equals(rows)
    assert command("worst", folder, "--by", "peak_torque", "-n", 1)[0] == 0
    code, said, _ = command("replay", folder, "--trial", 1, "--no-figures")
    assert (code, "equals its row to the last digit" in said) == (0, True)
    history = pl.read_csv(folder / "replay" / "1" / "trajectory.csv")
    assert history["x2"][0] == 0.02
    again = checked(folder / "replay" / "1").text  # `ptsmc simulate` has no option for a row of a run table
    assert f"ptsmc replay {shlex.quote(str(folder))} --trial 1" in again
    assert "ptsmc simulate scenario.toml" not in again
    assert command("replay", folder, "--trial", 3)[0] == 2

    (tmp_path / "corners.csv").write_text(CORNERS.replace("-0.02", "-0.03"))
    code, _, error = command(*asked)
    assert (code, "which holds a run with run_table_sha256" in error) == (2, True)
    (folder / "run_table.parquet").write_bytes(b"PAR1")
    said = refused(command, tmp_path, "worst", folder)
    assert said.startswith(f"ptsmc: the run table is {folder / 'run_table.parquet'}, which cannot be read: ")
    pl.read_csv(tmp_path / "corners.csv").write_parquet(folder / "run_table.parquet")
    for again in (["replay", folder, "--trial", 1], ["replay", folder, "--trial", 0]):
        said = refused(command, tmp_path, *again)
        assert "run_table.parquet has changed: it is not the run table of the campaign" in said
    assert command(*asked, "--force", "--quiet")[0] == 0
    assert rows_of(folder)["initial_x2"][2] == -0.03
    assert command("montecarlo", "s.toml", "--out", folder, "--force", "--quiet", "--trials", 5, "--no-figures")[0] == 0
    assert not (folder / "run_table.parquet").exists()


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--runs", "bad.csv"], "the run table bad.csv has initial_x2 nan in row 1, but must have a finite number"),
        (["--runs", "bad.csv", "--trials", "5"], "Mutually exclusive arguments: {--trials, --runs}"),
        (["--runs", "bad.csv", "--until-confident", "0.1"], "{--runs, --until-confident}"),
    ],
)
def test_invalid_run_tables_are_refused_and_nothing_is_written(command, tmp_path, options, said):
    (tmp_path / "bad.csv").write_text("initial_x1,initial_x2\n0,0\n0,nan\n")
    assert said in refused(command, tmp_path, "montecarlo", "s.toml", *options)


@pytest.mark.parametrize(
    ("table", "shown"),
    [
        ("initial_x1,initial_x2\n1.0,\x1b[31mred\n", r"initial_x2 \x1b[31mred in row 0"),
        ('initial_x1,"initial\nx2\x07"\n1.0,2.0\n', r"column initial\nx2\x07"),
        ("initial_x1;initial_x2\n1,5;0.2\n", "decimal commas and decimal points"),
    ],
)
def test_a_refused_table_prints_one_line_without_control_characters(command, tmp_path, table, shown):
    (tmp_path / "bad.csv").write_text(table)
    error = refused(command, tmp_path, "montecarlo", "s.toml", "--runs", "bad.csv")
    assert shown in error
    assert error.isprintable()
