"""Single images by random access are those of a pass over the tars."""

import shutil
from pathlib import Path

import pytest

from pipeline.core.errors import InputError
from pipeline.core.records import Split, View
from pipeline.shards.shard_set import open_shards
from pipeline.shards.tile_reader import TileReader


def test_tile_reader_reads_what_a_pass_reads(tiny_shards: str) -> None:
    opened = open_shards(tiny_shards)
    [shard, *_] = opened.manifest.of(Split.GALLERY, View.SATELLITE)
    images = {sample.key: sample.data for sample in opened.samples(shard)}
    keys = list(images)
    reader = TileReader(opened)
    assert reader.fetch([*keys, "unknown"]) == images
    assert reader.fetch([]) == {}
    assert reader.footprints(keys) == {}
    assert TileReader(opened, View.DRONE).fetch(keys) == {}


def test_tile_reader_of_a_damaged_tar_names_the_remedy(tiny_shards: str, tmp_path: Path) -> None:
    copy = f"{tmp_path}/shards"
    shutil.copytree(tiny_shards, copy)
    opened = open_shards(copy)
    [shard, *_] = opened.manifest.of(Split.GALLERY, View.SATELLITE)
    keys = [sample.key for sample in opened.samples(shard)]
    with open(opened.tar(shard), "r+b") as tar:
        tar.write(b"\xff" * 512)
    with pytest.raises(InputError, match="cannot be read"):
        TileReader(opened).fetch(keys)
