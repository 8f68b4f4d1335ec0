"""Some rows of a side in memory: which ones, evenly spread, and their vectors out of the stream of all of them.

Shapes: N chosen rows, B rows of a block, D dimensions.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from pipeline.features import Floats, Words
from pipeline.metrics import Whole
from pipeline.ranking import Side

BLOCK_ROWS = 4_096  # 32 MB at 2,048 dimensions


@dataclass(frozen=True, kw_only=True)
class Chosen:
    """Rows of a side with their vectors."""

    keys_N: Words
    locations_N: Words
    vectors_ND: Floats


def taken(side: Side, rows_N: Whole) -> Chosen:
    """These rows, in the order asked for."""
    return Chosen(keys_N=side.keys[rows_N], locations_N=side.locations[rows_N], vectors_ND=vectors_of(side, rows_N))


def evenly(total: int, most: int) -> Whole:
    """At most `most` of the numbers below `total`, evenly spaced from the first to the last, ascending."""
    if total <= most:
        return np.arange(total)
    return np.round(np.linspace(0, total - 1, most)).astype(np.int64)


def vectors_of(side: Side, rows_N: Whole) -> Floats:
    """Vectors (N, D) of these rows, in the order asked for; the side is read once, no more than a block of it in memory."""
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


def vectors_by_key(side: Side, keys: Iterable[str]) -> dict[str, Floats]:
    """Vectors (D,) of the rows with these keys; keys that the side does not hold are absent."""
    rows_N = np.flatnonzero(np.isin(side.keys, np.array(sorted(keys), np.str_)))
    return dict(zip(side.keys[rows_N].tolist(), vectors_of(side, rows_N), strict=True)) if len(rows_N) else {}
