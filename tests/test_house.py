"""The house: each file imports from floors below only, importing costs and changes nothing, files stay readable."""

import ast
import importlib
import inspect
import json
import re
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

import ptsmc_jax
from tests.tree import ROOT, modules

# Rooms in their order, the lowest first; in each the floors of its files: what shares a line are siblings, which do not
# see each other. A file sees the rooms and floors below its own; "." is the package's own folder. A new file goes here.
HOUSE = {
    "ptsmc_jax": {
        ".": "configure formulas provenance | programs",
        "numerics": "elementary guards paths pytrees stacking statistics | attitude draws matrices | integrators",
        "batching": "components dependence lapack | choices packed | kernel | lanes",
        "plants": "base | integrator_chain rigid_body second_order | flexible_body",
        "signals": "disturbances references",
        "laws": """
            closed_forms error_motions
            base
            acceleration prescribed_time
            fixed_time pd predefined_time scaling super_twisting terminal time_base
        """,
        "observers": "base | finite_time none nonlinear prescribed_time",
        "devices": """
            attitude_filter command_filter reaction_wheels ticks
            star_times
            actuators sensors
            own_sensors
        """,
        "simulation": """
            catalogues clock pointing
            interval
            assembly metric_rows requirements
            computer gains metrics
            run_state
            continuous sampled
            rollout
        """,
        "dispersions": "numbers | base inertias | quantities | variation | planned",
        "theory": """
            borders carries error_floor rules solutions
            envelopes linear
            covariance crossings
            rest
            margins
            hold run_margins
        """,
        "scenario": """
            errors systems values
            attitude_keys dispersion_tables gain_record keys mission pointing_table
            command_filter_tables scales
            device_tables gain_bounds own start_checks
            disturbance_bounds
            disturbance_tables law_record observer_tables own_devices reference_tables
            baseline_record
            baseline_tables own_laws
            law_tables
            tables
            spacecraft_scenario state_scenario
            layouts
            checks parsing
            free_gains timing
            build cautions own_checks reading
            flyable tuned
        """,
        "campaigns": "csv_tables montecarlo store | margin_verdicts plans rows | campaign runs | cluster",
        "onboard": """
            expressions sources
            control derived origins rules
            board fields printing translate
            parameters
            generate vectors
            templates
            library readme
            folder
        """,
        "paper": "claims remark_2 | slips",
        "figures": "style | animation campaign_plots margin_plots run_plots study_plots",
        "explore": "",
    },
    "tuning": {
        ".": "errors",
        "search": """
            lockstep gains journal own_parts progress
            design flights shares
            margin_rows
            objective
            confirm evaluate hand_overs worst
            descent starts trust
            cma_es rounds work
            descents
            optimise
            global_check
        """,
        "studies": """
            campaign_folder front judging mapping reproduction single stability
            campaign_figures campaign_theory posing
            campaign_summary tuner
            compare reasons trades tune_files
            pareto
        """,
        "output": """
            cells page_captions page_charts progress_lines
            margin_sentences page_parts pointing_sentences
            search_sentences sentences
            campaign_sentences front_sentences law_sentences
            page terminal
            campaign_terminal
        """,
        "cli": "options | convert flight_commands new searches | campaign_commands | writing_commands | main",
    },
}


def floors(package):
    """Module without the package's name -> (room, floor), both counted from below."""
    found = {}
    for number, (room, lines) in enumerate(HOUSE[package].items()):
        inside = {name: k for k, line in enumerate(re.split(r"[|\n]", lines.strip())) for name in line.split()}
        if room != ".":
            found[room] = (number, len(inside) if inside else 0)  # a file, or the folder's own `__init__`
        found |= {name if room == "." else f"{room}.{name}": (number, k) for name, k in inside.items()}
    return found


FLOOR = {package: floors(package) for package in HOUSE}
LONGEST = {"ptsmc_jax": 480, "tuning": 480, "tests": 800}


def allowed(package, name, other_package, other):
    """May a module import another? "" as the other is the package itself."""
    if package != other_package:
        return package == "tuning"  # ptsmc_jax never imports tuning
    return not other or FLOOR[package][other] < FLOOR[package][name]


