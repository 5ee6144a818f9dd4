"""The command `ptsmc`: files, exit statuses, messages."""

import csv
import json
import os
import shutil
import subprocess
import sys
from collections import Counter

import numpy as np
import pytest

from ptsmc_jax import scenario
from ptsmc_jax.campaigns import montecarlo, runs
from ptsmc_jax.scenario import timing
from ptsmc_jax.simulation import catalogues
from tests.helpers import (
    PAPER_ATTITUDE,
    QUICKLY,
    ROOT,
    SHORT,
    SHORT_CHAIN,
    refused,
    short,
    small_search,
    tree,
    undocumented,
)
from tests.output.pages import checked
from tuning.output import formats, terminal
from tuning.studies import compare, judging, single, stability


def test_simulate_writes_its_result_folder(command, tmp_path):
    """Output, history and summary agree. An existing folder is refused without --force."""
    status, out, err = command("simulate", "s.toml", "--trial", 3, "--seed", 7)
    assert (status, err) == (0, "")
    folder = tmp_path / "out" / "simulate-s"
    names = ("attitude", "error", "rate", "torque", "sliding", "disturbance", "convergence")
    figures = {f"figures/{name}.png" for name in names}
    assert set(tree(folder)) == {"trajectory.csv", "summary.json", "scenario.toml", "versions.json", *figures}
    header, *rows = (folder / "trajectory.csv").read_text().splitlines()
    logged = "measured_q1,measured_q2,measured_q3,measured_q4,measured_w1,measured_w2,measured_w3,sent1,sent2,sent3"
    assert header == f"t,q1,q2,q3,q4,w1,w2,w3,d_hat1,d_hat2,d_hat3,u1,u2,u3,s1,s2,s3,{logged}"
    assert undocumented(header.split(",")) == set()
    values = np.array([[float(v) for v in row.split(",")] for row in rows])
    assert values[0, 0] == 0.0
    assert values[-1, 0] == 6.5
    assert np.all(np.diff(values[:, 0]) > 0)
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["status"] == "ok"
    assert {name for name, entry in catalogues.CATALOGUE.items() if entry.table is None} <= set(summary)
    assert summary["peak_torque"] == pytest.approx(np.abs(values[:, 11:14]).max(), rel=1e-12)
    first, second, third, *_ = out.splitlines()
    assert (
        first
        == f"pointing error {formats.format_error(summary['window_error'], 'spacecraft')}: every requirement is met"
    )
    bound = formats.format_error(summary["lower_bound"], "spacecraft")  # of an RMS, so it has no ratio to one trial
    assert second.startswith(f"lower bound of the RMS error of many trials: {bound}; ")
    drawn, start = summary["drawn"], [*values[0, 1:8]]
    assert list(drawn) == ["initial_angle", *(f"initial_{name}" for name in header.split(",")[1:8])]
    np.testing.assert_allclose([one["value"] for one in drawn.values()][1:], start, rtol=1e-12)
    assert [one["unit"] for one in drawn.values()] == ["rad", *4 * ["-"], *3 * ["rad/s"]]
    angle = np.degrees(drawn["initial_angle"]["value"])
    assert third.startswith(f"initial_angle {angle:.6g} deg in this trial; summary.json has ")
    assert scenario.read(folder / "scenario.toml") == scenario.read(tmp_path / "s.toml")
    made = json.loads((folder / "versions.json").read_text())
    assert (made["command"], made["seed"], made["trial"]) == ("simulate", 7, 3)

    before = tree(folder)
    error = refused(command, tmp_path, "simulate", "s.toml")
    assert "simulate-s" in error
    assert "--force" in error
    status, _, _ = command("simulate", "s.toml", "--force", "--quiet", "--no-figures")
    assert status == 0
    assert tree(folder)["trajectory.csv"] != before["trajectory.csv"]  # the nominal run


