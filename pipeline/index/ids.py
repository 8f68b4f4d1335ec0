"""Whose vector a row of an index is: key, location, view, position, and where in the feature table
it stands.

Out: `ids.parquet`, for whoever reads the index, and the same as an Arrow file, which searching maps
into memory: only what is looked at is read, and none of it counts against a memory budget. Shapes:
N rows of a part of the index, R rows asked for.
"""

import shutil
from collections.abc import Iterable

import numpy as np
import pyarrow as pa

from pipeline.core import parquet as parquet_files
from pipeline.core import storage
from pipeline.core.arrays import Ints, Mask
from pipeline.core.errors import InputError
from pipeline.index.filters import Filter
from pipeline.index.metadata import REBUILD_HINT

ID_COLUMNS = ("key", "location", "view", "lat", "lon")
IDS_SCHEMA = pa.schema(
    [
        ("row", pa.int64()),
        ("key", pa.string()),
        ("location", pa.string()),
        ("view", pa.string()),
        ("lat", pa.float64()),
        ("lon", pa.float64()),
        # number of the feature table's part among those that this part of the index holds
        ("table_part", pa.int32()),
        ("part_row", pa.int32()),  # number of the row within it
    ]
)
BATCH_ROWS = 65_536


def write_ids(
    parquet: str, arrow: str, first_row: int, parts: Iterable[tuple[int, pa.Table]]
) -> None:
    """Write both files from the table's parts, each with its number and FeatureTable.numbered's
    columns COLUMNS.
    """
    with (
        parquet_files.writer(parquet, IDS_SCHEMA) as columns,
        storage.atomic_write(arrow) as other,
        pa.ipc.new_file(other, IDS_SCHEMA) as mapped,
    ):
        for batch in _batches(first_row, parts):
            columns.write_table(batch)
            mapped.write_table(batch, BATCH_ROWS)


def _batches(first_row: int, parts: Iterable[tuple[int, pa.Table]]) -> Iterable[pa.Table]:
    """The rows as tables of at least BATCH_ROWS: parts may be small, and batches cost the same
    whatever their size.
    """
    waiting: list[pa.Table] = []
    for number, rows in parts:
        row = pa.array(np.arange(first_row, first_row + len(rows)))
        columns = {
            "row": row,
            "table_part": pa.array(np.full(len(rows), number, np.int32)),
            "part_row": rows["part_row"],
        }
        columns |= {name: rows[name].cast(IDS_SCHEMA.field(name).type) for name in ID_COLUMNS}
        waiting.append(pa.table([columns[name] for name in IDS_SCHEMA.names], schema=IDS_SCHEMA))
        first_row += len(rows)
        if sum(map(len, waiting)) >= BATCH_ROWS:
            yield pa.concat_tables(waiting).combine_chunks()
            waiting = []
    if waiting:
        yield pa.concat_tables(waiting).combine_chunks()


class RowIds:
    """The rows of one part of an index, mapped from its Arrow file."""

    def __init__(self, path: str) -> None:
        """`path` is on a local disk. Raises InputError where it is no such file."""
        try:
            with pa.memory_map(path) as source:
                reader = pa.ipc.open_file(source)
                self._batches = [reader.get_batch(i) for i in range(reader.num_record_batches)]
        except (pa.ArrowException, OSError) as error:
            raise InputError(f"{path} is damaged ({error}); {REBUILD_HINT}") from None
        self._begin = np.cumsum([0, *(len(batch) for batch in self._batches)])

    def __len__(self) -> int:
        return int(self._begin[-1])

    def take(self, row_R: Ints, columns: Iterable[str] = ID_COLUMNS) -> pa.Table:
        """Columns of these rows, counted within the part, in the order asked for."""
        order_R = np.argsort(row_R, kind="stable")
        sorted_R = row_R[order_R]
        bounds = np.searchsorted(sorted_R, self._begin)
        names = list(columns)
        pieces = [
            batch.select(names).take(pa.array(sorted_R[first:last] - begin))
            for batch, begin, first, last in zip(
                self._batches, self._begin, bounds, bounds[1:], strict=False
            )
            if last > first
        ]
        whole = pa.Table.from_batches(pieces, pa.schema([IDS_SCHEMA.field(name) for name in names]))
        back_R = np.empty(len(row_R), np.int64)
        back_R[order_R] = np.arange(len(row_R))
        return whole.take(pa.array(back_R))

    def mask(self, where: Filter) -> Mask:
        """Which rows meet the conditions (N,)."""
        return np.concatenate(
            [np.empty(0, np.bool_), *(where.mask(batch) for batch in self._batches)]
        )


def local_copy(path: str, folder: str) -> str:
    """A path of this machine's at which the file can be mapped: its own, or a copy's in `folder`."""
    if storage.is_local(path):
        return str(storage.resolve(path)[1])
    target = storage.join(folder, path.rsplit("/", 1)[-1])
    with storage.open_read(path) as source, open(target, "wb") as copy:
        shutil.copyfileobj(source, copy, 1 << 24)
    return target
