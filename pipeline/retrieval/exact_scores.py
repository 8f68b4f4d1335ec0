"""Exact scores at the speed of float32 products: vectors of queries and of a gallery block in,
counts of better rows and the best rows out.

A score must not depend on how the work is divided, but a BLAS product does: its last bit changes
with the shape of the block, so equal vectors would tie in one run and not in another. So every
component is first rounded to a multiple of 2^-26. Products of such numbers are multiples of 2^-52
and, for unit vectors, no partial sum reaches 2, so each one fits the 53 bits of a double: the
float64 product is exact in any order of summation, on any machine. Rounded to float32 it is *the*
score, which is ranked, stored and shown.

Float64 products cost twice what float32 products do, and hardly any of them matters. A float32
product lies within `error_bound` of the score for any order of its sums, which decides already on
which side of a true match nearly every gallery row falls. Only uncertain rows, those nearer to a
match than the bound and those that may be among the best k, are scored exactly; where many are
uncertain (a network that gives all images nearly one vector) whole rows of the queries concerned
are multiplied in float64. The result is bit for bit that of float64 throughout.
benchmarks/evaluate.py measures the speed.

Shapes: Q queries, B gallery rows of a block, P pairs of a query and a true match, N or C entries of
a block, D dimensions.
"""

from collections.abc import Callable
from itertools import pairwise

import numpy as np

from pipeline.core.arrays import Doubles, Floats, Ints
from pipeline.core.errors import InputError

GRID_SCALE = np.float32(2.0**26)
STRIP_ROWS = 64  # rounded at a time: half a megabyte at 2,048 dimensions stays in a core's cache
LENGTH_TOLERANCE = 0.01  # of a vector's length around 1: what float16 and rounding change
UNIT_ROUNDOFF = 2.0**-24  # the largest relative error of one float32 operation
# Order key: 32 bits of score, 1 bit "wrong location", 31 bits of row (up to 2,147,483,648 rows).
ROW_BITS = 31
LAST_ROW = 2**ROW_BITS - 1
WRONG_BIT = 1 << ROW_BITS
NO_KEY = np.iinfo(np.int64).min
PAIR_BLOCK_ROWS = 128  # pairs at a time: 4 MB of float64 at 2,048 dimensions stay near the core
# Measured: below this number of entries per query, scoring pairs beats going query by query.
MAX_ENTRIES_BY_PAIR = 3
# Share of a block's entries up to which they are gathered and resolved apart; less for queries with
# many matches, each of which is compared with every gathered entry.
MAX_SPARSE_SHARE = 1 / 12
# Measured: from this share of uncertain entries, one float64 product of all beats row by row.
DENSE_FROM_SHARE = 1 / 32
# Measured: up to this number of matches near other rows, a scan for these rows beats an argsort.
MAX_SCANNED_BANDS = 12
# Measured: from this number of matches per query, sorting a row of scores beats comparing it with
# each match.
SORT_FROM_MATCHES = 6


def round_to_grid(vectors_BD: Floats) -> Floats:
    """Unit vectors with every component rounded to a multiple of 2^-26.

    Raises InputError if one is not of unit length, within the 1 % that float16 and rounding change.
    """
    grid_BD = np.empty_like(vectors_BD, np.float32)
    for first in range(0, len(vectors_BD), STRIP_ROWS):
        strip, out = vectors_BD[first : first + STRIP_ROWS], grid_BD[first : first + STRIP_ROWS]
        length_B = np.sqrt(np.einsum("bd,bd->b", strip, strip))
        unit_B = np.abs(length_B - 1) < LENGTH_TOLERANCE
        if not np.all(unit_B):
            row = int(np.argmin(unit_B))
            raise InputError(
                f"row {first + row} of a block of features has length {length_B[row]:.4g}; "
                "expected unit length; normalise the features, "
                "or embed the shards again with jobs/embed_gallery.py"
            )
        np.multiply(strip, GRID_SCALE, out=out)
        np.rint(out, out=out)
        np.multiply(out, 1 / GRID_SCALE, out=out)
    return grid_BD


def error_bound(dimension: int) -> float:
    """The largest difference between a float32 product of two rounded vectors and their score.

    The classic bound of an inner product, D u / (1 - D u) times the product of the lengths, holds
    for any order of summation, fused or not (Higham, Accuracy and Stability of Numerical
    Algorithms, 2nd ed., section 3.1); u = 2^-24. The score itself is rounded once. 1.2e-4 at 2,048
    dimensions; real errors are a hundred times smaller.
    """
    longest = 1 + 2 * LENGTH_TOLERANCE
    return longest**2 * (
        dimension * UNIT_ROUNDOFF / (1 - dimension * UNIT_ROUNDOFF) + UNIT_ROUNDOFF
    )


def lower_bound(score: Floats, bound: float) -> Floats:
    """The lowest float32 product whose score may reach `score`, rounded downwards."""
    return np.nextafter((score - np.float64(bound)).astype(np.float32), np.float32(-np.inf))


