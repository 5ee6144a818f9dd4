"""Every notebook runs without an error, and the stored .ipynb file matches the .py source."""

import base64
import importlib
import re
import sys
from functools import partial

import jax
import jupytext
import matplotlib.pyplot as plt
import nbformat
import numpy as np
import pytest

from ptsmc_jax.simulation import rollout
from tests.helpers import ROOT

sys.path.insert(0, str(ROOT / "notebooks"))
executed = importlib.import_module("execute").executed

SOURCES = sorted((ROOT / "notebooks").glob("0*.py"))
every_notebook = pytest.mark.parametrize("source", SOURCES, ids=lambda path: path.stem)


def test_the_documentation_lists_every_notebook():
    listed = re.findall(r"^tutorials/(\w+)$", (ROOT / "docs" / "index.md").read_text(), re.M)
    assert sorted(listed) == [path.stem for path in SOURCES]


def test_the_custom_plant_runs_with_traced_simulations(monkeypatch):
    """Simulations are only traced, and their results are made up with the right shapes, so that little is compiled."""
    traced = {}

    def simulated(*args, **how):
        structure = jax.tree.structure(args)
        if structure not in traced:
            traced[structure] = jax.eval_shape(partial(rollout.simulate, **how), *args)
        shapes = traced[structure]
        made_up = jax.tree.map(lambda v: np.linspace(1.0, 2.0, v.size).reshape(v.shape).astype(v.dtype), shapes)
        return made_up._replace(status=np.asarray(rollout.OK))

    monkeypatch.setattr(rollout, "single_run_program", lambda parts: simulated)
    monkeypatch.setattr("ptsmc_jax.configure.configure", lambda: None)  # done in conftest
    cells = jupytext.read(ROOT / "notebooks" / "05_your_own_plant.py").cells
    code = "\n".join(cell.source for cell in cells if cell.cell_type == "code")
    for exact, smaller in {
        "jax.jacfwd(peak)(jnp.asarray(3.0))": "jnp.ones(jax.eval_shape(jax.jacfwd(peak), jnp.asarray(3.0)).shape)",
        "(peak(3.0001) - peak(2.9999)) / 2e-4": "derivative",
    }.items():
        assert exact in code
        code = code.replace(exact, smaller)
    exec(compile(code, "05_your_own_plant", "exec"), {})
    plt.close("all")
    assert len(traced) == 3  # the pendulum, and each true plant beside it


@pytest.mark.long
@pytest.mark.filterwarnings("ignore")  # warnings of the kernel client
@every_notebook
def test_the_notebook_runs_in_a_kernel(source):
    book = executed(source)
    code = [cell for cell in book.cells if cell.cell_type == "code"]
    assert all(cell.execution_count for cell in code if cell.source.strip())
    for cell in code:
        for output in cell.outputs:
            assert output.output_type != "error"
            assert output.get("name") != "stderr", output.get("text")  # no warning either


@every_notebook
def test_the_stored_notebook_matches_its_source(source):
    kept, edited = nbformat.read(source.with_suffix(".ipynb"), 4), jupytext.read(source)
    assert [(cell.cell_type, cell.source) for cell in kept.cells] == [
        (cell.cell_type, cell.source) for cell in edited.cells
    ], "run: make notebooks-kept"
    assert [cell["id"] for cell in kept.cells] == [f"cell-{k}" for k in range(len(kept.cells))]  # not random
    outputs = [output for cell in kept.cells if cell.cell_type == "code" for output in cell.outputs]
    assert all(output.output_type != "error" for output in outputs)
    images = [output.data["image/png"] for output in outputs if "image/png" in output.get("data", {})]
    assert len(images) >= 2
    assert all(base64.b64decode(image)[:4] == b"\x89PNG" for image in images)
    # a reader that runs no script sees all figures, and no output contains a local path
    for output in outputs:
        shown = set(output.get("data", {}))
        assert shown <= {"text/plain", "text/html", "image/png"}
        assert not re.search(r"<script|<svg|<img", output.get("data", {}).get("text/html", ""))
    assert not re.search(r"/(home|root|work|Users|tmp)/", nbformat.writes(kept))


@every_notebook
def test_links_lead_to_existing_files(source):
    texts = [cell.source for cell in jupytext.read(source).cells if cell.cell_type == "markdown"]
    for link in re.findall(r"\]\((?!http|#)([^)#]+)", "\n".join(texts)):
        assert (source.parent / link).exists(), link
