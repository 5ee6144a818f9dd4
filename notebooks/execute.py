"""Executes every notebook, and keeps it with its outputs beside its source: `python notebooks/execute.py`."""

import sys
import time
from pathlib import Path

import jupytext
from nbclient import NotebookClient

HERE = Path(__file__).parent


def executed(source: Path):
    """The notebook of a source file, executed; raises what a cell raises."""
    book = jupytext.read(source)
    NotebookClient(book, timeout=600, kernel_name="python3", resources={"metadata": {"path": str(HERE)}}).execute()
    for place, cell in enumerate(book.cells):  # times, process numbers and drawn ids would be a change each time
        cell.metadata.pop("execution", None)
        cell["id"] = f"cell-{place}"
    book.metadata.pop("widgets", None)  # what a widget shows needs its kernel, and names hosts
    return book


def main() -> None:
    """Write NAME.ipynb for each of the named, or all, NAME.py."""
    names = sys.argv[1:] or [path.stem for path in sorted(HERE.glob("0*.py"))]
    for name in names:
        started = time.monotonic()
        jupytext.write(executed(HERE / f"{name}.py"), HERE / f"{name}.ipynb")
        print(f"{name}: {time.monotonic() - started:.0f} s")


if __name__ == "__main__":
    main()