# `test_interrupted_search_writes_its_best_gains_and_resumes` tunes a chain
@pytest.mark.parametrize("text", short([SHORT_CHAIN, SHORT], [SHORT]), ids=["chain", "spacecraft"])
def test_tune_command_writes_its_results_and_a_second_call_shows_them(command, tmp_path, monkeypatch, text):
    """tuned.toml reproduces the held-out trials. The tuned gains are more accurate than the gains before the search.

    The page has gains, margins and lower bound. Another seed and a damaged summary are refused.
    """
    small_search(monkeypatch)
    (tmp_path / "s.toml").write_text(text)
    status, _, _ = command("tune", "s.toml", "--out", "t")
    summary = json.loads((tmp_path / "t" / "summary.json").read_text())
    assert status == (0 if summary["status"] == "met" else 1)
    assert {"gains", "training", "held_out", "published", "verdicts"} <= set(summary)
    assert summary["held_out"]["trials"] == 40
    listed = {name for group in ("held_out", "published", "before") for name in summary[group]["gains"]}
    assert summary["gain_units"].keys() == {name for name in listed if "observer_gain_" not in name}
    assert summary["held_out"]["seed"] != summary["training"]["seed"]
    published = {"eta": 3.0, "delta": 0.1}  # the published delta of 0.05 s is below one period
    known = {"held_out": summary["gains"], "published": published}
    for group, of_group in known.items():
        assert 0.0 < summary[group]["lower_bound"] < summary[group]["window_error"]["rms"]
        assert summary[group]["gains"].items() >= of_group.items()
    files = {"tuned.toml", "history.csv", "summary.json", "scenario.toml", "versions.json"}
    drawn = {f"figures/{name}.png" for name in ("history", "tradeoff", "sensitivities", "profiles")}
    assert set(tree(tmp_path / "t")) == files | drawn
    tuned = scenario.read(tmp_path / "t" / "tuned.toml")
    assert tuned.controller.eta == summary["gains"]["eta"]
    assert tuned.controller.delta == summary["gains"]["delta"]
    ready = scenario.study(tuned)  # tuned.toml reproduces the held-out trials
    again = montecarlo.run(ready.parts, ready.dispersion, summary["held_out"]["seed"], np.arange(40))
    rms = np.sqrt(np.mean(again.metrics.window_error**2))
    assert rms == pytest.approx(summary["held_out"]["window_error"]["rms"], rel=1e-12)
    assert (tuned.loop.clock, tuned.controller.sign_width) == ("flight", 1e-3)
    header, *rows = (tmp_path / "t" / "history.csv").read_text().splitlines()
    assert header == "step,start,stage,rms_window_error,eta,delta,peak_torque_over_limit"
    stages = Counter(tuple(row.split(",")[1:3]) for row in rows)  # points of a start have several stages
    assert max(stages.values()) <= scenario.read(tmp_path / "s.toml").search.steps < len(rows)
    assert len(rows) == summary["search"]["history_points"] >= 2
    # The tuned gains are more accurate than the scenario's gains on the same trials. They need not be more accurate
    # than the published gains, whose faster surface and observer are not free in this search.
    assert summary["held_out"]["window_error"]["rms"] < summary["before"]["window_error"]["rms"]

    assert summary["trust"]["margins"] == stability.worst_margins(scenario.study(tuned))
    assert summary["shortest_t_f"]["theory"] > 0.0

    read = checked(tmp_path / "t")
    left = summary["trust"]["margins"]["hold"]["gain_margin"]
    assert f"margins of the nominal loop in the hold phase: gain {left:.3g} dB" in read.text
    assert set(read.charts) == {"search"}
    times = summary["held_out"]["window_error"]["rms"] / summary["held_out"]["lower_bound"]
    assert f"{formats.format_ratio(times)} times the lower bound of " in read.text
    assert len(read.charts["search"]["data"]) == summary["search"]["starts"]
    gains = ", ".join(f"{name} {value:.6g}" for name, value in summary["gains"].items())
    assert read.text.index(f"gains: {gains}") < read.text.index("Requirements")  # at once, with the verdict
    assert "These are the gains of the scenario" in read.text[read.text.index("Scenario") :]
    (verdict,) = summary["verdicts"]
    assert f"{100 * verdict['margin']:.3g} % of the limit" in read.text

    before = tree(tmp_path / "t")
    again, told, _ = command("tune", "s.toml", "--out", "t")
    assert again == status
    assert "from an earlier run" in told
    assert tree(tmp_path / "t") == before
    other, _, err = command("tune", "s.toml", "--out", "t", "--seed", 1)
    assert other == 2
    assert "--force" in err
    with monkeypatch.context() as patch:
        patch.setattr(terminal, "print_lines", lambda *_: "é".encode("ascii"))
        with pytest.raises(UnicodeEncodeError):  # no fault of the summary
            command("tune", "s.toml", "--out", "t")
    for damaged in ({"status": "met"}, {**summary, "status": "?"}, {**summary, "held_out": 1}):
        (tmp_path / "t" / "summary.json").write_text(json.dumps(damaged))
        assert "t/summary.json is damaged or of another version" in refused(
            command, tmp_path, "tune", "s.toml", "--out", "t"
        )


