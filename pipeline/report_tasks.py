"""A task as the page shows it: a metric row and its queries in, a line of the table and the recall curve out."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline import metrics
from pipeline.metrics import Whole
from pipeline.report_charts import Chart, recall_chart
from pipeline.report_inputs import Extras
from pipeline.report_panels import is_hit

MEASURES = {"r1": "R@1", "r5": "R@5", "r10": "R@10", "r1p": "R@1%", "ap": "AP"}


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


def task_view(row: Mapping[str, Any], rows: list[dict[str, Any]], extras: Extras) -> TaskView:
    """Raises InputError when the evaluation beside ranked other images."""
    query_view, gallery_view = row["task"].split("->")
    other = extras.beside.of(dict(row)) if extras.beside else None
    matches_Q = np.array([each["matches"] for each in rows], np.int64)
    name = f"{query_view} → {gallery_view}" + (", multi-query" if row["multi_query"] else "")
    bounds = {measure: (row.get(f"{measure}_low"), row.get(f"{measure}_high")) for measure in MEASURES}
    return TaskView(
        row=row, rows=rows, name=name, anchor=name.replace(" → ", "-").replace(", ", "-"),
        query_view=query_view, gallery_view=gallery_view, other=other,
        first=sum(map(is_hit, rows)), unmatched=int(np.count_nonzero(matches_Q == 0)),
        chance=metrics.chance(matches_Q, row["gallery"]), one_percent=metrics.one_percent(row["gallery"]),
        sure={measure: (low, high) for measure, (low, high) in bounds.items() if low is not None and high is not None},
        geo=row if row.get("geo_queries") else None,
        chart=_recall_chart(name, row, rows, extras if other else None),
    )  # fmt: skip


def _recall_chart(name: str, row: Mapping[str, Any], rows: list[dict[str, Any]], extras: Extras | None) -> Chart:
    beside = extras.beside if extras else None
    beside_Q = first_ranks(beside.results_of(dict(row))) if beside else None
    note = f"{row['queries']:,} queries, {row['gallery']:,} in the gallery"
    return recall_chart(name, note, first_ranks(rows), row["gallery"], beside_Q, beside.name if beside else "")


def first_ranks(rows: list[dict[str, Any]]) -> Whole:
    """Rank of each query's best true match (Q,); 0 where it has none."""
    return np.array([row["first_match_rank"] or 0 for row in rows], np.int64)
