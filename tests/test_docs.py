"""The documentation matches the code (reference pages, commands, keys, code blocks, names, docstrings) and builds."""

import doctest
import importlib
import inspect
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
from jaxtyping import Array

import ptsmc_jax
from ptsmc_jax import scenario
from ptsmc_jax.scenario import from_tables, layouts
from ptsmc_jax.simulation import catalogues
from tests.helpers import SHORT
from tests.scenario.test_schema import COMPLETE
from tests.tree import ROOT, modules
from tuning.cli.main import app

DOCS = ROOT / "docs"
GENERATE = runpy.run_path(str(DOCS / "generate.py"))
MADE, TITLES = GENERATE["PAGES"], GENERATE["PLANTS"]
WRITTEN = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted(DOCS.rglob("*.md"))]
page_name = operator.attrgetter("name")
FENCE = re.compile(r"^( *)```(\w*)\n(.*?)^\1```", re.M | re.S)


def blocks(path, *languages):
    """Return the code blocks of a page in one of these languages."""
    return [textwrap.dedent(block) for _, language, block in FENCE.findall(path.read_text()) if language in languages]


def commands():
    """Return the options of each command, by its name."""
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


def test_reference_pages_name_the_default_kind_of_each_plant():
    """The default disturbance is "none" for a system and "sinusoid" for a spacecraft."""
    page = (DOCS / "scenarios.md").read_text(encoding="utf-8")
    for plant, title in TITLES.items():
        part = page.split(f"## {title}\n")[1].split("\n## ")[0]
        for name, kinds in layouts.TABLES[plant].items():
            if not isinstance(kinds, Mapping):
                continue
            said = part.split(f"### [{name}]\n")[1].split("\n### ")[0].strip()
            others = [
                other for other, name_of in TITLES.items() if said == f"As for {name_of[0].lower()}{name_of[1:]}."
            ]
            for other in others:
                theirs = layouts.TABLES[other][name]
                assert isinstance(theirs, Mapping), (plant, name)
                assert list(kinds.items()) == list(theirs.items()), (plant, name)
            assert others or re.search(rf'"{next(iter(kinds))}"` \(default\)', said), (plant, name)


def test_reference_pages_name_every_key_and_metric():
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


def test_commands_and_keys_of_the_contract_are_documented():
    """The commands and keys of the contract are listed by hand, see `tests.scenario.test_schema`."""
    promised = """reproduce simulate map montecarlo summarize worst replay tune pareto compare report new
        convert-attitude""".split()
    assert set(promised) <= set(COMMANDS)
    page = (DOCS / "scenarios.md").read_text()
    for tables in COMPLETE:
        for name, table in tables.items():
            keys = table if isinstance(table, Mapping) and name != "requirements" else {}
            assert f"### [{name}]" in page
            assert all(f"`{key}`" in page or key == "kind" for key in keys), name


def test_the_guides_name_every_command():
    guides = "\n".join(path.read_text() for path in DOCS.glob("*.md") if path.name != "commands.md")
    assert not [command for command in COMMANDS if not re.search(rf"`(ptsmc )?{command}\b|ptsmc {command}\b", guides)]