# here, because the search above compiled the same programs
@pytest.mark.parametrize("others", short([[], ["pd"]], [[]]))
def test_compare_command_writes_its_results(command, tmp_path, monkeypatch, others):
    """The written scenario of each law reproduces its error, margins and gains.

    A second call shows the results again.
    """
    small_search(monkeypatch)
    monkeypatch.setattr(
        compare, "law_kinds", lambda: [compare.OURS, *others]
    )  # every further law compiles more programs
    model_errors = compare.MODEL_ERRORS if others else ("heavier", "lighter")  # "later" compiles another program too
    perturbed = compare.perturbed_scenarios
    monkeypatch.setattr(
        compare, "perturbed_scenarios", lambda one: {name: perturbed(one)[name] for name in model_errors}
    )
    code, said, _ = command("compare", "s.toml")
    folder = tmp_path / "out/compare-s"
    found = json.loads((folder / "summary.json").read_text())
    laws = ["published", "prescribed_time", *others]
    assert list(found["laws"]) == laws
    assert found["judged_on"] == "flight clock"  # without the sign function of one law
    assert code == (0 if found["laws"]["prescribed_time"]["met"] else 1)
    for said_of in found["laws"].values():  # another inertia changes the error slightly
        assert tuple(said_of["model_errors"]) == model_errors
        for other in said_of["model_errors"].values():
            assert other["window_error"] != said_of["window_error"]
    assert {path.name for path in (folder / "figures").iterdir()} == {"settling.png", "tradeoff.png"}
    rows = list(csv.DictReader((folder / "compare.csv").read_text().splitlines()))
    assert [row["law"] for row in rows] == laws
    for row, law in zip(rows, laws, strict=True):
        assert float(row["window_error"]) == found["laws"][law]["window_error"]
        assert law.split("_")[0] in said
        again = scenario.read(folder / "scenarios" / f"{law}.toml")  # the judged scenario
        error, _ = judging.rms_window_error(judging.judge(again, found["seed"]))  # simulated again on the same trials
        assert error == pytest.approx(found["laws"][law]["window_error"], rel=1e-9)
        assert found["laws"][law]["margins"] == stability.worst_margins(scenario.study(again))
        assert found["laws"][law]["gains"].keys() >= {"pd": {"k_p", "k_d"}}.get(law, {"eta", "delta"})
        for name, value in found["laws"][law]["gains"].items():
            if name != "observer_gain":
                assert getattr(again.controller, name) == pytest.approx(value, rel=1e-9)
    read = checked(folder)
    assert read.text.startswith("ptsmc compare: compare-s")
    error = found["laws"][laws[-1]]["window_error"]
    assert formats.format_ratio(np.degrees(2 * np.arcsin(error)) * 3600) in read.text
    monkeypatch.delattr(compare, "validated_contenders")  # a finished comparison builds no law
    code, again, _ = command("compare", "s.toml")
    assert "from an earlier run" in again
    assert command("compare", "s.toml", "--seed", "x")[0] == 2


