"""A scenario with custom parts is a program: reading results does not run it, and simulating it needs trust."""

import importlib.util
import py_compile
import shutil
from pathlib import Path
from typing import Any

import polars as pl
import pytest

from ptsmc_jax import scenario
from ptsmc_jax.campaigns.store import RefusedError
from ptsmc_jax.scenario import custom, parsing, systems
from ptsmc_jax.scenario.errors import ScenarioError
from tests.helpers import refused
from tuning.search import custom_parts
from tuning.studies import campaign_folder

# a custom file that writes a marker when it runs, with a double integrator and a custom metric
PROGRAM = """
from pathlib import Path

with open(Path(__file__).with_suffix(".ran"), "a") as file:
    file.write("ran ")

import jax.numpy as jnp
from ptsmc_jax.plants import system

mine = system(1, lambda t, a, b: b, lambda t, a, b: 0.0 * a, lambda t, a, b: jnp.eye(1))


def farthest(result, parts):
    return {"farthest": jnp.max(jnp.abs(result.log.x[:, 0]))}
"""
SCENARIO = """
plant = { kind = "system", system = "my.py:mine", x0 = [1.0, 0.0] }
loop = { mode = "sampled", period = 0.1, t_end = 6.0 }
controller = { t_f = 5.0, delta = 0.5 }
dispersion = { x0 = { kind = "uniform", half_width = [0.5, 0.1] } }
requirements = { window_error = 0.5 }
"""
FOLDER = "out/montecarlo-mine"


def reported(place, by="mine.toml"):
    """Return the line on stderr that names the custom file before a command runs it.

    place: folder of the custom file. by: the file that names it.
    """
    return f"ptsmc: runs {place}/my.py, which plant.system of {by} names\n"


@pytest.fixture(autouse=True)
def fresh(monkeypatch):
    """Clear the record of custom files that have run."""
    monkeypatch.setattr(systems, "_executed_files", {})


@pytest.fixture(scope="module")
def places(tmp_path_factory):
    """Return the path of an existing folder, and a path for a copy of it that does not exist."""
    return tmp_path_factory.mktemp("home"), tmp_path_factory.mktemp("kept") / "home"


@pytest.fixture
def home(command, places, monkeypatch):
    """Change to a folder with a campaign whose scenario and metrics use the custom file my.py; return the folder.

    The campaign is simulated once, and its folder is restored for each test, because results name files by their path.
    The marker that my.py writes when it runs is absent.
    """
    place, kept = places
    if kept.exists():
        shutil.rmtree(place)
        shutil.copytree(kept, place)
    monkeypatch.chdir(place)
    if not kept.exists():
        (place / "my.py").write_text(PROGRAM)
        (place / "mine.toml").write_text(SCENARIO)
        code, _, error = command(
            "montecarlo", "mine.toml", "--trials", 20, "--metrics", "my.py:farthest", "--no-figures", "--quiet"
        )
        assert (code, error) == (0, reported(place))
        assert ran(place)
        systems._executed_files.clear()
        shutil.copytree(place, kept)
    return place


@pytest.fixture
def simulated(home):
    """Return the result folder of the campaign."""
    return home / FOLDER


def ran(folder):
    """Return whether my.py in the folder has run since the last call."""
    marker = folder / "my.ran"
    found = marker.exists()
    marker.unlink(missing_ok=True)
    return found


def test_summarize_worst_and_report_run_no_custom_code(command, simulated, home):
    """They show the custom metric of the stored rows. Figures that need histories are not drawn."""
    rows = pl.read_parquet(simulated / "trials")
    code, said, error = command("summarize", FOLDER)
    assert (code, error) == (0, "")
    assert "farthest" in said
    assert (simulated / "figures" / "distributions.png").exists()
    assert not (simulated / "figures" / "fan.png").exists()  # this figure needs histories, which would need a run
    code, said, _ = command("worst", FOLDER, "--by", "farthest", "-n", 1)
    assert (
        code,
        f"ptsmc replay {FOLDER} --trial {pl.read_csv(simulated / 'worst.csv')['trial'][0]} --trust" in said,
    ) == (
        0,
        True,
    )
    assert pl.read_csv(simulated / "worst.csv")["farthest"][0] == rows["farthest"].max()
    assert command("report", FOLDER)[0] == 0
    assert not ran(home)
    page = (simulated / "report.html").read_text()
    assert "farthest" in page
    assert "--metrics my.py:farthest" in page


