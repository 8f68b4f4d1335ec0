"""Retrieval tasks: a query table and a gallery table -> one row per query and one row of metrics.

In: selections of feature tables. Out: a task's per-query rows (Arrow) and its metric row (a dict),
labelled with the task, the protocol and whether a location's queries were merged. Shapes: Q
queries, K answers of each.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa

from pipeline.core.arrays import Doubles, Floats, Ints, Strings
from pipeline.core.errors import InputError
from pipeline.core.geo import haversine_m
from pipeline.core.records import Split, View
from pipeline.features.table import FeatureTable
from pipeline.retrieval import geo_metrics, metrics
from pipeline.retrieval.bootstrap import confidence_intervals
from pipeline.retrieval.embedding_set import (
    EmbeddingSet,
    embedding_set_from_table,
    filter_locations,
)
from pipeline.retrieval.metrics import Protocol
from pipeline.retrieval.ranking import BlockSizes, Ranking, rank_distributed
from pipeline.retrieval.subsets import mean_by_location

TOP_K = 10
METRIC_NAMES = ("r1", "r5", "r10", "r1p", "ap")

METRICS_SCHEMA = pa.schema(
    [
        ("task", pa.string()),
        ("protocol", pa.string()),
        ("multi_query", pa.bool_()),
        ("queries", pa.int64()),
        ("gallery", pa.int64()),
        ("r1", pa.float64()),
        ("r5", pa.float64()),
        ("r10", pa.float64()),
        ("r1p", pa.float64()),
        ("ap", pa.float64()),
        ("fingerprint", pa.string()),
        # 95 % bootstrap over locations
        *((f"{name}_{end}", pa.float64()) for name in METRIC_NAMES for end in ("low", "high")),
        # queries with a position; 0 if distances are unknown, and then they are null
        ("geo_queries", pa.int64()),
        *((name, pa.float64()) for name in geo_metrics.QUANTILES),
        *((f"within_{metres}m", pa.float64()) for metres in geo_metrics.WITHIN_M),
        *(
            (f"{name}_{end}", pa.float64())
            for name in geo_metrics.WITH_INTERVALS
            for end in ("low", "high")
        ),
        *((f"sdm{k}", pa.float64()) for k in geo_metrics.SDM_K),
    ]
)
RESULTS_SCHEMA = pa.schema(
    [
        ("query", pa.string()),  # the key; for merged queries, the location
        ("location", pa.string()),
        ("task", pa.string()),
        ("protocol", pa.string()),
        ("multi_query", pa.bool_()),
        ("matches", pa.int64()),  # true matches in the gallery
        # from 1; null if there is no match, as are its key and score
        ("first_match_rank", pa.int64()),
        ("first_match_key", pa.string()),
        ("first_match_score", pa.float32()),
        ("ap", pa.float64()),
        ("top_keys", pa.list_(pa.string())),
        ("top_scores", pa.list_(pa.float32())),
        ("top_locations", pa.list_(pa.string())),
        # Positions of the query and of the best answer, WGS84, and their distance; null if
        # unknown, and for merged queries.
        *(
            (name, pa.float64())
            for name in ("lat", "lon", "answer_lat", "answer_lon", "distance_m")
        ),
    ]
)


@dataclass(frozen=True, kw_only=True)
class Task:
    """Which view is queried against which."""

    query_view: View
    gallery_view: View
    multi_query: bool = False
    "All queries of a location as one: their mean."

    @property
    def name(self) -> str:
        return f"{self.query_view}->{self.gallery_view}"

    def __str__(self) -> str:
        return f"{self.name}, multi-query" if self.multi_query else self.name


def possible_tasks(queries: FeatureTable, gallery: FeatureTable) -> list[Task]:
    """Every pair of different views with query and gallery rows, drone->satellite first."""
    query_views = [view for view in View if queries.counts.get((Split.QUERY, view))]
    gallery_views = [view for view in View if gallery.counts.get((Split.GALLERY, view))]
    return [
        Task(query_view=q, gallery_view=g) for q in query_views for g in gallery_views if q != g
    ]


@dataclass(frozen=True, kw_only=True)
class TaskResults:
    """The results of one task."""

    metrics: dict[str, Any]
    "One row of METRICS_SCHEMA."
    queries: pa.Table
    "Rows of RESULTS_SCHEMA, in the queries' order."


def retrieve(
    task: Task,
    queries: FeatureTable,
    gallery: FeatureTable,
    protocol: Protocol = "full",
    blocks: BlockSizes | None = None,
    advance: Callable[[int], None] = lambda scores: None,
    workers: int = 0,
) -> TaskResults:
    """Rank and measure one task. `advance` receives the number of scores computed since its last
    call; `workers` as in `rank_distributed`.

    Raises InputError if there are no queries or no gallery rows, or a feature is not of unit
    length.
    """
    query_set, gallery_set = task_embedding_sets(task, queries, gallery, protocol)
    ranking = rank_distributed(query_set, gallery_set, TOP_K, workers, advance, blocks)
    return TaskResults(
        metrics=_metric_row(task, protocol, query_set, gallery_set, ranking, queries.fingerprint),
        queries=_result_rows(task, protocol, query_set, gallery_set, ranking),
    )


def task_embedding_sets(
    task: Task, queries: FeatureTable, gallery: FeatureTable, protocol: Protocol
) -> tuple[EmbeddingSet, EmbeddingSet]:
    """The queries and the gallery of a task.

    Raises InputError if either has no rows.
    """
    query_set = embedding_set_from_table(queries.select(Split.QUERY, task.query_view))
    gallery_set = embedding_set_from_table(gallery.select(Split.GALLERY, task.gallery_view))
    if task.multi_query:
        query_set = mean_by_location(query_set)
    if protocol == "queried-only":
        gallery_set = filter_locations(gallery_set, query_set.locations)
    if not len(gallery_set.keys) or not len(query_set.keys):
        raise InputError(
            f"{task} has {len(query_set.keys)} queries and {len(gallery_set.keys)} gallery rows "
            f"under the protocol {protocol}; expected some of both, with location names in common; "
            "check the tables' splits and locations"
        )
    return query_set, gallery_set


def _metric_row(
    task: Task,
    protocol: Protocol,
    queries: EmbeddingSet,
    gallery: EmbeddingSet,
    ranking: Ranking,
    fingerprint: str,
) -> dict[str, Any]:
    scores = metrics.summarise(ranking.first_rank_Q, ranking.ap_Q, len(gallery.keys))
    row: dict[str, Any] = {
        "task": task.name,
        "protocol": protocol,
        "multi_query": task.multi_query,
        "queries": len(queries.keys),
        "gallery": len(gallery.keys),
        **{name: getattr(scores, name) for name in METRIC_NAMES},
        "fingerprint": fingerprint,
    }
    bounds = confidence_intervals(
        metrics.per_query_values(ranking.first_rank_Q, ranking.ap_Q, len(gallery.keys)),
        queries.locations,
    )
    for name, (low, high) in zip(METRIC_NAMES, bounds.T.tolist(), strict=True):
        row |= {f"{name}_low": low, f"{name}_high": high}
    answers_N2 = _positions(gallery)
    # With positions for a part of the gallery only, no distance is measured at all.
    unknown = bool(np.isnan(answers_N2).any())
    queries_Q2 = np.full((len(queries.keys), 2), np.nan) if unknown else _positions(queries)
    return row | geo_metrics.distance_metrics(
        queries_Q2, answers_N2[ranking.top_rows_QK], queries.locations
    )


def _positions(embeddings: EmbeddingSet) -> Doubles:
    return (
        np.full((len(embeddings.keys), 2), np.nan)
        if embeddings.positions is None
        else embeddings.positions
    )


def _result_rows(
    task: Task, protocol: Protocol, queries: EmbeddingSet, gallery: EmbeddingSet, ranking: Ranking
) -> pa.Table:
    unmatched_Q = ranking.first_rank_Q == 0
    count, top = ranking.top_rows_QK.shape
    query_Q2, answer_Q2 = _positions(queries), _positions(gallery)[ranking.top_rows_QK[:, 0]]
    positions_5Q = [*query_Q2.T, *answer_Q2.T, haversine_m(query_Q2, answer_Q2)]
    ends = pa.array(np.arange(count + 1) * top, pa.int32())

    def lists(values_QK: Ints | Strings | Floats, kind: pa.DataType) -> pa.ListArray:
        return pa.ListArray.from_arrays(ends, pa.array(values_QK.ravel().tolist(), kind))

    columns = [
        pa.array(queries.keys.tolist(), pa.string()),
        pa.array(queries.locations.tolist(), pa.string()),
        pa.array([task.name] * count),
        pa.array([str(protocol)] * count),
        pa.array([task.multi_query] * count),
        pa.array(ranking.matches_Q),
        pa.array(ranking.first_rank_Q, mask=unmatched_Q),
        pa.array(gallery.keys[ranking.first_row_Q].tolist(), pa.string(), mask=unmatched_Q),
        pa.array(ranking.first_score_Q, mask=unmatched_Q),
        pa.array(ranking.ap_Q),
        lists(gallery.keys[ranking.top_rows_QK], pa.string()),
        lists(ranking.top_scores_QK, pa.float32()),
        lists(gallery.locations[ranking.top_rows_QK], pa.string()),
        # NaN becomes null
        *(pa.array(values_Q, pa.float64(), from_pandas=True) for values_Q in positions_5Q),
    ]
    return pa.Table.from_arrays(columns, schema=RESULTS_SCHEMA)