def upper_bound(score: Floats, bound: float) -> Floats:
    """The float32 product above which the score surely exceeds `score`, rounded upwards."""
    return np.nextafter((score + np.float64(bound)).astype(np.float32), np.float32(np.inf))


def exact_pairs(one_PD: Floats, other_PD: Floats) -> Floats:
    """Scores of rows with rows (P,), bit for bit those of a float64 product of the blocks, as both
    are exact.
    """
    doubled: Doubles = np.einsum("pd,pd->p", one_PD.astype(np.float64), other_PD.astype(np.float64))
    return doubled.astype(np.float32)


def exact_entries(queries_QD: Floats, gallery_BD: Floats, flat_N: Ints) -> Floats:
    """Scores of some entries of a block (Q, B), by ascending flat index (N,)."""
    query_N, row_N = np.divmod(flat_N, len(gallery_BD))
    starts = np.flatnonzero(np.diff(query_N, prepend=-1))
    used_Q = query_N[starts]
    if len(flat_N) > DENSE_FROM_SHARE * len(queries_QD) * len(gallery_BD):
        scores = queries_QD[used_Q].astype(np.float64) @ gallery_BD.astype(np.float64).T
        return np.asarray(scores[np.searchsorted(used_Q, query_N), row_N], np.float32)
    scores_N = np.empty(len(flat_N), np.float32)
    if len(flat_N) < MAX_ENTRIES_BY_PAIR * len(used_Q):
        for first in range(0, len(flat_N), PAIR_BLOCK_ROWS):
            some = slice(first, first + PAIR_BLOCK_ROWS)
            scores_N[some] = exact_pairs(queries_QD[query_N[some]], gallery_BD[row_N[some]])
        return scores_N
    for query, (begin, end) in zip(used_Q, pairwise([*starts.tolist(), len(flat_N)]), strict=True):
        rows_ND = gallery_BD[row_N[begin:end]].astype(np.float64)
        scores_N[begin:end] = rows_ND @ queries_QD[query].astype(np.float64)
    return scores_N


def resolve_scores(
    scores_QB: Floats,
    owner_P: Ints,
    score_P: Floats,
    bounds_P: tuple[Floats, Floats],
    floor_Q: Floats,
    exact: Callable[[Ints], Floats],
) -> tuple[Ints, Floats, Ints]:
    """A block's part in the ranking: flat indices of its uncertain entries (N,), their exact scores
    (N,), and for each match the number of its query's entries that score at least as high (P,).

    `scores_QB`: float32 products, minus infinity at true matches; overwritten. `score_P`,
    `bounds_P`: each match's score, and its `lower_bound` and `upper_bound`. `floor_Q`: the product
    from which a row may be among the best k. `exact`: `exact_entries` of this block.

    Most entries are neither uncertain nor ahead of a match, so those that reach a query's lowest
    bound are gathered first, in one pass over the block. If they are many, passes over all entries
    cost less.
    """
    lowest_Q = floor_Q.copy()
    np.minimum.at(lowest_Q, owner_P, bounds_P[0])
    reach_QB = scores_QB >= lowest_Q[:, None]
    if (
        np.count_nonzero(reach_QB) * (1 + _max_count(owner_P) / 32)
        <= MAX_SPARSE_SHARE * reach_QB.size
    ):
        return _resolve_sparse(
            scores_QB, np.flatnonzero(reach_QB), owner_P, score_P, bounds_P, floor_Q, exact
        )
    flat_N = uncertain_entries(scores_QB, owner_P, *bounds_P, floor_Q)
    exact_N = exact(flat_N)
    scores_QB.reshape(-1)[flat_N] = exact_N
    return flat_N, exact_N, count_ahead(scores_QB, owner_P, score_P)


def _resolve_sparse(
    scores_QB: Floats,
    flat_C: Ints,
    owner_P: Ints,
    score_P: Floats,
    bounds_P: tuple[Floats, Floats],
    floor_Q: Floats,
    exact: Callable[[Ints], Floats],
) -> tuple[Ints, Floats, Ints]:
    """`resolve_scores` from the C entries alone that reach their query's lowest bound."""
    score_C, query_C = scores_QB.reshape(-1)[flat_C], flat_C // scores_QB.shape[1]
    uncertain_C = score_C >= floor_Q[query_C]
    for low_Q1, high_Q1 in zip(
        *(_match_columns(owner_P, p, len(scores_QB)) for p in bounds_P), strict=True
    ):
        uncertain_C |= (score_C >= low_Q1[query_C, 0]) & (score_C <= high_Q1[query_C, 0])
    exact_N = exact(flat_C[uncertain_C])
    score_C[uncertain_C] = exact_N
    ahead_P = np.empty(len(owner_P), np.int64)
    nth_P = _index_within_owner(owner_P)
    for m, at_Q1 in enumerate(_match_columns(owner_P, score_P, len(scores_QB))):
        ahead_Q = np.bincount(query_C[score_C >= at_Q1[query_C, 0]], minlength=len(scores_QB))
        ahead_P[nth_P == m] = ahead_Q[owner_P[nth_P == m]]
    return flat_C[uncertain_C], exact_N, ahead_P


