"""The documentation matches the code (reference pages, commands, keys, code blocks, names) and builds."""

import doctest
import importlib
import operator
import re
import runpy
import shlex
import subprocess
import sys
import textwrap
import tomllib
from collections.abc import Mapping
from pathlib import Path

import jaxtyping
import pytest

import ptsmc_jax
from ptsmc_jax import scenario
from ptsmc_jax.campaigns import store
from ptsmc_jax.scenario import from_tables, keys, layouts
from ptsmc_jax.simulation import catalogues, rollout
from tests.helpers import SHORT, SHORT_CHAIN
from tests.onboard.flights import PROFILE
from tests.tree import ROOT, modules
from tuning.cli.main import app
from tuning.studies import campaign_folder, campaign_theory, compare, mapping

DOCS = ROOT / "docs"
GENERATE = runpy.run_path(str(DOCS / "generate.py"))
MADE, TITLES = GENERATE["PAGES"], GENERATE["PLANTS"]
WRITTEN = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted(DOCS.rglob("*.md"))]
page_name = operator.attrgetter("name")
FENCE = re.compile(r"^( *)```(\w*)\n(.*?)^\1```", re.M | re.S)


def blocks(path, *languages):
    """Return a list of the code blocks of a page in one of these languages; path: of the page."""
    return [textwrap.dedent(block) for _, language, block in FENCE.findall(path.read_text()) if language in languages]


def commands():
    """Return {command: set of its options}, such as "--out", of all commands."""
    found, command = {}, ""
    for line in app.generate_docs(output_format="markdown", usage_name="ptsmc").splitlines():
        if line.startswith("## ptsmc "):
            command = line.removeprefix("## ptsmc ")
            found[command] = set()
        elif line.startswith("* `-"):
            found[command] |= set(re.findall(r"--?[a-z][\w-]*", line.split(":")[0]))
    return found


COMMANDS = commands()


@pytest.mark.parametrize("name", MADE)
def test_reference_pages_match_the_code(name):
    assert (DOCS / name).read_text(encoding="utf-8") == MADE[name](), "run `python docs/generate.py`"


def test_reference_pages_name_every_key_and_metric():
    """They also name every field of the history."""
    scenarios, metric_list = MADE["scenarios.md"](), MADE["metrics.md"]()
    for plant, tables in layouts.TABLES.items():
        part = scenarios[scenarios.index(f"## {TITLES[plant]}") :]
        for name, table in tables.items():
            assert f"### [{name}]" in part
            structs = table.values() if isinstance(table, Mapping) else [table]
            for struct in structs:
                assert all(
                    f"`{key}`" in scenarios for key in struct.__struct_fields__ if key not in ("kind", "rest")
                ), struct
    for catalogue in catalogues.CATALOGUES.values():
        assert all(f"| `{metric}` | {entry.unit} | " in metric_list for metric, entry in catalogue.items())
    assert all(f"| `{field}` | " in metric_list for field in rollout.Log._fields)


def test_the_scenario_page_states_the_allowed_values_of_every_dispersion():
    page = MADE["scenarios.md"]()
    for kinds in layouts.DISPERSIONS.values():
        for struct in kinds.values():
            for key in keys.list_keys(struct):
                assert f"`{key.name}` ({key.allowed}" in page, (struct, key.name)


def test_the_page_of_output_files_names_the_columns_and_files_that_the_code_writes():
    page = (DOCS / "output_files.md").read_text()
    named = [*mapping.Cell.__dataclass_fields__, *compare.MODEL_ERRORS, store.JOURNAL, campaign_theory.FILE]
    for name in {*named, campaign_folder.TABLE, *store.MADE_OF_RESULTS} - {"x", "y"}:
        assert f"`{name}`" in page or f"`window_error_{name}`" in page, name


def test_the_code_prints_the_messages_of_the_troubleshooting_page():
    sources = [path for package in ("ptsmc_jax", "tuning") for path in (ROOT / package).rglob("*.py")]
    code = "\n".join(path.read_text() for path in sources)
    code = re.sub(r'"\s+f?"', "", code)  # join the parts of long texts
    headings, found = re.compile(r"^\| message \|.*\n\| --- .*\n((?:\|.*\n)+)", re.M), []
    for rows in headings.findall((DOCS / "troubleshooting.md").read_text()):
        found += [row.split(" | ")[0].removeprefix("| ") for row in rows.splitlines()]
    assert len(found) > 30
    assert not [part for text in found for part in text.split("...") if part.strip() not in code]


def test_the_guides_name_every_command():
    guides = "\n".join(path.read_text() for path in DOCS.glob("*.md") if path.name != "commands.md")
    assert not [command for command in COMMANDS if not re.search(rf"`(ptsmc )?{command}\b|ptsmc {command}\b", guides)]


@pytest.mark.parametrize("path", WRITTEN, ids=page_name)
def test_commands_in_the_documentation_exist(path):
    """The command line accepts each call of ptsmc in shell blocks and in the text."""
    lines = [line.split("#")[0].strip() for block in blocks(path, "", "bash", "console") for line in block.splitlines()]
    calls = [line.removeprefix(".venv/bin/") for line in lines if re.match(r"(\.venv/bin/)?ptsmc ", line)]
    for call in calls:
        if any(word in call for word in ("[OPTIONS]", "COMMAND", "SHELL")):  # a usage line
            continue
        app.parse_args(shlex.split(call)[1:], exit_on_error=False, print_error=False)
    text = FENCE.sub("", path.read_text())
    for call in re.findall(r"`ptsmc ([a-z][^`]*)`", text):
        command, *rest = call.split()
        assert command in COMMANDS, call
        assert {word for word in rest if word.startswith("-")} <= COMMANDS[command] | {"--help"}, call
    known = set().union(*COMMANDS.values(), {"--help", "--version"})
    assert set(re.findall(r"`(--[a-z][\w-]*)", text)) <= known


