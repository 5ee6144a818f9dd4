"""A journal of the evaluations of a long computation. An interrupted computation resumes from it. See `Journal.get`.

Records are appended to one file, each with its length and checksum. Only one process writes at a time, see
`store.lock_folder`.
"""

import io
import struct
import zlib
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import numpy as np

_HEAD = struct.Struct("<QI")  # length and CRC-32 of the record that follows


class Journal:
    """Evaluations in the order of their requests. Without a path, nothing is recorded."""

    def __init__(self, path: Path | None = None):
        self._path = path
        self._unused_records = deque(_read_records(path.read_bytes()) if path is not None and path.exists() else ())
        self._end = 0  # size of the records that were read or written, in bytes

    def get(self, question: bytes, compute: Callable[[], Mapping[str, np.ndarray]]) -> dict[str, np.ndarray]:
        """Return the recorded answer to a question, or compute and record it.

        Args:
            question: all inputs of the answer, as bytes. If another question was recorded at this position, its record
                and all later records are replaced.
            compute: returns the answer.
        """
        question_checksum = np.frombuffer(struct.pack("<I", zlib.crc32(question)), dtype=np.uint8)
        if self._unused_records:
            record, end = self._unused_records.popleft()
            if np.array_equal(record.pop("question"), question_checksum):
                self._end = end
                return record
            self._unused_records.clear()
        answer = {name: np.asarray(value) for name, value in compute().items()}
        if self._path is not None:
            with self._path.open("ab") as file:
                file.truncate(self._end)  # removes an incomplete record, or records whose question differs
                self._end += file.write(_pack_record({"question": question_checksum, **answer}))
        return answer


def _pack_record(record: Mapping[str, np.ndarray]) -> bytes:
    """Return a record of arrays by name as bytes, preceded by length and CRC-32."""
    buffer = io.BytesIO()
    np.savez(buffer, **record)  # pyright: ignore[reportArgumentType]
    data = buffer.getvalue()
    return _HEAD.pack(len(data), zlib.crc32(data)) + data


def _read_records(data: bytes) -> Iterator[tuple[dict[str, np.ndarray], int]]:
    """Yield the complete records, each with the position of its end. Stop at a damaged record."""
    position = 0
    while position + _HEAD.size <= len(data):
        length, checksum = _HEAD.unpack_from(data, position)
        position += _HEAD.size
        body = data[position : position + length]
        if len(body) < length or zlib.crc32(body) != checksum:
            return
        position += length
        with np.load(io.BytesIO(body)) as loaded:
            yield dict(loaded), position
