"""Feature tables for the tests of the index: unit vectors in clusters, as real embeddings are."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pipeline.core.arrays import Floats
from pipeline.core.records import Split, View
from pipeline.features.part import PartFooter, PartRows, write_part
from pipeline.features.table import open_table
from pipeline.index.build import build_index
from pipeline.index.searcher import Index
from pipeline.index.settings import IndexSettings


def clustered(
    count: int, dimension: int, seed: int, clusters: int = 30, noise: float = 0.6
) -> Floats:
    """Unit vectors (count, dimension) around common centres."""
    rng = np.random.default_rng(seed)
    centres = np.random.default_rng(99).normal(size=(clusters, dimension))
    vectors = centres[rng.integers(0, clusters, count)] + noise * rng.normal(
        size=(count, dimension)
    )
    unit: Floats = (vectors / np.linalg.norm(vectors, axis=1, keepdims=True)).astype(np.float32)
    return unit


def write_table_part(
    table: Path,
    number: int,
    vectors: Floats,
    split: str = "gallery",
    view: str = "satellite",
    fingerprint: str = "f" * 64,
    dtype: str = "float32",
    locations: Sequence[str] | None = None,
    shard: str | None = None,
    sides_m: Sequence[float | None] | None = None,
) -> None:
    """A part whose i-th row lies i thousandths of a degree north of the equator, at the part's
    number in degrees east.
    """
    count = len(vectors)
    rows = PartRows(
        keys=[f"{split}-{number}-{n}" for n in range(count)],
        locations=locations or [f"{number}{n:04d}" for n in range(count)],
        views=[view] * count, splits=[split] * count, lats=[n / 1000 for n in range(count)],
        lons=[float(number) if n % 5 else None for n in range(count)], sides_m=sides_m,
        embeddings_BD=vectors,
    )  # fmt: skip
    footer = PartFooter(
        fingerprint=fingerprint, shard_sha256=shard or f"shard {number}", rows=count
    )
    write_part(str(table / f"{split}-{view}-{number:06d}.parquet"), rows, footer, dtype)


def write_gallery(
    table: Path,
    parts: int = 3,
    rows: int = 200,
    dimension: int = 32,
    first: int = 0,
    dtype: str = "float32",
) -> Path:
    """`parts` parts of satellite rows, and one of UAV queries."""
    for number in range(first, first + parts):
        write_table_part(table, number, clustered(rows, dimension, number), dtype=dtype)
    if not first:
        write_table_part(table, 0, clustered(40, dimension, 1000), "query", "drone", dtype=dtype)
    return table


def build(source: str, out: Path, **changes: object) -> Index:
    """The index of a table's satellite gallery, built and opened."""
    given = {
        "table": source,
        "out": str(out),
        "split": Split.GALLERY,
        "view": View.SATELLITE,
        "target_recall": 0.5,
    }
    build_index(IndexSettings(**(given | changes)))  # type: ignore[arg-type]
    return Index(str(out))


def answers(index: Index, table: str) -> list[list[tuple[str, float]]]:
    """Keys and scores of the hits of all queries of a table."""
    found = index.search(open_table(table).select(Split.QUERY).embeddings(), 8)
    return [[(hit.key, round(hit.score, 5)) for hit in hits] for hits in found]
