"""Whether a file still holds the bytes that were written: its size and SHA-256, recorded and
verified.

In: paths and streams. Out: a `FileChecksum`, which an artefact's metadata lists per file, and the
reason if a file does not match it. A file that no metadata lists gets its checksum in a file beside
it.

Parquet files (`core.parquet`), JSON metadata (`core.json_files`) and checkpoints
(`model.checkpoint`) carry a checksum within themselves instead.
"""

import hashlib
from dataclasses import asdict, dataclass
from typing import IO

from pipeline.core import storage
from pipeline.core.json_files import from_json, read_checksummed, write_checksummed

READ_BYTES = 1 << 22
"Of a file that is hashed, at a time."


@dataclass(frozen=True, kw_only=True)
class FileChecksum:
    """What a file held when it was written."""

    bytes: int
    sha256: str
    "64 hexadecimal digits."


class HashingStream:
    """Counts and hashes the bytes that are read, or those that are written, through a stream."""

    def __init__(self, stream: IO[bytes]) -> None:
        self._stream, self._digest, self._bytes = stream, hashlib.sha256(), 0

    def read(self, size: int = -1) -> bytes:
        data = self._stream.read(size)
        self._update(data)
        return data

    def drain(self) -> None:
        """Read the rest of the stream."""
        while self.read(READ_BYTES):
            pass

    def write(self, data: bytes) -> int:
        self._update(data)
        return self._stream.write(data)

    def tell(self) -> int:
        """Bytes so far."""
        return self._bytes

    @property
    def checksum(self) -> FileChecksum:
        """Of the bytes so far."""
        return FileChecksum(bytes=self._bytes, sha256=self._digest.hexdigest())

    def _update(self, data: bytes) -> None:
        self._digest.update(data)
        self._bytes += len(data)


def sha256_of(data: bytes) -> str:
    """SHA-256 of some bytes, in hexadecimal digits."""
    return hashlib.sha256(data).hexdigest()


def checksum_file(path: str) -> FileChecksum:
    """Size and SHA-256 of a file, read block by block. Raises OSError."""
    with storage.open_read(path) as stream:
        hashing = HashingStream(stream)
        hashing.drain()
    return hashing.checksum


def find_mismatch(path: str, expected: FileChecksum, content: bool = True) -> str | None:
    """What is wrong with a file, as the rest of a sentence that begins with its path; None if it is
    intact.

    `content`: compare the SHA-256 too, which reads the whole file; else only whether the file
    exists and its size.
    """
    if not storage.exists(path):
        return "is missing"
    size = storage.size(path)
    if size != expected.bytes:
        return f"has {size:,} bytes, expected {expected.bytes:,}"
    if content and checksum_file(path).sha256 != expected.sha256:
        return "holds other bytes than were written (its SHA-256 differs)"
    return None


def write_checksum(path: str) -> None:
    """Write the checksum of a finished file beside it, as `PATH.json`: it marks the file as
    complete."""
    write_checksummed(f"{path}.json", asdict(checksum_file(path)))


def checksum_ok(path: str) -> bool:
    """Whether a file and the checksum beside it exist and match."""
    try:
        if not storage.exists(f"{path}.json"):
            return False
        expected = from_json(FileChecksum, read_checksummed(f"{path}.json"))
        return find_mismatch(path, expected) is None
    except (OSError, ValueError):
        return False
