"""`ptsmc report`: pages that need nothing else, say the verdict first and run nothing that a user typed."""

import base64
import json
import os
import re
import shutil
import subprocess
import tempfile

import numpy as np
import pytest

from ptsmc_jax.campaigns import store
from ptsmc_jax.simulation import catalogues
from ptsmc_jax.simulation.requirements import Requirement
from tests.helpers import SHORT_CHAIN, refused, short, tree
from tests.output import examples
from tests.output.pages import checked
from tuning.output import campaign_report, page, page_charts, report

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
HOSTILE = "<img src=x onerror=document.title=1>\"'&</script><script>alert(1)</script>"


def in_chromium(path, tmp_path, *options):
    """Return the HTML of a page after rendering by Chromium, and the list of messages of its console.

    options: of Chromium. Two harmless messages are left out.
    """
    assert CHROMIUM is not None
    with tempfile.TemporaryDirectory() as home:
        done = subprocess.run(
            [CHROMIUM, "--headless", "--no-sandbox", "--enable-unsafe-swiftshader", "--virtual-time-budget=8000",
             "--enable-logging=stderr", "--disable-background-networking", f"--user-data-dir={home}", *options,
             path.as_uri()],
            capture_output=True, text=True, timeout=300, check=True, env={**os.environ, "HOME": home},
        )  # fmt: skip
    said = [line for line in done.stderr.splitlines() if "CONSOLE" in line]
    harmless = ("GL Driver Message", "willReadFrequently")
    return done.stdout, [line for line in said if not any(word in line for word in harmless)]


@pytest.fixture(scope="module")
def kept(tmp_path_factory):
    """Return the path of the results that `simulated` computes for its first test and copies for every test."""
    return tmp_path_factory.mktemp("kept") / "run"


@pytest.fixture
def simulated(command, kept, tmp_path):
    """Return the folder of a copy of the results of one run."""
    if not kept.exists():
        assert command("simulate", "s.toml", "--trial", 3, "--seed", 5, "--out", kept, "--quiet")[0] in (0, 1)
    return shutil.copytree(kept, tmp_path / "run")


def test_report_page_has_the_numbers_and_charts_of_the_run(command, simulated):
    """The page shows metrics with units, dispersions, command, scenario and history. No other file changes."""
    before = tree(simulated)
    code, said, error = command("report", "run")
    assert (code, said.strip(), error) == (0, f"page in {os.path.join('run', 'report.html')}", "")
    after = tree(simulated)
    assert {name: content for name, content in after.items() if name != "report.html"} == before
    read = checked(simulated)
    assert after["report.html"].decode() == page.build(simulated)
    assert store.MADE_OF_RESULTS["report.html"] in after["report.html"][:1024]
    summary = json.loads((simulated / "summary.json").read_text())
    angle = np.degrees(summary["window_angle"])
    assert f"window_angle {3600.0 * angle if angle < 1.0 else angle:.5g}" in read.text
    assert f"{summary['window_error']:.5g}" not in read.text  # the same error as a number without a unit
    assert f"peak_torque {summary['peak_torque']:.5g} N m" in read.text
    assert summary["settling_time"] is None
    assert "settling_time never s" in read.text
    assert f"initial_w2 {summary['drawn']['initial_w2']['value']:.6g} rad/s" in read.text
    assert "ptsmc simulate s.toml --trial 3 --seed 5" in read.text
    assert (simulated / "scenario.toml").read_text().split("\n")[0] in read.text
    rows = np.genfromtxt(simulated / "trajectory.csv", delimiter=",", names=True)
    history = {line["name"]: line for line in read.charts["history"]["data"]}
    assert set(history) == {name for name in rows.dtype.names or () if not name.startswith(("t", "measured", "sent"))}
    marked = {note["text"]: note["x"] for note in read.charts["history"]["layout"]["annotations"]}
    assert {name: marked[name] for name in ("t_f", "t_f - delta")} == {"t_f": 5.0, "t_f - delta": 4.5}
    assert [shape["x0"] for shape in read.charts["history"]["layout"]["shapes"]] == [5.0, 4.5]
    for name in ("q4", "w2", "u3"):
        np.testing.assert_allclose(history[name]["x"], rows["t"], rtol=1e-5, atol=1e-9)
        np.testing.assert_allclose(history[name]["y"], rows[name], rtol=1e-5, atol=1e-12)
    assert command("report", "run", "--quiet") == (0, "", "")  # again, in place


