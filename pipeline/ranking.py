"""Exact retrieval: queries and a gallery in, the rank of every true match, average precision and the top k out.

The full score matrix never exists: the gallery is read twice in blocks. The first pass scores the true matches alone,
the second counts what ranks ahead of each of them and keeps the k best. Both rest on one total order of gallery rows,
the same whatever the blocks: higher score first; at equal score the wrong rows before the true matches (see
pipeline/metrics.py on ties); then the gallery's order.

That order needs scores that do not depend on how the work was cut, and a BLAS product does: its last bit changes with
the shape of the block, so equal vectors would tie in one run and not in another. Here every component is first rounded
to a multiple of 2^-26. Products of such numbers are multiples of 2^-52 and, for unit vectors, no partial sum reaches 2,
so each one fits the 53 bits of a double: the float64 product is exact in any order of summation, on any machine. It is
then rounded to float32, the score that is ranked, stored and shown. The rounding moves a score by about 1e-8, less than
what a float32 product loses. benchmarks/retrieval.py measures what it costs.

Shapes: B gallery rows of a block, Q queries, P pairs of a query and a true match, D dimensions, K rows kept at the top.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from pipeline import metrics
from pipeline.features import Floats, Words
from pipeline.metrics import Doubles, Whole
from pipeline.records import InputError

GRID = np.float32(2.0**26)
ROW_BITS = 31  # an order key: 32 bits of score, 1 bit "wrong location", 31 bits of row (up to 2,147,483,648 rows)
LAST_ROW = 2**ROW_BITS - 1
WRONG = 1 << ROW_BITS
PAIR_ROWS = 4_096  # true matches scored at once: two float64 arrays of 64 MB at 2,048 dimensions
SORT_FROM = 24  # measured: from so many matches a query, sorting a row of keys beats comparing it with each match


@dataclass(frozen=True, kw_only=True)
class Side:
    """The queries or the gallery: names in memory, unit vectors in blocks."""

    keys: Words
    locations: Words
    blocks: Callable[[int], Iterator[Floats]]
    "Vectors of at most so many rows at a time, float32 (B, D), in the order of `keys`."


@dataclass(frozen=True, kw_only=True)
class Blocks:
    """How the work is cut. Changes memory and speed, never a result."""

    held_queries: int = 65_536
    "Queries in memory at once; the gallery is read twice for each such group. 0.5 GB at 2,048 dimensions."
    query_rows: int = 2_048
    "Queries of one product."
    gallery_rows: int = 4_096
    "Gallery rows of one product; 2,048 x 4,096 scores and keys take 170 MB."


@dataclass(frozen=True, kw_only=True)
class Ranking:
    """What came of each query, in the queries' order. Rows point into the gallery."""

    matches_Q: Whole
    "How many true matches the gallery holds."
    first_rank_Q: Whole
    "Rank of the best true match, from 1; 0 where there is none."
    first_row_Q: Whole
    "Its row; -1 where there is none."
    first_score_Q: Floats
    "Its score; NaN where there is none."
    ap_Q: Doubles
    top_rows_QK: Whole
    top_scores_QK: Floats


def side_of_array(keys: Words, locations: Words, vectors_QD: Floats) -> Side:
    """Vectors that are in memory."""

    def blocks(rows: int) -> Iterator[Floats]:
        return (vectors_QD[begin : begin + rows] for begin in range(0, len(vectors_QD), rows))

    return Side(keys=keys, locations=locations, blocks=blocks)


