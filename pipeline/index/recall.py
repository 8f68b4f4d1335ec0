"""Recall and speed of an index against exact search, and the search parameters that a recall needs.

Shapes: Q queries, K neighbours, D dimensions.
"""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, Protocol

import faiss
import numpy as np

from pipeline.core.arrays import Floats, Ints
from pipeline.core.prefetch import prefetch
from pipeline.features.table import FeatureTable
from pipeline.index.faiss_io import FAISS
from pipeline.index.metadata import SearchParams
from pipeline.index.part import NO_ROW
from pipeline.index.planning.families import Refine
from pipeline.index.planning.plan import RERANK_FACTOR
from pipeline.index.train import sample_rows

RECALL_QUERIES = 256
NEIGHBOURS = 10
MAX_EF_SEARCH = 1_024
"Of a graph: beyond, its recall hardly grows."
MAX_RERANK_FACTOR = 8 * RERANK_FACTOR
LIST_RATIOS = (0.9, 0.8, 0.7, 0.6, 0.5, 0.4, 0.3)
"Of SearchParams.list_ratio, from the fewest lists to the most."
TIMED_SECONDS = 0.1
"For which the batches of a finished index are timed, and its single queries."
MIN_TIMED, MAX_TIMED = 32, 1_024
"Batches whose times give p50 and p99."
Tuned = tuple[SearchParams, float, float]
"Search parameters with their recall@1 and recall@10."


@dataclass(frozen=True, kw_only=True)
class RecallQueries:
    """Queries with the rows that exact search finds for them."""

    queries_QD: Floats
    exact_QK: Ints
    own_row_Q: Ints
    "The query's own row, excluded from recall; NO_ROW if the query is not indexed."
    source: str
    "Where the queries are from."


class RowSearch(Protocol):
    """An opened index, or one that is tried in memory."""

    def search_rows(
        self, queries_QD: Floats, k: int = NEIGHBOURS, *, params: SearchParams | None = None
    ) -> tuple[Floats, Ints]: ...


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
    wanted = min(NEIGHBOURS + 1, sum(rows_of_part.values()))
    exact_QK = without_own_row(exact_search(queries_QD, indexed, wanted), own_row_Q)
    return RecallQueries(
        queries_QD=queries_QD, exact_QK=exact_QK, own_row_Q=own_row_Q, source=source
    )


def exact_search(queries_QD: Floats, table: FeatureTable, k: int) -> Ints:
    """Row numbers (Q, K) of the rows with the highest inner products, block by block."""
    heap = faiss.ResultHeap(len(queries_QD), k, keep_max=True)
    start = 0
    for block_BD in prefetch(table.blocks(), 1):
        nearest = min(k, len(block_BD))
        scores, rows = faiss.knn(queries_QD, block_BD, nearest, faiss.METRIC_INNER_PRODUCT)
        heap.add_result(scores, rows + start)
        start += len(block_BD)
    heap.finalize()
    rows_QK: Ints = heap.I
    return rows_QK


def without_own_row(rows_QK: Ints, own_row_Q: Ints) -> Ints:
    """Each query's rows but its own: one column fewer, the last one where its own is not there."""
    # Short lists give several NO_ROW, which are nobody's own.
    drop_QK = (rows_QK == own_row_Q[:, None]) & (rows_QK != NO_ROW)
    drop_QK[~drop_QK.any(axis=1), -1] = True
    return np.asarray(rows_QK[~drop_QK]).reshape(len(rows_QK), rows_QK.shape[1] - 1)


def measure_recall(
    index: RowSearch, queries: RecallQueries, params: SearchParams
) -> tuple[float, float]:
    """Shares of exact search's first row and of its first ten rows that the index finds."""
    exact_QK = queries.exact_QK
    k = exact_QK.shape[1]
    if not k:
        return 1.0, 1.0
    _, rows_QK = index.search_rows(queries.queries_QD, k + 1, params=params)
    found_QK = without_own_row(rows_QK, queries.own_row_Q)
    k = min(k, NEIGHBOURS)
    pairs = zip(exact_QK[:, :k].tolist(), found_QK[:, :k].tolist(), strict=True)
    at_10 = np.mean([len({*exact} & {*found}) / k for exact, found in pairs])
    return float((exact_QK[:, 0] == found_QK[:, 0]).mean()), float(at_10)