def test_attitude_animation_of_the_page_equals_the_simulated_attitude(simulated):
    made = checked(simulated).charts["attitude"]
    rows = np.genfromtxt(simulated / "trajectory.csv", delimiter=",", names=True)
    times = np.array([float(frame["name"]) for frame in made["frames"]])
    assert times[0] == 0.0
    assert times[-1] == pytest.approx(rows["t"][-1])
    for frame in (made["frames"][0], made["frames"][-1]):
        k = np.argmin(np.abs(rows["t"] - float(frame["name"])))
        q = [rows[f"q{j}"][k] for j in (1, 2, 3, 4)]
        from scipy.spatial.transform import Rotation

        tips = np.array([[axis[c][1] for c in "xyz"] for axis in frame["data"][1:]])
        np.testing.assert_allclose(tips, Rotation.from_quat(q).as_matrix().T, atol=2e-5)


@pytest.mark.parametrize(("status", "mood", "said"), [
    ("ok", "good", "every requirement is met"),
    ("not_converged", "bad", "the run failed: not converged"),
    ("diverged", "bad", "the run failed: diverged"),
])  # fmt: skip
def test_the_verdict_is_the_first_content_of_the_report_page(simulated, status, mood, said):
    """The colour of the header and the bar of the limit follow the verdict."""
    summary = json.loads((simulated / "summary.json").read_text())
    (verdict,) = (one for one in summary["verdicts"] if one["metric"] == "peak_torque")
    verdict |= {"limit": 30.0, "margin": 0.5, "met": True, "failures": 0}
    summary.update(status=status, reason="", verdicts=[verdict])
    (simulated / "summary.json").write_text(json.dumps(summary))
    read = checked(simulated)
    (header,) = [attrs for tag, attrs in read.found if tag == "header"]
    assert header["class"] == mood
    assert read.text.index(said) < read.text.index("Requirements")
    (bar,) = [float(attrs["width"]) for tag, attrs in read.found if tag == "rect" and attrs["class"] != "all"]
    assert bar == 150.0  # of a limit at 300
    assert "50 % of the limit" in read.text
    verdict |= {"limit": 0.01, "margin": None, "met": False, "failures": 1}
    (simulated / "summary.json").write_text(json.dumps(summary))
    assert [attrs["class"] for tag, attrs in checked(simulated).found if tag == "header"] == ["bad"]


@pytest.mark.parametrize(("status", "asked", "mood"), [
    ("met", True, "good"), ("met", False, "calm"), ("ok", False, "calm"),
    ("diverged", False, "bad"), ("not met", False, "bad"), ("interrupted", True, "bad"),
])  # fmt: skip
def test_headline_has_the_colour_of_its_status_with_and_without_requirements(status, asked, mood):
    """If nothing failed, the colour is neutral without requirements, and good if all requirements are met."""
    verdicts = [examples.entry(Requirement("peak_torque", 0.5).verdict(np.zeros(2), np.ones(2, bool)))]
    assert report.headline(status, verdicts if asked else [])[1] == mood


def test_headline_distinguishes_broken_requirements_from_too_few_trials():
    """A quantile of 99 % with 90 % confidence needs 230 trials without a violation; 229 trials do not show it."""
    limit = Requirement("peak_torque", 0.5, quantile=0.99, confidence=0.9)
    shown, not_shown, not_met = (examples.entry(limit.verdict(np.full(count, value), np.ones(count, bool)))
                                 for count, value in ((230, 0.4), (229, 0.4), (230, 0.6)))  # fmt: skip
    assert report.headline("met", [shown])[0] == "Every requirement is met"
    assert report.headline("not met", [shown, not_shown])[0] == "NOT shown that every requirement is met"
    assert report.headline("not met", [not_shown, not_met])[0] == "NOT every requirement is met"
    fractions = {"fraction": 1.0, "fraction_interval": (0.98, 1.0), "fraction_bound": 0.98, "fewest_trials": 230}
    in_campaign = examples.entry(limit.verdict(np.zeros(229), np.ones(229, bool)), **fractions)
    assert campaign_report.verdict_with_fraction(in_campaign).count("230") == 1


def hostile_folder(simulated):
    """Put HTML with a script into the names and texts of a result folder; return the renamed folder."""
    folder = simulated.with_name(re.sub("/", "", HOSTILE))
    simulated.rename(folder)
    summary = json.loads((folder / "summary.json").read_text())
    (folder / "summary.json").write_text(json.dumps({**summary, "status": "diverged", "reason": HOSTILE}))
    versions = json.loads((folder / "versions.json").read_text())
    (folder / "versions.json").write_text(json.dumps({**versions, HOSTILE: HOSTILE, "platform": HOSTILE}))
    with (folder / "scenario.toml").open("a") as file:
        file.write(f"# {HOSTILE}\n")
    header, *rows = (folder / "trajectory.csv").read_text().splitlines()
    header = header.replace("s3", '"' + HOSTILE.replace('"', '""') + '"')
    (folder / "trajectory.csv").write_text("\n".join([header, *rows]))
    return folder