def rank(
    queries: Side,
    gallery: Side,
    top: int = 10,
    blocks: Blocks | None = None,
    advance: Callable[[int], None] = lambda scores: None,
) -> Ranking:
    """Rank the gallery for every query, exactly. `advance` is told how many scores have been settled.

    Raises InputError when a vector is not of unit length.
    """
    cut = blocks or Blocks()
    names, code = np.unique(np.concatenate([queries.locations, gallery.locations]), return_inverse=True)
    query_code, gallery_code = code[: len(queries.keys)], code[len(queries.keys) :]
    rows_by_code = np.argsort(gallery_code, kind="stable")
    count_by_code = np.bincount(gallery_code, minlength=len(names))
    begin_by_code = np.cumsum(count_by_code) - count_by_code
    groups, begin = [], 0
    for held_QD in _regrouped(queries.blocks(cut.held_queries), cut.held_queries):
        code_Q = query_code[begin : begin + len(held_QD)]
        matches_Q = count_by_code[code_Q]
        owner_P = np.repeat(np.arange(len(held_QD)), matches_Q)
        nth_P = np.arange(len(owner_P)) - np.repeat(np.cumsum(matches_Q) - matches_Q, matches_Q)
        row_P = rows_by_code[np.repeat(begin_by_code[code_Q], matches_Q) + nth_P]
        groups.append(_rank_held(held_QD, gallery, owner_P, row_P, min(top, len(gallery.keys)), cut, advance))
        begin += len(held_QD)
    fields = Ranking.__dataclass_fields__
    return Ranking(**{name: np.concatenate([getattr(group, name) for group in groups]) for name in fields})


def _rank_held(
    held_QD: Floats, gallery: Side, owner_P: Whole, row_P: Whole, top: int, cut: Blocks, advance: Callable[[int], None]
) -> Ranking:
    queries = len(held_QD)
    score_P = _scores_of_pairs(held_QD, gallery, owner_P, row_P, cut)
    key_P = _order_keys(score_P) | (LAST_ROW - row_P)
    ahead_P = np.zeros(len(owner_P), np.int64)
    best_QK = np.full((queries, top), np.iinfo(np.int64).min)
    begin = 0
    for block_BD in _regrouped(gallery.blocks(cut.gallery_rows), cut.gallery_rows):
        end = begin + len(block_BD)
        exact_DB = block_BD.astype(np.float64).T
        low_B = WRONG | (LAST_ROW - np.arange(begin, end))
        for first in range(0, queries, cut.query_rows):
            part = slice(first, min(first + cut.query_rows, queries))
            keys_QB = _order_keys((held_QD[part].astype(np.float64) @ exact_DB).astype(np.float32))
            keys_QB |= low_B
            pairs = slice(*np.searchsorted(owner_P, [part.start, part.stop]))
            here = (row_P[pairs] >= begin) & (row_P[pairs] < end)
            keys_QB[owner_P[pairs][here] - first, row_P[pairs][here] - begin] ^= WRONG
            ahead, best = _settle(keys_QB, owner_P[pairs] - first, key_P[pairs], top)
            ahead_P[pairs] += ahead
            best_QK[part] = np.sort(np.concatenate([best_QK[part], best], axis=1), axis=1)[:, -top:]
            advance(keys_QB.size)
        begin = end
    return _ranking(best_QK[:, ::-1], owner_P, row_P, score_P, ahead_P + 1)


def _scores_of_pairs(held_QD: Floats, gallery: Side, owner_P: Whole, row_P: Whole, cut: Blocks) -> Floats:
    """Scores of the true matches alone: bit for bit what the product of whole blocks gives, as both are exact."""
    by_row = np.argsort(row_P, kind="stable")
    sorted_P, score_P, begin = row_P[by_row], np.zeros(len(row_P), np.float32), 0
    for block_BD in _regrouped(gallery.blocks(cut.gallery_rows), cut.gallery_rows):
        low, high = np.searchsorted(sorted_P, [begin, begin + len(block_BD)])
        for first in range(low, high, PAIR_ROWS):
            pairs = by_row[first : min(first + PAIR_ROWS, high)]
            query_PD = held_QD[owner_P[pairs]].astype(np.float64)
            score_P[pairs] = np.einsum("pd,pd->p", query_PD, block_BD[row_P[pairs] - begin].astype(np.float64))
        begin += len(block_BD)
    return score_P


def _order_keys(scores: Floats) -> Whole:
    """Integers that order as the scores do, in the upper 32 bits of 64."""
    bits = (scores + np.float32(0)).view(np.int32)  # + 0 makes -0 and 0 one score
    bits ^= (bits >> 31) & 0x7FFFFFFF  # a float's bits order as integers do once the negative ones are turned round
    keys = bits.astype(np.int64)
    keys <<= 32
    return keys


