"""Progress where the output is redirected."""

import contextlib
import os
import re
import time

import pytest

from ptsmc_jax import programs
from ptsmc_jax.campaigns import campaign
from tuning.output import progress, terminal
from tuning.output.report import Table


def test_progress_line_is_repeated_if_there_is_no_news(capsys, monkeypatch):
    """The last line is repeated with the elapsed time, for example while a law is compiled for minutes."""
    monkeypatch.setattr(progress, "INTERVAL", 0.05)
    with progress.Progress(quiet=False) as tell:  # the tests' output is no terminal
        tell("pd: compiling", 0, 0)
        time.sleep(0.4)
    said = capsys.readouterr().err.splitlines()
    assert 3 <= said.count("ptsmc: pd: compiling, 0 s so far") <= 8
    time.sleep(0.2)
    assert not capsys.readouterr().err
    with progress.Progress(quiet=True):
        time.sleep(0.2)
    assert not capsys.readouterr().err


def test_progress_line_has_the_number_of_steps(capsys, monkeypatch):
    monkeypatch.setattr(progress, "INTERVAL", 0.02)
    with progress.Progress(quiet=False) as tell:
        tell("searching", 1, 7)
        time.sleep(0.2)
    assert set(capsys.readouterr().err.splitlines()) == {"ptsmc: searching, 1 of 7, 0 s so far"}


def reported(bar, monkeypatch, *reports):
    """Return the texts of a bar after reports.

    Each report is a time [s] and the arguments of the bar, or only a time to display the bar again.
    """
    texts = []
    for now, *arguments in reports:
        monkeypatch.setattr(progress.time, "monotonic", lambda now=now: now)
        if arguments:
            bar(*arguments)
        texts.append(bar.__rich__())
    return texts


def test_the_rate_of_a_campaign_is_measured_after_its_first_part(monkeypatch):
    """The program is compiled before the first part is simulated. Several parts may end at the same time."""
    tallies = [(10.0, 1000, 0), (60.0, 2000, 2), (60.0, 3000, 2), (64.0, 5000, 2), (30064.0, 9000, 2)]
    texts = reported(progress.CampaignProgress(quiet=True), monkeypatch,
                     *((now, campaign.Tally(done, 9000, failed)) for now, done, failed in tallies))  # fmt: skip
    assert texts == [
        "1000 of 9000 trials",
        "2000 of 9000 trials, 2 failed or not converged",
        "3000 of 9000 trials, 2 failed or not converged",
        "5000 of 9000 trials, 750 a second, 2 failed or not converged, about 5 s left",
        "9000 of 9000 trials, 0.2 a second, 2 failed or not converged",
    ]


def test_the_time_left_of_a_step_follows_from_the_work_done_so_far(monkeypatch):
    steps = [
        (5.0, "searching", 0, 8),
        (35.0, "searching", 1, 8),
        (65.0, "searching", 2, 8),
        (155.0,),
        (300.0,),
        (301.0, "refining", 0, 4),
        (311.0, "refining", 4, 4),
        (321.0, "judging", 0, 4),
        (325.0, "judging", 2, 4),
        (326.0, "searching", 1, 4, 2.0),
    ]
    assert reported(progress.Progress(quiet=True, objective="effort"), monkeypatch, *steps) == [
        "searching, 0 of 8",
        "searching, 1 of 8",  # the first piece of work may include a compilation
        "searching, 2 of 8, about 3 min left in this step",
        "searching, 2 of 8, about 90 s left in this step",
        "searching, 2 of 8",
        "refining, 0 of 4",
        "refining, 4 of 4",
        "judging, 0 of 4",  # another step with as much work
        "judging, 2 of 4, about 4 s left in this step",
        "searching, 1 of 4: effort 2 N m s, limits met in training",  # the count is not of the limits
    ]


@pytest.fixture
def unread():
    """Yield a stream for writing into a pipe whose reader has closed it."""
    reading, writing = os.pipe()
    os.close(reading)
    with contextlib.suppress(OSError), os.fdopen(writing, "w") as stream:
        yield stream


def test_printing_into_a_closed_pipe_raises_no_error(unread, monkeypatch):
    """A pipe to `head` closes early. Rich would exit with 1, the status of requirements that are not met."""
    monkeypatch.setattr("sys.stdout", unread)
    terminal.print_lines("told", "to nobody")
    terminal.print_table(Table(("head",), [("row",)]))


def test_progress_into_a_closed_pipe_raises_no_error(unread, monkeypatch):
    monkeypatch.setattr("sys.stderr", unread)
    monkeypatch.setattr(progress, "INTERVAL", 0.01)
    with progress.Progress(quiet=False) as tell:
        tell("searching", 1, 7)
        time.sleep(0.1)  # an error of its thread would be a warning, which fails the test


def test_tables_in_a_narrow_terminal_have_complete_numbers(capsys, monkeypatch):
    """An earlier version shortened 0.000194 to 0.00 and three dots. Only sentences break, between their words."""
    monkeypatch.setenv("FORCE_COLOR", "1")  # a terminal
    monkeypatch.setenv("COLUMNS", "40")
    row = ("peak_torque_delivered", "0.000194", "0.000382..0.00102", "N m s", "largest delivered torque about one axis")
    terminal.print_table(Table(("metric", "median", "its 95 % interval", "unit", "meaning"), [row]))
    out = re.sub(r"\x1b\[[0-9;]*m", "", capsys.readouterr().out)
    assert all(cell in out for cell in row[:4])
    assert "…" not in out
    assert set(row[4].split()) <= set(out.split())
    assert len(out.splitlines()) > 2


def test_terminal_prints_text_as_it_is(capsys):
    """Rich would print `:x:` in the name of a folder as an emoji, and [bold] not at all."""
    terminal.print_lines("results in out/tune:x:/[bold]")
    terminal.print_table(Table(("a:key:",), [("b:x:[bold]",)]))
    out = capsys.readouterr().out
    assert "out/tune:x:/[bold]" in out
    assert "a:key:" in out
    assert "b:x:[bold]" in out


def test_progress_line_names_the_compilation_that_a_step_waits_for(capsys, monkeypatch):
    monkeypatch.setattr(progress, "INTERVAL", 0.02)
    monkeypatch.setattr(programs, "compiling", lambda: "compiling the gradients, 2 of 3")
    with progress.Progress(quiet=False) as tell:
        tell("searching", 1, 7)
        time.sleep(0.2)
        tell("pd, law 2 of 9: searching", 1, 7)
        time.sleep(0.2)
    assert list(dict.fromkeys(capsys.readouterr().err.splitlines())) == [
        "ptsmc: compiling the gradients, 2 of 3, 0 s so far",
        "ptsmc: pd, law 2 of 9: compiling the gradients, 2 of 3, 0 s so far",
    ]
