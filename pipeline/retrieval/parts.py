"""Embeddings made of parts: their number, what each part finds alone and all others without it, and
how similar two images are part by part.

PVDA, LPN and similar networks give each of P parts (ours: square rings, from the centre outwards)
unit length, divide it by sqrt(P) and concatenate them. A feature table does not record P, but its
vectors show it: each of P equal stretches has length 1/sqrt(P). Detected in the vectors, P is known
for imported features too.

Shapes: B rows of a block, N vectors, P parts, D dimensions.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from pipeline.core.arrays import Floats
from pipeline.features.table import FeatureTable
from pipeline.retrieval.bootstrap import metrics_with_intervals
from pipeline.retrieval.embedding_set import EmbeddingSet
from pipeline.retrieval.metrics import Protocol
from pipeline.retrieval.ranking import BlockSizes, rank_distributed
from pipeline.retrieval.tasks import Task, task_embedding_sets

# Twice what the field's networks have. Without a limit, a vector of +1 and -1 would have D parts.
MAX_PARTS = 16
PART_TOLERANCE = 2e-3
"""Error of a part's length times sqrt(P), which float16 explains; the lengths of arbitrary
stretches differ ten times as much at 2,048 dimensions."""
PROBE_ROWS = 64  # parts of equal length in so many rows are no coincidence


def count_parts(vectors_ND: Floats) -> int:
    """The largest P up to 16 for which all these vectors consist of P stretches of equal length; 1
    if there is none.
    """
    rows, dimension = vectors_ND.shape
    for parts in range(min(MAX_PARTS, dimension // 2), 1, -1):
        if rows and dimension % parts == 0:
            length_NP = np.linalg.norm(vectors_ND.reshape(rows, parts, -1), axis=2) * np.sqrt(parts)
            if np.abs(length_NP - 1).max() < PART_TOLERANCE:
                return parts
    return 1


def detect_parts(embeddings: EmbeddingSet) -> int:
    """`count_parts` of the first rows."""
    first_BD = next(iter(embeddings.blocks(PROBE_ROWS)), np.empty((0, 1), np.float32))
    return count_parts(first_BD)


def cosines_by_part(one_ND: Floats, other_ND: Floats, parts: int) -> Floats:
    """Cosine of each part with the same part of the other vector (N, P); the mean is the score."""
    split = (len(one_ND), parts, -1)
    return np.asarray(
        np.einsum("npd,npd->np", one_ND.reshape(split), other_ND.reshape(split)) * parts, np.float32
    )


def select_parts(embeddings: EmbeddingSet, parts: int, kept: Sequence[int]) -> EmbeddingSet:
    """The set with embeddings of these parts alone (numbered from 0), again at unit length."""
    scale = np.float32(np.sqrt(parts / len(kept)))

    def blocks(rows: int) -> Iterator[Floats]:
        for block_BD in embeddings.blocks(rows):
            split_BPD = block_BD.reshape(len(block_BD), parts, -1)
            yield split_BPD[:, list(kept)].reshape(len(block_BD), -1) * scale

    return replace(embeddings, blocks=blocks)


def measure_parts(
    task: Task,
    queries: FeatureTable,
    gallery: FeatureTable,
    protocol: Protocol = "full",
    workers: int = 0,
    advance: Callable[[int], None] = lambda scores: None,
    blocks: BlockSizes | None = None,
) -> list[dict[str, Any]]:
    """R@1, R@5 and AP with 95 % intervals for each part; `kept` is "alone" (this part only) or
    "without" (all others). Empty if the embeddings have no parts.

    Of two parts, all without one is the other alone, and is left out. Raises InputError as
    `tasks.retrieve` does.
    """
    both = task_embedding_sets(task, queries, gallery, protocol)
    parts = detect_parts(both[0])
    if parts < 2 or detect_parts(both[1]) != parts:
        return []
    every = tuple(range(parts))
    cases: list[tuple[str, int, tuple[int, ...]]] = [("alone", part, (part,)) for part in every]
    if parts > 2:
        cases += [
            ("without", part, tuple(other for other in every if other != part)) for part in every
        ]
    rows = []
    for kept, part, numbers in cases:
        query_set, gallery_set = (select_parts(each, parts, numbers) for each in both)
        ranking = rank_distributed(query_set, gallery_set, 0, workers, advance, blocks)
        labels = {
            "task": task.name,
            "protocol": protocol,
            "parts": parts,
            "part": part + 1,
            "kept": kept,
        }
        metrics = metrics_with_intervals(ranking.first_rank_Q, ranking.ap_Q, query_set.locations)
        rows.append(labels | metrics)
    return rows


def part_label(row: Mapping[str, Any]) -> str:
    """The label of one of these rows, under the heading "part"."""
    return f"{row['part']} alone" if row["kept"] == "alone" else f"all but {row['part']}"
