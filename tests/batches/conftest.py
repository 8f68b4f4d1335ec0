"""A small set of shards with images of one colour each."""

from dataclasses import asdict
from pathlib import Path

import pytest
from PIL import Image

from pipeline.batches.settings import StreamConfig
from pipeline.batches.training import Batch, TrainingStream
from pipeline.core import json_files, storage
from pipeline.core.records import ImageRecord, Split, View
from pipeline.images.augmentation import Augmentation
from pipeline.shards.manifest import MANIFEST, Manifest
from pipeline.shards.plan import ShardPlan
from pipeline.shards.shard_set import open_shards
from pipeline.shards.writer import write_shard
from pipeline.sources.university1652 import University1652

CLASSES = ("0003", "0008", "0839", "Aa")

SATELLITES, DRONES = 21, 40

PLAIN = StreamConfig(
    batch_size=4,
    image_size=8,
    augmentation=Augmentation(pad=0, rotation=0, mirror=False),
    threads=1,
)


def records(folder: Path, view: View, images: int) -> list[ImageRecord]:
    """Images of one colour each, spread over the classes."""
    found = []
    for number in range(images):
        path = folder / f"{view}-{number:03d}.png"
        Image.new("RGB", (9, 8), (number, 2 * number, list(View).index(view))).save(path)
        location = CLASSES[number % len(CLASSES)]
        found.append(ImageRecord(path=str(path), split=Split.TRAIN, view=view, location=location))
    return found


@pytest.fixture(scope="module")
def shards(tmp_path_factory: pytest.TempPathFactory) -> str:
    """21 satellite images in shards of 8, 8 and 5, and 40 UAV images in shards of 15, 15 and 10."""
    root = tmp_path_factory.mktemp("world")
    out, written = str(root / "shards"), []
    for view, images, size in ((View.SATELLITE, SATELLITES, 8), (View.DRONE, DRONES, 15)):
        every = records(root, view, images)
        for number, start in enumerate(range(0, images, size)):
            plan = ShardPlan(
                name=f"train-{view}-{number:06d}",
                split=Split.TRAIN,
                view=view,
                records=tuple(every[start : start + size]),
            )
            written.append(write_shard(plan, University1652(), out, "").shard)
    manifest = Manifest(shards=tuple(written), classes=CLASSES, packing={}, rejected=0)
    json_files.write_checksummed(storage.join(out, MANIFEST), asdict(manifest))
    return out


def keys(batches: list[tuple[Batch, Batch]], view: View) -> list[str]:
    return [key for pair in batches for batch in pair if batch.view == view for key in batch.keys]


def epoch(
    shards: str, number: int = 0, rank: int = 0, world: int = 1, reading: StreamConfig = PLAIN
) -> list[tuple[Batch, Batch]]:
    return list(TrainingStream(open_shards(shards), reading, rank, world).epoch(number))
