"""Recall and speed of an index against exact search.

Shapes: Q queries, K neighbours, D dimensions.
"""

import time
from collections.abc import Callable
from typing import Protocol

import numpy as np

from pipeline.core.arrays import Floats, Ints, Mask
from pipeline.index.metadata import SearchParams
from pipeline.index.part import NO_ROW
from pipeline.index.searcher import Index
from pipeline.index.tuning.ground_truth import NEIGHBOURS, RecallQueries, without_own_row

TIMED_SECONDS = 0.1
"For which the batches of a finished index are timed, and its single queries."
MIN_TIMED, MAX_TIMED = 32, 1_024
"Batches whose times give p50 and p99."


class RowSearch(Protocol):
    """An opened index, or one that is tried in memory."""

    def search_rows(
        self, queries_QD: Floats, k: int = NEIGHBOURS, *, params: SearchParams | None = None
    ) -> tuple[Floats, Ints]: ...


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
    at_10 = share_found(exact_QK[:, :NEIGHBOURS], found_QK[:, :NEIGHBOURS])
    return float((exact_QK[:, 0] == found_QK[:, 0]).mean()), at_10


def share_found(exact_QK: Ints, found_QK: Ints) -> float:
    """Recall@K: the share of exact search's rows that are among the found ones, whichever their
    order; 1 where there are none. NO_ROW counts as no row.
    """
    pairs = zip(exact_QK.tolist(), found_QK.tolist(), strict=True)
    found = sum(len({*exact} & {*rows} - {NO_ROW}) for exact, rows in pairs)
    of_all = np.count_nonzero(exact_QK != NO_ROW)
    return float(found / of_all) if of_all else 1.0


def measure_filtered_recall(index: Index, queries: RecallQueries, params: SearchParams) -> float:
    """Share of exact search's first ten rows that the index finds where a filter hides half of the
    locations, each query's own among them; 1 where the filters leave no rows.
    """
    assert queries.hidden is not None
    found_QK = np.full_like(queries.hidden.exact_QK, NO_ROW)
    for half in (False, True):
        some_Q = queries.hidden.within_Q == half
        if some_Q.any():
            allowed_N: Mask = queries.hidden.half_N == half
            _, rows_QK = index.search_rows(
                queries.queries_QD[some_Q], NEIGHBOURS + 1, allowed_N, params
            )
            found_QK[some_Q] = without_own_row(rows_QK, queries.own_row_Q[some_Q])
    return share_found(queries.hidden.exact_QK, found_QK)


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
