"""The ids of an index's rows: key, location, view, position, and the row in the feature table.

In: the rows of a table's parts. Out: `ids.parquet`, for people, and the same as an Arrow file,
which searching maps into memory: only the requested rows are read, and none of it counts against
the memory budget.
Shapes: N rows of a part of the index, R requested rows.
"""

from collections.abc import Iterable
from functools import partial
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from pipeline.core import parquet as parquet_files
from pipeline.core import storage
from pipeline.core.arrays import Ints, Mask
from pipeline.core.errors import InputError
from pipeline.core.filters import Filter
from pipeline.index.metadata import REBUILD_HINT

ID_COLUMNS = ("key", "location", "view", "lat", "lon", "side_m")
IDS_SCHEMA = pa.schema(
    [
        ("row", pa.int64()),
        ("key", pa.string()),
        ("location", pa.string()),
        ("view", pa.string()),
        ("lat", pa.float64()),
        ("lon", pa.float64()),
        # Number of the feature table's part among those that this part of the index holds.
        ("table_part", pa.int32()),
        ("part_row", pa.int32()),  # number of the row within that part
        ("side_m", pa.float64()),  # of the ground shown; not in indexes of before there were levels
    ]
)
BATCH_ROWS = 65_536


def write_ids(
    parquet: str, arrow: str, first_row: int, parts: Iterable[tuple[int, pa.Table]]
) -> None:
    """Write both files. `parts`: the table's parts, each with its number and the ID_COLUMNS of
    `FeatureTable.numbered_rows`.
    """
    with (
        parquet_files.writer(parquet, IDS_SCHEMA) as parquet_writer,
        storage.atomic_write(arrow) as stream,
        pa.ipc.new_file(stream, IDS_SCHEMA) as arrow_writer,
    ):
        for batch in _batches(first_row, parts):
            parquet_writer.write_table(batch)
            arrow_writer.write_table(batch, BATCH_ROWS)


def _batches(first_row: int, parts: Iterable[tuple[int, pa.Table]]) -> Iterable[pa.Table]:
    """The rows as tables of at least BATCH_ROWS: parts may be small, and every batch costs a
    search the same, whatever its size.
    """
    pending: list[pa.Table] = []
    for number, rows in parts:
        row = pa.array(np.arange(first_row, first_row + len(rows)))
        columns = {
            "row": row,
            "table_part": pa.array(np.full(len(rows), number, np.int32)),
            "part_row": rows["part_row"],
        }
        columns |= {name: rows[name].cast(IDS_SCHEMA.field(name).type) for name in ID_COLUMNS}
        pending.append(pa.table([columns[name] for name in IDS_SCHEMA.names], schema=IDS_SCHEMA))
        first_row += len(rows)
        if sum(map(len, pending)) >= BATCH_ROWS:
            yield pa.concat_tables(pending).combine_chunks()
            pending = []
    if pending:
        yield pa.concat_tables(pending).combine_chunks()


class RowIds:
    """The rows of one part of an index, mapped from its Arrow file."""

    def __init__(self, path: str) -> None:
        """`path` is on a local disk. Raises InputError where the file is damaged."""
        try:
            with pa.memory_map(path) as source:
                reader = pa.ipc.open_file(source)
                self._names = reader.schema.names
                self._batches = [reader.get_batch(i) for i in range(reader.num_record_batches)]
        except (pa.ArrowException, OSError) as error:
            raise InputError(f"{path} is damaged ({error}); {REBUILD_HINT}") from None
        self._begin = np.cumsum([0, *(len(batch) for batch in self._batches)])
        self._bounds: dict[tuple[int, str], tuple[Any, Any] | None] = {}

    def __len__(self) -> int:
        return int(self._begin[-1])

    def take(self, row_R: Ints, columns: Iterable[str] = ID_COLUMNS) -> pa.Table:
        """Columns of these rows, counted within the part, in the order of `row_R`."""
        order_R = np.argsort(row_R, kind="stable")
        sorted_R = row_R[order_R]
        bounds = np.searchsorted(sorted_R, self._begin)
        names = list(columns)
        there = [name for name in names if name in self._names]
        pieces = [
            batch.select(there).take(pa.array(sorted_R[first:last] - begin))
            for batch, begin, first, last in zip(
                self._batches, self._begin, bounds, bounds[1:], strict=False
            )
            if last > first
        ]
        schema = pa.schema([IDS_SCHEMA.field(name) for name in there])
        back_R = np.empty(len(row_R), np.int64)
        back_R[order_R] = np.arange(len(row_R))
        taken = pa.Table.from_batches(pieces, schema).take(pa.array(back_R))
        return parquet_files.select_or_null(taken, names, IDS_SCHEMA)

    def mask(self, where: Filter) -> Mask:
        """Which rows match the filter (N,). Batches that it surely leaves out are not looked at."""
        mask_N = np.zeros(len(self), np.bool_)
        for number, batch in enumerate(self._batches):
            if where.may_match(partial(self._bounds_of, number)):
                begin = self._begin[number]
                mask_N[begin : begin + len(batch)] = where.mask(batch)
        return mask_N

    def _bounds_of(self, number: int, column: str) -> tuple[Any, Any] | None:
        """Least and greatest value of a column in a batch, found once; None without a value."""
        if (number, column) not in self._bounds:
            ends = pc.min_max(self._batches[number][column]).as_py()
            known = ends["min"] is not None
            self._bounds[number, column] = (ends["min"], ends["max"]) if known else None
        return self._bounds[number, column]
