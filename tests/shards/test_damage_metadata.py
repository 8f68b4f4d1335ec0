"""Record tables and manifests of shards,
damaged by flipped bits, zeroed blocks, truncation and removal: rejected, or read as it was.
"""

from dataclasses import asdict
from pathlib import Path
from typing import Any

from pipeline.core import json_files
from pipeline.core.records import Rejection, Split, View
from pipeline.shards import record_table
from pipeline.shards.manifest import MANIFEST, Manifest, Shard, read_manifest
from pipeline.shards.record_table import Packed
from tests.damaging import (
    count_detected,
    raising_if_missing,
)


def test_record_part_damaged_does_not_count_as_done(tmp_path: Path) -> None:
    shard = Shard(
        name="train-drone-000000",
        split=Split.TRAIN,
        view=View.DRONE,
        samples=9,
        bytes=3,
        sha256="s" * 64,
    )
    packed = Packed(
        shard=shard,
        plan="p" * 64,
        rejected=(Rejection(path="x.jpg", reason="no image", found="text"),),
    )
    row = {
        "key": "k",
        "location": "a",
        "view": "drone",
        "split": "train",
        "variant": "",
        "shard": shard.name,
        "lat": 1.0,
        "footprint": [[1.0, 2.0]] * 4,
        "source": "table",
        "path": "/x.jpg",
        "part": "",
        "sha256": "h",
        "bytes": 3,
        "width": 2,
        "height": 2,
    }
    record_table.write_part(
        str(tmp_path), packed, [row | {"key": f"k{number}"} for number in range(9)]
    )
    path = tmp_path / record_table.FOLDER / f"{shard.name}.parquet"

    def look() -> Any:
        assert record_table.read_packed(str(tmp_path), shard.name) in (packed, None)
        return record_table.read_part(str(tmp_path), shard.name).to_pylist()

    assert count_detected(path, look, 300) > 200


def test_manifest_damaged_is_rejected(tmp_path: Path) -> None:
    shards = tuple(
        Shard(
            name=f"train-drone-{n:06d}",
            split=Split.TRAIN,
            view=View.DRONE,
            samples=n,
            bytes=n,
            sha256=f"{n:064x}",
        )
        for n in range(5)
    )
    manifest = Manifest(
        shards=shards, classes=("a", "b"), packing={"source": "table", "check": "quick"}, rejected=0
    )
    path = tmp_path / MANIFEST
    json_files.write_checksummed(str(path), asdict(manifest))
    look = raising_if_missing(path, lambda: asdict(read_manifest(str(tmp_path))))
    assert count_detected(path, look, 400) > 300
