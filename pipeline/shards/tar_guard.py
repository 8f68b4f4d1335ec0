"""A check of a tar's bytes on their way to webdataset's reader: damaged, hostile and sparse tars
are refused.

In: a stream. Out: the same bytes. webdataset reads tars with `tarfile`, which takes a broken
header, a zeroed header, and the end of the file for the end of the tar, fills the holes of a sparse
file with as many zeros as its header states, and reads a member name of any length.
"""

import gzip
import re
import tarfile
import zlib
from typing import IO, cast

BLOCK = tarfile.BLOCKSIZE
ZEROS = bytes(BLOCK)
GZIP_MAGIC = b"\x1f\x8b\x08"
GZIP_ERRORS = (gzip.BadGzipFile, zlib.error)
MAX_COMPRESSED_BYTES = 1 << 28
"Bytes of a file in a tar that may be compressed: a small tar could hold files of any size."
MAX_HEADER_BYTES = 1 << 16
"Bytes of a long name, or of a pax header; a path has four thousand at most."
PAX_HEADERS = (tarfile.XHDTYPE, tarfile.XGLTYPE, tarfile.SOLARIS_XHDTYPE)
EXTENDED_HEADERS = (tarfile.GNUTYPE_LONGNAME, tarfile.GNUTYPE_LONGLINK, *PAX_HEADERS)
"Kinds of headers that only describe the header behind them."
COMPRESSED = (GZIP_MAGIC, b"BZh", b"\x5d\x00\x00\x80", b"\xfd7zXZ")
"First bytes of compressed files: `tarfile` would unpack them itself, after this check."
PAX_RECORD = re.compile(rb"(\d+) ([^=]+)=")
"How `tarfile` finds the records of a pax header."


class GuardedTar:
    """A stream of a tar's bytes that raises tarfile.ReadError where the tar is not intact."""

    def __init__(self, stream: IO[bytes], compressed: bool = False) -> None:
        self._stream = stream
        self._limit = MAX_COMPRESSED_BYTES if compressed else None
        self._partial = b""
        "The beginning of a block whose end has not been read."
        self._skip = 0
        "Bytes of a member's data that are still to come."
        self._pax = -1
        "Bytes of a pax header, collected in `_partial`; -1 outside of one."
        self._begun = self._ended = False

    def read(self, size: int = -1) -> bytes:
        data = self._stream.read(size)
        if self._skip >= len(data) > 0:  # within an image, as most reads are
            self._skip -= len(data)
        elif data:
            self._check(data)
        elif self._partial or self._skip or not self._ended:
            raise tarfile.ReadError("it ends before its end marker")
        return data

    def finish(self) -> None:
        """Read on to the end of the file, where `tarfile` has stopped at an empty header."""
        while self.read(1 << 20):
            pass

    def _check(self, data: bytes) -> None:
        start = self._skip
        if not start:
            data = self._partial + data
        while True:
            if self._pax >= 0:
                if len(data) < start + self._pax:
                    break
                _check_pax(data[start : start + self._pax])
                start, self._pax = start + self._pax, -1
            if len(data) < start + BLOCK:
                break
            start += BLOCK + self._check_header(data[start : start + BLOCK])
        self._skip = max(0, start - len(data))
        self._partial = data[start:]

    def _check_header(self, block: bytes) -> int:
        """Bytes of the data behind a header that need no check."""
        if block == ZEROS:
            self._ended = True
            return 0
        if self._ended:
            raise tarfile.ReadError("it has an empty header before its end")
        if not self._begun:
            self._begun = True
            if block.startswith(COMPRESSED):
                raise tarfile.ReadError("it is compressed, or its first name looks like it")
        size = _plain_size(block)
        if size is None:
            try:
                header = tarfile.TarInfo.frombuf(block, "utf-8", "surrogateescape")
            except tarfile.HeaderError as error:
                raise tarfile.ReadError(str(error)) from None
            size = header.size
            if header.type == tarfile.GNUTYPE_SPARSE:
                raise tarfile.ReadError("it holds a sparse file")
            extended = header.type in EXTENDED_HEADERS
            if size < 0 or (extended and size > MAX_HEADER_BYTES):
                raise tarfile.ReadError(f"it has a header of {size} bytes")
            if size and block[156:157] == tarfile.AREGTYPE and header.type == tarfile.DIRTYPE:
                raise tarfile.ReadError(f"it holds a folder of {size} bytes")
            if header.type in PAX_HEADERS:
                self._pax = -(-size // BLOCK) * BLOCK
                return 0
            if not (extended or header.isreg() or header.type not in tarfile.SUPPORTED_TYPES):
                return 0
        if self._limit is not None and size > self._limit:
            raise tarfile.ReadError(f"it holds a file of {size} bytes, more than any image has")
        return -(-size // BLOCK) * BLOCK


def gunzipped(stream: IO[bytes]) -> IO[bytes]:
    """The stream, or its content where it is compressed by gzip."""
    head = stream.read(len(GZIP_MAGIC))
    replayed = cast(IO[bytes], _Replayed(head, stream))
    return cast(IO[bytes], gzip.GzipFile(fileobj=replayed)) if head == GZIP_MAGIC else replayed


class _Replayed:
    """A stream whose first bytes have been read already and come again, by themselves."""

    def __init__(self, head: bytes, stream: IO[bytes]) -> None:
        self._head, self._stream = head, stream

    def read(self, size: int = -1) -> bytes:
        if not self._head:
            return self._stream.read(size)
        end = len(self._head) if size < 0 else size
        head, self._head = self._head[:end], self._head[end:]
        return head


def _plain_size(block: bytes) -> int | None:
    """The size that a regular file's header states; None for a header of another kind.

    4 us, where `TarInfo.frombuf` takes 20 and is run by `tarfile` on the same header again.
    """
    if block[156] != 0x30 or block[135] not in b"\0 " or not block[124:135].isdigit():
        return None
    stated = block[148:154]
    if not stated.isdigit() or sum(block) - sum(block[148:156]) + 8 * 0x20 != int(stated, 8):
        return None
    return int(block[124:135], 8)


def _check_pax(data: bytes) -> None:
    """Raise ReadError where a pax header makes a file sparse or gives it another size."""
    position = 0
    while record := PAX_RECORD.match(data, position):
        length, keyword = int(record[1]), record[2]
        if keyword.startswith((b"GNU.sparse", b"SCHILY.realsize")):
            raise tarfile.ReadError("it holds a sparse file")
        if keyword == b"size":
            raise tarfile.ReadError("it holds a file larger than 8 GiB")
        if not length:
            raise tarfile.ReadError("it has a pax header that cannot be read")
        position += length
