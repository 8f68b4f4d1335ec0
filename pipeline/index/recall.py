"""How well and how fast an index finds what exact search finds, and how hard it has to try for a
wanted recall.

Shapes: Q queries, K neighbours, D dimensions.
"""

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import faiss
import numpy as np

from pipeline.core.arrays import Ints
from pipeline.features.table import FeatureTable, Floats
from pipeline.index.metadata import SearchParams
from pipeline.index.part import NO_ROW
from pipeline.index.plan import RERANK_FACTOR, Refine
from pipeline.index.searcher import Index
from pipeline.index.train import sample_rows

FAISS: Any = faiss  # whose types know nothing of its keyword arguments
RECALL_QUERIES = 256
NEIGHBOURS = 10
MAX_EF_SEARCH = 1_024  # of a graph: beyond, it hardly gains
MAX_RERANK_FACTOR = 8 * RERANK_FACTOR
TIMED_SECONDS = 0.1
SINGLE_QUERIES = 32


@dataclass(frozen=True, kw_only=True)
class RecallQueries:
    """Queries with the rows that exact search finds for them."""

    queries_QD: Floats
    exact_QK: Ints
    own_row_Q: Ints
    """The row that is the query itself, which nobody is credited for; NOBODY where it is not in the
    index."""
    source: str
    "Where the queries are from."


def sample_queries(
    indexed: FeatureTable, rows_of_part: dict[str, int], others: FeatureTable | None
) -> RecallQueries:
    """Queries for an index of a table: rows of `others`, else its own rows, and then none counts as
    found by itself.
    """
    if others is not None and others.rows:
        counts = {part: len(rows) for part, rows in others.numbered(["view"])}
        numbers_Q, queries_QD = sample_rows(others, counts, RECALL_QUERIES)
        own_row_Q, source = (
            np.full_like(numbers_Q, NO_ROW),
            "rows of the table that are not indexed",
        )
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
    for block_BD in table.blocks():
        flat = faiss.IndexFlatIP(table.dimension)
        flat.add(block_BD)
        scores, rows = flat.search(queries_QD, min(k, len(block_BD)))
        heap.add_result(scores, rows + start)
        start += len(block_BD)
    heap.finalize()
    found: Ints = heap.I
    return found


def without_own_row(found_QK: Ints, own_row_Q: Ints) -> Ints:
    """Each query's rows but its own: one column fewer, the last one where its own is not there."""
    drop_QK = found_QK == own_row_Q[:, None]
    drop_QK[~drop_QK.any(axis=1), -1] = True
    return np.asarray(found_QK[~drop_QK]).reshape(len(found_QK), found_QK.shape[1] - 1)


def measure_recall(index: Index, held: RecallQueries, effort: SearchParams) -> tuple[float, float]:
    """Shares of exact search's first row and first ten rows that the index finds at this effort."""
    k = held.exact_QK.shape[1]
    if not k:
        return 1.0, 1.0
    found_QK = without_own_row(
        index.search_rows(held.queries_QD, k + 1, effort=effort)[1], held.own_row_Q
    )
    k = min(k, NEIGHBOURS)
    pairs = zip(held.exact_QK[:, :k].tolist(), found_QK[:, :k].tolist(), strict=True)
    return (
        float((held.exact_QK[:, 0] == found_QK[:, 0]).mean()),
        float(np.mean([len({*exact} & {*found}) / k for exact, found in pairs])),
    )


def search_param_grid(index: Any, refine: Refine) -> Iterator[SearchParams]:
    """From the least effort to the most for a kind of index: the breadth is doubled, then the
    candidates scored again.
    """
    ivf = FAISS.try_extract_index_ivf(index)
    breadth, most = (16, MAX_EF_SEARCH) if ivf is None else (1, ivf.nlist)
    candidates = RERANK_FACTOR if refine == "table" else 1
    if ivf is None and not isinstance(FAISS.downcast_index(index), FAISS.IndexHNSW):
        breadth = most  # looks at every row anyway
    while breadth < most:
        yield SearchParams(breadth=breadth, candidates=candidates)
        breadth *= 2
    yield SearchParams(breadth=most, candidates=candidates)
    while refine == "table" and candidates < MAX_RERANK_FACTOR:
        candidates *= 2
        yield SearchParams(breadth=most, candidates=candidates)


def tune(
    index: Index, held: RecallQueries, ladder: Iterator[SearchParams], target: float
) -> tuple[SearchParams, float, float]:
    """The least effort that reaches the target, with its recall@1 and @10; the best one where none
    does.
    """
    best = SearchParams(breadth=1), -1.0, -1.0
    for effort in ladder:
        found = effort, *measure_recall(index, held, effort)
        if found[2] > best[2]:
            best = found
        if found[2] >= target:
            return _lower_rerank_factor(index, held, found, target)
    return best


def _lower_rerank_factor(
    index: Index, held: RecallQueries, found: tuple[SearchParams, float, float], target: float
) -> tuple[SearchParams, float, float]:
    """Reading the candidates' vectors may be most of a search: half as many, as long as they do."""
    while found[0].candidates >= 4:
        effort = replace(found[0], candidates=found[0].candidates // 2)
        fewer = effort, *measure_recall(index, held, effort)
        if fewer[2] < target:
            break
        found = fewer
    return found


def measure_speed(index: Index, held: RecallQueries, effort: SearchParams) -> dict[str, float]:
    """Queries a second in one batch, and the median milliseconds of one alone, names included."""
    start, rounds = time.perf_counter(), 0
    while (spent := time.perf_counter() - start) < TIMED_SECONDS or not rounds:
        index.search(held.queries_QD, NEIGHBOURS, effort=effort)
        rounds += 1
    single = []
    for query_D in held.queries_QD[:SINGLE_QUERIES]:
        start = time.perf_counter()
        index.search(query_D[None], NEIGHBOURS, effort=effort)
        single.append(time.perf_counter() - start)
    return {
        "queries_per_second": round(rounds * len(held.queries_QD) / spent, 1),
        "milliseconds_per_query": round(1e3 * float(np.median(single)), 3),
    }
