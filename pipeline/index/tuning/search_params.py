"""The search parameters of the least work that reach a recall.

In: an index, and queries with what exact search finds for them. Out: SearchParams.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from operator import itemgetter
from typing import Any

from pipeline.index.faiss_io import FAISS
from pipeline.index.metadata import SearchParams
from pipeline.index.planning.families import Refine
from pipeline.index.planning.plan import RERANK_FACTOR
from pipeline.index.searcher import Index
from pipeline.index.tuning.ground_truth import NEIGHBOURS, RecallQueries
from pipeline.index.tuning.recall import RowSearch, measure_filtered_recall, measure_recall

MAX_EF_SEARCH = 1_024
"Of a graph: beyond, its recall hardly grows."
MAX_RERANK_FACTOR = 8 * RERANK_FACTOR
MAX_HIDDEN_RERANK_FACTOR = 32 * RERANK_FACTOR
"""Where a filter hides a query's place: what is left is nearly all at one distance, the more rows
the more of it. 3,200 candidates are about what a narrow filter leaves to be scored one by one."""
LIST_RATIOS = (0.9, 0.8, 0.7, 0.6, 0.5, 0.4, 0.3)
"Of SearchParams.list_ratio, from the fewest lists to the most."
Tuned = tuple[SearchParams, float, float]
"Search parameters with their recall@1 and recall@10."


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
    grid: Iterable[SearchParams],
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


def tune_hidden(
    index: Index, queries: RecallQueries, params: SearchParams, target: float, most: int
) -> tuple[SearchParams, float]:
    """The same parameters with those for queries whose place a filter hides, and the recall@10 that
    these reach where it hides half of the locations, each query's own among them.

    Of twice the lists (or the graph's breadth, up to `most`) and twice the candidates the one that
    finds more is taken until the target is reached, or there are no more; then the best so far.
    """

    def measured(params: SearchParams) -> tuple[SearchParams, float]:
        return params, measure_filtered_recall(index, queries, params)

    last = measured(replace(params, hidden_nprobe_or_ef=min(most, 2 * params.nprobe_or_ef)))
    best = last
    while best[1] < target and (harder := [measured(one) for one in _harder(last[0], most)]):
        last = max(harder, key=itemgetter(1))
        best = max(best, last, key=itemgetter(1))
    return best


def _harder(params: SearchParams, most: int) -> Iterator[SearchParams]:
    breadth, factor = params.hidden_nprobe_or_ef or most, params.hidden_rerank_factor
    if breadth < most:
        yield replace(params, hidden_nprobe_or_ef=min(most, 2 * breadth))
    if params.rerank_factor > 1 and factor < MAX_HIDDEN_RERANK_FACTOR:
        yield replace(params, hidden_rerank_factor=2 * factor)
