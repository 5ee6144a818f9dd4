"""The rows of a campaign: Parquet files ("parts") that are complete or absent, each with a checksum in its name.

A part contains the trials from its first to its last. The checksum is keyed by the campaign, so it detects parts that
are truncated, changed or of another campaign. A part needs no second file.
"""

import functools
import hashlib
import io
import json
import os
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import polars as pl

from ptsmc_jax.campaigns import store

FOLDER = "trials"  # subfolder of a campaign with its parts
_NAME = re.compile(r"(\d{10})-(\d{10})-([0-9a-f]{32})\.parquet")


def has_part_name(path: Path) -> bool:
    """Return whether a file has the name of a part, of any campaign."""
    return _NAME.fullmatch(path.name) is not None


@dataclass(frozen=True, order=True)
class Part:
    """A complete part on disk: one Parquet file with the rows of consecutive trials."""

    first: int  # number of the first trial
    count: int  # number of trials
    path: Path

    @property
    def end(self) -> int:
        """The first trial after the part."""
        return self.first + self.count


@dataclass(frozen=True)
class Rows:
    """The parts in a folder that belong to one campaign."""

    folder: Path
    key: bytes  # key of the checksums in the file names, see `campaign_key`

    def write(self, first: int, frame: pl.DataFrame) -> Part:
        """Write a part as a Parquet file, first under a temporary name. Raises OSError if the disk is full.

        Args:
            first: number of its first trial.
            frame: its rows, one for each trial.
        """
        count, content = frame.height, encode_parquet(frame)
        self.folder.mkdir(parents=True, exist_ok=True)
        path = self.folder / f"{first:010d}-{first + count - 1:010d}-{self.checksum(first, count, content)}.parquet"
        with store.replace_file(path) as temporary, temporary.open("xb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        return Part(first, count, path)

    def parts(self) -> tuple[list[Part], list[Path]]:
        """Return the parts in order, without overlaps, and files that are damaged or of another campaign."""
        complete, damaged = [], []
        for path in sorted(self.folder.glob("*.parquet")):
            name = _NAME.fullmatch(path.name)
            first, count = (int(name[1]), int(name[2]) - int(name[1]) + 1) if name else (0, 0)
            status = path.stat()
            version = status.st_ino, status.st_size, status.st_mtime_ns
            if name is not None and _file_checksum(self, path, version, first, count) == name[3]:
                complete.append(Part(first, count, path))
            else:
                damaged.append(path)
        parts: list[Part] = []
        for part in sorted(complete, key=lambda p: (p.first, -p.count)):
            if not parts or part.first >= parts[-1].end:
                parts.append(part)
        return parts, damaged

    def tidy(self, parts: Iterable[Part]) -> None:
        """Remove temporary files of killed processes, and all parts except these."""
        for path in self.folder.glob(f"{store.TEMPORARY_PREFIX}*"):
            path.unlink(missing_ok=True)
        kept = {part.path for part in parts}
        for path in self.folder.glob("*.parquet"):
            if path not in kept and has_part_name(path):
                path.unlink(missing_ok=True)

    def checksum(self, first: int, count: int, content: bytes) -> str:
        """Return the checksum of a part, which depends on the campaign, the numbers of the trials and the rows.

        Args:
            first: number of the first trial of the part.
            count: number of trials of the part.
            content: content of the Parquet file.

        Returns:
            32 hexadecimal digits.
        """
        checksum = hashlib.blake2b(content, digest_size=16, key=self.key)
        checksum.update(f"{first}+{count}".encode())
        return checksum.hexdigest()


@functools.cache
def _file_checksum(rows: Rows, path: Path, version: tuple[int, int, int], first: int, count: int) -> str:
    """Return the checksum of a part's file; the cache saves reading an unchanged file again.

    Args:
        rows: the campaign's parts, with the key of the checksum.
        path: the Parquet file of the part.
        version: inode, size and time of the last change of the file [ns].
        first: number of the part's first trial.
        count: number of its trials.
    """
    return rows.checksum(first, count, path.read_bytes())


def campaign_key(scenario: store.Tables, made_by: store.Tables) -> bytes:
    """Return the key of a campaign's checksums, from its scenario, seed and other inputs of its rows."""
    text = json.dumps([scenario, made_by], sort_keys=True, default=lambda value: f"<{type(value).__name__}>")
    return hashlib.sha256(text.encode()).digest()


def encode_parquet(frame: pl.DataFrame) -> bytes:
    """Return a table as the content of a Parquet file."""
    buffer = io.BytesIO()
    frame.write_parquet(buffer, compression="zstd", compression_level=1)
    return buffer.getvalue()


def read(parts: Sequence[Part], columns: Iterable[str] | None = None) -> pl.DataFrame:
    """Return the rows of these parts, in order; columns: names, None for all."""
    wanted = None if columns is None else list(columns)
    # a folder with the name runs[1] or runs* is not a pattern
    return pl.read_parquet([part.path for part in parts], columns=wanted, glob=False).rechunk()


def column_names(part: Part) -> list[str]:
    """Return the names of the columns of a part, in order."""
    with part.path.open("rb") as file:  # opened here, because Polars takes a path as a pattern
        return list(pl.read_parquet_schema(file))
