"""Checksums of files: intact, changed, cut, gone; recorded in metadata or beside the file."""

import io
from pathlib import Path

import pytest

from pipeline.core.integrity import (
    FileChecksum,
    HashingStream,
    checksum_file,
    checksum_ok,
    find_mismatch,
    sha256_of,
    write_checksum,
)

ABC = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
"SHA-256 of `abc` [FIPS 180-2, appendix B.1]."


@pytest.fixture
def path(tmp_path: Path) -> Path:
    file = tmp_path / "a.bin"
    file.write_bytes(b"abc")
    return file


def test_checksum_of_a_file_is_size_and_sha256(path: Path) -> None:
    assert checksum_file(str(path)) == FileChecksum(bytes=3, sha256=ABC)
    assert sha256_of(b"abc") == ABC


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"abc", None),
        (b"abd", "holds other bytes than were written (its SHA-256 differs)"),
        (b"ab", "has 2 bytes, expected 3"),
        (None, "is missing"),
    ],
)
def test_mismatch_says_what_is_wrong(path: Path, data: bytes | None, reason: str | None) -> None:
    path.unlink()
    if data is not None:
        path.write_bytes(data)
    assert find_mismatch(str(path), FileChecksum(bytes=3, sha256=ABC)) == reason


def test_mismatch_without_content_compares_sizes_only(path: Path) -> None:
    assert find_mismatch(str(path), FileChecksum(bytes=3, sha256=""), content=False) is None


def test_hashing_stream_counts_reads_and_writes() -> None:
    reading = HashingStream(io.BytesIO(b"abc"))
    assert reading.read(2) == b"ab"
    assert reading.checksum.bytes == reading.tell() == 2
    reading.drain()
    target = io.BytesIO()
    writing = HashingStream(target)
    assert writing.write(b"abc") == 3
    assert target.getvalue() == b"abc"
    assert reading.checksum == writing.checksum == FileChecksum(bytes=3, sha256=ABC)


def test_checksum_beside_a_file_marks_it_complete(path: Path) -> None:
    assert not checksum_ok(str(path))
    write_checksum(str(path))
    assert checksum_ok(str(path))
    path.write_bytes(b"abd")
    assert not checksum_ok(str(path))


@pytest.mark.parametrize("data", [b"", b"[]", b"{}", b'{"bytes": 3}'])
def test_checksum_beside_a_file_may_be_damaged(path: Path, data: bytes) -> None:
    path.with_name("a.bin.json").write_bytes(data)
    assert not checksum_ok(str(path))
