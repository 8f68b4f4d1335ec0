"""Exact ranking: queries and a gallery in, the rank of every true match, average precision and the
top k out. In this process (`rank`) or on Ray workers (`rank_distributed`), with the same result.

The full score matrix never exists: the gallery is read twice in blocks. The first pass scores the
true matches alone, the second counts the rows ahead of each of them and keeps the k best. Both use
one total order of gallery rows, the same for any blocks: higher score first; at equal score the
wrong rows before the true matches (see metrics.py on ties); then the gallery's order. How scores
are both exact and fast: exact_scores.py.

Shapes: B gallery rows of a block, Q queries, P pairs of a query and a true match, D dimensions, K
rows kept at the top.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import ray

from pipeline.core import cluster
from pipeline.core.arrays import Doubles, Floats, Ints
from pipeline.core.prefetch import prefetch
from pipeline.retrieval import exact_scores, metrics
from pipeline.retrieval.embedding_set import EmbeddingSet, slice_rows
from pipeline.retrieval.exact_scores import LAST_ROW, NO_KEY, WRONG_BIT, round_to_grid

PREFETCH_BLOCKS = 1  # gallery blocks read ahead; each takes 34 MB at 2,048 dimensions


@dataclass(frozen=True, kw_only=True)
class BlockSizes:
    """How the work is divided. Changes memory and speed, never a result."""

    queries_in_memory: int = 65_536
    """The gallery is read twice for each group of so many. 0.5 GB at 2,048 dimensions."""
    query_rows: int = 2_048
    "Queries per matrix product."
    gallery_rows: int = 4_096
    "Gallery rows per matrix product; 2,048 x 4,096 scores take 33 MB."


@dataclass(frozen=True, kw_only=True)
class Ranking:
    """The result for each query, in the queries' order. Rows index the gallery."""

    matches_Q: Ints
    "Number of true matches in the gallery."
    first_rank_Q: Ints
    "Rank of the best true match, from 1; 0 if there is none."
    first_row_Q: Ints
    "Its row; -1 if there is none."
    first_score_Q: Floats
    "Its score; NaN if there is none."
    ap_Q: Doubles
    top_rows_QK: Ints
    top_scores_QK: Floats


def rank(
    queries: EmbeddingSet,
    gallery: EmbeddingSet,
    top: int = 10,
    blocks: BlockSizes | None = None,
    advance: Callable[[int], None] = lambda scores: None,
) -> Ranking:
    """Rank the gallery for every query, exactly. `advance` receives the number of scores computed
    since its last call.

    Raises InputError if a vector is not of unit length.
    """
    sizes = blocks or BlockSizes()
    names, code = np.unique(
        np.concatenate([queries.locations, gallery.locations]), return_inverse=True
    )
    query_code, gallery_code = code[: len(queries.keys)], code[len(queries.keys) :]
    rows_by_code = np.argsort(gallery_code, kind="stable")
    count_by_code = np.bincount(gallery_code, minlength=len(names))
    begin_by_code = np.cumsum(count_by_code) - count_by_code
    groups, begin = [], 0
    for group_QD in _rechunk(queries.blocks(sizes.queries_in_memory), sizes.queries_in_memory):
        code_Q = query_code[begin : begin + len(group_QD)]
        matches_Q = count_by_code[code_Q]
        owner_P = np.repeat(np.arange(len(group_QD)), matches_Q)
        index_P = np.arange(len(owner_P)) - np.repeat(np.cumsum(matches_Q) - matches_Q, matches_Q)
        row_P = rows_by_code[np.repeat(begin_by_code[code_Q], matches_Q) + index_P]
        groups.append(
            _rank_group(
                group_QD, gallery, owner_P, row_P, min(top, len(gallery.keys)), sizes, advance
            )
        )
        begin += len(group_QD)
    return concat_rankings(groups)


def concat_rankings(rankings: Sequence[Ranking]) -> Ranking:
    """The rankings of consecutive queries as one."""
    fields = Ranking.__dataclass_fields__
    return Ranking(
        **{name: np.concatenate([getattr(each, name) for each in rankings]) for name in fields}
    )


