"""Every notebook runs without an error, and the stored .ipynb file matches the .py source."""

import base64
import importlib
import re
import sys
import tomllib
from functools import partial

import jax
import jupytext
import matplotlib.pyplot as plt
import nbformat
import numpy as np
import pytest

from ptsmc_jax import scenario
from ptsmc_jax.simulation import rollout
from tests.helpers import ROOT, SHORT, small_search

sys.path.insert(0, str(ROOT / "notebooks"))
executed = importlib.import_module("execute").executed

SOURCES = sorted((ROOT / "notebooks").glob("0*.py"))


# replacements that make cells with many runs smaller
SMALLER = {
    "02_sampling_and_noise": {"count=300": "count=20", "0.05, 4.0, 9)": "0.1, 4.0, 3)"},
    "03_tuning": {
        'tune={"trials": 16, "starts": 3, "steps": 30}': "tune__steps=4",
        "0, 4)": "0, 3)",
        '"out/tune-first_flight"': '__import__("pathlib").Path("out")',
    },
    "04_monte_carlo": {"trials=20_000": "trials=200"},
    "05_your_own_plant": {
        '(("as the law knows it", pendulum), ("a tenth heavier", heavier))': '[("a tenth heavier", heavier)]',
        '    "built in": {"kind": "scaling", "t_f": t_f, "delta": delta},\n': "",
        "(peak(3.0001) - peak(2.9999)) / 2e-4": "slope",
    },
}


def cells(source, monkeypatch):
    """Run the cells at a small size, with a run of five seconds."""
    monkeypatch.setattr("ptsmc_jax.configure.configure", lambda: None)  # done in conftest
    monkeypatch.setattr("ptsmc_jax.read", lambda path: scenario.from_tables(tomllib.loads(SHORT)))
    code = "\n".join(cell.source for cell in jupytext.read(source).cells if cell.cell_type == "code")
    for of_the_notebook, small in SMALLER.get(source.stem, {}).items():
        assert of_the_notebook in code
        code = code.replace(of_the_notebook, small)
    exec(compile(code, source.name, "exec"), {})
    plt.close("all")


@pytest.mark.long
@pytest.mark.parametrize("source", SOURCES, ids=lambda path: path.stem)
def test_notebook_cells_run_at_a_small_size(source, monkeypatch):
    """The cells run in this process. Another test runs them unchanged in a kernel."""
    small_search(monkeypatch)
    cells(source, monkeypatch)


def test_notebook_cells_run_with_traced_runs(monkeypatch):
    """Runs are only traced, and their results are made up with the right shapes, so that little is compiled."""
    traced = {}

    def simulated(*args, **how):
        structure = jax.tree.structure(args)
        if structure not in traced:
            traced[structure] = jax.eval_shape(partial(rollout.simulate, **how), *args)
        shapes = traced[structure]
        made_up = jax.tree.map(lambda v: np.linspace(1.0, 2.0, v.size).reshape(v.shape).astype(v.dtype), shapes)
        return made_up._replace(status=np.asarray(rollout.OK))

    monkeypatch.setattr(rollout, "single_run_program", lambda parts: simulated)
    slope = "jax.jacfwd(peak)(jnp.asarray(3.0))"
    shape = slope.replace("(peak)(", "(peak), ")
    monkeypatch.setitem(SMALLER["05_your_own_plant"], slope, f"jnp.ones(jax.eval_shape({shape}.shape)")
    (source,) = (path for path in SOURCES if path.stem == "05_your_own_plant")
    cells(source, monkeypatch)
    assert len(traced) == 5


SLIDING = [source for source in SOURCES if "interact(" in source.read_text()]


def ends(widget):
    """Return both ends of a slider."""
    base = getattr(widget, "base", None)
    return [float(v) if base is None else base**v for v in (widget.min, widget.max)]


@pytest.mark.long
@pytest.mark.parametrize("source", SLIDING, ids=lambda path: path.stem)
def test_every_slider_accepts_both_ends(source, monkeypatch, capsys):
    """Each slider moves alone, then all move together, with few trials at each position."""
    kept = []
    monkeypatch.chdir(source.parent)  # the working folder of a kernel
    monkeypatch.setattr("ipywidgets.interact", lambda function, **widgets: kept.append((function, widgets)))
    monkeypatch.setattr("ptsmc_jax.configure.configure", lambda: None)
    cells = [cell.source for cell in jupytext.read(source).cells if cell.cell_type == "code"]
    for old, new in {**SMALLER.get(source.stem, {}), "period=0.2)), 64)": "period=0.2)), 8)"}.items():
        cells = [cell.replace(old, new) for cell in cells]
    exec(compile("\n".join(cells), source.name, "exec"), {})
    plt.close("all")
    assert kept
    for function, widgets in kept:
        first = {name: widget.value for name, widget in widgets.items()}
        stops = [{**first, name: end} for name, widget in widgets.items() for end in ends(widget)]
        stops += [{name: ends(widget)[k] for name, widget in widgets.items()} for k in (0, 1)]
        for stop in stops:
            capsys.readouterr()
            function(**stop)
            said = capsys.readouterr().out
            assert said, stop
            assert "nan" not in said, stop


@pytest.mark.long
@pytest.mark.filterwarnings("ignore")  # warnings of the kernel client
@pytest.mark.parametrize("source", SOURCES, ids=lambda path: path.stem)
def test_the_notebook_runs_in_a_kernel(source):
    book = executed(source)
    code = [cell for cell in book.cells if cell.cell_type == "code"]
    assert all(cell.execution_count for cell in code if cell.source.strip())
    for cell in code:
        for output in cell.outputs:
            assert output.output_type != "error"
            assert output.get("name") != "stderr", output.get("text")  # no warning either


@pytest.mark.parametrize("source", SOURCES, ids=lambda path: path.stem)
def test_the_stored_notebook_matches_its_source(source):
    kept, edited = nbformat.read(source.with_suffix(".ipynb"), 4), jupytext.read(source)
    assert [(cell.cell_type, cell.source) for cell in kept.cells] == [
        (cell.cell_type, cell.source) for cell in edited.cells
    ], "run: make notebooks-kept"
    assert [cell["id"] for cell in kept.cells] == [f"cell-{k}" for k in range(len(kept.cells))]  # not random
    outputs = [output for cell in kept.cells if cell.cell_type == "code" for output in cell.outputs]
    assert outputs
    assert all(output.output_type != "error" for output in outputs)
    text = nbformat.writes(kept)
    shown = [out for out in outputs if "image/png" in out.get("data", {}) or "<img" in str(out.get("data", {}))]
    assert len(shown) >= 2  # figures
    # an opened notebook loads no external files, and its outputs contain no local paths
    assert not re.search(r'(src|href)=\\?"https?://', text)
    assert not re.search(r"/(home|root|work|Users)/", text)
    for output in outputs:
        if "image/png" in output.get("data", {}):
            assert base64.b64decode(output.data["image/png"])[:4] == b"\x89PNG"
