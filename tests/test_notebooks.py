"""Every notebook runs without an error, and the stored .ipynb file matches the .py source."""

import base64
import importlib
import re
import sys

import jupytext
import nbformat
import pytest

from tests.helpers import ROOT

sys.path.insert(0, str(ROOT / "notebooks"))
executed = importlib.import_module("execute").executed

SOURCES = sorted((ROOT / "notebooks").glob("0*.py"))
every_notebook = pytest.mark.parametrize("source", SOURCES, ids=lambda path: path.stem)


def test_the_documentation_lists_every_notebook():
    listed = re.findall(r"^tutorials/(\w+)$", (ROOT / "docs" / "index.md").read_text(), re.M)
    assert sorted(listed) == [path.stem for path in SOURCES]


@pytest.mark.long
@pytest.mark.filterwarnings("ignore")  # warnings of the kernel client
@every_notebook
def test_a_notebook_runs_without_errors_and_warnings(source):
    book = executed(source)
    code = [cell for cell in book.cells if cell.cell_type == "code"]
    assert all(cell.execution_count for cell in code if cell.source.strip())
    for cell in code:
        for output in cell.outputs:
            assert output.output_type != "error"
            assert output.get("name") != "stderr", output.get("text")  # no warning either


@every_notebook
def test_a_stored_notebook_matches_its_source_and_has_portable_outputs(source):
    """The outputs are texts, tables and PNG images, without scripts, errors or local paths."""
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
def test_links_in_notebooks_lead_to_existing_files(source):
    texts = [cell.source for cell in jupytext.read(source).cells if cell.cell_type == "markdown"]
    for link in re.findall(r"\]\((?!http|#)([^)#]+)", "\n".join(texts)):
        assert (source.parent / link).exists(), link
