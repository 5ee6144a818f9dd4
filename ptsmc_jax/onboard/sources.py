"""The files of a controller's folder that determine its commands: the compiled C and the layout of its structs."""

import hashlib
import shutil
from pathlib import Path

LAYOUT = "controller.json"
OTHERS = ("check.c", "fuzz.c", "udp.c", "shared.c")  # sources of separate programs, which do not change the commands


def listed(folder: Path) -> list[Path]:
    """Return the files that determine the commands, by name, including files that the user has added."""
    code = {*folder.glob("*.c"), *folder.glob("*.h")} - {folder / name for name in OTHERS}
    return sorted(path for path in {*code, *folder.glob(LAYOUT)} if path.is_file())  # without lock files of editors


def checksum(folder: Path) -> str | None:
    """Return the SHA-256 of the names and contents of the `listed` files; None if no file can be read."""
    try:
        read = [(path.name, path.read_bytes()) for path in listed(folder)]
    except OSError:
        return None
    parts = (part for name, content in read for part in (name.encode(errors="surrogateescape"), content))
    # include the length of each part, so that moving text from one file to another changes the checksum
    lengths = (b"%d:%s" % (len(part), part) for part in parts)
    return hashlib.sha256(b"".join(lengths)).hexdigest() if read else None


def copy(folder: Path, to: Path) -> None:
    """Copy the `listed` files into a new folder."""
    to.mkdir()
    for path in listed(folder):
        shutil.copyfile(path, to / path.name)
