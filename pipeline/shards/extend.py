"""What of a source's imagery is new to a finished set of shards, and where the new tars' numbers
begin.

In: a manifest, its record table, records as found. Out: the records that are new, refusals, how
many were known.
"""

import hashlib
from collections.abc import Iterable

from pipeline.core import storage
from pipeline.core.records import ImageRecord, Rejection, Split, View
from pipeline.shards.manifest import Manifest
from pipeline.shards.record_table import read_part
from pipeline.sources.base import Source


def next_numbers(before: Manifest) -> dict[tuple[Split, View], int]:
    """Number of the first new tar of each split and view that the set has tars of."""
    after: dict[tuple[Split, View], int] = {}
    for shard in before.shards:
        number = int(shard.name.rsplit("-", 1)[1])
        after[shard.split, shard.view] = max(number + 1, after.get((shard.split, shard.view), 0))
    return after


def new_records(
    records: Iterable[ImageRecord], source: Source, shards: str, before: Manifest
) -> tuple[list[ImageRecord], list[Rejection], int]:
    """Records that the set does not hold; those whose key another image has; how many it holds
    already.

    The same file of the same size is known by its name alone. Only where another file has a known
    key are bytes compared.
    """
    columns = ["key", "path", "part", "bytes", "sha256"]
    held = {
        row["key"]: row
        for shard in before.shards
        for row in read_part(shards, shard.name, columns).to_pylist()
    }
    new, refused, known = [], [], 0
    for record in records:
        there = held.get(record.key)
        if there is None:
            new.append(record)
        elif (
            _is_same_file(record, there)
            or hashlib.sha256(source.read(record)).hexdigest() == there["sha256"]
        ):
            known += 1
        else:
            found = f"{there['path']}, in {storage.absolute(shards)}, has its key"
            refused.append(Rejection(path=record.name, reason="same name twice", found=found))
    return new, refused, known


def _is_same_file(record: ImageRecord, there: dict[str, str | int]) -> bool:
    same_path = (record.path, record.part) == (there["path"], there["part"])
    return same_path and record.bytes in (None, there["bytes"])
