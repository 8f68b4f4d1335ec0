"""Measures of the queries by what is known of their images: per-query rows and shard records in,
one row per group out.

The records are those beside the shards (pipeline/shards/record_table.py), joined by key. Numbers
fall into bins with round edges, directions into eight sectors, anything else into its own values.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.compute as pc

from pipeline.core.errors import InputError
from pipeline.retrieval.bootstrap import metrics_with_intervals
from pipeline.shards import record_table
from pipeline.shards.shard_set import ShardSet

SECTORS = ("N", "NE", "E", "SE", "S", "SW", "W", "NW")
MAX_VALUES = 12  # a number with more values than a table shows well is binned
MAX_BINS = 6
UNKNOWN = "unknown"


def read_column(shards: ShardSet, column: str) -> dict[str, Any]:
    """What the records say of each key under one column.

    Raises InputError when there is no such column.
    """
    usable = [name for name in record_table.SCHEMA.names if name not in ("key", "footprint")]
    if column not in usable:
        raise InputError(
            f"--by is {column}, expected a column of the shards' records: {', '.join(usable)}"
        )
    return shards.column(column)


def break_down(results: pa.Table, column: str, known: dict[str, Any]) -> list[dict[str, Any]]:
    """R@1, R@5 and AP of each group of each single-query task, with the 95 % interval of R@1 and
    AP.

    `results`: rows of retrieval.RESULTS_SCHEMA. `known`: the column's value of each key.
    """
    single = results.filter(pc.invert(results["multi_query"]))
    rows: list[dict[str, Any]] = []
    for task in dict.fromkeys(
        zip(single["task"].to_pylist(), single["protocol"].to_pylist(), strict=True)
    ):
        mask = pc.and_(
            *(pc.equal(single[n], v) for n, v in zip(("task", "protocol"), task, strict=True))
        )
        mine = single.filter(mask)
        groups = group_names(column, [known.get(key) for key in mine["query"].to_pylist()])
        first_Q = mine["first_match_rank"].fill_null(0).to_numpy()
        ap_Q, locations_Q = mine["ap"].to_numpy(), np.asarray(mine["location"].to_pylist(), np.str_)
        for name in dict.fromkeys(groups[1]):
            here = groups[0] == name
            if here.any():
                rows.append(
                    {"task": task[0], "protocol": task[1], "by": column, "value": name}
                    | metrics_with_intervals(first_Q[here], ap_Q[here], locations_Q[here])
                )
    return rows


def group_names(column: str, values: Sequence[Any]) -> tuple[npt.NDArray[np.str_], list[str]]:
    """The group of each value, and all groups in the order in which to show them."""
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
    edges = round_edges(min(given), max(given))
    labels = [f"{low:g} to {high:g}" for low, high in pairwise(edges)]
    at = [
        -1 if v is None else min(int(np.searchsorted(edges, v, side="right")) - 1, len(labels) - 1)
        for v in values
    ]
    return np.array([UNKNOWN if i < 0 else labels[i] for i in at], np.str_), [*labels, UNKNOWN]


def round_edges(low: float, high: float) -> list[float]:
    """Edges of at most BINS bins of equal, round width (1, 2 or 5 times a power of ten) that
    enclose [low, high].
    """
    for exponent in range(int(np.floor(np.log10((high - low) / MAX_BINS))), 400):
        for unit in (1, 2, 5):
            width = unit * 10.0**exponent
            first, last = int(np.floor(low / width)), int(np.ceil(high / width))
            if last - first <= MAX_BINS:
                return [float(f"{i * width:.12g}") for i in range(first, last + 1)]
    raise AssertionError("unreachable: some width spans the whole range")
