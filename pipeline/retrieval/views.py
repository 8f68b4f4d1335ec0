"""Retrieval by the number of views: how R@1 grows when a query is the mean of n images of its
place.

In: feature tables. Out: one row per n, for as many n of view_groups.VIEWS as every queried location
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
    """R@1 and AP with their 95 % intervals for each number of views a query; empty where no
    location has two.

    Raises InputError as `retrieval.retrieve` does.
    """
    query_side, gallery_side = task_embedding_sets(task, queries, gallery, protocol)
    numbers = possible_view_counts(query_side)
    rows = []
    for views in numbers if len(numbers) > 1 else []:
        grouped = mean_by_views(query_side, views)
        found = rank_distributed(grouped, gallery_side, 0, workers, advance, blocks)
        hit_Q = metrics.hits_at(1, found.first_rank_Q)
        low, high = confidence_intervals(
            np.stack([hit_Q, found.ap_Q], axis=1), grouped.locations
        ).tolist()
        rows.append({
            "task": task.name, "protocol": protocol, "views": views, "queries": len(grouped.keys),
            "r1": float(hit_Q.mean()), "r1_low": low[0], "r1_high": high[0],
            "ap": float(found.ap_Q.mean()), "ap_low": low[1], "ap_high": high[1],
        })  # fmt: skip
    return rows