WHOLE = "whole number"
NUMBERS = {
    "-1": ">= 0",
    "4294967296": "<= 4294967295",
    "1.5": WHOLE,
    "many": WHOLE,
    "1e3": WHOLE,
    "true": WHOLE,
}


@pytest.mark.parametrize(
    ("args", "named"),
    [
        *(
            (("simulate", f"--{option}", value), (f"--{option}", value, allowed))
            for option in ("seed", "trial")
            for value, allowed in NUMBERS.items()
        ),
        (("simulate", "nothere.toml"), ("nothere.toml does not exist",)),
        (("simulate", "folder"), ("folder cannot be read: Is a directory",)),
        (("simulate", "broken.toml"), ("broken.toml is no valid TOML",)),
        (("simulate", "eta.toml"), ("controller.eta is 1.0, but must be a number greater than 2",)),
        (("tune", "eta.toml"), ("controller.eta is 1.0, but must be a number greater than 2",)),
        (("tune", "far.toml"), ("initial.rotvec_deg is",)),
        (("map", "s.toml", "--trials", "2.5"), ("for --trials: 2.5 is no whole number",)),
        (("simulate", "s.toml", "--out", "folder"), ("folder, which holds something already",)),
        # the argument first, so that it does not take another try after a change of the folder
        (("map", "s.toml", "--out", "folder", "--x", "a"), ("--x is a, but must be KEY=LOW:HIGH:COUNT",)),
        (("simulate", "--seed"), ("--seed", "requires an argument")),
        (("simulate", "--out"), ("--out", "requires an argument")),
        (("simulate", "--sed", "1"), ("--sed", "--seed")),
        (("simulate", "--loud"), ("--loud",)),
        (("tune", "--trial", "1"), ("--trial",)),
        (("tune", "--steps=4"), ("tune does not take --steps; set tune.steps in the scenario",)),
        (("compare", "s.toml", "--trials", "10"), ("set tune.trials in the scenario",)),  # earlier: "--trust?"
        (("compare", "s.toml", "--against", "pd,scaling"), ("is pd,scaling", "repeat the option for several laws")),
        (("compare", "s.toml", "--against", "prescribed_time"), ("prescribed_time is always compared",)),
        (("simulate", "--quiet=perhaps"), ("--quiet", "perhaps")),
        (("simulate", "s.toml", "t.toml"), ("simulate does not take t.toml", "ptsmc simulate --help")),
        (("montecarl", "s.toml"), ("montecarl", "simulate, reproduce, map, margins, tune")),
        (("simulate", "huge.toml"), ("reference.rate is [0.0, 0.0, 1e+300]",)),
        (("simulate", "--out", "s.toml"), ("--out is s.toml", "a file", "a new folder")),
        (("simulate", "--out", "s.toml", "--force"), ("--out is s.toml", "a file", "a new folder")),
        (("simulate", "--out", "s.toml/below"), ("--out is s.toml/below", "a new folder")),
        (("tune", "--out", "."), ("--out is .", "a new folder, or --force")),
    ],
    ids=lambda part: " ".join(part),
)
def test_invalid_arguments_and_files_print_one_line_and_write_nothing(command, tmp_path, args, named):
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "mine").write_text("keep")
    (tmp_path / "broken.toml").write_text("x = ")
    (tmp_path / "eta.toml").write_text("[controller]\neta = 1.0")
    (tmp_path / "huge.toml").write_text('reference = { kind = "spin", rate = [0, 0, 1e300] }')
    (tmp_path / "far.toml").write_text("[initial]\nrotvec_deg = [180.0, 0.0, 0.0]")
    line = refused(command, tmp_path, *args, "--no-figures")
    assert line.startswith("ptsmc: ")
    assert all(part in line for part in named)


def history_of(folder):
    """Return the numbers of trajectory.csv (rows, columns)."""
    return np.loadtxt(folder / "trajectory.csv", delimiter=",", skiprows=1)


