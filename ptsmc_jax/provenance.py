"""Checksum of the source code, which identifies the version that made a result or a compiled program."""

import functools
import hashlib
from pathlib import Path

PACKAGES = ("ptsmc_jax", "tuning")
FOLDER = Path(__file__).parent.parent  # folder that contains the packages


@functools.cache
def code_checksum(*packages: str) -> str:
    """Return the SHA-256 of the Python files of some of `PACKAGES`, read at the first call."""
    checksum = hashlib.sha256()
    for package in packages:
        for path in sorted((FOLDER / package).rglob("*.py")):
            checksum.update(f"{path.relative_to(FOLDER)} {path.stat().st_size}".encode())
            checksum.update(path.read_bytes())
    return checksum.hexdigest()