def test_summarize_worst_and_report_work_without_the_custom_file(command, simulated, home):
    (home / "my.py").unlink()
    for asked in ("summarize", "worst", "report"):
        assert command(asked, FOLDER)[0] == 0, asked


def test_replay_names_the_custom_file_and_runs_it_with_trust_only(command, simulated, home):
    error = refused(command, home, "replay", FOLDER, "--trial", 3, "--no-figures")
    for said in (f"{home}/my.py (plant.system, --metrics)", "--trust"):
        assert said in error
    assert not ran(home)
    code, out, error = command("replay", FOLDER, "--trial", 3, "--no-figures", "--trust")
    assert (code, "equals its row" in out) == (0, True)
    assert f"ptsmc: runs {home}/my.py, which plant.system and --metrics of {FOLDER} name\n" in error
    assert ran(home)


def test_a_changed_custom_file_is_refused_even_with_trust(command, simulated, home):
    """Its code does not run, neither in a command nor in a worker on another computer."""
    shutil.copy(home / "my.py", simulated)
    text = (simulated / "scenario.toml").read_text().replace(f"{home}/my.py", "my.py")
    (simulated / "scenario.toml").write_text(text)
    (simulated / "my.py").write_text(PROGRAM + "# another\n")
    (home / "my.py").write_text(PROGRAM + "# another\n")
    assert "--trust" in command("replay", FOLDER, "--trial", 3)[2]
    for asked in (["replay", FOLDER, "--trial", 3], ["simulate", f"{FOLDER}/scenario.toml", "--out", "new"]):
        code, out, error = command(*asked, "--trust", "--no-figures")
        assert (code, out) == (2, "")
        assert f"was made with another plant.system: {simulated}/my.py had" in error
    code, _, error = command("montecarlo", "mine.toml", "--trials", 30, "--metrics", "my.py:farthest")
    assert (code, "holds a run with system_sha256" in error) == (2, True)
    assert not ran(simulated)
    other = campaign_folder.open_folder(simulated)  # as a worker on another computer does
    with pytest.raises(RefusedError, match=r"was made with another plant\.system"):
        campaign_folder.rebuild_campaign(str(simulated), other.rows.key.hex())
    assert not ran(simulated)


def test_montecarlo_resumes_its_campaign_without_the_option_trust(command, simulated, home):
    code, _, error = command(
        "montecarlo", "mine.toml", "--trials", 30, "--metrics", "my.py:farthest", "--no-figures", "--quiet"
    )
    assert (code, error) == (0, reported(home))
    assert pl.read_parquet(simulated / "trials").height == 30
    assert campaign_folder.open_folder(simulated).custom_metric_names == ["farthest"]


def test_a_scenario_in_results_needs_trust_wherever_its_file_is(command, simulated, home, capsys):
    """This holds for subfolders and links. With trust, a line names the file that runs."""
    shutil.copy(home / "my.py", simulated)
    (simulated / "evil.toml").write_text(SCENARIO)
    (simulated / "scenarios" / "deeper").mkdir(parents=True)
    (simulated / "scenarios" / "law.toml").write_text(SCENARIO.replace("my.py", "../my.py"))
    (simulated / "scenarios" / "deeper" / "law.toml").write_text(SCENARIO.replace("my.py", "../../my.py"))
    (home / "link.toml").symlink_to(simulated / "evil.toml")
    inside = ("scenario.toml", "evil.toml", "scenarios/law.toml", "scenarios/deeper/law.toml")
    for path in (*(f"{FOLDER}/{name}" for name in inside), "link.toml"):
        for asked in ("simulate", "tune", "montecarlo", "map", "pareto"):
            assert "names custom code" in refused(command, home, asked, path, "--out", "new")
    assert not ran(simulated)
    assert not ran(home)
    loaded = scenario.read(simulated / "evil.toml")
    custom_parts.allow_scenario(simulated / "evil.toml", loaded, True)
    assert capsys.readouterr().err == reported(simulated, simulated / "evil.toml")


