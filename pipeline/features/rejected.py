"""The list of the images and shards that have no row in a feature table, for people to query.

In: rejected images with reasons. Out: a Parquet file beside the table's folder. The same entries
are in the footers of the parts, by which embedding writes the list anew.
"""

from collections.abc import Iterable

import pyarrow as pa

from pipeline.core import parquet as parquet_files
from pipeline.core import rejections, storage
from pipeline.core.errors import InputError

REJECTED_ENDING = ".rejected.parquet"
"""Behind the table's path: beside the folder, since some readers (Polars) take every file within it
for a part."""
OLD_REJECTED_NAME = f"_rejected/{rejections.REJECTED_FILE}"
"Within the table, where tables had the list at first; writing the list removes it."
REJECTED_SCHEMA = pa.schema([(name, pa.string()) for name in ("shard", "key", "reason", "found")])


def rejected_file(table: str) -> str:
    """The path of a table's list."""
    return storage.beside(table, REJECTED_ENDING)


def write_rejected(table: str, rejected: Iterable[tuple[str, str | None, str, str]]) -> bool:
    """Write the list of what has no row, as (shard, key, reason, found), in that order.

    The key is None where a whole shard is missing. The file exists only while the list has entries
    and is not written again when it is the same. Returns whether it changed.
    """
    rows = sorted(rejected, key=lambda row: (row[0], row[1] or ""))
    path, old = rejected_file(table), storage.join(table, OLD_REJECTED_NAME)
    if storage.exists(old):
        storage.remove_folder(old.rpartition("/")[0])
    entries = [dict(zip(REJECTED_SCHEMA.names, row, strict=True)) for row in rows]
    wanted = pa.Table.from_pylist(entries, REJECTED_SCHEMA)
    exists = storage.exists(path)
    if not rows:
        if exists:
            storage.remove(path)
        return exists
    try:
        if exists and read_rejected(table).equals(wanted):
            return False
    except InputError:  # a damaged list is written again
        pass
    parquet_files.write_table(path, wanted)
    return True


def read_rejected(table: str) -> pa.Table:
    """The list as a table of `shard, key, reason, found`; without rows where the file is absent.

    Raises InputError when it cannot be read.
    """
    path = rejected_file(table)
    if not storage.exists(path):
        return REJECTED_SCHEMA.empty_table()
    try:
        return parquet_files.read_table(path)
    except parquet_files.DAMAGE_ERRORS as error:
        raise InputError(
            f"{path} cannot be read ({error}), expected the list that embedding writes; run "
            "jobs/embed_gallery.py again as it was run before, which writes it from the parts"
        ) from None
