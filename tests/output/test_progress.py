"""Progress where the output is redirected."""

import contextlib
import os
import re
import time
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from ptsmc_jax.campaigns import campaign
from ptsmc_jax.numerics import statistics
from tuning.output import campaign_sentences, campaign_terminal, law_sentences, progress_lines, terminal
from tuning.output.cells import Table
from tuning.output.progress_lines import Lines


def test_line_with_count_percentage_or_neither():
    assert progress_lines.line("searching", 1, 7, 10.4) == "ptsmc: searching, 1 of 7, 10 s"
    assert progress_lines.line("searching", 7, 100, 99.0) == "ptsmc: searching, 7 %, 99 s"
    assert progress_lines.line("compiling", 0, 0, 99.0) == "ptsmc: compiling, 99 s"


def test_a_line_comes_also_while_nothing_new_is_said(capsys, monkeypatch):
    """As where a law is compiled for minutes: what was said last, and how long ago the command began."""
    monkeypatch.setattr(progress_lines, "EVERY", 0.05)
    with terminal.Progress(quiet=False) as tell:  # the tests' output is no terminal
        tell("pd: compiling", 0, 0)
        time.sleep(0.4)
    said = capsys.readouterr().err.splitlines()
    assert 3 <= said.count("ptsmc: pd: compiling, 0 s") <= 8
    time.sleep(0.2)
    assert not capsys.readouterr().err
    with terminal.Progress(quiet=True):
        time.sleep(0.2)
    assert not capsys.readouterr().err


def test_trials_a_second_are_those_flown_since_the_command_began(monkeypatch):
    """3 000 in four seconds, of a campaign that goes on from 1 000; at first nothing is known. A slow rate is not 0."""
    at, said = iter([10.0, 14.0, 14.0, 16010.0]), []
    monkeypatch.setattr(campaign_terminal.time, "monotonic", lambda: 0.0)
    progress = campaign_terminal.Progress(quiet=True)
    monkeypatch.setattr(campaign_terminal.time, "monotonic", lambda: next(at))
    monkeypatch.setattr(progress, "_lines", lambda text, done, total: said.append(text))
    for done, failed in ((1000, 0), (4000, 2), (9000, 2), (9000, 2)):
        progress(campaign.Tally(done, 9000, failed))
    assert said == [
        "1000 of 9000 trials, compiling",
        "4000 of 9000 trials, 750 a second, 2 failed or missed",
        "9000 of 9000 trials, 2,000 a second, 2 failed or missed",
        "9000 of 9000 trials, 0.5 a second, 2 failed or missed",
    ]


@pytest.fixture
def unread():
    """A stream into a pipe that nobody reads any more."""
    reading, writing = os.pipe()
    os.close(reading)
    with contextlib.suppress(OSError), os.fdopen(writing, "w") as stream:
        yield stream


def test_a_reader_that_has_read_enough_changes_nothing(unread, monkeypatch):
    """As `head`: rich would exit with 1, which is the status of requirements that are not met."""
    monkeypatch.setattr("sys.stdout", unread)
    terminal.say("told", "to nobody")
    terminal.table(Table(("head",), [("row",)]))


def test_progress_that_nobody_reads_stops_nothing(unread, monkeypatch):
    monkeypatch.setattr("sys.stderr", unread)
    monkeypatch.setattr(progress_lines, "EVERY", 0.01)
    with Lines(silent=False) as tell:
        tell("searching", 1, 7)
        time.sleep(0.1)  # an error of its thread would be a warning, which fails the test


def test_the_gains_that_a_campaign_flew_with_have_their_units():
    tables = {
        "controller": {"kind": "prescribed_time", "eta": 3.0},
        "observer": {"kind": "nonlinear", "gain": [1.0, 2.0, 3.0]},
    }
    rows = campaign_sentences.flown_gains(tables, "spacecraft").rows
    assert rows == [
        ("controller.kind", "prescribed_time", ""),
        ("controller.eta", "3", ""),
        ("observer.kind", "nonlinear", ""),
        ("observer.gain", "1, 2, 3", "N m s"),
    ]
    bounds = {
        "controller": {"kind": "pd", "disturbance_bound": 0.1},
        "observer": {"kind": "finite_time", "gain": [0.02]},
    }
    assert campaign_sentences.flown_gains(bounds, "spacecraft").rows[1::2] == [
        ("controller.disturbance_bound", "0.1", "N m"),
        ("observer.gain", "0.02", "N m/s"),  # the nonlinear one's is in N m s
    ]
    own = {"controller": {"kind": "own", "t_f": 30.0, "k": 2.0}}  # whose class may say another unit than a built-in k
    assert campaign_sentences.flown_gains(own, "spacecraft").rows[1:] == [
        ("controller.t_f", "30", "s"),
        ("controller.k", "2", ""),
    ]