@pytest.mark.parametrize(
    ("system", "runs"),
    [
        ("my.py:mine", "{above}/home/my.py"),
        ("below/my.py:mine", "{above}/home/below/my.py"),
        ("below/../my.py:mine", "{above}/home/my.py"),
        ("../my.py:mine", "{above}/my.py"),
        ("link.py:mine", "{above}/my.py"),
        ("{above}/my.py:mine", "{above}/my.py"),
        ("package.module:mine", "the module package.module"),
    ],
)
def test_the_path_of_a_custom_file_in_a_users_scenario_is_reported(tmp_path, capsys, system, runs):
    """The scenario is not in a result folder, so no trust is needed."""
    home = tmp_path / "home"
    (home / "below").mkdir(parents=True)
    for folder in (tmp_path, home, home / "below"):
        (folder / "my.py").write_text(PROGRAM)
    (home / "link.py").symlink_to(tmp_path / "my.py")
    path = home / "mine.toml"
    path.write_text(SCENARIO.replace("my.py:mine", system.format(above=tmp_path)))
    custom_parts.allow_scenario(path, scenario.read(path), False)
    told = f"ptsmc: runs {runs.format(above=tmp_path)}, which plant.system of {path} names\n"
    assert capsys.readouterr().err == told
    assert not any(ran(folder) for folder in (tmp_path, home, home / "below"))


def test_reading_a_scenario_imports_no_module_and_no_package_around_it(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("around").mkdir()
    Path("around/__init__.py").write_text("raise SystemExit('was run')\n")
    Path("around/inside.py").write_text(PROGRAM)
    tables = {"plant": {"kind": "system", "system": "around.inside:mine", "x0": [1.0, 0.0]}}
    loaded = scenario.replace(scenario.from_tables(tables), controller__eta=4.0, tune={})
    assert parsing.dump(loaded)["plant"]["system"] == "around.inside:mine"
    with pytest.raises(ScenarioError, match=r"running around\.inside fails: SystemExit: was run"):
        scenario.study(loaded)
    assert systems.checksum("around.inside:mine") is None


def test_the_source_of_a_custom_file_is_run_and_never_a_compiled_copy(tmp_path):
    file = tmp_path / "my.py"
    file.write_text(PROGRAM.replace("system(1", "no_system_at_all(1"))
    cached = Path(importlib.util.cache_from_source(str(file)))
    py_compile.compile(str(file), str(cached), invalidation_mode=py_compile.PycInvalidationMode.UNCHECKED_HASH)
    file.write_text(PROGRAM)  # the .pyc claims to be valid without a comparison
    assert systems.load(f"{file}:mine").inputs == 1


def test_a_custom_file_runs_again_only_if_it_has_changed(tmp_path):
    file = tmp_path / "my.py"
    file.write_text(PROGRAM)
    first = systems.load(f"{file}:mine")
    assert systems.load(f"{file}:mine") is first
    file.write_text(PROGRAM.replace("mine = system(1", "mine = 3  # system(1"))
    with pytest.raises(ValueError, match="has a int of that name"):
        systems.load(f"{file}:mine")


VERSIONS = '{"command": "montecarlo", "seed": 0, "trials": 20, "precision": 64, "scenario_checksum": ""}'


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("versions.json", "[" * 100_000),
        ("versions.json", "[3]"),
        ("versions.json", VERSIONS.replace('"seed": 0', '"seed": -1')),
        ("versions.json", VERSIONS.replace("20", '"many"')),
        ("versions.json", VERSIONS.replace("}", ', "metrics": "m\\u0000.py:f"}')),
        ("scenario.toml", 'plant = { kind = "system", system = "my\\u001b[2K.py:mine" }'),
        ("scenario.toml", f"plant = {'[' * 9}{']' * 9}"),
        ("scenario.toml", "plant = 3"),
        ("summary.json", "[" * 100_000),
    ],
)
def test_inconsistent_result_folders_are_refused_in_one_sentence(command, tmp_path, name, text):
    folder = tmp_path / "theirs"
    folder.mkdir()
    for each, content in {"versions.json": VERSIONS, "scenario.toml": "", "summary.json": "{}", name: text}.items():
        (folder / each).write_text(content)
    for asked in (["summarize"], ["worst"], ["replay", "--trial", "1"], ["report"]):
        if name == "summary.json" and asked != ["report"]:
            continue
        refused(command, tmp_path, asked[0], "theirs", *asked[1:])


def _tables(*codes):
    """Return the tables of a scenario that uses these files: the first as its law, the others as disturbances.

    codes: "file:name" of each class.
    """
    laws = [{"kind": "custom", "code": str(code)} for code in codes]
    return {"controller": laws[0], "disturbance": {"terms": laws[1:]}} if laws[1:] else {"controller": laws[0]}


