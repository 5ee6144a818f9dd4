"""`ptsmc montecarlo`, `summarize`, `worst` and `replay` as a user calls them."""

import json
import re
from dataclasses import replace

import jax
import numpy as np
import polars as pl
import pytest

from ptsmc_jax.campaigns import campaign, montecarlo, store
from ptsmc_jax.simulation import rollout
from tests.helpers import SHORT, SHORT_CHAIN, refused, rows_of, same, short
from tests.output.pages import checked
from tuning.output import formats, progress
from tuning.studies import campaign_summary

pytestmark = pytest.mark.usefixtures("small_parts")
SCENARIO, FOLDER = SHORT_CHAIN, "out/montecarlo-s"
MANY = 70  # number of trials, large enough for the compiled program of many trials
OVERSHOOT = """
import jax.numpy as jnp

def overshoot(result, parts):
    error = jnp.sqrt(jnp.sum(result.log.error ** 2, axis=-1))
    return {"overshoot": jnp.max(jnp.where(result.log.t > parts.controller.t_f, error, 0.0))}

nothing = 3
"""


def summary(folder):
    """Return the content of summary.json in a folder as a dict."""
    return json.loads((folder / "summary.json").read_text())


@pytest.fixture
def simulated(command, tmp_path):
    """Return the result folder of a campaign of 250 trials with seed 3 that meets its requirement."""
    assert command("montecarlo", "s.toml", "--trials", 250, "--seed", 3, "--no-figures", "--quiet") == (0, "", "")
    return tmp_path / FOLDER


PLANTS = {"chain": (SHORT_CHAIN, "3 u"), "spacecraft": (SHORT, "30 N m")}


@pytest.mark.parametrize("plant", short(PLANTS, ["chain"]))
def test_montecarlo_writes_rows_summary_and_figures(command, tmp_path, monkeypatch, plant):
    """Output, page and summary agree with the statistics of the rows."""
    text, limit = PLANTS[plant]
    (tmp_path / "s.toml").write_text(text)
    monkeypatch.setattr(progress, "INTERVAL", 0.05)
    code, said, err = command("montecarlo", "s.toml", "--trials", 250, "--seed", 3)
    folder = tmp_path / FOLDER
    assert code == 0
    assert "ptsmc: summing up, " in err
    assert "250 trials of seed 3: 250 ok" in said
    assert f"peak_torque at most {limit}: worst" in said
    assert "100 % of trials keep the limit (95 %: 98.54 to 100 %)" in said  # 0.025^(1/250)
    names = {"scenario.toml", "versions.json", "theory.json", "summary.json", "trials", "figures"}
    assert {path.name for path in folder.iterdir()} == names
    assert [path.name[:21] for path in sorted((folder / "trials").iterdir())] == [
        "0000000000-0000000099", "0000000100-0000000199", "0000000200-0000000249"
    ]  # fmt: skip
    figures = {path.name for path in (folder / "figures").iterdir()}
    assert figures == {"fan.png", "distributions.png", "torque_by_angle.png", "inputs.png"}
    mark = store.MADE_OF_RESULTS["figures/*.png"]
    assert all(mark in (folder / "figures" / name).read_bytes()[:1024] for name in figures)
    read = checked(folder)
    assert "ptsmc montecarlo s.toml --trials 250 --seed 3" in read.text
    found, rows = summary(folder), rows_of(folder)
    assert (found["status"], found["simulated"], found["counts"]["ok"]) == ("met", 250, 250)
    errors = rows["window_error"].to_numpy()
    told = found["quantiles"]["window_error"]
    least = found["lower_bound"]
    assert 0.0 < least < told["rms"]
    for place in (said, read.text):
        rms, bound = (formats.format_error(value, plant) for value in (told["rms"], least))
        assert f"RMS {formats.error_name(plant)} {rms}: every requirement is met" in place
        assert f"{formats.format_ratio(told['rms'] / least)} times the lower bound of {bound}" in place
    np.testing.assert_allclose([told["mean"], told["rms"], told["max"]],
                               [errors.mean(), np.sqrt(np.mean(errors**2)), errors.max()], rtol=1e-12)  # fmt: skip
    assert told["0.9"]["value"] == np.sort(errors)[224]
    assert told["0.9"]["low"] < told["0.9"]["value"] < told["0.9"]["high"]
    assert told["0.9973"]["high"] is None  # 250 trials are too few for an upper bound
    unsettled = rows["settling_time"].null_count()
    assert found["quantiles"]["settling_time"]["without_value"] == unsettled


