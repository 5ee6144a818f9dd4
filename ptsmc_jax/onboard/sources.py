"""What of a controller's folder decides in flight: the C that is compiled, and the layout of its structs."""

import hashlib
import shutil
from pathlib import Path

LAYOUT = "controller.json"
CHECKS = ("check.c", "fuzz.c")  # of a step's numbers: programs of their own


def listed(folder: Path) -> list[Path]:
    """These files, in the order of their names; also those that a user has put beside."""
    code = {*folder.glob("*.c"), *folder.glob("*.h")} - {folder / name for name in CHECKS}
    return sorted(path for path in {*code, *folder.glob(LAYOUT)} if path.is_file())  # no lock of an editor


def digest(folder: Path) -> str | None:
    """SHA-256 of their names and what they say; None: there are none that can be read."""
    try:
        read = [(path.name, path.read_bytes()) for path in listed(folder)]
    except OSError:
        return None
    parts = (part for name, content in read for part in (name.encode(errors="surrogateescape"), content))
    # each by its length first, so that nothing can move from one file into another
    lengths = (b"%d:%s" % (len(part), part) for part in parts)
    return hashlib.sha256(b"".join(lengths)).hexdigest() if read else None


def copy(folder: Path, to: Path) -> None:
    """Copy them into a new folder."""
    to.mkdir()
    for path in listed(folder):
        shutil.copyfile(path, to / path.name)