@pytest.mark.parametrize("path", [page for page in WRITTEN if blocks(page, "toml")], ids=page_name)
def test_scenarios_in_the_documentation_are_valid(path, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for block in blocks(path, "python"):
        if "pendulum = system(" in block:
            (tmp_path / "pendulum.py").write_text(block)
    for block in blocks(path, "toml"):
        table = tomllib.loads(block)
        if "system" in table.get("plant", {}):
            table["plant"]["system"] = f"{tmp_path}/{table['plant']['system']}"
        if "file" in table.get("reference", {}):
            table["reference"]["file"] = PROFILE
        from_tables(table)


@pytest.mark.parametrize("path", WRITTEN, ids=page_name)
def test_names_in_the_documentation_exist(path):
    """The text names existing modules, functions and files of the project."""
    text = FENCE.sub("", path.read_text())
    for place, name in re.findall(r"`((?:[a-z_\d]+\.)+)([A-Za-z_]\w*)(?:\([^`]*\))?`", text):
        meant = [module for module in modules() if f".{module}.".endswith(f".{place}")]
        is_key = place[:-1] in layouts.TABLES["chain"]  # such as plant.x0
        if meant and not is_key and name not in "aem bin c csv h html ipynb json md png py toml".split():
            assert any(hasattr(importlib.import_module(module), name) for module in meant), place + name
    for file in re.findall(r"`((?:tests|docs|scenarios|benchmarks|notebooks)/[a-z\d_./]+)`", text):
        assert (ROOT / file).exists(), file
    for link in re.findall(r"\]\((?!http|#)([^)#]+)", text):
        assert (path.parent / link).exists(), link


CODED = [page for page in WRITTEN if blocks(page, "python")]
LARGE = [page for page in CODED if page.name in ("README.md", "python.md", "export.md")]


@pytest.mark.parametrize(
    ("path", "small"),
    [
        *(pytest.param(page, False, id=page_name(page)) for page in CODED if page not in LARGE),
        *(pytest.param(page, False, id=page_name(page), marks=pytest.mark.long) for page in LARGE),
        pytest.param(ROOT / "README.md", True, id="README.md, on a flight of five seconds"),
    ],
)
def test_code_in_the_documentation_runs_without_errors(path, small, monkeypatch, tmp_path, capsys, request):
    monkeypatch.chdir(tmp_path)
    Path("scenarios").symlink_to(ROOT / "scenarios")
    monkeypatch.setattr("ptsmc_jax.configure.configure", lambda **_: None)  # done in conftest
    if small:  # simulated with the compiled programs of other tests
        request.addfinalizer(lambda: jaxtyping.config.update("jaxtyping_disable", False))
        jaxtyping.config.update("jaxtyping_disable", True)
        monkeypatch.setattr("ptsmc_jax.read", lambda name: scenario.read(name) and from_tables(tomllib.loads(SHORT)))
    if path.name == "export.md":  # the page calls the command instead
        ptsmc_jax.export("scenarios/first_flight.toml", "out/controller")
    if path.name == "identification.md":
        Path("mine.toml").write_text(SHORT_CHAIN)
        ptsmc_jax.simulate("mine.toml").to_polars().write_csv("slew_1.csv")
    space = {}
    for block in blocks(path, "python"):
        exec(compile(block, str(path), "exec"), space)


@pytest.mark.long
def test_the_documentation_builds_without_warnings_and_external_files(tmp_path):
    building = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-b", "html", str(DOCS), str(tmp_path)]
    done = subprocess.run(building, capture_output=True, text=True, cwd=ROOT, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    pages = sorted(tmp_path.rglob("*.html"))
    assert {page.stem for page in pages} >= {path.stem for path in DOCS.rglob("*.md")}
    for page in pages:
        loaded = re.findall(r"<(?:script|img|link|iframe)\b[^>]*?(?:src|href)=\"(https?:)?//[^\"]*", page.read_text())
        assert not loaded, page.name
    assert (tmp_path / "theory" / "law.html").read_text().count("<math") > 50


def test_examples_in_docstrings_run():
    finder, runner = doctest.DocTestFinder(), doctest.DocTestRunner()
    for module in modules():
        for test in finder.find(importlib.import_module(module)):
            if test.examples:  # most docstrings have no examples
                failed, _ = runner.run(test)
                assert not failed, test.name
    assert runner.tries > 20


def test_the_citation_file_has_the_current_version():
    assert f"\nversion: {ptsmc_jax.__version__}\n" in (ROOT / "CITATION.cff").read_text()


@pytest.mark.long
def test_the_guide_shows_the_printed_numbers_of_a_trial():
    guide = " ".join((DOCS / "guide.md").read_text().split())
    said = dict(re.findall(r"`(\w+ at (?:least|most) [^:`]*): ([^`]*)`", guide))
    printed = [str(v) for v in ptsmc_jax.simulate(ROOT / "scenarios" / "cubesat.toml", trial=7).verdicts]
    assert said
    assert {f"{asked}: {found}" for asked, found in said.items()} <= set(printed)
