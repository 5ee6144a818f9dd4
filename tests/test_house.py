"""The house: each file imports from floors below only, importing costs and changes nothing, files stay readable."""

import ast
import importlib
import json
import subprocess
import sys
from pathlib import Path

import pytest

import ptsmc_jax
from tests.helpers import ROOT

# Ground floor first; what shares a line are siblings, which do not see each other. A new file goes into its place here.
FLOORS = {
    "ptsmc_jax": """
        configure formulas catalogues
        programs numerics elementary
        draws
        attitude
        plants
        signals hardware
        observers laws clock
        controllers
        sensors baselines
        metrics assembly
        computer
        rollout
        components
        lanes
        kernel
        theory estimation borders
        hold linear
        margins covariance
        requirements
        dispersions
        values systems
        plant_tables signal_tables law_tables device_tables dispersion_tables keys
        tables
        layouts
        schema
        attitude_keys scales
        free_gains
        checks
        reading build
        pace
        scenario
        montecarlo margin_verdicts
        runs
        store remark_2 drawing rows statistics
        plotting study_plots campaign_plots margin_plots campaign
        cluster animation
        explore
        paper
        slips
    """,
    "tuning": """
        gains own_parts abreast
        bounds design journal
        margin_rows
        objective
        evaluate
        worst trust descent starts confirm
        refine work
        descents
        optimise
        evolution stability
        report single reproduction mapping
        results pareto compare campaign_folder
        campaign_summary
        cells
        told_margins options
        told
        show
        show_campaign page_charts convert new
        page
        campaign_commands writing_commands
        cli table
    """,
}
FLOOR = {
    (package, name): floor
    for package, floors in FLOORS.items()
    for floor, names in enumerate(floors.strip().splitlines())
    for name in names.split()
}
LONGEST = {"ptsmc_jax": 400, "tuning": 400, "tests": 800}


def allowed(package, name, other_package, other):
    """May a file import another? `__init__` as the other file is the package itself."""
    if package != other_package:
        return package == "tuning"  # ptsmc_jax never imports tuning
    return other == "__init__" or FLOOR[other_package, other] < FLOOR[package, name]


def modules(package):
    return sorted(path.stem for path in (ROOT / package).glob("**/*.py") if path.stem != "__init__")


