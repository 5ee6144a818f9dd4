"""Execute notebooks and store them with their outputs: `python notebooks/execute.py [NAME ...]`."""

import sys
import time
from pathlib import Path

import jupytext
from nbclient import NotebookClient

HERE = Path(__file__).parent


def executed(source: Path):
    """Return the executed notebook of a source file. Raises CellExecutionError if a cell raises an error."""
    book = jupytext.read(source)
    NotebookClient(book, timeout=3600, kernel_name="python3", resources={"metadata": {"path": str(HERE)}}).execute()
    for place, cell in enumerate(book.cells):  # times and random ids would change each time
        cell.metadata.pop("execution", None)
        cell["id"] = f"cell-{place}"
    return book


def main() -> None:
    """Write NAME.ipynb for each named NAME.py, or for all of them."""
    names = sys.argv[1:] or [path.stem for path in sorted(HERE.glob("0*.py"))]
    for name in names:
        started = time.monotonic()
        jupytext.write(executed(HERE / f"{name}.py"), HERE / f"{name}.ipynb")
        print(f"{name}: {time.monotonic() - started:.0f} s")


if __name__ == "__main__":
    main()
