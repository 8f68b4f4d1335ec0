"""Row groups of a part that a filter cannot match, found by Parquet's statistics and skipped.

In: a filter and an open part. Out: the numbers of the row groups that may hold a matching row.
"""

from bisect import bisect_left
from typing import Any

import pyarrow.parquet as pq

from pipeline.core.filters import Filter, latitude_band


def matching_row_groups(parquet: pq.ParquetFile, filters: tuple[Filter, ...]) -> list[int]:
    """The row groups to read for the rows that all filters match."""
    groups = range(parquet.num_row_groups)
    return [group for group in groups if all(may_match(one, parquet, group) for one in filters)]


def may_match(row_filter: Filter, parquet: pq.ParquetFile, group: int) -> bool:
    """Whether a row group's statistics leave room for a row that matches.

    Most parts hold one split and one view only, so most row groups are skipped or read whole.
    """
    for name, wanted in _ranges(row_filter).items():
        bounds = _bounds(parquet, group, name)
        if bounds and not any(bounds[0] <= high and low <= bounds[1] for low, high in wanted):
            return False
    if row_filter.locations is None or not (bounds := _bounds(parquet, group, "location")):
        return True
    names = sorted(row_filter.locations)
    first = bisect_left(names, bounds[0])
    return first < len(names) and names[first] <= bounds[1]


def _ranges(row_filter: Filter) -> dict[str, list[tuple[Any, Any]]]:
    """For each column with a condition the ranges of values that can meet it."""
    ranges: dict[str, list[tuple[Any, Any]]] = {}
    for name, value in (("split", row_filter.split), ("view", row_filter.view)):
        if value is not None:
            ranges[name] = [(str(value), str(value))]
    if row_filter.near:
        ranges["lat"] = [latitude_band(row_filter.near)]
    if row_filter.box:
        ranges["lat"] = [(row_filter.box.south, row_filter.box.north)]
        ranges["lon"] = row_filter.box.spans()
    return ranges


def _bounds(parquet: pq.ParquetFile, group: int, name: str) -> tuple[Any, Any] | None:
    """Least and greatest value of a column in a row group; None where it has no statistics."""
    # These columns stand before the embedding, so Arrow's number of a column is Parquet's too.
    column = parquet.schema_arrow.get_field_index(name)
    statistics = parquet.metadata.row_group(group).column(column).statistics
    if statistics is None or not statistics.has_min_max:
        return None
    return statistics.min, statistics.max