@pytest.mark.parametrize(("drawn", "instead"), short([(r"\[0.5, 0.1\]", "[0, 0]"), ("x0 = {.*", "")],
                                                     [(r"\[0.5, 0.1\]", "[0, 0]")]))  # fmt: skip
def test_trials_with_equal_metrics_cause_a_warning(command, tmp_path, simulated, drawn, instead):
    """The scenario has no dispersion, or one of zero width, which compiled programs of other tests can simulate."""
    assert not [said for said in summary(simulated)["warnings"] if "the same metrics: neither" in said]
    text = re.sub(drawn, instead, SHORT_CHAIN).replace("[2e-5, 1e-5]", "[0, 0]")
    (tmp_path / "same.toml").write_text(text)
    _, said, _ = command("montecarlo", "same.toml", "--trials", 250, "--no-figures")
    assert "WARNING: all 250 trials have the same metrics: neither" in said


def test_failed_trials_without_metrics_cause_no_warning_of_equal_metrics():
    assert campaign_summary._equal_trials({"window_error": {"without_value": 5}}, 5) == []
    at_rest = {"window_error": {"without_value": 0, "mean": 0.0, "max": 0.0}}
    (said,) = campaign_summary._equal_trials(at_rest, 5)
    assert said.startswith("all 5 trials have the same metrics: neither [dispersion] nor")
    at_rest["window_error"]["without_value"] = 4  # only one trial has a value
    assert campaign_summary._equal_trials(at_rest, 5) == []


def test_more_trials_extend_an_existing_campaign(command, simulated, tmp_path):
    """Complete files of rows are not written again. Fewer trials than exist are refused."""
    before = rows_of(simulated)
    files = {path: path.stat().st_mtime_ns for path in (simulated / "trials").iterdir()}
    assert command("montecarlo", "s.toml", "--trials", 420, "--seed", 3, "--no-figures", "--quiet")[0] == 0
    after = rows_of(simulated)
    assert after["trial"].to_list() == list(range(420))
    same(after[:250], before)
    kept = [path for path in files if path.exists() and path.stat().st_mtime_ns == files[path]]
    assert len(kept) == 2  # the third part was a short one
    said = refused(command, tmp_path, "montecarlo", "s.toml", "--trials", 300, "--seed", 3)
    assert "--trials is 300, but must be at least 420" in said