def test_simulate_without_a_file_runs_case_one_of_the_paper(command, tmp_path):
    """The first row is that of theory.md 3.3, and the summary equals the metrics of the history.

    The folder has these files, the scenario and the versions. The times increase from 0 to t_end.
    """
    assert command("simulate", "--quiet", "--no-figures") == (0, "", "")
    folder = tmp_path / "out" / "simulate-default"
    assert set(tree(folder)) == {"trajectory.csv", "summary.json", "scenario.toml", "versions.json"}
    assert scenario.read(folder / "scenario.toml") == scenario.from_tables({})
    rows = history_of(folder)
    # At rest, v' = 0, so that s = t_f v' + eta v = eta v. The torque is u = -2 eta^2 J v / (q4 t_f^2), theory.md 3.3.
    # The tolerance allows rounding errors.
    v, q4 = PAPER_ATTITUDE[:3], PAPER_ATTITUDE[3]
    torque = -2 * 3.0**2 * np.array([10.0, 12.0, 14.0]) * v / (q4 * 30.0**2)
    np.testing.assert_allclose(rows[0], [0.0, *PAPER_ATTITUDE, *[0.0] * 6, *torque, *3.0 * v], atol=1e-14)
    assert (rows[0, 0], rows[-1, 0]) == (0.0, 40.0)
    assert np.all(np.diff(rows[:, 0]) > 0)
    np.testing.assert_allclose(np.linalg.norm(rows[:, 1:5], axis=1), 1.0, atol=1e-14)
    # t_f is a grid point, so that the history contains the values of the summary exactly
    summary = json.loads((folder / "summary.json").read_text())
    (at_t_f,) = rows[rows[:, 0] == 30.0]
    assert summary["terminal_error"] == pytest.approx(np.linalg.norm(at_t_f[1:4]), rel=1e-12)
    after = np.linalg.norm(rows[rows[:, 0] >= 30.0][:, 1:4], axis=1)
    assert summary["hold_error"] == pytest.approx(after.max(), rel=1e-12)
    assert summary["peak_rate"] == pytest.approx(np.linalg.norm(rows[:, 5:8], axis=1).max(), rel=1e-12)
    momentum = np.linalg.norm(rows[:, 5:8] * [10.0, 12.0, 14.0], axis=1)
    assert summary["peak_momentum"] == pytest.approx(momentum.max(), rel=1e-12)


def test_empty_scenario_file_is_reported_as_case_one_of_the_paper(command, tmp_path):
    (tmp_path / "none.toml").write_text("# to come\n")
    status, _, said = command("simulate", "none.toml", "--quiet", "--no-figures")
    assert (status, said) == (0, "ptsmc: none.toml is empty; the paper's Case I is simulated\n")


@pytest.mark.parametrize("timing", ['clock = "flight"\nt_end = 6.47', 'clock = "anchored"\nt_end = 6.4700001'])
def test_last_row_of_the_history_is_at_t_end(command, tmp_path, timing):
    (tmp_path / "s.toml").write_text(SHORT.replace("t_end = 6.5", timing))
    assert command("simulate", "s.toml", "--quiet", "--no-figures")[0] == 0
    rows = history_of(tmp_path / "out" / "simulate-s")
    assert (rows[0, 0], rows[-1, 0]) == (0.0, float(timing.split("t_end = ")[1]))
    assert np.all(np.diff(rows[:, 0]) > 0)


def test_seed_and_trial_select_initial_state_and_noise_of_a_run(command, tmp_path):
    """The nominal run has the initial attitude of the file and the noise of the seed."""

    def fly(name, *options):
        assert command("simulate", "s.toml", "--out", name, "--quiet", "--no-figures", *options) == (0, "", "")
        return history_of(tmp_path / name)

    nominal, zero, three = fly("a"), fly("b", "--trial", 0), fly("c", "--trial", 3, "--seed", 4294967295)
    np.testing.assert_array_equal(fly("d", "--trial", 3, "--seed", 4294967295), three)
    np.testing.assert_allclose(nominal[0, 1:5], PAPER_ATTITUDE, atol=1e-15)  # quaternion of the file, normalised
    starts = [nominal[0, 1:5], zero[0, 1:5], three[0, 1:5], fly("e", "--trial", 3)[0, 1:5]]
    assert len({tuple(q) for q in starts}) == 4
    np.testing.assert_array_equal(fly("f", "--seed", 1)[0, 1:5], nominal[0, 1:5])
    assert np.any(fly("g", "--seed", 1)[-1] != nominal[-1])  # other noise