def _rank_group(
    group_QD: Floats,
    gallery: EmbeddingSet,
    owner_P: Ints,
    row_P: Ints,
    top: int,
    sizes: BlockSizes,
    advance: Callable[[int], None],
) -> Ranking:
    queries = len(group_QD)
    bound = exact_scores.error_bound(group_QD.shape[1])
    score_P = _match_scores(group_QD, gallery, owner_P, row_P, sizes)
    low_P, high_P = (
        exact_scores.lower_bound(score_P, bound),
        exact_scores.upper_bound(score_P, bound),
    )
    ahead_P = np.zeros(len(owner_P), np.int64)
    best_QK = np.full((queries, top), NO_KEY)
    buffer = np.empty(sizes.query_rows * sizes.gallery_rows, np.float32)
    begin = 0
    for block_BD in prefetch(
        _rechunk(gallery.blocks(sizes.gallery_rows), sizes.gallery_rows), PREFETCH_BLOCKS
    ):
        end = begin + len(block_BD)
        for first in range(0, queries, sizes.query_rows):
            part = slice(first, min(first + sizes.query_rows, queries))
            part_QD = group_QD[part]
            scores_QB = buffer[: len(part_QD) * len(block_BD)].reshape(len(part_QD), len(block_BD))
            np.matmul(part_QD, block_BD.T, out=scores_QB)
            pairs = slice(*np.searchsorted(owner_P, [part.start, part.stop]))
            owner, here = owner_P[pairs] - first, (row_P[pairs] >= begin) & (row_P[pairs] < end)
            # The true matches' scores are known; only wrong rows are counted.
            scores_QB[owner[here], row_P[pairs][here] - begin] = -np.inf
            flat_N, exact_N, ahead = exact_scores.resolve_scores(
                scores_QB,
                owner,
                score_P[pairs],
                (low_P[pairs], high_P[pairs]),
                _top_k_floors(scores_QB, best_QK[part], bound),
                partial(exact_scores.exact_entries, part_QD, block_BD),
            )
            ahead_P[pairs] += ahead
            query_N, in_block_N = np.divmod(flat_N, len(block_BD))
            key_N = exact_scores.order_keys(exact_N) | WRONG_BIT | (LAST_ROW - begin - in_block_N)
            better = key_N > best_QK[part][query_N, 0] if top else np.zeros(len(key_N), np.bool_)
            best_QK[part] = exact_scores.merge_top_k(best_QK[part], query_N[better], key_N[better])
            advance(scores_QB.size)
        begin = end
    return _make_ranking(best_QK, owner_P, row_P, score_P, ahead_P)


def _top_k_floors(scores_QB: Floats, best_QK: Ints, bound: float) -> Floats:
    """For each query the lowest float32 product that may be among the best K, given the best so far
    and this block's K-th product. Never minus infinity, which marks true matches."""
    top = best_QK.shape[1]
    if not top:
        return np.full(len(best_QK), np.inf, np.float32)
    floor_Q = exact_scores.lower_bound(exact_scores.scores_from_keys(best_QK[:, 0]), bound)
    if scores_QB.shape[1] >= top and np.isneginf(floor_Q).any():
        kth_Q = np.partition(scores_QB, -top, axis=1)[:, -top]
        floor_Q = np.maximum(floor_Q, exact_scores.lower_bound(kth_Q, 2 * bound))
    return np.maximum(floor_Q, np.finfo(np.float32).min)


def _match_scores(
    group_QD: Floats, gallery: EmbeddingSet, owner_P: Ints, row_P: Ints, sizes: BlockSizes
) -> Floats:
    """Scores of the true matches alone."""
    by_row = np.argsort(row_P, kind="stable")
    sorted_P, score_P, begin = row_P[by_row], np.zeros(len(row_P), np.float32), 0
    for block_BD in _rechunk(gallery.blocks(sizes.gallery_rows), sizes.gallery_rows):
        low, high = np.searchsorted(sorted_P, [begin, begin + len(block_BD)])
        for first in range(low, high, exact_scores.PAIR_BLOCK_ROWS):
            pairs = by_row[first : min(first + exact_scores.PAIR_BLOCK_ROWS, high)]
            score_P[pairs] = exact_scores.exact_pairs(
                group_QD[owner_P[pairs]], block_BD[row_P[pairs] - begin]
            )
        begin += len(block_BD)
    return score_P


