"""CSV tables from spreadsheets, pandas and R: unambiguous tables are read, other tables are refused with the cause."""

import numpy as np
import polars as pl
import pytest

from ptsmc_jax.campaigns import run_tables
from ptsmc_jax.campaigns.store import RefusedError
from ptsmc_jax.numerics import csv_tables
from tests.helpers import refuses

PLAIN = "x1,x2\n1.5,-0.25\n1e-3,0.02\n"
NUMBERS = [[1.5, -0.25], [1e-3, 0.02]]
SEMICOLONS = "x1;x2\n1,5;-0,25\n1e-3;0,02\n"


def numbers(table):
    """Return the columns x1 and x2 of a data frame as numbers (rows, 2)."""
    return table.select("x1", "x2").cast(pl.Float64).to_numpy()


@pytest.mark.parametrize(
    "written",
    [
        PLAIN,
        PLAIN.replace("\n", "\r\n"),
        PLAIN.replace("\n", "\r"),
        PLAIN.replace(",", ", "),
        PLAIN.replace(",", "\t"),
        "\n" + PLAIN.replace("\n", "\n\n"),
        '"x1", "x2"\n"1.5", "-0.25"\n1e-3,0.02\n',
        "sep=,\n" + PLAIN,
        "# two corner cases, by hand\n#\n" + PLAIN,
        PLAIN.replace(",", ";"),
        SEMICOLONS,
        SEMICOLONS.replace(";", " ; "),
        "sep=;\n" + SEMICOLONS,
        ",x1,x2\n0,1.5,-0.25\n1,1e-3,0.02\n",
        '"","x1","x2"\n"1",1.5,-0.25\n"2",1e-3,0.02\n',
        ",Unnamed: 0,x1,x2\n0,0,1.5,-0.25\n1,1,1e-3,0.02\n",
        "x1,x2,\n1.5,-0.25,\n1e-3,0.02,\n",
        "x1;x2;reason\n1,5;-0,25;a metric, the first, is not finite\n1e-3;0,02;\n",
    ],
)
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_an_unambiguous_csv_table_is_read(tmp_path, written, encoding):
    (tmp_path / "table.csv").write_bytes(written.encode(encoding))
    np.testing.assert_array_equal(numbers(csv_tables.read(tmp_path / "table.csv")), NUMBERS)


def test_an_empty_cell_of_a_csv_table_is_null(tmp_path):
    (tmp_path / "table.csv").write_text("x1,x2\n1.0,\n")
    assert csv_tables.read(tmp_path / "table.csv")["x2"].to_list() == [None]


@pytest.mark.parametrize(
    ("written", "cause"),
    [
        (b"", "no line with column names"),
        (b"# x1,x2\n1.5,-0.25\n1e-3,0.02\n", "first line has numbers"),
        (b"1e-3,2\n1,2\n", "first line has numbers"),
        (b"x1,x2\n1,5,-0,25\n", "line 2 must have 2 cells"),
        (b"# by hand\n\nx1,x2\n1.5,2\n1.5\n", "line 5 must have 2 cells"),
        (b"x1;x2,x3\n1;2,3\n", "separated by ',' and ';'"),
        (b"x1;x2\n1,5;0.25\n", "decimal commas and decimal points, 1,5 and 0.25"),
        (b"x1,x2,x1\n1,2,3\n", "two columns with the name x1"),
        (b",x1\n7,1.5\n3,2.5\n", "column without a name does not count the rows"),
        (b'x1,x2\n"1.5,2\n', "not valid CSV"),
        (b"x" * 200_000 + b",x2\n1,2\n", "not valid CSV"),
        ("x1,größe\n1,2\n".encode("latin-1"), "not text in UTF-8"),
        (PLAIN.encode("utf-16-le"), "null characters"),
        (PLAIN.encode("utf-16")[:-1], "not text in UTF-8"),
    ],
)
def test_an_ambiguous_or_invalid_csv_table_is_refused_with_the_cause(tmp_path, written, cause):
    (tmp_path / "table.csv").write_bytes(written)
    with refuses(RefusedError, cause):
        run_tables.read(tmp_path / "table.csv")