def test_simulate_reports_status_reason_and_time_of_a_failed_run(command, tmp_path):
    # with attitude noise of 10 rad, the law cannot avoid its singularity
    text = SHORT.replace("attitude_noise = 2e-5", "attitude_noise = 10.0")
    (tmp_path / "s.toml").write_text(text.replace("window = 1.0", "window = 1.0\nsettling_angle = 1e-3"))
    status, out, err = command("simulate", "s.toml", "--no-figures")
    assert (status, err) == (1, "")
    text = (tmp_path / "out" / "simulate-s" / "summary.json").read_text()
    assert "NaN" not in text
    summary = json.loads(text)
    assert summary["status"] in ("diverged", "singular")
    assert summary["reason"]
    assert 0.0 <= summary["bad_time"] <= 6.5
    assert f"status {summary['status']}: {summary['reason']}, at " in " ".join(out.split())
    assert [verdict["met"] for verdict in summary["verdicts"]] == [False]


@pytest.mark.parametrize(("gain", "limit", "is_reported"), [("", 1e-3, True), ("eta = 3.0", 1e-3, False),
                                                            ("", 3e3, False)])  # fmt: skip
def test_default_gains_are_reported_with_a_requirement_that_is_not_met(command, tmp_path, gain, limit, is_reported):
    text = SHORT_CHAIN.replace("delta = 0.5", gain).replace("peak_torque = 3.0", f"peak_torque = {limit}")
    (tmp_path / "s.toml").write_text(text)
    axes = "--x", "loop.period=0.1:0.11:2", "--y", "controller.disturbance_bound=0.01:0.02:2", "--trials", 2
    for name, *options in (("simulate",), ("montecarlo", "--trials", 8), ("map", *axes)):
        _, out, err = command(name, "s.toml", "--no-figures", *options)
        assert (("default gains; ptsmc tune searches" in out), err) == (is_reported, ""), name


def stop_at(monkeypatch, call):
    """Interrupt the evaluation with the number `call` of the search (1: the first, 0: none).

    Return a list with an item for each computed evaluation. Evaluations that are read from the journal are not in the
    list.
    """
    from tuning.search.evaluate import Evaluator
    from tuning.search.journal import Journal

    calls, computed = [], []
    measure, get = Evaluator.measure_with_gradients, Journal.get

    def interrupted(self, problem, z):
        calls.append(1)
        if len(calls) == call:
            raise KeyboardInterrupt
        return measure(self, problem, z)

    def counted(self, question, compute):
        def one():
            computed.append(1)
            return compute()

        return get(self, question, one)

    monkeypatch.setattr(Evaluator, "measure_with_gradients", interrupted)
    monkeypatch.setattr(Journal, "get", counted)
    return computed