def search_param_grid(index: Any, refine: Refine) -> Iterator[SearchParams]:
    """The parameters of a kind of index, from the fastest search to the most thorough: nprobe or
    efSearch is doubled, then the number of reranked candidates.
    """
    ivf = FAISS.try_extract_index_ivf(index)
    breadth, most = (16, MAX_EF_SEARCH) if ivf is None else (1, ivf.nlist)
    factor = RERANK_FACTOR if refine == "table" else 1
    if ivf is None and not isinstance(FAISS.downcast_index(index), FAISS.IndexHNSW):
        breadth = most  # exact search has no such parameter
    while breadth < most:
        yield SearchParams(nprobe_or_ef=breadth, rerank_factor=factor)
        breadth *= 2
    yield SearchParams(nprobe_or_ef=most, rerank_factor=factor)
    while refine == "table" and factor < MAX_RERANK_FACTOR:
        factor *= 2
        yield SearchParams(nprobe_or_ef=most, rerank_factor=factor)


def tune(
    index: RowSearch,
    queries: RecallQueries,
    grid: Iterator[SearchParams],
    target: float,
    fast_enough: Callable[[SearchParams], bool] = lambda params: True,
) -> Tuned:
    """The first parameters of the grid that reach the target, with their recall@1 and @10; the best
    ones where none does. `fast_enough`: those that are not are left out, and those after them; the
    first of the grid is kept.
    """
    best = SearchParams(nprobe_or_ef=1), -1.0, -1.0
    for number, params in enumerate(grid):
        if number and not fast_enough(params):
            break
        tuned = params, *measure_recall(index, queries, params)
        if tuned[2] > best[2]:
            best = tuned
        if tuned[2] >= target:
            cheaper = cheaper_params(index, queries, tuned, target)
            return cheaper if fast_enough(cheaper[0]) else tuned
    return best


def cheaper_params(index: RowSearch, queries: RecallQueries, tuned: Tuned, target: float) -> Tuned:
    """Parameters of less work than the tuned ones that reach the target as well: twice the lists,
    of which easy queries skip most, where that reads fewer codes; then fewer reranked candidates.
    """
    codes = _codes_read(index, queries, tuned[0])
    for ratio in LIST_RATIOS if codes else ():
        params = replace(tuned[0], nprobe_or_ef=2 * tuned[0].nprobe_or_ef, list_ratio=ratio)
        if _codes_read(index, queries, params) >= codes:
            break
        skipping = params, *measure_recall(index, queries, params)
        if skipping[2] >= target:
            tuned = skipping
            break
    return _lower_rerank_factor(index, queries, tuned, target)


def _codes_read(index: RowSearch, queries: RecallQueries, params: SearchParams) -> int:
    """Codes in the lists that the queries look into, as FAISS counts them; 0 for other indexes."""
    stats = FAISS.cvar.indexIVF_stats
    stats.reset()
    index.search_rows(queries.queries_QD, NEIGHBOURS, params=params)
    return int(stats.ndis)


def _lower_rerank_factor(
    index: RowSearch, queries: RecallQueries, tuned: Tuned, target: float
) -> Tuned:
    """Halve the number of reranked candidates while the recall stays at the target: reading their
    vectors may be most of a search.
    """
    while tuned[0].rerank_factor >= 4:
        params = replace(tuned[0], rerank_factor=tuned[0].rerank_factor // 2)
        lower = params, *measure_recall(index, queries, params)
        if lower[2] < target:
            break
        tuned = lower
    return tuned


def measure_speed(
    search: Callable[[Floats], object],
    queries_QD: Floats,
    batch: int,
    seconds: float,
    clock: Callable[[], float] = time.perf_counter,
) -> dict[str, float]:
    """Queries a second, all in one batch; and milliseconds within which half and 99 of 100 batches
    of `batch` queries were answered. Each of the two is timed for so many seconds, the latency by
    at least MIN_TIMED batches.
    """
    start, rounds = clock(), 0
    while (spent := clock() - start) < seconds or not rounds:
        search(queries_QD)
        rounds += 1
    times: list[float] = []
    begin = clock()
    while len(times) < MIN_TIMED or (len(times) < MAX_TIMED and clock() - begin < seconds):
        rows_B = (len(times) * batch + np.arange(batch)) % len(queries_QD)
        batch_BD = queries_QD[rows_B]
        start = clock()
        search(batch_BD)
        times.append(clock() - start)
    p50, p99 = (float(np.quantile(times, share)) for share in (0.5, 0.99))
    return {
        "queries_per_second": round(rounds * len(queries_QD) / spent, 1),
        "p50_ms": round(1e3 * p50, 3),
        "p99_ms": round(1e3 * p99, 3),
        "timed_batches": len(times),
    }
