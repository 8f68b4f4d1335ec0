"""Several views as one query: vectors of a location's images in, their means at unit length out.

All of a location's images make one query (the paper's multi-query), or groups of n do, which tells how R@1 grows with the
number of views. Groups are the same in every run.
Shapes: B rows of a block, Q images, G groups, D dimensions.
"""

import numpy as np

from pipeline.features import Words
from pipeline.metrics import Whole
from pipeline.ranking import Side, side_of_array
from pipeline.scoring import on_grid

VIEWS = (1, 2, 3, 6, 9, 18, 27, 54)  # the divisors of University-1652's 54 views
MEAN_ROWS = 4_096  # rows added to their means at once: 64 MB of float64 at 2,048 dimensions


def mean_by_location(side: Side) -> Side:
    """One query per location: the mean of its vectors, brought to unit length; its key is the location's name."""
    names, location_Q = np.unique(side.locations, return_inverse=True)
    return mean_by_group(side, location_Q, names, names)


def views_possible(side: Side) -> list[int]:
    """Those of VIEWS that every location has enough images for, so that all are measured on the same locations."""
    _, count_L = np.unique(side.locations, return_counts=True)
    return [views for views in VIEWS if len(count_L) and views <= count_L.min()]


def mean_by_views(side: Side, views: int) -> Side:
    """Queries of `views` images each: of c images of a location, c // views groups, the rest left out.

    Ordered by key, which in University-1652 is the order of the flight, every (c // views)-th image goes to one group: each
    sees its place from all round.
    """
    order = np.lexsort((side.keys, side.locations))
    names, first_L, count_L = np.unique(side.locations[order], return_index=True, return_counts=True)
    location_Q = np.repeat(np.arange(len(names)), count_L)
    nth_Q = np.arange(len(order)) - first_L[location_Q]
    groups_L = count_L // views
    groups_Q = np.maximum(groups_L[location_Q], 1)
    used_Q = nth_Q < groups_L[location_Q] * views
    group_Q = np.empty(len(order), np.int64)
    group_Q[order] = np.where(used_Q, (np.cumsum(groups_L) - groups_L)[location_Q] + nth_Q % groups_Q, -1)
    locations_G = np.repeat(names, groups_L)
    keys_G = np.array([f"{name}#{i}" for name, groups in zip(names, groups_L, strict=True) for i in range(groups)])
    return mean_by_group(side, group_Q, keys_G, locations_G)


def mean_by_group(side: Side, group_Q: Whole, keys_G: Words, locations_G: Words) -> Side:
    """The mean at unit length of each group's vectors; rows of group -1 are left out."""
    total_GD, begin = np.zeros((len(keys_G), 0)), 0
    for block_BD in side.blocks(MEAN_ROWS):
        if not begin:
            total_GD = np.zeros((len(keys_G), block_BD.shape[1]))
        group_B = group_Q[begin : begin + len(block_BD)]
        begin += len(block_BD)
        order_B = np.argsort(group_B, kind="stable")[np.count_nonzero(group_B < 0) :]
        if len(order_B):
            groups, starts = np.unique(group_B[order_B], return_index=True)
            # Sums on the grid are exact, so the mean does not depend on the order of the rows either.
            total_GD[groups] += np.add.reduceat(on_grid(block_BD)[order_B].astype(np.float64), starts, axis=0)
    length_G1 = np.linalg.norm(total_GD, axis=1, keepdims=True)
    mean_GD = (total_GD / np.maximum(length_G1, np.finfo(np.float64).tiny)).astype(np.float32)
    return side_of_array(keys_G, locations_G, mean_GD)