@pytest.mark.parametrize("calls", short([[1, 4], [7]], [[1, 4]]))
def test_interrupted_search_writes_its_best_gains_and_resumes(command, tmp_path, monkeypatch, calls):
    """The first evaluation is before any result. Later ones are in the middle of a local search.

    The resumed search reads earlier evaluations from the journal and ends with the result of a search without
    interruption.
    """
    small_search(monkeypatch)
    (tmp_path / "s.toml").write_text(SHORT_CHAIN.replace("steps = 4", "steps = 2"))
    with monkeypatch.context() as patch:
        computed = stop_at(patch, 0)
        whole = command("tune", "s.toml", "--out", "whole", "--quiet", "--no-figures")[0]
        needed = len(computed)
    assert "journal.bin" not in tree(tmp_path / "whole")

    run, done = ("tune", "s.toml", "--out", "cut", "--no-figures"), 0
    for call in calls:
        with monkeypatch.context() as patch:
            computed = stop_at(patch, call)
            status, told, err = command(*run)
            done += len(computed)
        assert status == 130
        assert {"journal.bin", "scenario.toml", "versions.json"} <= set(tree(tmp_path / "cut"))
        if call == 1:
            assert "ptsmc: interrupted; the same command resumes it" in err
            assert not (tmp_path / "cut" / "tuned.toml").exists()
        else:
            assert "these are the best gains so far; the same command resumes the search" in told
            best = json.loads((tmp_path / "cut" / "summary.json").read_text())
            assert best["status"] == "interrupted"
            assert scenario.read(tmp_path / "cut" / "tuned.toml").controller.eta == best["gains"]["eta"]
            assert best["held_out"]["trials"] == 40
    assert command("simulate", "s.toml", "--out", "cut")[0] == 2  # the folder belongs to another command

    with monkeypatch.context() as patch:
        computed = stop_at(patch, 0)
        assert command(*run)[0] == whole
        assert len(computed) == needed - done  # earlier evaluations are read from the journal
    assert "journal.bin" not in tree(tmp_path / "cut")
    one, other = (json.loads((tmp_path / name / "summary.json").read_text()) for name in ("whole", "cut"))
    for summary in (one, other):
        summary["search"].pop("seconds")
    assert one == other


@pytest.mark.parametrize(
    ("stop", "status", "message"),
    [
        (KeyboardInterrupt(), 130, "interrupted; nothing was written"),
        (OSError(28, "No space left on device"), 2, "No space left on device"),
    ],
)
def test_stopped_run_prints_one_line_and_leaves_no_files(command, tmp_path, monkeypatch, stop, status, message):
    def stopped(*_, **__):
        raise stop

    monkeypatch.setattr(single, "write", stopped)
    before = tree(tmp_path)
    assert command("simulate", "s.toml", "--no-figures") == (status, "", f"ptsmc: {message}\n")
    assert tree(tmp_path) == before


def test_internal_error_is_raised_with_its_traceback(command, monkeypatch):
    def broken(*_):
        raise ValueError("ours")

    monkeypatch.setattr(runs, "simulate", broken)
    with pytest.raises(ValueError, match="ours"):
        command("simulate")


HELP = [[], ["simulate", "--help"], ["tune", "--help"], ["--help"], ["--version"]]


