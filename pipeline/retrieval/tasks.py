"""Query table x gallery table -> one row per query and one row of measures per task.

In: selections of feature tables. Out: a task's result rows (Arrow) and its metric row (a dict),
named by task, protocol and whether a location's queries were merged into one. Shapes: B rows of a
block, Q queries, L locations, D dimensions.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa

from pipeline.core.arrays import Doubles, Ints, Strings
from pipeline.core.errors import InputError
from pipeline.core.geo import haversine_m
from pipeline.core.records import Split, View
from pipeline.features.table import FeatureTable, Floats
from pipeline.retrieval import geo_metrics, metrics
from pipeline.retrieval.bootstrap import confidence_intervals
from pipeline.retrieval.metrics import Protocol
from pipeline.retrieval.ranking import BlockSizes, EmbeddingSet, Ranking, rank_distributed
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
        # queries with a position; 0 where distances cannot be told, and then they are null
        ("geo_queries", pa.int64()),
        ("distance_median_m", pa.float64()),
        *((f"within_{metres}m", pa.float64()) for metres in geo_metrics.WITHIN_M),
        *((f"sdm{k}", pa.float64()) for k in geo_metrics.SDM_K),
    ]
)
RESULTS_SCHEMA = pa.schema(
    [
        ("query", pa.string()),  # the key; of merged queries, the location
        ("location", pa.string()),
        ("task", pa.string()),
        ("protocol", pa.string()),
        ("multi_query", pa.bool_()),
        ("matches", pa.int64()),  # true matches in the gallery
        # from 1; null where there is no match, and so are its key and score
        ("first_match_rank", pa.int64()),
        ("first_match_key", pa.string()),
        ("first_match_score", pa.float32()),
        ("ap", pa.float64()),
        ("top_keys", pa.list_(pa.string())),
        ("top_scores", pa.list_(pa.float32())),
        ("top_locations", pa.list_(pa.string())),
        # Where the query's place and the best answer lie, WGS84, and how far apart; null where unknown,
        # as of merged queries.
        *(
            (name, pa.float64())
            for name in ("lat", "lon", "answer_lat", "answer_lon", "distance_m")
        ),
    ]
)


@dataclass(frozen=True, kw_only=True)
class Task:
    """What is looked for in what."""

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
    """Every pair of two different views of which there are query rows and gallery rows,
    drone->satellite first.
    """
    query_views = [view for view in View if queries.counts.get((Split.QUERY, view))]
    gallery_views = [view for view in View if gallery.counts.get((Split.GALLERY, view))]
    return [
        Task(query_view=q, gallery_view=g) for q in query_views for g in gallery_views if q != g
    ]


def embedding_set_from_table(table: FeatureTable) -> EmbeddingSet:
    """The selected rows of a feature table."""
    labels = table.labels()
    places = np.stack([labels.lats, labels.lons], axis=1)
    return EmbeddingSet(
        keys=labels.keys, locations=labels.locations, blocks=table.blocks, positions=places
    )


def filter_locations(side: EmbeddingSet, locations: Strings) -> EmbeddingSet:
    """The rows that show one of these locations: the gallery of the protocol `queried-only`."""
    keep = np.isin(side.locations, locations)

    def blocks(rows: int) -> Iterator[Floats]:
        begin = 0
        for block_BD in side.blocks(rows):
            kept_BD = block_BD[keep[begin : begin + len(block_BD)]]
            begin += len(block_BD)
            if len(kept_BD):
                yield kept_BD

    places = None if side.positions is None else side.positions[keep]
    return EmbeddingSet(
        keys=side.keys[keep], locations=side.locations[keep], blocks=blocks, positions=places
    )


@dataclass(frozen=True, kw_only=True)
class TaskResults:
    """What came of one task."""

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
    """Rank and measure one task. `advance` is told how many scores have been settled; `workers` as
    in `rank_spread`.

    Raises InputError when no gallery row is left, or a feature is not of unit length.
    """
    query_side, gallery_side = task_embedding_sets(task, queries, gallery, protocol)
    found = rank_distributed(query_side, gallery_side, TOP_K, workers, advance, blocks)
    return TaskResults(
        metrics=_metric_row(task, protocol, query_side, gallery_side, found, queries.fingerprint),
        queries=_result_rows(task, protocol, query_side, gallery_side, found),
    )


def task_embedding_sets(
    task: Task, queries: FeatureTable, gallery: FeatureTable, protocol: Protocol
) -> tuple[EmbeddingSet, EmbeddingSet]:
    """What is ranked for what.

    Raises InputError when nothing is left of either.
    """
    query_side = embedding_set_from_table(queries.select(Split.QUERY, task.query_view))
    gallery_side = embedding_set_from_table(gallery.select(Split.GALLERY, task.gallery_view))
    if task.multi_query:
        query_side = mean_by_location(query_side)
    if protocol == "queried-only":
        gallery_side = filter_locations(gallery_side, query_side.locations)
    if not len(gallery_side.keys) or not len(query_side.keys):
        raise InputError(
            f"{task} has {len(query_side.keys)} queries and {len(gallery_side.keys)} gallery rows under the protocol "
            f"{protocol}; expected some of both, with location names in common; check the tables' splits and locations"
        )
    return query_side, gallery_side


def _metric_row(
    task: Task,
    protocol: Protocol,
    queries: EmbeddingSet,
    gallery: EmbeddingSet,
    found: Ranking,
    fingerprint: str,
) -> dict[str, Any]:
    scores = metrics.summarise(found.first_rank_Q, found.ap_Q, len(gallery.keys))
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
        metrics.per_query_values(found.first_rank_Q, found.ap_Q, len(gallery.keys)),
        queries.locations,
    )
    for name, (low, high) in zip(METRIC_NAMES, bounds.T.tolist(), strict=True):
        row |= {f"{name}_low": low, f"{name}_high": high}
    unknown = np.full((len(queries.keys), 2), np.nan)
    given = _positions(gallery)
    asked = unknown if np.isnan(given).any() else _positions(queries)
    return row | geo_metrics.distance_metrics(asked, given[found.top_rows_QK])


def _positions(side: EmbeddingSet) -> Doubles:
    return np.full((len(side.keys), 2), np.nan) if side.positions is None else side.positions


def _result_rows(
    task: Task, protocol: Protocol, queries: EmbeddingSet, gallery: EmbeddingSet, found: Ranking
) -> pa.Table:
    unmatched_Q = found.first_rank_Q == 0
    count, kept = found.top_rows_QK.shape
    asked_Q2, answer_Q2 = _positions(queries), _positions(gallery)[found.top_rows_QK[:, 0]]
    places_5Q = [*asked_Q2.T, *answer_Q2.T, haversine_m(asked_Q2, answer_Q2)]
    ends = pa.array(np.arange(count + 1) * kept, pa.int32())

    def lists(values_QK: Ints | Strings | Floats, kind: pa.DataType) -> pa.ListArray:
        return pa.ListArray.from_arrays(ends, pa.array(values_QK.ravel().tolist(), kind))

    columns = [
        pa.array(queries.keys.tolist(), pa.string()),
        pa.array(queries.locations.tolist(), pa.string()),
        pa.array([task.name] * count),
        pa.array([str(protocol)] * count),
        pa.array([task.multi_query] * count),
        pa.array(found.matches_Q),
        pa.array(found.first_rank_Q, mask=unmatched_Q),
        pa.array(gallery.keys[found.first_row_Q].tolist(), pa.string(), mask=unmatched_Q),
        pa.array(found.first_score_Q, mask=unmatched_Q),
        pa.array(found.ap_Q),
        lists(gallery.keys[found.top_rows_QK], pa.string()),
        lists(found.top_scores_QK, pa.float32()),
        lists(gallery.locations[found.top_rows_QK], pa.string()),
        # NaN becomes null
        *(pa.array(place_Q, pa.float64(), from_pandas=True) for place_Q in places_5Q),
    ]
    return pa.Table.from_arrays(columns, schema=RESULTS_SCHEMA)
