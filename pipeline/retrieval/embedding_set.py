"""Queries or a gallery: keys and locations in memory, unit vectors read in blocks.

In: a feature table or an array. Out: an `EmbeddingSet`, or some rows of one. Shapes: B rows of a
block, D dimensions.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from pipeline.core.arrays import Doubles, Floats, Strings
from pipeline.features.table import FeatureTable


@dataclass(frozen=True, kw_only=True)
class EmbeddingSet:
    """The queries or the gallery: keys and locations in memory, unit vectors read in blocks."""

    keys: Strings
    locations: Strings
    blocks: Callable[[int], Iterator[Floats]]
    "Takes a number of rows, yields vectors of at most so many, float32 (B, D), in `keys`' order."
    positions: Doubles | None = None
    """Latitude and longitude of each row (rows, 2), degrees, NaN if unknown; None if not needed."""


def embedding_set_from_array(keys: Strings, locations: Strings, vectors_QD: Floats) -> EmbeddingSet:
    """An embedding set of vectors in memory."""

    def blocks(rows: int) -> Iterator[Floats]:
        return (vectors_QD[begin : begin + rows] for begin in range(0, len(vectors_QD), rows))

    return EmbeddingSet(keys=keys, locations=locations, blocks=blocks)


def embedding_set_from_table(table: FeatureTable) -> EmbeddingSet:
    """The selected rows of a feature table, with their positions."""
    labels = table.labels()
    return EmbeddingSet(
        keys=labels.keys,
        locations=labels.locations,
        blocks=table.blocks,
        positions=np.stack([labels.lats, labels.lons], axis=1),
    )


def filter_locations(embeddings: EmbeddingSet, locations: Strings) -> EmbeddingSet:
    """The rows of these locations: the gallery of the protocol `queried-only`."""
    keep = np.isin(embeddings.locations, locations)

    def blocks(rows: int) -> Iterator[Floats]:
        begin = 0
        for block_BD in embeddings.blocks(rows):
            kept_BD = block_BD[keep[begin : begin + len(block_BD)]]
            begin += len(block_BD)
            if len(kept_BD):
                yield kept_BD

    positions = None if embeddings.positions is None else embeddings.positions[keep]
    return EmbeddingSet(
        keys=embeddings.keys[keep],
        locations=embeddings.locations[keep],
        blocks=blocks,
        positions=positions,
    )


def slice_rows(embeddings: EmbeddingSet, begin: int, end: int) -> EmbeddingSet:
    """The rows from `begin` to before `end`, as `rank` needs them: without positions."""

    def blocks(rows: int) -> Iterator[Floats]:
        first = 0
        for block_BD in embeddings.blocks(rows):
            if first >= end:
                return
            kept_BD = block_BD[max(begin - first, 0) : max(end - first, 0)]
            first += len(block_BD)
            if len(kept_BD):
                yield kept_BD

    return EmbeddingSet(
        keys=embeddings.keys[begin:end], locations=embeddings.locations[begin:end], blocks=blocks
    )
