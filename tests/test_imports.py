"""Imports: the package changes no settings of JAX, and every public name resolves.

`cli/test_cli.py` tests that neither the package nor the command imports JAX.
"""

import ast
import importlib
import json
import subprocess
import sys

import pytest

from tests.tree import ROOT, modules


def python(code):
    """Run code in a new interpreter; return the last printed line, read as JSON."""
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


def test_reading_a_scenario_imports_no_package_that_only_some_scenarios_need():
    loaded = python(
        "from ptsmc_jax import scenario; scenario.from_tables({}); import json, sys; print(json.dumps([*sys.modules]))"
    )
    assert "ptsmc_jax.scenario.device_tables" in loaded
    assert not {"scipy.spatial", "scipy.interpolate", "polars", "matplotlib"} & set(loaded)


def test_importing_the_library_changes_no_setting_of_jax_or_the_environment():
    """The user can call `configure` after the import. A study warns if the call is missing."""
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
    assert looked > 50  # names were found
    assert warned.startswith("JAX computes with 32 bits here")
    assert late.startswith("configure() comes too late")


@pytest.mark.parametrize("package", ["ptsmc_jax", "ptsmc_jax.scenario"])
def test_every_exported_name_of_a_package_is_found_in_its_module(package):
    offering = importlib.import_module(package)
    assert offering._EXPORTS
    for name, module in offering._EXPORTS.items():
        module = f"{package}.{module.removeprefix(f'{package}.')}"
        assert getattr(offering, name) is getattr(importlib.import_module(module), name)
    assert set(offering._EXPORTS) <= set(dir(offering))
    with pytest.raises(AttributeError, match="no_such_name"):
        offering.no_such_name  # noqa: B018


def test_type_checkers_see_the_same_exports():
    """The imports under TYPE_CHECKING equal the lazy exports of the package."""
    package = "ptsmc_jax.scenario"
    tree = ast.parse(modules()[package].read_text())
    (block,) = [node for node in tree.body if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"]
    seen = {}
    for node in block.body:
        assert isinstance(node, ast.ImportFrom)
        for alias in node.names:
            assert alias.asname == alias.name  # marks a re-export
            seen[alias.name] = str(node.module).removeprefix(f"{package}.")
    assert seen == importlib.import_module(package)._EXPORTS