def test_a_comparison_says_which_requirement_each_law_breaks_and_in_how_many_trials():
    def law(failures, met):
        verdict = {
            "metric": "peak_torque",
            "limit": 0.5,
            "failures": failures,
            "trials": 1000,
            "met": met,
            "worst": 0.5,
        }
        numbers = dict.fromkeys(
            ("window_error", "peak_torque", "largest_peak_torque", "effort", "chattering", "settling_near_far",
             "window_error_interval", "margins")
        )  # fmt: skip
        told = {"settling_time": None, "unsettled": 0, "untold": {}, "verdicts": [verdict], "met": met}
        return {**numbers, **told, "window_error": 1e-5}

    laws = {"pd": law(12, False), "prescribed_time": law(0, True)}
    table = law_sentences.answers({"laws": laws})[0].table
    assert table.head[-2:] == ("trials beyond peak_torque", "all limits met")
    assert [row[-2:] for row in table.rows] == [("12 of 1000: NOT met", "no"), ("0 of 1000", "yes")]


def test_numbers_of_laws_have_no_exponents_below_a_million():
    """An effort of 2697 N m s stood there as 2.7e+03, 1500 times the floor as 1.5e+03."""
    assert law_sentences._cell(law_sentences.FLOOR, {"window_error": 1.5e-3, "floor": 1e-6}) == "1500"
    assert law_sentences._cell(law_sentences.FLOOR, {"window_error": None, "floor": 1e-6}) == "-"


def test_of_inputs_that_rank_the_trials_alike_only_the_first_is_a_driver():
    rng = np.random.default_rng(0)
    angle, other = rng.uniform(0.3, 2.4, 1000), rng.normal(size=1000)
    inputs = {"initial_angle": angle, "initial_q4": np.cos(angle / 2), "other": other}
    assert list(statistics.drivers(inputs, angle + other)) == ["initial_angle", "other"]


def test_what_chance_shows_is_not_said_to_drive_a_metric():
    """Of twenty inputs that a metric does not know, some had a correlation of 0.1 with it, and were named."""
    rng = np.random.default_rng(0)
    inputs, metric = {f"x{k}": rng.normal(size=300) for k in range(20)}, rng.normal(size=300)
    drivers = statistics.drivers(inputs, metric)
    assert max(abs(one["rank_correlation"]) for one in drivers.values()) > 0.1
    summary = {"verdicts": [], "flown": 300, "drivers": {"window_error": drivers}}
    assert not list(campaign_sentences.drivers(summary))
    # as where most trials fail: 300 of 10 000 have the metric
    assert not list(campaign_sentences.drivers({**summary, "flown": 10_000, "driver_trials": {"window_error": 300}}))
    summary["drivers"] = {"window_error": statistics.drivers({"y": metric + rng.normal(size=300)}, metric)}
    (said,) = campaign_sentences.drivers(summary)
    assert said.startswith("window_error hangs on y +0.")
    assert said.endswith("%): rank correlation (share of the variance of its ranks)")


@pytest.mark.parametrize(
    ("off", "rounding", "said", "unsaid"),
    [
        (0.0, 0.0, ["equal to its row, to the last digit", "same flight to round-off"], "NOT"),
        (7e-16, 3e-15, ["the same as its row to round-off: 7.0e-16 off at most", "differ by 3e-15 at most"], "NOT"),
        (2e-3, 3e-15, ["NOT the same as its row: 2.0e-03 off", "versions.json"], "its row to round-off"),
        (np.inf, 0.1, ["NOT the same as its row: it ends another way", "1.0e-01 off at most, relative; a loop"], "inf"),
        (None, 0.0, ["no row of this trial yet"], "NOT"),
    ],
)
def test_round_off_of_a_replay_does_not_read_as_a_fault(capsys, off, rounding, said, unsaid):
    campaign_terminal.replayed(off, rounding, 1e-12)
    out = capsys.readouterr().out
    assert all(words in out for words in said)
    assert unsaid not in out


def test_a_narrow_terminal_cuts_no_numbers(capsys, monkeypatch):
    """Of 0.000194 it left 0.00 and three dots; sentences still break at their words."""
    monkeypatch.setenv("FORCE_COLOR", "1")  # a terminal
    monkeypatch.setenv("COLUMNS", "40")
    row = ("peak_torque_delivered", "0.000194", "0.000382..0.00102", "N m s", "largest delivered torque about one axis")
    terminal.table(Table(("metric", "median", "its 95 % interval", "unit", "meaning"), [row]))
    out = re.sub(r"\x1b\[[0-9;]*m", "", capsys.readouterr().out)
    assert all(cell in out for cell in row[:4])
    assert "…" not in out
    assert set(row[4].split()) <= set(out.split())
    assert len(out.splitlines()) > 2


def test_how_far_beyond_a_limit_has_no_exponent(capsys, monkeypatch):
    """A search beyond twenty times a limit said "1.92e+03 % beyond a limit"."""
    monkeypatch.setattr(progress_lines, "EVERY", 0.05)
    with terminal.Progress(quiet=False, goal="error") as tell:  # the tests' output is no terminal
        tell("searching", 1, 7, 1e-5, 19.2)
        time.sleep(0.4)
    assert "1920 % beyond a limit" in capsys.readouterr().err


def test_how_to_replay_the_worst_trial_can_be_pasted_into_a_shell(capsys):
    rows = pl.DataFrame({"trial": [7], "window_error": [0.1]})
    campaign_terminal.worst(rows, "window_error", Path("my out"), "chain")
    assert "one in full: ptsmc replay 'my out' --trial 7\n" in capsys.readouterr().out
