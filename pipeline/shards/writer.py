"""One planned shard -> one tar with the source's own bytes and a JSON per image, and its part of
the record table.

In: a plan and its source. Out: two files, each whole or not there; the same input gives the same
bytes.
"""

import hashlib
import json
import tarfile
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import IO, Any

from pipeline.core import storage
from pipeline.core.prefetch import prefetch_map
from pipeline.core.records import ImageRecord, Rejection
from pipeline.images.decode import DecodeError, decode
from pipeline.images.inspect import inspect
from pipeline.shards import record_table
from pipeline.shards.manifest import Shard
from pipeline.shards.plan import ShardPlan
from pipeline.shards.record_table import Packed
from pipeline.shards.settings import Check
from pipeline.sources import name_of
from pipeline.sources.base import Source

READERS, REMOTE_READERS, READ_AHEAD = 1, 16, 64
"""Threads that read and judge images ahead of the tar, from a disk of this machine (more only get
in each other's way) and over a network, and how many images they may be ahead."""
UNREADABLE = "unreadable file"


def _template() -> bytes:
    info = tarfile.TarInfo("")
    info.uname = info.gname = "root"
    block = info.tobuf(tarfile.USTAR_FORMAT)
    return (
        block[:124] + bytes(12) + block[136:148] + bytes(8) + block[156:]
    )  # without size and checksum


TEMPLATE = _template()
CHECKSUM = sum(TEMPLATE) + 8 * ord(" ")
"Of the template; the checksum counts its own eight characters as blanks."


@dataclass(frozen=True, kw_only=True)
class Member:
    """An image on its way into the tar."""

    name: str
    "Of the file in the tar."
    data: bytes
    facts: dict[str, Any]
    "The JSON beside it."


def write_shard(
    plan: ShardPlan,
    source: Source,
    out: str,
    digest: str,
    check: Check = "quick",
    doubles: Mapping[str, str] | None = None,
) -> Packed:
    """Write one tar and its record part; images that cannot be used are left out and told of.

    `doubles`: keys to leave out, with the name of the image that has the same bytes.
    """
    left_out = doubles or {}

    def prepare(record: ImageRecord) -> Member | Rejection:
        if record.key in left_out:
            return Rejection(
                path=record.name, reason="duplicate", found=f"same bytes as {left_out[record.key]}"
            )
        try:
            return read_member(record, source, check)
        except DecodeError as error:
            return Rejection(path=record.name, reason=error.reason, found=error.found)

    rejected, rows = [], []
    with storage.atomic_write(storage.join(out, f"{plan.name}.tar")) as stream:
        tar = TarStream(stream)
        near = not plan.records or storage.is_local(plan.records[0].path)
        found = prefetch_map(prepare, plan.records, READERS if near else REMOTE_READERS, READ_AHEAD)
        for record, member in zip(plan.records, found, strict=True):
            if isinstance(member, Rejection):
                rejected.append(member)
                continue
            tar.add(member.name, member.data)
            tar.add(f"{record.key}.json", json.dumps(member.facts, ensure_ascii=False).encode())
            rows.append(record_table.row(record, plan.name, member.facts, len(member.data)))
        tar.close()
    shard = Shard(
        name=plan.name, split=plan.split, view=plan.view,
        samples=len(rows), bytes=tar.bytes, sha256=tar.digest.hexdigest(),
    )  # fmt: skip
    packed = Packed(shard=shard, plan=digest, rejected=tuple(rejected))
    record_table.write_part(out, packed, rows)
    return packed


def read_member(record: ImageRecord, source: Source, check: Check) -> Member:
    """An image's bytes, never encoded again, and what the tar says of them.

    Raises DecodeError when they are no image, or cannot be read, and are neither when they are read
    once more: a storage that fails for a moment costs no image.
    """
    try:
        data, (width, height) = _judged(record, source, check)
    except DecodeError:
        data, (width, height) = _judged(record, source, check)
    facts = {
        "key": record.key,
        "location": record.location,
        "view": record.view,
        "split": record.split,
        "variant": record.variant,
        "geotag": None if record.geotag is None else asdict(record.geotag),
        "taken_at": record.taken_at,
        "source": name_of(source),
        "sha256": hashlib.sha256(data).hexdigest(),
        "width": width,
        "height": height,
    }
    return Member(name=f"{record.key}.{source.ending(record)}", data=data, facts=facts)


def _judged(record: ImageRecord, source: Source, check: Check) -> tuple[bytes, tuple[int, int]]:
    """An image's bytes, with its width and height."""
    try:
        data = source.read(record)
    except OSError as error:
        raise DecodeError(UNREADABLE, str(error)) from None
    size = inspect(data)
    if check == "full":
        decode(data)
    return data, size


def header(name: str, size: int) -> bytes:
    """The tar header of a file: 512 bytes, ustar, fixed time, owner and mode.

    `name`: ASCII, at most 100 characters; `size`: bytes, below 8 GiB. tarfile makes the same, at a tenth of the speed.
    """
    named, sized = name.encode("ascii"), b"%011o\0" % size
    checksum = b"%06o\0 " % (CHECKSUM + sum(named) + sum(sized))
    return b"".join(
        (
            named.ljust(100, b"\0"),
            TEMPLATE[100:124],
            sized,
            TEMPLATE[136:148],
            checksum,
            TEMPLATE[156:],
        )
    )


class TarStream:
    """A tar that is written from front to back, counted and hashed on its way.

    Fixed time, owner and mode: the same members give the same bytes.
    """

    def __init__(self, stream: IO[bytes]) -> None:
        self._stream, self.digest, self.bytes = stream, hashlib.sha256(), 0

    def add(self, name: str, data: bytes) -> None:
        self._write(header(name, len(data)))
        self._write(data)
        if rest := -len(data) % tarfile.BLOCKSIZE:
            self._write(bytes(rest))

    def close(self) -> None:
        """Two empty blocks end a tar; tar programs fill the last record, so that others do not
        complain.
        """
        end = 2 * tarfile.BLOCKSIZE
        self._write(bytes(end + -(self.bytes + end) % tarfile.RECORDSIZE))

    def _write(self, data: bytes) -> None:
        self.digest.update(data)
        self.bytes += len(data)
        self._stream.write(data)
