"""A task as page and papers show it: its metric row, its charts, and the queries with pictures.

In: a metric row of an evaluation. Out: a `TaskView`, and of every task of single queries a
`PanelChoice`: hits, misses, and places whose single images are compared with all of them merged.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.core.arrays import Ints
from pipeline.report.charts import Chart, Row, recall_chart, scores_chart, views_chart
from pipeline.report.error_map import ErrorMap, distance_chart, error_map
from pipeline.report.inputs import EvaluationResults, ReportContext
from pipeline.report.panels import (
    MOSAIC_IMAGES,
    confidence_order,
    error_order,
    is_hit,
    panel_keys,
    spread_over_locations,
)
from pipeline.retrieval import metrics
from pipeline.retrieval.subsets import evenly_spaced

METRE_LABELS = {
    "within_1m": "≤ 1 m",
    "within_5m": "≤ 5 m",
    "within_25m": "≤ 25 m",
    "distance_median_m": "median",
    "distance_p90_m": "90 % within",
}
METRIC_LABELS = {"r1": "R@1", "r5": "R@5", "r10": "R@10", "r1p": "R@1%", "ap": "AP"}


@dataclass(frozen=True, kw_only=True)
class TaskView:
    """One task."""

    row: Row
    "Of tasks.METRICS_SCHEMA."
    rows: list[dict[str, Any]]
    "Its queries, rows of tasks.RESULTS_SCHEMA."
    name: str
    anchor: str
    query_view: str
    gallery_view: str
    other: Row | None
    "The metric row of the evaluation beside."
    first: int
    "Queries that have a true match first."
    unmatched: int
    "Queries without a true match in the gallery."
    chance: float
    "R@1 of a random ranking."
    one_percent: int
    "The K of the top 1 %."
    intervals: Mapping[str, tuple[float, float]]
    "95 % interval of each measure that has one."
    geo: Row | None
    "The metric row, if it has distances."
    recall: Chart
    views: Chart | None
    "R@1 by views per query; None if it was not measured."
    scores: Chart | None
    distances: Chart | None
    errors: ErrorMap | None
    "These three are None for merged queries, and where there is nothing to draw."

    @property
    def merged(self) -> bool:
        """Whether a query is all images of a location."""
        return bool(self.row["multi_query"])


def task_views(results: EvaluationResults, context: ReportContext) -> list[TaskView]:
    """Raises InputError if the evaluation beside ranked other images."""
    return [_task_view(row, results, context.beside) for row in results.metrics]


def _task_view(
    row: dict[str, Any], results: EvaluationResults, beside: EvaluationResults | None
) -> TaskView:
    rows, merged = results.rows_for(row), row["multi_query"]
    query_view, gallery_view = row["task"].split("->")
    name = f"{query_view} → {gallery_view}" + (", multi-query" if merged else "")
    other = beside.metrics_for(row) if beside else None
    matches_Q = np.array([each["matches"] for each in rows], np.int64)
    bounds = {
        measure: (row.get(f"{measure}_low"), row.get(f"{measure}_high"))
        for measure in METRIC_LABELS
    }
    views = [each for each in results.views if each["task"] == row["task"]]
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
        intervals={
            measure: (low, high)
            for measure, (low, high) in bounds.items()
            if low is not None and high is not None
        },
        geo=row if row.get("geo_queries") and "distance_p90_m" in row else None,
        recall=recall_chart(
            name,
            f"{row['queries']:,} queries, {row['gallery']:,} in the gallery",
            first_ranks(rows),
            row["gallery"],
            first_ranks(beside.rows_for(row)) if beside and other else None,
            beside.name if beside else "",
        ),
        views=None if merged else views_chart(f"{name}, R@1 by views a query", views),
        scores=None if merged else scores_chart(f"{name}, scores", rows),
        distances=None if merged else distance_chart(f"{name}, distance", rows),
        errors=None if merged else error_map(name, rows),
    )


def first_ranks(rows: list[dict[str, Any]]) -> Ints:
    """Rank of each query's best true match (Q,); 0 if it has none."""
    return np.array([row["first_match_rank"] or 0 for row in rows], np.int64)


@dataclass(frozen=True, kw_only=True)
class QueryPair:
    """A place queried by one image and by all."""

    single: Row
    "The image of the place whose true match ranks worst."
    merged: Row
    images: tuple[str, ...]
    "Keys of up to nine of its images, evenly spaced."


@dataclass(frozen=True, kw_only=True)
class QueryPairs:
    shown: tuple[QueryPair, ...]
    places: int
    "With at least one image that misses."
    fixed: int
    "Of these, found first by all images together."
    lost: int
    "Places that every image alone finds first, and all together do not."


@dataclass(frozen=True, kw_only=True)
class PanelChoice:
    """The queries of one task that are shown with pictures."""

    task: TaskView
    hits: list[Row]
    "From the highest best score to the lowest."
    misses: list[Row]
    "From the worst first rank to the best."
    pairs: QueryPairs

    @property
    def keys(self) -> set[str]:
        """Keys of all images on its panels."""
        rows = [
            *self.hits,
            *self.misses,
            *(row for pair in self.pairs.shown for row in (pair.single, pair.merged)),
        ]
        return panel_keys(rows) | {key for pair in self.pairs.shown for key in pair.images}


def choose_panels(tasks: Sequence[TaskView], count: int) -> list[PanelChoice]:
    """At most `count` hits, misses and pairs of each task of single queries."""
    merged = {task.row["task"]: task.rows for task in tasks if task.merged}
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
        for task in tasks
        if not task.merged
    ]


def pair_queries(single: Sequence[Row], merged: Sequence[Row], count: int) -> QueryPairs:
    """At most `count` of the places with an image that misses, ordered by the merged query's rank
    from the worst to the best, and evenly spaced in that order."""
    images: dict[str, list[Row]] = {}
    for row in sorted(single, key=lambda row: str(row["query"])):
        images.setdefault(row["location"], []).append(row)
    known = [row for row in merged if row["location"] in images]
    missed = [row for row in known if not all(is_hit(each) for each in images[row["location"]])]
    pairs = []
    for row in spread_over_locations(missed, count, error_order):
        own = images[row["location"]]
        keys = tuple(own[i]["query"] for i in evenly_spaced(len(own), MOSAIC_IMAGES))
        pairs.append(QueryPair(single=min(own, key=error_order), merged=row, images=keys))
    return QueryPairs(
        shown=tuple(pairs),
        places=len(missed),
        fixed=sum(map(is_hit, missed)),
        lost=sum(not is_hit(row) for row in known if row not in missed),
    )
