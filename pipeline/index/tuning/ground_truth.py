"""Queries with the rows that exact search finds for them, by which an index is measured.

In: the feature table of an index. Out: some of its rows as queries, and the nearest rows of each:
in the whole index, and in the half of it that its own place is not in.
Shapes: Q queries, K neighbours, N rows of the index, B rows of a block, D dimensions.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain

import faiss
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from pipeline.core.arrays import Floats, Ints, Mask
from pipeline.core.prefetch import prefetch
from pipeline.features.table import FeatureTable
from pipeline.index.part import NO_ROW
from pipeline.index.searcher import merge_results
from pipeline.index.train import sample_rows

RECALL_QUERIES = 256
NEIGHBOURS = 10
MIDDLE_SAMPLE = 65_536
"Rows whose locations tell the middle name."


@dataclass(frozen=True, kw_only=True)
class HiddenPlaces:
    """Each query with a filter that leaves half of the locations, its own not among them.

    What is left is then nearly all at one distance from the query, which is the hardest for coarse
    codes: all filters but those around a query's place do this to some of the queries.
    """

    half_N: Mask
    "The rows of one half of the locations; all others are of the other half."
    within_Q: Mask
    "Whether the query searches that half or the other one."
    exact_QK: Ints
    "The nearest rows in the half that it searches; NO_ROW where it has fewer."


@dataclass(frozen=True, kw_only=True)
class RecallQueries:
    """Queries with the rows that exact search finds for them."""

    queries_QD: Floats
    exact_QK: Ints
    own_row_Q: Ints
    "The query's own row, excluded from recall; NO_ROW if the query is not indexed."
    source: str
    "Where the queries are from."
    hidden: HiddenPlaces | None = None
    "None where filtered searches are not measured."


def sample_queries(
    indexed: FeatureTable, rows_of_part: dict[str, int], others: FeatureTable | None
) -> RecallQueries:
    """Queries for an index of a table: rows of `others`, else the table's own rows, which are then
    excluded from their own recall.
    """
    if others is not None and others.rows:
        counts = {part: len(rows) for part, rows in others.numbered_rows(["view"])}
        row_Q, queries_QD = sample_rows(others, counts, RECALL_QUERIES)
        own_row_Q = np.full_like(row_Q, NO_ROW)
        source = "rows of the table that are not indexed"
    else:
        own_row_Q, queries_QD = sample_rows(indexed, rows_of_part, RECALL_QUERIES)
        source = "rows of the index, each looking for others"
    half_N = _half_of_locations(indexed)
    found = _exact_by_half(queries_QD, indexed, half_N, NEIGHBOURS + 1)
    wanted = min(NEIGHBOURS + 1, len(half_N))
    nearest_QK = merge_results(found, wanted)[1]  # a query's own row is the first
    outside_QK, inside_QK = (without_own_row(rows_QK, own_row_Q) for _, rows_QK in found)
    within_Q = ~half_N[nearest_QK[:, 0]]
    return RecallQueries(
        queries_QD=queries_QD,
        exact_QK=without_own_row(nearest_QK, own_row_Q),
        own_row_Q=own_row_Q,
        source=source,
        hidden=HiddenPlaces(
            half_N=half_N,
            within_Q=within_Q,
            exact_QK=np.where(within_Q[:, None], inside_QK, outside_QK),
        ),
    )


def exact_search(queries_QD: Floats, table: FeatureTable, k: int) -> Ints:
    """Row numbers (Q, K) of the rows with the highest inner products, block by block."""
    (_, rows_QK), _ = _exact_by_half(queries_QD, table, np.zeros(table.rows, np.bool_), k)
    return rows_QK


def _exact_by_half(
    queries_QD: Floats, table: FeatureTable, half_N: Mask, k: int
) -> tuple[tuple[Floats, Ints], tuple[Floats, Ints]]:
    """Scores and row numbers (Q, K) of the nearest rows outside of the half and within it; NO_ROW
    where there are fewer. The table is read once.
    """
    heaps = [faiss.ResultHeap(len(queries_QD), k, keep_max=True) for _ in range(2)]
    start = 0
    for block_BD in prefetch(table.blocks(), 1):
        half_B = half_N[start : start + len(block_BD)]
        for heap, row_R in zip(heaps, map(np.flatnonzero, (~half_B, half_B)), strict=True):
            if not len(row_R):
                continue
            some_RD = block_BD if len(row_R) == len(block_BD) else block_BD[row_R]
            nearest = min(k, len(row_R))
            scores, rows = faiss.knn(queries_QD, some_RD, nearest, faiss.METRIC_INNER_PRODUCT)
            heap.add_result(scores, row_R[rows] + start)
        start += len(block_BD)
    for heap in heaps:
        heap.finalize()
    outside, inside = heaps
    return (outside.D, outside.I), (inside.D, inside.I)


def _half_of_locations(table: FeatureTable) -> Mask:
    """The rows whose location's name comes before the middle one of all rows' (N,): tiles of a map
    are named so that neighbours stay together. Read twice: kept, the names of a large gallery would
    be most of a memory budget.
    """
    every = -(-table.rows // MIDDLE_SAMPLE)
    some = sorted(chain.from_iterable(names[::every].to_pylist() for names in _locations(table)))
    middle = some[len(some) // 2]
    return np.concatenate([pc.less(names, middle).to_numpy() for names in _locations(table)])


def _locations(table: FeatureTable) -> Iterator[pa.ChunkedArray]:
    """The names of the rows' locations, part by part."""
    return (rows["location"] for _, rows in table.numbered_rows(["location"]))


def without_own_row(rows_QK: Ints, own_row_Q: Ints) -> Ints:
    """Each query's rows but its own: one column fewer, the last one where its own is not there."""
    # Short lists give several NO_ROW, which are nobody's own.
    drop_QK = (rows_QK == own_row_Q[:, None]) & (rows_QK != NO_ROW)
    drop_QK[~drop_QK.any(axis=1), -1] = True
    return np.asarray(rows_QK[~drop_QK]).reshape(len(rows_QK), rows_QK.shape[1] - 1)