def names(package):
    """Modules of a package without its name, the package itself apart."""
    return sorted(name.partition(".")[2] for name in modules(package) if name != package)


def tells(node):
    """Whether it imports, if only by a call, or is of the package itself."""
    if isinstance(node, ast.Call):
        return ast.unparse(node.func) in ("importlib.import_module", "__import__")
    if isinstance(node, ast.Attribute):
        return isinstance(node.value, ast.Name) and node.value.id == "ptsmc_jax"
    return isinstance(node, ast.Import | ast.ImportFrom)


@cache
def telling(source):
    """The nodes of a source that tell what it imports, wherever they stand."""
    return [node for node in ast.walk(ast.parse(source)) if tells(node)]


def imported(source):
    """(package, module) of every import of ours, wherever it stands: in functions and under TYPE_CHECKING too."""
    for node in telling(source):
        if isinstance(node, ast.Import):
            found = [alias.name.split(".") for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.module  # relative imports are refused by ruff
            found = [[*node.module.split("."), alias.name] for alias in node.names]
        elif isinstance(node, ast.Call):
            if ast.unparse(node) in LAZY:
                continue
            assert isinstance(node.args[0], ast.Constant), "an import that cannot be read"
            found = [str(node.args[0].value).split(".")]
        else:
            continue
        for first, *parts in found:
            if first in HOUSE:
                while parts and ".".join(parts) not in FLOOR[first]:
                    parts.pop()
                yield first, ".".join(parts)


LAZY = (  # imports by names that cannot be read here
    "importlib.import_module(place)",  # `systems`: what a user names
    "importlib.import_module(f'ptsmc_jax.scenario.{_EXPORTS[name]}')",  # `scenario`'s, see below
)


@pytest.mark.parametrize("package", HOUSE)
def test_every_file_has_its_floor(package):
    assert names(package) == sorted(FLOOR[package])


@pytest.mark.parametrize(("package", "name"), [(package, name) for package in HOUSE for name in FLOOR[package]])
def test_files_import_from_floors_below_only(package, name):
    source = modules(package)[f"{package}.{name}"].read_text()
    assert not [
        f"{other_package}.{other}"
        for other_package, other in imported(source)
        if not allowed(package, name, other_package, other)
    ]


def test_the_package_itself_is_imported_for_its_version_at_most():
    """Its lazy names would hide what floor they come from."""
    for name, path in modules().items():
        for node in telling(path.read_text()):
            if isinstance(node, ast.ImportFrom) and node.module in HOUSE:
                assert not {alias.name for alias in node.names} & set(ptsmc_jax._EXPORTS), name
            if isinstance(node, ast.Attribute):
                assert node.attr == "__version__", name


@pytest.mark.parametrize(
    "line",
    [
        "from ptsmc_jax.batching import lanes",
        "from ptsmc_jax.batching.lanes import vmap",
        "import ptsmc_jax.batching.lanes",
        "import ptsmc_jax.batching.lanes as L",
        "def f():\n    from ptsmc_jax.batching.lanes import vmap",
        "if TYPE_CHECKING:\n    from ptsmc_jax.batching.lanes import vmap",
        "import importlib\nimportlib.import_module('ptsmc_jax.batching.lanes')",
    ],
)
def test_the_reader_of_imports_sees_every_form(line):
    assert list(imported(line)) == [("ptsmc_jax", "batching.lanes")]
    assert not allowed("ptsmc_jax", "batching.components", "ptsmc_jax", "batching.lanes")
    assert not allowed("ptsmc_jax", "observers.nonlinear", "ptsmc_jax", "observers.none")
    assert not allowed("ptsmc_jax", "observers.nonlinear", "ptsmc_jax", "simulation.clock")
    assert not allowed("ptsmc_jax", "scenario.timing", "ptsmc_jax", "scenario")
    assert allowed("ptsmc_jax", "scenario", "ptsmc_jax", "scenario.timing")
    assert allowed("ptsmc_jax", "theory.solutions", "ptsmc_jax", "batching.lanes")
    assert not allowed("ptsmc_jax", "figures.run_plots", "tuning", "search.bounds")


def python(code):
    """Last line that a fresh interpreter prints, read as JSON."""
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


def test_importing_the_package_and_the_command_does_not_import_jax():
    loaded = python("import ptsmc_jax, tuning.cli.main, json, sys; print(json.dumps(sorted(sys.modules)))")
    assert "tuning.cli.main" in loaded
    assert not {"jax", "jaxlib", "numpy", "scipy", "matplotlib", "optax"} & set(loaded)


def test_importing_the_library_changes_nothing_of_jax_or_the_environment():
    """So that `configure` can still be called: who forgets it is warned by a study, and told when it comes too late."""
    names = list(modules())
    changed, started, looked, warned, late = python(f"""
import importlib, json, os, warnings
import jax, polars  # which sets a variable of its allocator's own
def state():
    return {{**jax.config.values, "flags": os.environ.get("XLA_FLAGS"), "environment": dict(os.environ)}}
before, filters = state(), list(warnings.filters)
for name in {names}:
    importlib.import_module(name)
after = state()
changed = [key for key in after if after[key] is not before.get(key) and after[key] != before.get(key)]
started = bool(jax._src.xla_bridge._backends)

from ptsmc_jax import configure, scenario, study
warnings.simplefilter("error")  # which stops it there
try:
    study(scenario.from_tables({{}}))
except RuntimeWarning as warning:
    warned = str(warning)
jax.numpy.zeros(3)
try:
    configure.configure(devices=2, cache=None, fast=False)
except RuntimeError as error:
    late = str(error)
print(json.dumps([changed, started, len(before), warned, late]))
""")
    assert changed == []
    assert started is False
    assert looked > 50  # it did look
    assert warned.startswith("JAX computes with 32 bits here")
    assert late.startswith("configure() comes too late")


@pytest.mark.parametrize("package", ["ptsmc_jax", "ptsmc_jax.scenario"])
def test_every_export_resolves(package):
    offering = importlib.import_module(package)
    assert offering._EXPORTS
    for name, module in offering._EXPORTS.items():
        assert getattr(offering, name) is getattr(importlib.import_module(f"{package}.{module}"), name)
    assert set(offering._EXPORTS) <= set(dir(offering))
    with pytest.raises(AttributeError, match="no_such_name"):
        offering.no_such_name  # noqa: B018


@pytest.mark.parametrize("package", ["ptsmc_jax", "ptsmc_jax.scenario"])
def test_type_checkers_see_the_same_exports(package):
    tree = ast.parse(modules()[package].read_text())
    (block,) = [node for node in tree.body if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"]
    seen = {}
    for node in block.body:
        assert isinstance(node, ast.ImportFrom)
        for alias in node.names:
            assert alias.asname == alias.name  # marks a re-export
            seen[alias.name] = str(node.module).removeprefix(f"{package}.")
    assert seen == importlib.import_module(package)._EXPORTS


@pytest.mark.parametrize("package", ["ptsmc_jax", "ptsmc_jax.scenario"])
def test_type_checkers_know_every_argument_of_the_functions_offered(package):
    offering = importlib.import_module(package)
    functions = [item for item in map(offering.__getattr__, offering._EXPORTS) if inspect.isfunction(item)]
    assert len(functions) > 3  # it did look
    for function in functions:
        assert set(inspect.signature(function).parameters) <= set(function.__annotations__), function.__name__


def test_tests_lie_in_the_rooms_of_what_they_test():
    """Across rooms: in the folder of tests itself."""
    rooms = {room for package in HOUSE.values() for room in package if room != "."}
    folders = {path.parent for path in modules("tests").values()} - {ROOT / "tests"}
    assert {path.name for path in folders} <= rooms
    assert {path.parent for path in folders} == {ROOT / "tests"}


def sources():
    return [*modules().values(), *modules("tests").values()]


def test_dataclasses_are_registered_by_our_own_decorator():
    """See `pytrees.pytree`: by JAX's own, one law's compiled program is taken for another's now and then."""
    files = [path for path in modules().values() if path.stem != "pytrees"]
    assert not [path.name for path in files if "register_dataclass" in path.read_text(encoding="utf-8")]


@pytest.mark.parametrize("path", sources(), ids=lambda path: str(path.relative_to(ROOT)))
def test_no_file_is_too_long(path: Path):
    assert len(path.read_text().splitlines()) <= LONGEST[path.relative_to(ROOT).parts[0]]
