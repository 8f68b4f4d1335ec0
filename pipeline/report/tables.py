"""Tables of R@1 with whiskers for its interval: metrics by group and by part of the embedding in,
titled rows out. The page and the papers' figures draw the same tables."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from pipeline.report.charts import nice_ticks
from pipeline.retrieval.parts import part_label


@dataclass(frozen=True, kw_only=True)
class TableRow:
    """One group; all measures are fractions."""

    label: str
    queries: int
    r1: float
    low: float
    "Ends of R@1's 95 % interval."
    high: float
    ap: float


@dataclass(frozen=True, kw_only=True)
class WhiskerTable:
    title: str
    column: str
    "What the labels are: a column of the shards' records, or `part`."
    rows: tuple[TableRow, ...]
    overall: float
    "R@1 of the task over all groups, a hairline in every row."

    @property
    def heading(self) -> str:
        return self.column.replace("_", " ")

    @property
    def span(self) -> tuple[float, float]:
        """Round percentages that enclose the whiskers of all rows."""
        ends = [100 * value for row in self.rows for value in (row.low, row.high)]
        ticks = nice_ticks(min(*ends, 100 * self.overall), max(*ends, 100 * self.overall))
        return ticks[0], ticks[-1]

    def at(self, value: float) -> float:
        """Position of a fraction along the span, in percent."""
        low, high = self.span
        return 100 * (100 * value - low) / (high - low)


def group_tables(
    groups: Sequence[Mapping[str, Any]], names: Mapping[str, str], r1: Mapping[str, float]
) -> list[WhiskerTable]:
    """One table for each task and column of groups.json. `names`, `r1`: each task's name on the
    page, and its R@1.
    """
    found: dict[tuple[str, str], list[TableRow]] = {}
    for row in groups:
        found.setdefault((row["task"], row["by"]), []).append(_table_row(str(row["value"]), row))
    return [
        WhiskerTable(title=names[task], column=column, rows=tuple(rows), overall=r1[task])
        for (task, column), rows in found.items()
        if len(rows) > 1  # one group is the whole task
    ]


def part_tables(
    parts: Sequence[Mapping[str, Any]], names: Mapping[str, str], r1: Mapping[str, float]
) -> list[WhiskerTable]:
    """One table for each task of parts.json."""
    found: dict[str, list[TableRow]] = {}
    for row in parts:
        found.setdefault(row["task"], []).append(_table_row(part_label(row), row))
    return [
        WhiskerTable(title=names[task], column="part", rows=tuple(rows), overall=r1[task])
        for task, rows in found.items()
    ]


def _table_row(label: str, row: Mapping[str, Any]) -> TableRow:
    return TableRow(
        label=label,
        queries=row["queries"],
        r1=row["r1"],
        low=row["r1_low"],
        high=row["r1_high"],
        ap=row["ap"],
    )
