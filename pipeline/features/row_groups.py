"""Row groups of a part that a filter cannot match, found by Parquet's statistics and skipped.

In: a filter and an open part. Out: the numbers of the row groups that may hold a matching row.
"""

from functools import partial
from typing import Any

import pyarrow.parquet as pq

from pipeline.core.filters import Filter


def matching_row_groups(parquet: pq.ParquetFile, filters: tuple[Filter, ...]) -> list[int]:
    """The row groups to read for the rows that all filters match. Most parts hold one split and one
    view only, so most row groups are skipped or read whole.
    """
    return [
        group
        for group in range(parquet.num_row_groups)
        if all(one.may_match(partial(_bounds, parquet, group)) for one in filters)
    ]


def _bounds(parquet: pq.ParquetFile, group: int, name: str) -> tuple[Any, Any] | None:
    """Least and greatest value of a column in a row group; None where it has no statistics."""
    # These columns stand before the embedding, so Arrow's number of a column is Parquet's too.
    column = parquet.schema_arrow.get_field_index(name)
    statistics = parquet.metadata.row_group(group).column(column).statistics
    if statistics is None or not statistics.has_min_max:
        return None
    return statistics.min, statistics.max
