"""The files of a controller's folder that determine its commands: the compiled C and the layout of its structs."""

import hashlib
import shutil
from pathlib import Path

LAYOUT = "controller.json"
# sources of separate programs, which do not change the commands
SEPARATE_PROGRAMS = ("check.c", "fuzz.c", "udp.c", "shared.c")


def list_files(folder: Path) -> list[Path]:
    """Return the files that determine the commands, by name, including files that the user has added."""
    code = {*folder.glob("*.c"), *folder.glob("*.h")} - {folder / name for name in SEPARATE_PROGRAMS}
    return sorted(path for path in {*code, *folder.glob(LAYOUT)} if path.is_file())  # without lock files of editors


def checksum(folder: Path) -> str | None:
    """Return the SHA-256 of the names and contents of the files in `list_files`; None if no file can be read."""
    try:
        contents = [(path.name, path.read_bytes()) for path in list_files(folder)]
    except OSError:
        return None
    parts = (part for name, content in contents for part in (name.encode(errors="surrogateescape"), content))
    # include the length of each part, so that moving text from one file to another changes the checksum
    lengths = (b"%d:%s" % (len(part), part) for part in parts)
    return hashlib.sha256(b"".join(lengths)).hexdigest() if contents else None


def copy(folder: Path, new_folder: Path) -> None:
    """Copy the files in `list_files` into a new folder."""
    new_folder.mkdir()
    for path in list_files(folder):
        shutil.copyfile(path, new_folder / path.name)