def imported(source, package):
    """(package, module) of every import of ours, wherever it stands: in functions and under TYPE_CHECKING too."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names = [alias.name.split(".") for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = (node.module or "").split(".") if node.level == 0 else [package, *(node.module or "").split(".")]
            base = [part for part in base if part]
            # `from package import module` names the module; `from package import name` the package itself
            names = [[*base, alias.name] if len(base) == 1 else base for alias in node.names]
        elif ast.unparse(node) == "importlib.import_module(place)":
            continue  # `systems`, what a user names
        elif isinstance(node, ast.Call) and ast.unparse(node.func) in ("importlib.import_module", "__import__"):
            assert isinstance(node.args[0], ast.Constant), "an import that cannot be read"
            names = [str(node.args[0].value).split(".")]
        else:
            continue
        for parts in names:
            if parts[0] in FLOORS:
                known = len(parts) > 1 and (parts[0], parts[1]) in FLOOR
                yield parts[0], parts[1] if known else "__init__"


@pytest.mark.parametrize("package", FLOORS)
def test_every_file_has_its_floor(package):
    assert modules(package) == sorted(name for owner, name in FLOOR if owner == package)


@pytest.mark.parametrize(("package", "name"), FLOOR)
def test_files_import_from_floors_below_only(package, name):
    upward = [
        f"{other_package}.{other}"
        for other_package, other in imported((ROOT / package / f"{name}.py").read_text(), package)
        if not allowed(package, name, other_package, other)
    ]
    assert not upward


def test_the_package_itself_is_imported_for_its_version_at_most():
    """Its lazy names would hide what floor they come from."""
    for package, name in FLOOR:
        tree = ast.parse((ROOT / package / f"{name}.py").read_text())
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom) and node.module in FLOORS:
                assert not {alias.name for alias in node.names} & set(ptsmc_jax._EXPORTS), (package, name)
            if isinstance(node, ast.Attribute) and ast.unparse(node.value) == "ptsmc_jax":
                assert node.attr == "__version__", (package, name)


@pytest.mark.parametrize(
    "line",
    [
        "from ptsmc_jax import lanes",
        "from ptsmc_jax.lanes import vmap",
        "import ptsmc_jax.lanes",
        "import ptsmc_jax.lanes as L",
        "from . import lanes",
        "from .lanes import vmap",
        "def f():\n    from ptsmc_jax.lanes import vmap",
        "if TYPE_CHECKING:\n    from ptsmc_jax.lanes import vmap",
        "import importlib\nimportlib.import_module('ptsmc_jax.lanes')",
    ],
)
def test_the_reader_of_imports_sees_every_form(line):
    assert list(imported(line, "ptsmc_jax")) == [("ptsmc_jax", "lanes")]
    assert not allowed("ptsmc_jax", "rollout", "ptsmc_jax", "lanes")
    assert not allowed("ptsmc_jax", "clock", "ptsmc_jax", "observers")
    assert allowed("ptsmc_jax", "theory", "ptsmc_jax", "lanes")
    assert not allowed("ptsmc_jax", "plotting", "tuning", "bounds")


def python(code):
    """Last line that a fresh interpreter prints, read as JSON."""
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


def test_importing_the_package_and_the_command_does_not_import_jax():
    loaded = python("import ptsmc_jax, tuning.cli, json, sys; print(json.dumps(sorted(sys.modules)))")
    assert "tuning.cli" in loaded
    assert not {"jax", "jaxlib", "numpy", "scipy", "matplotlib", "optax"} & set(loaded)


def test_importing_the_library_changes_nothing_of_jax_or_the_environment():
    names = [f"{package}.{name}" for package, name in FLOOR]
    changed = python(f"""
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
print(json.dumps([changed, started, len(before)]))
""")
    assert changed[0] == []
    assert changed[1] is False  # no backend has started: `configure` can still be called
    assert changed[2] > 50  # it did look


def test_every_export_resolves():
    assert ptsmc_jax._EXPORTS
    for name, module in ptsmc_jax._EXPORTS.items():
        assert getattr(ptsmc_jax, name) is getattr(importlib.import_module(f"ptsmc_jax.{module}"), name)
    assert set(ptsmc_jax._EXPORTS) <= set(dir(ptsmc_jax))
    with pytest.raises(AttributeError, match="no_such_name"):
        ptsmc_jax.no_such_name  # noqa: B018


def test_type_checkers_see_the_same_exports():
    tree = ast.parse((ROOT / "ptsmc_jax" / "__init__.py").read_text())
    (block,) = [node for node in tree.body if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"]
    seen = {}
    for node in block.body:
        assert isinstance(node, ast.ImportFrom)
        for alias in node.names:
            assert alias.asname == alias.name  # marks a re-export
            seen[alias.name] = str(node.module).removeprefix("ptsmc_jax.")
    assert seen == ptsmc_jax._EXPORTS


def sources():
    return [path for folder in (*FLOORS, "tests") for path in sorted((ROOT / folder).glob("**/*.py"))]


def test_dataclasses_are_registered_by_our_own_decorator():
    """See `numerics.pytree`: by JAX's own, one law's compiled program is taken for another's now and then."""
    files = [path for package in FLOORS for path in (ROOT / package).glob("**/*.py") if path.stem != "numerics"]
    assert not [path.name for path in files if "register_dataclass" in path.read_text(encoding="utf-8")]


@pytest.mark.parametrize("path", sources(), ids=lambda path: str(path.relative_to(ROOT)))
def test_no_file_is_too_long(path: Path):
    assert len(path.read_text().splitlines()) <= LONGEST[path.relative_to(ROOT).parts[0]]