def uncertain_entries(
    scores_QB: Floats, owner_P: Ints, low_P: Floats, high_P: Floats, floor_Q: Floats
) -> Ints:
    """Flat indices, ascending, of the entries within [low, high] of a match of their query or at
    its floor and above.
    """
    uncertain_QB = scores_QB >= floor_Q[:, None]
    if _max_count(owner_P) < SORT_FROM_MATCHES:
        for low_Q1, high_Q1 in zip(
            *(_match_columns(owner_P, p, len(scores_QB)) for p in (low_P, high_P)), strict=True
        ):
            near_QB = scores_QB >= low_Q1
            near_QB &= scores_QB <= high_Q1
            uncertain_QB |= near_QB
        return np.flatnonzero(uncertain_QB)
    bounds = np.searchsorted(owner_P, np.arange(len(scores_QB) + 1))
    for query, (first, last) in enumerate(pairwise(bounds)):
        row_B = scores_QB[query]
        ordered_B = np.sort(row_B)
        begin_P = np.searchsorted(ordered_B, low_P[first:last])
        end_P = np.searchsorted(ordered_B, high_P[first:last], side="right")
        near_P = np.flatnonzero(end_P > begin_P)
        if len(near_P) <= MAX_SCANNED_BANDS:
            for low, high in zip(
                low_P[first:last][near_P], high_P[first:last][near_P], strict=True
            ):
                uncertain_QB[query] |= (row_B >= low) & (row_B <= high)
        else:
            width = len(row_B) + 1
            covered = np.cumsum(
                np.bincount(begin_P, minlength=width) - np.bincount(end_P, minlength=width)
            )
            uncertain_QB[query, np.argsort(row_B)[covered[:-1] > 0]] = True
    return np.flatnonzero(uncertain_QB)


def count_ahead(scores_QB: Floats, owner_P: Ints, score_P: Floats) -> Ints:
    """For each match, the number of its query's entries that score at least as high (P,)."""
    if _max_count(owner_P) < SORT_FROM_MATCHES:
        ahead_MQ = np.zeros((_max_count(owner_P), len(scores_QB)), np.int64)
        for m, at_Q1 in enumerate(_match_columns(owner_P, score_P, len(scores_QB))):
            ahead_MQ[m] = np.count_nonzero(scores_QB >= at_Q1, axis=1)
        return np.asarray(ahead_MQ[_index_within_owner(owner_P), owner_P])
    ahead_P = np.empty(len(owner_P), np.int64)
    bounds = np.searchsorted(owner_P, np.arange(len(scores_QB) + 1))
    for query, (first, last) in enumerate(pairwise(bounds)):
        ahead_P[first:last] = scores_QB.shape[1] - np.searchsorted(
            np.sort(scores_QB[query]), score_P[first:last]
        )
    return ahead_P


def order_keys(scores: Floats) -> Ints:
    """Integers that order as the scores do, in the upper 32 bits of 64."""
    bits = (scores + np.float32(0)).view(np.int32)  # + 0 makes -0 and 0 one score
    # A float's bits order as integers do once the negative ones are reversed.
    bits ^= (bits >> 31) & 0x7FFFFFFF
    return bits.astype(np.int64) << 32


def scores_from_keys(keys: Ints) -> Floats:
    """The scores that keys were made from; minus infinity for NO_KEY."""
    bits = (keys >> 32).astype(np.int32)
    scores = (bits ^ ((bits >> 31) & 0x7FFFFFFF)).view(np.float32)
    return np.where(keys == NO_KEY, np.float32(-np.inf), scores)


def merge_top_k(best_QK: Ints, owner_N: Ints, key_N: Ints) -> Ints:
    """The K highest keys of each query, ascending, of the best so far (Q, K) and new ones (N,) with
    ascending owners.
    """
    if not len(owner_N):
        return best_QK
    new_QN = np.full((len(best_QK), _max_count(owner_N)), NO_KEY)
    new_QN[owner_N, _index_within_owner(owner_N)] = key_N
    return np.sort(np.concatenate([best_QK, new_QN], axis=1), axis=1)[:, new_QN.shape[1] :]


def _max_count(owner_P: Ints) -> int:
    return int(np.bincount(owner_P).max(initial=0))


def _index_within_owner(owner_P: Ints) -> Ints:
    """Index of each entry among those of its owner, from 0."""
    count = np.bincount(owner_P)
    return np.asarray(np.arange(len(owner_P)) - (np.cumsum(count) - count)[owner_P])


def _match_columns(owner_P: Ints, value_P: Floats, queries: int) -> list[Floats]:
    """The first, second, ... value of each query as columns (Q, 1); infinity if it has fewer."""
    columns_MQ1 = np.full((_max_count(owner_P), queries, 1), np.inf, np.float32)
    columns_MQ1[_index_within_owner(owner_P), owner_P, 0] = value_P
    return list(columns_MQ1)