def test_html_in_names_and_texts_of_a_result_is_shown_as_text(simulated):
    plain = [tag for tag, _ in checked(simulated).found]
    folder = hostile_folder(simulated)
    read = checked(folder)  # which knows every element and attribute that may be there
    assert [tag for tag in plain if tag in ("script", "img")] == [t for t, _ in read.found if t in ("script", "img")]
    assert read.text.count("onerror=document.title=1") >= 4
    assert HOSTILE in [line["name"] for line in read.charts["history"]["data"]]


def test_links_out_of_the_folder_and_other_files_than_pictures_are_not_embedded(command, simulated, tmp_path):
    """The page of a folder from another person must not embed private files of the reader, who may send the page."""
    picture = page.PNG_HEADER + b"secret"
    (tmp_path / "elsewhere.png").write_bytes(picture)
    (simulated / "figures" / "outside.png").symlink_to(tmp_path / "elsewhere.png")
    (simulated / "figures" / "gone.png").symlink_to(tmp_path / "not-there.png")
    (simulated / "figures" / "loop.png").symlink_to("loop.png")
    (simulated / "figures" / "key.png").write_text("secret")
    (simulated / "inside.png").write_bytes(page.PNG_HEADER + b"inside")
    (simulated / "figures" / "linked.png").symlink_to("../inside.png")
    code, _, error = command("report", "run")
    assert code == 0
    omitted = [f"run/figures/{name}.png" for name in ("gone", "key", "loop", "outside")]
    assert [line.split()[1] for line in error.splitlines()] == omitted
    read = (simulated / "report.html").read_text()
    embedded = [base64.b64decode(data) for data in re.findall(r"data:image/png;base64,([^\"]*)", read)]
    assert page.PNG_HEADER + b"inside" in embedded
    assert not any(b"secret" in content for content in embedded)


@pytest.mark.parametrize("name", ["scenario.toml", "versions.json", "summary.json", "trajectory.csv"])
def test_a_result_file_that_is_a_link_out_of_the_folder_is_refused(command, simulated, tmp_path, name):
    (simulated / name).rename(tmp_path / name)
    (simulated / name).symlink_to(tmp_path / name)
    assert refused(command, tmp_path, "report", "run").startswith(f"ptsmc: run/{name} is a link out of the folder")


@pytest.mark.skipif(CHROMIUM is None, reason="Chromium is not installed")
@pytest.mark.parametrize("hostile", short([False, True], [True]))
def test_chromium_draws_the_page_without_an_error_or_a_request(simulated, tmp_path, hostile):
    """The policy of the page forbids requests and other scripts. The console of the browser would report an attempt."""
    folder = hostile_folder(simulated) if hostile else simulated
    place = tmp_path / "page.html"
    place.write_text(page.build(folder))
    drawn, console = in_chromium(place, tmp_path, "--dump-dom")
    assert console == []
    title = re.search(r"<title>(.*?)</title>", drawn, re.S)
    assert title is not None
    assert title[1].startswith("ptsmc simulate: ")
    body = re.sub(r"<script.*?</script>", "", drawn, flags=re.S)
    for name in ("history", "attitude"):
        assert re.search(rf'class="chart \w+ js-plotly-plot" id="{name}"', body)
    assert body.count("scatterlayer") == 5 + hostile  # a panel for q, w, d_hat, u and s, and for another name
    assert "<canvas" in body  # the turning body
    assert "WebGL is not supported" not in body
    assert 'data-title="Zoom in"' in body
    assert "Share" not in re.findall(r'data-title="([^"]*)"', body)
    assert not any("hare" in title for title in re.findall(r'data-title="([^"]*)"', body))  # nothing is uploaded