@pytest.mark.parametrize("from_table", [False, True])
def test_trials_that_are_simulated_again_are_not_counted_twice_in_the_progress(command, monkeypatch, from_table):
    standing = []
    monkeypatch.setattr(progress.CampaignProgress, "__call__", lambda _, tally: standing.append(replace(tally)))
    for trials in (10, 20):
        dry = ["--dry-run"] if from_table else []
        command("montecarlo", "s.toml", "--trials", trials, "--out", "more", "--no-figures", "--quiet", *dry)
    assert [(tally.done, tally.total) for tally in standing] == [(0, 10), (10, 10), (0, 20), (20, 20)]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (["--seed", 4], "holds a run with seed 3, not 4"),
        (["--metrics", "m.py:overshoot"], "holds a run without metrics; allowed is"),
        ("eta", "holds a run of another scenario: controller.eta is 3.0 there, and 2.7 here"),
    ],
)
def test_another_campaign_in_the_same_folder_is_refused(command, simulated, tmp_path, change, said):
    """With --force, the other campaign replaces the first one. Files of the user are kept."""
    (tmp_path / "m.py").write_text(OVERSHOOT)
    options = ["--seed", 3]
    if change == "eta":
        (tmp_path / "s.toml").write_text(SHORT_CHAIN.replace("[controller]", "[controller]\neta = 2.7"))
    else:
        options = change if "--seed" in change else [*options, *change]
    assert said in refused(command, tmp_path, "montecarlo", "s.toml", "--trials", 250, *options)
    if "--metrics" not in options:  # custom metrics would compile another program
        again = ("montecarlo", "s.toml", "--trials", 110, *options, "--force", "--no-figures", "--quiet")
        mine = "runs/mine.parquet", "run_table.parquet", "controller/mine.c", "figures/mine.png"  # a user's own
        for name in mine:
            (simulated / name).parent.mkdir(exist_ok=True)
            (simulated / name).write_text("mine")
        assert command(*again, "--dry-run")[0] == 0
        assert [(simulated / name).read_text() for name in mine] == ["mine"] * 4
        assert not (simulated / "summary.json").exists()  # the summary of the earlier campaign must not remain
        (simulated / "trials" / "mine.parquet").write_text("mine")
        code, _, error = command(*again)
        assert (code, "mine.parquet is no part of a campaign; it is kept as mine.parquet.damaged" in error) == (0, True)
        assert rows_of(simulated)["trial"].to_list() == list(range(110))


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--device", "tpu"], 'Invalid value "tpu" for --device. Choose from: "cpu", "gpu".'),
        (["--precision", "16"], 'Invalid value "16" for --precision. Choose from: "64", "32".'),
        (["--precision", "32", "--cluster", "local:2"], "--cluster simulates on the workers' processors with 64 bits"),
        (["--trials", "0"], 'Invalid value "0" for --trials. Must be >= 1.'),
        (["--trials", "1e4"], "for --trials: 1e4 is no whole number"),
        (["--seed", "-1"], "--seed"),
        (["--shard", "3/2"], "--shard is 3/2, but must be I/N with I from 1 to N"),
        (["--shard", "half"], "--shard is half, but must be I/N"),
        (["--until-confident", "1"], "for --until-confident. Must be < 1."),
        (["--until-confident", "0.0"], "for --until-confident. Must be > 0."),
        (["--until-confident", "nan"], "for --until-confident. Must be < 1."),
        (["--until-confident", "0.1", "--dry-run"], "Mutually exclusive arguments: {--until-confident, --dry-run}"),
        (["--cluster", "local:2", "--shard", "1/2"], "Mutually exclusive arguments: {--shard, --cluster}"),
        (["--cluster", "local:none"], "--cluster is local:none, but must be local:N"),
        (["--cluster", "there.json"], "--cluster is there.json, which does not exist"),
        (["--tls-ca", "ca.pem"], "--tls-ca, --tls-cert and --tls-key need --cluster"),
        (["--metrics", "none.py:f"], "--metrics is none.py:f: the file none.py does not exist"),
        (["--metrics", "m.py:nothing"], "--metrics is m.py:nothing: it is of type int, but must be"),
        (["--metrics", "m.py:no"], "--metrics is m.py:no: m.py has no such name; allowed is"),
    ],
)
def test_invalid_options_of_montecarlo_print_one_line_and_write_nothing(command, tmp_path, options, said):
    (tmp_path / "m.py").write_text(OVERSHOOT)
    line = refused(command, tmp_path, "montecarlo", "s.toml", *options)
    assert line.startswith("ptsmc: ")
    assert said in line


NO_REQUIREMENTS = SHORT_CHAIN.replace("[requirements]\npeak_torque = 3.0\n", "")
HALF = SHORT_CHAIN.replace("peak_torque = 3.0", "peak_torque = 0.38")  # about half of the trials keep this limit


