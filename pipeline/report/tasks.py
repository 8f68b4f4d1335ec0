"""A task as the page shows it: a metric row and its queries in, a line of the table and the recall
curve out.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.core.arrays import Ints
from pipeline.report.inputs import ReportContext
from pipeline.report.panels import (
    MOSAIC_IMAGES,
    confidence_order,
    error_order,
    is_hit,
    panel_keys,
    spread_over_locations,
)
from pipeline.report.svg import Chart, recall_chart
from pipeline.retrieval import metrics
from pipeline.retrieval.subsets import evenly_spaced

METRIC_LABELS = {"r1": "R@1", "r5": "R@5", "r10": "R@10", "r1p": "R@1%", "ap": "AP"}


@dataclass(frozen=True, kw_only=True)
class TaskView:
    """One task."""

    row: Mapping[str, Any]
    "Of retrieval.METRICS_SCHEMA."
    rows: list[dict[str, Any]]
    "Its queries, rows of retrieval.RESULTS_SCHEMA."
    name: str
    anchor: str
    query_view: str
    gallery_view: str
    other: Mapping[str, Any] | None
    "The metric row of the evaluation beside."
    first: int
    "Queries that have a true match first."
    unmatched: int
    "Queries without a true match in the gallery."
    chance: float
    one_percent: int
    sure: Mapping[str, tuple[float, float]]
    "95 % interval of each measure that has one."
    geo: Mapping[str, Any] | None
    "The metric row, where it knows distances."
    chart: Chart


def task_view(
    row: Mapping[str, Any], rows: list[dict[str, Any]], extras: ReportContext
) -> TaskView:
    """Raises InputError when the evaluation beside ranked other images."""
    query_view, gallery_view = row["task"].split("->")
    other = extras.beside.of(dict(row)) if extras.beside else None
    matches_Q = np.array([each["matches"] for each in rows], np.int64)
    name = f"{query_view} → {gallery_view}" + (", multi-query" if row["multi_query"] else "")
    bounds = {
        measure: (row.get(f"{measure}_low"), row.get(f"{measure}_high"))
        for measure in METRIC_LABELS
    }
    return TaskView(
        row=row,
        rows=rows,
        name=name,
        anchor=name.replace(" → ", "-").replace(", ", "-"),
        query_view=query_view,
        gallery_view=gallery_view,
        other=other,
        first=sum(map(is_hit, rows)),
        unmatched=int(np.count_nonzero(matches_Q == 0)),
        chance=metrics.chance_recall(matches_Q, row["gallery"]),
        one_percent=metrics.one_percent_k(row["gallery"]),
        sure={
            measure: (low, high)
            for measure, (low, high) in bounds.items()
            if low is not None and high is not None
        },
        geo=row if row.get("geo_queries") else None,
        chart=_recall_chart(name, row, rows, extras if other else None),
    )


def _recall_chart(
    name: str, row: Mapping[str, Any], rows: list[dict[str, Any]], extras: ReportContext | None
) -> Chart:
    beside = extras.beside if extras else None
    beside_Q = first_ranks(beside.results_of(dict(row))) if beside else None
    note = f"{row['queries']:,} queries, {row['gallery']:,} in the gallery"
    return recall_chart(
        name, note, first_ranks(rows), row["gallery"], beside_Q, beside.name if beside else ""
    )


def first_ranks(rows: list[dict[str, Any]]) -> Ints:
    """Rank of each query's best true match (Q,); 0 where it has none."""
    return np.array([row["first_match_rank"] or 0 for row in rows], np.int64)


Row = Mapping[str, Any]


@dataclass(frozen=True, kw_only=True)
class QueryPair:
    """A place asked for by one image and by all."""

    single: Row
    "Of the place's images the one whose true match ranks worst."
    merged: Row
    images: tuple[str, ...]
    "Keys of up to nine of its images, evenly chosen."


@dataclass(frozen=True, kw_only=True)
class QueryPairs:
    shown: tuple[QueryPair, ...]
    places: int
    "With at least one image that misses."
    mended: int
    "Of these, found first by all images together."
    lost: int
    "Places that every image alone finds first, and all together do not."


@dataclass(frozen=True, kw_only=True)
class PanelChoice:
    """Of one task."""

    task: TaskView
    hits: list[Row]
    "From the surest to the least sure."
    misses: list[Row]
    "From the farthest off to the nearly right."
    pairs: QueryPairs

    @property
    def keys(self) -> set[str]:
        """Of all images that its panels show."""
        rows = [
            *self.hits,
            *self.misses,
            *(row for pair in self.pairs.shown for row in (pair.single, pair.merged)),
        ]
        return panel_keys(rows) | {key for pair in self.pairs.shown for key in pair.images}


def choose_panels(tasks: Sequence[TaskView], count: int) -> list[PanelChoice]:
    """At most `count` hits, misses and pairs of each task of single queries."""
    single = [task for task in tasks if not task.row["multi_query"]]
    merged = {task.row["task"]: task.rows for task in tasks if task.row["multi_query"]}
    return [
        PanelChoice(
            task=task,
            hits=spread_over_locations(
                [row for row in task.rows if is_hit(row)], count, confidence_order
            ),
            misses=spread_over_locations(
                [row for row in task.rows if not is_hit(row)], count, error_order
            ),
            pairs=pair_queries(task.rows, merged.get(task.row["task"], []), count),
        )
        for task in single
    ]


def pair_queries(single: Sequence[Row], merged: Sequence[Row], count: int) -> QueryPairs:
    """At most `count` of the places with an image that misses, from the one that merging leaves
    farthest off to those that it finds first; evenly spaced in that order."""
    images: dict[str, list[Row]] = {}
    for row in sorted(single, key=lambda row: str(row["query"])):
        images.setdefault(row["location"], []).append(row)
    known = [row for row in merged if row["location"] in images]
    missed = [row for row in known if not all(is_hit(each) for each in images[row["location"]])]
    pairs = []
    for row in spread_over_locations(missed, count, error_order):
        of_place = images[row["location"]]
        keys = tuple(of_place[i]["query"] for i in evenly_spaced(len(of_place), MOSAIC_IMAGES))
        pairs.append(QueryPair(single=min(of_place, key=error_order), merged=row, images=keys))
    return QueryPairs(
        shown=tuple(pairs),
        places=len(missed),
        mended=sum(map(is_hit, missed)),
        lost=sum(not is_hit(row) for row in known if row not in missed),
    )
