"""Tables of R@1 with whiskers: measures by group and by part of the embedding in, titled rows out."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from pipeline.report.svg import nice_ticks
from pipeline.retrieval.parts import part_label


@dataclass(frozen=True, kw_only=True)
class TableRow:
    """One group: figures as fractions."""

    label: str
    queries: int
    r1: float
    low: float
    "Of R@1's 95 % interval."
    high: float
    ap: float


@dataclass(frozen=True, kw_only=True)
class WhiskerTable:
    title: str
    heading: str
    "Of the labels."
    lines: tuple[TableRow, ...]
    overall: float
    "R@1 of the whole task, a hairline in every row."

    @property
    def span(self) -> tuple[float, float]:
        """Round percentages between which the whiskers of all rows lie."""
        ends = [100 * value for line in self.lines for value in (line.low, line.high)]
        ticks = nice_ticks(min(*ends, 100 * self.overall), max(*ends, 100 * self.overall))
        return ticks[0], ticks[-1]

    def at(self, value: float) -> float:
        """Where a fraction lies between the two, in percent."""
        low, high = self.span
        return 100 * (100 * value - low) / (high - low)


def group_tables(
    groups: Sequence[Mapping[str, Any]], names: Mapping[str, str], r1: Mapping[str, float]
) -> list[WhiskerTable]:
    """One table for each task and column of groups.json. `names`, `r1`: of each task, as the page
    calls it, and its R@1.
    """
    found: dict[tuple[str, str], list[TableRow]] = {}
    for row in groups:
        found.setdefault((row["task"], row["by"]), []).append(_line(str(row["value"]), row))
    return [
        WhiskerTable(
            title=names[task], heading=by.replace("_", " "), lines=tuple(lines), overall=r1[task]
        )
        for (task, by), lines in found.items()
        if len(lines) > 1  # one group is the whole task
    ]


def part_tables(
    parts: Sequence[Mapping[str, Any]], names: Mapping[str, str], r1: Mapping[str, float]
) -> list[WhiskerTable]:
    """One table for each task of parts.json."""
    found: dict[str, list[TableRow]] = {}
    for row in parts:
        found.setdefault(row["task"], []).append(_line(part_label(row), row))
    return [
        WhiskerTable(title=names[task], heading="part", lines=tuple(lines), overall=r1[task])
        for task, lines in found.items()
    ]


def _line(label: str, row: Mapping[str, Any]) -> TableRow:
    return TableRow(
        label=label,
        queries=row["queries"],
        r1=row["r1"],
        low=row["r1_low"],
        high=row["r1_high"],
        ap=row["ap"],
    )
