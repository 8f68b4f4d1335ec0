"""Images that are there twice: the same bytes, in one split and view, of one location or of one
place.

In: the record table of packed tars. Out: which images to leave out. A blank tile of the sea may be
there many times, each at its own place; University-1652's queries are in its gallery too: these are
not duplicates.
"""

from collections import defaultdict
from collections.abc import Iterable
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

COLUMNS = ["key", "shard", "split", "view", "location", "lat", "lon", "path", "part", "sha256"]


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
        bytes_in = row["split"], row["view"], row["sha256"]
        same: list[tuple[Any, ...]] = [(*bytes_in, row["location"])]
        if row["lat"] is not None:
            same.append((*bytes_in, row["lat"], row["lon"]))
        earlier = next((first[key] for key in same if key in first), None)
        if earlier is None:
            first |= dict.fromkeys(same, row["path"])
        elif row["shard"] not in settled:
            left_out[row["shard"]][row["key"]] = earlier
    return dict(left_out)