def test_help_and_version_import_neither_jax_nor_numpy():
    """The calls run one after the other in one process. The imports of the package and the command are part of it."""
    code = f"""
import sys
from tuning.cli.main import main
for args in {HELP}:
    sys.argv = ["ptsmc", *args]
    try: main()
    except SystemExit as told: assert not told.code
    assert not {{"jax", "jaxlib", "numpy", "scipy", "matplotlib", "optax"}} & set(sys.modules)
    print("---")
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    *helps, version, rest = done.stdout.split("---\n")
    assert len(helps) == len(HELP) - 1
    assert all("Usage: ptsmc" in told for told in helps)
    assert version.strip()
    assert rest == ""


def test_exit_status_is_1_for_a_violated_requirement_and_2_for_a_configuration_error(tmp_path):
    """Debug variables of JAX in the environment do not stop the run. A configuration error leaves no folder."""
    (tmp_path / "s.toml").write_text(SHORT_CHAIN.replace("peak_torque = 3.0", "peak_torque = 0.01"))
    run = ("simulate", tmp_path / "s.toml", "--out", tmp_path / "out", "--quiet", "--no-figures")
    # a user may set these variables to debug custom code; they must not stop a run with a NaN metric
    asked = dict.fromkeys(("JAX_DEBUG_NANS", "JAX_DEBUG_INFS"), "1")
    asked |= {"JAX_NUMPY_DTYPE_PROMOTION": "strict", "JAX_TRANSFER_GUARD": "disallow"}
    not_met = in_a_process(*run, **asked)
    assert (not_met.returncode, not_met.stdout, not_met.stderr) == (1, "", "")
    simulated = json.loads((tmp_path / "out" / "summary.json").read_text())
    (verdict,) = simulated["verdicts"]
    assert (simulated["status"], verdict["metric"], verdict["met"]) == ("ok", "peak_torque", False)
    (tmp_path / "s.toml").write_text("controller.eta = 2")
    bad = in_a_process("simulate", tmp_path / "s.toml", "--out", tmp_path / "other")
    assert (bad.returncode, bad.stdout) == (2, "")
    assert bad.stderr == "ptsmc: controller.eta is 2, but must be a number greater than 2 (Theorem 2)\n"
    assert not (tmp_path / "other").exists()


def in_a_process(*args, then="", **variables):
    """Run `ptsmc` in a new process and return the finished process with its output as text.

    args: of `ptsmc`. then: Python code to execute at its end. variables: environment variables.
    """
    code = f"import sys\nfrom tuning.cli.main import main\ntry: main()\nfinally:\n    {then or 'pass'}"
    command, quickly = [sys.executable, "-c", code, *map(str, args)], os.environ | {"XLA_FLAGS": QUICKLY} | variables
    return subprocess.run(command, capture_output=True, text=True, cwd=ROOT, env=quickly, check=False)


def test_simulate_refuses_a_nominal_initial_state_at_the_singularity(command, tmp_path):
    (tmp_path / "s.toml").write_text("initial.quat_xyzw = [1, 0, 0, 0]\n" + SHORT)
    assert "initial.quat_xyzw is [1.0, 0.0, 0.0, 0.0]" in refused(command, tmp_path, "simulate", "s.toml")
    assert command("simulate", "s.toml", "--trial", 0, "--no-figures", "--quiet")[0] in (0, 1)  # random initial state


@pytest.mark.skipif(shutil.which("bash") is None, reason="there is no bash")
def test_bash_completes_commands_and_options(command, tmp_path):
    """Scripts for zsh, fish and PowerShell have the commands, and other shells are refused."""
    status, script, _ = command("completion", "bash")
    assert status == 0
    (tmp_path / "complete.sh").write_text(script)
    asked = """
source complete.sh
for words in "mo" "tune --gl" "convert-attitude --mr" "replay --tri"; do
  COMP_WORDS=(ptsmc $words); COMP_CWORD=$((${#COMP_WORDS[@]} - 1)); COMPREPLY=()
  _ptsmc; echo "${COMPREPLY[@]}"
done
"""
    done = subprocess.run(["bash", "-c", asked], cwd=tmp_path, capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == ["montecarlo", "--global-check", "--mrp", "--trial"]
    for shell in ("zsh", "fish", "powershell"):
        assert "convert-attitude" in command("completion", shell)[1]
    assert command("completion", "tcsh")[::2] == (
        2,
        'ptsmc: Invalid value "tcsh" for SHELL. Choose from: "bash", "zsh", "fish", "powershell".\n',
    )


def test_long_run_prints_its_number_of_integration_steps(command, monkeypatch):
    run = ("simulate", "s.toml", "--no-figures", "--force")
    parts = scenario.study(scenario.read("s.toml")).parts
    steps = timing.count_steps(parts)
    assert steps == parts.clock.ticks(parts.controller.t_f, parts.controller.delta).t.size * parts.substeps
    assert "integration steps" not in command(*run)[2]
    monkeypatch.setattr("tuning.output.progress.INTERVAL", 0.001)
    assert f"ptsmc: simulating {steps} integration steps with their history, 0 s so far\n" in command(*run)[2]
    assert command(*run, "--quiet")[1:] == ("", "")


def test_unknown_matplotlib_backend_does_not_stop_a_command():
    """Earlier, such a campaign ended with a traceback after its simulations, without a summary."""
    code = """
from tuning.cli import main
main.main = lambda: __import__("matplotlib") and print("whole")
from tuning.cli import command
command()
"""
    bogus = {**os.environ, "MPLBACKEND": "bogus"}
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, env=bogus, check=False
    )
    assert (done.returncode, done.stdout) == (0, "whole\n"), done.stderr
