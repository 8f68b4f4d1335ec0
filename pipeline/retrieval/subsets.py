"""Some rows of a side in memory: which ones, evenly spread, and their vectors out of the stream of
all of them.

Shapes: N chosen rows, B rows of a block, D dimensions.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from pipeline.core.arrays import Ints, Strings
from pipeline.features.table import Floats
from pipeline.retrieval.exact_scores import round_to_grid
from pipeline.retrieval.ranking import EmbeddingSet, embedding_set_from_array

BLOCK_ROWS = 4_096  # 32 MB at 2,048 dimensions


@dataclass(frozen=True, kw_only=True)
class RowSample:
    """Rows of a side with their vectors."""

    keys_N: Strings
    locations_N: Strings
    vectors_ND: Floats


def take_rows(side: EmbeddingSet, rows_N: Ints) -> RowSample:
    """These rows, in the order asked for."""
    return RowSample(
        keys_N=side.keys[rows_N],
        locations_N=side.locations[rows_N],
        vectors_ND=read_vectors(side, rows_N),
    )


def evenly_spaced(total: int, most: int) -> Ints:
    """At most `most` of the numbers below `total`, evenly spaced from the first to the last,
    ascending.
    """
    if total <= most:
        return np.arange(total)
    return np.round(np.linspace(0, total - 1, most)).astype(np.int64)


def read_vectors(side: EmbeddingSet, rows_N: Ints) -> Floats:
    """Vectors (N, D) of these rows, in the order asked for; the side is read once, no more than a
    block of it in memory.
    """
    order = np.argsort(rows_N, kind="stable")
    ascending_N = rows_N[order]
    found_ND, begin, done = np.empty((0, 0), np.float32), 0, 0
    for block_BD in side.blocks(BLOCK_ROWS):
        if not begin:
            found_ND = np.empty((len(rows_N), block_BD.shape[1]), np.float32)
        end = int(np.searchsorted(ascending_N, begin + len(block_BD)))
        found_ND[order[done:end]] = block_BD[ascending_N[done:end] - begin]
        begin, done = begin + len(block_BD), end
        if done == len(rows_N):
            break
    return found_ND


def vectors_by_key(side: EmbeddingSet, keys: Iterable[str]) -> dict[str, Floats]:
    """Vectors (D,) of the rows with these keys; keys that the side does not hold are absent."""
    rows_N = np.flatnonzero(np.isin(side.keys, np.array(sorted(keys), np.str_)))
    return (
        dict(zip(side.keys[rows_N].tolist(), read_vectors(side, rows_N), strict=True))
        if len(rows_N)
        else {}
    )


VIEW_COUNTS = (1, 2, 3, 6, 9, 18, 27, 54)  # the divisors of University-1652's 54 views
MEAN_BLOCK_ROWS = 4_096  # rows added to their means at once: 64 MB of float64 at 2,048 dimensions


def mean_by_location(side: EmbeddingSet) -> EmbeddingSet:
    """One query per location: the mean of its vectors, brought to unit length; its key is the
    location's name.
    """
    names, location_Q = np.unique(side.locations, return_inverse=True)
    return mean_by_group(side, location_Q, names, names)


def possible_view_counts(side: EmbeddingSet) -> list[int]:
    """Those of VIEWS that every location has enough images for, so that all are measured on the
    same locations.
    """
    _, count_L = np.unique(side.locations, return_counts=True)
    return [views for views in VIEW_COUNTS if len(count_L) and views <= count_L.min()]


def mean_by_views(side: EmbeddingSet, views: int) -> EmbeddingSet:
    """Queries of `views` images each: of c images of a location, c // views groups, the rest left
    out.

    Ordered by key, which in University-1652 is the order of the flight, every (c // views)-th image
    goes to one group: each sees its place from all round.
    """
    order = np.lexsort((side.keys, side.locations))
    names, first_L, count_L = np.unique(
        side.locations[order], return_index=True, return_counts=True
    )
    location_Q = np.repeat(np.arange(len(names)), count_L)
    nth_Q = np.arange(len(order)) - first_L[location_Q]
    groups_L = count_L // views
    groups_Q = np.maximum(groups_L[location_Q], 1)
    used_Q = nth_Q < groups_L[location_Q] * views
    group_Q = np.empty(len(order), np.int64)
    group_Q[order] = np.where(
        used_Q, (np.cumsum(groups_L) - groups_L)[location_Q] + nth_Q % groups_Q, -1
    )
    locations_G = np.repeat(names, groups_L)
    keys_G = np.array(
        [f"{name}#{i}" for name, groups in zip(names, groups_L, strict=True) for i in range(groups)]
    )
    return mean_by_group(side, group_Q, keys_G, locations_G)


def mean_by_group(
    side: EmbeddingSet, group_Q: Ints, keys_G: Strings, locations_G: Strings
) -> EmbeddingSet:
    """The mean at unit length of each group's vectors; rows of group -1 are left out."""
    total_GD, begin = np.zeros((len(keys_G), 0)), 0
    for block_BD in side.blocks(MEAN_BLOCK_ROWS):
        if not begin:
            total_GD = np.zeros((len(keys_G), block_BD.shape[1]))
        group_B = group_Q[begin : begin + len(block_BD)]
        begin += len(block_BD)
        order_B = np.argsort(group_B, kind="stable")[np.count_nonzero(group_B < 0) :]
        if len(order_B):
            groups, starts = np.unique(group_B[order_B], return_index=True)
            # Sums on the grid are exact, so the mean does not depend on the order of the rows
            # either.
            total_GD[groups] += np.add.reduceat(
                round_to_grid(block_BD)[order_B].astype(np.float64), starts, axis=0
            )
    length_G1 = np.linalg.norm(total_GD, axis=1, keepdims=True)
    mean_GD = (total_GD / np.maximum(length_G1, np.finfo(np.float64).tiny)).astype(np.float32)
    return embedding_set_from_array(keys_G, locations_G, mean_GD)