def test_report_refuses_folders_without_a_result_and_damaged_results(command, simulated, tmp_path):
    (tmp_path / "empty").mkdir()
    for folder, said in (
        ("none", "none is no folder"),
        ("s.toml", "s.toml is no folder"),
        ("empty", "empty holds no result, or its versions.json is damaged"),
    ):
        assert refused(command, tmp_path, "report", folder).startswith(f"ptsmc: {said}; allowed is ")
    kept = tree(simulated)
    for name, content, said in (
        ("summary.json", None, "run/summary.json does not exist: "),
        ("summary.json", "{", "run/summary.json is damaged or of another version: "),
        ("summary.json", "[]", "run/summary.json is damaged or of another version: Expected `object`, got `array`; "),
        ("summary.json", "{}", "run/summary.json is damaged or of another version: "),
        ("summary.json", '{"verdicts": 1}', "run/summary.json is damaged or of another version: "),
        ("summary.json", '{"verdicts": []}', "run/summary.json is damaged or of another version: "),
        (
            "versions.json",
            "[]",
            "run holds no result, or its versions.json is damaged; allowed is a folder",
        ),
        ("versions.json", '{"command": "export"}', "run has exported code, which has no page; allowed is a folder"),
        ("versions.json", '{"command": ["x"]}', "run holds no result"),
        ("scenario.toml", None, "the scenario file run/scenario.toml does not exist"),
        ("scenario.toml", "a = [", "the scenario file run/scenario.toml is no valid TOML: "),
        ("scenario.toml", "", "run/scenario.toml is damaged or of another version: 'controller' is missing "),
        ("scenario.toml", "plant = 1", "run/scenario.toml is damaged or of another version: "),
        ("scenario.toml", "plant.kind = 'x'", "run/scenario.toml is damaged or of another version: plant.kind is "),
        ("scenario.toml", "controller.t_f = 'x'", "run/scenario.toml is damaged or of another version: "),
        ("scenario.toml", "controller = { t_f = 1, delta = 'x' }", "run/scenario.toml is damaged or of "),
        ("trajectory.csv", None, "run/trajectory.csv does not exist: "),
        ("trajectory.csv", "", "run/trajectory.csv is damaged or of another version: it has no rows; "),
        ("trajectory.csv", "a,b\n0,1\n", "run/trajectory.csv is damaged or of another version: 't' is missing "),
        ("trajectory.csv", "t,x1\n0.0,1.0\n0.1", "run/trajectory.csv is damaged or of another version: line 3 must "),
        ("trajectory.csv", "t,x1\n0.0,1.0\n0.1,1.0e-", "run/trajectory.csv is damaged or of another version: "),
    ):
        if content is None:
            (simulated / name).unlink()
        else:
            (simulated / name).write_text(content)
        assert refused(command, tmp_path, "report", "run").startswith(f"ptsmc: {said}"), name
        for path, old in kept.items():
            (simulated / path).write_bytes(old)


@pytest.mark.parametrize(("module", "name"), [(page_charts, "history"), (page.json, "dumps")])
def test_an_error_in_the_code_of_the_page_is_not_reported_as_a_damaged_file(simulated, monkeypatch, module, name):
    monkeypatch.setattr(module, name, raise_type_error)
    with pytest.raises(TypeError, match="of the code"):
        page.build(simulated)


def raise_type_error(*_, **__):
    """Raise a `TypeError`, for any arguments."""
    raise TypeError("an error of the code")


def test_report_without_plotly_names_the_command_that_installs_it(command, simulated, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "plotly.offline", None)
    code, _, error = command("report", "run")
    assert code == 2
    assert error == "ptsmc: the page needs plotly.offline: pip install 'ptsmc-jax[report]'\n"


def test_chart_of_a_long_history_has_fewer_points_and_gaps_at_values_that_are_not_finite():
    """The chart marks t_f."""
    t = np.linspace(0.0, 50.0, 10 * page_charts.POINTS)
    columns = {"t": t, "x1": np.sin(t), "u1": np.where(t > 49.0, np.nan, t)}
    made = page_charts.history(columns, False, {"t_f": 35.0})
    x, u = made["data"]
    assert len(x["x"]) == page_charts.POINTS
    assert (x["x"][0], x["x"][-1]) == (0.0, 50.0)
    assert u["y"][-1] is None
    json.dumps(made, allow_nan=False)
    assert [shape["x0"] for shape in made["layout"]["shapes"]] == [35.0]


def test_a_chain_has_a_report_page_with_its_own_figures_and_metrics(command, tmp_path):
    (tmp_path / "c.toml").write_text(SHORT_CHAIN)
    command("simulate", "c.toml", "--out", "chain", "--quiet")
    folder = tmp_path / "chain"
    assert set(checked(folder).charts) == {"history"}
    assert (folder / "trajectory.csv").read_text().splitlines()[
        0
    ] == "t,x1,x2,d_hat1,u1,s1,measured_x1,measured_x2,sent1"
    names = {path.stem for path in (folder / "figures").iterdir()}
    assert names == {"states", "error", "torque", "sliding", "convergence"}
    summary = json.loads((folder / "summary.json").read_text())
    assert set(catalogues.STATE_CATALOGUE) <= set(summary)
    assert not {"peak_momentum", "terminal_angle"} & set(summary)


@pytest.mark.parametrize(("values", "kind"), [([2.7, 3.05], None), ([1e-6, 4e-4], "log"), ([0.0, 5.0], None)])
def test_axis_of_a_chart_of_laws_is_logarithmic_only_if_it_contains_a_power_of_ten(values, kind):
    """A logarithmic axis has numbers at powers of ten only: between 2.7 and 3.05 there is none."""
    made = page_charts.laws(["pd", "custom"], {"all": (values, [None, None])}, "effort [N m s]", {}, logarithmic=True)
    assert made["layout"]["xaxis"].get("type") == kind
