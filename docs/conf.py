"""Settings of Sphinx for `make docs`, which builds these pages offline and treats every warning as an error."""

import ast
import inspect
import re
import textwrap
from pathlib import Path
from typing import Any

import latex2mathml.converter
from docutils import nodes
from sphinx.application import Sphinx

import ptsmc_jax

project = "ptsmc-jax"
author = "the ptsmc-jax developers"
release = version = ptsmc_jax.__version__
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
nb_execution_mode = "off"  # the notebooks are stored with their outputs
nb_merge_streams = True
myst_enable_extensions = ["dollarmath", "deflist"]
myst_heading_anchors = 3
html_theme = "furo"
html_title = f"ptsmc-jax {version}"
html_math_renderer = "mathml"
napoleon_use_ivar = True  # an "Attributes:" section does not describe a field twice
autodoc_default_options = {"members": True, "undoc-members": False, "member-order": "bysource"}
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
autodoc_type_aliases = {"Leaf": "Leaf", "Whole": "Whole"}
suppress_warnings = ["ref.python"]  # names of axes in shapes, taken for names of fields


def as_written(app: Sphinx, what: str, name: str, thing: object, options: Any, lines: list[str]) -> None:
    """Escape a docstring, which is plain text with equations: only `code` and indented lines are markup."""
    text = []
    lines += _fields(thing) if what == "class" else []
    for before, line in zip(["", *lines], lines, strict=False):
        if line.startswith("    ") and not before.strip() and text:
            text += ["::", ""] if text[-1:] != ["::"] else []
        plain = line if line.startswith("    ") else re.sub(r"([\\*|_])", r"\\\1", line)
        text.append(re.sub(r"`([^`]+)`", lambda code: f"``{code[1].replace(chr(92), '')}``", plain))
    lines[:] = text


def _fields(thing: Any) -> list[str]:
    """Return the fields of a class with the comments beside them in the source."""
    try:
        source = textwrap.dedent(inspect.getsource(thing))
    except (OSError, TypeError):  # an alias of a type
        return []
    rows = source.splitlines()
    found = ["", "Fields:", ""]
    for node in ast.parse(source).body[0].body:  # pyright: ignore[reportAttributeAccessIssue]
        if isinstance(node, ast.AnnAssign) and not (name := ast.unparse(node.target)).startswith("_"):
            comments = rows[node.lineno - 1].split("  # ")[1:]
            comment = next((text for text in comments if not text.startswith("pyright:")), "")
            found.append(f"- `{name}`" + (f": {comment}" if comment else ""))
    return found if len(found) > 3 else []


def inline(self: Any, node: nodes.math) -> None:
    """Write an equation in a line as MathML, which browsers draw without an external script."""
    self.body.append(latex2mathml.converter.convert(node.astext()))
    raise nodes.SkipNode


def block(self: Any, node: nodes.math_block) -> None:
    """Write an equation on its own line."""
    self.body.append(latex2mathml.converter.convert(node.astext(), display="block"))
    raise nodes.SkipNode


def copy_notebooks(app: Sphinx, config: Any) -> None:
    """Copy the notebooks to docs/tutorials, with links to the pages from there."""
    folder = Path(app.srcdir) / "tutorials"
    folder.mkdir(exist_ok=True)
    for path in (folder.parent.parent / "notebooks").glob("0*.ipynb"):
        copied, text = folder / path.name, path.read_text(encoding="utf-8").replace("](../docs/", "](../")
        if not copied.exists() or copied.read_text(encoding="utf-8") != text:  # unchanged pages are not built again
            copied.write_text(text, encoding="utf-8")


def setup(app: Sphinx) -> None:
    """Register the functions above; Sphinx calls this."""
    app.connect("config-inited", copy_notebooks)
    app.add_html_math_renderer("mathml", (inline, None), (block, None))
    app.connect("autodoc-process-docstring", as_written)
