"""Which rows of a feature table are meant: of a split, a view, some locations, a rectangle on the
map.

In: conditions. Out: per block of rows which are meant, and per row group of a part whether it can
hold any.
"""

from bisect import bisect_left
from dataclasses import dataclass
from functools import reduce
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from pipeline.core.geo import Box
from pipeline.core.records import Split, View


@dataclass(frozen=True, kw_only=True)
class Selection:
    """Conditions that a row meets all of. None: any will do."""

    split: Split | None = None
    view: View | None = None
    locations: frozenset[str] | None = None
    box: Box | None = None
    "Rows without a position are in no box."

    @property
    def columns(self) -> set[str]:
        """The columns that have to be read to tell."""
        named = {"split": self.split, "view": self.view, "location": self.locations}
        return {name for name, value in named.items() if value is not None} | (
            {"lat", "lon"} if self.box else set()
        )

    def mask(self, rows: pa.Table) -> Any:
        """Per row whether it is meant, as an Arrow array of booleans; null means no."""
        found: list[Any] = [
            pc.equal(rows[name].cast(pa.string()), str(value))
            for name, value in (("split", self.split), ("view", self.view))
            if value is not None
        ]
        if self.locations is not None:
            found.append(pc.is_in(rows["location"], pa.array(sorted(self.locations), pa.string())))
        if self.box:
            found.append(_between(rows["lat"], self.box.south, self.box.north))
            found.append(
                reduce(pc.or_, [_between(rows["lon"], *span) for span in self.box.spans()])
            )
        return reduce(pc.and_, found)

    def may_hold(self, parquet: pq.ParquetFile, group: int) -> bool:
        """Whether a row group's statistics leave room for such rows: most parts hold one split and
        one view only.
        """
        ranges: dict[str, list[tuple[Any, Any]]] = {}
        for name, value in (("split", self.split), ("view", self.view)):
            if value is not None:
                ranges[name] = [(str(value), str(value))]
        if self.box:
            ranges |= {"lat": [(self.box.south, self.box.north)], "lon": self.box.spans()}
        for name, wanted in ranges.items():
            bounds = _bounds(parquet, group, name)
            if bounds and not any(bounds[0] <= high and low <= bounds[1] for low, high in wanted):
                return False
        bounds = _bounds(parquet, group, "location") if self.locations is not None else None
        if not bounds:
            return True
        names = sorted(self.locations or ())
        first = bisect_left(names, bounds[0])
        return first < len(names) and names[first] <= bounds[1]


def _between(column: Any, low: float, high: float) -> Any:
    return pc.and_(pc.greater_equal(column, low), pc.less_equal(column, high))


def _bounds(parquet: pq.ParquetFile, group: int, name: str) -> tuple[Any, Any] | None:
    """Least and greatest value of a column in a row group; None where the part does not say."""
    column = parquet.schema_arrow.get_field_index(
        name
    )  # they stand before the embedding, so it is Parquet's number too
    said = parquet.metadata.row_group(group).column(column).statistics
    return (said.min, said.max) if said is not None and said.has_min_max else None
