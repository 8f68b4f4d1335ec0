"""Exact ranking spread over a Ray cluster: the queries are cut into parts, each worker ranks the gallery for its own.

Scores are exact (pipeline/scoring.py), so the outcome is bit for bit that of one process, for any number of workers.
"""

from collections.abc import Callable, Iterator
from typing import Any

import ray

from pipeline import cluster
from pipeline.features import Floats
from pipeline.ranking import Blocks, Ranking, Side, joined, rank


def rank_spread(
    queries: Side, gallery: Side, top: int, workers: int, advance: Callable[[int], None], blocks: Blocks | None = None
) -> Ranking:
    """As `ranking.rank`, with `workers` Ray tasks of one core each; 0 ranks in this process.

    Each worker reads the gallery from its storage by itself, twice: where tables lie on one machine's disk, they must be
    reachable under the same path from the others.
    """
    count = len(queries.keys)
    if workers < 1 or count < 2:
        return rank(queries, gallery, top, blocks, advance)
    cluster.connect()
    cut = blocks or Blocks()
    rows = max(1, min(cut.held_queries, -(-count // workers)))
    parts = [(begin, min(begin + rows, count)) for begin in range(0, count, rows)]
    sides = ray.put((queries, gallery))
    found: dict[tuple[int, int], Ranking] = {}
    for part, ranking in cluster.bounded(lambda part: _rank_part.remote(sides, part, top, cut), parts, workers):
        found[part] = ranking
        advance((part[1] - part[0]) * len(gallery.keys))
    return joined([found[part] for part in parts])


def rows_between(side: Side, begin: int, end: int) -> Side:
    """Some consecutive rows of a side."""

    def blocks(rows: int) -> Iterator[Floats]:
        first = 0
        for block_BD in side.blocks(rows):
            if first >= end:
                return
            kept_BD = block_BD[max(begin - first, 0) : max(end - first, 0)]
            first += len(block_BD)
            if len(kept_BD):
                yield kept_BD

    return Side(keys=side.keys[begin:end], locations=side.locations[begin:end], blocks=blocks)


@ray.remote(num_cpus=1)
def _rank_part(sides: tuple[Side, Side], part: tuple[int, int], top: int, cut: Blocks) -> Any:
    queries, gallery = sides
    return rank(rows_between(queries, *part), gallery, top, cut)