def test_a_result_folder_contains_copies_of_its_custom_files(tmp_path):
    """Two files of the same name, one of them named twice, give two copies."""
    made = tmp_path / "made"
    made.mkdir()
    for name, text in {"a": "x = 1\n", "b": "x = 2\n"}.items():
        (tmp_path / name).mkdir()
        (tmp_path / name / "mine.py").write_text(text)
    where = [f"{tmp_path}/a/mine.py:Law", f"{tmp_path}/b/mine.py:Push", f"{tmp_path}/a/mine.py:Pull", "pack.age:Mine"]
    found = custom_parts.copy_custom_files(_tables(*where), made)
    assert found == _tables("mine.py:Law", "mine_2.py:Push", "mine.py:Pull", "pack.age:Mine")
    assert {path.name: path.read_text() for path in made.iterdir()} == {"mine.py": "x = 1\n", "mine_2.py": "x = 2\n"}


@pytest.mark.parametrize(
    ("text", "carried"),
    [
        ("import jax.numpy as jnp\nimport ptsmc_jax as ptsmc\n", True),
        ("import beside\n", False),
        ("from beside.of import it\n", False),
        ("from package import it\n", False),
        ("import other\n", True),
        ("def f():\n    import beside\n", False),
        ("print(__file__)\n", False),
        ("x = = 1\n", False),
    ],
)
def test_a_custom_file_with_local_imports_is_not_copied(tmp_path, text, carried):
    made = tmp_path / "made"
    for folder in (made, tmp_path / "package"):
        folder.mkdir()
    (tmp_path / "beside.py").touch()
    (tmp_path / "mine.py").write_text(text)
    where = f"{tmp_path}/mine.py:Law"
    assert custom_parts.copy_custom_files(_tables(where), made) == _tables("mine.py:Law" if carried else where)
    assert [path.name for path in made.iterdir()] == (["mine.py"] if carried else [])


def test_a_symbolic_link_in_results_to_an_outside_file_belongs_to_the_results(tmp_path):
    results, mine = tmp_path / "results", tmp_path / "mine" / "deep" / "mine.toml"
    for place in (results, mine.parent):
        place.mkdir(parents=True)
    (results / "versions.json").write_text("{}")
    mine.write_text("")
    (results / "tuned.toml").symlink_to(mine)
    assert custom_parts.find_results_folder(results / "tuned.toml") == results
    assert custom_parts.find_results_folder(mine) is None


def test_a_file_named_by_several_keys_is_reported_once(tmp_path, capsys):
    law = tmp_path / "mine.py"
    law.write_text("")
    programs: Any = dict.fromkeys(("controller.code", "observer.code", "reference.code"), f"{law}:Mine")
    with pytest.raises(
        RefusedError, match=rf"custom code, {law} \(controller.code, observer.code, reference.code\), which"
    ):
        custom_parts.allow_results(programs, tmp_path, {}, trusted=False)
    checksums = {custom.checksum_name(key): systems.checksum(where) for key, where in programs.items()}
    custom_parts.allow_results(programs, tmp_path, checksums, trusted=True)
    keys = "controller.code, observer.code and reference.code"
    assert capsys.readouterr().err == f"ptsmc: runs {law}, which {keys} of {tmp_path} name\n"


def test_a_custom_file_without_a_checksum_in_the_results_is_reported(tmp_path, capsys):
    law, other = tmp_path / "mine.py", tmp_path / "other.py"
    law.write_text("")
    other.write_text("")
    programs = {"controller.code": f"{law}:Mine", "observer.code": f"{other}:Mine"}
    made = {"controller_sha256": systems.checksum(f"{law}:Mine")}
    assert custom_parts.check_unchanged(programs, tmp_path, made) == ["observer.code"]
    custom_parts.allow_results(programs, tmp_path, made, trusted=True)
    (said,) = [line for line in capsys.readouterr().err.splitlines() if "no checksum" in line]
    assert str(other) in said
    assert str(law) not in said


def test_checksum_covers_imported_files_in_the_same_folder(tmp_path):
    """A campaign could otherwise resume after a change of an imported file, and mix rows of both versions."""
    (tmp_path / "package").mkdir()
    files = {"mine.py": "import helper\n", "helper.py": "from package.inner import f\n", "package/inner.py": "f = 1\n"}
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    (tmp_path / "other.py").write_text("")
    where = f"{tmp_path}/mine.py:Mine"
    known = [systems.checksum(where)]
    for name, text in files.items():
        (tmp_path / name).write_text(f"{text}# changed\n")
        known.append(systems.checksum(where))
    assert len(set(known)) == 4
    (tmp_path / "other.py").write_text("x = 1\n")
    assert systems.checksum(where) == known[-1]
    with pytest.raises(RefusedError, match=r"was made with another controller\.code"):
        custom_parts.check_unchanged({"controller.code": where}, tmp_path, {"controller_sha256": known[0]})