def _make_ranking(
    best_QK: Ints, owner_P: Ints, row_P: Ints, score_P: Floats, ahead_P: Ints
) -> Ranking:
    """`ahead_P`: the wrong rows ahead of each match, to which the better matches of the same query
    are added here.
    """
    queries = len(best_QK)
    key_P = exact_scores.order_keys(score_P) | (LAST_ROW - row_P)
    order = np.lexsort((-key_P, owner_P))
    owner_P, row_P, score_P, key_P = owner_P[order], row_P[order], score_P[order], key_P[order]
    count_Q = np.bincount(owner_P, minlength=queries)
    nth_P = np.arange(len(owner_P)) - (np.cumsum(count_Q) - count_Q)[owner_P]
    rank_P = ahead_P[order] + nth_P + 1
    with_match, first = np.unique(owner_P, return_index=True)
    first_row_Q, first_score_Q = np.full(queries, -1), np.full(queries, np.nan, np.float32)
    first_row_Q[with_match], first_score_Q[with_match] = row_P[first], score_P[first]
    shown = nth_P < best_QK.shape[1]
    top_QK = exact_scores.merge_top_k(best_QK, owner_P[shown], key_P[shown])[:, ::-1]
    return Ranking(
        matches_Q=count_Q,
        first_rank_Q=metrics.first_match_ranks(rank_P, owner_P, queries),
        first_row_Q=first_row_Q,
        first_score_Q=first_score_Q,
        ap_Q=metrics.average_precisions(rank_P, owner_P, queries),
        top_rows_QK=LAST_ROW - (top_QK & LAST_ROW),
        top_scores_QK=exact_scores.scores_from_keys(top_QK),
    )


def _rechunk(blocks: Iterator[Floats], rows: int) -> Iterator[Floats]:
    """Blocks of any size as blocks of `rows` rows (the last one fewer), rounded to the grid."""
    buffered: list[Floats] = []
    count = 0
    for block_BD in blocks:
        buffered.append(round_to_grid(block_BD))
        count += len(block_BD)
        while count >= rows:
            joined_BD = _concatenate(buffered)
            yield joined_BD[:rows]
            buffered, count = [joined_BD[rows:]], count - rows
    if count:
        yield _concatenate(buffered)


def _concatenate(blocks: list[Floats]) -> Floats:
    filled = [block_BD for block_BD in blocks if len(block_BD)]
    return filled[0] if len(filled) == 1 else np.concatenate(filled)


def rank_distributed(
    queries: EmbeddingSet,
    gallery: EmbeddingSet,
    top: int,
    workers: int,
    advance: Callable[[int], None],
    blocks: BlockSizes | None = None,
) -> Ranking:
    """`rank` by `workers` Ray tasks of one core each; 0 ranks in this process.

    Each worker reads the gallery from storage by itself, twice: tables on one machine's disk must
    be reachable under the same path from the others.
    """
    count = len(queries.keys)
    if workers < 1 or count < 2:
        return rank(queries, gallery, top, blocks, advance)
    cluster.connect()
    sizes = blocks or BlockSizes()
    rows = max(1, min(sizes.queries_in_memory, -(-count // workers)))
    parts = [(begin, min(begin + rows, count)) for begin in range(0, count, rows)]
    shared = ray.put((queries, gallery))
    ranked: dict[tuple[int, int], Ranking] = {}
    for part, ranking in cluster.bounded_map(
        lambda part: _rank_part.remote(shared, part, top, sizes), parts, workers
    ):
        ranked[part] = ranking
        advance((part[1] - part[0]) * len(gallery.keys))
    return concat_rankings([ranked[part] for part in parts])


@ray.remote(num_cpus=1)
def _rank_part(
    shared: tuple[EmbeddingSet, EmbeddingSet], part: tuple[int, int], top: int, sizes: BlockSizes
) -> Any:
    queries, gallery = shared
    return rank(slice_rows(queries, *part), gallery, top, sizes)
