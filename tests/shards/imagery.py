"""Made imagery, the settings to pack it with, and what a folder of shards holds afterwards."""

from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
from PIL import Image

from pipeline.shards.settings import PackingSettings
from pipeline.sources.university1652 import University1652

SOURCE = University1652()


def jpeg(path: Path, seed: int, side: int = 16) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    pixels = np.random.default_rng(seed).integers(0, 255, (side, side, 3), dtype=np.uint8)
    Image.fromarray(pixels).save(path, "JPEG")


def imagery(root: Path, locations: range = range(3)) -> Path:
    """One satellite image and four UAV images per location."""
    for location in locations:
        jpeg(root / f"train/satellite/{location:04d}/{location:04d}.jpg", 100 * location)
        for number in range(4):
            jpeg(
                root / f"train/drone/{location:04d}/image-{number:02d}.jpeg",
                100 * location + 1 + number,
            )
    return root


def packing(root: Path | str, out: Path | str, **changes: object) -> PackingSettings:
    given = {"root": str(root), "out": str(out), "samples_per_shard": 5, "workers": 0}
    return PackingSettings(**(given | changes))  # type: ignore[arg-type]


def content(out: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(out)): path.read_bytes()
        for path in sorted(out.rglob("*"))
        if path.is_file()
    }


def rejected(out: Path) -> list[tuple[str, str]]:
    return [
        (Path(row["path"]).name, row["reason"])
        for row in pq.read_table(out / "rejected.parquet").to_pylist()
    ]
