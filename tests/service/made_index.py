"""A small index, and an encoder whose photos say which location they show."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.camera.pose import Perspective
from pipeline.core.arrays import Floats, Pixels
from pipeline.features.part import PartFooter, PartRows, write_part
from pipeline.index.build import build_index
from pipeline.index.metadata import IndexMetadata
from pipeline.index.settings import IndexSettings
from pipeline.service.request import LocateRequest
from tests.service.photos import photo

DIMENSION = 8


def make_index(path: Path, rows: int, fingerprint: str = "f" * 64) -> Path:
    """An index of `rows` locations 1,000 m apart; the embedding of location n is the n-th unit
    vector."""
    table = path.with_name(f"{path.name}-table")
    embeddings_BD = np.eye(rows, DIMENSION, dtype=np.float32)
    part = PartRows(
        keys=[f"gallery-{n}" for n in range(rows)],
        locations=[f"place{n}" for n in range(rows)],
        views=["satellite"] * rows,
        splits=["gallery"] * rows,
        lats=[47 + 0.009 * n for n in range(rows)],
        lons=[8.0] * rows,
        embeddings_BD=embeddings_BD,
    )
    write_part(
        str(table / "a.parquet"),
        part,
        PartFooter(fingerprint=fingerprint, shard_sha256="s", rows=rows),
    )
    build_index(IndexSettings(table=str(table), out=str(path)))
    return path


class WidthEncoder:
    """Encodes a photo 16 + n pixels wide as location n."""

    perspective: Perspective = "as_taken"

    def __init__(self, metadata: IndexMetadata | None = None) -> None:
        self.batches: list[int] = []

    def to_input(self, image_HW3: Pixels) -> Pixels:
        return image_HW3

    def forward(self, images: Sequence[Pixels]) -> Floats:
        self.batches.append(len(images))
        numbers = [image_HW3.shape[1] - 16 for image_HW3 in images]
        return np.eye(DIMENSION, dtype=np.float32)[numbers].reshape(-1, DIMENSION)


def locate_request(number: int, **where: Any) -> LocateRequest:
    return LocateRequest(photo=photo(size=(16 + number, 16)), **where)
