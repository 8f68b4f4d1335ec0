"""A tar of webdataset's layout -> its samples as named bytes, in one pass: nothing is unpacked,
nothing unpickled.

In: a tar as a stream. Out: per sample its key and the members behind it, by ending. Broken and
hostile tars are refused.
"""

import hashlib
import tarfile
from collections.abc import Iterator
from typing import IO, Self

from pipeline.core import storage
from pipeline.core.errors import InputError

IMAGE_SUFFIXES = ("jpg", "jpeg", "png", "webp", "tif", "tiff", "bmp", "gif", "ppm")
"Endings of the members that are images."
METADATA_SUFFIXES = ("json", "cls")
"""Endings of the members that say what an image shows. All others are passed over: captions, masks,
pickles."""

MAX_HEADER_BYTES = 1 << 16
"Bytes of a long name, or of a pax header; a path has four thousand at most."
EXTENDED_HEADERS = (
    tarfile.GNUTYPE_LONGNAME,
    tarfile.GNUTYPE_LONGLINK,
    tarfile.XHDTYPE,
    tarfile.XGLTYPE,
    tarfile.SOLARIS_XHDTYPE,
)
"Kinds of headers that only say something of the one behind them."


def read_tar(
    path: str, endings: tuple[str, ...] = IMAGE_SUFFIXES + METADATA_SUFFIXES
) -> Iterator[tuple[str, dict[str, bytes]]]:
    """Key and members (ending -> bytes) of each sample of a tar, in its order; members of other
    endings are not read.

    A sample is a run of members whose names agree up to the first dot after the folder, as
    webdataset has it. Raises InputError where the tar ends too early, is none, or holds a name that
    leads out of it.
    """
    with storage.open_read(path) as stream:
        yield from read_members(stream, path, endings)


def read_members(
    stream: IO[bytes], path: str, endings: tuple[str, ...]
) -> Iterator[tuple[str, dict[str, bytes]]]:
    """`read_tar` of an open stream, which is read from its start to its end; `path` stands in the
    messages.
    """
    key, held, samples = "", dict[str, bytes](), 0
    try:
        with tarfile.open(fileobj=stream, mode="r|", tarinfo=_Header) as tar:
            while (member := tar.next()) is not None:
                tar.members = []  # type: ignore[attr-defined]  # it would remember every header
                check_member_name(member.name, path)
                folder, _, name = member.name.removeprefix("./").rpartition("/")
                stem, _, ending = name.partition(".")
                if not member.isfile() or ending.lower() not in endings:
                    continue
                prefix = f"{folder}/{stem}" if folder else stem
                if prefix != key:
                    if held:
                        yield key, held
                        samples += 1
                    key, held = prefix, {}
                file = tar.extractfile(member)
                assert file is not None  # of a regular file there is one
                held[ending.lower()] = file.read()
    # The last two are of headers that make no sense.
    except (tarfile.TarError, EOFError, ValueError, RecursionError) as error:
        raise InputError(
            f"{path} is cut off or damaged after {samples} samples ({error}), expected a whole tar; copy it again from where "
            "it came from, or pack again with jobs/make_shards.py"
        ) from None
    if held:
        yield key, held


def check_member_name(name: str, path: str) -> None:
    """Raise InputError where a member's name leads out of the tar's own folder."""
    if (
        name.startswith(("/", "\\"))
        or ".." in name.replace("\\", "/").split("/")
        or name[1:2] == ":"
    ):
        raise InputError(
            f"{path} holds a member named {name!r}, expected a name below the tar's own folder; do not unpack this tar, and "
            "have it packed again with plain names"
        )


class _Header(tarfile.TarInfo):
    """A member's header. Left to itself tarfile takes a broken header, or the end of the file, for
    the end of the tar.

    And it fills the holes of a sparse file with as many zeros as the header says, reads a name of
    any length, and takes the square of a pax header's length to read it.
    """

    @classmethod
    def frombuf(cls, buf: bytes | bytearray, encoding: str, errors: str) -> Self:
        if len(buf) < tarfile.BLOCKSIZE:
            raise tarfile.ReadError("it ends before its end marker")
        if not any(buf):
            return super().frombuf(buf, encoding, errors)  # raises: the end marker
        try:
            said = super().frombuf(buf, encoding, errors)
        except tarfile.HeaderError as error:
            raise tarfile.ReadError(str(error)) from None
        if said.type == tarfile.GNUTYPE_SPARSE:
            cls._refuse_sparse()
        if said.size < 0 or (said.type in EXTENDED_HEADERS and said.size > MAX_HEADER_BYTES):
            raise tarfile.ReadError(f"it has a header of {said.size} bytes")
        return said

    @staticmethod
    def _refuse_sparse(*_: object) -> None:
        raise tarfile.ReadError("it holds a sparse file")

    _proc_gnusparse_00 = _proc_gnusparse_01 = _proc_gnusparse_10 = _refuse_sparse


class HashedStream:
    """A stream that counts and hashes what is read through it."""

    def __init__(self, stream: IO[bytes]) -> None:
        self._stream, self.digest, self.bytes = stream, hashlib.sha256(), 0

    def read(self, size: int = -1) -> bytes:
        data = self._stream.read(size)
        self.digest.update(data)
        self.bytes += len(data)
        return data

    def drain(self) -> None:
        """Read what stands behind the tar's end."""
        while self.read(1 << 20):
            pass
