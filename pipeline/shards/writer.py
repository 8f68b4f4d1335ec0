"""One planned shard -> one tar with the source's own bytes and a JSON per image, and its part of
the record table.

In: a plan and its source. Out: two files, each complete or absent; the same input gives the same
bytes.
"""

import io
import json
import tarfile
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import IO, Any, cast

from pipeline.core import storage
from pipeline.core.integrity import HashingStream, sha256_of
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
"""Threads that read and check images ahead of the tar, from a disk of this machine (more only get
in each other's way) and over a network, and how many images they may be ahead."""
UNREADABLE = "unreadable file"


@dataclass(frozen=True, kw_only=True)
class Member:
    """An image to be written into the tar."""

    name: str
    "Of the file in the tar."
    data: bytes
    metadata: dict[str, Any]
    "The JSON beside it."


def write_shard(
    plan: ShardPlan,
    source: Source,
    out: str,
    digest: str,
    check: Check = "quick",
    duplicates: Mapping[str, str] | None = None,
) -> Packed:
    """Write one tar and its record part; unusable images are rejected, with the reason.

    `duplicates`: keys to leave out, with the name of the image that has the same bytes.
    """
    left_out = duplicates or {}

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
        hashed = HashingStream(stream)
        near = not plan.records or storage.is_local(plan.records[0].path)
        threads = READERS if near else REMOTE_READERS
        members = prefetch_map(prepare, plan.records, threads, READ_AHEAD)
        with open_tar(hashed) as tar:
            for record, member in zip(plan.records, members, strict=True):
                if isinstance(member, Rejection):
                    rejected.append(member)
                    continue
                add_file(tar, member.name, member.data)
                text = json.dumps(member.metadata, ensure_ascii=False)
                add_file(tar, f"{record.key}.json", text.encode())
                rows.append(record_table.row(record, plan.name, member.metadata, len(member.data)))
    shard = Shard(
        name=plan.name, split=plan.split, view=plan.view,
        samples=len(rows), **asdict(hashed.checksum),
    )  # fmt: skip
    packed = Packed(shard=shard, plan=digest, rejected=tuple(rejected))
    record_table.write_part(out, packed, rows)
    return packed


def read_member(record: ImageRecord, source: Source, check: Check) -> Member:
    """An image's bytes, never re-encoded, and the metadata beside them.

    Raises DecodeError when they are no image or cannot be read, twice in a row: a storage that
    fails for a moment costs no image.
    """
    try:
        data, (width, height) = _read_checked(record, source, check)
    except DecodeError:
        data, (width, height) = _read_checked(record, source, check)
    metadata: dict[str, Any] = {
        "key": record.key,
        "location": record.location,
        "view": record.view,
        "split": record.split,
        "variant": record.variant,
        "geotag": None if record.geotag is None else record.geotag.as_json(),
        "taken_at": record.taken_at,
        "source": name_of(source),
        "sha256": sha256_of(data),
        "width": width,
        "height": height,
    }
    if record.level:
        metadata["level"] = record.level
    return Member(name=f"{record.key}.{source.ending(record)}", data=data, metadata=metadata)


def _read_checked(
    record: ImageRecord, source: Source, check: Check
) -> tuple[bytes, tuple[int, int]]:
    """An image's bytes, with its width and height."""
    try:
        data = source.read(record)
    except OSError as error:
        raise DecodeError(UNREADABLE, str(error)) from None
    size = inspect(data)
    if check == "full":
        decode(data)
    return data, size


def open_tar(stream: HashingStream) -> tarfile.TarFile:
    """A tar to be written into a stream."""
    return tarfile.open(fileobj=cast(IO[bytes], stream), mode="w", format=tarfile.USTAR_FORMAT)


def add_file(tar: tarfile.TarFile, name: str, data: bytes) -> None:
    """Add a file with a fixed time, owner and mode, so that the same files give the same tar.

    `name`: at most 100 ASCII characters; `data`: below 8 GiB. A longer one raises ValueError.
    """
    header = tarfile.TarInfo(name)
    header.size = len(data)
    header.uname = header.gname = "root"
    tar.addfile(header, io.BytesIO(data))
