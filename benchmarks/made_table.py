"""Feature tables of made vectors, in clusters as images of places are."""

from pathlib import Path

import numpy as np

from pipeline.core.arrays import Floats
from pipeline.features.part import PartFooter, PartRows, write_part
from pipeline.index.tuning.ground_truth import RECALL_QUERIES

PART_ROWS = 16_384
IMAGES_PER_PLACE = 20
KINDS = 500
"Kinds of places: towns, woods, fields."


def synthetic_vectors(first: int, count: int, dimension: int, seed: int) -> Floats:
    """Unit vectors of rows first .. first + count.

    Cosines are near 0.5 between images of one place, near 0.2 between places of one kind.
    """
    kinds_KD = np.random.default_rng(0).standard_normal((KINDS, dimension), dtype=np.float32)
    place_N = (np.arange(first, first + count) // IMAGES_PER_PLACE).astype(np.int64)
    places, inverse_N = np.unique(place_N, return_inverse=True)
    own_PD = np.stack(
        [
            np.random.default_rng([1, int(p)]).standard_normal(dimension, dtype=np.float32)
            for p in places
        ]
    )
    own_PD = 0.8 * own_PD + 0.65 * kinds_KD[places % KINDS]
    vectors_ND = own_PD[inverse_N]
    vectors_ND += np.random.default_rng([2, seed, first]).standard_normal(
        vectors_ND.shape, dtype=np.float32
    )
    vectors_ND /= np.linalg.norm(vectors_ND, axis=1, keepdims=True)
    return vectors_ND


def write_rows(
    folder: Path, split: str, view: str, number: int, vectors_ND: Floats, first: int
) -> None:
    count = len(vectors_ND)
    rows = PartRows(
        keys=[f"{split}-{view}-{first + i:09d}" for i in range(count)],
        locations=[f"{(first + i) // IMAGES_PER_PLACE:07d}" for i in range(count)],
        views=[view] * count,
        splits=[split] * count,
        lats=[(first + i) % 1000 / 1e4 for i in range(count)],
        lons=[(first + i) // 1000 / 1e4 for i in range(count)],
        embeddings_BD=vectors_ND,
    )
    footer = PartFooter(fingerprint="f" * 64, shard_sha256=f"{number}", rows=count)
    write_part(str(folder / f"{split}-{view}-{number:06d}.parquet"), rows, footer, "float16")


def make_table(folder: Path, rows: int, dimension: int) -> None:
    """Write a float16 gallery of `rows` images, twenty per place, and queries of those places."""
    for number, first in enumerate(range(0, rows, PART_ROWS)):
        count = min(PART_ROWS, rows - first)
        vectors_ND = synthetic_vectors(first, count, dimension, 0)
        write_rows(folder, "gallery", "satellite", number, vectors_ND, first)
    spread = np.linspace(0, rows - 1, RECALL_QUERIES).astype(int)
    queries = np.concatenate([synthetic_vectors(int(first), 1, dimension, 1) for first in spread])
    write_rows(folder, "query", "drone", 0, queries, 0)
