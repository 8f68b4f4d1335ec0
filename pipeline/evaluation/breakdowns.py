"""Metrics by group: per-query rows and a column of the shards' records in, one row per group out.

The records are those beside the shards (shards/record_table.py), joined by key. Numbers fall into
bins with round edges, headings into eight sectors; any other value is a group of its own.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from pipeline.core.arrays import Strings
from pipeline.core.errors import require
from pipeline.report.charts import nice_ticks
from pipeline.retrieval.bootstrap import metrics_with_intervals
from pipeline.shards import record_table
from pipeline.shards.shard_set import ShardSet

SECTORS = ("N", "NE", "E", "SE", "S", "SW", "W", "NW")
MAX_VALUES = 12  # numbers with more distinct values are binned
MAX_BINS = 6
UNKNOWN = "unknown"


def read_column(shards: ShardSet, column: str) -> dict[str, Any]:
    """The value of one column of the shards' records, by key.

    Raises InputError if there is no such column.
    """
    usable = [name for name in record_table.SCHEMA.names if name not in ("key", "footprint")]
    expected = f"a column of the shards' records: {', '.join(usable)}"
    require(column in usable, "by", (column,), expected)
    return shards.column(column)


def break_down(results: pa.Table, column: str, values: dict[str, Any]) -> list[dict[str, Any]]:
    """R@1, R@5 and AP of each group of each single-query task, R@1 and AP with 95 % intervals.

    `results`: rows of tasks.RESULTS_SCHEMA. `values`: the column's value by key.
    """
    single = results.filter(pc.invert(results["multi_query"]))
    rows: list[dict[str, Any]] = []
    for task in dict.fromkeys(
        zip(single["task"].to_pylist(), single["protocol"].to_pylist(), strict=True)
    ):
        mask = pc.and_(
            *(pc.equal(single[n], v) for n, v in zip(("task", "protocol"), task, strict=True))
        )
        own = single.filter(mask)
        group_Q, order = group_names(column, [values.get(key) for key in own["query"].to_pylist()])
        first_Q = own["first_match_rank"].fill_null(0).to_numpy()
        ap_Q, locations_Q = own["ap"].to_numpy(), np.asarray(own["location"].to_pylist(), np.str_)
        for name in dict.fromkeys(order):
            in_group = group_Q == name
            if in_group.any():
                rows.append(
                    {"task": task[0], "protocol": task[1], "by": column, "value": name}
                    | metrics_with_intervals(
                        first_Q[in_group], ap_Q[in_group], locations_Q[in_group]
                    )
                )
    return rows


def group_names(column: str, values: Sequence[Any]) -> tuple[Strings, list[str]]:
    """The group of each value, and all groups in display order."""
    given = [value for value in values if value is not None]
    numeric = all(isinstance(value, int | float) for value in given)
    if column == "heading_deg":
        names = [UNKNOWN if v is None else SECTORS[round((v % 360) / 45) % 8] for v in values]
        return np.array(names, np.str_), [*SECTORS, UNKNOWN]
    if not numeric or len(set(given)) <= MAX_VALUES:
        names = [
            UNKNOWN if v is None else f"{v:g}" if isinstance(v, float) else str(v) for v in values
        ]
        in_order = sorted(set(given)) if numeric else sorted(set(given), key=str)
        return np.array(names, np.str_), [
            *(f"{v:g}" if isinstance(v, float) else str(v) for v in in_order),
            UNKNOWN,
        ]
    edges = nice_ticks(min(given), max(given), MAX_BINS)
    labels = [f"{low:g} to {high:g}" for low, high in pairwise(edges)]
    # Inner edges only, so that the outer bins take values that rounding puts beside the edges.
    names = [
        UNKNOWN if v is None else labels[int(np.searchsorted(edges[1:-1], v, side="right"))]
        for v in values
    ]
    return np.array(names, np.str_), [*labels, UNKNOWN]
