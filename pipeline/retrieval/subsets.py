"""Subsets of an embedding set: evenly spaced rows with vectors, and means over groups of rows.

In: an `EmbeddingSet`, read once, block by block. Out: a `RowSample` in memory, or an
`EmbeddingSet` of one merged query per location or per group of views.

Shapes: N sampled rows, Q rows of the set, L locations, G groups, B rows of a block, D dimensions.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from pipeline.core.arrays import Floats, Ints, Strings
from pipeline.retrieval.embedding_set import EmbeddingSet, embedding_set_from_array
from pipeline.retrieval.exact_scores import round_to_grid

BLOCK_ROWS = 4_096  # 32 MB at 2,048 dimensions
MEAN_BLOCK_ROWS = 4_096  # added to their means at a time: 64 MB of float64 at 2,048 dimensions
VIEW_COUNTS = (1, 2, 3, 6, 9, 18, 27, 54)  # the divisors of University-1652's 54 views


@dataclass(frozen=True, kw_only=True)
class RowSample:
    """Some rows with their vectors."""

    keys_N: Strings
    locations_N: Strings
    vectors_ND: Floats


def take_rows(embeddings: EmbeddingSet, rows_N: Ints) -> RowSample:
    """These rows, in the given order."""
    return RowSample(
        keys_N=embeddings.keys[rows_N],
        locations_N=embeddings.locations[rows_N],
        vectors_ND=read_vectors(embeddings, rows_N),
    )


def evenly_spaced(total: int, most: int) -> Ints:
    """At most `most` of the numbers below `total`, ascending, evenly spaced from the first to the
    last.
    """
    if total <= most:
        return np.arange(total)
    return np.round(np.linspace(0, total - 1, most)).astype(np.int64)


def read_vectors(embeddings: EmbeddingSet, rows_N: Ints) -> Floats:
    """Vectors (N, D) of these rows, in the given order; the set is read once, with one block in
    memory.
    """
    order = np.argsort(rows_N, kind="stable")
    ascending_N = rows_N[order]
    vectors_ND, begin, done = np.empty((0, 0), np.float32), 0, 0
    for block_BD in embeddings.blocks(BLOCK_ROWS):
        if not begin:
            vectors_ND = np.empty((len(rows_N), block_BD.shape[1]), np.float32)
        end = int(np.searchsorted(ascending_N, begin + len(block_BD)))
        vectors_ND[order[done:end]] = block_BD[ascending_N[done:end] - begin]
        begin, done = begin + len(block_BD), end
        if done == len(rows_N):
            break
    return vectors_ND


def vectors_by_key(embeddings: EmbeddingSet, keys: Iterable[str]) -> dict[str, Floats]:
    """Vectors (D,) of the rows with these keys; keys that are not in the set are absent."""
    rows_N = np.flatnonzero(np.isin(embeddings.keys, np.array(sorted(keys), np.str_)))
    return (
        dict(zip(embeddings.keys[rows_N].tolist(), read_vectors(embeddings, rows_N), strict=True))
        if len(rows_N)
        else {}
    )


def mean_by_location(embeddings: EmbeddingSet) -> EmbeddingSet:
    """One query per location: the mean of its vectors at unit length; its key is the location's
    name.
    """
    names, location_Q = np.unique(embeddings.locations, return_inverse=True)
    return mean_by_group(embeddings, location_Q, names, names)


def possible_view_counts(embeddings: EmbeddingSet) -> list[int]:
    """Those of VIEW_COUNTS that every location has enough images for, so that all numbers are
    measured on the same locations.
    """
    _, count_L = np.unique(embeddings.locations, return_counts=True)
    return [views for views in VIEW_COUNTS if len(count_L) and views <= count_L.min()]


def mean_by_views(embeddings: EmbeddingSet, views: int) -> EmbeddingSet:
    """Merged queries of `views` images each: c // views groups of a location's c images; the
    remainder is left out.

    Ordered by key, which in University-1652 is the order of the flight, every (c // views)-th image
    goes to one group: each group sees its place from all sides.
    """
    order = np.lexsort((embeddings.keys, embeddings.locations))
    names, first_L, count_L = np.unique(
        embeddings.locations[order], return_index=True, return_counts=True
    )
    location_Q = np.repeat(np.arange(len(names)), count_L)
    index_Q = np.arange(len(order)) - first_L[location_Q]
    groups_L = count_L // views
    groups_Q = np.maximum(groups_L[location_Q], 1)
    used_Q = index_Q < groups_L[location_Q] * views
    group_Q = np.empty(len(order), np.int64)
    group_Q[order] = np.where(
        used_Q, (np.cumsum(groups_L) - groups_L)[location_Q] + index_Q % groups_Q, -1
    )
    locations_G = np.repeat(names, groups_L)
    keys_G = np.array(
        [f"{name}#{i}" for name, groups in zip(names, groups_L, strict=True) for i in range(groups)]
    )
    return mean_by_group(embeddings, group_Q, keys_G, locations_G)


def mean_by_group(
    embeddings: EmbeddingSet, group_Q: Ints, keys_G: Strings, locations_G: Strings
) -> EmbeddingSet:
    """The mean of each group's vectors at unit length; rows of group -1 are left out."""
    total_GD, begin = np.zeros((len(keys_G), 0)), 0
    for block_BD in embeddings.blocks(MEAN_BLOCK_ROWS):
        if not begin:
            total_GD = np.zeros((len(keys_G), block_BD.shape[1]))
        group_B = group_Q[begin : begin + len(block_BD)]
        begin += len(block_BD)
        order_B = np.argsort(group_B, kind="stable")[np.count_nonzero(group_B < 0) :]
        if len(order_B):
            groups, starts = np.unique(group_B[order_B], return_index=True)
            # Sums of rounded vectors are exact, so the mean does not depend on the rows' order.
            total_GD[groups] += np.add.reduceat(
                round_to_grid(block_BD)[order_B].astype(np.float64), starts, axis=0
            )
    length_G1 = np.linalg.norm(total_GD, axis=1, keepdims=True)
    mean_GD = (total_GD / np.maximum(length_G1, np.finfo(np.float64).tiny)).astype(np.float32)
    return embedding_set_from_array(keys_G, locations_G, mean_GD)
