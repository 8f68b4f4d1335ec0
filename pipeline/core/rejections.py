"""The table of rejected images: one row per image with its path, a countable reason, and what was
found.

In: rejections. Out: `rejected.parquet`.
"""

from collections import Counter
from collections.abc import Iterable

import pyarrow as pa

from pipeline.core import parquet, storage
from pipeline.core.errors import InputError
from pipeline.core.records import Rejection

REJECTED_FILE = "rejected.parquet"
REJECTED_SCHEMA = pa.schema(
    [("path", pa.string()), ("reason", pa.string()), ("found", pa.string())]
)


def write_rejections(folder: str, rejected: Iterable[Rejection], keep: bool) -> int:
    """Write the table, sorted by path, and return its length; `keep`: add to the rows already
    there.

    Raises InputError if those cannot be read.
    """
    path = storage.join(folder, REJECTED_FILE)
    rows = {(rejection.path, rejection.reason, rejection.found) for rejection in rejected}
    if keep and storage.exists(path):
        rows.update(zip(*_read_rejections(path).to_pydict().values(), strict=True))
    named = [dict(zip(REJECTED_SCHEMA.names, row, strict=True)) for row in sorted(rows)]
    table = pa.Table.from_pylist(named, REJECTED_SCHEMA)
    parquet.write_table(path, table)
    return len(table)


def rejections_intact(folder: str, count: int) -> bool:
    """Whether the table exists, holds every byte as it was written, and has so many rows."""
    path = storage.join(folder, REJECTED_FILE)
    return parquet.parquet_intact(path) and len(_read_rejections(path)) == count


def rejected_paths(folder: str) -> frozenset[str]:
    """Paths of the rejected images; none if there is no table.

    Raises InputError if it cannot be read.
    """
    path = storage.join(folder, REJECTED_FILE)
    if not storage.exists(path):
        return frozenset()
    return frozenset(_read_rejections(path)["path"].to_pylist())


def most_common_reasons(rejected: Iterable[Rejection]) -> str:
    """The three most common reasons with their counts."""
    counts = Counter(rejection.reason for rejection in rejected).most_common(3)
    return ", ".join(f"{reason} ({count})" for reason, count in counts)


def _read_rejections(path: str) -> pa.Table:
    try:
        return parquet.read_table(path)
    except parquet.DAMAGE_ERRORS as error:
        raise InputError(
            f"{path} cannot be read ({error}), expected the table of rejected images; delete it "
            "and run the same command again: it lists images that are rejected from now on"
        ) from None