@pytest.mark.parametrize("path", WRITTEN, ids=page_name)
def test_commands_in_the_text_exist(path):
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
def test_scenarios_in_the_text_are_valid(path, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for block in blocks(path, "python"):
        if "pendulum = system(" in block:
            (tmp_path / "pendulum.py").write_text(block)
    for block in blocks(path, "toml"):
        table = tomllib.loads(block)
        if "system" in table.get("plant", {}):
            table["plant"]["system"] = f"{tmp_path}/{table['plant']['system']}"
        from_tables(table)


@pytest.mark.parametrize("path", WRITTEN, ids=page_name)
def test_names_in_the_text_exist(path):
    """The text names existing modules, functions and files of the project."""
    text = FENCE.sub("", path.read_text())
    for place, name in re.findall(r"`((?:[a-z_\d]+\.)+)([A-Za-z_]\w*)(?:\([^`]*\))?`", text):
        meant = [module for module in modules() if f".{module}.".endswith(f".{place}")]
        if meant and name not in "csv html ipynb json md png py toml".split():
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
def test_code_in_the_text_runs_without_errors(path, small, monkeypatch, tmp_path, capsys, request):
    monkeypatch.chdir(tmp_path)
    Path("scenarios").symlink_to(ROOT / "scenarios")
    monkeypatch.setattr("ptsmc_jax.configure.configure", lambda **_: None)  # done in conftest
    if small:  # simulated with the compiled programs of other tests
        request.addfinalizer(lambda: jaxtyping.config.update("jaxtyping_disable", False))
        jaxtyping.config.update("jaxtyping_disable", True)
        monkeypatch.setattr("ptsmc_jax.read", lambda name: scenario.read(name) and from_tables(tomllib.loads(SHORT)))
    if path.name == "export.md":  # the page calls the command instead
        ptsmc_jax.export("scenarios/first_flight.toml", "out/controller")
    space = {}
    for block in blocks(path, "python"):
        exec(compile(block, str(path), "exec"), space)


@pytest.mark.long
def test_the_pages_build_without_warnings_and_external_files(tmp_path):
    building = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-b", "html", str(DOCS), str(tmp_path)]
    done = subprocess.run(building, capture_output=True, text=True, cwd=ROOT, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    pages = sorted(tmp_path.rglob("*.html"))
    assert {page.stem for page in pages} >= {path.stem for path in DOCS.rglob("*.md")}
    for page in pages:
        loaded = re.findall(r"<(?:script|img|link|iframe)\b[^>]*?(?:src|href)=\"(https?:)?//[^\"]*", page.read_text())
        assert not loaded, page.name
    assert (tmp_path / "theory" / "law.html").read_text().count("<math") > 50


# --- docstrings ---

ROOMS = ("plants", "signals", "laws", "observers", "devices", "dispersions")
PHYSICS = [name for name in modules("ptsmc_jax") if name.split(".")[1:2] and name.split(".")[1] in ROOMS]
PHYSICS += [
    f"ptsmc_jax.{name}"
    for name in """
    numerics.attitude numerics.draws simulation.clock theory.hold theory.linear theory.solutions theory.rules
    theory.closed_forms theory.envelopes theory.exact_motion theory.rates scenario.scales""".split()
]
ARRAYS = re.compile(r"\b(Array|Float|Int|Bool|UInt32|ndarray|ArrayLike|Leaf)\b")
UNIT = re.compile(
    r"\[[^][]+\]|in the (?:states'|inputs'|states' own|inputs' own) units|in the units of|unit quaternion", re.I
)
SHAPE = re.compile(r"\([\w ]+,[^()]*\)|\(its shape\)|\b(?:matrix|number|scalar)\b")


def public(module):
    """Yield name, function and docstrings of the public functions of a module; bases document inherited methods."""
    for name, thing in vars(module).items():
        if name.startswith("_") or getattr(thing, "__module__", None) != module.__name__:
            continue
        if inspect.isclass(thing):
            for key, member in vars(thing).items():
                function = member.fget if isinstance(member, property) else member
                if key.startswith("_") or not inspect.isfunction(function):
                    continue
                bases = [base for base in thing.__mro__ if base is not object]
                docs = [inspect.getdoc(vars(base)[key]) or "" for base in bases if key in vars(base)]
                docs += [vars(base).get("__doc__") or "" for base in bases]
                yield f"{name}.{key}", function, docs
        elif inspect.isfunction(inspect.unwrap(thing)):
            yield name, inspect.unwrap(thing), [inspect.getdoc(thing) or ""]


def lacking(function, docs):
    """Yield "units" or "shapes" if the docstrings of a function with array arguments lack them."""
    annotations = [str(value) for key, value in function.__annotations__.items()]
    if not any(ARRAYS.search(annotation) for annotation in annotations):
        return
    text = re.sub(r"^ *>>> .*(?:\n.+)*", "", "\n".join(docs), flags=re.M)  # ignore examples
    if not UNIT.search(text):
        yield "units"
    bare = [
        annotation
        for annotation in annotations
        if re.search(r"<class '.*(?:Array|ndarray)'>|^(?:Array|np\.ndarray)$", annotation)
    ]
    if bare and not SHAPE.search(text):
        yield "shapes"


@pytest.mark.parametrize("name", PHYSICS)
def test_docstrings_state_shapes_and_units(name):
    module = importlib.import_module(name)
    seen = list(public(module))
    assert not [f"{name}: {what}" for name, function, docs in seen for what in lacking(function, docs)]


def test_the_docstring_check_finds_missing_shapes_and_units():
    def silent(x: Array) -> Array:
        """Something."""
        return x

    def telling(x: Array) -> Array:
        """Something = x [N m], (3,)."""
        return x

    assert list(lacking(silent, [silent.__doc__])) == ["units", "shapes"]
    assert not list(lacking(telling, [telling.__doc__]))


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
