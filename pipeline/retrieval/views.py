"""Retrieval by number of views: R@1 and AP of queries that are the mean of n images of a location.

In: feature tables. Out: one row per n, for those of subsets.VIEW_COUNTS that every queried location
has images for.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import pyarrow as pa

from pipeline.features.table import FeatureTable
from pipeline.retrieval import metrics
from pipeline.retrieval.bootstrap import confidence_intervals
from pipeline.retrieval.metrics import Protocol
from pipeline.retrieval.ranking import BlockSizes, rank_distributed
from pipeline.retrieval.subsets import mean_by_views, possible_view_counts
from pipeline.retrieval.tasks import Task, task_embedding_sets

VIEWS_SCHEMA = pa.schema(
    [
        ("task", pa.string()),
        ("protocol", pa.string()),
        ("views", pa.int64()),
        ("queries", pa.int64()),
        *((f"{name}{end}", pa.float64()) for name in ("r1", "ap") for end in ("", "_low", "_high")),
    ]
)


def measure_views(
    task: Task,
    queries: FeatureTable,
    gallery: FeatureTable,
    protocol: Protocol = "full",
    workers: int = 0,
    advance: Callable[[int], None] = lambda scores: None,
    blocks: BlockSizes | None = None,
) -> list[dict[str, Any]]:
    """R@1 and AP with 95 % intervals for each number of views per query; empty if some location has
    a single image.

    Raises InputError as `tasks.retrieve` does.
    """
    query_set, gallery_set = task_embedding_sets(task, queries, gallery, protocol)
    numbers = possible_view_counts(query_set)
    rows = []
    for views in numbers if len(numbers) > 1 else []:
        grouped = mean_by_views(query_set, views)
        ranking = rank_distributed(grouped, gallery_set, 0, workers, advance, blocks)
        hit_Q = metrics.hits_at(1, ranking.first_rank_Q)
        low, high = confidence_intervals(
            np.stack([hit_Q, ranking.ap_Q], axis=1), grouped.locations
        ).tolist()
        rows.append(
            {
                "task": task.name,
                "protocol": protocol,
                "views": views,
                "queries": len(grouped.keys),
                "r1": float(hit_Q.mean()),
                "r1_low": low[0],
                "r1_high": high[0],
                "ap": float(ranking.ap_Q.mean()),
                "ap_low": low[1],
                "ap_high": high[1],
            }
        )
    return rows
