"""Embeddings that are made of parts: how many they are, and how two images agree part by part.
NumPy only, no I/O.

PVDA, LPN and their kin give each of P parts (our networks: square rings, from the centre outwards)
unit length, divide by sqrt(P) and lay them one behind the other. A feature table does not say P,
but its vectors do: each of P equal stretches has length 1/sqrt(P). Read off the vectors, it is
known of imported features too.

Shapes: B rows of a block, N vectors, P parts, D dimensions.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from pipeline.features.table import FeatureTable, Floats
from pipeline.retrieval.bootstrap import metrics_with_intervals
from pipeline.retrieval.metrics import Protocol
from pipeline.retrieval.ranking import BlockSizes, EmbeddingSet, rank_distributed
from pipeline.retrieval.tasks import Task, task_embedding_sets

MAX_PARTS = (
    16  # twice what the field's networks have; a vector of signs would else pass for D parts
)
PART_TOLERANCE = 2e-3
"""Of a part's length times sqrt(P): what float16 costs; ten times less than lengths of unmade parts
differ at 2,048 dimensions."""
PROBE_ROWS = 64  # by so many rows parts of equal length are no accident


def count_parts(vectors_ND: Floats) -> int:
    """The largest P up to 16 of which all these vectors have P stretches of equal length; 1 where
    there is none.
    """
    rows, dimension = vectors_ND.shape
    for parts in range(min(MAX_PARTS, dimension // 2), 1, -1):
        if rows and dimension % parts == 0:
            length_NP = np.linalg.norm(vectors_ND.reshape(rows, parts, -1), axis=2) * np.sqrt(parts)
            if np.abs(length_NP - 1).max() < PART_TOLERANCE:
                return parts
    return 1


def detect_parts(side: EmbeddingSet) -> int:
    """`count_parts` of a side's first rows."""
    first_BD = next(iter(side.blocks(PROBE_ROWS)), np.empty((0, 1), np.float32))
    return count_parts(first_BD)


def cosines_by_part(one_ND: Floats, other_ND: Floats, parts: int) -> Floats:
    """Cosine of each part with the same part of the other vector (N, P); their mean is the score."""
    split = (len(one_ND), parts, -1)
    return np.asarray(
        np.einsum("npd,npd->np", one_ND.reshape(split), other_ND.reshape(split)) * parts, np.float32
    )


def select_parts(side: EmbeddingSet, parts: int, kept: Sequence[int]) -> EmbeddingSet:
    """The side as if its embedding were these parts alone (numbered from 0), again of unit length."""
    scale = np.float32(np.sqrt(parts / len(kept)))

    def blocks(rows: int) -> Iterator[Floats]:
        for block_BD in side.blocks(rows):
            split_BPD = block_BD.reshape(len(block_BD), parts, -1)
            yield split_BPD[:, list(kept)].reshape(len(block_BD), -1) * scale

    return replace(side, blocks=blocks)


def measure_parts(
    task: Task,
    queries: FeatureTable,
    gallery: FeatureTable,
    protocol: Protocol = "full",
    workers: int = 0,
    advance: Callable[[int], None] = lambda scores: None,
    blocks: BlockSizes | None = None,
) -> list[dict[str, Any]]:
    """R@1, R@5 and AP with 95 % intervals, `kept` being "alone" (this part only) or "without" (all
    others).

    Of two parts the one without the other is that other alone, and is left out. Raises InputError as
    `retrieval.retrieve` does.
    """
    sides = task_embedding_sets(task, queries, gallery, protocol)
    parts = detect_parts(sides[0])
    if parts < 2 or detect_parts(sides[1]) != parts:
        return []
    every = tuple(range(parts))
    ways: list[tuple[str, int, tuple[int, ...]]] = [("alone", part, (part,)) for part in every]
    if parts > 2:
        ways += [
            ("without", part, tuple(other for other in every if other != part)) for part in every
        ]
    rows = []
    for kept, part, numbers in ways:
        asked, given = (select_parts(side, parts, numbers) for side in sides)
        found = rank_distributed(asked, given, 0, workers, advance, blocks)
        named = {
            "task": task.name,
            "protocol": protocol,
            "parts": parts,
            "part": part + 1,
            "kept": kept,
        }
        rows.append(named | metrics_with_intervals(found.first_rank_Q, found.ap_Q, asked.locations))
    return rows


def part_label(row: Mapping[str, Any]) -> str:
    """What one of these rows is of, where "part" stands beside it."""
    return f"{row['part']} alone" if row["kept"] == "alone" else f"all but {row['part']}"
