"""Images that a set holds already, and images that come twice: the same bytes, in one split, view
and level, of one location or at one position.

In: records and record tables. Out: the new records when extending, and the images to leave out. A
blank tile of the sea may come many times, each at its own position, and University-1652's queries
are in its gallery too: these are not duplicates.
"""

from collections import defaultdict
from collections.abc import Iterable
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

from pipeline.core import storage
from pipeline.core.integrity import sha256_of
from pipeline.core.records import ImageRecord, Rejection
from pipeline.shards.shard_set import ShardSet
from pipeline.sources.base import Source

COLUMNS = [
    "key", "shard", "split", "view", "level", "location", "lat", "lon", "path", "part", "sha256",
]  # fmt: skip


def find_duplicates(
    parts: Iterable[pa.Table], settled: frozenset[str]
) -> dict[str, dict[str, str]]:
    """By shard: the keys to leave out, each with the path of the image that stays.

    The first by path stays; those of the shards that are `settled` stay before all others.
    """
    table = pa.concat_tables(parts)
    counted = table["sha256"].value_counts()
    repeated = counted.filter(pc.greater(counted.field("counts"), 1)).field("values")
    rows = table.filter(pc.is_in(table["sha256"], repeated)).to_pylist()
    first: dict[tuple[Any, ...], str] = {}
    left_out: dict[str, dict[str, str]] = defaultdict(dict)
    for row in sorted(
        rows, key=lambda row: (row["shard"] not in settled, row["path"], row["part"])
    ):
        bytes_in = row["split"], row["view"], row["level"], row["sha256"]
        same: list[tuple[Any, ...]] = [(*bytes_in, row["location"])]
        if row["lat"] is not None:
            same.append((*bytes_in, row["lat"], row["lon"]))
        earlier = next((first[key] for key in same if key in first), None)
        if earlier is None:
            first |= dict.fromkeys(same, row["path"])
        elif row["shard"] not in settled:
            left_out[row["shard"]][row["key"]] = earlier
    return dict(left_out)


def new_records(
    records: Iterable[ImageRecord], source: Source, shards: ShardSet
) -> tuple[list[ImageRecord], list[Rejection], int]:
    """Records that the set does not hold, refusals of those whose key another image has, and the
    number of records that it holds already.

    A file with the path and size of a packed one is taken for the same. Only where another file has
    a known key are bytes compared.
    """
    columns = ["key", "path", "part", "bytes", "sha256"]
    packed = {
        row["key"]: row
        for shard in shards.manifest.shards
        for row in shards.records(shard, columns).to_pylist()
    }
    new, refused, known = [], [], 0
    for record in records:
        earlier = packed.get(record.key)
        if earlier is None:
            new.append(record)
        elif _is_same_file(record, earlier) or sha256_of(source.read(record)) == earlier["sha256"]:
            known += 1
        else:
            found = f"{earlier['path']}, in {storage.absolute(shards.path)}, has its key"
            refused.append(Rejection(path=record.name, reason="same name twice", found=found))
    return new, refused, known


def _is_same_file(record: ImageRecord, earlier: dict[str, str | int]) -> bool:
    same_path = (record.path, record.part) == (earlier["path"], earlier["part"])
    return same_path and record.bytes in (None, earlier["bytes"])