def _settle(keys_QB: Whole, owner_P: Whole, key_P: Whole, top: int) -> tuple[Whole, Whole]:
    """For each pair the keys above its own, and for each query its best keys (Q, at most K), both of this block."""
    kept = min(top, keys_QB.shape[1])
    count_Q = np.bincount(owner_P, minlength=len(keys_QB))
    most = int(count_Q.max(initial=0))
    if most >= SORT_FROM:
        keys_QB.sort(axis=1)
        bounds = np.concatenate([[0], np.cumsum(count_Q)])
        ahead_P = np.empty(len(owner_P), np.int64)
        for row, low, high in zip(keys_QB, bounds[:-1], bounds[1:], strict=True):
            ahead_P[low:high] = len(row) - np.searchsorted(row, key_P[low:high], side="right")
        return ahead_P, keys_QB[:, -kept:]
    nth_P = np.arange(len(owner_P)) - (np.cumsum(count_Q) - count_Q)[owner_P]
    key_QM = np.full((len(keys_QB), most), np.iinfo(np.int64).max)
    key_QM[owner_P, nth_P] = key_P
    ahead_QM = np.zeros_like(key_QM)
    for m in range(most):
        ahead_QM[:, m] = np.count_nonzero(keys_QB > key_QM[:, m, None], axis=1)
    keys_QB.partition(keys_QB.shape[1] - kept, axis=1)
    return ahead_QM[owner_P, nth_P], keys_QB[:, -kept:]


def _ranking(best_QK: Whole, owner_P: Whole, row_P: Whole, score_P: Floats, rank_P: Whole) -> Ranking:
    queries = len(best_QK)
    order = np.lexsort((rank_P, owner_P))
    owner_P, row_P, score_P, rank_P = owner_P[order], row_P[order], score_P[order], rank_P[order]
    with_match, first = np.unique(owner_P, return_index=True)
    first_row_Q, first_score_Q = np.full(queries, -1), np.full(queries, np.nan, np.float32)
    first_row_Q[with_match], first_score_Q[with_match] = row_P[first], score_P[first]
    bits = (best_QK >> 32).astype(np.int32)
    return Ranking(
        matches_Q=np.bincount(owner_P, minlength=queries),
        first_rank_Q=metrics.first_match_ranks(rank_P, owner_P, queries),
        first_row_Q=first_row_Q,
        first_score_Q=first_score_Q,
        ap_Q=metrics.average_precisions(rank_P, owner_P, queries),
        top_rows_QK=LAST_ROW - (best_QK & LAST_ROW),
        top_scores_QK=(bits ^ ((bits >> 31) & 0x7FFFFFFF)).view(np.float32),
    )


def on_grid(vectors_BD: Floats) -> Floats:
    """Unit vectors with every component rounded to a multiple of 2^-26.

    Raises InputError when one is not of unit length, within the 1 % that float16 and rounding take.
    """
    length_B = np.sqrt(np.einsum("bd,bd->b", vectors_BD, vectors_BD))
    if not np.all(np.abs(length_B - 1) < 0.01):
        row = int(np.argmin(np.abs(length_B - 1) < 0.01))
        raise InputError(
            f"row {row} of a block of features has length {length_B[row]:.4g}; expected unit length; normalise the "
            "features, or embed the shards again with jobs/embed_gallery.py"
        )
    grid_BD = vectors_BD * GRID
    np.rint(grid_BD, out=grid_BD)
    grid_BD /= GRID
    return grid_BD


def _regrouped(blocks: Iterator[Floats], rows: int) -> Iterator[Floats]:
    """On the grid, in blocks of `rows` rows (the last one fewer): tables come in parts of any size."""
    waiting: list[Floats] = []
    count = 0
    for block_BD in blocks:
        waiting.append(on_grid(block_BD))
        count += len(block_BD)
        while count >= rows:
            whole_BD = np.concatenate(waiting)
            yield whole_BD[:rows]
            waiting, count = [whole_BD[rows:]], count - rows
    if count:
        yield np.concatenate(waiting)