def test_a_campaign_warns_first_of_requirements_that_its_trials_cannot_verify(command, tmp_path, monkeypatch):
    limit = "peak_torque = { limit = 3.0, quantile = 0.99, confidence = 0.9 }\neffort = 9.0"
    (tmp_path / "s.toml").write_text(SHORT_CHAIN.replace("peak_torque = 3.0", limit))
    monkeypatch.setattr("tuning.studies.campaign_folder.begin", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    few, enough = (command("montecarlo", "s.toml", "--trials", count)[2] for count in (229, 230))
    assert few.startswith("ptsmc: peak_torque in 99 % of trials with 90 % confidence takes at least 230 trials")
    assert "takes" not in enough
    assert "effort" not in few


def test_until_confident_without_requirements_is_refused(command, tmp_path):
    (tmp_path / "s.toml").write_text(NO_REQUIREMENTS)
    assert "needs [requirements]" in refused(command, tmp_path, "montecarlo", "s.toml", "--until-confident", "0.1")


def test_until_confident_stops_at_the_required_interval_width(command, tmp_path):
    """The width is about 4 sqrt(p (1 - p) / n), so 0.1 needs 400 trials.

    A repeated command simulates no more trials. Existing trials count, and the campaign stops at the next check.
    """
    (tmp_path / "s.toml").write_text(HALF)
    code, said, _ = command("montecarlo", "s.toml", "--until-confident", "0.11", "--trials", 5000, "--no-figures")
    found = summary(tmp_path / FOLDER)
    assert code == 1
    assert "NOT met" in said
    assert found["simulated"] == found["trials"] == 400
    low, high = found["verdicts"][0]["fraction_interval"]
    assert 0.0 < high - low <= 0.11
    again = command("montecarlo", "s.toml", "--until-confident", "0.11", "--trials", 5000, "--no-figures")
    assert again[0] == 1
    assert summary(tmp_path / FOLDER)["simulated"] == 400
    command("montecarlo", "s.toml", "--trials", 600, "--no-figures")
    command("montecarlo", "s.toml", "--until-confident", "0.11", "--trials", 5000, "--no-figures")
    assert summary(tmp_path / FOLDER)["simulated"] == 800  # the first check after the 600 existing trials


def test_interrupted_until_confident_ends_with_the_same_number_of_trials(command, tmp_path, monkeypatch):
    """The campaign checks after 100, 200 and 400 trials, also if it is interrupted after 300 trials."""
    (tmp_path / "s.toml").write_text(HALF)
    confident = "montecarlo", "s.toml", "--trials", 5000, "--until-confident", "0.12", "--no-figures"
    write = campaign.Rows.write
    for interrupted in (False, True):
        out = "--out", f"out/{interrupted}"
        if interrupted:

            def until(self, first, frame):
                if first + frame.height > 300:
                    raise KeyboardInterrupt
                return write(self, first, frame)

            monkeypatch.setattr(campaign.Rows, "write", until)
            assert command(*confident, *out)[0] == 130
            monkeypatch.setattr(campaign.Rows, "write", write)
        assert command(*confident, *out)[0] == 1
    whole, again = (tmp_path / "out" / name for name in ("False", "True"))
    assert summary(whole) == summary(again)
    assert summary(whole)["simulated"] == 400
    made = [store.read_versions(folder) | {"command_line": ""} for folder in (whole, again)]
    assert made[0] == made[1]
    assert rows_of(whole).equals(rows_of(again))


@pytest.mark.parametrize(("made", "said"), [("tune", 1), ("montecarlo", 0)])
def test_montecarlo_warns_if_it_repeats_the_training_trials_of_tuned_gains(command, tmp_path, made, said):
    """`tune --seed 1000` and a default campaign have the same dispersions and noise, which would verify nothing."""
    found = tmp_path / "found"
    found.mkdir()
    (found / "versions.json").write_text(json.dumps({"command": made, "seed": 1000}))
    (found / "tuned.toml").write_text(SHORT_CHAIN)
    asked = "montecarlo", found / "tuned.toml", "--trials", 4, "--dry-run", "--quiet"
    for seed, times in ((), said), (("--seed", 7, "--out", "other"), 0):
        code, _, error = command(*asked, *seed)
        assert code == 0
        assert error.count("with the same trials of seed 1000; use another --seed") == times


def test_dry_run_writes_the_inputs_of_the_trials(command, tmp_path):
    code, said, _ = command("montecarlo", "s.toml", "--trials", 250, "--seed", 3, "--dry-run")
    folder = tmp_path / FOLDER
    assert (code, "run table of 250 trials" in said) == (0, True)
    assert not (folder / "trials").exists()
    run_table = pl.concat([pl.read_parquet(path) for path in sorted((folder / "runs").iterdir())])
    assert command("montecarlo", "s.toml", "--trials", 250, "--seed", 3, "--no-figures", "--quiet")[0] == 0
    same(run_table, rows_of(folder).select(run_table.columns))


def test_shards_in_one_folder_or_several_make_the_whole_campaign(command, simulated, tmp_path):
    """A campaign with missing shards is reported as not finished."""
    whole, options = rows_of(simulated), ["--trials", 250, "--seed", 3, "--no-figures"]
    for k in (1, 2):
        code, said, _ = command("montecarlo", "s.toml", *options, "--shard", f"{k}/2", "--out", "one")
        assert code == 0
        assert f"shard {k}/2 done: {(200 - 50, 250)[k - 1]} of 250 trials are in one" in said
        command("montecarlo", "s.toml", *options, "--shard", f"{k}/2", "--out", f"part{k}", "--quiet")
    code, said, _ = command("summarize", "part1", "--no-figures")
    assert (code, "NOT finished: 150 of 250 trials" in said) == (1, True)
    assert summary(tmp_path / "part1")["status"] == "incomplete"
    for path in (tmp_path / "part2" / "trials").iterdir():  # merge the shards into one folder
        path.rename(tmp_path / "part1" / "trials" / path.name)
    for folder in ("one", "part1"):
        assert command("summarize", folder, "--no-figures", "--quiet") == (0, "", "")
        same(rows_of(tmp_path / folder), whole)


def test_more_trials_of_a_campaign_of_another_code_version_are_refused(command, simulated, tmp_path):
    """With --force, the campaign is simulated again."""
    store.write_json(simulated / "versions.json", store.read_versions(simulated) | {"code_checksum": "before"})
    more = "montecarlo", "s.toml", "--trials", 260, "--seed", 3, "--no-figures", "--quiet"
    assert "another version of the source code (checksum before, not " in refused(command, tmp_path, *more)
    assert command(*more, "--force") == (0, "", "")
    assert store.read_versions(simulated)["code_checksum"] == store.packages()["code_checksum"]


def test_force_is_refused_for_one_of_several_shards(command, tmp_path):
    """It would delete the rows of the other shards. Shard 1/1 may use it."""
    options = "--trials", 250, "--seed", 3, "--no-figures", "--quiet", "--out", "one"
    assert command("montecarlo", "s.toml", *options, "--shard", "1/2") == (0, "", "")
    refused(command, tmp_path, "montecarlo", "s.toml", *options, "--shard", "2/2", "--force")
    assert command("montecarlo", "s.toml", *options, "--shard", "1/1", "--force") == (0, "", "")


def test_damaged_part_of_a_campaign_is_reported_and_simulated_again(command, simulated, tmp_path):
    """Commands that only read the campaign refuse it. The damaged file is renamed, not deleted."""
    whole = rows_of(simulated)
    part = sorted((simulated / "trials").iterdir())[1]
    part.write_bytes(part.read_bytes()[:-100])
    for asked in (["summarize", FOLDER], ["worst", FOLDER], ["replay", FOLDER, "--trial", 120], ["report", FOLDER]):
        error = refused(command, tmp_path, *asked)
        assert part.name in error
        assert "damaged" in error
    code, _, error = command("montecarlo", "s.toml", "--trials", 250, "--seed", 3, "--no-figures", "--quiet")
    assert code == 0
    assert f"{part.name} is damaged and is simulated again" in error
    same(rows_of(simulated), whole)
    assert part.with_name(part.name + ".damaged").exists()  # damaged files are renamed, not deleted


def test_a_campaign_whose_scenario_file_was_changed_is_refused(command, simulated, tmp_path):
    """A new comment in the file is no change."""
    scenario = simulated / "scenario.toml"
    written = scenario.read_text()
    scenario.write_text(written.replace("\nt_end = ", "\nt_end = 1"))
    again = "montecarlo", f"{FOLDER}/scenario.toml", "--trials", 250, "--seed", 3, "--out", FOLDER, "--no-figures"
    for asked in (["summarize", FOLDER], ["worst", FOLDER], ["replay", FOLDER, "--trial", 120], again):
        error = refused(command, tmp_path, *asked)
        assert "scenario.toml was changed after the run" in error
        assert "damaged" not in error
    scenario.write_text(f"# a comment\n{written}")
    assert command("summarize", FOLDER, "--no-figures", "--quiet") == (0, "", "")


def test_worst_lists_trials_that_replay_reproduces(command, simulated, tmp_path):
    """The nearest name of a metric is suggested. A trial that is not in the campaign is refused."""
    whole = rows_of(simulated)
    code, said, _ = command("worst", FOLDER, "--by", "peak_torque", "-n", 3)
    kept = pl.read_csv(simulated / "worst.csv")
    order = whole.sort("peak_torque", descending=True)[:3]
    assert code == 0
    assert kept["trial"].to_list() == order["trial"].to_list()
    assert str(order["trial"][0]) in said
    head = ("trial", "status", "peak_torque [u]", "window_error [x1]", "settling_time [s]", "initial_angle [x1]")
    assert re.split("  +", said.splitlines()[0].strip()) == list(head)
    trial = order["trial"][0]
    code, said, _ = command("replay", FOLDER, "--trial", trial, "--no-figures")
    assert code == 0
    assert "its row" in said
    made = json.loads((simulated / "replay" / str(trial) / "summary.json").read_text())
    assert made["peak_torque"] == pytest.approx(order["peak_torque"][0], rel=1e-12)
    assert (simulated / "replay" / str(trial) / "trajectory.csv").exists()
    error = refused(command, tmp_path, "replay", FOLDER, "--trial", 250)
    assert "--trial is 250, but must be a whole number from 0 to 249" in error
    assert "the nearest known one is peak_torque" in refused(command, tmp_path, "worst", FOLDER, "--by", "peek_torque")
    assert "known are terminal_error, " in refused(command, tmp_path, "worst", FOLDER, "--by", "xyz")


def test_replay_that_differs_from_its_row_has_exit_status_1(command, simulated):
    """The output has the largest relative difference.

    The changed row has a valid checksum, as if another version had computed it.
    """
    from tuning.studies import campaign_folder

    opened = campaign_folder.open_folder(simulated)
    first = opened.intact_parts()[0]
    changed = pl.read_parquet(first.path).with_columns(effort=pl.col("effort") * (1 + 1e-9))
    first.path.unlink()
    opened.rows.write(0, changed)
    code, said, _ = command("replay", FOLDER, "--trial", 5, "--no-figures")
    assert (code, "NOT equal its row: largest relative difference 1.0e-09" in said) == (1, True)


@pytest.mark.long
def test_replay_equals_its_row_exactly(command, tmp_path):
    """The error is 1e-6, so that rounding errors of another program are visible at 1e-11. A replay has none."""
    (tmp_path / "h.toml").write_text(
        'controller = { error = "multiplicative", t_f = 12.0, delta = 0.5, sign_width = 0.0 }\n'
        'loop = { mode = "sampled", period = 0.05, t_end = 13.0, clock = "flight" }\n'
        "hardware = { attitude_noise = 2e-5, rate_noise = 1e-6, torque_lag = 0.1 }\n"
        'reference = { kind = "sinusoid" }\nfilter = { kind = "steady_state" }\n'
        "dispersion = { attitude = {}, inertia = {} }\n"
    )
    assert command("montecarlo", "h.toml", "--trials", 70, "--no-figures", "--quiet")[0] in (0, 1)
    for trial in (0, 33, 69):
        code, said, _ = command("replay", "out/montecarlo-h", "--trial", trial, "--no-figures")
        assert (code, "equals its row to the last digit" in said) == (0, True)
    command("montecarlo", "h.toml", "--trials", 71, "--no-figures", "--quiet")
    rows = rows_of(tmp_path / "out/montecarlo-h")
    command("montecarlo", "h.toml", "--trials", 7, "--no-figures", "--quiet", "--out", "few")
    assert rows_of(tmp_path / "few").equals(rows.head(7))  # the same program simulates few trials


@pytest.mark.parametrize("asked", [["summarize"], ["worst"], ["replay", "--trial", "1"]])
def test_a_folder_without_a_campaign_is_refused(command, tmp_path, asked):
    (tmp_path / "empty").mkdir()
    for folder in ("empty", "not-there"):
        error = refused(command, tmp_path, asked[0], folder, *asked[1:])
        assert (
            f"{folder} is not a campaign, or its versions.json is damaged; allowed is a folder of `ptsmc montecarlo`"
            in error
        )
    assert command("simulate", "s.toml", "--out", "run", "--no-figures", "--quiet")[0] == 0
    assert "run has results of `ptsmc simulate`" in command(asked[0], "run", *asked[1:])[2]


def test_repeated_summary_does_not_depend_on_the_order_of_limits(command, tmp_path):
    """Earlier, another order of the verdicts deleted page and worst trials as files of another campaign."""
    limits = "[requirements]\npeak_torque = { limit = 3.0, quantile = 0.9 }\nwindow_error = 1.0"
    (tmp_path / "s.toml").write_text(SHORT_CHAIN.replace("[requirements]\npeak_torque = 3.0", limits))
    code, said, _ = command("montecarlo", "s.toml", "--trials", 120, "--no-figures", "--seed", 3)
    made = summary(tmp_path / FOLDER)
    command("worst", FOLDER)
    assert command("summarize", FOLDER, "--no-figures") == (code, said, "")
    assert summary(tmp_path / FOLDER) == made
    assert (tmp_path / FOLDER / "worst.csv").exists()


@pytest.fixture
def lost(monkeypatch):
    """Return a function without arguments; after its call, every fourth trial fails, from trial 0 on.

    Trials whose number is divisible by 8 diverge, and the others become singular. `test_campaign.py` simulates trials
    that fail.
    """

    def run(parts, dispersion, seed, trials, *more, simulated=montecarlo.run, **how):
        result, fails = simulated(parts, dispersion, seed, trials, *more, **how), np.asarray(trials) % 4 == 0
        codes = np.where(np.asarray(trials) % 8 == 0, rollout.DIVERGED, rollout.SINGULAR)
        return replace(
            result,
            status=np.where(fails, codes, result.status).astype(result.status.dtype),
            bad_time=np.where(fails, 1e-2 * np.asarray(trials), result.bad_time),
        )

    return lambda: monkeypatch.setattr(montecarlo, "run", run)


def test_failed_trials_are_counted_with_reason_and_time(command, tmp_path, lost):
    """They count as failures of the requirement, and `ptsmc worst` lists them first."""
    lost()
    code, said, _ = command("montecarlo", "s.toml", "--trials", 250)
    found = summary(tmp_path / FOLDER)
    assert code == 1
    assert sum(reason["trials"] for reason in found["reasons"]) == 250 - found["counts"]["ok"]
    for reason in found["reasons"]:
        assert f"{reason['trials']} {reason['status']}: {reason['reason']}, the first at" in said
        assert 0.0 <= reason["first_bad_time"] <= 6.5
    first = {reason["status"]: (reason["trials"], reason["first_bad_time"]) for reason in found["reasons"]}
    assert first == {"diverged": (32, 0.0), "singular": (31, 0.04)}
    failed = found["counts"]["diverged"] + found["counts"]["singular"]
    assert found["verdicts"][0]["failures"] >= failed > 30
    code, said, _ = command("worst", FOLDER, "-n", 2)
    assert set(pl.read_csv(tmp_path / FOLDER / "worst.csv")["status"]) <= {"diverged", "singular"}


def test_failed_trials_cause_exit_status_1_even_without_requirements(command, tmp_path, lost):
    (tmp_path / "s.toml").write_text(NO_REQUIREMENTS)
    assert command("montecarlo", "s.toml", "--trials", MANY, "--no-figures", "--quiet")[0] == 0
    lost()
    assert command("montecarlo", "s.toml", "--trials", MANY, "--no-figures", "--quiet", "--out", "b")[0] == 1


def test_single_precision_campaign_has_nearly_equal_rows(command, tmp_path, monkeypatch):
    """The option sets JAX to 32 bits. The test sets them by itself, because JAX is configured already.

    A replay uses 32 bits too. The folder is refused for a campaign with 64 bits.
    """
    asked = []
    monkeypatch.setattr("ptsmc_jax.configure.configure", lambda **told: asked.append(told))
    run = ("montecarlo", "s.toml", "--trials", MANY, "--no-figures", "--quiet")
    assert command(*run, "--out", "whole")[0] == 0
    with jax.enable_x64(False):
        assert command(*run, "--out", "half", "--precision", 32)[0] == 0
        code, _, error = command("replay", "half", "--trial", 7, "--no-figures")
    assert (code, error) == (0, "")
    made = json.loads((tmp_path / "half" / "replay" / "7" / "versions.json").read_text())
    assert made["campaign"] == str(tmp_path / "half")  # `ptsmc simulate` with 64 bits cannot repeat it
    assert asked == [{"device": "cpu", "bits": bits, "keep_programs": True} for bits in (64, 32, 32)]
    whole, half = (pl.read_parquet(tmp_path / name / "trials") for name in ("whole", "half"))
    assert half["window_error"].dtype == pl.Float32
    np.testing.assert_array_equal(half["status"], whole["status"])
    np.testing.assert_allclose(half["peak_torque"], whole["peak_torque"], rtol=1e-3)
    np.testing.assert_allclose(half["window_error"], whole["window_error"], atol=1e-5)
    assert "holds a run with precision 32, not 64" in refused(command, tmp_path, *run, "--out", "half")
